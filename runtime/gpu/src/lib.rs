//! Makes compute devices, buffers and recordings of kernels; holds no physics.
//!
//! From: wgpu adapters and WGSL source (`shaders/`).
//! Refuses: a software driver where a real GPU is asked for; an adapter whose limits are too small; a shader that naga
//! does not accept; buffers that are larger than the device binds. A lost device is an error of the next call.
#![forbid(unsafe_code)]

mod adapter;
mod batch;
mod device;
mod error;
mod kernel;
mod recording;
mod shader;

pub use adapter::{AdapterKind, AdapterReport, Choice, adapters};
pub use batch::{Batch, Piece};
pub use device::{Demand, Gpu};
pub use error::GpuError;
pub use kernel::Kernel;
pub use recording::{PartTime, Recording};
pub use shader::{EntryPoint, MemberLayout, Shader, StructLayout};

pub use wgpu;
