//! Agreement of neighbours: semi-global matching among few surfaces.

use multiversion::multiversion;

use super::judge::{Colours, falling};
use super::propose::{Choices, MOST, NONE};

/// Cost of a pixel of disparity between neighbours, and the most, where nothing is seen between them.
const BEND: f32 = 0.1;
const BREAK: f32 = 0.5;
/// The difference of colour by which the most falls to 1/e, and the least share that is left of it.
const CONTRAST: f32 = 0.05;
const LEAST_BREAK: f32 = 0.1;
/// A surface that costs so much more is less probable by e; of four paths together.
const CLOSE: f32 = 0.2;

/// The most that a step between neighbours costs, by their contrast.
pub(super) fn breaks() -> Vec<f32> {
    (falling(CONTRAST).iter())
        .map(|share| BREAK * share.max(LEAST_BREAK))
        .collect()
}

/// What a path through the image needs to know.
#[derive(Clone, Copy)]
pub(super) struct Ground<'a> {
    pub rows: &'a [Choices],
    pub disparity: &'a [f32],
    pub colours: &'a Colours,
    pub breaks: &'a [f32],
}

/// The pixel before on a path: what it may be and the least cost of the path up to there.
struct Before<'a> {
    disparity: &'a [f32],
    sums: &'a [f32],
}

impl Ground<'_> {
    /// Sums of costs along the columns, `[y][k]`, of the path that goes down or up. A pixel without
    /// a choice costs nothing, whoever comes before it: paths begin anew there.
    pub fn along_columns(&self, down: bool) -> Vec<Vec<[f32; MOST]>> {
        let mut all: Vec<Vec<[f32; MOST]>> = vec![vec![]; self.rows.len()];
        let height = self.rows.len();
        for n in 0..height {
            let y = if down { n } else { height - 1 - n };
            let before = if down {
                y.checked_sub(1)
            } else {
                Some(y + 1).filter(|y| *y < height)
            };
            let mut sums = std::mem::take(&mut all[y]);
            match before {
                Some(before) => across(*self, y, before, &all[before], &mut sums),
                None => sums.clone_from(&self.rows[y].cost),
            }
            all[y] = sums;
        }
        all
    }

    /// Which of its surfaces is the best for each pixel with a choice, all four paths together, and the
    /// spread of the disparity among them, pixels.
    pub fn choose(&self, y: usize, down: &[[f32; MOST]], up: &[[f32; MOST]]) -> Vec<(usize, f32)> {
        let n = self.rows[y].columns.len();
        let (mut right, mut left) = (vec![[0.0; MOST]; n], vec![[0.0; MOST]; n]);
        along(*self, y, &mut right, &mut left);
        let mut best = vec![(0, 0.0); n];
        cheapest(&self.rows[y], [&right, &left, down, up], &mut best);
        best
    }
}

/// The first of the least, a pixel's own cost counted once; and the standard deviation from it if what costs more is
/// as much less probable as an exponential says.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn cheapest(row: &Choices, paths: [&[[f32; MOST]]; 4], best: &mut [(usize, f32)]) {
    let [a, b, c, d] = paths;
    for (k, (best, spread)) in best.iter_mut().enumerate() {
        let mut total = [0.0; MOST];
        for i in 0..MOST {
            total[i] = a[k][i] + b[k][i] + c[k][i] + d[k][i] - 3.0 * row.cost[k][i];
        }
        let mut least = total[0];
        for i in 1..MOST {
            *best = if total[i] < least { i } else { *best };
            least = if total[i] < least { total[i] } else { least };
        }
        let chosen = row.disparity[k][*best];
        let (mut weights, mut squares) = ([0.0; MOST], [0.0; MOST]);
        for i in 0..MOST {
            // The eighth power of 1 + v / 8 instead of exp(v).
            let root = 1.0 / (1.0 + (total[i] - least) / (8.0 * CLOSE));
            let (square, apart) = (root * root, row.disparity[k][i] - chosen);
            weights[i] = square * square * (square * square);
            squares[i] = weights[i] * apart * apart;
        }
        let (mut weight, mut sum) = (0.0, 0.0);
        for i in 0..usize::from(row.count[k]) {
            weight += weights[i];
            sum += squares[i];
        }
        *spread = (sum / weight).sqrt();
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn across(
    ground: Ground,
    y: usize,
    before: usize,
    sums_before: &[[f32; MOST]],
    sums: &mut Vec<[f32; MOST]>,
) {
    let width = ground.colours.width;
    let (row, row_before) = (&ground.rows[y], &ground.rows[before]);
    sums.resize(row.columns.len(), [0.0; MOST]);
    for (k, sums) in sums.iter_mut().enumerate() {
        let x = row.columns[k] as usize;
        let there = before * width + x;
        let limit = ground.breaks[ground.colours.contrast(y * width + x, there)];
        let from = arrive(row_before, sums_before, x, &ground.disparity[there]);
        *sums = step(from, &row.disparity[k], &row.cost[k], limit);
    }
}

/// From the left and from the right at once: each waits for its own last step only.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn along(ground: Ground, y: usize, right: &mut [[f32; MOST]], left: &mut [[f32; MOST]]) {
    let width = ground.colours.width;
    let row = &ground.rows[y];
    let n = row.columns.len();
    for k in 0..n {
        for (forward, sums) in [(true, &mut *right), (false, &mut *left)] {
            let k = if forward { k } else { n - 1 - k };
            let x = row.columns[k] as usize;
            let before = if forward { x.wrapping_sub(1) } else { x + 1 };
            let here = y * width + x;
            sums[k] = if before < width {
                let there = y * width + before;
                let limit = ground.breaks[ground.colours.contrast(here, there)];
                let from = arrive(row, sums, before, &ground.disparity[there]);
                step(from, &row.disparity[k], &row.cost[k], limit)
            } else {
                row.cost[k]
            };
        }
    }
}

/// The pixel of a row at a column, as the one before.
#[inline(always)]
fn arrive<'a>(row: &'a Choices, sums: &'a [[f32; MOST]], x: usize, only: &'a f32) -> Before<'a> {
    match row.slot[x] {
        NONE => Before {
            disparity: std::slice::from_ref(only),
            sums: &[0.0],
        },
        slot => {
            let slot = slot as usize;
            let count = usize::from(row.count[slot]);
            Before {
                disparity: &row.disparity[slot][..count],
                sums: &sums[slot][..count],
            }
        }
    }
}

/// A pixel on a path: its own cost, and the least over what the pixel before may be.
#[inline(always)]
fn step(before: Before, disparity: &[f32; MOST], cost: &[f32; MOST], limit: f32) -> [f32; MOST] {
    let mut way = [f32::MAX; MOST];
    let mut least = f32::MAX;
    for (there, sum) in before.disparity.iter().zip(before.sums) {
        least = if *sum < least { *sum } else { least };
        for i in 0..MOST {
            let apart = (there - disparity[i]).abs() - 0.5;
            let bend = sum + BEND * if apart > 0.0 { apart } else { 0.0 };
            way[i] = if bend < way[i] { bend } else { way[i] };
        }
    }
    let mut sums = [0.0; MOST];
    for i in 0..MOST {
        let way = way[i] - least;
        sums[i] = cost[i] + if way < limit { way } else { limit };
    }
    sums
}
