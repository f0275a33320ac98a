//! The needle's state: nodes, rest lengths, material frames (Bergou et al. 2008; Chentanez et al. 2009, §3.2 and §3.5).

mod base;
mod bending;
mod equilibrium;
mod force;
mod geometry;
mod newmark;
mod refine;
mod reparametrize;
#[cfg(test)]
mod tests;
mod twist;

use crate::frame::{MaterialFrame, angle_about, material, transport, unwrap_near};
use crate::{NeedleError, NeedleParams, Stiffness, error::check, error::check_finite};
pub use base::BaseMotion;
pub use equilibrium::{Equilibrium, EquilibriumParams};
pub use force::{Energy, Evaluation, Loads, Tangent};
use geometry::Geometry;
use glam::{DVec2, DVec3};
pub use newmark::{NewmarkParams, StepReport, StepSystem};
pub use refine::{EdgeLimits, RefineReport};

/// Which ends are held, each by its last two nodes: they move as prescribed, and so does the edge's material frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Held {
    /// Nodes 0 and 1 are in the sleeve; node 1 is its mouth, where the needle comes out.
    pub base: bool,
    /// The last two nodes are held, at rest relative to space unless moved by hand.
    pub tip: bool,
}

/// Discrete elastic rod. Nodes `0 … n` from base to tip, edge `j` from node `j` to `j + 1`.
///
/// Material frames belong to edges: `theta[j]` is the angle of edge j's frame from its Bishop (twist-free) frame, which starts
/// from `director` at edge 0. Twist waves are taken as infinitely fast: the angles are those of least energy for the angle
/// given at edge 0 (and at the last edge where the tip is held).
///
/// Units: mm, g, s; forces µN. World frame as the caller's.
#[derive(Debug, Clone)]
pub struct Rod {
    params: NeedleParams,
    stiffness: Stiffness,
    held: Held,
    position: Vec<DVec3>,
    velocity: Vec<DVec3>,
    acceleration: Vec<DVec3>,
    rest_length: Vec<f64>,
    /// Growth of edge 1's rest length, mm/s: the needle being fed out of the sleeve.
    feed_mm_per_s: f64,
    director: DVec3,
    theta: Vec<f64>,
    /// Angular velocity of each edge's material frame about its tangent over the last step, rad/s.
    spin: Vec<f64>,
    /// Torque per length that the surroundings of each edge bear, µN·mm/mm; empty: none.
    grip: Vec<f64>,
    geometry: Geometry,
}

impl Rod {
    /// Needle through `nodes` (at least three, world mm, base first), at rest, unstretched: rest lengths are the distances.
    /// Its natural shape is `params.pre_bend`'s, else straight, whatever shape the nodes have.
    /// `director` is direction m1 of the base edge, made orthogonal to it.
    ///
    /// Errors
    /// - those of [`NeedleParams::validate`]
    /// - [`NeedleError::Count`] fewer than three nodes, or fewer than five where both ends are held
    /// - [`NeedleError::NotFinite`], [`NeedleError::ShortEdge`], [`NeedleError::Folded`] for nodes that make no needle
    pub fn new(
        params: NeedleParams,
        nodes: Vec<DVec3>,
        director: DVec3,
        held: Held,
    ) -> Result<Self, NeedleError> {
        let lengths = nodes.windows(2).map(|w| w[0].distance(w[1])).collect();
        Self::with_rest_lengths(params, nodes, lengths, director, held)
    }

    /// [`Self::new`] with rest lengths (mm, one per edge) of their own: a needle that starts stretched or compressed.
    pub fn with_rest_lengths(
        params: NeedleParams,
        nodes: Vec<DVec3>,
        rest_length: Vec<f64>,
        director: DVec3,
        held: Held,
    ) -> Result<Self, NeedleError> {
        let stiffness = params.stiffness()?;
        let needed = if held.base && held.tip { 5 } else { 3 };
        if nodes.len() < needed {
            return Err(NeedleError::Count {
                what: "needle nodes",
                found: nodes.len(),
                expected: format!("at least {needed}"),
            });
        }
        let count = nodes.len();
        if rest_length.len() != count - 1 {
            return Err(NeedleError::Count {
                what: "rest lengths",
                found: rest_length.len(),
                expected: format!("{}, one per edge", count - 1),
            });
        }
        check_finite("position", &nodes)?;
        check(
            director.is_finite(),
            "director",
            director.length(),
            "a finite vector",
        )?;
        let mut rod = Self {
            params,
            stiffness,
            held,
            position: nodes,
            velocity: vec![DVec3::ZERO; count],
            acceleration: vec![DVec3::ZERO; count],
            rest_length,
            feed_mm_per_s: 0.0,
            director,
            theta: vec![0.0; count - 1],
            spin: vec![0.0; count - 1],
            grip: Vec::new(),
            geometry: Geometry::default(),
        };
        rod.refresh_geometry()?;
        rod.director = rod.geometry.bishop[0];
        rod.relax_twist(&[])?;
        Ok(rod)
    }

    /// Straight needle held by a sleeve: node 0 lies `sleeve_mm` behind the `mouth`, then `edges` edges reach `length_mm` out of
    /// it along `direction` (any length but 0).
    ///
    /// Errors
    /// - those of [`Self::new`]
    /// - [`NeedleError::Parameter`] lengths not positive, no direction, fewer than one edge
    pub fn in_sleeve(
        params: NeedleParams,
        mouth: DVec3,
        direction: DVec3,
        director: DVec3,
        sleeve_mm: f64,
        length_mm: f64,
        edges: usize,
    ) -> Result<Self, NeedleError> {
        check(
            sleeve_mm > 0.0 && sleeve_mm.is_finite(),
            "sleeve_mm",
            sleeve_mm,
            "a positive length",
        )?;
        check(
            length_mm > 0.0 && length_mm.is_finite(),
            "length_mm",
            length_mm,
            "a positive length",
        )?;
        check(edges >= 1, "edges", edges as f64, "at least 1")?;
        let Some(along) = direction.try_normalize() else {
            return Err(NeedleError::Parameter {
                name: "direction",
                found: direction.length(),
                expected: "a vector with a direction",
            });
        };
        let mut nodes = vec![mouth - sleeve_mm * along];
        nodes.extend((0..=edges).map(|k| mouth + along * (length_mm * k as f64 / edges as f64)));
        Self::new(
            params,
            nodes,
            director,
            Held {
                base: true,
                tip: false,
            },
        )
    }

    /// What it is made of.
    pub fn params(&self) -> &NeedleParams {
        &self.params
    }

    /// Stiffnesses per length.
    pub fn stiffness(&self) -> &Stiffness {
        &self.stiffness
    }

    /// Ends that are held.
    pub fn held(&self) -> Held {
        self.held
    }

    /// Whether `node` moves as prescribed.
    pub fn is_prescribed(&self, node: usize) -> bool {
        (self.held.base && node < 2) || (self.held.tip && node + 2 >= self.position.len())
    }

    /// World positions of nodes, mm.
    pub fn position(&self) -> &[DVec3] {
        &self.position
    }

    /// Velocities of nodes, mm/s.
    pub fn velocity(&self) -> &[DVec3] {
        &self.velocity
    }

    /// Accelerations of nodes, mm/s².
    pub fn acceleration(&self) -> &[DVec3] {
        &self.acceleration
    }

    /// Rest lengths of edges, mm.
    pub fn rest_length(&self) -> &[f64] {
        &self.rest_length
    }

    /// Angle of each edge's material frame from its Bishop frame, rad.
    pub fn theta(&self) -> &[f64] {
        &self.theta
    }

    /// Natural curvature of each node's stretch of needle towards m1 and m2, as an integrated curvature 2·tan(φ/2), φ the natural
    /// turning angle; 0 at the ends.
    pub fn rest_curvature(&self) -> &[DVec2] {
        &self.geometry.rest_curvature
    }

    /// Curvature binormals of nodes, dimensionless, length 2·tan(turning angle/2); 0 at the ends.
    pub fn curvature_binormal(&self) -> &[DVec3] {
        &self.geometry.kb
    }

    /// Material frame of edge `edge`. Panics beyond the last edge.
    pub fn frame(&self, edge: usize) -> MaterialFrame {
        material(
            self.geometry.tangent[edge],
            self.geometry.bishop[edge],
            self.theta[edge],
        )
    }

    /// Material frame of the tip edge.
    pub fn tip_frame(&self) -> MaterialFrame {
        self.frame(self.theta.len() - 1)
    }

    /// World displacement by which a bevel of angle `bevel_rad` shifts the tip's target when the tip advances by `advance_mm`:
    /// `advance · tan ψ` along m2 of the tip (Chentanez et al. 2009, §3.5). A symmetric tip has ψ = 0.
    pub fn bevel_displacement(&self, advance_mm: f64, bevel_rad: f64) -> DVec3 {
        advance_mm * bevel_rad.tan() * self.tip_frame().m2
    }

    /// Unit tangent of each node, the direction of friction: mean direction of its two edges (Chentanez et al. 2009, §3.3), that
    /// of the only edge at the ends.
    pub fn node_tangent(&self, node: usize) -> DVec3 {
        let t = &self.geometry.tangent;
        if node == 0 {
            return t[0];
        }
        if node >= t.len() {
            return t[t.len() - 1];
        }
        (t[node - 1] + t[node]).try_normalize().unwrap_or(t[node])
    }

    /// Length of needle that belongs to `node`, mm: half of each adjoining rest length. Friction per length times this is the
    /// node's friction.
    pub fn node_length(&self, node: usize) -> f64 {
        let l = &self.rest_length;
        let before = if node > 0 { l[node - 1] } else { 0.0 };
        let after = l.get(node).copied().unwrap_or(0.0);
        0.5 * (before + after)
    }

    /// Sets velocities and accelerations of all nodes, mm/s and mm/s².
    ///
    /// Errors
    /// - [`NeedleError::Count`], [`NeedleError::NotFinite`]
    pub fn set_motion(&mut self, velocity: Vec<DVec3>, acceleration: Vec<DVec3>) -> Result<(), NeedleError> {
        for (what, values) in [("velocity", &velocity), ("acceleration", &acceleration)] {
            self.check_count(what, values.len())?;
            check_finite(what, values)?;
        }
        self.velocity = velocity;
        self.acceleration = acceleration;
        Ok(())
    }

    /// Moves all nodes, mm; material frames follow their edges without spinning, and free twist relaxes.
    ///
    /// Errors
    /// - [`NeedleError::Count`], [`NeedleError::NotFinite`], [`NeedleError::ShortEdge`], [`NeedleError::Folded`]; the rod is then
    ///   as before
    pub fn set_position(&mut self, position: Vec<DVec3>) -> Result<(), NeedleError> {
        self.check_count("position", position.len())?;
        check_finite("position", &position)?;
        self.move_to(position, None)?;
        self.relax_twist(&[])
    }

    /// Turns the material frame of a held end about its tangent, rad: at the base this is the base rotation of Chentanez et al.
    /// 2009, §3.5. A free tip cannot be turned; then only the base's angle counts.
    pub fn turn_ends(&mut self, base_rad: f64, tip_rad: f64) -> Result<(), NeedleError> {
        check(base_rad.is_finite(), "base_rad", base_rad, "a finite angle")?;
        check(tip_rad.is_finite(), "tip_rad", tip_rad, "a finite angle")?;
        self.theta[0] += base_rad;
        if self.held.tip {
            let last = self.theta.len() - 1;
            self.theta[last] += tip_rad;
        }
        self.relax_twist(&[])
    }

    fn check_count(&self, what: &'static str, found: usize) -> Result<(), NeedleError> {
        if found == self.position.len() {
            return Ok(());
        }
        Err(NeedleError::Count {
            what,
            found,
            expected: format!("{}, one per node", self.position.len()),
        })
    }

    fn refresh_geometry(&mut self) -> Result<(), NeedleError> {
        self.geometry = Geometry::new(
            &self.position,
            &self.rest_length,
            self.director,
            self.held,
            &self.params.pre_bend,
        )?;
        Ok(())
    }

    /// Takes new positions; edge 0's director is turned by the least rotation, or set to `director`; every frame is carried
    /// along in time by its own edge, without spin. On an error the rod is as before.
    fn move_to(&mut self, position: Vec<DVec3>, director: Option<DVec3>) -> Result<(), NeedleError> {
        let first = (position[1] - position[0])
            .try_normalize()
            .unwrap_or(self.geometry.tangent[0]);
        let new_director =
            director.unwrap_or_else(|| transport(self.director, self.geometry.tangent[0], first));
        let geometry = Geometry::new(
            &position,
            &self.rest_length,
            new_director,
            self.held,
            &self.params.pre_bend,
        )?;
        for j in 1..self.theta.len() {
            let carried = transport(self.frame(j).m1, self.geometry.tangent[j], geometry.tangent[j]);
            let angle = angle_about(geometry.tangent[j], geometry.bishop[j], carried);
            self.theta[j] = unwrap_near(angle, self.theta[j]);
        }
        self.position = position;
        self.director = geometry.bishop[0];
        self.geometry = geometry;
        Ok(())
    }
}
