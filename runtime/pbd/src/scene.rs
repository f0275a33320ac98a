use crate::{Collider, PbdError, SoftBody};

/// Bodies and solids before the first step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scene {
    /// Deformable bodies, from one or several packages, each in its place.
    pub bodies: Vec<SoftBody>,
    /// Solids that they touch.
    pub colliders: Vec<Collider>,
}

impl Scene {
    /// A scene of these bodies and colliders.
    pub fn new(bodies: Vec<SoftBody>, colliders: Vec<Collider>) -> Self {
        Self { bodies, colliders }
    }

    /// Index of the collider with this name.
    ///
    /// # Errors
    /// [`PbdError::Unknown`] where there is none.
    pub fn collider(&self, name: &str) -> Result<usize, PbdError> {
        self.colliders
            .iter()
            .position(|c| c.name == name)
            .ok_or_else(|| PbdError::Unknown {
                kind: "collider",
                name: name.into(),
                known: self
                    .colliders
                    .iter()
                    .map(|c| c.name.as_str())
                    .collect::<Vec<_>>()
                    .join(", "),
            })
    }
}
