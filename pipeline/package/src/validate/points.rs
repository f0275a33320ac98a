//! Checks that several arrays share.

use super::MAX_COORDINATE_MM;
use crate::check::{Found, Sink};
use crate::model::Skin;
use crate::{PackageError, topology};

/// Allowed distance of a weight sum from 1.
const WEIGHT_SUM: f64 = 1e-5;

pub(super) fn same_length(entry: &str, found: usize, expected: usize, of: &str) -> Result<(), PackageError> {
    if found == expected {
        return Ok(());
    }
    Err(PackageError::Shape {
        entry: entry.into(),
        found: format!("{found} rows"),
        expected: format!("{expected}, the number of {of}"),
    })
}

pub(super) fn finite(entry: &str, rows: &[[f32; 3]]) -> Result<Found, PackageError> {
    let mut worst = 0.0f32;
    for (i, row) in rows.iter().enumerate() {
        // NaN is not within any limit.
        if !row.iter().all(|v| v.abs() <= MAX_COORDINATE_MM) {
            return Err(PackageError::invalid(
                entry,
                format!("row {i}"),
                format!("{row:?}"),
                format!("finite numbers within {MAX_COORDINATE_MM} mm of the origin"),
            ));
        }
        worst = row.iter().fold(worst, |w, v| w.max(v.abs()));
    }
    Ok(Found::worst(
        f64::from(worst),
        "mm from the origin, at most 10000",
    ))
}

pub(super) fn unit(entry: &str, rows: &[[f32; 3]]) -> Result<Found, PackageError> {
    let mut worst = 0.0f64;
    for (i, row) in rows.iter().enumerate() {
        let off = (row.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt() - 1.0).abs();
        if off.is_nan() || off > 1e-3 {
            return Err(PackageError::invalid(
                entry,
                format!("row {i}"),
                format!("{row:?}"),
                "a unit vector",
            ));
        }
        worst = worst.max(off);
    }
    Ok(Found::worst(worst, "off unit length, at most 0.001"))
}

pub(super) fn regions(entry: &str, codes: &[u16], count: usize) -> Result<Found, PackageError> {
    match codes.iter().position(|&r| usize::from(r) >= count) {
        Some(i) => Err(PackageError::invalid(
            entry,
            format!("row {i}"),
            format!("region {}", codes[i]),
            format!("below {count}, the number of regions"),
        )),
        None => Ok(Found::NOTHING),
    }
}

/// Skin of `points` points over `clusters` clusters.
pub(super) fn skin(
    skin: &Skin,
    folder: &str,
    points: usize,
    clusters: usize,
    sink: &mut Sink,
) -> Result<bool, PackageError> {
    let indices = format!("{folder}/skin_indices.npy");
    let weights = format!("{folder}/skin_weights.npy");
    let a = sink.check("skin indices are in range", &indices, || {
        same_length(&indices, skin.indices.len(), points, "points")?;
        topology::check_rows(&indices, &skin.indices, clusters, "clusters")?;
        Ok(Found::NOTHING)
    })?;
    let b = sink.check("skin weights are not negative and sum to 1", &weights, || {
        same_length(&weights, skin.weights.len(), points, "points")?;
        let mut worst = 0.0f64;
        for (i, row) in skin.weights.iter().enumerate() {
            let off = (row.iter().map(|&w| f64::from(w)).sum::<f64>() - 1.0).abs();
            // Written so that NaN fails too.
            if !(row.iter().all(|&w| w >= 0.0) && off <= WEIGHT_SUM) {
                return Err(PackageError::invalid(
                    &weights,
                    format!("row {i}"),
                    format!("{row:?}"),
                    "weights of at least 0 that sum to 1 within 1e-5",
                ));
            }
            worst = worst.max(off);
        }
        Ok(Found::worst(worst, "off 1, at most 0.00001"))
    })?;
    Ok(a && b)
}
