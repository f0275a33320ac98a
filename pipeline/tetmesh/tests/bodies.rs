//! The stages on analytic bodies with known answers.

use palpate_fixtures::shapes;
use palpate_tetmesh::{
    EmbeddingParams, FemParams, FemReport, StructureMode, TetLocator, build_embedding, build_fem,
};
use palpate_volume::Implicit;

/// Volume of the points of a box that pass, by counting samples.
fn counted(lo: [f64; 3], hi: [f64; 3], inside: impl Fn([f64; 3]) -> bool) -> f64 {
    let h = 0.5;
    let n: [usize; 3] = std::array::from_fn(|a| ((hi[a] - lo[a]) / h) as usize + 1);
    let at = |m: usize| [m % n[0], m / n[0] % n[1], m / (n[0] * n[1])];
    let hits = (0..n.iter().product())
        .filter(|&m| inside(std::array::from_fn(|a| lo[a] + h * (at(m)[a] as f64 + 0.5))))
        .count();
    hits as f64 * h * h * h
}

fn check(report: &FemReport, low: f64, high: f64) {
    println!(
        "{} tets, edge {:.2}, {:.2}°–{:.2}° → {:.2}°–{:.2}°, {:?} {:?}",
        report.tets,
        report.edge_mm,
        report.before.min_dihedral_deg,
        report.before.max_dihedral_deg,
        report.after.min_dihedral_deg,
        report.after.max_dihedral_deg,
        report.several,
        report.interfaces
    );
    assert!((report.tets as f64 / 13_000.0 - 1.0).abs() < 0.1);
    assert!(
        report.patterns.iter().all(|p| p.violations == 0),
        "{:?}",
        report.patterns
    );
    assert_eq!(report.topology.fault(), None);
    assert_eq!(report.topology.boundary_euler, 2);
    assert!(report.after.min_dihedral_deg > low && report.after.max_dihedral_deg < high);
    assert!(report.outer_rms_mm < 0.5);
    for r in &report.regions {
        let allowed = if r.region == 0 { 0.5 } else { 1.0 };
        assert!(
            r.error_percent.unwrap().abs() < allowed && r.components == 1,
            "{r:?}"
        );
    }
    assert!(
        report
            .interfaces
            .iter()
            .all(|i| i.rms_edges < 0.1 && i.faces > 100)
    );
    assert!(report.topology.interfaces.iter().all(|i| i.open_edges == 0));
}

#[test]
fn kidney_is_stuffed_near_the_target() {
    let kidney = shapes::kidney([3.0, -7.0, 11.0]);
    let (lo, hi) = kidney.bounds();
    let volume = counted(lo, hi, |p| kidney.value(p) < 0.0);
    let (_, report) = build_fem(&kidney, &[], &[volume], &FemParams::default()).unwrap();
    check(&report, 25.0, 125.0);
    assert!(report.before.min_dihedral_deg > 15.0 && report.before.max_dihedral_deg < 150.0);
}

/// Kidney with a ball of tumour: within it, bulging out of it, or touching its surface from within.
#[test]
fn tumours_get_faces_of_their_own() {
    let c = [3.0, -7.0, 11.0];
    let kidney = shapes::kidney(c);
    let (lo, hi) = kidney.bounds();
    for (centre, radius, low, high) in [
        ([6.0, -6.0, 30.0], 7.5, 22.0, 130.0),
        ([25.0, -7.0, 20.0], 15.0, 15.0, 160.0),
        ([3.0, 4.5, 11.0], 10.5, 12.0, 160.0),
    ] {
        let ball = shapes::ball(centre, radius);
        let organ = shapes::Shape {
            value: |p| kidney.value(p).min(ball.value(p)),
            lo: std::array::from_fn(|a| lo[a].min(centre[a] - radius)),
            hi: std::array::from_fn(|a| hi[a].max(centre[a] + radius)),
        };
        // Outside of the kidney the divider opens like a funnel, so that it crosses the organ's surface.
        let divider = shapes::Shape {
            value: |p| ball.value(p) - 2.0 * kidney.value(p).max(0.0),
            lo: organ.lo,
            hi: organ.hi,
        };
        let whole = counted(organ.lo, organ.hi, |p| organ.value(p) < 0.0);
        let tumour = counted(organ.lo, organ.hi, |p| {
            organ.value(p) < 0.0 && divider.value(p) < 0.0
        });
        let (mesh, report) = build_fem(&organ, &[&divider], &[whole, tumour], &FemParams::default()).unwrap();
        check(&report, low, high);
        let again = build_fem(&organ, &[&divider], &[whole, tumour], &FemParams::default())
            .unwrap()
            .0;
        assert_eq!(mesh, again);
    }
}

/// A bulging ball halved into two structures that touch: organ, structure, structure and outside meet.
#[test]
fn structures_that_touch_share_faces() {
    let c = [3.0, -7.0, 11.0];
    let kidney = shapes::kidney(c);
    let (lo, hi) = kidney.bounds();
    let centre = [25.0, -7.0, 20.0];
    let ball = shapes::ball(centre, 15.0);
    let organ = shapes::Shape {
        value: |p| kidney.value(p).min(ball.value(p)),
        lo: std::array::from_fn(|a| lo[a].min(centre[a] - 15.0)),
        hi: std::array::from_fn(|a| hi[a].max(centre[a] + 15.0)),
    };
    let side = |p: [f64; 3]| (p[2] - centre[2] + 0.3 * (p[0] - centre[0])) / 1.09f64.sqrt();
    let half = |sign: f64| shapes::Shape {
        value: move |p| {
            let funnel = ball_value(p, centre) - 2.0 * shapes::kidney_value(p, c).max(0.0);
            funnel.max(sign * side(p))
        },
        lo: organ.lo,
        hi: organ.hi,
    };
    let (one, two) = (half(1.0), half(-1.0));
    let whole = counted(organ.lo, organ.hi, |p| organ.value(p) < 0.0);
    let volume = |d: &dyn Implicit| counted(organ.lo, organ.hi, |p| organ.value(p) < 0.0 && d.value(p) < 0.0);
    let volumes = [whole, volume(&one), volume(&two)];
    let (_, report) = build_fem(&organ, &[&one, &two], &volumes, &FemParams::default()).unwrap();
    check(&report, 12.0, 160.0);
    let between: Vec<[u16; 2]> = report.topology.interfaces.iter().map(|i| i.regions).collect();
    assert_eq!(between, [[0, 1], [0, 2], [1, 2]]);
}

#[test]
fn graded_interior_is_coarser_and_conforms() {
    let kidney = shapes::kidney([3.0, -7.0, 11.0]);
    let (lo, hi) = kidney.bounds();
    let ball = shapes::ball([6.0, -6.0, 30.0], 9.0);
    let tumour = shapes::Shape {
        value: |p| ball.value(p),
        lo,
        hi,
    };
    let whole = counted(lo, hi, |p| kidney.value(p) < 0.0);
    let volumes = [whole, 4.0 / 3.0 * std::f64::consts::PI * 729.0];
    let params = FemParams {
        graded: true,
        edge_mm: Some(2.8),
        lattice_shifts: 1,
        ..FemParams::default()
    };
    let (_, report) = build_fem(&kidney, &[&tumour], &volumes, &params).unwrap();
    assert_eq!(report.topology.fault(), None);
    assert!(
        report.patterns.iter().all(|p| p.violations == 0),
        "{:?}",
        report.patterns
    );
    assert!(report.after.min_dihedral_deg > 22.0 && report.after.max_dihedral_deg < 130.0);
    assert!(
        report
            .regions
            .iter()
            .all(|r| r.error_percent.unwrap().abs() < 0.5 && r.components == 1)
    );
    assert!(report.topology.interfaces.iter().all(|i| i.open_edges == 0));
    let coarse = report.patterns.last().unwrap();
    assert!(
        coarse.pattern == "graded" && coarse.tets > 500 && coarse.violations == 0,
        "{coarse:?}"
    );
    let uniform = 12.0 * whole / report.edge_mm.powi(3);
    println!(
        "edge {:.2}: {} tets instead of {uniform:.0}",
        report.edge_mm, report.tets
    );
    assert!((report.tets as f64) < 0.8 * uniform);
}

fn ball_value(p: [f64; 3], c: [f64; 3]) -> f64 {
    (0..3).map(|a| (p[a] - c[a]).powi(2)).sum::<f64>().sqrt() - 15.0
}

#[test]
fn thin_layers_are_tagged() {
    let kidney = shapes::kidney([0.0; 3]);
    let (lo, hi) = kidney.bounds();
    let layer = shapes::Shape {
        value: |p: [f64; 3]| (p[2] - 5.1).abs() - 0.75,
        lo,
        hi,
    };
    let whole = counted(lo, hi, |p| kidney.value(p) < 0.0);
    let thin = counted(lo, hi, |p| kidney.value(p) < 0.0 && layer.value(p) < 0.0);
    let (mesh, report) = build_fem(&kidney, &[&layer], &[whole, thin], &FemParams::default()).unwrap();
    assert_eq!(report.regions[1].mode, StructureMode::Tagged);
    assert!(
        (report.tagged[0].thickness_mm - 1.5).abs() < 0.05,
        "{:?}",
        report.tagged
    );
    assert_eq!(report.tagged[0].tet_fraction.len(), mesh.tets.len());
    assert!(mesh.regions.iter().all(|&r| r == 0));
    assert!(
        report.regions[1].error_percent.unwrap().abs() < 3.0,
        "{:?}",
        report.regions
    );
}

#[test]
fn embedding_holds_every_point_once() {
    let kidney = shapes::kidney([3.0, -7.0, 11.0]);
    let (mesh, report) = build_embedding(&kidney, &EmbeddingParams::default()).unwrap();
    println!(
        "{} tets, edge {:.2}, filled {}",
        mesh.tets.len(),
        report.edge_mm,
        report.filled_tets
    );
    assert!((mesh.tets.len() as f64 / 2200.0 - 1.0).abs() < 0.1);
    assert!((report.quality.min_dihedral_deg - 60.0).abs() < 1e-6);
    assert!((report.quality.max_dihedral_deg - 90.0).abs() < 1e-6);
    let locator = TetLocator::new(&mesh);
    let (lo, hi) = kidney.bounds();
    let mut inside = 0;
    let steps: [usize; 3] = std::array::from_fn(|a| (hi[a] - lo[a]) as usize + 2);
    for n in 0..steps.iter().product() {
        let ijk = [n % steps[0], n / steps[0] % steps[1], n / (steps[0] * steps[1])];
        let p = std::array::from_fn(|a| lo[a] + ijk[a] as f64);
        if kidney.value(p) <= 0.0 {
            inside += 1;
            let (tet, w) = locator.locate(p).expect("every organ point lies in a tet");
            let q: [f64; 3] = std::array::from_fn(|a| {
                (0..4)
                    .map(|i| w[i] * mesh.vertices[mesh.tets[tet][i] as usize][a])
                    .sum()
            });
            assert!((0..3).all(|a| (p[a] - q[a]).abs() < 1e-9));
        }
    }
    assert!(inside > 50_000);
    // Lattice points belong to up to 24 tets: the smallest index wins.
    for v in 0..mesh.vertices.len() {
        let (tet, _) = locator.locate(mesh.vertices[v]).unwrap();
        let least = mesh.tets.iter().position(|t| t.contains(&(v as u32))).unwrap();
        assert_eq!(tet, least);
    }
    assert!(locator.locate([1e3; 3]).is_none() && locator.locate([f64::NAN; 3]).is_none());
}
