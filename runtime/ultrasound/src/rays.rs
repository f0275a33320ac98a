//! Reflection, transmission, attenuation and gain along one scan line.

use crate::acoustics::specular_lobe;
use crate::properties::Properties;
use crate::{AcousticSettings, Probe, Source};

/// Per-line constants.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RayModel {
    pub(crate) step_mm: f64,
    /// Width over which the scan blurs an interface: its mean voxel size, mm.
    pub(crate) blur_mm: f64,
    pub(crate) frequency_mhz: f64,
    pub(crate) settings: AcousticSettings,
}

/// Where a line's samples lie, for the gradient across lines.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Neighbours<'a> {
    pub(crate) before: &'a [Properties],
    pub(crate) after: &'a [Properties],
    /// Lines from `before` to `after`: 2, or 1 at the image's sides.
    pub(crate) lines: f64,
}

/// Impedance below which there is no contact, MRayl: far below all tissue, far above air.
const CONTACT_MRAYL: f32 = 0.1;

/// Natural logarithm of the amplitude of one dB.
const DB: f64 = std::f64::consts::LN_10 / 20.0;

impl RayModel {
    /// `sources`: where the samples are from, as the numbers of [`Source`]. Fills `amplitude` (two-way factor of a scatterer's echo, depth gain included) and `interface` (echo of interfaces with
    /// the same factor). Returns whether the line has contact.
    pub(crate) fn line(
        &self,
        probe: &Probe,
        line: &[Properties],
        sources: &[u8],
        near: Neighbours,
        amplitude: &mut [f32],
        interface: &mut [f32],
    ) -> bool {
        let s = &self.settings;
        let first = ((s.contact_mm / self.step_mm).floor() as usize + 1).min(line.len());
        let contact = line[..first].iter().any(|p| p[0] > CONTACT_MRAYL.ln());
        interface.fill(0.0);
        if !contact {
            amplitude.fill(0.0);
            self.reverberation(interface);
            return false;
        }
        let blur = self.blur_mm.max(self.step_mm);
        let most = s.most_incidence_deg.to_radians();
        let lobe = s.specular_lobe_deg.to_radians();
        // One-way intensity through the interfaces so far, and one-way loss in dB.
        let (mut through, mut loss_db) = (1.0f64, 0.0f64);
        for j in 0..line.len() {
            let along = j as f64 * self.step_mm;
            let gain_db = (2.0 * s.tgc_db_cm_mhz * self.frequency_mhz * along * 0.1).min(s.tgc_most_db);
            let open = if through < s.shadow_transmission {
                0.0
            } else {
                through
            };
            // Out and back: the square of the one-way intensity is the intensity, so this is the amplitude.
            let factor = open * ((gain_db - 2.0 * loss_db) * DB).exp();
            amplitude[j] = factor as f32;
            let Some(next) = line.get(j + 1) else { break };
            let here = &line[j];
            let mean = 0.5 * f64::from(here[2] + next[2]);
            loss_db += mean * self.frequency_mhz * self.step_mm * 0.1;
            // Nothing is known here, so there is no interface either.
            let unknown =
                |n: usize| sources[n] == Source::Outside as u8 || sources[n] == Source::BeyondScan as u8;
            if unknown(j) && unknown(j + 1) {
                continue;
            }
            let dz = f64::from(next[0] - here[0]) / self.step_mm;
            let dc = f64::from(next[1] - here[1]) / self.step_mm;
            let pitch = near.lines * probe.pitch_mm(along);
            let cross = |q: usize| f64::from(near.after[j][q] - near.before[j][q]) / pitch;
            let across = cross(0);
            let steep = (dz * dz + across * across).sqrt();
            if steep * blur < 1e-4 {
                continue;
            }
            let cosine = (dz.abs() / steep).min(1.0);
            let incidence = cosine.acos();
            // Across the whole interface, in the beam's sense.
            let sense = if dz < 0.0 { -1.0 } else { 1.0 };
            let jump_z = sense * steep * blur;
            let jump_c = sense * (dc * dz + cross(1) * across) / steep * blur;
            let r = reflection(jump_z, jump_c, incidence.min(most));
            let echo = r.abs() * specular_lobe(incidence, lobe) * factor;
            // The step lies between the two samples.
            interface[j] += 0.5 * echo as f32;
            interface[j + 1] += 0.5 * echo as f32;
            through *= (1.0 - r * r)
                .max(0.0)
                .powf(self.step_mm * cosine.max(most.cos()) / blur);
        }
        true
    }

    /// Ringing of the transducer's own layers against air: bands that fall off with depth.
    fn reverberation(&self, interface: &mut [f32]) {
        let s = &self.settings;
        for (j, out) in interface.iter_mut().enumerate() {
            let along = j as f64 * self.step_mm;
            let order = (along / s.reverberation_mm).round().max(1.0);
            let off = (along - order * s.reverberation_mm) / (0.12 * s.reverberation_mm);
            *out = (10f64.powf(-s.reverberation_db * order / 20.0) * (-off * off).exp()) as f32;
        }
    }
}

/// Amplitude reflected at jumps of ln Z and ln c. Only ratios count.
fn reflection(jump_ln_z: f64, jump_ln_c: f64, incidence: f64) -> f64 {
    crate::acoustics::oblique_reflection(1.0, 1.0, jump_ln_z.exp(), jump_ln_c.exp(), incidence)
}
