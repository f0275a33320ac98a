use super::{Camera, Item, Material, Mesh, Picture, Rgb, TextSize, View3d, ball, draw_view, rgb, ribbon};
use glam::Vec3;

const GROUND: [Rgb; 2] = [rgb(0x39434f), rgb(0x14181d)];
const PANEL: Rgb = rgb(0x0c0e11);
const INK: Rgb = rgb(0xe8ebee);
const FAINT: Rgb = rgb(0x96a0aa);
const CAUTION: Rgb = rgb(0xf0b45a);
const ORGAN: Rgb = rgb(0xb4564c);
const SUPPORT: Rgb = rgb(0x8d9aa6);
const INSTRUMENT: Rgb = rgb(0xd9dde1);
const NEEDLE: Rgb = rgb(0xcfefff);
const TARGET: Rgb = rgb(0xff5a4d);
const FIDUCIAL: Rgb = rgb(0xf6e27a);
const PLANE: Rgb = rgb(0x4fc3f7);
/// Before every cut face, mm.
const IN_FRONT_MM: f32 = 1e4;
/// Colours of structures, in the package's order: as many as packages have, or a lesion in the sixth place has the colour of the gland around it.
const STRUCTURES: [Rgb; 12] = [
    rgb(0xe8c15a),
    rgb(0x5b8bd8),
    rgb(0x6fbf8b),
    rgb(0xb58ad0),
    rgb(0xd98fb0),
    rgb(0x7a3b1e),
    rgb(0xe9e2d0),
    rgb(0x2f6f7a),
    rgb(0xe07b2e),
    rgb(0x8a9a3a),
    rgb(0x4b4a8f),
    rgb(0x9fd6df),
];

/// A grey image with its size in the patient.
#[derive(Clone, Copy, Debug)]
pub struct GreyImage<'a> {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// One byte per pixel, row by row from the top (the probe's face).
    pub grey: &'a [u8],
    /// Width, mm.
    pub width_mm: f64,
    /// Depth, mm.
    pub depth_mm: f64,
}

/// What the 3-D view shows, in one frame of mm.
#[derive(Clone, Debug, Default)]
pub struct SceneGeometry<'a> {
    /// Organs.
    pub organs: Vec<&'a Mesh>,
    /// Structures, in order.
    pub structures: Vec<&'a Mesh>,
    /// Supports.
    pub supports: Vec<&'a Mesh>,
    /// Instruments.
    pub instruments: Vec<Mesh>,
    /// Needles.
    pub needles: Vec<Mesh>,
    /// What needles aim at.
    pub targets: Vec<[f32; 3]>,
    /// Points that are followed.
    pub fiducials: &'a [[f32; 3]],
    /// Corners of the scan plane in order round it.
    pub plane: Option<[Vec3; 4]>,
    /// Height of a cut towards the viewer from the camera's centre, mm: organs, structures and supports are cut open there, needles
    /// and targets show whole, points that are followed not at all.
    pub cut_mm: Option<f32>,
}

/// What is written beside the picture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrameText {
    /// Title.
    pub title: String,
    /// Lines below the image.
    pub lines: Vec<String>,
    /// What the reader must know about the figures; empty: nothing.
    pub caution: String,
    /// Heading of the image.
    pub image: String,
}

/// A frame: the 3-D view of the camera's size at the left, the image and the text beside it.
pub fn draw_frame(
    scene: &SceneGeometry,
    camera: &Camera,
    organ_opacity: f32,
    image: Option<GreyImage>,
    text: &FrameText,
    width: usize,
    height: usize,
) -> Picture {
    let mut out = Picture::new(width, height, PANEL);
    view(scene, camera, organ_opacity, &mut out);
    letters(camera, &mut out);
    out.text(&text.title, 16, 12, TextSize::Large, INK);
    panel(camera.width.min(width), image, text, &mut out);
    out
}

fn item(mesh: &Mesh, material: Material) -> Item<'_> {
    Item {
        vertices: &mesh.vertices,
        normals: &mesh.normals,
        triangles: &mesh.triangles,
        material,
    }
}

fn view(scene: &SceneGeometry, camera: &Camera, organ_opacity: f32, out: &mut Picture) {
    // One pixel is this wide.
    let px_mm = 1.0 / camera.px_per_mm.max(1e-6);
    let beads_of = |points: &[[f32; 3]], radius: f32| {
        let mut beads = Mesh::default();
        for &p in points {
            let b = ball(p.into(), radius, 8);
            let base = beads.vertices.len() as u32;
            beads.vertices.extend(b.vertices);
            beads.normals.extend(b.normals);
            beads
                .triangles
                .extend(b.triangles.iter().map(|t| t.map(|v| v + base)));
        }
        beads
    };
    let cut = scene.cut_mm.map(|_| 1.0);
    let beads = match cut {
        None => beads_of(scene.fiducials, (3.2 * px_mm).max(0.75)),
        Some(_) => Mesh::default(),
    };
    let targets = beads_of(
        &scene.targets,
        match cut {
            None => (4.5 * px_mm).max(1.2),
            Some(_) => 4.0 * px_mm,
        },
    );
    let plane = scene.plane.map(|c| {
        let ring = [c[0], c[1], c[2], c[3], c[0]];
        ribbon(&ring, 2.0 * px_mm, camera.toward)
    });
    let tool = Material {
        sharp: true,
        shine: 0.12,
        ..Material::plain(INSTRUMENT)
    };
    let support = Material {
        shine: 0.0,
        opacity: 0.3,
        cut: cut.map(|_| 0.55),
        ..Material::plain(SUPPORT)
    };
    let mut shown = View3d {
        ground: GROUND,
        cut_mm: scene.cut_mm,
        ..View3d::default()
    };
    // A needle shows in what it is pushed into.
    let pierced = !scene.needles.is_empty();
    let ranks = ranks(&scene.structures);
    let structures = scene.structures.iter().enumerate().map(|(i, m)| {
        let colour = STRUCTURES[i % STRUCTURES.len()];
        let opacity = if pierced { 0.4 } else { 1.0 };
        item(
            m,
            Material {
                opacity,
                cut,
                // Where it lies on the organ's surface; of cut faces, all in one plane, the smaller structure's is over the larger's.
                lift_mm: 0.5 + 0.01 * ranks[i] as f32,
                ..Material::plain(colour)
            },
        )
    });
    match pierced {
        true => shown.veils.extend(structures),
        false => shown.opaque.extend(structures),
    }
    shown.opaque.push(item(&beads, Material::plain(FIDUCIAL)));
    shown
        .opaque
        .extend(scene.instruments.iter().map(|m| item(m, tool)));
    let needle = Material {
        shine: 0.6,
        lift_mm: IN_FRONT_MM,
        ..Material::plain(NEEDLE)
    };
    let target = Material {
        lift_mm: IN_FRONT_MM - 1.0,
        ..Material::plain(TARGET)
    };
    let whole = match cut {
        Some(_) => &mut shown.veils,
        None => &mut shown.opaque,
    };
    whole.extend(scene.needles.iter().map(|m| item(m, needle)));
    whole.push(item(&targets, target));
    if let Some(p) = &plane {
        let line = Material {
            lit: false,
            two_sided: true,
            ..Material::plain(PLANE)
        };
        shown.opaque.push(item(p, line));
    }
    shown.veils.extend(scene.organs.iter().map(|m| {
        item(
            m,
            Material {
                opacity: organ_opacity,
                shine: 0.35,
                cut,
                ..Material::plain(ORGAN)
            },
        )
    }));
    shown
        .veils
        .extend(scene.supports.iter().map(|m| item(m, support)));
    draw_view(&shown, camera, out, 0);
}

/// How many structures are larger, of each.
fn ranks(structures: &[&Mesh]) -> Vec<usize> {
    let size = |m: &&Mesh| {
        let ends = m
            .vertices
            .iter()
            .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), &p| {
                (lo.min(p.into()), hi.max(p.into()))
            });
        (ends.1 - ends.0).length()
    };
    let sizes: Vec<f32> = structures.iter().map(size).collect();
    let mut order: Vec<usize> = (0..sizes.len()).collect();
    order.sort_by(|&a, &b| sizes[b].total_cmp(&sizes[a]));
    let mut ranks = vec![0; sizes.len()];
    order.iter().enumerate().for_each(|(rank, &i)| ranks[i] = rank);
    ranks
}

/// Patient directions at the edges of the view, and a scale bar.
fn letters(camera: &Camera, out: &mut Picture) {
    let (w, h) = (camera.width as f32, camera.height as f32);
    for (letter, [x, y], share) in camera.letters() {
        if share < 0.5 {
            continue;
        }
        // Where the ray from the middle meets the border.
        let t = ((0.5 * w - 20.0) / x.abs().max(1e-6)).min((0.5 * h - 20.0) / y.abs().max(1e-6));
        let at = [(0.5 * w + t * x) as i64 - 6, (0.5 * h + t * y) as i64 - 12];
        out.text(&letter.to_string(), at[0], at[1], TextSize::Medium, FAINT);
    }
    let fits = |mm: &f32| mm * camera.px_per_mm <= 0.22 * w;
    let mm = [100.0, 50.0, 20.0, 10.0, 5.0]
        .into_iter()
        .find(fits)
        .unwrap_or(1.0);
    let length = (mm * camera.px_per_mm) as usize;
    let y = camera.height.saturating_sub(26);
    out.rectangle(18, y, length, 2, INK);
    for x in [18, 16 + length] {
        out.rectangle(x, y.saturating_sub(4), 2, 10, INK);
    }
    out.text(&format!("{mm} mm"), 18, y as i64 - 22, TextSize::Small, INK);
}

fn panel(left: usize, image: Option<GreyImage>, text: &FrameText, out: &mut Picture) {
    let (x0, width) = (left + 20, out.width.saturating_sub(left + 40));
    if width < 40 {
        return;
    }
    let mut y = 16;
    if let Some(image) = image {
        out.text(&text.image, x0 as i64, y as i64, TextSize::Small, FAINT);
        y += 26;
        let room = out.height.saturating_sub(y + 28 * (text.lines.len() + 2)).max(32);
        let scale = (width as f64 / image.width_mm).min(room as f64 / image.depth_mm);
        let (w, h) = (
            (image.width_mm * scale) as usize,
            (image.depth_mm * scale) as usize,
        );
        let x = x0 + (width - w.min(width)) / 2;
        stretch(&image, x, y, w, h, out);
        // A tick each 10 mm of depth.
        let mut depth = 0.0;
        while depth <= image.depth_mm + 1e-9 {
            let long = (depth / 50.0).fract() == 0.0;
            let row = y + ((depth * scale) as usize).min(h.saturating_sub(1));
            out.rectangle(x + w + 3, row, if long { 10 } else { 5 }, 1, FAINT);
            depth += 10.0;
        }
        y += h + 14;
    }
    for line in &text.lines {
        out.text(line, x0 as i64, y as i64, TextSize::Medium, INK);
        y += 27;
    }
    if !text.caution.is_empty() {
        out.text(&text.caution, x0 as i64, y as i64 + 2, TextSize::Small, CAUTION);
    }
}

/// The image in a rectangle, bilinear.
fn stretch(image: &GreyImage, left: usize, top: usize, width: usize, height: usize, out: &mut Picture) {
    if image.grey.len() < image.width * image.height || image.width == 0 || image.height == 0 {
        return;
    }
    let axis = |n: usize, to: usize| -> Vec<(usize, usize, f32)> {
        (0..to)
            .map(|i| {
                let p = ((i as f32 + 0.5) * n as f32 / to as f32 - 0.5).clamp(0.0, (n - 1) as f32);
                let a = p as usize;
                (a, (a + 1).min(n - 1), p - a as f32)
            })
            .collect()
    };
    let columns = axis(image.width, width);
    for (dy, (y0, y1, fy)) in axis(image.height, height).into_iter().enumerate() {
        let y = top + dy;
        if y >= out.height {
            break;
        }
        let (upper, lower) = (&image.grey[y0 * image.width..], &image.grey[y1 * image.width..]);
        for (dx, &(x0, x1, fx)) in columns.iter().enumerate() {
            if left + dx >= out.width {
                break;
            }
            let row = |r: &[u8]| f32::from(r[x0]) * (1.0 - fx) + f32::from(r[x1]) * fx;
            let v = (row(upper) * (1.0 - fy) + row(lower) * fy + 0.5) as u8;
            let at = 3 * (y * out.width + left + dx);
            out.pixels[at..at + 3].fill(v);
        }
    }
}
