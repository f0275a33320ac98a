//! First contact: the node where the needle enters.

use super::candidate::{Goal, Motion, Search, Site, best};
use super::edit::Change;
use super::locate::{blend, state_at};
use super::{Claims, Track, TrackParams, TrackReport, shifted};
use crate::NeedleError;
use crate::error::check_finite;
use glam::DVec3;
use palpate_fem::Simulation;
use std::collections::BTreeMap;

impl Track {
    /// Makes a node where the needle enters: the place of the tissue's surface nearest to a world point (mm). It is entry and tip at
    /// once; [`Track::advance`] goes on from there.
    ///
    /// The face there is split at the point, an edge of it split or a node of it moved to the point, or, where all those leave slivers,
    /// the point is shifted onto an edge or node of the face ([`TrackParams::shift_share`]).
    ///
    /// # Errors
    /// - [`NeedleError::Parameter`], [`NeedleError::NotFinite`]: parameters or point out of range
    /// - [`NeedleError::OutsideTissue`]: a mesh without surface, or nothing valid at that place
    pub fn puncture(
        sim: &mut Simulation,
        surface_point: DVec3,
        params: TrackParams,
    ) -> Result<Self, NeedleError> {
        Self::puncture_apart(sim, surface_point, params, Claims::default())
    }

    /// As [`Track::puncture`], leaving to other tracks what they claim ([`Track::claims`]).
    ///
    /// # Errors
    /// As [`Track::puncture`]; [`NeedleError::TrackConflict`] where only what another track needs could be changed.
    pub fn puncture_apart(
        sim: &mut Simulation,
        surface_point: DVec3,
        params: TrackParams,
        others: Claims,
    ) -> Result<Self, NeedleError> {
        params.check()?;
        check_finite("surface point", &[surface_point])?;
        let mut track = Self {
            params,
            chain: Vec::new(),
            stack: Vec::new(),
            originals: BTreeMap::new(),
            foreign: others,
            backs: false,
        };
        let refused = NeedleError::OutsideTissue {
            point: surface_point.to_array(),
        };
        let Some((face, weights)) = nearest(sim, surface_point) else {
            return Err(refused);
        };
        let hole = blend(sim, face, weights);
        let (change, blocked) = {
            let mut search = Search::new(sim, &track);
            let mut found = Vec::new();
            search.volume_change = track.params.puncture_volume_change;
            let mut sites = vec![Site::Face(face)];
            for k in 0..3 {
                sites.push(Site::Edge([face[k], face[(k + 1) % 3]]));
                sites.push(Site::Pulled(face[k]));
            }
            for site in sites {
                let goal = Goal {
                    site,
                    rest: hole.rest,
                };
                search.candidates(&goal, Motion::Forward, &mut found);
            }
            let fair = found
                .iter()
                .any(|c| c.weighed.worst() >= track.params.fair_quality);
            if !fair {
                for (site, rest, shift) in shifted(sim, face, weights) {
                    if shift <= track.params.shift_share || found.is_empty() {
                        search.candidates(&Goal { site, rest }, Motion::Forward, &mut found);
                    }
                }
            }
            let blocked = search.blocked;
            (best(sim, found, None, track.params.tend_below), blocked)
        };
        let Some(change) = change else {
            return Err(match blocked {
                Some(node) => NeedleError::TrackConflict { node },
                None => refused,
            });
        };
        let rest = change.overlay.rest(change.tip);
        let state = state_at(sim, rest, face[0]).ok_or(refused)?;
        let change = Change::from(change);
        track.commit(sim, change, state, &mut TrackReport::default())?;
        Ok(track)
    }
}

/// Boundary face nearest to a world point and the nearest point's weights on it.
fn nearest(sim: &Simulation, point: DVec3) -> Option<([u32; 3], [f64; 3])> {
    let mut best: Option<(f64, [u32; 3], [f64; 3])> = None;
    for face in sim.mesh().boundary() {
        let x = face.map(|n| sim.positions()[n as usize]);
        let weights = nearest_on(x, point);
        let near: DVec3 = (0..3).map(|k| x[k] * weights[k]).sum();
        let distance = near.distance_squared(point);
        if best.is_none_or(|b| distance < b.0) {
            best = Some((distance, face, weights));
        }
    }
    best.map(|(_, face, weights)| (face, weights))
}

/// Weights of the point of a triangle that is nearest to `p`.
fn nearest_on(x: [DVec3; 3], p: DVec3) -> [f64; 3] {
    let (u, v) = (x[1] - x[0], x[2] - x[0]);
    let normal = u.cross(v);
    let area = normal.length_squared();
    if area > 0.0 {
        let w = p - x[0];
        let b = w.cross(v).dot(normal) / area;
        let c = u.cross(w).dot(normal) / area;
        if b >= 0.0 && c >= 0.0 && b + c <= 1.0 {
            return [1.0 - b - c, b, c];
        }
    }
    let mut best = (f64::INFINITY, [1.0, 0.0, 0.0]);
    for k in 0..3 {
        let (i, j) = (k, (k + 1) % 3);
        let along = x[j] - x[i];
        let length = along.length_squared();
        let s = if length > 0.0 {
            ((p - x[i]).dot(along) / length).clamp(0.0, 1.0)
        } else {
            0.0
        };
        let distance = (x[i] + along * s).distance_squared(p);
        if distance < best.0 {
            let mut weights = [0.0; 3];
            (weights[i], weights[j]) = (1.0 - s, s);
            best = (distance, weights);
        }
    }
    best.1
}
