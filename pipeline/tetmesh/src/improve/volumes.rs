//! Volumes held by shifting whole surfaces, and vertices brought onto their surfaces.

use super::Improver;
use super::params::{ImproveParams, VolumeChange};
use super::smooth::GAIN;
use crate::geometry::{cross, dot, sub};
use crate::tet_volume;

/// What the volumes of the whole (0) and of the regions 1, 2, … were and shall be, mm³.
pub(super) struct Goals {
    before: Vec<f64>,
    target: Vec<f64>,
}

impl Goals {
    pub fn new(improver: &Improver<'_>, params: &ImproveParams) -> Self {
        let before = improver.volumes();
        let mut target = before.clone();
        let sane = |v: &Option<f64>| v.filter(|v| v.is_finite() && *v > 0.0);
        if let Some(v) = sane(&params.targets.whole_mm3) {
            target[0] = v;
        }
        for (slot, v) in target[1..].iter_mut().zip(&params.targets.structures_mm3) {
            if let Some(v) = sane(v)
                && *slot > 0.0
            {
                *slot = v;
            }
        }
        Self { before, target }
    }

    pub fn changes(&self, improver: &Improver<'_>) -> Vec<VolumeChange> {
        improver
            .volumes()
            .into_iter()
            .enumerate()
            .map(|(s, after_mm3)| VolumeChange {
                before_mm3: self.before[s],
                after_mm3,
                target_mm3: self.target[s],
                error: if self.target[s] > 0.0 {
                    after_mm3 / self.target[s] - 1.0
                } else {
                    0.0
                },
                shift_mm: improver.sheets.level[s],
            })
            .collect()
    }
}

impl Improver<'_> {
    /// Volume of the whole, then of the regions 1, 2, …, mm³.
    pub fn volumes(&self) -> Vec<f64> {
        let mut out = vec![0.0; self.sheets.count()];
        for t in 0..self.complex.tets.len() as u32 {
            if self.complex.is_alive(t) {
                let volume = tet_volume(self.complex.corners(t));
                out[0] += volume;
                let r = usize::from(self.complex.region[t as usize]);
                if r > 0 {
                    out[r] += volume;
                }
            }
        }
        out
    }

    /// Area of each surface, mm²; and the part of the outer boundary that belongs to each region.
    fn areas(&self) -> (Vec<f64>, Vec<f64>) {
        let n = self.sheets.count();
        let (mut surface, mut outer) = (vec![0.0; n], vec![0.0; n]);
        let Some(faces) = super::sheets::interfaces(&self.complex.tets, &self.complex.region) else {
            return (surface, outer);
        };
        for f in faces {
            let [a, b, c] = f.corners.map(|v| self.complex.pos[v as usize]);
            let w = cross(sub(b, a), sub(c, a));
            let area = 0.5 * dot(w, w).sqrt();
            match f.outside {
                None => {
                    surface[0] += area;
                    outer[usize::from(f.inside)] += area;
                }
                Some(o) => surface[usize::from(self.complex.partition.between(f.inside, o))] += area,
            }
        }
        (surface, outer)
    }

    /// Shifts the levels of the surfaces towards the volumes; returns whether there was anything to do.
    pub fn shift_levels(&mut self, goals: &Goals, params: &ImproveParams, edge_mm: f64) -> bool {
        let volumes = self.volumes();
        let (area, outer) = self.areas();
        let most = params.max_shift_edges * edge_mm;
        let error = |s: usize| goals.target[s] - volumes[s];
        if (0..volumes.len()).all(|s| error(s).abs() <= params.volume_tolerance * goals.target[s]) {
            return false;
        }
        let mut shift = |s: usize, lack: f64| {
            let old = self.sheets.level[s];
            if area[s] > 0.0 {
                self.sheets.level[s] = (old + lack / area[s]).clamp(-most, most);
            }
            self.sheets.level[s] - old
        };
        let moved = shift(0, error(0));
        for s in 1..volumes.len() {
            if goals.target[s] > 0.0 {
                shift(s, error(s) - moved * outer[s]);
            }
        }
        true
    }

    /// Brings every surface vertex onto its surfaces, as far as no tet gets worse that is not good.
    pub fn settle(&mut self) {
        self.stuck_vertex.clear();
        self.stuck_tet.clear();
        let good = self.complex.marks.of_angles(26.0, 124.0);
        let worst = (0..self.complex.tets.len() as u32)
            .filter(|&t| self.complex.is_alive(t))
            .map(|t| self.complex.score[t as usize])
            .fold(f64::INFINITY, f64::min);
        let floor = good.max(worst);
        for v in 0..self.complex.pos.len() as u32 {
            let mask = self.complex.mask[v as usize];
            if mask == 0 || mask.count_ones() > 2 || self.complex.star[v as usize].is_empty() {
                continue;
            }
            let p = self.complex.pos[v as usize];
            let Some(q) = self.sheets.project(mask, p) else {
                continue;
            };
            let least = self.complex.star_score(v).min(floor) - GAIN;
            for part in [1.0, 0.5, 0.2] {
                let x: [f64; 3] = std::array::from_fn(|a| p[a] + part * (q[a] - p[a]));
                if x == p {
                    break;
                }
                let fits = self.complex.star[v as usize].iter().all(|&t| {
                    let [_, a, b, c] = self.complex.corners_from(t, v);
                    let [a, b, c] = [a, b, c].map(|u| self.complex.pos[u as usize]);
                    self.complex.marks.score(&[x, a, b, c]) >= least
                });
                if fits {
                    self.complex.move_vertex(v, x);
                    break;
                }
            }
        }
    }
}
