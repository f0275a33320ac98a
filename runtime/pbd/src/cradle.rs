//! A support moulded to an organ's lower side.

use crate::collider::MeshSolid;
use crate::{PbdError, Settings, SoftBody, TriangleMesh};
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Passes of lowering before the mould is taken as it is.
const PASSES: usize = 60;
/// Most nodes along a side.
const MOST_NODES: f32 = 400.0;

/// Form of a cradle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CradleParams {
    /// Least distance between the organ's surface and the cradle, mm. See [`clearance_mm`].
    pub clearance_mm: f64,
    /// Part of the organ's height, from below, that the cradle holds. As the plasticine of the synthetic experiment: 0.35.
    pub height_fraction: f64,
    /// Spacing of the mould's vertices, mm: about a particle spacing, for finer triangles cost time and hold nothing.
    pub cell_mm: f64,
    /// Width of the flat rim around the mould, mm.
    pub rim_mm: f64,
    /// Thickness below the deepest place, mm.
    pub floor_mm: f64,
}

impl Default for CradleParams {
    fn default() -> Self {
        Self {
            clearance_mm: 0.5,
            height_fraction: 0.35,
            cell_mm: 2.5,
            rim_mm: 8.0,
            floor_mm: 6.0,
        }
    }
}

impl CradleParams {
    fn check(&self) -> Result<(), PbdError> {
        let range = [
            ("clearance_mm", self.clearance_mm, 0.0, 50.0),
            ("height_fraction", self.height_fraction, 0.01, 1.0),
            ("cell_mm", self.cell_mm, 0.05, 100.0),
            ("rim_mm", self.rim_mm, 0.0, 1000.0),
            ("floor_mm", self.floor_mm, 0.1, 1000.0),
        ];
        for (name, v, lo, hi) in range {
            if !(v >= lo && v <= hi) {
                return Err(PbdError::Setting {
                    name,
                    found: v.to_string(),
                    expected: "clearance 0 to 50, height fraction 0.01 to 1, cell 0.05 to 100, rim 0 to 1000, floor 0.1 to 1000",
                });
            }
        }
        Ok(())
    }
}

/// Least clearance between the organ's surface and a cradle at which no particle of the body lies closer to the
/// cradle than the collision distance: the body then lies in it without overlap. Both in the body's rest frame.
pub fn clearance_mm(body: &SoftBody, surface: &TriangleMesh, settings: &Settings) -> Result<f64, PbdError> {
    surface.check()?;
    let solid = MeshSolid::new(surface);
    let keep = (settings.collision_distance_factor * body.spacing_mm()) as f32;
    let most = body
        .positions
        .par_iter()
        .map(|&p| keep + solid.distance(p.into()))
        .reduce(|| 0.0, f32::max);
    Ok(f64::from(most.max(0.0)))
}

/// A block with a mould of the surface's lower side: a closed mesh, its upper side a height field along `-down`, so
/// that the organ can be lifted out. Every point of the surface that lies lower than the rim keeps the clearance.
///
/// # Errors
/// - [`PbdError::Setting`] for parameters out of range, or a direction without length.
/// - [`PbdError::Array`], [`PbdError::Empty`] for a broken surface.
/// - [`PbdError::TooMany`] for a cell far smaller than the organ.
pub fn cradle(surface: &TriangleMesh, down: Vec3, params: &CradleParams) -> Result<TriangleMesh, PbdError> {
    params.check()?;
    surface.check()?;
    if !(down.is_finite() && down.length() > 1e-6) {
        return Err(PbdError::Setting {
            name: "down",
            found: format!("{down:?}"),
            expected: "a direction",
        });
    }
    let up = -down.normalize();
    let (e1, e2) = up.any_orthonormal_pair();
    let flat = |p: Vec3| Vec3::new(e1.dot(p), e2.dot(p), up.dot(p));
    let mut field = Field::new(surface, flat, params)?;
    field.lower_until_clear(params.clearance_mm as f32);
    let mesh = field.mesh(params.floor_mm as f32);
    // (e1, e2, up) may be left-handed; the triangles must face outward in either case.
    let mirrored = e1.cross(e2).dot(up) < 0.0;
    Ok(TriangleMesh {
        vertices: mesh
            .vertices
            .iter()
            .map(|v| (e1 * v[0] + e2 * v[1] + up * v[2]).to_array())
            .collect(),
        triangles: mesh
            .triangles
            .iter()
            .map(|&[a, b, c]| if mirrored { [a, c, b] } else { [a, b, c] })
            .collect(),
    })
}

/// Heights over a grid, in coordinates with z up.
struct Field {
    origin: [f32; 2],
    cell: f32,
    dims: [usize; 2],
    height: Vec<f32>,
    /// Points of the organ that must keep the clearance.
    samples: Vec<Vec3>,
}

impl Field {
    fn new(surface: &TriangleMesh, flat: impl Fn(Vec3) -> Vec3, p: &CradleParams) -> Result<Self, PbdError> {
        let clearance = p.clearance_mm as f32;
        let vertices: Vec<Vec3> = surface.vertices.iter().map(|&v| flat(v.into())).collect();
        let (lo, hi) = vertices
            .iter()
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(lo, hi), v| {
                (lo.min(v.z), hi.max(v.z))
            });
        let rim_height = lo + (hi - lo) * p.height_fraction as f32;
        let spacing = (0.4 * p.cell_mm as f32).max(0.02);
        let mut samples = Vec::new();
        for t in &surface.triangles {
            let [a, b, c] = t.map(|v| vertices[v as usize]);
            if a.z.min(b.z).min(c.z) > rim_height + clearance {
                continue;
            }
            let longest = a.distance(b).max(b.distance(c)).max(c.distance(a));
            let n = ((longest / spacing).ceil() as usize).clamp(1, 200);
            for i in 0..=n {
                for j in 0..=n - i {
                    let (u, v) = (i as f32 / n as f32, j as f32 / n as f32);
                    let s = a + (b - a) * u + (c - a) * v;
                    if s.z <= rim_height + clearance {
                        samples.push(s);
                    }
                }
            }
        }
        let around = p.rim_mm as f32 + clearance + p.cell_mm as f32;
        let (mut first, mut last) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for s in &samples {
            (first, last) = (first.min(*s), last.max(*s));
        }
        let origin = [first.x - around, first.y - around];
        let cell = p.cell_mm as f32;
        let span = |k: usize| (last[k] + around - origin[k]) / cell;
        if !(span(0) < MOST_NODES && span(1) < MOST_NODES) {
            return Err(PbdError::TooMany {
                what: "cells along a side of the cradle",
                found: span(0).max(span(1)) as usize,
                most: MOST_NODES as usize,
            });
        }
        let dims = [span(0).ceil() as usize + 1, span(1).ceil() as usize + 1];
        let mut height = vec![rim_height; dims[0] * dims[1]];
        for s in &samples {
            let at = [(s.x - origin[0]) / cell, (s.y - origin[1]) / cell];
            let reach = clearance / cell;
            let range =
                |k: usize| (at[k] - reach).ceil().max(0.0) as usize..=(at[k] + reach).floor() as usize;
            for j in range(1) {
                for i in range(0) {
                    let (dx, dy) = ((i as f32 - at[0]) * cell, (j as f32 - at[1]) * cell);
                    let room = clearance * clearance - dx * dx - dy * dy;
                    if room >= 0.0 && i < dims[0] && j < dims[1] {
                        let h = &mut height[i + dims[0] * j];
                        *h = h.min(s.z - room.sqrt());
                    }
                }
            }
        }
        Ok(Self {
            origin,
            cell,
            dims,
            height,
            samples,
        })
    }

    fn vertex(&self, i: usize, j: usize) -> Vec3 {
        let x = self.origin[0] + i as f32 * self.cell;
        let y = self.origin[1] + j as f32 * self.cell;
        Vec3::new(x, y, self.height[i + self.dims[0] * j])
    }

    /// Lowers vertices of the triangles that are nearest to samples without clearance, until all have it.
    fn lower_until_clear(&mut self, clearance: f32) {
        // Deepest violation first would be order-dependent; all at once and the largest per vertex is not.
        let mut open = self.samples.clone();
        for _ in 0..PASSES {
            let top = self.top();
            let solid = MeshSolid::new(&top);
            let wanted: Vec<Option<(u32, f32)>> = open
                .par_iter()
                .map(|&s| {
                    let (t, d) = solid.nearest_triangle(s)?;
                    (d < clearance).then_some((t, clearance - d))
                })
                .collect();
            let mut lower = vec![0f32; self.height.len()];
            let mut left = Vec::new();
            for (s, w) in open.iter().zip(&wanted) {
                let Some((t, deficit)) = *w else { continue };
                left.push(*s);
                let corners = top.triangles[t as usize];
                let [a, b, c] = top.corners(t as usize);
                let steep = (b - a).cross(c - a).normalize_or(Vec3::Z).z.max(0.25);
                for v in corners {
                    lower[v as usize] = lower[v as usize].max(deficit / steep + 1e-3);
                }
            }
            if left.is_empty() {
                break;
            }
            for (h, d) in self.height.iter_mut().zip(&lower) {
                *h -= d;
            }
            open = left;
        }
    }

    fn top(&self) -> TriangleMesh {
        let [nx, ny] = self.dims;
        let at = |i: usize, j: usize| (i + nx * j) as u32;
        let mut mesh = TriangleMesh::default();
        for j in 0..ny {
            for i in 0..nx {
                mesh.vertices.push(self.vertex(i, j).to_array());
            }
        }
        for j in 0..ny - 1 {
            for i in 0..nx - 1 {
                let q = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                let h = q.map(|v| self.height[v as usize]);
                // The lower diagonal: the mould is a bowl.
                if h[0] + h[2] <= h[1] + h[3] {
                    mesh.triangles.push([q[0], q[1], q[2]]);
                    mesh.triangles.push([q[0], q[2], q[3]]);
                } else {
                    mesh.triangles.push([q[0], q[1], q[3]]);
                    mesh.triangles.push([q[1], q[2], q[3]]);
                }
            }
        }
        mesh
    }

    /// The block: height field, walls, floor.
    fn mesh(&self, floor: f32) -> TriangleMesh {
        let [nx, ny] = self.dims;
        let mut mesh = self.top();
        let low = self.height.iter().fold(f32::INFINITY, |m, &h| m.min(h)) - floor;
        // Border of the field, counter-clockwise seen from above.
        let mut border: Vec<u32> = (0..nx).map(|i| i as u32).collect();
        border.extend((1..ny).map(|j| (nx - 1 + nx * j) as u32));
        border.extend((0..nx - 1).rev().map(|i| (i + nx * (ny - 1)) as u32));
        border.extend((1..ny - 1).rev().map(|j| (nx * j) as u32));
        let first = mesh.vertices.len() as u32;
        let mut middle = Vec3::ZERO;
        for &v in &border {
            let [x, y, _] = mesh.vertices[v as usize];
            mesh.vertices.push([x, y, low]);
            middle += Vec3::new(x, y, low) / border.len() as f32;
        }
        let centre = mesh.vertices.len() as u32;
        mesh.vertices.push(middle.with_z(low).to_array());
        let n = border.len();
        for k in 0..n {
            let (a, b) = (border[k], border[(k + 1) % n]);
            let (c, d) = (first + k as u32, first + ((k + 1) % n) as u32);
            mesh.triangles.push([a, c, d]);
            mesh.triangles.push([a, d, b]);
            mesh.triangles.push([centre, d, c]);
        }
        mesh
    }
}
