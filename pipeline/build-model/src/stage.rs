use serde::Serialize;
use serde_json::Value;

/// What one stage did.
#[derive(Clone, Debug, Serialize)]
pub struct StageRecord {
    /// Name of the stage.
    pub name: String,
    /// Wall time, s.
    pub seconds: f64,
    /// The stage's own report.
    pub report: Value,
    /// What a person judges by: name and figure.
    #[serde(skip)]
    pub rows: Vec<(String, String)>,
    /// What a person should look at.
    pub warnings: Vec<String>,
}

impl StageRecord {
    /// A stage without figures.
    pub fn new(name: &str, seconds: f64) -> Self {
        Self {
            name: name.into(),
            seconds,
            report: Value::Null,
            rows: Vec::new(),
            warnings: Vec::new(),
        }
    }

    /// Adds a figure.
    pub fn row(mut self, name: impl Into<String>, figure: impl Into<String>) -> Self {
        self.rows.push((name.into(), figure.into()));
        self
    }

    /// Adds a figure where `condition` holds.
    pub fn row_if(self, condition: bool, name: &str, figure: impl FnOnce() -> String) -> Self {
        if condition { self.row(name, figure()) } else { self }
    }

    /// Adds a warning where `condition` holds.
    pub fn warn_if(mut self, condition: bool, text: impl FnOnce() -> String) -> Self {
        if condition {
            self.warnings.push(text());
        }
        self
    }
}
