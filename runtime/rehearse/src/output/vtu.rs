use std::fmt::Write;

/// Values at the points.
#[derive(Clone, Debug, PartialEq)]
pub enum VtuArray {
    /// One number per point.
    Scalars(String, Vec<f32>),
    /// Three numbers per point.
    Vectors(String, Vec<[f32; 3]>),
}

/// Points with triangles or tets, or on their own.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointCloud<'a> {
    /// Patient RAS mm.
    pub points_mm: Vec<[f64; 3]>,
    /// Vertex indices; no triangles and no tets: every point is a cell of its own.
    pub triangles: &'a [[u32; 3]],
    /// Vertex indices, in place of triangles.
    pub tets: Vec<[u32; 4]>,
    /// Values at the points.
    pub arrays: Vec<VtuArray>,
    /// Values of the cells.
    pub cells: Vec<VtuArray>,
}

/// A VTK unstructured grid: XML with the arrays appended as raw bytes, which ParaView, pyvista and 3D Slicer read.
pub fn vtu(cloud: &PointCloud, time_s: f64) -> Vec<u8> {
    const VERTEX: u8 = 1;
    const TRIANGLE: u8 = 5;
    const TETRA: u8 = 10;
    let n = cloud.points_mm.len();
    let (cells, corners, kind): (Vec<i64>, usize, u8) = if !cloud.tets.is_empty() {
        let list = cloud.tets.iter().flatten().map(|&v| i64::from(v)).collect();
        (list, 4, TETRA)
    } else if cloud.triangles.is_empty() {
        ((0..n as i64).collect(), 1, VERTEX)
    } else {
        let list = cloud.triangles.iter().flatten().map(|&v| i64::from(v)).collect();
        (list, 3, TRIANGLE)
    };
    let count = cells.len() / corners;
    let mut data: Vec<u8> = Vec::new();
    let mut xml = String::from(
        "<?xml version=\"1.0\"?>\n<!-- Palpate rehearsal, patient mm, SPACE=RAS; stiffness not calibrated -->\n\
         <VTKFile type=\"UnstructuredGrid\" version=\"1.0\" byte_order=\"LittleEndian\" header_type=\"UInt64\">\n\
         <UnstructuredGrid>\n<FieldData>\n",
    );
    let mut append = |xml: &mut String,
                      kind: &str,
                      name: &str,
                      components: usize,
                      tuples: &str,
                      bytes: Vec<u8>| {
        let name = escaped(name);
        let _ = writeln!(
            xml,
            "<DataArray type=\"{kind}\" Name=\"{name}\" NumberOfComponents=\"{components}\"{tuples} format=\"appended\" \
             offset=\"{}\"/>",
            data.len()
        );
        data.extend((bytes.len() as u64).to_le_bytes());
        data.extend(bytes);
    };
    append(
        &mut xml,
        "Float64",
        "TimeValue",
        1,
        " NumberOfTuples=\"1\"",
        time_s.to_le_bytes().to_vec(),
    );
    let _ = write!(
        xml,
        "</FieldData>\n<Piece NumberOfPoints=\"{n}\" NumberOfCells=\"{count}\">\n<PointData>\n"
    );
    for (arrays, end) in [
        (&cloud.arrays, "</PointData>\n<CellData>\n"),
        (&cloud.cells, "</CellData>\n<Points>\n"),
    ] {
        for a in arrays {
            match a {
                VtuArray::Scalars(name, v) => {
                    let bytes = v.iter().flat_map(|x| x.to_le_bytes()).collect();
                    append(&mut xml, "Float32", name, 1, "", bytes);
                }
                VtuArray::Vectors(name, v) => {
                    let bytes = v.iter().flatten().flat_map(|x| x.to_le_bytes()).collect();
                    append(&mut xml, "Float32", name, 3, "", bytes);
                }
            }
        }
        xml.push_str(end);
    }
    let points = cloud
        .points_mm
        .iter()
        .flatten()
        .flat_map(|x| x.to_le_bytes())
        .collect();
    append(&mut xml, "Float64", "Points", 3, "", points);
    xml.push_str("</Points>\n<Cells>\n");
    let long = |v: &mut dyn Iterator<Item = i64>| v.flat_map(i64::to_le_bytes).collect::<Vec<u8>>();
    append(
        &mut xml,
        "Int64",
        "connectivity",
        1,
        "",
        long(&mut cells.iter().copied()),
    );
    let ends = long(&mut (1..=count as i64).map(|i| i * corners as i64));
    append(&mut xml, "Int64", "offsets", 1, "", ends);
    append(&mut xml, "UInt8", "types", 1, "", vec![kind; count]);
    xml.push_str("</Cells>\n</Piece>\n</UnstructuredGrid>\n<AppendedData encoding=\"raw\">\n_");
    let mut out = xml.into_bytes();
    out.extend(data);
    out.extend(b"\n</AppendedData>\n</VTKFile>\n");
    out
}

/// A collection: time (s) and file of each grid.
pub fn pvd(files: &[(f64, String)]) -> String {
    let mut out = String::from(
        "<?xml version=\"1.0\"?>\n<VTKFile type=\"Collection\" version=\"1.0\">\n<Collection>\n",
    );
    for (time, file) in files {
        let _ = writeln!(
            out,
            "<DataSet timestep=\"{time:.6}\" part=\"0\" file=\"{}\"/>",
            escaped(file)
        );
    }
    out.push_str("</Collection>\n</VTKFile>\n");
    out
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}
