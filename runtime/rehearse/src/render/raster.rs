use super::{Camera, Picture, Rgb, mix};
use glam::Vec3;
use rayon::prelude::*;

/// Samples along one pixel edge.
const SUPER: i32 = 2;
/// Fixed-point units along one sample's edge: coordinates are exact, so neighbouring triangles leave no gap.
const UNITS: i32 = 16;
/// Rows of pixels that are drawn together.
const BAND: usize = 16;
/// Farther off screen than this many units a triangle is left out.
const FAR: f32 = 4.0e6;
/// A veil must be nearer than what is opaque by this much, mm: surfaces that coincide show the opaque one.
const VEIL_BIAS_MM: f32 = 0.5;
const NOTHING: u32 = u32::MAX;

/// How a surface looks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// Colour in full light.
    pub colour: Rgb,
    /// Opacity of a veil where it faces the viewer; towards the outline it rises.
    pub opacity: f32,
    /// Strength of the highlight, 0 to 1.
    pub shine: f32,
    /// Whether the inside shows as well; otherwise triangles that face away are left out.
    pub two_sided: bool,
    /// Whether light matters; lines do without.
    pub lit: bool,
    /// Whether each triangle's border is smoothed: for bodies with sharp edges.
    pub sharp: bool,
    /// Whether the view's cut takes away what of it is on the viewer's side, and the opacity of a veil's cut face.
    pub cut: Option<f32>,
    /// How much nearer than it is a veil counts where veils are put in order, mm: of two that coincide the lifted one shows.
    pub lift_mm: f32,
}

impl Material {
    /// Opaque and smooth.
    pub const fn plain(colour: Rgb) -> Self {
        Self {
            colour,
            opacity: 1.0,
            shine: 0.25,
            two_sided: false,
            lit: true,
            sharp: false,
            cut: None,
            lift_mm: 0.0,
        }
    }
}

/// A mesh to draw: arrays as in [`super::Mesh`].
#[derive(Clone, Copy, Debug)]
pub struct Item<'a> {
    /// Positions, mm.
    pub vertices: &'a [[f32; 3]],
    /// Unit normals, one per vertex.
    pub normals: &'a [[f32; 3]],
    /// Vertex indices; those out of range are left out.
    pub triangles: &'a [[u32; 3]],
    /// Look.
    pub material: Material,
}

/// What a 3-D view shows.
#[derive(Clone, Debug, Default)]
pub struct View3d<'a> {
    /// Nearest wins.
    pub opaque: Vec<Item<'a>>,
    /// Each lies over what is behind its nearest sheet.
    pub veils: Vec<Item<'a>>,
    /// Height towards the viewer from the camera's centre, mm, of the plane that cuts materials with `cut`: closed surfaces among
    /// the veils get a flat face there.
    pub cut_mm: Option<f32>,
    /// Colours of the ground at the top and at the bottom.
    pub ground: [Rgb; 2],
}

/// A vertex on the screen.
#[derive(Clone, Copy)]
struct Corner {
    /// Units from the left and from the top.
    x: i32,
    y: i32,
    /// Height towards the viewer, mm.
    z: f32,
    /// Camera axes.
    normal: Vec3,
}

/// A triangle ready to be drawn; corners run so that inside all edge functions are positive.
struct Tri {
    corner: [Corner; 3],
    item: u32,
    layer: u8,
    /// Nothing of it shows above this height.
    limit: f32,
    /// It faces away and is there to tell where a closed surface is cut: nearest to the viewer of what is left of its item, it says
    /// that the plane runs inside.
    inside: bool,
    /// Edge k is opposite to corner k: value at the origin's sample, step per sample across and down.
    edge: [[i64; 3]; 3],
    /// Height at sample (0, 0), step across and down.
    depth: [f32; 3],
    rows: [i32; 2],
}

/// Draws the view into the part of `out` whose upper left pixel is (`left`, 0) and whose size is the camera's. The bytes do
/// not depend on the number of threads.
pub fn draw_view(view: &View3d, camera: &Camera, out: &mut Picture, left: usize) {
    let height = camera.height.min(out.height);
    let width = camera.width.min(out.width.saturating_sub(left));
    if width == 0 || height == 0 {
        return;
    }
    let items: Vec<(&Item, u8)> = view
        .opaque
        .iter()
        .map(|i| (i, 0))
        .chain(
            view.veils
                .iter()
                .enumerate()
                .map(|(k, i)| (i, (k + 1).min(255) as u8)),
        )
        .collect();
    let mut tris = Vec::new();
    for (n, &(item, layer)) in items.iter().enumerate() {
        let limit = match item.material.cut {
            Some(_) => view.cut_mm.unwrap_or(f32::INFINITY),
            None => f32::INFINITY,
        };
        set_up(item, n as u32, layer, limit, camera, height, &mut tris);
    }
    let bands = height.div_ceil(BAND);
    let mut lists = vec![Vec::new(); bands];
    let rows_per_band = BAND as i32 * SUPER;
    for (n, t) in tris.iter().enumerate() {
        for b in t.rows[0] / rows_per_band..=t.rows[1] / rows_per_band {
            if let Some(list) = lists.get_mut(b as usize) {
                list.push(n as u32);
            }
        }
    }
    let materials: Vec<Material> = items.iter().map(|(i, _)| i.material).collect();
    // Samples of one group are shaded alike within a pixel; each triangle of a sharp body is its own, and so is a cut face.
    let groups: Vec<u32> = tris
        .iter()
        .enumerate()
        .map(|(n, t)| match (t.inside, materials[t.item as usize].sharp) {
            (true, _) => (items.len() + tris.len()) as u32 + t.item,
            (false, true) => (items.len() + n) as u32,
            (false, false) => t.item,
        })
        .collect();
    let layers = 1 + view.veils.len();
    let stride = out.width * 3;
    out.pixels
        .par_chunks_mut(stride * BAND)
        .take(bands)
        .enumerate()
        .for_each(|(b, rows)| {
            let band = Band {
                first: b * BAND,
                count: (height - b * BAND).min(BAND).min(rows.len() / stride),
                width,
                layers,
            };
            let mut samples = Samples::new(&band);
            for &n in &lists[b] {
                fill(&tris[n as usize], n, &band, &mut samples);
            }
            for r in 0..band.count {
                let t = (band.first + r) as f32 / (height.max(2) - 1) as f32;
                let ground = mix(view.ground[0], view.ground[1], t);
                let line = &mut rows[r * stride + left * 3..r * stride + (left + width) * 3];
                resolve(r, ground, &band, &samples, &tris, &groups, &materials, line);
            }
        });
}

fn set_up(
    item: &Item,
    number: u32,
    layer: u8,
    limit: f32,
    camera: &Camera,
    height: usize,
    out: &mut Vec<Tri>,
) {
    let capped = layer > 0 && limit.is_finite();
    let scale = (SUPER * UNITS) as f32;
    let corners: Vec<Option<Corner>> = item
        .vertices
        .iter()
        .zip(item.normals)
        .map(|(&p, &n)| {
            let s = camera.project(p.into());
            let (x, y) = (s.x * scale, s.y * scale);
            (x.abs() < FAR && y.abs() < FAR && s.z.is_finite()).then(|| Corner {
                x: x.round() as i32,
                y: y.round() as i32,
                z: s.z,
                normal: camera.turn(n.into()),
            })
        })
        .collect();
    let last = height as i32 * SUPER - 1;
    for t in item.triangles {
        let at = |k: usize| corners.get(t[k] as usize).copied().flatten();
        let (Some(a), Some(b), Some(c)) = (at(0), at(1), at(2)) else {
            continue;
        };
        // y runs down: a triangle that faces the viewer has a negative area here.
        let area = cross(a, b, c);
        let (corner, inside) = match area.signum() {
            -1 => ([a, c, b], false),
            1 if capped => ([a, b, c], true),
            1 if item.material.two_sided => ([a, b, c], false),
            _ => continue,
        };
        let rows = corner
            .iter()
            .fold([i32::MAX, i32::MIN], |r, c| [r[0].min(c.y), r[1].max(c.y)]);
        // Rows whose sample centres lie between.
        let rows = [
            (rows[0] - UNITS / 2 + UNITS - 1).div_euclid(UNITS).max(0),
            (rows[1] - UNITS / 2).div_euclid(UNITS).min(last),
        ];
        if rows[0] > rows[1] {
            continue;
        }
        out.push(Tri {
            edge: std::array::from_fn(|k| edge(corner[(k + 1) % 3], corner[(k + 2) % 3])),
            depth: plane(&corner),
            corner,
            item: number,
            layer,
            limit,
            inside,
            rows,
        });
    }
}

fn cross(a: Corner, b: Corner, c: Corner) -> i64 {
    let d = |p: i32, q: i32| i64::from(p) - i64::from(q);
    d(b.x, a.x) * d(c.y, a.y) - d(b.y, a.y) * d(c.x, a.x)
}

/// Edge function from a to b: positive on the triangle's side, a sample on the line belongs to one triangle only.
fn edge(a: Corner, b: Corner) -> [i64; 3] {
    let (dx, dy) = (i64::from(b.x) - i64::from(a.x), i64::from(b.y) - i64::from(a.y));
    let half = i64::from(UNITS / 2);
    let value = dx * (half - i64::from(a.y)) - dy * (half - i64::from(a.x));
    let owns = dy < 0 || (dy == 0 && dx > 0);
    let step = i64::from(UNITS);
    [value - i64::from(!owns), -dy * step, dx * step]
}

/// Height over sample coordinates.
fn plane(c: &[Corner; 3]) -> [f32; 3] {
    let d = |p: i32, q: i32| f64::from(p) - f64::from(q);
    let (x1, y1, x2, y2) = (
        d(c[1].x, c[0].x),
        d(c[1].y, c[0].y),
        d(c[2].x, c[0].x),
        d(c[2].y, c[0].y),
    );
    let (z1, z2) = (f64::from(c[1].z - c[0].z), f64::from(c[2].z - c[0].z));
    let area = x1 * y2 - x2 * y1;
    let (gx, gy) = ((z1 * y2 - z2 * y1) / area, (x1 * z2 - x2 * z1) / area);
    let half = f64::from(UNITS / 2);
    let origin = f64::from(c[0].z) + gx * (half - f64::from(c[0].x)) + gy * (half - f64::from(c[0].y));
    let step = f64::from(UNITS);
    [origin as f32, (gx * step) as f32, (gy * step) as f32]
}

struct Band {
    first: usize,
    count: usize,
    width: usize,
    layers: usize,
}

/// Nearest triangle and its height for every sample of a band, layer by layer.
struct Samples {
    across: usize,
    per_layer: usize,
    height: Vec<f32>,
    tri: Vec<u32>,
}

impl Samples {
    fn new(band: &Band) -> Self {
        let across = band.width * SUPER as usize;
        let per_layer = across * band.count * SUPER as usize;
        Self {
            across,
            per_layer,
            height: vec![f32::NEG_INFINITY; per_layer * band.layers],
            tri: vec![NOTHING; per_layer * band.layers],
        }
    }
}

fn fill(t: &Tri, number: u32, band: &Band, samples: &mut Samples) {
    let first = band.first as i32 * SUPER;
    let last = first + band.count as i32 * SUPER - 1;
    for y in t.rows[0].max(first)..=t.rows[1].min(last) {
        let (mut lo, mut hi) = (0i64, samples.across as i64 - 1);
        for &[value, across, down] in &t.edge {
            let v = value + down * i64::from(y);
            match across {
                0 if v < 0 => hi = -1,
                0 => {}
                a if a > 0 => lo = lo.max((-v + a - 1).div_euclid(a)),
                a => hi = hi.min(v.div_euclid(-a)),
            }
        }
        if lo > hi {
            continue;
        }
        let (lo, hi) = (lo as usize, hi as usize);
        let row = t.layer as usize * samples.per_layer + (y - first) as usize * samples.across;
        let start = t.depth[0] + t.depth[2] * y as f32 + t.depth[1] * lo as f32;
        let heights = &mut samples.height[row + lo..=row + hi];
        let tris = &mut samples.tri[row + lo..=row + hi];
        for (k, (h, id)) in heights.iter_mut().zip(tris).enumerate() {
            let z = start + t.depth[1] * k as f32;
            let nearer = z > *h && z <= t.limit;
            *h = if nearer { z } else { *h };
            *id = if nearer { number } else { *id };
        }
    }
}

/// Colours of one row of pixels. Shading is computed once per pixel and surface, coverage per sample.
fn resolve(
    row: usize,
    ground: Rgb,
    band: &Band,
    samples: &Samples,
    tris: &[Tri],
    groups: &[u32],
    materials: &[Material],
    line: &mut [u8],
) {
    let two = SUPER as usize;
    let y = (band.first + row) as f32 + 0.5;
    let shown = |c: f32| (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    let empty = ground.map(shown);
    let group = |id: u32| groups.get(id as usize).copied().unwrap_or(NOTHING);
    for (x, pixel) in line.chunks_exact_mut(3).enumerate() {
        let place = |layer: usize, s: usize| {
            layer * samples.per_layer + (row * two + s / two) * samples.across + x * two + s % two
        };
        let mut any = false;
        let mut alike = true;
        for layer in 0..band.layers {
            let at = place(layer, 0);
            let (upper, lower) = (&samples.tri[at..at + 2], &samples.tri[at + samples.across..]);
            let ids = [upper[0], upper[1], lower[0], lower[1]];
            if ids == [NOTHING; 4] {
                continue;
            }
            any = true;
            // One triangle in most pixels; only at its border the group is asked for.
            alike &= ids == [ids[0]; 4] || ids[1..].iter().all(|&id| group(id) == group(ids[0]));
        }
        if !any {
            pixel.copy_from_slice(&empty);
            continue;
        }
        let at = (x as f32 + 0.5, y);
        let mut sum = [0.0f32; 3];
        let count = if alike { 1 } else { 4 };
        for s in 0..count {
            let c = sample_colour(s, ground, band, samples, &place, tris, materials, at);
            for k in 0..3 {
                sum[k] += c[k];
            }
        }
        for k in 0..3 {
            pixel[k] = shown(sum[k] / count as f32);
        }
    }
}

fn sample_colour(
    s: usize,
    ground: Rgb,
    band: &Band,
    samples: &Samples,
    place: &impl Fn(usize, usize) -> usize,
    tris: &[Tri],
    materials: &[Material],
    at: (f32, f32),
) -> Rgb {
    let look = |layer: usize| tris.get(samples.tri[place(layer, s)] as usize);
    let above = |layer: usize, t: &Tri| match t.inside {
        true => t.limit,
        false => samples.height[place(layer, s)],
    };
    let (mut colour, mut height) = (ground, f32::NEG_INFINITY);
    if let Some(t) = look(0) {
        colour = shade(t, &materials[t.item as usize], at).0;
        height = samples.height[place(0, s)];
    }
    // Farther veils first; there are few.
    let mut done = f32::NEG_INFINITY;
    for _ in 1..band.layers {
        let next = (1..band.layers)
            .filter_map(|l| {
                let t = look(l)?;
                let lift = materials[t.item as usize].lift_mm;
                Some((above(l, t) + lift, lift, l))
            })
            .filter(|&(h, ..)| h > done)
            .min_by(|a, b| a.0.total_cmp(&b.0));
        let Some((h, lift, l)) = next else { break };
        done = h;
        if let (true, Some(t)) = (h - lift > height + VEIL_BIAS_MM, look(l)) {
            let (c, opacity) = shade(t, &materials[t.item as usize], at);
            colour = mix(colour, c, opacity);
        }
    }
    colour
}

/// Colour and opacity at a pixel's centre.
fn shade(t: &Tri, m: &Material, (x, y): (f32, f32)) -> (Rgb, f32) {
    if t.inside {
        return (m.colour, m.cut.unwrap_or(m.opacity));
    }
    if !m.lit {
        return (m.colour, m.opacity);
    }
    let scale = (SUPER * UNITS) as f32;
    let (px, py) = (x * scale, y * scale);
    let c = &t.corner;
    let share = |a: Corner, b: Corner| {
        ((b.x - a.x) as f32 * (py - a.y as f32) - (b.y - a.y) as f32 * (px - a.x as f32)).max(0.0)
    };
    let w = [share(c[1], c[2]), share(c[2], c[0]), share(c[0], c[1])];
    let sum = (w[0] + w[1] + w[2]).max(1e-6);
    let mut n = (c[0].normal * w[0] + c[1].normal * w[1] + c[2].normal * w[2]) / sum;
    n = n.normalize_or(Vec3::Z);
    if m.two_sided && n.z < 0.0 {
        n = -n;
    }
    // Key light from the upper left, a fill from the lower right, and a lamp at the viewer.
    const KEY: Vec3 = Vec3::new(-0.455, 0.645, 0.614);
    const FILL: Vec3 = Vec3::new(0.70, -0.35, 0.62);
    const HALF: Vec3 = Vec3::new(-0.2533, 0.359, 0.8983);
    let facing = n.z.clamp(0.0, 1.0);
    let key = (n.dot(KEY) * 0.85 + 0.15).max(0.0);
    let light = 0.20 + 0.56 * key + 0.10 * n.dot(FILL).max(0.0) + 0.20 * facing;
    let mut glint = n.dot(HALF).max(0.0);
    for _ in 0..5 {
        glint *= glint;
    }
    let glint = m.shine * glint;
    let opacity = m.opacity + (1.0 - m.opacity) * 0.8 * (1.0 - facing) * (1.0 - facing);
    (m.colour.map(|v| v * light + glint), opacity.max(glint))
}
