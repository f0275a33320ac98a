use crate::model::{Cap, Clusters, Embedding, FemMesh, Fiducials, Particles, Skin, Surface, SurfaceKind};
use crate::{PackageError, topology};

/// The package's frame: patient RAS+ mm minus an origin near the organ, so that f32 positions stay exact to about
/// 10⁻⁵ mm.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Frame {
    /// Patient RAS+ mm of the zero point.
    pub local_origin_mm: [f64; 3],
}

impl Frame {
    /// The centre of the points' box, rounded to whole mm; zero where there are no finite points.
    pub fn around(points_mm: &[[f64; 3]]) -> Self {
        let mut lo = [f64::INFINITY; 3];
        let mut hi = [f64::NEG_INFINITY; 3];
        for p in points_mm {
            for a in 0..3 {
                lo[a] = lo[a].min(p[a]);
                hi[a] = hi[a].max(p[a]);
            }
        }
        let local_origin_mm = std::array::from_fn(|a| {
            let c = (0.5 * (lo[a] + hi[a])).round();
            // `+ 0.0` turns −0 into 0: one origin, one text in the manifest.
            if c.is_finite() { c + 0.0 } else { 0.0 }
        });
        Self { local_origin_mm }
    }

    /// Package position of a patient point (mm).
    pub fn local(&self, patient_mm: [f64; 3]) -> [f32; 3] {
        std::array::from_fn(|a| (patient_mm[a] - self.local_origin_mm[a] + 0.0) as f32)
    }

    /// Patient point (mm) of a package position.
    pub fn patient(&self, local: [f32; 3]) -> [f64; 3] {
        std::array::from_fn(|a| f64::from(local[a]) + self.local_origin_mm[a])
    }

    /// [`Frame::local`] for many points.
    pub fn locals(&self, patient_mm: &[[f64; 3]]) -> Vec<[f32; 3]> {
        patient_mm.iter().map(|&p| self.local(p)).collect()
    }

    /// A surface from patient mm. `caps` are (point, unit outward normal).
    pub fn surface(
        &self,
        name: impl Into<String>,
        kind: SurfaceKind,
        vertices_mm: &[[f64; 3]],
        triangles: &[[u32; 3]],
        skin: Option<Skin>,
        caps: &[([f64; 3], [f64; 3])],
    ) -> Surface {
        Surface {
            name: name.into(),
            kind,
            vertices: self.locals(vertices_mm),
            triangles: triangles.to_vec(),
            normals: None,
            skin,
            caps: caps
                .iter()
                .map(|(p, n)| Cap {
                    point: self.local(*p),
                    normal: n.map(|v| (v + 0.0) as f32),
                })
                .collect(),
        }
    }

    /// Particles from patient mm; the mass of each is `density_g_per_mm3 · volume_mm3 / count`.
    pub fn particles(
        &self,
        positions_mm: &[[f64; 3]],
        region: Vec<u16>,
        creation_order: Vec<u32>,
        radius_mm: f64,
        density_g_per_mm3: f64,
        volume_mm3: f64,
    ) -> Particles {
        Particles {
            positions: self.locals(positions_mm),
            region,
            creation_order,
            radius_mm,
            mass_g: density_g_per_mm3 * volume_mm3 / positions_mm.len().max(1) as f64,
        }
    }

    /// An embedding mesh from patient mm.
    pub fn embedding(&self, vertices_mm: &[[f64; 3]], tets: &[[u32; 4]], skin: Skin) -> Embedding {
        Embedding {
            vertices: self.locals(vertices_mm),
            tets: tets.to_vec(),
            skin,
        }
    }

    /// A FEM mesh from patient mm, without tagged structures.
    pub fn fem(&self, vertices_mm: &[[f64; 3]], tets: &[[u32; 4]], regions: &[u16]) -> FemMesh {
        FemMesh {
            vertices: self.locals(vertices_mm),
            tets: tets.to_vec(),
            regions: regions.to_vec(),
            tagged: Vec::new(),
        }
    }

    /// Fiducials from patient mm.
    pub fn fiducials(&self, names: Vec<String>, positions_mm: &[[f64; 3]], skin: Skin) -> Fiducials {
        Fiducials {
            names,
            positions: self.locals(positions_mm),
            skin,
        }
    }
}

impl Skin {
    /// Weights computed in f64, rounded to f32.
    pub fn from_f64(indices: Vec<[u32; 4]>, weights: &[[f64; 4]]) -> Self {
        Self {
            indices,
            weights: weights.iter().map(|w| w.map(|v| v as f32)).collect(),
        }
    }
}

impl Clusters {
    /// Clusters of `particles` from rows of members: computes rest centres, rest-local positions and the transpose.
    ///
    /// # Errors
    /// Offsets that are not monotone from 0 to `members.len()`, members out of range, empty clusters.
    pub fn new(
        particles: &Particles,
        offsets: Vec<u32>,
        members: Vec<u32>,
        region: Vec<u16>,
    ) -> Result<Self, PackageError> {
        topology::check_offsets("clusters/offsets.npy", &offsets, members.len())?;
        topology::check_indices(
            "clusters/members.npy",
            &members,
            particles.positions.len(),
            "particles",
        )?;
        let mut rest_centres = Vec::with_capacity(offsets.len().saturating_sub(1));
        let mut rest_local = Vec::with_capacity(members.len());
        for c in 0..offsets.len().saturating_sub(1) {
            let row = &members[offsets[c] as usize..offsets[c + 1] as usize];
            if row.is_empty() {
                return Err(PackageError::invalid(
                    "clusters/offsets.npy",
                    format!("cluster {c}"),
                    "no members",
                    "at least 4",
                ));
            }
            let mut sum = [0.0f64; 3];
            for &m in row {
                let p = particles.positions[m as usize];
                for a in 0..3 {
                    sum[a] += f64::from(p[a]);
                }
            }
            let centre = sum.map(|s| (s / row.len() as f64) as f32);
            rest_centres.push(centre);
            rest_local.extend(row.iter().map(|&m| {
                let p = particles.positions[m as usize];
                std::array::from_fn::<f32, 3, _>(|a| (f64::from(p[a]) - f64::from(centre[a])) as f32)
            }));
        }
        let (particle_offsets, particle_entries) = topology::transpose(&members, particles.positions.len());
        Ok(Self {
            offsets,
            members,
            rest_centres,
            rest_local,
            region,
            particle_offsets,
            particle_entries,
        })
    }
}
