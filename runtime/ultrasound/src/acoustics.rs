//! Formulas of sound at interfaces and along a path. Angles in radians, decibels as named.

/// Amplitude reflected at normal incidence from impedance `z1` to `z2` (same unit): (z2 − z1)/(z2 + z1). The intensity share
/// is its square.
pub fn normal_reflection(z1: f64, z2: f64) -> f64 {
    (z2 - z1) / (z2 + z1)
}

/// Sine of the refracted angle by Snell's law; 1 or more where there is total reflection. `c1`, `c2` are the speeds of
/// sound.
pub fn refracted_sine(c1: f64, c2: f64, incidence: f64) -> f64 {
    c2 / c1 * incidence.sin()
}

/// Amplitude reflected between two fluids at an angle of incidence (0 is along the normal); ±1 beyond the critical angle.
pub fn oblique_reflection(z1: f64, c1: f64, z2: f64, c2: f64, incidence: f64) -> f64 {
    let s = refracted_sine(c1, c2, incidence);
    if s >= 1.0 {
        return 1.0;
    }
    let (t1, t2) = (incidence.cos(), (1.0 - s * s).sqrt());
    (z2 * t1 - z1 * t2) / (z2 * t1 + z1 * t2)
}

/// One-way attenuation in dB: `a_db_cm_mhz`·`frequency_mhz`·path in cm.
pub fn attenuation_db(a_db_cm_mhz: f64, frequency_mhz: f64, path_mm: f64) -> f64 {
    a_db_cm_mhz * frequency_mhz * path_mm * 0.1
}

/// Amplitude factor of a loss in dB.
pub fn amplitude(loss_db: f64) -> f64 {
    10f64.powf(-loss_db / 20.0)
}

/// Strength of a specular echo at an angle of incidence: exp(−θ²/σ²).
pub fn specular_lobe(incidence: f64, sigma: f64) -> f64 {
    (-(incidence / sigma).powi(2)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(got: f64, want: f64, tol: f64) {
        assert!((got - want).abs() < tol, "{got} {want}");
    }

    /// Printed reflections of pairs from the default tissue table.
    #[test]
    fn reflection_oracle() {
        let table = crate::TissueTable::default();
        let z = |name: &str| f64::from(table.get(name).unwrap().impedance_mrayl);
        for (a, b, r, intensity) in [
            ("fat", "muscle", 0.103896, 0.010794),
            ("water", "liver", 0.054313, 0.002950),
            ("blood", "liver", 0.012270, 0.000151),
            ("liver", "fat", -0.089109, 0.007940),
            ("liver", "bone", 0.650794, 0.423532),
            ("muscle", "bone", 0.642105, 0.412299),
            ("fat", "air", -0.999420, 0.998841),
        ] {
            let got = normal_reflection(z(a), z(b));
            close(got, r, 1e-6);
            close(got * got, intensity, 1e-6);
        }
        close(
            20.0 * normal_reflection(z("fat"), z("muscle")).log10(),
            -19.7,
            0.05,
        );
    }

    #[test]
    fn oblique_oracle() {
        for (degrees, refracted, r) in [
            (20.0, 21.8812, 0.110107),
            (40.0, 44.4605, 0.138737),
            (60.0, 70.6771, 0.301058),
        ] {
            let t = f64::to_radians(degrees);
            close(
                refracted_sine(1450.0, 1580.0, t).asin().to_degrees(),
                refracted,
                1e-4,
            );
            close(oblique_reflection(1.38, 1450.0, 1.70, 1580.0, t), r, 1e-6);
        }
        close((1450.0f64 / 1580.0).asin().to_degrees(), 66.5952, 1e-4);
        assert_eq!(
            oblique_reflection(1.38, 1450.0, 1.70, 1580.0, 66.5953f64.to_radians()),
            1.0
        );
        assert!(oblique_reflection(1.38, 1450.0, 1.70, 1580.0, 66.5951f64.to_radians()) < 1.0);
        close(
            oblique_reflection(1.38, 1450.0, 1.70, 1580.0, 0.0),
            0.103896,
            1e-6,
        );
    }

    #[test]
    fn attenuation_oracle() {
        let db = attenuation_db(0.5, 5.0, 40.0);
        close(db, 10.0, 1e-12);
        close(amplitude(db), 0.316228, 1e-6);
        close(amplitude(db).powi(2), 0.1, 1e-9);
        close(amplitude(2.0 * db), 0.1, 1e-9);
        let db = attenuation_db(0.7, 3.5, 100.0);
        close(db, 24.5, 1e-12);
        close(amplitude(2.0 * db), 0.003548, 1e-6);
    }
}
