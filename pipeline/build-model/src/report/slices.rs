use super::{ReportInput, colour};
use crate::draw::Image;
use palpate_tetmesh::TetMesh;
use palpate_volume::{Affine, RegionLabels};

/// Pixels along the longest side.
const SIDE_PX: f64 = 720.0;
/// Room around the body, mm.
const MARGIN_MM: f64 = 9.0;
/// Soft-tissue window, HU.
const WINDOW: [f32; 2] = [-140.0, 260.0];

/// A patient plane as radiologists look at it.
#[derive(Clone, Copy)]
pub(super) struct Plane {
    pub name: &'static str,
    /// Patient axis (R, A, S) across the plane.
    pub axis: usize,
    /// Patient axis and sign towards the picture's right.
    right: (usize, f64),
    /// Patient axis and sign towards the picture's bottom.
    down: (usize, f64),
    letters: [&'static str; 4],
}

pub(super) const PLANES: [Plane; 3] = [
    Plane {
        name: "axial",
        axis: 2,
        right: (0, -1.0),
        down: (1, -1.0),
        letters: ["R", "L", "A", "P"],
    },
    Plane {
        name: "coronal",
        axis: 1,
        right: (0, -1.0),
        down: (2, -1.0),
        letters: ["R", "L", "S", "I"],
    },
    Plane {
        name: "sagittal",
        axis: 0,
        right: (1, -1.0),
        down: (2, -1.0),
        letters: ["A", "P", "S", "I"],
    },
];

/// Points that the slices go through: the organ's centroid, and the largest structure's.
pub(super) fn places(input: &ReportInput) -> Vec<(&'static str, [f64; 3])> {
    let mut out = vec![("organ", centroid(&input.surfaces[0].1.vertices))];
    if let Some(n) = largest_structure(input) {
        out.push(("structure", centroid(&input.surfaces[n + 1].1.vertices)));
    }
    out
}

/// Index of the structure with the largest volume that has a surface.
pub(super) fn largest_structure(input: &ReportInput) -> Option<usize> {
    let volume = |n: &usize| input.anatomy.structures[*n].body.voxel_volume_mm3;
    (0..input.anatomy.structures.len())
        .filter(|n| {
            input
                .surfaces
                .get(n + 1)
                .is_some_and(|s| !s.1.vertices.is_empty())
        })
        .max_by(|a, b| volume(a).total_cmp(&volume(b)).then(b.cmp(a)))
}

pub(super) fn centroid(points: &[[f64; 3]]) -> [f64; 3] {
    let n = points.len().max(1) as f64;
    std::array::from_fn(|a| points.iter().map(|p| p[a]).sum::<f64>() / n)
}

pub(super) fn draw(input: &ReportInput, plane: &Plane, centre: [f64; 3]) -> Image {
    let organ = input.anatomy.structures.len() + 1;
    let (mut lo, mut hi) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for p in input.surfaces.iter().take(organ).flat_map(|s| &s.1.vertices) {
        for a in 0..3 {
            lo[a] = lo[a].min(p[a] - MARGIN_MM);
            hi[a] = hi[a].max(p[a] + MARGIN_MM);
        }
    }
    // One scale for the three planes.
    let scale = SIDE_PX / (0..3).map(|a| hi[a] - lo[a]).fold(1.0, f64::max);
    let size = |a: usize| ((hi[a] - lo[a]) * scale).round().clamp(16.0, SIDE_PX) as usize;
    let start = |(a, sign): (usize, f64)| if sign > 0.0 { lo[a] } else { hi[a] };
    let window = Window {
        plane,
        depth: centre[plane.axis],
        scale,
        x0: start(plane.right),
        y0: start(plane.down),
    };
    let (w, h) = (size(plane.right.0), size(plane.down.0));

    let mut image = ground(input, &window, w, h);
    outline_labels(&input.anatomy.regions, &window, &mut image);
    for t in sheets(input.fem) {
        if let Some([a, b]) = window.cut(t) {
            image.line(a, b, 3.4, colour::FEM_LINE, 1.0);
        }
    }
    for (_, mesh) in input.surfaces {
        for t in &mesh.triangles {
            let p = |k: usize| mesh.vertices.get(t[k] as usize).copied();
            if let (Some(a), Some(b), Some(c)) = (p(0), p(1), p(2))
                && let Some([a, b]) = window.cut([a, b, c])
            {
                image.line(a, b, 1.6, colour::SURFACE_LINE, 1.0);
            }
        }
    }
    image.annotate(plane.letters, scale, [1.0; 3], [0.0; 3]);
    image
}

struct Window<'a> {
    plane: &'a Plane,
    depth: f64,
    scale: f64,
    x0: f64,
    y0: f64,
}

impl Window<'_> {
    fn patient(&self, x: f64, y: f64) -> [f64; 3] {
        let mut p = [0.0; 3];
        p[self.plane.axis] = self.depth;
        p[self.plane.right.0] = self.x0 + self.plane.right.1 * x / self.scale;
        p[self.plane.down.0] = self.y0 + self.plane.down.1 * y / self.scale;
        p
    }

    fn pixel(&self, p: [f64; 3]) -> [f64; 2] {
        [
            (p[self.plane.right.0] - self.x0) * self.plane.right.1 * self.scale,
            (p[self.plane.down.0] - self.y0) * self.plane.down.1 * self.scale,
        ]
    }

    /// Where a triangle crosses the plane. Corners on it count as above.
    fn cut(&self, t: [[f64; 3]; 3]) -> Option<[[f64; 2]; 2]> {
        let a = self.plane.axis;
        let above = t.map(|p| p[a] >= self.depth);
        let alone = (0..3).find(|&k| above[k] != above[(k + 1) % 3] && above[k] != above[(k + 2) % 3])?;
        Some([1, 2].map(|step| {
            let (p, q) = (t[alone], t[(alone + step) % 3]);
            let s = (self.depth - p[a]) / (q[a] - p[a]);
            self.pixel(std::array::from_fn(|k| p[k] + s * (q[k] - p[k])))
        }))
    }
}

/// The CT in greys, or the labels where there is none.
fn ground(input: &ReportInput, window: &Window, w: usize, h: usize) -> Image {
    let at = |x: usize, y: usize| window.patient(x as f64 + 0.5, y as f64 + 0.5);
    if let Some((ct, inverse)) = input.ct.and_then(|ct| ct.affine.inverse().map(|i| (ct, i))) {
        return Image::from_pixels(w, h, |x, y| {
            let hu = trilinear(&ct.hu, ct.dims, inverse.apply(at(x, y)));
            [hu.map_or(0.0, |hu| {
                ((hu - WINDOW[0]) / (WINDOW[1] - WINDOW[0])).clamp(0.0, 1.0)
            }); 3]
        });
    }
    let regions = &input.anatomy.regions;
    let inverse = regions.affine.inverse();
    let structures = input.anatomy.structures.len();
    Image::from_pixels(w, h, |x, y| {
        let label = usize::from(label_at(regions, inverse.as_ref(), at(x, y)));
        let grey: f32 = match label {
            0 => 0.10,
            1 => 0.46,
            l if l <= structures + 1 => 0.46 + 0.26 * (l - 1) as f32 / structures as f32,
            _ => 0.26,
        };
        [grey; 3]
    })
}

fn trilinear(values: &[i16], dims: [usize; 3], index: [f64; 3]) -> Option<f32> {
    let mut base = [0usize; 3];
    let mut t = [0.0f32; 3];
    for a in 0..3 {
        if !(index[a] >= -0.5 && index[a] <= dims[a] as f64 - 0.5) {
            return None;
        }
        let x = index[a].clamp(0.0, (dims[a] - 1) as f64);
        base[a] = (x as usize).min(dims[a].saturating_sub(2));
        t[a] = (x - base[a] as f64) as f32;
    }
    let mut sum = 0.0;
    for k in 0..8usize {
        let bit = |a: usize| k >> a & 1;
        let c: [usize; 3] = std::array::from_fn(|a| (base[a] + bit(a)).min(dims[a] - 1));
        let weight: f32 = (0..3)
            .map(|a| if bit(a) == 1 { t[a] } else { 1.0 - t[a] })
            .product();
        sum += weight * f32::from(*values.get(c[0] + dims[0] * (c[1] + dims[1] * c[2]))?);
    }
    Some(sum)
}

fn label_at(regions: &RegionLabels, inverse: Option<&Affine>, p: [f64; 3]) -> u8 {
    let Some(inverse) = inverse else { return 0 };
    let index = inverse.apply(p).map(|v| (v + 0.5).floor());
    if (0..3).any(|a| !(index[a] >= 0.0 && index[a] < regions.dims[a] as f64)) {
        return 0;
    }
    let [i, j, k] = index.map(|v| v as usize);
    regions
        .data
        .get(i + regions.dims[0] * (j + regions.dims[1] * k))
        .copied()
        .unwrap_or(0)
}

/// A thin line along the borders of labelled voxels, as drawn.
fn outline_labels(regions: &RegionLabels, window: &Window, image: &mut Image) {
    let inverse = regions.affine.inverse();
    // Twice the resolution of the picture, one row more on each side.
    let (w, h) = (2 * image.width + 1, 2 * image.height + 1);
    let labels: Vec<u8> = (0..w * h)
        .map(|i| {
            let (x, y) = (i % w, i / w);
            label_at(
                regions,
                inverse.as_ref(),
                window.patient(0.5 * x as f64 + 0.25, 0.5 * y as f64 + 0.25),
            )
        })
        .collect();
    for y in 0..h - 1 {
        for x in 0..w - 1 {
            let here = labels[y * w + x];
            if here != labels[y * w + x + 1] || here != labels[(y + 1) * w + x] {
                image.blend((x / 2) as i64, (y / 2) as i64, colour::LABEL_LINE, 0.5);
            }
        }
    }
}

/// Outer faces of the FEM mesh and faces between its regions.
fn sheets(fem: &TetMesh) -> impl Iterator<Item = [[f64; 3]; 3]> + '_ {
    super::views::faces(fem, |_| true)
        .into_iter()
        .filter(|f| {
            f.other
                .is_none_or(|o| fem.regions.get(o) != fem.regions.get(f.tet))
        })
        .map(|f| f.corners.map(|v| fem.vertices[v as usize]))
}
