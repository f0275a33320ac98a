//! Times rapier3d's shape-matching clusters on a package's particles and clusters, 3 solver iterations (substeps) of 9
//! internal passes a step, no contacts. Usage: peer-rapier PACKAGE [STEPS].

use std::io::{Cursor, Read};
use std::time::Instant;

use ndarray::{Array1, Array2};
use ndarray_npy::ReadNpyExt;
use rapier3d::prelude::*;

fn bytes(archive: &mut zip::ZipArchive<std::fs::File>, name: &str) -> Cursor<Vec<u8>> {
    let mut out = Vec::new();
    archive
        .by_name(name)
        .expect(name)
        .read_to_end(&mut out)
        .expect(name);
    Cursor::new(out)
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let steps = args.get(2).map_or(60, |s| s.parse().expect("steps"));
    let mut archive = zip::ZipArchive::new(std::fs::File::open(&args[1]).expect("package")).expect("zip");
    let x = Array2::<f32>::read_npy(bytes(&mut archive, "particles/positions.npy")).expect("positions");
    let offsets = Array1::<u32>::read_npy(bytes(&mut archive, "clusters/offsets.npy")).expect("offsets");
    let members = Array1::<u32>::read_npy(bytes(&mut archive, "clusters/members.npy")).expect("members");
    let points: Vec<Vector> = x
        .rows()
        .into_iter()
        .map(|p| Vector::new(p[0], p[1], p[2]))
        .collect();
    let mut world = PhysicsWorld::new();
    world.integration_parameters.dt = 1.0 / 60.0;
    world.integration_parameters.num_solver_iterations = 3;
    world.integration_parameters.num_internal_pgs_iterations = 9;
    let body = SoftBodyBuilder::new(points.clone())
        .particle_mass(1.0)
        .no_surface_collider()
        .self_contacts(false)
        .shape_matching(false)
        .can_sleep(false);
    let handle = world.insert_soft_body(body);
    for c in 0..offsets.len() - 1 {
        let list = &members.as_slice().expect("flat")[offsets[c] as usize..offsets[c + 1] as usize];
        let index = world
            .soft_bodies
            .add_cluster(handle, list, &mut world.bodies, &mut world.colliders)
            .expect("cluster");
        world.soft_bodies[handle].enable_cluster_shape_matching(index, true);
    }
    world.step();
    let mut times: Vec<f64> = (0..steps)
        .map(|_| {
            let t = Instant::now();
            world.step();
            t.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    let body = &world.soft_bodies[handle];
    assert!((0..points.len()).all(|i| body.particle_position(i).is_finite()));
    times.sort_by(f64::total_cmp);
    println!(
        "rapier3d: {} particles, {} clusters, {} memberships, {} threads: min {:.2}, median {:.2} ms a step",
        points.len(),
        offsets.len() - 1,
        members.len(),
        std::env::var("RAYON_NUM_THREADS").unwrap_or_else(|_| "all".into()),
        times[0],
        times[times.len() / 2]
    );
}
