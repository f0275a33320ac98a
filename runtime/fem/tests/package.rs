//! A package's FEM mesh, from the file to steps and a VTU.

use glam::DVec3;
use palpate_fem::{Settings, Simulation, TissueMesh, TissueTable};
use palpate_package::ModelPackage;

#[test]
fn a_package_can_be_simulated() {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../fixtures/golden/small-schema1.palpate"
    );
    let package = ModelPackage::read(path).unwrap();
    let mesh = TissueMesh::from_package(&package).unwrap();
    // Every node and tet of the package is there, under another number.
    for (slot, tet) in mesh.tets() {
        let source = mesh.input_tet(slot).unwrap() as usize;
        let corners = tet.corners.map(|c| mesh.input_node(c).unwrap());
        assert_eq!(
            (corners, tet.region),
            (package.fem.tets[source], package.fem.regions[source])
        );
        for (c, n) in tet.corners.into_iter().zip(corners) {
            let p = package.fem.vertices[n as usize].map(f64::from);
            assert_eq!(mesh.rest()[c as usize], DVec3::from_array(p));
        }
    }
    assert_eq!(mesh.tets().count(), package.fem.tets.len());
    let spread = |of: &dyn Fn(u32) -> u32| {
        mesh.tets()
            .flat_map(|(_, t)| t.corners.map(|a| t.corners.map(|b| of(a).abs_diff(of(b)))))
            .flatten()
            .max()
    };
    assert!(
        spread(&|n| n) < spread(&|n| mesh.input_node(n).unwrap()),
        "the numbering is no closer than the package's"
    );
    let table = TissueTable::default();
    let names: Vec<String> = package
        .info
        .regions
        .iter()
        .map(|r| {
            if table.get(r).is_ok() {
                r.clone()
            } else {
                "kidney".into()
            }
        })
        .collect();
    let (materials, warnings) = table.materials(&names).unwrap();
    assert!(warnings.is_empty());
    let bed = mesh.lowest_surface(DVec3::NEG_Y, 8.0);
    assert!(bed.len() > 3);
    let (nodes, tets) = (mesh.node_slots(), mesh.tet_slots());
    let mut s = Simulation::new(mesh, materials, Settings::default()).unwrap();
    for n in bed {
        s.hold(n, [true; 3]).unwrap();
    }
    for _ in 0..50 {
        s.step().unwrap();
    }
    let sag = s
        .positions()
        .iter()
        .zip(s.mesh().rest())
        .map(|(x, p)| p.y - x.y)
        .fold(0.0, f64::max);
    assert!(sag > 1e-4, "{sag}");
    let vtu = s.to_vtu(DVec3::from_array(package.info.local_origin_mm));
    assert!(vtu.contains(&format!("NumberOfPoints=\"{nodes}\" NumberOfCells=\"{tets}\"")));
}
