//! Merging and splitting of edges outside the tissue (Chentanez et al. 2009, §3.4.2).

use super::Rod;
use crate::frame::{MaterialFrame, angle_about, transport, unwrap_near};
use crate::{NeedleError, error::check};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Lengths between which edges outside the tissue are kept.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EdgeLimits {
    /// Shorter edges are merged, mm: half of the shortest initial edge.
    pub min_mm: f64,
    /// Longer edges are split, mm: four times the longest initial edge.
    pub max_mm: f64,
}

impl EdgeLimits {
    /// Limits by the edges of a rod as it starts, the one in the sleeve aside.
    pub fn of(rod: &Rod) -> Self {
        let outside = &rod.rest_length[usize::from(rod.held.base)..];
        let min = outside.iter().cloned().fold(f64::INFINITY, f64::min);
        let max = outside.iter().cloned().fold(0.0, f64::max);
        Self {
            min_mm: 0.5 * min,
            max_mm: 4.0 * max,
        }
    }
}

/// What [`Rod::refine`] did.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RefineReport {
    /// For each node now, its index before; `None` for a new node.
    pub origin: Vec<Option<usize>>,
    /// Nodes removed.
    pub merged: usize,
    /// Nodes added.
    pub split: usize,
    /// First node in the tissue, as an index now.
    pub first_coupled: Option<usize>,
    /// Edges that are too short but join two nodes that must stay, as indices now.
    pub stuck: Vec<usize>,
}

/// State of the nodes and edges while they are changed. Material frames are kept in world axes, for Bishop frames change
/// with the nodes.
struct Draft {
    position: Vec<DVec3>,
    velocity: Vec<DVec3>,
    acceleration: Vec<DVec3>,
    rest_length: Vec<f64>,
    theta: Vec<f64>,
    frames: Vec<MaterialFrame>,
    spin: Vec<f64>,
    origin: Vec<Option<usize>>,
}

impl Draft {
    fn remove(&mut self, node: usize) {
        let keep = if self.rest_length[node] > self.rest_length[node - 1] {
            node
        } else {
            node - 1
        };
        let total = self.rest_length[node - 1] + self.rest_length[node];
        self.theta[node - 1] = self.theta[keep];
        self.frames[node - 1] = self.frames[keep];
        self.spin[node - 1] = self.spin[keep];
        self.rest_length[node - 1] = total;
        for edge in [&mut self.theta, &mut self.spin, &mut self.rest_length] {
            edge.remove(node);
        }
        self.frames.remove(node);
        for nodes in [&mut self.position, &mut self.velocity, &mut self.acceleration] {
            nodes.remove(node);
        }
        self.origin.remove(node);
    }

    fn insert_middle(&mut self, edge: usize, position: DVec3, velocity: DVec3) {
        let half = 0.5 * self.rest_length[edge];
        self.rest_length[edge] = half;
        self.rest_length.insert(edge, half);
        self.theta.insert(edge, self.theta[edge]);
        self.frames.insert(edge, self.frames[edge]);
        self.spin.insert(edge, self.spin[edge]);
        let acceleration = 0.5 * (self.acceleration[edge] + self.acceleration[edge + 1]);
        self.position.insert(edge + 1, position);
        self.velocity.insert(edge + 1, velocity);
        self.acceleration.insert(edge + 1, acceleration);
        self.origin.insert(edge + 1, None);
    }
}

impl Rod {
    /// Removes nodes that lie too close together outside the tissue and splits edges that are too long, until neither is left.
    /// A free node gives way to the sleeve's mouth and to the tissue's surface; node `first_coupled` and all beyond it are in the
    /// tissue and stay (`None`: all of the needle is outside). Rest length is conserved.
    ///
    /// Errors
    /// - [`NeedleError::Parameter`] limits that cannot both be kept
    /// - [`NeedleError::ShortEdge`], [`NeedleError::Folded`] nodes that would make no needle; the rod is then as before
    pub fn refine(
        &mut self,
        limits: &EdgeLimits,
        first_coupled: Option<usize>,
    ) -> Result<RefineReport, NeedleError> {
        check(limits.min_mm >= 0.0, "min_mm", limits.min_mm, "at least 0")?;
        check(
            limits.max_mm >= 4.0 * limits.min_mm && limits.max_mm > 0.0,
            "max_mm",
            limits.max_mm,
            "at least four times min_mm",
        )?;
        let mut draft = self.draft();
        let mut report = RefineReport {
            first_coupled,
            ..Default::default()
        };
        let first = usize::from(self.held.base);
        // Edges outside the tissue that may change.
        let end = |draft: &Draft, coupled: Option<usize>| {
            let edges = draft.rest_length.len() - usize::from(self.held.tip);
            coupled.map_or(edges, |node| node.min(edges))
        };
        let mut j = first;
        while j < end(&draft, report.first_coupled) {
            if draft.rest_length[j] >= limits.min_mm {
                j += 1;
                continue;
            }
            let last_node = draft.position.len() - 1 - usize::from(self.held.tip);
            let free = |node: usize| {
                node > first && node < last_node && report.first_coupled.is_none_or(|c| node < c)
            };
            let victim = [j + 1, j].into_iter().find(|&node| free(node));
            match victim {
                // A needle keeps two edges, whatever their lengths.
                Some(node) if draft.rest_length.len() > 2 => {
                    draft.remove(node);
                    report.merged += 1;
                    report.first_coupled = report.first_coupled.map(|c| c - 1);
                    j = j.saturating_sub(1).max(first);
                }
                _ => {
                    report.stuck.push(j);
                    j += 1;
                }
            }
        }
        let mut tangent = self.smooth_tangents(&draft);
        let mut j = first;
        while j < end(&draft, report.first_coupled) {
            if draft.rest_length[j] <= limits.max_mm {
                j += 1;
                continue;
            }
            self.split(&mut draft, &mut tangent, j);
            report.split += 1;
            report.first_coupled = report.first_coupled.map(|c| c + 1);
            report.stuck.iter_mut().filter(|s| **s > j).for_each(|s| *s += 1);
        }
        report.origin = draft.origin.clone();
        if report.merged + report.split > 0 {
            self.adopt(draft)?;
        }
        Ok(report)
    }

    /// Tangents of a smooth curve through the draft's nodes: of the circle through each node and its neighbours (in which the
    /// shorter edge tells more); at the sleeve's mouth the sleeve's direction.
    fn smooth_tangents(&self, draft: &Draft) -> Vec<DVec3> {
        let edges: Vec<DVec3> = draft.position.windows(2).map(|w| w[1] - w[0]).collect();
        let last = edges.len() - 1;
        (0..=edges.len())
            .map(|i| match i {
                0 => edges[0].normalize_or_zero(),
                1 if self.held.base => edges[0].normalize_or_zero(),
                i if i > last => edges[last].normalize_or_zero(),
                i => {
                    let (a, b) = (edges[i - 1], edges[i]);
                    (a / a.length_squared() + b / b.length_squared()).normalize_or(b.normalize_or_zero())
                }
            })
            .collect()
    }

    /// Splits edge `j` at the middle of the cubic through its nodes with their tangents.
    fn split(&self, draft: &mut Draft, tangent: &mut Vec<DVec3>, j: usize) {
        let (p0, p1) = (draft.position[j], draft.position[j + 1]);
        let (t0, t1) = (tangent[j], tangent[j + 1]);
        let length = p0.distance(p1);
        let position = 0.5 * (p0 + p1) + length / 8.0 * (t0 - t1);
        let middle = (1.5 * (p1 - p0) - 0.25 * length * (t0 + t1)).normalize_or(t0);
        let mut velocity = 0.5 * (draft.velocity[j] + draft.velocity[j + 1]);
        if j == 1 && self.held.base {
            // Needle leaves the mouth at the speed at which it is fed, although the mouth's node does not move with it.
            velocity += 0.5 * self.feed_mm_per_s * t0;
        }
        draft.insert_middle(j, position, velocity);
        tangent.insert(j + 1, middle);
    }

    fn draft(&self) -> Draft {
        Draft {
            position: self.position.clone(),
            velocity: self.velocity.clone(),
            acceleration: self.acceleration.clone(),
            rest_length: self.rest_length.clone(),
            theta: self.theta.clone(),
            frames: (0..self.theta.len()).map(|j| self.frame(j)).collect(),
            spin: self.spin.clone(),
            origin: (0..self.position.len()).map(Some).collect(),
        }
    }

    fn adopt(&mut self, draft: Draft) -> Result<(), NeedleError> {
        let mut new = self.clone();
        new.position = draft.position;
        new.velocity = draft.velocity;
        new.acceleration = draft.acceleration;
        new.rest_length = draft.rest_length;
        new.spin = draft.spin;
        new.theta = draft.theta;
        new.refresh_geometry()?;
        for j in 1..new.theta.len() {
            let tangent = new.geometry.tangent[j];
            let old = draft.frames[j];
            let carried = transport(old.m1, old.tangent, tangent);
            let angle = angle_about(tangent, new.geometry.bishop[j], carried);
            new.theta[j] = unwrap_near(angle, new.theta[j]);
        }
        new.director = new.geometry.bishop[0];
        // Only edges outside the tissue have changed, which nothing grips.
        let (now, was) = (new.theta.len(), self.grip.len());
        new.grip = match was {
            0 => Vec::new(),
            _ => (0..now)
                .map(|j| match (j + was).checked_sub(now) {
                    Some(old) => self.grip[old],
                    None => 0.0,
                })
                .collect(),
        };
        new.relax_twist(&[])?;
        *self = new;
        Ok(())
    }
}
