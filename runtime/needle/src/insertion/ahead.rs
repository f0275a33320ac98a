//! Membranes that a tip comes to within a part: it stops at their face unless it is pushed with their force.

use super::system::Coupled;
use super::{Insertion, Needle};
use crate::stick_slip::{FrictionLimit, FrictionState, StickSlipSystem, solve_stick_slip};
use crate::{NeedleError, StickSlipOutcome, locate};

/// Places looked at along a tip's way in a part, at most.
const MOST_PLACES: usize = 64;
/// Halvings of the way between the last place before a membrane and the first one in it.
const BISECTIONS: usize = 8;

/// A membrane on a tip's way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Face {
    /// Which of the needle's membranes.
    pub membrane: usize,
    /// Slip that brings the tip just into it, mm.
    pub slip_mm: f64,
    /// Its cutting force, µN.
    pub cutting_un: f64,
}

impl Insertion {
    /// First membrane that cuts harder than `cutting_un` on the straight way of a needle's tip through `slip_mm` of the tissue as it is now.
    /// A way that is short beside the membranes' thickness does not pass one and is not looked at.
    pub(super) fn face_ahead(&self, needle: &Needle, slip_mm: f64, cutting_un: f64) -> Option<Face> {
        let membranes = &needle.friction.membranes;
        let thin = membranes.iter().fold(f64::INFINITY, |m, b| m.min(b.thickness_mm));
        let &node = needle.chain.last()?;
        if slip_mm <= 0.5 * thin || thin <= 0.0 {
            return None;
        }
        let strength = self.strength(needle, node);
        let (tip, along) = (needle.tip(), needle.rod.tip_frame().tangent);
        let mut hint = self.tissue.mesh().around(node).first().map_or(0, |e| e.tet);
        let mut toughest = |s: f64| -> Option<(usize, f64)> {
            let (slot, weights) = locate(&self.tissue, tip + along * s, hint)?;
            hint = slot;
            let tet = self.tissue.mesh().tet(slot)?;
            let u = self.state_in(tet, weights).rest;
            let mut most: Option<(usize, f64)> = None;
            for (k, (m, layer)) in membranes.iter().zip(&needle.layers).enumerate() {
                let cutting = m.cutting_un * strength;
                if cutting > most.map_or(cutting_un, |b| b.1)
                    && m.region.is_none_or(|r| r == tet.region)
                    && layer.holds(u, m.from_mm, m.from_mm + m.thickness_mm)
                {
                    most = Some((k, cutting));
                }
            }
            most
        };
        let places = ((slip_mm / (0.4 * thin)).ceil() as usize).clamp(1, MOST_PLACES);
        let mut before = 0.0;
        for k in 1..=places {
            let at = slip_mm * k as f64 / places as f64;
            let Some(mut found) = toughest(at) else {
                before = at;
                continue;
            };
            let mut inside = at;
            for _ in 0..BISECTIONS {
                let middle = 0.5 * (before + inside);
                match toughest(middle) {
                    Some(f) => (inside, found) = (middle, f),
                    None => before = middle,
                }
            }
            let (membrane, cutting_un) = found;
            return Some(Face {
                membrane,
                slip_mm: inside,
                cutting_un,
            });
        }
        None
    }

    /// Solves a part again where a tip has passed the face of a tough membrane: with the membrane's force where that is overcome within the
    /// part, else with as much of it as holds the tip at its face, from where the next part goes on. Slip is linear in the force while
    /// states are the same. Changes `limits` accordingly; returns the outcome and the membranes met, by needle.
    pub(super) fn meet_faces(
        &self,
        coupled: &mut Coupled,
        limits: &mut [FrictionLimit],
        mut outcome: StickSlipOutcome,
    ) -> Result<(StickSlipOutcome, Vec<(usize, usize)>), NeedleError> {
        let mut met = Vec::new();
        for (k, needle) in self.needles.iter().enumerate() {
            let tip = coupled.nodes.iter().rposition(|n| n.strand == k);
            let Some(tip) = tip.filter(|_| needle.beyond == 0) else {
                continue;
            };
            let (slip, own) = (coupled.slip_mm(tip), limits[tip].cutting_un);
            if outcome.states[tip] != FrictionState::Forward {
                continue;
            }
            let Some(face) = self.face_ahead(needle, slip, own) else {
                continue;
            };
            limits[tip].cutting_un = face.cutting_un;
            let params = &self.params.stick_slip;
            let mut again = solve_stick_slip(coupled, limits, &outcome.states, params)?;
            let (reached, force) = match again.states[tip] {
                FrictionState::Forward => (coupled.slip_mm(tip), face.cutting_un),
                _ => (0.0, -coupled.constraint_force_un(tip) - limits[tip].friction_un),
            };
            add(&mut outcome, &again);
            if reached < face.slip_mm {
                let share = ((slip - face.slip_mm) / (slip - reached)).clamp(0.0, 1.0);
                limits[tip].cutting_un = own + share * (force.clamp(own, face.cutting_un) - own);
                again = solve_stick_slip(coupled, limits, &outcome.states, params)?;
                add(&mut outcome, &again);
            }
            (outcome.states, outcome.consistent) = (again.states, again.consistent);
            met.push((k, face.membrane));
        }
        Ok((outcome, met))
    }
}

fn add(all: &mut StickSlipOutcome, again: &StickSlipOutcome) {
    all.trials += again.trials;
    all.iterations += again.iterations;
}
