use crate::{ClusterFrame, PbdError, Pose};
use glam::{Quat, Vec3};
use palpate_package::{ModelPackage, Skin};
use rayon::prelude::*;

/// Points of a unit of parallel work.
const CHUNK: usize = 512;

/// Points that follow up to four cluster frames each: x = Σ wₖ (Tₖ + Rₖ (X − Cₖ)) (Camara et al. 2016, "Weighted
/// matrix blending").
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SkinnedPoints {
    pub(crate) points: Vec<Tied>,
    normals: Vec<Vec3>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Tied {
    pub(crate) rest: Vec3,
    pub(crate) clusters: [u32; 4],
    pub(crate) weights: [f32; 4],
    /// X − Cₖ.
    pub(crate) local: [Vec3; 4],
}

impl SkinnedPoints {
    /// Ties points at rest to clusters. `clusters` of the frames of a body count from the body's first cluster.
    ///
    /// # Errors
    /// [`PbdError::Array`] where the arrays differ in length, a weight is not finite or a cluster with weight is not
    /// there.
    pub fn new(points: &[[f32; 3]], skin: &Skin, rest_centres: &[[f32; 3]]) -> Result<Self, PbdError> {
        let n = points.len();
        if skin.indices.len() != n || skin.weights.len() != n {
            return Err(PbdError::Array {
                what: "skin weights",
                index: n.min(skin.indices.len()).min(skin.weights.len()),
                found: format!("{} and {}", skin.indices.len(), skin.weights.len()),
                expected: format!("{n}, one row per point"),
            });
        }
        let mut tied = Vec::with_capacity(n);
        for i in 0..n {
            let rest = Vec3::from(points[i]);
            let mut t = Tied {
                rest,
                weights: skin.weights[i],
                ..Tied::default()
            };
            for k in 0..4 {
                let w = skin.weights[i][k];
                let c = skin.indices[i][k];
                match rest_centres.get(c as usize) {
                    Some(&centre) if w.is_finite() => {
                        t.clusters[k] = c;
                        t.local[k] = rest - Vec3::from(centre);
                    }
                    None if w == 0.0 => {}
                    _ => {
                        return Err(PbdError::Array {
                            what: "skin weights",
                            index: i,
                            found: format!("cluster {c}, weight {w}"),
                            expected: format!("clusters below {} and finite weights", rest_centres.len()),
                        });
                    }
                }
            }
            tied.push(t);
        }
        Ok(Self {
            points: tied,
            normals: Vec::new(),
        })
    }

    /// Vertices of a package's surface, with its normals where it has them.
    ///
    /// # Errors
    /// - [`PbdError::Unknown`] where there is no surface of this name, or it has no weights (a support).
    /// - [`PbdError::Array`] as [`SkinnedPoints::new`].
    pub fn of_surface(package: &ModelPackage, name: &str) -> Result<Self, PbdError> {
        let found = package.surface(name).and_then(|s| Some((s, s.skin.as_ref()?)));
        let Some((surface, skin)) = found else {
            let known = package.surfaces.iter().filter(|s| s.skin.is_some());
            return Err(PbdError::Unknown {
                kind: "surface with weights",
                name: name.into(),
                known: known.map(|s| s.name.as_str()).collect::<Vec<_>>().join(", "),
            });
        };
        let mut out = Self::new(&surface.vertices, skin, &package.clusters.rest_centres)?;
        if let Some(normals) = surface.normals.as_ref().filter(|n| n.len() == out.len()) {
            out.normals = normals.iter().map(|&n| n.into()).collect();
        }
        Ok(out)
    }

    /// Fiducials of a package.
    ///
    /// # Errors
    /// As [`SkinnedPoints::new`].
    pub fn of_fiducials(package: &ModelPackage) -> Result<Self, PbdError> {
        let f = &package.fiducials;
        Self::new(&f.positions, &f.skin, &package.clusters.rest_centres)
    }

    /// Vertices of a package's embedding mesh.
    ///
    /// # Errors
    /// As [`SkinnedPoints::new`].
    pub fn of_embedding(package: &ModelPackage) -> Result<Self, PbdError> {
        let e = &package.embedding;
        Self::new(&e.vertices, &e.skin, &package.clusters.rest_centres)
    }

    /// Ties the points anew so that these frames of one body hold them at their rest places, `placement` being the body's:
    /// for clusters whose rest shape is not the one that the points were given in (see [`crate::unload`]).
    pub fn tie_to(&mut self, frames: &[ClusterFrame], placement: Pose) {
        for t in &mut self.points {
            let at = placement.apply(t.rest);
            for k in 0..4 {
                if let Some(f) = frames.get(t.clusters[k] as usize) {
                    t.local[k] = f.quat().inverse() * (at - f.mean());
                }
            }
        }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Whether there are normals to turn.
    pub fn has_normals(&self) -> bool {
        !self.normals.is_empty()
    }

    /// Places of the points for the frames of one body (`solver.frames()[body.clusters]`), mm; as many as fit in
    /// `out`. Clusters that `frames` lacks leave a point at rest.
    pub fn positions(&self, frames: &[ClusterFrame], out: &mut [[f32; 3]]) {
        (self.points.par_chunks(CHUNK), out.par_chunks_mut(CHUNK))
            .into_par_iter()
            .for_each(|(points, out)| {
                for (p, out) in points.iter().zip(out) {
                    *out = p.place(frames).to_array();
                }
            });
    }

    /// Unit normals for the frames of one body; nothing where the points have none.
    pub fn normals(&self, frames: &[ClusterFrame], out: &mut [[f32; 3]]) {
        (
            self.points.par_chunks(CHUNK),
            self.normals.par_chunks(CHUNK),
            out.par_chunks_mut(CHUNK),
        )
            .into_par_iter()
            .for_each(|(points, normals, out)| {
                for ((p, &n), out) in points.iter().zip(normals).zip(out) {
                    *out = p.turn(n, frames).to_array();
                }
            });
    }
}

impl Tied {
    fn place(&self, frames: &[ClusterFrame]) -> Vec3 {
        let Some(first) = frames.get(self.clusters[0] as usize) else {
            return self.rest;
        };
        // Relative to the first frame: rounding of the weights then acts on short vectors.
        let base = first.mean();
        let mut sum = Vec3::ZERO;
        for k in 0..4 {
            if self.weights[k] > 0.0
                && let Some(f) = frames.get(self.clusters[k] as usize)
            {
                let q = Quat::from_array(f.rotation);
                sum += (f.mean() - base + q * self.local[k]) * self.weights[k];
            }
        }
        base + sum
    }

    fn turn(&self, n: Vec3, frames: &[ClusterFrame]) -> Vec3 {
        let mut sum = Vec3::ZERO;
        for k in 0..4 {
            if let Some(f) = frames.get(self.clusters[k] as usize) {
                sum += f.quat() * n * self.weights[k];
            }
        }
        sum.normalize_or(n)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The page's case: four centres, four frames, weights 1/d².
    #[test]
    fn blends_to_the_printed_digits() {
        let centres = [
            [0.0, 0.0, 0.0],
            [10.0, 0.0, 0.0],
            [0.0, 10.0, 0.0],
            [0.0, 0.0, 10.0],
        ];
        let skin = Skin {
            indices: vec![[0, 1, 2, 3]],
            weights: vec![[0.626_022, 0.162_302_85, 0.118_437_28, 0.093_237_884]],
        };
        let points = SkinnedPoints::new(&[[3.0, 2.0, 1.0]], &skin, &centres).unwrap();
        let frame = |rotation: Quat, translation: [f32; 3]| ClusterFrame {
            rotation: rotation.to_array(),
            translation,
        };
        let frames = [
            frame(Quat::IDENTITY, [0.0, 0.0, 0.0]),
            frame(Quat::from_rotation_z(30f32.to_radians()), [11.0, 0.0, 0.0]),
            frame(Quat::from_rotation_x(-20f32.to_radians()), [0.0, 10.0, 2.0]),
            frame(Quat::from_rotation_y(10f32.to_radians()), [0.0, -1.0, 10.0]),
        ];
        let mut out = [[0f32; 3]];
        points.positions(&frames, &mut out);
        let want = [3.002_246_4, 1.392_862_3, 1.517_972_1];
        for (got, want) in out[0].iter().zip(want) {
            assert!((got - want).abs() < 3e-6, "{out:?}");
        }
    }

    #[test]
    fn refuses_clusters_that_are_not_there() {
        let skin = Skin {
            indices: vec![[0, 7, 0, 0]],
            weights: vec![[0.5, 0.5, 0.0, 0.0]],
        };
        assert!(SkinnedPoints::new(&[[0.0; 3]], &skin, &[[0.0; 3]]).is_err());
    }
}
