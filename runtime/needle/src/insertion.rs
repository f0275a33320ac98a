//! Needle and tissue as one system (Chentanez et al. 2009, §3.3 and Algorithm 3): the coupled step with stick-slip friction, needles that
//! enter, advance, turn back and leave.

mod advance;
mod ahead;
mod bevel;
mod chain;
mod foundation;
mod meet;
mod pace;
mod params;
mod report;
mod saddle;
mod skyline;
mod surface;
mod system;
#[cfg(test)]
mod tests;
mod unknowns;

use crate::{BaseMotion, EdgeLimits, FrictionState, NeedleError, Rod, Track, locate};
use glam::DVec3;
use palpate_fem::Simulation;
pub use params::{CutLaw, InsertionParams, Linear, Membrane, NeedleFriction, RegionCutting};
pub use report::{Event, InsertionReport, NeedleReport};
use surface::Layer;

/// A needle in or before tissue.
#[derive(Debug, Clone)]
pub struct Needle {
    rod: Rod,
    friction: NeedleFriction,
    limits: EdgeLimits,
    /// Tissue nodes on the needle, from entry to tip.
    chain: Vec<u32>,
    /// Nodes of the rod past the chain: the tip, while a deep dent in the surface that it has pierced goes back.
    beyond: usize,
    track: Option<Track>,
    /// Where its tip came through the material; `None` before it has cut.
    course: Option<bevel::Course>,
    states: Vec<FrictionState>,
    layers: Vec<Layer>,
    /// Membranes that the tip lay in after the last part.
    within: Vec<bool>,
    last_membrane: Option<String>,
    /// Speed at which the base pushed along the needle when it last moved, mm/s.
    speed: f64,
}

impl Needle {
    /// The rod.
    pub fn rod(&self) -> &Rod {
        &self.rod
    }

    /// What it meets in tissue.
    pub fn friction(&self) -> &NeedleFriction {
        &self.friction
    }

    /// Tissue nodes on the needle, from the entry to the tip; empty outside. They belong to the last nodes of the rod.
    pub fn chain(&self) -> &[u32] {
        &self.chain
    }

    /// What remeshing has done for it; `None` outside.
    pub fn track(&self) -> Option<&Track> {
        self.track.as_ref()
    }

    /// Friction state of each node of [`Needle::chain`] in the last step.
    pub fn states(&self) -> &[FrictionState] {
        &self.states
    }

    /// World position of the tip, mm.
    pub fn tip(&self) -> DVec3 {
        let x = self.rod.position();
        x[x.len() - 1]
    }

    /// Speed at which the base pushes along the needle, mm/s.
    fn base_speed(&self, motion: &BaseMotion) -> f64 {
        motion.insertion_mm_per_s + DVec3::from_array(motion.velocity_mm_per_s).dot(self.rod.frame(0).tangent)
    }

    /// First node of the rod that the tissue holds; the number of nodes where none is.
    fn first(&self) -> usize {
        self.rod.position().len() - self.chain.len() - self.beyond
    }

    /// Length of needle in the tissue that belongs to each node of the chain, mm.
    fn lengths(&self) -> Vec<f64> {
        if self.beyond > 0 {
            // Only the surface's hole is on it.
            return vec![0.0; self.chain.len()];
        }
        let (first, rest) = (self.first(), self.rod.rest_length());
        (0..self.chain.len())
            .map(|k| {
                let before = if k > 0 { rest[first + k - 1] } else { 0.0 };
                let after = rest.get(first + k).copied().unwrap_or(0.0);
                0.5 * (before + after)
            })
            .collect()
    }

    /// Tells the rod which of its edges the tissue holds against turning.
    fn grip(&mut self) {
        if self.friction.torsional_friction_un == 0.0 {
            return;
        }
        let edges = self.rod.rest_length().len();
        let first = if self.beyond > 0 { edges } else { self.first() };
        let mut per_length = vec![0.0; edges];
        per_length[first.min(edges)..].fill(self.friction.torsional_friction_un);
        self.rod.grip(per_length);
    }

    /// Distance of each node of the chain from the sleeve's mouth along the needle, mm.
    fn arcs(&self) -> Vec<f64> {
        let x = self.rod.position();
        let from = usize::from(self.rod.held().base).min(x.len() - 1);
        let mut arc = 0.0;
        let mut arcs = vec![0.0; x.len()];
        for i in from + 1..x.len() {
            arc += x[i].distance(x[i - 1]);
            arcs[i] = arc;
        }
        let mut own = arcs.split_off(self.first());
        own.truncate(self.chain.len());
        own
    }
}

/// Tissue and needles that move together; [`Insertion::step`] moves all on by one time step of the tissue's settings.
///
/// Units: mm, g, s; forces µN. World frame that of the tissue.
#[derive(Debug)]
pub struct Insertion {
    tissue: Simulation,
    params: InsertionParams,
    needles: Vec<Needle>,
    /// Accelerations of the tissue after the last parts, the latest first.
    history: Vec<Vec<DVec3>>,
    /// States that a longer part ended with which was tried from the state at hand.
    guess: Option<Vec<FrictionState>>,
    pace: pace::Pace,
}

impl Insertion {
    /// Tissue without needles.
    ///
    /// Errors
    /// - [`NeedleError::Parameter`]
    pub fn new(tissue: Simulation, params: InsertionParams) -> Result<Self, NeedleError> {
        params.validate()?;
        Ok(Self {
            tissue,
            params,
            needles: Vec::new(),
            history: Vec::new(),
            guess: None,
            pace: pace::Pace::default(),
        })
    }

    /// The tissue.
    pub fn tissue(&self) -> &Simulation {
        &self.tissue
    }

    /// The tissue, to move solids and holds or to change loads. Its mesh is changed by needles alone, and its state by
    /// [`Insertion::step`].
    pub fn tissue_mut(&mut self) -> &mut Simulation {
        &mut self.tissue
    }

    /// Settings.
    pub fn params(&self) -> &InsertionParams {
        &self.params
    }

    /// Needles, in the order in which they came.
    pub fn needles(&self) -> &[Needle] {
        &self.needles
    }

    /// Adds a needle that lies outside the tissue with all its nodes and returns its index.
    ///
    /// Errors
    /// - [`NeedleError::StartsInside`]
    /// - [`NeedleError::Parameter`] friction out of range, a needle whose base is not held
    pub fn add_needle(&mut self, rod: Rod, friction: NeedleFriction) -> Result<usize, NeedleError> {
        for (node, &at) in rod.position().iter().enumerate() {
            if locate(&self.tissue, at, 0).is_some() {
                return Err(NeedleError::StartsInside { node, at });
            }
        }
        self.admit(rod, friction, Vec::new())
    }

    fn admit(&mut self, rod: Rod, friction: NeedleFriction, chain: Vec<u32>) -> Result<usize, NeedleError> {
        friction.validate()?;
        let held = rod.held();
        crate::error::check(
            held.base && !held.tip,
            "held",
            f64::from(u8::from(held.base)),
            "a needle held at its base and free at its tip",
        )?;
        let limits = self.params.edge_limits.unwrap_or_else(|| EdgeLimits::of(&rod));
        let layers: Vec<Layer> = friction
            .membranes
            .iter()
            .map(|m| Layer::new(self.tissue.mesh(), m))
            .collect();
        self.needles.push(Needle {
            within: vec![false; layers.len()],
            track: None,
            course: None,
            beyond: 0,
            states: vec![FrictionState::Static; chain.len()],
            last_membrane: None,
            speed: 0.0,
            rod,
            friction,
            limits,
            chain,
            layers,
        });
        Ok(self.needles.len() - 1)
    }

    /// Moves tissue and needles on by one time step; `motion` has the base motion of each needle. Solids and held nodes of the tissue
    /// go where they were told.
    ///
    /// The step is made in halves where a tip would pass too many tets, a needle edge turn or a tet deform too much at once, and its last part in
    /// slow motion where many have been tried ([`InsertionParams::most_tries`]).
    ///
    /// Errors
    /// - [`NeedleError::Count`], [`NeedleError::Parameter`] motions that do not fit
    /// - [`NeedleError::SleeveEdge`], [`NeedleError::Folded`], [`NeedleError::LeavesTissue`], [`NeedleError::HitsRigid`],
    ///   [`NeedleError::CrossesItself`], [`NeedleError::NotPositiveDefinite`], [`NeedleError::Tissue`]; the state is then that after the last
    ///   part that was whole
    /// - [`NeedleError::MeetsNeedle`], [`NeedleError::WithdrawFirst`]; the state is whole, the tip where it could still go
    pub fn step(&mut self, motion: &[BaseMotion]) -> Result<InsertionReport, NeedleError> {
        if motion.len() != self.needles.len() {
            return Err(NeedleError::Count {
                what: "base motions",
                found: motion.len(),
                expected: format!("{}, one per needle", self.needles.len()),
            });
        }
        for m in motion {
            m.validate()?;
        }
        match self.tissue.pool() {
            Some(pool) => pool.install(|| self.whole_step(motion)),
            None => self.whole_step(motion),
        }
    }
}
