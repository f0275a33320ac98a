use super::Picture;
use crate::RehearseError;
use png::{BitDepth, ColorType, Compression, Encoder};

/// An 8-bit RGB PNG file with text entries (keyword, text in Latin letters). The bytes depend on the arguments alone.
///
/// # Errors
/// [`RehearseError::Picture`]: only for pictures without pixels or keywords that PNG does not allow.
pub fn encode_png(name: &str, picture: &Picture, notes: &[(&str, &str)]) -> Result<Vec<u8>, RehearseError> {
    let fail = |source| RehearseError::Picture {
        name: name.into(),
        source,
    };
    let mut out = Vec::new();
    let mut encoder = Encoder::new(&mut out, picture.width as u32, picture.height as u32);
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::Fast);
    for (keyword, text) in notes {
        encoder
            .add_itxt_chunk((*keyword).into(), (*text).into())
            .map_err(fail)?;
    }
    let mut writer = encoder.write_header().map_err(fail)?;
    writer.write_image_data(&picture.pixels).map_err(fail)?;
    writer.finish().map_err(fail)?;
    Ok(out)
}

/// An animated PNG in the making: shown by every browser, and by viewers that know no animation as its first frame.
#[derive(Clone, Debug, Default)]
pub struct Preview {
    frames: Vec<Picture>,
}

impl Preview {
    /// Takes a frame; all must have the size of the first, others are left out.
    pub fn push(&mut self, picture: Picture) {
        let fits = self
            .frames
            .first()
            .is_none_or(|f| (f.width, f.height) == (picture.width, picture.height));
        if fits {
            self.frames.push(picture);
        }
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether there is no frame.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// The file: frames for `frame_s` each, the last for 1.5 s, over and over. Of each frame only the box of the changed
    /// pixels is stored.
    ///
    /// # Errors
    /// [`RehearseError::Picture`]: only without frames.
    pub fn encode(&self, frame_s: f64, notes: &[(&str, &str)]) -> Result<Vec<u8>, RehearseError> {
        let fail = |source| RehearseError::Picture {
            name: "preview".into(),
            source,
        };
        let Some(first) = self.frames.first() else {
            return Ok(Vec::new());
        };
        let mut out = Vec::new();
        let mut encoder = Encoder::new(&mut out, first.width as u32, first.height as u32);
        encoder.set_color(ColorType::Rgb);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_compression(Compression::Balanced);
        encoder.set_filter(png::Filter::Adaptive);
        for (keyword, text) in notes {
            encoder
                .add_itxt_chunk((*keyword).into(), (*text).into())
                .map_err(fail)?;
        }
        encoder.set_animated(self.frames.len() as u32, 0).map_err(fail)?;
        let mut writer = encoder.write_header().map_err(fail)?;
        let delay = (frame_s * 1000.0).round().clamp(10.0, 10_000.0) as u16;
        for (n, frame) in self.frames.iter().enumerate() {
            let last = n + 1 == self.frames.len();
            writer
                .set_frame_delay(if last { 1500 } else { delay }, 1000)
                .map_err(fail)?;
            let [x, y, w, h] = match n.checked_sub(1) {
                Some(before) => changed(&self.frames[before], frame),
                None => [0, 0, frame.width, frame.height],
            };
            if n > 0 {
                // Size and place are checked against each other: start from the corner.
                writer.reset_frame_position().map_err(fail)?;
                writer.set_frame_dimension(w as u32, h as u32).map_err(fail)?;
                writer.set_frame_position(x as u32, y as u32).map_err(fail)?;
            }
            let part: Vec<u8> = (y..y + h)
                .flat_map(|row| &frame.pixels[3 * (row * frame.width + x)..3 * (row * frame.width + x + w)])
                .copied()
                .collect();
            writer.write_image_data(&part).map_err(fail)?;
        }
        writer.finish().map_err(fail)?;
        Ok(out)
    }
}

/// Left, top, width, height of the changed pixels; one pixel where nothing changed.
fn changed(a: &Picture, b: &Picture) -> [usize; 4] {
    let (mut lo, mut hi) = ([usize::MAX; 2], [0; 2]);
    for y in 0..b.height {
        for x in 0..b.width {
            if a.get(x, y) != b.get(x, y) {
                lo = [lo[0].min(x), lo[1].min(y)];
                hi = [hi[0].max(x), hi[1].max(y)];
            }
        }
    }
    if lo[0] > hi[0] {
        return [0, 0, 1, 1];
    }
    [lo[0], lo[1], hi[0] - lo[0] + 1, hi[1] - lo[1] + 1]
}
