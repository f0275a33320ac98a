//! Files that a session leaves.

mod chart;
mod csv;
mod folder;
mod needle;
mod npz;
mod summary;
#[cfg(test)]
mod tests;
mod vtu;

pub use chart::{Line, Plot, bars, plot};
pub use csv::{fiducials_csv, force_csv, timings_csv};
pub use folder::OutputFolder;
pub use needle::{NeedleFigures, needle_csv, needle_figures};
pub use npz::trace_npz;
pub use summary::{SummaryInput, summary_html};
pub use vtu::{PointCloud, VtuArray, pvd, vtu};
