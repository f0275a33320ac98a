use crate::totalsegmentator::TOTAL_V2;
use std::{io, path::Path};

/// Names of voxel values.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LabelTable {
    /// Label and name, in the order of the source.
    pub entries: Vec<(i64, String)>,
}

/// Labels that make up one body, with its name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Selection {
    /// Name of the body in the package.
    pub name: String,
    /// Labels that belong to it, without repetition, in the order given.
    pub labels: Vec<i64>,
}

/// A published labelling with what it is usually built from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Preset {
    /// Name on the command line.
    pub name: &'static str,
    /// All its labels.
    pub table: LabelTable,
    /// The organ that is built unless another is named; `None` where the user must say.
    pub organ: Option<Selection>,
    /// Structures that are built with that organ unless others are named.
    pub structures: Vec<Selection>,
}

/// A label name, number or list that does not say what is meant.
#[derive(Debug, thiserror::Error)]
pub enum LabelTableError {
    /// The description file cannot be read.
    #[error("the label description file {file} cannot be read")]
    Io {
        /// The file.
        file: String,
        /// What the operating system said.
        #[source]
        source: io::Error,
    },
    /// A line that is no label description.
    #[error(
        "line {line} of {file} is not an ITK-SNAP label description ({found:?}); expected IDX R G B A VIS MSH \"NAME\""
    )]
    BadLine {
        /// The file.
        file: String,
        /// Line number, from 1.
        line: usize,
        /// The line.
        found: String,
    },
    /// A number twice in a description file.
    #[error("line {line} of {file} describes label {label} again")]
    Repeated {
        /// The file.
        file: String,
        /// Line number, from 1.
        line: usize,
        /// The label.
        label: i64,
    },
    /// Neither a number nor a known name.
    #[error("no label is named {name:?}{}", hint(suggestions))]
    UnknownName {
        /// As given.
        name: String,
        /// Similar names, most similar first; empty where there is no table or nothing similar.
        suggestions: Vec<String>,
    },
    /// A name that several labels have.
    #[error("the name {name:?} belongs to labels {labels:?}; give the number")]
    Ambiguous {
        /// As given.
        name: String,
        /// All labels of that name.
        labels: Vec<i64>,
    },
    /// Nothing between two commas, or no label at all.
    #[error("{text:?} has an empty entry; expected labels separated by commas, such as 1,2")]
    EmptyEntry {
        /// As given.
        text: String,
    },
    /// The background as a body.
    #[error("label 0 is the background and cannot be built")]
    Background,
    /// A body name that cannot become a file name.
    #[error(
        "{name:?} cannot be the name of a body; use 1 to 64 letters, digits, '_', '-' or '.', with a letter or digit first"
    )]
    BadBodyName {
        /// As given.
        name: String,
    },
}

fn hint(suggestions: &[String]) -> String {
    match suggestions {
        [] => String::new(),
        some => format!("; did you mean {}?", some.join(" or ")),
    }
}

/// Names of all presets.
pub const PRESET_NAMES: [&str; 2] = ["kits19", "totalsegmentator"];

/// The preset of that name, or `None` where there is none (see [`PRESET_NAMES`]).
pub fn preset(name: &str) -> Option<Preset> {
    let one = |name: &str, label: i64| Selection {
        name: name.to_owned(),
        labels: vec![label],
    };
    match name {
        "kits19" => Some(Preset {
            name: "kits19",
            table: LabelTable {
                entries: vec![(1, "kidney".to_owned()), (2, "tumour".to_owned())],
            },
            organ: Some(one("kidney", 1)),
            structures: vec![one("tumour", 2)],
        }),
        "totalsegmentator" => Some(Preset {
            name: "totalsegmentator",
            table: LabelTable {
                entries: (1..).zip(TOTAL_V2.map(str::to_owned)).collect(),
            },
            organ: None,
            structures: Vec::new(),
        }),
        _ => None,
    }
}

impl LabelTable {
    /// Reads an ITK-SNAP label description file: lines of `IDX R G B A VIS MSH "NAME"`, `#` starts a comment.
    ///
    /// # Errors
    /// [`LabelTableError::Io`], [`LabelTableError::BadLine`] or [`LabelTableError::Repeated`].
    pub fn from_itksnap(path: impl AsRef<Path>) -> Result<Self, LabelTableError> {
        let file = path.as_ref().display().to_string();
        match std::fs::read(path) {
            Ok(bytes) => Self::parse_itksnap(&String::from_utf8_lossy(&bytes), &file),
            Err(source) => Err(LabelTableError::Io { file, source }),
        }
    }

    /// The same from text; `file` is named in errors.
    pub fn parse_itksnap(text: &str, file: &str) -> Result<Self, LabelTableError> {
        let mut out = Self::default();
        for (n, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let (label, name) = itksnap_line(line).ok_or_else(|| LabelTableError::BadLine {
                file: file.to_owned(),
                line: n + 1,
                found: line.chars().take(80).collect(),
            })?;
            if out.name(label).is_some() {
                return Err(LabelTableError::Repeated {
                    file: file.to_owned(),
                    line: n + 1,
                    label,
                });
            }
            out.entries.push((label, name.to_owned()));
        }
        Ok(out)
    }

    /// Name of a label.
    pub fn name(&self, label: i64) -> Option<&str> {
        self.entries
            .iter()
            .find(|(l, _)| *l == label)
            .map(|(_, n)| n.as_str())
    }

    /// The label that `text` names: a number, or a name of this table. Exact names win; otherwise case is ignored and
    /// space, `_` and `-` are the same.
    ///
    /// # Errors
    /// [`LabelTableError::UnknownName`] with similar names, or [`LabelTableError::Ambiguous`].
    pub fn label(&self, text: &str) -> Result<i64, LabelTableError> {
        let text = text.trim();
        if let Ok(label) = text.parse() {
            return Ok(label);
        }
        let having = |same: &dyn Fn(&str) -> bool| -> Vec<i64> {
            self.entries
                .iter()
                .filter(|(_, n)| same(n))
                .map(|(l, _)| *l)
                .collect()
        };
        let mut found = having(&|n| n == text);
        if found.is_empty() {
            found = having(&|n| plain(n) == plain(text));
        }
        match found[..] {
            [label] => Ok(label),
            [] => Err(LabelTableError::UnknownName {
                name: text.to_owned(),
                suggestions: self.similar(text),
            }),
            _ => Err(LabelTableError::Ambiguous {
                name: text.to_owned(),
                labels: found,
            }),
        }
    }

    /// Labels of a comma-separated list of numbers and names, each once.
    ///
    /// # Errors
    /// As [`LabelTable::label`]; [`LabelTableError::EmptyEntry`]; [`LabelTableError::Background`] for label 0.
    pub fn parse_label_list(&self, text: &str) -> Result<Vec<i64>, LabelTableError> {
        let mut out = Vec::new();
        for part in text.split(',') {
            if part.trim().is_empty() {
                return Err(LabelTableError::EmptyEntry {
                    text: text.to_owned(),
                });
            }
            let label = self.label(part)?;
            if label == 0 {
                return Err(LabelTableError::Background);
            }
            if !out.contains(&label) {
                out.push(label);
            }
        }
        Ok(out)
    }

    /// Up to three names that look like `text`, most similar first: the same words in another order, the text as a
    /// part, or few letters changed.
    pub fn similar(&self, text: &str) -> Vec<String> {
        let wanted = plain(text);
        let words = |s: &str| {
            let mut w: Vec<String> = s.split('_').map(str::to_owned).collect();
            w.sort();
            w
        };
        let mut scored: Vec<(usize, usize, &str)> = Vec::new();
        for (n, (_, name)) in self.entries.iter().enumerate() {
            let candidate = plain(name);
            let distance = edit_distance(&wanted, &candidate);
            let score = if words(&wanted) == words(&candidate) {
                0
            } else if wanted.len() >= 3 && candidate.contains(&wanted) {
                1
            } else if 3 * distance <= wanted.chars().count().max(3) {
                1 + distance
            } else {
                continue;
            };
            scored.push((score, n, name));
        }
        scored.sort();
        scored
            .into_iter()
            .take(3)
            .map(|(_, _, name)| name.to_owned())
            .collect()
    }
}

impl Selection {
    /// Parses `NAME=L[,L…]`, each L a number or a name of `table`, or a bare `NAME` that `table` knows.
    ///
    /// # Errors
    /// What [`LabelTable::parse_label_list`] says, or [`LabelTableError::BadBodyName`].
    pub fn parse(text: &str, table: &LabelTable) -> Result<Self, LabelTableError> {
        let (name, labels) = text.split_once('=').unwrap_or((text, text));
        let labels = table.parse_label_list(labels)?;
        // A bare name is the table's own spelling, whatever the user's; spaces do not suit file names.
        let own = match labels[..] {
            [label] if !text.contains('=') => table.name(label).unwrap_or(name),
            _ => name,
        };
        let name = own.trim().replace(' ', "_");
        let fine = |c: char| c.is_alphanumeric() || matches!(c, '_' | '-' | '.');
        let first = name.chars().next().is_some_and(char::is_alphanumeric);
        if !first || name.chars().count() > 64 || !name.chars().all(fine) {
            return Err(LabelTableError::BadBodyName { name: own.to_owned() });
        }
        Ok(Self { name, labels })
    }
}

/// Lower case, with `_` for space and `-`.
fn plain(name: &str) -> String {
    name.trim().to_lowercase().replace([' ', '-'], "_")
}

fn itksnap_line(line: &str) -> Option<(i64, &str)> {
    let (numbers, rest) = line.split_once('"')?;
    let (name, after) = rest.rsplit_once('"')?;
    let mut fields = numbers.split_whitespace();
    let label = fields.next()?.parse().ok()?;
    let others = fields
        .map(str::parse::<f64>)
        .collect::<Result<Vec<_>, _>>()
        .ok()?;
    (others.len() == 6 && after.trim().is_empty()).then_some((label, name))
}

/// Levenshtein distance in characters.
fn edit_distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (n, ca) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = n + 1;
        for (m, &cb) in b.iter().enumerate() {
            let change = diagonal + usize::from(ca != cb);
            diagonal = row[m + 1];
            row[m + 1] = change.min(diagonal + 1).min(row[m] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn total() -> LabelTable {
        preset("totalsegmentator").unwrap().table
    }

    #[test]
    fn presets_have_their_labels() {
        for name in PRESET_NAMES {
            assert_eq!(preset(name).unwrap().name, name);
        }
        assert!(preset("kits").is_none());
        let t = total();
        assert_eq!(t.entries.len(), 117);
        for (label, name) in [
            (1, "spleen"),
            (2, "kidney_right"),
            (5, "liver"),
            (52, "aorta"),
            (117, "costal_cartilages"),
        ] {
            assert_eq!(t.name(label), Some(name));
            assert_eq!(t.label(name).unwrap(), label);
        }
        assert_eq!(preset("kits19").unwrap().structures[0].labels, [2]);
    }

    #[test]
    fn selections() {
        let t = total();
        let s = |text: &str| Selection::parse(text, &t);
        let sel = |name: &str, labels: &[i64]| Selection {
            name: name.to_owned(),
            labels: labels.to_vec(),
        };
        assert_eq!(s("kidney=2,3").unwrap(), sel("kidney", &[2, 3]));
        assert_eq!(
            s("both = kidney_left, kidney_right,2").unwrap(),
            sel("both", &[3, 2])
        );
        assert_eq!(s("Kidney Right").unwrap(), sel("kidney_right", &[2]));
        assert_eq!(s("2").unwrap(), sel("kidney_right", &[2]));
        assert!(matches!(s("x=2,,3"), Err(LabelTableError::EmptyEntry { .. })));
        assert!(matches!(s("x="), Err(LabelTableError::EmptyEntry { .. })));
        assert!(matches!(s("x=0"), Err(LabelTableError::Background)));
        for bad in ["=2", "../x=2", "a/b=2", "-a=2", "a\tb=2"] {
            assert!(
                matches!(s(bad), Err(LabelTableError::BadBodyName { .. })),
                "{bad}"
            );
        }
    }

    #[test]
    fn unknown_names_suggest() {
        let said = |text: &str| total().label(text).unwrap_err().to_string();
        assert!(
            said("right kidney").ends_with("did you mean kidney_right?"),
            "{}",
            said("right kidney")
        );
        assert!(
            said("kidny_left").contains("did you mean kidney_left"),
            "{}",
            said("kidny_left")
        );
        assert!(
            said("kidney").contains("kidney_right or kidney_left"),
            "{}",
            said("kidney")
        );
        assert_eq!(said("xyzzy"), "no label is named \"xyzzy\"");
    }

    #[test]
    fn itksnap_files() {
        let text = "\u{feff}################\r\n# ITK-SnAP Label Description File\r\n\
            0 0 0 0 0 0 0 \"Clear Label\"\r\n  1  255 0 0  1  1 1  \"Left Kidney\"\r\n12 0 9 0 0.5 1 1 \"say \"x\"\"\r\n";
        let t = LabelTable::parse_itksnap(text, "labels.txt").unwrap();
        assert_eq!(t.name(1), Some("Left Kidney"));
        assert_eq!(t.name(12), Some("say \"x\""));
        assert_eq!(Selection::parse("left_kidney", &t).unwrap().name, "Left_Kidney");
        for bad in [
            "1 255 0 0 1 1 \"six\"",
            "1 2 3 4 5 6 7 none",
            "x 0 0 0 1 1 1 \"n\"",
            "1 0 0 0 1 1 1 \"n\" 7",
        ] {
            let err = LabelTable::parse_itksnap(&format!("# c\n{bad}"), "f").unwrap_err();
            assert!(matches!(err, LabelTableError::BadLine { line: 2, .. }), "{bad}");
        }
        let twice = "1 0 0 0 1 1 1 \"a\"\n1 0 0 0 1 1 1 \"b\"";
        let err = LabelTable::parse_itksnap(twice, "f").unwrap_err();
        assert!(matches!(
            err,
            LabelTableError::Repeated {
                line: 2,
                label: 1,
                ..
            }
        ));
    }

    #[test]
    fn names_that_several_labels_have() {
        let t = LabelTable {
            entries: vec![(1, "a b".to_owned()), (2, "A_b".to_owned())],
        };
        assert_eq!(t.label("A_b").unwrap(), 2);
        assert!(matches!(t.label("a-b"), Err(LabelTableError::Ambiguous { .. })));
        assert_eq!(edit_distance("kitten", "sitting"), 3);
    }
}
