use std::path::Path;
use thiserror::Error;

/// Named points in patient RAS mm.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Fiducials {
    /// One name per point.
    pub names: Vec<String>,
    /// Positions in patient RAS mm.
    pub positions: Vec<[f64; 3]>,
}

/// Why a fiducial file was refused.
#[derive(Debug, Error)]
pub enum FiducialError {
    /// The file cannot be read.
    #[error("cannot read the fiducials: {source}: {path}")]
    Io {
        /// What the system said.
        source: std::io::Error,
        /// File.
        path: String,
    },
    /// A line is not `name,x,y,z`.
    #[error(
        "fiducial line {line}: found {found:?}, expected name,x,y,z with numbers in patient RAS mm: {path}"
    )]
    Line {
        /// Line number from 1.
        line: usize,
        /// The line.
        found: String,
        /// File.
        path: String,
    },
    /// Nothing in it.
    #[error("no fiducials in the file; expected lines name,x,y,z in patient RAS mm: {path}")]
    Empty {
        /// File.
        path: String,
    },
}

impl Fiducials {
    /// Reads a CSV of name,x,y,z. Blank lines and lines that start with `#` are passed over, as is a first line
    /// whose last three cells are not numbers (a heading).
    pub fn read(path: &Path) -> Result<Self, FiducialError> {
        let shown = path.display().to_string();
        let bytes = std::fs::read(path).map_err(|source| FiducialError::Io {
            source,
            path: shown.clone(),
        })?;
        Self::parse(&String::from_utf8_lossy(&bytes), &shown)
    }

    fn parse(text: &str, path: &str) -> Result<Self, FiducialError> {
        let mut out = Self::default();
        for (n, line) in text.lines().enumerate() {
            let line = line.trim().trim_start_matches('\u{feff}');
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let cells: Vec<&str> = line.split([',', ';', '\t']).map(str::trim).collect();
            let point = match cells.as_slice() {
                [_, xyz @ ..] if xyz.len() == 3 => {
                    let v: Vec<f64> = xyz.iter().filter_map(|c| c.parse().ok()).collect();
                    <[f64; 3]>::try_from(v)
                        .ok()
                        .filter(|p| p.iter().all(|c| c.is_finite()))
                }
                _ => None,
            };
            match point {
                Some(p) => {
                    out.names.push(cells[0].to_string());
                    out.positions.push(p);
                }
                None if n == 0
                    && cells.len() == 4
                    && cells[1..].iter().all(|c| c.parse::<f64>().is_err()) => {}
                None => {
                    return Err(FiducialError::Line {
                        line: n + 1,
                        found: line.chars().take(80).collect(),
                        path: path.to_string(),
                    });
                }
            }
        }
        if out.names.is_empty() {
            return Err(FiducialError::Empty {
                path: path.to_string(),
            });
        }
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heading_comments_and_separators() {
        let f = Fiducials::parse("name,x,y,z\n# beads\nb1, 1.5,-2,3e1\n\nb2;4;5;6\n", "f.csv").unwrap();
        assert_eq!(f.names, ["b1", "b2"]);
        assert_eq!(f.positions, [[1.5, -2.0, 30.0], [4.0, 5.0, 6.0]]);
    }

    #[test]
    fn faults_name_the_line() {
        for (text, line) in [
            ("b1,1,2,3\nb2,1,2\n", 2),
            ("b1,1,x,3\n", 1),
            ("a,1,2,3\nb,1,2,nan\n", 2),
            ("a,1,2,3\nb,q,r,s\n", 2),
        ] {
            match Fiducials::parse(text, "f.csv") {
                Err(FiducialError::Line { line: l, .. }) => assert_eq!(l, line, "{text}"),
                other => panic!("{text}: {other:?}"),
            }
        }
        assert!(matches!(
            Fiducials::parse("# nothing\n", "f.csv"),
            Err(FiducialError::Empty { .. })
        ));
    }
}
