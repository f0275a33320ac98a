//! States on small systems along one line, judged by trying all of them.

use super::*;
use FrictionState::{Backward, Forward, Static};

const DT: f64 = 0.02;

/// Needle and tissue nodes on a line, dense matrices. Units as they come.
#[derive(Clone)]
struct Line {
    tissue: Vec<Vec<f64>>,
    needle: Vec<Vec<f64>>,
    tissue_rhs: Vec<f64>,
    needle_rhs: Vec<f64>,
    /// Right side of the sticking rows, `e` of Eq. 7.
    e: Vec<f64>,
    /// Relative motion of the step apart from the new accelerations (needle less tissue).
    drift: Vec<f64>,
    solution: Vec<f64>,
    /// As an iterative solver would: stops when the error has fallen to the tolerance.
    loose: bool,
}

impl Line {
    fn exact(&self, states: &[FrictionState], drag: &[f64]) -> Vec<f64> {
        let q = states.len();
        let mut a = vec![vec![0.0; 3 * q + 1]; 3 * q];
        for i in 0..q {
            for j in 0..q {
                a[i][j] = self.tissue[i][j];
                a[q + i][q + j] = self.needle[i][j];
            }
            a[i][3 * q] = self.tissue_rhs[i] + drag[i];
            a[q + i][3 * q] = self.needle_rhs[i] - drag[i];
            if states[i] == Static {
                a[i][2 * q + i] = 1.0;
                a[q + i][2 * q + i] = -1.0;
                a[2 * q + i][i] = 1.0;
                a[2 * q + i][q + i] = -1.0;
                a[2 * q + i][3 * q] = self.e[i];
            } else {
                a[2 * q + i][2 * q + i] = 1.0;
            }
        }
        gauss(a)
    }

    fn is_consistent(&mut self, limits: &[FrictionLimit], states: &[FrictionState]) -> bool {
        let drag: Vec<f64> = limits.iter().zip(states).map(|(l, &s)| l.drag_un(s)).collect();
        self.solution = self.exact(states, &drag);
        violations(self, limits, states, &sharp(), 0.0).is_empty()
    }
}

/// Tolerances far below the size of anything in the random systems, so that border cases do not count twice.
fn sharp() -> StickSlipParams {
    StickSlipParams {
        solution_tolerance: 1e-11,
        force_tolerance: 1e-9,
        slip_tolerance_mm: 1e-12,
        ..Default::default()
    }
}

/// Gauss with row exchanges on rows `[A | b]`.
fn gauss(mut a: Vec<Vec<f64>>) -> Vec<f64> {
    let n = a.len();
    for k in 0..n {
        let p = (k..n)
            .max_by(|&i, &j| a[i][k].abs().total_cmp(&a[j][k].abs()))
            .unwrap();
        a.swap(k, p);
        for i in k + 1..n {
            let f = a[i][k] / a[k][k];
            for j in k..=n {
                a[i][j] -= f * a[k][j];
            }
        }
    }
    let mut x = vec![0.0; n];
    for i in (0..n).rev() {
        x[i] = (a[i][n] - (i + 1..n).map(|j| a[i][j] * x[j]).sum::<f64>()) / a[i][i];
    }
    x
}

impl StickSlipSystem for Line {
    type Error = NeedleError;

    fn clear(&mut self) {
        self.solution = vec![0.0; 3 * self.e.len()];
    }

    fn solve(
        &mut self,
        states: &[FrictionState],
        drag: &[f64],
        tolerance: f64,
    ) -> Result<usize, NeedleError> {
        let exact = self.exact(states, drag);
        if !self.loose {
            self.solution = exact;
            return Ok(1);
        }
        let size = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
        let error = |s: &[f64]| size(&s.iter().zip(&exact).map(|(a, b)| a - b).collect::<Vec<_>>());
        let mut iterations = 0;
        while error(&self.solution) > tolerance * size(&exact) {
            self.solution
                .iter_mut()
                .zip(&exact)
                .for_each(|(s, x)| *s = x + 0.7 * (*s - x));
            iterations += 1;
        }
        Ok(iterations)
    }

    fn constraint_force_un(&self, node: usize) -> f64 {
        self.solution[2 * self.e.len() + node]
    }

    fn slip_mm(&self, node: usize) -> f64 {
        let q = self.e.len();
        self.drift[node] + 0.25 * DT * DT * (self.solution[q + node] - self.solution[node])
    }
}

fn one(push: f64) -> Line {
    Line {
        tissue: vec![vec![0.03]],
        needle: vec![vec![0.001]],
        tissue_rhs: vec![0.0],
        needle_rhs: vec![push],
        e: vec![0.0],
        drift: vec![0.0],
        solution: vec![],
        loose: false,
    }
}

/// needle.md §4, in SI: pushed by 1 N and pulled by 0.5 N, friction 0.1 N, cutting 0.5 N.
#[test]
fn printed_example() {
    let limits = [FrictionLimit {
        friction_un: 0.1,
        cutting_un: 0.5,
    }];
    let params = StickSlipParams::default();
    let mut line = one(1.0);
    line.is_consistent(&limits, &[Static]);
    assert!(
        (line.solution[0] - 32.258065).abs() < 1e-6 && (line.constraint_force_un(0) + 0.967742).abs() < 1e-6
    );
    let outcome = solve_stick_slip(&mut line, &limits, &[Static], &params).unwrap();
    assert_eq!(
        (outcome.states, outcome.trials, outcome.consistent),
        (vec![Forward], 2, true)
    );
    assert!((line.solution[0] - 20.0).abs() < 1e-9 && (line.solution[1] - 400.0).abs() < 1e-9);
    assert!((line.slip_mm(0) - 0.038).abs() < 1e-9);

    let mut line = one(-0.5);
    line.is_consistent(&limits, &[Static]);
    assert!((line.constraint_force_un(0) - 0.483871).abs() < 1e-6);
    let outcome = solve_stick_slip(&mut line, &limits, &[Forward], &params).unwrap();
    assert_eq!(
        (outcome.states, outcome.trials, outcome.consistent),
        (vec![Backward], 3, true)
    );
    assert!((line.solution[0] + 3.3333333).abs() < 1e-6 && (line.solution[1] + 400.0).abs() < 1e-9);
    assert!((line.slip_mm(0) + 0.039667).abs() < 1e-6);

    // A push below friction and cutting sticks; the same pull would not.
    for (push, state) in [(0.55, Static), (-0.55, Backward)] {
        let outcome = solve_stick_slip(&mut one(push), &limits, &[Static], &params).unwrap();
        assert_eq!(outcome.states, [state]);
    }
}

struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64 * 2.0 - 1.0
    }

    /// Chain of springs between neighbours and to the ground, with masses; as `A` of Newmark's method.
    fn chain(&mut self, q: usize, mass: f64, neighbour: f64, ground: f64) -> Vec<Vec<f64>> {
        let mut a = vec![vec![0.0; q]; q];
        for i in 0..q {
            a[i][i] += mass * (1.5 + self.next()) + ground * (1.2 + self.next());
            if i > 0 {
                let k = neighbour * (1.2 + self.next());
                a[i][i] += k;
                a[i - 1][i - 1] += k;
                a[i][i - 1] -= k;
                a[i - 1][i] -= k;
            }
        }
        a
    }

    /// Needle of `q` nodes in tissue, pushed and moving at random.
    fn line(&mut self, q: usize) -> (Line, Vec<FrictionLimit>) {
        let e: Vec<f64> = (0..q).map(|_| 0.5 * self.next()).collect();
        let line = Line {
            tissue: self.chain(q, 1.0, 0.5, 0.2),
            needle: self.chain(q, 0.1, 3.0, 0.0),
            tissue_rhs: (0..q).map(|_| self.next()).collect(),
            needle_rhs: (0..q).map(|_| 2.0 * self.next()).collect(),
            drift: e.iter().map(|e| 0.25 * DT * DT * e).collect(),
            e,
            solution: vec![],
            loose: false,
        };
        let limits = (0..q)
            .map(|i| FrictionLimit {
                friction_un: 0.4 + 0.3 * self.next(),
                cutting_un: if i + 1 == q { 0.5 } else { 0.0 },
            })
            .collect();
        (line, limits)
    }
}

fn decode(mut code: usize, q: usize) -> Vec<FrictionState> {
    (0..q)
        .map(|_| {
            let state = [Static, Forward, Backward][code % 3];
            code /= 3;
            state
        })
        .collect()
}

/// Bounds of friction are known, so the forces solve a linear complementarity problem with a positive definite matrix: exactly
/// one choice of states is consistent, and with trials enough it is found, from a poor guess too.
#[test]
fn agrees_with_trying_everything() {
    let mut random = Random(7);
    let (mut within_ten, cases) = (0, 600);
    for case in 0..cases {
        let q = 2 + case % 4;
        let (mut line, limits) = random.line(q);
        line.loose = case % 2 == 0;
        let all: Vec<_> = (0..3usize.pow(q as u32)).map(|c| decode(c, q)).collect();
        let consistent: Vec<_> = all.iter().filter(|s| line.is_consistent(&limits, s)).collect();
        assert_eq!(consistent.len(), 1, "case {case}: {consistent:?}");
        let guess = decode((case * 31) % 3usize.pow(q as u32), q);
        let enough = StickSlipParams {
            max_trials: 1000,
            ..sharp()
        };
        let outcome = solve_stick_slip(&mut line, &limits, &guess, &enough).unwrap();
        assert!(outcome.consistent, "case {case}: {outcome:?}");
        assert_eq!(&outcome.states, consistent[0], "case {case}");
        within_ten += usize::from(outcome.trials <= 10);
    }
    assert!(within_ten * 100 >= 99 * cases, "{within_ten} of {cases}");
}

/// Reversal: every one of 25 nodes guessed to slide one way, the needle pushed or pulled at random; from a soft needle to one a
/// million times as stiff as the tissue. Ten trials suffice.
#[test]
fn reversal_settles_within_ten_trials() {
    let mut random = Random(5);
    for neighbour in [3.0, 300.0, 3e5] {
        for case in 0..100 {
            let q = 25;
            let (mut line, limits) = random.line(q);
            line.needle = random.chain(q, 0.1, neighbour, 0.0);
            line.needle_rhs.fill(0.0);
            line.needle_rhs[0] = 25.0 * random.next();
            let guess = vec![if case % 2 == 0 { Forward } else { Backward }; q];
            let outcome = solve_stick_slip(&mut line, &limits, &guess, &sharp()).unwrap();
            assert!(
                outcome.consistent && outcome.trials <= 10,
                "{neighbour} {case}: {outcome:?}"
            );
        }
    }
}

/// A 25 nodes long needle against the exact solution of its complementarity problem by block pivoting, which the trials reach within ten.
#[test]
fn agrees_with_block_pivoting() {
    let mut random = Random(23);
    let q = 25;
    for (case, neighbour) in (0..120).zip([3.0, 300.0, 3e4].into_iter().cycle()) {
        let (mut line, limits) = random.line(q);
        line.needle = random.chain(q, 0.1, neighbour, 0.0);
        line.needle_rhs[0] = 25.0 * random.next();
        let sliding = vec![Forward; q];
        let mut slips = |drag: &[f64]| -> Vec<f64> {
            line.solution = line.exact(&sliding, drag);
            (0..q).map(|i| line.slip_mm(i)).collect()
        };
        let free = slips(&vec![0.0; q]);
        let mut answer = vec![vec![0.0; q]; q];
        for j in 0..q {
            let unit: Vec<f64> = (0..q).map(|i| f64::from(u8::from(i == j))).collect();
            for (i, s) in slips(&unit).into_iter().enumerate() {
                answer[i][j] = free[i] - s;
            }
        }
        let guess = [Forward, Backward, Static][case % 3];
        let exact = judge::solve_boxed(&answer, &free, &limits, &vec![guess; q]).unwrap();
        assert!(line.is_consistent(&limits, &exact), "{case}");
        let outcome = solve_stick_slip(&mut line, &limits, &vec![guess; q], &sharp()).unwrap();
        assert!(outcome.consistent && outcome.trials <= 10, "{case}: {outcome:?}");
        assert_eq!(outcome.states, exact, "{case}");
    }
}

/// What is left of a violation at rest, below a thousandth of the friction and far below what a needle moves in a step, changes no state.
#[test]
fn noise_changes_no_state() {
    struct Still(f64);
    impl StickSlipSystem for Still {
        type Error = NeedleError;
        fn clear(&mut self) {}
        fn solve(&mut self, _: &[FrictionState], _: &[f64], _: f64) -> Result<usize, NeedleError> {
            Ok(0)
        }
        fn constraint_force_un(&self, _: usize) -> f64 {
            -1e4 * (1.0 + self.0)
        }
        fn slip_mm(&self, _: usize) -> f64 {
            -self.0 * 1e-2
        }
    }
    let limits = [FrictionLimit {
        friction_un: 1e4,
        cutting_un: 0.0,
    }; 2];
    let params = StickSlipParams::default();
    for (part, trials) in [(5e-4, 1), (2e-3, 2)] {
        let guess = [Static, Forward];
        let outcome = solve_stick_slip(&mut Still(part), &limits, &guess, &params).unwrap();
        assert_eq!(outcome.trials.min(2), trials);
        assert_eq!(outcome.states == guess, trials == 1);
    }
}

/// A needle of eight nodes pushed and pulled in turn, states carried from step to step: nearly always the guess is right.
#[test]
fn states_carry_from_step_to_step() {
    let mut random = Random(11);
    let (mut line, limits) = random.line(8);
    line.tissue_rhs.fill(0.0);
    line.e.fill(0.0);
    line.drift.fill(0.0);
    let mut states = vec![Static; 8];
    let (mut trials, mut consistent) = (0, 0);
    for k in 0..400 {
        line.needle_rhs.fill(0.0);
        line.needle_rhs[0] = 8.0 * (0.02 * f64::from(k)).sin();
        let outcome = solve_stick_slip(&mut line, &limits, &states, &StickSlipParams::default()).unwrap();
        trials += outcome.trials;
        consistent += usize::from(outcome.consistent);
        states = outcome.states;
    }
    let mean = trials as f64 / 400.0;
    assert!(mean < 1.3 && consistent == 400, "{mean} {consistent}");
}

/// A system whose answers contradict every state: trials end at the bound, or when all states were tried. None is judged twice by exact
/// forces, nor twice by rough ones.
#[test]
fn never_the_same_states_twice() {
    struct Contrary(Vec<Vec<FrictionState>>);
    impl StickSlipSystem for Contrary {
        type Error = NeedleError;
        fn clear(&mut self) {}
        fn solve(&mut self, states: &[FrictionState], _: &[f64], _: f64) -> Result<usize, NeedleError> {
            if self.0.last().is_none_or(|s| s != states) {
                self.0.push(states.to_vec());
            }
            Ok(1)
        }
        fn constraint_force_un(&self, _: usize) -> f64 {
            -10.0
        }
        fn slip_mm(&self, node: usize) -> f64 {
            -self.0[self.0.len() - 1][node].sign()
        }
    }
    for (q, max_trials, all) in [(2, 100, Some(9)), (3, 100, Some(27)), (5, 10, None)] {
        let mut system = Contrary(vec![]);
        let limits = vec![
            FrictionLimit {
                friction_un: 1.0,
                cutting_un: 0.0
            };
            q
        ];
        let params = StickSlipParams {
            max_trials,
            ..Default::default()
        };
        let outcome = solve_stick_slip(&mut system, &limits, &vec![Static; q], &params).unwrap();
        assert_eq!((outcome.trials, outcome.consistent), (system.0.len(), false));
        let times = |s| system.0.iter().filter(|t| *t == s).count();
        assert!(system.0.iter().all(|s| times(s) <= 2));
        // Those that come twice were in the first circle, that of rough forces.
        let repeated = system.0.iter().filter(|s| times(*s) == 2).count() / 2;
        assert!(repeated <= 2, "{repeated}");
        match all {
            Some(all) => assert_eq!(outcome.trials, all + repeated),
            None => assert_eq!(outcome.trials, max_trials),
        }
    }
}

#[test]
fn first_guess_is_the_nearest_state() {
    assert_eq!(carry_states(&[], &[1.0, 2.0]), [Forward, Forward]);
    let before = [(0.0, Static), (10.0, Forward), (20.0, Backward)];
    assert_eq!(
        carry_states(&before, &[4.0, 6.0, 30.0]),
        [Static, Forward, Backward]
    );
}

#[test]
fn refusals() {
    let params = StickSlipParams::default();
    let limits = [FrictionLimit {
        friction_un: -1.0,
        cutting_un: 0.0,
    }];
    assert!(solve_stick_slip(&mut one(1.0), &limits, &[Static], &params).is_err());
    let limits = [FrictionLimit {
        friction_un: 1.0,
        cutting_un: 0.0,
    }];
    assert!(solve_stick_slip(&mut one(1.0), &limits, &[], &params).is_err());
    let never = StickSlipParams {
        max_trials: 0,
        ..params
    };
    assert!(solve_stick_slip(&mut one(1.0), &limits, &[Static], &never).is_err());
}
