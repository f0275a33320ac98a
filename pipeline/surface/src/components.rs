use crate::TriMesh;
use crate::vector::{V3, cross, dot, sub};

/// Signed volume (mm³) of each part of a closed surface, negative for voids, and the part of each triangle.
pub(crate) struct Parts {
    pub volumes_mm3: Vec<f64>,
    pub of_triangle: Vec<u32>,
}

/// Parts of a surface that hang together by shared vertices, numbered in the order of their first triangle.
pub(crate) fn parts(mesh: &TriMesh) -> Parts {
    let mut root: Vec<u32> = (0..mesh.vertices.len() as u32).collect();
    fn find(root: &mut [u32], mut v: u32) -> u32 {
        while root[v as usize] != v {
            root[v as usize] = root[root[v as usize] as usize];
            v = root[v as usize];
        }
        v
    }
    for t in &mesh.triangles {
        let a = find(&mut root, t[0]);
        for v in &t[1..] {
            let b = find(&mut root, *v);
            // The lower number wins, so that `a` stays a root or becomes its child.
            let (low, high) = (a.min(b), a.max(b));
            let low = find(&mut root, low);
            root[high as usize] = low;
        }
    }
    let mut number = vec![u32::MAX; mesh.vertices.len()];
    let mut out = Parts {
        volumes_mm3: Vec::new(),
        of_triangle: Vec::with_capacity(mesh.triangles.len()),
    };
    let origin = mesh.vertices.first().copied().unwrap_or_default();
    let at = |v: u32| -> V3 { sub(mesh.vertices[v as usize], origin) };
    for t in &mesh.triangles {
        let r = find(&mut root, t[0]) as usize;
        if number[r] == u32::MAX {
            number[r] = out.volumes_mm3.len() as u32;
            out.volumes_mm3.push(0.0);
        }
        out.volumes_mm3[number[r] as usize] += dot(at(t[0]), cross(at(t[1]), at(t[2]))) / 6.0;
        out.of_triangle.push(number[r]);
    }
    out
}

/// The surface without parts (bodies and voids) whose volume is below `share` of the largest; the volumes that were
/// dropped, in order of their first triangle.
pub(crate) fn drop_small_parts(mesh: TriMesh, share: f64) -> (TriMesh, Vec<f64>) {
    let p = parts(&mesh);
    let largest = p.volumes_mm3.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let small: Vec<bool> = p.volumes_mm3.iter().map(|v| v.abs() < share * largest).collect();
    let dropped: Vec<f64> = p
        .volumes_mm3
        .iter()
        .zip(&small)
        .filter(|(_, s)| **s)
        .map(|(v, _)| *v)
        .collect();
    if dropped.is_empty() {
        return (mesh, dropped);
    }
    let mut number = vec![u32::MAX; mesh.vertices.len()];
    let mut out = TriMesh::default();
    let kept = mesh
        .triangles
        .iter()
        .zip(&p.of_triangle)
        .filter(|(_, n)| !small[**n as usize])
        .map(|(t, _)| *t);
    for t in kept {
        for v in t {
            if number[v as usize] == u32::MAX {
                number[v as usize] = out.vertices.len() as u32;
                out.vertices.push(mesh.vertices[v as usize]);
            }
        }
        out.triangles.push(t.map(|v| number[v as usize]));
    }
    (out, dropped)
}
