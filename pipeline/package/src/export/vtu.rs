use super::parts::{Array, Part, Shape, Values};
use std::fmt::Write;

const VERTEX: u8 = 1;
const TRIANGLE: u8 = 5;
const TETRA: u8 = 10;

/// VTK unstructured grid, arrays inline in base64: plain XML.
pub(super) fn bytes(part: &Part) -> Vec<u8> {
    let (cells, kind): (Vec<i64>, u8) = match &part.shape {
        Shape::Points => ((0..part.points.len() as i64).collect(), VERTEX),
        Shape::Triangles(t) => (t.iter().flatten().map(|&v| i64::from(v)).collect(), TRIANGLE),
        Shape::Tets(t) => (t.iter().flatten().map(|&v| i64::from(v)).collect(), TETRA),
    };
    let corners = match kind {
        VERTEX => 1,
        TRIANGLE => 3,
        _ => 4,
    };
    let count = cells.len() / corners;
    let mut out = String::new();
    out.push_str(
        "<?xml version=\"1.0\"?>\n<!-- Palpate model, patient mm, SPACE=RAS -->\n\
         <VTKFile type=\"UnstructuredGrid\" version=\"1.0\" byte_order=\"LittleEndian\" header_type=\"UInt64\">\n\
         <UnstructuredGrid>\n",
    );
    // The character codes of `RAS`, as VTK writes string arrays.
    out.push_str(
        "<FieldData>\n<Array type=\"String\" Name=\"SPACE\" NumberOfTuples=\"1\" format=\"ascii\">82 65 83 0</Array>\n\
         </FieldData>\n",
    );
    // Writing to a String cannot fail.
    let _ = writeln!(
        out,
        "<Piece NumberOfPoints=\"{}\" NumberOfCells=\"{count}\">",
        part.points.len()
    );
    out.push_str("<PointData>\n");
    for a in &part.point_arrays {
        named(&mut out, a);
    }
    out.push_str("</PointData>\n<CellData>\n");
    for a in &part.cell_arrays {
        named(&mut out, a);
    }
    out.push_str("</CellData>\n<Points>\n");
    let points: Vec<u8> = part
        .points
        .iter()
        .flatten()
        .flat_map(|x| (x + 0.0).to_le_bytes())
        .collect();
    array(&mut out, "Float64", "Points", 3, &points);
    out.push_str("</Points>\n<Cells>\n");
    let le = |v: &mut dyn Iterator<Item = i64>| v.flat_map(i64::to_le_bytes).collect::<Vec<u8>>();
    array(
        &mut out,
        "Int64",
        "connectivity",
        1,
        &le(&mut cells.iter().copied()),
    );
    array(
        &mut out,
        "Int64",
        "offsets",
        1,
        &le(&mut (1..=count as i64).map(|i| i * corners as i64)),
    );
    array(&mut out, "UInt8", "types", 1, &vec![kind; count]);
    out.push_str("</Cells>\n</Piece>\n</UnstructuredGrid>\n</VTKFile>\n");
    out.into_bytes()
}

fn named(out: &mut String, a: &Array) {
    let (kind, data): (&str, Vec<u8>) = match &a.values {
        Values::Int(v) => ("Int32", v.iter().flat_map(|x| x.to_le_bytes()).collect()),
        Values::Float(v) => ("Float32", v.iter().flat_map(|x| x.to_le_bytes()).collect()),
    };
    array(out, kind, &a.name, 1, &data);
}

/// One array: its size in bytes as a 64-bit number, then the bytes, both in one base64 run.
fn array(out: &mut String, kind: &str, name: &str, components: usize, data: &[u8]) {
    let name = name
        .replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;");
    let _ = writeln!(
        out,
        "<DataArray type=\"{kind}\" Name=\"{name}\" NumberOfComponents=\"{components}\" format=\"binary\">"
    );
    let mut bytes = (data.len() as u64).to_le_bytes().to_vec();
    bytes.extend_from_slice(data);
    base64(out, &bytes);
    out.push_str("\n</DataArray>\n");
}

fn base64(out: &mut String, bytes: &[u8]) {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    out.reserve(bytes.len().div_ceil(3) * 4);
    for three in bytes.chunks(3) {
        let word = three
            .iter()
            .enumerate()
            .fold(0u32, |w, (i, &b)| w | (u32::from(b) << (16 - 8 * i)));
        for i in 0..4 {
            let digit = DIGITS[((word >> (18 - 6 * i)) & 63) as usize];
            out.push(if i <= three.len() { char::from(digit) } else { '=' });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::base64;

    #[test]
    fn base64_of_the_rfc_4648_vectors() {
        for (text, expected) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("fooba", "Zm9vYmE="),
            ("foobar", "Zm9vYmFy"),
        ] {
            let mut out = String::new();
            base64(&mut out, text.as_bytes());
            assert_eq!(out, expected);
        }
    }
}
