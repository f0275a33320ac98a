use crate::UltrasoundError;
use crate::vector::{Vec3, add, cross, dot, norm, scale, sub};
use serde::{Deserialize, Serialize};

/// Where the transducer is: patient RAS+ mm.
///
/// The image plane is spanned by `lateral` (columns, left to right) and `axial` (rows, away from the transducer);
/// `lateral × axial` is the elevation direction, across the plane.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProbePose {
    /// Middle of the transducer's face: lateral 0, depth 0.
    pub face_mm: [f64; 3],
    /// Unit vector along the face, in the image plane.
    pub lateral: [f64; 3],
    /// Unit vector into the body, perpendicular to `lateral`.
    pub axial: [f64; 3],
}

impl ProbePose {
    /// A pose that looks from `face_mm` along `axial`, with the face as near to `lateral` as is perpendicular to it.
    ///
    /// # Errors
    /// Vectors that are not finite, zero or parallel.
    pub fn looking(face_mm: [f64; 3], axial: [f64; 3], lateral: [f64; 3]) -> Result<Self, UltrasoundError> {
        let fault = |what, v: Vec3, expected| UltrasoundError::Pose {
            what,
            found: format!("{v:?}"),
            expected,
        };
        if !face_mm.iter().all(|v| v.is_finite()) {
            return Err(fault("face_mm", face_mm, "finite mm"));
        }
        let unit = |v: Vec3| {
            let n = norm(v);
            (n.is_finite() && n > 1e-12).then(|| scale(v, 1.0 / n))
        };
        let a = unit(axial).ok_or_else(|| fault("axial", axial, "a finite vector that is not zero"))?;
        let l = unit(lateral).ok_or_else(|| fault("lateral", lateral, "a finite vector that is not zero"))?;
        let flat = sub(l, scale(a, dot(a, l)));
        if norm(flat) < 1e-6 {
            return Err(fault(
                "lateral",
                lateral,
                "a vector that is not along the axial one",
            ));
        }
        let l = scale(flat, 1.0 / norm(flat));
        Ok(Self {
            face_mm,
            lateral: l,
            axial: a,
        })
    }

    /// Unit vector across the image plane: `lateral × axial`.
    pub fn elevation(&self) -> [f64; 3] {
        cross(self.lateral, self.axial)
    }

    /// Patient point (mm) at lateral `x`, depth `z` and elevation `y` mm.
    pub fn point(&self, x: f64, z: f64, y: f64) -> [f64; 3] {
        add(
            self.face_mm,
            add(
                add(scale(self.lateral, x), scale(self.axial, z)),
                scale(self.elevation(), y),
            ),
        )
    }

    /// Lateral, depth and elevation (mm) of a patient point (mm).
    pub fn plane(&self, patient_mm: [f64; 3]) -> [f64; 3] {
        let d = sub(patient_mm, self.face_mm);
        [dot(d, self.lateral), dot(d, self.axial), dot(d, self.elevation())]
    }

    /// The pose moved by `offset_mm` across its plane.
    pub(crate) fn shifted(&self, offset_mm: f64) -> Self {
        Self {
            face_mm: add(self.face_mm, scale(self.elevation(), offset_mm)),
            ..*self
        }
    }

    pub(crate) fn check(&self) -> Result<(), UltrasoundError> {
        let fault = |what, v: Vec3, expected| {
            Err(UltrasoundError::Pose {
                what,
                found: format!("{v:?}"),
                expected,
            })
        };
        if !self.face_mm.iter().all(|v| v.is_finite() && v.abs() < 1e6) {
            return fault("face_mm", self.face_mm, "finite mm below 10⁶");
        }
        for (what, v) in [("lateral", self.lateral), ("axial", self.axial)] {
            let off = (norm(v) - 1.0).abs();
            if off.is_nan() || off > 1e-4 {
                return fault(what, v, "a unit vector");
            }
        }
        if dot(self.lateral, self.axial).abs() > 1e-4 {
            return fault("lateral", self.lateral, "a vector perpendicular to the axial one");
        }
        Ok(())
    }
}

/// Pixels of an image in the scan plane. Pixel (column, row) has its centre at lateral `x0_mm + column·pixel_mm`,
/// depth `z0_mm + row·pixel_mm`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PixelGrid {
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Distance of neighbouring pixel centres, mm, the same along both axes.
    pub pixel_mm: f64,
    /// Lateral position of column 0, mm.
    pub x0_mm: f64,
    /// Depth of row 0, mm.
    pub z0_mm: f64,
}

impl PixelGrid {
    /// The grid with square pixels that holds the box, centred.
    pub(crate) fn holding(width_px: usize, height_px: usize, lo: [f64; 2], hi: [f64; 2]) -> Self {
        let (w, h) = (width_px.max(1) as f64, height_px.max(1) as f64);
        let pixel_mm = ((hi[0] - lo[0]) / w).max((hi[1] - lo[1]) / h);
        Self {
            width_px,
            height_px,
            pixel_mm,
            x0_mm: 0.5 * (lo[0] + hi[0]) - 0.5 * (w - 1.0) * pixel_mm,
            // Depth starts at the top: room that is left over lies below.
            z0_mm: lo[1] + 0.5 * pixel_mm,
        }
    }

    /// Number of pixels.
    pub fn len(&self) -> usize {
        self.width_px * self.height_px
    }

    /// Whether there is no pixel.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Lateral and depth (mm) of a pixel position (column, row), fractions allowed.
    pub fn plane(&self, pixel: [f64; 2]) -> [f64; 2] {
        [
            self.x0_mm + pixel[0] * self.pixel_mm,
            self.z0_mm + pixel[1] * self.pixel_mm,
        ]
    }

    /// Pixel position (column, row) of a lateral and a depth (mm); may lie outside of the image.
    pub fn pixel(&self, plane_mm: [f64; 2]) -> [f64; 2] {
        [
            (plane_mm[0] - self.x0_mm) / self.pixel_mm,
            (plane_mm[1] - self.z0_mm) / self.pixel_mm,
        ]
    }

    /// Affine from (column, row, plane) to patient RAS+ mm, row-major 3×4: what NIfTI calls the sform. The third
    /// column spans `thickness_mm` across the plane.
    pub fn affine(&self, pose: &ProbePose, thickness_mm: f64) -> [[f64; 4]; 3] {
        let origin = pose.point(self.x0_mm, self.z0_mm, 0.0);
        let columns = [
            scale(pose.lateral, self.pixel_mm),
            scale(pose.axial, self.pixel_mm),
            scale(pose.elevation(), thickness_mm),
            origin,
        ];
        std::array::from_fn(|r| std::array::from_fn(|c| columns[c][r]))
    }
}
