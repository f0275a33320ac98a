use crate::cut::{Cut, check_deformed};
use crate::organ::Organ;
use crate::slice::{self, Pixels, Scene};
use crate::vector::{norm, sub, wide};
use crate::{PixelGrid, Probe, ProbePose, Settings, Source, UltrasoundError};

/// Makes images of deformed organs. Owns all buffers: after the first image none is allocated.
#[derive(Clone, Debug)]
pub struct Scanner {
    organs: Vec<Organ>,
    probe: Probe,
    settings: Settings,
    grid: PixelGrid,
    label_base: Vec<u16>,
    label_names: Vec<String>,
    edge_mm: Vec<f64>,
    pose: Option<ProbePose>,
    cut: Cut,
    pixels: Pixels,
}

impl Scanner {
    /// Prepares for images of these organs; deformations come in the same order.
    ///
    /// # Errors
    /// No organ, a setting out of range.
    pub fn new(organs: Vec<Organ>, probe: Probe, settings: Settings) -> Result<Self, UltrasoundError> {
        if organs.is_empty() {
            return Err(UltrasoundError::NoOrgan);
        }
        probe.check()?;
        settings.check()?;
        let mut label_base = Vec::new();
        let mut label_names = Vec::new();
        for organ in &organs {
            let base = u16::try_from(label_names.len()).map_err(|_| UltrasoundError::Package {
                organ: organ.name.clone(),
                what: "labels/names",
                found: format!("more than {} over all organs", u16::MAX),
                expected: "fewer".to_owned(),
            })?;
            label_base.push(base);
            label_names.extend(organ.label_names.iter().cloned());
        }
        let edge_mm = organs.iter().map(mean_edge).collect();
        let grid = probe.grid(settings.width_px, settings.height_px);
        let mut pixels = Pixels::default();
        pixels.resize(grid.len());
        Ok(Self {
            organs,
            probe,
            settings,
            grid,
            label_base,
            label_names,
            edge_mm,
            pose: None,
            cut: Cut::default(),
            pixels,
        })
    }

    /// The organs.
    pub fn organs(&self) -> &[Organ] {
        &self.organs
    }

    /// The transducer.
    pub fn probe(&self) -> &Probe {
        &self.probe
    }

    /// The settings.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Pixels of the image in the scan plane.
    pub fn grid(&self) -> &PixelGrid {
        &self.grid
    }

    /// Names of the label codes 1, 2, … of label images, over all organs.
    pub fn label_names(&self) -> &[String] {
        &self.label_names
    }

    /// The level 0 image: CT values, labels and rest points on the plane of `pose`.
    ///
    /// `deformed`: per organ its embedding vertices, local mm (patient minus the package's origin).
    ///
    /// # Errors
    /// Positions that do not belong to the organs, a pose that is not rigid. Positions that are not finite are no error:
    /// their tets count as inverted.
    pub fn slice(
        &mut self,
        deformed: &[&[[f32; 3]]],
        pose: &ProbePose,
    ) -> Result<SliceImage<'_>, UltrasoundError> {
        check_deformed(&self.organs, deformed)?;
        pose.check()?;
        self.cut.update(&self.organs, deformed, pose);
        let scene = Scene {
            organs: &self.organs,
            label_base: &self.label_base,
            edge_mm: &self.edge_mm,
            background: self.settings.background,
            fill_hu: f32::from(self.settings.fill_hu),
        };
        slice::resample(&scene, &self.cut, pose, &self.grid, &mut self.pixels);
        self.pose = Some(*pose);
        Ok(SliceImage {
            scanner: self,
            pose: *pose,
        })
    }

    /// Where a rest point of an organ (patient mm) is now, by the embedding (patient mm); `None` outside of its mesh.
    pub fn deform_point(
        &self,
        organ: usize,
        deformed_local: &[[f32; 3]],
        rest_mm: [f64; 3],
    ) -> Option<[f64; 3]> {
        self.organs.get(organ)?.deform_point(deformed_local, rest_mm)
    }
}

fn mean_edge(organ: &Organ) -> f64 {
    let mut sum = 0.0;
    for t in &organ.tets {
        let x = t.map(|v| wide(organ.rest[v as usize]));
        for i in 0..4 {
            for j in i + 1..4 {
                sum += norm(sub(x[i], x[j]));
            }
        }
    }
    sum / (6 * organ.tets.len()).max(1) as f64
}

/// A level 0 image, borrowed from its [`Scanner`]. Arrays are row by row, first row nearest to the transducer.
#[derive(Clone, Copy, Debug)]
pub struct SliceImage<'a> {
    scanner: &'a Scanner,
    pose: ProbePose,
}

impl<'a> SliceImage<'a> {
    /// CT values, HU.
    pub fn hu(&self) -> &'a [f32] {
        &self.scanner.pixels.hu
    }

    /// Label codes: 0, or n + 1 for [`Scanner::label_names`]`[n]`; the nearest voxel's at the rest point.
    pub fn labels(&self) -> &'a [u16] {
        &self.scanner.pixels.label
    }

    /// Where each pixel's value is from, as the numbers of [`Source`].
    pub fn sources(&self) -> &'a [u8] {
        &self.scanner.pixels.source
    }

    /// Number of pixels by source, in the order of [`Source::ALL`].
    pub fn source_counts(&self) -> [usize; 7] {
        let mut out = [0; 7];
        for &s in self.sources() {
            if let Some(n) = out.get_mut(usize::from(s)) {
                *n += 1;
            }
        }
        out
    }

    /// Tets of all meshes that are inverted or not finite, in this plane or not.
    pub fn inverted_tets(&self) -> usize {
        self.scanner.cut.inverted_tets
    }

    /// Pixels.
    pub fn grid(&self) -> &'a PixelGrid {
        &self.scanner.grid
    }

    /// The pose of the plane.
    pub fn pose(&self) -> &ProbePose {
        &self.pose
    }

    /// The scanner that made it.
    pub fn scanner(&self) -> &'a Scanner {
        self.scanner
    }

    /// Organ and tet that a pixel lies in.
    pub fn tet(&self, column: usize, row: usize) -> Option<(usize, usize)> {
        let p = self
            .scanner
            .cut
            .polygons
            .get(self.polygon(column, row)? as usize)?;
        Some((p.organ as usize, p.tet as usize))
    }

    /// Patient point (mm) of a pixel position (column, row); fractions allowed.
    pub fn patient_point(&self, pixel: [f64; 2]) -> [f64; 3] {
        let [x, z] = self.grid().plane(pixel);
        self.pose.point(x, z, 0.0)
    }

    /// Pixel position (column, row) of a patient point's foot in the plane, and the point's distance from the plane (mm,
    /// signed, along the elevation). The position may lie outside of the image.
    pub fn pixel_of(&self, patient_mm: [f64; 3]) -> ([f64; 2], f64) {
        let [x, z, y] = self.pose.plane(patient_mm);
        (self.grid().pixel([x, z]), y)
    }

    /// Rest point (patient mm) of a pixel's centre by the deformed tet; `None` outside of the meshes.
    pub fn rest_point(&self, column: usize, row: usize) -> Option<[f64; 3]> {
        let plane = self.grid().plane([column as f64, row as f64]);
        let polygon = self.polygon(column, row)?;
        slice::rest_point(&self.scanner.organs, &self.scanner.cut, polygon, plane)
    }

    fn polygon(&self, column: usize, row: usize) -> Option<u32> {
        let g = self.grid();
        if column >= g.width_px || row >= g.height_px {
            return None;
        }
        self.scanner
            .pixels
            .polygon
            .get(column + row * g.width_px)
            .copied()
    }

    /// Grey values by the CT window of the settings.
    pub fn grey(&self) -> Vec<u8> {
        let s = &self.scanner.settings;
        let gain = 255.0 / (s.white_hu - s.black_hu);
        self.hu()
            .iter()
            .map(|&v| ((v - s.black_hu) * gain + 0.5).clamp(0.0, 255.0) as u8)
            .collect()
    }

    /// Whether a pixel's value is from a source.
    pub fn is(&self, column: usize, row: usize, source: Source) -> bool {
        let n = column + row * self.grid().width_px;
        column < self.grid().width_px && self.sources().get(n) == Some(&(source as u8))
    }
}
