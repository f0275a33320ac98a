use crate::manifest::{self, Manifest};
use crate::model::{
    Affine34, Cap, Clusters, Ct, Embedding, FemMesh, Fiducials, Labels, ModelPackage, PackageInfo, Particles,
    Skin, Surface, TaggedStructure,
};
use crate::npy::{self, ArrayView, Element};
use crate::{PackageError, archive};
use std::collections::BTreeMap;

/// The arrays of a package by name; each is taken once, what is left at the end belongs to no schema.
struct Arrays<'a> {
    views: BTreeMap<String, ArrayView<'a>>,
}

impl<'a> Arrays<'a> {
    fn take<T: Element>(&mut self, entry: &str) -> Result<ArrayView<'a>, PackageError> {
        let view = self.views.remove(entry).ok_or_else(|| PackageError::Missing {
            entry: entry.to_string(),
        })?;
        if view.dtype != T::DTYPE {
            return Err(PackageError::Dtype {
                entry: entry.to_string(),
                found: view.dtype.descr().into(),
                expected: T::DTYPE.descr().into(),
            });
        }
        Ok(view)
    }

    fn has(&self, entry: &str) -> bool {
        self.views.contains_key(entry)
    }

    fn list<T: Element>(&mut self, entry: &str) -> Result<Vec<T>, PackageError> {
        let view = self.take::<T>(entry)?;
        if view.shape.len() != 1 {
            return Err(shape(entry, &view, "(n,)"));
        }
        Ok(values(&view))
    }

    fn rows<T: Element + Default, const K: usize>(
        &mut self,
        entry: &str,
    ) -> Result<Vec<[T; K]>, PackageError> {
        let view = self.take::<T>(entry)?;
        if view.shape.len() != 2 || view.shape[1] != K {
            return Err(shape(entry, &view, &format!("(n, {K})")));
        }
        let size = T::DTYPE.size();
        Ok(view
            .data
            .chunks_exact(size * K)
            .map(|row| {
                let mut out = [T::default(); K];
                for (v, b) in out.iter_mut().zip(row.chunks_exact(size)) {
                    *v = T::get(b);
                }
                out
            })
            .collect())
    }

    fn grid<T: Element>(&mut self, entry: &str) -> Result<([usize; 3], Vec<T>), PackageError> {
        let view = self.take::<T>(entry)?;
        match view.shape[..] {
            [nk, nj, ni] => Ok(([ni, nj, nk], values(&view))),
            _ => Err(shape(entry, &view, "(nk, nj, ni)")),
        }
    }

    fn affine(&mut self, entry: &str) -> Result<Affine34, PackageError> {
        let rows = self.rows::<f64, 4>(entry)?;
        <[[f64; 4]; 3]>::try_from(rows).map_err(|r| PackageError::Shape {
            entry: entry.to_string(),
            found: format!("({}, 4)", r.len()),
            expected: "(3, 4)".into(),
        })
    }

    fn skin(&mut self, folder: &str) -> Result<Skin, PackageError> {
        Ok(Skin {
            indices: self.rows(&format!("{folder}/skin_indices.npy"))?,
            weights: self.rows(&format!("{folder}/skin_weights.npy"))?,
        })
    }
}

fn values<T: Element>(view: &ArrayView<'_>) -> Vec<T> {
    view.data.chunks_exact(T::DTYPE.size()).map(T::get).collect()
}

fn shape(entry: &str, view: &ArrayView<'_>, expected: &str) -> PackageError {
    PackageError::Shape {
        entry: entry.to_string(),
        found: npy::shape_text(&view.shape),
        expected: expected.to_string(),
    }
}

/// What a package's bytes hold, before the checks of what the arrays say.
pub(crate) struct Decoded {
    pub(crate) model: ModelPackage,
    pub(crate) schema: u32,
    pub(crate) digest: String,
    pub(crate) entries: Vec<manifest::EntryInfo>,
}

/// Reads the archive, the manifest and every array; checks records, checksums, types and shapes.
pub(crate) fn decode(bytes: &[u8], strict: bool) -> Result<Decoded, PackageError> {
    let entries = archive::read(bytes, strict)?;
    let text = match entries.first() {
        Some(e) if e.name == manifest::NAME => e.data,
        _ => match entries.iter().find(|e| e.name == manifest::NAME) {
            None => {
                return Err(PackageError::Missing {
                    entry: manifest::NAME.into(),
                });
            }
            Some(e) if !strict => e.data,
            Some(_) => return Err(PackageError::malformed(manifest::NAME, "is not the first entry")),
        },
    };
    let manifest = manifest::from_text(text, strict)?;
    let mut arrays = views(&entries, &manifest, strict)?;
    let (schema, digest) = (manifest.schema, manifest.content_sha256.clone());
    let infos = manifest.entries.clone();
    let model = assemble(manifest, &mut arrays)?;
    if let Some(entry) = arrays.views.into_keys().next() {
        return Err(PackageError::Unexpected { entry });
    }
    Ok(Decoded {
        model,
        schema,
        digest,
        entries: infos,
    })
}

/// Matches the archive's entries with the manifest's list, in both directions.
fn views<'a>(
    entries: &[archive::Entry<'a>],
    manifest: &Manifest,
    strict: bool,
) -> Result<Arrays<'a>, PackageError> {
    let mut infos = BTreeMap::new();
    for info in &manifest.entries {
        if infos.insert(info.name.as_str(), info).is_some() {
            return Err(PackageError::Duplicate {
                entry: info.name.clone(),
            });
        }
    }
    let mut views = BTreeMap::new();
    for e in entries.iter().filter(|e| e.name != manifest::NAME) {
        let Some(info) = infos.remove(e.name.as_str()) else {
            return Err(PackageError::Unexpected {
                entry: e.name.clone(),
            });
        };
        if strict {
            let computed = manifest::sha256(e.data);
            if computed != info.sha256 {
                return Err(PackageError::Checksum {
                    entry: e.name.clone(),
                    kind: "SHA-256",
                    recorded: info.sha256.chars().take(64).collect(),
                    computed,
                });
            }
        }
        let view = npy::parse(e.data).map_err(|what| PackageError::malformed(&e.name, what))?;
        if view.dtype.descr() != info.dtype {
            return Err(PackageError::Dtype {
                entry: e.name.clone(),
                found: view.dtype.descr().into(),
                expected: format!("{} by the manifest", info.dtype),
            });
        }
        if view.shape != info.shape {
            return Err(shape(
                &e.name,
                &view,
                &format!("{} by the manifest", npy::shape_text(&info.shape)),
            ));
        }
        views.insert(e.name.clone(), view);
    }
    match infos.into_keys().next() {
        Some(name) => Err(PackageError::Missing {
            entry: name.to_string(),
        }),
        None => Ok(Arrays { views }),
    }
}

fn assemble(manifest: Manifest, arrays: &mut Arrays<'_>) -> Result<ModelPackage, PackageError> {
    let mut surfaces = Vec::with_capacity(manifest.surfaces.len());
    for s in manifest.surfaces {
        let f = &s.folder;
        let normals = format!("{f}/normals.npy");
        let skinned =
            arrays.has(&format!("{f}/skin_indices.npy")) || arrays.has(&format!("{f}/skin_weights.npy"));
        let capped =
            arrays.has(&format!("{f}/cap_points.npy")) || arrays.has(&format!("{f}/cap_normals.npy"));
        surfaces.push(Surface {
            vertices: arrays.rows(&format!("{f}/vertices.npy"))?,
            triangles: arrays.rows(&format!("{f}/triangles.npy"))?,
            normals: if arrays.has(&normals) {
                Some(arrays.rows(&normals)?)
            } else {
                None
            },
            skin: if skinned { Some(arrays.skin(f)?) } else { None },
            caps: if capped { caps(arrays, f)? } else { Vec::new() },
            name: s.name,
            kind: s.kind,
        });
    }
    let particles = Particles {
        positions: arrays.rows("particles/positions.npy")?,
        region: arrays.list("particles/region.npy")?,
        creation_order: arrays.list("particles/creation_order.npy")?,
        radius_mm: manifest.particles.radius_mm,
        mass_g: manifest.particles.mass_g,
    };
    let clusters = Clusters {
        offsets: arrays.list("clusters/offsets.npy")?,
        members: arrays.list("clusters/members.npy")?,
        rest_centres: arrays.rows("clusters/rest_centres.npy")?,
        rest_local: arrays.rows("clusters/rest_local.npy")?,
        region: arrays.list("clusters/region.npy")?,
        particle_offsets: arrays.list("clusters/particle_offsets.npy")?,
        particle_entries: arrays.list("clusters/particle_entries.npy")?,
    };
    let embedding = Embedding {
        vertices: arrays.rows("embedding/vertices.npy")?,
        tets: arrays.rows("embedding/tets.npy")?,
        skin: arrays.skin("embedding")?,
    };
    let mut fem = FemMesh {
        vertices: arrays.rows("fem/vertices.npy")?,
        tets: arrays.rows("fem/tets.npy")?,
        regions: arrays.list("fem/regions.npy")?,
        tagged: Vec::with_capacity(manifest.tagged.len()),
    };
    for t in manifest.tagged {
        fem.tagged.push(TaggedStructure {
            tet_fraction: arrays.list(&format!("{}/tet_fraction.npy", t.folder))?,
            name: t.name,
            region: t.region,
            thickness_mm: t.thickness_mm,
        });
    }
    let fiducials = Fiducials {
        names: manifest.fiducials,
        positions: arrays.rows("fiducials/positions.npy")?,
        skin: arrays.skin("fiducials")?,
    };
    let (dims, data) = arrays.grid("labels/data.npy")?;
    let affine = arrays.affine("labels/affine.npy")?;
    let labels = Labels {
        dims,
        affine,
        data,
        names: manifest.label_names,
    };
    let ct = if arrays.has("ct/hu.npy") || arrays.has("ct/affine.npy") {
        let (dims, hu) = arrays.grid("ct/hu.npy")?;
        Some(Ct {
            dims,
            affine: arrays.affine("ct/affine.npy")?,
            hu,
        })
    } else {
        None
    };
    let info = PackageInfo {
        generator: manifest.generator,
        local_origin_mm: manifest.local_origin_mm,
        regions: manifest.regions,
        scan: manifest.scan,
        label_table: manifest.label_table,
        inputs: manifest.inputs,
        recipe: manifest.recipe,
        report: manifest.report,
    };
    Ok(ModelPackage {
        info,
        surfaces,
        particles,
        clusters,
        embedding,
        fem,
        fiducials,
        labels,
        ct,
    })
}

fn caps(arrays: &mut Arrays<'_>, folder: &str) -> Result<Vec<Cap>, PackageError> {
    let points = arrays.rows::<f32, 3>(&format!("{folder}/cap_points.npy"))?;
    let entry = format!("{folder}/cap_normals.npy");
    let normals = arrays.rows::<f32, 3>(&entry)?;
    if points.len() != normals.len() {
        return Err(PackageError::Shape {
            entry,
            found: format!("({}, 3)", normals.len()),
            expected: format!("({}, 3), as many as cap points", points.len()),
        });
    }
    Ok(points
        .into_iter()
        .zip(normals)
        .map(|(point, normal)| Cap { point, normal })
        .collect())
}
