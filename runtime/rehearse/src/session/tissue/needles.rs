//! From a scene's needles to rods before the tissue, and what their bases do.

use super::super::organ::Organ;
use crate::RehearseError;
use crate::scene::{NeedleEntry, NeedleMotion, Reach, Scene};
use glam::DVec3;
use palpate_fem::TissueMesh;
use palpate_needle::{BaseMotion, Insertion, NeedleError, NeedleFriction, Rod};

/// A needle enters more aslant than this, degrees from the surface's normal, with a warning.
const MOST_ASLANT_DEGREES: f64 = 60.0;

/// One movement of a base.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Segment {
    pub(super) name: String,
    /// First and last step, from 1.
    pub(super) first: u32,
    pub(super) last: u32,
    /// Whether the target should be reached at its end.
    pub(super) at_target: bool,
    motion: BaseMotion,
}

/// A needle of the scene as the session has it. World mm.
pub(super) struct Plan {
    pub(super) name: String,
    pub(super) rod: Rod,
    pub(super) friction: NeedleFriction,
    pub(super) radius_mm: f64,
    /// Target at rest.
    pub(super) target: Option<DVec3>,
    /// Where the tip starts, and where it points.
    pub(super) start: DVec3,
    pub(super) direction: DVec3,
    /// Across it: where its bevel pushes at the start.
    pub(super) side: DVec3,
    pub(super) segments: Vec<Segment>,
    pub(super) warnings: Vec<String>,
}

impl Plan {
    /// The needle of the scene's entry `index`, which was checked, before the tissue at rest. `organ` is the package's, `origin` the world's zero point
    /// in patient mm.
    pub(super) fn new(
        scene: &Scene,
        index: usize,
        regions: &[String],
        mesh: &TissueMesh,
        organ: &Organ,
        origin: DVec3,
        dt_s: f64,
    ) -> Result<Self, RehearseError> {
        let entry = &scene.needles[index];
        let refuse = |problem: String| RehearseError::NeedlePlan {
            name: entry.name.clone(),
            problem,
        };
        let mut warnings = Vec::new();
        let mut warn = |text: String| warnings.push(format!("Needle \"{}\": {text}", entry.name));
        let target = match (&entry.target, entry.target_mm) {
            (_, Some(p)) => Some(DVec3::from(p) - origin),
            (Some(name), None) => Some(middle(name, regions, mesh, organ).ok_or_else(|| {
                refuse(format!(
                    "nothing of \"{name}\" is in the FEM mesh; give target_mm in its place"
                ))
            })?),
            _ => None,
        };
        let faces = mesh.boundary();
        let (start, direction) = match (entry.entry_mm, target) {
            (Some(p), _) => {
                let start = DVec3::from(p) - origin;
                let way = entry.direction.map(|d| d.unit());
                let to = target.and_then(|t| (t - start).try_normalize());
                let direction = way.or(to).ok_or_else(|| {
                    refuse(
                        "starts at its target: no direction; move entry_mm away from it, out of the organ"
                            .into(),
                    )
                })?;
                (start, direction)
            }
            (None, Some(target)) => {
                let direction = -entry.from.unit();
                let hits = hits(mesh, &faces, target, -direction);
                let Some(&(way, normal)) = hits.last() else {
                    return Err(refuse(format!(
                        "no tissue lies between its target and the {} side; aim inside of the organ, or give entry_mm and direction",
                        entry.from
                    )));
                };
                if hits.len() > 1 {
                    warn(format!(
                        "its straight way to the target crosses the surface {} times; `from` another side avoids the gap",
                        hits.len()
                    ));
                }
                let aslant = normal.dot(-direction).clamp(-1.0, 1.0).acos().to_degrees();
                if aslant > MOST_ASLANT_DEGREES {
                    warn(format!(
                        "it meets the surface {aslant:.0}° from its normal and may slip along it before it enters"
                    ));
                }
                (target - direction * (way + entry.gap_mm), direction)
            }
            (None, None) => return Err(refuse("has neither a target nor entry_mm".into())),
        };
        if let Some(target) = target {
            let beside = (target - start).cross(direction).length();
            if beside > 1.0 {
                warn(format!("it points {beside:.1} mm past its target"));
            }
        }
        let way = Way {
            surface_mm: hits(mesh, &faces, start, direction).first().map(|h| h.0),
            target_mm: target.map(|t| (t - start).dot(direction)),
        };
        let segments = segments(&entry.motions, &way, dt_s).map_err(refuse)?;
        let fed = most_fed(&segments, dt_s);
        if entry.free_mm + fed > entry.length_mm {
            return Err(refuse(format!(
                "is {} mm long, and its motions feed {fed:.1} mm beside the {} mm that are out of the sleeve at the start; make length_mm \
                 at least {:.0}",
                entry.length_mm,
                entry.free_mm,
                (entry.free_mm + fed).ceil()
            )));
        }
        let side = side(entry, direction);
        let rod = rod(entry, start, direction, side)
            .map_err(|e| failed(&entry.name, format!("needle[{index}]"), e, origin))?;
        Ok(Self {
            name: entry.name.clone(),
            friction: entry.friction(regions, &scene.holds),
            radius_mm: 0.5 * entry.outer_diameter_mm(),
            rod,
            target,
            start,
            direction,
            side,
            segments,
            warnings,
        })
    }

    /// What the base does in a step; rests after the last movement.
    pub(super) fn motion(&self, step: u32) -> BaseMotion {
        let now = self.segments.iter().find(|s| (s.first..=s.last).contains(&step));
        now.map_or_else(BaseMotion::default, |s| s.motion)
    }

    /// Key within the needle of the movement of a step.
    pub(super) fn motion_key(&self, step: u32) -> String {
        let now = self
            .segments
            .iter()
            .position(|s| (s.first..=s.last).contains(&step));
        now.map_or_else(String::new, |n| format!(".motion[{n}]"))
    }

    /// Needle fed since the start after a step, mm.
    pub(super) fn fed_mm(&self, step: u32, dt_s: f64) -> f64 {
        let done = |s: &Segment| f64::from((step + 1).clamp(s.first, s.last + 1) - s.first);
        self.segments
            .iter()
            .map(|s| done(s) * dt_s * s.motion.insertion_mm_per_s)
            .sum()
    }
}

/// An error of the needle crate in words of the patient.
pub(super) fn failed(name: &str, key: String, error: NeedleError, origin: DVec3) -> RehearseError {
    let error = match error {
        NeedleError::StartsInside { node, at } => NeedleError::StartsInside {
            node,
            at: at + origin,
        },
        NeedleError::LeavesTissue { needle, at } => NeedleError::LeavesTissue {
            needle,
            at: at + origin,
        },
        NeedleError::HitsRigid { needle, region, at } => NeedleError::HitsRigid {
            needle,
            region,
            at: at + origin,
        },
        NeedleError::CrossesItself { needle, at } => NeedleError::CrossesItself {
            needle,
            at: at + origin,
        },
        NeedleError::Folded { node, at, angle_deg } => NeedleError::Folded {
            node,
            at: at + origin,
            angle_deg,
        },
        other => other,
    };
    RehearseError::Needle {
        name: name.into(),
        error,
        key,
    }
}

/// The needle that an error in a step is about.
pub(super) fn at_fault(error: &NeedleError, both: &Insertion) -> usize {
    let needles = both.needles();
    // The sharpest bend between two edges, for what says only that something is bent too far.
    let bend = |k: usize| {
        let x = needles[k].rod().position();
        let turn = |w: &[DVec3]| (w[1] - w[0]).angle_between(w[2] - w[1]);
        x.windows(3).map(turn).fold(0.0, f64::max)
    };
    match error {
        NeedleError::LeavesTissue { needle, .. }
        | NeedleError::HitsRigid { needle, .. }
        | NeedleError::CrossesItself { needle, .. }
        | NeedleError::MeetsNeedle { needle, .. }
        | NeedleError::WithdrawFirst { needle, .. } => *needle,
        _ => {
            let most = (0..needles.len()).max_by(|&a, &b| bend(a).total_cmp(&bend(b)).then(b.cmp(&a)));
            most.unwrap_or(0)
        }
    }
}

/// Where the bevel pushes, across the direction.
fn side(entry: &NeedleEntry, direction: DVec3) -> DVec3 {
    let wanted = entry.bevel_towards.map_or(DVec3::Z, |d| d.unit());
    let across = |v: DVec3| (v - direction * v.dot(direction)).try_normalize();
    across(wanted)
        .or_else(|| across(DVec3::X))
        .unwrap_or_else(|| direction.any_orthonormal_vector())
}

/// A straight rod whose tip is at `start`; its bevel pushes towards m2 = t × m1.
fn rod(entry: &NeedleEntry, start: DVec3, direction: DVec3, m2: DVec3) -> Result<Rod, NeedleError> {
    let edges = (entry.free_mm / entry.edge_mm).ceil().max(1.0) as usize;
    let free = entry.free_mm;
    Rod::in_sleeve(
        entry.params(),
        start - direction * free,
        direction,
        m2.cross(direction),
        entry.edge_mm,
        free,
        edges,
    )
}

/// Middle of a region of the FEM mesh by volume; of a structure without tets, of its surface.
fn middle(name: &str, regions: &[String], mesh: &TissueMesh, organ: &Organ) -> Option<DVec3> {
    let volume_of = |code: usize| {
        let mut sum = (0.0, DVec3::ZERO);
        for (_, t) in mesh.tets().filter(|(_, t)| usize::from(t.region) == code) {
            let [a, b, c, d] = t.corners.map(|n| mesh.rest()[n as usize]);
            let v = (b - a).dot((c - a).cross(d - a));
            sum = (sum.0 + v, sum.1 + (a + b + c + d) * (0.25 * v));
        }
        sum
    };
    let code = match name {
        "structure" => {
            (1..regions.len()).max_by(|&a, &b| volume_of(a).0.total_cmp(&volume_of(b).0).then(b.cmp(&a)))?
        }
        _ => regions.iter().position(|r| r == name)?,
    };
    let (volume, moment) = volume_of(code);
    if volume > 0.0 {
        return Some(moment / volume);
    }
    let surface = organ
        .structures
        .iter()
        .find(|s| Some(&s.name) == regions.get(code))?;
    let points = &surface.mesh.vertices;
    let sum: DVec3 = points.iter().map(|&p| glam::Vec3::from(p).as_dvec3()).sum();
    (!points.is_empty()).then(|| sum / points.len() as f64)
}

/// Where the ray from `p` along the unit vector `d` crosses the surface: distance and outer normal, ascending.
fn hits(mesh: &TissueMesh, faces: &[[u32; 3]], p: DVec3, d: DVec3) -> Vec<(f64, DVec3)> {
    let mut out: Vec<(f64, DVec3)> = Vec::new();
    for f in faces {
        let [a, b, c] = f.map(|n| mesh.rest()[n as usize]);
        // Möller and Trumbore 1997.
        let (e, g) = (b - a, c - a);
        let h = d.cross(g);
        let det = e.dot(h);
        if det.abs() < 1e-12 {
            continue;
        }
        let s = p - a;
        let u = s.dot(h) / det;
        let q = s.cross(e);
        let v = d.dot(q) / det;
        let t = g.dot(q) / det;
        if u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0 {
            out.push((t, e.cross(g).normalize_or_zero()));
        }
    }
    out.sort_by(|a, b| a.0.total_cmp(&b.0));
    // Two faces share the edge that a ray meets.
    out.dedup_by(|a, b| (a.0 - b.0).abs() < 1e-6);
    out
}

/// Lengths along the straight way from where the tip starts, mm.
#[derive(Clone, Copy, Debug, Default)]
struct Way {
    surface_mm: Option<f64>,
    target_mm: Option<f64>,
}

impl Way {
    /// Where a movement ends, if it ends at a place.
    fn goal(&self, m: &NeedleMotion) -> Result<Option<f64>, String> {
        let target = || self.target_mm.ok_or("has no target to reach");
        let surface = || {
            self.surface_mm.ok_or(
                "misses the organ on its straight way, so that no depth can be counted; point it at the organ, or give steps or seconds",
            )
        };
        Ok(match (m.reach, m.reach_share, m.reach_depth_mm) {
            (Some(Reach::Target), ..) => Some(target()?),
            (Some(Reach::Start), ..) => Some(0.0),
            (None, Some(share), _) => {
                let from = surface()?;
                Some(from + share * (target()? - from))
            }
            (None, None, Some(mm)) => Some(surface()? + mm),
            _ => None,
        })
    }
}

/// The movements one after the other.
fn segments(motions: &[NeedleMotion], way: &Way, dt_s: f64) -> Result<Vec<Segment>, String> {
    let (mut out, mut fed, mut step) = (Vec::new(), 0.0, 0u32);
    for (n, m) in motions.iter().enumerate() {
        let name = m.name.clone().unwrap_or_else(|| format!("motion {}", n + 1));
        let (steps, speed) = match way.goal(m)? {
            Some(goal) => {
                let way: f64 = goal - fed;
                let steps = (way / (m.insertion_mm_s * dt_s) - 1e-6).ceil();
                if !(1.0..=1e6).contains(&steps) {
                    return Err(format!(
                        "motion \"{name}\" has {way:.1} mm to go at {} mm/s: expected a way in that direction of up to a million steps",
                        m.insertion_mm_s
                    ));
                }
                (steps as u32, way / (steps * dt_s))
            }
            None => {
                let by_time = || (m.seconds.unwrap_or_default() / dt_s - 1e-6).ceil().max(1.0) as u32;
                let steps = m.steps.unwrap_or_else(by_time);
                (steps, m.insertion_mm_s)
            }
        };
        let seconds = f64::from(steps) * dt_s;
        fed += speed * seconds;
        out.push(Segment {
            name,
            first: step + 1,
            last: step + steps,
            at_target: m.reach == Some(Reach::Target),
            motion: BaseMotion {
                insertion_mm_per_s: speed,
                velocity_mm_per_s: m.velocity_mm_s,
                rotation_rad_per_s: m.rotation_degrees.to_radians() / seconds,
                ..BaseMotion::default()
            },
        });
        step += steps;
    }
    Ok(out)
}

/// Most needle fed at any time, mm.
fn most_fed(segments: &[Segment], dt_s: f64) -> f64 {
    let (mut fed, mut most) = (0.0, 0.0f64);
    for s in segments {
        fed += f64::from(s.last + 1 - s.first) * dt_s * s.motion.insertion_mm_per_s;
        most = most.max(fed);
    }
    most
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn movements_follow_each_other_and_end_where_they_should() {
        let motion = |reach, insertion_mm_s| NeedleMotion {
            reach,
            insertion_mm_s,
            ..NeedleMotion::default()
        };
        let list = [
            motion(Some(Reach::Target), 10.0),
            NeedleMotion {
                seconds: Some(0.5),
                rotation_degrees: 90.0,
                ..NeedleMotion::default()
            },
            motion(Some(Reach::Start), -20.0),
        ];
        let to = |mm| Way {
            surface_mm: Some(3.3),
            target_mm: Some(mm),
        };
        let s = segments(&list, &to(33.3), 0.02).unwrap();
        // 33.3 mm in steps of 0.2 mm, half a second, and back in steps of 0.4 mm.
        assert_eq!(s.iter().map(|s| s.last).collect::<Vec<_>>(), [167, 192, 276]);
        assert!((s[0].motion.insertion_mm_per_s * 167.0 * 0.02 - 33.3).abs() < 1e-12);
        assert!((s[1].motion.rotation_rad_per_s * 0.5 - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        assert!((most_fed(&s, 0.02) - 33.3).abs() < 1e-12);
        assert!(s[0].at_target && !s[2].at_target);
        assert!(
            segments(&list, &to(-4.0), 0.02)
                .unwrap_err()
                .contains("-4.0 mm to go")
        );
        assert!(segments(&list[2..], &to(9.0), 0.02).is_err());
        // 0.4 of the 30 mm below the surface, on to 20 mm, back to 5.
        let at = |reach_share, reach_depth_mm, insertion_mm_s| NeedleMotion {
            reach_share,
            reach_depth_mm,
            insertion_mm_s,
            ..NeedleMotion::default()
        };
        let list = [
            at(Some(0.4), None, 10.0),
            at(None, Some(20.0), 10.0),
            at(None, Some(5.0), -10.0),
        ];
        let s = segments(&list, &to(33.3), 0.02).unwrap();
        assert_eq!(s.iter().map(|s| s.last).collect::<Vec<_>>(), [77, 117, 192]);
        let fed = |n: usize| f64::from(s[n].last + 1 - s[n].first) * 0.02 * s[n].motion.insertion_mm_per_s;
        for (n, mm) in [15.3, 8.0, -15.0].into_iter().enumerate() {
            assert!((fed(n) - mm).abs() < 1e-9, "{n}: {}", fed(n));
        }
        let beside = Way {
            surface_mm: None,
            ..to(33.3)
        };
        assert!(
            segments(&list, &beside, 0.02)
                .unwrap_err()
                .contains("misses the organ")
        );
    }

    #[test]
    fn a_ray_meets_a_cube_where_it_should() {
        let at = |n: u32| [n & 1, n >> 1 & 1, n >> 2].map(f64::from);
        let points: Vec<[f64; 3]> = (0..8).map(at).collect();
        let tets = [
            [0, 1, 3, 7],
            [0, 5, 1, 7],
            [0, 3, 2, 7],
            [0, 2, 6, 7],
            [0, 4, 5, 7],
            [0, 6, 4, 7],
        ];
        let mesh = TissueMesh::new(&points, &tets, &[0; 6]).unwrap();
        let faces = mesh.boundary();
        let found = hits(&mesh, &faces, DVec3::new(0.3, 0.6, 0.4), DVec3::Y);
        assert_eq!(found.len(), 1);
        assert!((found[0].0 - 0.4).abs() < 1e-12 && (found[0].1 - DVec3::Y).length() < 1e-12);
        assert_eq!(hits(&mesh, &faces, DVec3::new(0.3, -1.0, 0.3), DVec3::Y).len(), 2);
        assert!(hits(&mesh, &faces, DVec3::new(0.3, 2.0, 0.4), DVec3::Y).is_empty());
    }
}
