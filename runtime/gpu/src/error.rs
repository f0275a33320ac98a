use thiserror::Error;

/// What can go wrong between asking for a device and reading a result back.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum GpuError {
    /// Nothing fits the choice.
    #[error(
        "no GPU that can be used: {found}. Use the CPU backend, or install a Vulkan, Metal or DirectX 12 driver"
    )]
    NoAdapter {
        /// What was found and why it was not taken.
        found: String,
    },
    /// The adapter binds or runs less than the kernels need.
    #[error(
        "adapter {adapter} is too small: {limit} is {found}, at least {needed} is needed. Use the CPU backend"
    )]
    LimitTooSmall {
        /// Name of the adapter.
        adapter: String,
        /// Name of the limit as WebGPU has it.
        limit: String,
        /// What the adapter offers.
        found: u64,
        /// What is needed.
        needed: u64,
    },
    /// The driver refused a device.
    #[error("adapter {adapter} gives no device: {reason}")]
    Device {
        /// Name of the adapter.
        adapter: String,
        /// The driver's words.
        reason: String,
    },
    /// A shader does not parse or validate.
    #[error("shader {shader}: {message}")]
    Shader {
        /// Name of the shader.
        shader: String,
        /// naga's message with the source line.
        message: String,
    },
    /// A buffer is larger than one binding may be.
    #[error(
        "buffer {buffer} needs {needed} bytes, the device binds {found} at most. Use a smaller model or the CPU backend"
    )]
    BufferTooLarge {
        /// Name of the buffer.
        buffer: String,
        /// Its size.
        needed: u64,
        /// Largest binding.
        found: u64,
    },
    /// The device has no memory left.
    #[error("the GPU has no memory left ({context}). Use a smaller model or the CPU backend")]
    OutOfMemory {
        /// What was being made.
        context: String,
    },
    /// The device was lost: driver reset, removal, time-out.
    #[error("the GPU was lost: {reason}. Start the session again, or use the CPU backend")]
    Lost {
        /// The driver's words.
        reason: String,
    },
    /// wgpu refused a call: a fault of this program.
    #[error("the GPU refused {context}: {reason}")]
    Refused {
        /// What was being done.
        context: String,
        /// wgpu's words.
        reason: String,
    },
}
