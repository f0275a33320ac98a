//! Forces and Jacobians of all tets, four at a time, and their sums per node and per matrix row. Every node gathers from
//! its own tets in ascending order: no locks, no atomics, the same bits on any number of threads.

use crate::material::{JacobianMode, Law, Material, Moduli};
use crate::matrix::{BlockMatrix, ROWS_PER_TASK};
use crate::mesh::{Tet, TissueMesh};
use crate::rotation::get_lane;
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use wide::f64x4;

mod pack;

use pack::{Extra, Pack, block_index, set, splat3};

/// Packs handled by one task.
const PACKS_PER_TASK: usize = 32;

/// Which change of a tet makes its Jacobian stale (Chentanez et al. 2009, Eq. 12).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LazyTest {
    /// e = max|ΔR|·max|N|·max|B|·max(λ, α), with R = U·Vᵀ (for laws whose Jacobian depends on more than R, ΔF). Only R enters
    /// the blocks, and it is unique where U and V are not.
    #[default]
    Rotation,
    /// What force the stale Jacobian gets wrong in the coming step, µN: e = max|ΔR|·max|Ḟ|·Δt·max|N|·max(λ, α), with ΔF as above. A tet that
    /// has turned but stands still needs no new Jacobian; one that moves on does, for each step leaves it a residual that slows it down.
    Force,
    /// As printed, e = (max|ΔU|·max|ΔV|)²·max|N|·max|B|·max(λ, α). It is zero for any rigid turn, so that such tets are never
    /// renewed; for comparison. Signs of U and V follow the last ones.
    Printed,
}

/// A = mass·M + stiffness·K + damping·C, where −K and −C are the Jacobians of force by position and by velocity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Combination {
    pub mass: f64,
    pub stiffness: f64,
    pub damping: f64,
}

/// What a pass over the tets takes.
pub(crate) struct Pass<'a> {
    pub x: &'a [DVec3],
    pub v: &'a [DVec3],
    pub a: &'a [DVec3],
    /// The force gets −K·(px·v + pa·a) − C·(pd·a) added, K and C as they are in the matrix: [px, pa, pd].
    pub predict: Option<[f64; 3]>,
    /// Whether stale Jacobians are renewed.
    pub renew: bool,
    pub mode: JacobianMode,
    pub test: LazyTest,
    /// Least e at which a Jacobian is renewed, µN/mm (µN for [`LazyTest::Force`]); below 0 all are.
    pub threshold: f64,
    /// Length of the step, s, for [`LazyTest::Force`].
    pub dt: f64,
}

/// A tet's entry in a matrix row: the places of its four columns.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Entry {
    pub tet: u32,
    pub corner: u8,
    pub at: [u16; 4],
}

/// All tets of a mesh in packs, by slot.
#[derive(Clone, Debug, Default)]
pub(crate) struct Elements {
    packs: Vec<Pack>,
    /// Explicit stiffness by tet slot: blocks (i ≤ j) in row order, µN/mm. Empty while no tet needs it.
    blocks: Vec<[DMat3; 10]>,
    /// U and V of the last renewal by tet slot; empty unless the printed test is used.
    frames: Vec<[DMat3; 2]>,
    /// F of the last renewal of explicit tets.
    last_f: Vec<DMat3>,
    entries: Vec<Vec<Entry>>,
    /// Rows that must be summed again.
    dirty: Vec<bool>,
    pub mass: Vec<f64>,
    combination: Option<Combination>,
    mode: Option<JacobianMode>,
    /// Share of tets renewed in the last pass that renewed.
    pub renewed_share: f64,
}

impl Elements {
    /// Everything of a mesh; `materials` has one for each region that occurs.
    pub fn new(mesh: &TissueMesh, materials: &[Material], matrix: &mut BlockMatrix) -> Self {
        let mut e = Self::default();
        e.grow(mesh, matrix);
        for (slot, tet) in mesh.tets() {
            e.set_tet(mesh, slot, tet, materials);
            e.enter(slot, tet, matrix);
        }
        e.weigh(mesh, materials, 0..mesh.node_slots() as u32);
        e
    }

    /// Makes room for all slots of the mesh.
    pub fn grow(&mut self, mesh: &TissueMesh, matrix: &mut BlockMatrix) {
        while self.packs.len() * 4 < mesh.tet_slots() {
            self.packs.push(Pack::empty());
        }
        self.entries.resize(mesh.node_slots(), Vec::new());
        self.dirty.resize(mesh.node_slots(), true);
        self.mass.resize(mesh.node_slots(), 0.0);
        if !self.blocks.is_empty() {
            self.blocks.resize(mesh.tet_slots(), [DMat3::ZERO; 10]);
            self.last_f.resize(mesh.tet_slots(), DMat3::IDENTITY);
        }
        if !self.frames.is_empty() {
            self.frames.resize(mesh.tet_slots(), [DMat3::IDENTITY; 2]);
        }
        matrix.grow(mesh.node_slots());
    }

    /// Geometry and constants of a tet slot.
    pub fn set_tet(&mut self, mesh: &TissueMesh, slot: u32, tet: Tet, materials: &[Material]) {
        let element = mesh.element(tet);
        let material = &materials[tet.region as usize];
        let Moduli {
            mu_pa,
            lambda_pa,
            stiffening,
        } = material.moduli();
        let (pack, lane) = (&mut self.packs[slot as usize / 4], slot as usize % 4);
        for c in 0..4 {
            pack.corners[c][lane] = tet.corners[c];
        }
        for c in 0..3 {
            splat3(element.gradients[c + 1], lane, &mut pack.g[c]);
        }
        set(&mut pack.volume, lane, element.volume_mm3);
        set(&mut pack.mu, lane, mu_pa);
        set(&mut pack.lambda, lane, lambda_pa);
        set(&mut pack.stiffening, lane, stiffening);
        set(&mut pack.damping_s, lane, material.damping_s);
        let bit = 1u8 << lane;
        pack.law[lane] = material.law;
        pack.live |= bit;
        pack.linear &= !bit;
        if material.law == Law::Linear {
            pack.linear |= bit;
        }
        let largest = element
            .gradients
            .iter()
            .map(|g| g.abs().max_element())
            .fold(0.0, f64::max);
        let reach = largest * largest * 3.0 * element.volume_mm3 * lambda_pa * material.damping_s.max(1.0);
        set(&mut pack.reach, lane, reach);
        set(&mut pack.largest, lane, largest);
        pack.stale |= bit;
        self.set_explicit(mesh.tet_slots(), slot);
    }

    /// Keeps a tet's stiffness as blocks where its law and the Jacobian mode need it.
    fn set_explicit(&mut self, slots: usize, slot: u32) {
        let (pack, bit) = (&mut self.packs[slot as usize / 4], 1u8 << (slot % 4));
        let explicit = match pack.law[slot as usize % 4] {
            Law::Linear => false,
            Law::RotatedLinear | Law::Corotated => self.mode.is_some_and(|m| m != JacobianMode::Frozen),
            Law::NeoHookean | Law::StableNeoHookean | Law::Demiray => true,
        };
        if explicit {
            pack.explicit |= bit;
            if self.blocks.is_empty() {
                self.blocks = vec![[DMat3::ZERO; 10]; slots];
                self.last_f = vec![DMat3::IDENTITY; slots];
            }
        } else {
            pack.explicit &= !bit;
        }
    }

    /// Enters a tet into the rows of its nodes.
    pub fn enter(&mut self, slot: u32, tet: Tet, matrix: &mut BlockMatrix) {
        for (corner, &n) in tet.corners.iter().enumerate() {
            let at = tet.corners.map(|m| matrix.place(n, m));
            let list = &mut self.entries[n as usize];
            let place = list.partition_point(|e| e.tet < slot);
            list.insert(
                place,
                Entry {
                    tet: slot,
                    corner: corner as u8,
                    at,
                },
            );
            self.dirty[n as usize] = true;
        }
    }

    /// Takes a tet out.
    pub fn remove(&mut self, slot: u32, tet: Tet) {
        let (pack, lane) = (&mut self.packs[slot as usize / 4], slot as usize % 4);
        let bit = 1u8 << lane;
        for c in 0..4 {
            pack.corners[c][lane] = 0;
        }
        set(&mut pack.volume, lane, 0.0);
        for mask in [
            &mut pack.live,
            &mut pack.linear,
            &mut pack.explicit,
            &mut pack.stale,
        ] {
            *mask &= !bit;
        }
        for n in tet.corners {
            self.entries[n as usize].retain(|e| e.tet != slot);
            self.dirty[n as usize] = true;
        }
    }

    /// Drops unused matrix entries and looks up all places again.
    pub fn compact(&mut self, mesh: &TissueMesh, matrix: &mut BlockMatrix) {
        matrix.compact(|i, j| {
            mesh.around(i)
                .iter()
                .any(|e| mesh.tet(e.tet).is_some_and(|t| t.corners.contains(&j)))
        });
        for (n, list) in self.entries.iter_mut().enumerate() {
            for e in list {
                if let Some(t) = mesh.tet(e.tet) {
                    e.at = t.corners.map(|m| matrix.place(n as u32, m));
                }
            }
        }
    }

    /// Lumped masses of nodes, g: a quarter of each tet around.
    pub fn weigh(&mut self, mesh: &TissueMesh, materials: &[Material], nodes: impl IntoIterator<Item = u32>) {
        for n in nodes {
            self.mass[n as usize] = mesh
                .around(n)
                .iter()
                .filter_map(|e| Some((e.tet, mesh.tet(e.tet)?)))
                .map(|(slot, t)| {
                    let volume = self.packs[slot as usize / 4].volume.to_array()[slot as usize % 4];
                    0.25 * volume * materials[t.region as usize].density_g_mm3
                })
                .sum();
            self.dirty[n as usize] = true;
        }
    }

    /// Has a node's row summed anew by the next assembly: something was added to it.
    pub fn soil(&mut self, node: usize) {
        self.dirty[node] = true;
    }

    /// Makes the next pass renew everything.
    pub fn invalidate(&mut self) {
        for p in &mut self.packs {
            p.stale = p.live;
        }
    }

    fn set_mode(&mut self, mode: JacobianMode, test: LazyTest) {
        let slots = self.packs.len() * 4;
        if self.mode != Some(mode) {
            self.mode = Some(mode);
            for slot in 0..slots as u32 {
                if self.packs[slot as usize / 4].live & (1 << (slot % 4)) != 0 {
                    self.set_explicit(slots, slot);
                }
            }
            self.invalidate();
        }
        if test == LazyTest::Printed && self.frames.is_empty() {
            self.frames = vec![[DMat3::IDENTITY; 2]; slots];
            self.invalidate();
        }
    }

    /// Forces of every tet and, where asked, renewal of its Jacobian; then the sum of forces per node, µN.
    pub fn pass(&mut self, pass: &Pass, forces: &mut [DVec3]) {
        if pass.renew {
            self.set_mode(pass.mode, pass.test);
        }
        let slots = self.packs.len() * 4;
        // Padded to whole packs, so that chunks line up.
        if !self.blocks.is_empty() {
            self.blocks.resize(slots, [DMat3::ZERO; 10]);
            self.last_f.resize(slots, DMat3::IDENTITY);
        }
        if !self.frames.is_empty() {
            self.frames.resize(slots, [DMat3::IDENTITY; 2]);
        }
        let width = 4 * PACKS_PER_TASK;
        let tasks = self.packs.len().div_ceil(PACKS_PER_TASK);
        let mut extras: Vec<Extra> = (0..tasks).map(|_| Extra::default()).collect();
        for (extra, chunk) in extras.iter_mut().zip(self.blocks.chunks_mut(width)) {
            extra.blocks = chunk;
        }
        for (extra, chunk) in extras.iter_mut().zip(self.last_f.chunks_mut(width)) {
            extra.last_f = chunk;
        }
        for (extra, chunk) in extras.iter_mut().zip(self.frames.chunks_mut(width)) {
            extra.frames = chunk;
        }
        self.packs
            .par_chunks_mut(PACKS_PER_TASK)
            .zip(extras.par_iter_mut())
            .for_each(|(packs, extra)| {
                for (k, pack) in packs.iter_mut().enumerate() {
                    pack.run(pass, extra, 4 * k);
                }
            });
        let packs = &self.packs;
        forces
            .par_chunks_mut(ROWS_PER_TASK)
            .zip(self.entries.par_chunks(ROWS_PER_TASK))
            .zip(self.dirty.par_chunks_mut(ROWS_PER_TASK))
            .for_each(|((forces, entries), dirty)| {
                for ((force, list), dirty) in forces.iter_mut().zip(entries).zip(dirty) {
                    let mut sum = DVec3::ZERO;
                    for e in list {
                        let (pack, lane) = (&packs[e.tet as usize / 4], e.tet as usize % 4);
                        let f = &pack.force[e.corner as usize];
                        sum += DVec3::new(
                            f[0].as_array()[lane],
                            f[1].as_array()[lane],
                            f[2].as_array()[lane],
                        );
                        *dirty |= pass.renew && pack.renewed & (1 << lane) != 0;
                    }
                    *force = sum;
                }
            });
        if pass.renew {
            let (mut renewed, mut live) = (0, 0);
            for p in &self.packs {
                renewed += p.renewed.count_ones();
                live += p.live.count_ones();
            }
            self.renewed_share = f64::from(renewed) / f64::from(live.max(1));
        }
    }

    /// Brings the matrix to mass·M + stiffness·K + damping·C with the Jacobians of the last renewal: rows around renewed tets are
    /// summed again, all others stay.
    pub fn assemble(&mut self, combination: Combination, matrix: &mut BlockMatrix) {
        if self.combination != Some(combination) {
            self.combination = Some(combination);
            self.dirty.fill(true);
        }
        let Self {
            packs,
            blocks,
            entries,
            dirty,
            mass,
            ..
        } = self;
        let (packs, blocks, mass) = (&*packs, &*blocks, &*mass);
        matrix
            .rows
            .par_chunks_mut(ROWS_PER_TASK)
            .zip(entries.par_chunks(ROWS_PER_TASK))
            .zip(dirty.par_chunks_mut(ROWS_PER_TASK))
            .enumerate()
            .for_each(|(task, ((rows, entries), dirty))| {
                for (k, ((row, list), dirty)) in rows.iter_mut().zip(entries).zip(dirty).enumerate() {
                    if !std::mem::take(dirty) {
                        continue;
                    }
                    row.blocks.fill(DMat3::ZERO);
                    row.blocks[0] =
                        DMat3::from_diagonal(DVec3::splat(combination.mass * mass[task * ROWS_PER_TASK + k]));
                    for e in list {
                        let lane = e.tet as usize % 4;
                        let pack = &packs[e.tet as usize / 4];
                        pack.add_blocks(lane, e, combination, &mut row.blocks);
                        if pack.explicit & (1 << lane) != 0 {
                            let b = &blocks[e.tet as usize];
                            let i = e.corner as usize;
                            for j in 0..4 {
                                let block = b[block_index(i, j)] * combination.stiffness;
                                row.blocks[e.at[j] as usize] +=
                                    if i <= j { block } else { block.transpose() };
                            }
                        }
                    }
                }
            });
    }

    /// Strain energy, nJ.
    pub fn energy_nj(&self, x: &[DVec3]) -> f64 {
        let parts: Vec<f64> = self
            .packs
            .par_chunks(PACKS_PER_TASK)
            .map(|packs| {
                let mut sum = 0.0;
                for p in packs {
                    let f = p.gradient(x);
                    for lane in (0..4).filter(|l| p.live & (1 << l) != 0) {
                        let volume = p.volume.to_array()[lane];
                        sum += volume * p.law[lane].energy_density(p.moduli(lane), get_lane(&f, lane));
                    }
                }
                sum
            })
            .collect();
        parts.iter().sum()
    }

    /// Largest entry of any tet's Σ wᵢ gᵢᵀ; infinite where one is not finite.
    pub fn largest_gradient(&self, w: &[DVec3]) -> f64 {
        self.packs
            .par_iter()
            .map(|p| {
                let g = p.gradient_of_rate(w);
                let mut most = f64x4::ZERO;
                let mut sum = f64x4::ZERO;
                for x in g.iter().flatten() {
                    most = most.max(x.abs());
                    sum += x.abs();
                }
                let most = most.to_array().into_iter().fold(0.0, f64::max);
                if sum.reduce_add().is_finite() {
                    most
                } else {
                    f64::INFINITY
                }
            })
            .reduce(|| 0.0, f64::max)
    }

    /// Determinant of F by live tet slot.
    pub fn volume_ratios(&self, x: &[DVec3]) -> Vec<(u32, f64)> {
        let mut out = Vec::new();
        for (k, p) in self.packs.iter().enumerate() {
            let f = p.gradient(x);
            for lane in (0..4).filter(|l| p.live & (1 << l) != 0) {
                out.push(((4 * k + lane) as u32, get_lane(&f, lane).determinant()));
            }
        }
        out
    }
}

#[cfg(test)]
mod tests;
