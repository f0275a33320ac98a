use super::{Picture, ReportInput, StageRow, chart, colour};
use crate::draw::{Rgb, base64};
use palpate_surface::{TriMesh, triangle_quality};
use std::fmt::Write;

const STYLE: &str = include_str!("style.css");

pub(super) fn html(input: &ReportInput, pictures: &[Picture]) -> String {
    let organ = escape(&input.surfaces[0].0);
    let mut out = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <title>{organ} – {}</title><style>{STYLE}</style></head>\n<body><main>\n",
        escape(input.scan)
    );
    head(&mut out, input, &organ);
    warnings(&mut out, input.stages);
    let mut figures = Figures {
        pictures,
        number: 0,
        out,
    };
    slices(&mut figures, input);
    surfaces(&mut figures, input);
    particles(&mut figures, input);
    tets(&mut figures, input);
    let mut out = figures.out;
    shapes(&mut out, input);
    stages(&mut out, input.stages);
    let _ = write!(
        out,
        "<section><h2>Recipe</h2><details><summary>Every setting of this build, as TOML</summary>\
         <pre>{}</pre></details></section>\n</main></body></html>\n",
        escape(input.recipe)
    );
    out
}

fn head(out: &mut String, input: &ReportInput, organ: &str) {
    let structures = input.anatomy.structures.len();
    let seconds: f64 = input.stages.iter().map(|s| s.seconds).sum();
    let _ = write!(
        out,
        "<header><h1>{organ}</h1><p class=\"scan\">{}",
        escape(input.scan)
    );
    if let Some(remark) = input.remark {
        let _ = write!(out, " · {}", escape(remark));
    }
    out.push_str("</p><dl class=\"figures\">");
    let mut figure = |name: &str, value: String, unit: &str| {
        let _ = write!(
            out,
            "<div><dt>{name}</dt><dd>{value}<small>{unit}</small></dd></div>"
        );
    };
    figure(
        "volume",
        format!("{:.1}", input.anatomy.organ.voxel_volume_mm3 / 1000.0),
        " mL",
    );
    for s in &input.anatomy.structures {
        figure(
            &escape(&s.body.name),
            format!("{:.2}", s.body.voxel_volume_mm3 / 1000.0),
            " mL",
        );
    }
    figure(
        "surface",
        thousands(input.surfaces[0].1.triangles.len()),
        " triangles",
    );
    figure("particles", thousands(input.particles.positions.len()), "");
    figure("clusters", thousands(input.clusters.len()), "");
    figure("FEM", thousands(input.fem.tets.len()), " tets");
    figure("embedding", thousands(input.embedding.tets.len()), " tets");
    if seconds > 0.0 {
        figure("built in", format!("{seconds:.1}"), " s");
    }
    out.push_str("</dl><p class=\"legend\">");
    for (n, (name, _)) in input.surfaces.iter().enumerate() {
        let c = if n <= structures {
            colour::region(n)
        } else {
            colour::SUPPORT
        };
        swatch(out, c, &escape(name));
    }
    out.push_str("</p></header>\n");
}

fn swatch(out: &mut String, c: Rgb, name: &str) {
    let _ = write!(
        out,
        "<span><i style=\"background:{}\"></i>{name}</span>",
        colour::css(c)
    );
}

/// A coordinate with one decimal and a true minus sign.
fn mm(v: f64) -> String {
    format!("{v:.1}").replace('-', "\u{2212}")
}

fn thousands(n: usize) -> String {
    let digits = n.to_string();
    let mut out = String::new();
    for (k, c) in digits.chars().enumerate() {
        if k > 0 && (digits.len() - k).is_multiple_of(3) {
            out.push('\u{202f}');
        }
        out.push(c);
    }
    out
}

fn warnings(out: &mut String, stages: &[StageRow]) {
    if stages.iter().all(|s| s.warnings.is_empty()) {
        return;
    }
    out.push_str("<section class=\"warnings\"><h2>Worth knowing</h2><ul>");
    for s in stages {
        for w in &s.warnings {
            let _ = write!(out, "<li><b>{}</b> {}</li>", escape(&s.name), escape(w));
        }
    }
    out.push_str("</ul></section>\n");
}

struct Figures<'a> {
    pictures: &'a [Picture],
    number: usize,
    out: String,
}

impl Figures<'_> {
    fn section(&mut self, title: &str) {
        let _ = write!(self.out, "<section><h2>{title}</h2><div class=\"row\">");
    }

    fn picture(&mut self, name: &str, below: &str) {
        let Some(p) = self.pictures.iter().find(|p| p.name == name) else {
            return;
        };
        let _ = write!(
            self.out,
            "<figure style=\"flex:{} 1 0\"><img width=\"{}\" height=\"{}\" alt=\"{below}\" src=\"data:image/png;base64,{}\">\
             <figcaption>{below}</figcaption></figure>",
            p.width,
            p.width,
            p.height,
            base64(&p.png)
        );
    }

    fn caption(&mut self, text: &str) {
        self.number += 1;
        let _ = write!(
            self.out,
            "</div><p class=\"caption\"><b>Figure {}.</b> {text}</p></section>",
            self.number
        );
    }
}

fn slices(f: &mut Figures, input: &ReportInput) {
    let places = super::slices::places(input);
    for (n, (place, centre)) in places.iter().enumerate() {
        let [x, y, z] = centre.map(mm);
        let at = format!("({x}, {y}, {z}) mm");
        let name = if n == 0 {
            escape(&input.surfaces[0].0)
        } else {
            super::slices::largest_structure(input)
                .map_or_else(String::new, |n| escape(&input.surfaces[n + 1].0))
        };
        f.section(&format!("Slices through the {name}"));
        for plane in super::slices::PLANES {
            let axis = ["R", "A", "S"][plane.axis];
            let below = format!("{}, {axis} = {} mm", plane.name, mm(centre[plane.axis]));
            f.picture(&format!("slice-{place}-{}", plane.name), &below);
        }
        let ground = if input.ct.is_some() {
            "CT, window −140 to 260 HU"
        } else {
            "label map in greys (no CT was given)"
        };
        let mut lines = String::new();
        swatch(&mut lines, colour::LABEL_LINE, "labels as drawn");
        swatch(&mut lines, colour::SURFACE_LINE, "collision surfaces");
        swatch(&mut lines, colour::FEM_LINE, "FEM boundary and interfaces");
        f.caption(&format!(
            "Three planes through the centroid of the {name}, at {at} in patient RAS. Ground: {ground}. \
             <span class=\"legend\">{lines}</span> Letters name the patient's sides."
        ));
    }
}

fn surfaces(f: &mut Figures, input: &ReportInput) {
    f.section("Collision surfaces");
    for (name, below) in [
        ("front", "from the front"),
        ("left", "from the patient's left"),
        ("back", "from the back"),
    ] {
        f.picture(&format!("surface-{name}"), below);
    }
    f.picture("surface-wire", "triangles of the organ");
    let through = if input.anatomy.structures.is_empty() {
        ""
    } else {
        " The organ is drawn translucent, so that its structures show through."
    };
    f.caption(&format!("Collision surfaces, parallel projection.{through}"));
}

fn particles(f: &mut Figures, input: &ReportInput) {
    f.section("Particles and clusters");
    f.picture("particles", "particles, coloured by cluster");
    f.picture("particles-cut", "cut open, coloured by region");
    f.picture(
        "clusters",
        &format!(
            "clusters in a slab of {:.0} mm, and their bonds",
            2.0 * super::views::slab_mm(input)
        ),
    );
    let each = input.clusters.members.len() as f64 / input.clusters.len().max(1) as f64;
    f.caption(&format!(
        "{} particles in {} shape-matching clusters, {each:.0} particles in each on average. A particle belongs to \
         several clusters; it is shown in the colour of the one whose centre is nearest. Bonds join clusters that \
         share at least three particles.",
        thousands(input.particles.positions.len()),
        thousands(input.clusters.len())
    ));
}

fn tets(f: &mut Figures, input: &ReportInput) {
    f.section("Tetrahedral meshes");
    f.picture("fem-cut", "FEM mesh, cut open");
    f.picture("fem", "FEM mesh, outer boundary");
    f.picture("embedding", "embedding mesh around the organ");
    let through = super::slices::largest_structure(input)
        .map_or("organ's centroid", |n| input.surfaces[n + 1].0.as_str());
    f.caption(&format!(
        "FEM mesh of {} tetrahedra, opened by a coronal plane through the {}: whole elements behind it, outer faces \
         greyed. The embedding mesh of {} tetrahedra holds the organ with a margin.",
        thousands(input.fem.tets.len()),
        escape(through),
        thousands(input.embedding.tets.len())
    ));
}

fn shapes(out: &mut String, input: &ReportInput) {
    out.push_str("<section><h2>Element shapes</h2><div class=\"row\">");
    let blue = colour::css(colour::region(1));
    let dark = colour::css(colour::EDGE);
    let mut series = vec![chart::Series {
        name: "FEM mesh as it is",
        counts: input.dihedral_after.to_vec(),
        colour: &blue,
        filled: true,
    }];
    if !input.dihedral_before.is_empty() {
        series.push(chart::Series {
            name: "before optimisation",
            counts: input.dihedral_before.to_vec(),
            colour: &dark,
            filled: false,
        });
    }
    let angles = chart::histogram("dihedral angle, degrees", [0.0, 180.0], 30.0, &series);
    let quality = chart::histogram(
        "triangle quality 4√3·A/(a² + b² + c²)",
        [0.0, 1.0],
        0.2,
        &[chart::Series {
            name: "collision surface",
            counts: qualities(&input.surfaces[0].1),
            colour: &blue,
            filled: true,
        }],
    );
    let _ = write!(
        out,
        "<figure style=\"flex:1 1 0\">{angles}<figcaption>All dihedral angles of the FEM mesh; a regular tetrahedron has 70.5°.\
         </figcaption></figure><figure style=\"flex:1 1 0\">{quality}<figcaption>Triangles of the organ's collision surface; an \
         equilateral triangle has 1.</figcaption></figure></div></section>"
    );
}

/// Triangles by quality, bins of 0.05.
fn qualities(mesh: &TriMesh) -> Vec<u64> {
    let mut out = vec![0; 20];
    for t in &mesh.triangles {
        let p = |k: usize| mesh.vertices.get(t[k] as usize).copied();
        if let (Some(a), Some(b), Some(c)) = (p(0), p(1), p(2)) {
            out[((triangle_quality(&[a, b, c]) * 20.0).max(0.0) as usize).min(19)] += 1;
        }
    }
    out
}

fn stages(out: &mut String, stages: &[StageRow]) {
    if stages.is_empty() {
        return;
    }
    out.push_str(
        "<section><h2>Stages</h2><table><thead><tr><th>stage</th><th>figure</th><th>value</th><th>time</th></tr></thead>",
    );
    for s in stages {
        out.push_str("<tbody>");
        let rows = s.rows.len().max(1);
        let none = (String::new(), String::new());
        for k in 0..rows {
            let (name, value) = s.rows.get(k).unwrap_or(&none);
            out.push_str("<tr>");
            if k == 0 {
                let _ = write!(out, "<th rowspan=\"{rows}\">{}</th>", escape(&s.name));
            }
            let _ = write!(
                out,
                "<td class=\"name\">{}</td><td>{}</td>",
                escape(name),
                escape(value)
            );
            if k == 0 {
                let _ = write!(
                    out,
                    "<td class=\"time\" rowspan=\"{rows}\">{:.2} s</td>",
                    s.seconds
                );
            }
            out.push_str("</tr>");
        }
        out.push_str("</tbody>");
    }
    out.push_str("</table></section>\n");
}

/// Text that stands for itself in HTML.
fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c => out.push(c),
        }
    }
    out
}
