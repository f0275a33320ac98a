use crate::compare::{BodyComparison, compare, surface_to_fem};
use crate::fiducials::Fiducials;
use crate::report::{ReportInput, StageRow, write_report};
use crate::stage::StageRecord;
use crate::{Inputs, Progress, Recipe, rows};
use anyhow::Context;
use palpate_package as package;
use palpate_particles::{Clusters, ParticleReport, ParticleSet, build_particles};
use palpate_skinning::{SkinReport, SkinWeights, bind, points_far_from_members};
use palpate_surface::{SurfaceReport, TriMesh, build_surface};
use palpate_tetmesh::{EmbeddingReport, FemReport, TetMesh, build_embedding, build_fem};
use palpate_volume::{
    Anatomy, Body, CtVolume, Implicit, LabelGrid, ReadReport, ScalarField, build_anatomy, read_ct,
    read_labels,
};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::io::Read;
use std::path::Path;
use std::time::Instant;

/// A finished build: the package, and what the report's pictures are made from.
pub struct Built {
    /// What is written.
    pub package: package::ModelPackage,
    /// Stages in order, with times, figures and warnings.
    pub stages: Vec<StageRecord>,
    /// Recipe that was used.
    pub recipe: Recipe,
    /// Scan file, as given.
    pub scan: String,
    /// Fields and voxels.
    pub anatomy: Anatomy,
    /// Intensities on the crop.
    pub ct: Option<CtVolume>,
    /// Organ, structures, supports: name and surface, patient RAS mm.
    pub surfaces: Vec<(String, TriMesh)>,
    /// Particles, patient RAS mm.
    pub particles: ParticleSet,
    /// Clusters.
    pub clusters: Clusters,
    /// FEM mesh, patient RAS mm.
    pub fem: TetMesh,
    /// FEM report, for its histograms.
    pub fem_report: FemReport,
    /// Embedding mesh, patient RAS mm.
    pub embedding: TetMesh,
}

struct SurfaceSide {
    surfaces: Vec<(String, TriMesh)>,
    particles: ParticleSet,
    clusters: Clusters,
    stages: Vec<StageRecord>,
}

struct TetSide {
    fem: TetMesh,
    fem_report: FemReport,
    embedding: TetMesh,
    stages: Vec<StageRecord>,
}

/// Builds a model: reads the scan and runs every stage in order.
///
/// # Errors
/// The first stage that refuses, with the file or body that it refused.
pub fn build(inputs: &Inputs, recipe: &Recipe, progress: &Progress) -> anyhow::Result<Built> {
    progress.stage("read");
    let clock = Instant::now();
    let (labels, read_report) = read_labels(&inputs.scan, &|f| progress.fraction(f))?;
    let mut stages = vec![rows::read(&read_report, &labels, clock.elapsed().as_secs_f64())?];

    progress.stage("volume");
    let clock = Instant::now();
    let grid = LabelGrid {
        dims: labels.dims,
        affine: labels.affine,
        codes: &labels.codes,
        values: &labels.values,
    };
    let (anatomy, volume_report) = build_anatomy(&grid, &recipe.selection, &recipe.volume, &|_, f| {
        progress.fraction(f)
    })
    .with_context(|| format!("cannot build from {}", inputs.scan.display()))?;
    let scan = package::ScanInfo {
        dims: labels.dims.map(|d| d as u64),
        affine: labels.affine.m,
    };
    // The whole scan is not needed any more; a large one is most of the memory.
    drop(labels);
    stages.push(rows::volume(&volume_report, clock.elapsed().as_secs_f64())?);

    let fiducials = inputs
        .fiducials
        .as_deref()
        .map(Fiducials::read)
        .transpose()?
        .unwrap_or_default();
    let ct = match &inputs.ct {
        Some(path) => {
            progress.stage("intensities");
            let clock = Instant::now();
            let (ct, report) = read_ct(path, anatomy.regions.dims, &anatomy.regions.affine, &|f| {
                progress.fraction(f)
            })?;
            stages.push(rows::ct(&report, &ct, clock.elapsed().as_secs_f64())?);
            Some(ct)
        }
        None => None,
    };

    progress.stage("surface, particles, tets");
    let dividers: Vec<&dyn Implicit> = anatomy
        .structures
        .iter()
        .map(|s| &s.divider as &dyn Implicit)
        .collect();
    let (left, right) = rayon::join(
        || surface_side(&anatomy, recipe),
        || tet_side(&anatomy, &dividers, recipe),
    );
    let (mut left, mut right) = (left?, right?);
    stages.append(&mut left.stages);
    stages.append(&mut right.stages);

    let clock = Instant::now();
    let cover = surface_to_fem(&left.surfaces[0].1, &right.fem)?;
    stages.push(rows::cover(
        &cover,
        right.fem_report.edge_mm,
        clock.elapsed().as_secs_f64(),
    )?);

    progress.stage("skinning");
    let clock = Instant::now();
    let skins = Skins::bind(
        &left,
        &right.embedding,
        &fiducials,
        anatomy.structures.len(),
        recipe,
    )?;
    stages.push(rows::skinning(
        &skins.reports,
        skins.far,
        clock.elapsed().as_secs_f64(),
    )?);

    progress.stage("package");
    let clock = Instant::now();
    let model = assemble(
        inputs, recipe, &anatomy, scan, &ct, &left, &right, skins, fiducials, &stages,
    )?;
    stages.push(StageRecord::new("package", clock.elapsed().as_secs_f64()));
    Ok(Built {
        package: model,
        stages,
        recipe: recipe.clone(),
        scan: inputs.scan.display().to_string(),
        anatomy,
        ct,
        surfaces: left.surfaces,
        particles: left.particles,
        clusters: left.clusters,
        fem: right.fem,
        fem_report: right.fem_report,
        embedding: right.embedding,
    })
}

fn surface_side(anatomy: &Anatomy, recipe: &Recipe) -> anyhow::Result<SurfaceSide> {
    let clock = Instant::now();
    let bodies: Vec<&Body> = std::iter::once(&anatomy.organ)
        .chain(anatomy.structures.iter().map(|s| &s.body))
        .chain(&anatomy.supports)
        .collect();
    let made = bodies
        .par_iter()
        .map(|body| {
            build_surface(&body.field, &body.caps, body.voxel_volume_mm3, &recipe.surface)
                .with_context(|| format!("surface of {}", body.name))
        })
        .collect::<anyhow::Result<Vec<(TriMesh, SurfaceReport)>>>()?;
    let (meshes, reports): (Vec<TriMesh>, Vec<SurfaceReport>) = made.into_iter().unzip();
    let names = || bodies.iter().map(|b| b.name.as_str());
    let mut stages = vec![rows::surface(
        names().zip(&reports),
        clock.elapsed().as_secs_f64(),
    )?];

    let (compared, filled) = rayon::join(
        || compare_all(&bodies, &meshes),
        || fill(anatomy, &meshes[0], recipe),
    );
    let (comparisons, seconds) = compared?;
    stages.push(rows::comparison(names().zip(&comparisons), seconds)?);
    let (particles, clusters, stage) = filled?;
    stages.push(stage);
    let surfaces = bodies.iter().map(|b| b.name.clone()).zip(meshes).collect();
    Ok(SurfaceSide {
        surfaces,
        particles,
        clusters,
        stages,
    })
}

/// Distances of every body's surface to its labels, and the time that took, s.
fn compare_all(bodies: &[&Body], meshes: &[TriMesh]) -> anyhow::Result<(Vec<BodyComparison>, f64)> {
    let clock = Instant::now();
    let found = bodies
        .par_iter()
        .zip(meshes)
        .map(|(body, mesh)| compare(body, mesh).with_context(|| format!("distances of {}", body.name)))
        .collect::<anyhow::Result<_>>()?;
    Ok((found, clock.elapsed().as_secs_f64()))
}

fn fill(
    anatomy: &Anatomy,
    organ: &TriMesh,
    recipe: &Recipe,
) -> anyhow::Result<(ParticleSet, Clusters, StageRecord)> {
    let clock = Instant::now();
    let fields: Vec<&ScalarField> = anatomy.structures.iter().map(|s| &s.divider).collect();
    let region_of = |p: [f64; 3]| {
        fields
            .iter()
            .position(|f| f.value(p) < 0.0)
            .map_or(0, |n| u16::try_from(n + 1).unwrap_or(0))
    };
    let (particles, clusters, report): (_, _, ParticleReport) =
        build_particles(&organ.vertices, &organ.triangles, &region_of, &recipe.particles)
            .with_context(|| format!("particles of {}", anatomy.organ.name))?;
    let stage = rows::particles(&report, clock.elapsed().as_secs_f64())?;
    Ok((particles, clusters, stage))
}

fn tet_side(anatomy: &Anatomy, dividers: &[&dyn Implicit], recipe: &Recipe) -> anyhow::Result<TetSide> {
    let clock = Instant::now();
    let volumes: Vec<f64> = std::iter::once(&anatomy.organ)
        .chain(anatomy.structures.iter().map(|s| &s.body))
        .map(|b| b.voxel_volume_mm3)
        .collect();
    let (fem, fem_report) = build_fem(&anatomy.organ.field, dividers, &volumes, &recipe.fem)
        .with_context(|| format!("FEM mesh of {}", anatomy.organ.name))?;
    let names: Vec<&str> = std::iter::once(anatomy.organ.name.as_str())
        .chain(anatomy.structures.iter().map(|s| s.body.name.as_str()))
        .collect();
    let mut stages = vec![rows::fem(&fem_report, &names, clock.elapsed().as_secs_f64())?];
    let clock = Instant::now();
    let (embedding, report): (_, EmbeddingReport) = build_embedding(&anatomy.organ.field, &recipe.embedding)
        .with_context(|| format!("embedding mesh of {}", anatomy.organ.name))?;
    stages.push(rows::embedding(&report, clock.elapsed().as_secs_f64())?);
    Ok(TetSide {
        fem,
        fem_report,
        embedding,
        stages,
    })
}

struct Skins {
    surfaces: Vec<SkinWeights>,
    embedding: SkinWeights,
    fiducials: SkinWeights,
    reports: Vec<(String, SkinReport)>,
    /// Points of the organ's and structures' surfaces without a member of their first cluster within two radii.
    far: usize,
}

impl Skins {
    fn bind(
        side: &SurfaceSide,
        embedding: &TetMesh,
        fiducials: &Fiducials,
        structures: usize,
        recipe: &Recipe,
    ) -> anyhow::Result<Self> {
        let mut reports = Vec::new();
        let mut one = |name: &str, points: &[[f64; 3]]| -> anyhow::Result<SkinWeights> {
            let (weights, report) = bind(points, &side.clusters.rest_centres, &recipe.skinning)
                .with_context(|| format!("skinning of {name}"))?;
            reports.push((name.to_string(), report));
            Ok(weights)
        };
        // Supports do not move: the organ and its structures come first.
        let surfaces = side
            .surfaces
            .iter()
            .take(1 + structures)
            .map(|(name, mesh)| one(name, &mesh.vertices))
            .collect::<anyhow::Result<Vec<_>>>()?;
        let reach = 2.0 * recipe.particles.radius_mm;
        let far = side
            .surfaces
            .iter()
            .zip(&surfaces)
            .map(|((_, mesh), w)| {
                let c = &side.clusters;
                points_far_from_members(
                    &mesh.vertices,
                    w,
                    &c.offsets,
                    &c.members,
                    &side.particles.positions,
                    reach,
                )
            })
            .sum();
        let embedding = one("embedding", &embedding.vertices)?;
        let fiducials = if fiducials.names.is_empty() {
            SkinWeights::default()
        } else {
            one("fiducials", &fiducials.positions)?
        };
        Ok(Self {
            surfaces,
            embedding,
            fiducials,
            reports,
            far,
        })
    }
}

fn skin(w: SkinWeights) -> package::Skin {
    package::Skin {
        indices: w.indices,
        weights: w.weights,
    }
}

fn assemble(
    inputs: &Inputs,
    recipe: &Recipe,
    anatomy: &Anatomy,
    scan: package::ScanInfo,
    ct: &Option<CtVolume>,
    left: &SurfaceSide,
    right: &TetSide,
    skins: Skins,
    fiducials: Fiducials,
    stages: &[StageRecord],
) -> anyhow::Result<package::ModelPackage> {
    let frame = package::Frame::around(&left.surfaces[0].1.vertices);
    let moving = 1 + anatomy.structures.len();
    let bodies: Vec<(&Body, package::SurfaceKind)> =
        std::iter::once((&anatomy.organ, package::SurfaceKind::Organ))
            .chain(
                anatomy
                    .structures
                    .iter()
                    .map(|s| (&s.body, package::SurfaceKind::Structure)),
            )
            .chain(
                anatomy
                    .supports
                    .iter()
                    .map(|b| (b, package::SurfaceKind::Support)),
            )
            .collect();
    let mut weights = skins.surfaces.into_iter();
    let surfaces = bodies
        .iter()
        .zip(&left.surfaces)
        .map(|(&(body, kind), (name, mesh))| {
            let caps: Vec<_> = body.caps.iter().map(|c| (c.point_mm, c.normal)).collect();
            frame.surface(
                name,
                kind,
                &mesh.vertices,
                &mesh.triangles,
                weights.next().map(skin),
                &caps,
            )
        })
        .collect();
    let particles = frame.particles(
        &left.particles.positions,
        left.particles.regions.clone(),
        left.particles.creation_order.clone(),
        recipe.particles.radius_mm,
        recipe.tissue.density_g_per_mm3,
        anatomy.organ.voxel_volume_mm3,
    );
    let clusters = package::Clusters::new(
        &particles,
        left.clusters.offsets.clone(),
        left.clusters.members.clone(),
        left.clusters.regions.clone(),
    )?;
    let mut fem = frame.fem(&right.fem.vertices, &right.fem.tets, &right.fem.regions);
    fem.tagged = right
        .fem_report
        .tagged
        .iter()
        .map(|t| package::TaggedStructure {
            name: anatomy
                .structures
                .get(t.structure)
                .map(|s| s.body.name.clone())
                .unwrap_or_default(),
            region: u16::try_from(t.structure + 1).unwrap_or(u16::MAX),
            thickness_mm: t.thickness_mm,
            tet_fraction: t.tet_fraction.clone(),
        })
        .collect();
    let regions: Vec<String> = bodies[..moving].iter().map(|(b, _)| b.name.clone()).collect();
    let s = &recipe.selection;
    let label_table = std::iter::once(&s.organ)
        .chain(&s.structures)
        .chain(&s.supports)
        .flat_map(|r| r.labels.iter().map(move |&value| (value, &r.name)))
        .map(|(value, body)| package::LabelEntry {
            value,
            name: recipe
                .label_names
                .iter()
                .find(|l| l.label == value)
                .map_or_else(|| body.clone(), |l| l.name.clone()),
            body: body.clone(),
        })
        .collect();
    let mut digests = vec![digest("labels", &inputs.scan)?];
    if let Some(path) = &inputs.ct {
        digests.push(digest("ct", path)?);
    }
    if let Some(path) = &inputs.fiducials {
        digests.push(digest("fiducials", path)?);
    }
    let report: serde_json::Map<String, serde_json::Value> = stages
        .iter()
        .map(|s| (s.name.clone(), s.report.clone()))
        .collect();
    let r = &anatomy.regions;
    let model = package::ModelPackage {
        info: package::PackageInfo {
            generator: format!("build-model {}", env!("CARGO_PKG_VERSION")),
            local_origin_mm: frame.local_origin_mm,
            regions,
            scan,
            label_table,
            inputs: digests,
            recipe: serde_json::to_value(recipe)?,
            report: report.into(),
        },
        surfaces,
        particles,
        clusters,
        embedding: frame.embedding(
            &right.embedding.vertices,
            &right.embedding.tets,
            skin(skins.embedding),
        ),
        fem,
        fiducials: frame.fiducials(fiducials.names, &fiducials.positions, skin(skins.fiducials)),
        labels: package::Labels {
            dims: r.dims,
            affine: r.affine.m,
            data: r.data.clone(),
            names: r.names.clone(),
        },
        ct: ct.as_ref().map(|c| package::Ct {
            dims: c.dims,
            affine: c.affine.m,
            hu: c.hu.clone(),
        }),
    };
    model
        .validate()
        .context("internal error: the assembled model breaks the package's own rules")?;
    Ok(model)
}

fn digest(role: &str, path: &Path) -> anyhow::Result<package::InputDigest> {
    let mut file = std::fs::File::open(path).with_context(|| format!("cannot open: {}", path.display()))?;
    let mut hash = Sha256::new();
    let mut block = vec![0; 1 << 16];
    let mut bytes = 0u64;
    loop {
        let n = file
            .read(&mut block)
            .with_context(|| format!("cannot read: {}", path.display()))?;
        if n == 0 {
            break;
        }
        bytes += n as u64;
        hash.update(&block[..n]);
    }
    let sha256 = hash.finalize().iter().map(|b| format!("{b:02x}")).collect();
    Ok(package::InputDigest {
        role: role.into(),
        sha256,
        bytes,
    })
}

impl Built {
    /// Writes the page with pictures into `dir`.
    ///
    /// # Errors
    /// A folder or file that cannot be written.
    pub fn write_report(&self, dir: &Path) -> anyhow::Result<()> {
        let stages: Vec<StageRow> = self
            .stages
            .iter()
            .map(|s| StageRow {
                name: s.name.clone(),
                seconds: s.seconds,
                rows: s.rows.clone(),
                warnings: s.warnings.clone(),
            })
            .collect();
        let scan = Path::new(&self.scan)
            .file_name()
            .unwrap_or_default()
            .to_string_lossy();
        write_report(
            dir,
            &ReportInput {
                scan: &scan,
                recipe: &self.recipe.to_toml()?,
                remark: None,
                anatomy: &self.anatomy,
                ct: self.ct.as_ref(),
                surfaces: &self.surfaces,
                particles: &self.particles,
                clusters: &self.clusters,
                fem: &self.fem,
                embedding: &self.embedding,
                dihedral_before: &self.fem_report.before.dihedral_histogram,
                dihedral_after: &self.fem_report.after.dihedral_histogram,
                stages: &stages,
            },
        )?;
        Ok(())
    }

    /// Runs `work` on the finished build and records its time as a stage.
    ///
    /// # Errors
    /// What `work` answers.
    pub fn timed<T, E>(&mut self, name: &str, work: impl FnOnce(&Self) -> Result<T, E>) -> Result<T, E> {
        let clock = Instant::now();
        let out = work(self)?;
        self.stages
            .push(StageRecord::new(name, clock.elapsed().as_secs_f64()));
        Ok(out)
    }
}

/// Read reports carry the file's name as the user gave it; the package must not depend on where the file lies.
pub(crate) fn without_path(report: &ReadReport) -> ReadReport {
    let mut r = report.clone();
    r.file = Path::new(&r.file)
        .file_name()
        .map(|n| n.to_string_lossy().into_owned())
        .unwrap_or_default();
    r
}
