//! Stress, energy and derivatives of every law; worked numbers in SI units (the formulas are homogeneous in length).

use glam::{DMat3, DVec3};
use palpate_fem::{
    Element, GREATEST_EXPONENT, JacobianMode, LEAST_VOLUME_RATIO, Law, Material, Moduli, Tangent,
    damping_stress, rotation, svd,
};
use proptest::prelude::*;

const LAWS: [Law; 6] = [
    Law::Linear,
    Law::RotatedLinear,
    Law::Corotated,
    Law::NeoHookean,
    Law::StableNeoHookean,
    Law::Demiray,
];

/// Sum of squares − 3 − 2(J − 1) + (J − 1)²: the strain of Demiray's law.
fn demiray_strain(f: DMat3) -> f64 {
    let d = f.determinant() - 1.0;
    f.to_cols_array().iter().map(|x| x * x).sum::<f64>() - 3.0 - 2.0 * d + d * d
}

fn tissue(law: Law) -> Material {
    Material {
        law,
        youngs_modulus_pa: 1000.0,
        poisson_ratio: 0.45,
        stiffening: 3.0,
        density_g_mm3: 1.05e-3,
        damping_s: 0.0,
    }
}

fn lame() -> Moduli {
    tissue(Law::Linear).moduli()
}

fn size(m: DMat3) -> f64 {
    m.to_cols_array().iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn rows(m: [[f64; 3]; 3]) -> DMat3 {
    DMat3::from_cols_array_2d(&m).transpose()
}

fn near(found: &[f64], wanted: &[f64], tolerance: f64) {
    for (f, w) in found.iter().zip(wanted) {
        assert!((f - w).abs() <= tolerance, "{found:?} for {wanted:?}");
    }
}

const REST: [DVec3; 4] = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];

fn bent(x3: [f64; 3]) -> [DVec3; 4] {
    [
        DVec3::ZERO,
        DVec3::new(1.1, 0.2, 0.0),
        DVec3::new(-0.1, 0.9, 0.1),
        DVec3::from_array(x3),
    ]
}

#[test]
fn lame_constants() {
    let l = lame();
    near(&[l.mu_pa, l.lambda_pa], &[344.827586, 3103.448276], 5e-7);
    let l = Material {
        youngs_modulus_pa: 10_000.0,
        poisson_ratio: 0.49,
        ..Material::default()
    }
    .moduli();
    near(&[l.mu_pa, l.lambda_pa], &[3355.70, 164_429.5], 0.05);
}

#[test]
fn the_deformed_unit_tet_has_the_worked_numbers() {
    let e = Element::new(REST);
    let x = bent([0.05, 0.0, 1.2]);
    let f = e.gradient(x);
    assert!((f.determinant() - 1.213).abs() < 1e-12);
    let s = svd(f).s;
    near(&s.to_array(), &[1.217732, 1.112832, 0.895116], 5e-7);
    let hat = Law::RotatedLinear.principal_stress(lame(), s);
    near(&hat.to_array(), &[850.547807, 778.202826, 628.053753], 5e-7);
    let r = rows([
        [0.988442, -0.148703, 0.02949],
        [0.149985, 0.987548, -0.047467],
        [-0.022064, 0.051341, 0.998437],
    ]);
    assert!(size(rotation(f) - r) < 2e-6);
    let p = rows([
        [769.229041, -70.561461, 34.799254],
        [139.540733, 631.288413, -0.509434],
        [-0.2368, 69.516533, 838.301832],
    ]);
    for law in [Law::RotatedLinear, Law::Corotated] {
        assert!(size(law.stress(lame(), f) - p) < 2e-6);
        let forces = e.material_forces(&tissue(law), x, [DVec3::ZERO; 4]);
        near(&forces[0].to_array(), &[122.244472, 128.386619, 151.263594], 5e-7);
        near(&forces[1].to_array(), &[-128.20484, -23.256789, 0.039467], 5e-7);
        near(&forces[2].to_array(), &[11.760243, -105.214735, -11.586089], 5e-7);
        near(&forces[3].to_array(), &[-5.799876, 0.084906, -139.716972], 5e-7);
    }
    let t = Tangent::new(Law::RotatedLinear, lame(), f, JacobianMode::Frozen);
    let jacobian = |i: usize, j: usize| t.block(e.gradients[i], e.gradients[j]) * -e.volume_mm3;
    let j00 = rows([
        [-606.642525, -544.549716, -513.401638],
        [-544.549716, -855.312855, -643.837443],
        [-513.401638, -643.837443, -779.423931],
    ]);
    let j01 = rows([
        [551.253956, 129.356815, 48.461407],
        [564.803263, 151.43312, -3.581567],
        [524.33044, 78.346284, 44.439362],
    ]);
    assert!(size(jacobian(0, 0) - j00) < 2e-6);
    assert!(size(jacobian(0, 1) - j01) < 2e-6);
    assert!(size(jacobian(1, 0) - j01.transpose()) < 2e-6);
    let stretched = DMat3::from_diagonal(DVec3::new(1.2177, 1.1128, 0.8951));
    let exact = Tangent::new(Law::RotatedLinear, lame(), stretched, JacobianMode::Exact);
    near(&[exact.flip.z, exact.twist.z], &[689.655172, 698.651318], 5e-7);
}

#[test]
fn an_inverted_tet_pushes_itself_back() {
    let e = Element::new(REST);
    let x = bent([0.05, 0.1, -0.3]);
    let f = e.gradient(x);
    near(&[f.determinant()], &[-0.313], 1e-12);
    let s = svd(f).s;
    near(&s.to_array(), &[1.125732, 0.906132, -0.306844], 5e-7);
    let hat = Law::RotatedLinear.principal_stress(lame(), s);
    near(&hat.to_array(), &[-3870.125702, -4021.573757, -4858.109068], 5e-7);
    let forces = e.material_forces(&tissue(Law::Corotated), x, [DVec3::ZERO; 4]);
    near(
        &forces[0].to_array(),
        &[-587.933863, -740.473296, -747.844424],
        5e-7,
    );
    near(&forces[1].to_array(), &[636.418183, 95.211237, -61.646662], 5e-7);
    near(&forces[2].to_array(), &[-105.901493, 661.876356, 3.190186], 5e-7);
    near(&forces[3].to_array(), &[57.417173, -16.614297, 806.3009], 5e-7);
    // Every nonlinear law moves it towards its rest volume.
    for law in [
        Law::RotatedLinear,
        Law::Corotated,
        Law::NeoHookean,
        Law::StableNeoHookean,
        Law::Demiray,
    ] {
        let f = e.material_forces(&tissue(law), x, [DVec3::ZERO; 4]);
        assert!(f[3].z > 0.0 && f.iter().all(|v| v.is_finite()), "{law:?} {f:?}");
    }
}

#[test]
fn simple_shear() {
    let f = rows([[1.0, 0.3, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
    let p = rows([
        [76.301015, 114.893428, 0.0],
        [92.003124, 76.301015, 0.0],
        [0.0, 0.0, 69.439164],
    ]);
    assert!(size(Law::Corotated.stress(lame(), f) - p) < 2e-6);
}

/// Lateral stretch of a bar stretched by `s` that is free at its sides, by bisection on the law's own stress.
fn free_lateral(law: Law, s: f64) -> f64 {
    let (mut lo, mut hi) = (0.5, 1.5);
    for _ in 0..200 {
        let t = 0.5 * (lo + hi);
        let f = DMat3::from_diagonal(DVec3::new(s, t, t));
        if law.stress(lame(), f).y_axis.y > 0.0 {
            hi = t;
        } else {
            lo = t;
        }
    }
    0.5 * (lo + hi)
}

#[test]
fn uniaxial_tension_and_compression() {
    let table = [
        (0.8, [1.09, -200.0], [1.104462, -249.930], [1.103970, -249.461]),
        (0.9, [1.045, -100.0], [1.048313, -110.713], [1.048220, -110.638]),
        (1.1, [0.955, 100.0], [0.957844, 91.703], [0.957787, 91.738]),
        (1.25, [0.8875, 250.0], [0.903593, 205.799], [0.903327, 205.931]),
    ];
    for (s, hooke, neo, stable) in table {
        for (law, [t, p]) in [
            (Law::Linear, hooke),
            (Law::RotatedLinear, hooke),
            (Law::Corotated, hooke),
            (Law::NeoHookean, neo),
            (Law::StableNeoHookean, stable),
        ] {
            let lateral = free_lateral(law, s);
            let f = DMat3::from_diagonal(DVec3::new(s, lateral, lateral));
            near(&[lateral], &[t], 6e-7);
            near(&[law.stress(lame(), f).x_axis.x], &[p], 6e-4);
        }
    }
}

#[test]
fn rigid_motion_makes_no_force() {
    let e = Element::new([
        DVec3::new(0.3, 0.1, 0.0),
        DVec3::new(2.0, 0.2, 0.1),
        DVec3::new(0.0, 1.5, -0.2),
        DVec3::new(0.5, 0.4, 1.1),
    ]);
    let turn = DMat3::from_rotation_y(2.0) * DMat3::from_rotation_x(-0.7);
    for law in LAWS {
        let f = if law == Law::Linear { DMat3::IDENTITY } else { turn };
        let force = e.forces(law.stress(lame(), f));
        assert!(force.iter().all(|v| v.length() < 1e-11), "{law:?} {force:?}");
        assert!(law.energy_density(lame(), f).abs() < 1e-12);
    }
    // A rigid spin is not damped: Ḟ = W·F with W skew.
    let spin = DMat3::from_cols(
        DVec3::new(0.0, 3.0, -1.0),
        DVec3::new(-3.0, 0.0, 2.0),
        DVec3::new(1.0, -2.0, 0.0),
    );
    assert!(size(damping_stress(lame(), 0.1, turn, spin * turn)) < 1e-10);
}

fn gradients() -> impl Strategy<Value = DMat3> {
    (prop::array::uniform9(-1.0f64..1.0), 0.0f64..1.0, -3.0f64..3.0).prop_map(|(x, t, angle)| {
        let near = DMat3::IDENTITY + DMat3::from_cols_array(&x) * t;
        DMat3::from_rotation_z(angle) * DMat3::from_rotation_x(0.4 * angle) * near
    })
}

/// Away from the places where a law's own derivative jumps: rotations of flat inverted tets, the neo-Hookean joint. (Stress and derivative of
/// Demiray's law have no jump at all.)
fn smooth(law: Law, f: DMat3) -> bool {
    let s = svd(f).s;
    let rotated = matches!(law, Law::RotatedLinear | Law::Corotated);
    (!rotated || s.y + s.z > 0.05) && (f.determinant() - LEAST_VOLUME_RATIO).abs() > 1e-3
}

/// What Demiray's law adds to the size of a law's second derivative, for tolerances of differences.
fn curvature(law: Law, f: DMat3) -> f64 {
    if law != Law::Demiray {
        return 0.0;
    }
    size(law.stress(lame(), f))
        + Tangent::new(law, lame(), f, JacobianMode::Exact)
            .scale
            .to_cols_array()
            .iter()
            .map(|x| x.abs())
            .sum::<f64>()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn stress_is_the_slope_of_energy(f in gradients(), d in prop::array::uniform9(-1.0f64..1.0)) {
        let d = DMat3::from_cols_array(&d);
        for law in LAWS.into_iter().filter(|&l| smooth(l, f)) {
            let h = 1e-6;
            let slope = (law.energy_density(lame(), f + d * h) - law.energy_density(lame(), f - d * h)) / (2.0 * h);
            let p = law.stress(lame(), f);
            let work: f64 = p.to_cols_array().iter().zip(d.to_cols_array()).map(|(a, b)| a * b).sum();
            prop_assert!((slope - work).abs() < 2e-6 * (1.0 + size(p) + 4000.0 + curvature(law, f)), "{law:?}: {slope} for {work}");
        }
    }

    #[test]
    fn exact_tangents_are_the_slope_of_stress(f in gradients(), d in prop::array::uniform9(-1.0f64..1.0)) {
        let d = DMat3::from_cols_array(&d);
        for law in LAWS.into_iter().filter(|&l| smooth(l, f)) {
            let t = Tangent::new(law, lame(), f, JacobianMode::Exact);
            let h = 1e-6;
            let slope = (law.stress(lame(), f + d * h) - law.stress(lame(), f - d * h)) * (0.5 / h);
            let found = t.apply(d);
            prop_assert!(size(slope - found) < 1e-5 * (size(slope) + 4000.0 + curvature(law, f)), "{law:?} {slope} {found}");
        }
    }

    #[test]
    fn frozen_tangents_are_the_slope_with_the_rotations_held(f in gradients(), d in prop::array::uniform9(-1.0f64..1.0)) {
        let d = DMat3::from_cols_array(&d);
        for law in LAWS.into_iter().filter(|&l| l != Law::Linear && smooth(l, f)) {
            let t = Tangent::new(law, lame(), f, JacobianMode::Frozen);
            let (u, v) = (t.u, t.v);
            // The law on the symmetric stretch in the held frame.
            let held = |f: DMat3| {
                let m = u.transpose() * f * v;
                let m = (m + m.transpose()) * 0.5;
                let n = match law {
                    Law::RotatedLinear | Law::Corotated => Law::Linear.stress(lame(), m),
                    _ => law.stress(lame(), m),
                };
                u * n * v.transpose()
            };
            prop_assert!(size(held(f) - law.stress(lame(), f)) < 1e-8 * (1.0 + size(held(f))));
            let h = 1e-6;
            let slope = (held(f + d * h) - held(f - d * h)) * (0.5 / h);
            prop_assert!(size(slope - t.apply(d)) < 1e-5 * (size(slope) + 4000.0 + curvature(law, f)), "{law:?}");
        }
    }

    #[test]
    fn positive_tangents_never_give_energy_back_and_keep_what_is_positive(f in gradients(), d in prop::array::uniform9(-1.0f64..1.0)) {
        let d = DMat3::from_cols_array(&d);
        let dot = |a: DMat3, b: DMat3| -> f64 { a.to_cols_array().iter().zip(b.to_cols_array()).map(|(x, y)| x * y).sum() };
        for law in LAWS {
            let exact = Tangent::new(law, lame(), f, JacobianMode::Exact);
            let positive = Tangent::new(law, lame(), f, JacobianMode::ExactPositive);
            let (e, p) = (dot(d, exact.apply(d)), dot(d, positive.apply(d)));
            prop_assert!(p >= -1e-9 * size(positive.apply(d)), "{law:?} {p}");
            prop_assert!(p >= e - 1e-9 * size(exact.apply(d)), "{law:?} {p} under {e}");
            if law == Law::Linear || law == Law::RotatedLinear {
                let frozen = Tangent::new(law, lame(), f, JacobianMode::Frozen);
                prop_assert!(dot(d, frozen.apply(d)) >= -1e-9);
            }
        }
    }

    #[test]
    fn blocks_are_the_tangent_between_corners(f in gradients()) {
        let e = Element::new([DVec3::ZERO, DVec3::new(2.0, 0.1, 0.0), DVec3::new(0.2, 1.5, 0.3), DVec3::new(-0.1, 0.2, 1.7)]);
        for law in LAWS {
            let t = Tangent::new(law, lame(), f, JacobianMode::Exact);
            for i in 0..4 {
                for j in 0..4 {
                    let (gi, gj) = (e.gradients[i], e.gradients[j]);
                    let block = t.block(gi, gj);
                    for a in 0..3 {
                        let unit = DMat3::IDENTITY.col(a);
                        let df = DMat3::from_cols(unit * gj.x, unit * gj.y, unit * gj.z);
                        let column = t.apply(df) * gi;
                        prop_assert!((column - block.col(a)).length() < 1e-9 * (1.0 + size(block)));
                    }
                }
            }
        }
    }

    #[test]
    fn the_two_forms_of_the_papers_law_agree(f in gradients(), rate in prop::array::uniform9(-1.0f64..1.0)) {
        let d = svd(f);
        prop_assume!(d.s.y + d.s.z > 1e-3);
        let (a, b) = (Law::RotatedLinear.stress(lame(), f), Law::Corotated.stress(lame(), f));
        prop_assert!(size(a - b) < 1e-10 * (1.0 + size(a)));
        // Damping as the paper writes it, in the frame of U and V.
        let rate = DMat3::from_cols_array(&rate);
        let hat = d.u.transpose() * rate * d.v;
        let trace = hat.x_axis.x + hat.y_axis.y + hat.z_axis.z;
        let l = lame();
        let inner = (hat + hat.transpose()) * (0.3 * l.mu_pa) + DMat3::IDENTITY * (0.3 * l.lambda_pa * trace);
        let paper = d.u * inner * d.v.transpose();
        prop_assert!(size(paper - damping_stress(l, 0.3, d.u * d.v.transpose(), rate)) < 1e-9);
        // Forces of a tet sum to zero and, elastic ones, turn nothing.
        let e = Element::new(REST);
        let x = REST.map(|p| f * p);
        for law in LAWS {
            let forces = e.forces(law.stress(l, f));
            let sum: DVec3 = forces.iter().sum();
            let torque: DVec3 = x.iter().zip(&forces).map(|(p, f)| p.cross(*f)).sum();
            let scale = 1.0 + forces.iter().map(|f| f.length()).fold(size(a), f64::max);
            prop_assert!(sum.length() < 1e-12 * (1e3 + scale));
            prop_assert!(law == Law::Linear || torque.length() < 1e-8 * scale);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    /// Turned before, the energy stays and the stress turns along; turned after (an isotropic body turned in its rest shape), likewise.
    #[test]
    fn demirays_law_is_objective_and_isotropic(f in gradients(), angles in prop::array::uniform3(-3.0f64..3.0)) {
        let turn = DMat3::from_rotation_x(angles[0]) * DMat3::from_rotation_y(angles[1]) * DMat3::from_rotation_z(angles[2]);
        let (law, m) = (Law::Demiray, lame());
        let (w, p) = (law.energy_density(m, f), law.stress(m, f));
        for (g, q) in [(turn * f, turn * p), (f * turn, p * turn)] {
            prop_assert!((law.energy_density(m, g) - w).abs() < 1e-10 * (1.0 + w));
            prop_assert!(size(law.stress(m, g) - q) < 1e-10 * (1e3 + size(p)));
        }
        // Its strain is at least 0 for any F, so that the exponential only ever stiffens.
        prop_assert!(demiray_strain(f) > -1e-12 * (1.0 + size(f).powi(6)));
        prop_assert!(w >= Law::StableNeoHookean.energy_density(m, f) - 1e-9);
    }

    #[test]
    fn demirays_law_is_hookes_at_small_strain_and_stable_neo_hookean_without_stiffening(d in prop::array::uniform9(-1.0f64..1.0), f in gradients()) {
        let d = DMat3::from_cols_array(&d);
        for b in [1e-3, 1.0, 30.0] {
            let m = Moduli { stiffening: b, ..lame() };
            let h = 1e-6;
            let slope = (Law::Demiray.stress(m, DMat3::IDENTITY + d * h) - Law::Demiray.stress(m, DMat3::IDENTITY - d * h)) * (0.5 / h);
            let hooke = Law::Linear.stress(m, DMat3::IDENTITY + d);
            prop_assert!(size(slope - hooke) < 1e-5 * size(hooke), "{b}: {slope} for {hooke}");
            let t = Tangent::new(Law::Demiray, m, DMat3::IDENTITY, JacobianMode::Frozen);
            prop_assert!(size(t.apply(d) - hooke) < 1e-9 * size(hooke));
        }
        let m = Moduli { stiffening: 1e-9, ..lame() };
        let (soft, stable) = (Law::Demiray.stress(m, f), Law::StableNeoHookean.stress(m, f));
        prop_assert!(size(soft - stable) < 1e-6 * (1e3 + size(stable)), "{soft} {stable}");
    }
}

/// A bar stretched without change of volume, to the closed form of Demiray's incompressible law: the Cauchy stress along it, less that
/// across, is µ·exp(b(s² + 2/s − 3))·(s² − 1/s).
#[test]
fn demirays_law_has_its_uniaxial_closed_form() {
    for b in [0.5, 4.0, 12.0] {
        for s in [0.7f64, 0.9, 1.1, 1.3, 1.5] {
            let m = Moduli {
                stiffening: b,
                ..lame()
            };
            let strain = s * s + 2.0 / s - 3.0;
            if b * strain > GREATEST_EXPONENT {
                continue;
            }
            let f = DMat3::from_diagonal(DVec3::new(s, s.powf(-0.5), s.powf(-0.5)));
            let p = Law::Demiray.stress(m, f);
            let cauchy = p * f.transpose();
            let wanted = m.mu_pa * (b * strain).exp() * (s * s - 1.0 / s);
            let found = cauchy.x_axis.x - cauchy.y_axis.y;
            assert!(
                (found - wanted).abs() < 1e-9 * wanted.abs(),
                "{b} {s}: {found} for {wanted}"
            );
        }
    }
}

#[test]
fn the_exponential_is_continued_smoothly_and_cannot_overflow() {
    let m = Moduli {
        stiffening: 4.0,
        ..lame()
    };
    let at = |s: f64| DMat3::from_diagonal(DVec3::new(s, s.powf(-0.5), s.powf(-0.5)));
    // The stretch of the joint, by bisection.
    let (mut lo, mut hi) = (1.0, 3.0);
    for _ in 0..100 {
        let mid = 0.5 * (lo + hi);
        if 4.0 * demiray_strain(at(mid)) < GREATEST_EXPONENT {
            lo = mid
        } else {
            hi = mid
        }
    }
    let of = |s: f64| {
        let t = Tangent::new(Law::Demiray, m, at(s), JacobianMode::Exact);
        [
            Law::Demiray.energy_density(m, at(s)),
            size(Law::Demiray.stress(m, at(s))),
            size(t.scale),
        ]
    };
    let (a, b) = (of(lo - 1e-9), of(lo + 1e-9));
    for (a, b) in a.iter().zip(b) {
        assert!((a - b).abs() < 1e-6 * b.abs(), "{a} {b} at {lo}");
    }
    // Without the joint exp would overflow from a stretch of 13 on.
    for s in [2.0, 13.5, 1e3, 1e6] {
        for f in [
            at(s),
            at(1.0 / s),
            at(s) * DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0)),
            DMat3::IDENTITY * s,
            DMat3::ZERO,
        ] {
            let t = Tangent::new(Law::Demiray, m, f, JacobianMode::ExactPositive);
            let p = Law::Demiray.stress(m, f);
            assert!(
                Law::Demiray.energy_density(m, f).is_finite()
                    && p.is_finite()
                    && t.scale.is_finite()
                    && t.flip.is_finite()
            );
        }
    }
}

#[test]
fn continued_neo_hookean_joins_smoothly_and_stays_finite() {
    let at = |j: f64| {
        let f = DMat3::from_diagonal(DVec3::new(1.0, 1.0, j));
        (
            Law::NeoHookean.energy_density(lame(), f),
            Law::NeoHookean.stress(lame(), f).z_axis.z,
        )
    };
    let (a, b) = (at(LEAST_VOLUME_RATIO - 1e-9), at(LEAST_VOLUME_RATIO + 1e-9));
    assert!(
        (a.0 - b.0).abs() < 1e-3 && (a.1 - b.1).abs() < 1e-2,
        "{a:?} {b:?}"
    );
    let flat = at(0.0);
    let turned = at(-1.0);
    assert!(turned.0 > flat.0 && turned.1 < flat.1 && turned.1.is_finite());
}

#[test]
fn impossible_constants_are_refused_and_odd_ones_warned_of() {
    let with = |e: f64, nu: f64, rho: f64, r: f64| Material {
        law: Law::Corotated,
        youngs_modulus_pa: e,
        poisson_ratio: nu,
        stiffening: 4.0,
        density_g_mm3: rho,
        damping_s: r,
    };
    let stiffening = |b: f64| Material {
        law: Law::Demiray,
        stiffening: b,
        ..with(5000.0, 0.45, 1.05e-3, 0.02)
    };
    assert_eq!(stiffening(100.0).check("kidney").unwrap().len(), 1);
    assert!(stiffening(8.0).check("kidney").is_ok_and(|w| w.is_empty()));
    let good = with(5000.0, 0.45, 1.05e-3, 0.02);
    assert!(good.check("kidney").is_ok_and(|w| w.is_empty()));
    for (bad, word) in [
        (with(0.0, 0.45, 1e-3, 0.0), "youngs_modulus_pa"),
        (with(-5.0, 0.45, 1e-3, 0.0), "youngs_modulus_pa"),
        (with(f64::NAN, 0.45, 1e-3, 0.0), "youngs_modulus_pa"),
        (with(1e3, 0.5, 1e-3, 0.0), "poisson_ratio"),
        (with(1e3, -0.1, 1e-3, 0.0), "poisson_ratio"),
        (with(1e3, 0.4, 0.0, 0.0), "density_g_mm3"),
        (with(1e3, 0.4, 1e-3, -1.0), "damping_s"),
        (with(f64::INFINITY, 0.4, 1e-3, 0.0), "youngs_modulus_pa"),
        (stiffening(0.0), "stiffening"),
        (stiffening(-2.0), "stiffening"),
        (stiffening(2e3), "stiffening"),
        (stiffening(f64::NAN), "stiffening"),
    ] {
        let error = bad.check("kidney").unwrap_err().to_string();
        assert!(error.contains(word) && error.contains("kidney"), "{error}");
    }
    // 10 where 10 000 Pa was meant; kg/m³ for g/mm³.
    let w = with(10.0, 0.45, 1.05e-3, 0.0).check("tumour").unwrap();
    assert!(w.len() == 1 && w[0].contains("10000"), "{w:?}");
    assert_eq!(with(5000.0, 0.45, 1050.0, 0.0).check("fat").unwrap().len(), 1);
    assert_eq!(with(5000.0, 0.495, 1e-3, 0.0).check("fat").unwrap().len(), 1);
}
