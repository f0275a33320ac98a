use super::aim::{peak, rim};
use crate::RehearseError;
use crate::motion::{RigidPose, rotation};
use crate::render::{Mesh, capsule, polytope};
use crate::scene::{Instrument, ShapeKind, StartPose};
use glam::{DMat3, DQuat, DVec3, Quat, Vec3};
use palpate_pbd::{Convex, Pose, Shape};

/// Points on the organ's surface that contact is looked for at are this far apart, mm.
const SPACING_MM: f64 = 0.5;

/// An instrument in its own frame: origin in the middle of the front, z into the tissue.
#[derive(Clone, Debug)]
pub(super) enum Form {
    /// x, y, z, mm.
    Cuboid(DVec3),
    /// Radius, mm.
    Sphere(f64),
    /// Radius and whole length, mm.
    Capsule(f64, f64),
    /// Rows n, d: inside where n·x ≤ d.
    Convex(Vec<[f64; 4]>),
}

impl Form {
    /// Of a checked instrument.
    pub(super) fn new(tool: &Instrument) -> Self {
        let diameter = tool.diameter_mm.unwrap_or(1.0);
        match tool.shape {
            ShapeKind::Cuboid => Self::Cuboid(DVec3::from_array(tool.size_mm.unwrap_or([1.0; 3]))),
            ShapeKind::Sphere => Self::Sphere(0.5 * diameter),
            ShapeKind::Capsule => Self::Capsule(0.5 * diameter, tool.length_mm.unwrap_or(diameter)),
            ShapeKind::Convex => Self::Convex(tool.planes_mm.clone().unwrap_or_default()),
        }
    }

    /// The solver's shape, and its frame in the instrument's.
    pub(super) fn collider(&self) -> Result<(Shape, DVec3), RehearseError> {
        Ok(match self {
            Self::Cuboid(size) => {
                let half_extents_mm = (*size * 0.5).as_vec3();
                (Shape::Cuboid { half_extents_mm }, DVec3::Z * (-0.5 * size.z))
            }
            Self::Sphere(r) => (Shape::Sphere { radius_mm: *r as f32 }, DVec3::Z * -r),
            Self::Capsule(r, length) => {
                let shape = Shape::Capsule {
                    half_length_mm: (0.5 * length - r).max(0.0) as f32,
                    radius_mm: *r as f32,
                };
                (shape, DVec3::Z * (-0.5 * length))
            }
            Self::Convex(planes) => {
                let rows: Vec<_> = planes
                    .iter()
                    .map(|p| ([p[0] as f32, p[1] as f32, p[2] as f32], p[3] as f32))
                    .collect();
                (Shape::Convex(Convex::new(&rows)?), DVec3::ZERO)
            }
        })
    }

    /// Surface to draw, in the instrument's frame.
    pub(super) fn mesh(&self) -> Mesh {
        match self {
            Self::Cuboid(s) => polytope(&[
                [1.0, 0.0, 0.0, 0.5 * s.x],
                [-1.0, 0.0, 0.0, 0.5 * s.x],
                [0.0, 1.0, 0.0, 0.5 * s.y],
                [0.0, -1.0, 0.0, 0.5 * s.y],
                [0.0, 0.0, 1.0, 0.0],
                [0.0, 0.0, -1.0, s.z],
            ]),
            Self::Sphere(r) => capsule(Vec3::NEG_Z * *r as f32, Vec3::Z, 0.0, *r as f32, 32),
            Self::Capsule(r, l) => {
                let (r, half) = (*r as f32, (0.5 * l) as f32);
                capsule(Vec3::NEG_Z * half, Vec3::Z, (half - r).max(0.0), r, 32)
            }
            Self::Convex(planes) => polytope(planes),
        }
    }

    /// How far the body reaches from its axis along x, mm: from 10 (an image is no narrower) to 60.
    pub(super) fn half_width(&self) -> f64 {
        (10..=60)
            .rev()
            .map(f64::from)
            .find(|&x| self.front(x, 0.0).is_some())
            .unwrap_or(10.0)
    }

    /// How far the body reaches from its axis along y, mm: from 5 to 60.
    pub(super) fn half_thickness(&self) -> f64 {
        (5..=60)
            .rev()
            .map(f64::from)
            .find(|&y| self.front(0.0, y).is_some())
            .unwrap_or(5.0)
    }

    /// How far the body reaches along z over (x, y); none beside it.
    pub(super) fn front(&self, x: f64, y: f64) -> Option<f64> {
        match self {
            Self::Cuboid(s) => (x.abs() <= 0.5 * s.x && y.abs() <= 0.5 * s.y).then_some(0.0),
            Self::Sphere(r) | Self::Capsule(r, _) => {
                let left = r * r - x * x - y * y;
                (left >= 0.0).then(|| left.sqrt() - r)
            }
            Self::Convex(planes) => {
                let (mut top, mut bottom) = (f64::INFINITY, f64::NEG_INFINITY);
                for &[nx, ny, nz, d] in planes {
                    let room = d - nx * x - ny * y;
                    if nz.abs() < 1e-12 {
                        if room < 0.0 {
                            return None;
                        }
                    } else if nz > 0.0 {
                        top = top.min(room / nz);
                    } else {
                        bottom = bottom.max(room / nz);
                    }
                }
                (top.is_finite() && top >= bottom).then_some(top)
            }
        }
    }
}

/// What a start pose is found from: the first organ as it is placed, mm.
pub(super) struct Target<'a> {
    /// Surface vertices.
    pub vertices: &'a [[f32; 3]],
    /// Surface triangles.
    pub triangles: &'a [[u32; 3]],
    /// Structures: name and surface vertices, largest first.
    pub structures: &'a [(String, Vec<[f32; 3]>)],
}

/// The pose of the front's middle at the start. `origin` is the world's zero point in patient mm.
pub(super) fn start_pose(pose: &StartPose, form: &Form, target: &Target, origin: DVec3) -> RigidPose {
    let axis = -pose.above.unit();
    let (aimed, along) = aim_point(pose, form, target);
    let lateral = lateral(pose, along, target);
    let upright = DQuat::from_mat3(&DMat3::from_cols(lateral, axis.cross(lateral), axis));
    let turned = (upright * rotation(pose.rotation_deg)).normalize();
    if let Some(p) = pose.position_mm {
        return RigidPose {
            position: DVec3::from_array(p) - origin,
            rotation: turned,
        };
    }
    let aim = RigidPose {
        position: aimed,
        rotation: turned,
    };
    let aim = RigidPose {
        position: aim.apply(DVec3::new(pose.shift_mm[0], pose.shift_mm[1], 0.0)),
        ..aim
    };
    let way = first_contact(form, aim, target).unwrap_or(0.0);
    RigidPose {
        position: aim.apply(DVec3::Z * (way - pose.gap_mm)),
        ..aim
    }
}

/// The image's x axis: as the pose says, else `along`, else the organ's longest extent across the axis.
fn lateral(pose: &StartPose, along: Option<DVec3>, target: &Target) -> DVec3 {
    let axis = -pose.above.unit();
    pose.lateral
        .map(|d| d.unit())
        .or(along)
        .and_then(|v| (v - axis * v.dot(axis)).try_normalize())
        .unwrap_or_else(|| longest_across(target.vertices, axis))
}

/// How far the instrument can go along its axis from `pose` (negative: must go back) until it touches the surface. None where
/// it passes the organ by.
pub(super) fn first_contact(form: &Form, pose: RigidPose, target: &Target) -> Option<f64> {
    let local: Vec<DVec3> = target
        .vertices
        .iter()
        .map(|&v| pose.unapply(Vec3::from(v).as_dvec3()))
        .collect();
    let mut way = f64::INFINITY;
    for t in target.triangles {
        let [Some(&a), Some(&b), Some(&c)] = t.map(|v| local.get(v as usize)) else {
            continue;
        };
        let longest = (b - a).length().max((c - b).length()).max((a - c).length());
        let n = (longest / SPACING_MM).ceil().clamp(1.0, 200.0) as u32;
        for i in 0..=n {
            for j in 0..=n - i {
                let (u, v) = (f64::from(i) / f64::from(n), f64::from(j) / f64::from(n));
                let p = a + (b - a) * u + (c - a) * v;
                if let Some(front) = form.front(p.x, p.y) {
                    way = way.min(p.z - front);
                }
            }
        }
    }
    way.is_finite().then_some(way)
}

/// The point to aim at, and where the image's x axis should point for what is there to be seen.
fn aim_point(pose: &StartPose, form: &Form, target: &Target) -> (DVec3, Option<DVec3>) {
    let up = pose.above.unit();
    for name in &pose.over {
        let found = match name.as_str() {
            "peak" => {
                let lateral = lateral(pose, None, target);
                peak(form, target, up, lateral).map(|p| (p, None))
            }
            "centre" => Some((middle(target.vertices), None)),
            "rim" => target.structures.first().map(|s| {
                let (p, d) = rim(&s.1, form, target, up);
                (p, Some(d))
            }),
            "structure" => target.structures.first().map(|s| (middle(&s.1), None)),
            name => target
                .structures
                .iter()
                .find(|s| s.0 == name)
                .map(|s| (middle(&s.1), None)),
        };
        if let Some(p) = found {
            return p;
        }
    }
    (middle(target.vertices), None)
}

/// Middle of the bounding box.
pub(super) fn middle(v: &[[f32; 3]]) -> DVec3 {
    let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for &p in v {
        let p = Vec3::from(p).as_dvec3();
        lo = lo.min(p);
        hi = hi.max(p);
    }
    0.5 * (lo + hi)
}

/// The direction across `axis` in which the points spread most. Its largest part points to the left, back or feet, as
/// images are laid out by custom.
fn longest_across(points: &[[f32; 3]], axis: DVec3) -> DVec3 {
    let (u, v) = axis.any_orthonormal_pair();
    let n = points.len().max(1) as f64;
    let flat: Vec<(f64, f64)> = points
        .iter()
        .map(|&p| Vec3::from(p).as_dvec3())
        .map(|p| (p.dot(u), p.dot(v)))
        .collect();
    let mean = flat
        .iter()
        .fold((0.0, 0.0), |m, p| (m.0 + p.0 / n, m.1 + p.1 / n));
    let (mut uu, mut uv, mut vv) = (0.0, 0.0, 0.0);
    for p in &flat {
        let d = (p.0 - mean.0, p.1 - mean.1);
        uu += d.0 * d.0;
        uv += d.0 * d.1;
        vv += d.1 * d.1;
    }
    let angle = 0.5 * (2.0 * uv).atan2(uu - vv);
    let long = u * angle.cos() + v * angle.sin();
    let largest = long
        .to_array()
        .into_iter()
        .max_by(|a, b| a.abs().total_cmp(&b.abs()))
        .unwrap_or(0.0);
    if largest > 0.0 { -long } else { long }
}

/// For the solver, which counts in f32.
pub(super) fn solver_pose(p: RigidPose) -> Pose {
    let q = p.rotation;
    Pose::new(
        Quat::from_xyzw(q.x as f32, q.y as f32, q.z as f32, q.w as f32),
        p.position.as_vec3(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::ball;
    use crate::scene::Direction;

    fn over_a_ball(form: &Form, shift_mm: [f64; 2]) -> RigidPose {
        let organ = ball(Vec3::new(5.0, -3.0, 2.0), 20.0, 120);
        let target = Target {
            vertices: &organ.vertices,
            triangles: &organ.triangles,
            structures: &[],
        };
        let pose = StartPose {
            over: vec!["peak".into()],
            lateral: Direction::named("inferior"),
            shift_mm,
            ..StartPose::default()
        };
        start_pose(&pose, form, &target, DVec3::ZERO)
    }

    #[test]
    fn first_contact_with_a_ball_has_the_closed_form() {
        let flat = over_a_ball(&Form::Cuboid(DVec3::new(40.0, 10.0, 20.0)), [0.0; 2]);
        assert!(
            (flat.position - DVec3::new(5.0, 17.0, 2.0)).length() < 0.3,
            "{flat:?}"
        );
        assert!((flat.position.y - 17.0).abs() < 0.02);
        assert!((flat.rotation * DVec3::Z - DVec3::NEG_Y).length() < 1e-9);
        assert!((flat.rotation * DVec3::X - DVec3::NEG_Z).length() < 1e-9);
        // Ball on ball, 9 mm aside: centres are 20 + 6 apart.
        let round = over_a_ball(&Form::Sphere(6.0), [9.0, 0.0]);
        let height = (26.0f64 * 26.0 - 9.0 * 9.0).sqrt() - 6.0 - 3.0;
        assert!(
            (round.position.y - height).abs() < 0.03,
            "{} {height}",
            round.position.y
        );
        // A point that leads: contact where the point meets the ball.
        let tip = Form::Convex(vec![
            [1.0, 0.0, 1.0, 0.0],
            [-1.0, 0.0, 1.0, 0.0],
            [0.0, 1.0, 1.0, 0.0],
            [0.0, -1.0, 1.0, 0.0],
            [0.0, 0.0, -1.0, 10.0],
        ]);
        let sharp = over_a_ball(&tip, [0.0; 2]);
        assert!((sharp.position.y - 17.0).abs() < 0.05, "{sharp:?}");
    }

    #[test]
    fn the_rim_lies_between_structure_and_organ() {
        // A ball of 8 mm near the -z end of a long body.
        let organ = capsule(Vec3::ZERO, Vec3::Z, 40.0, 15.0, 60);
        let tumour = ball(Vec3::new(0.0, 2.0, -40.0), 8.0, 40);
        let structures = [("tumour".to_string(), tumour.vertices)];
        let target = Target {
            vertices: &organ.vertices,
            triangles: &organ.triangles,
            structures: &structures,
        };
        let pose = StartPose {
            over: vec!["rim".into(), "peak".into()],
            ..StartPose::default()
        };
        let at = start_pose(
            &pose,
            &Form::Cuboid(DVec3::new(20.0, 10.0, 20.0)),
            &target,
            DVec3::ZERO,
        );
        assert!(
            (at.position - DVec3::new(0.0, 15.0, -32.0)).length() < 1.0,
            "{at:?}"
        );
        assert!((at.rotation * DVec3::X - DVec3::Z).length() < 1e-6, "{at:?}");
        let none = Target {
            structures: &[],
            ..target
        };
        let peak = start_pose(&pose, &Form::Sphere(5.0), &none, DVec3::ZERO);
        assert!((peak.position.y - 15.0).abs() < 0.1);
    }

    #[test]
    fn the_image_runs_along_the_longest_extent() {
        let points: Vec<[f32; 3]> = (0..100)
            .map(|i| {
                let t = i as f32 - 50.0;
                [0.3 * t, (i % 7) as f32, t]
            })
            .collect();
        let long = longest_across(&points, DVec3::NEG_Y);
        let expected = DVec3::new(-0.3, 0.0, -1.0).normalize();
        assert!((long - expected).length() < 0.02, "{long}");
    }
}
