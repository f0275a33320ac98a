//! The needle: a discrete elastic rod that bends, twists and is steered from its base (Chentanez et al. 2009; Bergou et al.
//! 2008; Spillmann and Teschner 2007).
//!
//! From: what a needle is made of ([`NeedleParams`]), where it starts, how its base moves ([`BaseMotion`]), what acts on it
//! ([`Loads`]).
//! Makes: its motion, alone ([`Rod::step`], [`Rod::equilibrium`]) or as the block-banded part of a system coupled with tissue
//! ([`Rod::begin_step`], [`StepSystem`], [`Rod::finish_step`]); interpolation of its quantities when its nodes change; the
//! friction states of nodes shared with tissue ([`solve_stick_slip`]); nodes and edges of the tissue's mesh along the needle
//! ([`Track`]); needles and tissue moved on together, from the first touch to the last ([`Insertion`]).
//! Refuses: parameters out of range, nodes that make no needle, a needle bent back on itself, more retraction than there is; one that
//! starts inside the tissue, leaves it through the far side, meets a rigid region, another needle or its own shaft, or is drawn back before one
//! that has cut the same elements after it.
//!
//! Units: mm, g, s; so force is µN, stress Pa, energy nJ.
#![forbid(unsafe_code)]

mod akima;
mod banded;
mod bicycle;
mod error;
mod frame;
mod insertion;
mod params;
mod rod;
mod stick_slip;
mod track;

pub use akima::Akima;
pub use banded::{BandFactor, BlockBand};
pub use bicycle::{Bicycle, BicycleParams};
pub use error::NeedleError;
pub use frame::{MaterialFrame, transport};
pub use insertion::{
    CutLaw, Event, Insertion, InsertionParams, InsertionReport, Linear, Membrane, Needle, NeedleFriction,
    NeedleReport, RegionCutting,
};
pub use params::{NeedleParams, PreBend, Stiffness, gauge_outer_diameter_mm};
pub use rod::{
    BaseMotion, EdgeLimits, Energy, Equilibrium, EquilibriumParams, Evaluation, Held, Loads, NewmarkParams,
    RefineReport, Rod, StepReport, StepSystem, Tangent,
};
pub use stick_slip::{
    FrictionLimit, FrictionState, StickSlipOutcome, StickSlipParams, StickSlipSystem, carry_states,
    solve_stick_slip,
};
pub use track::{Claims, Displaced, LeaveReport, Operation, Track, TrackParams, TrackReport, locate};
