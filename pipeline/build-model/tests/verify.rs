//! Every check of `verify` can warn or fail: a sound package, damaged on purpose one way at a time. What no package
//! can be written with (inverted tets, flat clusters, open surfaces) is tested in the package crate.

use build_model::{Inputs, Progress, Recipe, build, verify};
use palpate_fixtures::nifti::{NiftiOptions, NiftiType, nifti_bytes};
use palpate_fixtures::phantoms::{self, TumourPlace};
use palpate_package::{Check, Clusters, Mark, ModelPackage, VerifyReport};
use palpate_volume::RegionSelection;
use std::process::Command;
use std::sync::OnceLock;

/// A kidney with an inner tumour on a cradle.
fn sound() -> &'static ModelPackage {
    static MODEL: OnceLock<ModelPackage> = OnceLock::new();
    MODEL.get_or_init(|| {
        let p = phantoms::kidney([1.6, 1.6, 2.0], TumourPlace::Inner);
        let dir = tempfile::tempdir().unwrap();
        let scan = dir.path().join("kidney.nii");
        let bytes = nifti_bytes(
            p.dims,
            &p.affine,
            NiftiType::U8,
            &p.labels,
            &NiftiOptions::default(),
        );
        std::fs::write(&scan, bytes).unwrap();
        let region = |name: &str, label| RegionSelection {
            name: name.into(),
            labels: vec![label],
        };
        let mut recipe = Recipe::default();
        recipe.selection.organ = region("kidney", 1);
        recipe.selection.structures = vec![region("tumour", 2)];
        recipe.selection.supports = vec![region("cradle", 3)];
        recipe.fem.target_tets = 4000;
        recipe.surface.target_faces = 2000;
        let inputs = Inputs {
            scan,
            ct: None,
            fiducials: None,
        };
        build(&inputs, &recipe, &Progress::new(true)).unwrap().package
    })
}

fn report(model: &ModelPackage) -> VerifyReport {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("model.palpate");
    std::fs::write(&path, model.to_bytes().unwrap().0).unwrap();
    verify::verify(&path).unwrap()
}

fn find<'a>(report: &'a VerifyReport, what: &str, entry: &str) -> &'a Check {
    let found = report.checks.iter().find(|c| c.what == what && c.entry == entry);
    found.unwrap_or_else(|| panic!("no check {what:?} of {entry:?} in\n{report}"))
}

#[test]
fn a_sound_package_passes_and_every_figure_is_there() {
    let r = report(sound());
    assert!(r.passed() && r.warnings().next().is_none(), "{r}");
    for (what, entry) in [
        ("surface does not cross itself", "cradle"),
        ("boundary does not cross itself", "fem"),
        ("collision surface lies on the FEM boundary", "kidney"),
        ("FEM boundary lies on the collision surface", "fem"),
        ("surface follows the labels", "tumour"),
        ("particles fill the organ", "particles"),
        ("clusters reach across no gap", "clusters"),
        ("skin hangs on clusters nearby", "tumour"),
        ("organ lies outside of the support", "cradle"),
        ("smallest triangle angle", "kidney"),
        ("mean triangle quality", "kidney"),
        ("smallest dihedral angle", "fem"),
        ("tet volumes are positive", "fem/tets.npy"),
        ("skinned points stay in the rest pose", "embedding"),
        ("rest shapes are well conditioned", "clusters/rest_local.npy"),
    ] {
        assert!(find(&r, what, entry).worst.is_some(), "{what}");
    }
}

fn shift(points: &mut [[f32; 3]], by: [f32; 3]) {
    for p in points {
        for a in 0..3 {
            p[a] += by[a];
        }
    }
}

fn scale(points: &mut [[f32; 3]], by: [f32; 3]) {
    for p in points {
        for a in 0..3 {
            p[a] *= by[a];
        }
    }
}

/// Other clusters, every skin on the first of them.
fn recluster(m: &mut ModelPackage, lists: &[Vec<u32>]) {
    let mut offsets = vec![0];
    for l in lists {
        offsets.push(offsets[offsets.len() - 1] + l.len() as u32);
    }
    m.clusters = Clusters::new(&m.particles, offsets, lists.concat(), vec![0; lists.len()]).unwrap();
    let skins = m.surfaces.iter_mut().filter_map(|s| s.skin.as_mut());
    for skin in skins.chain([&mut m.embedding.skin]) {
        skin.indices.fill([0; 4]);
        skin.weights.fill([1.0, 0.0, 0.0, 0.0]);
    }
}

/// Keeps some particles, as one cluster.
fn keep(m: &mut ModelPackage, kept: impl Fn([f32; 3]) -> bool) {
    let old = m.particles.clone();
    let rows: Vec<usize> = (0..old.positions.len())
        .filter(|&i| kept(old.positions[i]))
        .collect();
    m.particles.positions = rows.iter().map(|&i| old.positions[i]).collect();
    m.particles.region = rows.iter().map(|&i| old.region[i]).collect();
    m.particles.creation_order = (0..rows.len() as u32).collect();
    recluster(m, &[(0..rows.len() as u32).collect()]);
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>().sqrt()
}

/// Particles by distance from `p`.
fn by_distance(m: &ModelPackage, p: [f32; 3]) -> Vec<u32> {
    let mut all: Vec<u32> = (0..m.particles.positions.len() as u32).collect();
    let d = |i: &u32| distance(m.particles.positions[*i as usize], p);
    all.sort_by(|a, b| d(a).total_cmp(&d(b)));
    all
}

/// Moves one corner of a tet close to the opposite face, where all tets around it stay positive.
fn flatten_a_tet(m: &mut ModelPackage) {
    let f = &mut m.fem;
    let volume = |v: &[[f32; 3]], t: &[u32; 4]| {
        let [a, b, c, d] = t.map(|i| v[i as usize].map(f64::from));
        let e = |p: [f64; 3]| [p[0] - a[0], p[1] - a[1], p[2] - a[2]];
        let (u, w, x) = (e(b), e(c), e(d));
        u[0] * (w[1] * x[2] - w[2] * x[1])
            + u[1] * (w[2] * x[0] - w[0] * x[2])
            + u[2] * (w[0] * x[1] - w[1] * x[0])
    };
    for t in f.tets.clone() {
        let at = t[3] as usize;
        let before = f.vertices[at];
        f.vertices[at] = std::array::from_fn(|a| {
            let foot = (0..3).map(|k| f.vertices[t[k] as usize][a]).sum::<f32>() / 3.0;
            foot + 0.1 * (before[a] - foot)
        });
        let sound = |o: &[u32; 4]| !o.contains(&t[3]) || volume(&f.vertices, o) > 1e-3;
        if f.tets.iter().all(sound) {
            return;
        }
        f.vertices[at] = before;
    }
    panic!("no corner of any tet can be moved");
}

type Damage = fn(&mut ModelPackage);

const DAMAGES: &[(Mark, &str, &str, Damage)] = &[
    (Mark::Fails, "surface does not cross itself", "kidney", |m| {
        let far = m.surfaces[0].vertices[0].map(|c| -1.2 * c);
        m.surfaces[0].vertices[0] = far;
    }),
    (Mark::Warns, "boundary does not cross itself", "fem", |m| {
        let (mut copy, n) = (m.fem.clone(), m.fem.vertices.len() as u32);
        shift(&mut copy.vertices, [9.0, 3.0, 1.0]);
        m.fem.vertices.extend(copy.vertices);
        m.fem.tets.extend(copy.tets.iter().map(|t| t.map(|v| v + n)));
        m.fem.regions.extend(copy.regions);
    }),
    (
        Mark::Warns,
        "collision surface lies on the FEM boundary",
        "kidney",
        |m| scale(&mut m.fem.vertices, [0.75; 3]),
    ),
    (
        Mark::Fails,
        "collision surface lies on the FEM boundary",
        "kidney",
        |m| shift(&mut m.fem.vertices, [80.0, 0.0, 0.0]),
    ),
    (
        Mark::Warns,
        "FEM boundary lies on the collision surface",
        "fem",
        |m| scale(&mut m.fem.vertices, [1.3; 3]),
    ),
    (Mark::Warns, "surface follows the labels", "kidney", |m| {
        shift(&mut m.surfaces[0].vertices, [2.5, 0.0, 0.0]);
    }),
    (Mark::Fails, "surface follows the labels", "tumour", |m| {
        shift(&mut m.surfaces[1].vertices, [12.0, 0.0, 0.0]);
    }),
    (Mark::Warns, "particles fill the organ", "particles", |m| {
        let hole = m.particles.positions[by_distance(m, [0.0; 3])[0] as usize];
        keep(m, |p| distance(p, hole) > 3.2);
    }),
    (Mark::Fails, "particles fill the organ", "particles", |m| {
        keep(m, |p| p[2] < 0.0);
    }),
    (
        Mark::Fails,
        "particle spacing fits their number",
        "particles",
        |m| m.particles.radius_mm *= 10.0,
    ),
    (
        Mark::Warns,
        "particle spacing fits their number",
        "particles",
        |m| m.particles.radius_mm *= 1.4,
    ),
    (Mark::Warns, "clusters reach across no gap", "clusters", |m| {
        // Both ends of the kidney without its middle in one cluster.
        let order = by_distance(m, [0.0, 0.0, 60.0]);
        let all: Vec<u32> = (0..order.len() as u32).collect();
        let fifth = order.len() / 5;
        let ends = [&order[..2 * fifth], &order[3 * fifth..]].concat();
        recluster(m, &[all, ends]);
    }),
    (Mark::Warns, "the cluster graph holds together", "clusters", |m| {
        let order = by_distance(m, [0.0, 0.0, 60.0]);
        let (a, b) = order.split_at(order.len() / 2);
        recluster(m, &[a.to_vec(), b.to_vec()]);
    }),
    (Mark::Warns, "skin hangs on clusters nearby", "kidney", |m| {
        let p = m.surfaces[0].vertices[0];
        let centres = &m.clusters.rest_centres;
        let far = (0..centres.len())
            .max_by(|&a, &b| distance(centres[a], p).total_cmp(&distance(centres[b], p)))
            .unwrap();
        let skin = m.surfaces[0].skin.as_mut().unwrap();
        skin.indices[0] = [far as u32; 4];
        skin.weights[0] = [1.0, 0.0, 0.0, 0.0];
    }),
    (
        Mark::Fails,
        "skinned points stay in the rest pose",
        "kidney",
        |m| {
            let s = &mut m.surfaces[0];
            let reach = |p: &[f32; 3]| distance(*p, [0.0; 3]);
            let far = (0..s.vertices.len())
                .max_by(|&a, &b| reach(&s.vertices[a]).total_cmp(&reach(&s.vertices[b])))
                .unwrap();
            s.skin.as_mut().unwrap().weights[far] = [1.0 - 9e-6, 0.0, 0.0, 0.0];
        },
    ),
    (Mark::Warns, "organ lies outside of the support", "cradle", |m| {
        shift(&mut m.surfaces[2].vertices, [0.0, 2.5, 0.0])
    }),
    (Mark::Fails, "organ lies outside of the support", "cradle", |m| {
        shift(&mut m.surfaces[2].vertices, [0.0, 14.0, 0.0])
    }),
    (Mark::Warns, "smallest triangle angle", "tumour", |m| {
        let s = &mut m.surfaces[1];
        let [a, b, _] = s.triangles[0].map(|v| v as usize);
        s.vertices[a] =
            std::array::from_fn(|k| s.vertices[b][k] + 0.05 * (s.vertices[a][k] - s.vertices[b][k]));
    }),
    (Mark::Warns, "mean triangle quality", "tumour", |m| {
        scale(&mut m.surfaces[1].vertices, [1.0, 1.0, 0.3]);
    }),
    (Mark::Warns, "smallest dihedral angle", "fem", flatten_a_tet),
    (Mark::Warns, "largest dihedral angle", "fem", flatten_a_tet),
    (Mark::Warns, "FEM volume beside the organ surface's", "fem", |m| {
        scale(&mut m.fem.vertices, [1.01; 3])
    }),
];

#[test]
fn every_check_can_warn_or_fail() {
    for (mark, what, entry, damage) in DAMAGES {
        let mut model = sound().clone();
        damage(&mut model);
        let checks = report(&model);
        let found = find(&checks, what, entry);
        assert_eq!(found.mark, *mark, "{what} of {entry}\n{checks}");
        assert!(!found.fault.is_empty(), "{what} says nothing");
    }
}

#[test]
fn the_command_exits_1_and_names_the_place() {
    let dir = tempfile::tempdir().unwrap();
    let run = |name: &str, model: &ModelPackage| {
        let path = dir.path().join(name);
        std::fs::write(&path, model.to_bytes().unwrap().0).unwrap();
        let out = Command::new(env!("CARGO_BIN_EXE_build-model"))
            .arg("verify")
            .arg(&path)
            .output()
            .unwrap();
        let text = |b: &[u8]| String::from_utf8_lossy(b).into_owned();
        (out.status.code(), text(&out.stdout), text(&out.stderr))
    };
    let mut model = sound().clone();
    model.surfaces[0].vertices[0] = model.surfaces[0].vertices[0].map(|c| -1.2 * c);
    let (code, out, err) = run("crossing.palpate", &model);
    assert_eq!(code, Some(1), "{err}");
    assert!(out.contains("FAIL  surface does not cross itself"), "{out}");
    for part in ["triangles", "cross near (", "kidney", "crossing.palpate"] {
        assert!(err.contains(part), "{part} is not in {err}");
    }
    let mut model = sound().clone();
    scale(&mut model.fem.vertices, [1.01; 3]);
    let (code, out, _) = run("swollen.palpate", &model);
    assert_eq!(code, Some(0), "{out}");
    assert!(
        out.contains("WARN  FEM volume") && out.contains("0 failed, 1 warned"),
        "{out}"
    );
}
