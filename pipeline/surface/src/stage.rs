use crate::components::{drop_small_parts, parts};
use crate::decimate::{decimate_half_edges, triangle_edge};
use crate::halfedge::HalfEdges;
use crate::improve::Improver;
use crate::smooth::hc_smooth_pinned;
use crate::vector::{dot, sub};
use crate::{
    DecimateParams, DecimateReport, DistanceStats, HcParams, ImproveReport, SurfaceError, SurfaceParams,
    TriMesh, TriangleBvh, contour, mesh_to_field, one_way_distance, self_intersections, surface_quality,
    validate,
};
use palpate_volume::{CapPlane, ScalarField};
use serde::{Deserialize, Serialize};

/// Size of the surface after a step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StepReport {
    /// `iso_surface`, `hc_smoothed`, `decimated` or `improved`.
    pub step: String,
    /// Vertices.
    pub vertices: usize,
    /// Triangles.
    pub faces: usize,
    /// Enclosed volume, mm³.
    pub volume_mm3: f64,
    /// The same against the reference volume, per cent.
    pub volume_error_percent: f64,
}

/// What the surface stage made, and how good it is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SurfaceReport {
    /// Volume of the repaired voxels, mm³.
    pub reference_volume_mm3: f64,
    /// Sizes and volumes after each step.
    pub steps: Vec<StepReport>,
    /// Smoothing that was used.
    pub hc: HcParams,
    /// Triangles asked for, after the limit that the field's sampling sets.
    pub target_faces: usize,
    /// Bodies (positive) and voids (negative) that were dropped as too small, mm³.
    pub dropped_parts_mm3: Vec<f64>,
    /// Decimation.
    pub decimate: DecimateReport,
    /// Improvement.
    pub improve: ImproveReport,
    /// Whether the first result had crossing triangles, so that the work was done again with every guard on.
    pub redone_with_all_guards: bool,
    /// Parts of the surface (bodies and voids).
    pub components: usize,
    /// Euler number of the iso-surface and of the result: equal.
    pub euler_number: i64,
    /// Surface area, mm².
    pub area_mm2: f64,
    /// Smallest 4√3·area/Σedge² (1 is equilateral).
    pub min_quality: f64,
    /// Mean 4√3·area/Σedge².
    pub mean_quality: f64,
    /// Smallest angle, degrees.
    pub min_angle_deg: f64,
    /// Share of the triangles whose smallest angle is under 20°.
    pub below_20_deg_share: f64,
    /// Share of the triangles whose smallest angle is under 30°.
    pub below_30_deg_share: f64,
    /// Mean edge, mm.
    pub mean_edge_mm: f64,
    /// Pairs of triangles that cross: 0, or the stage refuses.
    pub self_intersections: usize,
    /// From the result to the unsmoothed iso-surface (zero set of the field).
    pub to_iso_surface: DistanceStats,
    /// From the unsmoothed iso-surface to the result.
    pub from_iso_surface: DistanceStats,
    /// Both ways together: `rms_mm` and the Hausdorff distance `max_mm`.
    pub symmetric_rms_mm: f64,
    /// Larger of both ways.
    pub symmetric_p99_mm: f64,
    /// Larger of both ways.
    pub hausdorff_mm: f64,
    /// From the result within two samples of a flat cap's plane to the iso-surface: left out above.
    pub cap_to_iso_surface: DistanceStats,
    /// From the iso-surface there to the result.
    pub cap_from_iso_surface: DistanceStats,
}

/// Makes the collision surface of one body: iso-surface → HC Laplacian → quadric edge collapse → improvement.
///
/// `reference_volume_mm3`: volume of the repaired voxels. `caps`: where the scan's border cuts the body; the surface
/// there keeps to the border plane. The result is closed, 2-manifold, outward-facing, of the iso-surface's topology,
/// and free of self-intersection; patient RAS mm. The same bytes on any number of threads.
///
/// # Errors
/// A field that cannot be contoured, a parameter out of range, a volume off by more than the larger of 0.5 % and
/// 20 mm³, or crossings that could not be avoided (where).
pub fn build_surface(
    field: &ScalarField,
    caps: &[CapPlane],
    reference_volume_mm3: f64,
    params: &SurfaceParams,
) -> Result<(TriMesh, SurfaceReport), SurfaceError> {
    params.check()?;
    if !(reference_volume_mm3 > 0.0 && reference_volume_mm3.is_finite()) {
        return Err(SurfaceError::Parameter {
            name: "reference_volume_mm3",
            value: reference_volume_mm3,
            expected: "above 0",
        });
    }
    let mut report = SurfaceReport {
        reference_volume_mm3,
        hc: params.hc.clone(),
        ..Default::default()
    };
    let (iso, dropped) = drop_small_parts(contour(field)?, params.min_part_share);
    report.dropped_parts_mm3 = dropped;
    report.add_step("iso_surface", &iso);
    let on_cap = |p: [f64; 3], within_mm: f64| {
        caps.iter()
            .any(|c| dot(sub(p, c.point_mm), c.normal).abs() < within_mm)
    };
    let pin_mm = 0.5 * field.spacing_mm;
    let smooth = hc_smooth_pinned(&iso, &params.hc, |p| on_cap(p, pin_mm))?;
    report.add_step("hc_smoothed", &smooth);

    let area_mm2 = area_mm2(&smooth);
    let finest_mm = params.finest_edge_samples * field.spacing_mm;
    let most = (area_mm2 / (0.25 * 3f64.sqrt() * finest_mm * finest_mm)) as usize;
    let least = match params.largest_mean_face_mm2 {
        0.0 => 0,
        largest => (area_mm2 / largest) as usize,
    };
    report.target_faces = params.target_faces.max(least).min(most).max(MIN_FACES);
    let half_edges = HalfEdges::from_mesh(&smooth)?;
    drop(smooth);

    let mut built = build_guarded(
        field,
        caps,
        half_edges.clone(),
        area_mm2,
        params,
        false,
        &mut report,
    )?;
    let mut crossings = self_intersections(&built, MAX_CROSSINGS)?;
    if !crossings.is_empty() {
        report.redone_with_all_guards = true;
        built = build_guarded(field, caps, half_edges, area_mm2, params, true, &mut report)?;
        crossings = self_intersections(&built, MAX_CROSSINGS)?;
    }
    report.self_intersections = crossings.len();
    if let Some((f, _)) = crossings.first() {
        let t = built.triangles[*f as usize].map(|v| built.vertices[v as usize]);
        let position_mm = std::array::from_fn(|a| (t[0][a] + t[1][a] + t[2][a]) / 3.0);
        return Err(SurfaceError::SelfIntersecting {
            count: crossings.len(),
            position_mm,
        });
    }
    check_soundness(&iso, &built, &mut report)?;
    measure(
        field,
        &iso,
        &built,
        params,
        &|p| on_cap(p, 2.0 * field.spacing_mm),
        &mut report,
    )?;
    let volume = built.volume_mm3();
    let allowed_mm3 = (0.005 * reference_volume_mm3).max(20.0);
    if (volume - reference_volume_mm3).abs() > allowed_mm3 {
        return Err(SurfaceError::Volume {
            found_mm3: volume,
            reference_mm3: reference_volume_mm3,
            allowed_mm3,
        });
    }
    Ok((built, report))
}

/// Fewest triangles that a body is given.
const MIN_FACES: usize = 60;
/// Crossing pairs that are listed at most.
const MAX_CROSSINGS: usize = 1000;
/// Edges shorter than this share of the final edge length are collapsed without a heap: four times as many triangles
/// as asked for are left to the heap, at a sixth of the time and with the same distances (measured on real kidneys).
const FIRST_PHASE_SHARE: f64 = 0.35;

fn area_mm2(mesh: &TriMesh) -> f64 {
    let p = |v: u32| mesh.vertices[v as usize];
    mesh.triangles
        .iter()
        .map(|t| 0.5 * crate::vector::length(crate::vector::area_normal(p(t[0]), p(t[1]), p(t[2]))))
        .sum()
}

/// Decimation and improvement; with `guard_all` every change is tested for crossings, not only those near a second
/// sheet.
fn build_guarded(
    field: &ScalarField,
    caps: &[CapPlane],
    mesh: HalfEdges,
    area_mm2: f64,
    params: &SurfaceParams,
    guard_all: bool,
    report: &mut SurfaceReport,
) -> Result<TriMesh, SurfaceError> {
    report.steps.truncate(2);
    let decimate = DecimateParams {
        target_faces: report.target_faces,
        quality_threshold: params.quality_threshold,
        first_phase_edge_mm: FIRST_PHASE_SHARE * triangle_edge(area_mm2, report.target_faces),
        guard: true,
    };
    let (mesh, decimated) = decimate_half_edges(mesh, &decimate, (!guard_all).then_some(field))?;
    report.decimate = decimated;
    report.add_step("decimated", &mesh.to_mesh());
    let mut improver = Improver::new(mesh, field, caps, &params.improve, guard_all);
    improver.run();
    if params.improve.rounds > 0 {
        improver.match_volume(report.reference_volume_mm3);
    }
    let (mesh, improved) = improver.finish();
    report.improve = improved;
    report.add_step("improved", &mesh);
    Ok(mesh)
}

impl SurfaceReport {
    fn add_step(&mut self, step: &str, mesh: &TriMesh) {
        let volume_mm3 = mesh.volume_mm3();
        self.steps.push(StepReport {
            step: step.into(),
            vertices: mesh.vertices.len(),
            faces: mesh.triangles.len(),
            volume_mm3,
            volume_error_percent: 100.0 * (volume_mm3 / self.reference_volume_mm3 - 1.0),
        });
    }
}

/// Closed, manifold, each part on the side and with the Euler number that the iso-surface has.
fn check_soundness(iso: &TriMesh, mesh: &TriMesh, report: &mut SurfaceReport) -> Result<(), SurfaceError> {
    let topology = validate(mesh)?;
    let refuse = |what: String| Err(SurfaceError::Unsound { what });
    if !(topology.closed && topology.manifold && topology.misoriented_edges == 0) {
        return refuse(format!(
            "{} open edges, {} non-manifold edges, {} non-manifold vertices, {} misoriented edges",
            topology.open_edges,
            topology.nonmanifold_edges,
            topology.nonmanifold_vertices,
            topology.misoriented_edges
        ));
    }
    if topology.degenerate_faces > 0 {
        return refuse(format!("{} triangles without area", topology.degenerate_faces));
    }
    let sides = |m: &TriMesh| parts(m).volumes_mm3.iter().filter(|v| **v > 0.0).count();
    let (parts_iso, parts_mesh) = (parts(iso).volumes_mm3.len(), topology.components.len());
    if parts_iso != parts_mesh || sides(iso) != sides(mesh) {
        return refuse(format!(
            "{parts_mesh} parts of which {} face outward, in the iso-surface {parts_iso} and {}",
            sides(mesh),
            sides(iso)
        ));
    }
    let euler = iso.vertices.len() as i64 - iso.triangles.len() as i64 / 2;
    if topology.euler != euler {
        return refuse(format!(
            "Euler number {}, in the iso-surface {euler}",
            topology.euler
        ));
    }
    report.components = parts_mesh;
    report.euler_number = euler;
    Ok(())
}

fn measure(
    field: &ScalarField,
    iso: &TriMesh,
    mesh: &TriMesh,
    params: &SurfaceParams,
    near_cap: &(dyn Fn([f64; 3]) -> bool + Sync),
    report: &mut SurfaceReport,
) -> Result<(), SurfaceError> {
    let q = surface_quality(mesh)?;
    report.area_mm2 = q.area_mm2;
    report.min_quality = q.min_quality;
    report.mean_quality = q.mean_quality;
    report.min_angle_deg = q.min_angle_deg;
    report.mean_edge_mm = q.mean_edge_mm;
    let below = |deg: f64| {
        let limit = f64::to_radians(deg);
        let small = |t: &&[u32; 3]| crate::improve::min_angle(&t.map(|v| mesh.vertices[v as usize])) < limit;
        mesh.triangles.iter().filter(small).count() as f64 / q.faces.max(1) as f64
    };
    report.below_20_deg_share = below(20.0);
    report.below_30_deg_share = below(30.0);
    let to = mesh_to_field(mesh, field, params.distance_samples, near_cap)?;
    let from = one_way_distance(iso, &TriangleBvh::build(mesh)?, params.distance_samples, near_cap)?;
    report.to_iso_surface = to.measured;
    report.from_iso_surface = from.measured;
    report.cap_to_iso_surface = to.exempt;
    report.cap_from_iso_surface = from.exempt;
    let (a, b) = (to.measured, from.measured);
    report.symmetric_rms_mm = (0.5 * (a.rms_mm * a.rms_mm + b.rms_mm * b.rms_mm)).sqrt();
    report.symmetric_p99_mm = a.p99_mm.max(b.p99_mm);
    report.hausdorff_mm = a.max_mm.max(b.max_mm);
    Ok(())
}
