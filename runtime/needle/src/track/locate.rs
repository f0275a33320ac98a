//! Where a point lies in the mesh: barycentric coordinates, walks from tet to tet, the faces that a segment crosses.

use glam::{DMat3, DVec3};
use palpate_fem::{NodeState, Simulation, Tet, TissueMesh};

/// A point this far outside a tet, in barycentric coordinates, still counts as inside.
const SLACK: f64 = 1e-10;
/// Steps of a walk before all tets are searched.
const MOST_STEPS: usize = 200;

/// Corner order of the face opposite each corner.
const OPPOSITE: [[usize; 3]; 4] = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]];

/// Barycentric coordinates of a point; not finite for a flat tet.
pub(super) fn barycentric(x: [DVec3; 4], p: DVec3) -> [f64; 4] {
    let w = DMat3::from_cols(x[1] - x[0], x[2] - x[0], x[3] - x[0]).inverse() * (p - x[0]);
    [1.0 - w.x - w.y - w.z, w.x, w.y, w.z]
}

fn least(w: [f64; 4]) -> f64 {
    let least = w.into_iter().fold(f64::INFINITY, f64::min);
    if w.iter().all(|x| x.is_finite()) {
        least
    } else {
        f64::NEG_INFINITY
    }
}

/// Whether barycentric coordinates are those of a point inside or on the tet.
pub(super) fn inside(w: [f64; 4]) -> bool {
    least(w) >= -SLACK
}

fn corners(tet: Tet, at: &[DVec3]) -> [DVec3; 4] {
    tet.corners.map(|c| at[c as usize])
}

/// Tet on the other side of the face opposite a corner.
fn across(mesh: &TissueMesh, slot: u32, tet: Tet, corner: usize) -> Option<u32> {
    let [a, b, c] = OPPOSITE[corner].map(|k| tet.corners[k]);
    mesh.around(a).iter().map(|e| e.tet).find(|&t| {
        t != slot
            && mesh
                .tet(t)
                .is_some_and(|t| t.corners.contains(&b) && t.corners.contains(&c))
    })
}

/// Tet of the deformed mesh that holds a world point (mm), with the point's barycentric coordinates in it; `None` outside the tissue.
///
/// Walks from the tet `hint` (any number will do) by the signs of the coordinates and searches all tets where the walk fails, which
/// costs a pass over the mesh for a point outside.
pub fn locate(sim: &Simulation, point: DVec3, hint: u32) -> Option<(u32, [f64; 4])> {
    locate_in(sim.mesh(), sim.positions(), point, hint)
}

/// As [`locate`], with any positions of the nodes.
pub(super) fn locate_in(mesh: &TissueMesh, at: &[DVec3], point: DVec3, hint: u32) -> Option<(u32, [f64; 4])> {
    if let Some(found) = walk(mesh, at, point, hint) {
        return Some(found);
    }
    let mut best: Option<(f64, u32, [f64; 4])> = None;
    for (slot, tet) in mesh.tets() {
        let x = corners(tet, at);
        let (low, high) = (
            x[0].min(x[1]).min(x[2].min(x[3])),
            x[0].max(x[1]).max(x[2].max(x[3])),
        );
        let slack = SLACK * (high - low).max_element();
        if point.cmplt(low - slack).any() || point.cmpgt(high + slack).any() {
            continue;
        }
        let w = barycentric(x, point);
        if inside(w) && best.is_none_or(|b| least(w) > b.0) {
            best = Some((least(w), slot, w));
        }
    }
    best.map(|(_, slot, w)| (slot, w))
}

/// As [`locate_in`], but by the walk alone: cheap for a point outside, which it may also say of one behind a hollow of the boundary.
pub(crate) fn walk(mesh: &TissueMesh, at: &[DVec3], point: DVec3, hint: u32) -> Option<(u32, [f64; 4])> {
    let mut slot = hint;
    for _ in 0..MOST_STEPS {
        let tet = mesh.tet(slot)?;
        let w = barycentric(corners(tet, at), point);
        if inside(w) {
            return Some((slot, w));
        }
        let mut order = [0, 1, 2, 3];
        order.sort_by(|&i, &j| w[i].total_cmp(&w[j]));
        slot = order
            .into_iter()
            .filter(|&i| w[i] < 0.0)
            .find_map(|i| across(mesh, slot, tet, i))?;
    }
    None
}

/// State of the tissue at weights of four nodes, `rest` aside.
pub(super) fn blend<const N: usize>(sim: &Simulation, nodes: [u32; N], weights: [f64; N]) -> NodeState {
    let mut state = NodeState::default();
    for (n, w) in nodes.into_iter().zip(weights) {
        let n = n as usize;
        state.rest += sim.mesh().rest()[n] * w;
        state.position += sim.positions()[n] * w;
        state.velocity += sim.velocities()[n] * w;
        state.acceleration += sim.accelerations()[n] * w;
    }
    state
}

/// State of the tissue at a material point, by linear interpolation; near `node` the mesh is continued past its boundary.
pub(super) fn state_at(sim: &Simulation, rest: DVec3, node: u32) -> Option<NodeState> {
    let mesh = sim.mesh();
    let mut best: Option<(f64, Tet, [f64; 4])> = None;
    for e in mesh.around(node) {
        if let Some(tet) = mesh.tet(e.tet) {
            let w = barycentric(corners(tet, mesh.rest()), rest);
            if best.is_none_or(|b| least(w) > b.0) {
                best = Some((least(w), tet, w));
            }
        }
    }
    let (depth, mut tet, mut w) = best?;
    if depth < -SLACK
        && let Some((slot, inner)) = locate_in(mesh, mesh.rest(), rest, mesh.around(node)[0].tet)
        && let Some(found) = mesh.tet(slot)
    {
        (tet, w) = (found, inner);
    }
    Some(NodeState {
        rest,
        ..blend(sim, tet.corners, w)
    })
}

/// A face that a segment crosses.
#[derive(Clone, Copy, Debug)]
pub(super) struct Crossing {
    pub face: [u32; 3],
    /// Barycentric coordinates on the face; none negative, sum 1.
    pub weights: [f64; 3],
    /// Whether tets of two regions meet there.
    pub interface: bool,
}

/// Faces that the segment from a node to a material point crosses, in order; ends early where it leaves the mesh.
pub(super) fn trace(mesh: &TissueMesh, from: u32, to: DVec3) -> Vec<Crossing> {
    let rest = mesh.rest();
    let start = rest[from as usize];
    let mut found = Vec::new();
    // The tet that the segment starts into: its coordinates of the other three corners grow.
    let mut first: Option<(f64, u32)> = None;
    for e in mesh.around(from) {
        if let Some(tet) = mesh.tet(e.tet) {
            let mut w = barycentric(corners(tet, rest), to);
            w[e.corner as usize] = f64::INFINITY;
            let depth = w.into_iter().fold(f64::INFINITY, f64::min);
            if first.is_none_or(|f| depth > f.0) {
                first = Some((depth, e.tet));
            }
        }
    }
    let Some((_, mut slot)) = first else { return found };
    let mut reached = 0.0;
    for _ in 0..MOST_STEPS {
        let Some(tet) = mesh.tet(slot) else { break };
        let x = corners(tet, rest);
        let (a, b) = (barycentric(x, start), barycentric(x, to));
        if inside(b) {
            break;
        }
        let mut exit: Option<(f64, usize)> = None;
        for i in 0..4 {
            if b[i] < -SLACK && b[i] < a[i] {
                let s = a[i] / (a[i] - b[i]);
                if s > reached - 1e-9 && exit.is_none_or(|e| s < e.0) {
                    exit = Some((s, i));
                }
            }
        }
        let Some((s, i)) = exit else { break };
        reached = s;
        let Some(next) = across(mesh, slot, tet, i) else {
            break;
        };
        let mut weights = OPPOSITE[i].map(|k| (a[k] + s * (b[k] - a[k])).max(0.0));
        let sum: f64 = weights.iter().sum();
        weights = weights.map(|w| w / sum);
        found.push(Crossing {
            face: OPPOSITE[i].map(|k| tet.corners[k]),
            weights,
            interface: mesh.tet(next).is_some_and(|t| t.region != tet.region),
        });
        slot = next;
    }
    found
}
