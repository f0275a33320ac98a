//! Rest shapes that sag into the shape of the scan.

use crate::{ClusterFrame, Collider, PbdError, Scene, Settings, SoftBody, Solver};
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// How the unloaded shape is looked for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct UnloadParams {
    /// Corrections of the rest shape, at most. Each takes away two thirds or more of what is left; 6.
    pub rounds: u32,
    /// Steps that the bodies get to settle after each. With Table 1's drag 40 steps (0.67 s) are eight time constants.
    pub steps: u32,
    /// Mean distance from the scan at which the search ends, mm: a twentieth of a voxel, 0.05.
    pub enough_mm: f64,
}

impl Default for UnloadParams {
    fn default() -> Self {
        Self {
            rounds: 6,
            steps: 40,
            enough_mm: 0.05,
        }
    }
}

/// What [`unload`] found.
#[derive(Clone, Debug, PartialEq)]
pub struct Unloaded {
    /// Frames of each body's clusters in equilibrium, for [`crate::SkinnedPoints::tie_to`].
    pub frames: Vec<Vec<ClusterFrame>>,
    /// Distance of the particles from where the scan has them after settling, mean and largest, mm: before the search.
    pub sag_mm: [f64; 2],
    /// The same with the shapes found.
    pub left_mm: [f64; 2],
    /// Corrections made.
    pub rounds: u32,
}

/// Gives the clusters of all bodies rest shapes with which the bodies, as they are placed, are in equilibrium with gravity
/// and the colliders. A scan shows the organ under its own weight; taken as the shape without weight it would sag a second
/// time. The solver itself is the forward model: rest shapes are moved by what the settled particles are off, until they
/// settle where the scan has them (the backward displacement method, Bols et al. 2013). Bodies start as they settled.
/// `watch` hears how many solver steps are done, of how many at most.
///
/// # Errors
/// As [`Solver::new`].
pub fn unload(
    bodies: &mut [SoftBody],
    colliders: &[Collider],
    settings: &Settings,
    params: &UnloadParams,
    threads: usize,
    mut watch: impl FnMut(u64, u64),
) -> Result<Unloaded, PbdError> {
    let all = (u64::from(params.rounds) + 1) * u64::from(params.steps);
    let mut done = 0;
    let mut shapes: Vec<Vec<Vec3>> = bodies
        .iter()
        .map(|b| b.positions.iter().map(|&p| p.into()).collect())
        .collect();
    let mut best: Option<(Vec<SoftBody>, Unloaded)> = None;
    let mut sag = [0.0; 2];
    for round in 0..=params.rounds {
        let scene = Scene::new(bodies.to_vec(), colliders.to_vec());
        let mut solver = Solver::with_threads(scene, settings.clone(), threads)?;
        for _ in 0..params.steps {
            solver.step();
            done += 1;
            watch(done, all);
        }
        let (mut sum, mut most, mut count) = (0.0f64, 0.0f64, 0usize);
        for ((body, shape), info) in bodies.iter_mut().zip(&mut shapes).zip(solver.bodies()) {
            let settled = &solver.positions()[info.particles.clone()];
            let placement = body.placement;
            for ((x, at), want) in shape.iter_mut().zip(settled).zip(&body.positions) {
                let off = Vec3::from(*want) - placement.unapply(Vec3::from(*at));
                let length = f64::from(off.length());
                sum += length;
                most = most.max(length);
                count += 1;
                *x += off;
            }
            if round > 0 {
                let back = settled.iter().map(|&p| placement.unapply(p.into()).to_array());
                body.start = Some(back.collect());
            }
        }
        let left = [sum / count.max(1) as f64, most];
        if round == 0 {
            sag = left;
        }
        let better = best.as_ref().is_none_or(|b| left[0] < b.1.left_mm[0]);
        if better {
            let frames = solver
                .bodies()
                .iter()
                .map(|b| solver.frames()[b.clusters.clone()].to_vec())
                .collect();
            let found = Unloaded {
                frames,
                sag_mm: sag,
                left_mm: left,
                rounds: round,
            };
            best = Some((bodies.to_vec(), found));
        }
        // A body that nothing holds only moves away.
        if !better || left[0] <= params.enough_mm {
            break;
        }
        for (body, shape) in bodies.iter_mut().zip(&shapes) {
            body.set_shape(shape);
        }
    }
    match best {
        Some((found, out)) => {
            bodies.clone_from_slice(&found);
            Ok(out)
        }
        None => Ok(Unloaded {
            frames: Vec::new(),
            sag_mm: sag,
            left_mm: sag,
            rounds: 0,
        }),
    }
}

impl SoftBody {
    /// Matches clusters with this shape of the body instead of the one it starts in.
    fn set_shape(&mut self, shape: &[Vec3]) {
        let (offsets, members) = (&self.offsets, &self.members);
        let rows: Vec<Vec<[f32; 3]>> = offsets
            .par_windows(2)
            .map(|row| {
                let of = &members[row[0] as usize..row[1] as usize];
                let mean = of
                    .iter()
                    .map(|&m| shape[m as usize].as_dvec3())
                    .sum::<glam::DVec3>()
                    / of.len() as f64;
                of.iter()
                    .map(|&m| (shape[m as usize].as_dvec3() - mean).as_vec3().to_array())
                    .collect()
            })
            .collect();
        self.local = rows.concat();
    }
}
