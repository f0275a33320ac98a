use crate::{PixelGrid, ProbePose, Scanner};

/// Grey values of the settings' level, borrowed from the [`Scanner`]; row by row, first row nearest to the transducer.
#[derive(Clone, Copy, Debug)]
pub struct Image<'a> {
    pub(crate) scanner: &'a Scanner,
    pub(crate) pose: ProbePose,
}

impl<'a> Image<'a> {
    /// Grey values.
    pub fn pixels(&self) -> &'a [u8] {
        &self.scanner.grey
    }

    /// Pixels in the plane.
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

    /// Echo amplitudes before compression, relative to a perfect reflector, line by line; `None` at the levels without sound.
    pub fn echoes(&self) -> Option<Echoes<'a>> {
        let beams = self.scanner.beams.as_ref()?;
        let (samples, step_mm) = beams.sampling();
        Some(Echoes {
            amplitude: &beams.envelope,
            contact: beams.contact(),
            samples,
            step_mm,
        })
    }

    /// Tets of all meshes that are inverted or not finite, in this plane or not.
    pub fn inverted_tets(&self) -> usize {
        match &self.scanner.beams {
            Some(beams) => beams.cuts.first().map_or(0, |c| c.inverted_tets),
            None => self.scanner.cut.inverted_tets,
        }
    }

    /// Number of pixels (samples on scan lines at the levels with sound, in the middle plane) by source, in the order of
    /// [`crate::Source::ALL`].
    pub fn source_counts(&self) -> [usize; 7] {
        let sources = match &self.scanner.beams {
            Some(beams) => beams.sources(),
            None => &self.scanner.slice.source,
        };
        let mut out = [0; 7];
        for &s in sources {
            if let Some(n) = out.get_mut(usize::from(s)) {
                *n += 1;
            }
        }
        out
    }
}

/// Echo amplitudes on scan lines.
#[derive(Clone, Copy, Debug)]
pub struct Echoes<'a> {
    /// `amplitude[line·samples + sample]`.
    pub amplitude: &'a [f32],
    /// Which lines have contact.
    pub contact: &'a [bool],
    /// Samples of a line; sample n lies n·`step_mm` from the face.
    pub samples: usize,
    /// Distance of samples, mm.
    pub step_mm: f64,
}
