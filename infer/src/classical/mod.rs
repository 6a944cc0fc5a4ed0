//! Matching without learning: what everybody has, and what the network is compared with.

mod block_matching;
mod census;
mod finish;
mod semi_global;

pub use block_matching::BlockMatching;
pub use semi_global::SemiGlobal;

use barchan_datasets::{Rgb, luma};

use census::{Census, census};

/// Disparities are worked on in blocks of this many bytes, a register of AVX2.
const BLOCK: usize = 32;

/// Matching costs of all disparities of all pixels of the left image: `[y][x][d]`.
struct CostVolume {
    width: usize,
    height: usize,
    /// Disparities `0..range`; a multiple of [`BLOCK`].
    range: usize,
    costs: Vec<u8>,
}

impl CostVolume {
    /// Hamming distances of census transforms (Zabih and Woodfill 1994).
    fn new(left: &Rgb, right: &Rgb, range: Option<usize>) -> Self {
        let (left, right): (Census, Census) =
            rayon::join(|| census(&luma(left)), || census(&luma(right)));
        // Beyond the width nothing is seen.
        let range = range
            .unwrap_or((left.width / 4).clamp(64, 512))
            .clamp(1, left.width)
            .next_multiple_of(BLOCK);
        Self {
            width: left.width,
            height: left.height,
            range,
            costs: census::distances(&left, &right, range),
        }
    }
}
