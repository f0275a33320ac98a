//! What turns a needle besides its bevel: its base, its natural shape, the tissue that holds it. And what does not: the mesh.

mod common;

use common::gel::{gel_of, push};
use glam::DVec3;
use palpate_fem::{Material, Simulation};
use palpate_needle::{
    BaseMotion, Bicycle, BicycleParams, Insertion, InsertionParams, NeedleFriction, NeedleParams, PreBend,
    Rod,
};

/// A needle in a box of gel of 80 × 40 × 40 mm that is held at all sides but the one where it enters.
#[derive(Clone, Copy)]
struct Scene {
    edge: f64,
    /// Young's moduli before and behind x = 40 mm, Pa.
    youngs_modulus_pa: [f64; 2],
    degrees: f64,
    pre_bend: Option<PreBend>,
    /// Sideways motion of the base towards +y after 12 mm, mm.
    aside_mm: f64,
    depth_mm: f64,
}

const SCENE: Scene = Scene {
    edge: 5.0,
    youngs_modulus_pa: [10_000.0; 2],
    degrees: 0.0,
    pre_bend: None,
    aside_mm: 0.0,
    depth_mm: 50.0,
};

impl Scene {
    /// Path of the tip in the material.
    fn path(self) -> Vec<DVec3> {
        let count = |mm: f64| (mm / self.edge).round() as usize;
        let [soft, hard] = self.youngs_modulus_pa;
        let region = |u: DVec3| u16::from(u.x > 40.0);
        let cells = [count(80.0), count(40.0), count(40.0)];
        let like = gel_of(self.edge, cells, 1.0, 0, &region);
        let materials = [soft, hard].map(|youngs_modulus_pa| Material {
            youngs_modulus_pa,
            ..like.materials()[0]
        });
        let (mesh, settings) = (like.mesh().clone(), like.settings().clone());
        let mut tissue = Simulation::new(mesh, materials.to_vec(), settings).unwrap();
        for n in 0..tissue.mesh().node_slots() as u32 {
            let u = tissue.mesh().rest()[n as usize];
            if u.y.min(u.z) < 1e-9 || u.y.max(u.z) > 40.0 - 1e-9 || u.x > 80.0 - 1e-9 {
                tissue.hold(n, [true; 3]).unwrap();
            }
        }
        let mut s = Insertion::new(tissue, InsertionParams::default()).unwrap();
        let params = NeedleParams {
            pre_bend: self.pre_bend.into_iter().collect(),
            ..NeedleParams::default()
        };
        let mouth = DVec3::new(-11.0, 20.2, 20.3);
        let rod = Rod::in_sleeve(params, mouth, DVec3::X, -DVec3::Z, 5.0, 10.0, 4).unwrap();
        assert!((rod.tip_frame().m2 - DVec3::Y).length() < 1e-9);
        let friction = NeedleFriction {
            bevel_degrees: self.degrees,
            ..NeedleFriction::default()
        };
        s.add_needle(rod, friction).unwrap();
        let mut path = Vec::new();
        let mut run = |motion: BaseMotion, seconds: f64| {
            for _ in 0..(seconds / 0.02).round() as usize {
                path.extend(s.step(&[motion]).unwrap().needles[0].tip_material);
            }
        };
        run(push(20.0), 0.65);
        let aside = BaseMotion {
            velocity_mm_per_s: [0.0, 2.0 * self.aside_mm, 0.0],
            ..BaseMotion::default()
        };
        run(aside, 0.5);
        run(push(20.0), (self.depth_mm - 12.0) / 20.0);
        path
    }
}

/// Where a path crosses the plane at a depth, from its entry.
fn at_depth(p: &[DVec3], x: f64) -> DVec3 {
    let k = p.iter().position(|u| u.x > x).unwrap();
    p[k - 1].lerp(p[k], (x - p[k - 1].x) / (p[k].x - p[k - 1].x)) - p[0]
}

/// Slope dy/dx of a path between two depths.
fn slope(p: &[DVec3], from: f64, to: f64) -> f64 {
    (at_depth(p, to).y - at_depth(p, from).y) / (to - from)
}

/// Undisturbed, the path is that of the kinematic model with the length in which the needle bends, on tets of any size and at the first try.
#[test]
fn an_undisturbed_needle_runs_as_the_kinematic_model() {
    let run = |edge| {
        Scene {
            edge,
            degrees: 6.0,
            youngs_modulus_pa: [25_000.0; 2],
            depth_mm: 70.0,
            ..SCENE
        }
        .path()
    };
    let (fine, coarse) = (run(5.0), run(10.0));
    // Length for 25 kPa, ν 0.45 and a needle of 0.83 mm and 60 GPa.
    let tip_ahead_mm = 22.4;
    let params = BicycleParams {
        curvature_per_mm: 6f64.to_radians().tan() / tip_ahead_mm,
        tip_ahead_mm,
    };
    let mut model = Bicycle::new(params, fine[0], DVec3::X, DVec3::Y).unwrap();
    let mut kinematic = vec![model.tip()];
    for _ in 0..800 {
        model.advance(0.1, 0.0);
        kinematic.push(model.tip());
    }
    let [fine, coarse, kinematic] = [&fine, &coarse, &kinematic].map(|p| at_depth(p, 60.0));
    println!("{fine} {coarse} {kinematic}");
    assert!(kinematic.y > 12.0);
    assert!(fine.distance(kinematic) < 0.5, "{fine} {kinematic}");
    assert!(coarse.distance(kinematic) < 0.5, "{coarse} {kinematic}");
}

/// A lever about the tissue: a base that moves aside turns a shallow tip the other way, and the path goes on that way.
#[test]
fn a_base_pushed_aside_steers_a_shallow_needle() {
    let run = |aside_mm| Scene { aside_mm, ..SCENE }.path();
    let (still, up, down) = (run(0.0), run(3.0), run(-3.0));
    let [still, up, down] = [&still, &up, &down].map(|p| slope(p, 25.0, 45.0));
    println!("{still} {up} {down}");
    assert!(still.abs() < 0.01, "{still}");
    assert!(up < -0.03 && down > 0.03, "{up} {down}");
    assert!((up + down).abs() < 0.2 * (up - down).abs(), "{up} {down}");
}

/// The natural arc of a symmetric tip turns it in tissue too, by less than in the open.
#[test]
fn a_pre_bent_tip_steers() {
    let bend = PreBend {
        length_mm: 15.0,
        curvature_per_mm: [0.0, 0.01],
    };
    let bent = Scene {
        pre_bend: Some(bend),
        ..SCENE
    }
    .path();
    let (early, late) = (slope(&bent, 5.0, 20.0), slope(&bent, 30.0, 45.0));
    println!("{early} {late}");
    assert!(early > 0.02 && late > early + 0.02, "{early} {late}");
    assert!(at_depth(&bent, 45.0).z.abs() < 1.0);
}

/// Harder tissue bends a needle more: over a shorter length, for the same bevel.
#[test]
fn a_harder_layer_bends_the_path_more() {
    let run = |hard| {
        Scene {
            youngs_modulus_pa: [10_000.0, hard],
            degrees: 3.0,
            depth_mm: 75.0,
            ..SCENE
        }
        .path()
    };
    let bend = |p: &[DVec3]| slope(p, 60.0, 70.0) - slope(p, 45.0, 55.0);
    let (same, harder) = (bend(&run(10_000.0)), bend(&run(160_000.0)));
    println!("{same} {harder}");
    assert!(harder > 1.3 * same, "{harder} {same}");
}
