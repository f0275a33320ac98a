//! What a scene says of needles.

use super::{MOST_STEPS, unknown};
use crate::RehearseError;
use crate::scene::{NeedleEntry, NeedleMotion, Reach, SceneSource};
use palpate_needle::{NeedleError, gauge_outer_diameter_mm};

impl SceneSource {
    /// Everything about needles that can be said without the package.
    pub(super) fn needles(&self) -> Result<(), RehearseError> {
        let s = &self.scene;
        if !s.needles.is_empty() && !s.is_fem() {
            return Err(self.fault("needle", "needles go into finite elements; set model = \"fem\""));
        }
        if s.is_fem()
            && let Err(e) = s.tissue.clone().unwrap_or_default().insertion.validate()
        {
            let key = match &e {
                NeedleError::Parameter { name, .. } => format!("tissue.insertion.{name}"),
                _ => "tissue.insertion".into(),
            };
            return Err(self.fault(&key, e.to_string()));
        }
        for (i, needle) in s.needles.iter().enumerate() {
            if let Some(j) = s.needles[..i].iter().position(|n| n.name == needle.name) {
                return Err(self.fault(
                    &format!("needle[{i}].name"),
                    format!(
                        "needles {} and {} are both named \"{}\"",
                        j + 1,
                        i + 1,
                        needle.name
                    ),
                ));
            }
            self.needle(i, needle)?;
        }
        Ok(())
    }

    fn needle(&self, i: usize, n: &NeedleEntry) -> Result<(), RehearseError> {
        let key = |k: &str| format!("needle[{i}].{k}");
        let apart = |a: &str, b: &str, both: bool| match both {
            true => Err(self.fault(&key(b), format!("{a} and {b} say the same; keep one of them"))),
            false => Ok(()),
        };
        apart(
            "diameter_mm",
            "gauge",
            n.diameter_mm.is_some() && n.gauge.is_some(),
        )?;
        apart("target", "target_mm", n.target.is_some() && n.target_mm.is_some())?;
        apart(
            "symmetric",
            "bevel_degrees",
            n.symmetric
                && self.has(&key("bevel_degrees"))
                && n.bevel_degrees != NeedleEntry::default().bevel_degrees,
        )?;
        if let Some(g) = n.gauge
            && gauge_outer_diameter_mm(g).is_none()
        {
            return Err(self.fault(&key("gauge"), format!("gauge {g}, expected 10 to 34 (ISO 9626)")));
        }
        if let Some(d) = n.diameter_mm {
            self.number(&key("diameter_mm"), d, 0.1, 5.0, "0.1 to 5 mm")?;
        }
        let outer = n.outer_diameter_mm();
        self.number(
            &key("inner_diameter_mm"),
            n.inner_diameter_mm,
            0.0,
            0.95 * outer,
            "0 to 0.95 of the outer diameter, mm",
        )?;
        if n.youngs_modulus_pa < 1e8 {
            return Err(self.fault(
                &key("youngs_modulus_pa"),
                format!(
                    "youngs_modulus_pa is {}, expected 1e8 to 1e12 Pa: nitinol has 60e9, steel 200e9 (was GPa meant?)",
                    n.youngs_modulus_pa
                ),
            ));
        }
        for (k, v, lo, hi, expected) in [
            (
                "youngs_modulus_pa",
                n.youngs_modulus_pa,
                1e8,
                1e12,
                "1e8 to 1e12 Pa",
            ),
            ("bevel_degrees", n.bevel_degrees, -80.0, 80.0, "-80 to 80 degrees"),
            ("length_mm", n.length_mm, 10.0, 1000.0, "10 to 1000 mm"),
            ("free_mm", n.free_mm, 2.0, n.length_mm, "2 mm to length_mm"),
            ("edge_mm", n.edge_mm, 0.5, 50.0, "0.5 to 50 mm"),
            ("gap_mm", n.gap_mm, 0.0, 500.0, "0 to 500 mm"),
            (
                "friction_n_per_mm",
                n.friction_n_per_mm,
                0.0,
                5.0,
                "0 to 5 N/mm (measured: 0.005 to 0.1)",
            ),
            (
                "torsional_friction_n",
                n.torsional_friction_n,
                0.0,
                5.0,
                "0 to 5 N·mm/mm (radius times friction_n_per_mm: some 0.01)",
            ),
            (
                "viscous_n_s_per_m2",
                n.viscous_n_s_per_m2,
                0.0,
                1e6,
                "0 to 1e6 N·s/m²",
            ),
            (
                "cutting_force_n",
                n.cutting_force_n,
                0.0,
                50.0,
                "0 to 50 N (measured: some 0.1 to 2)",
            ),
        ] {
            self.number(&key(k), v, lo, hi, expected)?;
        }
        for (name, &f) in &n.cutting_n {
            self.number(&key(&format!("cutting_n.{name}")), f, 0.0, 50.0, "0 to 50 N")?;
        }
        for (k, m) in n.membranes.iter().enumerate() {
            let at = |part: &str| key(&format!("membrane[{k}].{part}"));
            self.number(&at("thickness_mm"), m.thickness_mm, 0.0, 20.0, "0 to 20 mm")?;
            self.number(&at("from_mm"), m.from_mm, 0.0, 100.0, "0 to 100 mm")?;
            self.number(&at("force_n"), m.force_n, 0.0, 50.0, "0 to 50 N")?;
        }
        for (k, p) in [("target_mm", &n.target_mm), ("entry_mm", &n.entry_mm)] {
            if let Some(p) = p {
                self.numbers(&key(k), p, 1e5)?;
            }
        }
        let aimed = n.target.is_some() || n.target_mm.is_some();
        match n.entry_mm {
            None if !aimed => {
                return Err(self.fault(
                    &format!("needle[{i}]"),
                    "a needle without a way: expected a target (target or target_mm), or entry_mm and direction",
                ));
            }
            None if n.direction.is_some() => {
                return Err(self.fault(
                    &key("direction"),
                    "direction goes with entry_mm; `from` says the side",
                ));
            }
            Some(_) if !aimed && n.direction.is_none() => {
                return Err(self.fault(&key("entry_mm"), "entry_mm needs a target or a direction"));
            }
            _ => {}
        }
        if let Err(e) = n.params().validate() {
            return Err(self.fault(&key("pre_bend"), e.to_string()));
        }
        if n.motions.is_empty() {
            return Err(self.fault(
                &format!("needle[{i}]"),
                "a needle that does not move; add a [[needle.motion]]",
            ));
        }
        n.motions
            .iter()
            .enumerate()
            .try_for_each(|(k, m)| self.motion(&format!("needle[{i}].motion[{k}]"), m, aimed))
    }

    fn motion(&self, at: &str, m: &NeedleMotion, aimed: bool) -> Result<(), RehearseError> {
        let key = |k: &str| format!("{at}.{k}");
        let given = [
            m.steps.is_some(),
            m.seconds.is_some(),
            m.reach.is_some(),
            m.reach_share.is_some(),
            m.reach_depth_mm.is_some(),
        ];
        if given.iter().filter(|g| **g).count() != 1 {
            return Err(self.fault(
                at,
                "expected one of steps, seconds, reach, reach_share and reach_depth_mm",
            ));
        }
        if let Some(n) = m.steps
            && !(1..=MOST_STEPS).contains(&n)
        {
            return Err(self.fault(&key("steps"), format!("{n} steps, expected 1 to {MOST_STEPS}")));
        }
        if let Some(s) = m.seconds {
            self.number(&key("seconds"), s, 1e-6, 1e4, "above 0, up to 10000 s")?;
        }
        self.number(
            &key("insertion_mm_s"),
            m.insertion_mm_s,
            -500.0,
            500.0,
            "-500 to 500 mm/s",
        )?;
        self.number(
            &key("rotation_degrees"),
            m.rotation_degrees,
            -36_000.0,
            36_000.0,
            "-36000 to 36000 degrees",
        )?;
        self.numbers(&key("velocity_mm_s"), &m.velocity_mm_s, 500.0)?;
        if let Some(share) = m.reach_share {
            self.number(
                &key("reach_share"),
                share,
                0.0,
                1.0,
                "0 (the surface) to 1 (the target)",
            )?;
            if !aimed {
                return Err(self.fault(
                    &key("reach_share"),
                    "no target to reach a share of the way to; give reach_depth_mm",
                ));
            }
        }
        if let Some(mm) = m.reach_depth_mm {
            self.number(
                &key("reach_depth_mm"),
                mm,
                0.0,
                500.0,
                "0 to 500 mm below the surface",
            )?;
        }
        for (k, given) in [
            ("reach_share", m.reach_share),
            ("reach_depth_mm", m.reach_depth_mm),
        ] {
            if given.is_some() && m.insertion_mm_s.abs() < 0.01 {
                return Err(self.fault(
                    &key(k),
                    "reached with insertion_mm_s of 0.01 or more, or, from beyond, of -0.01 or less",
                ));
            }
        }
        match m.reach {
            Some(Reach::Target) if !aimed => Err(self.fault(&key("reach"), "no target to reach")),
            Some(Reach::Target) if m.insertion_mm_s < 0.01 => Err(self.fault(
                &key("reach"),
                "the target is reached with insertion_mm_s of 0.01 or more",
            )),
            Some(Reach::Start) if m.insertion_mm_s > -0.01 => Err(self.fault(
                &key("reach"),
                "the start is reached with insertion_mm_s of -0.01 or less",
            )),
            _ => Ok(()),
        }
    }

    /// Names that needles say.
    pub(super) fn needles_against(&self, regions: &[String]) -> Result<(), RehearseError> {
        let known: Vec<&str> = regions.iter().map(String::as_str).collect();
        for (i, n) in self.scene.needles.iter().enumerate() {
            let key = |k: &str| format!("needle[{i}].{k}");
            let check = |key: String, name: &str| match known.contains(&name) {
                true => Ok(()),
                false => Err(self.fault(&key, unknown("organ or structure of the package", name, &known))),
            };
            match n.target.as_deref() {
                Some("structure") if known.len() < 2 => {
                    return Err(self.fault(
                        &key("target"),
                        "the package has no structure to aim at; give target_mm, or a package with a tumour",
                    ));
                }
                Some("structure") | None => {}
                Some(name) => check(key("target"), name)?,
            }
            for name in n.cutting_n.keys() {
                check(key(&format!("cutting_n.{name}")), name)?;
            }
            for (k, m) in n.membranes.iter().enumerate() {
                for (part, name) in [("of", &m.of), ("against", &m.against)] {
                    if let Some(name) = name {
                        check(key(&format!("membrane[{k}].{part}")), name)?;
                    }
                }
            }
        }
        Ok(())
    }
}
