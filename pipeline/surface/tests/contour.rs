//! The contourer against counts, volumes and topologies that are known.

use palpate_fixtures::shapes;
use palpate_surface::{SurfaceError, TriMesh, contour, contour_mask, validate};
use palpate_volume::{Affine, ScalarField, VoxelMask};

fn mask(dims: [usize; 3], inside: impl Fn([usize; 3]) -> bool) -> VoxelMask {
    let mut data = Vec::new();
    for k in 0..dims[2] {
        for j in 0..dims[1] {
            for i in 0..dims[0] {
                data.push(u8::from(inside([i, j, k])));
            }
        }
    }
    VoxelMask {
        dims,
        affine: Affine::from_spacing([1.0; 3], [0.0; 3]),
        data,
    }
}

fn assert_solid(mesh: &TriMesh, what: &str) {
    let t = validate(mesh).unwrap();
    assert!(
        t.closed && t.manifold && t.misoriented_edges == 0,
        "{what}: {t:?}"
    );
}

#[test]
fn every_pair_of_neighbouring_cells_agrees_on_its_face() {
    for axis in 0..3 {
        let mut dims = [2; 3];
        dims[axis] = 3;
        for pattern in 1..1u32 << 12 {
            let m = mask(dims, |[i, j, k]| {
                pattern >> (i + dims[0] * (j + dims[1] * k)) & 1 == 1
            });
            assert_solid(
                &contour_mask(&m).unwrap(),
                &format!("axis {axis}, pattern {pattern:012b}"),
            );
        }
    }
}

#[test]
fn random_noise_is_closed_and_manifold_and_all_cells_occur() {
    let mut state = 7u64;
    let mut next = || {
        state = state
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        state >> 33
    };
    let dims = [37, 29, 31];
    let bits: Vec<bool> = (0..dims[0] * dims[1] * dims[2])
        .map(|_| next() & 1 == 1)
        .collect();
    let at = |i: usize, j: usize, k: usize| bits[i + dims[0] * (j + dims[1] * k)];
    let m = mask(dims, |[i, j, k]| at(i, j, k));
    let mut seen = [false; 256];
    for k in 0..dims[2] - 1 {
        for j in 0..dims[1] - 1 {
            for i in 0..dims[0] - 1 {
                let case = (0..8).fold(0, |c, n| {
                    c | usize::from(at(i + (n & 1), j + (n >> 1 & 1), k + (n >> 2))) << n
                });
                seen[case] = true;
            }
        }
    }
    assert!(seen.iter().all(|s| *s));
    assert_solid(&contour_mask(&m).unwrap(), "noise mask");
    // The same signs with magnitudes, exact zeros among them.
    let values: Vec<f32> = bits
        .iter()
        .map(|b| (next() % 5) as f32 * if *b { -1.0 } else { 1.0 } + f32::from(u8::from(!*b)) * 0.5)
        .collect();
    let mut field = ScalarField {
        dims,
        origin_mm: [0.0; 3],
        spacing_mm: 0.7,
        values,
    };
    for k in 0..dims[2] {
        for j in 0..dims[1] {
            for i in 0..dims[0] {
                if i == 0 || j == 0 || k == 0 || i == dims[0] - 1 || j == dims[1] - 1 || k == dims[2] - 1 {
                    let n = field.index(i, j, k);
                    field.values[n] = 1.0;
                }
            }
        }
    }
    let mesh = contour(&field).unwrap();
    assert_solid(&mesh, "noise field");
    assert_eq!(validate(&mesh).unwrap().degenerate_faces, 0);
}

/// Figures of surface.md 2.1 and 2.4.
#[test]
fn digitised_ball_has_the_known_counts_and_errors() {
    let (c, r) = ([15.7, 16.2, 15.9], 10.3f64);
    let m = mask([32; 3], |p| {
        (0..3).map(|a| (p[a] as f64 - c[a]).powi(2)).sum::<f64>() <= r * r
    });
    let mesh = contour_mask(&m).unwrap();
    assert_eq!((mesh.vertices.len(), mesh.triangles.len()), (2006, 4008));
    let exact = 4.0 / 3.0 * std::f64::consts::PI * r.powi(3);
    assert!(
        (mesh.volume_mm3() / exact - 1.0 + 0.0058).abs() < 0.002,
        "{}",
        mesh.volume_mm3() / exact
    );
    assert_eq!(validate(&mesh).unwrap().euler, 2);
}

#[test]
fn euler_numbers_and_volumes_of_ball_and_torus() {
    let pi = std::f64::consts::PI;
    let ball = contour(&ScalarField::sample(
        &shapes::ball([5.0, -3.0, 2.0], 12.0),
        0.6,
        3,
    ))
    .unwrap();
    let t = validate(&ball).unwrap();
    assert!(t.is_solid() && t.euler == 2 && t.components.len() == 1);
    assert!((ball.volume_mm3() / (4.0 / 3.0 * pi * 1728.0) - 1.0).abs() < 2e-3);
    let torus = contour(&ScalarField::sample(&shapes::torus([0.0; 3], 14.0, 5.0), 0.6, 3)).unwrap();
    let t = validate(&torus).unwrap();
    assert!(t.is_solid() && t.euler == 0);
    assert!((torus.volume_mm3() / (2.0 * pi * pi * 14.0 * 25.0) - 1.0).abs() < 4e-3);
}

#[test]
fn left_handed_and_oblique_affines_face_outward_at_their_place() {
    let mut m = mask([9, 8, 7], |[i, j, k]| {
        (2..7).contains(&i) && (2..6).contains(&j) && (2..5).contains(&k)
    });
    m.affine = Affine {
        m: [
            [0.0, 0.8, 0.1, 10.0],
            [0.9, 0.0, 0.0, -20.0],
            [0.0, 0.2, 2.5, 30.0],
        ],
    };
    assert!(m.affine.det() < 0.0);
    let mesh = contour_mask(&m).unwrap();
    let t = validate(&mesh).unwrap();
    assert!(t.is_solid(), "{t:?}");
    let centre = m.affine.apply([4.0, 3.5, 3.0]);
    let n = mesh.vertices.len() as f64;
    for a in 0..3 {
        let mean = mesh.vertices.iter().map(|v| v[a]).sum::<f64>() / n;
        assert!((mean - centre[a]).abs() < 1e-9);
    }
    // A mask that fills its crop is closed by the layer around it.
    assert_solid(&contour_mask(&mask([3, 3, 3], |_| true)).unwrap(), "full crop");
}

#[test]
fn bad_fields_are_refused_with_their_place() {
    let good = ScalarField::sample(&shapes::ball([0.0; 3], 4.0), 1.0, 2);
    let mut f = good.clone();
    f.values.pop();
    assert!(matches!(contour(&f), Err(SurfaceError::GridSize { .. })));
    let mut f = good.clone();
    let n = f.index(3, 4, 5);
    f.values[n] = f32::NAN;
    assert_eq!(
        contour(&f),
        Err(SurfaceError::NotFinite {
            what: "the field's sample",
            position_mm: f.position([3, 4, 5])
        })
    );
    let mut f = good.clone();
    let n = f.index(2, 3, 0);
    f.values[n] = -1.0;
    assert_eq!(
        contour(&f),
        Err(SurfaceError::OpenField {
            position_mm: f.position([2, 3, 0])
        })
    );
    let mut f = good;
    f.values.fill(1.0);
    assert_eq!(contour(&f), Err(SurfaceError::Empty));
}

#[test]
fn same_bytes_on_any_number_of_threads() {
    let field = ScalarField::sample(&shapes::kidney([0.0; 3]), 1.3, 3);
    let on = |n| {
        rayon::ThreadPoolBuilder::new()
            .num_threads(n)
            .build()
            .unwrap()
            .install(|| contour(&field).unwrap())
    };
    assert_eq!(on(1), on(4));
}
