use std::sync::{Arc, Mutex, PoisonError};

use bytemuck::Pod;
use wgpu::util::DeviceExt;

use crate::adapter::{choose, shortfall};
use crate::{AdapterReport, Choice, GpuError};

/// What is asked of a device.
#[derive(Clone, Debug)]
pub struct Demand {
    /// The least that will do. The default is WebGPU's, which the kernels stay inside.
    pub limits: wgpu::Limits,
    /// Taken where the adapter offers them: by default timestamps, between passes and inside.
    pub wanted: wgpu::Features,
}

impl Default for Demand {
    fn default() -> Self {
        Self {
            limits: wgpu::Limits::default(),
            wanted: wgpu::Features::TIMESTAMP_QUERY | wgpu::Features::TIMESTAMP_QUERY_INSIDE_PASSES,
        }
    }
}

/// Where a device can take the time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stamps {
    None,
    Passes,
    Inside,
}

/// A device with its queue. Cheap to clone; clones share the device.
#[derive(Clone, Debug)]
pub struct Gpu {
    /// The device.
    pub device: wgpu::Device,
    /// Its queue.
    pub queue: wgpu::Queue,
    adapter: AdapterReport,
    stamps: Stamps,
    fault: Arc<Mutex<Option<GpuError>>>,
}

fn keep_first(fault: &Mutex<Option<GpuError>>, error: GpuError) {
    let mut slot = fault.lock().unwrap_or_else(PoisonError::into_inner);
    // A lost device is the cause of whatever else is reported around it.
    if slot.is_none() || matches!(error, GpuError::Lost { .. }) {
        *slot = Some(error);
    }
}

impl Gpu {
    /// Opens the adapter that `choice` names, with the WebGPU default limits, but storage bindings as large as the adapter
    /// offers.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`], [`GpuError::LimitTooSmall`], [`GpuError::Device`].
    pub fn open(choice: &Choice) -> Result<Self, GpuError> {
        Self::open_with(choice, &Demand::default())
    }

    /// As [`Gpu::open`], with other demands.
    ///
    /// # Errors
    /// As [`Gpu::open`].
    pub fn open_with(choice: &Choice, demand: &Demand) -> Result<Self, GpuError> {
        let (adapter, report) = choose(choice)?;
        let offered = adapter.limits();
        if let Some(error) = shortfall(&adapter.get_info(), &offered, &demand.limits) {
            return Err(error);
        }
        let features = adapter.features() & demand.wanted;
        let limits = wgpu::Limits {
            max_storage_buffer_binding_size: offered.max_storage_buffer_binding_size,
            max_buffer_size: offered.max_buffer_size,
            ..demand.limits.clone()
        };
        let request = adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("palpate"),
            required_features: features,
            required_limits: limits,
            ..Default::default()
        });
        let (device, queue) = pollster::block_on(request).map_err(|e| GpuError::Device {
            adapter: report.name.clone(),
            reason: e.to_string(),
        })?;
        let fault = Arc::new(Mutex::new(None));
        let lost = fault.clone();
        device.set_device_lost_callback(move |_, reason| keep_first(&lost, GpuError::Lost { reason }));
        let refused = fault.clone();
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            keep_first(&refused, fault_of("a call", &error));
        }));
        Ok(Self {
            device,
            queue,
            adapter: report,
            stamps: match (
                features.contains(wgpu::Features::TIMESTAMP_QUERY),
                features.contains(wgpu::Features::TIMESTAMP_QUERY_INSIDE_PASSES),
            ) {
                (true, true) => Stamps::Inside,
                (true, false) => Stamps::Passes,
                _ => Stamps::None,
            },
            fault,
        })
    }

    /// A device of whatever kind for checks of kernels. None where there is no adapter, unless the environment variable
    /// `REQUIRE_GPU` is 1: then that is the error.
    pub fn for_checks() -> Result<Option<Self>, GpuError> {
        match Self::open(&Choice::Any) {
            Ok(gpu) => Ok(Some(gpu)),
            Err(GpuError::NoAdapter { .. }) if std::env::var_os("REQUIRE_GPU").is_none_or(|v| v != "1") => {
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    /// The adapter behind the device.
    pub fn adapter(&self) -> &AdapterReport {
        &self.adapter
    }

    /// Whether passes can be timed on the device.
    pub fn has_timestamps(&self) -> bool {
        self.stamps != Stamps::None
    }

    pub(crate) fn stamps(&self) -> Stamps {
        self.stamps
    }

    /// The first fault since the device was opened, if any: lost device, memory, refused call.
    pub fn check(&self) -> Result<(), GpuError> {
        match &*self.fault.lock().unwrap_or_else(PoisonError::into_inner) {
            Some(error) => Err(error.clone()),
            None => Ok(()),
        }
    }

    fn fits(&self, label: &str, bytes: u64) -> Result<(), GpuError> {
        let limits = self.device.limits();
        let most = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        if bytes > most {
            return Err(GpuError::BufferTooLarge {
                buffer: label.into(),
                needed: bytes,
                found: most,
            });
        }
        Ok(())
    }

    /// Runs `make` and turns a fault of the driver into an error that names `context`.
    pub(crate) fn guarded<T>(&self, context: &str, make: impl FnOnce() -> T) -> Result<T, GpuError> {
        self.check()?;
        let memory = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let validation = self.device.push_error_scope(wgpu::ErrorFilter::Validation);
        let made = make();
        let second = pollster::block_on(validation.pop());
        let first = pollster::block_on(memory.pop());
        match first.or(second) {
            Some(error) => Err(fault_of(context, &error)),
            None => Ok(made),
        }
    }

    /// A storage buffer with these values; one element of zeros where there are none, since a binding may not be empty.
    pub fn storage<T: Pod>(&self, label: &str, values: &[T]) -> Result<wgpu::Buffer, GpuError> {
        if values.is_empty() {
            return self.storage_zeroed(label, size_of::<T>().max(16) as u64);
        }
        self.fits(label, size_of_val(values) as u64)?;
        self.guarded(label, || {
            self.device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                label: Some(label),
                contents: bytemuck::cast_slice(values),
                usage: STORAGE,
            })
        })
    }

    /// A storage buffer of zeros. `bytes` is rounded up to 16.
    pub fn storage_zeroed(&self, label: &str, bytes: u64) -> Result<wgpu::Buffer, GpuError> {
        let size = bytes.max(16).next_multiple_of(16);
        self.fits(label, size)?;
        self.guarded(label, || {
            self.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size,
                usage: STORAGE,
                mapped_at_creation: false,
            })
        })
    }

    /// A uniform buffer with this value.
    pub fn uniform<T: Pod>(&self, label: &str, value: &T) -> Result<wgpu::Buffer, GpuError> {
        self.guarded(label, || {
            self.device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                label: Some(label),
                contents: bytemuck::bytes_of(value),
                usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            })
        })
    }

    /// Writes `values` at `offset` bytes; takes effect before the next submission.
    pub fn write<T: Pod>(&self, buffer: &wgpu::Buffer, offset: u64, values: &[T]) {
        self.queue
            .write_buffer(buffer, offset, bytemuck::cast_slice(values));
    }

    /// Reads `count` values from the start of a buffer; waits for the device.
    pub fn read<T: Pod>(&self, buffer: &wgpu::Buffer, count: usize) -> Result<Vec<T>, GpuError> {
        let bytes = (count * size_of::<T>()) as u64;
        if bytes > buffer.size() {
            return Err(GpuError::Refused {
                context: "a read".into(),
                reason: format!("{bytes} bytes asked of a buffer of {}", buffer.size()),
            });
        }
        if bytes == 0 {
            return Ok(Vec::new());
        }
        let padded = bytes.next_multiple_of(4);
        let staging = self.guarded("a read", || {
            let staging = self.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("read back"),
                size: padded,
                usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            });
            let mut encoder = self.device.create_command_encoder(&Default::default());
            encoder.copy_buffer_to_buffer(buffer, 0, &staging, 0, padded);
            self.queue.submit([encoder.finish()]);
            staging
        })?;
        self.map(&staging, bytes)
    }

    /// Reads the first `bytes` of a mappable buffer; waits for the device.
    fn map<T: Pod>(&self, staging: &wgpu::Buffer, bytes: u64) -> Result<Vec<T>, GpuError> {
        let mut values = vec![T::zeroed(); bytes as usize / size_of::<T>().max(1)];
        self.map_into(staging, bytemuck::cast_slice_mut(&mut values))?;
        Ok(values)
    }

    /// Reads the start of a mappable buffer; waits for the device.
    pub(crate) fn map_into(&self, staging: &wgpu::Buffer, out: &mut [u8]) -> Result<(), GpuError> {
        let (send, receive) = std::sync::mpsc::channel();
        staging.map_async(wgpu::MapMode::Read, .., move |result| {
            // The receiver lives until the poll below returns.
            let _ = send.send(result);
        });
        self.wait()?;
        let refused = |reason: String| GpuError::Refused {
            context: "a read".into(),
            reason,
        };
        match receive.try_recv() {
            Ok(Ok(())) => {}
            Ok(Err(e)) => {
                self.check()?;
                return Err(refused(e.to_string()));
            }
            Err(e) => {
                self.check()?;
                return Err(refused(e.to_string()));
            }
        }
        {
            let range = staging
                .get_mapped_range(..)
                .map_err(|e| refused(format!("{e:?}")))?;
            let n = out.len().min(range.len());
            out[..n].copy_from_slice(&range[..n]);
        }
        staging.unmap();
        Ok(())
    }

    /// Waits until all submitted work is done.
    pub fn wait(&self) -> Result<(), GpuError> {
        self.device
            .poll(wgpu::PollType::wait_indefinitely())
            .map_err(|e| GpuError::Lost {
                reason: e.to_string(),
            })?;
        self.check()
    }
}

const STORAGE: wgpu::BufferUsages = wgpu::BufferUsages::STORAGE
    .union(wgpu::BufferUsages::COPY_DST)
    .union(wgpu::BufferUsages::COPY_SRC);

fn fault_of(context: &str, error: &wgpu::Error) -> GpuError {
    match error {
        wgpu::Error::OutOfMemory { .. } => GpuError::OutOfMemory {
            context: context.into(),
        },
        wgpu::Error::Validation { description, .. } | wgpu::Error::Internal { description, .. } => {
            GpuError::Refused {
                context: context.into(),
                reason: description.clone(),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_device_says_what_to_do() {
        let error = wgpu::Error::OutOfMemory {
            source: Box::new(std::io::Error::other("full")),
        };
        let told = fault_of("positions", &error).to_string();
        assert!(
            told.contains("no memory left (positions)") && told.contains("smaller model"),
            "{told}"
        );
    }
}
