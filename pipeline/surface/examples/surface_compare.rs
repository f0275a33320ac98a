//! The surface chain beside meshopt's simplifier, on kidneys of label maps.
//!
//! `cargo run --release -p palpate-surface --example surface_compare -- case.nii.gz…` (KiTS19: labels 1 and 2)

use meshopt::SimplifyOptions;
use palpate_surface::{
    HcParams, SurfaceParams, TriMesh, build_surface, contour, contour_mask, hc_smooth, self_intersections,
    surface_distance, surface_quality, validate,
};
use palpate_volume::{
    AnatomySelection, ComponentChoice, LabelGrid, RegionSelection, VolumeParams, build_anatomy, read_labels,
};
use std::time::Instant;

type Anything = Box<dyn std::error::Error>;

/// meshopt with moved vertices and RegularizeLight; indices are checked before (it reads what they say).
fn simplify(mesh: &TriMesh, faces: usize) -> Result<TriMesh, Anything> {
    palpate_surface::check_arrays(mesh)?;
    let mut indices: Vec<u32> = mesh.triangles.iter().flatten().copied().collect();
    let mut positions: Vec<[f32; 3]> = mesh.vertices.iter().map(|p| p.map(|x| x as f32)).collect();
    let count = meshopt::simplify_with_update(
        &mut indices,
        &mut positions,
        &mut [],
        &[],
        0,
        None,
        3 * faces,
        f32::MAX,
        SimplifyOptions::RegularizeLight,
        None,
    );
    let mut number = vec![u32::MAX; positions.len()];
    let mut out = TriMesh::default();
    for t in indices[..count].chunks_exact(3) {
        out.triangles.push(std::array::from_fn(|c| {
            let n = &mut number[t[c] as usize];
            if *n == u32::MAX {
                *n = out.vertices.len() as u32;
                out.vertices.push(positions[t[c] as usize].map(f64::from));
            }
            *n
        }));
    }
    Ok(out)
}

fn row(
    name: &str,
    ms: f64,
    mesh: &TriMesh,
    iso: &TriMesh,
    raw: &TriMesh,
    voxels_mm3: f64,
) -> Result<(), Anything> {
    let t = validate(mesh)?;
    let q = surface_quality(mesh)?;
    let crossings = self_intersections(mesh, 100_000)?.len();
    let (i, r) = (
        surface_distance(mesh, iso, 30_000)?.symmetric,
        surface_distance(mesh, raw, 30_000)?.symmetric,
    );
    println!(
        "| {name} | {} | {} | {} | {crossings} | {:.1}° | {:.2} % | {:.3} | {:+.3} % | {:.3} | {:.2} | {:.3} | {:.3} | {ms:.0} |",
        mesh.triangles.len(),
        if t.closed && t.manifold { "yes" } else { "no" },
        t.euler,
        q.min_angle_deg,
        100.0 * q.below_20_deg as f64 / q.faces as f64,
        q.mean_quality,
        100.0 * (mesh.volume_mm3() / voxels_mm3 - 1.0),
        i.rms_mm,
        i.max_mm,
        r.rms_mm,
        r.p99_mm,
    );
    Ok(())
}

fn main() -> Result<(), Anything> {
    println!(
        "| chain | faces | closed, manifold | Euler | crossings | min angle | < 20° | mean quality | volume | RMS iso | Hausdorff iso | RMS raw | p99 raw | ms |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|---|---|");
    for path in std::env::args().skip(1) {
        let (labels, _) = read_labels(&path, &|_| {})?;
        let region = |name: &str, label| RegionSelection {
            name: name.into(),
            labels: vec![label],
        };
        let selection = AnatomySelection {
            organ: region("kidney", 1),
            structures: vec![region("tumour", 2)],
            supports: vec![],
            component: ComponentChoice::Largest,
        };
        let grid = LabelGrid {
            dims: labels.dims,
            affine: labels.affine,
            codes: &labels.codes,
            values: &labels.values,
        };
        let (anatomy, _) = build_anatomy(&grid, &selection, &VolumeParams::default(), &|_, _| {})?;
        let body = &anatomy.organ;
        let (iso, raw) = (contour(&body.field)?, contour_mask(&body.mask)?);
        let case = path
            .rsplit('/')
            .next()
            .unwrap_or(&path)
            .replace("_segmentation.nii.gz", "");
        let start = Instant::now();
        let built = build_surface(
            &body.field,
            &body.caps,
            body.voxel_volume_mm3,
            &SurfaceParams::default(),
        );
        let ms = start.elapsed().as_secs_f64() * 1e3;
        match built {
            Ok((mesh, report)) => {
                row(
                    &format!("{case}: palpate"),
                    ms,
                    &mesh,
                    &iso,
                    &raw,
                    body.voxel_volume_mm3,
                )?;
                println!(
                    "<!-- {} iso faces, redone {} -->",
                    report.steps[0].faces, report.redone_with_all_guards
                );
            }
            Err(e) => println!("<!-- {case}: {e} -->"),
        }
        let start = Instant::now();
        let smooth = hc_smooth(&contour(&body.field)?, &HcParams::default())?;
        let other = simplify(&smooth, 5000)?;
        let ms = start.elapsed().as_secs_f64() * 1e3;
        row(
            &format!("{case}: meshopt"),
            ms,
            &other,
            &iso,
            &raw,
            body.voxel_volume_mm3,
        )?;
    }
    Ok(())
}
