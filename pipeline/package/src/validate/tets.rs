use super::points::finite;
use crate::check::{Found, Sink};
use crate::vector::volume6;
use crate::{PackageError, topology};

/// Six times the volume over the cube of the longest edge: 1/√2 = 0.71 for a regular tet, about 10⁻² at the worst
/// angles that meshing allows. Below this the tet's rest shape cannot be inverted in f32.
const MIN_SHAPE: f64 = 1e-6;

/// Checks one tet mesh; true where it holds.
pub(super) fn check(
    folder: &str,
    vertices: &[[f32; 3]],
    tets: &[[u32; 4]],
    sink: &mut Sink,
) -> Result<bool, PackageError> {
    let (points, entry) = (format!("{folder}/vertices.npy"), format!("{folder}/tets.npy"));
    let positions = sink.check("positions are finite", &points, || finite(&points, vertices))?;
    let indices = sink.check("tets use every vertex and no other", &entry, || {
        if tets.is_empty() {
            return Err(PackageError::invalid(&entry, "shape", "no tets", "at least one"));
        }
        topology::check_rows(&entry, tets, vertices.len(), "vertices")?;
        let mut used = vec![false; vertices.len()];
        for &v in tets.iter().flatten() {
            used[v as usize] = true;
        }
        match used.iter().position(|u| !u) {
            Some(v) => Err(PackageError::invalid(
                &entry,
                format!("vertex {v}"),
                "in no tet",
                "in at least one",
            )),
            None => Ok(Found::figure(tets.len() as f64).named("tets")),
        }
    })?;
    if !(positions && indices) {
        return Ok(false);
    }
    let volumes = sink.check("tet volumes are positive", &entry, || {
        shapes(&entry, vertices, tets)
    })?;
    Ok(
        sink.check("faces join at most two tets, one on each side", &entry, || {
            faces(&entry, tets)
        })? && volumes,
    )
}

fn longest(vertices: &[[f32; 3]], t: &[u32; 4]) -> f64 {
    let mut most = 0.0f64;
    for i in 0..4 {
        for j in i + 1..4 {
            let (p, q) = (vertices[t[i] as usize], vertices[t[j] as usize]);
            most = most.max((0..3).map(|a| (f64::from(p[a]) - f64::from(q[a])).powi(2)).sum());
        }
    }
    most.sqrt()
}

fn shapes(entry: &str, vertices: &[[f32; 3]], tets: &[[u32; 4]]) -> Result<Found, PackageError> {
    let mut worst = f64::INFINITY;
    for (i, t) in tets.iter().enumerate() {
        let volume = volume6(vertices, t);
        if volume <= MIN_SHAPE * longest(vertices, t).powi(3) {
            return Err(PackageError::invalid(
                entry,
                format!("tet {i} {t:?}"),
                format!("volume {:e} mm³", volume / 6.0),
                "(b−a)·((c−a)×(d−a)) > 0 and not flat",
            ));
        }
        worst = worst.min(volume / 6.0);
    }
    Ok(Found::worst(worst, "mm³, above 0"))
}

fn faces(entry: &str, tets: &[[u32; 4]]) -> Result<Found, PackageError> {
    let faces = topology::sorted_faces(tets);
    let mut outer = 0usize;
    let mut i = 0;
    while i < faces.len() {
        let same = faces[i..].iter().take_while(|f| f.0 == faces[i].0).count();
        let tet = |k: usize| faces[k].1 / 4;
        let side = |k: usize| {
            let f = topology::face(&tets[tet(k) as usize], (faces[k].1 % 4) as usize);
            // Even permutations of the sorted vertices face one way, odd ones the other.
            f == faces[k].0
                || f.iter().cycle().skip(1).take(3).eq(&faces[k].0)
                || f.iter().cycle().skip(2).take(3).eq(&faces[k].0)
        };
        match same {
            1 => outer += 1,
            2 if side(i) != side(i + 1) => {}
            _ => {
                return Err(PackageError::invalid(
                    entry,
                    format!("tet {}, face {:?}", tet(i), faces[i].0),
                    format!(
                        "{same} tets, two of them on one side ({} and {})",
                        tet(i),
                        tet(i + 1)
                    ),
                    "at most two tets, one on each side",
                ));
            }
        }
        i += same;
    }
    Ok(Found::figure(outer as f64).named("outer faces"))
}
