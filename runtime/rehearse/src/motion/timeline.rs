use crate::motion::{Interpolation, RigidPose, Track};
use crate::scene::{Press, Scene};
use glam::{DQuat, DVec3};

/// Steps from the start of a stage to its end.
#[derive(Clone, Debug, PartialEq)]
pub struct StageSpan {
    /// Name: `warm-up` for stage 0.
    pub name: String,
    /// Indentation when the stage ends, mm.
    pub indentation_mm: f64,
    /// First step of it, counted from 1.
    pub first_step: u32,
    /// Last step of it; positions of the stage are taken after this step.
    pub last_step: u32,
}

/// Where each instrument is after each step of a session. Step 0 is the start, step n lies at n·dt.
#[derive(Clone, Debug, PartialEq)]
pub struct Timeline {
    dt_s: f64,
    steps: u32,
    stages: Vec<StageSpan>,
    ease: Interpolation,
    presses: Option<usize>,
    tracks: Vec<Track>,
}

impl Timeline {
    /// The timeline of a checked scene: as long as its press and its keyframes; `scene.steps` where there are neither.
    pub fn new(scene: &Scene, dt_s: f64) -> Self {
        let tracks: Vec<Track> = scene
            .instruments
            .iter()
            .map(|i| Track::new(&i.keyframes, i.interpolation))
            .collect();
        let stages = scene.press.as_ref().map(spans).unwrap_or_default();
        let pressed = stages.last().map_or(0, |s| s.last_step);
        // A keyframe on a step's time counts as reached in that step, whatever the rounding.
        let moved = tracks
            .iter()
            .map(|t| (t.end_s() / dt_s - 1e-6).ceil().clamp(0.0, f64::from(u32::MAX)) as u32)
            .max()
            .unwrap_or(0);
        let steps = pressed.max(moved);
        Self {
            dt_s,
            steps: if steps == 0 { scene.steps } else { steps },
            stages,
            ease: scene
                .press
                .as_ref()
                .map_or(Interpolation::Linear, |p| p.interpolation),
            presses: scene
                .press
                .as_ref()
                .and_then(|p| scene.instruments.iter().position(|i| i.name == p.instrument)),
            tracks,
        }
    }

    /// Makes the session as long as needles move. Without a press their `movements` (name, first and last step) are its stages.
    pub fn extend(&mut self, steps: u32, movements: &[(String, u32, u32)]) {
        if steps == 0 {
            return;
        }
        let scripted = !self.stages.is_empty() || self.tracks.iter().any(|t| t.end_s() > 0.0);
        self.steps = if scripted { self.steps.max(steps) } else { steps };
        if self.stages.is_empty() {
            self.stages = movements
                .iter()
                .map(|(name, first, last)| StageSpan {
                    name: name.clone(),
                    indentation_mm: 0.0,
                    first_step: *first,
                    last_step: *last,
                })
                .collect();
        }
    }

    /// Number of steps.
    pub fn steps(&self) -> u32 {
        self.steps
    }

    /// Time after a step, s.
    pub fn time_s(&self, step: u32) -> f64 {
        f64::from(step) * self.dt_s
    }

    /// The warm-up and the stages; empty without a press.
    pub fn stages(&self) -> &[StageSpan] {
        &self.stages
    }

    /// The stage that a step belongs to; the last one after the end.
    pub fn stage_at(&self, step: u32) -> Option<&StageSpan> {
        self.stages
            .iter()
            .find(|s| step <= s.last_step)
            .or(self.stages.last())
    }

    /// The stage that ends with this step. A stage of no steps ends with the one before.
    pub fn stage_ending(&self, step: u32) -> Option<usize> {
        self.stages.iter().rposition(|s| s.last_step == step)
    }

    /// How far the pressing instrument stands past its start pose after a step, mm.
    pub fn indentation_mm(&self, step: u32) -> f64 {
        let mut from = 0.0;
        for s in &self.stages {
            if step >= s.first_step && step <= s.last_step {
                let done = f64::from(step + 1 - s.first_step) / f64::from(s.last_step + 1 - s.first_step);
                return from + (s.indentation_mm - from) * self.ease.ease(done);
            }
            if step > s.last_step {
                from = s.indentation_mm;
            }
        }
        from
    }

    /// The instrument that is pressed.
    pub fn pressed(&self) -> Option<usize> {
        self.presses
    }

    /// Step after which the pressed instrument is seated on the settled organ, and the step by which it has arrived; none
    /// without a press or a warm-up.
    pub fn seating(&self) -> Option<[u32; 2]> {
        let warm = self.stages.first()?.last_step;
        (warm > 0).then_some([warm / 2, warm])
    }

    /// Move of instrument `index` from its start pose after a step, in the frame of the start pose.
    pub fn pose(&self, index: usize, step: u32) -> RigidPose {
        if self.presses == Some(index) {
            return RigidPose {
                position: DVec3::Z * self.indentation_mm(step),
                rotation: DQuat::IDENTITY,
            };
        }
        self.tracks
            .get(index)
            .map_or(RigidPose::IDENTITY, |t| t.pose(self.time_s(step)))
    }
}

fn spans(press: &Press) -> Vec<StageSpan> {
    let mut out = vec![StageSpan {
        name: "warm-up".into(),
        indentation_mm: 0.0,
        first_step: 1,
        last_step: press.warm_up_steps,
    }];
    let mut last = press.warm_up_steps;
    for s in &press.stages {
        out.push(StageSpan {
            name: s.name.clone(),
            indentation_mm: s.indentation_mm,
            first_step: last + 1,
            last_step: last.saturating_add(s.steps),
        });
        last = last.saturating_add(s.steps);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{PROBE_PRESS, SceneSource};

    fn protocol() -> Timeline {
        let scene = SceneSource::parse(PROBE_PRESS, "probe-press.toml".as_ref()).unwrap();
        Timeline::new(&scene.scene, 1.0 / 60.0)
    }

    #[test]
    fn the_bundled_scene_is_the_papers_protocol() {
        let t = protocol();
        assert_eq!(t.steps(), 120 + 3 * 90);
        // Closed form of the paper: warm-up, then straight lines.
        for step in 0..=390u32 {
            let s = f64::from(step);
            let expected = if step <= 120 {
                0.0
            } else if step <= 210 {
                5.95 * (s - 120.0) / 90.0
            } else if step <= 300 {
                5.95 + (9.48 - 5.95) * (s - 210.0) / 90.0
            } else {
                9.48 + (12.38 - 9.48) * (s - 300.0) / 90.0
            };
            assert!((t.indentation_mm(step) - expected).abs() < 1e-12, "step {step}");
            assert_eq!(t.pose(0, step).position, DVec3::Z * t.indentation_mm(step));
        }
        let ends: Vec<_> = (0..=390).filter(|&s| t.stage_ending(s).is_some()).collect();
        assert_eq!(ends, [120, 210, 300, 390]);
        assert_eq!(t.stage_at(121).unwrap().indentation_mm, 5.95);
        assert!((t.time_s(390) - 6.5).abs() < 1e-12);
    }

    #[test]
    fn keyframes_set_the_length_of_a_session_without_a_press() {
        let text = "[[instrument]]\nname='a'\nshape='sphere'\ndiameter_mm=5\n[[instrument.keyframe]]\ntime_s=0\n\
                    [[instrument.keyframe]]\ntime_s=0.5\nposition_mm=[0,0,6]\n";
        let scene = SceneSource::parse(text, "s.toml".as_ref()).unwrap().scene;
        let t = Timeline::new(&scene, 1.0 / 60.0);
        assert_eq!(t.steps(), 30);
        assert!((t.pose(0, 15).position.z - 3.0).abs() < 1e-12);
        assert_eq!(t.pose(0, 99).position.z, 6.0);
    }
}
