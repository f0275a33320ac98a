//! Prediction at the start of a substep and the velocity update at its end.

use super::CHUNK;
use glam::Vec3A;
use rayon::prelude::*;

/// State of all particles, bodies one after the other.
#[derive(Clone, Debug, Default)]
pub(crate) struct Particles {
    /// Positions at the start of the substep, after stabilisation.
    pub x: Vec<Vec3A>,
    /// Predicted, then iterated positions.
    pub predicted: Vec<Vec3A>,
    /// Where particle contacts write, before it takes the place of `predicted`.
    pub next: Vec<Vec3A>,
    pub velocity: Vec<Vec3A>,
    /// Rest positions in the body's frame.
    pub rest: Vec<Vec3A>,
    /// 1/mass, 0 for pinned particles.
    pub inverse_mass: Vec<f32>,
    /// The same with mass scaling, as contacts see it.
    pub contact_weight: Vec<f32>,
    pub body: Vec<u16>,
    pub area_mm2: Vec<f32>,
    pub correction: Vec<Vec3A>,
    pub correction_count: Vec<u32>,
    /// Constraints of the substep; used by `Averaging::Total` only.
    pub total_count: Vec<u32>,
}

/// Constants of a substep.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Integration {
    pub h: f32,
    pub gravity: Vec3A,
    pub drag_factor: f32,
    pub mass_scaling: f32,
    pub sleep: f32,
    pub max_speed: f32,
    pub max_change: f32,
}

/// How often limits took hold.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClampCounts {
    /// Velocities cut to the largest speed.
    pub speed: u64,
    /// Velocity changes cut to the largest acceleration.
    pub acceleration: u64,
    /// Positions that were no number and were put back to their last place.
    pub not_finite: u64,
    /// Shape contacts beyond the six of a particle.
    pub shape_contacts: u64,
    /// Particle contacts beyond the setting.
    pub particle_contacts: u64,
}

impl ClampCounts {
    pub(crate) fn add(&mut self, o: &Self) {
        self.speed += o.speed;
        self.acceleration += o.acceleration;
        self.not_finite += o.not_finite;
        self.shape_contacts += o.shape_contacts;
        self.particle_contacts += o.particle_contacts;
    }
}

impl Particles {
    /// v += h·g; v *= drag; x* = x + h·v. Returns nothing; pinned particles stay.
    pub(crate) fn predict(&mut self, c: &Integration) {
        let down = c.gravity.normalize_or_zero();
        (
            self.predicted.par_chunks_mut(CHUNK),
            self.velocity.par_chunks_mut(CHUNK),
            self.contact_weight.par_chunks_mut(CHUNK),
            self.x.par_chunks(CHUNK),
            self.inverse_mass.par_chunks(CHUNK),
        )
            .into_par_iter()
            .for_each(|(predicted, velocity, weight, x, w)| {
                for i in 0..x.len() {
                    if w[i] == 0.0 {
                        velocity[i] = Vec3A::ZERO;
                        predicted[i] = x[i];
                        continue;
                    }
                    let v = (velocity[i] + c.gravity * c.h) * c.drag_factor;
                    velocity[i] = v;
                    predicted[i] = x[i] + v * c.h;
                    if c.mass_scaling > 0.0 {
                        // m·exp(−k·height): what lies higher yields to what lies lower.
                        let height = -down.dot(predicted[i]);
                        weight[i] = w[i] * (c.mass_scaling * height).clamp(-60.0, 60.0).exp();
                    }
                }
            });
    }

    /// v = (x* − x)/h, clamps, x = x*.
    pub(crate) fn finish(&mut self, c: &Integration, counts: &mut [ClampCounts]) {
        (
            self.predicted.par_chunks_mut(CHUNK),
            self.velocity.par_chunks_mut(CHUNK),
            self.x.par_chunks_mut(CHUNK),
            self.inverse_mass.par_chunks(CHUNK),
            counts.par_iter_mut(),
        )
            .into_par_iter()
            .for_each(|(predicted, velocity, x, w, counts)| {
                let inverse_h = 1.0 / c.h;
                for i in 0..x.len() {
                    if w[i] == 0.0 {
                        continue;
                    }
                    if !predicted[i].is_finite() {
                        counts.not_finite += 1;
                        velocity[i] = Vec3A::ZERO;
                        continue;
                    }
                    let moved = predicted[i] - x[i];
                    let mut v = moved * inverse_h;
                    if c.max_change > 0.0 {
                        let change = v - velocity[i];
                        let length = change.length();
                        if length > c.max_change {
                            v = velocity[i] + change * (c.max_change / length);
                            counts.acceleration += 1;
                        }
                    }
                    if c.max_speed > 0.0 {
                        let speed = v.length();
                        if speed > c.max_speed {
                            v *= c.max_speed / speed;
                            counts.speed += 1;
                        }
                    }
                    velocity[i] = v;
                    if moved.length_squared() >= c.sleep * c.sleep {
                        x[i] = predicted[i];
                    }
                }
            });
    }
}
