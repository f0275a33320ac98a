//! The ultrasound image of a session.

use super::organ::Organ;
use super::{Loaded, Tool};
use crate::RehearseError;
use crate::scene::Scene;
use glam::DVec3;
use palpate_gpu::{Gpu, wgpu};
use palpate_package::Embedding;
use palpate_ultrasound::{Background, GpuScanner, Level, ProbePose, Scanner};

/// The scanner with the instrument that carries it.
pub(super) struct Imaging {
    pub(super) scanner: Scanner,
    pub(super) tool: usize,
    pub(super) inverted_tets: u32,
    /// The image is still on the GPU.
    waiting: bool,
}

impl Imaging {
    /// None where the scene asks for no image.
    pub(super) fn new(
        scene: &Scene,
        packages: &[Loaded],
        embeddings: &[Embedding],
    ) -> Result<Option<Self>, RehearseError> {
        let Some(image) = &scene.image else {
            return Ok(None);
        };
        let tool = scene
            .instruments
            .iter()
            .position(|i| i.name == image.instrument)
            .unwrap_or(0);
        let organs = packages
            .iter()
            .zip(embeddings)
            .map(|(p, mesh)| {
                palpate_ultrasound::Organ::new(&p.model, &image.tissues)?
                    .with_embedding(&mesh.vertices, &mesh.tets)
            })
            .collect::<Result<Vec<_>, _>>()?;
        Ok(Some(Self {
            scanner: Scanner::new(organs, &image.tissues, image.probe, image.settings.clone())?,
            tool,
            inverted_tets: 0,
            waiting: false,
        }))
    }

    /// Why a session on a GPU leaves the image to the CPU; none where it does not.
    pub(super) fn by_cpu(&self) -> Option<&'static str> {
        let s = self.scanner.settings();
        if s.level > Level::Grey {
            Some("levels with sound are not made on GPUs")
        } else if self.scanner.organs().len() > 1 {
            Some("images of several organs are not made on GPUs")
        } else if s.background == Background::Extrapolate {
            Some("extrapolation is not made on GPUs")
        } else {
            None
        }
    }

    /// The twin on a GPU, of embedding vertices that are there.
    pub(super) fn on_gpu(&self, gpu: &Gpu, embedding: &wgpu::Buffer) -> Result<GpuScanner, RehearseError> {
        let organ = self
            .scanner
            .organs()
            .first()
            .ok_or(palpate_ultrasound::UltrasoundError::NoOrgan)?;
        let (probe, settings) = (self.scanner.probe(), self.scanner.settings());
        Ok(GpuScanner::new(gpu, organ.clone(), probe, settings, embedding)?)
    }

    /// Where the transducer is, patient mm.
    pub(super) fn pose(&self, tools: &[Tool], origin: DVec3) -> Result<ProbePose, RehearseError> {
        let pose = tools[self.tool].now;
        let unit = |v: DVec3| (pose.rotation * v).to_array();
        Ok(ProbePose::looking(
            (pose.position + origin).to_array(),
            unit(DVec3::Z),
            unit(DVec3::X),
        )?)
    }

    /// Makes the image on the CPU.
    pub(super) fn scan(&mut self, organs: &[Organ], pose: &ProbePose) -> Result<(), RehearseError> {
        let deformed: Vec<&[[f32; 3]]> = organs.iter().map(|o| o.embedding_local.as_slice()).collect();
        let image = self.scanner.image(&deformed, pose)?;
        self.inverted_tets = u32::try_from(image.inverted_tets()).unwrap_or(u32::MAX);
        self.waiting = false;
        Ok(())
    }

    /// A GPU has made the image.
    pub(super) fn made(&mut self, inverted_tets: u32) {
        self.inverted_tets = inverted_tets;
        self.waiting = true;
    }

    /// Takes the image from the GPU unless it is here already.
    pub(super) fn fetch(&mut self, from: &mut GpuScanner, pose: &ProbePose) -> Result<(), RehearseError> {
        if self.waiting {
            from.image_in(&mut self.scanner, pose)?;
            self.waiting = false;
        }
        Ok(())
    }
}
