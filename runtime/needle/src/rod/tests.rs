//! Forces against printed values and finite differences; invariances.

use super::*;
use crate::PreBend;
use glam::{DMat3, DQuat};

/// needle.md §1.5: five nodes, rest lengths the current lengths, bending stiffness 0.7 and twist stiffness 0.5, no stretch.
fn oracle_rod() -> Rod {
    let mut nodes = vec![DVec3::ZERO];
    for edge in [
        [1.0, 0.1, 0.0],
        [1.0, 0.3, 0.2],
        [0.9, 0.2, -0.3],
        [1.0, -0.4, 0.1],
    ] {
        nodes.push(nodes[nodes.len() - 1] + DVec3::from_array(edge));
    }
    let mut rod = Rod::new(NeedleParams::default(), nodes, DVec3::Y, Held::default()).unwrap();
    rod.stiffness = Stiffness {
        bending_un_mm2: [0.7; 2],
        twist_un_mm2: 0.5,
        stretch_un: 0.0,
        mass_g_per_mm: 0.0,
    };
    rod
}

fn assert_forces(found: &[DVec3], printed: &[[f64; 3]]) {
    for (f, p) in found.iter().zip(printed) {
        assert!(
            (*f - DVec3::from_array(*p)).abs().max_element() < 6e-10,
            "{f} {p:?}"
        );
    }
    assert!(found.iter().sum::<DVec3>().length() < 1e-13);
}

#[test]
fn printed_curvature_binormal() {
    let nodes = vec![DVec3::ZERO, DVec3::X, DVec3::new(1.8, 0.6, 0.0)];
    let rod = Rod::new(NeedleParams::default(), nodes, DVec3::Y, Held::default()).unwrap();
    let kb = rod.curvature_binormal()[1];
    assert!((kb - DVec3::new(0.0, 0.0, 2.0 / 3.0)).length() < 1e-15);
    assert!((kb.length() - 2.0 * (36.8699_f64.to_radians() / 2.0).tan()).abs() < 1e-6);
}

#[test]
fn printed_bending_energy_and_forces() {
    let rod = oracle_rod();
    assert!((rod.energy(&Loads::default()).unwrap().bending_nj - 0.3100021862).abs() < 6e-11);
    assert_forces(
        &rod.static_force(&Loads::default()),
        &[
            [0.037937138, -0.127615248, -0.131408962],
            [-0.064613792, 0.304348485, 0.623155312],
            [0.020062455, 0.289475696, -1.262814638],
            [0.003511601, -0.939206044, 1.101031025],
            [0.003102599, 0.472997112, -0.329962738],
        ],
    );
}

#[test]
fn printed_twist_energy_and_forces() {
    let mut rod = oracle_rod();
    rod.stiffness.bending_un_mm2 = [0.0; 2];
    let sum: f64 = rod.geometry.cell.iter().sum();
    for i in 1..rod.theta.len() {
        rod.theta[i] = rod.theta[i - 1] + 0.9 * rod.geometry.cell[i] / sum;
    }
    assert!((rod.energy(&Loads::default()).unwrap().twist_nj - 0.0658348817).abs() < 6e-11);
    assert_forces(
        &rod.static_force(&Loads::default()),
        &[
            [0.001387528, -0.013875284, 0.013875284],
            [-0.009342939, 0.034974759, -0.005747443],
            [-0.010411935, -0.015588945, -0.059556190],
            [0.011011433, -0.034198589, 0.010235240],
            [0.007355912, 0.028688058, 0.041193110],
        ],
    );
}

/// A bent, twisted, stretched, pre-bent rod with unequal bending stiffnesses, in convenient units.
fn general_rod(held: Held) -> Rod {
    let nodes = vec![
        DVec3::new(0.0, 0.0, 0.0),
        DVec3::new(1.0, 0.1, 0.0),
        DVec3::new(2.1, 0.5, 0.2),
        DVec3::new(2.9, 0.4, -0.1),
        DVec3::new(3.6, -0.2, 0.1),
        DVec3::new(4.7, -0.4, 0.5),
        DVec3::new(5.6, -0.3, 0.4),
    ];
    let lengths = vec![1.0, 1.1, 0.9, 0.85, 1.2, 0.95];
    let params = NeedleParams {
        pre_bend: vec![
            PreBend {
                length_mm: 1.5,
                curvature_per_mm: [0.1, -0.4],
            },
            PreBend {
                length_mm: 2.0,
                curvature_per_mm: [0.3, 0.2],
            },
        ],
        ..Default::default()
    };
    let mut rod = Rod::with_rest_lengths(params, nodes, lengths, DVec3::Z, held).unwrap();
    rod.stiffness = Stiffness {
        bending_un_mm2: [0.7, 1.3],
        twist_un_mm2: 0.5,
        stretch_un: 3.0,
        mass_g_per_mm: 0.2,
    };
    rod.turn_ends(0.4, 1.1).unwrap();
    rod
}

fn moved(rod: &Rod, node: usize, by: DVec3) -> Rod {
    let mut position = rod.position.clone();
    position[node] += by;
    let mut rod = rod.clone();
    rod.move_to(position, None).unwrap();
    rod
}

/// Forces are minus the gradient of the energy while twist follows: with a free tip, with a held one, with outside torques.
#[test]
fn forces_by_finite_differences() {
    for (held, torque) in [
        (Held::default(), vec![]),
        (
            Held {
                base: false,
                tip: true,
            },
            vec![],
        ),
        (
            Held {
                base: true,
                tip: true,
            },
            vec![],
        ),
        (
            Held {
                base: true,
                tip: false,
            },
            vec![0.0, 0.2, -0.1, 0.3, 0.0, -0.25],
        ),
    ] {
        let mut rod = general_rod(held);
        let loads = Loads {
            gravity_mm_per_s2: DVec3::new(0.3, -0.2, 0.5),
            nodal_un: (0..7)
                .map(|i| DVec3::new(0.1 * f64::from(i), -0.2, 0.05))
                .collect(),
            edge_torque_un_mm: torque,
        };
        rod.relax_twist(&loads.edge_torque_un_mm).unwrap();
        let force = rod.static_force(&loads);
        let scale = force.iter().fold(0.0, |m: f64, f| m.max(f.length()));
        // A torque works on the angle by which an edge's material turns about it, beyond being carried along.
        let energy = |moved: &mut Rod| {
            moved.relax_twist(&loads.edge_torque_un_mm).unwrap();
            let no_torque = Loads {
                edge_torque_un_mm: vec![],
                ..loads.clone()
            };
            let work: f64 = loads
                .edge_torque_un_mm
                .iter()
                .enumerate()
                .map(|(j, t)| {
                    let (old, new) = (rod.frame(j), moved.frame(j));
                    t * angle_about(new.tangent, transport(old.m1, old.tangent, new.tangent), new.m1)
                })
                .sum();
            moved.energy_unchecked(&no_torque).potential_nj() - work
        };
        for i in 0..7 {
            for axis in DMat3::IDENTITY.to_cols_array_2d() {
                let axis = DVec3::from_array(axis);
                let h = 1e-5;
                let plus = energy(&mut moved(&rod, i, h * axis));
                let minus = energy(&mut moved(&rod, i, -h * axis));
                let by_difference = -(plus - minus) / (2.0 * h);
                let found = force[i].dot(axis);
                assert!(
                    (found - by_difference).abs() < 1e-8 * scale,
                    "{held:?} {i} {axis}: {found} {by_difference}"
                );
            }
        }
    }
}

/// −∂F/∂x by central differences with angles carried along. Carrying a frame round a small loop turns it, which gives the
/// difference quotient an antisymmetric part (proportional to the torque on the edge); the symmetric part is the stiffness.
fn stiffness_by_differences(rod: &Rod) -> Vec<Vec<DMat3>> {
    let n = rod.position.len();
    let mut matrix = vec![vec![DMat3::ZERO; n]; n];
    for j in 0..n {
        let h = 1e-5;
        for axis in 0..3 {
            let by = DMat3::IDENTITY.col(axis) * h;
            let plus = moved(rod, j, by).static_force(&Loads::default());
            let minus = moved(rod, j, -by).static_force(&Loads::default());
            for i in 0..n {
                *matrix[i][j].col_mut(axis) = (minus[i] - plus[i]) / (2.0 * h);
            }
        }
    }
    (0..n)
        .map(|i| {
            (0..n)
                .map(|j| (matrix[i][j] + matrix[j][i].transpose()) * 0.5)
                .collect()
        })
        .collect()
}

#[test]
fn exact_stiffness_by_finite_differences() {
    let mut rod = general_rod(Held {
        base: true,
        tip: false,
    });
    rod.stiffness.twist_un_mm2 = 0.0;
    assert!(
        rod.geometry
            .length
            .iter()
            .zip(&rod.rest_length)
            .any(|(l, r)| l < r),
        "one edge compressed"
    );
    let matrix = rod.stiffness_matrix(Tangent::Exact);
    let expected = stiffness_by_differences(&rod);
    for i in 0..7 {
        for j in 0..7 {
            let difference = (matrix.block(i, j) - expected[i][j]).abs();
            let worst = difference
                .x_axis
                .max(difference.y_axis)
                .max(difference.z_axis)
                .max_element();
            assert!(
                worst < 1e-8 * 20.0,
                "({i}, {j}): {} {}",
                matrix.block(i, j),
                expected[i][j]
            );
        }
    }
}

/// Gauss–Newton leaves out only what vanishes at the natural shape, and it never is indefinite.
#[test]
fn gauss_newton_is_exact_at_the_natural_shape_and_semidefinite_elsewhere() {
    let nodes = (0..6).map(|i| DVec3::new(1.1 * f64::from(i), 0.0, 0.0)).collect();
    let straight = Rod::new(NeedleParams::default(), nodes, DVec3::Y, Held::default()).unwrap();
    let (gauss_newton, exact) = (
        straight.stiffness_matrix(Tangent::GaussNewton),
        straight.stiffness_matrix(Tangent::Exact),
    );
    for i in 0..6 {
        for j in 0..6 {
            let d = gauss_newton.block(i, j) - exact.block(i, j);
            assert!(d.to_cols_array().iter().all(|v| v.abs() < 1e-6), "{d}");
        }
    }
    let rod = general_rod(Held::default());
    let mut shifted = rod.stiffness_matrix(Tangent::GaussNewton);
    for i in 0..7 {
        shifted.add(i, i, DMat3::from_diagonal(DVec3::splat(1e-9)));
    }
    shifted.factor().unwrap();
    let mut exact = rod.stiffness_matrix(Tangent::Exact);
    for i in 0..7 {
        exact.add(i, i, DMat3::from_diagonal(DVec3::splat(1e-9)));
    }
    assert!(
        exact.factor().is_err(),
        "a compressed edge makes the exact stiffness indefinite"
    );
}

#[test]
fn damping_is_linear_in_velocity_and_blind_to_rigid_motion() {
    let mut rod = general_rod(Held {
        base: true,
        tip: false,
    });
    rod.params.stretch_damping_s = 0.3;
    rod.params.bending_damping_s = 0.2;
    let still = rod.evaluate(&Loads::default(), Tangent::GaussNewton).unwrap();
    let velocity: Vec<_> = (0..7)
        .map(|i| DVec3::new(0.3, f64::from(i).sin(), 0.1 * f64::from(i)))
        .collect();
    rod.velocity = velocity.clone();
    let moving = rod.evaluate(&Loads::default(), Tangent::GaussNewton).unwrap();
    let expected = still.damping.mul(&velocity);
    let mut power = 0.0;
    for i in 0..7 {
        assert!((still.force[i] - moving.force[i] - expected[i]).length() < 1e-12);
        power -= expected[i].dot(velocity[i]);
    }
    assert!(power < -1e-3, "{power}");

    let (omega, v) = (DVec3::new(0.4, -0.3, 0.7), DVec3::new(1.0, 2.0, 3.0));
    rod.velocity = rod.position.iter().map(|x| v + omega.cross(*x)).collect();
    rod.spin = rod.geometry.tangent.iter().map(|t| omega.dot(*t)).collect();
    let rigid = rod.evaluate(&Loads::default(), Tangent::GaussNewton).unwrap();
    for i in 0..7 {
        assert!(
            (rigid.force[i] - still.force[i]).length() < 1e-13,
            "{} {}",
            rigid.force[i],
            still.force[i]
        );
    }
}

#[test]
fn rigid_motion_turns_forces_with_the_rod() {
    let rod = general_rod(Held {
        base: true,
        tip: true,
    });
    let (rotation, shift) = (
        DQuat::from_scaled_axis(DVec3::new(0.5, 1.2, -0.8)),
        DVec3::new(30.0, -20.0, 5.0),
    );
    let mut turned = rod.clone();
    turned.position = rod.position.iter().map(|x| rotation * *x + shift).collect();
    turned.director = rotation * rod.director;
    turned.refresh_geometry().unwrap();
    let (a, b) = (
        rod.static_force(&Loads::default()),
        turned.static_force(&Loads::default()),
    );
    let (ea, eb) = (
        rod.energy(&Loads::default()).unwrap(),
        turned.energy(&Loads::default()).unwrap(),
    );
    assert!((ea.potential_nj() - eb.potential_nj()).abs() < 1e-12 * ea.potential_nj());
    let mut torque = DVec3::ZERO;
    for i in 0..7 {
        assert!((rotation * a[i] - b[i]).length() < 1e-12);
        torque += rod.position[i].cross(a[i]);
    }
    assert!(a.iter().sum::<DVec3>().length() < 1e-13);
    // Held ends carry torques of their own, so nodal forces alone need not balance; without twist and pre-bend they do.
    let mut free = oracle_rod();
    free.stiffness.stretch_un = 2.0;
    let force = free.static_force(&Loads::default());
    let torque: DVec3 = free.position.iter().zip(&force).map(|(x, f)| x.cross(*f)).sum();
    assert!(torque.length() < 1e-13, "{torque}");
}

/// Twist of a straight isotropic rod is shared in proportion to length, and its torque is GJ times twist per length.
#[test]
fn twist_is_uniform() {
    let nodes = [0.0, 1.0, 2.5, 3.0, 7.0, 7.5, 9.0]
        .map(|x| DVec3::new(x, 0.0, 0.0))
        .to_vec();
    let held = Held {
        base: true,
        tip: true,
    };
    let mut rod = Rod::new(NeedleParams::default(), nodes, DVec3::Y, held).unwrap();
    rod.turn_ends(0.3, 2.0).unwrap();
    // Between the inner ends of the held edges: 1.0 to 7.5 mm.
    let expected = rod.stiffness.twist_un_mm2 * 1.7 / 6.5;
    for i in 1..6 {
        assert!((rod.twist_torque(i) / expected - 1.0).abs() < 1e-12);
    }
}

/// Torques on edges: the twist between two nodes carries the sum of those beyond.
#[test]
fn outside_torques_are_carried_to_the_base() {
    let nodes = (0..6).map(|i| DVec3::new(f64::from(i), 0.0, 0.0)).collect();
    let mut rod = Rod::new(
        NeedleParams::default(),
        nodes,
        DVec3::Y,
        Held {
            base: true,
            tip: false,
        },
    )
    .unwrap();
    rod.relax_twist(&[5.0, 1.0, -2.0, 4.0, 0.5]).unwrap();
    for (node, torque) in [(1, 3.5), (2, 2.5), (3, 4.5), (4, 0.5)] {
        assert!(
            (rod.twist_torque(node) - torque).abs() < 1e-6,
            "{node} {}",
            rod.twist_torque(node)
        );
    }
}

#[test]
fn natural_curvature_is_the_integral_over_each_cell() {
    let nodes = (0..8).map(|i| DVec3::new(2.0 * f64::from(i), 0.0, 0.0)).collect();
    let arcs = vec![
        PreBend {
            length_mm: 3.0,
            curvature_per_mm: [0.0, 0.05],
        },
        PreBend {
            length_mm: 4.0,
            curvature_per_mm: [0.02, 0.0],
        },
    ];
    let params = NeedleParams {
        pre_bend: arcs,
        ..Default::default()
    };
    let rod = Rod::new(
        params,
        nodes,
        DVec3::Y,
        Held {
            base: true,
            tip: false,
        },
    )
    .unwrap();
    let turning: DVec2 = rod
        .rest_curvature()
        .iter()
        .map(|w| 2.0 * (w.length() / 2.0).atan() * w.normalize_or_zero())
        .sum();
    // 3 mm of the first arc less the outer half edge (1 mm), 4 mm of the second.
    assert!((turning - DVec2::new(0.08, 0.1)).length() < 1e-12, "{turning}");
}

/// A straight shaft gripped over its last 60 mm and turned at its base winds up by a front that goes inwards: the tip stays until the twist is
/// m·L·a/GJ + m·L²/(2GJ), a the length outside, and lags by that from then on. Turned back, it holds until twice the torque.
#[test]
fn gripped_shaft_lags_by_the_closed_form() {
    let (out, inside, m) = (40.0, 60.0, 2e6);
    let mut rod = Rod::in_sleeve(
        NeedleParams::default(),
        DVec3::ZERO,
        DVec3::X,
        DVec3::Y,
        5.0,
        out + inside,
        100,
    )
    .unwrap();
    let mut grip = vec![0.0; rod.theta().len()];
    grip[41..].fill(m);
    rod.grip(grip);
    let twist = rod.stiffness().twist_un_mm2;
    let full = m * inside * out / twist + m * inside * inside / (2.0 * twist);
    let (mut turned, step) = (0.0, full / 40.0);
    let tip = |rod: &Rod| rod.theta()[rod.theta().len() - 1];
    for _ in 0..80 {
        rod.turn_ends(step, 0.0).unwrap();
        turned += step;
        // Torque at the mouth from the length of the front.
        let front = (out * out + 2.0 * turned * twist / m).sqrt() - out;
        let expected = m * front.min(inside);
        let off = -rod.twist_torque(1) - expected;
        assert!(off.abs() < 0.03 * m * inside, "{turned} {off}");
        let lag = turned.min(full);
        assert!(
            (tip(&rod) - (turned - lag)).abs() < 0.01 * full,
            "{turned} {}",
            tip(&rod)
        );
    }
    let at = tip(&rod);
    for _ in 0..79 {
        rod.turn_ends(-step, 0.0).unwrap();
    }
    assert!((tip(&rod) - at).abs() < 0.02 * full, "{} {at}", tip(&rod));
    for _ in 0..20 {
        rod.turn_ends(-step, 0.0).unwrap();
    }
    assert!((at - tip(&rod) - 19.0 * step).abs() < 0.02 * full);
    assert!((rod.twist_torque(1) / (m * inside) - 1.0).abs() < 1e-6);
}
