//! A support moulded to an organ's lower side.

use crate::collider::MeshSolid;
use crate::{PbdError, Settings, SoftBody, TriangleMesh};
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Passes of lowering before the mould is taken as it is.
const PASSES: usize = 60;
/// Radius of the opening that takes narrow ridges off the mould, cells.
const OPENING_CELLS: usize = 2;
/// Most nodes along a side.
const MOST_NODES: f32 = 400.0;

/// Form of a cradle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CradleParams {
    /// Least distance between the organ's surface and the cradle, mm. 0: they touch, as organs do in the body.
    pub clearance_mm: f64,
    /// Part of the organ's height, from below, that the cradle may reach. 1: the whole lower side lies in it up to the
    /// outline, as an organ does in the fat and the neighbours below it; parts that hang high are held as well. The
    /// plasticine of a bench experiment: about 0.35.
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
            clearance_mm: 0.0,
            height_fraction: 1.0,
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
/// that the organ can be lifted out. Every point of the surface keeps the clearance.
///
/// # Errors
/// - [`PbdError::Setting`] for parameters out of range, or a direction without length.
/// - [`PbdError::Array`], [`PbdError::Empty`] for a broken surface.
/// - [`PbdError::TooMany`] for a cell far smaller than the organ.
pub fn cradle(surface: &TriangleMesh, down: Vec3, params: &CradleParams) -> Result<TriangleMesh, PbdError> {
    cradle_of_body(surface, &[], 0.0, down, params)
}

/// As [`cradle`], and no particle (centres, mm, in the surface's frame) lies nearer to it than `keep_mm`, the
/// collider's collision distance: the body starts in its bed, touching it along its whole lower side, and nothing is
/// pushed or drops.
///
/// # Errors
/// As [`cradle`]; [`PbdError::Setting`] for a `keep_mm` that is negative or not finite.
pub fn cradle_of_body(
    surface: &TriangleMesh,
    particles: &[[f32; 3]],
    keep_mm: f64,
    down: Vec3,
    params: &CradleParams,
) -> Result<TriangleMesh, PbdError> {
    params.check()?;
    surface.check()?;
    if !(down.is_finite() && down.length() > 1e-6) {
        return Err(PbdError::Setting {
            name: "down",
            found: format!("{down:?}"),
            expected: "a direction",
        });
    }
    if !(0.0..=1e3).contains(&keep_mm) {
        return Err(PbdError::Setting {
            name: "keep_mm",
            found: keep_mm.to_string(),
            expected: "0 to 1000 mm",
        });
    }
    let up = -down.normalize();
    let (e1, e2) = up.any_orthonormal_pair();
    let flat = |p: Vec3| Vec3::new(e1.dot(p), e2.dot(p), up.dot(p));
    let mut field = Field::new(surface, flat, params)?;
    let mut guests = field.samples(surface, flat, params);
    let centres = particles.iter().map(|&p| flat(p.into()));
    guests.extend(centres.map(|at| Guest {
        at,
        keep: keep_mm as f32,
    }));
    field.lower_until_clear(guests);
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

/// A point that must keep a distance from the mould.
#[derive(Clone, Copy)]
struct Guest {
    at: Vec3,
    keep: f32,
}

/// Heights over a grid, in coordinates with z up.
struct Field {
    origin: [f32; 2],
    cell: f32,
    dims: [usize; 2],
    height: Vec<f32>,
}

impl Field {
    /// The lower side of the surface, column by column, less the clearance; beyond the outline it runs on level.
    fn new(surface: &TriangleMesh, flat: impl Fn(Vec3) -> Vec3, p: &CradleParams) -> Result<Self, PbdError> {
        let clearance = p.clearance_mm as f32;
        let vertices: Vec<Vec3> = surface.vertices.iter().map(|&v| flat(v.into())).collect();
        let (mut first, mut last) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for t in &surface.triangles {
            for v in t.map(|v| vertices[v as usize]) {
                (first, last) = (first.min(v), last.max(v));
            }
        }
        let rim = first.z + (last.z - first.z) * p.height_fraction as f32;
        let around = p.rim_mm as f32 + clearance + p.cell_mm as f32;
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
        let mut low = vec![f32::INFINITY; dims[0] * dims[1]];
        for t in &surface.triangles {
            let c = t.map(|v| vertices[v as usize]);
            let at = c.map(|v| [(v.x - origin[0]) / cell, (v.y - origin[1]) / cell]);
            let range = |k: usize| {
                let (lo, hi) = at
                    .iter()
                    .fold((f32::INFINITY, 0f32), |(lo, hi), a| (lo.min(a[k]), hi.max(a[k])));
                lo.ceil().max(0.0) as usize..=(hi.floor() as usize).min(dims[k] - 1)
            };
            for j in range(1) {
                for i in range(0) {
                    let node = [i as f32, j as f32];
                    if let Some(w) = shares(at, node) {
                        let h = &mut low[i + dims[0] * j];
                        *h = h.min(c[0].z * w[0] + c[1].z * w[1] + c[2].z * w[2]);
                    }
                }
            }
        }
        let mut out = Self {
            origin,
            cell,
            dims,
            height: low,
        };
        out.run_on();
        for h in &mut out.height {
            *h = if h.is_finite() {
                (*h - clearance).min(rim)
            } else {
                rim
            };
        }
        // What stands up into folds of the organ narrower than this holds nothing and would be caught in them.
        out.spread(OPENING_CELLS, f32::min);
        out.spread(OPENING_CELLS, f32::max);
        Ok(out)
    }

    /// Continues heights into nodes that have none, ring by ring.
    fn run_on(&mut self) {
        let [nx, ny] = self.dims;
        loop {
            let before = &self.height;
            let mut next = before.clone();
            let mut changed = false;
            for j in 0..ny {
                for i in 0..nx {
                    if before[i + nx * j].is_finite() {
                        continue;
                    }
                    let (mut sum, mut count) = (0.0, 0);
                    for b in j.saturating_sub(1)..=(j + 1).min(ny - 1) {
                        for a in i.saturating_sub(1)..=(i + 1).min(nx - 1) {
                            let h = before[a + nx * b];
                            if h.is_finite() {
                                sum += h;
                                count += 1;
                            }
                        }
                    }
                    if count > 0 {
                        next[i + nx * j] = sum / count as f32;
                        changed = true;
                    }
                }
            }
            self.height = next;
            if !changed {
                return;
            }
        }
    }

    /// Each height becomes the least or largest (`pick`) within so many cells.
    fn spread(&mut self, cells: usize, pick: impl Fn(f32, f32) -> f32) {
        let [nx, ny] = self.dims;
        let disc = (cells * cells) as i64;
        let old = std::mem::take(&mut self.height);
        for j in 0..ny {
            for i in 0..nx {
                let mut h = old[i + nx * j];
                for b in j.saturating_sub(cells)..=(j + cells).min(ny - 1) {
                    for a in i.saturating_sub(cells)..=(i + cells).min(nx - 1) {
                        let (dx, dy) = (a as i64 - i as i64, b as i64 - j as i64);
                        if dx * dx + dy * dy <= disc {
                            h = pick(h, old[a + nx * b]);
                        }
                    }
                }
                self.height.push(h);
            }
        }
    }

    /// Points all over the surface.
    fn samples(&self, surface: &TriangleMesh, flat: impl Fn(Vec3) -> Vec3, p: &CradleParams) -> Vec<Guest> {
        let spacing = (0.4 * self.cell).max(0.02);
        let mut out = Vec::new();
        for t in &surface.triangles {
            let [a, b, c] = t.map(|v| flat(surface.vertices[v as usize].into()));
            let longest = a.distance(b).max(b.distance(c)).max(c.distance(a));
            let n = ((longest / spacing).ceil() as usize).clamp(1, 200);
            for i in 0..=n {
                for j in 0..=n - i {
                    let (u, v) = (i as f32 / n as f32, j as f32 / n as f32);
                    out.push(Guest {
                        at: a + (b - a) * u + (c - a) * v,
                        keep: p.clearance_mm as f32,
                    });
                }
            }
        }
        out
    }

    /// Whether the mould can come nearer to a guest than it may: not where all of it around lies too low.
    fn concerns(&self, g: &Guest) -> bool {
        let [nx, ny] = self.dims;
        let range = |k: usize, n: usize| {
            let at = (g.at[k] - self.origin[k]) / self.cell;
            let reach = g.keep / self.cell + 1.0;
            (at - reach).floor().max(0.0) as usize..=((at + reach).ceil().max(0.0) as usize).min(n - 1)
        };
        range(1, ny).any(|j| range(0, nx).any(|i| self.height[i + nx * j] + g.keep > g.at.z))
    }

    fn vertex(&self, i: usize, j: usize) -> Vec3 {
        let x = self.origin[0] + i as f32 * self.cell;
        let y = self.origin[1] + j as f32 * self.cell;
        Vec3::new(x, y, self.height[i + self.dims[0] * j])
    }

    /// Lowers vertices of the triangles that are nearest to guests without their distance, until all have it.
    fn lower_until_clear(&mut self, mut open: Vec<Guest>) {
        open.retain(|g| self.concerns(g));
        // Deepest violation first would be order-dependent; all at once and the largest per vertex is not.
        for _ in 0..PASSES {
            let top = self.top();
            let solid = MeshSolid::new(&top);
            let wanted: Vec<Option<(u32, f32)>> = open
                .par_iter()
                .map(|g| {
                    let (t, d) = solid.nearest_triangle(g.at)?;
                    (d < g.keep).then_some((t, g.keep - d))
                })
                .collect();
            let mut lower = vec![0f32; self.height.len()];
            let mut left = Vec::new();
            for (g, w) in open.iter().zip(&wanted) {
                let Some((t, deficit)) = *w else { continue };
                left.push(*g);
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
            // Where a triangle was lowered, its neighbours are the nearest now: those that were clear stay so.
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

/// Barycentric shares of a point in a triangle of the plane; none outside.
fn shares(c: [[f32; 2]; 3], p: [f32; 2]) -> Option<[f32; 3]> {
    let d = |a: [f32; 2], b: [f32; 2]| {
        [
            f64::from(b[0]) - f64::from(a[0]),
            f64::from(b[1]) - f64::from(a[1]),
        ]
    };
    let area = |u: [f64; 2], v: [f64; 2]| u[0] * v[1] - u[1] * v[0];
    let whole = area(d(c[0], c[1]), d(c[0], c[2]));
    if whole == 0.0 {
        return None;
    }
    let w: [f64; 3] = std::array::from_fn(|k| area(d(p, c[(k + 1) % 3]), d(p, c[(k + 2) % 3])) / whole);
    // A node on an edge belongs to both triangles.
    w.iter().all(|&w| w >= -1e-9).then(|| w.map(|w| w as f32))
}
