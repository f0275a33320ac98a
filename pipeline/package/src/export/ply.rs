use super::parts::{Part, Shape, Values};
use std::fmt::Write;

/// Binary little-endian PLY.
pub(super) fn bytes(part: &Part) -> Vec<u8> {
    let triangles: &[[u32; 3]] = match &part.shape {
        Shape::Triangles(t) => t,
        _ => &[],
    };
    let mut head = String::new();
    // Writing to a String cannot fail.
    let _ = write!(
        head,
        "ply\nformat binary_little_endian 1.0\ncomment Palpate model, patient mm\ncomment {}\nelement vertex {}\n\
         property float x\nproperty float y\nproperty float z\n",
        super::SPACE,
        part.points.len()
    );
    for a in &part.point_arrays {
        let kind = match a.values {
            Values::Int(_) => "int",
            Values::Float(_) => "float",
        };
        let _ = writeln!(
            head,
            "property {kind} {}",
            a.name.replace(char::is_whitespace, "_")
        );
    }
    if !triangles.is_empty() {
        let _ = write!(
            head,
            "element face {}\nproperty list uchar int vertex_indices\n",
            triangles.len()
        );
    }
    head.push_str("end_header\n");
    let mut out = head.into_bytes();
    for (i, p) in part.points.iter().enumerate() {
        for x in p {
            out.extend_from_slice(&((x + 0.0) as f32).to_le_bytes());
        }
        for a in &part.point_arrays {
            match &a.values {
                Values::Int(v) => out.extend_from_slice(&v[i].to_le_bytes()),
                Values::Float(v) => out.extend_from_slice(&v[i].to_le_bytes()),
            }
        }
    }
    for t in triangles {
        out.push(3);
        for v in t {
            out.extend_from_slice(&v.to_le_bytes());
        }
    }
    out
}
