//! From logits to disparity: soft-argmin (Kendall 2017) and learned convex up-sampling (Teed 2020).

use burn::module::Module;
use burn::nn::conv::Conv2d;
use burn::tensor::Device;

use crate::features::{conv1x1, conv3x3};
use crate::ops::NEIGHBOURS;
use crate::refinement::Refinement;
use crate::{Kernel, Ops, Prediction};

/// The volume stands at this fraction of the resolution, so a bin is this many pixels.
pub const SCALE: usize = 4;

const SUBPIXELS: usize = SCALE * SCALE;

/// Which bins the mean is taken over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Argmin {
    /// All: every bin gets a gradient. For training on images alone.
    Everywhere,
    /// Two on either side of the most probable one: a second peak does not draw the mean into the empty
    /// space between. For inference, and for training where the distribution has a loss of its own.
    AroundPeak,
}

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
            mix: conv1x1([hidden, NEIGHBOURS * SUBPIXELS], device),
        }
    }

    /// Disparity, standard deviation (pixels) and confidence at full resolution `[B, 1, 4h, 4w]`
    /// from logits `[B, bins, h, w]`, near to far, and the left image's features `[B, context, h, w]`;
    /// refined on the way where there is a `refinement`.
    pub fn forward<O: Ops>(
        &self,
        ops: &mut O,
        bins: usize,
        argmin: Argmin,
        logits: &O::Map,
        context: &O::Map,
        refinement: Option<&Refinement>,
    ) -> Prediction<O::Map> {
        let coarse = moments(ops, bins, argmin, logits);
        let (coarse, context) = match refinement {
            Some(refinement) => refinement.forward(ops, &coarse, context),
            None => (coarse.as_channels(ops), context.clone()),
        };

        let hidden = ops.conv2d("regression.look", &self.look, &context);
        let hidden = ops.relu(&hidden);
        let mix = ops.conv2d("regression.mix", &self.mix, &hidden);
        // Positive weights over their sum. Far below zero a sigmoid is an exponential, so this chooses as a
        // softmax does, and it joins the convolution before it.
        let weights = ops.sigmoid(&mix);
        let fine =
            ops.mean_of_neighbours("regression.mean", SUBPIXELS, 1, &weights, MOMENTS, &coarse);
        let fine = ops.depth_to_space(SCALE, &fine);
        let [mean, square, confidence] = ops.split_channels(&fine);

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
            logits: logits.clone(),
            disparity: ops.affine(SCALE as f32, 0.0, &mean),
            sigma: ops.affine(SCALE as f32, 0.0, &sigma),
            confidence,
        }
    }
}

/// Of the distribution at every coarse pixel, in bins.
#[derive(Clone)]
pub(crate) struct Moments<M> {
    pub mean: M,
    /// Second moment about zero, of a distribution of that mean and of the whole distribution's spread about it.
    pub square: M,
    /// Probability near the peak, or near the mean.
    pub confidence: M,
}

/// How many [`Moments`] there are.
pub(crate) const MOMENTS: usize = 3;

impl<M: Clone> Moments<M> {
    pub fn as_channels<O: Ops<Map = M>>(&self, ops: &mut O) -> M {
        ops.concat(&[
            self.mean.clone(),
            self.square.clone(),
            self.confidence.clone(),
        ])
    }
}

fn moments<O: Ops>(ops: &mut O, bins: usize, argmin: Argmin, logits: &O::Map) -> Moments<O::Map> {
    // Not normalised: ratios of sums need no division of every bin.
    let largest = ops.channel_max(logits);
    let below = ops.sub(logits, &largest);
    let likelihood = ops.exp(&below);
    // Near to far: the first bin holds the largest disparity.
    let moment = |ops: &mut O, name: &str, power: i32, x: &O::Map| {
        let kernel = Kernel::from_fn([1, bins, 1, 1], |_, k, _, _| {
            ((bins - 1 - k) as f32).powi(power)
        });
        ops.fixed_conv2d(&format!("regression.{name}"), &kernel, 1, x)
    };
    let total = moment(ops, "total", 0, &likelihood);
    let first = moment(ops, "first", 1, &likelihood);
    let first = ops.div(&first, &total);
    let second = moment(ops, "second", 2, &likelihood);
    let second = ops.div(&second, &total);

    let centre = match argmin {
        Argmin::Everywhere => ops.affine(-1.0, (bins - 1) as f32, &first),
        Argmin::AroundPeak => ops.channel_argmax(logits),
    };
    // 1 within a bin and a half of the centre, 0 from two and a half on.
    let index: Vec<f32> = (0..bins).map(|k| k as f32).collect();
    let index = ops.channel_constant("regression.bins", &index);
    let offset = ops.sub(&index, &centre);
    let distance = ops.abs(&offset);
    let window = ops.affine(-1.0, 2.5, &distance);
    let window = ops.clamp(0.0, 1.0, &window);
    let inside = ops.mul(&likelihood, &window);
    let near = moment(ops, "near", 0, &inside);
    let confidence = ops.div(&near, &total);
    let mean = match argmin {
        Argmin::Everywhere => {
            return Moments {
                mean: first,
                square: second,
                confidence,
            };
        }
        Argmin::AroundPeak => {
            let near_first = moment(ops, "near_first", 1, &inside);
            ops.div(&near_first, &near)
        }
    };
    // E (k - mean)^2 + mean^2 = E k^2 + 2 mean (mean - E k).
    let off = ops.sub(&mean, &first);
    let off = ops.mul(&mean, &off);
    let off = ops.affine(2.0, 0.0, &off);
    Moments {
        square: ops.add(&second, &off),
        mean,
        confidence,
    }
}
