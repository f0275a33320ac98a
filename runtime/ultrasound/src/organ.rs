use crate::vector::{Vec3, add, apply, barycentric_rows, dot, inverse, mix, sub, wide};
use crate::{Tissue, TissueTable, UltrasoundError};
use palpate_package::{Affine34, ModelPackage};

/// What an image needs of one model package: rest embedding mesh, CT values and labels.
///
/// In packages without CT every voxel gets the nominal CT value of its label's tissue.
#[derive(Clone, Debug)]
pub struct Organ {
    pub(crate) name: String,
    pub(crate) origin_mm: Vec3,
    pub(crate) rest: Vec<[f32; 3]>,
    pub(crate) tets: Vec<[u32; 4]>,
    pub(crate) volume: Volume,
    /// Names of label values 1, 2, …: regions, then supports.
    pub(crate) label_names: Vec<String>,
    pub(crate) regions: usize,
    pub(crate) nominal: bool,
    /// Where there is no CT: `label: tissue, HU`, the surroundings first.
    pub(crate) nominal_tissues: Vec<String>,
}

/// CT values and labels on one voxel grid; index i + dims[0]·(j + dims[1]·k).
#[derive(Clone, Debug)]
pub(crate) struct Volume {
    pub(crate) dims: [usize; 3],
    /// Patient mm → voxel index.
    pub(crate) to_index: Affine34,
    /// Voxel index → patient mm.
    pub(crate) to_patient: Affine34,
    pub(crate) hu: Vec<i16>,
    pub(crate) label: Vec<u8>,
    /// Per cell (named by its lowest voxel): [`TOUCHES_REGION`], [`MIXED`], from [`EVEN`] on the distance to the nearest cell
    /// whose voxels differ.
    cell: Vec<u8>,
    /// Mean distance of neighbouring voxels, mm.
    pub(crate) spacing_mm: f64,
}

/// Bit of a cell whose eight voxels hold a region's label.
const TOUCHES_REGION: u8 = 1;
/// Bit of a cell whose eight voxels have different labels.
const MIXED: u8 = 2;
/// Lowest bit of a cell's distance from those whose eight voxels differ in label or CT value; 0 for these.
const EVEN: u8 = 4;

impl Organ {
    /// Prepares a package; `tissues` gives the nominal CT values where it has none.
    ///
    /// # Errors
    /// Arrays that contradict each other (a package that `verify` accepts has none), an unknown tissue.
    pub fn new(package: &ModelPackage, tissues: &TissueTable) -> Result<Self, UltrasoundError> {
        let name = package.info.regions.first().cloned().unwrap_or_default();
        let fault = |what, found: String, expected: &str| UltrasoundError::Package {
            organ: name.clone(),
            what,
            found,
            expected: expected.to_owned(),
        };
        tissues.check()?;
        let origin_mm = package.info.local_origin_mm;
        if !origin_mm.iter().all(|v| v.is_finite()) {
            return Err(fault("local_origin_mm", format!("{origin_mm:?}"), "finite mm"));
        }
        let mesh = &package.embedding;
        check_mesh(&name, &mesh.vertices, &mesh.tets)?;
        let labels = &package.labels;
        let cells = |d: [usize; 3]| d.iter().try_fold(1usize, |n, &v| n.checked_mul(v)).unwrap_or(0);
        let count = cells(labels.dims);
        if count == 0 || labels.data.len() != count {
            return Err(fault(
                "labels/data",
                format!("{} voxels for {:?}", labels.data.len(), labels.dims),
                "one per cell of a grid that is not empty",
            ));
        }
        let surroundings = tissues.of_surroundings()?;
        let mut nominal_hu = vec![surroundings.nominal_hu];
        let named = |label: &str, t: &Tissue| format!("{label}: {}, {} HU", t.name, t.nominal_hu);
        let mut nominal_tissues = vec![named("surroundings", surroundings)];
        for label in &labels.names {
            let tissue = tissues.of_region(label)?;
            nominal_hu.push(tissue.nominal_hu);
            nominal_tissues.push(named(label, tissue));
        }
        if package.ct.is_some() {
            nominal_tissues.clear();
        }
        if let Some(&v) = labels.data.iter().find(|&&v| usize::from(v) >= nominal_hu.len()) {
            return Err(fault(
                "labels/data",
                format!("value {v}"),
                &format!("values up to {}", nominal_hu.len() - 1),
            ));
        }
        let label_to_index = inverse(&labels.affine)
            .ok_or_else(|| fault("labels/affine", format!("{:?}", labels.affine), "invertible"))?;
        let regions = package.info.regions.len();
        let volume = match &package.ct {
            None => Volume::new(
                regions,
                labels.dims,
                labels.affine,
                label_to_index,
                labels.data.iter().map(|&v| nominal_hu[usize::from(v)]).collect(),
                labels.data.clone(),
            ),
            Some(ct) => {
                if ct.hu.len() != cells(ct.dims) || ct.hu.is_empty() {
                    return Err(fault(
                        "ct/hu",
                        format!("{} voxels for {:?}", ct.hu.len(), ct.dims),
                        "one per cell of a grid that is not empty",
                    ));
                }
                let to_index = inverse(&ct.affine)
                    .ok_or_else(|| fault("ct/affine", format!("{:?}", ct.affine), "invertible"))?;
                let label = if (ct.dims, ct.affine) == (labels.dims, labels.affine) {
                    labels.data.clone()
                } else {
                    onto(ct.dims, &ct.affine, labels.dims, &label_to_index, &labels.data)
                };
                Volume::new(regions, ct.dims, ct.affine, to_index, ct.hu.clone(), label)
            }
        };
        Ok(Self {
            name,
            origin_mm,
            rest: mesh.vertices.clone(),
            tets: mesh.tets.clone(),
            volume,
            label_names: labels.names.clone(),
            regions,
            nominal: package.ct.is_none(),
            nominal_tissues,
        })
    }

    /// The organ with another embedding mesh of its rest shape, local mm: finer than the package's (see
    /// [`crate::split_tets`]).
    ///
    /// # Errors
    /// No tet, one of vertices that are not there, one without positive volume.
    pub fn with_embedding(
        mut self,
        vertices: &[[f32; 3]],
        tets: &[[u32; 4]],
    ) -> Result<Self, UltrasoundError> {
        check_mesh(&self.name, vertices, tets)?;
        self.rest = vertices.to_vec();
        self.tets = tets.to_vec();
        Ok(self)
    }

    /// Name of the organ.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Number of embedding vertices that a deformation has.
    pub fn vertex_count(&self) -> usize {
        self.rest.len()
    }

    /// Rest positions of the embedding vertices, local mm.
    pub fn rest_vertices(&self) -> &[[f32; 3]] {
        &self.rest
    }

    /// Names of the label values 1, 2, …: the regions, then the supports.
    pub fn label_names(&self) -> &[String] {
        &self.label_names
    }

    /// Whether the CT values are nominal ones by label.
    pub fn is_nominal(&self) -> bool {
        self.nominal
    }

    /// Where the embedding carries a rest point: patient mm to patient mm. `None` outside of the rest mesh, or where the
    /// positions do not fit.
    ///
    /// Tests every tet; made for fiducials and checks. A point on a shared face belongs to the lowest tet.
    pub fn deform_point(&self, deformed_local: &[[f32; 3]], rest_mm: [f64; 3]) -> Option<[f64; 3]> {
        if deformed_local.len() != self.rest.len() {
            return None;
        }
        let p = sub(rest_mm, self.origin_mm);
        for t in &self.tets {
            let x = t.map(|v| wide(self.rest[v as usize]));
            let Some(rows) = barycentric_rows(x) else { continue };
            let d = sub(p, x[0]);
            let l = rows.map(|r| dot(r, d));
            if l.iter().all(|&v| v >= -1e-9) && l.iter().sum::<f64>() <= 1.0 + 1e-9 {
                let y = t.map(|v| wide(deformed_local[v as usize]));
                return Some(add(mix(y, l), self.origin_mm));
            }
        }
        None
    }

    /// Label and CT value at a rest point (patient mm); `None` outside of the scan's crop. The label is that with the most
    /// trilinear weight, the CT value trilinear.
    pub fn at_rest(&self, rest_mm: [f64; 3]) -> Option<(u8, f32)> {
        let index = apply(&self.volume.to_index, rest_mm).map(|v| v as f32);
        self.volume
            .holds(index)
            .then(|| (self.volume.label_at(index), self.volume.hu_at(index)))
    }
}

fn check_mesh(organ: &str, vertices: &[[f32; 3]], tets: &[[u32; 4]]) -> Result<(), UltrasoundError> {
    let fault = |found, expected: &str| UltrasoundError::Package {
        organ: organ.to_owned(),
        what: "embedding/tets",
        found,
        expected: expected.to_owned(),
    };
    if tets.is_empty() {
        return Err(fault("none".into(), "at least one"));
    }
    let n = vertices.len();
    if let Some(t) = tets.iter().find(|t| t.iter().any(|&v| v as usize >= n)) {
        return Err(fault(format!("{t:?}"), &format!("vertices below {n}")));
    }
    let flat = |t: &&[u32; 4]| barycentric_rows(t.map(|v| wide(vertices[v as usize]))).is_none();
    match tets.iter().find(flat) {
        Some(t) => Err(fault(format!("{t:?} of no volume"), "positive volumes at rest")),
        None => Ok(()),
    }
}

/// Labels of the nearest voxels of another grid; 0 outside of it.
fn onto(
    dims: [usize; 3],
    affine: &Affine34,
    from_dims: [usize; 3],
    from_index: &Affine34,
    from: &[u8],
) -> Vec<u8> {
    let mut out = Vec::with_capacity(dims.iter().product());
    for k in 0..dims[2] {
        for j in 0..dims[1] {
            for i in 0..dims[0] {
                let p = apply(from_index, apply(affine, [i as f64, j as f64, k as f64]));
                let inside = (0..3).all(|a| p[a] >= -0.5 && p[a] < from_dims[a] as f64 - 0.5);
                out.push(if inside {
                    let [i, j, k] = p.map(|v| (v + 0.5) as usize);
                    from[i + from_dims[0] * (j + from_dims[1] * k)]
                } else {
                    0
                });
            }
        }
    }
    out
}

impl Volume {
    pub(crate) fn new(
        regions: usize,
        dims: [usize; 3],
        to_patient: Affine34,
        to_index: Affine34,
        hu: Vec<i16>,
        label: Vec<u8>,
    ) -> Self {
        let size = |c: usize| (0..3).map(|r| to_patient[r][c].powi(2)).sum::<f64>().sqrt();
        let region = |l: &u8| u8::from(*l >= 1 && usize::from(*l) <= regions);
        let touches = pooled(dims, label.iter().map(region).collect(), u8::max);
        let low = pooled(dims, label.clone(), u8::min);
        let high = pooled(dims, label.clone(), u8::max);
        let mut cell = steps_to(
            dims,
            pooled(dims, hu.clone(), i16::min)
                .iter()
                .zip(pooled(dims, hu.clone(), i16::max))
                .zip(low.iter().zip(&high))
                .map(|((a, b), (l, h))| *a != b || l != h)
                .collect(),
            u8::MAX / EVEN,
        );
        for (cell, ((t, l), h)) in cell.iter_mut().zip(touches.iter().zip(&low).zip(&high)) {
            let mixed = if l == h { 0 } else { MIXED };
            *cell = *cell * EVEN + t * TOUCHES_REGION + mixed;
        }
        Self {
            spacing_mm: (size(0) + size(1) + size(2)) / 3.0,
            cell,
            dims,
            to_index,
            to_patient,
            hu,
            label,
        }
    }

    /// Whether an index lies in the grid or within half a voxel of it.
    #[inline]
    pub(crate) fn holds(&self, index: [f32; 3]) -> bool {
        (0..3).all(|a| index[a] >= -0.5 && index[a] <= self.dims[a] as f32 - 0.5)
    }

    /// Offset of the lower corner, and the weights of the upper ones; clamped to the grid.
    #[inline(always)]
    pub(crate) fn corner(&self, index: [f32; 3]) -> ([usize; 3], [f32; 3], [usize; 3]) {
        let mut lower = [0; 3];
        let mut weight = [0.0; 3];
        let mut step = [0; 3];
        let stride = [1, self.dims[0], self.dims[0] * self.dims[1]];
        for a in 0..3 {
            let last = self.dims[a] - 1;
            // Not a number becomes 0 here.
            let v = index[a].max(0.0).min(last as f32);
            let n = (v as usize).min(last);
            lower[a] = n;
            weight[a] = v - n as f32;
            step[a] = if n < last { stride[a] } else { 0 };
        }
        (lower, weight, step)
    }

    /// Trilinear CT value at an index, clamped to the grid.
    #[inline]
    pub(crate) fn hu_at(&self, index: [f32; 3]) -> f32 {
        let (lower, weight, step) = self.corner(index);
        let n = lower[0] + self.dims[0] * (lower[1] + self.dims[1] * lower[2]);
        Corners::new(&self.hu, n, step).at(weight)
    }

    /// Distance of neighbouring voxels along each axis in the arrays.
    pub(crate) fn strides(&self) -> [usize; 3] {
        [1, self.dims[0], self.dims[0] * self.dims[1]]
    }

    /// The label with the most trilinear weight at an index, clamped to the grid; of equals that of the lowest corner.
    /// Beside the nearest voxel's label, the border between labels is as smooth as interpolation makes it.
    #[inline]
    pub(crate) fn label_at(&self, index: [f32; 3]) -> u8 {
        let (lower, weight, step) = self.corner(index);
        let n = lower[0] + self.dims[0] * (lower[1] + self.dims[1] * lower[2]);
        if self.cell[n] & MIXED == 0 {
            return self.label[n];
        }
        self.prevailing(n, weight, step)
    }

    /// As [`Volume::label_at`] in a cell given by its lowest voxel.
    pub(crate) fn prevailing(&self, voxel: usize, w: [f32; 3], step: [usize; 3]) -> u8 {
        let mut label = [0u8; 8];
        let mut weight = [0f32; 8];
        for c in 0..8 {
            let upper = [c & 1 == 1, c & 2 == 2, c & 4 == 4];
            let mut m = voxel;
            let mut share = 1.0;
            for a in 0..3 {
                m += if upper[a] { step[a] } else { 0 };
                share *= if upper[a] { w[a] } else { 1.0 - w[a] };
            }
            label[c] = self.label[m];
            weight[c] = share;
        }
        // Nearly always there are two labels.
        let first = label[0];
        let second = label.iter().copied().find(|&l| l != first).unwrap_or(first);
        if label.iter().all(|&l| l == first || l == second) {
            let (mut a, mut b) = (0.0, 0.0);
            for c in 0..8 {
                *(if label[c] == first { &mut a } else { &mut b }) += weight[c];
            }
            return if b > a { second } else { first };
        }
        let (mut best, mut most) = (first, -1.0);
        for c in 0..8 {
            let mut sum = 0.0;
            for d in 0..8 {
                sum += if label[d] == label[c] { weight[d] } else { 0.0 };
            }
            if sum > most {
                (best, most) = (label[c], sum);
            }
        }
        best
    }

    /// Whether any of the eight voxels around an index has a region's label; clamped to the grid.
    #[inline]
    pub(crate) fn touches_region(&self, index: [f32; 3]) -> bool {
        let (lower, _, _) = self.corner(index);
        self.cell_touches_region(lower[0] + self.dims[0] * (lower[1] + self.dims[1] * lower[2]))
    }

    /// Whether any of a cell's voxels has a region's label.
    #[inline(always)]
    pub(crate) fn cell_touches_region(&self, voxel: usize) -> bool {
        self.cell[voxel] & TOUCHES_REGION != 0
    }

    /// Of a cell whose voxels have all one label and one CT value: how many cells further on, along all axes, all are the
    /// same.
    #[inline(always)]
    pub(crate) fn cell_is_even(&self, voxel: usize) -> Option<u8> {
        (self.cell[voxel] / EVEN).checked_sub(1)
    }

    /// Whether a cell's voxels have different labels.
    #[inline(always)]
    pub(crate) fn cell_is_mixed(&self, voxel: usize) -> bool {
        self.cell[voxel] & MIXED != 0
    }
}

/// For each cell the minimum or maximum of its eight voxels; at the grid's far sides of those that there are.
pub(crate) fn pooled<T: Copy>(dims: [usize; 3], mut values: Vec<T>, pick: impl Fn(T, T) -> T) -> Vec<T> {
    let mut stride = 1;
    for d in dims {
        for block in values.chunks_mut((stride * d).max(1)) {
            // Ascending, so that the upper value is still the original one.
            for n in 0..block.len().saturating_sub(stride) {
                block[n] = pick(block[n], block[n + stride]);
            }
        }
        stride *= d;
    }
    values
}

/// Steps from each cell to the nearest marked one, diagonals being one step, at most `most`.
pub(crate) fn steps_to(dims: [usize; 3], marked: Vec<bool>, most: u8) -> Vec<u8> {
    let mut steps: Vec<u8> = marked.iter().map(|&m| if m { 0 } else { most }).collect();
    let [w, h, d] = dims;
    let mut near = vec![0u8; w];
    // Forwards and backwards, each from the neighbours that are done: exact for this distance.
    for back in [false, true] {
        for n in 0..h * d {
            let row = if back { h * d - 1 - n } else { n };
            let (j, k) = (row % h, row / h);
            near.fill(most);
            // The row before in this sheet, three of the sheet before.
            for (dj, dk) in [(1, 0), (1, 1), (0, 1), (-1, 1)] {
                let (dj, dk) = if back { (dj, dk) } else { (-dj, -dk) };
                let (Some(j), Some(k)) = (j.checked_add_signed(dj), k.checked_add_signed(dk)) else {
                    continue;
                };
                if j < h && k < d {
                    let other = &steps[w * (j + h * k)..][..w];
                    near.iter_mut().zip(other).for_each(|(a, b)| *a = (*a).min(*b));
                }
            }
            let row = &mut steps[w * row..][..w];
            let mut last = most;
            for n in 0..w {
                let i = if back { w - 1 - n } else { n };
                let beside = near[i]
                    .min(near[i.saturating_sub(1)])
                    .min(near[(i + 1).min(w - 1)]);
                last = row[i].min(beside.min(last).saturating_add(1));
                row[i] = last;
            }
        }
    }
    steps
}

/// CT values at a cell's corners: those at lower first axis, and how much the upper ones have more.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Corners([[f32; 2]; 4]);

impl Corners {
    #[inline(always)]
    pub(crate) fn new(hu: &[i16], voxel: usize, step: [usize; 3]) -> Self {
        let row = |m: usize| {
            let (a, b) = (f32::from(hu[m]), f32::from(hu[m + step[0]]));
            [a, b - a]
        };
        Self([
            row(voxel),
            row(voxel + step[1]),
            row(voxel + step[2]),
            row(voxel + step[1] + step[2]),
        ])
    }

    /// Trilinear value at weights of the upper corners.
    #[inline(always)]
    pub(crate) fn at(&self, w: [f32; 3]) -> f32 {
        let row = |n: usize| self.0[n][0] + w[0] * self.0[n][1];
        let sheet = |n: usize| {
            let (a, b) = (row(n), row(n + 1));
            a + w[1] * (b - a)
        };
        let (a, b) = (sheet(0), sheet(2));
        a + w[2] * (b - a)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_those_of_a_brute_force_search() {
        let dims = [9usize, 6, 7];
        let mut random = 1u32;
        for share in [3, 40, 1000] {
            let marked: Vec<bool> = (0..dims.iter().product())
                .map(|_| {
                    random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    (random >> 8).is_multiple_of(share)
                })
                .collect();
            let place = |n: usize| [n % dims[0], n / dims[0] % dims[1], n / dims[0] / dims[1]];
            let found = steps_to(dims, marked.clone(), 5);
            for (n, found) in found.iter().enumerate() {
                let steps = |m: usize| {
                    let (a, b) = (place(n), place(m));
                    (0..3).map(|k| a[k].abs_diff(b[k])).max().unwrap()
                };
                let all = (0..marked.len()).filter(|&m| marked[m]).map(steps);
                assert_eq!(usize::from(*found), all.min().unwrap_or(5).min(5), "{n}");
            }
        }
    }
}
