//! Contact between nodes. A solid's rim that runs across a boundary triangle, or a small solid within one, touches no node: points on the
//! triangles, no farther apart than `contact_spacing_mm`, meet solids as well. Nodes are constraints, and a point hangs on three of them,
//! which no projection of directions can hold: it gets an augmented Lagrangian, a damped spring that starts each step from the force of the
//! step before, so that it need not be stiff and its depth goes to zero where the solid rests. A point whose nodes are held already has none.

use crate::Simulation;
use crate::contact::Shape;
use crate::simulation::{Spring, SpringState};
use glam::{DMat3, DVec3};
use rayon::prelude::*;

/// A spring is let go where it would pull harder than this, µN.
const PULL_UN: f64 = 1e-3;
/// A point deeper than this after a solve becomes a contact, mm.
const DEEP_MM: f64 = 0.02;
/// Triangles nearer to a solid than this are looked at in a step, beside what moves in it, mm.
const NEAR_MM: f64 = 1.0;
/// Stiffness of a spring over that of the free nodes that it moves.
const STIFFNESS: f64 = 1.0;
/// A point whose nodes are free along the normal by less than this share follows them.
const LEAST_FREE: f64 = 0.1;
/// A point this near to a solid counts for the area that touches, mm.
const TOUCH_MM: f64 = 0.1;
/// Most parts that an edge is divided into.
const MOST_PARTS: f64 = 12.0;

/// A point of a boundary triangle: its nodes and their weights, which sum to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Point {
    pub nodes: [u32; 3],
    pub weights: [f64; 3],
}

impl Point {
    /// Sum over the nodes.
    pub fn of(&self, x: &[DVec3]) -> DVec3 {
        (0..3).map(|k| x[self.nodes[k] as usize] * self.weights[k]).sum()
    }
}

/// Points of all boundary triangles, beside their corners.
#[derive(Clone, Debug, Default)]
pub(crate) struct Points {
    pub list: Vec<Point>,
    /// By triangle: its corners and where its points end in the list; those of an edge belong to the first triangle with it.
    pub triangles: Vec<([u32; 3], u32)>,
    /// By node: the sum of the weights of all its points.
    pub weight: Vec<f64>,
}

impl Points {
    /// Points of triangles with corners at `rest` (mm).
    pub fn new(faces: &[[u32; 3]], rest: &[DVec3], spacing_mm: f64) -> Self {
        let mut out = Self {
            weight: vec![0.0; rest.len()],
            ..Self::default()
        };
        let parts = |a: u32, b: u32| {
            let length = (rest[a as usize] - rest[b as usize]).length();
            (length / spacing_mm).ceil().clamp(1.0, MOST_PARTS) as u32
        };
        let mut edges = std::collections::HashSet::new();
        for &[a, b, c] in faces {
            for (a, b, c) in [(a, b, c), (b, c, a), (c, a, b)] {
                if edges.insert((a.min(b), a.max(b))) {
                    let n = parts(a, b);
                    for i in 1..n {
                        let w = f64::from(i) / f64::from(n);
                        out.list.push(Point {
                            nodes: [a, b, c],
                            weights: [1.0 - w, w, 0.0],
                        });
                    }
                }
            }
            let n = parts(a, b).max(parts(b, c)).max(parts(c, a));
            for i in 1..n {
                for j in 1..n - i {
                    let w = [i, j, n - i - j].map(|k| f64::from(k) / f64::from(n));
                    out.list.push(Point {
                        nodes: [a, b, c],
                        weights: w,
                    });
                }
            }
            out.triangles.push(([a, b, c], out.list.len() as u32));
        }
        for p in &out.list {
            for k in 0..3 {
                out.weight[p.nodes[k] as usize] += p.weights[k];
            }
        }
        out
    }
}

fn square(n: DVec3) -> DMat3 {
    DMat3::from_cols(n * n.x, n * n.y, n * n.z)
}

impl Simulation {
    /// Whether points of triangles are looked at: planes are met by nodes first, whatever the triangle.
    fn wants_points(&self) -> bool {
        self.settings.contact_spacing_mm > 0.0 && self.solids.iter().any(|s| s.shape != Shape::Plane)
    }

    fn update_points(&mut self) {
        if self.points.is_none() {
            let faces = self.mesh.boundary();
            self.points = Some(Points::new(
                &faces,
                self.mesh.rest(),
                self.settings.contact_spacing_mm,
            ));
            // Numbers of points are others now.
            self.springs.active.clear();
            self.springs.made += 1;
        }
    }

    pub(super) fn point(&self, s: &Spring) -> Point {
        match &self.points {
            Some(p) => p.list[s.point as usize],
            None => Point {
                nodes: [0; 3],
                weights: [0.0; 3],
            },
        }
    }

    /// How free a node is along a normal, 0 to 1.
    fn freedom(&self, node: u32, normal: DVec3) -> f64 {
        let held = self.holds[node as usize].map_or(1.0, |h| normal.dot(h.free * normal));
        match self.contacts.binary_search_by_key(&node, |c| c.node) {
            Ok(at) => {
                let c = &self.contacts[at];
                let touch = self.solids[c.solid as usize].touch(self.x[node as usize], Some(c.face));
                held * (1.0 - touch.normal.dot(normal).powi(2))
            }
            Err(_) => held,
        }
    }

    fn is_free(&self, p: &Point, normal: DVec3) -> bool {
        let free: f64 = (0..3)
            .map(|k| p.weights[k] * self.freedom(p.nodes[k], normal))
            .sum();
        free > LEAST_FREE
    }

    /// Points that a solid may reach in this step, and of them those that it would hold at its end. Springs of the step before are no
    /// longer in the matrix: their rows have been summed anew.
    pub(super) fn find_springs(&mut self) {
        self.springs.applied.clear();
        self.springs.near.clear();
        self.springs.touching.clear();
        if !self.wants_points() {
            self.springs.active.clear();
            return;
        }
        self.update_points();
        let Some(points) = &self.points else { return };
        let dt = self.dt;
        let way = self
            .solids
            .iter()
            .map(|s| (s.place.centre_mm - s.before.centre_mm).length())
            .fold(0.0, f64::max);
        let of = |k: usize| {
            let (corners, end) = points.triangles[k];
            let x = corners.map(|n| self.x[n as usize]);
            let middle = (x[0] + x[1] + x[2]) / 3.0;
            let size = x.iter().map(|p| (*p - middle).length()).fold(0.0, f64::max);
            let moved = corners
                .iter()
                .map(|&n| self.v[n as usize].length() * dt)
                .fold(0.0, f64::max);
            let reach = NEAR_MM + size + moved + way;
            let close = self
                .solids
                .iter()
                .any(|s| s.shape != Shape::Plane && s.touch(middle, None).depth > -reach);
            let start = if k == 0 { 0 } else { points.triangles[k - 1].1 };
            (if close { start..end } else { start..start }).map(|p| {
                let at = &points.list[p as usize];
                let x = at.of(&self.x);
                (p, self.spring(p, x, x + at.of(&self.v) * dt, 0.0))
            })
        };
        let found: Vec<(u32, Option<Spring>)> = (0..points.triangles.len())
            .into_par_iter()
            .flat_map_iter(of)
            .collect();
        let kept = std::mem::take(&mut self.springs.active);
        self.springs.active = found
            .iter()
            .filter_map(|&(p, new)| match kept.binary_search_by_key(&p, |s| s.point) {
                Ok(at) => Some(kept[at]),
                Err(_) => new,
            })
            .collect();
        self.springs.near = found.into_iter().map(|f| f.0).collect();
    }

    /// The deepest solid at `to` for a point that was at `from`, entered by the face that it lay farthest before; none where the point's
    /// nodes are held along its normal.
    fn spring(&self, point: u32, from: DVec3, to: DVec3, least: f64) -> Option<Spring> {
        let mut best: Option<(f64, DVec3, Spring)> = None;
        for (k, solid) in self.solids.iter().enumerate() {
            let touch = solid.touch(to, Some(solid.entered_by(from)));
            if touch.depth > least && best.is_none_or(|(d, ..)| touch.depth > d) {
                let spring = Spring {
                    point,
                    solid: k as u32,
                    face: touch.face,
                    push_un: 0.0,
                };
                best = Some((touch.depth, touch.normal, spring));
            }
        }
        best.filter(|(_, normal, s)| self.is_free(&self.point(s), *normal))
            .map(|b| b.2)
    }

    /// Puts this step's springs into matrix and right-hand side, in place of those of the pass before.
    pub(super) fn apply_springs(&mut self) {
        let old = std::mem::take(&mut self.springs.applied);
        for s in &old {
            self.stiffen(s, -1.0);
            self.push(s, -1.0);
        }
        let [beta, gamma] = self.newmark;
        let (dt, most) = (self.dt, self.settings.contact_push_mm);
        let mut applied = Vec::with_capacity(self.springs.active.len());
        for s in &self.springs.active {
            let p = self.point(s);
            let solid = &self.solids[s.solid as usize];
            let (x, v, a) = (p.of(&self.x), p.of(&self.v), p.of(&self.a));
            let normal = solid.touch(x, Some(s.face)).normal;
            // How far a unit force on the point moves it where each node moves by itself; what is held does not.
            let (mut compliance, mut free) = (0.0, 0.0);
            for k in 0..3 {
                let node = p.nodes[k];
                let share = p.weights[k] * self.freedom(node, normal);
                let stiffness = normal.dot(self.matrix.rows[node as usize].blocks[0] * normal);
                compliance += share * p.weights[k] / stiffness;
                free += share;
            }
            if free <= LEAST_FREE {
                continue;
            }
            let stiffness = STIFFNESS / (compliance * beta * dt * dt);
            let damping = stiffness * dt;
            let ahead = x + v * dt + a * (dt * dt * (0.5 - beta));
            let depth = solid.depth_by(ahead, s.face).min(most);
            let closing = -normal.dot(v + a * (dt * (1.0 - gamma)) - solid.velocity(x, dt));
            applied.push(SpringState {
                spring: *s,
                normal,
                coefficient: stiffness * beta * dt * dt + damping * gamma * dt,
                push: s.push_un + stiffness * depth + damping * closing,
            });
        }
        for s in &applied {
            self.stiffen(s, 1.0);
            self.push(s, 1.0);
        }
        self.springs.applied = applied;
    }

    /// A spring's part of the matrix, added or taken away.
    fn stiffen(&mut self, s: &SpringState, sign: f64) {
        let p = self.point(&s.spring);
        let n = s.normal;
        let across = square(n) * (sign * s.coefficient);
        for i in (0..3).filter(|&i| p.weights[i] != 0.0) {
            let node = p.nodes[i] as usize;
            let row = &mut self.matrix.rows[node];
            for j in (0..3).filter(|&j| p.weights[j] != 0.0) {
                if let Some(at) = row.columns.iter().position(|&c| c == p.nodes[j]) {
                    row.blocks[at] += across * (p.weights[i] * p.weights[j]);
                }
            }
            self.elements.soil(node);
        }
    }

    /// A spring's part of the right-hand side, added or taken away.
    fn push(&mut self, s: &SpringState, sign: f64) {
        let p = self.point(&s.spring);
        for k in 0..3 {
            self.rhs[p.nodes[k] as usize] += s.normal * (sign * s.push * p.weights[k]);
        }
    }

    /// Newton iterations renew the matrix: the springs' part of it again, without the right-hand side.
    pub(super) fn stiffen_by_springs(&mut self) {
        let applied = std::mem::take(&mut self.springs.applied);
        for s in &applied {
            self.stiffen(s, 1.0);
        }
        self.springs.applied = applied;
    }

    /// Forces of springs on the nodes with accelerations `a` at the end of the step.
    pub(super) fn spring_forces(&self, a: &[DVec3], forces: &mut [DVec3]) {
        for s in &self.springs.applied {
            let p = self.point(&s.spring);
            let push = s.push - s.coefficient * s.normal.dot(p.of(a));
            for k in 0..3 {
                forces[p.nodes[k] as usize] += s.normal * (push * p.weights[k]);
            }
        }
    }

    /// Lets go springs that pull and adds points that the solution drives into a solid; whether anything changed.
    pub(super) fn correct_springs(&mut self, a: &[DVec3]) -> bool {
        if self.springs.near.is_empty() {
            return false;
        }
        let Some(points) = &self.points else {
            return false;
        };
        let (dt, beta) = (self.dt, self.newmark[0]);
        let after = |p: &Point| {
            p.of(&self.x) + p.of(&self.v) * dt + (p.of(&self.a) * (0.5 - beta) + p.of(a) * beta) * (dt * dt)
        };
        let mut changed = false;
        let mut kept = Vec::with_capacity(self.springs.applied.len());
        let mut let_go = Vec::new();
        for s in &self.springs.applied {
            let p = self.point(&s.spring);
            let push = s.push - s.coefficient * s.normal.dot(p.of(a));
            let solid = &self.solids[s.spring.solid as usize];
            let beside = solid.touch(after(&p), Some(s.spring.face)).face != s.spring.face;
            if push < -PULL_UN || beside {
                let_go.push(s.spring.point);
                changed = true;
            } else {
                kept.push((s.spring, push.max(0.0)));
            }
        }
        let known = |k: u32| self.springs.active.binary_search_by_key(&k, |s| s.point).is_ok();
        let new: Vec<Spring> = self
            .springs
            .near
            .par_iter()
            .filter(|&&k| !known(k) && let_go.binary_search(&k).is_err())
            .filter_map(|&k| {
                let p = &points.list[k as usize];
                self.spring(k, p.of(&self.x), after(p), DEEP_MM)
            })
            .collect();
        changed |= !new.is_empty();
        // A pass that is made again starts from the forces of the step before, the last one leaves its own.
        self.springs.pushes = kept.iter().map(|k| (k.0.point, k.1)).collect();
        let mut active: Vec<Spring> = kept.into_iter().map(|k| k.0).chain(new).collect();
        active.sort_unstable_by_key(|s| s.point);
        self.springs.active = active;
        changed
    }

    /// After the step: what springs did to nodes and solids, and the deepest point.
    pub(super) fn settle_springs(&mut self) {
        self.springs.applied.clear();
        let pushes = std::mem::take(&mut self.springs.pushes);
        for k in 0..self.springs.active.len() {
            let s = &mut self.springs.active[k];
            s.push_un = pushes
                .binary_search_by_key(&s.point, |p| p.0)
                .map_or(0.0, |at| pushes[at].1);
            let s = *s;
            let p = self.point(&s);
            let solid = &mut self.solids[s.solid as usize];
            let force = solid.touch(p.of(&self.x), Some(s.face)).normal * s.push_un;
            solid.force_un += force;
            for i in 0..3 {
                self.reactions[p.nodes[i] as usize] += force * p.weights[i];
            }
        }
        self.springs.touching.clear();
        let Some(points) = &self.points else { return };
        for &k in &self.springs.near {
            let x = points.list[k as usize].of(&self.x);
            for (n, s) in self.solids.iter_mut().enumerate() {
                if s.shape == Shape::Plane {
                    continue;
                }
                let depth = s.touch(x, None).depth;
                s.depth_mm = s.depth_mm.max(depth);
                if depth > -TOUCH_MM {
                    self.springs.touching.push((k, n as u32));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contact::{Place, Solid};
    use crate::{Material, Settings, TissueMesh};
    use palpate_fixtures::tets::tet_block;

    #[test]
    fn points_lie_on_every_edge_and_triangle_once() {
        let rest = [
            DVec3::ZERO,
            DVec3::X * 4.0,
            DVec3::Y * 4.0,
            DVec3::new(4.0, 4.0, 0.0),
        ];
        let points = Points::new(&[[0, 1, 2], [1, 3, 2]], &rest, 1.0);
        let mut places: Vec<[i64; 3]> = points
            .list
            .iter()
            .map(|p| (p.of(&rest) * 1e6).to_array().map(|v| v.round() as i64))
            .collect();
        assert!(
            points
                .list
                .iter()
                .all(|p| (p.weights.iter().sum::<f64>() - 1.0).abs() < 1e-12)
        );
        let all = places.len();
        places.sort_unstable();
        places.dedup();
        assert_eq!(places.len(), all);
        // Four edges of 4 mm and one of 5.7 in 4 and 6 parts; both triangles in 6.
        assert_eq!(all, 4 * 3 + 5 + 2 * 10);
        assert_eq!(points.triangles.len(), 2);
        // Coarser than the triangles: nodes alone.
        assert!(Points::new(&[[0, 1, 2]], &rest, 9.0).list.is_empty());
    }

    /// What springs add to matrix and right-hand side is the derivative and the value of their forces, by differences.
    #[test]
    fn the_matrix_has_the_slope_of_the_springs() {
        let block = tet_block([0.0; 3], [20.0; 3], [2; 3]);
        let mesh = TissueMesh::new(&block.points, &block.tets, &vec![0; block.tets.len()]).unwrap();
        let settings = Settings {
            gravity_mm_s2: [0.0; 3],
            ..Settings::default()
        };
        let mut s = Simulation::new(mesh, vec![Material::default()], settings).unwrap();
        let at = |depth: f64| Place::at(DVec3::new(13.0, 22.0 - depth, 6.0));
        let ball = Solid::new("ball", Shape::Sphere { radius_mm: 2.0 }, at(0.3), 0.0).unwrap();
        s.add_solid(ball);
        s.step().unwrap();
        s.move_solid(0, at(0.5)).unwrap();
        s.begin_step();
        let (matrix, rhs) = (s.matrix.clone(), s.rhs.clone());
        let n = s.x.len();
        let random = |seed: usize| -> Vec<DVec3> {
            let of = |i: usize| ((i * 7919 + seed * 104_729) % 1000) as f64 / 500.0 - 1.0;
            (0..n)
                .map(|i| DVec3::new(of(3 * i), of(3 * i + 1), of(3 * i + 2)) * 100.0)
                .collect()
        };
        let mut a = random(1);
        s.constrain_step(&mut a);
        assert!(!s.springs.applied.is_empty());
        let forces = |a: &[DVec3]| {
            let mut f = vec![DVec3::ZERO; n];
            s.spring_forces(a, &mut f);
            f
        };
        let d = random(2);
        let moved = |sign: f64| -> Vec<DVec3> { a.iter().zip(&d).map(|(a, d)| *a + *d * sign).collect() };
        let (ahead, behind, still) = (
            forces(&moved(0.5)),
            forces(&moved(-0.5)),
            forces(&vec![DVec3::ZERO; n]),
        );
        let (mut with, mut without) = (vec![DVec3::ZERO; n], vec![DVec3::ZERO; n]);
        s.matrix.multiply(&d, &mut with);
        matrix.multiply(&d, &mut without);
        let size = ahead.iter().map(|f| f.length()).fold(0.0, f64::max);
        let mut pushed = 0.0f64;
        for i in 0..n {
            let slope = behind[i] - ahead[i];
            assert!((with[i] - without[i] - slope).length() < 1e-6 * size, "node {i}");
            assert!((s.rhs[i] - rhs[i] - still[i]).length() < 1e-6 * size, "node {i}");
            pushed = pushed.max(slope.length());
        }
        assert!(pushed > 1e-3 * size);
    }
}
