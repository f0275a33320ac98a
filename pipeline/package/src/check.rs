use crate::PackageError;
use serde::Serialize;

/// One thing that was looked at.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Check {
    /// What holds where the check passes.
    pub what: String,
    /// The entry or entries that it looks at.
    pub entry: String,
    /// Whether it holds.
    pub passed: bool,
    /// The worst value found, where there is one.
    pub worst: Option<f64>,
    /// The value's unit and its limit; the unit alone for a figure that is only reported.
    pub limit: String,
    /// The fault where the check fails.
    pub fault: String,
}

/// All checks of one package.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct VerifyReport {
    /// In the order in which they ran; a check that stands on a failed one is left out.
    pub checks: Vec<Check>,
}

impl VerifyReport {
    /// Whether every check passed.
    pub fn passed(&self) -> bool {
        self.checks.iter().all(|c| c.passed)
    }

    /// The checks that failed.
    pub fn failures(&self) -> impl Iterator<Item = &Check> {
        self.checks.iter().filter(|c| !c.passed)
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
            let mark = if c.passed { "ok  " } else { "FAIL" };
            let worst = c.worst.map_or_else(String::new, |w| format!("{w:.6}"));
            let line = format!(
                "{mark}  {:what$}  {:entry$}  {worst:>14}  {}",
                c.what, c.entry, c.limit
            );
            writeln!(f, "{}", line.trim_end())?;
            if !c.passed {
                writeln!(f, "      {}", c.fault)?;
            }
        }
        let failed = self.failures().count();
        writeln!(f, "{} checks, {failed} failed", self.checks.len())
    }
}

/// Result of one check that holds: the worst value and its limit, or nothing to tell.
pub(crate) struct Found {
    worst: Option<f64>,
    limit: String,
}

impl Found {
    pub(crate) const NOTHING: Self = Self {
        worst: None,
        limit: String::new(),
    };

    pub(crate) fn worst(value: f64, limit: &str) -> Self {
        Self {
            worst: Some(value),
            limit: limit.into(),
        }
    }

    pub(crate) fn figure(value: f64) -> Self {
        Self {
            worst: Some(value),
            limit: String::new(),
        }
    }

    /// Unit or noun of a figure that has no limit.
    pub(crate) fn named(mut self, unit: &str) -> Self {
        self.limit = unit.into();
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
        let (passed, worst, limit, fault) = match run() {
            Ok(_) if !self.collect => return Ok(true),
            Err(e) if !self.collect => return Err(e),
            Ok(found) => (true, found.worst, found.limit, String::new()),
            Err(e) => (false, None, String::new(), e.to_string()),
        };
        let (what, entry) = (what.into(), entry.into());
        self.report.checks.push(Check {
            what,
            entry,
            passed,
            worst,
            limit,
            fault,
        });
        Ok(passed)
    }
}
