//! From summed costs to a disparity map.

use barchan_datasets::Plane;
use multiversion::multiversion;
use rayon::prelude::*;

use crate::DisparityMap;

/// Left and right may differ by this much, pixels.
const AGREE: usize = 1;
/// Connected pixels fewer than this are a speckle; neighbours are connected within a pixel.
const SPECKLE: usize = 100;
const CONNECTED: f32 = 1.0;

/// What was decided of a pixel.
#[derive(Clone, Copy, Default)]
pub(super) struct Pixel {
    disparity: f32,
    sigma: f32,
    confidence: f32,
}

/// The winner of each pixel, to a fraction of a pixel; unknown where the right image disagrees or
/// ends.
///
/// `terms` is how many costs each sum holds; `sums_of_row` fills the sums `[x][d]` of a row, counted
/// from 0 in `pixels`.
pub(super) fn decide(
    pixels: &mut [Pixel],
    (width, range): (usize, usize),
    terms: f32,
    sums_of_row: impl Fn(usize, &mut [u16]) + Sync,
) {
    pixels.par_chunks_mut(width).enumerate().for_each_init(
        || vec![0u16; width * range],
        |sums, (y, row)| {
            sums_of_row(y, sums);
            decide_row(sums, range, terms, row);
        },
    );
}

/// The map, without speckles, each disparity the median of its neighbours.
pub(super) fn clean(pixels: &[Pixel], width: usize) -> DisparityMap {
    let mut disparity: Vec<f32> = pixels.iter().map(|p| p.disparity).collect();
    remove_speckles(&mut disparity, width);
    let disparity = median3(&disparity, width);
    let plane = |values: Vec<f32>| {
        let height = values.len() / width;
        // One value a pixel by construction.
        Plane::from_raw(width as u32, height as u32, values).unwrap_or_default()
    };
    DisparityMap {
        disparity: plane(disparity),
        sigma: plane(pixels.iter().map(|p| p.sigma).collect()),
        confidence: plane(pixels.iter().map(|p| p.confidence).collect()),
    }
}

#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512vl",
    "x86_64+avx2",
    "x86_64+sse4.1",
    "aarch64+neon"
))]
fn decide_row(sums: &[u16], range: usize, terms: f32, row: &mut [Pixel]) {
    let width = row.len();
    let of = |x: usize| &sums[x * range..][..range];
    // The same sums seen from the right image, whose pixel x is the left one's x + d: the least sum
    // with its disparity behind it, so that one minimum finds both. From right to left, so that
    // growing disparities are growing addresses; what lies beyond its first column is never asked.
    let mut right = vec![u32::MAX; width + range];
    for x in 0..width {
        let seen = &mut right[width - 1 - x..][..range];
        for (d, (right, sum)) in seen.iter_mut().zip(of(x)).enumerate() {
            *right = (*right).min(u32::from(*sum) << 16 | d as u32);
        }
    }
    for (x, pixel) in row.iter_mut().enumerate() {
        let sums = of(x);
        let least = lowest(sums);
        let d = sums.iter().position(|s| *s == least).unwrap_or(0);
        let second = lowest(&sums[..d.saturating_sub(1)]).min(lowest(&sums[(d + 2).min(range)..]));
        let lead = f32::from(second - least) / terms;
        let (offset, sigma) = around(sums, d, terms);
        // What falls outside the right image cannot be checked there.
        let seen = x >= d && {
            let back = right[width - 1 - (x - d)] & 0xffff;
            (back as usize).abs_diff(d) <= AGREE
        };
        *pixel = Pixel {
            disparity: if seen { d as f32 + offset } else { f32::NAN },
            sigma,
            confidence: lead / (lead + 1.0),
        };
    }
}

#[inline(always)]
fn lowest(sums: &[u16]) -> u16 {
    sums.iter().copied().fold(u16::MAX, u16::min)
}

/// How far the minimum lies from disparity `d`, -1/2 to 1/2, and its standard deviation, both from
/// the costs to either side.
fn around(sums: &[u16], d: usize, terms: f32) -> (f32, f32) {
    let at = |d: usize| f32::from(sums[d]);
    if d == 0 || d + 1 == sums.len() {
        return (0.0, 0.5);
    }
    let (before, here, after) = (at(d - 1), at(d), at(d + 1));
    // Two lines of equal and opposite slope through the three costs: census distances grow linearly.
    let slope = (before.max(after) - here).max(1e-3);
    let offset = 0.5 * (before - after) / slope;
    // One and a half bits a term of noise, over that slope: between what renders and what photographs
    // ask for, which differ by a factor of two.
    (
        offset.clamp(-0.5, 0.5),
        (0.1 + 1.5 * terms / slope).min(8.0),
    )
}

/// Marks small islands as unknown.
fn remove_speckles(disparity: &mut [f32], width: usize) {
    let mut visited = vec![false; disparity.len()];
    let (mut stack, mut island) = (Vec::new(), Vec::new());
    for start in 0..disparity.len() {
        if visited[start] || disparity[start].is_nan() {
            continue;
        }
        island.clear();
        stack.push(start);
        visited[start] = true;
        while let Some(at) = stack.pop() {
            island.push(at);
            let x = at % width;
            let neighbours = [
                (x > 0).then(|| at - 1),
                (x + 1 < width).then(|| at + 1),
                at.checked_sub(width),
                Some(at + width).filter(|next| *next < disparity.len()),
            ];
            for next in neighbours.into_iter().flatten() {
                if !visited[next] && (disparity[next] - disparity[at]).abs() <= CONNECTED {
                    visited[next] = true;
                    stack.push(next);
                }
            }
        }
        if island.len() < SPECKLE {
            island.iter().for_each(|at| disparity[*at] = f32::NAN);
        }
    }
}

/// The median of the known neighbours of each known pixel.
fn median3(disparity: &[f32], width: usize) -> Vec<f32> {
    let height = disparity.len() / width.max(1);
    let mut out = disparity.to_vec();
    out.par_chunks_mut(width.max(1))
        .enumerate()
        .for_each(|(y, row)| {
            let rows = [y.saturating_sub(1), y, (y + 1).min(height - 1)]
                .map(|v| &disparity[v * width..][..width]);
            for (x, out) in row.iter_mut().enumerate() {
                if out.is_nan() {
                    continue;
                }
                let columns = [x.saturating_sub(1), x, (x + 1).min(width - 1)];
                let mut around: [f32; 9] = std::array::from_fn(|k| rows[k / 3][columns[k % 3]]);
                *out = if around.iter().any(|d| d.is_nan()) {
                    // The unknown go to the end.
                    around.sort_unstable_by(f32::total_cmp);
                    let known = around.iter().filter(|d| !d.is_nan()).count();
                    around[known / 2]
                } else {
                    median9(around)
                };
            }
        });
    out
}

/// The middle of nine, by the 19 exchanges of Paeth (Graphics Gems, 1990).
fn median9(mut v: [f32; 9]) -> f32 {
    for (a, b) in [
        (1, 2),
        (4, 5),
        (7, 8),
        (0, 1),
        (3, 4),
        (6, 7),
        (1, 2),
        (4, 5),
        (7, 8),
        (0, 3),
        (5, 8),
        (4, 7),
        (3, 6),
        (1, 4),
        (2, 5),
        (4, 7),
        (4, 2),
        (6, 4),
        (4, 2),
    ] {
        (v[a], v[b]) = (v[a].min(v[b]), v[a].max(v[b]));
    }
    v[4]
}
