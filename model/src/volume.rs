//! The cost volume: how well every pixel of the left image matches every disparity of the right.
//!
//! Two opinions stand side by side as channels. One is learned: group-wise correlation of unit
//! features (Guo 2019, GwcNet). The other is not: a soft census transform (Zabih 1994, with the
//! sign made smooth), which compares local order instead of brightness and so needs no training to
//! be right about most of an image. It is what lets a small network generalise within minutes.

use crate::{Kernel, Ops};

/// Channels that [`census_volume`] yields.
pub const CENSUS_CHANNELS: usize = 2;

/// Census neighbourhood: 5x5 without its centre.
const WINDOW: usize = 5;
const NEIGHBOURS: usize = WINDOW * WINDOW - 1;

/// Group-wise correlation: `groups` channels over `bins` disparities of one feature pixel each.
pub fn correlation_volume<O: Ops>(
    ops: &mut O,
    left: &O::Map,
    right: &O::Map,
    channels: usize,
    groups: usize,
    bins: usize,
) -> O::Volume {
    let per_group = channels / groups;
    let group_sum = Kernel::from_fn([groups, channels, 1, 1], |g, c, _, _| {
        f32::from(c / per_group == g)
    });
    let planes: Vec<O::Map> = (0..bins)
        .map(|d| {
            let shifted = ops.shift_right(d, right);
            let product = ops.mul(left, &shifted);
            ops.fixed_conv2d(&format!("correlation.{d}"), &group_sum, 1, &product)
        })
        .collect();
    ops.stack(&planes)
}

/// Census agreement (-1..=1) of the normalised images at half resolution, averaged over 8x8 pixels to
/// a quarter. Channel 0 holds the whole bins, channel 1 the disparities half a bin further.
pub fn census_volume<O: Ops>(ops: &mut O, left: &O::Map, right: &O::Map, bins: usize) -> O::Volume {
    let (left, right) = (soft_census(ops, left), soft_census(ops, right));
    let mean = Kernel::from_fn([1, NEIGHBOURS, 1, 1], |_, _, _, _| 1.0 / NEIGHBOURS as f32);
    let window = Kernel::from_fn([1, 1, 4, 4], |_, _, _, _| 1.0 / 16.0);
    let planes: Vec<O::Map> = (0..2 * bins)
        .map(|half_d| {
            let shifted = ops.shift_right(half_d, &right);
            let product = ops.mul(&left, &shifted);
            let agreement = ops.fixed_conv2d(&format!("census.{half_d}"), &mean, 1, &product);
            let padded = ops.pad_edge(1, &agreement);
            ops.fixed_conv2d(&format!("census.{half_d}.window"), &window, 2, &padded)
        })
        .collect();
    let half = |odd: usize| {
        planes
            .iter()
            .skip(odd)
            .step_by(2)
            .cloned()
            .collect::<Vec<_>>()
    };
    let (whole_bins, half_bins) = (ops.stack(&half(0)), ops.stack(&half(1)));
    ops.concat_volumes(&[whole_bins, half_bins])
}

/// Differences to the neighbours, squashed to -1..1 relative to their own local strength, so that
/// faint sand and bright rock speak equally loud.
fn soft_census<O: Ops>(ops: &mut O, image: &O::Map) -> O::Map {
    let grey_half = Kernel::from_fn([1, 3, 2, 2], |_, _, _, _| 1.0 / 12.0);
    let grey = ops.fixed_conv2d("census.grey", &grey_half, 2, image);
    let padded = ops.pad_edge(WINDOW / 2, &grey);
    let centre = NEIGHBOURS / 2;
    let differences = Kernel::from_fn([NEIGHBOURS, 1, WINDOW, WINDOW], |n, _, y, x| {
        let at = y * WINDOW + x;
        let neighbour = if n < centre { n } else { n + 1 };
        f32::from(at == neighbour) - f32::from(at == centre)
    });
    let difference = ops.fixed_conv2d("census.difference", &differences, 1, &padded);
    let squared = ops.mul(&difference, &difference);
    let mean = Kernel::from_fn([1, NEIGHBOURS, 1, 1], |_, _, _, _| 1.0 / NEIGHBOURS as f32);
    let energy = ops.fixed_conv2d("census.energy", &mean, 1, &squared);
    // The floor is noise of 1 % of the image's own contrast.
    let scale2 = ops.affine(0.25, 1e-4, &energy);
    let scale2 = ops.add(&squared, &scale2);
    let scale = ops.sqrt(&scale2);
    ops.div(&difference, &scale)
}
