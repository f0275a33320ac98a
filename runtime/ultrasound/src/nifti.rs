//! Slices as NIfTI-1 files with their pose.

use crate::vector::{Vec3, cross, dot, norm, scale};

/// Voxel values of a one-plane file.
pub(crate) enum Voxels<'a> {
    U8(&'a [u8]),
    U16(&'a [u16]),
    F32(&'a [f32]),
}

const HEADER: usize = 352;

/// A single-file NIfTI-1 of one plane, first axis fastest, with its affine to patient RAS+ mm as sform and qform (scanner
/// coordinates), mm. `what` goes into its description. The affine's columns must be perpendicular and right-handed, as those of a
/// [`crate::PixelGrid::affine`] are.
pub(crate) fn encode(
    width: usize,
    height: usize,
    affine: &[[f64; 4]; 3],
    voxels: &Voxels,
    what: &str,
) -> Vec<u8> {
    let (code, bits) = match voxels {
        Voxels::U8(_) => (2i16, 8i16),
        Voxels::U16(_) => (512, 16),
        Voxels::F32(_) => (16, 32),
    };
    let mut out = vec![0u8; HEADER];
    let mut put = |at: usize, bytes: &[u8]| out[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &348i32.to_le_bytes());
    // Settings keep both below 8192.
    for (n, d) in [3, width as i16, height as i16, 1, 1, 1, 1, 1]
        .into_iter()
        .enumerate()
    {
        put(40 + 2 * n, &d.to_le_bytes());
    }
    put(70, &code.to_le_bytes());
    put(72, &bits.to_le_bytes());
    let columns: [Vec3; 3] = std::array::from_fn(|c| std::array::from_fn(|r| affine[r][c]));
    let size = columns.map(norm);
    for (n, v) in [1.0, size[0], size[1], size[2], 1.0].into_iter().enumerate() {
        put(76 + 4 * n, &(v as f32).to_le_bytes());
    }
    put(108, &(HEADER as f32).to_le_bytes());
    put(112, &1f32.to_le_bytes());
    // mm.
    put(123, &[2]);
    let description = format!("palpate: {what}");
    // 80 bytes with the closing zero.
    put(148, &description.as_bytes()[..description.len().min(79)]);
    put(252, &1i16.to_le_bytes());
    put(254, &1i16.to_le_bytes());
    let q = quaternion([0, 1, 2].map(|c| scale(columns[c], 1.0 / size[c])));
    for n in 0..3 {
        put(256 + 4 * n, &(q[n] as f32).to_le_bytes());
        put(268 + 4 * n, &(affine[n][3] as f32).to_le_bytes());
        for c in 0..4 {
            put(280 + 16 * n + 4 * c, &(affine[n][c] as f32).to_le_bytes());
        }
    }
    put(344, b"n+1\0");
    match voxels {
        Voxels::U8(v) => out.extend_from_slice(v),
        Voxels::U16(v) => v.iter().for_each(|v| out.extend_from_slice(&v.to_le_bytes())),
        Voxels::F32(v) => v.iter().for_each(|v| out.extend_from_slice(&v.to_le_bytes())),
    }
    out
}

/// (b, c, d) of the rotation with these columns, a ≥ 0.
fn quaternion(c: [Vec3; 3]) -> [f64; 3] {
    debug_assert!(dot(cross(c[0], c[1]), c[2]) > 0.0);
    let m = |row: usize, column: usize| c[column][row];
    let squares = [
        1.0 + m(0, 0) + m(1, 1) + m(2, 2),
        1.0 + m(0, 0) - m(1, 1) - m(2, 2),
        1.0 - m(0, 0) + m(1, 1) - m(2, 2),
        1.0 - m(0, 0) - m(1, 1) + m(2, 2),
    ];
    // The largest square is the pivot, so that nothing is divided by a number near zero.
    let pivot = (0..4).fold(0, |best, n| if squares[n] > squares[best] { n } else { best });
    let w = 2.0 * squares[pivot].max(0.0).sqrt();
    let (sum, diff) = (
        |a: usize, b: usize| (m(a, b) + m(b, a)) / w,
        |a: usize, b: usize| (m(a, b) - m(b, a)) / w,
    );
    let q = match pivot {
        0 => [w / 4.0, diff(2, 1), diff(0, 2), diff(1, 0)],
        1 => [diff(2, 1), w / 4.0, sum(0, 1), sum(0, 2)],
        2 => [diff(0, 2), sum(0, 1), w / 4.0, sum(1, 2)],
        _ => [diff(1, 0), sum(0, 2), sum(1, 2), w / 4.0],
    };
    let sign = if q[0] < 0.0 { -1.0 } else { 1.0 };
    [sign * q[1], sign * q[2], sign * q[3]]
}
