use super::Scene;
use super::names::{differ_in_unit, nearest};
use crate::RehearseError;
use std::path::{Path, PathBuf};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// A scene with the text that it was read from, so that every complaint can name its line.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneSource {
    /// The scene.
    pub scene: Scene,
    /// The file.
    pub path: PathBuf,
    text: String,
}

impl SceneSource {
    /// Reads and checks a scene file; packages are not opened.
    ///
    /// # Errors
    /// - [`RehearseError::Read`] for a file that cannot be read.
    /// - [`RehearseError::Scene`] for everything that is wrong in it, with its line.
    pub fn read(path: &Path) -> Result<Self, RehearseError> {
        let text = std::fs::read_to_string(path).map_err(|source| RehearseError::Read {
            what: "scene",
            source,
            path: path.into(),
        })?;
        Self::parse(&text, path)
    }

    /// [`SceneSource::read`] for a text; `path` stands in messages and is where relative paths start.
    ///
    /// # Errors
    /// As [`SceneSource::read`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, RehearseError> {
        let scene = toml::from_str(text).map_err(|e| syntax(&e, text, path))?;
        let out = Self {
            scene,
            path: path.into(),
            text: text.into(),
        };
        out.check()?;
        Ok(out)
    }

    /// A path of the scene, as it stands or from the scene's folder on.
    pub fn resolve(&self, path: &Path) -> PathBuf {
        match self.path.parent() {
            Some(folder) if path.is_relative() => folder.join(path),
            _ => path.into(),
        }
    }

    /// An error at the line of a key such as `instrument[0].size_mm`; where the key is absent, at its table.
    pub fn fault(&self, key: &str, message: impl Into<String>) -> RehearseError {
        RehearseError::Scene {
            line: self.line_of(key),
            message: message.into(),
            path: self.path.clone(),
        }
    }

    /// File and line of a key, or of the table that should hold it.
    pub fn place_of(&self, key: &str) -> String {
        format!("{}:{}", self.path.display(), self.line_of(key))
    }

    /// Whether the text holds this key.
    pub(super) fn has(&self, key: &str) -> bool {
        self.find(key).1
    }

    fn line_of(&self, key: &str) -> usize {
        line_at(&self.text, self.find(key).0)
    }

    /// Where the value of a key starts, or of the table that should hold it, and whether it is the key's own.
    fn find(&self, key: &str) -> (usize, bool) {
        let Ok(table) = DeTable::parse(&self.text) else {
            return (0, false);
        };
        let mut start = 0;
        let mut here: Option<&Spanned<DeValue>> = None;
        for part in key.split(['.', '[']).filter(|p| !p.is_empty()) {
            let next = match part.strip_suffix(']') {
                Some(index) => index
                    .parse()
                    .ok()
                    .and_then(|i: usize| here?.get_ref().as_array()?.get(i)),
                None => match here {
                    None => table.get_ref().get(part),
                    Some(v) => v.get_ref().as_table().and_then(|t| t.get(part)),
                },
            };
            match next {
                Some(v) => {
                    start = v.span().start;
                    here = Some(v);
                }
                None => return (start, false),
            }
        }
        (start, true)
    }
}

fn line_at(text: &str, byte: usize) -> usize {
    1 + text.bytes().take(byte).filter(|&b| b == b'\n').count()
}

/// The parser's complaint with the nearest valid key added: serde's message lists the valid ones.
fn syntax(error: &toml::de::Error, text: &str, path: &Path) -> RehearseError {
    let raw = error.message();
    let message = match unknown_key(raw) {
        Some((found, known)) => {
            let hint = match nearest(&found, &known) {
                Some(k) if differ_in_unit(&found, k) => {
                    format!("the nearest valid key is \"{k}\" (mind the unit)")
                }
                Some(k) => format!("the nearest valid key is \"{k}\""),
                None => format!("valid keys: {}", known.join(", ")),
            };
            format!("unknown key \"{found}\"; {hint}")
        }
        None => match unknown_value(raw) {
            Some((found, known)) => {
                let hint =
                    nearest(&found, &known).map_or_else(String::new, |k| format!("; did you mean \"{k}\"?"));
                format!("found \"{found}\", expected {}{hint}", known.join(", "))
            }
            None => raw.trim().to_string(),
        },
    };
    RehearseError::Scene {
        line: error.span().map_or(1, |s| line_at(text, s.start)),
        message,
        path: path.into(),
    }
}

fn listed<'a>(raw: &'a str, intro: &str) -> Option<(String, Vec<&'a str>)> {
    let rest = raw.trim().strip_prefix(intro)?;
    let mut quoted = rest.split('`').skip(1).step_by(2);
    let found = quoted.next()?.to_string();
    Some((found, quoted.collect()))
}

fn unknown_key(raw: &str) -> Option<(String, Vec<&str>)> {
    listed(raw, "unknown field ")
}

fn unknown_value(raw: &str) -> Option<(String, Vec<&str>)> {
    listed(raw, "unknown variant ")
}
