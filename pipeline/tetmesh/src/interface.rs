//! Several materials: cuts the stuffed organ along each divider, on both sides, so that faces lie on it.
//!
//! Nodes close to a divider are moved onto it first (nodes of the outer surface slide along it onto the junction
//! curve), then every crossed tet is cut with the stencils. On faces of the lattice the parity rule picks the
//! diagonals, elsewhere the smaller node index; both depend on the face alone, so the pieces conform.

use crate::background::{Background, EdgeKind, edge_kind};
use crate::faces::{Components, FaceTable};
use crate::geometry::{centroid4, dot, lerp, volume6};
use crate::quality::volume_length_quality;
use crate::stencil::{Cutter, ZZZZ, cut_tet, pattern_index};
use crate::stuffing::{Complex, Source, WarpRule, edge_root};
use crate::surfaces::{OUTER, SurfaceSet, divider_bit};
use palpate_volume::Implicit;
use rustc_hash::FxHashMap;

/// Tets that more than one surface has shaped: no proven bound.
pub(crate) const SEVERAL: u8 = 255;

/// Share of an edge that is not one of the lattice's within which a divider's cut attracts the end.
const ALPHA_OTHER: f64 = 0.32;
/// Structures closer than this share of the lattice edge share faces.
const TOUCHING: f64 = 0.25;
/// A move that shapes tets outside of the proven cases must leave them this good (volume–length), or as they were.
const LEAST_QUALITY: f64 = 0.08;

/// What cutting the dividers did.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct CutCounts {
    /// Nodes moved onto a divider.
    pub snapped: usize,
    /// Of these, nodes that slid along another surface.
    pub slid: usize,
    /// Moves that were refused because they would have flattened a tet.
    pub refused: usize,
    /// Tets with all corners on the divider.
    pub zzzz: usize,
    /// Wedges that needed a node of their own.
    pub middles: usize,
    /// Cut nodes left on their chord because the surface point would have inverted a tet.
    pub on_chord: usize,
    /// Pieces of a region smaller than four lattice tets that were given to a neighbour.
    pub merged_pieces: usize,
    /// Their volume, mm³.
    pub merged_mm3: f64,
}

/// Cuts `complex` (all of region 0) along every conforming divider in turn. Returns the region of each tet.
pub(crate) fn cut_dividers(
    complex: &mut Complex,
    background: &Background,
    surfaces: &SurfaceSet,
    conforming: &[bool],
    linear: bool,
) -> (Vec<u16>, CutCounts) {
    let mut regions = vec![0; complex.tets.len()];
    let mut counts = CutCounts::default();
    for n in (0..surfaces.dividers.len()).filter(|&n| conforming[n]) {
        Stage {
            complex,
            regions: &mut regions,
            background,
            surfaces,
            n,
            linear,
            counts: &mut counts,
        }
        .run();
    }
    merge_specks(
        complex,
        &mut regions,
        background.edge_mm.powi(3) / 3.0,
        &mut counts,
    );
    (regions, counts)
}

/// Surfaces that each edge of a surface face lies on, by the face's two sides.
pub(crate) fn surface_edges(tets: &[[u32; 4]], regions: &[u16], nodes: usize) -> FxHashMap<(u32, u32), u64> {
    let mut out: FxHashMap<(u32, u32), u64> = FxHashMap::default();
    for g in FaceTable::new(tets, nodes, |_| true).groups() {
        let bit = match g {
            [_] => OUTER,
            [a, b, ..] => match interface_divider(regions[a.tet as usize], regions[b.tet as usize]) {
                Some(n) => divider_bit(n),
                None => continue,
            },
            [] => continue,
        };
        let k = g[0].key;
        for e in [(k[0], k[1]), (k[0], k[2]), (k[1], k[2])] {
            *out.entry(e).or_default() |= bit;
        }
    }
    out
}

/// The divider on which faces between two regions lie: the first structure of the two was cut first.
pub(crate) fn interface_divider(a: u16, b: u16) -> Option<usize> {
    match (a.min(b), a.max(b)) {
        (x, y) if x == y => None,
        (0, y) => Some(usize::from(y) - 1),
        (x, _) => Some(usize::from(x) - 1),
    }
}

struct Stage<'a> {
    complex: &'a mut Complex,
    regions: &'a mut Vec<u16>,
    background: &'a Background,
    surfaces: &'a SurfaceSet<'a>,
    n: usize,
    linear: bool,
    counts: &'a mut CutCounts,
}

fn key(a: u32, b: u32) -> (u32, u32) {
    (a.min(b), a.max(b))
}

const EDGES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];

impl Stage<'_> {
    fn field(&self) -> &dyn Implicit {
        self.surfaces.dividers[self.n]
    }

    fn run(mut self) {
        let values: Vec<f64> = self
            .complex
            .points
            .iter()
            .map(|&p| self.field().value(p))
            .collect();
        let mut signs: Vec<i8> = values
            .iter()
            .map(|&v| if v < 0.0 { -1 } else { i8::from(v > 0.0) })
            .collect();
        let on_edge = surface_edges(&self.complex.tets, self.regions, self.complex.points.len());
        let mut on_node = vec![0u64; self.complex.points.len()];
        for (e, set) in &on_edge {
            on_node[e.0 as usize] |= set;
            on_node[e.1 as usize] |= set;
        }
        self.respect_earlier(&values, &on_node, &mut signs);
        if !signs.iter().any(|&s| s < 0) {
            return;
        }
        let roots = self.roots(&values, &signs);
        let (irregular, moved) = self.snap(&roots, &on_node, &mut signs);
        let shared: Vec<bool> = on_node.iter().map(|set| set & !OUTER != 0).collect();
        self.cut(&roots, &on_edge, [&irregular, &moved, &shared], &signs);
    }

    /// Keeps the cut out of structures that were cut before: their inner nodes count as on the divider, so that no
    /// edge to them is crossed; so do nodes of an earlier interface along which this divider runs, so that
    /// structures which touch share faces.
    fn respect_earlier(&self, values: &[f64], on_node: &[u64], signs: &mut [i8]) {
        let mut host = vec![false; signs.len()];
        for (t, &r) in self.complex.tets.iter().zip(self.regions.iter()) {
            if r == 0 {
                t.iter().for_each(|&v| host[v as usize] = true);
            }
        }
        for v in 0..signs.len() {
            if !host[v] {
                signs[v] = 0;
                continue;
            }
            let earlier = on_node[v] & !OUTER;
            if earlier != 0 && values[v].abs() < TOUCHING * self.background.edge_mm {
                let p = self.complex.points[v];
                let g = self.field().gradient(p);
                let along = (0..self.n).filter(|&m| earlier & divider_bit(m) != 0).any(|m| {
                    let q = self.surfaces.dividers[m].gradient(p);
                    dot(g, q) < -0.8 * (dot(g, g) * dot(q, q)).sqrt()
                });
                if along {
                    signs[v] = 0;
                }
            }
        }
    }

    /// Parameter of the cut from the smaller node, for each crossed edge.
    fn roots(&self, values: &[f64], signs: &[i8]) -> Vec<((u32, u32), f64)> {
        let mut crossed: Vec<(u32, u32)> = Vec::new();
        for t in &self.complex.tets {
            for [i, j] in EDGES {
                if signs[t[i] as usize] * signs[t[j] as usize] < 0 {
                    crossed.push(key(t[i], t[j]));
                }
            }
        }
        crossed.sort_unstable();
        crossed.dedup();
        crossed
            .into_iter()
            .map(|(a, b)| {
                let (pa, pb) = (self.complex.points[a as usize], self.complex.points[b as usize]);
                let t = edge_root(
                    self.field(),
                    pa,
                    pb,
                    values[a as usize],
                    values[b as usize],
                    self.linear,
                );
                ((a, b), t)
            })
            .collect()
    }

    /// Share of the edge a–b within which a cut attracts its ends.
    fn alpha(&self, a: u32, b: u32) -> f64 {
        match (self.complex.sources[a as usize], self.complex.sources[b as usize]) {
            (Source::Lattice(a), Source::Lattice(b)) => {
                match edge_kind(self.background.triple(a), self.background.triple(b)).0 {
                    EdgeKind::Long => WarpRule::ARBITRARY.alpha_long,
                    EdgeKind::Short => WarpRule::ARBITRARY.alpha_short,
                    EdgeKind::Other => ALPHA_OTHER,
                }
            }
            _ => ALPHA_OTHER,
        }
    }

    /// Moves nodes with a near cut onto the divider, nodes of other surfaces first. Returns for each node whether it
    /// lies on another surface or moved otherwise than along a lattice edge (tets around it are outside of the
    /// proven cases), and whether it moved.
    fn snap(
        &mut self,
        roots: &[((u32, u32), f64)],
        on_node: &[u64],
        signs: &mut [i8],
    ) -> (Vec<bool>, Vec<bool>) {
        let mut irregular: Vec<bool> = on_node.iter().map(|&set| set != 0).collect();
        let mut moved = vec![false; on_node.len()];
        let mut ends: Vec<(u32, u32, f64)> = Vec::with_capacity(2 * roots.len());
        for &((a, b), t) in roots {
            ends.push((a, b, t));
            ends.push((b, a, 1.0 - t));
        }
        ends.sort_unstable_by_key(|e| (on_node[e.0 as usize] == 0, e.0, e.1));
        let star = self.stars(&ends);
        let bit = divider_bit(self.n);
        for group in ends.chunk_by(|a, b| a.0 == b.0) {
            let node = group[0].0;
            if signs[node as usize] == 0 {
                continue;
            }
            let p = self.complex.points[node as usize];
            let mut best: Option<(f64, [f64; 3], u32)> = None;
            for &(_, other, t) in group {
                if signs[other as usize] != -signs[node as usize] || t >= self.alpha(node, other) {
                    continue;
                }
                let q = lerp(p, self.complex.points[other as usize], t);
                let d = crate::geometry::distance(p, q);
                if best.is_none_or(|b| d < b.0) {
                    best = Some((d, q, other));
                }
            }
            let Some((d, mut q, other)) = best else { continue };
            let set = on_node[node as usize];
            if set != 0 {
                // Slide: a surface node may not leave its surfaces.
                let reach = (2.0 * d).max(0.1 * self.background.edge_mm);
                match self.surfaces.project(q, set | bit, reach) {
                    Some(s) => q = s,
                    None => {
                        self.counts.refused += 1;
                        continue;
                    }
                }
            }
            if self.may_move(&star[&node], node, q) {
                self.complex.points[node as usize] = q;
                signs[node as usize] = 0;
                moved[node as usize] = true;
                irregular[node as usize] |=
                    !self.on_lattice(node) || !self.on_lattice(other) || irregular[other as usize];
                self.counts.snapped += 1;
                self.counts.slid += usize::from(set != 0);
            } else {
                self.counts.refused += 1;
                irregular[node as usize] = true;
            }
        }
        (irregular, moved)
    }

    fn on_lattice(&self, node: u32) -> bool {
        matches!(self.complex.sources[node as usize], Source::Lattice(_))
    }

    /// Tets around each node of `ends`.
    fn stars(&self, ends: &[(u32, u32, f64)]) -> FxHashMap<u32, Vec<u32>> {
        let mut star: FxHashMap<u32, Vec<u32>> = ends.iter().map(|e| (e.0, Vec::new())).collect();
        for (n, t) in self.complex.tets.iter().enumerate() {
            for v in t {
                if let Some(list) = star.get_mut(v) {
                    list.push(n as u32);
                }
            }
        }
        star
    }

    /// Whether the node may go to `q`: no tet inverts, and tets outside of the proven cases stay good.
    fn may_move(&self, star: &[u32], node: u32, q: [f64; 3]) -> bool {
        star.iter().all(|&t| {
            let tet = self.complex.tets[t as usize];
            let old = self.complex.corners(tet);
            let new = std::array::from_fn(|i| if tet[i] == node { q } else { old[i] });
            let proven = tet
                .iter()
                .all(|&v| matches!(self.complex.sources[v as usize], Source::Lattice(_)))
                && self.complex.patterns[t as usize] == 0;
            let least = if proven {
                0.0
            } else {
                LEAST_QUALITY.min(0.9 * volume_length_quality(old))
            };
            volume6(new) > 0.0 && volume_length_quality(new) >= least
        })
    }

    fn cut(
        &mut self,
        roots: &[((u32, u32), f64)],
        on_edge: &FxHashMap<(u32, u32), u64>,
        [irregular, moved, shared]: [&[bool]; 3],
        signs: &[i8],
    ) {
        let old_nodes = self.complex.points.len();
        let tets = std::mem::take(&mut self.complex.tets);
        let patterns = std::mem::take(&mut self.complex.patterns);
        let regions = std::mem::take(self.regions);
        let structure = self.n as u16 + 1;
        let mut to = Pieces {
            complex: self.complex,
            background: self.background,
            surfaces: self.surfaces,
            bit: divider_bit(self.n),
            roots,
            on_edge,
            cuts: FxHashMap::default(),
            chords: Vec::new(),
            pieces: Vec::new(),
            middles: 0,
        };
        for (n, &t) in tets.iter().enumerate() {
            let s = t.map(|v| signs[v as usize]);
            let crossed = s.contains(&-1) && s.contains(&1);
            let touched = crossed
                || if regions[n] == 0 {
                    s.contains(&0)
                } else {
                    t.iter().any(|&v| moved[v as usize])
                };
            to.pieces.clear();
            if s == [0; 4] {
                self.counts.zzzz += usize::from(regions[n] == 0);
                // A gap between structures that share faces is closed.
                let gap = t.iter().any(|&v| shared[v as usize]);
                let level = if gap {
                    TOUCHING * self.background.edge_mm
                } else {
                    0.0
                };
                let c = centroid4(to.complex.corners(t));
                let inside = self.surfaces.dividers[self.n].value(c) < level;
                let side = if inside { -1 } else { 1 };
                to.pieces.push((side, 0, 0, t));
            } else {
                cut_tet(t, s, &mut to);
            }
            // Proven shapes: lattice tets that this divider alone has shaped.
            let lattice_tet = patterns[n] == 0 && t.iter().all(|&v| !irregular[v as usize]);
            for i in 0..to.pieces.len() {
                let (side, own, other, piece) = to.pieces[i];
                let pattern = if !touched {
                    patterns[n]
                } else if !lattice_tet {
                    SEVERAL
                } else if own == 0 {
                    ZZZZ
                } else {
                    pattern_index(own, other) as u8
                };
                to.complex.tets.push(piece);
                to.complex.patterns.push(pattern);
                self.regions.push(if side < 0 && regions[n] == 0 {
                    structure
                } else {
                    regions[n]
                });
            }
        }
        self.counts.middles += to.middles;
        let chords = to.chords;
        self.untangle(&chords, old_nodes);
    }

    /// Puts cut nodes back on their chord where their place on the surface inverts a tet.
    fn untangle(&mut self, chords: &[(u32, [f64; 3])], old_nodes: usize) {
        if chords.is_empty() {
            return;
        }
        let mut chord: FxHashMap<u32, [f64; 3]> = chords.iter().copied().collect();
        loop {
            let mut changed = false;
            for t in 0..self.complex.tets.len() {
                let tet = self.complex.tets[t];
                if tet.iter().all(|&v| (v as usize) < old_nodes) || volume6(self.complex.corners(tet)) > 0.0 {
                    continue;
                }
                for v in tet {
                    if let Some(p) = chord.remove(&v) {
                        self.complex.points[v as usize] = p;
                        self.counts.on_chord += 1;
                        changed = true;
                    }
                }
            }
            if !changed {
                return;
            }
        }
    }
}

struct Pieces<'a> {
    complex: &'a mut Complex,
    background: &'a Background,
    surfaces: &'a SurfaceSet<'a>,
    bit: u64,
    roots: &'a [((u32, u32), f64)],
    on_edge: &'a FxHashMap<(u32, u32), u64>,
    cuts: FxHashMap<(u32, u32), u32>,
    /// Cut nodes that left their chord, with the place on it.
    chords: Vec<(u32, [f64; 3])>,
    pieces: Vec<(i8, usize, usize, [u32; 4])>,
    middles: usize,
}

impl Cutter for Pieces<'_> {
    fn cut(&mut self, a: u32, b: u32) -> u32 {
        let k = key(a, b);
        if let Some(&n) = self.cuts.get(&k) {
            return n;
        }
        let t = match self.roots.binary_search_by_key(&k, |r| r.0) {
            Ok(i) => self.roots[i].1,
            Err(_) => 0.5,
        };
        let (pa, pb) = (
            self.complex.points[k.0 as usize],
            self.complex.points[k.1 as usize],
        );
        let chord = lerp(pa, pb, t);
        let n = self.complex.points.len() as u32;
        let mut p = chord;
        let set = self.on_edge.get(&k).copied().unwrap_or(0);
        if set != 0 {
            let reach = 0.3 * crate::geometry::distance(pa, pb);
            if let Some(q) = self.surfaces.project(chord, set | self.bit, reach) {
                p = q;
                self.chords.push((n, chord));
            }
        }
        self.complex.points.push(p);
        self.complex.sources.push(Source::Other);
        self.cuts.insert(k, n);
        n
    }

    fn diagonal_at_first(&self, a: u32, b: u32, e: u32) -> bool {
        let id = |v: u32| match self.complex.sources[v as usize] {
            Source::Lattice(id) => Some(id),
            _ => None,
        };
        match (id(a), id(b), id(e)) {
            (Some(a), Some(b), Some(e)) => self.background.diagonal_at_first(a, b, e),
            _ => a < b,
        }
    }

    fn middle(&mut self, corners: [u32; 6]) -> u32 {
        let p = std::array::from_fn(|a| {
            corners
                .iter()
                .map(|&n| self.complex.points[n as usize][a])
                .sum::<f64>()
                / 6.0
        });
        self.complex.points.push(p);
        self.complex.sources.push(Source::Other);
        self.middles += 1;
        self.complex.points.len() as u32 - 1
    }

    fn wants(&self, _: i8) -> bool {
        true
    }

    fn emit(&mut self, side: i8, own: usize, other: usize, tet: [u32; 4]) {
        self.pieces.push((side, own, other, tet));
    }
}

/// Gives face-connected pieces of a region that are smaller than `least_mm3`, the region's largest excepted, to the
/// region with which they share most area.
fn merge_specks(complex: &Complex, regions: &mut [u16], least_mm3: f64, counts: &mut CutCounts) {
    let n = complex.tets.len();
    let table = FaceTable::new(&complex.tets, complex.points.len(), |_| true);
    let mut parts = Components::new(n);
    for g in table.groups() {
        if let [a, b] = g
            && regions[a.tet as usize] == regions[b.tet as usize]
        {
            parts.join(a.tet, b.tet);
        }
    }
    let root: Vec<u32> = (0..n as u32).map(|t| parts.root(t)).collect();
    let mut volume = vec![0.0; n];
    for t in 0..n {
        volume[root[t] as usize] += volume6(complex.corners(complex.tets[t])) / 6.0;
    }
    let mut largest: Vec<Option<u32>> = Vec::new();
    for t in 0..n {
        let r = usize::from(regions[t]);
        largest.resize(largest.len().max(r + 1), None);
        if root[t] as usize == t && largest[r].is_none_or(|l| volume[t] > volume[l as usize]) {
            largest[r] = Some(t as u32);
        }
    }
    let speck =
        |t: usize| volume[root[t] as usize] < least_mm3 && largest[usize::from(regions[t])] != Some(root[t]);
    // Area towards each region, per piece.
    let mut area: Vec<(u32, u16, f64)> = Vec::new();
    for g in table.groups() {
        if let [a, b] = g {
            let (ra, rb) = (regions[a.tet as usize], regions[b.tet as usize]);
            if ra != rb {
                let [p, q, r] = a.key.map(|v| complex.points[v as usize]);
                let s = crate::geometry::length(crate::geometry::cross(
                    crate::geometry::sub(q, p),
                    crate::geometry::sub(r, p),
                ));
                for (own, other) in [(a, rb), (b, ra)] {
                    if speck(own.tet as usize) {
                        area.push((root[own.tet as usize], other, s));
                    }
                }
            }
        }
    }
    area.sort_by_key(|a| (a.0, a.1));
    let mut target: FxHashMap<u32, (f64, u16)> = FxHashMap::default();
    for g in area.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        let s: f64 = g.iter().map(|a| a.2).sum();
        let best = target.entry(g[0].0).or_insert((s, g[0].1));
        if s > best.0 {
            *best = (s, g[0].1);
        }
    }
    counts.merged_pieces += target.len();
    counts.merged_mm3 += target
        .keys()
        .collect::<std::collections::BTreeSet<_>>()
        .iter()
        .map(|r| volume[**r as usize])
        .sum::<f64>();
    for t in 0..n {
        if let Some(&(_, r)) = target.get(&root[t]) {
            regions[t] = r;
        }
    }
}
