//! A whole session with its output folder.

use crate::output::{
    OutputFolder, PointCloud, SummaryInput, fiducials_csv, force_csv, needle_csv, pvd, summary_html,
    timings_csv, trace_npz, vtu,
};
use crate::recording::Recording;
use crate::render::{Camera, Picture, Preview, encode_png};
use crate::session::{Loaded, RestShape, Session};
use crate::trace::{Spread, UNCALIBRATED};
use crate::{Progress, RehearseError};
use rayon::prelude::*;
use std::path::Path;

/// Figures of a session that ran.
#[derive(Clone, Debug, PartialEq)]
pub struct RunReport {
    /// What computed, in words.
    pub device: String,
    /// Steps.
    pub steps: u32,
    /// Wall time of a step (solver, skinning, image), ms.
    pub step_ms: Spread,
    /// Limits that took hold, over all steps.
    pub clamps: u64,
    /// Largest number of inverted embedding tets at a step.
    pub inverted_tets: u32,
    /// What the user should know.
    pub warnings: Vec<String>,
    /// Why the session ended before its time; none where it did not. What was computed until then has been written.
    pub stopped: Option<String>,
    /// The scene's key at which it stopped.
    pub stopped_at: Option<String>,
}

/// Pictures that wait to be coded, at most.
const BATCH: usize = 8;

/// Runs the session to its end and writes everything that the scene wants into `place`.
///
/// # Errors
/// An output folder that holds something else or cannot be written; whatever stops a session.
pub fn run(
    mut session: Session,
    packages: &[Loaded],
    place: &Path,
    progress: &Progress,
) -> Result<RunReport, RehearseError> {
    let folder = OutputFolder::new(place)?;
    let mut recording = Recording::new(&session, packages);
    let mut out = Writer::new(&session, folder)?;
    let steps = session.timeline().steps();
    progress.start("press", u64::from(steps));
    let (mut stopped, mut stopped_at) = (None, None);
    for step in 1..=steps {
        let poses = session.poses(step);
        match session.advance(&poses) {
            Ok(row) => recording.push(&poses, row),
            // A needle that cannot go on leaves what it did.
            Err(e) if step > 1 && e.needle_key().is_some() => {
                stopped_at = e.needle_key().map(String::from);
                stopped = Some(format!("step {step}: {e}"));
                out.step(&mut session, step - 1, true)?;
                break;
            }
            Err(e) => return Err(e),
        }
        out.step(&mut session, step, step == steps)?;
        progress.step(u64::from(step));
    }
    progress.start("write", 0);
    let mut report = report(&session);
    if let Some(why) = &stopped {
        report.warnings.insert(0, format!("The session stopped: {why}"));
    }
    (report.stopped, report.stopped_at) = (stopped, stopped_at);
    out.finish(&session, packages, &report, &recording)?;
    progress.finish();
    Ok(report)
}

fn report(session: &Session) -> RunReport {
    let trace = session.trace();
    let ms: Vec<f64> = trace.steps.iter().map(|s| 1e3 * s.times.total_s()).collect();
    let clamps = trace.steps.iter().map(|s| s.clamps).sum();
    let inverted_tets = trace.steps.iter().map(|s| s.inverted_tets).max().unwrap_or(0);
    let mut warnings = session.warnings().to_vec();
    if clamps > 0 {
        let first = trace.steps.iter().find(|s| s.clamps > 0).map_or(0, |s| s.step);
        warnings.push(match trace.fem {
            true => format!(
                "{clamps} steps were too violent for the trapezoid rule and lost energy, first step {first}; slower motion or a \
                 shorter dt_s keeps it."
            ),
            false => format!(
                "Limits of speed, acceleration or contacts took hold {clamps} times, first in step {first}."
            ),
        });
    }
    if inverted_tets > 0 {
        warnings.push(match trace.fem {
            true => format!(
                "Up to {inverted_tets} tets, of the tissue or of the mesh that carries the image, were turned over; law = \
                 \"neo_hookean\" keeps the tissue's upright longest."
            ),
            false => format!(
                "Up to {inverted_tets} embedding tets were inverted; their pixels show the fill value."
            ),
        });
    }
    RunReport {
        device: session.device(),
        steps: session.step_number(),
        step_ms: Spread::of(&ms),
        clamps,
        inverted_tets,
        warnings,
        stopped: None,
        stopped_at: None,
    }
}

/// Everything that is written on the way and at the end.
struct Writer {
    folder: OutputFolder,
    camera: Camera,
    rest: RestShape,
    preview: Preview,
    waiting: Vec<(String, Picture)>,
    stages: Vec<(String, Picture)>,
    series: Vec<(String, Vec<(f64, String)>)>,
    frames: usize,
}

impl Writer {
    fn new(session: &Session, folder: OutputFolder) -> Result<Self, RehearseError> {
        Ok(Self {
            folder,
            camera: session.camera(),
            rest: session.rest_shape()?,
            preview: Preview::default(),
            waiting: Vec::new(),
            stages: Vec::new(),
            series: Vec::new(),
            frames: 0,
        })
    }

    fn step(&mut self, session: &mut Session, step: u32, last: bool) -> Result<(), RehearseError> {
        let record = session.scene().record;
        let stage = session.timeline().stage_ending(step);
        let due = |every: u32| every > 0 && (step.is_multiple_of(every) || stage.is_some() || last);
        let frame = due(record.frame_every_steps);
        let preview =
            record.preview_every_steps > 0 && (step.is_multiple_of(record.preview_every_steps) || last);
        if frame || preview || stage.is_some() {
            let picture = session.picture(&self.camera)?;
            if preview {
                self.preview.push(picture.halved());
            }
            if let Some(s) = stage.and_then(|n| session.timeline().stages().get(n)) {
                let caption = match session.scene().press {
                    Some(_) => format!("After {}: {} mm", s.name, s.indentation_mm),
                    None => format!("After {}", s.name),
                };
                self.stages.push((caption, picture.clone()));
            }
            if frame {
                self.frames += 1;
                self.waiting
                    .push((format!("frames/frame-{step:05}.png"), picture));
                if record.images {
                    self.image(session, step)?;
                }
            }
        }
        if due(record.vtu_every_steps) {
            self.grids(session, step)?;
        }
        if self.waiting.len() >= BATCH || last {
            self.flush()?;
        }
        Ok(())
    }

    fn image(&mut self, session: &mut Session, step: u32) -> Result<(), RehearseError> {
        let name = format!("images/image-{step:05}");
        if let Some(image) = session.image()? {
            self.waiting.push((format!("{name}.png"), image.picture()));
        }
        if let Some((nifti, metadata)) = session.image_files()? {
            self.folder.write(&format!("{name}.nii"), &nifti)?;
            self.folder.write(&format!("{name}.json"), metadata.as_bytes())?;
        }
        Ok(())
    }

    /// Codes and writes the pictures that wait.
    fn flush(&mut self) -> Result<(), RehearseError> {
        let coded: Vec<(String, Vec<u8>)> = self
            .waiting
            .par_iter()
            .map(|(name, picture)| Ok((name.clone(), encode_png(name, picture, &NOTES)?)))
            .collect::<Result<_, RehearseError>>()?;
        self.waiting.clear();
        coded
            .iter()
            .try_for_each(|(name, bytes)| self.folder.write(name, bytes))
    }

    fn grids(&mut self, session: &mut Session, step: u32) -> Result<(), RehearseError> {
        session.read_back()?;
        let session = &*session;
        let time = session.timeline().time_s(step);
        let mut clouds = session.surface_clouds(&self.rest);
        let (name, cloud) = session.body_cloud(&self.rest)?;
        clouds.push((name.into(), cloud));
        let instruments = session.instrument_meshes();
        for (name, points_mm, triangles) in &instruments {
            clouds.push((
                format!("instrument-{name}"),
                PointCloud {
                    points_mm: points_mm.clone(),
                    triangles,
                    ..PointCloud::default()
                },
            ));
        }
        for (name, cloud) in clouds {
            let name = file_name(&name);
            let file = format!("{name}-{step:05}.vtu");
            self.folder.write(&format!("vtu/{file}"), &vtu(&cloud, time))?;
            match self.series.iter_mut().find(|s| s.0 == name) {
                Some(s) => s.1.push((time, file)),
                None => self.series.push((name, vec![(time, file)])),
            }
        }
        Ok(())
    }

    fn finish(
        mut self,
        session: &Session,
        packages: &[Loaded],
        report: &RunReport,
        recording: &Recording,
    ) -> Result<(), RehearseError> {
        let record = session.scene().record;
        let trace = session.trace();
        let mut files: Vec<(String, String)> = Vec::new();
        self.flush()?;
        if self.frames > 0 {
            files.push(("frames/".into(), format!("{} pictures", self.frames)));
            if record.images && session.scene().image.is_some() {
                files.push((
                    "images/".into(),
                    "ultrasound images alone: PNG, NIfTI that lies in place in 3D Slicer, metadata".into(),
                ));
            }
        }
        let mut preview = Vec::new();
        if !self.preview.is_empty() {
            let every = f64::from(record.preview_every_steps) * session.scene().dt_s();
            preview = self.preview.encode(every, &NOTES)?;
            self.folder.write("preview.png", &preview)?;
            files.push(("preview.png".into(), "the session as an animated PNG".into()));
        }
        for (name, list) in &self.series {
            self.folder
                .write(&format!("vtu/{name}.pvd"), pvd(list).as_bytes())?;
        }
        if !self.series.is_empty() {
            for (n, cloud) in session.support_clouds().iter().enumerate() {
                self.folder
                    .write(&format!("vtu/support-{n}.vtu"), &vtu(cloud, 0.0))?;
            }
            files.push((
                "vtu/*.pvd".into(),
                "series for ParaView: surfaces, particles or tets, instruments".into(),
            ));
        }
        if record.csv {
            for (name, text, what) in [
                (
                    "fiducials.csv",
                    fiducials_csv(trace),
                    "fiducials at every step, patient RAS mm",
                ),
                (
                    "force.csv",
                    force_csv(trace),
                    "contact of every instrument; not calibrated",
                ),
                (
                    "timings.csv",
                    timings_csv(trace),
                    "wall time of every part of every step",
                ),
            ] {
                self.folder.write(name, text.as_bytes())?;
                files.push((name.into(), what.into()));
            }
        }
        if record.csv && !trace.needles.is_empty() {
            self.folder.write("needle.csv", needle_csv(trace).as_bytes())?;
            files.push((
                "needle.csv".into(),
                "every needle at every step: forces, tip, target, friction states; not calibrated".into(),
            ));
        }
        if record.npz {
            self.folder.write("session.npz", &trace_npz(trace)?)?;
            files.push(("session.npz".into(), "all of this as arrays for numpy".into()));
        }
        files.push(("recording.json".into(), "for rehearse replay".into()));
        let pictures = self
            .stages
            .par_iter()
            .map(|(caption, p)| Ok((caption.clone(), encode_png(caption, p, &NOTES)?)))
            .collect::<Result<Vec<_>, RehearseError>>()?;
        let fail = |e: &dyn std::error::Error| RehearseError::Recording {
            problem: e.to_string(),
            path: "recording.json".into(),
        };
        let scene = toml::to_string(session.scene()).map_err(|e| fail(&e))?;
        let title = session.scene().name.clone();
        let page = summary_html(&SummaryInput {
            facts: facts(session, packages, report),
            warnings: report.warnings.clone(),
            preview: &preview,
            pictures: &pictures,
            image: session.scene().image.is_some(),
            scene: &scene,
            files: &files,
            ..SummaryInput::new(&title, trace)
        });
        self.folder.write("summary.html", page.as_bytes())?;
        let text = recording.to_json().map_err(|e| fail(&e))?;
        self.folder.write("recording.json", text.as_bytes())?;
        self.folder.finish()
    }
}

/// What goes into every picture's metadata.
const NOTES: [(&str, &str); 2] = [("Software", "Palpate rehearse"), ("Comment", UNCALIBRATED)];

fn file_name(name: &str) -> String {
    name.chars()
        .map(|c| {
            if c.is_alphanumeric() || c == '-' || c == '_' {
                c
            } else {
                '-'
            }
        })
        .collect()
}

fn facts(session: &Session, packages: &[Loaded], report: &RunReport) -> Vec<(String, String)> {
    let mut out = Vec::new();
    for p in packages {
        let m = &p.model;
        out.push((
            "package".into(),
            format!(
                "{}: {} ({}…)",
                m.info.regions.join(", "),
                p.path.file_name().unwrap_or_default().to_string_lossy(),
                &p.digest.get(..12).unwrap_or_default()
            ),
        ));
        if session.scene().is_fem() {
            continue;
        }
        out.push((
            "particles".into(),
            format!(
                "{} of {:.2} mm in {} clusters, {} memberships; {:.0} g",
                m.particles.positions.len(),
                m.particles.radius_mm,
                m.clusters.len(),
                m.clusters.members.len(),
                m.particles.mass_g * m.particles.positions.len() as f64
            ),
        ));
    }
    let s = session.scene();
    out.push(("support".into(), s.support.clone()));
    let acts = match s.is_fem() && s.gravity.balanced_in_scan {
        true => ", borne as in the scan: none acts",
        false => "",
    };
    out.push((
        "gravity".into(),
        format!(
            "{:.2} m/s² {}{acts}",
            1e-3 * s.gravity.acceleration_mm_s2,
            s.gravity.direction
        ),
    ));
    if let Some([nodes, tets, held]) = session.size().fem {
        out.push((
            "finite elements".into(),
            format!("{nodes} nodes, {held} of them held, {tets} tets"),
        ));
        for m in session.materials() {
            out.push(("material".into(), format!("{m} (not calibrated)")));
        }
    } else {
        out.push((
            "stiffness α".into(),
            format!(
                "organ {}, structures {} (not calibrated)",
                s.stiffness.organ, s.stiffness.structures
            ),
        ));
        out.push((
            "contact distance".into(),
            format!(
                "{:.2} mm from solids to particle centres",
                session.contact_distance_mm()
            ),
        ));
    }
    if let Some(b) = session.balance() {
        out.push((
            "rest shape".into(),
            format!(
                "sags into the scan's shape under the weight: particles {:.2} mm off in the mean, {:.2} mm at most (without: \
                 {:.2} and {:.2} mm); found in {} rounds, {:.1} s",
                b.left_mm[0], b.left_mm[1], b.sag_mm[0], b.sag_mm[1], b.rounds, b.seconds
            ),
        ));
    }
    // Less than the last digit shown is none.
    if session.seat_mm().abs() >= 0.005 {
        out.push((
            "settled organ".into(),
            format!(
                "first contact {:.2} mm farther along the instrument's axis than at rest",
                session.seat_mm()
            ),
        ));
    }
    out.push((
        "computed".into(),
        format!(
            "{} steps of {:.2} ms on {}: {:.1} ms a step, {:.0} steps/s",
            report.steps,
            1e3 * s.dt_s(),
            session.device(),
            report.step_ms.mean,
            1e3 / report.step_ms.mean.max(1e-9)
        ),
    ));
    if let Some(by) = session.image_device() {
        out.push(("ultrasound image".into(), format!("of every step, made on {by}")));
    }
    out
}
