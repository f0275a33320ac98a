//! Models that break what the runtime relies on: the writer refuses each, and the error names entry and element.

mod common;

use common::small_model;
use palpate_package::*;
use proptest::prelude::*;

/// Changes a good model and asks for the error's entry and a word of its text.
fn refused(change: impl FnOnce(&mut ModelPackage), entry: &str, word: &str) {
    let mut model = small_model();
    change(&mut model);
    let problem = model.to_bytes().unwrap_err();
    let text = problem.to_string();
    assert!(
        text.starts_with(&format!("{entry}:")),
        "{entry} is not named: {text}"
    );
    assert!(text.contains(word), "{word:?} is not in: {text}");
}

#[test]
fn numbers_must_be_finite_and_near() {
    refused(
        |m| m.surfaces[0].vertices[7][1] = f32::NAN,
        "surfaces/kidney/vertices.npy",
        "row 7",
    );
    refused(
        |m| m.particles.positions[3][0] = f32::INFINITY,
        "particles/positions.npy",
        "row 3",
    );
    refused(
        |m| m.embedding.vertices[2][2] = -2e4,
        "embedding/vertices.npy",
        "row 2",
    );
    refused(|m| m.fem.vertices[0][0] = f32::NAN, "fem/vertices.npy", "row 0");
    refused(
        |m| m.fiducials.positions[1][0] = f32::NAN,
        "fiducials/positions.npy",
        "row 1",
    );
    refused(
        |m| m.clusters.rest_local[9][0] = f32::NAN,
        "clusters/rest_local.npy",
        "row 9",
    );
    refused(
        |m| m.info.local_origin_mm[0] = f64::NAN,
        "manifest.json",
        "local_origin_mm",
    );
    refused(|m| m.particles.mass_g = 0.0, "manifest.json", "mass_g");
    refused(
        |m| m.surfaces[0].caps[0].normal = [0.0, 0.0, 2.0],
        "surfaces/kidney/cap_normals.npy",
        "unit vector",
    );
}

#[test]
fn indices_must_be_in_range() {
    refused(
        |m| m.surfaces[1].triangles[5][2] = 18,
        "surfaces/tumour/triangles.npy",
        "row 5: index 18",
    );
    refused(|m| m.fem.tets[11][0] = 120, "fem/tets.npy", "row 11: index 120");
    refused(
        |m| m.embedding.skin.indices[4][3] = 18,
        "embedding/skin_indices.npy",
        "row 4: index 18",
    );
    refused(
        |m| m.clusters.members[40] = 60,
        "clusters/members.npy",
        "row 40: index 60",
    );
    refused(
        |m| m.particles.creation_order[0] = 1,
        "particles/creation_order.npy",
        "again",
    );
    refused(
        |m| m.particles.region[8] = 3,
        "particles/region.npy",
        "row 8: region 3",
    );
    refused(
        |m| m.clusters.region[8] = 3,
        "clusters/region.npy",
        "row 8: region 3",
    );
    refused(|m| m.fem.regions[8] = 3, "fem/regions.npy", "row 8: region 3");
    refused(
        |m| m.labels.data[100] = 4,
        "labels/data.npy",
        "voxel 100: label 4",
    );
}

#[test]
fn weights_must_be_shares() {
    refused(
        |m| m.embedding.skin.weights[0] = [0.5, 0.5, 0.5, -0.5],
        "embedding/skin_weights.npy",
        "row 0",
    );
    refused(
        |m| m.embedding.skin.weights[1] = [0.25, 0.25, 0.25, 0.2501],
        "embedding/skin_weights.npy",
        "row 1",
    );
    refused(
        |m| m.fiducials.skin.weights[1][0] = f32::NAN,
        "fiducials/skin_weights.npy",
        "row 1",
    );
    refused(
        |m| m.surfaces[0].skin.as_mut().unwrap().weights.truncate(3),
        "surfaces/kidney/skin_weights.npy",
        "shape is 3 rows, expected 96",
    );
    refused(
        |m| m.fem.tagged[0].tet_fraction[5] = 1.5,
        "fem/tagged/fascia/tet_fraction.npy",
        "row 5",
    );
    refused(
        |m| m.fem.tagged[0].thickness_mm = f64::NAN,
        "manifest.json",
        "thickness_mm",
    );
    // Five millionths off is rounding.
    let mut model = small_model();
    model.embedding.skin.weights[1] = [0.25, 0.25, 0.25, 0.250_005];
    model.to_bytes().unwrap();
}

#[test]
fn rows_and_transpose_must_agree() {
    refused(
        |m| m.clusters.offsets[2] = m.clusters.offsets[1] - 1,
        "clusters/offsets.npy",
        "row 2: offset 11 after 12",
    );
    refused(|m| m.clusters.offsets[0] = 1, "clusters/offsets.npy", "row 0");
    refused(
        |m| *m.clusters.offsets.last_mut().unwrap() -= 1,
        "clusters/offsets.npy",
        "last offset 215",
    );
    refused(
        |m| m.clusters.offsets[1] = 3,
        "clusters/offsets.npy",
        "cluster 0: 3 members",
    );
    refused(
        |m| m.clusters.members[1] = m.clusters.members[0],
        "clusters/members.npy",
        "again in cluster 0",
    );
    refused(
        |m| m.clusters.particle_entries.swap(0, 30),
        "clusters/particle_entries.npy",
        "row 0",
    );
    refused(
        |m| m.clusters.particle_offsets[4] += 1,
        "clusters/particle_offsets.npy",
        "row 4",
    );
    refused(
        |m| m.clusters.rest_centres[5][0] += 0.01,
        "clusters/rest_local.npy",
        "mm away",
    );
    // A particle that no cluster holds.
    refused(
        |m| {
            m.particles.positions.push([0.0, 0.0, 0.0]);
            m.particles.region.push(0);
            m.particles.creation_order.push(60);
            m.clusters.particle_offsets.push(216);
        },
        "clusters/members.npy",
        "particle 60: in no cluster",
    );
}

#[test]
fn flat_clusters_are_refused() {
    refused(
        |m| {
            // One more cluster: the lowest layer, all in one plane.
            let mut offsets = m.clusters.offsets.clone();
            let mut members = m.clusters.members.clone();
            members.extend(0..20);
            offsets.push(members.len() as u32);
            let mut region = m.clusters.region.clone();
            region.push(0);
            m.clusters = Clusters::new(&m.particles, offsets, members, region).unwrap();
        },
        "clusters/rest_local.npy",
        "cluster 18: moment ratio 0.00000",
    );
}

#[test]
fn surfaces_must_be_closed_manifold_and_outward() {
    let entry = "surfaces/kidney/triangles.npy";
    let less = |m: &mut ModelPackage| m.surfaces[0].triangles.truncate(187);
    refused(less, entry, "an open edge");
    refused(|m| m.surfaces[0].triangles[3].swap(0, 1), entry, "the same way");
    refused(
        |m| m.surfaces[0].triangles.iter_mut().for_each(|t| t.swap(0, 1)),
        entry,
        "counter-clockwise",
    );
    refused(
        |m| m.surfaces[0].triangles[3][1] = m.surfaces[0].triangles[3][0],
        entry,
        "area 0",
    );
    refused(
        |m| {
            m.surfaces[0].vertices.push([0.0; 3]);
            let skin = m.surfaces[0].skin.as_mut().unwrap();
            skin.indices.push([0; 4]);
            skin.weights.push([1.0, 0.0, 0.0, 0.0]);
        },
        entry,
        "vertex 96: no triangle",
    );
    // Two boxes that share one corner vertex: each edge is fine, the vertex is not.
    refused(
        |m| {
            let s = &mut m.surfaces[2];
            let (v, t) = (s.vertices.clone(), s.triangles.clone());
            let corner = v.iter().enumerate().max_by(|a, b| {
                let sum = |p: &[f32; 3]| p[0] + p[1] + p[2];
                sum(a.1).total_cmp(&sum(b.1))
            });
            let (c, p) = corner.map(|(i, p)| (i as u32, *p)).unwrap();
            let n = v.len() as u32;
            // The mirror image through the corner faces inward, so its triangles are turned.
            s.vertices.extend(
                v.iter()
                    .map(|q| std::array::from_fn::<f32, 3, _>(|a| 2.0 * p[a] - q[a])),
            );
            s.triangles.extend(t.iter().map(|f| {
                let f = f.map(|i| if i == c { c } else { i + n });
                [f[0], f[2], f[1]]
            }));
            // Vertex n + c is unused: move the last one there.
            let last = s.vertices.len() as u32 - 1;
            s.vertices.swap_remove((n + c) as usize);
            for i in s.triangles.iter_mut().flatten().filter(|i| **i == last) {
                *i = n + c;
            }
        },
        "surfaces/table_top/triangles.npy",
        "in more than one fan",
    );
}

#[test]
fn a_hollow_body_is_sound_and_an_inverted_neighbour_is_not() {
    let grid = common::kuhn([0.0, 0.0, 0.0], [5, 5, 5], 2.0);
    let shell = |c: [usize; 3]| c.iter().any(|&x| x == 0 || x == 4);
    let (v, t) = common::boundary(&grid, |i| shell(grid.cell[i]));
    let mut model = small_model();
    let frame = model.frame();
    let at: Vec<[f64; 3]> = v
        .iter()
        .map(|p| std::array::from_fn(|a| p[a] + common::CORNER_MM[a]))
        .collect();
    model.surfaces[2] = frame.surface("hollow", SurfaceKind::Support, &at, &t, None, &[]);
    model.validate().unwrap();
    // The inner wall pulled out of the body: a piece of its own that faces inward.
    for p in &mut model.surfaces[2].vertices {
        let q = frame.patient(*p);
        let inner = (0..3).all(|a| (1.0..9.0).contains(&(q[a] - common::CORNER_MM[a])));
        if inner {
            p[0] += 40.0;
        }
    }
    assert!(
        model
            .validate()
            .unwrap_err()
            .to_string()
            .contains("counter-clockwise")
    );
}

#[test]
fn tets_must_be_positive_and_joined_face_to_face() {
    refused(|m| m.fem.tets[7].swap(0, 1), "fem/tets.npy", "tet 7");
    refused(
        |m| m.embedding.tets.iter_mut().for_each(|t| t.swap(2, 3)),
        "embedding/tets.npy",
        "volume -",
    );
    refused(
        |m| {
            let t = m.embedding.tets[0];
            m.embedding.tets.push(t);
        },
        "embedding/tets.npy",
        "on one side",
    );
    refused(
        |m| m.fem.vertices.push([0.0; 3]),
        "fem/tets.npy",
        "vertex 120: in no tet",
    );
    refused(
        |m| m.fem.regions.truncate(5),
        "fem/regions.npy",
        "shape is 5 rows",
    );
}

#[test]
fn grids_and_affines_must_fit() {
    refused(|m| m.labels.dims[0] = 13, "labels/data.npy", "13 × 10 × 8");
    refused(
        |m| m.labels.affine[1] = m.labels.affine[0],
        "labels/affine.npy",
        "invertible",
    );
    refused(
        |m| m.ct.as_mut().unwrap().hu.truncate(9),
        "ct/hu.npy",
        "with 9 values",
    );
    refused(
        |m| m.ct.as_mut().unwrap().affine[0][3] = f64::INFINITY,
        "ct/affine.npy",
        "finite",
    );
    refused(|m| m.info.scan.dims[2] = 0, "manifest.json", "scan.dims");
    refused(
        |m| m.labels.dims = [usize::MAX, 2, 1],
        "labels/data.npy",
        "as many values as voxels",
    );
}

#[test]
fn names_must_tell_bodies_apart() {
    refused(
        |m| {
            for n in 0..253 {
                let mut s = m.surfaces[2].clone();
                s.name = format!("support {n}");
                m.surfaces.push(s);
            }
        },
        "manifest.json",
        "surfaces: 256 bodies",
    );
    refused(|m| m.info.regions[1] = "kidney".into(), "manifest.json", "twice");
    refused(
        |m| m.surfaces[0].name = "liver".into(),
        "manifest.json",
        "named as the regions",
    );
    refused(|m| m.surfaces.swap(0, 1), "manifest.json", "one organ first");
    refused(|m| m.surfaces.clear(), "manifest.json", "surfaces");
    refused(|m| m.surfaces[0].skin = None, "manifest.json", "skin weights");
    refused(
        |m| m.fiducials.names[0] = "a\nb".into(),
        "manifest.json",
        "control characters",
    );
    refused(
        |m| m.labels.names.truncate(1),
        "manifest.json",
        "the regions first",
    );
    refused(
        |m| m.info.inputs[0].sha256 = "12".into(),
        "manifest.json",
        "inputs[0].sha256",
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Whatever the recipe, report, names and origin are, they come back the same.
    #[test]
    fn free_text_and_numbers_come_back(
        note in "\\PC{0,40}",
        name in "[a-zA-ZäöüßÅ/ .-]{0,12}x",
        number in any::<f64>().prop_filter("JSON holds finite numbers", |v| v.is_finite()),
        origin in prop::array::uniform3(-1e5f64..1e5),
    ) {
        let mut model = small_model();
        let name = name.trim().to_string();
        prop_assume!(!model.info.regions.contains(&name));
        model.info.recipe = serde_json::json!({"note": note, "number": number, "nested": {"list": [1, 2.5, null, true]}});
        model.info.local_origin_mm = origin;
        model.surfaces[2].name = name.clone();
        model.fiducials.names[0] = name;
        let (bytes, digest) = model.to_bytes().unwrap();
        let back = ModelPackage::read_bytes(&bytes).unwrap();
        prop_assert_eq!(&back, &model);
        prop_assert_eq!(back.to_bytes().unwrap(), (bytes, digest));
    }

    /// Any bytes put anywhere: an error or, where they were the same, the same model; never a panic.
    #[test]
    fn overwritten_bytes_never_panic(at in 0usize..58_000, with in prop::collection::vec(any::<u8>(), 1..64), checksums: bool) {
        let model = small_model();
        let mut bytes = model.to_bytes().unwrap().0;
        let end = (at + with.len()).min(bytes.len());
        let same = bytes[at..end] == with[..end - at];
        bytes[at..end].copy_from_slice(&with[..end - at]);
        let options = ReadOptions { checksums };
        let read = ModelPackage::read_bytes_with(&bytes, options);
        if checksums {
            prop_assert_eq!(read.is_ok(), same);
        }
    }

    /// Positions keep to 4e-6 mm within 100 mm of the origin.
    #[test]
    fn frames_round_trip(p in prop::array::uniform3(-60.0f64..60.0), far in prop::array::uniform3(-2000.0f64..2000.0)) {
        let at: [f64; 3] = std::array::from_fn(|a| far[a] + p[a]);
        let frame = Frame::around(&[far, at]);
        let back = frame.patient(frame.local(at));
        for a in 0..3 {
            prop_assert!((back[a] - at[a]).abs() < 4e-6);
            prop_assert_eq!(frame.local_origin_mm[a].fract(), 0.0);
        }
    }
}
