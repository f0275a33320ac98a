//! Which coupling nodes stick and which slide: the friction states of one step (Chentanez et al. 2009, §3.3 and §3.6.1,
//! Algorithm 3), over whatever solves the coupled system for given states.

use crate::{NeedleError, error::check};
use serde::{Deserialize, Serialize};

/// State of a node that needle and tissue share. Nodes outside the tissue (the paper's FREE) take no part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash)]
pub enum FrictionState {
    /// Needle and tissue move together.
    #[default]
    Static,
    /// The needle slides forward through the tissue (DYNAMIC+).
    Forward,
    /// The needle slides back (DYNAMIC−).
    Backward,
}

impl FrictionState {
    /// +1 forward, −1 backward, 0 static.
    pub fn sign(self) -> f64 {
        match self {
            Self::Static => 0.0,
            Self::Forward => 1.0,
            Self::Backward => -1.0,
        }
    }

    /// The state after this one in the order static, forward, backward; `None` after the last.
    fn next(self) -> Option<Self> {
        match self {
            Self::Static => Some(Self::Forward),
            Self::Forward => Some(Self::Backward),
            Self::Backward => None,
        }
    }
}

/// What a node can hold before it slides.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FrictionLimit {
    /// Friction of the shaft, either way, µN: friction per length times the node's length.
    pub friction_un: f64,
    /// Cutting force on top of it where the needle advances, µN; only the tip cuts.
    pub cutting_un: f64,
}

impl FrictionLimit {
    /// Known tangential force of a sliding node on the tissue (d of Eq. 7), µN; 0 for a static one.
    pub fn drag_un(&self, state: FrictionState) -> f64 {
        match state {
            FrictionState::Static => 0.0,
            FrictionState::Forward => self.friction_un + self.cutting_un,
            FrictionState::Backward => -self.friction_un,
        }
    }
}

/// The coupled system, able to be solved for given states. Tangents point from base to tip.
pub trait StickSlipSystem {
    /// Why it could not be solved.
    type Error;

    /// Forgets the last solution: the next one starts from 0.
    fn clear(&mut self);

    /// Solves Eq. 7 from the last solution to the relative residual `tolerance`. `drag_un` is the known force of sliding nodes on the
    /// tissue along the tangent, 0 for static ones. Returns the iterations spent.
    fn solve(
        &mut self,
        states: &[FrictionState],
        drag_un: &[f64],
        tolerance: f64,
    ) -> Result<usize, Self::Error>;

    /// Tangential constraint force on the needle at a static node (c_t of Eq. 7), µN: negative while the tissue holds the needle back.
    fn constraint_force_un(&self, node: usize) -> f64;

    /// How far the needle moves forward relative to the tissue at a node in this step, mm (needle less tissue: printed Eq. 11
    /// has the opposite order, with which no sliding state could ever be kept).
    fn slip_mm(&self, node: usize) -> f64;
}

/// Settings of [`solve_stick_slip`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StickSlipParams {
    /// Relative residual at which the states are checked first. Default 1e-3, the paper's.
    pub check_tolerance: f64,
    /// Relative residual of the final solution. Default 1e-5, the paper's.
    pub solution_tolerance: f64,
    /// Trials at most; the last is accepted as it is. Default 10, the paper's.
    pub max_trials: usize,
    /// Violation of a force limit that counts in the final check, relative to the largest limit. Default 1e-3: the final residual is
    /// relative to all forces of the tissue, and below that part of a node's limit a needle at rest changes states by rounding.
    pub force_tolerance: f64,
    /// Slip the wrong way that counts in the final check, mm. Default 1e-5 (0.5 µm/s in steps of 20 ms).
    pub slip_tolerance_mm: f64,
}

impl Default for StickSlipParams {
    fn default() -> Self {
        Self {
            check_tolerance: 1e-3,
            solution_tolerance: 1e-5,
            max_trials: 10,
            force_tolerance: 1e-3,
            slip_tolerance_mm: 1e-5,
        }
    }
}

impl StickSlipParams {
    /// Checks every field.
    ///
    /// Errors
    /// - [`NeedleError::Parameter`]
    pub fn validate(&self) -> Result<(), NeedleError> {
        for (name, value) in [
            ("check_tolerance", self.check_tolerance),
            ("solution_tolerance", self.solution_tolerance),
            ("force_tolerance", self.force_tolerance),
            ("slip_tolerance_mm", self.slip_tolerance_mm),
        ] {
            check(value > 0.0 && value.is_finite(), name, value, "a positive number")?;
        }
        check(
            self.max_trials >= 1,
            "max_trials",
            self.max_trials as f64,
            "at least 1",
        )
    }
}

/// What a residual can make of a constraint force, which gathers that of many nodes. States that a loose solution rejects wrongly are
/// never tried again: with 1 some reversals went round in circles.
const LOOSE: f64 = 10.0;

/// Result of [`solve_stick_slip`]; the solution is in the system.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StickSlipOutcome {
    /// States of the solution.
    pub states: Vec<FrictionState>,
    /// States tried.
    pub trials: usize,
    /// Whether the solution keeps every limit; else the last trial was accepted.
    pub consistent: bool,
    /// Iterations of the linear solver, all trials.
    pub iterations: usize,
}

/// Finds states that agree with the solution they lead to.
///
/// No states are judged twice by rough forces (`check_tolerance`), nor twice by exact ones. Rough forces may reject the right states; once they have led
/// in a circle all further trials are exact.
///
/// `limits` and `guess` have one entry per coupling node, from where the needle enters to the tip; `guess` is best the states
/// of the step before ([`carry_states`]).
///
/// Errors
/// - the system's own, and [`NeedleError`] (through `From`) for settings, limits and counts that make no sense
pub fn solve_stick_slip<S: StickSlipSystem>(
    system: &mut S,
    limits: &[FrictionLimit],
    guess: &[FrictionState],
    params: &StickSlipParams,
) -> Result<StickSlipOutcome, S::Error>
where
    S::Error: From<NeedleError>,
{
    params.validate()?;
    if guess.len() != limits.len() {
        let expected = format!("{}, one per coupling node", limits.len());
        return Err(NeedleError::Count {
            what: "friction states",
            found: guess.len(),
            expected,
        }
        .into());
    }
    for limit in limits {
        for (name, value) in [
            ("friction_un", limit.friction_un),
            ("cutting_un", limit.cutting_un),
        ] {
            check(
                value >= 0.0 && value.is_finite(),
                name,
                value,
                "a force of at least 0",
            )?;
        }
    }
    system.clear();
    let mut states = guess.to_vec();
    let mut tried: Vec<Vec<FrictionState>> = vec![];
    let (mut iterations, mut trials) = (0, 0);
    // Whether loose solutions have led in a circle.
    let mut strict = false;
    loop {
        tried.push(states.clone());
        trials += 1;
        let drag: Vec<f64> = limits.iter().zip(&states).map(|(l, &s)| l.drag_un(s)).collect();
        let last = trials == params.max_trials;
        // A violation that the residual left could explain does not count yet.
        let mut violated = vec![];
        if !last && !strict {
            iterations += system.solve(&states, &drag, params.check_tolerance)?;
            violated = violations(system, limits, &states, params, LOOSE * params.check_tolerance);
        }
        if violated.is_empty() {
            iterations += system.solve(&states, &drag, params.solution_tolerance)?;
            violated = violations(system, limits, &states, params, 0.0);
        }
        let mut next = None;
        if !violated.is_empty() && !last {
            let mut changed = changed_states(system, &states, &violated);
            if tried.contains(&changed) && !strict {
                // What was tried was judged by rough forces, which may reject the right states: these and the next ones exactly.
                strict = true;
                tried = vec![states.clone()];
                iterations += system.solve(&states, &drag, params.solution_tolerance)?;
                violated = violations(system, limits, &states, params, 0.0);
                changed = changed_states(system, &states, &violated);
            }
            if !violated.is_empty() {
                next = match tried.contains(&changed) {
                    false => Some(changed),
                    true => untried_after(changed, &tried),
                };
            }
        }
        match next {
            Some(next) => states = next,
            None => {
                if !violated.is_empty() && !last {
                    // Nothing is left to try; the states at hand may only be solved roughly.
                    iterations += system.solve(&states, &drag, params.solution_tolerance)?;
                }
                return Ok(StickSlipOutcome {
                    states,
                    trials,
                    consistent: violated.is_empty(),
                    iterations,
                });
            }
        }
    }
}

/// Nodes whose solution contradicts their state (Eqs. 9–11), violations up to the part `slack` of the largest quantity aside.
fn violations<S: StickSlipSystem>(
    system: &S,
    limits: &[FrictionLimit],
    states: &[FrictionState],
    params: &StickSlipParams,
    slack: f64,
) -> Vec<usize> {
    let largest_limit = limits
        .iter()
        .fold(0.0, |m: f64, l| m.max(l.friction_un + l.cutting_un));
    let largest_slip = (0..states.len()).fold(0.0, |m: f64, i| match states[i] {
        FrictionState::Static => m,
        _ => m.max(system.slip_mm(i).abs()),
    });
    let force_slack = largest_limit * params.force_tolerance.max(slack);
    let slip_slack = params.slip_tolerance_mm.max(slack * largest_slip);
    (0..states.len())
        .filter(|&i| match states[i] {
            FrictionState::Static => {
                let c = system.constraint_force_un(i);
                let forward = limits[i].friction_un + limits[i].cutting_un;
                !(c >= -forward - force_slack && c <= limits[i].friction_un + force_slack)
            }
            state => {
                let forward = state.sign() * system.slip_mm(i);
                forward.is_nan() || forward < -slip_slack
            }
        })
        .collect()
}

/// The paper's changes.
fn changed_states<S: StickSlipSystem>(
    system: &S,
    states: &[FrictionState],
    violated: &[usize],
) -> Vec<FrictionState> {
    let mut next = states.to_vec();
    for &i in violated {
        next[i] = match states[i] {
            FrictionState::Static if system.constraint_force_un(i) > 0.0 => FrictionState::Backward,
            FrictionState::Static => FrictionState::Forward,
            _ => FrictionState::Static,
        };
    }
    next
}

/// The next untried states in lexicographic order with the first node (where the needle enters) as the least digit; `None` when all
/// have been tried.
fn untried_after(mut next: Vec<FrictionState>, tried: &[Vec<FrictionState>]) -> Option<Vec<FrictionState>> {
    // As many steps as were tried and one more must meet an untried one, if there is any.
    for _ in 0..=tried.len() {
        for state in next.iter_mut() {
            match state.next() {
                Some(up) => {
                    *state = up;
                    break;
                }
                None => *state = FrictionState::Static,
            }
        }
        if !tried.contains(&next) {
            return Some(next);
        }
    }
    None
}

/// First guess: the state of the nearest node of the step before, by arc length from the base (`before`: arc lengths, increasing,
/// and states). With nothing before, the needle has just touched the tissue and cuts: forward.
pub fn carry_states(before: &[(f64, FrictionState)], now_mm: &[f64]) -> Vec<FrictionState> {
    now_mm
        .iter()
        .map(|&s| {
            let nearest = before
                .iter()
                .min_by(|a, b| (a.0 - s).abs().total_cmp(&(b.0 - s).abs()));
            nearest.map_or(FrictionState::Forward, |n| n.1)
        })
        .collect()
}

#[cfg(test)]
mod judge;
#[cfg(test)]
mod tests;
