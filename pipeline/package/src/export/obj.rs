use super::parts::{Part, Shape};
use std::fmt::Write;

/// OBJ text with positions to a nanometre; points are `p` elements.
pub(super) fn bytes(part: &Part) -> Vec<u8> {
    let object: String = part
        .name
        .chars()
        .map(|c| if c.is_whitespace() { '_' } else { c })
        .collect();
    let mut out = format!("# Palpate model, patient mm, {}\no {object}\n", super::SPACE);
    // Writing to a String cannot fail.
    for p in &part.points {
        let _ = writeln!(out, "v {:.6} {:.6} {:.6}", p[0] + 0.0, p[1] + 0.0, p[2] + 0.0);
    }
    match &part.shape {
        Shape::Triangles(triangles) => {
            for t in triangles {
                let _ = writeln!(out, "f {} {} {}", t[0] + 1, t[1] + 1, t[2] + 1);
            }
        }
        _ => {
            for i in 1..=part.points.len() {
                let _ = writeln!(out, "p {i}");
            }
        }
    }
    out.into_bytes()
}
