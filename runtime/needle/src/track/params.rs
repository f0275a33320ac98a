//! Parameters of the remeshing.

use crate::NeedleError;
use crate::error::check;
use serde::{Deserialize, Serialize};

/// How the mesh follows the tip.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrackParams {
    /// Quality (signed volume over the cube of the root-mean-squared edge length; 0.118 for a regular tet) that every tet made must
    /// exceed. Just above what the FEM refuses as flat: right after a puncture edges are unavoidably short.
    pub least_quality: f64,
    /// Quality that the tets around a puncture of the surface or of an interface should reach; below it the hole may be shifted onto
    /// an edge or node nearby. About that of a dihedral angle of 10°.
    pub fair_quality: f64,
    /// Farthest such a shift, as a share of the mean edge length of the face: a compromise between slivers that stay as long as the
    /// needle does and a needle pushed aside.
    pub shift_share: f64,
    /// Largest change of a region's volume that moving a node of the surface to the puncture may cause, as a share of the volume of
    /// the tets around it; what a coarse mesh of a curved organ misses anyway.
    pub puncture_volume_change: f64,
    /// Largest change of a region's volume that a node at the tip may cause at an interface between regions, as a share of the volume
    /// of the tets around it, while the needle is there; 0 keeps interfaces as they are. A little spares slivers between tip and
    /// interface: 0.06 lets an interface give way by about a fifth of an element.
    pub interface_volume_change: f64,
    /// Quality of tets at the tip below which tissue nodes next to them, not on the needle, move to make them better; 0 never. About
    /// that of a dihedral angle of 15°. Beyond Algorithm 2, which moves only nodes that are or were on the needle.
    pub relax_below: f64,
    /// Fit of dihedral angles to the paper's range, 10.3–160.0°, below which nodes along the whole needle move to make it better after
    /// each motion, and operations are chosen by it rather than by quality: 1 is the range itself, above is inside it, about as the
    /// square of the angle; 0 never, and so with several needles, whose tracks would widen. Beyond Algorithm 2.
    pub tend_below: f64,
    /// Evaluations of the optimiser that moves the node next to the tip; 20 leave 1e-4 of the segment.
    pub evaluations: u32,
    /// Whether nodes left moved go back to their first places when the needle has left.
    pub put_back: bool,
}

impl Default for TrackParams {
    fn default() -> Self {
        Self {
            least_quality: 1e-5,
            fair_quality: 0.02,
            shift_share: 0.1,
            puncture_volume_change: 0.01,
            interface_volume_change: 0.06,
            relax_below: 0.03,
            tend_below: 1.5,
            evaluations: 20,
            put_back: true,
        }
    }
}

impl TrackParams {
    /// # Errors
    /// [`NeedleError::Parameter`] for the first field out of range.
    pub fn check(&self) -> Result<(), NeedleError> {
        let between = |v: f64, low: f64, high: f64| v >= low && v <= high;
        check(
            between(self.least_quality, 2e-6, 0.01),
            "least_quality",
            self.least_quality,
            "2e-6 to 0.01",
        )?;
        check(
            between(self.fair_quality, 0.0, 0.118),
            "fair_quality",
            self.fair_quality,
            "0 to 0.118",
        )?;
        check(
            between(self.shift_share, 0.0, 0.5),
            "shift_share",
            self.shift_share,
            "0 to 0.5",
        )?;
        check(
            between(self.puncture_volume_change, 0.0, 0.1),
            "puncture_volume_change",
            self.puncture_volume_change,
            "0 to 0.1",
        )?;
        check(
            between(self.interface_volume_change, 0.0, 0.1),
            "interface_volume_change",
            self.interface_volume_change,
            "0 to 0.1",
        )?;
        check(
            between(self.relax_below, 0.0, 0.118),
            "relax_below",
            self.relax_below,
            "0 to 0.118",
        )?;
        check(
            between(self.tend_below, 0.0, 10.0),
            "tend_below",
            self.tend_below,
            "0 to 10",
        )?;
        check(
            (4..=200).contains(&self.evaluations),
            "evaluations",
            f64::from(self.evaluations),
            "4 to 200",
        )
    }
}
