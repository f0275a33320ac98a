//! Where a tip cuts on to in the material (after Chentanez et al. 2009, §3.5).

use super::{Insertion, Needle};
use crate::Rod;
use crate::track::walk;
use glam::{DMat3, DVec3};
use palpate_fem::Material;
use std::f64::consts::PI;

/// Fewest places inside the tissue from which its mean deformation is taken.
const LEAST_PLACES: usize = 12;
/// Halvings of a ball that reaches too far out of thin tissue.
const BALLS: u32 = 3;
/// Radius of the cylinder as which a row of nodes of a mesh acts, of the tets' size (Peaceman's equivalent radius of a well).
const ROW_RADIUS: f64 = 0.2;
/// The mesh's share in the tip's direction at most, rad.
const MOST_EXCESS: f64 = 0.3;

/// What one part of a step did to a needle.
pub(super) struct Part<'a> {
    /// The needle before it.
    pub before: &'a Rod,
    /// Force of the tissue on each node of the chain, µN.
    pub forces: &'a [DVec3],
    /// Slip of the tip, mm.
    pub slip: f64,
}

/// A needle in tissue as a beam on an elastic foundation (Hetényi 1946).
struct Beam {
    /// Length over which it bends, mm: (4 E I / k)^¼, k the stiffness of the tissue per length.
    length: f64,
    /// Share of the mesh's stiffness per length that the tissue itself does not have.
    surplus: f64,
    /// Bending stiffness, µN·mm².
    bending: f64,
}

impl Beam {
    /// `size` is that of the tets, mm. A line load spread over a cylinder of radius r, held at a distance R, displaces it by
    /// (3 − 4ν) ln(R/r) / (8πG(1 − ν)) in plane strain (Kelvin); R is the length of the beam itself.
    fn new(rod: &Rod, material: &Material, size: f64) -> Self {
        let nu = material.poisson_ratio;
        let shear = material.youngs_modulus_pa / (2.0 * (1.0 + nu));
        let plane = 8.0 * PI * shear * (1.0 - nu) / (3.0 - 4.0 * nu);
        let bending = rod.stiffness().bending_un_mm2[0];
        let radius = 0.5 * rod.params().outer_diameter_mm;
        let reach = |length: f64, radius: f64| (length / radius).ln().max(0.2);
        let mut length = 50.0 * radius;
        for _ in 0..8 {
            length = (4.0 * bending * reach(length, radius) / plane).powf(0.25);
        }
        let row = (ROW_RADIUS * size).max(radius);
        Self {
            length,
            surplus: 1.0 - reach(length, row) / reach(length, radius),
            bending,
        }
    }

    /// Turn of a free end, rad per µN, that a force across the beam causes `behind` the end, mm.
    fn turn(&self, behind: f64) -> f64 {
        let s = behind / self.length;
        self.length * self.length / (2.0 * self.bending) * (-s).exp() * (s.cos() - s.sin())
    }
}

impl Insertion {
    /// Material place to which the tip of a needle cuts on, mm; `literal` is the world tip's place in the deformed tet `slot`. `None` where
    /// the tissue around gives no answer: so near the surface that one node is on the needle, in slivers of tissue, in a dent.
    ///
    /// As far as `literal`, but in the direction that the tissue around the tip has on the average, over the length in which the needle bends:
    /// one tet goes back from tissue that the needle drags along to tissue at rest, the more steeply, the smaller it is.
    pub(super) fn cut_place(&self, needle: &Needle, part: &Part, slot: u32, literal: DVec3) -> Option<DVec3> {
        let [.., _, last] = needle.chain[..] else {
            return None;
        };
        let mesh = self.tissue.mesh();
        let from = mesh.rest()[last as usize];
        let tet = mesh.tet(slot)?;
        let material = &self.tissue.materials()[tet.region as usize];
        let mut sizes: Vec<f64> = needle.chain.iter().map(|&n| self.size_at(n)).collect();
        sizes.sort_by(f64::total_cmp);
        let beam = Beam::new(&needle.rod, material, sizes[sizes.len() / 2]);
        let inverse = (0..BALLS)
            .find_map(|k| self.mean_gradient(from, beam.length * 0.5f64.powi(k as i32), slot))?
            .inverse();
        let (now, then) = (needle.rod.tip_frame(), part.before.tip_frame());
        // The direction half-way through the slip that the part has made: the needle's is that from where it began.
        let half = 0.5 * (now.tangent - then.tangent);
        let tangent = (now.tangent + half - excess(needle, part, &beam)).try_normalize()?;
        let along = (inverse * tangent).try_normalize()?;
        let way = (literal - from).dot(along);
        let aside = (inverse * now.m2).try_normalize()?;
        let to = from + way * (along + needle.friction.bevel_degrees.to_radians().tan() * aside);
        (way > 0.0 && walk(mesh, mesh.rest(), to, slot).is_some()).then_some(to)
    }

    /// Mean deformation gradient of the tissue in a ball of the material: the affine map that fits places in it best, which weighs the
    /// gradient by 1 − r²/radius². What the needle drags along falls off on both sides of the tip and cancels.
    fn mean_gradient(&self, middle: DVec3, radius: f64, mut slot: u32) -> Option<DMat3> {
        let (mesh, x) = (self.tissue.mesh(), self.tissue.positions());
        let mut places = Vec::with_capacity(33);
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
        let u0 = places.iter().map(|p| p.0).sum::<DVec3>() * share;
        let x0 = places.iter().map(|p| p.1).sum::<DVec3>() * share;
        let outer = |a: DVec3, b: DVec3| DMat3::from_cols(a * b.x, a * b.y, a * b.z);
        let (mut moved, mut spread) = (DMat3::ZERO, DMat3::ZERO);
        for (u, x) in &places {
            moved += outer(*x - x0, *u - u0) * share;
            spread += outer(*u - u0, *u - u0) * share;
        }
        // A full ball has (0.24 radius²)³.
        if spread.determinant() < 1e-4 * radius.powi(6) {
            return None;
        }
        let gradient = moved * spread.inverse();
        (gradient.determinant() > 0.1).then_some(gradient)
    }
}

/// By how much the tip's direction is turned because a mesh holds a needle more stiffly than the tissue itself: its nodes spread the needle's force
/// over their tets, and those at the ends of the chain, whose tissue half belongs to needle that is not there, over twice the length.
fn excess(needle: &Needle, part: &Part, beam: &Beam) -> DVec3 {
    let x = needle.rod.position();
    let (first, count) = (needle.first(), needle.chain.len());
    let (mut turn, mut behind) = (DVec3::ZERO, 0.0);
    for (j, force) in part.forces.iter().enumerate().rev() {
        let i = first + j;
        if j + 1 < count {
            behind += x[i].distance(x[i + 1]);
        }
        let end = j == 0 || j + 1 == count;
        let held = (1.0 - beam.surplus) * if end { 0.5 } else { 1.0 };
        let across = force.reject_from_normalized(needle.rod.node_tangent(i));
        turn += across * ((1.0 - held) * beam.turn(behind));
    }
    turn.reject_from_normalized(needle.rod.tip_frame().tangent)
        .clamp_length_max(MOST_EXCESS)
}
