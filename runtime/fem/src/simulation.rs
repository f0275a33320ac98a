use crate::contact::{Place, Solid, check_place};
use crate::elements::{Combination, Elements};
use crate::mesh::fault;
use crate::precondition::Precondition;
use crate::step::Points;
use crate::{BlockMatrix, FemError, Filter, Material, Settings, SolveReport, TissueMesh};
use glam::{DMat3, DVec3};
use std::sync::Arc;

/// State of one node.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NodeState {
    /// Material position, mm.
    pub rest: DVec3,
    /// Position, mm.
    pub position: DVec3,
    /// Velocity, mm/s.
    pub velocity: DVec3,
    /// Acceleration, mm/s².
    pub acceleration: DVec3,
}

/// What one step did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    /// Parts that the step was made in; more than one where it would have deformed a tet too much at once.
    pub substeps: u32,
    /// Whether a part was still too violent after all halvings and was made by implicit Euler, which loses energy.
    pub braked: bool,
    /// Newton iterations.
    pub newton: u32,
    /// Solves, contact corrections among them.
    pub solves: u32,
    /// Iterations of all solves together.
    pub iterations: u32,
    /// The last solve.
    pub solve: SolveReport,
    /// Share of the tets whose Jacobian was renewed.
    pub renewed_share: f64,
    /// Whether contacts still changed in the last pass.
    pub contacts_open: bool,
    /// Whether the exact Jacobian was not positive definite and its positive part was used.
    pub positive_part: bool,
    /// Whether the preconditioner was made anew.
    pub preconditioned: bool,
    /// Time of forces and Jacobians, s.
    pub assembly_time_s: f64,
    /// Time of solves, s.
    pub solve_time_s: f64,
}

impl StepReport {
    /// Takes over a substep.
    pub(crate) fn add(&mut self, part: Self) {
        *self = Self {
            substeps: self.substeps + part.substeps,
            newton: self.newton + part.newton,
            solves: self.solves + part.solves,
            iterations: self.iterations + part.iterations,
            braked: self.braked | part.braked,
            positive_part: self.positive_part | part.positive_part,
            preconditioned: self.preconditioned | part.preconditioned,
            assembly_time_s: self.assembly_time_s + part.assembly_time_s,
            solve_time_s: self.solve_time_s + part.solve_time_s,
            ..part
        };
    }
}

/// A directional constraint of one node in the step at hand: the projection on its free directions and the constrained part of
/// its acceleration.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Constraint {
    pub free: DMat3,
    pub acceleration: DVec3,
}

/// A node held in some directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Hold {
    pub free: DMat3,
    pub position: DVec3,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Contact {
    pub node: u32,
    pub solid: u32,
    pub face: u8,
    /// Normal force of the last step, µN.
    pub push_un: f64,
}

/// A contact of a point between nodes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Spring {
    pub point: u32,
    pub solid: u32,
    pub face: u8,
    /// Force of the last step, µN.
    pub push_un: f64,
}

/// A spring in the system at hand: force push − coefficient·(normal·a⁺) along the normal.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SpringState {
    pub spring: Spring,
    pub normal: DVec3,
    /// µN·s²/mm.
    pub coefficient: f64,
    /// µN.
    pub push: f64,
}

#[derive(Clone, Debug, Default)]
pub(crate) struct Springs {
    /// By point.
    pub active: Vec<Spring>,
    /// Those in the matrix.
    pub applied: Vec<SpringState>,
    /// Points that solids may reach in this step, ascending.
    pub near: Vec<u32>,
    /// Forces of the last solution, µN, by point.
    pub pushes: Vec<(u32, f64)>,
    /// Points that lie at a solid after the last step, pressed or not, and the solid.
    pub touching: Vec<(u32, u32)>,
    /// How often points were made anew: numbers of points before that mean nothing.
    pub made: u32,
}

/// Tissue with its state, constraints and solids; [`Simulation::step`] moves it on by one time step.
///
/// Nodes and tets are named by their slots in [`Simulation::mesh`].
#[derive(Debug)]
pub struct Simulation {
    pub(crate) settings: Settings,
    pub(crate) materials: Vec<Material>,
    pub(crate) mesh: TissueMesh,
    pub(crate) elements: Elements,
    pub(crate) matrix: BlockMatrix,
    pub(crate) x: Vec<DVec3>,
    pub(crate) v: Vec<DVec3>,
    pub(crate) a: Vec<DVec3>,
    pub(crate) load: Vec<DVec3>,
    pub(crate) holds: Vec<Option<Hold>>,
    pub(crate) solids: Vec<Solid>,
    pub(crate) contacts: Vec<Contact>,
    /// Points of the boundary between nodes; `None` when the mesh has changed.
    pub(crate) points: Option<Points>,
    pub(crate) springs: Springs,
    /// Nodes on the boundary, ascending; `None` when the mesh has changed.
    pub(crate) surface: Option<Vec<u32>>,
    pub(crate) precondition: Option<Precondition>,
    /// Iterations of the first solve with the preconditioner.
    pub(crate) first_iterations: Option<u32>,
    /// Right-hand side of the step at hand.
    pub(crate) rhs: Vec<DVec3>,
    pub(crate) reactions: Vec<DVec3>,
    pub(crate) edits: u32,
    pub(crate) steps: u64,
    /// Length of the step or substep at hand, s.
    pub(crate) dt: f64,
    /// β and γ at hand.
    pub(crate) newmark: [f64; 2],
    pub(crate) pool: Option<Arc<rayon::ThreadPool>>,
}

impl Simulation {
    /// Tissue at rest; `materials[r]` is the material of region r.
    ///
    /// # Errors
    /// [`FemError::Value`] for settings or materials out of range, [`FemError::Element`] for a tet whose region has no material.
    pub fn new(mesh: TissueMesh, materials: Vec<Material>, settings: Settings) -> Result<Self, FemError> {
        settings.check()?;
        for (r, m) in materials.iter().enumerate() {
            m.check(&format!("of region {r}"))?;
        }
        for (t, tet) in mesh.tets() {
            check_region(t, tet.region, &materials)?;
        }
        let mut matrix = BlockMatrix::new(mesh.node_slots());
        let elements = Elements::new(&mesh, &materials, &mut matrix);
        let n = mesh.node_slots();
        let pool = match settings.threads {
            0 => None,
            threads => rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .ok()
                .map(Arc::new),
        };
        Ok(Self {
            x: mesh.rest().to_vec(),
            v: vec![DVec3::ZERO; n],
            a: vec![DVec3::ZERO; n],
            load: vec![DVec3::ZERO; n],
            holds: vec![None; n],
            solids: Vec::new(),
            contacts: Vec::new(),
            points: None,
            springs: Springs::default(),
            surface: None,
            precondition: None,
            first_iterations: None,
            rhs: vec![DVec3::ZERO; n],
            reactions: vec![DVec3::ZERO; n],
            edits: 0,
            steps: 0,
            dt: settings.dt_s,
            newmark: [settings.newmark_beta, settings.newmark_gamma],
            pool,
            settings,
            materials,
            mesh,
            elements,
            matrix,
        })
    }

    /// Nodes and tets.
    pub fn mesh(&self) -> &TissueMesh {
        &self.mesh
    }

    /// Settings.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Materials by region.
    pub fn materials(&self) -> &[Material] {
        &self.materials
    }

    /// Position of each node slot, mm.
    pub fn positions(&self) -> &[DVec3] {
        &self.x
    }

    /// Velocity of each node slot, mm/s.
    pub fn velocities(&self) -> &[DVec3] {
        &self.v
    }

    /// Acceleration of each node slot, mm/s².
    pub fn accelerations(&self) -> &[DVec3] {
        &self.a
    }

    /// Lumped mass of each node slot, g.
    pub fn masses(&self) -> &[f64] {
        &self.elements.mass
    }

    /// Matrix of the last step or equilibrium.
    pub fn matrix(&self) -> &BlockMatrix {
        &self.matrix
    }

    /// Force of holds and solids on each node in the last step or equilibrium, µN; zero for free nodes up to the solver's
    /// tolerance.
    pub fn reactions(&self) -> &[DVec3] {
        &self.reactions
    }

    /// Steps made.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Simulated time, s.
    pub fn time_s(&self) -> f64 {
        self.steps as f64 * self.settings.dt_s
    }

    /// Replaces the state of a node except its rest position.
    ///
    /// # Errors
    /// [`FemError::Element`]: no such node, or a state that is no finite number.
    pub fn set_state(
        &mut self,
        node: u32,
        position: DVec3,
        velocity: DVec3,
        acceleration: DVec3,
    ) -> Result<(), FemError> {
        self.mesh.check_node(node)?;
        if !(position.is_finite() && velocity.is_finite() && acceleration.is_finite()) {
            return Err(fault(
                "node",
                node as usize,
                format!("position {position}, velocity {velocity}"),
                "finite numbers".into(),
            ));
        }
        let n = node as usize;
        (self.x[n], self.v[n], self.a[n]) = (position, velocity, acceleration);
        Ok(())
    }

    /// Constant force on a node, µN, beside gravity.
    ///
    /// # Errors
    /// [`FemError::Element`]: no such node, or a force that is no finite number.
    pub fn set_load(&mut self, node: u32, force_un: DVec3) -> Result<(), FemError> {
        self.mesh.check_node(node)?;
        if !force_un.is_finite() {
            return Err(fault(
                "load of node",
                node as usize,
                format!("{force_un}"),
                "finite µN".into(),
            ));
        }
        self.load[node as usize] = force_un;
        Ok(())
    }

    /// Holds a node in the directions (x, y, z) marked, at its position now; no direction marked frees it.
    ///
    /// # Errors
    /// [`FemError::Element`]: no such node.
    pub fn hold(&mut self, node: u32, axes: [bool; 3]) -> Result<(), FemError> {
        self.mesh.check_node(node)?;
        let n = node as usize;
        let free = axes.map(|held| if held { 0.0 } else { 1.0 });
        self.holds[n] = axes.contains(&true).then(|| Hold {
            free: DMat3::from_diagonal(DVec3::from_array(free)),
            position: self.x[n],
        });
        self.precondition = None;
        Ok(())
    }

    /// Whether a node is held in any direction.
    pub fn is_held(&self, node: u32) -> bool {
        self.holds.get(node as usize).is_some_and(Option::is_some)
    }

    /// Where a held node is to be at the end of the coming step, mm (its held directions only).
    ///
    /// # Errors
    /// [`FemError::Element`]: the node is not held, or the position is no finite number.
    pub fn move_hold(&mut self, node: u32, position: DVec3) -> Result<(), FemError> {
        self.mesh.check_node(node)?;
        match &mut self.holds[node as usize] {
            Some(h) if position.is_finite() => {
                h.position = position;
                Ok(())
            }
            _ => Err(fault(
                "node",
                node as usize,
                format!("not held, or {position}"),
                "a held node and finite mm".into(),
            )),
        }
    }

    /// Adds a solid and returns its index.
    pub fn add_solid(&mut self, solid: Solid) -> usize {
        self.solids.push(solid);
        self.solids.len() - 1
    }

    /// Solids with their contact read-outs.
    pub fn solids(&self) -> &[Solid] {
        &self.solids
    }

    /// Where a solid is to be at the end of the coming step.
    ///
    /// # Errors
    /// [`FemError::Element`]: no such solid; [`FemError::Value`]: no rigid motion.
    pub fn move_solid(&mut self, solid: usize, place: Place) -> Result<(), FemError> {
        let count = self.solids.len();
        let Some(s) = self.solids.get_mut(solid) else {
            return Err(fault(
                "solid",
                solid,
                format!("{count} solids"),
                "an index below that".into(),
            ));
        };
        check_place(&s.name, place)?;
        s.place = place;
        Ok(())
    }

    /// Strain energy, nJ.
    pub fn strain_energy_nj(&self) -> f64 {
        self.elements.energy_nj(&self.x)
    }

    /// Kinetic energy, nJ.
    pub fn kinetic_energy_nj(&self) -> f64 {
        self.elements
            .mass
            .iter()
            .zip(&self.v)
            .map(|(m, v)| 0.5 * m * v.length_squared())
            .sum()
    }

    /// Volume of each tet over its rest volume, by slot; below 0 it is inverted.
    pub fn volume_ratios(&self) -> Vec<(u32, f64)> {
        self.elements.volume_ratios(&self.x)
    }

    /// Adds a node without tets and returns its slot, which may be one left free by [`Simulation::remove_node`].
    ///
    /// # Errors
    /// [`FemError::Element`]: numbers that are not finite.
    pub fn add_node(&mut self, state: NodeState) -> Result<u32, FemError> {
        let node = self.mesh.add_node(state.rest)?;
        let n = self.mesh.node_slots();
        self.elements.grow(&self.mesh, &mut self.matrix);
        for array in [
            &mut self.x,
            &mut self.v,
            &mut self.a,
            &mut self.load,
            &mut self.rhs,
            &mut self.reactions,
        ] {
            array.resize(n, DVec3::ZERO);
        }
        self.holds.resize(n, None);
        self.load[node as usize] = DVec3::ZERO;
        self.holds[node as usize] = None;
        if let Err(e) = self.set_state(node, state.position, state.velocity, state.acceleration) {
            self.mesh.remove_node(node)?;
            return Err(e);
        }
        self.edited();
        Ok(node)
    }

    /// Removes a node that no tet holds.
    ///
    /// # Errors
    /// [`FemError::Element`]: no such node, or tets hold it.
    pub fn remove_node(&mut self, node: u32) -> Result<(), FemError> {
        self.mesh.remove_node(node)?;
        self.contacts.retain(|c| c.node != node);
        self.elements.weigh(&self.mesh, &self.materials, [node]);
        let n = node as usize;
        (self.v[n], self.a[n], self.load[n]) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO);
        self.holds[n] = None;
        self.edited();
        Ok(())
    }

    /// Adds a tet between nodes and returns its slot.
    ///
    /// # Errors
    /// [`FemError::Element`]: nodes that are not there, a flat or inverted rest shape, a region without material.
    pub fn add_tet(&mut self, corners: [u32; 4], region: u16) -> Result<u32, FemError> {
        check_region(self.mesh.tet_slots() as u32, region, &self.materials)?;
        let slot = self.mesh.add_tet(corners, region)?;
        self.elements.grow(&self.mesh, &mut self.matrix);
        if let Some(tet) = self.mesh.tet(slot) {
            self.elements.set_tet(&self.mesh, slot, tet, &self.materials);
            self.elements.enter(slot, tet, &mut self.matrix);
        }
        self.elements.weigh(&self.mesh, &self.materials, corners);
        self.edited();
        Ok(slot)
    }

    /// Removes a tet; its nodes stay.
    ///
    /// # Errors
    /// [`FemError::Element`]: no such tet.
    pub fn remove_tet(&mut self, tet: u32) -> Result<(), FemError> {
        let old = self.mesh.remove_tet(tet)?;
        self.elements.remove(tet, old);
        self.elements.weigh(&self.mesh, &self.materials, old.corners);
        self.edited();
        Ok(())
    }

    /// Gives a node another rest position and state (a node snap).
    ///
    /// # Errors
    /// [`FemError::Element`]: no such node, numbers that are not finite, or a tet around it that would turn flat; then nothing has
    /// changed.
    pub fn move_node(&mut self, node: u32, state: NodeState) -> Result<(), FemError> {
        let old = self.mesh.rest().get(node as usize).copied();
        self.mesh.move_rest(node, state.rest)?;
        if let Err(e) = self.set_state(node, state.position, state.velocity, state.acceleration) {
            if let Some(old) = old {
                self.mesh.move_rest(node, old)?;
            }
            return Err(e);
        }
        let around: Vec<u32> = self.mesh.around(node).iter().map(|e| e.tet).collect();
        let mut touched = vec![node];
        for slot in around {
            if let Some(tet) = self.mesh.tet(slot) {
                self.elements.set_tet(&self.mesh, slot, tet, &self.materials);
                touched.extend(tet.corners);
            }
        }
        touched.sort_unstable();
        touched.dedup();
        self.elements.weigh(&self.mesh, &self.materials, touched);
        Ok(())
    }

    /// Makes changes of nodes and tets that leave the set of boundary nodes as it is, so that it need not be found anew for contacts.
    pub fn edit_inside<R>(&mut self, changes: impl FnOnce(&mut Self) -> R) -> R {
        let outside = (self.surface.take(), self.points.take());
        let result = changes(self);
        (self.surface, self.points) = outside;
        result
    }

    fn edited(&mut self) {
        (self.surface, self.points) = (None, None);
        self.edits += 1;
        // Zero entries of edges that are gone cost time: drop them once in a while.
        if self.edits >= 4000 {
            self.edits = 0;
            self.precondition = None;
            self.elements.compact(&self.mesh, &mut self.matrix);
        }
    }

    /// Nodes of the boundary, ascending.
    pub fn surface_nodes(&mut self) -> &[u32] {
        let mesh = &self.mesh;
        self.surface.get_or_insert_with(|| {
            let mut nodes: Vec<u32> = mesh.boundary().into_iter().flatten().collect();
            nodes.sort_unstable();
            nodes.dedup();
            nodes
        })
    }

    /// Nodes without unknowns: held in all directions, free slots, nodes without tets.
    pub(crate) fn held_mask(&self) -> Vec<bool> {
        (0..self.x.len())
            .map(|n| {
                self.mesh.around(n as u32).is_empty() || self.holds[n].is_some_and(|h| h.free == DMat3::ZERO)
            })
            .collect()
    }

    /// External force of gravity and loads, µN.
    pub(crate) fn external(&self, n: usize) -> DVec3 {
        self.load[n] + DVec3::from_array(self.settings.gravity_mm_s2) * self.elements.mass[n]
    }

    pub(crate) fn filter_of(constraints: &[Option<Constraint>]) -> Filter {
        Filter::new(
            constraints
                .iter()
                .enumerate()
                .filter_map(|(n, c)| c.map(|c| (n as u32, c.free)))
                .collect(),
        )
    }

    pub(crate) fn dynamic_combination(&self) -> Combination {
        let [beta, gamma] = self.newmark;
        Combination {
            mass: 1.0,
            stiffness: beta * self.dt * self.dt,
            damping: gamma * self.dt,
        }
    }
}

fn check_region(tet: u32, region: u16, materials: &[Material]) -> Result<(), FemError> {
    if (region as usize) < materials.len() {
        return Ok(());
    }
    Err(fault(
        "tet",
        tet as usize,
        format!("region {region}"),
        format!("one of {} regions with a material", materials.len()),
    ))
}
