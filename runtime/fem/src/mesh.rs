//! The tet mesh of a simulation: rest positions and connectivity that may change between steps.

use crate::FemError;
use crate::element::Element;
use crate::order::reverse_cuthill_mckee;
use glam::DVec3;

/// Least rest volume of a tet, of its longest edge cubed. Below it the shape gradients are noise.
pub(crate) const LEAST_FLATNESS: f64 = 1e-7;

/// A tet that holds a node, and which of its corners the node is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Incidence {
    /// Tet slot.
    pub tet: u32,
    /// Corner, 0 to 3.
    pub corner: u8,
}

/// One tet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tet {
    /// Node slots (a, b, c, d) with (b−a)·((c−a)×(d−a)) > 0 at rest.
    pub corners: [u32; 4],
    /// Index into the materials.
    pub region: u16,
}

/// Nodes and tets in slots: a removed one leaves its slot free for the next that is added, all others keep theirs.
///
/// At load, nodes are renumbered by reverse Cuthill–McKee and tets follow their least node, for locality;
/// [`TissueMesh::input_node`] and [`TissueMesh::input_tet`] tell where each came from.
#[derive(Clone, Debug)]
pub struct TissueMesh {
    rest: Vec<DVec3>,
    used: Vec<bool>,
    tets: Vec<Option<Tet>>,
    incident: Vec<Vec<Incidence>>,
    free_nodes: Vec<u32>,
    free_tets: Vec<u32>,
    input_nodes: Vec<u32>,
    input_tets: Vec<u32>,
}

impl TissueMesh {
    /// A mesh of rest positions (mm), corner indices and regions. Nodes without a tet are kept.
    ///
    /// # Errors
    /// - [`FemError::Empty`]: no tet
    /// - [`FemError::Element`]: more or fewer regions than tets, an index out of range, a position that is no finite
    ///   number, a flat or inverted tet
    pub fn new(points: &[[f64; 3]], tets: &[[u32; 4]], regions: &[u16]) -> Result<Self, FemError> {
        if tets.is_empty() {
            return Err(FemError::Empty);
        }
        if regions.len() != tets.len() {
            return Err(fault(
                "region list",
                0,
                format!("{} regions", regions.len()),
                format!("{}, one a tet", tets.len()),
            ));
        }
        for (n, p) in points.iter().enumerate() {
            check_point("node", n, DVec3::from_array(*p))?;
        }
        for (t, corners) in tets.iter().enumerate() {
            if let Some(bad) = corners.iter().find(|&&c| c as usize >= points.len()) {
                return Err(fault(
                    "tet",
                    t,
                    format!("corner {bad}"),
                    format!("nodes 0 to {}", points.len().saturating_sub(1)),
                ));
            }
            check_shape(t, corners.map(|c| DVec3::from_array(points[c as usize])))?;
        }
        let order = reverse_cuthill_mckee(points.len(), tets);
        let mut slot = vec![0u32; points.len()];
        for (s, &n) in order.iter().enumerate() {
            slot[n as usize] = s as u32;
        }
        let mut turn: Vec<u32> = (0..tets.len() as u32).collect();
        let place = |t: u32| {
            let mut c = tets[t as usize].map(|n| slot[n as usize]);
            c.sort_unstable();
            c
        };
        turn.sort_by_key(|&t| (place(t), t));
        let mut mesh = Self {
            rest: order
                .iter()
                .map(|&n| DVec3::from_array(points[n as usize]))
                .collect(),
            used: vec![true; points.len()],
            tets: Vec::with_capacity(tets.len()),
            incident: vec![Vec::new(); points.len()],
            free_nodes: Vec::new(),
            free_tets: Vec::new(),
            input_nodes: order,
            input_tets: turn.clone(),
        };
        for (slot_t, &t) in turn.iter().enumerate() {
            let tet = Tet {
                corners: tets[t as usize].map(|n| slot[n as usize]),
                region: regions[t as usize],
            };
            mesh.tets.push(Some(tet));
            mesh.enter(slot_t as u32, tet);
        }
        Ok(mesh)
    }

    fn enter(&mut self, slot: u32, tet: Tet) {
        for (corner, &n) in tet.corners.iter().enumerate() {
            let list = &mut self.incident[n as usize];
            let entry = Incidence {
                tet: slot,
                corner: corner as u8,
            };
            let at = list.partition_point(|e| *e < entry);
            list.insert(at, entry);
        }
    }

    /// Node slots, free ones included.
    pub fn node_slots(&self) -> usize {
        self.rest.len()
    }

    /// Tet slots, free ones included.
    pub fn tet_slots(&self) -> usize {
        self.tets.len()
    }

    /// Whether the slot holds a node.
    pub fn has_node(&self, node: u32) -> bool {
        self.used.get(node as usize).copied().unwrap_or(false)
    }

    /// The tet in a slot.
    pub fn tet(&self, tet: u32) -> Option<Tet> {
        self.tets.get(tet as usize).copied().flatten()
    }

    /// All tets with their slots, ascending.
    pub fn tets(&self) -> impl Iterator<Item = (u32, Tet)> {
        self.tets
            .iter()
            .enumerate()
            .filter_map(|(s, t)| t.map(|t| (s as u32, t)))
    }

    /// Rest position of each node slot, mm.
    pub fn rest(&self) -> &[DVec3] {
        &self.rest
    }

    /// Tets around a node, ascending.
    pub fn around(&self, node: u32) -> &[Incidence] {
        self.incident.get(node as usize).map_or(&[], Vec::as_slice)
    }

    /// Index that the node of a slot had in the arrays given; `None` for a node added later.
    pub fn input_node(&self, node: u32) -> Option<u32> {
        self.input_nodes
            .get(node as usize)
            .copied()
            .filter(|&n| n != u32::MAX)
    }

    /// Index that the tet of a slot had in the arrays given; `None` for a tet added later.
    pub fn input_tet(&self, tet: u32) -> Option<u32> {
        self.input_tets
            .get(tet as usize)
            .copied()
            .filter(|&t| t != u32::MAX)
    }

    /// Slot of each node of the arrays given, as long as none was removed.
    pub fn slots_of_input(&self) -> Vec<u32> {
        let mut slots: Vec<(u32, u32)> = self
            .input_nodes
            .iter()
            .enumerate()
            .filter(|(_, n)| **n != u32::MAX)
            .map(|(s, &n)| (n, s as u32))
            .collect();
        slots.sort_unstable();
        slots.into_iter().map(|(_, s)| s).collect()
    }

    /// Faces of one tet only, counter-clockwise seen from outside, sorted.
    pub fn boundary(&self) -> Vec<[u32; 3]> {
        let mut faces: Vec<([u32; 3], [u32; 3])> = self
            .tets()
            .flat_map(|(_, t)| {
                let [a, b, c, d] = t.corners;
                [[b, c, d], [a, d, c], [a, b, d], [a, c, b]]
            })
            .map(|f| {
                let mut key = f;
                key.sort_unstable();
                (key, f)
            })
            .collect();
        faces.sort_unstable();
        faces
            .chunk_by(|a, b| a.0 == b.0)
            .filter(|run| run.len() == 1)
            .map(|run| run[0].1)
            .collect()
    }

    /// Least and greatest dihedral angle of the mesh at rest, degrees.
    pub fn dihedral_degrees(&self) -> (f64, f64) {
        let (mut least, mut most) = (1.0f64, -1.0f64);
        for (_, t) in self.tets() {
            let x = t.corners.map(|n| self.rest[n as usize]);
            // Outer normals of the faces opposite to each corner; the angle between faces is π less that between normals.
            let n = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]
                .map(|[a, b, c]: [usize; 3]| (x[b] - x[a]).cross(x[c] - x[a]).normalize_or_zero());
            for (i, j) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)] {
                let cosine = -n[i].dot(n[j]);
                least = least.min(cosine);
                most = most.max(cosine);
            }
        }
        let degrees = |c: f64| c.clamp(-1.0, 1.0).acos().to_degrees();
        (degrees(most), degrees(least))
    }

    /// Nodes of each piece of the mesh, ascending; pieces by their least node. Tets that share a node are of one piece; nodes
    /// without a tet are of none.
    pub fn pieces(&self) -> Vec<Vec<u32>> {
        let mut seen = vec![false; self.rest.len()];
        let mut pieces = Vec::new();
        for start in 0..self.rest.len() as u32 {
            if seen[start as usize] || self.around(start).is_empty() {
                continue;
            }
            seen[start as usize] = true;
            let mut piece = vec![start];
            let mut next = 0;
            while let Some(&node) = piece.get(next) {
                next += 1;
                for t in self.around(node).iter().filter_map(|e| self.tet(e.tet)) {
                    for c in t.corners {
                        if !std::mem::replace(&mut seen[c as usize], true) {
                            piece.push(c);
                        }
                    }
                }
            }
            piece.sort_unstable();
            pieces.push(piece);
        }
        pieces
    }

    /// Adds a node at a rest position and returns its slot.
    pub(crate) fn add_node(&mut self, rest: DVec3) -> Result<u32, FemError> {
        check_point("new node", self.rest.len(), rest)?;
        if let Some(slot) = self.free_nodes.pop() {
            self.rest[slot as usize] = rest;
            self.used[slot as usize] = true;
            return Ok(slot);
        }
        self.rest.push(rest);
        self.used.push(true);
        self.incident.push(Vec::new());
        self.input_nodes.push(u32::MAX);
        Ok(self.rest.len() as u32 - 1)
    }

    /// Removes a node that no tet holds.
    pub(crate) fn remove_node(&mut self, node: u32) -> Result<(), FemError> {
        self.check_node(node)?;
        let tets = self.around(node).len();
        if tets > 0 {
            return Err(fault(
                "node",
                node as usize,
                format!("{tets} tets around it"),
                "none: remove its tets first".into(),
            ));
        }
        self.used[node as usize] = false;
        self.input_nodes[node as usize] = u32::MAX;
        self.free_nodes.push(node);
        Ok(())
    }

    /// Adds a tet and returns its slot.
    pub(crate) fn add_tet(&mut self, corners: [u32; 4], region: u16) -> Result<u32, FemError> {
        for c in corners {
            self.check_node(c)?;
        }
        let slot = self.free_tets.last().copied().unwrap_or(self.tets.len() as u32);
        check_shape(slot as usize, corners.map(|c| self.rest[c as usize]))?;
        let tet = Tet { corners, region };
        if self.free_tets.pop().is_some() {
            self.tets[slot as usize] = Some(tet);
        } else {
            self.tets.push(Some(tet));
            self.input_tets.push(u32::MAX);
        }
        self.enter(slot, tet);
        Ok(slot)
    }

    /// Removes a tet; its nodes stay.
    pub(crate) fn remove_tet(&mut self, tet: u32) -> Result<Tet, FemError> {
        let Some(old) = self.tets.get_mut(tet as usize).and_then(Option::take) else {
            return Err(fault("tet", tet as usize, "a free slot".into(), "a tet".into()));
        };
        for n in old.corners {
            self.incident[n as usize].retain(|e| e.tet != tet);
        }
        self.input_tets[tet as usize] = u32::MAX;
        self.free_tets.push(tet);
        Ok(old)
    }

    /// Moves a node's rest position; refused, and undone, where a tet around it would turn flat.
    pub(crate) fn move_rest(&mut self, node: u32, rest: DVec3) -> Result<(), FemError> {
        self.check_node(node)?;
        check_point("node", node as usize, rest)?;
        let old = std::mem::replace(&mut self.rest[node as usize], rest);
        for e in &self.incident[node as usize] {
            if let Some(t) = self.tets[e.tet as usize]
                && let Err(flat) = check_shape(e.tet as usize, t.corners.map(|c| self.rest[c as usize]))
            {
                self.rest[node as usize] = old;
                return Err(flat);
            }
        }
        Ok(())
    }

    pub(crate) fn check_node(&self, node: u32) -> Result<(), FemError> {
        if self.has_node(node) {
            Ok(())
        } else {
            Err(fault(
                "node",
                node as usize,
                "a free or absent slot".into(),
                "a node".into(),
            ))
        }
    }

    pub(crate) fn element(&self, tet: Tet) -> Element {
        Element::new(tet.corners.map(|c| self.rest[c as usize]))
    }
}

pub(crate) fn fault(what: &'static str, index: usize, found: String, expected: String) -> FemError {
    FemError::Element {
        what,
        index,
        found,
        expected,
    }
}

fn check_point(what: &'static str, index: usize, p: DVec3) -> Result<(), FemError> {
    if p.is_finite() && p.abs().max_element() < 1e6 {
        Ok(())
    } else {
        Err(fault(
            what,
            index,
            format!("{p}"),
            "finite mm within a kilometre".into(),
        ))
    }
}

fn check_shape(tet: usize, x: [DVec3; 4]) -> Result<(), FemError> {
    let volume = (x[1] - x[0]).dot((x[2] - x[0]).cross(x[3] - x[0])) / 6.0;
    let mut longest = 0.0f64;
    for i in 0..4 {
        for j in 0..i {
            longest = longest.max(x[i].distance(x[j]));
        }
    }
    if volume > LEAST_FLATNESS * longest.powi(3) {
        Ok(())
    } else {
        Err(fault(
            "tet",
            tet,
            format!("a rest volume of {volume:.3e} mm³ with a longest edge of {longest:.3} mm"),
            "a positive volume: order its corners so that (b−a)·((c−a)×(d−a)) > 0, or drop the flat tet"
                .into(),
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A corner tet has 90° at three edges and 54.7° at the others; a second one far away is a piece of its own.
    #[test]
    fn angles_and_pieces_of_two_corner_tets() {
        let mut points = vec![[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]];
        points.extend(points.clone().iter().map(|p| [p[0] + 9.0, p[1], p[2]]));
        let mut mesh = TissueMesh::new(&points, &[[0, 1, 2, 3], [4, 5, 6, 7]], &[0, 0]).unwrap();
        let (least, most) = mesh.dihedral_degrees();
        assert!(
            (least - (1.0 / 3.0f64.sqrt()).acos().to_degrees()).abs() < 1e-12,
            "{least}"
        );
        assert!((most - 90.0).abs() < 1e-12, "{most}");
        let pieces = mesh.pieces();
        assert_eq!(pieces.iter().map(Vec::len).collect::<Vec<_>>(), [4, 4]);
        // A bridge of one shared node joins them.
        let at = |x: f64| mesh.rest().iter().position(|p| *p == DVec3::X * x).unwrap() as u32;
        let (a, b) = (at(2.0), at(9.0));
        let up = mesh.add_node(DVec3::new(5.0, 0.0, 4.0)).unwrap();
        let aside = mesh.add_node(DVec3::new(5.0, 4.0, 0.0)).unwrap();
        assert!(mesh.add_tet([a, b, aside, up], 0).is_ok());
        assert_eq!(mesh.pieces().len(), 1);
    }
}
