//! VTK unstructured grids of a deformed mesh, for ParaView and the like.

use crate::Simulation;
use glam::DVec3;
use std::fmt::Write as _;

impl Simulation {
    /// The deformed mesh as a `.vtu` file (XML, ASCII numbers): point arrays `displacement` (mm) and `velocity` (mm/s), cell arrays
    /// `region` and `volume_ratio`. `origin` is added to positions: a package's local origin, or zero.
    pub fn to_vtu(&self, origin: DVec3) -> String {
        let mesh = self.mesh();
        let tets: Vec<_> = mesh.tets().collect();
        let n = mesh.node_slots();
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = write!(
            out,
            "<?xml version=\"1.0\"?>\n<VTKFile type=\"UnstructuredGrid\" version=\"0.1\" byte_order=\"LittleEndian\">\n\
             <UnstructuredGrid>\n<Piece NumberOfPoints=\"{n}\" NumberOfCells=\"{}\">\n<PointData>\n",
            tets.len()
        );
        let vectors = |out: &mut String, name: &str, of: &dyn Fn(usize) -> DVec3| {
            let _ = writeln!(
                out,
                "<DataArray type=\"Float64\" Name=\"{name}\" NumberOfComponents=\"3\" format=\"ascii\">"
            );
            for i in 0..n {
                let v = of(i);
                let _ = writeln!(out, "{} {} {}", v.x, v.y, v.z);
            }
            out.push_str("</DataArray>\n");
        };
        vectors(&mut out, "displacement", &|i| {
            self.positions()[i] - mesh.rest()[i]
        });
        vectors(&mut out, "velocity", &|i| self.velocities()[i]);
        out.push_str(
            "</PointData>\n<CellData>\n<DataArray type=\"Int32\" Name=\"region\" format=\"ascii\">\n",
        );
        for (_, t) in &tets {
            let _ = writeln!(out, "{}", t.region);
        }
        out.push_str("</DataArray>\n<DataArray type=\"Float64\" Name=\"volume_ratio\" format=\"ascii\">\n");
        for (_, ratio) in self.volume_ratios() {
            let _ = writeln!(out, "{ratio}");
        }
        out.push_str("</DataArray>\n</CellData>\n<Points>\n");
        vectors(&mut out, "points", &|i| self.positions()[i] + origin);
        out.push_str(
            "</Points>\n<Cells>\n<DataArray type=\"Int32\" Name=\"connectivity\" format=\"ascii\">\n",
        );
        for (_, t) in &tets {
            let [a, b, c, d] = t.corners;
            let _ = writeln!(out, "{a} {b} {c} {d}");
        }
        out.push_str("</DataArray>\n<DataArray type=\"Int32\" Name=\"offsets\" format=\"ascii\">\n");
        for i in 1..=tets.len() {
            let _ = writeln!(out, "{}", 4 * i);
        }
        out.push_str("</DataArray>\n<DataArray type=\"UInt8\" Name=\"types\" format=\"ascii\">\n");
        for _ in &tets {
            out.push_str("10\n");
        }
        out.push_str("</DataArray>\n</Cells>\n</Piece>\n</UnstructuredGrid>\n</VTKFile>\n");
        out
    }
}
