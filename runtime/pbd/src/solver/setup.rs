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
        let core = pool.install(|| Core::new(&scene, &settings))?;
        Ok(Self { settings, pool, core })
    }
}

impl Core {
    pub(crate) fn new(scene: &Scene, s: &Settings) -> Result<Self, PbdError> {
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
            positions: Vec::new(),
            counts: vec![ClampCounts::default(); particles.div_ceil(CHUNK)],
            reports: vec![ContactReport::default(); scene.colliders.len()],
            clamps: ClampCounts::default(),
            timings: Timings::default(),
            steps: 0,
        };
        core.clusters.offsets.push(0);
        for (b, body) in scene.bodies.iter().enumerate() {
            core.add_body(b as u16, body, s);
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
        core.positions = core.particles.x.iter().map(|x| x.to_array()).collect();
        core.frames = (0..core.clusters.len())
            .map(|c| ClusterFrame {
                rotation: rotation_of(&core.clusters.rotation, c).to_array(),
                translation: core.clusters.mean[c].to_array(),
            })
            .collect();
        Ok(core)
    }

    fn add_body(&mut self, index: u16, body: &SoftBody, s: &Settings) {
        let p = &mut self.particles;
        let first = p.x.len();
        let n = body.particle_count();
        let place = |x: &[f32; 3]| Vec3A::from(body.placement.apply(Vec3::from(*x)));
        p.x.extend(body.positions.iter().map(place));
        p.rest.extend(body.positions.iter().map(|&x| Vec3A::from(x)));
        let inverse = 1.0 / body.mass_g;
        p.inverse_mass
            .extend(body.pinned.iter().map(|&pin| if pin { 0.0 } else { inverse }));
        p.body.extend(std::iter::repeat_n(index, n));
        p.area_mm2.extend_from_slice(&body.area_mm2);

        let c = &mut self.clusters;
        let first_cluster = c.len();
        let base = c.members.len() as u32;
        c.offsets.extend(body.offsets[1..].iter().map(|o| o + base));
        c.members.extend(body.members.iter().map(|m| m + first as u32));
        c.local
            .extend(body.local.iter().map(|&q| Vec3::from(q).extend(0.0)));
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
