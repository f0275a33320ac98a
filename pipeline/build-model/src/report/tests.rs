use super::*;
use palpate_fixtures::shapes::{Shape, kidney_value};
use palpate_particles::{ParticleParams, build_particles};
use palpate_surface::contour;
use palpate_tetmesh::{EmbeddingParams, FemParams, build_embedding, build_fem};
use palpate_volume::{
    Affine, Body, ComponentInfo, Implicit, RegionLabels, ScalarField, Structure, VoxelMask,
};

/// A kidney with a bulging tumour, a support under it, and all that a report shows.
struct Model {
    anatomy: Anatomy,
    ct: CtVolume,
    surfaces: Vec<(String, TriMesh)>,
    particles: ParticleSet,
    clusters: Clusters,
    fem: TetMesh,
    embedding: TetMesh,
}

fn tumour_value(p: [f64; 3]) -> f64 {
    (0..3)
        .map(|a| (p[a] - [19.0, 4.0, 16.0][a]).powi(2))
        .sum::<f64>()
        .sqrt()
        - 13.0
}

fn support_value(p: [f64; 3]) -> f64 {
    let q = [p[0].abs() - 34.0, (p[1] + 34.0).abs() - 6.0, p[2].abs() - 44.0];
    q.into_iter().fold(f64::NEG_INFINITY, f64::max)
}

fn model() -> Model {
    let wide = ([-40.0, -44.0, -60.0], [44.0, 34.0, 60.0]);
    let shape = |value: fn([f64; 3]) -> f64| Shape {
        value,
        lo: wide.0,
        hi: wide.1,
    };
    let organ_value = |p: [f64; 3]| kidney_value(p, [0.0; 3]).min(tumour_value(p));
    let spacing = 3.0;
    let field = |f: &dyn Implicit| ScalarField::sample(f, spacing, 2);
    let organ = field(&shape(organ_value));
    let (tumour, support) = (field(&shape(tumour_value)), field(&shape(support_value)));

    let voxel = [1.5, 1.5, 3.0];
    let dims: [usize; 3] = std::array::from_fn(|a| ((wide.1[a] - wide.0[a]) / voxel[a]) as usize + 1);
    let affine = Affine::from_spacing(voxel, wide.0);
    let each = |f: &dyn Fn([f64; 3]) -> u8| -> Vec<u8> {
        (0..dims[0] * dims[1] * dims[2])
            .map(|n| [n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1])])
            .map(|c| f(affine.apply(c.map(|v| v as f64))))
            .collect()
    };
    let regions = each(&|p| {
        if tumour_value(p) < 0.0 {
            2
        } else if organ_value(p) < 0.0 {
            1
        } else if support_value(p) < 0.0 {
            3
        } else {
            0
        }
    });
    let hu = regions
        .iter()
        .map(|&l| [-90i16, 150, 60, 30][l as usize])
        .collect();
    let body = |name: &str, field: &ScalarField, f: &dyn Fn([f64; 3]) -> f64| {
        let mask = VoxelMask {
            dims,
            affine,
            data: each(&|p| u8::from(f(p) < 0.0)),
        };
        let volume = mask.data.iter().map(|&v| f64::from(v)).sum::<f64>() * affine.det();
        Body {
            name: name.into(),
            drawn: mask.clone(),
            mask,
            voxel_volume_mm3: volume,
            field: field.clone(),
            interpolated: None,
            slice_axis: 2,
            caps: vec![],
        }
    };
    let names = ["kidney", "tumour <1>", "spine"].map(String::from).to_vec();
    let anatomy = Anatomy {
        organ: body(&names[0], &organ, &organ_value),
        structures: vec![Structure {
            body: body(&names[1], &tumour, &tumour_value),
            divider: tumour.clone(),
        }],
        supports: vec![body(&names[2], &support, &support_value)],
        regions: RegionLabels {
            dims,
            affine,
            data: regions,
            names: names.clone(),
        },
        components: vec![ComponentInfo {
            volume_mm3: 1.0,
            centroid_mm: [0.0; 3],
            side: String::new(),
            chosen: true,
        }],
    };
    let meshes = [&organ, &tumour, &support].map(|f| contour(f).unwrap());
    let params = ParticleParams {
        radius_mm: 4.0,
        ..ParticleParams::default()
    };
    let region = |p: [f64; 3]| u16::from(tumour_value(p) < 0.0);
    let (particles, clusters, _) =
        build_particles(&meshes[0].vertices, &meshes[0].triangles, &region, &params).unwrap();
    let fem_params = FemParams {
        target_tets: 4000,
        ..FemParams::default()
    };
    let (fem, _) = build_fem(&organ, &[&tumour], &[], &fem_params).unwrap();
    let (embedding, _) = build_embedding(&organ, &EmbeddingParams::default()).unwrap();
    Model {
        anatomy,
        ct: CtVolume { dims, affine, hu },
        surfaces: names.into_iter().zip(meshes).collect(),
        particles,
        clusters,
        fem,
        embedding,
    }
}

fn write(model: &Model, ct: bool, dir: &Path) -> String {
    let stages = [
        StageRow {
            name: "volume".into(),
            seconds: 0.41,
            rows: vec![
                ("organ".into(), "212.4 mL".into()),
                ("Euler number".into(), "−12 → 2".into()),
            ],
            warnings: vec!["3 stray voxels dropped <here>".into()],
        },
        StageRow {
            name: "surface".into(),
            seconds: 0.2,
            ..StageRow::default()
        },
    ];
    let input = ReportInput {
        scan: "case & scan.nii.gz",
        recipe: "[particles]\nradius_mm = 4.0\n",
        remark: None,
        anatomy: &model.anatomy,
        ct: ct.then_some(&model.ct),
        surfaces: &model.surfaces,
        particles: &model.particles,
        clusters: &model.clusters,
        fem: &model.fem,
        embedding: &model.embedding,
        dihedral_before: &[],
        dihedral_after: &[1, 2, 3, 4, 3, 2, 1, 0, 0, 0],
        stages: &stages,
    };
    write_report(dir, &input).unwrap();
    std::fs::read_to_string(dir.join("index.html")).unwrap()
}

#[test]
fn page_is_self_contained_and_the_same_each_time() {
    let model = model();
    let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let page = write(&model, true, dirs[0].path());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(page, pool.install(|| write(&model, true, dirs[1].path())));
    // Nothing is fetched, nothing runs; text of others stands for itself.
    for word in ["http:", "https:", "<script", "url(", "<1>", "<here>"] {
        assert!(!page.contains(word), "{word}");
    }
    assert!(page.contains("tumour &lt;1&gt;") && page.contains("case &amp; scan.nii.gz"));
    let images = page.matches("data:image/png;base64,").count();
    let files = std::fs::read_dir(dirs[0].path()).unwrap().count();
    assert_eq!(files, images + 1, "every picture is on the page and beside it");
    assert_ne!(page, write(&model, false, dirs[1].path()));
}

#[test]
fn slices_show_what_lies_where() {
    let model = model();
    let dir = tempfile::tempdir().unwrap();
    write(&model, true, dir.path());
    let file = std::fs::File::open(dir.path().join("slice-organ-coronal.png")).unwrap();
    let mut reader = png::Decoder::new(std::io::BufReader::new(file))
        .read_info()
        .unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    let (w, h) = (info.width as usize, info.height as usize);
    let blue = |p: &[u8]| p[2] > 170 && p[0] < 110;
    let (mut left, mut right, mut top, mut bottom) = (0, 0, 0, 0);
    for (i, _) in pixels.chunks(3).enumerate().filter(|(_, p)| blue(p)) {
        let (x, y) = (i % w, i / w);
        *if x < w / 2 { &mut left } else { &mut right } += 1;
        *if y < h / 2 { &mut top } else { &mut bottom } += 1;
    }
    // The tumour lies on the patient's right (picture's left) and towards the head (top): more outline there.
    assert!(
        left > right && top > bottom && right > 100 && bottom > 100,
        "{left} {right} {top} {bottom}"
    );
}

#[test]
fn refusals_name_the_path() {
    let model = model();
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("taken");
    std::fs::write(&file, "x").unwrap();
    let input = ReportInput {
        scan: "",
        recipe: "",
        remark: None,
        anatomy: &model.anatomy,
        ct: None,
        surfaces: &[],
        particles: &model.particles,
        clusters: &model.clusters,
        fem: &model.fem,
        embedding: &model.embedding,
        dihedral_before: &[],
        dihedral_after: &[],
        stages: &[],
    };
    assert!(matches!(
        write_report(&file, &input),
        Err(ReportError::NoSurfaces)
    ));
    let input = ReportInput {
        surfaces: &model.surfaces,
        ..input
    };
    let error = write_report(&file, &input).unwrap_err();
    assert!(error.to_string().contains("taken"), "{error}");
}
