use serde::{Deserialize, Serialize};

/// What an image shows outside of the deformed meshes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Background {
    /// The fill value.
    Fixed,
    /// The scan as it was, without the organ: a place whose eight voxels hold a region's label gets the fill value, so that
    /// no ghost stays where the organ lay. Beyond the scan's crop the fill value. In packages without CT the nominal
    /// surroundings.
    #[default]
    Surroundings,
    /// What the nearest tet in the plane would show, up to one mean edge of its mesh away, then the fill value. Slower.
    Extrapolate,
}

/// Where a pixel's value is from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Source {
    /// A deformed tet and the scan.
    Mesh = 0,
    /// The undeformed scan around the organ.
    Surroundings = 1,
    /// The organ's rest place that the mesh has left: fill value.
    Vacated = 2,
    /// Outside of mesh and scan: fill value.
    Outside = 3,
    /// A deformed tet that carries no voxel of the scan's crop: fill value.
    BeyondScan = 4,
    /// Only inverted tets are here: fill value.
    Inverted = 5,
    /// Carried on from the nearest tet.
    Extrapolated = 6,
}

impl Source {
    /// All sources, in the order of their numbers.
    pub const ALL: [Self; 7] = [
        Self::Mesh,
        Self::Surroundings,
        Self::Vacated,
        Self::Outside,
        Self::BeyondScan,
        Self::Inverted,
        Self::Extrapolated,
    ];
}
