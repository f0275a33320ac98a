/// Order of `points` along the Z-curve over their box (21 bits an axis, one scale for all axes); ties keep their order.
pub(crate) fn order(points: &[[f64; 3]]) -> Vec<u32> {
    let mut lo = [f64::INFINITY; 3];
    let mut hi = [f64::NEG_INFINITY; 3];
    for p in points {
        for a in 0..3 {
            lo[a] = lo[a].min(p[a]);
            hi[a] = hi[a].max(p[a]);
        }
    }
    let extent = (0..3).map(|a| hi[a] - lo[a]).fold(1e-9, f64::max);
    let scale = f64::from((1u32 << 21) - 1) / extent;
    let mut keyed: Vec<(u64, u32)> = points
        .iter()
        .enumerate()
        .map(|(i, p)| {
            let code = (0..3).map(|a| spread(((p[a] - lo[a]) * scale) as u64) << a).sum();
            (code, i as u32)
        })
        .collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|k| k.1).collect()
}

/// Puts two zero bits between the low 21 bits.
fn spread(v: u64) -> u64 {
    let v = v & 0x1f_ffff;
    let v = (v | v << 32) & 0x001f_0000_0000_ffff;
    let v = (v | v << 16) & 0x001f_0000_ff00_00ff;
    let v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    let v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}

#[cfg(test)]
mod tests {
    #[test]
    fn interleaves_bits() {
        for v in [0u64, 1, 2, 0x1f_ffff, 0x12_3456] {
            let slow: u64 = (0..21).map(|b| (v >> b & 1) << (3 * b)).sum();
            assert_eq!(super::spread(v), slow);
        }
    }

    #[test]
    fn neighbours_in_space_stay_together() {
        let points: Vec<[f64; 3]> = (0..64)
            .map(|i| [i / 16, i / 4 % 4, i % 4].map(f64::from))
            .collect();
        let order = super::order(&points);
        // The first eight places of the curve over a 4³ grid are one octant.
        assert!(
            order[..8]
                .iter()
                .all(|&i| points[i as usize].iter().all(|&c| c < 2.0))
        );
    }
}
