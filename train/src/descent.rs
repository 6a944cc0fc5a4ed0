use barchan_model::StereoNet;
use burn::optim::{AdamConfig, GradientsParams, ModuleOptimizer};
use burn::tensor::Tensor;

use crate::loss::{Loss, LossTerms, View};
use crate::{Batch, TrainError, gradients};

/// A network and the optimiser that changes it.
pub(crate) struct Descent {
    pub net: StereoNet,
    pub optimizer: ModuleOptimizer,
}

/// What a step found.
pub(crate) struct Found {
    pub loss: f32,
    pub terms: LossTerms,
    /// Euclidean norm of the whole gradient, before it was clipped.
    pub gradient: f32,
}

/// What is no number.
pub(crate) struct NotFinite {
    pub what: &'static str,
    pub value: f32,
}

impl NotFinite {
    pub fn error(self, step: usize, frames: &str) -> TrainError {
        TrainError::NotFinite {
            step,
            what: self.what,
            value: self.value,
            frames: frames.to_owned(),
        }
    }
}

/// Refuses a value that is no number.
pub(crate) fn number(what: &'static str, value: f32) -> Result<f32, NotFinite> {
    match value.is_finite() {
        true => Ok(value),
        false => Err(NotFinite { what, value }),
    }
}

impl Descent {
    /// `net` is on an autodiff device.
    pub fn new(net: StereoNet) -> Self {
        // Clipping is done here, over all weights together: Burn's own is layer by layer.
        let optimizer = AdamConfig::new()
            .with_beta_1(0.9)
            .with_beta_2(0.999)
            .with_epsilon(1e-8)
            .init();
        Self { net, optimizer }
    }

    /// Figure 4 of Hong 2021: predict, compare by warping (or with the truth of the batch, where `supervised`),
    /// follow the gradient, clipped to the norm `clip`.
    pub fn step(
        &mut self,
        batch: &Batch,
        loss: &Loss,
        supervised: bool,
        clip: f32,
        lr: f64,
    ) -> Result<Found, NotFinite> {
        let (mut view, mirrored) = View::predict(&self.net, batch, loss);
        // What the network cannot say it is not asked.
        let most = (self.net.config().max_disparity - 2) as f32;
        let reachable = |[d, known]: &[Tensor<4>; 2]| {
            let known = known.clone() * d.clone().lower_equal_scalar(most).float();
            [d.clone(), known]
        };
        view.proxies = view.proxies.as_ref().map(reachable);
        let (total, terms) = loss.self_supervised(&view, mirrored.as_ref());
        let total = match batch.truth.as_ref().filter(|_| supervised) {
            Some(truth) => {
                let [truth, known] = reachable(truth);
                loss.supervised(&view, &truth, &known)
            }
            None => total,
        };
        let value = number("the loss", total.clone().into_scalar::<f32>())?;
        let mut gradients = GradientsParams::from_grads(total.backward(), &self.net);
        let norm = gradients::clip(&mut gradients, &self.net, clip);
        number("the gradient", norm)?;
        self.net = self.optimizer.step(lr, self.net.clone(), gradients);
        Ok(Found {
            loss: value,
            terms: terms.values(),
            gradient: norm,
        })
    }
}
