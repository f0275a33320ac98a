//! Blocks of tets, and what must hold of them while a needle is inside.

use glam::DVec3;
use palpate_fem::{Material, NodeState, Settings, Simulation, TissueMesh};
use palpate_fixtures::tets::tet_block;
use palpate_needle::{Track, locate};
use std::collections::BTreeMap;

/// A cube of `n` cells a side, each cut into six tets around its diagonal; corner at the origin, `size` mm a side. Regions by the
/// centroid of each tet.
pub fn block(size: f64, n: usize, region: &dyn Fn(DVec3) -> u16) -> Simulation {
    let block = tet_block([0.0; 3], [size; 3], [n; 3]);
    let regions: Vec<u16> = (0..block.tets.len())
        .map(|t| region(DVec3::from_array(block.middle(t))))
        .collect();
    let most = regions.iter().copied().max().unwrap_or(0);
    let mesh = TissueMesh::new(&block.points, &block.tets, &regions).unwrap();
    Simulation::new(
        mesh,
        vec![Material::default(); most as usize + 1],
        Settings::default(),
    )
    .unwrap()
}

/// Mean edge length, mm.
pub fn edge_mm(sim: &Simulation) -> f64 {
    let rest = sim.mesh().rest();
    let (mut sum, mut count) = (0.0, 0.0);
    for (_, t) in sim.mesh().tets() {
        for i in 1..4 {
            for j in 0..i {
                sum += rest[t.corners[i] as usize].distance(rest[t.corners[j] as usize]);
                count += 1.0;
            }
        }
    }
    sum / count
}

/// State of the tissue at a world point.
pub fn state_at(sim: &Simulation, point: DVec3) -> NodeState {
    let (slot, w) = locate(sim, point, 0).unwrap_or_else(|| panic!("{point} is outside"));
    let mut state = NodeState::default();
    for (n, w) in sim.mesh().tet(slot).unwrap().corners.into_iter().zip(w) {
        let n = n as usize;
        state.rest += sim.mesh().rest()[n] * w;
        state.velocity += sim.velocities()[n] * w;
        state.acceleration += sim.accelerations()[n] * w;
    }
    state.position = point;
    state
}

/// What a mesh was like at the start.
pub struct Watch {
    tets: Vec<([u32; 4], u16)>,
    rest: Vec<DVec3>,
    volumes: BTreeMap<u16, f64>,
    /// Boundary and interface area by pair of regions.
    areas: BTreeMap<(u16, u16), f64>,
}

fn connectivity(sim: &Simulation) -> Option<Vec<([u32; 4], u16)>> {
    let mesh = sim.mesh();
    let mut tets = Vec::new();
    for (_, t) in mesh.tets() {
        let mut corners = [0; 4];
        for (c, n) in corners.iter_mut().zip(t.corners) {
            *c = mesh.input_node(n)?;
        }
        tets.push((corners, t.region));
    }
    tets.sort_unstable();
    Some(tets)
}

fn originals(sim: &Simulation) -> Vec<DVec3> {
    let slots = sim.mesh().slots_of_input();
    slots.into_iter().map(|s| sim.mesh().rest()[s as usize]).collect()
}

/// Volume by region, mm³; all tets upright.
fn volumes(sim: &Simulation) -> BTreeMap<u16, f64> {
    let rest = sim.mesh().rest();
    let mut volumes = BTreeMap::new();
    for (_, t) in sim.mesh().tets() {
        let [a, b, c, d] = t.corners.map(|n| rest[n as usize]);
        let volume = (b - a).dot((c - a).cross(d - a)) / 6.0;
        assert!(volume > 0.0, "{t:?} has volume {volume}");
        *volumes.entry(t.region).or_insert(0.0) += volume;
    }
    volumes
}

/// Area where each pair of regions meets (equal numbers: the outside); any face with more than two tets fails.
fn areas(sim: &Simulation) -> BTreeMap<(u16, u16), f64> {
    let mut faces: BTreeMap<[u32; 3], Vec<u16>> = BTreeMap::new();
    for (_, t) in sim.mesh().tets() {
        let [a, b, c, d] = t.corners;
        for mut f in [[b, c, d], [a, c, d], [a, b, d], [a, b, c]] {
            f.sort_unstable();
            faces.entry(f).or_default().push(t.region);
        }
    }
    let rest = sim.mesh().rest();
    let mut areas = BTreeMap::new();
    for (f, mut regions) in faces {
        assert!(regions.len() <= 2, "face {f:?} in {} tets", regions.len());
        regions.sort_unstable();
        let pair = (regions[0], regions[regions.len() - 1]);
        if regions.len() == 1 || pair.0 != pair.1 {
            let [a, b, c] = f.map(|n| rest[n as usize]);
            *areas.entry(pair).or_insert(0.0) += 0.5 * (b - a).cross(c - a).length();
        }
    }
    areas
}

impl Watch {
    pub fn new(sim: &Simulation) -> Self {
        Self {
            tets: connectivity(sim).unwrap(),
            rest: originals(sim),
            volumes: volumes(sim),
            areas: areas(sim),
        }
    }

    /// As [`Watch::check_loosely`], and the volume of each region and the area of each interface are what they were.
    pub fn check(&self, sim: &Simulation, track: &Track) {
        self.check_loosely(sim, track, 0.0);
        let found = areas(sim);
        assert_eq!(found.len(), self.areas.len());
        for (pair, a) in found {
            assert!(
                (a - self.areas[&pair]).abs() < 1e-11 * a,
                "{pair:?}: {a} not {}",
                self.areas[&pair]
            );
        }
    }

    /// All tets upright, the chain joined by edges, total volume and outer surface as they were, each region's volume up to a share.
    pub fn check_loosely(&self, sim: &Simulation, track: &Track, share: f64) {
        let found = volumes(sim);
        let total = |v: &BTreeMap<u16, f64>| v.values().sum::<f64>();
        let (now, before) = (total(&found), total(&self.volumes));
        assert!((now - before).abs() < 1e-12 * before, "{now} not {before}");
        for (region, v) in found {
            let before = self.volumes[&region];
            assert!(
                (v - before).abs() <= (share + 1e-12) * before,
                "region {region}: {v} not {before}"
            );
        }
        let outside = |a: &BTreeMap<(u16, u16), f64>| -> f64 {
            a.iter().filter(|(p, _)| p.0 == p.1).map(|(_, a)| a).sum()
        };
        let (now, before) = (outside(&areas(sim)), outside(&self.areas));
        assert!((now - before).abs() < 1e-11 * before, "{now} not {before}");
        let mesh = sim.mesh();
        for w in track.nodes().windows(2) {
            let joined = mesh
                .around(w[0])
                .iter()
                .any(|e| mesh.tet(e.tet).unwrap().corners.contains(&w[1]));
            assert!(joined, "{w:?} are not joined");
        }
        let mut nodes = track.nodes().to_vec();
        nodes.sort_unstable();
        nodes.dedup();
        assert_eq!(nodes.len(), track.nodes().len());
    }

    /// Everything as it was, to the bit.
    pub fn check_restored(&self, sim: &Simulation) {
        assert!(connectivity(sim).unwrap() == self.tets, "connectivity differs");
        assert!(originals(sim) == self.rest, "places differ");
    }
}
