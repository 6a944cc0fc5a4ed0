use std::sync::Arc;
use std::time::Instant;

use barchan_datasets::{Prefetch, StereoSource};
use barchan_model::{Device, SCALE, StereoNet};
use burn::module::Module;
use burn::tensor::Tensor;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::batch::Sample;
use crate::descent::{Descent, number};
use crate::loss::View;
use crate::pool::Pool;
use crate::run_dir::Saved;
use crate::validation::{Errors, to_plane};
use crate::{Batch, Explained, LogLine, RunDir, Scored, TrainConfig, TrainError, Validation};
use crate::{averaging, gradients, spread};

/// Who watches a run: told of what happens, and asked whether to go on.
pub trait Observer {
    /// A step was made.
    fn step(&mut self, line: &LogLine) {
        let _ = line;
    }

    /// Held-out pairs were looked at; `best` is the best so far, this time included, and `pairs` are
    /// the first few with what the network makes of them.
    ///
    /// # Errors
    /// Whatever ends the run: a picture that cannot be written, say.
    fn validated(
        &mut self,
        scored: &Scored,
        best: &Scored,
        pairs: &[Explained],
    ) -> Result<(), TrainError> {
        let _ = (scored, best, pairs);
        Ok(())
    }

    /// Whether to save a checkpoint and stop; asked after every step and every held-out pair.
    fn stop(&mut self) -> bool {
        false
    }
}

/// Watches nothing.
impl Observer for () {}

/// How a run came to its end.
#[derive(Clone, Copy, Debug)]
#[allow(clippy::large_enum_variant)] // There is one of it in a run.
pub enum Ended {
    /// All steps are made.
    Finished {
        /// Held-out pairs before the first step.
        before: Scored,
        /// And after the last.
        after: Scored,
        /// The best of all validations.
        best: Scored,
    },
    /// The observer stopped it; a checkpoint was saved.
    Stopped {
        /// Steps done.
        step: usize,
    },
}

/// What a checkpoint remembers beside weights and optimiser.
#[derive(Clone, Copy, Default, Serialize, Deserialize)]
struct State {
    before: Option<Scored>,
    best: Option<Scored>,
}

/// Of so many held-out pairs the observer gets pictures.
const PICTURES: usize = 3;

/// Runs the schedule.
pub struct Trainer {
    config: TrainConfig,
    run: RunDir,
    device: Device,
    pool: Arc<Pool>,
    descent: Descent,
    /// The moving average of the weights, where there is one; without gradients.
    average: Option<StereoNet>,
    training: Vec<usize>,
    held_out: Vec<usize>,
    /// Steps done.
    step: usize,
    /// The step of the checkpoint on disk.
    saved: Option<usize>,
    state: State,
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
        // What can fail comes before anything is on disk.
        config.device.device()?;
        let pool = Pool::new(sources, &config)?;
        Self::prepare(RunDir::create(root, &config)?, config, pool, init)
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
        let mut trainer = Self::prepare(run, config, pool, init)?;
        let saved = Saved {
            net: trainer.descent.net,
            average: trainer.average,
            optimizer: trainer.descent.optimizer,
        };
        let (saved, state) = trainer.run.restore::<State>(saved)?;
        trainer.average = saved.average;
        trainer.descent = Descent {
            net: saved.net,
            optimizer: saved.optimizer,
        };
        if let Some((step, state)) = state {
            (trainer.step, trainer.state) = (step, state);
            trainer.saved = Some(step);
        }
        Ok(trainer)
    }

    fn prepare(
        run: RunDir,
        config: TrainConfig,
        pool: Pool,
        init: Option<StereoNet>,
    ) -> Result<Self, TrainError> {
        let pool = Arc::new(pool);
        let (training, held_out) = split(pool.len());
        let device = config.device.device()?.autodiff();
        let net = match init {
            Some(net) => net,
            None => StereoNet::init(&config.net, config.seed, &device)?,
        };
        Ok(Self {
            average: (config.average > 0.0).then(|| net.valid()),
            config,
            run,
            device,
            pool,
            descent: Descent::new(net),
            training,
            held_out,
            step: 0,
            saved: None,
            state: State::default(),
        })
    }

    /// The network that is validated and saved, without gradients: the average where there is one.
    pub fn net(&self) -> StereoNet {
        self.average
            .clone()
            .unwrap_or_else(|| self.descent.net.valid())
    }

    /// The configuration.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// The run directory.
    pub fn run_dir(&self) -> &RunDir {
        &self.run
    }

    /// What was found on the held-out pairs before the first step, once that is known.
    pub fn before(&self) -> Option<Scored> {
        self.state.before
    }

    /// How many steps are done, and how many there are.
    pub fn progress(&self) -> (usize, usize) {
        (
            self.step,
            self.config.schedule.total(self.steps_per_epoch()),
        )
    }

    /// Trains to the end of the schedule, or until the observer stops it. Held-out pairs are looked
    /// at before the first step, after the last, and as often in between as the configuration says.
    ///
    /// # Errors
    /// When data cannot be read, the run directory not written, or what is computed is no number.
    pub fn run(&mut self, observer: &mut dyn Observer) -> Result<Ended, TrainError> {
        let (_, total) = self.progress();
        while self.step < total {
            let epoch = self.step / self.steps_per_epoch();
            let mut samples = self.samples(epoch);
            while self.step < total && self.step / self.steps_per_epoch() == epoch {
                // A validation comes after the checkpoint of its step: a run that goes on from there
                // repeats it.
                if self.validation_is_due() && self.assess(observer)?.is_none() {
                    return self.stopped();
                }
                let waiting = Instant::now();
                let batch: Vec<Sample> = samples
                    .by_ref()
                    .take(self.config.batch)
                    .collect::<Result<_, _>>()?;
                let waited = waiting.elapsed().as_secs_f64();
                let mut line = self.step(&batch, epoch)?;
                line.waited = waited;
                self.run.log(&line)?;
                observer.step(&line);
                if self.step.is_multiple_of(self.config.checkpoint_every) || self.step == total {
                    self.checkpoint(&line.frames)?;
                }
                if observer.stop() {
                    return self.stopped();
                }
            }
        }
        if self.config.supervised && !self.fit_spread(observer)? {
            return self.stopped();
        }
        let Some(after) = self.assess(observer)? else {
            return self.stopped();
        };
        Ok(Ended::Finished {
            before: self.state.before.unwrap_or(after),
            after,
            best: self.state.best.unwrap_or(after),
        })
    }

    /// One step: crop and augment, then figure 4 of the paper ([`Descent::step`]).
    fn step(&mut self, samples: &[Sample], epoch: usize) -> Result<LogLine, TrainError> {
        let started = Instant::now();
        let config = &self.config;
        let mut rng = self.rng(2 * self.step as u64 + 1);
        let batch = Batch::crop(
            samples,
            config.crop,
            Some(&config.augmentation),
            &mut rng,
            &self.device,
        );
        if config.supervised && batch.truth.is_none() {
            return Err(TrainError::Config(format!(
                "--supervised: {} has no true disparity",
                batch.names
            )));
        }
        let lr = config.schedule.lr(self.step, self.steps_per_epoch());
        let found = self
            .descent
            .step(&batch, &config.loss, config.supervised, config.clip, lr)
            .map_err(|e| e.error(self.step + 1, &batch.names))?;
        self.step += 1;
        if let Some(average) = self.average.take() {
            let decay = self.config.average;
            let net = &self.descent.net;
            self.average = Some(averaging::follow(average, net, decay, self.step));
        }

        Ok(LogLine {
            step: self.step,
            epoch,
            lr,
            loss: found.loss,
            terms: found.terms,
            gradient: found.gradient,
            seconds: started.elapsed().as_secs_f64(),
            waited: 0.0,
            frames: batch.names,
        })
    }

    /// Makes the network's sigma as large as its errors on held-out pairs, and saves the weights with that;
    /// `false` when the observer stops it on the way.
    fn fit_spread(&mut self, observer: &mut dyn Observer) -> Result<bool, TrainError> {
        /// One pixel in so many is enough.
        const EVERY: usize = 17;
        let net = self.net().with_spread(None)?;
        let device = self.device.clone().inner();
        let mut found = vec![];
        for sample in self.pool.whole(self.held_out.clone()) {
            let (frame, truth) = sample?;
            let Some(truth) = truth else { continue };
            let (width, height) = frame.left.dimensions();
            let [left, right]: [Tensor<4>; 2] = Batch::whole(&frame, &device);
            let prediction = net.forward(left, right);
            let [disparity, sigma] =
                [prediction.disparity, prediction.sigma].map(|t| to_plane(&t, width, height));
            let most = (self.config.net.max_disparity - 2) as f32;
            let pixels = disparity.iter().zip(sigma.iter()).zip(truth.iter());
            let reachable = pixels.filter(|(_, truth)| **truth <= most).step_by(EVERY);
            let in_bins = |v: f32| (v / SCALE as f32).powi(2);
            found.extend(reachable.map(|((d, s), truth)| (in_bins(d - truth), in_bins(*s))));
            if observer.stop() {
                return Ok(false);
            }
        }
        if let Some(fitted) = spread::fit(found) {
            let net = self.descent.net.clone();
            self.descent.net = net.with_spread(Some(fitted))?;
            self.average = match self.average.take() {
                Some(average) => Some(average.with_spread(Some(fitted))?),
                None => None,
            };
            self.run.weights(&self.net())?;
        }
        Ok(true)
    }

    /// Looks at the held-out pairs, writes down what it found and tells the observer; `None` when that
    /// stops it on the way.
    fn assess(&mut self, observer: &mut dyn Observer) -> Result<Option<Scored>, TrainError> {
        let Some((validation, pairs)) = self.validate(observer)? else {
            return Ok(None);
        };
        let scored = Scored {
            step: self.step,
            validation,
        };
        if self.step == 0 {
            self.state.before = Some(scored);
        }
        let best = match self.state.best {
            Some(best) if !validation.is_better_than(&best.validation) => best,
            _ => scored,
        };
        self.state.best = Some(best);
        self.run.log(&scored)?;
        observer.validated(&scored, &best, &pairs)?;
        Ok(Some(scored))
    }

    /// How the network explains whole held-out pairs, and the first few of them for pictures; `None`
    /// when the observer stops it on the way.
    fn validate(
        &self,
        observer: &mut dyn Observer,
    ) -> Result<Option<(Validation, Vec<Explained>)>, TrainError> {
        let net = self.net();
        let device = self.device.clone().inner();
        let (mut ssim, mut l1, mut census) = (0.0, 0.0, 0.0);
        let (mut errors, mut pairs) = (Errors::default(), vec![]);
        for sample in self.pool.whole(self.held_out.clone()) {
            let (frame, truth) = sample?;
            let [left, right]: [Tensor<4>; 2] = Batch::whole(&frame, &device);
            let disparity = net.forward(left.clone(), right.clone()).disparity;
            let view = View::new(left, right.clone(), disparity.clone());
            let (_, terms) = self.config.loss.self_supervised(&view, None);
            let terms = terms.values();
            ssim += terms.ssim;
            l1 += terms.l1;
            census += terms.census.unwrap_or(0.0);
            number("the photometric loss", ssim + l1)
                .map_err(|e| e.error(self.step, &frame.name))?;
            if let Some(truth) = &truth {
                let (width, height) = frame.left.dimensions();
                errors.add(&to_plane(&disparity, width, height), truth);
            }
            if pairs.len() < PICTURES {
                pairs.push(Explained::new(frame, &right, &disparity, truth));
            }
            if observer.stop() {
                return Ok(None);
            }
        }
        let n = self.held_out.len() as f32;
        let (ssim, l1, census) = (ssim / n, l1 / n, census / n);
        let weights = &self.config.loss;
        let validation = Validation {
            frames: self.held_out.len(),
            photometric: weights.ssim * ssim + weights.l1 * l1 + weights.census * census,
            ssim,
            l1,
            census: (weights.census > 0.0).then_some(census),
            accuracy: errors.accuracy(),
        };
        Ok(Some((validation, pairs)))
    }

    fn validation_is_due(&self) -> bool {
        let every = match self.config.validate_every {
            0 => self.steps_per_epoch(),
            every => every,
        };
        self.step.is_multiple_of(every)
    }

    /// Saves what is needed to go on, unless `frames` (the last batch) spoiled the weights.
    fn checkpoint(&mut self, frames: &str) -> Result<(), TrainError> {
        number(
            "the length of the weights",
            gradients::norm(&self.descent.net),
        )
        .map_err(|e| e.error(self.step, frames))?;
        let saved = Saved {
            net: self.descent.net.clone(),
            average: self.average.clone(),
            optimizer: self.descent.optimizer.clone(),
        };
        self.run
            .checkpoint(self.step, &saved, &self.net(), &self.state)?;
        self.saved = Some(self.step);
        Ok(())
    }

    fn stopped(&mut self) -> Result<Ended, TrainError> {
        if self.saved != Some(self.step) {
            self.checkpoint("the last batch")?;
        }
        Ok(Ended::Stopped { step: self.step })
    }

    fn steps_per_epoch(&self) -> usize {
        self.training.len().div_ceil(self.config.batch)
    }

    /// What is left of an epoch, read ahead on threads.
    fn samples(&self, epoch: usize) -> Prefetch<Sample, TrainError> {
        let mut order = self.training.clone();
        order.shuffle(&mut self.rng(2 * epoch as u64));
        let first = (epoch * self.training.len()) as u64;
        let done = (self.step % self.steps_per_epoch()) * self.config.batch;
        let order = (first..).zip(order).skip(done).collect();
        self.pool.training(order, 2 * self.config.batch)
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
