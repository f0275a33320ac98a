use crate::beams::Beams;
use crate::cut::{Cut, check_deformed};
use crate::needle::overlay;
use crate::organ::Organ;
use crate::slice::{self, Pixels, Scene};
use crate::vector::{norm, sub, wide};
use crate::{
    Image, Level, Needle, PixelGrid, Probe, ProbePose, Settings, SliceImage, TissueTable, UltrasoundError,
};
use rayon::prelude::*;

/// Makes images of deformed organs. Owns all buffers: after the first image none is allocated.
#[derive(Clone, Debug)]
pub struct Scanner {
    pub(crate) organs: Vec<Organ>,
    pub(crate) probe: Probe,
    pub(crate) settings: Settings,
    pub(crate) grid: PixelGrid,
    label_base: Vec<u16>,
    label_names: Vec<String>,
    edge_mm: Vec<f64>,
    pub(crate) cut: Cut,
    pub(crate) slice: Pixels,
    pub(crate) beams: Option<Beams>,
    pub(crate) grey: Vec<u8>,
    needles: Vec<Needle>,
    /// Pose of the image whose grey values these are.
    held: Option<ProbePose>,
}

impl Scanner {
    /// Prepares for images of these organs; deformations come in the same order.
    ///
    /// # Errors
    /// No organ, a setting out of range.
    pub fn new(
        organs: Vec<Organ>,
        tissues: &TissueTable,
        probe: Probe,
        settings: Settings,
    ) -> Result<Self, UltrasoundError> {
        if organs.is_empty() {
            return Err(UltrasoundError::NoOrgan);
        }
        probe.check()?;
        settings.check()?;
        tissues.check()?;
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
        let mut slice = Pixels::default();
        slice.resize(grid.len());
        let beams = match settings.level {
            Level::Slice | Level::Grey => None,
            Level::Rays | Level::BMode => Some(Beams::new(&organs, tissues, &probe, &settings, &grid)?),
        };
        Ok(Self {
            organs,
            probe,
            settings,
            grid,
            label_base,
            label_names,
            edge_mm,
            cut: Cut::default(),
            slice,
            beams,
            grey: vec![0; grid.len()],
            needles: Vec::new(),
            held: None,
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

    /// Needles that the images from now on show; none: as if there never were any.
    ///
    /// At the levels with sound a needle echoes by the angle between beam and shaft, its tip at any angle; it rings on, casts
    /// a shadow, and fades out of the plane as the beam's profile across it does. At the other levels a line one pixel wide
    /// is drawn over the grey values where it lies within the beam's thickness; [`Scanner::slice`] keeps the bare scan.
    ///
    /// # Errors
    /// Fewer than two points, positions that are not finite, a radius that is not positive. The needles then stay as they were.
    pub fn set_needles(&mut self, needles: &[Needle]) -> Result<(), UltrasoundError> {
        needles.iter().try_for_each(Needle::check)?;
        self.needles.truncate(needles.len());
        let kept = self.needles.len();
        for (own, new) in self.needles.iter_mut().zip(needles) {
            own.points_mm.clone_from(&new.points_mm);
            own.radius_mm = new.radius_mm;
        }
        self.needles.extend_from_slice(&needles[kept..]);
        Ok(())
    }

    /// The needles that images show.
    pub fn needles(&self) -> &[Needle] {
        &self.needles
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
        self.held = None;
        self.cut.update(&self.organs, deformed, pose);
        let scene = Scene {
            organs: &self.organs,
            label_base: &self.label_base,
            edge_mm: &self.edge_mm,
            background: self.settings.background,
            fill_hu: f32::from(self.settings.fill_hu),
            needles: &self.needles,
            needle: &self.settings.needle,
        };
        slice::resample(&scene, &self.cut, pose, &self.grid, &mut self.slice);
        Ok(SliceImage {
            scanner: self,
            pose: *pose,
        })
    }

    /// The image of the settings' level, as grey values. Arguments and errors as [`Scanner::slice`].
    ///
    /// # Errors
    /// As [`Scanner::slice`].
    pub fn image(
        &mut self,
        deformed: &[&[[f32; 3]]],
        pose: &ProbePose,
    ) -> Result<Image<'_>, UltrasoundError> {
        if let Some(beams) = &mut self.beams {
            check_deformed(&self.organs, deformed)?;
            pose.check()?;
            let scene = Scene {
                organs: &self.organs,
                label_base: &self.label_base,
                edge_mm: &self.edge_mm,
                background: self.settings.background,
                fill_hu: f32::from(self.settings.fill_hu),
                needles: &self.needles,
                needle: &self.settings.needle,
            };
            let level = self.settings.level;
            beams.image(&scene, &self.probe, level, deformed, pose, &mut self.grey);
        } else {
            self.slice(deformed, pose)?;
            self.map_grey();
        }
        Ok(self.hold(pose))
    }

    /// The last image of [`Scanner::image`], which lasts until the next image or slice; none before the first.
    pub fn held(&self) -> Option<Image<'_>> {
        Some(Image {
            scanner: self,
            pose: self.held?,
        })
    }

    /// The grey values are those of an image at `pose`.
    pub(crate) fn hold(&mut self, pose: &ProbePose) -> Image<'_> {
        self.held = Some(*pose);
        if self.beams.is_none() {
            overlay(&self.needles, pose, &self.probe, &self.grid, &mut self.grey);
        }
        Image {
            scanner: self,
            pose: *pose,
        }
    }

    /// Grey values of the level 0 image.
    pub(crate) fn map_grey(&mut self) {
        let (grid, s) = (&self.grid, &self.settings);
        let width = grid.width_px;
        self.grey
            .par_chunks_mut(width)
            .zip(self.slice.hu.par_chunks(width))
            .enumerate()
            .for_each(|(row, (pixels, hu))| {
                let depth_cm = 0.1 * grid.plane([0.0, row as f64])[1].max(0.0);
                let gain_db = if s.level == Level::Grey {
                    s.grey_gain_db_cm * depth_cm
                } else {
                    0.0
                };
                let gain = 255.0 * 10f64.powf(gain_db / 20.0) as f32 / (s.white_hu - s.black_hu);
                for (pixel, &hu) in pixels.iter_mut().zip(hu) {
                    *pixel = ((hu - s.black_hu) * gain + 0.5).clamp(0.0, 255.0) as u8;
                }
            });
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
