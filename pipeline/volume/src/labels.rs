use crate::{Affine, LabelTable};
use std::collections::BTreeMap;

/// Voxels `lo` to `hi` (exclusive) along each index axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct IndexBox {
    /// First index.
    pub lo: [usize; 3],
    /// One past the last index.
    pub hi: [usize; 3],
}

impl IndexBox {
    /// Number of voxels along each axis.
    pub fn dims(&self) -> [usize; 3] {
        std::array::from_fn(|a| self.hi[a] - self.lo[a])
    }

    /// The smallest box that holds both.
    pub fn union(&self, other: &Self) -> Self {
        Self {
            lo: std::array::from_fn(|a| self.lo[a].min(other.lo[a])),
            hi: std::array::from_fn(|a| self.hi[a].max(other.hi[a])),
        }
    }
}

/// A segmented scan: one byte code per voxel and the label that each code stands for.
///
/// Memory of pure background is touched only when it is read, so a large, sparse scan is small in memory.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelVolume {
    /// Voxels along the index axes i, j, k.
    pub dims: [usize; 3],
    /// Index → patient RAS mm (voxel centres).
    pub affine: Affine,
    /// Label of each code, ascending; every one of them is present.
    pub values: Vec<i64>,
    /// Code of voxel (i, j, k) at `i + dims[0]·(j + dims[1]·k)`.
    pub codes: Vec<u8>,
    /// Voxels of each code.
    pub counts: Vec<u64>,
    /// The smallest box that holds all voxels of each code.
    pub boxes: Vec<IndexBox>,
}

/// A label that occurs in the volume.
#[derive(Clone, Debug, PartialEq)]
pub struct PresentLabel {
    /// The voxel value.
    pub label: i64,
    /// Its name, where a table knows it.
    pub name: Option<String>,
    /// How many voxels have it.
    pub voxels: u64,
    /// Their volume in mm³.
    pub volume_mm3: f64,
}

impl std::fmt::Display for PresentLabel {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.label)?;
        if let Some(name) = &self.name {
            write!(f, " {name}")?;
        }
        write!(f, " ({} voxels, {:.1} mL)", self.voxels, self.volume_mm3 / 1000.0)
    }
}

/// Voxels and labels that do not fit together.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LabelVolumeError {
    /// Another number of voxels than the dimensions say.
    #[error("{found} voxels were given for dimensions {dims:?}")]
    WrongLength {
        /// Dimensions.
        dims: [usize; 3],
        /// Voxels given.
        found: usize,
    },
    /// More distinct labels than a byte can number.
    #[error("{found} distinct labels, at most 256 are supported")]
    TooManyLabels {
        /// Distinct labels.
        found: usize,
    },
}

impl LabelVolume {
    /// A volume from one label per voxel, first axis fastest.
    ///
    /// # Errors
    /// Where `labels` is not as long as `dims` say, or holds more than 256 distinct values.
    pub fn from_labels<T: Copy + Into<i64>>(
        dims: [usize; 3],
        affine: Affine,
        labels: &[T],
    ) -> Result<Self, LabelVolumeError> {
        let voxels = dims[0].checked_mul(dims[1]).and_then(|n| n.checked_mul(dims[2]));
        if voxels != Some(labels.len()) {
            return Err(LabelVolumeError::WrongLength {
                dims,
                found: labels.len(),
            });
        }
        // Neighbours are mostly equal: the map is asked only where the label changes.
        let mut code_of: BTreeMap<i64, u8> = BTreeMap::new();
        for run in labels.chunk_by(|&a, &b| a.into() == b.into()) {
            code_of.insert(run[0].into(), 0);
        }
        if code_of.len() > 256 {
            return Err(LabelVolumeError::TooManyLabels { found: code_of.len() });
        }
        for (n, code) in code_of.values_mut().enumerate() {
            *code = n as u8;
        }
        let mut codes = Vec::with_capacity(labels.len());
        for run in labels.chunk_by(|&a, &b| a.into() == b.into()) {
            let code = code_of.get(&run[0].into()).copied().unwrap_or(0);
            codes.resize(codes.len() + run.len(), code);
        }
        let mut tally = Tally::new(dims);
        tally.add(&codes);
        let values: Vec<i64> = code_of.into_keys().collect();
        let counts = tally.counts[..values.len()].to_vec();
        let boxes = tally.boxes[..values.len()].to_vec();
        Ok(Self {
            dims,
            affine,
            values,
            codes,
            counts,
            boxes,
        })
    }

    /// The code of a label, or `None` where no voxel has it.
    pub fn code_of(&self, label: i64) -> Option<u8> {
        self.values.binary_search(&label).ok().map(|n| n as u8)
    }

    /// The label of voxel (i, j, k); the index must lie within `dims`.
    pub fn label_at(&self, index: [usize; 3]) -> i64 {
        let [i, j, k] = index;
        self.values[usize::from(self.codes[i + self.dims[0] * (j + self.dims[1] * k)])]
    }

    /// For every code whether its label is one of `labels`: the lookup table for a pass over `codes`.
    pub fn selected(&self, labels: &[i64]) -> [bool; 256] {
        let mut out = [false; 256];
        for &label in labels {
            if let Some(code) = self.code_of(label) {
                out[usize::from(code)] = true;
            }
        }
        out
    }

    /// Those of `labels` that no voxel has.
    pub fn absent(&self, labels: &[i64]) -> Vec<i64> {
        labels
            .iter()
            .copied()
            .filter(|&l| self.code_of(l).is_none())
            .collect()
    }

    /// The smallest box that holds every voxel of `labels`, or `None` where there is none.
    pub fn bounds_of(&self, labels: &[i64]) -> Option<IndexBox> {
        labels
            .iter()
            .filter_map(|&l| self.code_of(l))
            .map(|code| self.boxes[usize::from(code)])
            .reduce(|a, b| a.union(&b))
    }

    /// Volume of one voxel in mm³.
    pub fn voxel_volume_mm3(&self) -> f64 {
        self.affine.det().abs()
    }

    /// Every label that occurs, ascending, with its count, and its name where `table` has one.
    pub fn present(&self, table: Option<&LabelTable>) -> Vec<PresentLabel> {
        let voxel = self.voxel_volume_mm3();
        std::iter::zip(&self.values, &self.counts)
            .map(|(&label, &voxels)| PresentLabel {
                label,
                name: table.and_then(|t| t.name(label)).map(str::to_owned),
                voxels,
                volume_mm3: voxels as f64 * voxel,
            })
            .collect()
    }
}

/// Counts and boxes of codes, gathered run by run while the voxels pass.
pub(crate) struct Tally {
    pub(crate) counts: [u64; 256],
    pub(crate) boxes: [IndexBox; 256],
    /// Runs of equal codes so far.
    pub(crate) runs: u64,
    dims: [usize; 3],
    next: [usize; 3],
    last: Option<u8>,
}

impl Tally {
    pub(crate) fn new(dims: [usize; 3]) -> Self {
        let empty = IndexBox {
            lo: [usize::MAX; 3],
            hi: [0; 3],
        };
        Self {
            counts: [0; 256],
            boxes: [empty; 256],
            runs: 0,
            dims,
            next: [0; 3],
            last: None,
        }
    }

    /// Takes the next voxels in file order.
    pub(crate) fn add(&mut self, codes: &[u8]) {
        let mut at = 0;
        while at < codes.len() {
            let code = codes[at];
            let len = run_length(&codes[at..]);
            self.run(code, len);
            at += len;
        }
    }

    /// Takes `len` > 0 voxels of the same code.
    pub(crate) fn run(&mut self, code: u8, len: usize) {
        self.runs += u64::from(self.last != Some(code));
        self.last = Some(code);
        let [nx, ny, _] = self.dims;
        let first = self.next;
        let mut last = first;
        last[0] += len - 1;
        if last[0] >= nx {
            last[1] += last[0] / nx;
            last[0] %= nx;
            if last[1] >= ny {
                last[2] += last[1] / ny;
                last[1] %= ny;
            }
        }
        self.next = last;
        self.next[0] += 1;
        if self.next[0] == nx {
            self.next[0] = 0;
            self.next[1] += 1;
            if self.next[1] == ny {
                self.next[1] = 0;
                self.next[2] += 1;
            }
        }
        // A run that goes on into the next row (slice) reaches both ends of the row (slice).
        let rows = first[1] != last[1] || first[2] != last[2];
        let slices = first[2] != last[2];
        let lo = [
            if rows { 0 } else { first[0] },
            if slices { 0 } else { first[1] },
            first[2],
        ];
        let hi = [
            if rows { nx } else { last[0] + 1 },
            if slices { ny } else { last[1] + 1 },
            last[2] + 1,
        ];
        let c = usize::from(code);
        self.counts[c] += len as u64;
        self.boxes[c] = self.boxes[c].union(&IndexBox { lo, hi });
    }
}

/// Length of the run of equal bytes at the start of `codes`, which is not empty.
fn run_length(codes: &[u8]) -> usize {
    let first = codes[0];
    let mut n = 1;
    for block in codes[1..].chunks_exact(32) {
        if block.iter().fold(0, |a, &b| a | (b ^ first)) != 0 {
            break;
        }
        n += 32;
    }
    n + codes[n..].iter().take_while(|&&b| b == first).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Counts and boxes against the obvious loop, with the voxels given in pieces.
        #[test]
        fn tally_matches_a_plain_count(
            dims in [1usize..7, 1usize..7, 1usize..7],
            seed in proptest::collection::vec(0u8..3, 216),
            stretch in 1usize..60,
            piece in 1usize..50,
        ) {
            let n = dims[0] * dims[1] * dims[2];
            let codes: Vec<u8> = (0..n).map(|v| seed[v / stretch]).collect();
            let mut tally = Tally::new(dims);
            for part in codes.chunks(piece) {
                tally.add(part);
            }
            for code in 0..3u8 {
                let (mut lo, mut hi, mut count) = ([usize::MAX; 3], [0; 3], 0);
                for (v, _) in codes.iter().enumerate().filter(|(_, c)| **c == code) {
                    let p = [v % dims[0], v / dims[0] % dims[1], v / dims[0] / dims[1]];
                    count += 1;
                    for a in 0..3 {
                        lo[a] = p[a].min(lo[a]);
                        hi[a] = (p[a] + 1).max(hi[a]);
                    }
                }
                prop_assert_eq!(tally.counts[usize::from(code)], count);
                prop_assert_eq!(tally.boxes[usize::from(code)], IndexBox { lo, hi });
            }
            let changes = codes.windows(2).filter(|w| w[0] != w[1]).count() as u64;
            prop_assert_eq!(tally.runs, changes + 1);
        }
    }

    #[test]
    fn from_labels_numbers_ascending() {
        let affine = Affine::from_spacing([1.0, 2.0, 3.0], [0.0; 3]);
        let v = LabelVolume::from_labels([2, 2, 1], affine, &[7i64, -1, 7, 0]).unwrap();
        assert_eq!(v.values, [-1, 0, 7]);
        assert_eq!(v.codes, [2, 0, 2, 1]);
        assert_eq!(v.counts, [1, 1, 2]);
        assert_eq!(
            v.bounds_of(&[7, 9]),
            Some(IndexBox {
                lo: [0, 0, 0],
                hi: [1, 2, 1]
            })
        );
        assert_eq!(v.absent(&[7, 9]), [9]);
        assert_eq!(v.label_at([1, 0, 0]), -1);
        assert_eq!(v.voxel_volume_mm3(), 6.0);
        let err = LabelVolume::from_labels([2, 2, 2], affine, &[0i64]).unwrap_err();
        assert_eq!(
            err,
            LabelVolumeError::WrongLength {
                dims: [2, 2, 2],
                found: 1
            }
        );
    }
}
