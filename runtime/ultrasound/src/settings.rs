use crate::{AcousticSource, Background, NeedleSettings, Probe, UltrasoundError};
use serde::{Deserialize, Serialize};

/// What is computed of the image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    /// CT values on the deformed plane, as the paper does it: the geometric reference.
    #[default]
    Slice,
    /// [`Level::Slice`] with a grey map and a depth gain.
    Grey,
    /// Ray model: reflection, transmission, attenuation, shadow, gain by depth.
    Rays,
    /// [`Level::Rays`] with speckle and point spread: B-mode.
    BMode,
}

/// Settings of the image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// What is computed.
    pub level: Level,
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
    /// Gain by depth of [`Level::Grey`], dB/cm; negative darkens with depth.
    pub grey_gain_db_cm: f64,
    /// What [`Level::Rays`] and [`Level::BMode`] take from the tissue and show of it.
    pub acoustic: AcousticSettings,
    /// How needles echo.
    pub needle: NeedleSettings,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            level: Level::Slice,
            width_px: 512,
            height_px: 512,
            background: Background::Surroundings,
            fill_hu: -1000,
            black_hu: -160.0,
            white_hu: 240.0,
            grey_gain_db_cm: -1.0,
            acoustic: AcousticSettings::default(),
            needle: NeedleSettings::default(),
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
        if !(self.grey_gain_db_cm.is_finite() && self.grey_gain_db_cm.abs() <= 100.0) {
            return fault(
                "grey_gain_db_cm",
                self.grey_gain_db_cm.to_string(),
                "-100 to 100 dB/cm",
            );
        }
        self.acoustic.check()?;
        self.needle.check()
    }
}

/// Sound in the tissue and the display of its echoes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AcousticSettings {
    /// What a voxel's properties are taken from.
    pub source: AcousticSource,
    /// Fill between transducer, organ and scan: gel or saline (water) if true, else air, against which the transducer has no
    /// contact. Gel by default, because a gap of air hides all that lies behind it.
    pub gel: bool,
    /// A scan line has contact where something other than air lies within this distance of the face, mm.
    pub contact_mm: f64,
    /// Distance of the reverberation's bands in lines without contact, mm.
    pub reverberation_mm: f64,
    /// Loss from band to band, dB.
    pub reverberation_db: f64,
    /// Width of the specular lobe, degrees: an echo falls with exp(−θ²/σ²) of the angle of incidence.
    pub specular_lobe_deg: f64,
    /// Angle at which the oblique formula stops, degrees: near grazing incidence it reflects everything, at fat beside kidney
    /// from 68° on, and a voxel's step would shadow a whole line. A beam of finite width on a smooth surface is not.
    pub most_incidence_deg: f64,
    /// One-way transmitted intensity below which a line is black: beyond bone and air.
    pub shadow_transmission: f64,
    /// Time gain compensation, one way, dB/(cm·MHz); twice this is applied. 0.7 suits liver.
    pub tgc_db_cm_mhz: f64,
    /// Most gain that the compensation gives, dB.
    pub tgc_most_db: f64,
    /// Echo of unit scatter below that of a perfect reflector, dB: kidney's then lies 47 dB below it, and its capsule against
    /// fat stands out as a bright line.
    pub scatter_db: f64,
    /// Standard deviation of the pulse's envelope along the beam, wavelengths.
    pub axial_sigma_wavelengths: f64,
    /// Standard deviation of the beam across, wavelengths, at the face.
    pub lateral_sigma_near_wavelengths: f64,
    /// The same at the image's full depth; linear between.
    pub lateral_sigma_far_wavelengths: f64,
    /// Echo that is white, dB below a perfect reflector.
    pub white_db: f64,
    /// From white down to black, dB.
    pub dynamic_range_db: f64,
    /// Changes the scatterers' pattern.
    pub seed: u32,
}

impl Default for AcousticSettings {
    fn default() -> Self {
        Self {
            source: AcousticSource::Label,
            gel: true,
            contact_mm: 1.0,
            reverberation_mm: 2.0,
            reverberation_db: 6.0,
            specular_lobe_deg: 30.0,
            most_incidence_deg: 60.0,
            shadow_transmission: 1e-3,
            tgc_db_cm_mhz: 0.7,
            tgc_most_db: 100.0,
            scatter_db: -36.0,
            axial_sigma_wavelengths: 0.75,
            lateral_sigma_near_wavelengths: 2.0,
            lateral_sigma_far_wavelengths: 4.0,
            white_db: -18.0,
            dynamic_range_db: 60.0,
            seed: 0,
        }
    }
}

impl AcousticSettings {
    /// Standard deviation of the beam across at a distance from the face, mm.
    pub(crate) fn lateral_sigma_mm(&self, probe: &Probe, along_mm: f64) -> f64 {
        let near = self.lateral_sigma_near_wavelengths;
        let share = along_mm / probe.depth_mm;
        (near + share * (self.lateral_sigma_far_wavelengths - near)) * probe.wavelength_mm()
    }

    /// # Errors
    /// A value that is out of range.
    pub fn check(&self) -> Result<(), UltrasoundError> {
        let ranges = [
            ("contact_mm", self.contact_mm, 0.0, 100.0, "0 to 100 mm"),
            (
                "reverberation_mm",
                self.reverberation_mm,
                0.1,
                100.0,
                "0.1 to 100 mm",
            ),
            (
                "reverberation_db",
                self.reverberation_db,
                0.0,
                100.0,
                "0 to 100 dB",
            ),
            (
                "specular_lobe_deg",
                self.specular_lobe_deg,
                1.0,
                1000.0,
                "1 to 1000 degrees",
            ),
            (
                "most_incidence_deg",
                self.most_incidence_deg,
                0.0,
                89.0,
                "0 to 89 degrees",
            ),
            (
                "shadow_transmission",
                self.shadow_transmission,
                0.0,
                1.0,
                "0 to 1",
            ),
            (
                "tgc_db_cm_mhz",
                self.tgc_db_cm_mhz,
                0.0,
                20.0,
                "0 to 20 dB/(cm·MHz)",
            ),
            ("tgc_most_db", self.tgc_most_db, 0.0, 300.0, "0 to 300 dB"),
            ("scatter_db", self.scatter_db, -200.0, 50.0, "-200 to 50 dB"),
            (
                "axial_sigma_wavelengths",
                self.axial_sigma_wavelengths,
                0.25,
                10.0,
                "0.25 to 10",
            ),
            (
                "lateral_sigma_near_wavelengths",
                self.lateral_sigma_near_wavelengths,
                0.0,
                50.0,
                "0 to 50",
            ),
            (
                "lateral_sigma_far_wavelengths",
                self.lateral_sigma_far_wavelengths,
                0.0,
                50.0,
                "0 to 50",
            ),
            ("white_db", self.white_db, -300.0, 300.0, "-300 to 300 dB"),
            (
                "dynamic_range_db",
                self.dynamic_range_db,
                1.0,
                300.0,
                "1 to 300 dB",
            ),
        ];
        for (name, v, lo, hi, expected) in ranges {
            if !(v >= lo && v <= hi) {
                return Err(UltrasoundError::Setting {
                    name,
                    found: v.to_string(),
                    expected,
                });
            }
        }
        Ok(())
    }
}
