use super::*;
use crate::sample_meshes::sphere;
use palpate_volume::Affine;

/// An upright cylinder of voxels, radius `r` mm around the middle, in slices `from..to`.
fn cylinder(affine: Affine, dims: [usize; 3], axis: usize, r: f64, from: usize, to: usize) -> VoxelMask {
    let middle = affine.apply(dims.map(|d| 0.5 * (d as f64 - 1.0)));
    let mut data = vec![0; dims[0] * dims[1] * dims[2]];
    for (n, v) in data.iter_mut().enumerate() {
        let ijk = [n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1])];
        let mut c = ijk.map(|v| v as f64);
        c[axis] = 0.5 * (dims[axis] as f64 - 1.0);
        let p = affine.apply(c);
        let d2: f64 = (0..3).map(|x| (p[x] - middle[x]).powi(2)).sum();
        *v = u8::from(d2 < r * r && (from..to).contains(&ijk[axis]));
    }
    VoxelMask { dims, affine, data }
}

/// Open tube around the middle of the mask along `axis`.
fn tube(mask: &VoxelMask, axis: usize, r: f64) -> TriMesh {
    let d = mask.dims.map(|d| 0.5 * (d as f64 - 1.0));
    let n = 400;
    let spacing = mask.affine.spacing_mm();
    let mut mesh = TriMesh::default();
    for i in 0..n {
        let a = i as f64 / n as f64 * std::f64::consts::TAU;
        for end in [-1.0, mask.dims[axis] as f64] {
            let mut c = d;
            c[axis] = end;
            c[(axis + 1) % 3] += r * a.cos() / spacing[(axis + 1) % 3];
            c[(axis + 2) % 3] += r * a.sin() / spacing[(axis + 2) % 3];
            mesh.vertices.push(mask.affine.apply(c));
        }
        let (p, q) = (2 * i as u32, 2 * ((i as u32 + 1) % n as u32));
        mesh.triangles.extend([[p, q, p + 1], [q, q + 1, p + 1]]);
    }
    mesh
}

#[test]
fn a_tube_through_its_own_voxels_is_within_a_voxel_and_a_wider_one_is_off_by_the_difference() {
    for axis in 0..3 {
        let mut spacing = [0.7; 3];
        spacing[axis] = 5.0;
        let mut affine = Affine::from_spacing(spacing, [-10.0, 40.0, 7.0]);
        affine.m[(axis + 1) % 3][(axis + 1) % 3] = -0.7;
        let mut dims = [60; 3];
        dims[axis] = 8;
        let mask = cylinder(affine, dims, axis, 15.0, 1, 7);
        let own = slice_contour_rms(&tube(&mask, axis, 15.0), &mask, axis).unwrap();
        assert!((own.in_plane_voxel_mm - 0.7).abs() < 1e-12);
        assert!(own.through.rms_mm > 0.1 && own.through.rms_mm < 0.25, "{own:?}");
        assert!(own.through.max_mm < 0.7, "{own:?}");
        assert_eq!(
            (own.slices, own.slices_without_label, own.slices_without_surface),
            (6, 2, 0)
        );
        // The first and the last slice of the label are ends.
        assert!(
            (own.ends.rms_mm - own.through.rms_mm).abs() < 0.001 && own.ends.samples < own.through.samples,
            "{own:?}"
        );
        let wide = slice_contour_rms(&tube(&mask, axis, 17.0), &mask, axis).unwrap();
        assert!((wide.through.mean_mm - 2.0).abs() < 0.05, "{wide:?}");
    }
}

/// A ball cut by a plane is a circle of known radius; a one-voxel label far from it is as far as it is.
#[test]
fn known_circle_and_lone_voxel() {
    let mask = VoxelMask {
        dims: [41, 41, 1],
        affine: Affine::from_spacing([1.0; 3], [-20.0, -20.0, 6.0]),
        data: (0..41 * 41).map(|n| u8::from(n == 20 + 41 * 20)).collect(),
    };
    let s = slice_contour_rms(&sphere([0.0; 3], 10.0, 60), &mask, 2).unwrap();
    // Circle of radius 8 against a diamond of half-diagonal 0.5 in its centre; the lone voxel ends here.
    assert_eq!(s.through.samples, 0);
    assert!(
        (s.ends.max_mm - 7.64).abs() < 0.05 && (s.ends.mean_mm - 7.56).abs() < 0.1,
        "{s:?}"
    );
    let far = slice_contour_rms(&sphere([0.0, 0.0, 30.0], 10.0, 10), &mask, 2).unwrap();
    assert_eq!((far.slices, far.slices_without_surface), (1, 1));
}

#[test]
fn malformed_input_is_refused() {
    let ball = sphere([0.0; 3], 10.0, 4);
    let mut mask = VoxelMask {
        dims: [2; 3],
        affine: Affine::from_spacing([1.0; 3], [0.0; 3]),
        data: vec![1; 8],
    };
    assert_eq!(
        slice_contour_rms(&ball, &mask, 3),
        Err(SliceContourError::Axis(3))
    );
    mask.data.pop();
    assert!(matches!(
        slice_contour_rms(&ball, &mask, 2),
        Err(SliceContourError::Size {
            expected: 8,
            found: 7,
            ..
        })
    ));
    mask.affine.m[0][0] = 0.0;
    assert!(matches!(
        slice_contour_rms(&ball, &mask, 2),
        Err(SliceContourError::Affine(_))
    ));
}

#[test]
fn diagonal_voxels_keep_their_own_outlines() {
    // Two voxels that touch in a corner: eight pieces in two closed diamonds.
    let mask = VoxelMask {
        dims: [2, 2, 1],
        affine: Affine::from_spacing([1.0; 3], [0.0; 3]),
        data: vec![1, 0, 0, 1],
    };
    let plane = Plane::new(&mask, [0, 1]);
    let pieces = label_contour(&mask, 2, 0, &plane);
    assert_eq!(pieces.len(), 8);
    assert!(
        pieces
            .iter()
            .all(|p| (apart(p.a, p.b) - 0.5f64.sqrt()).abs() < 1e-12)
    );
}
