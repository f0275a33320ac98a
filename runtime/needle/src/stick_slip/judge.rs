//! Small dense friction problems, solved exactly.

use crate::stick_slip::{FrictionLimit, FrictionState};

/// Changes of all violated nodes at once that may fail to lessen the violations before nodes change one at a time.
const PATIENCE: u32 = 5;

/// States of nodes whose slips are `free − answer · d`, with −friction ≤ d ≤ friction + cutting the forces of the needle on the tissue: d at a
/// bound where the node slides, no slip where it lies between. `answer` (mm/µN, row by row) is symmetric and positive definite, so there is exactly
/// one solution; block pivoting finds it (Júdice and Pires 1994): violated nodes change all at once, and one at a time where that
/// goes round in circles, which always ends. `None` where rounding keeps it from that.
pub(super) fn solve_boxed(
    answer: &[Vec<f64>],
    free_mm: &[f64],
    limits: &[FrictionLimit],
    guess: &[FrictionState],
) -> Option<Vec<FrictionState>> {
    let mut states = guess.to_vec();
    let (mut fewest, mut patience) = (usize::MAX, PATIENCE);
    let size = free_mm.iter().fold(0.0, |m: f64, s| m.max(s.abs()));
    for _ in 0..(20 + 10 * states.len()) {
        let violated = changes(answer, free_mm, limits, &states, 1e-12 * size)?;
        if violated.is_empty() {
            return Some(states);
        }
        if violated.len() < fewest {
            (fewest, patience) = (violated.len(), PATIENCE);
        } else {
            patience = patience.saturating_sub(1);
        }
        // One at a time, always the last: finite for such a matrix (Murty 1974).
        let from = if patience > 0 { 0 } else { violated.len() - 1 };
        for &(i, s) in &violated[from..] {
            states[i] = s;
        }
    }
    None
}

/// Nodes whose state the solution for `states` contradicts, with the states that it asks for.
fn changes(
    answer: &[Vec<f64>],
    free_mm: &[f64],
    limits: &[FrictionLimit],
    states: &[FrictionState],
    slack_mm: f64,
) -> Option<Vec<(usize, FrictionState)>> {
    let n = states.len();
    let mut force: Vec<f64> = limits.iter().zip(states).map(|(l, &s)| l.drag_un(s)).collect();
    let stuck: Vec<usize> = (0..n).filter(|&i| states[i] == FrictionState::Static).collect();
    let slip = |force: &[f64], i: usize| -> f64 {
        free_mm[i] - answer[i].iter().zip(force).map(|(g, d)| g * d).sum::<f64>()
    };
    let right: Vec<f64> = stuck.iter().map(|&i| slip(&force, i)).collect();
    let held = cholesky(&stuck, answer, right)?;
    for (&i, d) in stuck.iter().zip(held) {
        force[i] = d;
    }
    let mut found = Vec::new();
    for i in 0..n {
        let (up, down) = (limits[i].drag_un(FrictionState::Forward), -limits[i].friction_un);
        let slack = 1e-12 * (up - down);
        match states[i] {
            FrictionState::Static if force[i] > up + slack => found.push((i, FrictionState::Forward)),
            FrictionState::Static if force[i] < down - slack => found.push((i, FrictionState::Backward)),
            FrictionState::Static => {}
            s => {
                if s.sign() * slip(&force, i) < -slack_mm {
                    found.push((i, FrictionState::Static));
                }
            }
        }
    }
    Some(found)
}

/// Solution of the rows and columns `of` of a symmetric positive definite matrix.
fn cholesky(of: &[usize], matrix: &[Vec<f64>], mut x: Vec<f64>) -> Option<Vec<f64>> {
    let n = of.len();
    let mut l = vec![vec![0.0; n]; n];
    for i in 0..n {
        for j in 0..=i {
            let sum: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
            let rest = matrix[of[i]][of[j]] - sum;
            if i == j {
                if !(rest > 0.0 && rest.is_finite()) {
                    return None;
                }
                l[i][i] = rest.sqrt();
            } else {
                l[i][j] = rest / l[j][j];
            }
        }
        let sum: f64 = (0..i).map(|k| l[i][k] * x[k]).sum();
        x[i] = (x[i] - sum) / l[i][i];
    }
    for i in (0..n).rev() {
        let sum: f64 = (i + 1..n).map(|k| l[k][i] * x[k]).sum();
        x[i] = (x[i] - sum) / l[i][i];
    }
    Some(x)
}
