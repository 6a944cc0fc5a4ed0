//! The cost volume: how well every pixel of the left image matches every disparity of the right.
//!
//! Two opinions stand side by side as channels. One is learned: group-wise correlation of unit
//! features (Guo 2019, GwcNet), or their concatenation (Kendall 2017, Zhong 2017). The other is not: a
//! soft census transform (Zabih 1994, with the sign made smooth), which compares local order instead of
//! brightness and so needs no training to be right about most of an image. It is what lets a small network
//! generalise within minutes.
//!
//! Bins run from near to far: the first one holds the largest disparity. This is the order in which
//! the diagonals of a matrix product are read off ([`Ops::correlate`]).

use crate::{Correlated, Kernel, Ops};

/// Channels that [`census_descriptors`] add to a volume: the whole bins, and half a bin further.
pub const CENSUS_CHANNELS: usize = 2;

/// Pairs of opposite neighbours in a 5x5 window: the centre-symmetric census (Spangenberg 2013), half the work of
/// comparing all neighbours with the centre, and as good.
const PAIRS: usize = 12;
const WINDOW: usize = 5;
/// A descriptor at a quarter of the resolution holds the pairs of its 2x2 pixels of half the resolution.
const DESCRIPTOR: usize = 4 * PAIRS;

/// Census descriptors at a quarter of the resolution, to be correlated like learned features.
pub struct Census<M> {
    left: M,
    right: M,
    /// The right image seen half a bin further right.
    right_half: M,
}

impl<M> Census<M> {
    /// What [`Ops::correlate`] makes [`CENSUS_CHANNELS`] channels of.
    pub fn correlated(&self) -> [Correlated<'_, M>; CENSUS_CHANNELS] {
        [&self.right, &self.right_half].map(|right| Correlated {
            left: &self.left,
            right,
            channels: DESCRIPTOR,
            groups: 1,
        })
    }
}

/// Descriptors of both normalised images, one after the other in the batch.
///
/// Differences of opposite neighbours, in units of their own neighbourhood's contrast and limited to
/// -1..1, so that faint sand and bright rock speak equally loud. The product of two descriptors is the
/// agreement over 24 x 24 pixels of the image, at most 1.
pub fn census_descriptors<O: Ops>(ops: &mut O, images: &O::Map) -> Census<O::Map> {
    let half = ops.average_pool(2, 2, images);
    let grey = ops.channel_mean(&half);
    let mean = |ops: &mut O, x: &O::Map| {
        let padded = ops.pad_edge([WINDOW / 2; 4], x);
        ops.average_pool(WINDOW, 1, &padded)
    };
    let local = mean(ops, &grey);
    let centred = ops.sub(&grey, &local);
    let square = ops.mul(&centred, &centred);
    let variance = mean(ops, &square);
    // The floor is noise of 1.4 % of the image's own contrast.
    let variance = ops.affine(1.0, 2e-4, &variance);
    let contrast = ops.sqrt(&variance);
    let normal = ops.div(&centred, &contrast);
    let (left, right) = ops.halves(&normal);
    let descriptor = |ops: &mut O, name: &str, shift: usize, x: &O::Map| {
        // Room for the window around both pixels, and on the left for the shift.
        let padded = ops.pad_edge([3, 2, 2, 2], x);
        let y = ops.fixed_conv2d(name, &opposite_differences(shift), 2, &padded);
        let y = ops.clamp(-1.0, 1.0, &y);
        // So that a product of two is a mean over the pairs.
        ops.affine((DESCRIPTOR as f32).sqrt().recip(), 0.0, &y)
    };
    Census {
        left: descriptor(ops, "census.left", 0, &left),
        right: descriptor(ops, "census.right", 0, &right),
        right_half: descriptor(ops, "census.right_half", 1, &right),
    }
}

/// For each of 2x2 pixels the differences of its opposite neighbours, `shift` pixels further left.
fn opposite_differences(shift: usize) -> Kernel {
    /// How sharply a difference decides: half a standard deviation is already a certain order.
    const GAIN: f32 = 2.0;
    Kernel::from_fn([DESCRIPTOR, 1, WINDOW + 1, WINDOW + 2], |k, _, y, x| {
        let (pixel, pair) = (k / PAIRS, k % PAIRS);
        let (top, left) = (pixel / 2, pixel % 2 + 1 - shift);
        let at = |row: usize, column: usize| f32::from(y == top + row && x == left + column);
        let (row, column) = (pair / WINDOW, pair % WINDOW);
        GAIN * (at(row, column) - at(WINDOW - 1 - row, WINDOW - 1 - column))
    })
}

/// Left features beside the right ones at every disparity (Kendall 2017): `[B, 2 C, bins, H, W]`.
pub fn concatenation_volume<O: Ops>(
    ops: &mut O,
    left: &O::Map,
    right: &O::Map,
    bins: usize,
) -> O::Volume {
    let planes: Vec<O::Map> = (0..bins)
        .rev()
        .map(|d| {
            let shifted = ops.shift_right(d, right);
            ops.concat(&[left.clone(), shifted])
        })
        .collect();
    ops.stack(&planes)
}

/// How sharply census agreement alone decides at the start: a step of 0.05 in agreement is a factor
/// of e in probability.
const CENSUS_GAIN: f32 = 20.0;

/// Weights of a kernel of three bins over `channels`, the census ones last, that make logits of census
/// agreement alone: the whole bin by a half, the half bins before and behind it by a quarter.
pub(crate) fn census_matching(channels: usize) -> Vec<f32> {
    let mut weights = vec![0.0; channels * 3];
    let whole = 3 * (channels - CENSUS_CHANNELS);
    weights[whole + 1] = 0.5 * CENSUS_GAIN;
    // Bins run from near to far, so the half bin below is that of the next one.
    weights[whole + 4] = 0.25 * CENSUS_GAIN;
    weights[whole + 5] = 0.25 * CENSUS_GAIN;
    weights
}
