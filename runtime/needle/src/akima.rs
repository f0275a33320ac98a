//! Akima's interpolation (Akima 1970), and piecewise linear beside it.

use crate::NeedleError;
use glam::DVec3;

/// Piecewise cubic through given points whose slopes are decided by the four nearest secants, so that an outlier disturbs only
/// its neighbourhood. Continuous slope; not monotone.
#[derive(Debug, Clone, PartialEq)]
pub struct Akima {
    x: Vec<f64>,
    y: Vec<f64>,
    slope: Vec<f64>,
}

impl Akima {
    /// Interpolant of `y` over strictly increasing `x`. Two points make a line.
    ///
    /// Errors
    /// - [`NeedleError::Count`] fewer than two points, or not as many `y` as `x`
    /// - [`NeedleError::Parameter`] `x` not strictly increasing, or a value that is not finite
    pub fn new(x: Vec<f64>, y: Vec<f64>) -> Result<Self, NeedleError> {
        let n = x.len();
        if n < 2 {
            return Err(NeedleError::Count {
                what: "points to interpolate",
                found: n,
                expected: "at least 2".into(),
            });
        }
        if y.len() != n {
            return Err(NeedleError::Count {
                what: "values to interpolate",
                found: y.len(),
                expected: format!("{n}, one per point"),
            });
        }
        if let Some(bad) = x.windows(2).find(|w| !(w[1] > w[0] && w[1].is_finite())) {
            return Err(NeedleError::Parameter {
                name: "abscissa",
                found: bad[1],
                expected: "strictly increasing finite numbers",
            });
        }
        if let Some(bad) = y.iter().find(|v| !v.is_finite()) {
            return Err(NeedleError::Parameter {
                name: "ordinate",
                found: *bad,
                expected: "a finite number",
            });
        }
        let segments = n - 1;
        // Secants with two extrapolated ones at either end: secant[k + 2] belongs to segment k.
        let mut secant = vec![0.0; segments + 4];
        for k in 0..segments {
            secant[k + 2] = (y[k + 1] - y[k]) / (x[k + 1] - x[k]);
        }
        if segments == 1 {
            return Ok(Self {
                x,
                y,
                slope: vec![secant[2]; 2],
            });
        }
        secant[1] = 2.0 * secant[2] - secant[3];
        secant[0] = 2.0 * secant[1] - secant[2];
        secant[segments + 2] = 2.0 * secant[segments + 1] - secant[segments];
        secant[segments + 3] = 2.0 * secant[segments + 2] - secant[segments + 1];
        let scale = secant.iter().fold(0.0, |m: f64, s| m.max(s.abs()));
        let slope = (0..n)
            .map(|k| {
                let s = &secant[k..k + 4];
                let (right, left) = ((s[3] - s[2]).abs(), (s[1] - s[0]).abs());
                if right + left <= 1e-14 * scale {
                    0.5 * (s[1] + s[2])
                } else {
                    (right * s[1] + left * s[2]) / (right + left)
                }
            })
            .collect();
        Ok(Self { x, y, slope })
    }

    /// Value at `x`; beyond the ends the curve goes on straight.
    pub fn value(&self, x: f64) -> f64 {
        let last = self.x.len() - 1;
        if x <= self.x[0] {
            return self.y[0] + self.slope[0] * (x - self.x[0]);
        }
        if x >= self.x[last] {
            return self.y[last] + self.slope[last] * (x - self.x[last]);
        }
        let k = segment(&self.x, x);
        let (h, z) = (self.x[k + 1] - self.x[k], x - self.x[k]);
        let (s0, s1) = (self.slope[k], self.slope[k + 1]);
        let secant = (self.y[k + 1] - self.y[k]) / h;
        self.y[k] + z * (s0 + z / h * ((3.0 * secant - 2.0 * s0 - s1) + z / h * (s0 + s1 - 2.0 * secant)))
    }

    /// Slopes at the points.
    pub fn slopes(&self) -> &[f64] {
        &self.slope
    }
}

/// Segment of increasing `knots` that holds `x`, within the range of segments.
fn segment(knots: &[f64], x: f64) -> usize {
    knots.partition_point(|k| *k <= x).clamp(1, knots.len() - 1) - 1
}

/// Piecewise linear interpolation of vectors over increasing `knots`, constant beyond the ends.
pub(crate) fn linear(knots: &[f64], values: &[DVec3], x: f64) -> DVec3 {
    let k = segment(knots, x);
    let s = ((x - knots[k]) / (knots[k + 1] - knots[k])).clamp(0.0, 1.0);
    values[k].lerp(values[k + 1], s)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// needle.md §8.1.
    #[test]
    fn printed_values() {
        let akima = Akima::new(
            vec![0.0, 1.0, 2.0, 3.5, 5.0, 6.0],
            vec![0.0, 1.0, 0.5, 2.0, 2.2, 4.0],
        )
        .unwrap();
        let slopes = [1.75, 0.25, 0.450704225, 0.589473684, 0.703508772, 2.633333333];
        for (found, printed) in akima.slopes().iter().zip(slopes) {
            assert!((found - printed).abs() < 6e-10, "{found} {printed}");
        }
        for (x, y) in [
            (0.5, 0.6875),
            (1.5, 0.724911972),
            (2.75, 1.223980726),
            (4.25, 2.078618421),
            (5.5, 2.858771930),
        ] {
            assert!((akima.value(x) - y).abs() < 6e-10, "{x}: {} {y}", akima.value(x));
        }
    }

    #[test]
    fn lines_and_parabolas_are_exact_and_two_points_make_a_line() {
        let x: Vec<f64> = vec![-1.0, 0.5, 0.6, 2.0, 7.0];
        let line = Akima::new(x.clone(), x.iter().map(|x| 3.0 - 2.0 * x).collect()).unwrap();
        for k in 0..=40 {
            let q = -2.0 + 0.25 * f64::from(k);
            assert!((line.value(q) - (3.0 - 2.0 * q)).abs() < 1e-13);
        }
        // On even knots the secants of a parabola are in arithmetic progression, which Akima's slopes reproduce.
        let x: Vec<f64> = (0..6).map(f64::from).collect();
        let parabola = Akima::new(x.clone(), x.iter().map(|x| x * x).collect()).unwrap();
        assert!((parabola.value(2.3) - 2.3 * 2.3).abs() < 1e-13);
        assert!((parabola.value(0.4) - 0.16).abs() < 1e-13);
        let two = Akima::new(vec![1.0, 3.0], vec![2.0, 8.0]).unwrap();
        assert_eq!(two.value(2.0), 5.0);
        assert_eq!(two.value(4.0), 11.0);
    }

    /// The reason why Akima's slopes are used: next to a jump of flat data nothing overshoots, where a cubic spline would.
    #[test]
    fn flat_data_beside_a_jump_stays_flat() {
        let x: Vec<f64> = (0..8).map(f64::from).collect();
        let step = Akima::new(x, vec![0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]).unwrap();
        for k in 0..=700 {
            let q = f64::from(k) / 100.0;
            let v = step.value(q);
            assert!((0.0..=1.0).contains(&v), "{q} {v}");
            if q < 3.0 {
                assert_eq!(v, 0.0);
            }
        }
    }

    /// Why new rest lengths need a floor: between steep neighbours a flat piece of increasing data comes out falling.
    #[test]
    fn increasing_data_may_give_a_falling_curve() {
        let x: Vec<f64> = (0..6).map(f64::from).collect();
        let curve = Akima::new(x, vec![0.0, 10.0, 20.0, 20.1, 30.1, 40.1]).unwrap();
        assert!(
            curve.value(2.7) < curve.value(2.3) - 0.5,
            "{} {}",
            curve.value(2.3),
            curve.value(2.7)
        );
    }

    #[test]
    fn refusals() {
        assert!(matches!(
            Akima::new(vec![0.0], vec![0.0]),
            Err(NeedleError::Count { found: 1, .. })
        ));
        assert!(matches!(
            Akima::new(vec![0.0, 1.0], vec![0.0]),
            Err(NeedleError::Count { .. })
        ));
        assert!(matches!(
            Akima::new(vec![0.0, 0.0], vec![0.0, 1.0]),
            Err(NeedleError::Parameter { .. })
        ));
        assert!(matches!(
            Akima::new(vec![0.0, 1.0], vec![0.0, f64::NAN]),
            Err(NeedleError::Parameter { .. })
        ));
    }
}
