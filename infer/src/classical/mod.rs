//! Matching without learning: what everybody has, and what the network is compared with.

mod block_matching;
mod census;
mod finish;
mod semi_global;

pub use block_matching::BlockMatching;
pub(crate) use census::{Census, MOST as MOST_DIFFERENT, census};
pub use semi_global::SemiGlobal;

use std::ops::Range;

use barchan_datasets::{Rgb, luma};

use finish::{Pixel, clean};

use crate::DisparityMap;

/// Disparities are worked on in blocks of this many bytes, a register of AVX2.
const BLOCK: usize = 32;
/// Rows above and below a strip that are worked on for its sake alone.
const MARGIN: usize = 32;
/// Matching costs of a strip take at most about this many bytes, whatever the size of the image.
const STRIP: usize = 64 << 20;

/// Matching costs of all disparities of the pixels of some rows of the left image: `[y][x][d]`.
#[derive(Debug, Default)]
struct CostVolume {
    width: usize,
    rows: usize,
    /// Disparities `0..range`; a multiple of [`BLOCK`].
    range: usize,
    costs: Vec<u8>,
}

/// Works through a pair strip by strip, so that memory does not grow with the image: `decide` is
/// given the costs of a strip with its margins, and the pixels of those rows of it that are meant.
fn match_in_strips(
    left: &Rgb,
    right: &Rgb,
    range: Option<usize>,
    volume: &mut CostVolume,
    mut decide: impl FnMut(&CostVolume, Range<usize>, &mut [Pixel]),
) -> DisparityMap {
    let (left, right): (Census, Census) =
        rayon::join(|| census(&luma(left)), || census(&luma(right)));
    let (width, height) = (left.width, left.height);
    // Beyond the width nothing is seen.
    let range = range
        .unwrap_or((width / 4).clamp(64, 512))
        .clamp(1, width)
        .next_multiple_of(BLOCK);
    let strip = (STRIP / (width * range))
        .saturating_sub(2 * MARGIN)
        .max(MARGIN);
    let mut pixels = vec![Pixel::default(); width * height];
    for (k, pixels) in pixels.chunks_mut(strip * width).enumerate() {
        let first = k * strip;
        let rows =
            first.saturating_sub(MARGIN)..(first + pixels.len() / width + MARGIN).min(height);
        volume.width = width;
        volume.rows = rows.len();
        volume.range = range;
        volume.costs.resize(rows.len() * width * range, 0);
        let meant = first - rows.start;
        census::distances(&left, &right, rows, range, &mut volume.costs);
        decide(volume, meant..meant + pixels.len() / width, pixels);
    }
    clean(&pixels, width)
}
