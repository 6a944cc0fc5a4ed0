//! The self-supervised loss of Hong 2021, eq. 1-5, and the supervised one, eq. 8.

use burn::tensor::module::avg_pool2d;
use burn::tensor::ops::AvgPoolOptions;
use burn::tensor::{Int, Tensor};
use serde::{Deserialize, Serialize};

/// Weights of eq. 1: `L = a1 L_SSIM + a2 L_1 + a3 L_smooth + a4 L_0`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Loss {
    /// Weight of the structural term, eq. 2.
    pub ssim: f32,
    /// Weight of the colour term, eq. 3.
    pub l1: f32,
    /// Weight of the smoothness term. The paper's eq. 4 repeats eq. 3 by mistake; what its text
    /// describes, edge-aware first differences of the disparity (Godard 2017), is done here.
    pub smooth: f32,
    /// Weight of the disparity-magnitude term, eq. 5.
    pub magnitude: f32,
}

impl Default for Loss {
    fn default() -> Self {
        Self {
            ssim: 0.8,
            l1: 0.2,
            smooth: 0.1,
            magnitude: 0.1,
        }
    }
}

/// How fast an edge of the image forgives an edge of the disparity: a step of 0.1 in brightness
/// divides the smoothness weight by e.
const EDGE: f32 = 10.0;

/// The terms of eq. 1, each a mean over the pixels it can see, unweighted; and their weighted sum.
#[derive(Clone, Debug)]
pub struct LossTerms<T = Tensor<1>> {
    /// The weighted sum.
    pub total: T,
    /// Mean of (1 - SSIM) / 2, eq. 2.
    pub ssim: T,
    /// Mean absolute difference of colours, eq. 3.
    pub l1: T,
    /// Edge-aware smoothness of the disparity, as a share of the width per pixel.
    pub smooth: T,
    /// Mean disparity as a share of the width, eq. 5.
    pub magnitude: T,
}

impl LossTerms {
    /// The numbers, off the device.
    pub fn values(&self) -> LossTerms<f32> {
        let read = |t: &Tensor<1>| t.clone().into_scalar::<f32>();
        LossTerms {
            total: read(&self.total),
            ssim: read(&self.ssim),
            l1: read(&self.l1),
            smooth: read(&self.smooth),
            magnitude: read(&self.magnitude),
        }
    }
}

impl Loss {
    /// Eq. 1 for images `[B, 3, H, W]` in 0..=1 and disparity `[B, 1, H, W]` in pixels.
    ///
    /// Pixels whose match falls outside the right image cannot be judged and are left out of the
    /// photometric terms, and of the magnitude term too: with nothing to hold against it, that one
    /// would draw the whole left border to infinity. Disparity enters eq. 4 and 5 as a share of the image's width (as Godard 2017
    /// has it): in pixels the paper's weights would let the magnitude term outweigh the images.
    pub fn self_supervised(
        &self,
        left: &Tensor<4>,
        right: &Tensor<4>,
        disparity: &Tensor<4>,
    ) -> LossTerms {
        let (warped, inside) = warp_right_to_left(right, disparity);
        let ssim = masked_mean(structural_dissimilarity(left, &warped), shrink(&inside));
        let l1 = masked_mean((left.clone() - warped).abs(), inside.clone());
        let share = disparity.clone() / disparity.dims()[3] as f32;
        let smooth = edge_aware_smoothness(left, &share);
        let magnitude = masked_mean(share.abs(), inside);
        let total = ssim.clone() * self.ssim
            + l1.clone() * self.l1
            + smooth.clone() * self.smooth
            + magnitude.clone() * self.magnitude;
        LossTerms {
            total,
            ssim,
            l1,
            smooth,
            magnitude,
        }
    }
}

/// Smooth L1 (eq. 8) of `disparity - truth` where `known` is 1, in pixels; all `[B, 1, H, W]`.
pub fn supervised(disparity: &Tensor<4>, truth: &Tensor<4>, known: &Tensor<4>) -> Tensor<1> {
    let error = (disparity.clone() - truth.clone()).abs();
    let near = error.clone().clamp_max(1.0);
    // 0.5 e^2 below one pixel and e - 0.5 above, without a branch.
    let loss = near.clone().square() * 0.5 + (error - near);
    masked_mean(loss, known.clone())
}

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

/// `|dx d| exp(-10 |dx I|) + |dy d| exp(-10 |dy I|)`, the mean over pixels.
pub fn edge_aware_smoothness(image: &Tensor<4>, disparity: &Tensor<4>) -> Tensor<1> {
    let difference = |x: &Tensor<4>, dim: usize| {
        let n = x.dims()[dim];
        (x.clone().narrow(dim, 1, n - 1) - x.clone().narrow(dim, 0, n - 1)).abs()
    };
    let along = |dim: usize| {
        let edge = difference(image, dim).mean_dim(1);
        (difference(disparity, dim) * (edge * -EDGE).exp()).mean()
    };
    along(3) + along(2)
}

/// Mean of `x` over the pixels where `mask` (one channel) is 1; 0 where there are none.
fn masked_mean(x: Tensor<4>, mask: Tensor<4>) -> Tensor<1> {
    let channels = x.dims()[1] as f32;
    (x * mask.clone()).sum() / (mask.sum() * channels + 1e-6)
}

/// A mask without its outermost pixels, as a valid 3x3 window leaves.
fn shrink(mask: &Tensor<4>) -> Tensor<4> {
    let [_, _, h, w] = mask.dims();
    mask.clone().narrow(2, 1, h - 2).narrow(3, 1, w - 2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, Distribution};

    fn device() -> Device {
        Device::flex().autodiff()
    }

    /// A smooth pair and a disparity away from whole pixels, where linear sampling has kinks.
    fn scene() -> (Tensor<4>, Tensor<4>, Tensor<4>) {
        let device = device();
        device.seed(7);
        let wave = |phase: f32| {
            let pixel = |i: usize| {
                let (c, y, x) = (i / (8 * 12), i / 12 % 8, i % 12);
                0.5 + 0.3 * (0.7 * x as f32 + 0.4 * y as f32 + phase + c as f32).sin()
            };
            let data: Vec<f32> = (0..3 * 8 * 12).map(pixel).collect();
            Tensor::<1>::from_floats(data.as_slice(), &device).reshape([1, 3, 8, 12])
        };
        let whole = Tensor::random([1, 1, 8, 12], Distribution::Uniform(0.0, 3.0), &device).floor();
        let part = Tensor::random([1, 1, 8, 12], Distribution::Uniform(0.2, 0.8), &device);
        (wave(0.0), wave(1.3), whole + part)
    }

    #[test]
    fn gradient_of_the_loss_matches_finite_differences() {
        let (left, right, disparity) = scene();
        let total = |d: &Tensor<4>| Loss::default().self_supervised(&left, &right, d).total;
        let d = disparity.clone().require_grad();
        let gradients = total(&d).backward();
        let gradient: Vec<f32> = d
            .grad(&gradients)
            .unwrap()
            .into_data()
            .iter::<f32>()
            .collect();
        let base: Vec<f32> = disparity.to_data().iter::<f32>().collect();
        let step = 0.02;
        let (mut worst, mut largest) = (0.0f32, 0.0f32);
        for i in (0..base.len()).step_by(5) {
            let at = |offset: f32| {
                let mut moved = base.clone();
                moved[i] += offset;
                let moved =
                    Tensor::<1>::from_floats(moved.as_slice(), &device()).reshape([1, 1, 8, 12]);
                total(&moved).into_scalar::<f32>()
            };
            let numeric = (at(step) - at(-step)) / (2.0 * step);
            worst = worst.max((numeric - gradient[i]).abs());
            largest = largest.max(gradient[i].abs());
        }
        assert!(largest > 1e-4, "the gradient vanishes: {largest}");
        assert!(
            worst < 0.05 * largest,
            "worst {worst}, largest gradient {largest}"
        );
    }

    #[test]
    fn warping_by_a_whole_disparity_shifts_columns_and_masks_the_outside() {
        let (_, right, _) = scene();
        let d = Tensor::<4>::full([1, 1, 8, 12], 3.0, &device());
        let (warped, inside) = warp_right_to_left(&right, &d);
        let shifted = right.clone().narrow(3, 0, 9);
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
        let (left, _, _) = scene();
        let same = structural_dissimilarity(&left, &left)
            .max()
            .into_scalar::<f32>();
        assert!(same < 1e-5, "{same}");
        let opposite = structural_dissimilarity(&left, &(-left.clone() + 1.0))
            .mean()
            .into_scalar::<f32>();
        assert!(opposite > 0.5, "{opposite}");
    }

    #[test]
    fn smoothness_counts_disparity_edges_less_on_image_edges() {
        let device = device();
        let step = |height: f32| {
            let row: Vec<f32> = (0..12).map(|x| if x < 6 { 0.0 } else { height }).collect();
            Tensor::<1>::from_floats(row.as_slice(), &device)
                .reshape([1, 1, 1, 12])
                .repeat_dim(2, 8)
        };
        let disparity = step(0.5);
        let flat =
            edge_aware_smoothness(&step(0.0).repeat_dim(1, 3), &disparity).into_scalar::<f32>();
        let edge =
            edge_aware_smoothness(&step(0.3).repeat_dim(1, 3), &disparity).into_scalar::<f32>();
        // One of eleven differences is 0.5; the image step of 0.3 forgives it by exp(-3).
        assert!((flat - 0.5 / 11.0).abs() < 1e-6, "{flat}");
        assert!(
            (edge / flat - (-3.0f32).exp()).abs() < 1e-4,
            "{edge} {flat}"
        );
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
