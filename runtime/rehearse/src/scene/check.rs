mod needle;
mod tissue;

use super::names::nearest;
use super::{Cut, FORMAT, Instrument, Press, SceneSource, ShapeKind};
use crate::RehearseError;
use palpate_package::{ModelPackage, SurfaceKind};
use palpate_pbd::PbdError;
use palpate_ultrasound::UltrasoundError;

/// Longest session, steps: about five hours of simulated time.
const MOST_STEPS: u32 = 1_000_000;

impl SceneSource {
    /// Everything that can be said without the packages.
    pub(super) fn check(&self) -> Result<(), RehearseError> {
        let s = &self.scene;
        if s.format != FORMAT {
            let hint = if s.format > FORMAT {
                "; a newer version wrote this scene"
            } else {
                ""
            };
            return Err(self.fault(
                "format",
                format!("scene format {}, expected {FORMAT}{hint}", s.format),
            ));
        }
        if s.support.is_empty() {
            return Err(self.fault(
                "support",
                "found an empty support, expected cradle, plane, none, a support body's name or an STL file",
            ));
        }
        self.number(
            "gravity.acceleration_mm_s2",
            s.gravity.acceleration_mm_s2,
            0.0,
            1e6,
            "0 to 1000000 mm/s²",
        )?;
        let c = s.cradle;
        self.number("cradle.height_share", c.height_share, 0.01, 1.0, "0.01 to 1")?;
        self.number("cradle.gap_mm", c.gap_mm, 0.0, 50.0, "0 to 50 mm")?;
        self.number("stiffness.organ", s.stiffness.organ, 0.0, 1.0, "0 to 1")?;
        self.number("stiffness.structures", s.stiffness.structures, 0.0, 1.0, "0 to 1")?;
        for (name, &alpha) in &s.stiffness.named {
            self.number(&format!("stiffness.named.{name}"), alpha, 0.0, 1.0, "0 to 1")?;
        }
        if s.fiducials.count > 10_000 {
            return Err(self.fault(
                "fiducials.count",
                format!("{} fiducials, expected 10000 at most", s.fiducials.count),
            ));
        }
        for (i, p) in s.packages.iter().enumerate() {
            self.numbers(&format!("package[{i}].offset_mm"), &p.offset_mm, 1e5)?;
            self.numbers(&format!("package[{i}].rotation_deg"), &p.rotation_deg, 1e5)?;
            if let Some(j) = s.packages[..i]
                .iter()
                .position(|q| q.name.is_some() && q.name == p.name)
            {
                return Err(self.fault(
                    &format!("package[{i}].name"),
                    format!(
                        "packages {} and {} have one name; give each its own",
                        j + 1,
                        i + 1
                    ),
                ));
            }
        }
        for (i, tool) in s.instruments.iter().enumerate() {
            self.instrument(i, tool)?;
        }
        if let Some(press) = &s.press {
            self.press(press)?;
        }
        if s.steps == 0 || s.steps > MOST_STEPS {
            return Err(self.fault("steps", format!("{} steps, expected 1 to {MOST_STEPS}", s.steps)));
        }
        self.solver()?;
        self.tissue()?;
        self.needles()?;
        self.pictures()
    }

    fn solver(&self) -> Result<(), RehearseError> {
        let s = &self.scene;
        match s.solver.check() {
            Ok(()) => {}
            Err(PbdError::Setting {
                name,
                found,
                expected,
            }) => {
                return Err(self.fault(
                    &format!("solver.{name}"),
                    format!("{name} is {found}, expected {expected}"),
                ));
            }
            Err(e) => return Err(self.fault("solver", e.to_string())),
        }
        if self.has("solver.gravity_mm_s2") && s.solver.gravity_mm_s2 != s.gravity.vector_mm_s2() {
            return Err(self.fault(
                "solver.gravity_mm_s2",
                format!(
                    "gravity_mm_s2 is {:?}, but [gravity] says {:?}; keep one of them",
                    s.solver.gravity_mm_s2,
                    s.gravity.vector_mm_s2()
                ),
            ));
        }
        Ok(())
    }

    fn pictures(&self) -> Result<(), RehearseError> {
        let s = &self.scene;
        let v = &s.view;
        self.number("view.organ_opacity", v.organ_opacity, 0.0, 1.0, "0 to 1")?;
        if v.cut == Some(Cut::Needle) && s.needles.is_empty() {
            return Err(self.fault("view.cut", "a cut along a needle, and the scene has none"));
        }
        if let Some(mm) = v.span_mm {
            self.number("view.span_mm", mm, 5.0, 2000.0, "5 to 2000 mm")?;
        }
        for (key, px) in [("view.width_px", v.width_px), ("view.height_px", v.height_px)] {
            if !(160..=4096).contains(&px) {
                return Err(self.fault(key, format!("{px} pixels, expected 160 to 4096")));
            }
        }
        let Some(image) = &s.image else { return Ok(()) };
        let told = [image.probe.check(), image.settings.check(), image.tissues.check()];
        if let Some(e) = told.into_iter().find_map(Result::err) {
            let key = match &e {
                UltrasoundError::Setting { name, .. } => {
                    ["probe", "settings", "settings.acoustic", "probe.shape.linear"]
                        .iter()
                        .map(|t| format!("image.{t}.{name}"))
                        .find(|k| self.has(k))
                }
                _ => None,
            };
            return Err(self.fault(&key.unwrap_or_else(|| "image".into()), e.to_string()));
        }
        if image.embedding_splits > 2 {
            return Err(self.fault(
                "image.embedding_splits",
                format!("{}, expected 0 to 2", image.embedding_splits),
            ));
        }
        if s.instruments.is_empty() {
            return Err(self.fault(
                "image",
                "an image without an instrument to carry it; add an [[instrument]]",
            ));
        }
        if !image.instrument.is_empty() {
            self.known_instrument("image.instrument", &image.instrument)?;
        }
        Ok(())
    }

    fn known_instrument(&self, key: &str, name: &str) -> Result<(), RehearseError> {
        let names: Vec<&str> = self.scene.instruments.iter().map(|i| i.name.as_str()).collect();
        if names.contains(&name) {
            return Ok(());
        }
        Err(self.fault(key, unknown("instrument", name, &names)))
    }

    fn press(&self, press: &Press) -> Result<(), RehearseError> {
        self.known_instrument("press.instrument", &press.instrument)?;
        if press.stages.is_empty() {
            return Err(self.fault("press", "a press without stages; add a [[press.stage]]"));
        }
        let mut total = u64::from(press.warm_up_steps);
        for (i, s) in press.stages.iter().enumerate() {
            let key = |k: &str| format!("press.stage[{i}].{k}");
            self.number(
                &key("indentation_mm"),
                s.indentation_mm,
                -500.0,
                500.0,
                "-500 to 500 mm",
            )?;
            if s.steps == 0 {
                return Err(self.fault(&key("steps"), "found 0 steps, expected at least 1"));
            }
            if let Some(j) = press.stages[..i].iter().position(|t| t.name == s.name) {
                return Err(self.fault(
                    &key("name"),
                    format!("stages {} and {} are both named \"{}\"", j + 1, i + 1, s.name),
                ));
            }
            total += u64::from(s.steps);
        }
        if total > u64::from(MOST_STEPS) {
            return Err(self.fault("press", format!("{total} steps, expected {MOST_STEPS} at most")));
        }
        let tool = self
            .scene
            .instruments
            .iter()
            .position(|i| i.name == press.instrument);
        match tool {
            Some(i) if !self.scene.instruments[i].keyframes.is_empty() => Err(self.fault(
                &format!("instrument[{i}].keyframe"),
                format!(
                    "instrument \"{}\" is moved by [press] already; take its keyframes out",
                    press.instrument
                ),
            )),
            _ => Ok(()),
        }
    }

    fn instrument(&self, i: usize, tool: &Instrument) -> Result<(), RehearseError> {
        let key = |k: &str| format!("instrument[{i}].{k}");
        if let Some(j) = self.scene.instruments[..i]
            .iter()
            .position(|o| o.name == tool.name)
        {
            return Err(self.fault(
                &key("name"),
                format!(
                    "instruments {} and {} are both named \"{}\"",
                    j + 1,
                    i + 1,
                    tool.name
                ),
            ));
        }
        let (needed, given): (&[&str], [(&str, bool); 4]) = (
            match tool.shape {
                ShapeKind::Cuboid => &["size_mm"],
                ShapeKind::Sphere => &["diameter_mm"],
                ShapeKind::Capsule => &["diameter_mm", "length_mm"],
                ShapeKind::Convex => &["planes_mm"],
            },
            [
                ("size_mm", tool.size_mm.is_some()),
                ("diameter_mm", tool.diameter_mm.is_some()),
                ("length_mm", tool.length_mm.is_some()),
                ("planes_mm", tool.planes_mm.is_some()),
            ],
        );
        let shape = format!("{:?}", tool.shape).to_lowercase();
        for (name, there) in given {
            match (needed.contains(&name), there) {
                (true, false) => return Err(self.fault(&key("shape"), format!("a {shape} needs {name}"))),
                (false, true) => {
                    return Err(self.fault(
                        &key(name),
                        format!(
                            "{name} says nothing about a {shape}, which has {}",
                            needed.join(" and ")
                        ),
                    ));
                }
                _ => {}
            }
        }
        for v in tool.size_mm.iter().flatten() {
            self.number(&key("size_mm"), *v, 0.1, 1e3, "three lengths from 0.1 to 1000 mm")?;
        }
        if let Some(d) = tool.diameter_mm {
            self.number(&key("diameter_mm"), d, 0.1, 1e3, "0.1 to 1000 mm")?;
            if let Some(l) = tool.length_mm {
                self.number(
                    &key("length_mm"),
                    l,
                    d,
                    1e3,
                    "the diameter at least, 1000 mm at most",
                )?;
            }
        }
        for p in tool.planes_mm.iter().flatten() {
            self.numbers(&key("planes_mm"), p, 1e3)?;
        }
        if let Some(mu) = tool.friction {
            self.number(&key("friction"), mu, 0.0, 10.0, "0 to 10")?;
        }
        if let Some(d) = tool.collision_distance_mm {
            self.number(&key("collision_distance_mm"), d, 0.0, 50.0, "0 to 50 mm")?;
        }
        let pose = &tool.pose;
        self.numbers(&key("pose.shift_mm"), &pose.shift_mm, 1e3)?;
        self.numbers(&key("pose.rotation_deg"), &pose.rotation_deg, 1e5)?;
        self.number(&key("pose.gap_mm"), pose.gap_mm, -100.0, 1e3, "-100 to 1000 mm")?;
        if let Some(p) = &pose.position_mm {
            self.numbers(&key("pose.position_mm"), p, 1e5)?;
        }
        if pose.over.is_empty() {
            return Err(self.fault(
                &key("pose.over"),
                "an empty list, expected peak, centre, structure or names",
            ));
        }
        let mut last = 0.0;
        for (k, f) in tool.keyframes.iter().enumerate() {
            let at = |part: &str| key(&format!("keyframe[{k}].{part}"));
            self.number(&at("time_s"), f.time_s, 0.0, 1e6, "0 to 1000000 s")?;
            if k > 0 && f.time_s <= last {
                return Err(self.fault(
                    &at("time_s"),
                    format!("{} s after {last} s, expected rising times", f.time_s),
                ));
            }
            last = f.time_s;
            self.numbers(&at("position_mm"), &f.position_mm, 1e4)?;
            self.numbers(&at("rotation_deg"), &f.rotation_deg, 1e5)?;
        }
        Ok(())
    }

    fn number(&self, key: &str, v: f64, lo: f64, hi: f64, expected: &str) -> Result<(), RehearseError> {
        if v.is_finite() && v >= lo && v <= hi {
            return Ok(());
        }
        let name = key.rsplit('.').next().unwrap_or(key);
        Err(self.fault(key, format!("{name} is {v}, expected {expected}")))
    }

    fn numbers(&self, key: &str, v: &[f64], most: f64) -> Result<(), RehearseError> {
        match v.iter().find(|x| !(x.is_finite() && x.abs() <= most)) {
            Some(bad) => self.number(key, *bad, -most, most, &format!("finite numbers up to {most}")),
            None => Ok(()),
        }
    }

    /// What the scene asks of its first package: names of structures and of the support.
    ///
    /// # Errors
    /// [`RehearseError::Scene`] for a structure or support that the package lacks, with the names that it has.
    pub fn check_against(&self, package: &ModelPackage) -> Result<(), RehearseError> {
        let structures: Vec<&str> = package.info.regions.iter().skip(1).map(String::as_str).collect();
        for name in self.scene.stiffness.named.keys() {
            if !structures.contains(&name.as_str()) {
                return Err(self.fault(
                    &format!("stiffness.named.{name}"),
                    unknown("structure of the package", name, &structures),
                ));
            }
        }
        for (i, tool) in self.scene.instruments.iter().enumerate() {
            let over = &tool.pose.over;
            let fits = |n: &String| match n.as_str() {
                "peak" | "centre" => true,
                "structure" | "rim" => !structures.is_empty(),
                name => structures.contains(&name),
            };
            if tool.pose.position_mm.is_none() && !over.iter().any(fits) {
                let mut known = vec!["peak", "centre", "structure", "rim"];
                known.extend(&structures);
                return Err(self.fault(
                    &format!("instrument[{i}].pose.over"),
                    unknown("place of the package", &over.join(", "), &known),
                ));
            }
        }
        self.tissue_against(&package.info.regions)?;
        self.needles_against(&package.info.regions)?;
        let support = self.scene.support.as_str();
        if matches!(support, "cradle" | "plane" | "none") {
            return Ok(());
        }
        if is_mesh_file(support) {
            let file = self.resolve(support.as_ref());
            if !file.is_file() {
                return Err(self.fault("support", format!("no such file: {}", file.display())));
            }
            return Ok(());
        }
        let bodies: Vec<&str> = package
            .surfaces
            .iter()
            .filter(|s| s.kind == SurfaceKind::Support)
            .map(|s| s.name.as_str())
            .collect();
        if bodies.contains(&support) || (support == "package" && !bodies.is_empty()) {
            return Ok(());
        }
        let mut known = vec!["cradle", "plane", "none"];
        if !bodies.is_empty() {
            known.push("package");
        }
        known.extend(&bodies);
        Err(self.fault("support", unknown("support", support, &known)))
    }
}

/// Whether a support is a file.
pub(crate) fn is_mesh_file(support: &str) -> bool {
    support.to_lowercase().ends_with(".stl")
}

fn unknown(kind: &str, found: &str, known: &[&str]) -> String {
    let hint = nearest(found, known).map_or_else(String::new, |k| format!("; did you mean \"{k}\"?"));
    let list = if known.is_empty() {
        "none".to_string()
    } else {
        known.join(", ")
    };
    format!("no {kind} is named \"{found}\"; there are: {list}{hint}")
}
