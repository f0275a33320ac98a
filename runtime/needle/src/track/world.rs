//! What a change in the material does to the deformed mesh: in a dent a tet that is fair at rest may be flat or turned over.

use super::locate::state_at;
use super::overlay::{NEW, Overlay};
use super::quality::volume;
use glam::DVec3;
use palpate_fem::{Simulation, Tet};

/// Share of its volume from which a tet is upright enough.
const UPRIGHT: f64 = 0.3;

/// World places of the nodes that an overlay moves or makes.
#[derive(Clone, Default)]
pub(super) struct World {
    places: Vec<(u32, DVec3)>,
}

impl World {
    /// Of all nodes that an overlay has moved; `tip` goes where the needle's tip is.
    pub fn of(sim: &Simulation, overlay: &Overlay, tip: u32, at: Option<DVec3>) -> Self {
        let mut world = Self::default();
        for &(node, rest) in &overlay.moved {
            match at.filter(|_| node == tip) {
                Some(p) => world.places.push((node, p)),
                None => world.follow(sim, overlay, node, rest),
            }
        }
        world
    }

    /// A node goes with the tissue that is at a place of the material.
    pub fn follow(&mut self, sim: &Simulation, overlay: &Overlay, node: u32, rest: DVec3) {
        // A node that is only about to be made has no tets to look in yet.
        let near = match node {
            NEW => overlay
                .removed
                .first()
                .and_then(|&t| sim.mesh().tet(t))
                .map(|t| t.corners[0]),
            _ => Some(node),
        };
        if let Some(state) = near.and_then(|n| state_at(sim, rest, n)) {
            self.places.retain(|p| p.0 != node);
            self.places.push((node, state.position));
        }
    }

    fn place(&self, sim: &Simulation, node: u32) -> DVec3 {
        let moved = self.places.iter().find(|p| p.0 == node);
        moved.map_or_else(
            || sim.positions().get(node as usize).copied().unwrap_or(DVec3::NAN),
            |p| p.1,
        )
    }

    /// Least world volume over rest volume of some tets, no more than 0.3: more of it is as good.
    pub fn upright(&self, sim: &Simulation, overlay: &Overlay, tets: impl IntoIterator<Item = Tet>) -> f64 {
        tets.into_iter().fold(UPRIGHT, |least, t| {
            let now = volume(t.corners.map(|n| self.place(sim, n)));
            let ratio = now / volume(overlay.shape(t));
            if ratio.is_nan() {
                f64::NEG_INFINITY
            } else {
                least.min(ratio)
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_fem::{Material, Settings, TissueMesh};

    /// One tet, its corner at the origin pressed to half its height in the world.
    #[test]
    fn upright_is_judged_in_the_world() {
        let points = [[0.0; 3], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]];
        let mesh = TissueMesh::new(&points, &[[0, 1, 2, 3]], &[0]).unwrap();
        let mut sim = Simulation::new(mesh, vec![Material::default()], Settings::default()).unwrap();
        let tet = sim.mesh().tets().next().unwrap().1;
        // Slots are in an order of the mesh's own.
        let top = (0..4).find(|&n| sim.mesh().rest()[n as usize].z == 2.0).unwrap();
        let ratio = |sim: &Simulation, overlay: &Overlay, at| {
            let world = World::of(sim, overlay, top, at);
            world.upright(sim, overlay, [tet])
        };
        let rest = Overlay::new(sim.mesh());
        assert_eq!(ratio(&sim, &rest, None), UPRIGHT);
        for (height, expected) in [(1.0, UPRIGHT), (0.2, 0.1), (0.0, 0.0), (-0.4, -0.2)] {
            let x = DVec3::new(0.0, 0.0, height);
            sim.set_state(top, x, DVec3::ZERO, DVec3::ZERO).unwrap();
            let rest = Overlay::new(sim.mesh());
            assert!((ratio(&sim, &rest, None) - expected).abs() < 1e-12, "{height}");
            // A node that goes with the tissue takes the deformation along; one at a place of its own need not.
            let mut moved = Overlay::new(sim.mesh());
            moved.move_to(top, DVec3::new(0.3, 0.1, 1.0));
            assert!((ratio(&sim, &moved, None) - expected).abs() < 1e-12, "{height}");
            let own = ratio(&sim, &moved, Some(DVec3::new(0.0, 0.0, -0.1)));
            assert!((own + 0.1).abs() < 1e-12, "{own}");
        }
    }
}
