//! How exact the image is: its mesh against points that are skinned directly.

use super::{Loaded, Session};
use crate::RehearseError;
use palpate_ultrasound::{Level, Probe, ProbePose, ProbeShape, Scanner, Settings, TissueTable};

/// The image's mesh against skinning, of the first organ as it is now.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageExactness {
    /// Surface vertices compared.
    pub points: usize,
    /// Vertices that the image's mesh does not hold.
    pub outside: usize,
    /// Distance of a vertex skinned directly from where the image shows it, mm: mean, 99 %, most.
    pub distance_mm: [f64; 3],
    /// Largest displacement of a vertex from rest, mm.
    pub moved_mm: f64,
    /// The largest structure's centroid in the image; none without one.
    pub centroid: Option<CentroidError>,
}

/// A structure's area centroid in level 0 images of three planes through it against that of its skinned surface's section;
/// the worst of the three, pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct CentroidError {
    /// Name.
    pub structure: String,
    /// Pixel, mm.
    pub pixel_mm: f64,
    /// At rest: voxels against the smooth surface.
    pub rest_px: f64,
    /// As it is now.
    pub now_px: f64,
    /// What the deformation adds: how much the error changes between the two.
    pub change_px: f64,
}

impl Session {
    /// Compares the image's mesh with skinning as both are after the last step; none where the scene asks for no image.
    /// `packages` are those that the session was made of.
    ///
    /// # Errors
    /// A GPU that was lost; an image that cannot be made.
    pub fn image_exactness(&mut self, packages: &[Loaded]) -> Result<Option<ImageExactness>, RehearseError> {
        self.read_back()?;
        let (Some(imaging), Some(organ), Some(loaded)) =
            (&self.imaging, self.organs.first(), packages.first())
        else {
            return Ok(None);
        };
        let Some(of) = imaging.scanner.organs().first() else {
            return Ok(None);
        };
        let origin = loaded.model.info.local_origin_mm;
        let rest = loaded.model.organ().map_or(&[][..], |s| &s.vertices);
        let now = organ.to_local(&organ.surface.mesh.vertices);
        let mesh = &organ.embedding_local;
        let wide = |p: [f32; 3]| [0, 1, 2].map(|a| f64::from(p[a]) + origin[a]);
        let (mut apart, mut outside, mut moved) = (Vec::new(), 0, 0.0f64);
        for (&x, &y) in rest.iter().zip(&now) {
            moved = moved.max(distance(wide(x), wide(y)));
            match of.deform_point(mesh, wide(x)) {
                Some(p) => apart.push(distance(p, wide(y))),
                None => outside += 1,
            }
        }
        apart.sort_by(f64::total_cmp);
        let at = |share: f64| {
            let n = (share * apart.len() as f64).ceil() as usize;
            apart.get(n.saturating_sub(1)).copied().unwrap_or(f64::NAN)
        };
        let mean = apart.iter().sum::<f64>() / apart.len().max(1) as f64;
        let pixel_mm = imaging.scanner.grid().pixel_mm;
        let largest = organ
            .structures
            .iter()
            .max_by_key(|s| (s.mesh.vertices.len(), std::cmp::Reverse(s.name.as_str())));
        let centroid = match largest {
            None => None,
            Some(s) => {
                let at_rest = loaded.model.structures().find(|r| r.name == s.name);
                let at_rest = at_rest.map_or(&[][..], |r| &r.vertices);
                let place = |v: &[[f32; 3]]| v.iter().map(|&p| wide(p)).collect::<Vec<_>>();
                let shapes = [place(at_rest), place(&organ.to_local(&s.mesh.vertices))];
                let meshes = [of.rest_vertices(), mesh.as_slice()];
                centroid(of, &s.name, pixel_mm, meshes, &shapes, &s.mesh.triangles)?
            }
        };
        Ok(Some(ImageExactness {
            points: apart.len(),
            outside,
            distance_mm: [mean, at(0.99), at(1.0)],
            moved_mm: moved,
            centroid,
        }))
    }
}

/// In images of about `pixel_mm`. At rest and now: the meshes' vertices (local mm) and the structure's surface (patient mm).
fn centroid(
    organ: &palpate_ultrasound::Organ,
    name: &str,
    pixel_mm: f64,
    meshes: [&[[f32; 3]]; 2],
    shapes: &[Vec<[f64; 3]>; 2],
    triangles: &[[u32; 3]],
) -> Result<Option<CentroidError>, RehearseError> {
    let Some(code) = organ.label_names().iter().position(|l| l == name) else {
        return Ok(None);
    };
    if shapes.iter().any(Vec::is_empty) {
        return Ok(None);
    }
    let middles = shapes.each_ref().map(|s| middle(s));
    let reach = shapes
        .iter()
        .zip(middles)
        .flat_map(|(s, m)| s.iter().map(move |&p| distance(p, m)));
    let reach = 1.05 * reach.fold(0.0, f64::max) + 1.0;
    // The scene's pixels, as many as hold the structure.
    let pixels = (2.0 * reach / pixel_mm).ceil().clamp(16.0, 8192.0);
    let size = (pixels * pixel_mm).max(2.0 * reach);
    let probe = Probe {
        shape: ProbeShape::Linear { width_mm: size },
        depth_mm: size,
        ..Probe::default()
    };
    let settings = Settings {
        level: Level::Slice,
        width_px: pixels as usize,
        height_px: pixels as usize,
        ..Settings::default()
    };
    let mut scanner = Scanner::new(vec![organ.clone()], &TissueTable::default(), probe, settings)?;
    let pixel_mm = scanner.grid().pixel_mm;
    let mut worst = [0.0f64; 3];
    for lateral in [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0]] {
        let mut errors = [[0.0; 2]; 2];
        for n in 0..2 {
            let mut pose = ProbePose::looking(middles[n], [0.0, -1.0, 0.0], lateral)?;
            pose.face_mm = pose.point(0.0, -0.5 * size, 0.0);
            let image = scanner.slice(&[meshes[n]], &pose)?;
            let (mut sum, mut count) = ([0.0; 2], 0.0);
            let width = image.grid().width_px;
            for (k, &label) in image.labels().iter().enumerate() {
                if usize::from(label) == code + 1 {
                    sum[0] += (k % width) as f64;
                    sum[1] += (k / width) as f64;
                    count += 1.0;
                }
            }
            let flat: Vec<[f64; 3]> = shapes[n]
                .iter()
                .map(|&p| {
                    let (pixel, off) = image.pixel_of(p);
                    [pixel[0], pixel[1], off]
                })
                .collect();
            let Some(want) = section(&flat, triangles).filter(|_| count > 0.0) else {
                return Ok(None);
            };
            errors[n] = [0, 1].map(|a| sum[a] / count - want[a]);
        }
        let [rest, now] = errors;
        worst[0] = worst[0].max(rest[0].hypot(rest[1]));
        worst[1] = worst[1].max(now[0].hypot(now[1]));
        worst[2] = worst[2].max((now[0] - rest[0]).hypot(now[1] - rest[1]));
    }
    Ok(Some(CentroidError {
        structure: name.into(),
        pixel_mm,
        rest_px: worst[0],
        now_px: worst[1],
        change_px: worst[2],
    }))
}

/// Area centroid of a closed surface's section by the plane where the third coordinate is 0: sums over the section's directed
/// edges. None where it does not cut.
fn section(points: &[[f64; 3]], triangles: &[[u32; 3]]) -> Option<[f64; 2]> {
    let (mut twice, mut first) = (0.0, [0.0; 2]);
    for t in triangles {
        let [Some(&a), Some(&b), Some(&c)] = t.map(|v| points.get(v as usize)) else {
            continue;
        };
        let p = [a, b, c];
        let (mut from, mut to) = (None, None);
        for (i, j) in [(0, 1), (1, 2), (2, 0)] {
            let (up, next) = (p[i][2] >= 0.0, p[j][2] >= 0.0);
            if up == next {
                continue;
            }
            let s = p[i][2] / (p[i][2] - p[j][2]);
            let cut = [0, 1].map(|a| p[i][a] + s * (p[j][a] - p[i][a]));
            if up {
                from = Some(cut);
            } else {
                to = Some(cut);
            }
        }
        if let (Some(a), Some(b)) = (from, to) {
            let cross = a[0] * b[1] - a[1] * b[0];
            twice += cross;
            for k in 0..2 {
                first[k] += (a[k] + b[k]) * cross / 3.0;
            }
        }
    }
    (twice.abs() > 0.0).then(|| first.map(|v| v / twice))
}

/// Middle of the bounding box.
fn middle(points: &[[f64; 3]]) -> [f64; 3] {
    [0, 1, 2].map(|a| {
        let (lo, hi) = points
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), p| {
                (lo.min(p[a]), hi.max(p[a]))
            });
        0.5 * (lo + hi)
    })
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|n| (a[n] - b[n]).powi(2)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::ball;
    use glam::Vec3;

    #[test]
    fn the_section_of_a_ball_is_a_circle_around_its_centre() {
        let ball = ball(Vec3::new(7.0, -3.0, 4.0), 10.0, 60);
        let points: Vec<[f64; 3]> = ball.vertices.iter().map(|p| p.map(f64::from)).collect();
        let at = section(&points, &ball.triangles).unwrap();
        assert!((at[0] - 7.0).abs() < 1e-3 && (at[1] + 3.0).abs() < 1e-3, "{at:?}");
        let far: Vec<[f64; 3]> = points.iter().map(|p| [p[0], p[1], p[2] + 20.0]).collect();
        assert_eq!(section(&far, &ball.triangles), None);
    }
}
