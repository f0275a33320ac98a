//! The surfaces that vertices are held on, and the classes of vertices that follow from the mesh.

use super::complex::{Complex, NONE, Partition};
use crate::geometry::{cross, dot, sub};
use palpate_volume::Implicit;

/// The zero sets that a mesh conforms to. The values already include whatever level offset the mesh was made with.
#[derive(Clone, Copy)]
pub struct Surfaces<'a> {
    /// Negative inside the organ.
    pub outer: &'a dyn Implicit,
    /// Divider n is negative where, inside the organ, the region is n + 1.
    pub dividers: &'a [&'a dyn Implicit],
}

/// The surfaces by number (0 the outer boundary, n + 1 divider n), each at an adjustable level.
pub(super) struct Sheets<'a> {
    surfaces: Surfaces<'a>,
    /// Vertices are held where the surface's value is this, mm.
    pub level: Vec<f64>,
    /// Distance that counts as on the surface, mm.
    accuracy: f64,
    /// Longest way (mm) that a projection may go.
    reach: f64,
}

impl<'a> Sheets<'a> {
    pub fn new(surfaces: Surfaces<'a>, edge_mm: f64) -> Self {
        Self {
            level: vec![0.0; surfaces.dividers.len() + 1],
            surfaces,
            accuracy: 2e-4 * edge_mm,
            reach: 0.5 * edge_mm,
        }
    }

    pub fn count(&self) -> usize {
        self.level.len()
    }

    #[inline]
    fn implicit(&self, surface: usize) -> &'a dyn Implicit {
        if surface == 0 {
            self.surfaces.outer
        } else {
            self.surfaces.dividers[surface - 1]
        }
    }

    /// Signed distance (to first order) from the surface at its level, mm.
    #[inline]
    pub fn value(&self, surface: usize, p: [f64; 3]) -> f64 {
        self.implicit(surface).value(p) - self.level[surface]
    }

    #[inline]
    pub fn gradient(&self, surface: usize, p: [f64; 3]) -> [f64; 3] {
        self.implicit(surface).gradient(p)
    }

    /// The nearest point (by Newton steps along the gradients) on all surfaces of `mask`, at most two; `None`
    /// where the steps do not arrive, for instance where two surfaces run along each other.
    pub fn project(&self, mask: u64, start: [f64; 3]) -> Option<[f64; 3]> {
        let mut p = start;
        let mut surfaces = bits(mask);
        let (first, second) = (surfaces.next(), surfaces.next());
        if surfaces.next().is_some() {
            return None;
        }
        let Some(first) = first else { return Some(p) };
        for _ in 0..8 {
            let u = self.value(first, p);
            let v = second.map_or(0.0, |s| self.value(s, p));
            if u.abs() <= self.accuracy && v.abs() <= self.accuracy {
                let way = sub(p, start);
                return (dot(way, way) <= self.reach * self.reach).then_some(p);
            }
            let g = self.gradient(first, p);
            let gg = dot(g, g);
            let step = match second {
                None => g.map(|x| x * u / gg),
                Some(second) => {
                    let h = self.gradient(second, p);
                    let (gh, hh) = (dot(g, h), dot(h, h));
                    let det = gg * hh - gh * gh;
                    if det <= 0.02 * gg * hh {
                        return None;
                    }
                    let (a, b) = ((u * hh - v * gh) / det, (v * gg - u * gh) / det);
                    std::array::from_fn(|i| a * g[i] + b * h[i])
                }
            };
            let length = dot(step, step).sqrt();
            if length.is_nan() || length > 2.0 * self.reach {
                return None;
            }
            p = std::array::from_fn(|i| p[i] - step[i]);
        }
        None
    }

    /// Takes from `g` what leads off the surfaces of `mask`, given the constraint frame at a vertex.
    pub fn frame(&self, mask: u64, p: [f64; 3]) -> Frame {
        let mut surfaces = bits(mask);
        match (surfaces.next(), surfaces.next(), surfaces.next()) {
            (None, ..) => Frame::Free,
            (Some(s), None, _) => unit(self.gradient(s, p)).map_or(Frame::Fixed, Frame::Plane),
            (Some(s), Some(t), None) => {
                let (g, h) = (unit(self.gradient(s, p)), unit(self.gradient(t, p)));
                let (Some(g), Some(h)) = (g, h) else {
                    return Frame::Fixed;
                };
                let along = cross(g, h);
                if dot(along, along) < 0.02 {
                    Frame::Fixed
                } else {
                    unit(along).map_or(Frame::Fixed, Frame::Line)
                }
            }
            _ => Frame::Fixed,
        }
    }
}

/// The directions in which a vertex may go.
#[derive(Clone, Copy, Debug)]
pub(super) enum Frame {
    Free,
    /// Across this unit normal.
    Plane([f64; 3]),
    /// Along this unit tangent.
    Line([f64; 3]),
    Fixed,
}

impl Frame {
    #[inline]
    pub fn restrict(&self, g: [f64; 3]) -> [f64; 3] {
        match self {
            Self::Free => g,
            Self::Plane(n) => {
                let d = dot(*n, g);
                std::array::from_fn(|a| g[a] - d * n[a])
            }
            Self::Line(t) => {
                let d = dot(*t, g);
                t.map(|t| t * d)
            }
            Self::Fixed => [0.0; 3],
        }
    }
}

pub(super) fn unit(v: [f64; 3]) -> Option<[f64; 3]> {
    let length = dot(v, v).sqrt();
    (length.is_finite() && length > 1e-12).then(|| v.map(|x| x / length))
}

pub(super) fn bits(mask: u64) -> impl Iterator<Item = usize> {
    let mut rest = mask;
    std::iter::from_fn(move || {
        (rest != 0).then(|| {
            let s = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            s
        })
    })
}

/// A face that lies on the boundary or between two regions: corners as stored in its first tet (outward), and the
/// regions on its two sides (the second `None` outside of the mesh).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Interface {
    pub corners: [u32; 3],
    pub inside: u16,
    pub outside: Option<u16>,
}

/// All faces on the boundary or between regions; `None` where three tets share a face, or two from the same side.
pub(super) fn interfaces(tets: &[[u32; 4]], regions: &[u16]) -> Option<Vec<Interface>> {
    let mut faces = Vec::with_capacity(4 * tets.len());
    for (t, &[a, b, c, d]) in tets.iter().enumerate() {
        if a == NONE {
            continue;
        }
        for f in [[b, c, d], [a, d, c], [a, b, d], [a, c, b]] {
            let mut key = f;
            key.sort_unstable();
            let even = f == key || [f[1], f[2], f[0]] == key || [f[2], f[0], f[1]] == key;
            faces.push((key, t as u32, f, even));
        }
    }
    faces.sort_unstable_by_key(|f| (f.0, f.1));
    let mut out = Vec::new();
    let mut i = 0;
    while i < faces.len() {
        let (key, t, corners, even) = faces[i];
        let n = faces[i..].iter().take_while(|f| f.0 == key).count();
        let inside = regions[t as usize];
        match n {
            1 => out.push(Interface {
                corners,
                inside,
                outside: None,
            }),
            2 if faces[i + 1].3 != even => {
                let other = regions[faces[i + 1].1 as usize];
                if other != inside {
                    out.push(Interface {
                        corners,
                        inside,
                        outside: Some(other),
                    });
                }
            }
            _ => return None,
        }
        i += n;
    }
    Some(out)
}

/// Which divider parts each pair of regions. Region 0 and n + 1: divider n. Regions m + 1 and n + 1: whichever of
/// the two dividers runs nearer to the vertices between them.
pub(super) fn partition(faces: &[Interface], pos: &[[f64; 3]], sheets: &Sheets<'_>) -> Partition {
    let regions = sheets.count();
    let mut out = Partition::new(regions);
    let mut sums = vec![[0.0f64; 2]; regions * regions];
    for f in faces {
        let Some(outside) = f.outside else { continue };
        let (a, b) = (f.inside.min(outside), f.inside.max(outside));
        if a > 0 {
            let slot = &mut sums[usize::from(a) * regions + usize::from(b)];
            for v in f.corners {
                slot[0] += sheets.value(usize::from(a), pos[v as usize]).powi(2);
                slot[1] += sheets.value(usize::from(b), pos[v as usize]).powi(2);
            }
        }
    }
    for b in 1..regions as u16 {
        out.set(0, b, b);
        for a in 1..b {
            let [of_a, of_b] = sums[usize::from(a) * regions + usize::from(b)];
            out.set(a, b, if of_b < of_a { b } else { a });
        }
    }
    out
}

/// Sets masks and pins from the faces. A vertex where the faces of one surface form more than one fan (two sheets
/// that touch) is pinned.
pub(super) fn classify(complex: &mut Complex, faces: &[Interface]) {
    for f in faces {
        let s = f.outside.map_or(0, |o| complex.partition.between(f.inside, o));
        for v in f.corners {
            complex.mask[v as usize] |= 1 << s;
        }
    }
    let mut around = Vec::new();
    for v in 0..complex.pos.len() as u32 {
        complex.surface_faces(v, &mut around);
        complex.pinned[v as usize] = around.iter().any(|f| {
            let same = around.iter().filter(|g| g.surface == f.surface);
            same.clone().filter(|g| g.p == f.p).count() > 1 || same.filter(|g| g.q == f.q).count() > 1
        }) || fans(&around) > 1;
    }
}

/// Largest number of separate fans that the faces of any one surface form.
fn fans(around: &[super::complex::SurfaceFace]) -> usize {
    let mut most = 0;
    let mut seen: Vec<bool> = vec![false; around.len()];
    let mut count = [0usize; 64];
    for i in 0..around.len() {
        if seen[i] {
            continue;
        }
        let s = around[i].surface;
        count[usize::from(s) & 63] += 1;
        most = most.max(count[usize::from(s) & 63]);
        for forward in [true, false] {
            let mut at = i;
            loop {
                seen[at] = true;
                let next = (0..around.len()).find(|&j| {
                    around[j].surface == s
                        && if forward {
                            around[j].p == around[at].q
                        } else {
                            around[j].q == around[at].p
                        }
                });
                match next {
                    Some(j) if !seen[j] => at = j,
                    _ => break,
                }
            }
        }
    }
    most
}
