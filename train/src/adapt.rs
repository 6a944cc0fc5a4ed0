use std::collections::VecDeque;

use barchan_datasets::{Plane, StereoFrame};
use barchan_geometry::RectifiedRig;
use barchan_model::{Device, StereoNet};
use burn::module::Module;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::batch::Sample;
use crate::descent::{Descent, number};
use crate::loss::View;
use crate::validation::to_plane;
use crate::{Augmentation, Batch, Loss, TrainError};

/// How an [`Adapter`] goes about it.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AdaptConfig {
    /// Steps after each pair.
    pub steps: usize,
    /// Learning rate.
    pub lr: f64,
    /// Longest gradient, Euclidean norm over all weights; 0 does not clip.
    pub clip: f32,
    /// Height and width of the crops, pixels.
    pub crop: [usize; 2],
    /// Pairs that are kept to learn from: each step draws the newest or, as often, any of them.
    pub memory: usize,
    /// One pair in so many is not learned from: it judges.
    pub judge: usize,
    /// So many of the newest judges are kept.
    pub judges: usize,
    /// Pairs between two judgements.
    pub every: usize,
    /// Seeds crops, augmentation and the choice of pairs.
    pub seed: u64,
    /// Weights of eq. 1, and its options; neighbours and proxies are not for streams.
    pub loss: Loss,
    /// What is done to the images that the network sees.
    pub augmentation: Augmentation,
}

impl Default for AdaptConfig {
    fn default() -> Self {
        Self {
            steps: 2,
            lr: 1e-4,
            clip: 1.0,
            crop: [192, 320],
            memory: 32,
            judge: 4,
            judges: 4,
            every: 8,
            seed: 1,
            loss: Loss::default(),
            augmentation: Augmentation::default(),
        }
    }
}

impl AdaptConfig {
    /// Refuses what cannot adapt.
    ///
    /// # Errors
    /// Says which field and what it should be.
    pub fn check(&self) -> Result<(), TrainError> {
        let refuse = |message: &str| Err(TrainError::Config(format!("adapt: {message}")));
        if [self.memory, self.judges, self.every].contains(&0) || self.judge < 2 {
            return refuse("memory, judges and every must be at least 1, judge at least 2");
        }
        if self.crop.iter().any(|n| *n < 32) {
            return refuse("a crop must be at least 32 x 32 pixels");
        }
        if !(self.lr.is_finite() && self.lr > 0.0) {
            return refuse("the learning rate must be above zero");
        }
        if !(self.clip.is_finite() && self.clip >= 0.0) {
            return refuse("clip must be a length of the gradient, or 0 for none");
        }
        if self.loss.neighbours > 0 || self.loss.proxies > 0.0 {
            return refuse("neighbours and proxies are not for streams");
        }
        self.loss.check(false)?;
        self.augmentation.check()
    }
}

/// Whose weights explained the latest judges best.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// What was learned since the last judgement: it is trusted from now on.
    Learned,
    /// What was trusted before: learning starts again from there.
    Trusted,
    /// The weights that all began with: everything learned is forgotten.
    First,
}

/// A judgement: the photometric loss `a1 L_SSIM + a2 L_1` (and census) over the latest judges, which nobody
/// learned from.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Judgement {
    /// Pairs seen so far.
    pub pairs: usize,
    /// Steps made so far, those rolled back among them.
    pub steps: usize,
    /// With what was learned since the last judgement.
    pub learned: f32,
    /// With the weights trusted until now.
    pub trusted: f32,
    /// With the first weights.
    pub first: f32,
    /// Who is trusted from now on.
    pub verdict: Verdict,
}

/// Adapts a network to a stream of pairs without truth (Tonioni 2019, "Real-time self-adaptive deep
/// stereo"), and takes back what does not help.
///
/// Learning follows the loss of training on the pairs as they come; some of them are held back. On
/// these the learned weights are judged against those trusted so far and against the first ones, and the best
/// of the three is trusted: a step that goes wrong, or a place that the learned weights do not
/// suit, costs no more than the time until the next judgement, and the trusted weights are not even touched.
pub struct Adapter {
    config: AdaptConfig,
    device: Device,
    first: StereoNet,
    trusted: StereoNet,
    learning: Descent,
    memory: VecDeque<Sample>,
    judges: VecDeque<StereoFrame>,
    pairs: usize,
    steps: usize,
    /// Steps since the last judgement.
    untried: usize,
    rng: ChaCha8Rng,
}

impl Adapter {
    /// Starts from `net`, which is on the autodiff form of `device`.
    ///
    /// # Errors
    /// When the configuration is refused.
    pub fn new(net: StereoNet, device: &Device, config: AdaptConfig) -> Result<Self, TrainError> {
        config.check()?;
        Ok(Self {
            rng: ChaCha8Rng::seed_from_u64(config.seed),
            device: device.clone().autodiff(),
            first: net.valid(),
            trusted: net.valid(),
            learning: Descent::new(net),
            memory: VecDeque::new(),
            judges: VecDeque::new(),
            pairs: 0,
            steps: 0,
            untried: 0,
            config,
        })
    }

    /// The weights to work with, without gradients; they change with judgements only.
    pub fn trusted(&self) -> &StereoNet {
        &self.trusted
    }

    /// Takes the next pair of the stream: learns from it, or holds it back; and judges when it is time.
    ///
    /// # Errors
    /// When the pair is too small, or the trusted network's own answer is no number. A step of learning that
    /// ends in no number is rolled back, and no error.
    pub fn see(
        &mut self,
        frame: StereoFrame,
        rig: &RectifiedRig,
    ) -> Result<Option<Judgement>, TrainError> {
        if frame.left.width().min(frame.left.height()) < 16 {
            return Err(TrainError::Config(format!(
                "{}: {} x {} pixels are too few to learn from, 16 x 16 are needed",
                frame.name,
                frame.left.width(),
                frame.left.height()
            )));
        }
        self.pairs += 1;
        if self.pairs.is_multiple_of(self.config.judge) {
            keep(&mut self.judges, frame, self.config.judges);
        } else {
            let sample = Sample {
                frame,
                rig: *rig,
                truth: None,
                proxy: None,
                neighbours: vec![],
            };
            keep(&mut self.memory, sample, self.config.memory);
            for _ in 0..self.config.steps {
                self.learn();
            }
        }
        let due = self.pairs.is_multiple_of(self.config.every);
        if due && self.untried > 0 && !self.judges.is_empty() {
            return self.judge().map(Some);
        }
        Ok(None)
    }

    /// A step from the newest pair or, as often, from any that is remembered: what was seen before is not
    /// forgotten over what is seen now.
    fn learn(&mut self) {
        let chosen = match self.rng.random_bool(0.5) {
            true => self.memory.len() - 1,
            false => self.rng.random_range(0..self.memory.len()),
        };
        let config = &self.config;
        let batch = Batch::crop(
            &self.memory.make_contiguous()[chosen..=chosen],
            config.crop,
            Some(&config.augmentation),
            &mut self.rng,
            &self.device,
        );
        let found = self
            .learning
            .step(&batch, &config.loss, false, config.clip, config.lr);
        self.steps += 1;
        self.untried += 1;
        if found.is_err() {
            self.start_from(self.trusted.clone());
        }
    }

    fn judge(&mut self) -> Result<Judgement, TrainError> {
        let learned = self.learning.net.valid();
        let [first, trusted] = [&self.first, &self.trusted].map(|net| self.photometric(net));
        let (first, trusted) = (first?, trusted?);
        // What ended in no number explains nothing.
        let explained = self.photometric(&learned).unwrap_or(f32::INFINITY);
        let verdict = if explained < trusted.min(first) {
            self.trusted = learned;
            Verdict::Learned
        } else if trusted <= first {
            self.start_from(self.trusted.clone());
            Verdict::Trusted
        } else {
            self.trusted = self.first.clone();
            self.start_from(self.first.clone());
            Verdict::First
        };
        self.untried = 0;
        Ok(Judgement {
            pairs: self.pairs,
            steps: self.steps,
            learned: explained,
            trusted,
            first,
            verdict,
        })
    }

    /// Mean photometric loss of whole judges.
    fn photometric(&self, net: &StereoNet) -> Result<f32, TrainError> {
        let device = self.device.clone().inner();
        let mut sum = 0.0;
        for frame in &self.judges {
            sum += explain(net, &self.config.loss, frame, &device)?.1;
        }
        Ok(sum / self.judges.len() as f32)
    }

    fn start_from(&mut self, net: StereoNet) {
        self.learning = Descent::new(net.train());
    }
}

/// Disparity of a whole pair, and the photometric loss that it leaves (`a1 L_SSIM + a2 L_1` and census); `net` and
/// `device` without gradients.
///
/// # Errors
/// When the loss is no number.
pub fn explain(
    net: &StereoNet,
    loss: &Loss,
    frame: &StereoFrame,
    device: &Device,
) -> Result<(Plane, f32), TrainError> {
    let [left, right] = Batch::whole(frame, device);
    let disparity = net.forward(left.clone(), right.clone()).disparity;
    let (_, terms) = loss.self_supervised(&View::new(left, right, disparity.clone()), None);
    let found = number("the photometric loss", loss.photometric(&terms.values()))
        .map_err(|e| e.error(0, &frame.name))?;
    let (width, height) = frame.left.dimensions();
    Ok((to_plane(&disparity, width, height), found))
}

/// Appends, and drops the oldest beyond `most`.
fn keep<T>(queue: &mut VecDeque<T>, item: T, most: usize) {
    queue.push_back(item);
    while queue.len() > most {
        queue.pop_front();
    }
}
