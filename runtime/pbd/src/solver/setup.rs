//! From a scene to the solver's arrays.

use super::clusters::{Clusters, Entry, Frame, rotation_of};
use super::neighbours::{Neighbours, Range};
use super::particles::Particles;
use super::report::ClusterFrame;
use super::solids::Solids;
use super::{BodyInfo, CHUNK, CLUSTER_LANES, ClampCounts, ContactReport, Core, Solver, Timings};
use crate::rotation::QuatX8;
use crate::{NetMomentum, PbdError, Scene, Settings, SoftBody};
use glam::{Mat3A, Vec3, Vec3A, Vec4};

/// Most particles or memberships of a scene.
const MOST: usize = 1 << 26;
/// Cells of the curve along which particles are sorted, of the spacing.
const CURVE_CELL: f32 = 1.0;

impl Solver {
    /// Makes a solver on all cores.
    ///
    /// # Errors
    /// - [`PbdError::Setting`] for a setting out of range.
    /// - [`PbdError::Shape`], [`PbdError::Array`], [`PbdError::Empty`] for a bad collider.
    /// - [`PbdError::TooMany`] for a scene beyond memory.
    /// - [`PbdError::Threads`] where threads could not be started.
    pub fn new(scene: Scene, settings: Settings) -> Result<Self, PbdError> {
        Self::with_threads(scene, settings, 0)
    }

    /// As [`Solver::new`], on this many threads; 0 for one per core.
    ///
    /// # Errors
    /// As [`Solver::new`].
    pub fn with_threads(scene: Scene, settings: Settings, threads: usize) -> Result<Self, PbdError> {
        settings.check()?;
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("pbd-{i}"))
            .build()?;
        let core = pool.install(|| Core::new(&scene, &settings, Order::ByPlace))?;
        Ok(Self { settings, pool, core })
    }
}

/// In which order particles lie in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Order {
    /// As the body has them.
    AsGiven,
    /// Those near each other in space near each other in memory.
    ByPlace,
}

/// Particles of a body along a Z-order curve, and within each chunk by the number of their clusters, so that loops over
/// these are alike. The body's first particle shall have the index `first`.
fn by_place(body: &SoftBody, first: usize) -> Vec<usize> {
    let n = body.particle_count();
    let lo = body
        .positions
        .iter()
        .fold(Vec3::INFINITY, |lo, &x| lo.min(x.into()));
    let keys: Vec<u64> = body
        .positions
        .iter()
        .map(|&x| {
            let cell = (Vec3::from(x) - lo) / (CURVE_CELL * body.spacing_mm);
            let spread = |v: f32| {
                // The cast saturates; 21 bits a coordinate, each two bits apart.
                let v = u64::from((v as u32).min((1 << 21) - 1));
                (0..21).fold(0, |key, bit| key | (v >> bit & 1) << (3 * bit))
            };
            spread(cell.x) | spread(cell.y) << 1 | spread(cell.z) << 2
        })
        .collect();
    let mut clusters = vec![0u32; n];
    for &m in &body.members {
        clusters[m as usize] += 1;
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_unstable_by_key(|&i| (keys[i], i));
    let (head, tail) = order.split_at_mut((first.next_multiple_of(CHUNK) - first).min(n));
    head.sort_by_key(|&i| clusters[i]);
    for chunk in tail.chunks_mut(CHUNK) {
        chunk.sort_by_key(|&i| clusters[i]);
    }
    order
}

impl Core {
    pub(crate) fn new(scene: &Scene, s: &Settings, order: Order) -> Result<Self, PbdError> {
        let count = |what, found: usize, most: usize| {
            if found > most {
                Err(PbdError::TooMany { what, found, most })
            } else {
                Ok(())
            }
        };
        count("bodies", scene.bodies.len(), usize::from(u16::MAX))?;
        count("colliders", scene.colliders.len(), 4096)?;
        let particles: usize = scene.bodies.iter().map(SoftBody::particle_count).sum();
        count("particles", particles, MOST)?;
        count(
            "memberships",
            scene.bodies.iter().map(SoftBody::membership_count).sum(),
            MOST,
        )?;
        let mut core = Self {
            particles: Particles::default(),
            clusters: Clusters::default(),
            neighbours: Neighbours::new(particles, s.max_particle_contacts as usize),
            solids: Solids::new(&scene.colliders, s, particles)?,
            bodies: Vec::new(),
            ranges: Vec::new(),
            distance: Vec::new(),
            margin: Vec::new(),
            mass: Vec::new(),
            drift: vec![Vec3A::ZERO; scene.bodies.len()],
            free: Vec::new(),
            frames: Vec::new(),
            given: Vec::with_capacity(particles),
            positions: vec![[0.0; 3]; particles],
            counts: vec![ClampCounts::default(); particles.div_ceil(CHUNK)],
            reports: vec![ContactReport::default(); scene.colliders.len()],
            clamps: ClampCounts::default(),
            timings: Timings::default(),
            steps: 0,
        };
        core.clusters.offsets.push(0);
        for (b, body) in scene.bodies.iter().enumerate() {
            core.add_body(b as u16, body, s, order);
        }
        let p = &mut core.particles;
        p.predicted = p.x.clone();
        p.next = p.x.clone();
        p.velocity = vec![Vec3A::ZERO; particles];
        p.contact_weight = p.inverse_mass.clone();
        p.correction = vec![Vec3A::ZERO; particles];
        p.correction_count = vec![0; particles];
        p.total_count = vec![0; particles];
        core.finish_clusters();
        core.publish();
        core.frames = (0..core.clusters.len())
            .map(|c| ClusterFrame {
                rotation: rotation_of(&core.clusters.rotation, c).to_array(),
                translation: core.clusters.mean[c].to_array(),
            })
            .collect();
        Ok(core)
    }

    fn add_body(&mut self, index: u16, body: &SoftBody, s: &Settings, order: Order) {
        let p = &mut self.particles;
        let first = p.x.len();
        let n = body.particle_count();
        let given = match order {
            Order::AsGiven => (0..n).collect(),
            Order::ByPlace => by_place(body, first),
        };
        let mut inside = vec![0; n];
        for (k, &g) in given.iter().enumerate() {
            inside[g] = (first + k) as u32;
        }
        self.given.extend(given.iter().map(|g| (first + g) as u32));
        let place = |x: &[f32; 3]| Vec3A::from(body.placement.apply(Vec3::from(*x)));
        let start = body.start.as_ref().unwrap_or(&body.positions);
        let inverse = 1.0 / body.mass_g;
        for &g in &given {
            p.x.push(place(&start[g]));
            p.rest.push(body.positions[g].into());
            p.inverse_mass.push(if body.pinned[g] { 0.0 } else { inverse });
            p.area_mm2.push(body.area_mm2[g]);
        }
        p.body.extend(std::iter::repeat_n(index, n));

        let c = &mut self.clusters;
        let first_cluster = c.len();
        let base = c.members.len() as u32;
        c.offsets.extend(body.offsets[1..].iter().map(|o| o + base));
        for w in body.offsets.windows(2) {
            let row = w[0] as usize..w[1] as usize;
            let mut members: Vec<(u32, Vec4)> = body.members[row.clone()]
                .iter()
                .zip(&body.local[row])
                .map(|(&m, &q)| (inside[m as usize], Vec3::from(q).extend(0.0)))
                .collect();
            if order == Order::ByPlace {
                members.sort_unstable_by_key(|m| m.0);
            }
            c.members.extend(members.iter().map(|m| m.0));
            c.local.extend(members.iter().map(|m| m.1));
        }
        c.stiffness.extend_from_slice(&body.stiffness);
        c.mean.extend(body.centres.iter().map(place));
        for k in first_cluster..c.len() {
            if k / CLUSTER_LANES >= c.rotation.len() {
                c.rotation.push(QuatX8::default());
            }
            c.rotation[k / CLUSTER_LANES].set_lane(k % CLUSTER_LANES, body.placement.rotation);
        }

        let spacing = body.spacing_mm;
        let of = |factor: f64| factor as f32 * spacing;
        self.ranges.push(Range {
            half_contact: 0.5 * of(s.solid_rest_distance_factor),
            half_margin: 0.5 * of(s.particle_margin_factor),
            half_skin: 0.5 * of(s.neighbour_skin_factor),
        });
        self.distance.push(of(s.collision_distance_factor));
        self.margin.push(of(s.shape_margin_factor));
        self.mass.push(body.mass_g);
        let pinned = body.pinned.contains(&true);
        let corrected =
            s.net_momentum == NetMomentum::Corrected && s.averaging == crate::Averaging::PerGroup && !pinned;
        // Only particles in clusters are moved by them, so only they share what has to be taken back.
        let mut clustered = vec![false; n];
        for &m in &body.members {
            clustered[m as usize] = true;
        }
        let share = clustered.iter().filter(|c| **c).count() as u32;
        self.free.push(if corrected { share } else { 0 });
        self.bodies.push(BodyInfo {
            name: body.name.clone(),
            particles: first..first + n,
            clusters: first_cluster..self.clusters.len(),
        });
    }

    /// Transpose, shares and moments.
    fn finish_clusters(&mut self) {
        let c = &mut self.clusters;
        let n = self.particles.x.len();
        c.particle_offsets = vec![0; n + 1];
        for &m in &c.members {
            c.particle_offsets[m as usize + 1] += 1;
        }
        for i in 0..n {
            c.particle_offsets[i + 1] += c.particle_offsets[i];
        }
        let mut next = c.particle_offsets.clone();
        c.entries = vec![Entry::default(); c.members.len()];
        for k in 0..c.stiffness.len() {
            let mut moment = Mat3A::ZERO;
            let mut share = Vec4::ZERO;
            let row = c.offsets[k] as usize..c.offsets[k + 1] as usize;
            for m in row {
                let i = c.members[m] as usize;
                let q = c.local[m].truncate();
                let slot = &mut next[i];
                c.entries[*slot as usize] = Entry {
                    local: q.to_array(),
                    cluster: k as u32,
                };
                *slot += 1;
                let part = 1.0 / (c.particle_offsets[i + 1] - c.particle_offsets[i]) as f32;
                c.local[m].w = part;
                share += (q * part).extend(part);
                let q = Vec3A::from(q);
                moment += Mat3A::from_cols(q * q.x, q * q.y, q * q.z);
            }
            // A flat cluster has no linear map; a little of the identity stands in for the missing direction.
            let trace = moment.x_axis.x + moment.y_axis.y + moment.z_axis.z;
            let moment = moment + Mat3A::from_diagonal(Vec3::splat((1e-6 * trace).max(1e-12)));
            c.inverse_moment.push(moment.inverse());
            c.share.push(share);
        }
        c.frame = vec![Frame::default(); c.stiffness.len()];
        c.net = vec![Vec3A::ZERO; c.stiffness.len()];
    }
}
