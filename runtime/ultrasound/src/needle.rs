//! Needles in the image: a polyline that echoes, rings and shadows in the beams, and a thin line on images without sound.

use crate::acoustics::{normal_reflection, specular_lobe};
use crate::properties::Properties;
use crate::vector::{norm, scale, sub};
use crate::{AcousticSettings, PixelGrid, Probe, ProbePose, UltrasoundError};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// A needle, stylet or other thin rod.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Needle {
    /// Its centreline from the hub to the tip, patient RAS+ mm.
    pub points_mm: Vec<[f64; 3]>,
    /// Outer radius, mm.
    pub radius_mm: f64,
}

impl Needle {
    pub(crate) fn check(&self) -> Result<(), UltrasoundError> {
        let fault = |what, found: String, expected| {
            Err(UltrasoundError::Needle {
                what,
                found,
                expected,
            })
        };
        if !(2..=MOST_POINTS).contains(&self.points_mm.len()) {
            return fault(
                "points_mm",
                format!("{} points", self.points_mm.len()),
                "2 to 10000",
            );
        }
        if let Some(p) = self
            .points_mm
            .iter()
            .find(|p| !p.iter().all(|v| v.is_finite() && v.abs() < 1e6))
        {
            return fault("points_mm", format!("{p:?}"), "finite mm below 10⁶");
        }
        if !(self.radius_mm > 0.0 && self.radius_mm <= 20.0) {
            return fault("radius_mm", self.radius_mm.to_string(), "above 0, up to 20 mm");
        }
        Ok(())
    }
}

const MOST_POINTS: usize = 10_000;

/// How needles echo. Steel's impedance is a handbook value; the other figures are assumptions set by the look of images of
/// biopsy needles, not measured ones.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NeedleSettings {
    /// Acoustic impedance, MRayl. 46: steel of 7.9 g/cm³ and 5800 m/s.
    pub impedance_mrayl: f64,
    /// Echo of the shaft that does not depend on its angle, dB below a perfect reflector. Its mirror echo falls with the
    /// angle between beam and shaft's normal by [`AcousticSettings::specular_lobe_deg`], so a steep shaft has this alone.
    pub diffuse_db: f64,
    /// Echo of the tip, whose bevel sends sound back at any angle, dB below a perfect reflector.
    pub tip_db: f64,
    /// Two-way loss behind a shaft in the plane, dB.
    pub shadow_db: f64,
    /// Distance of the echoes that follow the shaft's own, mm: a bore of 1 mm.
    pub reverberation_mm: f64,
    /// Loss from one such echo to the next, dB.
    pub reverberation_db: f64,
}

impl Default for NeedleSettings {
    fn default() -> Self {
        Self {
            impedance_mrayl: 46.0,
            diffuse_db: -25.0,
            tip_db: -8.0,
            shadow_db: 6.0,
            reverberation_mm: 1.0,
            reverberation_db: 8.0,
        }
    }
}

impl NeedleSettings {
    pub(crate) fn check(&self) -> Result<(), UltrasoundError> {
        let ranges = [
            (
                "impedance_mrayl",
                self.impedance_mrayl,
                1e-6,
                1000.0,
                "10⁻⁶ to 1000 MRayl",
            ),
            ("diffuse_db", self.diffuse_db, -200.0, 0.0, "-200 to 0 dB"),
            ("tip_db", self.tip_db, -200.0, 0.0, "-200 to 0 dB"),
            ("shadow_db", self.shadow_db, 0.0, 200.0, "0 to 200 dB"),
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
                1.0,
                200.0,
                "1 to 200 dB",
            ),
        ];
        match ranges
            .into_iter()
            .find(|&(_, v, lo, hi, _)| !(v >= lo && v <= hi))
        {
            Some((name, v, _, _, expected)) => Err(UltrasoundError::Setting {
                name,
                found: v.to_string(),
                expected,
            }),
            None => Ok(()),
        }
    }
}

/// A short piece of a needle in the probe's frame: lateral, depth, elevation, mm.
struct Piece {
    at: [f64; 3],
    length_mm: f64,
    direction: [f64; 3],
}

/// Most pieces of one segment.
const MOST_PIECES: f64 = 20_000.0;

/// Calls `each` for pieces of at most `step_mm` in order from the hub to the tip; segments that stay further than `reach_mm`
/// on one side of the plane are left out.
fn pieces(needle: &Needle, pose: &ProbePose, step_mm: f64, reach_mm: f64, mut each: impl FnMut(Piece)) {
    for ends in needle.points_mm.windows(2) {
        let (a, b) = (pose.plane(ends[0]), pose.plane(ends[1]));
        let way = sub(b, a);
        let length = norm(way);
        let beside = (a[2] > reach_mm && b[2] > reach_mm) || (a[2] < -reach_mm && b[2] < -reach_mm);
        if length <= 0.0 || beside {
            continue;
        }
        let n = (length / step_mm).ceil().clamp(1.0, MOST_PIECES);
        let direction = scale(way, 1.0 / length);
        for k in 0..n as usize {
            let t = (k as f64 + 0.5) / n;
            each(Piece {
                at: [0, 1, 2].map(|c| a[c] + t * way[c]),
                length_mm: length / n,
                direction,
            });
        }
    }
}

/// Amplitude of the beam's profile across the plane, whose full width at half maximum is the probe's thickness, at a rod's
/// nearest point.
fn profile(probe: &Probe, elevation_mm: f64, radius_mm: f64) -> f64 {
    let sigma = probe.thickness_mm / (8.0 * std::f64::consts::LN_2).sqrt();
    let off = (elevation_mm.abs() - radius_mm).max(0.0);
    if off <= 0.0 {
        return 1.0;
    }
    (-0.5 * (off / sigma.max(1e-6)).powi(2)).exp()
}

/// How far from the plane a needle is seen at all, in thicknesses: below −100 dB beyond.
const SEEN: f64 = 2.1;

/// Echoes and losses of needles on scan lines; arrays are `[line·samples + sample]`.
#[derive(Clone, Debug, Default)]
pub(crate) struct NeedleEchoes {
    echo: Vec<f32>,
    loss_db: Vec<f32>,
}

/// What the echoes are made from.
pub(crate) struct Medium<'a> {
    pub(crate) probe: &'a Probe,
    pub(crate) acoustic: &'a AcousticSettings,
    pub(crate) needle: &'a NeedleSettings,
    pub(crate) samples: usize,
    pub(crate) step_mm: f64,
    /// Whether the beam's width will be applied.
    pub(crate) blurred: bool,
    pub(crate) properties: &'a [Properties],
}

impl NeedleEchoes {
    /// Adds the needles to interface echoes and takes their shadow from these and from scatterers' amplitudes.
    pub(crate) fn apply(
        &mut self,
        needles: &[Needle],
        pose: &ProbePose,
        medium: &Medium,
        amplitude: &mut [f32],
        interface: &mut [f32],
    ) {
        self.echo.clear();
        self.echo.resize(amplitude.len(), 0.0);
        self.loss_db.clear();
        self.loss_db.resize(amplitude.len(), 0.0);
        for needle in needles {
            self.add(needle, pose, medium, amplitude);
        }
        let m = medium.samples;
        amplitude
            .par_chunks_mut(m)
            .zip(interface.par_chunks_mut(m))
            .zip(self.echo.par_chunks(m).zip(self.loss_db.par_chunks(m)))
            .for_each(|((amplitude, interface), (echo, loss))| {
                let mut behind = 0.0;
                for j in 0..amplitude.len() {
                    if behind > 0.0 {
                        let open = 10f32.powf(-behind / 20.0);
                        amplitude[j] *= open;
                        interface[j] *= open;
                    }
                    // A needle does not shade its own echoes.
                    interface[j] += echo[j];
                    behind += loss[j];
                }
            });
    }

    fn add(&mut self, needle: &Needle, pose: &ProbePose, medium: &Medium, amplitude: &[f32]) {
        let (probe, s) = (medium.probe, medium.needle);
        let radius = needle.radius_mm;
        let lobe = medium.acoustic.specular_lobe_deg.to_radians();
        let level = |db: f64| 10f64.powf(db / 20.0);
        let (diffuse, fading) = (level(s.diffuse_db), level(-s.reverberation_db));
        // Two pieces a sample: the sum over a line is then the integral to a percent.
        let step = 0.5 * medium.step_mm;
        let reach = SEEN * probe.thickness_mm + radius;
        pieces(needle, pose, step, reach, |piece| {
            let [x, z, y] = piece.at;
            let [line, along] = probe.beam([x, z]);
            if !probe.sees([x, z]) {
                return;
            }
            let Some(place) = Place::new(medium, line, along) else {
                return;
            };
            let (_, beam) = probe.line(line);
            let t = piece.direction;
            let cosine = (t[0] * beam[0] + t[1] * beam[1]).abs().min(1.0);
            let z_tissue = f64::from(medium.properties[place.nearest][0]).exp();
            let r = normal_reflection(z_tissue, s.impedance_mrayl).abs();
            let seen = profile(probe, y, radius) * f64::from(amplitude[place.nearest]);
            // Of a scan line's width this piece takes this share.
            let pitch = probe.pitch_mm(along).max(1e-6);
            let wide = piece.length_mm / pitch;
            let mirror = r * specular_lobe(cosine.asin(), lobe);
            place.put(&mut self.echo, wide * seen * mirror.max(r * diffuse));
            // The mirror's echo rings on.
            let mut ring = wide * seen * mirror * fading;
            let mut below = along + s.reverberation_mm;
            while ring > 1e-6 {
                let Some(place) = Place::new(medium, line, below) else {
                    break;
                };
                place.put(&mut self.echo, ring);
                ring *= fading;
                below += s.reverberation_mm;
            }
            let across = (1.0 - cosine * cosine).sqrt();
            let loss = s.shadow_db * profile(probe, y, radius) * wide * across;
            place.put(&mut self.loss_db, loss);
        });
        let Some(&tip) = needle.points_mm.last() else {
            return;
        };
        let [x, z, y] = pose.plane(tip);
        let [line, along] = probe.beam([x, z]);
        if !probe.sees([x, z]) || y.abs() > reach {
            return;
        }
        let Some(place) = Place::new(medium, line, along) else {
            return;
        };
        let pitch = probe.pitch_mm(along).max(1e-6);
        // A point loses to the beam's width, which a line across the beam does not: √2π σ lines of it.
        let sigma = medium.acoustic.lateral_sigma_mm(probe, along);
        let lines = (std::f64::consts::TAU.sqrt() * sigma / pitch).max(1.0);
        let gain = if medium.blurred { lines } else { 1.0 };
        let seen = profile(probe, y, radius) * f64::from(amplitude[place.nearest]);
        place.put(&mut self.echo, level(s.tip_db) * gain * seen);
        let loss = s.shadow_db * profile(probe, y, radius) * (2.0 * radius / pitch).min(1.0);
        place.put(&mut self.loss_db, loss);
    }
}

/// The four samples around a place on the scan lines.
struct Place {
    at: [usize; 4],
    weight: [f64; 4],
    nearest: usize,
}

impl Place {
    /// None beyond the last sample.
    fn new(medium: &Medium, line: f64, along_mm: f64) -> Option<Self> {
        let (m, sample) = (medium.samples, along_mm / medium.step_mm);
        let last = medium.probe.lines - 1;
        if !(sample >= 0.0 && sample < (m - 1) as f64 && line >= 0.0 && line <= last as f64) {
            return None;
        }
        let (i, j) = ((line as usize).min(last - 1), sample as usize);
        let (u, v) = (line - i as f64, sample - j as f64);
        let n = i * m + j;
        Some(Self {
            at: [n, n + 1, n + m, n + m + 1],
            weight: [(1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v],
            nearest: (line.round() as usize).min(last) * m + sample.round() as usize,
        })
    }

    fn put(&self, into: &mut [f32], value: f64) {
        for (&n, w) in self.at.iter().zip(self.weight) {
            into[n] += (w * value) as f32;
        }
    }
}

/// Draws the needles one pixel wide in white, where they lie within the beam's thickness.
pub(crate) fn overlay(
    needles: &[Needle],
    pose: &ProbePose,
    probe: &Probe,
    grid: &PixelGrid,
    grey: &mut [u8],
) {
    for needle in needles {
        let reach = 0.5 * probe.thickness_mm + needle.radius_mm;
        pieces(needle, pose, 0.5 * grid.pixel_mm, reach, |piece| {
            let [x, z, y] = piece.at;
            if y.abs() > reach || !probe.sees([x, z]) {
                return;
            }
            let [column, row] = grid.pixel([x, z]).map(|v| v.round());
            if column >= 0.0 && row >= 0.0 && (column as usize) < grid.width_px {
                let n = column as usize + grid.width_px * row as usize;
                if let Some(pixel) = grey.get_mut(n) {
                    *pixel = 255;
                }
            }
        });
    }
}
