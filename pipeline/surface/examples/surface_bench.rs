//! Times of the surface steps and the quality of what comes out, for the analytic kidney.
//!
//! `cargo run --release -p palpate-surface --example surface_bench -- [target faces]`

use palpate_fixtures::shapes;
use palpate_surface::{
    DecimateParams, HcParams, ImproveParams, SurfaceParams, build_surface, contour, decimate, hc_smooth,
    improve,
};
use palpate_volume::ScalarField;
use std::time::Instant;

fn timed<T>(what: &str, f: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let out = f();
    println!("{what:<40} {:8.1} ms", start.elapsed().as_secs_f64() * 1e3);
    out
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let target_faces = std::env::args().nth(1).map_or(Ok(5000), |a| a.parse())?;
    let field = ScalarField::sample(&shapes::kidney([0.0; 3]), 0.8, 3);
    let iso = timed("contour", || contour(&field))?;
    let smooth = timed("HC Laplacian", || hc_smooth(&iso, &HcParams::default()))?;
    let params = DecimateParams {
        target_faces,
        first_phase_edge_mm: 0.8,
        ..Default::default()
    };
    let (small, _) = timed("decimate, all guards", || decimate(&smooth, &params))?;
    timed("improve, all guards", || {
        improve(&small, &field, &ImproveParams::default())
    })?;
    let params = SurfaceParams {
        target_faces,
        ..Default::default()
    };
    let (_, report) = timed("whole stage", || {
        build_surface(&field, &[], iso.volume_mm3(), &params)
    })?;
    println!("{report:#?}");
    Ok(())
}
