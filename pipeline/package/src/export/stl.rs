use super::parts::{Part, Shape};
use crate::PackageError;
use stl_io::{Normal, Triangle, Vertex};

/// Binary STL with `SPACE=RAS` in its header; other shapes than triangles give an empty mesh.
pub(super) fn bytes(part: &Part) -> Result<Vec<u8>, PackageError> {
    let triangles: &[[u32; 3]] = match &part.shape {
        Shape::Triangles(t) => t,
        _ => &[],
    };
    let facets: Vec<Triangle> = triangles
        .iter()
        .map(|t| {
            let [a, b, c] = t.map(|v| part.points[v as usize]);
            let (u, v): ([f64; 3], [f64; 3]) = (
                std::array::from_fn(|i| b[i] - a[i]),
                std::array::from_fn(|i| c[i] - a[i]),
            );
            let n = [
                u[1] * v[2] - u[2] * v[1],
                u[2] * v[0] - u[0] * v[2],
                u[0] * v[1] - u[1] * v[0],
            ];
            let l = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
            // `+ 0.0` turns −0 into 0: readers weld vertices by their bits.
            Triangle {
                normal: Normal::new(n.map(|x| (x / l + 0.0) as f32)),
                vertices: [a, b, c].map(|p| Vertex::new(p.map(|x| (x + 0.0) as f32))),
            }
        })
        .collect();
    let mut out = Vec::with_capacity(84 + 50 * facets.len());
    stl_io::write_stl(&mut out, facets.iter()).map_err(|source| PackageError::Write {
        step: "making STL",
        source,
        path: format!("{}.stl", part.name).into(),
    })?;
    // The crate leaves the header empty. It must not start with `solid`, which marks the text variant.
    let header = format!("Palpate model, patient mm, {}", super::SPACE);
    if let Some(place) = out.get_mut(..header.len()) {
        place.copy_from_slice(header.as_bytes());
    }
    Ok(out)
}
