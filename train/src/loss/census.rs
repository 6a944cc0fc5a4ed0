//! Census photometric term: compares local order instead of brightness, so that cameras of different
//! exposure still agree.

use burn::tensor::module::conv2d;
use burn::tensor::ops::ConvOptions;
use burn::tensor::{Tensor, TensorData};

/// Neighbourhood: 5x5 without its centre.
const WINDOW: usize = 5;
const NEIGHBOURS: usize = WINDOW * WINDOW - 1;
/// How far a window reaches.
pub(super) const REACH: usize = WINDOW / 2;
/// Differences below a hundredth of the image's own contrast are noise.
const NOISE: f32 = 0.01;
/// Half of the distance that counts as plain disagreement of one neighbour (Meister 2018).
const SATURATION: f32 = 0.1;

/// Distance 0..1 between the soft ternary census of two images `[B, 3, H, W]`, `[B, 1, H-4, W-4]`
/// (Stein 2004 as Meister 2018, UnFlow, has it: a squashed difference to each neighbour, and the share
/// of neighbours that disagree, likewise squashed).
///
/// Unlike UnFlow's, differences are measured against the strength of their own neighbourhood, and
/// noise against the contrast of `like`, the image that `b` was warped from: so neither a gain nor an
/// offset of either camera changes the distance.
pub fn census_distance(a: &Tensor<4>, b: &Tensor<4>, like: &Tensor<4>) -> Tensor<4> {
    let (ours, theirs) = (
        transform(&grey(a), &grey(a)),
        transform(&grey(b), &grey(like)),
    );
    let squared = (ours - theirs).square();
    (squared.clone() / (squared + SATURATION)).mean_dim(1)
}

/// Luminance by the BT.601 weights.
fn grey(image: &Tensor<4>) -> Tensor<4> {
    let weights = TensorData::new(vec![0.299f32, 0.587, 0.114], [1, 3, 1, 1]);
    (image.clone() * Tensor::from_data(weights, &image.device())).sum_dim(1)
}

/// Differences to the neighbours, squashed to -1..1 relative to their own local strength.
fn transform(grey: &Tensor<4>, like: &Tensor<4>) -> Tensor<4> {
    let like = like.clone().detach();
    let centred = like.clone() - like.mean_dims(&[2, 3]);
    // The last term keeps an image of one colour from dividing by zero.
    let noise = centred.square().mean_dims(&[2, 3]) * NOISE.powi(2) + 1e-10;
    let kernel = Tensor::from_data(differences(), &grey.device());
    let difference = conv2d(
        grey.clone(),
        kernel,
        None,
        ConvOptions::new([1; 2], [0; 2], [1; 2], 1),
    );
    let squared = difference.clone().square();
    let strength = squared.clone().mean_dim(1) * 0.25 + noise;
    difference / (squared + strength).sqrt()
}

/// A kernel `[24, 1, 5, 5]`: each neighbour less the centre.
fn differences() -> TensorData {
    let centre = NEIGHBOURS / 2;
    let mut kernel = vec![0.0f32; NEIGHBOURS * WINDOW * WINDOW];
    for (n, plane) in kernel.chunks_mut(WINDOW * WINDOW).enumerate() {
        plane[if n < centre { n } else { n + 1 }] = 1.0;
        plane[centre] = -1.0;
    }
    TensorData::new(kernel, [NEIGHBOURS, 1, WINDOW, WINDOW])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::checks::waves;

    #[test]
    fn gain_and_offset_of_one_image_change_nothing() {
        let (left, right) = (waves(0.0), waves(0.9));
        let plain = census_distance(&left, &right, &right);
        let brighter = right * 1.7 - 0.3;
        let changed = census_distance(&left, &brighter, &brighter);
        let largest = plain.clone().max().into_scalar::<f32>();
        let difference = (plain - changed).abs().max().into_scalar::<f32>();
        assert!(largest > 0.2, "{largest}");
        assert!(difference < 1e-4, "{difference}");
    }

    #[test]
    fn equal_images_are_near_and_opposite_ones_far() {
        let left = waves(0.0);
        let far = |b: &Tensor<4>| census_distance(&left, b, b).mean().into_scalar::<f32>();
        assert!(far(&left) < 1e-6);
        let opposite = far(&(-left.clone() + 1.0));
        assert!(opposite > 0.6 && opposite < 1.0, "{opposite}");
        // An image of one colour says nothing and breaks nothing.
        assert!(far(&left.zeros_like()).is_finite());
    }
}
