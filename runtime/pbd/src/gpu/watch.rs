//! A step and what comes back of it in one submission.

use super::buffers::COUNTS;
use super::layout::Report;
use super::{GpuSolver, SkinId};
use crate::{ClampCounts, ContactReport, PbdError};
use palpate_gpu::{Batch, PartTime, Piece, Recording};

/// What comes back with every step that [`GpuSolver::step_watched`] makes: contacts, clamps, chosen points and chosen pieces of
/// other buffers. Made once; a step copies into it.
#[derive(Debug)]
pub struct Watch {
    batch: Batch,
    contacts: Vec<ContactReport>,
    clamps: ClampCounts,
    points: Vec<Vec<[f32; 3]>>,
}

/// Pieces before the points.
const OWN: usize = 2;

impl Watch {
    /// What each collider exchanged with the bodies in the step, in the scene's order.
    pub fn contacts(&self) -> &[ContactReport] {
        &self.contacts
    }

    /// How often limits took hold in the step.
    pub fn clamps(&self) -> &ClampCounts {
        &self.clamps
    }

    /// Places of the `n`th set of points, mm; nothing where there is no such set.
    pub fn points(&self, n: usize) -> &[[f32; 3]] {
        self.points.get(n).map_or(&[], Vec::as_slice)
    }

    /// The `n`th of the other pieces; nothing where there is no such piece.
    pub fn piece(&self, n: usize) -> &[u8] {
        self.batch.piece(OWN + self.points.len() + n)
    }

    /// Times of the parts on the device; none where it cannot tell.
    pub fn times(&self) -> Option<&[PartTime]> {
        self.batch.times()
    }

    /// Digest of contacts, clamps and points: equal on repeated runs of one device.
    pub fn digest(&self) -> u64 {
        let words = (0..OWN + self.points.len())
            .flat_map(|n| self.batch.piece(n).chunks_exact(4))
            .map(|word| word.try_into().map_or(0, u32::from_le_bytes));
        // FNV-1a by words.
        words.fold(0xcbf2_9ce4_8422_2325, |hash, word| {
            (hash ^ u64::from(word)).wrapping_mul(0x0000_0100_0000_01b3)
        })
    }
}

impl GpuSolver {
    /// Prepares steps that bring back contacts, clamps, these sets of attached points and these pieces. `after`: recordings
    /// that follow the step in the same submission, such as an image's. Attach all points before.
    ///
    /// # Errors
    /// - [`PbdError::Unknown`] where points belong to another solver.
    /// - [`PbdError::Gpu`] for pieces beyond their buffer, or a device that is lost or out of memory.
    pub fn watch(
        &self,
        points: &[SkinId],
        after: &[&Recording],
        pieces: &[Piece],
    ) -> Result<Watch, PbdError> {
        let piece = |buffer: &palpate_gpu::wgpu::Buffer, bytes: usize| Piece {
            buffer: buffer.clone(),
            offset: 0,
            bytes: bytes as u64,
        };
        let mut all = vec![
            piece(&self.buffers.reports, self.sizes.solids * size_of::<Report>()),
            piece(&self.buffers.counts, COUNTS * 4),
        ];
        let mut places = Vec::with_capacity(points.len());
        for &id in points {
            let skin = self.skin(id)?;
            all.push(piece(&skin.skinned, skin.count * 16));
            places.push(vec![[0.0; 3]; skin.count]);
        }
        all.extend_from_slice(pieces);
        let mut recordings = vec![&self.recording];
        recordings.extend_from_slice(after);
        Ok(Watch {
            batch: Batch::new(&self.gpu, &recordings, &all, true)?,
            contacts: vec![ContactReport::default(); self.sizes.solids],
            clamps: ClampCounts::default(),
            points: places,
        })
    }

    /// As [`GpuSolver::step`] with what `watch` adds to it, in one submission; waits.
    ///
    /// # Errors
    /// [`PbdError::Gpu`] where the device was lost, is out of memory or refused an earlier command.
    pub fn step_watched(&mut self, watch: &mut Watch) -> Result<(), PbdError> {
        self.begin();
        watch.batch.run(&self.gpu)?;
        self.end();
        for (n, row) in watch.batch.piece(0).chunks_exact(size_of::<Report>()).enumerate() {
            // The device keeps solids in the order of priority.
            let k = self.solids.order.get(n).copied().unwrap_or(n);
            if let Some(out) = watch.contacts.get_mut(k) {
                *out = bytemuck::pod_read_unaligned::<Report>(row).told();
            }
        }
        let mut counts = [0u32; COUNTS];
        bytemuck::bytes_of_mut(&mut counts).copy_from_slice(watch.batch.piece(1));
        watch.clamps = super::solver::clamp_counts(&counts);
        for (n, points) in watch.points.iter_mut().enumerate() {
            let rows = watch.batch.piece(OWN + n).chunks_exact(16);
            for (out, row) in points.iter_mut().zip(rows) {
                let [x, y, z, _] = bytemuck::pod_read_unaligned::<[f32; 4]>(row);
                *out = [x, y, z];
            }
        }
        Ok(())
    }
}
