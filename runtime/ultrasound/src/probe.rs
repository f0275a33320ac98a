use crate::{PixelGrid, UltrasoundError};
use serde::{Deserialize, Serialize};

/// Shape of the transducer's face.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum ProbeShape {
    /// Parallel scan lines: line i at lateral (i/(N − 1) − ½)·width.
    Linear {
        /// Width of the face, mm.
        width_mm: f64,
    },
    /// Scan lines that fan out from an arc whose centre lies `radius_mm` behind the face.
    Curvilinear {
        /// Radius of the face, mm.
        radius_mm: f64,
        /// Angle between the first and the last line, degrees.
        field_deg: f64,
    },
}

/// The transducer.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Probe {
    /// Shape of the face.
    pub shape: ProbeShape,
    /// Depth of the image from the face, mm.
    pub depth_mm: f64,
    /// Centre frequency, MHz.
    pub frequency_mhz: f64,
    /// Scan lines.
    pub lines: usize,
    /// Beam thickness across the plane, mm: full width at half maximum of the two-way elevation profile.
    pub thickness_mm: f64,
    /// Parallel planes that are summed over the thickness; 1 is an infinitely thin beam.
    pub planes: usize,
}

impl Default for Probe {
    /// A drop-in transducer for laparoscopic kidney surgery, about that of the paper: linear, 7.5 MHz.
    fn default() -> Self {
        Self {
            shape: ProbeShape::Linear { width_mm: 40.0 },
            depth_mm: 60.0,
            frequency_mhz: 7.5,
            lines: 128,
            thickness_mm: 2.0,
            planes: 3,
        }
    }
}

impl Probe {
    /// An abdominal convex array: 60 mm radius, 70° field, 3.5 MHz, 160 mm deep.
    pub fn abdominal() -> Self {
        Self {
            shape: ProbeShape::Curvilinear {
                radius_mm: 60.0,
                field_deg: 70.0,
            },
            depth_mm: 160.0,
            frequency_mhz: 3.5,
            lines: 160,
            thickness_mm: 3.0,
            planes: 3,
        }
    }

    /// # Errors
    /// A value that is out of range.
    pub fn check(&self) -> Result<(), UltrasoundError> {
        let real = |name, v: f64, lo: f64, hi: f64, expected| {
            if v.is_finite() && v >= lo && v <= hi {
                Ok(())
            } else {
                Err(UltrasoundError::Setting {
                    name,
                    found: v.to_string(),
                    expected,
                })
            }
        };
        let count = |name, v: usize, lo: usize, hi: usize, expected| {
            if (lo..=hi).contains(&v) {
                Ok(())
            } else {
                Err(UltrasoundError::Setting {
                    name,
                    found: v.to_string(),
                    expected,
                })
            }
        };
        match self.shape {
            ProbeShape::Linear { width_mm } => real("width_mm", width_mm, 1.0, 500.0, "1 to 500 mm")?,
            ProbeShape::Curvilinear { radius_mm, field_deg } => {
                real("radius_mm", radius_mm, 0.0, 500.0, "0 to 500 mm")?;
                real("field_deg", field_deg, 1.0, 170.0, "1 to 170 degrees")?;
            }
        }
        real("depth_mm", self.depth_mm, 1.0, 500.0, "1 to 500 mm")?;
        real("frequency_mhz", self.frequency_mhz, 0.5, 30.0, "0.5 to 30 MHz")?;
        count("lines", self.lines, 2, 4096, "2 to 4096")?;
        real("thickness_mm", self.thickness_mm, 0.0, 50.0, "0 to 50 mm")?;
        count("planes", self.planes, 1, 33, "1 to 33")
    }

    /// Wavelength in soft tissue (1540 m/s), mm.
    pub fn wavelength_mm(&self) -> f64 {
        1.54 / self.frequency_mhz
    }

    /// Start (lateral, depth mm, on the face) and unit direction of scan line `line` (fractions allowed).
    pub fn line(&self, line: f64) -> ([f64; 2], [f64; 2]) {
        let share = line / (self.lines.max(2) - 1) as f64 - 0.5;
        match self.shape {
            ProbeShape::Linear { width_mm } => ([share * width_mm, 0.0], [0.0, 1.0]),
            ProbeShape::Curvilinear { radius_mm, field_deg } => {
                let (s, c) = (share * field_deg.to_radians()).sin_cos();
                ([radius_mm * s, radius_mm * c - radius_mm], [s, c])
            }
        }
    }

    /// Lateral and depth (mm) of the point at distance `along_mm` from the face on scan line `line`.
    pub fn plane(&self, line: f64, along_mm: f64) -> [f64; 2] {
        let (start, direction) = self.line(line);
        [
            start[0] + along_mm * direction[0],
            start[1] + along_mm * direction[1],
        ]
    }

    /// Scan line and distance from the face (mm) of a point given by lateral and depth (mm): the inverse of
    /// [`Probe::plane`]. Lines below 0 or above N − 1 and negative distances lie outside of the image.
    pub fn beam(&self, plane_mm: [f64; 2]) -> [f64; 2] {
        let last = (self.lines.max(2) - 1) as f64;
        match self.shape {
            ProbeShape::Linear { width_mm } => [(plane_mm[0] / width_mm + 0.5) * last, plane_mm[1]],
            ProbeShape::Curvilinear { radius_mm, field_deg } => {
                let (x, z) = (plane_mm[0], plane_mm[1] + radius_mm);
                let line = (x.atan2(z) / field_deg.to_radians() + 0.5) * last;
                [line, x.hypot(z) - radius_mm]
            }
        }
    }

    /// Whether a point lies on the side of the arc's centre to which the scan lines fan out: there the line of
    /// [`Probe::beam`] is monotone along any straight path.
    pub(crate) fn fans_towards(&self, plane_mm: [f64; 2]) -> bool {
        match self.shape {
            ProbeShape::Linear { .. } => true,
            ProbeShape::Curvilinear { radius_mm, .. } => plane_mm[1] + radius_mm > 1e-3,
        }
    }

    /// Whether a point (lateral, depth mm) lies in the field of view.
    pub fn sees(&self, plane_mm: [f64; 2]) -> bool {
        let [line, along] = self.beam(plane_mm);
        line >= 0.0 && line <= (self.lines.max(2) - 1) as f64 && along >= 0.0 && along <= self.depth_mm
    }

    /// Distance of neighbouring scan lines at `along_mm` from the face, mm.
    pub fn pitch_mm(&self, along_mm: f64) -> f64 {
        let last = (self.lines.max(2) - 1) as f64;
        match self.shape {
            ProbeShape::Linear { width_mm } => width_mm / last,
            ProbeShape::Curvilinear { radius_mm, field_deg } => {
                (radius_mm + along_mm) * field_deg.to_radians() / last
            }
        }
    }

    /// Pixels that hold the whole field of view, square and centred.
    pub fn grid(&self, width_px: usize, height_px: usize) -> PixelGrid {
        let (mut lo, mut hi) = ([0.0, 0.0], [0.0, self.depth_mm]);
        match self.shape {
            ProbeShape::Linear { width_mm } => {
                lo[0] = -0.5 * width_mm;
                hi[0] = 0.5 * width_mm;
            }
            ProbeShape::Curvilinear { radius_mm, field_deg } => {
                let (s, c) = (0.5 * field_deg.to_radians()).sin_cos();
                hi[0] = (radius_mm + self.depth_mm) * s;
                lo = [-hi[0], radius_mm * (c - 1.0)];
            }
        }
        PixelGrid::holding(width_px, height_px, lo, hi)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: [f64; 2], b: [f64; 2], tol: f64) {
        assert!(
            (a[0] - b[0]).abs() < tol && (a[1] - b[1]).abs() < tol,
            "{a:?} {b:?}"
        );
    }

    /// Printed digits of the scan conversion formula for radius 60 mm, field 70°, 128 lines.
    #[test]
    fn curvilinear_oracle() {
        let probe = Probe {
            shape: ProbeShape::Curvilinear {
                radius_mm: 60.0,
                field_deg: 70.0,
            },
            lines: 128,
            ..Probe::abdominal()
        };
        close(probe.plane(0.0, 0.0), [-34.414586, -10.850877], 1e-6);
        close(probe.plane(127.0, 100.0), [91.772230, 71.064327], 1e-6);
        close(probe.beam([30.0, 80.0]), [85.443345, 83.178211], 1e-6);
    }

    #[test]
    fn beam_inverts_plane_and_the_grid_holds_the_field() {
        for probe in [Probe::default(), Probe::abdominal()] {
            let grid = probe.grid(512, 384);
            for line in [0.0, 3.25, 64.0, (probe.lines - 1) as f64] {
                for along in [0.0, 0.1, 31.0, probe.depth_mm] {
                    let p = probe.plane(line, along);
                    close(probe.beam(p), [line, along], 1e-9);
                    let px = grid.pixel(p);
                    assert!(px[0] >= -0.5 - 1e-9 && px[0] <= 511.5 + 1e-9, "{px:?}");
                    assert!(px[1] >= -0.5 - 1e-9 && px[1] <= 383.5 + 1e-9, "{px:?}");
                    close(grid.plane(px), p, 1e-9);
                }
            }
        }
    }

    #[test]
    fn bad_values_are_named() {
        let bad = Probe {
            lines: 1,
            ..Probe::default()
        };
        assert!(bad.check().unwrap_err().to_string().contains("lines is 1"));
        let bad = Probe {
            depth_mm: f64::NAN,
            ..Probe::default()
        };
        assert!(bad.check().unwrap_err().to_string().contains("depth_mm is NaN"));
    }
}
