use crate::{PbdError, Pose};
use glam::Vec3;
use palpate_package::{ModelPackage, SurfaceKind};

/// Particles and clusters of one deformable body, at rest, and where it is placed.
///
/// Region codes are those of the package: 0 the organ proper, n + 1 structure n.
#[derive(Clone, Debug, PartialEq)]
pub struct SoftBody {
    pub(crate) name: String,
    pub(crate) positions: Vec<[f32; 3]>,
    pub(crate) offsets: Vec<u32>,
    pub(crate) members: Vec<u32>,
    pub(crate) centres: Vec<[f32; 3]>,
    /// Member minus centre, as long as `members`.
    pub(crate) local: Vec<[f32; 3]>,
    pub(crate) cluster_region: Vec<u16>,
    /// α of each cluster.
    pub(crate) stiffness: Vec<f32>,
    pub(crate) regions: Vec<String>,
    pub(crate) spacing_mm: f32,
    pub(crate) mass_g: f32,
    pub(crate) pinned: Vec<bool>,
    /// Share of the body's surface that belongs to each particle, mm².
    pub(crate) area_mm2: Vec<f32>,
    pub(crate) placement: Pose,
    /// Where particles start, in the rest frame, where that is not `positions`.
    pub(crate) start: Option<Vec<[f32; 3]>>,
}

/// Raw arrays of a body, for bodies that are not patients.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RawBody {
    /// Rest positions, mm.
    pub positions: Vec<[f32; 3]>,
    /// Members of each cluster; any number of clusters, also none.
    pub clusters: Vec<Vec<u32>>,
    /// α of every cluster, 0 to 1.
    pub stiffness: f32,
    /// Particle spacing, mm, above 0.
    pub spacing_mm: f32,
    /// Mass of one particle, g, above 0.
    pub mass_g: f32,
}

impl SoftBody {
    /// The organ of a package. `stiffness` gives α by region name; regions that it does not name get `organ_stiffness`.
    ///
    /// # Errors
    /// - [`PbdError::Unknown`] for a region that the package lacks.
    /// - [`PbdError::Setting`] for an α outside 0 to 1.
    /// - [`PbdError::Array`], [`PbdError::Empty`] for arrays that do not fit together (a package read with validation
    ///   has none).
    pub fn from_package(
        package: &ModelPackage,
        organ_stiffness: f64,
        stiffness: &[(&str, f64)],
    ) -> Result<Self, PbdError> {
        let regions = &package.info.regions;
        let mut alpha = vec![organ_stiffness as f32; regions.len().max(1)];
        for &(name, a) in stiffness {
            let code = package.region(name).ok_or_else(|| PbdError::Unknown {
                kind: "region",
                name: name.into(),
                known: regions.join(", "),
            })?;
            alpha[usize::from(code)] = a as f32;
        }
        let (p, c) = (&package.particles, &package.clusters);
        let of_region = |r: &u16| alpha.get(usize::from(*r)).copied().unwrap_or(alpha[0]);
        let mut body = Self {
            name: regions.first().cloned().unwrap_or_else(|| "organ".into()),
            positions: p.positions.clone(),
            offsets: c.offsets.clone(),
            members: c.members.clone(),
            centres: c.rest_centres.clone(),
            local: c.rest_local.clone(),
            cluster_region: c.region.clone(),
            stiffness: c.region.iter().map(of_region).collect(),
            regions: regions.clone(),
            spacing_mm: p.radius_mm as f32,
            mass_g: p.mass_g as f32,
            pinned: vec![false; p.positions.len()],
            area_mm2: Vec::new(),
            placement: Pose::IDENTITY,
            start: None,
        };
        body.check()?;
        let organ = package.surfaces.iter().find(|s| s.kind == SurfaceKind::Organ);
        body.area_mm2 = match organ {
            Some(s) => shares(&body.positions, body.spacing_mm, &s.vertices, &s.triangles),
            None => vec![body.spacing_mm * body.spacing_mm; body.positions.len()],
        };
        Ok(body)
    }

    /// A body from arrays; every particle stands for a surface of one spacing squared.
    ///
    /// # Errors
    /// As [`SoftBody::from_package`].
    pub fn from_raw(raw: &RawBody) -> Result<Self, PbdError> {
        let n = raw.positions.len();
        let mut offsets = vec![0u32];
        let mut members: Vec<u32> = Vec::new();
        let (mut centres, mut local) = (Vec::new(), Vec::new());
        for (k, cluster) in raw.clusters.iter().enumerate() {
            if let Some(&bad) = cluster.iter().find(|&&m| m as usize >= n) {
                return Err(PbdError::Array {
                    what: "cluster",
                    index: k,
                    found: format!("member {bad}"),
                    expected: format!("particle indices below {n}"),
                });
            }
            let wide = |m: u32| raw.positions[m as usize].map(f64::from);
            let mut c = [0f64; 3];
            for &m in cluster {
                for (c, x) in c.iter_mut().zip(wide(m)) {
                    *c += x / cluster.len() as f64;
                }
            }
            for &m in cluster {
                let x = wide(m);
                local.push(std::array::from_fn(|a| (x[a] - c[a]) as f32));
            }
            centres.push(c.map(|v| v as f32));
            members.extend_from_slice(cluster);
            offsets.push(members.len() as u32);
        }
        let k = centres.len();
        let body = Self {
            name: "body".into(),
            positions: raw.positions.clone(),
            offsets,
            members,
            centres,
            local,
            cluster_region: vec![0; k],
            stiffness: vec![raw.stiffness; k],
            regions: vec!["body".into()],
            spacing_mm: raw.spacing_mm,
            mass_g: raw.mass_g,
            pinned: vec![false; n],
            area_mm2: vec![raw.spacing_mm * raw.spacing_mm; n],
            placement: Pose::IDENTITY,
            start: None,
        };
        body.check()?;
        Ok(body)
    }

    /// The same body under another name.
    pub fn named(mut self, name: impl Into<String>) -> Self {
        self.name = name.into();
        self
    }

    /// The same body placed elsewhere; `placement` maps its rest frame to the world.
    pub fn placed(mut self, placement: Pose) -> Self {
        self.placement = placement;
        self
    }

    /// Pins the particles for which `pin` is true, given their rest positions: they never move.
    pub fn pin(mut self, pin: impl Fn(Vec3) -> bool) -> Self {
        for (flag, &x) in self.pinned.iter_mut().zip(&self.positions) {
            *flag |= pin(x.into());
        }
        self
    }

    /// Name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Number of particles.
    pub fn particle_count(&self) -> usize {
        self.positions.len()
    }

    /// Number of clusters.
    pub fn cluster_count(&self) -> usize {
        self.stiffness.len()
    }

    /// Number of memberships: the sum of all cluster sizes.
    pub fn membership_count(&self) -> usize {
        self.members.len()
    }

    /// Rest positions in the body's own frame, mm.
    pub fn rest_positions(&self) -> &[[f32; 3]] {
        &self.positions
    }

    /// Particle spacing (the paper's particle radius), mm.
    pub fn spacing_mm(&self) -> f64 {
        self.spacing_mm.into()
    }

    /// Mass of the whole body, g.
    pub fn mass_g(&self) -> f64 {
        f64::from(self.mass_g) * self.positions.len() as f64
    }

    /// Where the body is placed.
    pub fn placement(&self) -> Pose {
        self.placement
    }

    /// α of each cluster; may be changed before the solver is made.
    pub fn stiffness_mut(&mut self) -> &mut [f32] {
        &mut self.stiffness
    }

    fn check(&self) -> Result<(), PbdError> {
        let array = |what, index, found: String, expected: String| {
            Err(PbdError::Array {
                what,
                index,
                found,
                expected,
            })
        };
        let n = self.positions.len();
        if n == 0 {
            return Err(PbdError::Empty {
                what: "soft body",
                help: "give it at least one particle",
            });
        }
        let finite = |p: &[f32; 3]| p.iter().all(|x| x.is_finite() && x.abs() < 1e6);
        for (what, list) in [
            ("particle position", &self.positions),
            ("cluster centre", &self.centres),
            ("member's rest place", &self.local),
        ] {
            if let Some(i) = list.iter().position(|p| !finite(p)) {
                return array(
                    what,
                    i,
                    format!("{:?}", list[i]),
                    "finite numbers below 1e6 mm".into(),
                );
            }
        }
        let k = self.centres.len();
        let m = self.members.len();
        if self.offsets.len() != k + 1
            || self.local.len() != m
            || self.cluster_region.len() != k
            || self.offsets.first() != Some(&0)
            || self.offsets.last().copied() != u32::try_from(m).ok()
        {
            return array(
                "cluster rows",
                0,
                format!("{} offsets, {m} members, {k} centres", self.offsets.len()),
                "offsets from 0 to the number of members, one row per centre".into(),
            );
        }
        for (i, w) in self.offsets.windows(2).enumerate() {
            if w[0] >= w[1] {
                return array("cluster", i, "no members".into(), "at least one member".into());
            }
            let mut row = self.members[w[0] as usize..w[1] as usize].to_vec();
            row.sort_unstable();
            if row.windows(2).any(|p| p[0] == p[1]) {
                return array("cluster", i, "a member twice".into(), "each member once".into());
            }
        }
        if let Some(i) = self.members.iter().position(|&p| p as usize >= n) {
            return array(
                "member",
                i,
                self.members[i].to_string(),
                format!("a particle below {n}"),
            );
        }
        for &a in &self.stiffness {
            if !(0.0..=1.0).contains(&a) {
                return Err(PbdError::Setting {
                    name: "stiffness",
                    found: a.to_string(),
                    expected: "0 to 1",
                });
            }
        }
        for (name, v) in [("spacing_mm", self.spacing_mm), ("mass_g", self.mass_g)] {
            if !(v.is_finite() && v > 0.0 && v < 1e6) {
                return Err(PbdError::Setting {
                    name,
                    found: v.to_string(),
                    expected: "a finite number above 0",
                });
            }
        }
        Ok(())
    }
}

/// Gives every triangle's area to the particle nearest to its centre.
fn shares(particles: &[[f32; 3]], spacing: f32, vertices: &[[f32; 3]], triangles: &[[u32; 3]]) -> Vec<f32> {
    let mut out = vec![0f32; particles.len()];
    let grid = crate::grid::PointGrid::new(particles, spacing.max(1e-3));
    for t in triangles {
        let mut corner = [Vec3::ZERO; 3];
        for (c, &v) in corner.iter_mut().zip(t) {
            match vertices.get(v as usize) {
                Some(&p) => *c = p.into(),
                None => continue,
            }
        }
        let [a, b, c] = corner;
        if let Some(i) = grid.nearest((a + b + c) / 3.0, particles) {
            out[i as usize] += 0.5 * (b - a).cross(c - a).length();
        }
    }
    out
}
