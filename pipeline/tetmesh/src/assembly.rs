//! The unoptimised mesh: lattice, outer surface, dividers, at given levels.

use crate::TetError;
use crate::background::Background;
use crate::faces::FaceTable;
use crate::geometry::{cross, length, sub, volume6};
use crate::graded::Splits;
use crate::interface::{CutCounts, cut_dividers, interface_divider};
use crate::lattice::{Lattice, NEIGHBOURS};
use crate::mending::stuff;
use crate::quality::dihedral_angles;
use crate::stuffing::{Complex, StuffCounts, WarpRule};
use crate::surfaces::{Level, SurfaceSet};
use palpate_volume::Implicit;
use rayon::prelude::*;

/// A point this far (edges) inside stays where it is: warping reaches 0.36 edges.
const CLEAR_EDGES: f64 = 0.36;

/// What is meshed and how, apart from the lattice and the levels.
pub(crate) struct Plan<'a> {
    pub organ: &'a dyn Implicit,
    pub dividers: &'a [&'a dyn Implicit],
    /// Dividers that get faces of their own.
    pub conforming: &'a [bool],
    pub rule: WarpRule,
    /// Whether the interior is coarser.
    pub graded: bool,
}

/// Levels of the fields that are stuffed, mm.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Levels {
    pub outer: f64,
    pub dividers: Vec<f64>,
}

impl Levels {
    pub fn zero(dividers: usize) -> Self {
        Self {
            outer: 0.0,
            dividers: vec![0.0; dividers],
        }
    }
}

/// The mesh before optimisation.
pub(crate) struct Assembly {
    pub complex: Complex,
    pub regions: Vec<u16>,
    pub stuffed: StuffCounts,
    pub cut: CutCounts,
    /// Volume of the whole, then of each structure, mm³.
    pub volumes_mm3: Vec<f64>,
    /// Area of the outer surface, then of each structure's interface, mm².
    pub areas_mm2: Vec<f64>,
    /// Smallest and largest dihedral angle, degrees.
    pub angles: (f64, f64),
    /// Tets with an angle outside of 15°–150°.
    pub poor: usize,
    /// Euler number of the outer boundary.
    pub euler: i64,
}

impl Plan<'_> {
    /// Lattice with the given edge; `shift` (shares of an edge) moves it against the organ's box.
    pub fn lattice(&self, edge_mm: f64, shift: [f64; 3]) -> Result<Lattice, TetError> {
        let (lo, hi) = self.organ.bounds();
        let origin = std::array::from_fn(|a| lo[a] + shift[a] * edge_mm);
        Lattice::covering(lo, hi, edge_mm, origin)
    }

    /// The lattice with the cells of `splits` divided; with a coarser interior, where that is asked for.
    pub fn background(&self, base: Lattice, splits: &Splits) -> Background {
        if !self.graded {
            return if splits.is_empty() {
                Background::uniform(base)
            } else {
                Background::graded(&base, splits, |_| false, self.organ)
            };
        }
        // Cells plainly inside, with all that they touch, and on one side of every divider.
        let clear = CLEAR_EDGES * base.edge_mm;
        let side: Vec<Option<u64>> = (0..base.len() as u32)
            .into_par_iter()
            .with_min_len(512)
            .map(|id| {
                let p = base.position(base.triple(id));
                let v = self.organ.value(p);
                if v.is_nan() || v > -clear {
                    return None;
                }
                let mut inside = 0u64;
                for n in (0..self.dividers.len()).filter(|&n| self.conforming[n]) {
                    let v = self.dividers[n].value(p);
                    if v.is_nan() || v.abs() < 0.9 * base.edge_mm {
                        return None;
                    }
                    inside |= u64::from(v < 0.0) << n;
                }
                Some(inside)
            })
            .collect();
        let may_grow = |c: [usize; 3]| {
            let centre: [i32; 3] = std::array::from_fn(|a| base.lo[a] + 2 * c[a] as i32 + 1);
            let at = |d: [i32; 3]| {
                base.id(std::array::from_fn(|a| centre[a] + d[a]))
                    .and_then(|id| side[id as usize])
            };
            let own = at([0; 3]);
            own.is_some() && NEIGHBOURS.iter().all(|&d| at(d) == own)
        };
        Background::graded(&base, splits, may_grow, self.organ)
    }

    pub fn assemble(&self, background: &Background, levels: &Levels) -> Result<Assembly, TetError> {
        let outer = Level {
            inner: self.organ,
            level_mm: levels.outer,
        };
        let shifted: Vec<Level> = self
            .dividers
            .iter()
            .zip(&levels.dividers)
            .map(|(d, l)| Level {
                inner: *d,
                level_mm: *l,
            })
            .collect();
        let dividers: Vec<&dyn Implicit> = shifted.iter().map(|l| l as &dyn Implicit).collect();
        let surfaces = SurfaceSet {
            outer: &outer,
            dividers: &dividers,
        };
        let (mut complex, stuffed) = stuff(&outer, background.clone(), &self.rule)?;
        let (regions, cut) = cut_dividers(
            &mut complex,
            background,
            &surfaces,
            self.conforming,
            self.rule.linear,
        );
        let mut out = Assembly {
            complex,
            regions,
            stuffed,
            cut,
            volumes_mm3: vec![0.0; self.dividers.len() + 1],
            areas_mm2: vec![0.0; self.dividers.len() + 1],
            angles: (180.0, 0.0),
            poor: 0,
            euler: 0,
        };
        out.measure()?;
        Ok(out)
    }
}

impl Assembly {
    fn measure(&mut self) -> Result<(), TetError> {
        for (n, &t) in self.complex.tets.iter().enumerate() {
            let c = self.complex.corners(t);
            let v = volume6(c) / 6.0;
            if v.is_nan() || v <= 0.0 {
                let position = crate::geometry::centroid4(c);
                return Err(TetError::Inverted {
                    tet: n,
                    position,
                    volume_mm3: v,
                });
            }
            self.volumes_mm3[0] += v;
            if self.regions[n] > 0 {
                self.volumes_mm3[usize::from(self.regions[n])] += v;
            }
            let angles = dihedral_angles(c);
            let (low, high) = angles
                .iter()
                .fold((180.0f64, 0.0f64), |m, &a| (m.0.min(a), m.1.max(a)));
            self.angles = (self.angles.0.min(low), self.angles.1.max(high));
            self.poor += usize::from(low < 15.0 || high > 150.0);
        }
        let mut outer_faces = 0i64;
        let mut on_outer = vec![false; self.complex.points.len()];
        for g in FaceTable::new(&self.complex.tets, self.complex.points.len(), |_| true).groups() {
            let at = match g {
                [f] => {
                    outer_faces += 1;
                    f.key.iter().for_each(|&v| on_outer[v as usize] = true);
                    Some(0)
                }
                [a, b, ..] => interface_divider(self.regions[a.tet as usize], self.regions[b.tet as usize])
                    .map(|n| n + 1),
                [] => None,
            };
            if let Some(at) = at {
                let [p, q, r] = g[0].key.map(|v| self.complex.points[v as usize]);
                self.areas_mm2[at] += 0.5 * length(cross(sub(q, p), sub(r, p)));
            }
        }
        // On a closed surface three edges belong to two faces.
        self.euler = on_outer.iter().filter(|&&on| on).count() as i64 - outer_faces / 2;
        Ok(())
    }
}
