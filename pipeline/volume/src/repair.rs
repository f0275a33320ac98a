//! Voids and strays inside a body's materials (0 outside, 1 organ, 2… structures).

use crate::components::{Components, Runs};
use crate::volume_report::{StrayReport, VoidReport};

/// Visits the voxels of a component, row by row.
fn each_voxel(runs: &Runs, components: &Components, which: u32, mut f: impl FnMut(usize)) {
    let [nx, ny, _] = runs.dims;
    let c = &components.list[which as usize];
    for k in c.lo[2]..c.hi[2] {
        for j in c.lo[1]..c.hi[1] {
            for r in runs.row(j, k) {
                if components.of_run[r] == which {
                    let row = nx * (j + ny * k);
                    (runs.runs[r].start..runs.runs[r].end).for_each(|i| f(row + i as usize));
                }
            }
        }
    }
}

/// The material that most face neighbours of a component have, its own and the outside not counted; 0: none.
fn majority(runs: &Runs, components: &Components, which: u32, material: &[u8]) -> u8 {
    let [nx, ny, nz] = runs.dims;
    let mut count = [0u32; 256];
    each_voxel(runs, components, which, |v| {
        let (i, j, k) = (v % nx, v / nx % ny, v / (nx * ny));
        let mut see = |ok: bool, w: usize| {
            if ok && material[w] != material[v] {
                count[material[w] as usize] += 1;
            }
        };
        see(i > 0, v.wrapping_sub(1));
        see(i + 1 < nx, v + 1);
        see(j > 0, v.wrapping_sub(nx));
        see(j + 1 < ny, v + nx);
        see(k > 0, v.wrapping_sub(nx * ny));
        see(k + 1 < nz, v + nx * ny);
    });
    // The first of equals, so that the result is unique.
    (1..256)
        .max_by_key(|&m| (count[m], 255 - m))
        .filter(|&m| count[m] > 0)
        .unwrap_or(0) as u8
}

/// Fills enclosed voids up to `limit_mm3` with the material around them. A void is a set of outside voxels, joined
/// by faces or edges (the connectivity that the iso-surface gives the outside), that does not reach the crop's ends.
pub(crate) fn fill_voids(
    material: &mut [u8],
    dims: [usize; 3],
    voxel_mm3: f64,
    limit_mm3: f64,
) -> VoidReport {
    let mut outside = [0; 256];
    outside[0] = 1;
    let runs = Runs::scan(material, dims, &outside);
    let components = runs.components_by_edge();
    let mut report = VoidReport::default();
    for (n, c) in components.list.iter().enumerate() {
        if (0..3).any(|a| c.lo[a] == 0 || c.hi[a] == dims[a]) {
            continue;
        }
        let volume = c.voxels as f64 * voxel_mm3;
        if volume > limit_mm3 {
            report.kept += 1;
            report.kept_mm3 += volume;
            continue;
        }
        let m = majority(&runs, &components, n as u32, material);
        each_voxel(&runs, &components, n as u32, |v| material[v] = m);
        report.filled += 1;
        report.filled_mm3 += volume;
    }
    report
}

/// Gives every connected part of one material below `limit_mm3` to the material that surrounds it most; parts that
/// touch no other material stay. Returns what each material (by its number) gave away.
pub(crate) fn absorb_strays(
    material: &mut [u8],
    dims: [usize; 3],
    voxel_mm3: f64,
    limit_mm3: f64,
    materials: usize,
) -> Vec<StrayReport> {
    let mut class = [0; 256];
    for (m, c) in class.iter_mut().enumerate().skip(1) {
        *c = m as u8;
    }
    let runs = Runs::scan(material, dims, &class);
    let components = runs.components_by_class();
    let mut report = vec![StrayReport::default(); materials + 1];
    // Smallest first, so that a crumb beside a stray follows it.
    for (n, c) in components.list.iter().enumerate().rev() {
        let volume = c.voxels as f64 * voxel_mm3;
        if volume >= limit_mm3 {
            break;
        }
        let own = material[c.lo_voxel(&runs, &components, n as u32)];
        let m = majority(&runs, &components, n as u32, material);
        if m == 0 {
            continue;
        }
        each_voxel(&runs, &components, n as u32, |v| material[v] = m);
        report[own as usize].count += 1;
        report[own as usize].volume_mm3 += volume;
    }
    report
}

/// Keeps the face-connected components of a 0/1 mask from `limit_mm3` on (the largest in any case).
pub(crate) fn drop_small(
    mask: &mut [u8],
    dims: [usize; 3],
    voxel_mm3: f64,
    limit_mm3: f64,
) -> (usize, StrayReport) {
    let mut class = [0; 256];
    class[1] = 1;
    let runs = Runs::scan(mask, dims, &class);
    let components = runs.components(|_| true);
    let mut report = StrayReport::default();
    let mut kept = 0;
    for (n, c) in components.list.iter().enumerate() {
        let volume = c.voxels as f64 * voxel_mm3;
        if n == 0 || volume >= limit_mm3 {
            kept += 1;
            continue;
        }
        each_voxel(&runs, &components, n as u32, |v| mask[v] = 0);
        report.count += 1;
        report.volume_mm3 += volume;
    }
    (kept, report)
}

impl crate::components::Component {
    /// Some voxel of the component.
    fn lo_voxel(&self, runs: &Runs, components: &Components, which: u32) -> usize {
        let [nx, ny, _] = runs.dims;
        for k in self.lo[2]..self.hi[2] {
            for j in self.lo[1]..self.hi[1] {
                for r in runs.row(j, k) {
                    if components.of_run[r] == which {
                        return runs.runs[r].start as usize + nx * (j + ny * k);
                    }
                }
            }
        }
        0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn voids_take_the_label_around_and_large_ones_stay() {
        let dims = [20, 12, 12];
        let at = |i: usize, j: usize, k: usize| i + dims[0] * (j + dims[1] * k);
        let mut m = vec![0u8; dims.iter().product()];
        for k in 1..11 {
            for j in 1..11 {
                for i in 1..19 {
                    m[at(i, j, k)] = if i < 10 { 1 } else { 2 };
                }
            }
        }
        m[at(4, 5, 5)] = 0;
        // Joined by an edge only: one void.
        m[at(14, 5, 5)] = 0;
        m[at(15, 6, 5)] = 0;
        for i in 3..7 {
            m[at(i, 8, 8)] = 0;
        }
        let r = fill_voids(&mut m, dims, 0.5, 1.0);
        assert_eq!((r.filled, r.kept), (2, 1));
        assert_eq!((r.filled_mm3, r.kept_mm3), (1.5, 2.0));
        assert_eq!(
            [m[at(4, 5, 5)], m[at(14, 5, 5)], m[at(15, 6, 5)], m[at(3, 8, 8)]],
            [1, 2, 2, 0]
        );
    }

    #[test]
    fn strays_go_to_their_surroundings() {
        let dims = [20, 12, 12];
        let at = |i: usize, j: usize, k: usize| i + dims[0] * (j + dims[1] * k);
        let mut m = vec![0u8; dims.iter().product()];
        for k in 1..11 {
            for j in 1..11 {
                for i in 1..19 {
                    m[at(i, j, k)] = if i < 10 { 1 } else { 2 };
                }
            }
        }
        m[at(4, 5, 5)] = 2;
        m[at(14, 5, 5)] = 1;
        let r = absorb_strays(&mut m, dims, 1.0, 3.0, 2);
        assert_eq!((r[1].count, r[2].count), (1, 1));
        assert_eq!((m[at(4, 5, 5)], m[at(14, 5, 5)]), (1, 2));
    }
}
