use crate::slice;
use crate::{PixelGrid, ProbePose, Scanner, Source};

/// A level 0 image, borrowed from its [`Scanner`]. Arrays are row by row, first row nearest to the transducer.
#[derive(Clone, Copy, Debug)]
pub struct SliceImage<'a> {
    pub(crate) scanner: &'a Scanner,
    pub(crate) pose: ProbePose,
}

impl<'a> SliceImage<'a> {
    /// CT values, HU.
    pub fn hu(&self) -> &'a [f32] {
        &self.scanner.slice.hu
    }

    /// Label codes: 0, or n + 1 for [`Scanner::label_names`]`[n]`; that with the most trilinear weight at the rest point.
    pub fn labels(&self) -> &'a [u16] {
        &self.scanner.slice.label
    }

    /// Where each pixel's value is from, as the numbers of [`Source`].
    pub fn sources(&self) -> &'a [u8] {
        &self.scanner.slice.source
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
        self.scanner.slice.polygon.get(column + row * g.width_px).copied()
    }

    /// Whether a pixel's value is from a source.
    pub fn is(&self, column: usize, row: usize, source: Source) -> bool {
        let n = column + row * self.grid().width_px;
        column < self.grid().width_px && self.sources().get(n) == Some(&(source as u8))
    }
}
