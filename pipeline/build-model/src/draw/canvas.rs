use super::{Image, Rgb, mix};

/// Samples along one pixel edge.
const SUPER: usize = 2;

/// Parallel projection.
#[derive(Clone, Copy, Debug)]
pub struct Camera {
    /// Patient direction to the right of the picture (unit).
    pub right: [f64; 3],
    /// Patient direction to the top of the picture (unit).
    pub up: [f64; 3],
    /// Patient direction from the scene to the viewer (unit).
    pub toward: [f64; 3],
    /// Patient point in the middle of the picture, mm.
    pub centre: [f64; 3],
    /// Scale.
    pub px_per_mm: f64,
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
}

impl Camera {
    /// Looks against `toward` with `up` to the top (made perpendicular), so that `points` fill the picture to a margin.
    pub fn framing(points: &[[f64; 3]], toward: [f64; 3], up: [f64; 3], width: usize, height: usize) -> Self {
        let toward = unit(toward);
        let along = dot(up, toward);
        let up = unit(std::array::from_fn(|a| up[a] - along * toward[a]));
        let right = cross(up, toward);
        let mut lo = [f64::INFINITY; 3];
        let mut hi = [f64::NEG_INFINITY; 3];
        for p in points {
            for (k, axis) in [right, up, toward].into_iter().enumerate() {
                let v = dot(*p, axis);
                lo[k] = lo[k].min(v);
                hi[k] = hi[k].max(v);
            }
        }
        if points.is_empty() {
            (lo, hi) = ([-1.0; 3], [1.0; 3]);
        }
        let m: [f64; 3] = std::array::from_fn(|k| 0.5 * (lo[k] + hi[k]));
        let fit = |k: usize, px: usize| px as f64 / (hi[k] - lo[k]).max(1e-6);
        Self {
            right,
            up,
            toward,
            centre: std::array::from_fn(|a| m[0] * right[a] + m[1] * up[a] + m[2] * toward[a]),
            px_per_mm: 0.86 * fit(0, width).min(fit(1, height)),
            width,
            height,
        }
    }

    /// Sample coordinates (x right, y down) and height towards the viewer in mm.
    fn project(&self, p: [f64; 3]) -> [f64; 3] {
        let q: [f64; 3] = std::array::from_fn(|a| p[a] - self.centre[a]);
        let s = self.px_per_mm * SUPER as f64;
        [
            0.5 * (self.width * SUPER) as f64 + s * dot(q, self.right),
            0.5 * (self.height * SUPER) as f64 - s * dot(q, self.up),
            dot(q, self.toward),
        ]
    }

    /// Letters for the picture's left, right, top and bottom edge where an axis of the patient points there within
    /// 30°, else empty.
    pub fn letters(&self) -> [&'static str; 4] {
        let name = |v: [f64; 3]| {
            let names = [["R", "L"], ["A", "P"], ["S", "I"]];
            (0..3)
                .find(|&a| v[a].abs() > 0.86)
                .map_or("", |a| names[a][usize::from(v[a] < 0.0)])
        };
        let minus = |v: [f64; 3]| v.map(|c| -c);
        [
            name(minus(self.right)),
            name(self.right),
            name(self.up),
            name(minus(self.up)),
        ]
    }
}

/// How a surface is painted.
#[derive(Clone, Copy, Debug)]
pub struct Finish {
    /// Opacity where the surface faces the viewer; 1 is opaque. Towards the outline it rises.
    pub opacity: f32,
    /// Colour and half width (pixels) of the triangles' edges.
    pub edges: Option<(Rgb, f32)>,
}

impl Finish {
    /// Opaque, no edges.
    pub const PLAIN: Self = Self {
        opacity: 1.0,
        edges: None,
    };
}

#[derive(Clone, Copy)]
struct Sample {
    colour: Rgb,
    opacity: f32,
    height: f32,
}

/// A supersampled picture with depth.
pub struct Canvas {
    camera: Camera,
    width: usize,
    height: usize,
    ground: Rgb,
    samples: Vec<Sample>,
}

impl Canvas {
    /// Empty, over `ground`.
    pub fn new(camera: Camera, ground: Rgb) -> Self {
        let (width, height) = (camera.width * SUPER, camera.height * SUPER);
        let empty = Sample {
            colour: ground,
            opacity: 0.0,
            height: f32::NEG_INFINITY,
        };
        Self {
            camera,
            width,
            height,
            ground,
            samples: vec![empty; width * height],
        }
    }

    /// Draws triangles, shaded by the corners' normals (or flat without them), nearest wins. `colour` is asked per
    /// triangle. Translucent surfaces show their nearest sheet only and go on a canvas of their own: see
    /// [`Canvas::over`].
    pub fn mesh(
        &mut self,
        vertices: &[[f64; 3]],
        normals: Option<&[[f64; 3]]>,
        triangles: &[[u32; 3]],
        colour: impl Fn(usize) -> Rgb,
        finish: Finish,
    ) {
        let screen: Vec<[f64; 3]> = vertices.iter().map(|&p| self.camera.project(p)).collect();
        for (i, t) in triangles.iter().enumerate() {
            let [a, b, c] = t.map(|v| v as usize);
            let (Some(&p), Some(&q), Some(&r)) = (screen.get(a), screen.get(b), screen.get(c)) else {
                continue;
            };
            let flat = unit(cross(
                sub(vertices[b], vertices[a]),
                sub(vertices[c], vertices[a]),
            ));
            let n = normals.map_or([flat; 3], |n| [n[a], n[b], n[c]]);
            self.triangle([p, q, r], n, colour(i), finish);
        }
    }

    fn triangle(&mut self, p: [[f64; 3]; 3], n: [[f64; 3]; 3], colour: Rgb, finish: Finish) {
        let side = |a: [f64; 3], b: [f64; 3], x: f64, y: f64| {
            (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
        };
        let area = side(p[0], p[1], p[2][0], p[2][1]);
        if !(area.is_finite() && area.abs() > 1e-9) {
            return;
        }
        let range = |k: usize, most: usize| {
            let v = p.map(|p| p[k]);
            let lo = v.iter().copied().fold(f64::INFINITY, f64::min) - 0.5;
            let hi = v.iter().copied().fold(f64::NEG_INFINITY, f64::max) + 0.5;
            lo.ceil().clamp(0.0, most as f64) as usize..hi.floor().clamp(0.0, most as f64) as usize
        };
        // Height of the triangle over each edge: a share of it is a distance to that edge.
        let rise: [f64; 3] = std::array::from_fn(|k| {
            let (a, b) = (p[(k + 1) % 3], p[(k + 2) % 3]);
            area.abs() / (a[0] - b[0]).hypot(a[1] - b[1]).max(1e-9)
        });
        for y in range(1, self.height) {
            for x in range(0, self.width) {
                let (fx, fy) = (x as f64 + 0.5, y as f64 + 0.5);
                let w: [f64; 3] =
                    std::array::from_fn(|k| side(p[(k + 1) % 3], p[(k + 2) % 3], fx, fy) / area);
                if w.iter().any(|&w| w < 0.0) {
                    continue;
                }
                let height = (w[0] * p[0][2] + w[1] * p[1][2] + w[2] * p[2][2]) as f32;
                let s = &mut self.samples[y * self.width + x];
                if height <= s.height {
                    continue;
                }
                let normal = unit(std::array::from_fn(|a| {
                    w[0] * n[0][a] + w[1] * n[1][a] + w[2] * n[2][a]
                }));
                let mut shaded = shade(&self.camera, normal, colour);
                let facing = dot(normal, self.camera.toward).abs() as f32;
                let mut opacity = finish.opacity + (1.0 - finish.opacity) * 0.75 * (1.0 - facing).powi(2);
                if let Some((ink, half)) = finish.edges {
                    let gap = (0..3).map(|k| w[k] * rise[k]).fold(f64::INFINITY, f64::min) as f32;
                    let t = (half * SUPER as f32 + 0.5 - gap).clamp(0.0, 1.0);
                    shaded = mix(shaded, ink, t);
                    opacity = opacity.max(t);
                }
                *s = Sample {
                    colour: shaded,
                    opacity,
                    height,
                };
            }
        }
    }

    /// Draws balls of one radius (mm).
    pub fn balls(&mut self, centres: &[[f64; 3]], radius_mm: f64, colour: impl Fn(usize) -> Rgb) {
        let r = radius_mm * self.camera.px_per_mm * SUPER as f64;
        for (i, &c) in centres.iter().enumerate() {
            let p = self.camera.project(c);
            let base = colour(i);
            let range = |v: f64, most: usize| {
                (v - r).ceil().clamp(0.0, most as f64) as usize
                    ..(v + r).floor().clamp(0.0, most as f64) as usize
            };
            for y in range(p[1], self.height) {
                for x in range(p[0], self.width) {
                    let (u, v) = ((x as f64 + 0.5 - p[0]) / r, (p[1] - y as f64 - 0.5) / r);
                    let left = 1.0 - u * u - v * v;
                    if left <= 0.0 {
                        continue;
                    }
                    let w = left.sqrt();
                    let height = (p[2] + w * radius_mm) as f32;
                    let s = &mut self.samples[y * self.width + x];
                    if height > s.height {
                        let cam = &self.camera;
                        let n = std::array::from_fn(|a| u * cam.right[a] + v * cam.up[a] + w * cam.toward[a]);
                        *s = Sample {
                            colour: shade(cam, n, base),
                            opacity: 1.0,
                            height,
                        };
                    }
                }
            }
        }
    }

    /// Draws straight lines `width` pixels wide; where `hidden` is above 0, parts behind something show that faintly.
    pub fn lines(&mut self, segments: &[[[f64; 3]; 2]], width: f64, colour: Rgb, hidden: f32) {
        let r = 0.5 * width * SUPER as f64;
        for s in segments {
            let [a, b] = s.map(|p| self.camera.project(p));
            let length = (a[0] - b[0]).hypot(a[1] - b[1]);
            let d = [b[0] - a[0], b[1] - a[1]];
            let range = |k: usize, most: usize| {
                let (lo, hi) = (a[k].min(b[k]) - r, a[k].max(b[k]) + r);
                lo.floor().clamp(0.0, most as f64) as usize..hi.ceil().clamp(0.0, most as f64) as usize
            };
            for y in range(1, self.height) {
                for x in range(0, self.width) {
                    let p = [x as f64 + 0.5 - a[0], y as f64 + 0.5 - a[1]];
                    let t = ((p[0] * d[0] + p[1] * d[1]) / (length * length).max(1e-9)).clamp(0.0, 1.0);
                    if (p[0] - t * d[0]).hypot(p[1] - t * d[1]) > r {
                        continue;
                    }
                    let height = (a[2] + t * (b[2] - a[2])) as f32;
                    let s = &mut self.samples[y * self.width + x];
                    if height > s.height {
                        *s = Sample {
                            colour,
                            opacity: 1.0,
                            height,
                        };
                    } else if hidden > 0.0 {
                        s.colour = mix(s.colour, colour, hidden);
                    }
                }
            }
        }
    }

    /// Lays a canvas of the same camera over this one where it is nearer by more than `bias_mm`, by its opacity. The
    /// bias settles surfaces that coincide: what is below then shows unveiled.
    pub fn over(&mut self, layer: &Self, bias_mm: f32) {
        for (s, l) in self.samples.iter_mut().zip(&layer.samples) {
            if l.height > s.height + bias_mm {
                s.colour = mix(s.colour, l.colour, l.opacity);
            }
        }
    }

    /// A canvas of the same camera without anything on it.
    pub fn layer(&self) -> Self {
        Self::new(self.camera, self.ground)
    }

    /// The picture: samples averaged.
    pub fn finish(&self) -> Image {
        Image::from_pixels(self.camera.width, self.camera.height, |x, y| {
            let mut sum = [0.0; 3];
            for dy in 0..SUPER {
                for dx in 0..SUPER {
                    let s = &self.samples[(y * SUPER + dy) * self.width + x * SUPER + dx];
                    for k in 0..3 {
                        sum[k] += s.colour[k] / (SUPER * SUPER) as f32;
                    }
                }
            }
            sum
        })
    }
}

/// Light from the viewer's upper left, seen from both sides; a faint highlight, a darker outline.
fn shade(camera: &Camera, normal: [f64; 3], colour: Rgb) -> Rgb {
    let facing = dot(normal, camera.toward);
    let n = if facing < 0.0 { normal.map(|c| -c) } else { normal };
    let light = unit(std::array::from_fn(|a| {
        camera.toward[a] + 0.55 * camera.up[a] - 0.45 * camera.right[a]
    }));
    let half = unit(std::array::from_fn(|a| light[a] + camera.toward[a]));
    let diffuse = dot(n, light).max(0.0) as f32;
    let edge = 0.8 + 0.2 * facing.abs() as f32;
    let shine = 0.16 * dot(n, half).max(0.0).powi(40) as f32;
    colour.map(|c| (c * (0.40 + 0.66 * diffuse) * edge + shine).min(1.0))
}

/// Area-weighted unit normals of the vertices.
pub fn vertex_normals(vertices: &[[f64; 3]], triangles: &[[u32; 3]]) -> Vec<[f64; 3]> {
    let mut out = vec![[0.0; 3]; vertices.len()];
    for t in triangles {
        let Some([a, b, c]) = corners(vertices, t) else {
            continue;
        };
        let n = cross(sub(b, a), sub(c, a));
        for &v in t {
            for k in 0..3 {
                out[v as usize][k] += n[k];
            }
        }
    }
    out.into_iter().map(unit).collect()
}

fn corners(vertices: &[[f64; 3]], t: &[u32; 3]) -> Option<[[f64; 3]; 3]> {
    let p = |k: usize| vertices.get(t[k] as usize).copied();
    Some([p(0)?, p(1)?, p(2)?])
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

fn unit(a: [f64; 3]) -> [f64; 3] {
    let l = dot(a, a).sqrt();
    if l > 0.0 {
        a.map(|c| c / l)
    } else {
        [0.0, 0.0, 1.0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        let box_ = [[-10.0, -10.0, -10.0], [10.0, 10.0, 10.0]];
        Camera::framing(&box_, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 80, 80)
    }

    #[test]
    fn patients_left_is_on_the_right_from_the_front() {
        let cam = camera();
        assert_eq!(cam.letters(), ["R", "L", "S", "I"]);
        let left = cam.project([-5.0, 0.0, 0.0]);
        let head = cam.project([0.0, 0.0, 5.0]);
        let front = cam.project([0.0, 5.0, 0.0]);
        assert!(left[0] > 80.0 && head[1] < 80.0 && front[2] > 0.0);
    }

    #[test]
    fn nearer_things_hide_farther_ones_in_any_order() {
        let near = [[-8.0, 5.0, -8.0], [8.0, 5.0, -8.0], [0.0, 5.0, 8.0]];
        let far = near.map(|p| [p[0], -5.0, p[2]]);
        let red = [1.0, 0.0, 0.0];
        let blue = [0.0, 0.0, 1.0];
        let picture = |near_first: bool| {
            let mut canvas = Canvas::new(camera(), [1.0; 3]);
            for is_near in [near_first, !near_first] {
                let (v, c) = if is_near { (near, red) } else { (far, blue) };
                canvas.mesh(&v, None, &[[0, 1, 2]], |_| c, Finish::PLAIN);
            }
            canvas.finish()
        };
        let image = picture(true);
        assert_eq!(image, picture(false));
        let p = image.get(40, 44);
        assert!(p[0] > 0.5 && p[2] < 0.3, "{p:?}");
        // Through a translucent front the back shows.
        let mut canvas = Canvas::new(camera(), [1.0; 3]);
        canvas.mesh(&far, None, &[[0, 1, 2]], |_| blue, Finish::PLAIN);
        let mut layer = canvas.layer();
        layer.mesh(
            &near,
            None,
            &[[0, 1, 2]],
            |_| red,
            Finish {
                opacity: 0.4,
                edges: None,
            },
        );
        canvas.over(&layer, 0.0);
        let p = canvas.finish().get(40, 44);
        assert!(p[0] > 0.25 && p[2] > 0.4, "{p:?}");
    }

    #[test]
    fn a_ball_has_the_area_of_its_disc() {
        let cam = camera();
        let mut canvas = Canvas::new(cam, [1.0; 3]);
        canvas.balls(&[[0.0; 3]], 6.0, |_| [0.0; 3]);
        let image = canvas.finish();
        let ink: f64 = (0..6400)
            .map(|i| 1.0 - f64::from(image.get(i % 80, i / 80)[0]))
            .sum();
        let disc = std::f64::consts::PI * (6.0 * cam.px_per_mm).powi(2);
        assert!(ink < disc && ink > 0.85 * disc, "{ink} {disc}");
    }
}
