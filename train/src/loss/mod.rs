//! The self-supervised loss of Hong 2021, eq. 1-5, and the supervised one, eq. 8; and what later work
//! found to help, each off unless asked for:
//!
//! | option | for | after |
//! |---|---|---|
//! | [`Loss::census`] | cameras of different exposure, vignetting, automatic gain | Meister 2018, UnFlow |
//! | [`Loss::second_order`] | ground that slants away, which eq. 4 pulls upright | Woodford 2009 |
//! | [`Loss::occlusion`] | rims of rocks, where one camera sees what the other does not | Godard 2017, Meister 2018 |
//! | [`Loss::symmetric`] | twice the comparisons out of a pair | Godard 2017 |
//! | [`Loss::neighbours`] | what the right camera does not see, the camera a moment later may | Godard 2019, Monodepth2 |
//! | [`Loss::proxies`] | a guide: images alone teach nothing where the first guess is pixels off | Tonioni 2017, Watson 2019 |
//!
//! The paper's eq. 4 repeats eq. 3 by mistake; what its text describes, edge-aware first differences of
//! the disparity (Godard 2017), is done here.

mod census;
mod known;
mod neighbour;
mod occlusion;
mod photometric;
mod smoothness;

pub use census::census_distance;
pub use known::{cross_entropy, smooth_l1, supervised};
pub use neighbour::{Neighbour, projection};
pub use occlusion::visible;
pub use photometric::{structural_dissimilarity, warp_right_to_left};
pub use smoothness::{edge_aware_smoothness, second_order_smoothness};

use std::fmt::{Display, Formatter};

use barchan_model::{Argmin, StereoNet};
use burn::module::Module;
use burn::tensor::Tensor;
use burn::tensor::ops::PadMode;
use serde::{Deserialize, Serialize};

use crate::{Batch, TrainError};

/// Weights of eq. 1, `L = a1 L_SSIM + a2 L_1 + a3 L_smooth + a4 L_0`, and its options.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Loss {
    /// Weight of the structural term, eq. 2.
    pub ssim: f32,
    /// Weight of the colour term, eq. 3.
    pub l1: f32,
    /// Weight of the smoothness term, eq. 4 as its text means it.
    pub smooth: f32,
    /// Weight of the disparity-magnitude term, eq. 5.
    pub magnitude: f32,
    /// Weight of the second-order smoothness.
    pub second_order: f32,
    /// Weight of the census term.
    pub census: f32,
    /// Leaves out pixels whose disparity the right image's contradicts by more than this, pixels. The
    /// network is run on the mirrored pair for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub occlusion: Option<f32>,
    /// The mirrored pair is judged too, and the loss is the mean of both.
    pub symmetric: bool,
    /// Left images this many frames before and after are compared too, through depth and known poses,
    /// and each pixel is left to the image that explains it best; 0 is off. Their pictures are all that
    /// is looked at, of held-out frames too.
    pub neighbours: usize,
    /// Weight of the distance (eq. 8) to disparity by semi-global matching, where left and right agree and
    /// it explains the image better than the network does. In pixels, where the other terms are shares:
    /// 0.01 helps, 0.1 already binds the network to the matcher's errors.
    pub proxies: f32,
    /// Weight of the cross-entropy of the distribution ([`cross_entropy`]) beside eq. 8, for supervised training. The mean
    /// is then taken around the peak, as at inference.
    pub distribution: f32,
}

impl Default for Loss {
    fn default() -> Self {
        Self {
            ssim: 0.8,
            l1: 0.2,
            smooth: 0.1,
            magnitude: 0.1,
            second_order: 0.0,
            census: 0.0,
            occlusion: None,
            symmetric: false,
            neighbours: 0,
            proxies: 0.0,
            distribution: 0.0,
        }
    }
}

/// The terms of eq. 1 and its options, each a mean over the pixels it can see, unweighted; those that
/// are off are absent.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LossTerms<T = f32> {
    /// Mean of (1 - SSIM) / 2, eq. 2.
    pub ssim: T,
    /// Mean absolute difference of colours, eq. 3.
    pub l1: T,
    /// Edge-aware smoothness of the disparity, as a share of the width per pixel.
    pub smooth: T,
    /// Mean disparity as a share of the width, eq. 5.
    pub magnitude: T,
    /// Second-order smoothness, as a share of the width per pixel.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub second_order: Option<T>,
    /// Mean census distance, 0 to 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub census: Option<T>,
    /// Smooth L1 to the disparity of semi-global matching where that is the better, else zero, pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub proxies: Option<T>,
    /// Share of the pixels inside the right image that pass the left-right check.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub visible: Option<T>,
    /// Share of the compared pixels that a neighbouring image explains best.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from_neighbours: Option<T>,
}

/// What the loss looks at. Images `[B, 3, H, W]` in 0..=1, disparities `[B, 1, H, W]` in pixels.
#[derive(Clone, Debug)]
pub struct View {
    /// The image that is to be explained.
    pub left: Tensor<4>,
    /// The image it is explained by.
    pub right: Tensor<4>,
    /// Disparity of `left`.
    pub disparity: Tensor<4>,
    /// The distribution that it is the mean of, where it is known.
    pub logits: Option<Tensor<4>>,
    /// Disparity of `right`, for the left-right check.
    pub right_disparity: Option<Tensor<4>>,
    /// Images of other times.
    pub neighbours: Vec<Neighbour>,
    /// Disparity known from elsewhere, and 1 where it is.
    pub proxies: Option<[Tensor<4>; 2]>,
}

impl View {
    /// A pair with nothing but its images.
    pub fn new(left: Tensor<4>, right: Tensor<4>, disparity: Tensor<4>) -> Self {
        Self {
            left,
            right,
            disparity,
            logits: None,
            right_disparity: None,
            neighbours: vec![],
            proxies: None,
        }
    }

    /// The network's opinion of a batch, with what `loss` needs to judge it. The right image's
    /// disparity is the network's for the mirrored pair: left and right swapped and flipped, so that
    /// disparities are positive again. It gets gradients, and a view of its own, only where the loss is
    /// symmetric.
    pub(crate) fn predict(net: &StereoNet, batch: &Batch, loss: &Loss) -> (Self, Option<Self>) {
        let (left, right) = (&batch.seen_left, &batch.seen_right);
        let argmin = match loss.distribution > 0.0 {
            true => Argmin::AroundPeak,
            false => Argmin::Everywhere,
        };
        let (disparity, logits, mirrored) = if loss.symmetric {
            let both = |a: &Tensor<4>, b: &Tensor<4>| Tensor::cat(vec![a.clone(), mirror(b)], 0);
            let prediction = net.forward_training(argmin, &both(left, right), &both(right, left));
            let halves = prediction.disparity.chunk(2, 0);
            (halves[0].clone(), None, Some(halves[1].clone()))
        } else {
            let mirrored = loss.occlusion.map(|_| {
                let [left, right] = [right, left].map(|image| mirror(image).inner());
                Tensor::from_inner(net.valid().forward(left, right).disparity)
            });
            let prediction = net.forward_training(argmin, left, right);
            (prediction.disparity, Some(prediction.logits), mirrored)
        };
        let right_disparity = mirrored.as_ref().filter(|_| loss.occlusion.is_some());
        let view = Self {
            left: batch.left.clone(),
            right: batch.right.clone(),
            right_disparity: right_disparity.map(mirror),
            neighbours: batch.neighbours.clone(),
            proxies: batch.proxies.clone(),
            disparity,
            logits,
        };
        let other = mirrored.filter(|_| loss.symmetric).map(|mirrored| Self {
            right_disparity: loss.occlusion.map(|_| mirror(&view.disparity)),
            ..Self::new(mirror(&batch.right), mirror(&batch.left), mirrored)
        });
        (view, other)
    }
}

/// One image warped onto the one it is to explain: how far it is off, term by term, and where it can be
/// compared at all.
struct Comparison {
    ssim: Tensor<4>,
    l1: Tensor<4>,
    census: Option<Tensor<4>>,
    seen: Tensor<4>,
    /// 1 where a neighbouring image was the better one.
    from_neighbours: Option<Tensor<4>>,
}

impl Loss {
    /// Refuses weights that are none, and options that would have no effect.
    ///
    /// # Errors
    /// Says which field and what it should be.
    pub fn check(&self, supervised: bool) -> Result<(), TrainError> {
        let weights = [
            ("ssim", self.ssim),
            ("l1", self.l1),
            ("smooth", self.smooth),
            ("magnitude", self.magnitude),
            ("second_order", self.second_order),
            ("census", self.census),
            ("proxies", self.proxies),
            ("distribution", self.distribution),
            ("occlusion", self.occlusion.unwrap_or(0.0)),
        ];
        for (name, weight) in weights {
            if !(weight.is_finite() && weight >= 0.0) {
                return Err(TrainError::Config(format!(
                    "loss: {name} is {weight}, and must be zero or above"
                )));
            }
        }
        if !supervised && self.distribution > 0.0 {
            return Err(TrainError::Config(
                "loss: distribution has no effect without true disparity\n  cure: add --supervised, or leave it away".into(),
            ));
        }
        let costly =
            self.occlusion.is_some() || self.symmetric || self.neighbours > 0 || self.proxies > 0.0;
        if supervised && costly {
            return Err(TrainError::Config(
                "loss: occlusion, symmetric, neighbours and proxies have no effect with true disparity\n  cure: leave them or --supervised away".into(),
            ));
        }
        Ok(())
    }

    /// Eq. 8, with the cross-entropy of the distribution where that is asked for.
    pub fn supervised(&self, view: &View, truth: &Tensor<4>, known: &Tensor<4>) -> Tensor<1> {
        let loss = supervised(&view.disparity, truth, known);
        match &view.logits {
            Some(logits) if self.distribution > 0.0 => {
                loss + cross_entropy(logits, truth, known) * self.distribution
            }
            _ => loss,
        }
    }

    /// The photometric part, `a1 L_SSIM + a2 L_1` and the weighted census term where that is on.
    pub fn photometric(&self, terms: &LossTerms) -> f32 {
        self.ssim * terms.ssim + self.l1 * terms.l1 + self.census * terms.census.unwrap_or(0.0)
    }

    /// Eq. 1 with its options, the mean of the views that are given; and its terms.
    pub fn self_supervised(
        &self,
        view: &View,
        mirrored: Option<&View>,
    ) -> (Tensor<1>, LossTerms<Tensor<1>>) {
        let mut terms = self.judge(view);
        if let Some(mirrored) = mirrored {
            terms = terms.mean(self.judge(mirrored));
        }
        (self.total(&terms), terms)
    }

    /// The terms for one view.
    ///
    /// Pixels whose match falls outside the right image cannot be judged and are left out of the
    /// photometric terms, and of the magnitude term too: with nothing to hold against it, that one
    /// would draw the whole left border to infinity. The same holds for what the left-right check
    /// refuses. Disparity enters eq. 4 and 5 as a share of the image's width (as Godard 2017 has it): in
    /// pixels the paper's weights would let the magnitude term outweigh the images.
    fn judge(&self, view: &View) -> LossTerms<Tensor<1>> {
        let (warped, inside) = warp_right_to_left(&view.right, &view.disparity);
        let visible = match (self.occlusion, &view.right_disparity) {
            (Some(limit), Some(right)) => Some(visible(&view.disparity, right, limit)),
            _ => None,
        };
        let seen = match &visible {
            Some(visible) => inside.clone() * visible.clone(),
            None => inside.clone(),
        };
        let mut best = self.compare(&view.left, &warped, &view.right, seen);
        let proxies = view.proxies.as_ref().map(|[proxy, known]| {
            // A proxy is a hint (Watson 2019, eq. 4): it holds where it explains the image better than
            // the network does, and lets go where the network has become the finer of the two.
            let (warped, inside) = warp_right_to_left(&view.right, proxy);
            let hint = self.compare(&view.left, &warped, &view.right, inside);
            let better = self.error(&hint).lower_equal(self.error(&best)).float();
            masked_mean(smooth_l1(&view.disparity, proxy) * better, known.clone())
        });
        for neighbour in &view.neighbours {
            let (warped, seen) = neighbour.warp(&view.disparity);
            let other = self.compare(&view.left, &warped, &neighbour.image, seen);
            best = self.better(best, other);
        }

        let share = view.disparity.clone() / view.disparity.dims()[3] as f32;
        let mean = |x: Tensor<4>, reach| masked_mean(x, shrink(&best.seen, reach));
        LossTerms {
            ssim: mean(best.ssim, 1),
            l1: mean(best.l1, 0),
            smooth: edge_aware_smoothness(&view.left, &share),
            magnitude: mean(share.clone().abs(), 0),
            second_order: (self.second_order > 0.0)
                .then(|| second_order_smoothness(&view.left, &share)),
            census: best.census.map(|census| mean(census, census::REACH)),
            proxies,
            visible: visible.map(|visible| masked_mean(visible, inside)),
            from_neighbours: best.from_neighbours.map(|from| mean(from, 0)),
        }
    }

    fn compare(
        &self,
        left: &Tensor<4>,
        warped: &Tensor<4>,
        like: &Tensor<4>,
        seen: Tensor<4>,
    ) -> Comparison {
        Comparison {
            ssim: structural_dissimilarity(left, warped),
            l1: (left.clone() - warped.clone()).abs(),
            census: (self.census > 0.0).then(|| census_distance(left, warped, like)),
            seen,
            from_neighbours: None,
        }
    }

    /// The weighted photometric error of each pixel, `[B, 1, H, W]`, without gradient.
    fn error(&self, of: &Comparison) -> Tensor<4> {
        // A windowed term knows nothing of the border: the next pixel stands for it.
        let grow = |x: &Tensor<4>, by: usize| {
            x.clone()
                .detach()
                .mean_dim(1)
                .pad((by, by, by, by), PadMode::Edge)
        };
        let error = grow(&of.ssim, 1) * self.ssim + grow(&of.l1, 0) * self.l1;
        let error = match &of.census {
            Some(census) => error + grow(census, census::REACH) * self.census,
            None => error,
        };
        // Beyond any error of what is seen.
        error + (-of.seen.clone() + 1.0) * 1e6
    }

    /// Pixel by pixel the comparison whose error is less (Godard 2019, eq. 4); `b` is of a neighbouring
    /// image.
    fn better(&self, a: Comparison, b: Comparison) -> Comparison {
        let b_is_better = self.error(&b).lower(self.error(&a)).float();
        let choose = |a: Tensor<4>, b: Tensor<4>, reach| {
            let b_is_better = shrink(&b_is_better, reach);
            a.clone() + (b - a) * b_is_better
        };
        let from = a.from_neighbours.unwrap_or_else(|| a.seen.zeros_like());
        Comparison {
            ssim: choose(a.ssim, b.ssim, 1),
            l1: choose(a.l1, b.l1, 0),
            census: (a.census.zip(b.census)).map(|(a, b)| choose(a, b, census::REACH)),
            from_neighbours: Some(choose(from, b.seen.ones_like(), 0)),
            seen: choose(a.seen, b.seen, 0),
        }
    }

    fn total(&self, terms: &LossTerms<Tensor<1>>) -> Tensor<1> {
        let paper = terms.ssim.clone() * self.ssim
            + terms.l1.clone() * self.l1
            + terms.smooth.clone() * self.smooth
            + terms.magnitude.clone() * self.magnitude;
        [
            (&terms.second_order, self.second_order),
            (&terms.census, self.census),
            (&terms.proxies, self.proxies),
        ]
        .into_iter()
        .fold(paper, |sum, (term, weight)| match term {
            Some(term) => sum + term.clone() * weight,
            None => sum,
        })
    }
}

impl LossTerms<Tensor<1>> {
    /// The numbers, off the device.
    pub fn values(&self) -> LossTerms {
        let read = |t: &Tensor<1>| t.clone().into_scalar::<f32>();
        LossTerms {
            ssim: read(&self.ssim),
            l1: read(&self.l1),
            smooth: read(&self.smooth),
            magnitude: read(&self.magnitude),
            second_order: self.second_order.as_ref().map(read),
            census: self.census.as_ref().map(read),
            proxies: self.proxies.as_ref().map(read),
            visible: self.visible.as_ref().map(read),
            from_neighbours: self.from_neighbours.as_ref().map(read),
        }
    }

    /// Term by term; what only one view has is kept.
    fn mean(self, other: Self) -> Self {
        let mean = |a: Tensor<1>, b: Tensor<1>| (a + b) * 0.5;
        let either = |a: Option<Tensor<1>>, b: Option<Tensor<1>>| match (a, b) {
            (Some(a), Some(b)) => Some(mean(a, b)),
            (a, b) => a.or(b),
        };
        LossTerms {
            ssim: mean(self.ssim, other.ssim),
            l1: mean(self.l1, other.l1),
            smooth: mean(self.smooth, other.smooth),
            magnitude: mean(self.magnitude, other.magnitude),
            second_order: either(self.second_order, other.second_order),
            census: either(self.census, other.census),
            proxies: either(self.proxies, other.proxies),
            visible: either(self.visible, other.visible),
            from_neighbours: either(self.from_neighbours, other.from_neighbours),
        }
    }
}

impl Display for LossTerms {
    /// `ssim 0.1234  l1 0.0345 ...`, without those that are off.
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        let options = [
            ("second order", self.second_order),
            ("census", self.census),
            ("proxies", self.proxies),
            ("visible", self.visible),
            ("from neighbours", self.from_neighbours),
        ];
        let Self {
            ssim,
            l1,
            smooth,
            magnitude,
            ..
        } = self;
        write!(
            f,
            "ssim {ssim:.4}  l1 {l1:.4}  smooth {smooth:.4}  magnitude {magnitude:.4}"
        )?;
        for (name, value) in options {
            if let Some(value) = value {
                write!(f, "  {name} {value:.4}")?;
            }
        }
        Ok(())
    }
}

/// Swaps left and right of every image.
fn mirror(images: &Tensor<4>) -> Tensor<4> {
    images.clone().flip([3])
}

/// Mean of `x` over the pixels where `mask` (one channel) is 1; 0 where there are none.
fn masked_mean(x: Tensor<4>, mask: Tensor<4>) -> Tensor<1> {
    let channels = x.dims()[1] as f32;
    (x * mask.clone()).sum() / (mask.sum() * channels + 1e-6)
}

/// A mask without its outermost pixels, as a window that reaches `by` leaves.
fn shrink(mask: &Tensor<4>, by: usize) -> Tensor<4> {
    let [_, _, h, w] = mask.dims();
    mask.clone()
        .narrow(2, by, h - 2 * by)
        .narrow(3, by, w - 2 * by)
}

#[cfg(test)]
mod checks;
#[cfg(test)]
mod tests;
