//! Scan → package on bodies whose answers are known, and against golden records.

use build_model::args::BuildArgs;
use build_model::{Built, Recipe};
use palpate_fixtures::blocks;
use palpate_fixtures::phantoms::{self, Phantom, TumourPlace};
use palpate_surface::surface_distance;
use palpate_tests::{build_phantom, phantom_recipe};
use palpate_volume::Implicit;
use serde_json::{Value, json};
use std::path::Path;

fn figure(built: &Built, stage: &str, pointer: &str) -> Value {
    let s = built
        .stages
        .iter()
        .find(|s| s.name == stage)
        .unwrap_or_else(|| panic!("no stage {stage}"));
    s.report
        .pointer(pointer)
        .unwrap_or_else(|| panic!("{stage}{pointer} is not in\n{:#}", s.report))
        .clone()
}

fn record(built: &Built) -> Value {
    let round = |v: f64, digits: i32| (v * 10f64.powi(digits)).round() / 10f64.powi(digits);
    let surfaces: Vec<Value> = built
        .surfaces
        .iter()
        .map(|(name, mesh)| {
            let min_angle = figure(built, "surface", &format!("/{name}/min_angle_deg"))
                .as_f64()
                .unwrap();
            json!({
                "name": name,
                "faces": mesh.triangles.len(),
                "volume_mm3": round(mesh.volume_mm3(), 3),
                "euler": figure(built, "surface", &format!("/{name}/euler_number")),
                "min_angle_deg": round(min_angle, 2),
            })
        })
        .collect();
    let (_, digest) = built.package.to_bytes().unwrap();
    let quality = &built.fem_report.after;
    json!({
        "surfaces": surfaces,
        "particles": built.particles.positions.len(),
        "clusters": built.clusters.rest_centres.len(),
        "memberships": built.clusters.members.len(),
        "fem_tets": built.fem.tets.len(),
        "fem_vertices": built.fem.vertices.len(),
        "fem_dihedral_deg": [round(quality.min_dihedral_deg, 2), round(quality.max_dihedral_deg, 2)],
        "fem_volumes_mm3": built.fem_report.regions.iter().map(|r| round(r.volume_mm3, 2)).collect::<Vec<_>>(),
        "embedding_tets": built.embedding.tets.len(),
        "digest": digest,
    })
}

/// Compares with `golden/NAME.json`. Rewriting a record and adding one are two different acts.
fn golden(name: &str, found: &Value) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("golden/{name}.json"));
    let text = serde_json::to_string_pretty(found).unwrap() + "\n";
    let wanted = match std::fs::read_to_string(&path) {
        Ok(t) => t,
        Err(_) if std::env::var_os("PALPATE_ADD_GOLDEN").is_some() => {
            std::fs::write(&path, text).unwrap();
            return;
        }
        Err(e) => panic!(
            "no golden record {}: {e}; PALPATE_ADD_GOLDEN=1 adds it",
            path.display()
        ),
    };
    if wanted != text {
        if std::env::var_os("PALPATE_UPDATE_GOLDEN").is_some() {
            std::fs::write(&path, text).unwrap();
        } else {
            panic!(
                "{} differs; PALPATE_UPDATE_GOLDEN=1 rewrites it\nwas {wanted}\nis {text}",
                path.display()
            );
        }
    }
}

/// Builds, checks the known answers, and compares with the golden record. `percent`: how far voxels of this size may
/// be from the analytic volume.
fn check(name: &str, p: &Phantom, percent: f64) -> Built {
    let built = build_phantom(p, &phantom_recipe(p)).unwrap_or_else(|e| panic!("{name}: {e:#}"));
    let organ = &built.surfaces[0].1;
    let off = 100.0 * (organ.volume_mm3() / p.body_volume_mm3 - 1.0);
    assert!(
        off.abs() < percent,
        "{name}: volume {off:+.2} % off the analytic body's"
    );
    assert_eq!(
        figure(&built, "surface", "/organ/euler_number"),
        json!(p.euler),
        "{name}: Euler number"
    );
    for (body, _) in &built.surfaces {
        let at = |k: &str| figure(&built, "surface", &format!("/{body}/{k}"));
        assert_eq!(at("self_intersections"), json!(0), "{name} {body}");
        let (angle, quality) = (at("min_angle_deg").as_f64(), at("mean_quality").as_f64());
        assert!(angle >= Some(15.0), "{name} {body}: smallest angle {angle:?}°");
        assert!(quality >= Some(0.9), "{name} {body}: mean quality {quality:?}");
    }
    let fem: f64 = built.fem_report.regions.iter().map(|r| r.volume_mm3).sum();
    let off = 100.0 * (fem / p.body_volume_mm3 - 1.0);
    assert!(off.abs() < percent + 0.5, "{name}: FEM volume {off:+.2} % off");
    assert_eq!(built.fem_report.topology.fault(), None, "{name}");
    golden(name, &record(&built));
    built
}

#[test]
fn ball() {
    check("ball", &phantoms::ball([1.0; 3]), 0.6);
}

#[test]
fn thick_slices() {
    // Eight slices hold this ellipsoid to about 1.6 % by themselves.
    check("ellipsoid-thick", &phantoms::ellipsoid([0.7, 0.7, 5.0]), 2.0);
}

#[test]
fn torus_keeps_its_handle() {
    check("torus", &phantoms::torus([1.2; 3]), 1.0);
}

#[test]
fn touching_organs_are_one_body() {
    check("touching", &phantoms::touching([1.0; 3]), 1.0);
}

#[test]
fn one_of_a_pair() {
    check("pair", &phantoms::pair([1.0; 3]), 1.0);
}

#[test]
fn tumours_inside_bulging_and_outside() {
    for (place, name) in [
        (TumourPlace::Inner, "kidney-inner"),
        (TumourPlace::Bulging, "kidney-bulging"),
        (TumourPlace::Outer, "kidney-outer"),
    ] {
        let built = check(name, &phantoms::kidney([1.2, 1.2, 1.2], place), 0.8);
        let tumour = &built.fem_report.regions[1];
        let off = 100.0 * (tumour.volume_mm3 / phantoms::tumour_volume_mm3(place) - 1.0);
        assert!(
            off.abs() < 2.5,
            "{name}: tumour {off:+.2} % off the analytic ball"
        );
        assert!(tumour.error_percent.unwrap().abs() < 1.0, "{name}: {tumour:?}");
        for i in &built.fem_report.interfaces {
            assert!(i.rms_edges <= 0.1, "{name}: {i:?}");
        }
        assert!(built.particles.regions.contains(&1) && built.clusters.regions.contains(&1));
        assert_eq!(built.surfaces.len(), 3, "organ, tumour, support");
    }
}

/// The preset's names end on the right voxels: a swap of two labels keeps the body as it is, and only the volumes by
/// name tell.
#[test]
fn preset_names_go_with_their_volumes() {
    let place = TumourPlace::Bulging;
    let p = phantoms::kidney([1.2; 3], place);
    let mut recipe = Recipe::from_args(&BuildArgs {
        preset: Some("kits19".into()),
        ..BuildArgs::default()
    })
    .unwrap();
    recipe.particles.radius_mm = 3.3;
    recipe.fem.target_tets = 6000;
    let built = build_phantom(&p, &recipe).unwrap();
    let package = &built.package;
    let tumour = phantoms::tumour_volume_mm3(place);
    let voxel: f64 = p.affine.det().abs();
    for (name, volume) in [("kidney", p.body_volume_mm3 - tumour), ("tumour", tumour)] {
        let region = package.region(name).unwrap_or_else(|| panic!("no region {name}"));
        let tets = built
            .fem_report
            .regions
            .iter()
            .find(|r| r.region == usize::from(region))
            .unwrap();
        let label = package.labels.names.iter().position(|n| n == name).unwrap() + 1;
        let count = package
            .labels
            .data
            .iter()
            .filter(|&&v| usize::from(v) == label)
            .count();
        let particles = package.particles.region.iter().filter(|&&r| r == region).count();
        let share = particles as f64 / package.particles.positions.len() as f64;
        for (what, found, within) in [
            ("FEM region", tets.volume_mm3, 0.025),
            ("label crop", count as f64 * voxel, 0.01),
            ("particles", share * p.body_volume_mm3, 0.15),
        ] {
            let off = found / volume - 1.0;
            assert!(
                off.abs() < within,
                "{name}, {what}: {found:.0} mm³ instead of {volume:.0}"
            );
        }
    }
    let drawn = built
        .surfaces
        .iter()
        .find(|s| s.0 == "tumour")
        .unwrap()
        .1
        .volume_mm3();
    assert!(
        (drawn / tumour - 1.0).abs() < 0.02,
        "tumour surface: {drawn:.0} mm³ instead of {tumour:.0}"
    );
}

#[test]
fn cut_by_the_border() {
    let built = check("cut-kidney", &phantoms::cut_kidney([1.0; 3]), 1.0);
    let caps = &built.package.surfaces[0].caps;
    assert_eq!(caps.len(), 1, "{caps:?}");
    assert!(caps[0].normal[2] < -0.999, "the scan ends below: {caps:?}");
}

#[test]
fn a_sheet_is_not_eaten() {
    let p = phantoms::sheet([0.8; 3]);
    let mut recipe = phantom_recipe(&p);
    recipe.particles.radius_mm = 1.0;
    recipe.fem.target_tets = 40_000;
    let built = build_phantom(&p, &recipe).unwrap_or_else(|e| panic!("{e:#}"));
    let off = 100.0 * (built.surfaces[0].1.volume_mm3() / p.body_volume_mm3 - 1.0);
    assert!(
        off.abs() < 6.0,
        "volume {off:+.2} %: voxels of 0.8 mm hold a sheet of 2.4 mm to about ±5 %"
    );
    let (lo, hi) = built.surfaces[0]
        .1
        .vertices
        .iter()
        .fold(([f64::MAX; 3], [f64::MIN; 3]), |(lo, hi), v| {
            (
                std::array::from_fn(|a| lo[a].min(v[a])),
                std::array::from_fn(|a| hi[a].max(v[a])),
            )
        });
    for (a, wide) in [63.2, 53.2, 3.2].into_iter().enumerate() {
        assert!(
            (hi[a] - lo[a] - wide).abs() < 1.0,
            "axis {a}: {} instead of {wide} mm",
            hi[a] - lo[a]
        );
    }
}

/// `spacing_mm` and how far the zero sets may differ (mm).
fn stored_order(spacing_mm: [f64; 3], within_mm: f64) {
    let p = phantoms::kidney(spacing_mm, TumourPlace::Bulging);
    let recipe = phantom_recipe(&p);
    let a = build_phantom(&p, &recipe).unwrap();
    for (order, flip) in [
        ([2, 0, 1], [true, false, true]),
        ([1, 0, 2], [false, true, false]),
    ] {
        let b = build_phantom(&phantoms::reoriented(&p, order, flip), &recipe).unwrap();
        let (f, g) = (&a.anatomy.organ.field, &b.anatomy.organ.field);
        let off = (0..f.values.len())
            .map(|n| {
                f.position([
                    n % f.dims[0],
                    n / f.dims[0] % f.dims[1],
                    n / (f.dims[0] * f.dims[1]),
                ])
            })
            .filter(|p| f.value(*p).abs() < 0.5)
            .map(|p| (f.value(p) - g.value(p)).abs())
            .fold(0.0, f64::max);
        assert!(
            off < within_mm,
            "zero sets differ by {off} mm for {order:?} {flip:?}"
        );
        // The collapse takes edges in another order: the surfaces differ by as much as each does from the field.
        for ((name, x), (_, y)) in a.surfaces.iter().zip(&b.surfaces) {
            let d = surface_distance(x, y, 5000).unwrap().symmetric;
            assert!(
                d.rms_mm < 0.15 && d.max_mm < 1.5,
                "{name} {order:?} {flip:?}: {d:?}"
            );
        }
    }
}

#[test]
fn stored_order_of_the_axes_does_not_matter() {
    stored_order([1.2, 1.2, 1.2], 0.02);
}

#[test]
fn stored_order_of_thick_slices_does_not_matter() {
    stored_order([1.3, 1.3, 1.6], 0.02);
}

#[test]
fn oblique_and_sheared_grids_land_on_the_same_patient_points() {
    let c = [15.0, -40.0, 120.0];
    let axes = [26.0, 18.0, 34.0];
    let value = |p: [f64; 3]| palpate_fixtures::shapes::ellipsoid_value(p, c, axes);
    let lo = std::array::from_fn(|a| c[a] - axes[a]);
    let hi = std::array::from_fn(|a| c[a] + axes[a]);
    let (dims, affine, labels) = phantoms::oblique(lo, hi, 1.1, 33.0, 0.2, |p| u8::from(value(p) < 0.0));
    let p = Phantom {
        name: "oblique",
        dims,
        affine,
        labels,
        ct: None,
        body_volume_mm3: 4.0 / 3.0 * std::f64::consts::PI * axes.iter().product::<f64>(),
        euler: 2,
    };
    let built = build_phantom(&p, &phantom_recipe(&p)).unwrap_or_else(|e| panic!("{e:#}"));
    let mesh = &built.surfaces[0].1;
    let rms =
        (mesh.vertices.iter().map(|v| value(*v).powi(2)).sum::<f64>() / mesh.vertices.len() as f64).sqrt();
    assert!(rms < 0.2, "RMS {rms} mm to the analytic ellipsoid");
    let off = 100.0 * (mesh.volume_mm3() / p.body_volume_mm3 - 1.0);
    assert!(off.abs() < 0.8, "volume {off:+.2} %");
}

#[test]
fn threads_do_not_change_a_byte() {
    let p = phantoms::kidney([1.5; 3], TumourPlace::Bulging);
    let recipe = phantom_recipe(&p);
    let bytes = |threads: usize| {
        let pool = build_model::thread_pool(threads).unwrap();
        pool.install(|| build_phantom(&p, &recipe).unwrap().package.to_bytes().unwrap())
    };
    let one = bytes(1);
    assert!(one == bytes(2), "two threads give another package");
    assert!(one == bytes(5), "five threads give another package");
}

/// The bodies that needles are pushed through, built by the recipes bundled with them: those parts that are held or pierced have
/// tets of their own.
#[test]
fn bodies_for_needles() {
    let files = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/files");
    for (name, p, own) in [
        (
            "pelvis",
            blocks::pelvis([1.0; 3]),
            &["body", "prostate", "bladder", "bone"][..],
        ),
        ("gel", blocks::gel_block([2.0, 2.0, 1.5]), &["gel"]),
        ("cylinders", blocks::two_cylinders([1.0; 3]), &["gel", "cylinder"]),
    ] {
        let recipe = Recipe::read(&files.join(format!("{name}.toml"))).unwrap();
        let built = build_phantom(&p, &recipe).unwrap_or_else(|e| panic!("{name}: {e:#}"));
        let off = 100.0 * (built.surfaces[0].1.volume_mm3() / p.body_volume_mm3 - 1.0);
        assert!(off.abs() < 1.0, "{name}: volume {off:+.2} % off");
        for region in own {
            let n = built
                .package
                .region(region)
                .unwrap_or_else(|| panic!("{name}: no {region}"));
            let r = built
                .fem_report
                .regions
                .iter()
                .find(|r| r.region == usize::from(n))
                .unwrap();
            assert!(r.tets > 200, "{name}: {region} has {} tets", r.tets);
        }
        let (tets, aim) = (built.fem.tets.len() as f64, recipe.fem.target_tets as f64);
        assert!((tets / aim - 1.0).abs() < 0.15, "{name}: {tets} tets of {aim}");
        let quality = &built.fem_report.after;
        assert!(
            quality.min_dihedral_deg > 15.0 && quality.max_dihedral_deg < 150.0,
            "{name}"
        );
        golden(name, &record(&built));
    }
}
