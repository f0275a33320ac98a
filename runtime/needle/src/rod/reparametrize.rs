//! Quantities of the needle at new nodes (Chentanez et al. 2009, §3.4.2).

use super::Rod;
use crate::akima::{Akima, linear};
use crate::frame::{angle_about, transport, unwrap_near};
use crate::{NeedleError, error::check, error::check_finite};
use glam::DVec3;

/// A new rest length is at least this part of what linear interpolation gives, for Akima's curve need not increase.
const LEAST_PART_OF_LINEAR: f64 = 0.1;

/// Distances along a polyline from its node `start`, one per node from there on.
fn distances(position: &[DVec3], start: usize) -> Vec<f64> {
    let mut total = 0.0;
    let mut d = vec![0.0];
    for pair in position[start..].windows(2) {
        total += pair[0].distance(pair[1]);
        d.push(total);
    }
    d
}

fn midpoints(d: &[f64]) -> impl Iterator<Item = f64> {
    d.windows(2).map(|w| 0.5 * (w[0] + w[1]))
}

impl Rod {
    /// Replaces the nodes by others along the needle, `position` from base to tip (any number ≥ 3; the last one at the tip, the
    /// first two as they are where the base is held). Old nodes are told apart by their distance along the needle, new ones by
    /// theirs, scaled so that the tips agree. Rest lengths follow by Akima interpolation of their sum and material angles by
    /// Akima interpolation, velocities and accelerations linearly. The total rest length is conserved. Natural curvature is
    /// fixed to the material by its distance from the tip and needs no interpolation.
    ///
    /// Errors
    /// - [`NeedleError::Count`], [`NeedleError::NotFinite`], [`NeedleError::ShortEdge`], [`NeedleError::Folded`]
    /// - [`NeedleError::Parameter`] a held base that moves; the rod is as before after any error
    pub fn reparametrize(&mut self, position: Vec<DVec3>) -> Result<(), NeedleError> {
        let needed = if self.held.base && self.held.tip { 5 } else { 3 };
        if position.len() < needed {
            return Err(NeedleError::Count {
                what: "needle nodes",
                found: position.len(),
                expected: format!("at least {needed}"),
            });
        }
        check_finite("position", &position)?;
        let start = usize::from(self.held.base);
        if self.held.base {
            let moved = position[0]
                .distance(self.position[0])
                .max(position[1].distance(self.position[1]));
            check(
                moved <= 1e-9,
                "displacement of the sleeve's nodes, mm",
                moved,
                "at most 1e-9",
            )?;
        }
        let before = distances(&self.position, start);
        let mut after = distances(&position, start);
        let (old_total, new_total) = (before[before.len() - 1], after[after.len() - 1]);
        check(
            new_total > 0.0,
            "length of the new needle, mm",
            new_total,
            "a positive length",
        )?;
        after.iter_mut().for_each(|d| *d *= old_total / new_total);

        let mut new = self.clone();
        new.rest_length = self.rest_length[..start].to_vec();
        new.rest_length
            .extend(self.rest_lengths_at(&before, &after, start)?);
        let angles = self.angles_at(&before, &after, start)?;
        new.theta = self.theta[..start].iter().cloned().chain(angles).collect();
        if self.grip.len() == self.theta.len() {
            new.grip = nearest_edge(&self.grip, &before, &after, start);
        }
        new.spin = nearest_edge(&self.spin, &before, &after, start);
        let mut velocity = self.velocity[start..].to_vec();
        if self.held.base {
            // Needle leaves the mouth at the speed at which it is fed, although the mouth's node does not move with it.
            velocity[0] += self.feed_mm_per_s * self.geometry.tangent[0];
        }
        let at = |values: &[DVec3], own: &[DVec3]| -> Vec<DVec3> {
            let inside = after[start..].iter().map(|&d| linear(&before, values, d));
            own[..start]
                .iter()
                .cloned()
                .chain(own[start..2 * start].iter().cloned())
                .chain(inside)
                .collect()
        };
        new.velocity = at(&velocity, &self.velocity);
        new.acceleration = at(&self.acceleration[start..], &self.acceleration);
        new.position = position;
        new.refresh_geometry()?;
        new.director = new.geometry.bishop[0];
        if self.held.tip {
            let (old, last) = (self.frame(self.theta.len() - 1), new.theta.len() - 1);
            let tangent = new.geometry.tangent[last];
            let carried = transport(old.m1, old.tangent, tangent);
            let angle = angle_about(tangent, new.geometry.bishop[last], carried);
            new.theta[last] = unwrap_near(angle, new.theta[last]);
        }
        new.relax_twist(&[])?;
        *self = new;
        Ok(())
    }

    fn rest_lengths_at(&self, before: &[f64], after: &[f64], start: usize) -> Result<Vec<f64>, NeedleError> {
        let mut sum = vec![0.0];
        for l in &self.rest_length[start..] {
            sum.push(sum[sum.len() - 1] + l);
        }
        let total = sum[sum.len() - 1];
        let sums: Vec<DVec3> = sum.iter().map(|&s| DVec3::new(s, 0.0, 0.0)).collect();
        let akima = Akima::new(before.to_vec(), sum)?;
        let mut lengths: Vec<f64> = after
            .windows(2)
            .map(|w| {
                let by_line = linear(before, &sums, w[1]).x - linear(before, &sums, w[0]).x;
                (akima.value(w[1]) - akima.value(w[0])).max(LEAST_PART_OF_LINEAR * by_line)
            })
            .collect();
        let found: f64 = lengths.iter().sum();
        lengths.iter_mut().for_each(|l| *l *= total / found);
        Ok(lengths)
    }

    /// Material angles at the middles of the new edges. The base's angle holds at the mouth.
    fn angles_at(&self, before: &[f64], after: &[f64], start: usize) -> Result<Vec<f64>, NeedleError> {
        let (mut x, mut y): (Vec<f64>, Vec<f64>) = (Vec::new(), Vec::new());
        if start == 1 {
            x.push(0.0);
            y.push(self.theta[0]);
        }
        x.extend(midpoints(before));
        y.extend(&self.theta[start..]);
        let (low, high) = (x[0], x[x.len() - 1]);
        if x.len() < 2 {
            return Ok(vec![y[0]; after.len() - 1]);
        }
        let akima = Akima::new(x, y)?;
        Ok(midpoints(after)
            .map(|d| akima.value(d.clamp(low, high)))
            .collect())
    }
}

/// Per-edge values of the old edge in which the middle of each new edge lies; those in the sleeve stay.
fn nearest_edge(values: &[f64], before: &[f64], after: &[f64], start: usize) -> Vec<f64> {
    let pick = |d: f64| {
        let edge = before.partition_point(|b| *b <= d).clamp(1, before.len() - 1) - 1;
        values[start + edge]
    };
    values[..start]
        .iter()
        .cloned()
        .chain(midpoints(after).map(pick))
        .collect()
}
