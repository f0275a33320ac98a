use super::{Rgb, mix};
use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};

/// Height of text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TextSize {
    /// 16 pixels.
    Small,
    /// 20 pixels.
    Medium,
    /// 24 pixels, bold.
    Large,
}

impl TextSize {
    fn font(self) -> (FontWeight, RasterHeight) {
        match self {
            Self::Small => (FontWeight::Regular, RasterHeight::Size16),
            Self::Medium => (FontWeight::Regular, RasterHeight::Size20),
            Self::Large => (FontWeight::Bold, RasterHeight::Size24),
        }
    }

    /// Width of a text, pixels.
    pub fn width(self, text: &str) -> usize {
        let (weight, height) = self.font();
        text.chars().count() * get_raster_width(weight, height)
    }
}

/// An 8-bit RGB picture, row by row from the top.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// Three bytes per pixel.
    pub pixels: Vec<u8>,
}

impl Picture {
    /// Filled with one colour; at least one pixel.
    pub fn new(width: usize, height: usize, colour: Rgb) -> Self {
        let (width, height) = (width.max(1), height.max(1));
        let c = colour.map(byte);
        Self {
            width,
            height,
            pixels: c.iter().copied().cycle().take(3 * width * height).collect(),
        }
    }

    /// Colour at (x, y); black outside.
    pub fn get(&self, x: usize, y: usize) -> [u8; 3] {
        let at = 3 * (y * self.width + x);
        match self.pixels.get(at..at + 3) {
            Some(p) if x < self.width => [p[0], p[1], p[2]],
            _ => [0; 3],
        }
    }

    /// Mixes a share of a colour in; nothing outside of the picture.
    pub fn blend(&mut self, x: i64, y: i64, colour: Rgb, share: f32) {
        if x < 0 || y < 0 || x >= self.width as i64 || y >= self.height as i64 {
            return;
        }
        let at = 3 * (y as usize * self.width + x as usize);
        let old: Rgb = std::array::from_fn(|k| f32::from(self.pixels[at + k]) / 255.0);
        let new = mix(old, colour, share.clamp(0.0, 1.0)).map(byte);
        self.pixels[at..at + 3].copy_from_slice(&new);
    }

    /// Fills a rectangle.
    pub fn rectangle(&mut self, left: usize, top: usize, width: usize, height: usize, colour: Rgb) {
        let c = colour.map(byte);
        for y in top..(top + height).min(self.height) {
            for x in left..(left + width).min(self.width) {
                let at = 3 * (y * self.width + x);
                self.pixels[at..at + 3].copy_from_slice(&c);
            }
        }
    }

    /// Text with its upper left corner at (x, y). Characters beyond Latin-1 show as `?`.
    pub fn text(&mut self, text: &str, x: i64, y: i64, size: TextSize, colour: Rgb) {
        let (weight, height) = size.font();
        let advance = get_raster_width(weight, height) as i64;
        for (n, c) in text.chars().enumerate() {
            let Some(glyph) = get_raster(c, weight, height).or_else(|| get_raster('?', weight, height))
            else {
                continue;
            };
            for (row, line) in glyph.raster().iter().enumerate() {
                for (column, &ink) in line.iter().enumerate() {
                    if ink > 0 {
                        let at = (x + n as i64 * advance + column as i64, y + row as i64);
                        self.blend(at.0, at.1, colour, f32::from(ink) / 255.0);
                    }
                }
            }
        }
    }

    /// Half the size in both directions, pixels averaged; odd rests are cut.
    pub fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut out = Self::new(width, height, [0.0; 3]);
        for y in 0..height {
            for x in 0..width {
                for k in 0..3 {
                    let at = |dx: usize, dy: usize| {
                        u16::from(self.pixels[3 * ((2 * y + dy) * self.width + 2 * x + dx) + k])
                    };
                    out.pixels[3 * (y * width + x) + k] =
                        ((at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1) + 2) / 4) as u8;
                }
            }
        }
        out
    }
}

fn byte(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}
