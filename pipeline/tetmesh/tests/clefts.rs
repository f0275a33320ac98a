//! Clefts narrower than a tet: the mesh must leave them open.

use palpate_fixtures::shapes::{self, Shape};
use palpate_tetmesh::{FemParams, FemReport, TetLocator, TetMesh, build_fem};
use palpate_volume::Implicit;

fn norm(p: [f64; 3]) -> f64 {
    p.iter().map(|v| v * v).sum::<f64>().sqrt()
}

/// Share of the points that lie in some tet.
fn covered(mesh: &TetMesh, points: &[[f64; 3]]) -> f64 {
    let locator = TetLocator::new(mesh);
    points.iter().filter(|p| locator.locate(**p).is_some()).count() as f64 / points.len() as f64
}

fn sound(report: &FemReport) {
    let r = report.refinement.as_ref().unwrap();
    println!(
        "{} tets of {:.2} mm, {:?} {r:?}",
        report.tets, report.edge_mm, report.after.min_dihedral_deg
    );
    assert_eq!(report.topology.fault(), None);
    assert_eq!(
        (
            report.topology.boundary_euler,
            report.topology.boundary_components
        ),
        (2, 1)
    );
    assert!(report.after.min_dihedral_deg > 22.0 && report.after.max_dihedral_deg < 130.0);
    assert!(
        report.patterns.iter().all(|p| p.violations == 0),
        "{:?}",
        report.patterns
    );
    assert!(
        r.tets_after as f64 <= 1.6 * r.tets_before as f64
            && report.tets as f64 <= 1.15 * 1.6 * r.tets_before as f64
    );
    assert!(r.far_before > 20 && r.far_after == 0, "{r:?}");
}

fn build(f: &dyn Implicit, params: &FemParams) -> (TetMesh, FemReport) {
    build_fem(f, &[], &[], params).unwrap()
}

fn uniform() -> FemParams {
    FemParams {
        max_tets_factor: 1.0,
        ..FemParams::default()
    }
}

#[test]
fn slit_of_two_millimetres_stays_open() {
    let slit = |p: [f64; 3]| (p[0].abs() - 1.0).max(12.0 - p[2]);
    let body = Shape {
        value: |p: [f64; 3]| shapes::smooth_max(norm(p) - 30.0, -slit(p), 1.0),
        lo: [-30.0; 3],
        hi: [30.0; 3],
    };
    let points: Vec<[f64; 3]> = (0..40 * 20)
        .map(|n| [0.0, f64::from(n % 40) - 19.5, 14.0 + 0.7 * f64::from(n / 40)])
        .filter(|p| norm(*p) < 27.0)
        .collect();
    let (closed, _) = build(&body, &uniform());
    let (open, report) = build(&body, &FemParams::default());
    sound(&report);
    let (before, after) = (covered(&closed, &points), covered(&open, &points));
    println!("in tissue: {before:.3} → {after:.3}");
    assert!(before > 0.3 && after < 0.02);
    assert_eq!(open, build(&body, &FemParams::default()).0);
}

/// A pocket that a channel of 3 mm joins to the outside, as the renal sinus behind its hilum.
#[test]
fn pocket_behind_a_narrow_mouth_is_joined_to_the_outside() {
    let body = Shape {
        value: |p: [f64; 3]| {
            let pocket = norm([p[0], p[1], p[2] - 10.0]) - 9.0;
            let channel = (p[0].hypot(p[1]) - 1.5).max(-p[2]);
            (norm(p) - 30.0).max(-pocket.min(channel))
        },
        lo: [-30.0; 3],
        hi: [30.0; 3],
    };
    let points: Vec<[f64; 3]> = (0..20).map(|n| [0.0, 0.0, 12.0 + 0.85 * f64::from(n)]).collect();
    let (closed, report) = build(&body, &uniform());
    assert_eq!(report.refinement, None);
    let (open, report) = build(&body, &FemParams::default());
    sound(&report);
    let (before, after) = (covered(&closed, &points), covered(&open, &points));
    println!("in tissue: {before:.3} → {after:.3}");
    assert!(before > 0.2 && after < 0.03);
}
