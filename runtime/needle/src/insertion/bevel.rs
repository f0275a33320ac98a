//! Where a tip cuts on to in the material: the kinematics of a bevel needle (Webster et al. 2006), turned by what bends the needle (after
//! Chentanez et al. 2009, §3.5, which has neither).

use super::foundation::{Foundation, Held, tip_direction};
use super::{Insertion, Needle};
use crate::Rod;
use crate::track::walk;
use glam::{DMat3, DVec3};

/// Fewest places inside the tissue from which its mean deformation is taken.
const LEAST_PLACES: usize = 12;
/// Halvings of a ball that reaches too far out of thin tissue.
const BALLS: u32 = 3;
/// Length of a piece of the course, of the length over which the needle bends.
const PIECE: f64 = 1.0 / 32.0;
/// How far behind the tip its needle is looked at, and the distance of the places at which the tissue's mean deformation is taken, of that length.
const REACH: f64 = 5.0;
const STATION: f64 = 0.75;
/// Most that what bends the needle turns its tip from the kinematic direction.
const MOST_TURN: f64 = 0.3;

/// What one part of a step did to a needle.
pub(super) struct Part<'a> {
    /// The needle before it.
    pub before: &'a Rod,
    /// Slip of the tip, mm.
    pub slip: f64,
}

/// A place that a tip came through.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Place {
    /// In the material, mm.
    at: DVec3,
    /// Unit vector of the material along which a needle without a bevel would cut on from there, undisturbed.
    axis: DVec3,
    /// Way cut up to there, mm.
    arc: f64,
}

/// Course of a tip through the material, kept apart from the nodes of the mesh, which move and are as far apart as tets are long.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Course {
    /// Places with a least distance, the first one that of the entry.
    fixed: Vec<Place>,
    /// The tip's.
    tip: Place,
}

impl Course {
    pub fn new(entry: DVec3, axis: DVec3) -> Self {
        let place = Place {
            at: entry,
            axis,
            arc: 0.0,
        };
        Self {
            fixed: vec![place],
            tip: place,
        }
    }

    /// Place to which a tip cuts on by `way` mm along its axis turned to `along`, with `aside` for the tangent of the bevel angle: the axis is the one
    /// half-way there.
    fn ahead(&self, way: f64, along: DVec3, aside: DVec3, length: f64) -> DVec3 {
        let direction = along + aside;
        self.tip.at + way * (direction + (direction - self.tip.axis) * (0.5 * way / length))
    }

    /// The tip has cut on to a place; `length` is the one over which the needle bends.
    ///
    /// The axis follows the direction of the cut as the rear wheel of a bicycle follows the front one, `length` ahead (a tractrix).
    pub fn advance(&mut self, to: DVec3, length: f64) {
        let Some(&last) = self.fixed.last() else { return };
        let way = to - last.at;
        let distance = way.length();
        let share = -(-distance / length).exp_m1();
        let turned = last.axis + (way.normalize_or_zero() - last.axis) * share;
        self.tip = Place {
            at: to,
            axis: turned.try_normalize().unwrap_or(last.axis),
            arc: last.arc + distance,
        };
        if distance >= PIECE * length {
            self.fixed.push(self.tip);
        }
    }

    /// The tip has gone back to a place.
    pub fn retract(&mut self, to: DVec3) {
        while let [.., before, last] = self.fixed[..] {
            if (to - last.at).dot(last.at - before.at) > 0.0 {
                break;
            }
            self.fixed.pop();
        }
        if let Some(&last) = self.fixed.last() {
            self.tip = Place {
                at: to,
                axis: last.axis,
                arc: last.arc + to.distance(last.at),
            };
        }
    }

    /// Places from `reach` mm behind the tip on to the tip, and whether the entry is the first of them.
    fn behind(&self, reach: f64) -> (Vec<Place>, bool) {
        let from = self.fixed.partition_point(|p| p.arc < self.tip.arc - reach);
        let mut places = self.fixed[from.min(self.fixed.len() - 1)..].to_vec();
        // No piece much shorter than the others.
        let short = match places[..] {
            [.., a, b] => self.tip.arc - b.arc < 0.5 * (b.arc - a.arc),
            _ => false,
        };
        if short {
            places.pop();
        }
        places.push(self.tip);
        (places, from == 0)
    }
}

/// Mean motion of the tissue around a place: the affine map that fits it best.
#[derive(Clone, Copy)]
struct Mean {
    rest: DVec3,
    now: DVec3,
    gradient: DMat3,
}

impl Mean {
    fn of(&self, u: DVec3) -> DVec3 {
        self.now + self.gradient * (u - self.rest)
    }
}

/// Where the tissue's mean motion is known along a course.
struct Station {
    arc: f64,
    mean: Mean,
    foundation: Foundation,
}

impl Insertion {
    /// How the tissue at a tet holds a needle.
    fn foundation(&self, needle: &Needle, slot: u32) -> Option<Foundation> {
        let tet = self.tissue.mesh().tet(slot)?;
        let material = &self.tissue.materials()[tet.region as usize];
        let bending = needle.rod.stiffness().bending_un_mm2;
        let radius = 0.5 * needle.rod.params().outer_diameter_mm;
        Some(Foundation::new(bending[0], radius, material))
    }

    /// Material place to which the tip of a needle cuts on, mm; `literal` is the world tip's place in the deformed tet `slot`. `None` where
    /// the tissue around gives no answer: so near the surface that one node is on the needle, in slivers of tissue, in a dent.
    ///
    /// As far as `literal`, along the course's axis, with the tangent of the bevel angle aside. The axis is turned by as much as beam theory says that
    /// the needle's tip is turned from that of a straight needle pushed along the same course in tissue like that at the tip, at rest: by a base
    /// that has moved, by tissue that has moved or is harder on one part of the way than on another, by a pre-bent needle.
    pub(super) fn cut_place(&self, needle: &Needle, slot: u32, literal: DVec3) -> Option<DVec3> {
        let course = needle.course.as_ref()?;
        let mesh = self.tissue.mesh();
        let from = course.tip.at;
        let own = self.foundation(needle, slot)?;
        let (places, whole) = course.behind(REACH * own.length);
        let stations = self.stations(needle, &places, slot, own.length)?;
        let inverse = stations.last()?.mean.gradient.inverse();
        let turn = match tips(needle, &places, whole, &stations, own) {
            Some((now, free)) => (inverse * now).try_normalize()? - free,
            None => DVec3::ZERO,
        };
        let axis = course.tip.axis;
        let turn = turn.reject_from_normalized(axis).clamp_length_max(MOST_TURN);
        let along = (axis + turn).try_normalize()?;
        let aside = inverse * needle.rod.tip_frame().m2;
        let aside = aside.reject_from_normalized(along).try_normalize()?;
        let way = (literal - from).dot(along);
        let aside = aside * needle.friction.bevel_degrees.to_radians().tan();
        let to = course.ahead(way, along, aside, own.length);
        (way > 0.0 && walk(mesh, mesh.rest(), to, slot).is_some()).then_some(to)
    }

    /// Begins a needle's course at its entry, or goes on with it, after its tip has cut on to its node.
    pub(super) fn note_cut(&mut self, k: usize) {
        let mesh = self.tissue.mesh();
        let n = &self.needles[k];
        let [entry, .., tip] = n.chain[..] else { return };
        let Some(slot) = mesh.around(tip).first().map(|e| e.tet) else {
            return;
        };
        let Some(foundation) = self.foundation(n, slot) else {
            return;
        };
        let rest = mesh.rest();
        let (entry, tip) = (rest[entry as usize], rest[tip as usize]);
        let mut course = match self.needles[k].course.take() {
            Some(course) => course,
            None => {
                let mean = self.mean(entry, foundation.length, slot);
                let tangent = self.needles[k].rod.tip_frame().tangent;
                let axis = mean.map_or(tangent, |m| m.0.gradient.inverse() * tangent);
                Course::new(entry, axis.try_normalize().unwrap_or(tangent))
            }
        };
        course.advance(tip, foundation.length);
        self.needles[k].course = Some(course);
    }

    /// Goes back along a needle's course to its tip's node.
    pub(super) fn note_retreat(&mut self, k: usize) {
        let n = &mut self.needles[k];
        if let ([_, .., tip], Some(course)) = (&n.chain[..], &mut n.course) {
            course.retract(self.tissue.mesh().rest()[*tip as usize]);
        }
    }

    /// Mean motion of the tissue along a course, its last place included.
    fn stations(
        &self,
        needle: &Needle,
        places: &[Place],
        mut slot: u32,
        length: f64,
    ) -> Option<Vec<Station>> {
        let mut stations = Vec::new();
        let mut next = f64::INFINITY;
        for (j, p) in places.iter().enumerate().rev() {
            if p.arc > next && j > 0 {
                continue;
            }
            next = p.arc - STATION * length;
            let Some((mean, found)) = self.mean(p.at, length, slot) else {
                if stations.is_empty() {
                    return None;
                }
                continue;
            };
            slot = found;
            stations.push(Station {
                arc: p.arc,
                mean,
                foundation: self.foundation(needle, slot)?,
            });
        }
        stations.reverse();
        Some(stations)
    }

    /// Mean motion of the tissue in a ball of the material, smaller where little of it is tissue; and a tet next to its middle.
    fn mean(&self, middle: DVec3, radius: f64, slot: u32) -> Option<(Mean, u32)> {
        (0..BALLS).find_map(|k| self.mean_in(middle, radius * 0.5f64.powi(k as i32), slot))
    }

    /// The affine map that fits places in a ball best weighs the gradient by 1 − r²/radius². What the needle drags along falls off on both sides
    /// of the tip and cancels.
    fn mean_in(&self, middle: DVec3, radius: f64, slot: u32) -> Option<(Mean, u32)> {
        let (mesh, x) = (self.tissue.mesh(), self.tissue.positions());
        let centre = walk(mesh, mesh.rest(), middle, slot).map_or(slot, |f| f.0);
        let mut places = Vec::with_capacity(33);
        let mut slot = centre;
        for k in 0..125 {
            let at = DVec3::new(f64::from(k % 5), f64::from(k / 5 % 5), f64::from(k / 25)) * 0.5 - 1.0;
            if at.length_squared() > 1.0 {
                continue;
            }
            let u = middle + at * radius;
            if let Some((found, weights)) = walk(mesh, mesh.rest(), u, slot) {
                slot = found;
                let corners = mesh.tet(found)?.corners.into_iter().zip(weights);
                places.push((u, corners.map(|(n, w)| x[n as usize] * w).sum::<DVec3>()));
            }
        }
        if places.len() < LEAST_PLACES {
            return None;
        }
        let share = 1.0 / places.len() as f64;
        let rest = places.iter().map(|p| p.0).sum::<DVec3>() * share;
        let now = places.iter().map(|p| p.1).sum::<DVec3>() * share;
        let outer = |a: DVec3, b: DVec3| DMat3::from_cols(a * b.x, a * b.y, a * b.z);
        let (mut moved, mut spread) = (DMat3::ZERO, DMat3::ZERO);
        for (u, x) in &places {
            moved += outer(*x - now, *u - rest) * share;
            spread += outer(*u - rest, *u - rest) * share;
        }
        // A full ball has (0.24 radius²)³.
        if spread.determinant() < 1e-4 * radius.powi(6) {
            return None;
        }
        let gradient = moved * spread.inverse();
        let mean = Mean { rest, now, gradient };
        (gradient.determinant() > 0.1).then_some((mean, centre))
    }
}

/// Direction of a needle's tip in the tissue as it has moved, and the one that a straight needle pushed along the same course would have in the
/// material at rest, both by beam theory.
fn tips(
    needle: &Needle,
    places: &[Place],
    whole: bool,
    stations: &[Station],
    own: Foundation,
) -> Option<(DVec3, DVec3)> {
    let x = needle.rod.position();
    let frame = needle.rod.tip_frame();
    let step = PIECE * own.length;
    let [.., before, tip] = places else { return None };
    let last = tip.arc;
    if last - before.arc < 0.1 * step {
        // Just in: its direction would be that of a rounding error.
        return None;
    }
    let natural = |arc: f64| {
        let mut start = 0.0;
        for bend in &needle.rod.params().pre_bend {
            if (start..start + bend.length_mm).contains(&(last - arc)) {
                let [a, b] = bend.curvature_per_mm;
                return frame.m1 * a + frame.m2 * b;
            }
            start += bend.length_mm;
        }
        DVec3::ZERO
    };
    let (mut now, mut free) = (Vec::new(), Vec::new());
    let mut push = |arc: f64, at: [DVec3; 2], stiffness: [f64; 2]| {
        let node = |at, stiffness, natural| Held {
            arc,
            at,
            stiffness,
            natural,
        };
        now.push(node(at[0], stiffness[0], natural(arc)));
        free.push(node(at[1], stiffness[1], DVec3::ZERO));
    };
    let motion = |p: &Place| {
        let j = stations.partition_point(|s| s.arc < p.arc);
        let (after, before) = (stations.get(j), j.checked_sub(1).map(|j| &stations[j]));
        match (before, after) {
            (Some(b), Some(a)) => {
                let t = (p.arc - b.arc) / (a.arc - b.arc);
                let nearer = if t < 0.5 { b } else { a };
                let at = b.mean.of(p.at).lerp(a.mean.of(p.at), t);
                Some((at, nearer.foundation.stiffness))
            }
            (Some(s), None) | (None, Some(s)) => Some((s.mean.of(p.at), s.foundation.stiffness)),
            (None, None) => None,
        }
    };
    if whole {
        // The piece outside, from the mouth of the sleeve on.
        let entry = &places[0];
        let (mouth, out) = (x[1], (x[1] - x[0]).try_normalize()?);
        let way = (motion(entry)?.0 - mouth).length().max(0.5 * step);
        let count = (way / step).ceil();
        for k in -1..count as i32 {
            // All of the sleeve is held by two nodes.
            let arc = f64::from(k) * way / count - way;
            let held = if k <= 0 { f64::INFINITY } else { 0.0 };
            let at = [mouth + out * (arc + way), entry.at + entry.axis * arc];
            push(entry.arc + arc, at, [held; 2]);
        }
    }
    for p in places {
        let (at, stiffness) = motion(p)?;
        push(p.arc, [at, p.at], [stiffness, own.stiffness]);
    }
    Some((tip_direction(&now)?, tip_direction(&free)?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Bicycle, BicycleParams};

    /// Cuts on along the axis and the bevel, in the plane, until the way along the axes is `way`.
    fn cut(course: &mut Course, way: f64, step: f64, slope: f64, length: f64) {
        for _ in 0..(way / step).round() as usize {
            let axis = course.tip.axis;
            let aside = DVec3::Z.cross(axis) * slope;
            course.advance(course.ahead(step, axis, aside, length), length);
        }
    }

    /// In undisturbed tissue a course is the path of the kinematic model, through a turn by half and whatever the parts.
    #[test]
    fn a_course_is_the_path_of_the_kinematic_model() {
        let (length, slope) = (20.0, 0.1);
        for step in [0.03, 0.5, 1.7] {
            let mut course = Course::new(DVec3::ZERO, DVec3::X);
            let params = BicycleParams {
                curvature_per_mm: slope / length,
                tip_ahead_mm: length,
            };
            let mut model = Bicycle::new(params, DVec3::ZERO, DVec3::X, DVec3::Y).unwrap();
            cut(&mut course, 51.0, step, slope, length);
            model.advance(51.0, 0.0);
            let apart = course.tip.at.distance(model.tip());
            assert!(apart < 0.03, "{step}: {apart}");
            cut(&mut course, 51.0, step, -slope, length);
            model.advance(0.0, std::f64::consts::PI);
            model.advance(51.0, 0.0);
            let apart = course.tip.at.distance(model.tip());
            assert!(apart < 0.05, "{step}: {apart}");
            assert!(course.tip.axis.distance(model.frame().tangent) < 0.01);
        }
    }

    /// Back to a place where it was before, a course goes on as it did from there.
    #[test]
    fn a_course_gone_back_is_the_shorter_one() {
        let (length, slope, step) = (20.0, 0.1, 0.25);
        let mut long = Course::new(DVec3::ZERO, DVec3::X);
        cut(&mut long, 20.0, step, slope, length);
        let short = long.clone();
        cut(&mut long, 20.0, step, slope, length);
        long.retract(short.tip.at + DVec3::Y * 0.01);
        assert!(long.fixed.len().abs_diff(short.fixed.len()) <= 1);
        assert!(long.tip.axis.distance(short.tip.axis) < slope * PIECE);
        assert!((long.tip.arc - short.tip.arc).abs() < 0.05);
        long.retract(DVec3::X * -3.0);
        assert_eq!(long.fixed.len(), 1);
        assert_eq!(long.tip.axis, DVec3::X);
    }

    /// What is handed to the beam ends at the tip, has no short pieces and begins at the entry where that is near enough.
    #[test]
    fn the_needle_behind_a_tip() {
        let mut course = Course::new(DVec3::ZERO, DVec3::X);
        cut(&mut course, 40.0, 0.11, 0.0, 20.0);
        for reach in [10.0, 100.0] {
            let (places, whole) = course.behind(reach);
            assert_eq!(whole, reach > 40.0);
            assert!((places[0].arc - (course.tip.arc - reach).max(0.0)).abs() < 1.0);
            assert_eq!(places.last().map(|p| p.at), Some(course.tip.at));
            for pair in places.windows(2) {
                assert!(pair[1].arc - pair[0].arc > 0.25 * PIECE * 20.0);
            }
        }
    }
}
