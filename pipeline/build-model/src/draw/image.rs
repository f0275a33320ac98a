use super::{Rgb, glyph, mix};

/// A picture of floating-point colours, row by row from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    pixels: Vec<Rgb>,
}

impl Image {
    /// Filled with one colour; at least one pixel.
    pub fn new(width: usize, height: usize, colour: Rgb) -> Self {
        let (width, height) = (width.max(1), height.max(1));
        Self {
            width,
            height,
            pixels: vec![colour; width * height],
        }
    }

    /// From the colours of each pixel, row by row.
    pub fn from_pixels(width: usize, height: usize, pixel: impl Fn(usize, usize) -> Rgb) -> Self {
        let mut out = Self::new(width, height, [0.0; 3]);
        for (i, p) in out.pixels.iter_mut().enumerate() {
            *p = pixel(i % out.width, i / out.width);
        }
        out
    }

    /// Colour at (x, y).
    pub fn get(&self, x: usize, y: usize) -> Rgb {
        self.pixels[y * self.width + x]
    }

    /// Mixes a share `alpha` of `colour` in; nothing outside of the picture.
    pub fn blend(&mut self, x: i64, y: i64, colour: Rgb, alpha: f32) {
        if (0..self.width as i64).contains(&x) && (0..self.height as i64).contains(&y) {
            let p = &mut self.pixels[y as usize * self.width + x as usize];
            *p = mix(*p, colour, alpha);
        }
    }

    /// 8-bit RGB, row by row.
    pub fn bytes(&self) -> Vec<u8> {
        self.pixels
            .iter()
            .flatten()
            .map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8)
            .collect()
    }

    /// Smooth-edged line of the given width in pixels.
    pub fn line(&mut self, a: [f64; 2], b: [f64; 2], width: f64, colour: Rgb, alpha: f32) {
        if !a.iter().chain(&b).all(|v| v.is_finite()) {
            return;
        }
        let r = 0.5 * width + 0.5;
        let (w, h) = (self.width as f64, self.height as f64);
        let span = |k: usize, most: f64| {
            let lo = (a[k].min(b[k]) - r).floor().clamp(0.0, most);
            let hi = (a[k].max(b[k]) + r).ceil().clamp(0.0, most);
            lo as i64..hi as i64
        };
        let d = [b[0] - a[0], b[1] - a[1]];
        let length2 = (d[0] * d[0] + d[1] * d[1]).max(1e-12);
        for y in span(1, h) {
            for x in span(0, w) {
                let p = [x as f64 + 0.5 - a[0], y as f64 + 0.5 - a[1]];
                let t = ((p[0] * d[0] + p[1] * d[1]) / length2).clamp(0.0, 1.0);
                let gap = (p[0] - t * d[0]).hypot(p[1] - t * d[1]);
                let cover = (r - gap).clamp(0.0, 1.0) as f32;
                if cover > 0.0 {
                    self.blend(x, y, colour, alpha * cover);
                }
            }
        }
    }

    /// Text with its centre at `at`, `height` pixels high, with a halo that keeps it legible on any ground.
    pub fn text(&mut self, text: &str, at: [f64; 2], height: f64, colour: Rgb, halo: Rgb) {
        let unit = height / 6.0;
        let advance = 5.8 * unit;
        let left = at[0] - 0.5 * (advance * text.chars().count() as f64 - 1.8 * unit);
        for (ink, width) in [(halo, 0.42 * height), (colour, 0.17 * height)] {
            for (k, c) in text.chars().enumerate() {
                let place = |p: (f32, f32)| {
                    [
                        left + advance * k as f64 + unit * f64::from(p.0),
                        at[1] - 0.5 * height + unit * f64::from(p.1),
                    ]
                };
                for stroke in glyph::strokes(c) {
                    for pair in stroke.windows(2) {
                        self.line(place(pair[0]), place(pair[1]), width, ink, 1.0);
                    }
                }
            }
        }
    }

    /// Letters in the middle of the edges (left, right, top, bottom) and a scale bar below.
    pub fn annotate(&mut self, letters: [&str; 4], px_per_mm: f64, ink: Rgb, halo: Rgb) {
        let (w, h) = (self.width as f64, self.height as f64);
        let size = (0.032 * w.max(h)).clamp(10.0, 20.0);
        let m = 1.1 * size;
        for (text, at) in
            letters
                .into_iter()
                .zip([[m, 0.5 * h], [w - m, 0.5 * h], [0.5 * w, m], [0.5 * w, h - m]])
        {
            self.text(text, at, size, ink, halo);
        }
        let fits = |mm: &f64| mm * px_per_mm <= 0.28 * w;
        let mm = [50.0, 20.0, 10.0, 5.0, 2.0].into_iter().find(fits).unwrap_or(1.0);
        let (x0, y) = (m, h - 0.9 * m);
        let x1 = x0 + mm * px_per_mm;
        for (colour, width) in [(halo, 5.0), (ink, 2.0)] {
            self.line([x0, y], [x1, y], width, colour, 1.0);
            for x in [x0, x1] {
                self.line([x, y - 4.0], [x, y + 4.0], width, colour, 1.0);
            }
        }
        self.text(
            &format!("{mm:.0} mm"),
            [0.5 * (x0 + x1), y - 0.95 * size],
            0.72 * size,
            ink,
            halo,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_covers_its_length_times_its_width() {
        for (a, b) in [([10.0, 10.0], [50.0, 10.0]), ([8.0, 9.0], [40.0, 51.0])] {
            let mut image = Image::new(64, 64, [0.0; 3]);
            image.line(a, b, 3.0, [1.0; 3], 1.0);
            let ink: f64 = image.pixels.iter().map(|p| f64::from(p[0])).sum();
            let length = f64::hypot(a[0] - b[0], a[1] - b[1]);
            // Body and two round ends.
            let expected = 3.0 * length + std::f64::consts::PI * 2.25;
            assert!((ink / expected - 1.0).abs() < 0.06, "{ink} {expected}");
        }
    }

    #[test]
    fn lines_far_outside_cost_nothing_and_draw_nothing() {
        let mut image = Image::new(8, 8, [0.0; 3]);
        image.line([1e9, 1e9], [2e9, 1e9], 2.0, [1.0; 3], 1.0);
        image.line([f64::NAN, 0.0], [1.0, 1.0], 2.0, [1.0; 3], 1.0);
        assert!(image.pixels.iter().all(|p| p[0] == 0.0));
    }
}
