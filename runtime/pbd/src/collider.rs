//! Solids that particles touch.

mod convex;
mod grid;
mod solid;
#[cfg(test)]
mod tests;

pub use convex::Convex;
pub use grid::SignedDistanceGrid;
pub(crate) use solid::MeshSolid;

use crate::{PbdError, Pose, TriangleMesh};
use glam::Vec3;

/// Form of a collider in its own frame, mm.
#[derive(Clone, Debug, PartialEq)]
pub enum Shape {
    /// The half-space below z = 0: pushes along +z.
    Plane,
    /// One-sided triangles, which push towards the side from which they run counter-clockwise. Particles inside a
    /// closed mesh are pushed out.
    Mesh(TriangleMesh),
    /// Intersection of half-spaces.
    Convex(Convex),
    /// A box around the origin; each half extent above 0.
    Cuboid {
        /// mm.
        half_extents_mm: Vec3,
    },
    /// The inside of a signed distance field.
    Grid(SignedDistanceGrid),
    /// A ball around the origin.
    Sphere {
        /// mm.
        radius_mm: f32,
    },
    /// Everything within the radius of a segment on the z axis, centred at the origin.
    Capsule {
        /// Half of the segment's length, mm.
        half_length_mm: f32,
        /// mm.
        radius_mm: f32,
    },
}

/// A solid in the scene: fixed, or moved by [`crate::Solver::set_pose`].
#[derive(Clone, Debug, PartialEq)]
pub struct Collider {
    /// Name in reports.
    pub name: String,
    /// Form.
    pub shape: Shape,
    /// Placement at the start.
    pub pose: Pose,
    /// Whether it is meant to move. Where a particle touches more shapes than it has slots for contacts, shapes that
    /// do not move go first.
    pub moving: bool,
    /// Coulomb coefficient; absent: [`crate::Settings::shape_friction`].
    pub friction: Option<f64>,
    /// Distance kept to particle centres, mm; absent: by [`crate::Settings::collision_distance_factor`].
    pub collision_distance_mm: Option<f64>,
}

impl Collider {
    /// A solid that stays where it is.
    pub fn fixed(name: impl Into<String>, shape: Shape, pose: Pose) -> Self {
        Self {
            name: name.into(),
            shape,
            pose,
            moving: false,
            friction: None,
            collision_distance_mm: None,
        }
    }

    /// A solid that an instrument or script moves.
    pub fn moving(name: impl Into<String>, shape: Shape, pose: Pose) -> Self {
        Self {
            moving: true,
            ..Self::fixed(name, shape, pose)
        }
    }

    /// A fixed plane through a point, pushing along `normal`.
    pub fn plane(name: impl Into<String>, point: Vec3, normal: Vec3) -> Self {
        let n = normal.normalize_or(Vec3::Z);
        Self::fixed(
            name,
            Shape::Plane,
            Pose::new(glam::Quat::from_rotation_arc(Vec3::Z, n), point),
        )
    }
}

/// A particle's way over a substep in the frame of a shape.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Motion {
    /// Where it starts, in the shape's frame at the start.
    pub a: Vec3,
    /// Where it is predicted, in the shape's frame at the end.
    pub b: Vec3,
    /// Distance to keep.
    pub distance: f32,
    /// Distance up to which contacts are wanted.
    pub reach: f32,
}

/// Contact plane in the shape's frame: through `point`, pushing along `normal`.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct LocalContact {
    pub normal: Vec3,
    pub point: Vec3,
}

/// Up to eight contacts of one particle with one shape.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct LocalContacts {
    items: [LocalContact; 8],
    count: usize,
}

impl LocalContacts {
    pub(crate) fn push(&mut self, c: LocalContact) {
        if self.count < self.items.len() {
            self.items[self.count] = c;
            self.count += 1;
        }
    }

    pub(crate) fn as_slice(&self) -> &[LocalContact] {
        &self.items[..self.count]
    }
}

/// A checked shape, ready for queries.
#[derive(Clone, Debug)]
pub(crate) enum PreparedShape {
    Plane,
    Mesh(Box<(MeshSolid, SignedDistanceGrid)>),
    Convex(Convex),
    Cuboid(Vec3),
    Grid(SignedDistanceGrid),
    /// Half length (0 for a ball) and radius.
    Capsule(f32, f32),
}

impl PreparedShape {
    pub(crate) fn new(c: &Collider) -> Result<Self, PbdError> {
        let refuse = |found: String, expected| {
            Err(PbdError::Shape {
                name: c.name.clone(),
                found,
                expected,
            })
        };
        let size = |v: f32| v.is_finite() && v > 0.0 && v < 1e6;
        if !c.pose.is_finite() {
            return refuse(format!("pose {:?}", c.pose), "finite numbers");
        }
        let options = [
            ("friction", c.friction),
            ("collision distance", c.collision_distance_mm),
        ];
        for (what, v) in options {
            if let Some(v) = v.filter(|v| !(v.is_finite() && *v >= 0.0)) {
                return refuse(format!("{what} {v}"), "a finite number of at least 0");
            }
        }
        Ok(match &c.shape {
            Shape::Plane => Self::Plane,
            Shape::Mesh(mesh) => {
                mesh.check()?;
                let solid = MeshSolid::new(mesh);
                if solid.triangle_count() == 0 {
                    return refuse(
                        "a mesh whose triangles have no area".into(),
                        "triangles with area",
                    );
                }
                let grid = solid.grid()?;
                Self::Mesh(Box::new((solid, grid)))
            }
            Shape::Convex(convex) => Self::Convex(convex.clone()),
            Shape::Cuboid { half_extents_mm: h } => {
                if !h.to_array().into_iter().all(size) {
                    return refuse(format!("half extents {h:?}"), "three finite lengths above 0");
                }
                Self::Cuboid(*h)
            }
            Shape::Grid(grid) => Self::Grid(grid.clone()),
            Shape::Sphere { radius_mm } => {
                if !size(*radius_mm) {
                    return refuse(format!("radius {radius_mm}"), "a finite length above 0");
                }
                Self::Capsule(0.0, *radius_mm)
            }
            Shape::Capsule {
                half_length_mm,
                radius_mm,
            } => {
                if !(size(*radius_mm) && *half_length_mm >= 0.0 && half_length_mm.is_finite()) {
                    return refuse(
                        format!("half length {half_length_mm}, radius {radius_mm}"),
                        "finite lengths, the radius above 0",
                    );
                }
                Self::Capsule(*half_length_mm, *radius_mm)
            }
        })
    }

    /// Place in the queue for contact slots: meshes, fields, fixed convexes, moving ones.
    pub(crate) fn priority(&self, moving: bool) -> u8 {
        match self {
            _ if moving => 3,
            Self::Mesh(_) => 0,
            Self::Grid(_) => 1,
            _ => 2,
        }
    }

    /// Centre and radius of a ball around the shape; `None` where it has no end.
    pub(crate) fn bounding_ball(&self) -> Option<(Vec3, f32)> {
        let of_box = |(lo, hi): (Vec3, Vec3)| Some(((lo + hi) * 0.5, (hi - lo).length() * 0.5));
        match self {
            Self::Plane => None,
            Self::Convex(c) => c.bounds().and_then(of_box),
            Self::Mesh(m) => of_box(m.0.bounds()),
            Self::Cuboid(h) => Some((Vec3::ZERO, h.length())),
            Self::Grid(g) => of_box(g.bounds()),
            Self::Capsule(half, r) => Some((Vec3::ZERO, half + r)),
        }
    }

    /// Box around the shape in its own frame; `None` where it has no end.
    pub(crate) fn local_bounds(&self) -> Option<(Vec3, Vec3)> {
        match self {
            Self::Plane => None,
            Self::Convex(c) => c.bounds(),
            Self::Mesh(m) => Some(m.0.bounds()),
            Self::Cuboid(h) => Some((-*h, *h)),
            Self::Grid(g) => Some(g.bounds()),
            Self::Capsule(half, r) => {
                let h = Vec3::new(*r, *r, half + r);
                Some((-h, h))
            }
        }
    }

    /// How far a particle at `p` may go before its contact is possible, so long as the shape stays; a negative number
    /// where it is possible now. For a mesh [`MeshSolid::room`] says more.
    pub(crate) fn room(&self, p: Vec3, reach: f32, steepness: f32) -> f32 {
        match self {
            Self::Plane => p.z - reach,
            Self::Mesh(m) => m.1.distance_bound(p).0 - self.ambit(reach),
            Self::Convex(c) => c.clearance(p) - reach,
            Self::Cuboid(h) => p.distance(p.clamp(-*h, *h)) - self.ambit(reach),
            Self::Grid(g) => (g.distance(p) - reach) / steepness,
            Self::Capsule(half, radius) => {
                let axis = Vec3::new(0.0, 0.0, p.z.clamp(-half, *half));
                p.distance(axis) - radius - self.ambit(reach)
            }
        }
    }

    /// Whether contacts are possible only within [`PreparedShape::ambit`] of the shape, which has an end.
    pub(crate) fn has_distance(&self) -> bool {
        matches!(self, Self::Mesh(_) | Self::Cuboid(_) | Self::Capsule(..))
    }

    /// Distance from the shape beyond which no contact is possible.
    pub(crate) fn ambit(&self, reach: f32) -> f32 {
        // A sweep takes the corners of a box for sharp ones.
        let corner = 1.7321 * reach;
        match self {
            Self::Mesh(m) if m.0.closed => corner.max(m.1.blur()),
            _ => corner,
        }
    }

    /// How fast the value of a field may fall per mm; 1 for other shapes.
    pub(crate) fn steepness(&self) -> f32 {
        match self {
            Self::Grid(g) => g.steepness(),
            _ => 1.0,
        }
    }

    /// Contacts of a moving particle, in the shape's frame.
    pub(crate) fn contacts(&self, motion: &Motion, out: &mut LocalContacts) {
        let Motion { b, reach, .. } = *motion;
        match self {
            Self::Plane => {
                if b.z < reach {
                    out.push(LocalContact {
                        normal: Vec3::Z,
                        point: b.with_z(0.0),
                    });
                }
            }
            Self::Mesh(m) => m.0.contacts(&m.1, motion, out),
            Self::Convex(c) => c.contacts(motion, out),
            Self::Cuboid(h) => convex::cuboid_contacts(*h, motion, out),
            Self::Grid(g) => {
                let d = g.distance(b);
                if d < reach {
                    let normal = g.normal(b);
                    out.push(LocalContact {
                        normal,
                        point: b - normal * d,
                    });
                }
            }
            Self::Capsule(half, radius) => {
                let axis = Vec3::new(0.0, 0.0, b.z.clamp(-half, *half));
                let away = b - axis;
                let d = away.length();
                if d - radius < reach {
                    let normal = if d > 1e-6 { away / d } else { Vec3::X };
                    out.push(LocalContact {
                        normal,
                        point: axis + normal * *radius,
                    });
                }
            }
        }
    }
}
