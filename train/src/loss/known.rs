//! Disparity that is known from elsewhere: eq. 8.

use burn::tensor::Tensor;

use super::masked_mean;

/// The mean of [`smooth_l1`] where `known` is 1; all `[B, 1, H, W]`.
pub fn supervised(disparity: &Tensor<4>, truth: &Tensor<4>, known: &Tensor<4>) -> Tensor<1> {
    masked_mean(smooth_l1(disparity, truth), known.clone())
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
