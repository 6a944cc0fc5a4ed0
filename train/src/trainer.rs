use std::sync::Arc;
use std::time::Instant;

use barchan_datasets::{StereoSource, prefetch};
use barchan_model::{Device, NetConfig, StereoNet};
use burn::module::Module;
use burn::optim::grad_clipping::GradientClippingConfig;
use burn::optim::{AdamConfig, GradientsParams, ModuleOptimizer};
use burn::tensor::Tensor;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::batch::Sample;
use crate::loss::{self, Loss, View};
use crate::pool::Pool;
use crate::{Augmentation, Batch, LogLine, RunDir, TrainError};

/// Where training runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DeviceName {
    /// Burn's own CPU kernels: the default.
    Flex,
    /// The `ndarray` crate on the CPU: slower, a second opinion.
    Ndarray,
}

impl DeviceName {
    /// The device, without gradients.
    pub fn device(self) -> Device {
        match self {
            Self::Flex => Device::flex(),
            // Deprecated in 0.22, whose version is pinned; wanted as a second opinion.
            #[allow(deprecated)]
            Self::Ndarray => Device::ndarray(),
        }
    }
}

/// How long and how fast.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Schedule {
    /// Passes over the data.
    pub epochs: usize,
    /// Learning rate.
    pub lr: f64,
    /// The learning rate is divided by ten from this epoch on.
    pub drop_epoch: usize,
    /// Stops after this many steps, where that is sooner.
    pub steps: Option<usize>,
}

impl Schedule {
    /// From nothing: 10 epochs at 1e-3, the last three at 1e-4 (Hong 2021, 4.2.1).
    pub const PRETRAIN: Self = Self {
        epochs: 10,
        lr: 1e-3,
        drop_epoch: 7,
        steps: None,
    };
    /// From weights: one epoch at 1e-4 (Hong 2021, 4.2.1).
    pub const FINETUNE: Self = Self {
        epochs: 1,
        lr: 1e-4,
        drop_epoch: usize::MAX >> 1,
        steps: None,
    };
}

/// Everything that decides a run; written to `config.toml`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// The data, as given.
    pub data: Vec<String>,
    /// The weights started from; none is a random network.
    pub init: Option<String>,
    /// Where training runs.
    pub device: DeviceName,
    /// Seeds the network, the order of frames, crops and augmentation.
    pub seed: u64,
    /// Trains against true disparity (eq. 8) instead of the images alone.
    pub supervised: bool,
    /// Pairs a step.
    pub batch: usize,
    /// Height and width of the crops, pixels.
    pub crop: [usize; 2],
    /// Steps between checkpoints.
    pub checkpoint_every: usize,
    /// The network.
    pub net: NetConfig,
    /// How long and how fast.
    pub schedule: Schedule,
    /// Weights of eq. 1, and its options.
    pub loss: Loss,
    /// What is done to the images that the network sees.
    pub augmentation: Augmentation,
}

impl TrainConfig {
    /// Refuses what cannot be trained.
    ///
    /// # Errors
    /// Says which field and what it should be.
    pub fn check(&self) -> Result<(), TrainError> {
        let refuse = |message: &str| Err(TrainError::Config(message.into()));
        self.net.check()?;
        self.loss.check(self.supervised)?;
        if self.batch == 0 || self.checkpoint_every == 0 || self.schedule.epochs == 0 {
            return refuse("batch, checkpoint_every and epochs must be at least 1");
        }
        if self.crop.iter().any(|n| *n < 32) {
            return refuse("a crop must be at least 32 x 32 pixels");
        }
        if !(self.schedule.lr.is_finite() && self.schedule.lr > 0.0) {
            return refuse("the learning rate must be above zero");
        }
        Ok(())
    }
}

/// How well held-out pairs are explained.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Validation {
    /// How many pairs were held out.
    pub frames: usize,
    /// The photometric part of the loss, `a1 L_SSIM + a2 L_1` and the weighted census term where that
    /// is on, mean over pairs; whole images, without options that choose pixels.
    pub photometric: f32,
    /// Mean (1 - SSIM) / 2.
    pub ssim: f32,
    /// Mean absolute difference.
    pub l1: f32,
    /// Mean census distance, where that is part of the loss.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub census: Option<f32>,
}

/// What a checkpoint remembers beside weights and optimiser.
#[derive(Serialize, Deserialize)]
struct State {
    before: Option<Validation>,
}

/// Runs the schedule. Its private `step` is figure 4 of the paper.
pub struct Trainer {
    config: TrainConfig,
    run: RunDir,
    device: Device,
    pool: Arc<Pool>,
    net: StereoNet,
    optimizer: ModuleOptimizer,
    training: Vec<usize>,
    held_out: Vec<usize>,
    /// Steps done.
    step: usize,
    before: Option<Validation>,
}

impl Trainer {
    /// A new run in `root`, from `init` (on the autodiff form of the configured device) or from a
    /// random network.
    ///
    /// # Errors
    /// When the configuration is refused, or the run directory holds a run already.
    pub fn create(
        root: &std::path::Path,
        config: TrainConfig,
        sources: Vec<Box<dyn StereoSource>>,
        init: Option<StereoNet>,
    ) -> Result<Self, TrainError> {
        config.check()?;
        // What cannot be trained on leaves no run behind.
        let pool = Pool::new(sources, &config)?;
        let mut trainer = Self::prepare(RunDir::create(root, &config)?, config, pool)?;
        if let Some(init) = init {
            trainer.net = init;
        }
        Ok(trainer)
    }

    /// Goes on with the run in `root` from its last checkpoint. `sources` are those of its configuration.
    ///
    /// # Errors
    /// When there is no run, or its checkpoint is damaged.
    pub fn resume(
        root: &std::path::Path,
        sources: Vec<Box<dyn StereoSource>>,
        init: Option<StereoNet>,
    ) -> Result<Self, TrainError> {
        let (run, config) = RunDir::open(root)?;
        config.check()?;
        let pool = Pool::new(sources, &config)?;
        let mut trainer = Self::prepare(run, config, pool)?;
        if let Some(init) = init {
            trainer.net = init;
        }
        let (net, optimizer, state) = trainer
            .run
            .restore::<State>(trainer.net, trainer.optimizer)?;
        (trainer.net, trainer.optimizer) = (net, optimizer);
        if let Some((step, state)) = state {
            (trainer.step, trainer.before) = (step, state.before);
        }
        Ok(trainer)
    }

    fn prepare(run: RunDir, config: TrainConfig, pool: Pool) -> Result<Self, TrainError> {
        let (training, held_out) = split(pool.len());
        let device = config.device.device().autodiff();
        let net = StereoNet::init(&config.net, config.seed, &device)?;
        let optimizer = AdamConfig::new()
            .with_epsilon(1e-8)
            .with_grad_clipping(Some(GradientClippingConfig::Norm(1.0)))
            .init();
        Ok(Self {
            config,
            run,
            device,
            pool: Arc::new(pool),
            net,
            optimizer,
            training,
            held_out,
            step: 0,
            before: None,
        })
    }

    /// The network as it stands.
    pub fn net(&self) -> &StereoNet {
        &self.net
    }

    /// The configuration.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// How many steps are done, and how many there are.
    pub fn progress(&self) -> (usize, usize) {
        let all = self.steps_per_epoch() * self.config.schedule.epochs;
        (
            self.step,
            all.min(self.config.schedule.steps.unwrap_or(usize::MAX)),
        )
    }

    /// Held-out pairs before the first step and after the last. Trains in between, telling
    /// `on_step` of every step.
    ///
    /// # Errors
    /// When data cannot be read, the run directory not written, or the loss is no number.
    pub fn run(
        &mut self,
        mut on_step: impl FnMut(&LogLine),
    ) -> Result<(Validation, Validation), TrainError> {
        let before = match self.before {
            Some(before) => before,
            None => self.validate()?,
        };
        self.before = Some(before);
        let (_, total) = self.progress();
        let ahead = 2 * self.config.batch;
        while self.step < total {
            let epoch = self.step / self.steps_per_epoch();
            let order = self.epoch_order(epoch);
            let rest = order[(self.step % self.steps_per_epoch()) * self.config.batch..].to_vec();
            let mut read = self.pool.prefetch(rest, ahead);
            while self.step < total && self.step / self.steps_per_epoch() == epoch {
                let samples: Vec<Sample> = read
                    .by_ref()
                    .take(self.config.batch)
                    .collect::<Result<_, _>>()?;
                if samples.is_empty() {
                    break;
                }
                let line = self.step(&samples, epoch)?;
                self.run.log(&line)?;
                on_step(&line);
                if self.step.is_multiple_of(self.config.checkpoint_every) || self.step == total {
                    self.checkpoint()?;
                }
            }
        }
        let after = self.validate()?;
        Ok((before, after))
    }

    /// One step: crop and augment, predict, compare by warping, follow the gradient.
    fn step(&mut self, samples: &[Sample], epoch: usize) -> Result<LogLine, TrainError> {
        let started = Instant::now();
        let mut rng = self.rng(2 * self.step as u64 + 1);
        let batch = Batch::crop(
            samples,
            self.config.crop,
            Some(&self.config.augmentation),
            &mut rng,
            &self.device,
        );

        let (mut view, mirrored) = View::predict(&self.net, &batch, &self.config.loss);
        // What the network cannot say it is not asked.
        let most = (self.config.net.max_disparity - 2) as f32;
        let reachable =
            |[d, known]: [Tensor<4>; 2]| [d.clone(), known * d.lower_equal_scalar(most).float()];
        view.proxies = view.proxies.map(reachable);
        let (total, terms) = self.config.loss.self_supervised(&view, mirrored.as_ref());
        let total = match (batch.truth.map(reachable), self.config.supervised) {
            (Some([truth, known]), true) => loss::supervised(&view.disparity, &truth, &known),
            (None, true) => {
                return Err(TrainError::Config(format!(
                    "--supervised: {} has no true disparity",
                    batch.names
                )));
            }
            (_, false) => total,
        };
        let value = total.clone().into_scalar::<f32>();
        if !value.is_finite() {
            return Err(TrainError::NotFinite {
                step: self.step + 1,
                loss: value,
                frames: batch.names,
            });
        }
        let gradients = GradientsParams::from_grads(total.backward(), &self.net);
        let lr = self.lr(epoch);
        self.net = self.optimizer.step(lr, self.net.clone(), gradients);
        self.step += 1;

        Ok(LogLine {
            step: self.step,
            epoch,
            lr,
            loss: value,
            terms: terms.values(),
            seconds: started.elapsed().as_secs_f64(),
        })
    }

    /// The photometric loss over whole held-out pairs.
    ///
    /// # Errors
    /// When a pair cannot be read.
    pub fn validate(&self) -> Result<Validation, TrainError> {
        let net = self.net.valid();
        let device = self.device.clone().inner();
        let (mut ssim, mut l1, mut census) = (0.0, 0.0, 0.0);
        for frame in prefetch(self.pool.clone(), self.held_out.clone(), 2) {
            let [left, right]: [Tensor<4>; 2] = Batch::whole(&frame?, &device);
            let disparity = net.forward(left.clone(), right.clone()).disparity;
            let view = View::new(left, right, disparity);
            let (_, terms) = self.config.loss.self_supervised(&view, None);
            let terms = terms.values();
            ssim += terms.ssim;
            l1 += terms.l1;
            census += terms.census.unwrap_or(0.0);
        }
        let n = self.held_out.len() as f32;
        let (ssim, l1, census) = (ssim / n, l1 / n, census / n);
        let weights = &self.config.loss;
        Ok(Validation {
            frames: self.held_out.len(),
            photometric: weights.ssim * ssim + weights.l1 * l1 + weights.census * census,
            ssim,
            l1,
            census: (weights.census > 0.0).then_some(census),
        })
    }

    fn checkpoint(&self) -> Result<(), TrainError> {
        self.run.checkpoint(
            self.step,
            &self.net,
            &self.optimizer,
            &State {
                before: self.before,
            },
        )
    }

    /// The run directory.
    pub fn run_dir(&self) -> &RunDir {
        &self.run
    }

    fn steps_per_epoch(&self) -> usize {
        self.training.len().div_ceil(self.config.batch)
    }

    fn lr(&self, epoch: usize) -> f64 {
        let Schedule { lr, drop_epoch, .. } = self.config.schedule;
        if epoch < drop_epoch { lr } else { lr / 10.0 }
    }

    fn epoch_order(&self, epoch: usize) -> Vec<usize> {
        let mut order = self.training.clone();
        order.shuffle(&mut self.rng(2 * epoch as u64));
        order
    }

    /// A generator that depends on the seed and the place in the schedule only, so that a resumed
    /// run draws what an uninterrupted one would.
    fn rng(&self, stream: u64) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::seed_from_u64(self.config.seed);
        rng.set_stream(stream);
        rng
    }
}

/// Training and held-out frames: one in twenty, at least one and at most sixteen, evenly spread. A
/// single frame serves as both.
fn split(frames: usize) -> (Vec<usize>, Vec<usize>) {
    let held = (frames / 20).clamp(1, 16);
    if frames < 2 {
        return ((0..frames).collect(), (0..frames).collect());
    }
    let held_out: Vec<usize> = (0..held)
        .map(|k| (2 * k + 1) * frames / (2 * held))
        .collect();
    let training = (0..frames).filter(|i| !held_out.contains(i)).collect();
    (training, held_out)
}

#[cfg(test)]
mod tests {
    use super::split;

    #[test]
    fn held_out_frames_are_never_trained_on() {
        for n in 2..700 {
            let (training, held_out) = split(n);
            assert!(held_out.iter().all(|i| *i < n && !training.contains(i)));
            assert_eq!(training.len() + held_out.len(), n);
            assert!(!training.is_empty() && (1..=16).contains(&held_out.len()));
        }
    }
}
