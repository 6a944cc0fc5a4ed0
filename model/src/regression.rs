//! From probabilities to disparity: soft-argmin (Kendall 2017) and learned convex up-sampling
//! (Teed 2020).

use burn::module::Module;
use burn::nn::conv::{Conv2d, Conv2dConfig};
use burn::tensor::Device;

use crate::features::conv3x3;
use crate::{Kernel, Ops, Prediction};

/// The volume stands at this fraction of the resolution, so a bin is this many pixels.
pub const SCALE: usize = 4;

const NEIGHBOURS: usize = 9;
const SUBPIXELS: usize = SCALE * SCALE;

/// Up-samples by mixing the 3x3 coarse neighbours with weights learned from the image.
#[derive(Module, Debug)]
pub struct Regression {
    look: Conv2d,
    mix: Conv2d,
}

impl Regression {
    /// `context` channels come in; `hidden` are used.
    pub fn init(context: usize, hidden: usize, device: &Device) -> Self {
        Self {
            look: conv3x3([context, hidden], 1, device),
            mix: Conv2dConfig::new([hidden, NEIGHBOURS * SUBPIXELS], [1, 1]).init(device),
        }
    }

    /// Disparity, standard deviation (pixels) and confidence at full resolution `[B, 1, 4h, 4w]`
    /// from logits `[B, bins, h, w]`.
    pub fn forward<O: Ops>(
        &self,
        ops: &mut O,
        bins: usize,
        logits: &O::Map,
        context: &O::Map,
    ) -> Prediction<O::Map> {
        let probability = ops.softmax(logits);
        let mean = self.expectation(ops, "mean", bins, &probability, |k| k);
        let square = self.expectation(ops, "square", bins, &probability, |k| k * k);
        let confidence = mass_around(ops, bins, &probability, &mean);

        let hidden = ops.conv2d("regression.look", &self.look, context);
        let hidden = ops.relu(&hidden);
        let logits = ops.conv2d("regression.mix", &self.mix, &hidden);
        // exp over its sum is a softmax without a reduction over a strided axis; the clamp keeps it finite.
        let logits = ops.clamp(-12.0, 12.0, &logits);
        let weights = ops.exp(&logits);
        let sum = Kernel::from_fn([SUBPIXELS, NEIGHBOURS * SUBPIXELS, 1, 1], |s, c, _, _| {
            f32::from(c % SUBPIXELS == s)
        });
        let total = ops.fixed_conv2d("regression.total", &sum, 1, &weights);
        let neighbours = Kernel::from_fn([NEIGHBOURS * SUBPIXELS, 1, 3, 3], |c, _, y, x| {
            f32::from(c / SUBPIXELS == 3 * y + x)
        });
        let up_sample = |ops: &mut O, name: &str, x: &O::Map| {
            let padded = ops.pad_edge(1, x);
            let around = ops.fixed_conv2d(
                &format!("regression.{name}.around"),
                &neighbours,
                1,
                &padded,
            );
            let weighted = ops.mul(&weights, &around);
            let mixed = ops.fixed_conv2d(&format!("regression.{name}.mix"), &sum, 1, &weighted);
            let mixed = ops.div(&mixed, &total);
            ops.depth_to_space(SCALE, &mixed)
        };
        let mean = up_sample(ops, "mean", &mean);
        let square = up_sample(ops, "square", &square);
        let confidence = up_sample(ops, "confidence", &confidence);

        // The mixed moments are those of the mixed distribution, so their variance includes the
        // disagreement of the neighbours. A certain answer between two bins needs both, a share f of
        // the upper one, and so has a variance of f (1 - f) that says nothing of doubt: it is taken
        // off. The floor is a twentieth of a pixel.
        let mean2 = ops.mul(&mean, &mean);
        let variance = ops.sub(&square, &mean2);
        let whole = ops.floor(&mean);
        let share = ops.sub(&mean, &whole);
        let rest = ops.affine(-1.0, 1.0, &share);
        let between = ops.mul(&share, &rest);
        let variance = ops.sub(&variance, &between);
        let variance = ops.clamp(1.5e-4, f32::MAX, &variance);
        let sigma = ops.sqrt(&variance);
        Prediction {
            disparity: ops.affine(SCALE as f32, 0.0, &mean),
            sigma: ops.affine(SCALE as f32, 0.0, &sigma),
            confidence,
        }
    }

    fn expectation<O: Ops>(
        &self,
        ops: &mut O,
        name: &str,
        bins: usize,
        p: &O::Map,
        value: impl Fn(f32) -> f32,
    ) -> O::Map {
        let kernel = Kernel::from_fn([1, bins, 1, 1], |_, k, _, _| value(k as f32));
        ops.fixed_conv2d(&format!("regression.{name}"), &kernel, 1, p)
    }
}

/// The probability within one bin of the mean, with a linear shoulder to two bins: 1 when the
/// distribution has one narrow peak, small when it is flat or has two.
fn mass_around<O: Ops>(ops: &mut O, bins: usize, probability: &O::Map, mean: &O::Map) -> O::Map {
    let index: Vec<f32> = (0..bins).map(|k| k as f32).collect();
    let index = ops.channel_constant("regression.bins", &index);
    let offset = ops.sub(&index, mean);
    let distance = ops.abs(&offset);
    let window = ops.affine(-1.0, 2.0, &distance);
    let window = ops.clamp(0.0, 1.0, &window);
    let inside = ops.mul(probability, &window);
    let sum = Kernel::from_fn([1, bins, 1, 1], |_, _, _, _| 1.0);
    ops.fixed_conv2d("regression.confidence", &sum, 1, &inside)
}
