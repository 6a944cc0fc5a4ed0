//! How alike the two images are under what a pixel may be.

use barchan_datasets::Rgb;
use multiversion::multiversion;
use rayon::prelude::*;

use super::doubt::MARK;
use super::propose::{Choices, MOST, NEVER};
use crate::classical::{Census, MOST_DIFFERENT};

/// Where likeness is looked at around a pixel, along an axis: so far from it.
const STEP: usize = 4;
/// Cost of what has no match in the right image, in shares of the bits of a census.
const UNSEEN: f32 = 0.3;
/// What a proposal must be better by than what is there.
const MARGIN: f32 = 0.03;
/// The difference of colour by which a pixel of the window counts less by e, and the distance.
const LIKE: f32 = 0.06;
const NEAR: f32 = 5.0;
/// By how much the nearer surface must be nearer to hide what is behind it, pixels.
const BEHIND: f32 = 1.5;

/// An image whose differences of colour are whole numbers, so that weights by them are looked up.
pub(super) struct Colours {
    pub width: usize,
    pub height: usize,
    /// Red, green, blue.
    planes: [Vec<u8>; 3],
}

/// Most that two colours differ, over three channels.
const MOST_CONTRAST: usize = 3 * 255;
/// Contrasts in a table: a power of two, so that every index is inside.
const LISTED: usize = 1024;
/// Pixels that are weighed at once.
const BLOCK: usize = 64;

impl Colours {
    pub fn of(image: &Rgb) -> Self {
        let (width, height) = (image.width() as usize, image.height() as usize);
        let mut planes = [0, 1, 2].map(|_| vec![0; width * height]);
        let [red, green, blue] = &mut planes;
        (red.par_chunks_mut(width))
            .zip(green.par_chunks_mut(width))
            .zip(blue.par_chunks_mut(width))
            .zip(image.as_raw().par_chunks(3 * width))
            .for_each(|(((red, green), blue), row)| whole_numbers(row, [red, green, blue]));
        Self {
            width,
            height,
            planes,
        }
    }

    /// How much two pixels differ, summed over the channels.
    #[inline(always)]
    pub fn contrast(&self, a: usize, b: usize) -> usize {
        let [red, green, blue] = &self.planes;
        let apart = |plane: &[u8]| usize::from(plane[a].abs_diff(plane[b]));
        apart(red) + apart(green) + apart(blue)
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn whole_numbers(values: &[f32], [red, green, blue]: [&mut [u8]; 3]) {
    let pixels = values.chunks_exact(3);
    for (((red, green), blue), p) in red.iter_mut().zip(green).zip(blue).zip(pixels) {
        // At most 255.5, and a number.
        let byte = |v: f32| ((if v > 0.0 { v } else { 0.0 }).min(1.0) * 255.0 + 0.5) as i32 as u8;
        (*red, *green, *blue) = (byte(p[0]), byte(p[1]), byte(p[2]));
    }
}

/// `exp(-contrast / scale)` for every contrast, of colours in `0..=1`.
pub(super) fn falling(scale: f32) -> Vec<f32> {
    let share = |sum: usize| sum as f32 / MOST_CONTRAST as f32;
    (0..LISTED).map(|sum| (-share(sum) / scale).exp()).collect()
}

/// A pixel of the right image: its census, and the largest disparity that lands on it, 0 where none does.
#[derive(Clone, Copy)]
struct Seen {
    bits: u64,
    nearest: f32,
}

/// What is needed to look up how alike the images are.
pub(super) struct Likeness<'a> {
    pub colours: &'a Colours,
    left: &'a Census,
    /// Rows of the right image, each with one pixel more: what is outside, and hidden by all.
    right: Vec<Seen>,
    weights: Weights,
    /// Cost by differing bits, and of what is hidden.
    costs: [f32; HIDDEN + 1],
}

/// The place of what is hidden among the costs.
const HIDDEN: usize = 63;

impl<'a> Likeness<'a> {
    pub fn new(colours: &'a Colours, [left, right]: &'a [Census; 2]) -> Self {
        let mut costs = [0.0; HIDDEN + 1];
        for (bits, cost) in costs.iter_mut().enumerate() {
            *cost = bits as f32 / f32::from(MOST_DIFFERENT);
        }
        costs[HIDDEN] = UNSEEN;
        let outside = Seen {
            bits: 0,
            nearest: f32::INFINITY,
        };
        let mut seen = vec![outside; (right.width + 1) * right.height];
        let rows = seen.par_chunks_mut(right.width + 1);
        rows.zip(right.bits.par_chunks(right.width))
            .for_each(|(seen, bits)| {
                for (seen, bits) in seen.iter_mut().zip(bits) {
                    seen.bits = *bits;
                }
            });
        Self {
            colours,
            left,
            right: seen,
            weights: Weights::of(colours),
            costs,
        }
    }

    /// What hides from the right camera is known from here on.
    pub fn set_surfaces(&mut self, disparity: &[f32]) {
        let width = self.colours.width;
        let rows = (self.right.par_chunks_mut(width + 1)).zip(disparity.par_chunks(width));
        rows.for_each(|(seen, row)| {
            let seen = &mut seen[..width];
            for seen in seen.iter_mut() {
                seen.nearest = 0.0;
            }
            for (x, d) in row.iter().enumerate() {
                // Left of the image wraps to far beyond its end.
                if let Some(there) = seen.get_mut(x.wrapping_sub((d + 0.5) as usize)) {
                    // An unknown disparity is never the larger.
                    there.nearest = if *d > there.nearest {
                        *d
                    } else {
                        there.nearest
                    };
                }
            }
        });
    }

    /// How many bits of the census differ between the pixels of a row and what they match; [`MARK`] where the right
    /// camera does not see it.
    pub fn differing(&self, y: usize, disparity: &[f32], out: &mut [u8]) {
        let width = self.colours.width;
        let left = &self.left.bits[y * width..][..width];
        differing(
            left,
            &self.right[y * (width + 1)..][..width + 1],
            disparity,
            out,
        );
    }

    /// How unlike the two images are under each proposal: differing census bits around the pixel, weighed by
    /// how much the colour there is its own.
    pub fn judge(&self, choices: &mut Choices, y: usize) {
        judge(self, choices, y);
    }
}

#[multiversion(targets("x86_64+avx2+popcnt", "aarch64+neon"))]
fn differing(left: &[u64], right: &[Seen], disparity: &[f32], out: &mut [u8]) {
    for (x, ((out, left), d)) in out.iter_mut().zip(left).zip(disparity).enumerate() {
        let at = x.wrapping_sub((d + 0.5) as usize).min(right.len() - 1);
        let there = right[at];
        let seen = there.nearest <= d + BEHIND;
        *out = if seen {
            (left ^ there.bits).count_ones() as u8
        } else {
            MARK
        };
    }
}

#[multiversion(targets("x86_64+avx2+popcnt", "aarch64+neon"))]
fn judge(seen: &Likeness, choices: &mut Choices, y: usize) {
    let (width, height) = (seen.colours.width, seen.colours.height);
    // What is beyond the border has no weight, whatever it is.
    let lines = [y.saturating_sub(STEP), y, (y + STEP).min(height - 1)];
    let lefts = lines.map(|line| &seen.left.bits[line * width..][..width]);
    let rights = lines.map(|line| &seen.right[line * (width + 1)..][..width + 1]);
    let weights = seen.weights.rows(y);
    choices.cost.clear();
    choices.cost.resize(choices.columns.len(), [NEVER; MOST]);
    for (k, cost) in choices.cost.iter_mut().enumerate() {
        let x = choices.columns[k] as usize;
        let weights = weights.around(x);
        let columns = [x.saturating_sub(STEP), x, (x + STEP).min(width - 1)];
        let mut own = [[0u64; 3]; 3];
        let mut sum = 0.0;
        for j in 0..3 {
            for i in 0..3 {
                own[j][i] = lefts[j][columns[i]];
                sum += weights[j][i];
            }
        }
        let share = 1.0 / sum;
        let disparities = &choices.disparity[k][..usize::from(choices.count[k])];
        for (n, (cost, &d)) in cost.iter_mut().zip(disparities).enumerate() {
            let whole = (d + 0.5) as usize;
            let mut total = 0.0;
            for j in 0..3 {
                for i in 0..3 {
                    // Left of the right image is what is after its end.
                    let at = columns[i].wrapping_sub(whole).min(rights[j].len() - 1);
                    let there = rights[j][at];
                    let differ = (there.bits ^ own[j][i]).count_ones() as usize;
                    let hidden = there.nearest > d + BEHIND;
                    let unlike = if hidden { HIDDEN } else { differ };
                    total += weights[j][i] * seen.costs[unlike & HIDDEN];
                }
            }
            let moved = if n > 0 { MARGIN } else { 0.0 };
            *cost = total * share + moved;
        }
    }
}

/// How much the pixels around count: by colour and distance; 0 where one of two is outside.
struct Weights {
    stride: usize,
    /// Of the neighbours to the right, and below on the left, straight and on the right. A row begins and ends
    /// with [`STEP`] pixels outside, and as many rows outside come first.
    planes: [Vec<f32>; 4],
}

/// The neighbours that [`Weights`] holds, in steps; the others are those of the neighbours.
const AHEAD: [[isize; 2]; 4] = [[1, 0], [-1, 1], [0, 1], [1, 1]];

impl Weights {
    fn of(colours: &Colours) -> Self {
        let stride = colours.width + 2 * STEP;
        let alike = falling(LIKE);
        let planes = AHEAD.map(|[dx, dy]| {
            let apart = (dx.abs() + dy.abs()) as f32 * STEP as f32;
            let scaled: Vec<f32> = alike.iter().map(|w| w * (-apart / NEAR).exp()).collect();
            let mut plane = vec![0.0; stride * (colours.height + STEP)];
            let rows = plane.par_chunks_mut(stride).skip(STEP);
            rows.enumerate().for_each(|(y, row)| {
                let below = y + dy as usize * STEP;
                if below < colours.height {
                    let row = &mut row[STEP..STEP + colours.width];
                    weigh(colours, [y, below], dx, &scaled, row);
                }
            });
            plane
        });
        Self { stride, planes }
    }

    /// What is needed for a row.
    fn rows(&self, y: usize) -> WeightRows<'_> {
        let line = |plane: usize, y: usize| &self.planes[plane][y * self.stride..][..self.stride];
        WeightRows {
            here: [0, 1, 2, 3].map(|plane| line(plane, y + STEP)),
            above: [1, 2, 3].map(|plane| line(plane, y)),
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn weigh(colours: &Colours, [y, below]: [usize; 2], dx: isize, scaled: &[f32], out: &mut [f32]) {
    let width = colours.width;
    let from = if dx < 0 { STEP.min(width) } else { 0 };
    let to = if dx > 0 {
        width.saturating_sub(STEP)
    } else {
        width
    };
    let Some(table) = scaled.first_chunk::<LISTED>() else {
        return;
    };
    for start in (from..to).step_by(BLOCK) {
        let n = BLOCK.min(to - start);
        let there = below * width + start.saturating_add_signed(dx * STEP as isize);
        let here = y * width + start;
        let mut contrast = [0u16; BLOCK];
        for plane in &colours.planes {
            let (a, b) = (&plane[here..here + n], &plane[there..there + n]);
            for ((sum, a), b) in contrast.iter_mut().zip(a).zip(b) {
                *sum += u16::from(a.abs_diff(*b));
            }
        }
        for (out, contrast) in out[start..start + n].iter_mut().zip(&contrast) {
            *out = table[usize::from(*contrast) % LISTED];
        }
    }
}

/// Rows of [`Weights`].
struct WeightRows<'a> {
    here: [&'a [f32]; 4],
    above: [&'a [f32]; 3],
}

impl WeightRows<'_> {
    /// Of the pixels around one, `[y][x]`.
    #[inline(always)]
    fn around(&self, x: usize) -> [[f32; 3]; 3] {
        let [right, below_left, below, below_right] = self.here;
        let [above_right, above, above_left] = self.above;
        // Column `x` is at `x + STEP`.
        let (before, here, after) = (x, x + STEP, x + 2 * STEP);
        [
            [above_left[before], above[here], above_right[after]],
            [right[before], 1.0, right[here]],
            [below_left[here], below[here], below_right[here]],
        ]
    }
}
