//! One step of Algorithm 1 of Camara et al. 2016, on all cores, the same bits on any number of them.

pub(crate) mod clusters;
mod contacts;
pub(crate) mod neighbours;
pub(crate) mod particles;
mod report;
mod search;
mod setup;
pub(crate) mod solids;
mod state;

pub use particles::ClampCounts;
pub use report::{BodyInfo, ClusterFrame, ContactReport, Timings};
pub(crate) use setup::Order;
pub use state::SolverState;

use crate::{Averaging, Group, NetMomentum, PbdError, Pose, Settings, ShapeMatching, SkinnedPoints};
use clusters::{Clusters, Gather, Matching};
use glam::{DVec3, Vec3, Vec3A};
use neighbours::{Neighbours, PairContact, Range};
use particles::{Integration, Particles};
use rayon::prelude::*;
use solids::{Exchange, ShapeContact, Solids, Start};
use std::time::Instant;

/// Particles in a unit of parallel work. Fixed: sums over chunks then do not depend on the number of threads.
pub(crate) const CHUNK: usize = 128;
/// Clusters whose rotations are extracted at once.
const CLUSTER_LANES: usize = 8;

/// Steps a scene of soft bodies and solids.
///
/// All arrays are made at the start; a step allocates nothing. The result is the same bits on any number of threads.
#[derive(Debug)]
pub struct Solver {
    settings: Settings,
    pool: rayon::ThreadPool,
    core: Core,
}

/// Everything but the thread pool.
#[derive(Debug)]
pub(crate) struct Core {
    pub(crate) particles: Particles,
    pub(crate) clusters: Clusters,
    pub(crate) neighbours: Neighbours,
    pub(crate) solids: Solids,
    pub(crate) bodies: Vec<BodyInfo>,
    pub(crate) ranges: Vec<Range>,
    pub(crate) distance: Vec<f32>,
    pub(crate) margin: Vec<f32>,
    pub(crate) mass: Vec<f32>,
    pub(crate) drift: Vec<Vec3A>,
    /// Particles that share a body's net displacement; 0 where it is left as it is.
    pub(crate) free: Vec<u32>,
    pub(crate) frames: Vec<ClusterFrame>,
    /// The scene's index of each particle: here they lie in another order.
    pub(crate) given: Vec<u32>,
    /// In the scene's order.
    pub(crate) positions: Vec<[f32; 3]>,
    pub(crate) counts: Vec<ClampCounts>,
    pub(crate) reports: Vec<ContactReport>,
    pub(crate) clamps: ClampCounts,
    pub(crate) timings: Timings,
    pub(crate) steps: u64,
}

impl Solver {
    /// Advances the scene by one step, `settings().dt_s`.
    ///
    /// Moving colliders go from their last pose to the one set by [`Solver::set_pose`], evenly over the substeps.
    pub fn step(&mut self) {
        let Self { settings, pool, core } = self;
        pool.install(|| core.step(settings));
    }

    /// Settings in use.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Steps made so far.
    pub fn steps(&self) -> u64 {
        self.core.steps
    }

    /// Threads at work.
    pub fn threads(&self) -> usize {
        self.pool.current_num_threads()
    }

    /// Bodies, in the scene's order, with their ranges of particles and clusters.
    pub fn bodies(&self) -> &[BodyInfo] {
        &self.core.bodies
    }

    /// Positions of all particles, mm; body `b` has `bodies()[b].particles`.
    pub fn positions(&self) -> &[[f32; 3]] {
        &self.core.positions
    }

    /// Velocities of all particles, mm/s.
    pub fn velocities(&self) -> impl ExactSizeIterator<Item = [f32; 3]> + '_ {
        self.core
            .in_given_order(&self.core.particles.velocity)
            .into_iter()
    }

    /// Frames of all clusters, extracted from the positions after the last step.
    pub fn frames(&self) -> &[ClusterFrame] {
        &self.core.frames
    }

    /// What each collider exchanged with the bodies in the last step, in the scene's order.
    pub fn contacts(&self) -> &[ContactReport] {
        &self.core.reports
    }

    /// Times of the last step.
    pub fn timings(&self) -> &Timings {
        &self.core.timings
    }

    /// How often limits took hold in the last step.
    pub fn clamps(&self) -> &ClampCounts {
        &self.core.clamps
    }

    /// How often the lists of near particles were made since the start; they live for many substeps.
    pub fn neighbour_lists_made(&self) -> u64 {
        self.core.neighbours.rebuilds
    }

    /// Pairs of particles within reach of each other in the last substep, each counted from both sides.
    pub fn particle_contacts(&self) -> u64 {
        self.core.neighbours.pairs()
    }

    /// Where collider `k` is.
    ///
    /// # Errors
    /// [`PbdError::Unknown`] where there is no such collider.
    pub fn pose(&self, k: usize) -> Result<Pose, PbdError> {
        self.core
            .solids
            .list
            .get(k)
            .map(|s| s.to)
            .ok_or_else(|| self.no_collider(k))
    }

    /// Where collider `k` shall be after the next step; on the way it pushes and drags what it touches.
    ///
    /// # Errors
    /// - [`PbdError::Unknown`] where there is no such collider.
    /// - [`PbdError::Setting`] where the pose is not finite.
    pub fn set_pose(&mut self, k: usize, pose: Pose) -> Result<(), PbdError> {
        self.check_pose(k, &pose)?;
        if let Some(s) = self.core.solids.list.get_mut(k) {
            s.to = pose;
        }
        Ok(())
    }

    /// Puts collider `k` elsewhere at once, without a way in between.
    ///
    /// # Errors
    /// As [`Solver::set_pose`].
    pub fn place(&mut self, k: usize, pose: Pose) -> Result<(), PbdError> {
        self.check_pose(k, &pose)?;
        if let Some(s) = self.core.solids.list.get_mut(k) {
            (s.from, s.to) = (pose, pose);
        }
        Ok(())
    }

    /// Places of skinned points of body `b` after the last step, mm, on the solver's threads; the time counts as
    /// [`Timings::skinning_s`].
    ///
    /// # Errors
    /// [`PbdError::Unknown`] where there is no such body.
    pub fn skin(&mut self, b: usize, points: &SkinnedPoints, out: &mut [[f32; 3]]) -> Result<(), PbdError> {
        let Some(body) = self.core.bodies.get(b) else {
            return Err(PbdError::Unknown {
                kind: "body",
                name: format!("number {b}"),
                known: self
                    .core
                    .bodies
                    .iter()
                    .map(|b| b.name.as_str())
                    .collect::<Vec<_>>()
                    .join(", "),
            });
        };
        let mut mark = Instant::now();
        let frames = &self.core.frames[body.clusters.clone()];
        self.pool.install(|| points.positions(frames, out));
        self.core.timings.skinning_s += lap(&mut mark);
        Ok(())
    }

    fn check_pose(&self, k: usize, pose: &Pose) -> Result<(), PbdError> {
        if k >= self.core.solids.list.len() {
            return Err(self.no_collider(k));
        }
        if !pose.is_finite() {
            return Err(PbdError::Setting {
                name: "pose",
                found: format!("{pose:?}"),
                expected: "finite numbers",
            });
        }
        Ok(())
    }

    fn no_collider(&self, k: usize) -> PbdError {
        PbdError::Unknown {
            kind: "collider",
            name: format!("number {k}"),
            known: self
                .core
                .solids
                .list
                .iter()
                .map(|s| s.name.as_str())
                .collect::<Vec<_>>()
                .join(", "),
        }
    }
}

/// Time since `mark`, which moves to now.
fn lap(mark: &mut Instant) -> f64 {
    let now = Instant::now();
    let t = now.duration_since(*mark).as_secs_f64();
    *mark = now;
    t
}

impl Core {
    fn step(&mut self, s: &Settings) {
        let begin = Instant::now();
        self.timings = Timings::default();
        self.counts.fill(ClampCounts::default());
        self.solids.exchange.fill(Exchange::default());
        for q in 0..s.substeps {
            self.substep(s, q);
        }
        self.solids.settle();
        let mut mark = Instant::now();
        self.read_out(s);
        self.timings.frames_s += lap(&mut mark);
        self.report(s);
        self.steps += 1;
        self.timings.total_s = begin.elapsed().as_secs_f64();
    }

    fn substep(&mut self, s: &Settings, q: u32) {
        let h = s.substep_s();
        let total = s.averaging == Averaging::Total;
        let mut mark = Instant::now();
        let integration = Integration {
            h: h as f32,
            gravity: DVec3::from(s.gravity_mm_s2).as_vec3().into(),
            drag_factor: s.drag_factor() as f32,
            mass_scaling: s.mass_scaling_per_mm as f32,
            sleep: s.sleep_distance_mm as f32,
            max_speed: s.max_speed_mm_s as f32,
            max_change: (s.max_acceleration_mm_s2 * h) as f32,
        };
        self.solids.advance(q, s.substeps);
        self.particles.predict(&integration);
        self.timings.integrate_s += lap(&mut mark);

        let pairs = PairContact {
            ranges: &self.ranges,
            rest_filter: s.rest_filter,
            symmetric: s.net_momentum == NetMomentum::Corrected && !total,
            stabilise_self: s.stabilise_self_contacts,
            friction: s.particle_friction as f32,
            static_friction: s.static_particle_friction.unwrap_or(s.particle_friction) as f32,
        };
        let shapes = ShapeContact {
            distance: &self.distance,
            margin: &self.margin,
            mass: &self.mass,
            omega: s.over_relaxation as f32,
            total,
        };
        self.neighbours.find(&self.particles, &pairs, &mut self.counts);
        self.timings.neighbours_s += lap(&mut mark);
        self.solids.find(&self.particles, &shapes, &mut self.counts);
        if total {
            count_constraints(
                &mut self.particles,
                &self.clusters,
                &self.neighbours,
                &self.solids,
                &pairs,
            );
        }
        self.timings.collision_s += lap(&mut mark);

        for _ in 0..s.stabilisation_iterations {
            if !self.neighbours.any && self.solids.is_empty() {
                break;
            }
            self.neighbours.correct_start(&mut self.particles, &pairs);
            self.solids.correct_start(&mut self.particles, pairs.symmetric);
            move_both(&mut self.particles);
        }
        self.timings.contacts_s += lap(&mut mark);

        let matching = matching(s);
        for _ in 0..s.iterations {
            for (n, group) in s.group_order.iter().enumerate() {
                match group {
                    Group::ParticleContacts if self.neighbours.any => {
                        self.neighbours
                            .push_apart(&mut self.particles, &pairs, shapes.omega, total);
                        self.timings.contacts_s += lap(&mut mark);
                    }
                    Group::ParticleContacts => {}
                    Group::ShapeMatching => {
                        self.clusters.match_shapes(&self.particles.predicted, matching);
                        net_drift(
                            &self.clusters,
                            &self.bodies,
                            &self.free,
                            shapes.omega,
                            &mut self.drift,
                        );
                        // Where shape contacts follow, they act on each chunk while it is at hand.
                        let fused = s.group_order.get(n + 1) == Some(&Group::ShapeContacts);
                        gather(
                            &mut self.particles,
                            &self.clusters,
                            &mut self.solids,
                            &self.drift,
                            &shapes,
                            fused,
                        );
                        self.timings.shape_matching_s += lap(&mut mark);
                    }
                    Group::ShapeContacts => {
                        let fused = n > 0 && s.group_order[n - 1] == Group::ShapeMatching;
                        if !fused {
                            solve_shapes(&mut self.particles, &mut self.solids, &shapes);
                            self.timings.contacts_s += lap(&mut mark);
                        }
                    }
                }
            }
        }

        if s.restitution > 0.0 {
            // Needs x* and the velocity before: the clamp below sees the rebound as well.
            restitute(&mut self.particles, &self.solids, s.restitution as f32, h as f32);
        }
        self.particles.finish(&integration, &mut self.counts);
        if q + 1 == s.substeps {
            self.solids.tally(&self.particles);
        }
        self.timings.integrate_s += lap(&mut mark);
    }

    /// Frames and positions as the caller sees them, from the same x.
    fn read_out(&mut self, s: &Settings) {
        self.clusters.match_shapes(&self.particles.x, matching(s));
        for (c, f) in self.frames.iter_mut().enumerate() {
            *f = ClusterFrame {
                rotation: clusters::rotation_of(&self.clusters.rotation, c).to_array(),
                translation: self.clusters.mean[c].to_array(),
            };
        }
        self.publish();
    }

    /// Positions for the caller.
    fn publish(&mut self) {
        for (&g, x) in self.given.iter().zip(&self.particles.x) {
            self.positions[g as usize] = x.to_array();
        }
    }

    /// Values of particles in the scene's order.
    fn in_given_order(&self, values: &[Vec3A]) -> Vec<[f32; 3]> {
        let mut out = vec![[0.0; 3]; values.len()];
        for (&g, v) in self.given.iter().zip(values) {
            out[g as usize] = v.to_array();
        }
        out
    }

    fn report(&mut self, s: &Settings) {
        self.clamps = ClampCounts::default();
        for c in &self.counts {
            self.clamps.add(c);
        }
        // Prediction scales gravity's impulse by the drag factor; contact impulses come after it. Brought to the same
        // place in the step, the force that holds a resting body is its weight.
        let drag = Some(s.drag_factor()).filter(|f| *f > 0.0).unwrap_or(1.0);
        let width = self.solids.list.len();
        let keep = if s.force_smoothing_s > 0.0 {
            (1.0 - s.dt_s / s.force_smoothing_s).max(0.0)
        } else {
            0.0
        };
        for (k, report) in self.reports.iter_mut().enumerate() {
            let mut sum = Exchange::default();
            for chunk in self.solids.exchange.chunks(width) {
                let e = &chunk[k];
                sum.push += e.push;
                sum.twist += e.twist;
                sum.normal += e.normal;
                sum.contacts += e.contacts;
                sum.area_mm2 += e.area_mm2;
                sum.depth_mm = sum.depth_mm.max(e.depth_mm);
            }
            report.update(&sum, s.substep_s() * s.dt_s * drag, keep);
        }
    }
}

pub(crate) fn matching(s: &Settings) -> Matching {
    Matching {
        passes: s.rotation_iterations,
        beta: match s.shape_matching {
            ShapeMatching::Rotation => None,
            ShapeMatching::Linear { beta } => Some(beta as f32),
        },
    }
}

/// Mean displacement that averaging would give each body.
pub(crate) fn net_drift(
    clusters: &Clusters,
    bodies: &[BodyInfo],
    free: &[u32],
    omega: f32,
    drift: &mut [Vec3A],
) {
    for ((body, &free), drift) in bodies.iter().zip(free).zip(drift) {
        if free > 0 {
            let sum = clusters.net[body.clusters.clone()]
                .iter()
                .fold(DVec3::ZERO, |s, v| s + Vec3::from(*v).as_dvec3());
            *drift = (sum * f64::from(omega) / f64::from(free)).as_vec3().into();
        }
    }
}

pub(crate) fn total_of<'a>(p: &'a [u32], how: &ShapeContact) -> Option<&'a [u32]> {
    how.total.then_some(p)
}

pub(crate) fn gather(
    p: &mut Particles,
    clusters: &Clusters,
    solids: &mut Solids,
    drift: &[Vec3A],
    how: &ShapeContact,
    fused: bool,
) {
    let Particles {
        x,
        predicted,
        inverse_mass,
        body,
        total_count,
        ..
    } = p;
    let total_count = total_of(total_count, how);
    let each = Gather {
        inverse_mass,
        body,
        drift,
        omega: how.omega,
        total_count,
    };
    let (view, exchange, pressed) = solids.solver();
    if fused && view.width() > 0 {
        let start = Start { x, body, total_count };
        (
            predicted.par_chunks_mut(CHUNK),
            exchange.par_chunks_mut(view.width()),
            pressed.par_chunks_mut(CHUNK),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (predicted, exchange, pressed))| {
                clusters.gather(chunk, predicted, &each);
                view.solve(chunk, predicted, &start, how, exchange, pressed);
            });
    } else {
        predicted
            .par_chunks_mut(CHUNK)
            .enumerate()
            .for_each(|(chunk, predicted)| clusters.gather(chunk, predicted, &each));
    }
}

pub(crate) fn solve_shapes(p: &mut Particles, solids: &mut Solids, how: &ShapeContact) {
    let (view, exchange, pressed) = solids.solver();
    if view.width() == 0 {
        return;
    }
    let Particles {
        x,
        predicted,
        body,
        total_count,
        ..
    } = p;
    let start = Start {
        x,
        body,
        total_count: total_of(total_count, how),
    };
    (
        predicted.par_chunks_mut(CHUNK),
        exchange.par_chunks_mut(view.width()),
        pressed.par_chunks_mut(CHUNK),
    )
        .into_par_iter()
        .enumerate()
        .for_each(|(chunk, (predicted, exchange, pressed))| {
            view.solve(chunk, predicted, &start, how, exchange, pressed);
        });
}

/// x += dx/n and x* += dx/n: overlap goes, the velocity stays.
pub(crate) fn move_both(p: &mut Particles) {
    (
        p.x.par_chunks_mut(CHUNK),
        p.predicted.par_chunks_mut(CHUNK),
        p.correction.par_chunks_mut(CHUNK),
        p.correction_count.par_chunks_mut(CHUNK),
    )
        .into_par_iter()
        .for_each(|(x, predicted, dx, count)| {
            for k in 0..x.len() {
                if count[k] > 0 {
                    let d = dx[k] / count[k] as f32;
                    x[k] += d;
                    predicted[k] += d;
                    // Ready for the next pass even where no pair resets it.
                    dx[k] = Vec3A::ZERO;
                    count[k] = 0;
                }
            }
        });
}

/// Constraints of every particle: its clusters, and the contacts that are violated at the prediction.
pub(crate) fn count_constraints(
    p: &mut Particles,
    clusters: &Clusters,
    near: &Neighbours,
    solids: &Solids,
    how: &PairContact,
) {
    let Particles {
        predicted,
        body,
        total_count,
        ..
    } = p;
    for (i, count) in total_count.iter_mut().enumerate() {
        let mut n = clusters.particle_offsets[i + 1] - clusters.particle_offsets[i];
        if near.any {
            let a = how.ranges[usize::from(body[i])].half_contact;
            for &j in near.row(i) {
                let contact = a + how.ranges[usize::from(body[j as usize])].half_contact;
                let d2 = predicted[i].distance_squared(predicted[j as usize]);
                n += u32::from(d2 < contact * contact);
            }
        }
        if !solids.is_empty() {
            for c in solids.row(i) {
                n += u32::from(Vec3A::from(c.normal).dot(predicted[i]) < c.offset);
            }
        }
        *count = n;
    }
}

/// Lets particles leave a shape with a share of the speed with which they came.
pub(crate) fn restitute(p: &mut Particles, solids: &Solids, restitution: f32, h: f32) {
    if solids.is_empty() {
        return;
    }
    for i in 0..p.x.len() {
        if p.inverse_mass[i] == 0.0 {
            continue;
        }
        for c in solids.row(i) {
            let normal = Vec3A::from(c.normal);
            let drift = Vec3A::from(c.drift) / h;
            if normal.dot(p.predicted[i]) > c.offset + 1e-3 {
                continue;
            }
            let before = normal.dot(p.velocity[i] - drift);
            let after = normal.dot((p.predicted[i] - p.x[i]) / h - drift);
            if before < 0.0 && after < -restitution * before {
                p.predicted[i] += normal * ((-restitution * before - after) * h);
            }
        }
    }
}
