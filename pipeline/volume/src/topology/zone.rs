//! Where handles are looked for.

use super::Edit;

/// Samples in which a search may change something; all others are taken as they are.
pub(super) enum Zone {
    /// All samples.
    Everywhere,
    /// Blocks of samples.
    Blocks {
        /// Blocks along each axis.
        dims: [usize; 3],
        /// Whether a block belongs to the zone.
        open: Vec<bool>,
    },
}

/// Samples along the edge of a block.
const EDGE: usize = 8;

impl Zone {
    /// The blocks within `margin` samples of the edits.
    pub fn around(edits: &[Edit], dims: [usize; 3], margin: [usize; 3]) -> Self {
        let blocks = dims.map(|d| d.div_ceil(EDGE));
        let mut open = vec![false; blocks.iter().product()];
        for &n in edits.iter().flat_map(|e| &e.samples) {
            let n = n as usize;
            let c = [n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1])];
            let lo: [usize; 3] = std::array::from_fn(|a| c[a].saturating_sub(margin[a]) / EDGE);
            let hi: [usize; 3] = std::array::from_fn(|a| ((c[a] + margin[a]) / EDGE).min(blocks[a] - 1));
            for k in lo[2]..=hi[2] {
                for j in lo[1]..=hi[1] {
                    let row = blocks[0] * (j + blocks[1] * k);
                    open[row + lo[0]..=row + hi[0]].fill(true);
                }
            }
        }
        Self::Blocks { dims: blocks, open }
    }

    /// The parts of the row of `nx` samples at (j, k) that belong to the zone, in order.
    pub fn spans(&self, nx: usize, j: usize, k: usize) -> impl Iterator<Item = std::ops::Range<usize>> + '_ {
        let (step, row) = match self {
            Self::Everywhere => (nx.max(1), None),
            Self::Blocks { dims, open } => {
                let at = dims[0] * (j / EDGE + dims[1] * (k / EDGE));
                (EDGE, Some(&open[at..at + dims[0]]))
            }
        };
        (0..nx.div_ceil(step))
            .filter(move |&b| row.is_none_or(|r| r[b]))
            .map(move |b| b * step..((b + 1) * step).min(nx))
    }
}
