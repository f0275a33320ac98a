use super::points::{finite, same_length, unit};
use crate::check::{Found, Sink};
use crate::model::Surface;
use crate::vector::{self, cross, dot, sub};
use crate::{PackageError, topology};

/// Smaller triangles have no usable normal in f32, mm².
const MIN_AREA_MM2: f64 = 1e-8;
/// Inner shells beyond this many are refused instead of located.
const MAX_SHELLS: usize = 64;

pub(super) fn check(s: &Surface, folder: &str, sink: &mut Sink) -> Result<bool, PackageError> {
    let vertices = format!("{folder}/vertices.npy");
    let triangles = format!("{folder}/triangles.npy");
    let mut sound = sink.check("positions are finite", &vertices, || {
        finite(&vertices, &s.vertices)
    })?;
    sound &= sink.check("triangles are in range and not degenerate", &triangles, || {
        if s.triangles.is_empty() {
            return Err(PackageError::invalid(
                &triangles,
                "shape",
                "no triangles",
                "a closed surface",
            ));
        }
        topology::check_rows(&triangles, &s.triangles, s.vertices.len(), "vertices")?;
        areas(&triangles, s)
    })?;
    if let Some(n) = &s.normals {
        let entry = format!("{folder}/normals.npy");
        sink.check("normals are unit vectors", &entry, || {
            same_length(&entry, n.len(), s.vertices.len(), "vertices")?;
            unit(&entry, n)
        })?;
    }
    if !s.caps.is_empty() {
        let (points, normals) = (
            format!("{folder}/cap_points.npy"),
            format!("{folder}/cap_normals.npy"),
        );
        sink.check("border caps are planes", &normals, || {
            finite(&points, &s.caps.iter().map(|c| c.point).collect::<Vec<_>>())?;
            unit(&normals, &s.caps.iter().map(|c| c.normal).collect::<Vec<_>>())
        })?;
    }
    if !sound {
        return Ok(false);
    }
    let manifold = sink.check("surface is closed and 2-manifold", &triangles, || {
        edges(&triangles, &s.triangles)?;
        fans(&triangles, &s.triangles, s.vertices.len(), true)?;
        Ok(Found::figure(s.triangles.len() as f64).named("triangles"))
    })?;
    Ok(manifold && sink.check("surface faces outward", &triangles, || outward(&triangles, s))?)
}

fn point(s: &Surface, v: u32) -> [f64; 3] {
    vector::point(s.vertices[v as usize])
}

fn areas(entry: &str, s: &Surface) -> Result<Found, PackageError> {
    let mut worst = f64::INFINITY;
    for (i, t) in s.triangles.iter().enumerate() {
        let [a, b, c] = t.map(|v| point(s, v));
        let n = cross(sub(b, a), sub(c, a));
        let area = 0.5 * dot(n, n).sqrt();
        if area < MIN_AREA_MM2 {
            return Err(PackageError::invalid(
                entry,
                format!("triangle {i} {t:?}"),
                format!("area {area:e} mm²"),
                "an area above 1e-8 mm²",
            ));
        }
        worst = worst.min(area);
    }
    Ok(Found::worst(worst, "mm², at least 1e-8"))
}

/// Each edge must be run through once in each direction.
fn edges(entry: &str, triangles: &[[u32; 3]]) -> Result<(), PackageError> {
    let mut halves: Vec<(u32, u32, bool, u32)> = Vec::with_capacity(3 * triangles.len());
    for (i, t) in triangles.iter().enumerate() {
        for k in 0..3 {
            let (a, b) = (t[k], t[(k + 1) % 3]);
            halves.push((a.min(b), a.max(b), a > b, i as u32));
        }
    }
    halves.sort_unstable();
    let mut i = 0;
    while i < halves.len() {
        let h = halves[i];
        let same = halves[i..]
            .iter()
            .take_while(|o| (o.0, o.1) == (h.0, h.1))
            .count();
        if same != 2 || halves[i].2 == halves[i + 1].2 {
            let found = match same {
                1 => "an open edge".to_string(),
                2 => "two triangles that run through it the same way".to_string(),
                n => format!("{n} triangles"),
            };
            return Err(PackageError::invalid(
                entry,
                format!("triangle {}, edge {}–{}", h.3, h.0, h.1),
                found,
                "two triangles, one in each direction",
            ));
        }
        i += same;
    }
    Ok(())
}

/// The triangles around each vertex must form one closed fan. Edges must be manifold already.
fn fans(entry: &str, triangles: &[[u32; 3]], vertices: usize, all_used: bool) -> Result<(), PackageError> {
    // Per vertex the pairs (next, previous) of its triangles, sorted: each `next` appears once.
    let mut corners: Vec<(u32, u32, u32)> = Vec::with_capacity(3 * triangles.len());
    for t in triangles {
        for k in 0..3 {
            corners.push((t[k], t[(k + 1) % 3], t[(k + 2) % 3]));
        }
    }
    corners.sort_unstable();
    let mut at = 0;
    for v in 0..vertices as u32 {
        let count = corners[at..].iter().take_while(|c| c.0 == v).count();
        let fan = &corners[at..at + count];
        at += count;
        let Some(first) = fan.first() else {
            if !all_used {
                continue;
            }
            return Err(PackageError::invalid(
                entry,
                format!("vertex {v}"),
                "no triangle",
                "each vertex in at least three",
            ));
        };
        let (mut steps, mut next) = (1, first.2);
        while next != first.1 && steps <= count {
            match fan.binary_search_by_key(&next, |c| c.1) {
                Ok(i) => next = fan[i].2,
                Err(_) => break,
            }
            steps += 1;
        }
        if steps != count {
            return Err(PackageError::invalid(
                entry,
                format!("vertex {v}"),
                format!("{count} triangles in more than one fan"),
                "one closed fan",
            ));
        }
    }
    Ok(())
}

/// Closed and 2-manifold, with vertices that no triangle uses left aside.
pub(crate) fn check_closed(entry: &str, triangles: &[[u32; 3]], vertices: usize) -> Result<(), PackageError> {
    edges(entry, triangles)?;
    fans(entry, triangles, vertices, false)
}

/// Pieces must enclose positive volume; a negative one must be the inner wall of a hollow body.
fn outward(entry: &str, s: &Surface) -> Result<Found, PackageError> {
    let pieces = pieces(&s.triangles, s.vertices.len());
    let count = pieces.iter().copied().max().map_or(0, |m| m as usize + 1);
    let mut volumes = vec![0.0f64; count];
    let mut first = vec![0usize; count];
    // Measured from one of the surface's own vertices, so that distance from the origin costs no digits.
    let o = s.triangles.first().map_or([0.0; 3], |t| point(s, t[0]));
    for (i, t) in s.triangles.iter().enumerate().rev() {
        let [a, b, c] = t.map(|v| sub(point(s, v), o));
        volumes[pieces[i] as usize] += dot(a, cross(b, c)) / 6.0;
        first[pieces[i] as usize] = i;
    }
    let inner: Vec<usize> = (0..count).filter(|&p| volumes[p] <= 0.0).collect();
    for (n, &p) in inner.iter().enumerate() {
        let x = point(s, s.triangles[first[p]][0]);
        if n >= MAX_SHELLS || winding(s, &pieces, p as u32, x) < 0.5 {
            return Err(PackageError::invalid(
                entry,
                format!("the piece with triangle {}", first[p]),
                format!("volume {} mm³", volumes[p]),
                "triangles counter-clockwise seen from outside",
            ));
        }
    }
    let total: f64 = volumes.iter().sum();
    if total <= 0.0 {
        return Err(PackageError::invalid(
            entry,
            "all",
            format!("volume {total} mm³"),
            "a positive volume",
        ));
    }
    Ok(Found::worst(total, "mm³, above 0"))
}

/// Connected piece of each triangle, numbered by first appearance.
pub(crate) fn pieces(triangles: &[[u32; 3]], vertices: usize) -> Vec<u32> {
    let mut parent: Vec<u32> = (0..vertices as u32).collect();
    fn root(parent: &mut [u32], mut v: u32) -> u32 {
        while parent[v as usize] != v {
            parent[v as usize] = parent[parent[v as usize] as usize];
            v = parent[v as usize];
        }
        v
    }
    for t in triangles {
        for k in 1..3 {
            let (a, b) = (root(&mut parent, t[0]), root(&mut parent, t[k]));
            parent[a.max(b) as usize] = a.min(b);
        }
    }
    let mut number = vec![u32::MAX; vertices];
    let mut count = 0;
    triangles
        .iter()
        .map(|t| {
            let n = &mut number[root(&mut parent, t[0]) as usize];
            if *n == u32::MAX {
                *n = count;
                count += 1;
            }
            *n
        })
        .collect()
}

/// Winding number of all pieces but `skip` around `x`: the sum of the triangles' solid angles over 4π.
fn winding(s: &Surface, pieces: &[u32], skip: u32, x: [f64; 3]) -> f64 {
    let mut sum = 0.0;
    for (t, _) in s.triangles.iter().zip(pieces).filter(|(_, p)| **p != skip) {
        let [a, b, c] = t.map(|v| sub(point(s, v), x));
        let (la, lb, lc) = (dot(a, a).sqrt(), dot(b, b).sqrt(), dot(c, c).sqrt());
        let det = dot(a, cross(b, c));
        sum += 2.0 * det.atan2(la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb);
    }
    sum / (4.0 * std::f64::consts::PI)
}
