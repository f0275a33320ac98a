use crate::PackageError;
use serde::Serialize;

/// How a check ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Mark {
    /// All is as promised.
    #[default]
    Holds,
    /// Usable, but a person should look at it: the figure misses its mark.
    Warns,
    /// A rehearsal must not use the package.
    Fails,
}

/// One thing that was looked at.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Check {
    /// What holds where the check passes.
    pub what: String,
    /// The entry or body that it looks at.
    pub entry: String,
    /// How it ended.
    pub mark: Mark,
    /// The worst value found, where there is one.
    pub worst: Option<f64>,
    /// The value's unit and its limit; the unit alone for a figure that is only reported.
    pub limit: String,
    /// What is wrong and where, unless the check holds.
    pub fault: String,
}

impl Check {
    /// A check that holds until told otherwise.
    pub fn new(what: impl Into<String>, entry: impl Into<String>) -> Self {
        Self {
            what: what.into(),
            entry: entry.into(),
            ..Self::default()
        }
    }

    /// The figure that was found, with its unit and limit.
    pub fn figure(mut self, worst: f64, limit: impl Into<String>) -> Self {
        self.worst = Some(worst);
        self.limit = limit.into();
        self
    }

    /// Warns where `missed`; never softens a failure.
    pub fn warn_if(self, missed: bool, fault: impl FnOnce() -> String) -> Self {
        if missed && self.mark == Mark::Holds {
            self.marked(Mark::Warns, fault())
        } else {
            self
        }
    }

    /// Fails where `broken`.
    pub fn fail_if(self, broken: bool, fault: impl FnOnce() -> String) -> Self {
        if broken {
            self.marked(Mark::Fails, fault())
        } else {
            self
        }
    }

    fn marked(mut self, mark: Mark, fault: String) -> Self {
        self.mark = mark;
        self.fault = fault;
        self
    }

    /// Whether the check did not fail.
    pub fn passed(&self) -> bool {
        self.mark != Mark::Fails
    }
}

/// All checks of one package.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct VerifyReport {
    /// In the order in which they ran; a check that stands on a failed one is left out.
    pub checks: Vec<Check>,
}

impl VerifyReport {
    /// Whether no check failed.
    pub fn passed(&self) -> bool {
        self.failures().next().is_none()
    }

    /// The checks that failed.
    pub fn failures(&self) -> impl Iterator<Item = &Check> {
        self.checks.iter().filter(|c| c.mark == Mark::Fails)
    }

    /// The checks whose figure misses its mark.
    pub fn warnings(&self) -> impl Iterator<Item = &Check> {
        self.checks.iter().filter(|c| c.mark == Mark::Warns)
    }
}

impl std::fmt::Display for VerifyReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let wide = |get: fn(&Check) -> &str| {
            self.checks
                .iter()
                .map(|c| get(c).chars().count())
                .max()
                .unwrap_or(0)
        };
        let (what, entry) = (wide(|c| &c.what), wide(|c| &c.entry));
        for c in &self.checks {
            let mark = match c.mark {
                Mark::Holds => "ok  ",
                Mark::Warns => "WARN",
                Mark::Fails => "FAIL",
            };
            let worst = c.worst.map_or_else(String::new, short);
            let line = format!(
                "{mark}  {:what$}  {:entry$}  {worst:>12}  {}",
                c.what, c.entry, c.limit
            );
            writeln!(f, "{}", line.trim_end())?;
            if c.mark != Mark::Holds {
                writeln!(f, "      {}", c.fault)?;
            }
        }
        writeln!(
            f,
            "{} checks, {} failed, {} warned",
            self.checks.len(),
            self.failures().count(),
            self.warnings().count()
        )
    }
}

/// Whole numbers whole, others with about five digits.
fn short(v: f64) -> String {
    if v == v.trunc() && v.abs() < 1e15 {
        format!("{v}")
    } else if v.abs() < 1e-3 {
        format!("{v:.2e}")
    } else {
        let digits = (4 - v.abs().log10().floor() as i32).clamp(0, 6) as usize;
        format!("{v:.digits$}")
    }
}

/// Result of one check that holds: the worst value and its limit, or nothing to tell; a warning where a mark is missed.
pub(crate) struct Found {
    worst: Option<f64>,
    limit: String,
    warning: Option<String>,
}

impl Found {
    pub(crate) const NOTHING: Self = Self {
        worst: None,
        limit: String::new(),
        warning: None,
    };

    pub(crate) fn worst(value: f64, limit: &str) -> Self {
        Self {
            worst: Some(value),
            limit: limit.into(),
            warning: None,
        }
    }

    pub(crate) fn figure(value: f64) -> Self {
        Self::worst(value, "")
    }

    /// Unit or noun of a figure that has no limit.
    pub(crate) fn named(mut self, unit: &str) -> Self {
        self.limit = unit.into();
        self
    }

    /// The figure misses a mark that no rehearsal breaks on.
    pub(crate) fn warn_if(mut self, missed: bool, text: impl FnOnce() -> String) -> Self {
        if missed {
            self.warning = Some(text());
        }
        self
    }
}

/// Where checks go: the reader stops at the first fault, the verifier collects them all.
#[derive(Default)]
pub(crate) struct Sink {
    collect: bool,
    pub(crate) report: VerifyReport,
}

impl Sink {
    pub(crate) fn stopping() -> Self {
        Self::default()
    }

    pub(crate) fn collecting() -> Self {
        Self {
            collect: true,
            ..Self::default()
        }
    }

    /// Runs one check. `Ok(true)`: it holds; `Ok(false)`: it failed and was noted; `Err`: it failed and that ends it.
    pub(crate) fn check(
        &mut self,
        what: &str,
        entry: &str,
        run: impl FnOnce() -> Result<Found, PackageError>,
    ) -> Result<bool, PackageError> {
        let check = Check::new(what, entry);
        let check = match run() {
            Ok(_) if !self.collect => return Ok(true),
            Err(e) if !self.collect => return Err(e),
            Ok(found) => Check {
                worst: found.worst,
                limit: found.limit,
                ..check
            }
            .warn_if(found.warning.is_some(), || found.warning.unwrap_or_default()),
            Err(e) => check.fail_if(true, || e.to_string()),
        };
        let passed = check.passed();
        self.report.checks.push(check);
        Ok(passed)
    }
}
