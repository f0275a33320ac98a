use crate::manifest::{self, EntryInfo, Manifest, ParticleInfo, SurfaceInfo, TaggedInfo};
use crate::model::{ModelPackage, Skin};
use crate::npy::{self, Element};
use crate::{PackageError, archive};

/// Folders of the surfaces and of the tagged structures, by their names made safe for a file name.
pub(crate) fn folders(model: &ModelPackage) -> (Vec<String>, Vec<String>) {
    let surfaces = file_names(model.surfaces.iter().map(|s| s.name.as_str()));
    let tagged = file_names(model.fem.tagged.iter().map(|t| t.name.as_str()));
    (
        surfaces.into_iter().map(|n| format!("surfaces/{n}")).collect(),
        tagged.into_iter().map(|n| format!("fem/tagged/{n}")).collect(),
    )
}

/// Names made of ASCII letters, digits, `-` and `_`, none twice even where case does not count.
pub(crate) fn file_names<'a>(names: impl Iterator<Item = &'a str>) -> Vec<String> {
    let mut out: Vec<String> = Vec::new();
    let mut taken = std::collections::BTreeSet::new();
    for name in names {
        let safe: String = name
            .chars()
            .take(64)
            .map(|c| {
                if c.is_ascii_alphanumeric() || c == '-' {
                    c
                } else {
                    '_'
                }
            })
            .collect();
        let safe = if safe.is_empty() {
            "unnamed".to_string()
        } else {
            safe
        };
        let mut n = 1;
        let mut unique = safe.clone();
        while !taken.insert(unique.to_ascii_lowercase()) {
            n += 1;
            unique = format!("{safe}-{n}");
        }
        out.push(unique);
    }
    out
}

struct Writer {
    entries: Vec<(String, Vec<u8>)>,
    infos: Vec<EntryInfo>,
}

impl Writer {
    fn put<T: Element>(&mut self, name: String, shape: &[usize], data: impl IntoIterator<Item = T>) {
        let bytes = npy::encode(shape, data);
        self.infos.push(EntryInfo {
            name: name.clone(),
            dtype: T::DTYPE.descr().into(),
            shape: shape.to_vec(),
            sha256: manifest::sha256(&bytes),
        });
        self.entries.push((name, bytes));
    }

    fn list<T: Element>(&mut self, name: String, data: &[T]) {
        self.put(name, &[data.len()], data.iter().copied());
    }

    fn rows<T: Element, const K: usize>(&mut self, name: String, rows: &[[T; K]]) {
        self.put(name, &[rows.len(), K], rows.iter().flatten().copied());
    }

    fn skin(&mut self, folder: &str, skin: &Skin) {
        self.rows(format!("{folder}/skin_indices.npy"), &skin.indices);
        self.rows(format!("{folder}/skin_weights.npy"), &skin.weights);
    }
}

/// The package's bytes and its content digest. The model must be valid.
pub(crate) fn encode(model: &ModelPackage) -> Result<(Vec<u8>, String), PackageError> {
    let size = payload(model);
    if size > archive::MAX_BYTES {
        return Err(PackageError::TooLarge {
            what: "the model".into(),
            bytes: size,
            limit: archive::MAX_BYTES,
        });
    }
    let (surface_folders, tagged_folders) = folders(model);
    let mut w = Writer {
        entries: vec![(manifest::NAME.into(), Vec::new())],
        infos: Vec::new(),
    };
    for (s, folder) in model.surfaces.iter().zip(&surface_folders) {
        w.rows(format!("{folder}/vertices.npy"), &s.vertices);
        w.rows(format!("{folder}/triangles.npy"), &s.triangles);
        if let Some(normals) = &s.normals {
            w.rows(format!("{folder}/normals.npy"), normals);
        }
        if let Some(skin) = &s.skin {
            w.skin(folder, skin);
        }
        if !s.caps.is_empty() {
            let points: Vec<_> = s.caps.iter().map(|c| c.point).collect();
            let normals: Vec<_> = s.caps.iter().map(|c| c.normal).collect();
            w.rows(format!("{folder}/cap_points.npy"), &points);
            w.rows(format!("{folder}/cap_normals.npy"), &normals);
        }
    }
    let p = &model.particles;
    w.rows("particles/positions.npy".into(), &p.positions);
    w.list("particles/region.npy".into(), &p.region);
    w.list("particles/creation_order.npy".into(), &p.creation_order);
    let c = &model.clusters;
    w.list("clusters/offsets.npy".into(), &c.offsets);
    w.list("clusters/members.npy".into(), &c.members);
    w.rows("clusters/rest_centres.npy".into(), &c.rest_centres);
    w.rows("clusters/rest_local.npy".into(), &c.rest_local);
    w.list("clusters/region.npy".into(), &c.region);
    w.list("clusters/particle_offsets.npy".into(), &c.particle_offsets);
    w.list("clusters/particle_entries.npy".into(), &c.particle_entries);
    w.rows("embedding/vertices.npy".into(), &model.embedding.vertices);
    w.rows("embedding/tets.npy".into(), &model.embedding.tets);
    w.skin("embedding", &model.embedding.skin);
    w.rows("fem/vertices.npy".into(), &model.fem.vertices);
    w.rows("fem/tets.npy".into(), &model.fem.tets);
    w.list("fem/regions.npy".into(), &model.fem.regions);
    for (t, folder) in model.fem.tagged.iter().zip(&tagged_folders) {
        w.list(format!("{folder}/tet_fraction.npy"), &t.tet_fraction);
    }
    w.rows("fiducials/positions.npy".into(), &model.fiducials.positions);
    w.skin("fiducials", &model.fiducials.skin);
    let l = &model.labels;
    w.put(
        "labels/data.npy".into(),
        &[l.dims[2], l.dims[1], l.dims[0]],
        l.data.iter().copied(),
    );
    w.rows("labels/affine.npy".into(), &l.affine);
    if let Some(ct) = &model.ct {
        w.put(
            "ct/hu.npy".into(),
            &[ct.dims[2], ct.dims[1], ct.dims[0]],
            ct.hu.iter().copied(),
        );
        w.rows("ct/affine.npy".into(), &ct.affine);
    }

    let (format, schema, units, frame) = Manifest::fixed();
    let info = &model.info;
    let manifest = Manifest {
        format,
        schema,
        generator: info.generator.clone(),
        units,
        frame,
        local_origin_mm: info.local_origin_mm,
        scan: info.scan,
        regions: info.regions.clone(),
        label_names: l.names.clone(),
        label_table: info.label_table.clone(),
        inputs: info.inputs.clone(),
        surfaces: model
            .surfaces
            .iter()
            .zip(surface_folders)
            .map(|(s, folder)| SurfaceInfo {
                name: s.name.clone(),
                kind: s.kind,
                folder,
            })
            .collect(),
        particles: ParticleInfo {
            radius_mm: p.radius_mm,
            mass_g: p.mass_g,
        },
        tagged: model
            .fem
            .tagged
            .iter()
            .zip(tagged_folders)
            .map(|(t, folder)| TaggedInfo {
                name: t.name.clone(),
                region: t.region,
                thickness_mm: t.thickness_mm,
                folder,
            })
            .collect(),
        fiducials: model.fiducials.names.clone(),
        recipe: info.recipe.clone(),
        report: info.report.clone(),
        entries: w.infos,
        content_sha256: String::new(),
    };
    let (text, digest) = manifest::to_text(&manifest)?;
    w.entries[0].1 = text;
    Ok((archive::write(&w.entries)?, digest))
}

/// Bytes of the arrays alone, before anything is allocated for them.
fn payload(model: &ModelPackage) -> u64 {
    let skin = |s: &Skin| 16 * (s.indices.len() + s.weights.len());
    let surfaces: usize = model
        .surfaces
        .iter()
        .map(|s| 12 * (s.vertices.len() + s.triangles.len()) + s.skin.as_ref().map_or(0, skin))
        .sum();
    let particles = 18 * model.particles.positions.len() + 20 * model.clusters.members.len();
    let tets = 16 * (model.embedding.tets.len() + model.fem.tets.len())
        + 12 * (model.embedding.vertices.len() + model.fem.vertices.len());
    let voxels = model.labels.data.len() + 2 * model.ct.as_ref().map_or(0, |c| c.hu.len());
    (surfaces + particles + tets + voxels) as u64
}
