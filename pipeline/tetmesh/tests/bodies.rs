//! The stages on analytic bodies with known answers.

use palpate_fixtures::shapes;
use palpate_tetmesh::{EmbeddingParams, FemParams, TetLocator, build_embedding, build_fem};
use palpate_volume::Implicit;

#[test]
fn kidney_is_stuffed_near_the_target() {
    let kidney = shapes::kidney([3.0, -7.0, 11.0]);
    let (mesh, report) = build_fem(&kidney, &[], &[], &FemParams::default()).unwrap();
    println!(
        "{} tets, {} vertices, edge {:.2}",
        mesh.tets.len(),
        mesh.vertices.len(),
        report.edge_mm
    );
    println!(
        "{:.2} … {:.2}, {:?}",
        report.before.min_dihedral_deg, report.before.max_dihedral_deg, report.patterns
    );
    assert!((mesh.tets.len() as f64 / 13_000.0 - 1.0).abs() < 0.1);
    assert!(report.patterns.iter().all(|p| p.violations == 0));
    assert!(report.topology.fault().is_none() && report.topology.boundary_euler == 2);
    assert!(report.before.min_dihedral_deg > 15.0 && report.before.max_dihedral_deg < 150.0);
    assert!(report.outer_rms_mm < 0.5);
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
