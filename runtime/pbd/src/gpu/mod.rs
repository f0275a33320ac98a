//! The solver on a GPU: kernels of shaders/, each the twin of a CPU function of the same name.
//!
//! The commands of a step are put together once; each step submits them again after the poses of moving solids have been
//! written. Nothing is read back unless it is asked for. Results are the same bits on repeated runs of one device; against
//! the CPU and between devices they differ by rounding, since compilers may fuse multiplications and additions.

mod buffers;
mod kernels;
mod layout;
mod record;
mod shapes;
mod skin;
mod solver;
mod state;
#[cfg(test)]
mod tests;
mod watch;

pub use skin::SkinId;
pub use solver::{GpuOptions, GpuSolver};
pub use watch::Watch;
