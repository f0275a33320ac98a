use crate::SurfaceError;
use serde::{Deserialize, Serialize};

/// Which HC Laplacian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HcVariant {
    /// Vollmer, Mencl and Müller 1999 as published: keeps the volume to second order.
    #[default]
    Vollmer,
    /// MeshLab's filter, for reproduction: α is 0, β 0.5, and the neighbours' term has the opposite sign, so that it
    /// shrinks like a plain Laplacian.
    MeshlabCompat,
}

/// HC Laplacian smoothing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HcParams {
    /// Published or MeshLab's.
    pub variant: HcVariant,
    /// Pull to the position before smoothing, 0–1. Above 0 the highest frequency cannot oscillate.
    pub alpha: f64,
    /// Share of a vertex's own difference in the push back, 0–1.
    pub beta: f64,
    /// Steps; 0 leaves the iso-surface as it is. 3: on a real kidney at 5000 triangles 0, 1, 3 and 10 steps leave
    /// 0.061, 0.059, 0.057 and 0.057 mm RMS to the iso-surface; the field is smooth already, so few do.
    pub iterations: usize,
}

impl Default for HcParams {
    fn default() -> Self {
        Self {
            variant: HcVariant::Vollmer,
            alpha: 0.1,
            beta: 0.5,
            iterations: 3,
        }
    }
}

impl HcParams {
    pub(crate) fn check(&self) -> Result<(), SurfaceError> {
        let unit = |name, value: f64| {
            if (0.0..=1.0).contains(&value) {
                Ok(())
            } else {
                Err(SurfaceError::Parameter {
                    name,
                    value,
                    expected: "between 0 and 1",
                })
            }
        };
        unit("hc.alpha", self.alpha)?;
        unit("hc.beta", self.beta)
    }
}

/// Quadric edge collapse.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DecimateParams {
    /// Triangles to stop at (reached to within one, or as near as the guards allow).
    pub target_faces: usize,
    /// MeshLab's "quality threshold" with 2·area/longest² (at most 0.866) as quality: a collapse costs its quadric
    /// error divided by the worst quality that it leaves, or by this where that is less. At the paper's 0.99 it never
    /// limits: every collapse is weighted by its worst triangle. 0 is not valid.
    pub quality_threshold: f64,
    /// Edges shorter than this (mm) are collapsed first, in order and without a heap; 0: none. Set it well below the
    /// edge length aimed at.
    pub first_phase_edge_mm: f64,
    /// Refuse collapses whose new triangles would cross others.
    pub guard: bool,
}

impl Default for DecimateParams {
    fn default() -> Self {
        Self {
            target_faces: 5000,
            quality_threshold: 0.99,
            first_phase_edge_mm: 0.0,
            guard: true,
        }
    }
}

impl DecimateParams {
    pub(crate) fn check(&self) -> Result<(), SurfaceError> {
        if !(self.quality_threshold > 0.0 && self.quality_threshold.is_finite()) {
            return Err(SurfaceError::Parameter {
                name: "quality_threshold",
                value: self.quality_threshold,
                expected: "above 0 (0 would make every cost infinite)",
            });
        }
        if !(self.first_phase_edge_mm >= 0.0 && self.first_phase_edge_mm.is_finite()) {
            return Err(SurfaceError::Parameter {
                name: "first_phase_edge_mm",
                value: self.first_phase_edge_mm,
                expected: "0 or a length in mm",
            });
        }
        if self.target_faces < 4 {
            return Err(SurfaceError::Parameter {
                name: "target_faces",
                value: self.target_faces as f64,
                expected: "at least 4",
            });
        }
        Ok(())
    }
}

/// Improvement of the decimated surface.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImproveParams {
    /// Rounds of edge flips and vertex moves; 0 leaves the decimated surface as it is.
    pub rounds: usize,
    /// At most so many more, with growing weight on shapes, while the mean quality is below the goal.
    pub extra_rounds: usize,
    /// Mean of 4√3·area/Σedge² to reach.
    pub goal_mean_quality: f64,
    /// Rounds of the fit to the field's zero set.
    pub fit_rounds: usize,
    /// Weight of even triangle shapes against the fit to the zero set, in the directions along which the surface
    /// bends: near 0 vertices stay on ridges, near 1 they slide freely.
    pub pull: f64,
    /// Triangles with a smaller angle (degrees) than this are repaired one by one.
    pub goal_angle_deg: f64,
    /// A flip that leaves its edge within this distance (mm) of the zero set is never refused for its distance.
    pub flip_error_mm: f64,
    /// A repair may put a triangle's centre this far (mm) off the zero set.
    pub repair_error_mm: f64,
}

impl Default for ImproveParams {
    fn default() -> Self {
        Self {
            rounds: 4,
            extra_rounds: 12,
            goal_mean_quality: 0.905,
            fit_rounds: 3,
            pull: 0.03,
            goal_angle_deg: 24.0,
            flip_error_mm: 0.05,
            repair_error_mm: 0.3,
        }
    }
}

/// The whole surface stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SurfaceParams {
    /// Triangles of the result. The paper's collision meshes have about 5000.
    pub target_faces: usize,
    /// More triangles than that where their mean area would be above this, mm². 6: an organ several times a kidney's
    /// size, whose 5000 triangles would leave its shape by 0.2 mm RMS, stays within 0.1 mm. 0: never more.
    pub largest_mean_face_mm2: f64,
    /// No finer than this many samples of the field an edge on average, so that small structures are not given more
    /// triangles than their field can shape.
    pub finest_edge_samples: f64,
    /// Bodies and voids below this share of the largest part's volume are dropped. 1e-5: specks only, since the
    /// volume stage has dropped strays by stated volumes already.
    pub min_part_share: f64,
    /// Smoothing of the iso-surface.
    pub hc: HcParams,
    /// See [`DecimateParams::quality_threshold`]; the paper's 0.99.
    pub quality_threshold: f64,
    /// Improvement after the decimation.
    pub improve: ImproveParams,
    /// Points by which the distance to the iso-surface is measured, each way (vertices come in addition).
    pub distance_samples: usize,
}

impl Default for SurfaceParams {
    fn default() -> Self {
        Self {
            target_faces: 5000,
            largest_mean_face_mm2: 6.0,
            finest_edge_samples: 1.5,
            min_part_share: 1e-5,
            hc: HcParams::default(),
            quality_threshold: 0.99,
            improve: ImproveParams::default(),
            distance_samples: 20_000,
        }
    }
}

impl SurfaceParams {
    pub(crate) fn check(&self) -> Result<(), SurfaceError> {
        self.hc.check()?;
        let mut decimate = DecimateParams {
            quality_threshold: self.quality_threshold,
            ..Default::default()
        };
        decimate.target_faces = self.target_faces;
        decimate.check()?;
        self.improve.check()?;
        if !(self.largest_mean_face_mm2 >= 0.0 && self.largest_mean_face_mm2.is_finite()) {
            return Err(SurfaceError::Parameter {
                name: "largest_mean_face_mm2",
                value: self.largest_mean_face_mm2,
                expected: "0 or an area in mm²",
            });
        }
        let above_0 = |name, value: f64| {
            if value > 0.0 && value.is_finite() {
                Ok(())
            } else {
                Err(SurfaceError::Parameter {
                    name,
                    value,
                    expected: "above 0",
                })
            }
        };
        above_0("finest_edge_samples", self.finest_edge_samples)?;
        if !(0.0..1.0).contains(&self.min_part_share) {
            let (name, value) = ("min_part_share", self.min_part_share);
            return Err(SurfaceError::Parameter {
                name,
                value,
                expected: "from 0 to below 1",
            });
        }
        Ok(())
    }
}

impl ImproveParams {
    pub(crate) fn check(&self) -> Result<(), SurfaceError> {
        let fields = [
            ("improve.pull", self.pull, 1e-6, 1e3),
            ("improve.goal_mean_quality", self.goal_mean_quality, 0.0, 1.0),
            ("improve.goal_angle_deg", self.goal_angle_deg, 0.0, 40.0),
            ("improve.flip_error_mm", self.flip_error_mm, 0.0, 1e3),
            ("improve.repair_error_mm", self.repair_error_mm, 0.0, 1e3),
        ];
        for (name, value, lo, hi) in fields {
            if !(lo..=hi).contains(&value) {
                let expected = match name {
                    "improve.goal_angle_deg" => "an angle from 0 to 40 degrees",
                    "improve.goal_mean_quality" => "from 0 to 1",
                    _ => "a positive number up to 1000",
                };
                return Err(SurfaceError::Parameter {
                    name,
                    value,
                    expected,
                });
            }
        }
        Ok(())
    }
}
