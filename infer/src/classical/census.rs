//! What a pixel's surroundings look like, whatever the exposure.

use std::ops::Range;

use barchan_datasets::Plane;
use multiversion::multiversion;
use rayon::prelude::*;

/// A census transform: a bit for each neighbour in a window of 9 x 7, set where it is darker than
/// the pixel.
pub(crate) struct Census {
    pub width: usize,
    pub height: usize,
    pub bits: Vec<u64>,
}

/// Most bits that differ between two transforms.
pub(crate) const MOST: u8 = 62;

/// The cost of what lies outside the right image: that of a fair match, so that paths carry on with
/// what they know from inside rather than turn to a chance likeness.
const UNSEEN: u8 = 16;

/// Half the sides of the window.
const RADIUS_X: usize = 4;
const RADIUS_Y: usize = 3;

/// The transform of a grey image; beyond the border its last pixels repeat.
pub(crate) fn census(image: &Plane) -> Census {
    let (width, height) = (image.width() as usize, image.height() as usize);
    // Sixteen bits: finer than any camera, and half the work of floats.
    let stride = width + 2 * RADIUS_X;
    let mut padded = vec![0i16; stride * height];
    padded
        .par_chunks_mut(stride)
        .zip(image.as_raw().par_chunks(width.max(1)))
        .for_each(|(out, row)| {
            for (x, out) in out.iter_mut().enumerate() {
                let value = row[x.saturating_sub(RADIUS_X).min(width - 1)];
                *out = (value.clamp(0.0, 1.0) * 32767.0) as i16;
            }
        });
    let mut bits = vec![0u64; width * height];
    bits.par_chunks_mut(width.max(1))
        .enumerate()
        .for_each(|(y, row)| {
            let rows: [&[i16]; 2 * RADIUS_Y + 1] = std::array::from_fn(|k| {
                let y = (y + k).saturating_sub(RADIUS_Y).min(height - 1);
                &padded[y * stride..][..stride]
            });
            census_row(&rows, row);
        });
    Census {
        width,
        height,
        bits,
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn census_row(rows: &[&[i16]; 2 * RADIUS_Y + 1], out: &mut [u64]) {
    let width = out.len();
    let centre = &rows[RADIUS_Y][RADIUS_X..][..width];
    for (start, out) in (0..width).step_by(64).zip(out.chunks_mut(64)) {
        let n = out.len();
        // Sixteen bits at a time, so that lanes are as wide as the pixels.
        let mut lanes = [[0u16; 64]; 4];
        let mut bit = 0;
        for (j, row) in rows.iter().enumerate() {
            for i in 0..=2 * RADIUS_X {
                if (j, i) == (RADIUS_Y, RADIUS_X) {
                    continue;
                }
                let neighbours = &row[start + i..][..n];
                let lane = &mut lanes[bit / 16];
                for ((lane, a), c) in lane.iter_mut().zip(neighbours).zip(&centre[start..]) {
                    *lane |= u16::from(a < c) << (bit % 16);
                }
                bit += 1;
            }
        }
        for (x, out) in out.iter_mut().enumerate() {
            *out = lanes
                .iter()
                .enumerate()
                .map(|(k, lane)| u64::from(lane[x]) << (16 * k))
                .sum();
        }
    }
}

/// Hamming distances `[y][x][d]` between pixel `x` of some rows of the left image and `x - d` of the
/// right one. Where the right image ends, the cost is [`UNSEEN`].
pub(super) fn distances(
    left: &Census,
    right: &Census,
    rows: Range<usize>,
    range: usize,
    costs: &mut [u8],
) {
    let width = left.width;
    let pixels = rows.start * width..rows.end * width;
    costs
        .par_chunks_mut((width * range).max(1))
        .zip(left.bits[pixels.clone()].par_chunks(width.max(1)))
        .zip(right.bits[pixels].par_chunks(width.max(1)))
        .for_each(|((costs, left), right)| {
            // Reversed, so that growing disparities are growing addresses.
            let mut reversed = vec![0; width + range];
            for (x, bits) in right.iter().enumerate() {
                reversed[width - 1 - x] = *bits;
            }
            distance_row(left, &reversed, range, costs);
        });
}

#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512vl+avx512vpopcntdq+popcnt",
    "x86_64+avx2+popcnt",
    "aarch64+neon"
))]
fn distance_row(left: &[u64], reversed: &[u64], range: usize, costs: &mut [u8]) {
    let width = left.len();
    for (x, (left, costs)) in left.iter().zip(costs.chunks_exact_mut(range)).enumerate() {
        let right = &reversed[width - 1 - x..][..range];
        for (cost, right) in costs.iter_mut().zip(right) {
            *cost = (left ^ right).count_ones() as u8;
        }
        if x + 1 < range {
            costs[x + 1..].fill(UNSEEN);
        }
    }
}
