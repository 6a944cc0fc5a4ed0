//! The right image seen from the left camera, and how it differs: eq. 2 and 3.

use burn::tensor::module::avg_pool2d;
use burn::tensor::ops::AvgPoolOptions;
use burn::tensor::{Int, Tensor};

/// The right image seen from the left camera: row-wise linear sampling at `x - d`, differentiable in
/// the disparity; and 1 where that lies inside the right image, else 0, `[B, 1, H, W]`.
pub fn warp_right_to_left(right: &Tensor<4>, disparity: &Tensor<4>) -> (Tensor<4>, Tensor<4>) {
    let [_, channels, _, width] = right.dims();
    let device = disparity.device();
    let columns = Tensor::<1, Int>::arange(0..width as i64, &device)
        .float()
        .reshape([1, 1, 1, width]);
    let at = columns - disparity.clone();
    let last = (width - 1) as f32;
    let inside = at.clone().detach().greater_equal_scalar(0.0).float()
        * at.clone().detach().lower_equal_scalar(last).float();
    let at = at.clamp(0.0, last);
    let before = at.clone().detach().floor().clamp_max(last - 1.0);
    let a = at - before.clone();
    let index = before.int().repeat_dim(1, channels);
    let sample = |index: Tensor<4, Int>| right.clone().gather(3, index);
    let warped = sample(index.clone()) * (-a.clone() + 1.0) + sample(index + 1) * a;
    (warped, inside)
}

/// (1 - SSIM) / 2 per channel over 3x3 windows (Wang 2004; the window as Godard 2017), `[B, C, H-2, W-2]`.
pub fn structural_dissimilarity(a: &Tensor<4>, b: &Tensor<4>) -> Tensor<4> {
    const C1: f32 = 0.01 * 0.01;
    const C2: f32 = 0.03 * 0.03;
    let mean = |x: Tensor<4>| avg_pool2d(x, AvgPoolOptions::new([3, 3]).with_stride([1, 1]));
    let (ma, mb) = (mean(a.clone()), mean(b.clone()));
    let va = mean(a.clone().square()) - ma.clone().square();
    let vb = mean(b.clone().square()) - mb.clone().square();
    let cov = mean(a.clone() * b.clone()) - ma.clone() * mb.clone();
    let ssim = ((ma.clone() * mb.clone() * 2.0 + C1) * (cov * 2.0 + C2))
        / ((ma.square() + mb.square() + C1) * (va + vb + C2));
    ((-ssim + 1.0) * 0.5).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::checks::{device, waves};

    #[test]
    fn warping_by_a_whole_disparity_shifts_columns_and_masks_the_outside() {
        let right = waves(1.3);
        let d = Tensor::<4>::full([1, 1, 8, 12], 3.0, &device());
        let (warped, inside) = warp_right_to_left(&right, &d);
        let shifted = right.narrow(3, 0, 9);
        let difference = (warped.narrow(3, 3, 9) - shifted)
            .abs()
            .max()
            .into_scalar::<f32>();
        assert!(difference < 1e-6, "{difference}");
        assert_eq!(
            inside.clone().narrow(3, 0, 3).sum().into_scalar::<f32>(),
            0.0
        );
        assert_eq!(inside.narrow(3, 3, 9).mean().into_scalar::<f32>(), 1.0);
    }

    #[test]
    fn equal_images_have_no_dissimilarity_and_opposite_ones_have_much() {
        let left = waves(0.0);
        let same = structural_dissimilarity(&left, &left)
            .max()
            .into_scalar::<f32>();
        assert!(same < 1e-5, "{same}");
        let opposite = structural_dissimilarity(&left, &(-left.clone() + 1.0))
            .mean()
            .into_scalar::<f32>();
        assert!(opposite > 0.5, "{opposite}");
    }
}
