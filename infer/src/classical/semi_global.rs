use barchan_datasets::Rgb;
use multiversion::multiversion;

use super::finish::decide;
use super::{BLOCK, CostVolume, census, match_in_strips};
use crate::engine::check_sizes;
use crate::{DisparityEngine, DisparityMap, InferError};

/// Semi-global matching (Hirschmueller 2008) of census transforms along eight paths, to a fraction of
/// a pixel, without pixels that left and right see differently and without speckles.
#[derive(Debug, Default)]
pub struct SemiGlobal {
    range: Option<usize>,
    // Kept from pair to pair: fresh memory would cost as much as the work.
    volume: CostVolume,
    down: Vec<u16>,
    up: Vec<u16>,
}

impl SemiGlobal {
    /// Searches disparities `0..range`, rounded up to 32; a quarter of the width, 64 to 512, when not
    /// given.
    pub fn new(range: Option<usize>) -> Self {
        Self {
            range,
            ..Self::default()
        }
    }

    /// Searches disparities `0..range` from now on.
    pub(crate) fn search(&mut self, range: usize) {
        self.range = Some(range);
    }
}

impl DisparityEngine for SemiGlobal {
    fn name(&self) -> String {
        "semi-global matching".into()
    }

    fn disparity(&mut self, left: &Rgb, right: &Rgb) -> Result<DisparityMap, InferError> {
        check_sizes(left, right)?;
        let (down, up) = (&mut self.down, &mut self.up);
        let volume = &mut self.volume;
        Ok(match_in_strips(
            left,
            right,
            self.range,
            volume,
            |volume, rows, pixels| {
                // Four paths come from above and the left, four from below and the right; the two
                // groups know nothing of each other.
                rayon::join(
                    || aggregate(volume, false, down),
                    || aggregate(volume, true, up),
                );
                let row = volume.width * volume.range;
                decide(pixels, (volume.width, volume.range), 8.0, |y, sums| {
                    let at = (rows.start + y) * row..(rows.start + y + 1) * row;
                    add(&down[at.clone()], &up[at], sums);
                });
            },
        ))
    }
}

/// Costs of a disparity that changes along a path by one, and by more (eq. 11 of the paper). With the
/// 62 bits of a census they fit in a byte.
const SMALL_STEP: u8 = 11;
const LARGE_STEP: u8 = 90;
const _: () = assert!(LARGE_STEP < u8::MAX - census::MOST);

/// Path costs of a pixel, `range` of them between two guards that no minimum takes.
const GUARDS: usize = 2;

/// Sums of the costs of the four paths that reach a pixel from the rows already seen and along its
/// own row: from the top left corner on, or, with `from_below`, from the bottom right one.
fn aggregate(volume: &CostVolume, from_below: bool, sums: &mut Vec<u16>) {
    sums.resize(volume.costs.len(), 0);
    let size = (volume.width, volume.rows, volume.range);
    aggregate_into(size, &volume.costs, from_below, sums);
}

#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512vl",
    "x86_64+avx2",
    "x86_64+sse4.1",
    "aarch64+neon"
))]
fn aggregate_into(
    (width, height, range): (usize, usize, usize),
    costs: &[u8],
    from_below: bool,
    sums: &mut [u16],
) {
    let slot = range + GUARDS;
    // Path costs of the row before and of this one, for the three paths that come from it; each
    // slot with its minimum. A slot beyond either end stands for a path that starts.
    let empty = vec![u8::MAX; 3 * (width + 2) * slot];
    let (mut before, mut now) = (empty.clone(), empty);
    let mut least_before = vec![0u8; 3 * (width + 2)];
    let mut least_now = least_before.clone();
    let mut along = [vec![u8::MAX; slot], vec![u8::MAX; slot]];
    for k in 0..height {
        let y = if from_below { height - 1 - k } else { k };
        let mut least_along = u8::MAX;
        for i in 0..width {
            let x = if from_below { width - 1 - i } else { i };
            let at = (y * width + x) * range;
            let cost = &costs[at..at + range];
            let sum = &mut sums[at..at + range];
            // The neighbour from which path `p` comes: left, middle, right in the row before.
            for path in 0..3 {
                let from = 3 * (x + path) + path;
                let to = 3 * (x + 1) + path;
                let starts = k == 0 || (x + path == 0) || (x + path == width + 1);
                let least = if starts { u8::MAX } else { least_before[from] };
                least_now[to] = step(
                    &before[from * slot..][..slot],
                    least,
                    cost,
                    &mut now[to * slot..][..slot],
                    sum,
                    path == 0,
                );
            }
            let [from, to] = &mut along;
            least_along = step(from, least_along, cost, to, sum, false);
            along.swap(0, 1);
        }
        std::mem::swap(&mut before, &mut now);
        std::mem::swap(&mut least_before, &mut least_now);
    }
}

/// Eq. 13 of the paper for all disparities of a pixel: the path's costs here from those one pixel
/// back, whose least is `least`; 255 starts a path. Adds to `sum`, or begins it. Returns the least
/// cost.
#[inline(always)]
fn step(from: &[u8], least: u8, cost: &[u8], to: &mut [u8], sum: &mut [u16], first: bool) -> u8 {
    let starts = least == u8::MAX;
    let cap = if starts {
        0
    } else {
        least.saturating_add(LARGE_STEP)
    };
    let least = if starts { 0 } else { least };
    let mut lowest = [u8::MAX; BLOCK];
    for block in (0..cost.len()).step_by(BLOCK) {
        let mut here = [0u8; BLOCK];
        let same = &from[block + 1..block + 1 + BLOCK];
        let nearer = &from[block..block + BLOCK];
        let farther = &from[block + 2..block + 2 + BLOCK];
        let cost = &cost[block..block + BLOCK];
        let sum = &mut sum[block..block + BLOCK];
        for d in 0..BLOCK {
            let change = nearer[d].min(farther[d]).saturating_add(SMALL_STEP);
            here[d] = same[d].min(change).min(cap) - least.min(cap) + cost[d];
        }
        for d in 0..BLOCK {
            lowest[d] = lowest[d].min(here[d]);
        }
        if first {
            for d in 0..BLOCK {
                sum[d] = u16::from(here[d]);
            }
        } else {
            for d in 0..BLOCK {
                sum[d] += u16::from(here[d]);
            }
        }
        to[block + 1..block + 1 + BLOCK].copy_from_slice(&here);
    }
    lowest.into_iter().fold(u8::MAX, u8::min)
}

#[multiversion(targets("x86_64+avx512f+avx512bw", "x86_64+avx2", "aarch64+neon"))]
fn add(a: &[u16], b: &[u16], sums: &mut [u16]) {
    for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
        *sum = a + b;
    }
}
