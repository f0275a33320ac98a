//! How deep an instrument dents the organ.

use super::tool::{Form, Target};
use crate::motion::RigidPose;
use glam::{DVec3, Vec3};

/// Surface further than this behind the front-most part below an instrument belongs to another side of the organ, mm.
const LAYER_MM: f64 = 20.0;

/// The organ's surface below an instrument's front at its start.
#[derive(Clone, Debug)]
pub(super) struct Dent {
    axis: DVec3,
    /// Vertices and where they are along the axis before the first step, mm.
    below: Vec<(usize, f64)>,
}

impl Dent {
    /// Of vertices of triangles that face the front.
    pub(super) fn new(form: &Form, start: RigidPose, target: &Target) -> Self {
        let axis = start.rotation * DVec3::Z;
        let at = |v: u32| target.vertices.get(v as usize).map(|&p| Vec3::from(p).as_dvec3());
        let mut faces = vec![false; target.vertices.len()];
        for t in target.triangles {
            let [Some(a), Some(b), Some(c)] = t.map(at) else {
                continue;
            };
            if (b - a).cross(c - a).dot(axis) < 0.0 {
                t.iter().for_each(|&v| faces[v as usize] = true);
            }
        }
        let mut below: Vec<(usize, f64)> = target
            .vertices
            .iter()
            .enumerate()
            .filter(|&(n, _)| faces[n])
            .map(|(n, &p)| (n, Vec3::from(p).as_dvec3()))
            .filter(|&(_, p)| {
                let local = start.unapply(p);
                form.front(local.x, local.y).is_some()
            })
            .map(|(n, p)| (n, p.dot(axis)))
            .collect();
        let front = below.iter().map(|b| b.1).fold(f64::INFINITY, f64::min);
        below.retain(|b| b.1 <= front + LAYER_MM);
        Self { axis, below }
    }

    /// Mean and most of the way along the axis since the start, mm; not a number where nothing lies below the front.
    pub(super) fn measure(&self, vertices: &[[f32; 3]]) -> [f64; 2] {
        let (mut sum, mut most, mut count) = (0.0, f64::NEG_INFINITY, 0.0);
        for &(n, before) in &self.below {
            let Some(&p) = vertices.get(n) else { continue };
            let way = Vec3::from(p).as_dvec3().dot(self.axis) - before;
            sum += way;
            most = most.max(way);
            count += 1.0;
        }
        if count > 0.0 {
            [sum / count, most]
        } else {
            [f64::NAN; 2]
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::ball;
    use glam::DQuat;

    #[test]
    fn a_ball_that_is_pushed_in_has_the_depth() {
        let organ = ball(Vec3::ZERO, 30.0, 120);
        let target = Target {
            vertices: &organ.vertices,
            triangles: &organ.triangles,
            structures: &[],
        };
        // From +y down.
        let start = RigidPose {
            position: DVec3::new(0.0, 30.0, 0.0),
            rotation: DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2),
        };
        assert!((start.rotation * DVec3::Z - DVec3::NEG_Y).length() < 1e-12);
        let form = Form::Cuboid(DVec3::new(20.0, 10.0, 20.0));
        let dent = Dent::new(&form, start, &target);
        assert_eq!(dent.measure(&organ.vertices), [0.0, 0.0]);
        // All below y = 25 stays.
        let pressed: Vec<[f32; 3]> = organ
            .vertices
            .iter()
            .map(|p| [p[0], p[1].min(25.0), p[2]])
            .collect();
        let [mean, most] = dent.measure(&pressed);
        assert!((most - 5.0).abs() < 1e-5, "{most}");
        // The part of the ball under the face is 30 − (x² + y²)/60 high in the mean: 41.7/60 = 0.69 below the top.
        assert!((mean - 4.3).abs() < 0.1, "{mean}");
        let aside = RigidPose {
            position: DVec3::new(80.0, 30.0, 0.0),
            ..start
        };
        assert!(Dent::new(&form, aside, &target).measure(&pressed)[0].is_nan());
    }
}
