use crate::{Background, UltrasoundError};
use serde::{Deserialize, Serialize};

/// Settings of the image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// What is shown outside of the deformed meshes.
    pub background: Background,
    /// CT value where nothing is known, HU. Air, which is black.
    pub fill_hu: i16,
    /// CT value that is black, HU.
    pub black_hu: f32,
    /// CT value that is white, HU. With −160 and 240 soft tissue fills the grey range.
    pub white_hu: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            width_px: 512,
            height_px: 512,
            background: Background::Surroundings,
            fill_hu: -1000,
            black_hu: -160.0,
            white_hu: 240.0,
        }
    }
}

impl Settings {
    /// # Errors
    /// A value that is out of range.
    pub fn check(&self) -> Result<(), UltrasoundError> {
        let fault = |name, found: String, expected| {
            Err(UltrasoundError::Setting {
                name,
                found,
                expected,
            })
        };
        for (name, n) in [("width_px", self.width_px), ("height_px", self.height_px)] {
            if !(1..=8192).contains(&n) {
                return fault(name, n.to_string(), "1 to 8192");
            }
        }
        if !(self.black_hu.is_finite() && self.white_hu.is_finite() && self.black_hu < self.white_hu) {
            return fault(
                "black_hu",
                format!("{} with white_hu {}", self.black_hu, self.white_hu),
                "finite and below white_hu",
            );
        }
        Ok(())
    }
}
