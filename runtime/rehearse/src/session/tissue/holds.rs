//! Which nodes a scene holds.

use crate::scene::{Hold, Scene};
use glam::DVec3;
use palpate_fem::TissueMesh;

/// Node slots that the scene's support and holds keep in place, ascending. The mesh is in the world, `origin` its zero
/// point in patient mm.
pub(super) fn held(scene: &Scene, regions: &[String], mesh: &TissueMesh, origin: DVec3) -> Vec<u32> {
    let mut out = Vec::new();
    if scene.support == "cradle" {
        out.extend(bedded(
            mesh,
            scene.gravity.direction.unit(),
            scene.cradle.height_share,
        ));
    }
    for hold in &scene.holds {
        out.extend(by_entry(hold, regions, mesh, origin));
    }
    out.sort_unstable();
    out.dedup();
    out
}

/// A warning for each piece of the mesh of which nothing is held; `held` ascending.
pub(super) fn floating(mesh: &TissueMesh, held: &[u32], origin: DVec3) -> Vec<String> {
    if held.is_empty() {
        return vec!["Nothing holds the tissue: it floats away from what presses it. Add a [[hold]].".into()];
    }
    let free = |piece: &Vec<u32>| piece.iter().all(|n| held.binary_search(n).is_err());
    mesh.pieces()
        .into_iter()
        .filter(free)
        .map(|piece| {
            let sum: DVec3 = piece.iter().map(|&n| mesh.rest()[n as usize]).sum();
            let at = sum / piece.len() as f64 + origin;
            format!(
                "Nothing holds a piece of the tissue of {} nodes around ({:.1}, {:.1}, {:.1}) mm: it floats away from what presses it. \
                 Add a [[hold]].",
                piece.len(),
                at.x,
                at.y,
                at.z
            )
        })
        .collect()
}

/// Nodes of faces that look down and lie within the share of the height from the lowest point: what a mould bears.
fn bedded(mesh: &TissueMesh, down: DVec3, share: f64) -> Vec<u32> {
    let height = |n: u32| -mesh.rest()[n as usize].dot(down);
    let faces = mesh.boundary();
    let (lo, hi) = faces
        .iter()
        .flatten()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), &n| {
            (lo.min(height(n)), hi.max(height(n)))
        });
    let top = lo + share * (hi - lo);
    faces
        .into_iter()
        .filter(|f| {
            let [a, b, c] = f.map(|n| mesh.rest()[n as usize]);
            (b - a).cross(c - a).dot(down) > 0.0 && f.iter().all(|&n| height(n) <= top)
        })
        .flatten()
        .collect()
}

fn by_entry(hold: &Hold, regions: &[String], mesh: &TissueMesh, origin: DVec3) -> Vec<u32> {
    if let Some(name) = &hold.structure {
        let code = regions.iter().position(|r| r == name);
        return mesh
            .tets()
            .filter(|(_, t)| Some(usize::from(t.region)) == code)
            .flat_map(|(_, t)| t.corners)
            .collect();
    }
    if let (Some(side), Some(depth)) = (hold.side, hold.depth_mm) {
        return mesh.lowest_surface(side.unit(), depth);
    }
    let Some([lo, hi]) = hold.box_mm else {
        return Vec::new();
    };
    let (lo, hi) = (DVec3::from(lo) - origin, DVec3::from(hi) - origin);
    (0..mesh.node_slots() as u32)
        .filter(|&n| {
            let p = mesh.rest()[n as usize];
            mesh.has_node(n) && p.cmpge(lo).all() && p.cmple(hi).all()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Direction;
    use palpate_fixtures::tets::{TetBlock, tet_block};

    /// One row of cubes along y, four of 10 mm; region 1 is the last.
    fn bar() -> TissueMesh {
        let TetBlock { points, tets } = tet_block([0.0; 3], [10.0, 40.0, 10.0], [1, 4, 1]);
        let regions: Vec<u16> = (0..tets.len()).map(|t| u16::from(t / 6 == 3)).collect();
        TissueMesh::new(&points, &tets, &regions).unwrap()
    }

    fn heights(mesh: &TissueMesh, nodes: &[u32]) -> Vec<f64> {
        let mut out: Vec<f64> = nodes.iter().map(|&n| mesh.rest()[n as usize].y).collect();
        out.sort_by(f64::total_cmp);
        out
    }

    #[test]
    fn supports_and_holds_say_which_nodes_stay() {
        let mesh = bar();
        let regions = ["kidney".to_string(), "bone".to_string()];
        let with = |support: &str, holds: Vec<Hold>| {
            let scene = Scene {
                support: support.into(),
                holds,
                ..Scene::default()
            };
            heights(&mesh, &held(&scene, &regions, &mesh, DVec3::new(100.0, 0.0, 0.0)))
        };
        // Gravity goes to −y: only the lower end looks down.
        assert_eq!(with("cradle", vec![]), [0.0; 4]);
        assert!(with("none", vec![]).is_empty());
        let bone = Hold {
            structure: Some("bone".into()),
            ..Hold::default()
        };
        assert_eq!(
            with("none", vec![bone.clone()]),
            [30.0, 30.0, 30.0, 30.0, 40.0, 40.0, 40.0, 40.0]
        );
        let side = Hold {
            side: Some(Direction::POSTERIOR),
            depth_mm: Some(12.0),
            ..Hold::default()
        };
        assert_eq!(
            with("none", vec![side]),
            [0.0, 0.0, 0.0, 0.0, 10.0, 10.0, 10.0, 10.0]
        );
        // Patient x is 100 more than the world's.
        let cube = Hold {
            box_mm: Some([[99.0, 15.0, -1.0], [101.0, 45.0, 11.0]]),
            ..Hold::default()
        };
        assert_eq!(with("none", vec![cube]), [20.0, 20.0, 30.0, 30.0, 40.0, 40.0]);
        assert_eq!(with("cradle", vec![bone]).len(), 12);
    }

    /// Of two bars only one is held: the other is told with its middle.
    #[test]
    fn a_piece_that_nothing_holds_is_told() {
        let one = bar();
        let n = one.rest().len() as u32;
        let mut points: Vec<[f64; 3]> = one.rest().iter().map(|p| p.to_array()).collect();
        let mut tets: Vec<[u32; 4]> = one.tets().map(|(_, t)| t.corners).collect();
        points.extend(one.rest().iter().map(|p| (*p + DVec3::X * 50.0).to_array()));
        tets.extend(tets.clone().iter().map(|t| t.map(|c| c + n)));
        let mesh = TissueMesh::new(&points, &tets, &vec![0; tets.len()]).unwrap();
        let near = |mesh: &TissueMesh, most: f64| -> Vec<u32> {
            (0..2 * n)
                .filter(|&k| mesh.rest()[k as usize].x <= most)
                .collect()
        };
        let told = floating(&mesh, &near(&mesh, 0.0), DVec3::new(0.0, 0.0, 100.0));
        assert_eq!(told.len(), 1, "{told:?}");
        assert!(
            told[0].contains("20 nodes around (55.0, 20.0, 105.0) mm"),
            "{told:?}"
        );
        assert!(floating(&mesh, &near(&mesh, 55.0), DVec3::ZERO).is_empty());
        assert!(floating(&mesh, &[], DVec3::ZERO)[0].starts_with("Nothing holds the tissue"));
    }
}
