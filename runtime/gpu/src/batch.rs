use std::ops::Range;

use crate::device::Stamps;
use crate::{Gpu, GpuError, PartTime, Recording};

/// A piece of a buffer that comes back with every submission of a [`Batch`].
#[derive(Clone, Debug)]
pub struct Piece {
    /// The buffer.
    pub buffer: wgpu::Buffer,
    /// First byte; a multiple of 4.
    pub offset: u64,
    /// Bytes; a multiple of 4.
    pub bytes: u64,
}

/// Recordings that are submitted together, once a step, with what is read back of each step. Put together once: running it
/// makes no buffer.
#[derive(Debug)]
pub struct Batch {
    all: Recording,
    pieces: Vec<(Piece, Range<usize>)>,
    staging: Option<wgpu::Buffer>,
    clock: Option<Clock>,
    bytes: Vec<u8>,
    times: Vec<PartTime>,
}

/// Timestamps around each run of dispatches of one part.
#[derive(Debug)]
struct Clock {
    sets: Vec<wgpu::QuerySet>,
    resolved: wgpu::Buffer,
    /// Part and dispatches.
    runs: Vec<(usize, Range<usize>)>,
    stamps: Stamps,
    count: u32,
    ms_per_tick: f64,
}

/// Timestamps of a query set; even, so that a pass's two lie in one set.
const SET: u32 = wgpu::QUERY_SET_MAX_QUERIES;

impl Clock {
    fn new(gpu: &Gpu, all: &Recording) -> Result<Option<Self>, GpuError> {
        let stamps = gpu.stamps();
        let runs = all.runs();
        if runs.is_empty() || stamps == Stamps::None {
            return Ok(None);
        }
        let runs_count = runs.len() as u32;
        let count = match stamps {
            Stamps::Inside => runs_count + 1,
            _ => 2 * runs_count,
        };
        let (sets, resolved) = gpu.guarded("timestamps", || {
            let sets = (0..count.div_ceil(SET))
                .map(|k| {
                    gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                        label: Some("timestamps"),
                        ty: wgpu::QueryType::Timestamp,
                        count: SET.min(count - k * SET),
                    })
                })
                .collect();
            let resolved = gpu.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("timestamps"),
                size: u64::from(count) * 8,
                usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            });
            (sets, resolved)
        })?;
        Ok(Some(Self {
            sets,
            resolved,
            runs,
            stamps,
            count,
            ms_per_tick: f64::from(gpu.queue.get_timestamp_period()) * 1e-6,
        }))
    }

    fn bytes(&self) -> u64 {
        u64::from(self.count) * 8
    }

    fn place(&self, stamp: usize) -> (&wgpu::QuerySet, u32) {
        (&self.sets[stamp / SET as usize], (stamp % SET as usize) as u32)
    }

    fn encode(&self, all: &Recording, encoder: &mut wgpu::CommandEncoder) {
        if self.stamps == Stamps::Inside {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            for (n, (_, range)) in self.runs.iter().enumerate() {
                let (set, index) = self.place(n);
                pass.write_timestamp(set, index);
                all.encode(&mut pass, range.clone());
            }
            let (set, index) = self.place(self.runs.len());
            pass.write_timestamp(set, index);
        } else {
            for (n, (_, range)) in self.runs.iter().enumerate() {
                let (query_set, index) = self.place(2 * n);
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                    label: None,
                    timestamp_writes: Some(wgpu::ComputePassTimestampWrites {
                        query_set,
                        beginning_of_pass_write_index: Some(index),
                        end_of_pass_write_index: Some(index + 1),
                    }),
                });
                all.encode(&mut pass, range.clone());
            }
        }
        for (k, set) in self.sets.iter().enumerate() {
            let first = k as u32 * SET;
            let count = SET.min(self.count - first);
            encoder.resolve_query_set(set, 0..count, &self.resolved, u64::from(first) * 8);
        }
    }

    fn read(&self, bytes: &[u8], times: &mut [PartTime]) {
        let tick = |n: usize| {
            let at = bytes.get(8 * n..8 * n + 8).and_then(|b| b.try_into().ok());
            at.map_or(0, u64::from_le_bytes)
        };
        times.iter_mut().for_each(|t| t.ms = 0.0);
        for (n, (part, _)) in self.runs.iter().enumerate() {
            let (from, to) = match self.stamps {
                Stamps::Inside => (tick(n), tick(n + 1)),
                _ => (tick(2 * n), tick(2 * n + 1)),
            };
            times[*part].ms += to.saturating_sub(from) as f64 * self.ms_per_tick;
        }
    }
}

impl Batch {
    /// Puts recordings together, in this order, with the pieces that every submission brings back. `timed`: with timestamps
    /// around the parts, where the device has them.
    ///
    /// # Errors
    /// Pieces beyond their buffer or not in steps of 4 bytes; a device that is lost or out of memory.
    pub fn new(
        gpu: &Gpu,
        recordings: &[&Recording],
        pieces: &[Piece],
        timed: bool,
    ) -> Result<Self, GpuError> {
        let mut all = Recording::new();
        for r in recordings {
            all.append(r);
        }
        let mut at = 0usize;
        let mut placed = Vec::with_capacity(pieces.len());
        for p in pieces {
            let end = p.offset.checked_add(p.bytes);
            if end.is_none_or(|e| e > p.buffer.size()) || !(p.offset | p.bytes).is_multiple_of(4) {
                return Err(GpuError::Refused {
                    context: "a read".into(),
                    reason: format!(
                        "{} bytes from {} of a buffer of {}, in steps of 4",
                        p.bytes,
                        p.offset,
                        p.buffer.size()
                    ),
                });
            }
            placed.push((p.clone(), at..at + p.bytes as usize));
            at += p.bytes as usize;
        }
        let clock = if timed { Clock::new(gpu, &all)? } else { None };
        // Timestamps lie behind the pieces, on a multiple of their size.
        let total = at.next_multiple_of(8) as u64 + clock.as_ref().map_or(0, Clock::bytes);
        let staging = match total {
            0 => None,
            size => Some(gpu.guarded("read back", || {
                gpu.device.create_buffer(&wgpu::BufferDescriptor {
                    label: Some("read back"),
                    size,
                    usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
                    mapped_at_creation: false,
                })
            })?),
        };
        let times = all
            .parts()
            .iter()
            .map(|part| PartTime {
                part: part.clone(),
                ms: 0.0,
            })
            .collect();
        Ok(Self {
            all,
            pieces: placed,
            staging,
            clock,
            bytes: vec![0; total as usize],
            times,
        })
    }

    /// Submits everything at once, waits, and takes the pieces and times over.
    ///
    /// # Errors
    /// A device that is lost, out of memory, or refused an earlier call.
    pub fn run(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        gpu.check()?;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        match &self.clock {
            Some(clock) => clock.encode(&self.all, &mut encoder),
            None => {
                let mut pass = encoder.begin_compute_pass(&Default::default());
                self.all.encode(&mut pass, 0..self.all.len());
            }
        }
        let Some(staging) = &self.staging else {
            gpu.queue.submit([encoder.finish()]);
            return gpu.wait();
        };
        for (p, at) in self.pieces.iter().filter(|(p, _)| p.bytes > 0) {
            encoder.copy_buffer_to_buffer(&p.buffer, p.offset, staging, at.start as u64, p.bytes);
        }
        let ticks = self.bytes.len() - self.clock.as_ref().map_or(0, |c| c.bytes() as usize);
        if let Some(clock) = &self.clock {
            encoder.copy_buffer_to_buffer(&clock.resolved, 0, staging, ticks as u64, clock.bytes());
        }
        gpu.queue.submit([encoder.finish()]);
        gpu.map_into(staging, &mut self.bytes)?;
        if let Some(clock) = &self.clock {
            clock.read(&self.bytes[ticks..], &mut self.times);
        }
        Ok(())
    }

    /// Piece `n` as it came back last; zeros before the first run, nothing where there is no such piece.
    pub fn piece(&self, n: usize) -> &[u8] {
        self.pieces
            .get(n)
            .and_then(|(_, at)| self.bytes.get(at.clone()))
            .unwrap_or_default()
    }

    /// Times of the parts on the device in the last run, in the order of first use; none where they are not measured.
    pub fn times(&self) -> Option<&[PartTime]> {
        self.clock.as_ref().map(|_| self.times.as_slice())
    }
}
