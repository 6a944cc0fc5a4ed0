//! Disparity that is known from elsewhere: eq. 8, and what the distribution over disparities makes of it.

use barchan_model::SCALE;
use burn::tensor::activation::log_softmax;
use burn::tensor::module::avg_pool2d;
use burn::tensor::ops::{AvgPoolOptions, PadMode};
use burn::tensor::{Int, Tensor};

use super::masked_mean;

/// The mean of [`smooth_l1`] where `known` is 1; all `[B, 1, H, W]`.
pub fn supervised(disparity: &Tensor<4>, truth: &Tensor<4>, known: &Tensor<4>) -> Tensor<1> {
    masked_mean(smooth_l1(disparity, truth), known.clone())
}

/// The cross-entropy of the distribution `logits` (`[B, bins, h, w]`, near to far, bins of [`SCALE`] pixels) with
/// that of the true disparities in each block of `SCALE x SCALE` pixels (`[B, 1, H, W]`, 1 where `known`): each
/// true disparity is shared between the two bins next to it. A block across an outline asks for
/// two peaks, where a loss of the mean asks for a disparity in between that nothing has (Xu 2024, "Adaptive
/// multi-modal cross-entropy loss for stereo matching").
pub fn cross_entropy(logits: &Tensor<4>, truth: &Tensor<4>, known: &Tensor<4>) -> Tensor<1> {
    let [_, bins, h, w] = logits.dims();
    let [_, _, height, width] = truth.dims();
    // The network pads its images to the right and below.
    let whole = |x: &Tensor<4>| {
        let (right, below) = (SCALE * w - width, SCALE * h - height);
        x.clone().pad((0, right, 0, below), PadMode::Constant(0.0))
    };
    let (truth, known) = (whole(truth), whole(known));
    let index = Tensor::<1, Int>::arange(0..bins as i64, &logits.device()).float();
    let index = (-index + (bins - 1) as f32).reshape([1, bins, 1, 1]);
    let share = (-(truth / SCALE as f32 - index).abs() + 1.0).clamp_min(0.0) * known.clone();
    let blocks = |x| avg_pool2d(x, AvgPoolOptions::new([SCALE; 2]).with_stride([SCALE; 2]));
    let surprise = blocks(share) * log_softmax(logits.clone(), 1);
    -surprise.sum() / (blocks(known).sum() + 1e-6)
}

/// Smooth L1 (eq. 8) of `disparity - truth`, pixel by pixel, in pixels.
pub fn smooth_l1(disparity: &Tensor<4>, truth: &Tensor<4>) -> Tensor<4> {
    let error = (disparity.clone() - truth.clone()).abs();
    let near = error.clone().clamp_max(1.0);
    // 0.5 e^2 below one pixel and e - 0.5 above, without a branch.
    near.clone().square() * 0.5 + (error - near)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::checks::device;

    #[test]
    fn cross_entropy_is_least_for_the_distribution_of_the_truth() {
        let device = device();
        // One block of one row of two disparities: 6 pixels lie midway between bins 1 and 2, 8 on bin 2.
        let row = |v: [f32; 4]| Tensor::<1>::from_floats(v, &device).reshape([1, 1, 1, 4]);
        let (truth, known) = (row([6.0, 6.0, 8.0, 99.0]), row([1.0, 1.0, 1.0, 0.0]));
        let loss = |p: [f32; 4]| {
            let logits = Tensor::<1>::from_floats(p.map(f32::ln), &device).reshape([1, 4, 1, 1]);
            cross_entropy(&logits, &truth, &known).into_scalar::<f32>()
        };
        // Near to far: bins 3, 2, 1, 0.
        let best = [1e-6, 2.0 / 3.0, 1.0 / 3.0, 1e-6];
        let entropy = -(2.0f32 / 3.0 * (2.0f32 / 3.0).ln() + (1.0f32 / 3.0).ln() / 3.0);
        assert!((loss(best) - entropy).abs() < 1e-4, "{}", loss(best));
        for other in [
            [1e-6, 0.6, 0.4, 1e-6],
            [1e-6, 0.75, 0.25, 1e-6],
            [0.1, 0.6, 0.3, 1e-6],
            [1e-6, 1.0, 1e-6, 1e-6],
        ] {
            assert!(loss(other) > loss(best), "{other:?}");
        }
    }

    #[test]
    fn supervised_loss_is_smooth_l1_over_known_pixels() {
        let device = device();
        let row = |v: [f32; 4]| Tensor::<1>::from_floats(v, &device).reshape([1, 1, 1, 4]);
        let loss = supervised(
            &row([1.5, 5.0, 9.0, 2.0]),
            &row([1.0, 2.0, 0.0, 2.0]),
            &row([1.0, 1.0, 0.0, 1.0]),
        );
        // (0.5 * 0.25 + 2.5 + 0) / 3
        assert!((loss.into_scalar::<f32>() - 2.625 / 3.0).abs() < 1e-5);
    }
}
