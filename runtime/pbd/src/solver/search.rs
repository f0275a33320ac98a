//! Search for contact planes, and what one search tells about the next ones.
//!
//! Most particles are far from every solid and stay so for long; those that lie on a mesh meet the same few triangles
//! again and again. A search therefore leaves behind how far particle and solids may travel before any contact is
//! possible, or a row of triangles that holds all contacts while the particle stays near. Both only say what a search
//! need not look at: the contacts are the same bits as without.

#[cfg(test)]
mod tests;

use super::CHUNK;
use super::particles::{ClampCounts, Particles};
use super::solids::{PlaneContact, SLOTS, ShapeContact, Solid, Solids};
use crate::Pose;
use crate::collider::{LocalContacts, MeshSolid, Motion, PreparedShape, SignedDistanceGrid};
use glam::{Quat, Vec3, Vec3A};
use rayon::prelude::*;

/// Triangles in a row; a particle with more near it searches the tree each time.
const ROW: usize = 24;
/// Rows of a particle, at most; meshes beyond that take turns.
const ROWS: usize = 2;
/// How far a particle may move before its row is made anew, of the range in which contacts are looked for: a longer
/// life costs longer rows.
const SKIN: f32 = 0.03;
/// How far off its ways may start, likewise: gravity alone makes a resting particle set out each time.
const SWEEP: f32 = 0.5;
/// Way of the solids after which memories start anew, so that sums stay exact to 1e-5 mm, mm.
const LONGEST: f64 = 100.0;
/// Mark of a row whose triangles are too many.
const FULL: u32 = u32::MAX;

/// What earlier searches left behind.
#[derive(Clone, Debug, Default)]
pub(crate) struct Memory {
    chunks: Vec<Remembered>,
    /// Way of all solids since the memories were last cleared, mm.
    travel: f64,
    /// Part of `travel` in the present substep that is the same for all particles, and whether a solid turns.
    slide: f32,
    turns: bool,
    /// Number of each solid among the meshes.
    mesh: Vec<usize>,
    /// Rows of a particle.
    rows: usize,
}

/// Memories of the particles of a chunk.
#[derive(Clone, Debug)]
struct Remembered {
    /// Predicted positions at the last search.
    base: Vec<Vec3A>,
    /// Distance that particle and solids may travel together, plus the solids' travel at that time.
    until: Vec<f32>,
    rows: Vec<Row>,
    triangles: Vec<u32>,
}

/// Triangles of a mesh that are within reach and skin of a point.
#[derive(Clone, Copy, Debug)]
struct Row {
    /// In the mesh's frame.
    base: Vec3,
    mesh: u32,
    count: u32,
}

impl Row {
    const NONE: Self = Self {
        base: Vec3::ZERO,
        mesh: u32::MAX,
        count: 0,
    };
}

/// How a solid moves over a substep.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Swing {
    /// Centre of the shape at the start.
    centre: Vec3A,
    /// Chord of the turn, for a point 1 mm off the centre.
    turn: f32,
}

/// Chord that a turn from `a` to `b` takes 1 mm off the axis, never too short.
fn chord(a: Quat, b: Quat) -> f32 {
    // |a − b| is 2 sin(θ/4).
    if a == b {
        0.0
    } else {
        2.0 * (a - b).length().min((a + b).length()) + 1e-6
    }
}

impl Memory {
    pub(crate) fn new(list: &[Solid], particles: usize) -> Self {
        let mut meshes = 0;
        let mesh = list
            .iter()
            .map(|s| {
                meshes += usize::from(matches!(s.shape, PreparedShape::Mesh(_)));
                meshes.saturating_sub(1)
            })
            .collect();
        let rows = meshes.min(ROWS);
        let particles = if list.is_empty() { 0 } else { particles };
        let chunks = (0..particles.div_ceil(CHUNK))
            .map(|c| {
                let n = CHUNK.min(particles - c * CHUNK);
                Remembered {
                    base: vec![Vec3A::ZERO; n],
                    until: vec![f32::NEG_INFINITY; n],
                    rows: vec![Row::NONE; n * rows],
                    triangles: vec![0; n * rows * ROW],
                }
            })
            .collect();
        Self {
            chunks,
            mesh,
            rows,
            ..Self::default()
        }
    }

    /// Forgets everything.
    pub(crate) fn clear(&mut self) {
        self.travel = 0.0;
        for c in &mut self.chunks {
            c.until.fill(f32::NEG_INFINITY);
            c.rows.fill(Row::NONE);
        }
    }

    /// A substep begins.
    pub(crate) fn begin(&mut self) {
        (self.slide, self.turns) = (0.0, false);
        if self.travel.is_nan() || self.travel > LONGEST {
            self.travel = 0.0;
            for c in &mut self.chunks {
                c.until.fill(f32::NEG_INFINITY);
            }
        }
    }

    /// A solid that was last seen at `seen` goes from `from` to `to` in this substep.
    pub(crate) fn moves(&mut self, shape: &PreparedShape, seen: Pose, from: Pose, to: Pose) -> Swing {
        if seen == from && from == to {
            return Swing::default();
        }
        // Where room is not a distance to points of the shape, a turn may use it up at any rate.
        let ball = shape.bounding_ball().filter(|_| shape.has_distance());
        let (centre, radius) = ball.unwrap_or((Vec3::ZERO, f32::INFINITY));
        let way = |a: &Pose, b: &Pose| {
            let turn = chord(a.rotation, b.rotation);
            let off = if turn > 0.0 { turn * radius } else { 0.0 };
            a.apply(centre).distance(b.apply(centre)) + off
        };
        self.travel += f64::from(way(&seen, &from)) + f64::from(way(&from, &to));
        let at = from.apply(centre);
        let turn = chord(from.rotation, to.rotation);
        self.slide += at.distance(to.apply(centre));
        self.turns |= turn > 0.0;
        Swing {
            centre: at.into(),
            turn,
        }
    }
}

impl Solids {
    /// Forgets what earlier searches found; the next one finds the same contacts without it.
    pub(crate) fn forget(&mut self) {
        self.memory.clear();
    }

    /// Contact planes of every particle on its way from x to its prediction.
    pub(crate) fn find(&mut self, p: &Particles, how: &ShapeContact, counts: &mut [ClampCounts]) {
        if self.list.is_empty() {
            return;
        }
        let Memory {
            chunks,
            travel,
            slide,
            turns,
            mesh,
            rows,
            ..
        } = &mut self.memory;
        let search = Search {
            list: &self.list,
            order: &self.order,
            p,
            how,
            travel: *travel as f32,
            slide: *slide,
            turns: *turns,
            mesh,
            rows: *rows,
        };
        (
            self.planes.par_chunks_mut(CHUNK * SLOTS),
            self.count.par_chunks_mut(CHUNK),
            self.pressed.par_chunks_mut(CHUNK),
            self.busy.par_iter_mut(),
            counts.par_iter_mut(),
            chunks.par_iter_mut(),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (planes, count, pressed, busy, counts, memory))| {
                *busy = false;
                pressed.fill(0);
                count.fill(0);
                for n in 0..count.len() {
                    let i = chunk * CHUNK + n;
                    if p.inverse_mass[i] == 0.0 || search.is_far(i, n, memory) || !p.predicted[i].is_finite()
                    {
                        continue;
                    }
                    let out = &mut planes[n * SLOTS..(n + 1) * SLOTS];
                    let (found, lost) = search.one(i, n, memory, out);
                    count[n] = found as u8;
                    counts.shape_contacts += lost;
                    *busy |= found > 0;
                }
            });
    }
}

/// A search as all chunks see it.
struct Search<'a> {
    list: &'a [Solid],
    order: &'a [usize],
    p: &'a Particles,
    how: &'a ShapeContact<'a>,
    travel: f32,
    slide: f32,
    turns: bool,
    mesh: &'a [usize],
    rows: usize,
}

impl Search<'_> {
    /// Whether particle `i`, the `n`-th of its chunk, and the solids have not travelled far enough to touch.
    #[inline]
    fn is_far(&self, i: usize, n: usize, memory: &Remembered) -> bool {
        let (x, predicted) = (self.p.x[i], self.p.predicted[i]);
        let mut way = predicted.distance(memory.base[n]) + predicted.distance(x) + self.slide;
        if self.turns {
            // In a turning frame the way from start to prediction is the longer the farther the particle is off.
            for s in self.list {
                way += s.swing.turn * predicted.distance(s.swing.centre);
            }
        }
        way + self.travel < memory.until[n]
    }

    /// Contacts of particle `i`, the `n`-th of its chunk: how many, and how many found no slot.
    fn one(&self, i: usize, n: usize, memory: &mut Remembered, out: &mut [PlaneContact]) -> (usize, u64) {
        let (mut count, mut lost) = (0, 0);
        let mut room = f32::INFINITY;
        let body = usize::from(self.p.body[i]);
        let (x, predicted) = (self.p.x[i], self.p.predicted[i]);
        for &k in self.order {
            let solid = &self.list[k];
            let distance = solid.distance_mm.unwrap_or(self.how.distance[body]);
            let reach = distance + self.how.margin[body];
            let apart = solid.way.lo.cmpgt(x.max(predicted) + reach).any()
                || solid.way.hi.cmplt(x.min(predicted) - reach).any();
            if apart && solid.shape.has_distance() {
                let gap = (solid.way.lo - predicted)
                    .max(predicted - solid.way.hi)
                    .max(Vec3A::ZERO);
                room = room.min(gap.length() - solid.shape.ambit(reach));
                continue;
            }
            let (a, b) = solid.way.local(x, predicted);
            let motion = Motion {
                a,
                b,
                distance,
                reach,
            };
            // Rounding of places in the frames of both, and of the distances made from them.
            let slack = 1e-3 + 1e-5 * (b.abs().max_element() + predicted.abs().max_element());
            let mut found = LocalContacts::default();
            let clear = match &solid.shape {
                PreparedShape::Mesh(m) => {
                    let row = self.mesh[k] % self.rows.max(1);
                    let at = n * self.rows + row;
                    memory.mesh_contacts(at, k as u32, m, &motion, slack, &mut found)
                }
                shape => {
                    if !apart {
                        shape.contacts(&motion, &mut found);
                    }
                    shape.room(b, reach, solid.steepness)
                }
            };
            room = room.min(clear - slack);
            for c in found.as_slice() {
                if count == SLOTS {
                    lost += 1;
                    continue;
                }
                let normal = solid.way.to.rotation * c.normal;
                let point = solid.way.to.apply(c.point);
                out[count] = PlaneContact {
                    normal,
                    offset: normal.dot(point) + distance,
                    drift: point - solid.way.from.apply(c.point),
                    solid: k as u32,
                };
                count += 1;
            }
        }
        memory.base[n] = predicted;
        memory.until[n] = if count == 0 && room > 0.0 {
            room + self.travel
        } else {
            f32::NEG_INFINITY
        };
        (count, lost)
    }
}

impl Remembered {
    /// Contacts with a mesh, by row `at`, and a distance beyond reach in which there are no others.
    fn mesh_contacts(
        &mut self,
        at: usize,
        solid: u32,
        (mesh, grid): &(MeshSolid, SignedDistanceGrid),
        motion: &Motion,
        slack: f32,
        out: &mut LocalContacts,
    ) -> f32 {
        let Motion { a, b, reach, .. } = *motion;
        let far = mesh.room(grid, motion);
        if mesh.is_beyond(grid, motion) {
            return far;
        }
        let (skin, sweep) = (SKIN * reach, SWEEP * reach);
        let row = &mut self.rows[at];
        let triangles = &mut self.triangles[at * ROW..(at + 1) * ROW];
        if a.distance(b) > sweep {
            mesh.contacts(grid, motion, out);
            return far;
        }
        if row.mesh != solid || row.base.distance(b) > skin || row.base.distance(a) > sweep {
            *row = Row {
                base: b,
                mesh: solid,
                count: mesh
                    .near(motion, skin, sweep, slack, triangles)
                    .map_or(FULL, |n| n as u32),
            };
        }
        if row.count == FULL {
            mesh.contacts(grid, motion, out);
            return far;
        }
        mesh.contacts_among(grid, motion, &triangles[..row.count as usize], out);
        if row.count == 0 {
            far.max(mesh.unless_inside(grid, motion, skin - row.base.distance(b)))
        } else {
            far
        }
    }
}
