//! Levels 2 and 3: everything that happens on scan lines. Arrays are line by line, samples along a line contiguous; a
//! sample is half a wavelength.

use crate::coverage::{self, NONE, Reach};
use crate::cut::{Cut, Polygon, Ray};
use crate::lateral::Lateral;
use crate::needle::{Medium, NeedleEchoes};
use crate::organ::{Organ, Volume};
use crate::properties::{Classes, Properties, of_tissue};
use crate::rays::{Neighbours, RayModel};
use crate::scan_conversion::ScanConversion;
use crate::slice::{self, Scene};
use crate::speckle::{self, Pulse, filter, gaussian, rest_of};
use crate::vector::{add, apply, apply_linear, scale, sub};
use crate::{Background, Level, PixelGrid, Probe, ProbePose, Settings, Source, TissueTable, UltrasoundError};
use rayon::prelude::*;

/// Most samples of all lines.
const MOST_SAMPLES: usize = 1 << 24;

/// Buffers and tables of the beam-formed image.
#[derive(Clone, Debug)]
pub(crate) struct Beams {
    samples: usize,
    step_mm: f64,
    /// Elevation of each plane, mm, its weight (sum 1) and its weight in the sum of incoherent noise (squares' sum 1).
    planes: Vec<(f64, f32, f32)>,
    classes: Vec<Classes>,
    fill: Properties,
    model: RayModel,
    /// Envelope of the pulse along the line for speckle.
    noise: Pulse,
    /// The same for interfaces, `[d]` for ±d samples, of sum 1.
    pulse: Vec<f32>,
    lateral: Lateral,
    conversion: ScanConversion,
    pub(crate) cuts: Vec<Cut>,
    /// Per plane.
    reach: Vec<Reach>,
    /// Per line, per plane, per sample.
    polygon: Vec<u32>,
    source: Vec<u8>,
    properties: Vec<Properties>,
    contact: Vec<bool>,
    amplitude: Vec<f32>,
    interface: Vec<f32>,
    needles: NeedleEchoes,
    /// Per fine line: polygons of the plane at work; the scatterers' in phase and quadrature samples, drawn at every other
    /// sample (with room for the pulse on either side) and filtered.
    fine_polygon: Vec<u32>,
    drawn: Vec<f32>,
    filtered: Vec<f32>,
    /// Interfaces, filtered along the lines.
    smooth: Vec<f32>,
    /// Display value, 0 to 255.
    display: Vec<f32>,
    /// Echo amplitude relative to a perfect reflector.
    pub(crate) envelope: Vec<f32>,
}

impl Beams {
    pub(crate) fn new(
        organs: &[Organ],
        tissues: &TissueTable,
        probe: &Probe,
        settings: &Settings,
        grid: &PixelGrid,
    ) -> Result<Self, UltrasoundError> {
        let a = settings.acoustic;
        let step_mm = 0.5 * probe.wavelength_mm();
        let samples = (probe.depth_mm / step_mm).ceil() as usize + 1;
        let lines = probe.lines;
        if lines * samples * probe.planes > MOST_SAMPLES {
            return Err(UltrasoundError::Setting {
                name: "lines",
                found: format!("{lines} with {samples} samples each in {} planes", probe.planes),
                expected: "lines × samples (two per wavelength) × planes up to 16.8 million",
            });
        }
        let classes = organs
            .iter()
            .map(|o| Classes::new(o, tissues, a.source))
            .collect::<Result<_, _>>()?;
        let filler = if a.gel { "water" } else { "air" };
        let fill = tissues.get(filler).ok_or_else(|| UltrasoundError::Tissue {
            region: "fill".to_owned(),
            tissue: filler.to_owned(),
            known: tissues
                .tissues
                .iter()
                .map(|t| t.name.as_str())
                .collect::<Vec<_>>()
                .join(", "),
        })?;
        let blur_mm = organs
            .iter()
            .map(|o| o.volume.spacing_mm)
            .fold(f64::INFINITY, f64::min);
        let wavelength = probe.wavelength_mm();
        let pulse = |sigma_mm: f64| {
            let steps = sigma_mm / step_mm;
            let w = gaussian(steps, (3.0 * steps).ceil() as usize);
            let sum = 2.0 * w.iter().sum::<f64>() - w[0];
            w.iter().map(|v| v / sum).collect::<Vec<f64>>()
        };
        let axial_mm = a.axial_sigma_wavelengths * wavelength;
        let noise = Pulse::new(&pulse(rest_of(axial_mm, wavelength)), step_mm / wavelength);
        let lateral = Lateral::new(probe, &a, samples, step_mm, wavelength);
        let n = lines * samples;
        let fine = (lines - 1) * lateral.sub + 1;
        let fine = if settings.level >= Level::BMode { fine } else { 0 };
        let drawn = samples.div_ceil(2) + 2 * noise.margin();
        Ok(Self {
            samples,
            step_mm,
            planes: planes(probe),
            classes,
            fill: of_tissue(fill),
            model: RayModel {
                step_mm,
                blur_mm,
                frequency_mhz: probe.frequency_mhz,
                settings: a,
            },
            noise,
            pulse: pulse(axial_mm).iter().map(|&v| v as f32).collect(),
            lateral,
            conversion: ScanConversion::new(probe, grid, samples, step_mm),
            cuts: vec![Cut::default(); probe.planes],
            reach: vec![Reach::default(); probe.planes],
            polygon: vec![NONE; n * probe.planes],
            source: vec![0; n],
            properties: vec![[0.0; 4]; n],
            contact: vec![false; lines],
            amplitude: vec![0.0; n],
            interface: vec![0.0; n],
            needles: NeedleEchoes::default(),
            fine_polygon: vec![NONE; fine * samples],
            drawn: vec![0.0; fine * 2 * drawn],
            filtered: vec![0.0; fine * 2 * samples],
            smooth: vec![0.0; n],
            display: vec![0.0; n],
            envelope: vec![0.0; n],
        })
    }

    /// Samples of a line and their distance, mm.
    pub(crate) fn sampling(&self) -> (usize, f64) {
        (self.samples, self.step_mm)
    }

    /// Middle plane's sources by sample.
    pub(crate) fn sources(&self) -> &[u8] {
        &self.source
    }

    /// Which lines have contact.
    pub(crate) fn contact(&self) -> &[bool] {
        &self.contact
    }

    /// The image of all planes around `pose`, into `pixels`.
    pub(crate) fn image(
        &mut self,
        scene: &Scene,
        probe: &Probe,
        level: Level,
        deformed: &[&[[f32; 3]]],
        pose: &ProbePose,
        pixels: &mut [u8],
    ) {
        self.cuts
            .par_iter_mut()
            .zip(&mut self.reach)
            .zip(&self.planes)
            .for_each(|((cut, reach), &(offset, ..))| {
                cut.update(scene.organs, deformed, &pose.shifted(offset));
                reach.update(cut, probe);
            });
        self.sample(scene, probe, pose);
        self.propagate(probe);
        if !scene.needles.is_empty() {
            let medium = Medium {
                probe,
                acoustic: &self.model.settings,
                needle: scene.needle,
                samples: self.samples,
                step_mm: self.step_mm,
                blurred: level >= Level::BMode,
                properties: &self.properties,
            };
            let (amplitude, interface) = (&mut self.amplitude, &mut self.interface);
            self.needles
                .apply(scene.needles, pose, &medium, amplitude, interface);
        }
        let scatter = 10f64.powf(self.model.settings.scatter_db / 20.0) as f32;
        if level >= Level::BMode {
            self.scatter(scene, probe, pose);
            self.lateral.apply(
                self.samples,
                &self.filtered,
                &self.smooth,
                scatter,
                &mut self.envelope,
            );
        } else {
            let (properties, amplitude, interface) = (&self.properties, &self.amplitude, &self.interface);
            self.envelope.par_iter_mut().enumerate().for_each(|(n, out)| {
                let s = scatter * properties[n][3] * amplitude[n];
                *out = (s * s + interface[n] * interface[n]).sqrt();
            });
        }
        let s = &self.model.settings;
        let gain = (255.0 / s.dynamic_range_db) as f32;
        let black = (s.white_db - s.dynamic_range_db) as f32;
        self.display
            .par_chunks_mut(self.samples)
            .zip(self.envelope.par_chunks(self.samples))
            .for_each(|(display, envelope)| {
                for (d, e) in display.iter_mut().zip(envelope) {
                    // The floor keeps the logarithm finite.
                    let db = 20.0 * e.max(1e-20).log10();
                    *d = ((db - black) * gain).clamp(0.0, 255.0);
                }
            });
        self.conversion.apply(&self.display, pixels);
    }

    /// Which tets the samples lie in, and their properties averaged over the beam's thickness.
    fn sample(&mut self, scene: &Scene, probe: &Probe, pose: &ProbePose) {
        let m = self.samples;
        let middle = self.planes.len() / 2;
        let (planes, cuts, reach) = (&self.planes, &self.cuts, &self.reach);
        let (classes, fill, step) = (&self.classes, self.fill, self.step_mm);
        self.polygon
            .par_chunks_mut(m * planes.len())
            .zip(self.properties.par_chunks_mut(m))
            .zip(self.source.par_chunks_mut(m))
            .enumerate()
            .for_each(|(line, ((polygon, properties), source))| {
                let ray = ray(probe, line as f64, m, step);
                properties.fill([0.0; 4]);
                for (e, polygon) in polygon.chunks_mut(m).enumerate() {
                    let (offset, weight, _) = planes[e];
                    let plane = Plane {
                        scene,
                        classes,
                        fill,
                        cut: &cuts[e],
                        pose: pose.shifted(offset),
                    };
                    coverage::cover(plane.cut, scene.organs, &reach[e], line as f32, &ray, polygon);
                    coverage::runs(polygon, |p, range| {
                        plane.run(p, range, &ray, |n, p, s| {
                            for q in 0..4 {
                                properties[n][q] += weight * p[q];
                            }
                            if e == middle {
                                source[n] = s as u8;
                            }
                        });
                    });
                }
            });
    }

    fn propagate(&mut self, probe: &Probe) {
        let (m, last) = (self.samples, self.contact.len() - 1);
        let (model, properties, source) = (&self.model, &self.properties, &self.source);
        let row = |n: usize| &properties[n * m..(n + 1) * m];
        self.amplitude
            .par_chunks_mut(m)
            .zip(self.interface.par_chunks_mut(m))
            .zip(&mut self.contact)
            .enumerate()
            .for_each(|(line, ((amplitude, interface), contact))| {
                let (before, after) = (line.saturating_sub(1), (line + 1).min(last));
                let near = Neighbours {
                    before: row(before),
                    after: row(after),
                    lines: (after - before).max(1) as f64,
                };
                let sources = &source[line * m..(line + 1) * m];
                *contact = model.line(probe, row(line), sources, near, amplitude, interface);
            });
    }

    /// Scatterers along each line, filtered by the pulse.
    fn scatter(&mut self, scene: &Scene, probe: &Probe, pose: &ProbePose) {
        let (m, step_mm, sub) = (self.samples, self.step_mm, self.lateral.sub);
        let (planes, cuts, reach) = (&self.planes, &self.cuts, &self.reach);
        let (pulse, noise) = (&self.pulse, &self.noise);
        let (properties, amplitude) = (&self.properties, &self.amplitude);
        let (margin, half) = (noise.margin(), m.div_ceil(2));
        let lattice = Lattice {
            per_mm: 1.0 / probe.wavelength_mm(),
            seed: self.model.settings.seed,
        };
        self.smooth
            .par_chunks_mut(m)
            .zip(self.interface.par_chunks(m))
            .for_each(|(smooth, interface)| filter(pulse, interface, smooth));
        self.drawn
            .par_chunks_mut(2 * (half + 2 * margin))
            .zip(self.filtered.par_chunks_mut(2 * m))
            .zip(self.fine_polygon.par_chunks_mut(m))
            .enumerate()
            .for_each(|(fine, ((drawn, filtered), polygon))| {
                // Strength between this scan line and the next.
                let (line, t) = (fine / sub, (fine % sub) as f32 / sub as f32);
                let next = (line + usize::from(fine % sub > 0)) * m;
                let strength = |j: usize| {
                    let at = |n: usize| amplitude[n] * properties[n][3];
                    let (a, b) = (at(line * m + j), at(next + j));
                    a + t * (b - a)
                };
                let ray = ray(probe, fine as f64 / sub as f64, m, step_mm);
                drawn.fill(0.0);
                let (in_phase, quadrature) = drawn.split_at_mut(half + 2 * margin);
                let own = margin..margin + half;
                for ((cut, reach), &(offset, _, weight)) in cuts.iter().zip(reach).zip(planes) {
                    coverage::cover(cut, scene.organs, reach, line as f32 + t, &ray, polygon);
                    let pose = pose.shifted(offset);
                    coverage::runs(polygon, |p, range| {
                        let drawn = range.start.div_ceil(2)..range.end.div_ceil(2);
                        if !drawn.clone().any(|k| strength(2 * k) > 0.0) {
                            return;
                        }
                        let polygon = cut.polygons.get(p as usize).filter(|p| !p.inverted);
                        let along = lattice.along(scene.organs, polygon, &pose, &ray);
                        let parts = [&mut in_phase[own.clone()], &mut quadrature[own.clone()]];
                        along.add(drawn, weight, parts);
                    });
                }
                for (k, (i, q)) in in_phase[own.clone()]
                    .iter_mut()
                    .zip(&mut quadrature[own])
                    .enumerate()
                {
                    let s = strength(2 * k);
                    *i *= s;
                    *q *= s;
                }
                let (i, q) = filtered.split_at_mut(m);
                noise.apply(in_phase, i);
                noise.apply(quadrature, q);
            });
    }
}

/// A scan line (fractions lie between lines) as a ray.
fn ray(probe: &Probe, line: f64, samples: usize, step_mm: f64) -> Ray {
    let (start, direction) = probe.line(line);
    Ray {
        start,
        direction,
        step_mm,
        samples,
    }
}

/// Planes over the beam's thickness: from −1.2σ to 1.2σ of a Gaussian with the given full width at half maximum.
fn planes(probe: &Probe) -> Vec<(f64, f32, f32)> {
    const REACH: f64 = 1.2;
    let sigma = probe.thickness_mm / (8.0 * std::f64::consts::LN_2).sqrt();
    let n = probe.planes;
    let at = |e: usize| {
        if n == 1 {
            0.0
        } else {
            REACH * (2.0 * e as f64 / (n - 1) as f64 - 1.0)
        }
    };
    let weight = |e: usize| (-0.5 * at(e).powi(2)).exp();
    let sum: f64 = (0..n).map(weight).sum();
    let squares = (0..n).map(|e| weight(e).powi(2)).sum::<f64>().sqrt();
    (0..n)
        .map(|e| {
            let w = weight(e);
            (sigma * at(e), (w / sum) as f32, (w / squares) as f32)
        })
        .collect()
}

/// What samples of one plane are taken from.
struct Plane<'a> {
    scene: &'a Scene<'a>,
    classes: &'a [Classes],
    fill: Properties,
    cut: &'a Cut,
    pose: ProbePose,
}

impl Plane<'_> {
    /// Properties of a run of samples.
    fn run(
        &self,
        polygon: u32,
        range: std::ops::Range<usize>,
        ray: &Ray,
        mut each: impl FnMut(usize, Properties, Source),
    ) {
        match self.cut.polygons.get(polygon as usize) {
            Some(p) if !p.inverted => {
                let [zero, step] = p.along(ray);
                for n in range {
                    let index = [0, 1, 2].map(|a| (zero[a] + n as f64 * step[a]) as f32);
                    let (value, source) = self.mesh(p, index, Source::Mesh);
                    each(n, value, source);
                }
            }
            Some(_) => range.for_each(|n| each(n, self.fill, Source::Inverted)),
            None => match self.scene.background {
                Background::Fixed => range.for_each(|n| each(n, self.fill, Source::Outside)),
                Background::Surroundings if self.scene.organs.len() == 1 => {
                    let volume = &self.scene.organs[0].volume;
                    let [zero, step] = slice::undeformed(volume, &self.pose, ray);
                    for n in range {
                        let index = [0, 1, 2].map(|a| (zero[a] + n as f64 * step[a]) as f32);
                        let (value, source) = self.around(volume, index);
                        each(n, value, source);
                    }
                }
                Background::Surroundings => range.for_each(|n| {
                    let (value, source) = self.surroundings(ray.point(n as f64));
                    each(n, value, source);
                }),
                Background::Extrapolate => {
                    let reach = self.scene.edge_mm.iter().copied().fold(0.0, f64::max);
                    coverage::nearest(self.cut, ray, range, reach, |n, near| {
                        let point = ray.point(n as f64);
                        let polygon = near
                            .and_then(|p| self.cut.polygons.get(p as usize))
                            .filter(|p| p.distance(point) <= self.scene.edge_mm[p.organ as usize]);
                        let (value, source) = match polygon {
                            Some(p) => self.mesh(p, p.index(point).map(|v| v as f32), Source::Extrapolated),
                            None => (self.fill, Source::Outside),
                        };
                        each(n, value, source);
                    });
                }
            },
        }
    }

    fn mesh(&self, p: &Polygon, index: [f32; 3], source: Source) -> (Properties, Source) {
        let organ = &self.scene.organs[p.organ as usize];
        let value = self.classes[p.organ as usize].at(&organ.volume, index);
        if organ.volume.holds(index) {
            (value, source)
        } else {
            (self.beyond(value), Source::BeyondScan)
        }
    }

    /// Fill beyond the crop: black, but of the impedance at the crop's border, where no interface is.
    fn beyond(&self, border: Properties) -> Properties {
        [border[0], border[1], self.fill[2], 0.0]
    }

    /// The scan of the only organ, without the organ.
    #[inline]
    fn around(&self, volume: &Volume, index: [f32; 3]) -> (Properties, Source) {
        let classes = &self.classes[0];
        if !volume.holds(index) {
            (self.beyond(classes.at(volume, index)), Source::Outside)
        } else if volume.touches_region(index) {
            (self.fill, Source::Vacated)
        } else {
            (classes.at(volume, index), Source::Surroundings)
        }
    }

    /// As level 0 does it: the scan without the organs.
    fn surroundings(&self, plane_mm: [f64; 2]) -> (Properties, Source) {
        let patient = self.pose.point(plane_mm[0], plane_mm[1], 0.0);
        let mut found = (self.fill, Source::Outside);
        let mut first = true;
        for (organ, classes) in self.scene.organs.iter().zip(self.classes) {
            let index = apply(&organ.volume.to_index, patient).map(|v| v as f32);
            if !organ.volume.holds(index) {
                if std::mem::take(&mut first) {
                    found.0 = self.beyond(classes.at(&organ.volume, index));
                }
                continue;
            }
            if organ.volume.touches_region(index) {
                return (self.fill, Source::Vacated);
            }
            if found.1 == Source::Outside {
                found = (classes.at(&organ.volume, index), Source::Surroundings);
            }
        }
        found
    }
}

/// The scatterers' lattice in rest space.
#[derive(Clone, Copy)]
struct Lattice {
    per_mm: f64,
    seed: u32,
}

/// Lattice positions along a ray.
#[derive(Clone, Copy)]
struct Along {
    zero: [f64; 3],
    step: [f64; 3],
    seed: u32,
}

impl Lattice {
    /// Lattice positions of a ray's samples through a tet, or through the undeformed surroundings; organs have lattices of
    /// their own.
    fn along(&self, organs: &[Organ], polygon: Option<&Polygon>, pose: &ProbePose, ray: &Ray) -> Along {
        let (origin, zero, step, organ) = match polygon {
            Some(p) => {
                let organ = &organs[p.organ as usize];
                let [zero, step] = p.along(ray);
                let to = &organ.volume.to_patient;
                (organ.origin_mm, apply(to, zero), apply_linear(to, step), p.organ)
            }
            None => {
                let start = pose.point(ray.start[0], ray.start[1], 0.0);
                let direction = add(
                    scale(pose.lateral, ray.direction[0]),
                    scale(pose.axial, ray.direction[1]),
                );
                let origin = organs.first().map_or([0.0; 3], |o| o.origin_mm);
                (origin, start, scale(direction, ray.step_mm), 0)
            }
        };
        Along {
            zero: scale(sub(zero, origin), self.per_mm),
            step: scale(step, self.per_mm),
            seed: self.seed ^ organ.wrapping_mul(0x1656_67B1),
        }
    }
}

impl Along {
    /// Adds the field at a range of every other sample to in phase and quadrature.
    fn add(&self, range: std::ops::Range<usize>, weight: f32, [in_phase, quadrature]: [&mut [f32]; 2]) {
        let first = 2.0 * range.start as f64;
        let mut at = [0, 1, 2].map(|a| speckle::fixed(self.zero[a] + first * self.step[a]));
        let step = self.step.map(|v| speckle::fixed(2.0 * v));
        let pairs = in_phase[range.clone()].iter_mut().zip(&mut quadrature[range]);
        for (i, q) in pairs {
            let v = speckle::field(at, self.seed);
            for a in 0..3 {
                at[a] = at[a].wrapping_add(step[a]);
            }
            *i += weight * v[0];
            *q += weight * v[1];
        }
    }
}
