use super::Mesh;
use glam::Vec3;

/// A ball of `rings` rows of quads.
pub fn ball(centre: Vec3, radius_mm: f32, rings: u32) -> Mesh {
    capsule(centre, Vec3::Z, 0.0, radius_mm, rings)
}

/// Everything within the radius of a segment of twice `half_length_mm` along `axis` (unit).
pub fn capsule(centre: Vec3, axis: Vec3, half_length_mm: f32, radius_mm: f32, rings: u32) -> Mesh {
    let axis = axis.normalize_or(Vec3::Z);
    let (u, v) = axis.any_orthonormal_pair();
    // An even number of rows: the two halves part at the equator.
    let rows = (rings.max(4) / 2) * 2;
    let around = 2 * rows;
    let mut out = Mesh::default();
    for i in 0..=rows + 1 {
        let (row, shift) = if i <= rows / 2 {
            (i, -half_length_mm)
        } else {
            (i - 1, half_length_mm)
        };
        let polar = std::f32::consts::PI * row as f32 / rows as f32;
        for j in 0..around {
            let turn = std::f32::consts::TAU * j as f32 / around as f32;
            let n = (u * turn.cos() + v * turn.sin()) * polar.sin() - axis * polar.cos();
            out.vertices
                .push((centre + axis * shift + n * radius_mm).to_array());
            out.normals.push(n.normalize_or(axis).to_array());
        }
    }
    for i in 0..=rows {
        for j in 0..around {
            let at = |i: u32, j: u32| i * around + j % around;
            let (a, b, c, d) = (at(i, j), at(i, j + 1), at(i + 1, j + 1), at(i + 1, j));
            out.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    out
}

/// The body where n·x ≤ d for all rows (nx, ny, nz, d), flat faces with their own vertices. What reaches beyond 1 m is cut
/// there.
pub fn polytope(planes: &[[f64; 4]]) -> Mesh {
    const REACH_MM: f32 = 1000.0;
    let unit: Vec<(Vec3, f32)> = planes
        .iter()
        .filter_map(|p| {
            let n = Vec3::new(p[0] as f32, p[1] as f32, p[2] as f32);
            let length = n.length();
            (length > 0.0).then(|| (n / length, p[3] as f32 / length))
        })
        .collect();
    let mut out = Mesh::default();
    for (i, &(n, d)) in unit.iter().enumerate() {
        let (u, v) = n.any_orthonormal_pair();
        let foot = n * d;
        // Counter-clockwise seen from outside.
        let mut face: Vec<Vec3> = [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)]
            .map(|(a, b)| foot + (u * a + v * b) * REACH_MM)
            .to_vec();
        if u.cross(v).dot(n) < 0.0 {
            face.reverse();
        }
        for (j, &(m, e)) in unit.iter().enumerate() {
            // Of equal planes the first makes the face.
            let same = m.dot(n) > 1.0 - 1e-6 && (e - d).abs() < 1e-4;
            if j != i && !(same && j > i) {
                face = clip(&face, m, if same { e - 1.0 } else { e });
            }
        }
        if face.len() < 3 {
            continue;
        }
        let base = out.vertices.len() as u32;
        out.triangles
            .extend((1..face.len() as u32 - 1).map(|k| [base, base + k, base + k + 1]));
        out.normals.extend(face.iter().map(|_| n.to_array()));
        out.vertices.extend(face.iter().map(|p| p.to_array()));
    }
    out
}

/// The part of a convex polygon where n·x ≤ d.
fn clip(polygon: &[Vec3], n: Vec3, d: f32) -> Vec<Vec3> {
    let mut out = Vec::with_capacity(polygon.len() + 1);
    for (k, &p) in polygon.iter().enumerate() {
        let q = polygon[(k + 1) % polygon.len()];
        let (a, b) = (n.dot(p) - d, n.dot(q) - d);
        if a <= 0.0 {
            out.push(p);
        }
        if (a < 0.0 && b > 0.0) || (a > 0.0 && b < 0.0) {
            out.push(p + (q - p) * (a / (a - b)));
        }
    }
    out
}

/// A line as a flat band that faces the viewer.
pub fn ribbon(points: &[Vec3], width_mm: f32, toward: Vec3) -> Mesh {
    let mut out = Mesh::default();
    for pair in points.windows(2) {
        let side = (pair[1] - pair[0]).cross(toward).normalize_or_zero() * (0.5 * width_mm);
        let along = (pair[1] - pair[0]).normalize_or_zero() * (0.5 * width_mm);
        let base = out.vertices.len() as u32;
        let corners = [
            pair[0] - side - along,
            pair[0] + side - along,
            pair[1] + side + along,
            pair[1] - side + along,
        ];
        out.vertices.extend(corners.map(|p| p.to_array()));
        out.normals.extend([toward.to_array(); 4]);
        out.triangles
            .extend([[base, base + 1, base + 2], [base, base + 2, base + 3]]);
    }
    out
}

/// A tube of `sides` sides around a line, with a pointed end of two radii at its last point.
pub fn tube(line: &[Vec3], radius_mm: f32, sides: u32) -> Mesh {
    let mut out = Mesh::default();
    let (Some(&first), Some(&last)) = (line.first(), line.last()) else {
        return out;
    };
    let sides = sides.max(3);
    let mut across = (line.get(1).copied().unwrap_or(first) - first)
        .normalize_or(Vec3::Z)
        .any_orthonormal_vector();
    let mut ring = |at: Vec3, tangent: Vec3, radius: f32| {
        across = (across - tangent * tangent.dot(across)).normalize_or(tangent.any_orthonormal_vector());
        let other = tangent.cross(across);
        for k in 0..sides {
            let turn = std::f32::consts::TAU * k as f32 / sides as f32;
            let n = across * turn.cos() + other * turn.sin();
            out.vertices.push((at + n * radius).to_array());
            out.normals.push(n.to_array());
        }
    };
    for (k, &p) in line.iter().enumerate() {
        let before = k.checked_sub(1).map_or(p, |k| line[k]);
        let after = line.get(k + 1).copied().unwrap_or(p);
        let tangent = (after - before).normalize_or(Vec3::Z);
        if k + 1 == line.len() {
            // The point is at the end of the line.
            let back = (2.0 * radius_mm).min(0.5 * p.distance(before));
            ring(p - tangent * back, tangent, radius_mm);
        } else {
            ring(p, tangent, radius_mm);
        }
    }
    let tip = out.vertices.len() as u32;
    out.vertices.push(last.to_array());
    let before = line.len().checked_sub(2).map_or(first, |k| line[k]);
    out.normals.push((last - before).normalize_or(Vec3::Z).to_array());
    for k in 0..line.len() as u32 {
        for j in 0..sides {
            let (a, b) = (k * sides + j, k * sides + (j + 1) % sides);
            if k + 1 == line.len() as u32 {
                out.triangles.push([a, b, tip]);
            } else {
                out.triangles
                    .extend([[a, b, b + sides], [a, b + sides, a + sides]]);
            }
        }
    }
    out
}
