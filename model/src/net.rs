use std::sync::{Mutex, PoisonError};

use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};

use crate::ModelError;
use crate::aggregation::Aggregation;
use crate::features::Features;
use crate::ops::{Execute, Ops};
use crate::regression::{Regression, SCALE};
use crate::volume::{CENSUS_CHANNELS, census_volume, correlation_volume};

/// Images are padded inside the network to a multiple of this.
const MULTIPLE: usize = 16;

/// A named configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// 0.2 M parameters: trains on a laptop in minutes, every stage of the real network.
    Tiny,
}

impl Preset {
    /// What the preset stands for.
    pub fn config(self) -> NetConfig {
        match self {
            Self::Tiny => NetConfig {
                max_disparity: 96,
                features: [16, 24, 40],
                matching: 16,
                groups: 4,
                aggregation: [12, 24, 32],
                up_sampling: 32,
            },
        }
    }
}

/// Everything that shapes a network; stored with its weights.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetConfig {
    /// Disparities are searched in `0..max_disparity` pixels; a multiple of 16.
    pub max_disparity: usize,
    /// Channels of the 2-D features at 1/2, 1/4 and 1/8 of the resolution.
    pub features: [usize; 3],
    /// Channels of the features that are correlated; a multiple of `groups`.
    pub matching: usize,
    /// Groups of the group-wise correlation.
    pub groups: usize,
    /// Channels of the 3-D convolutions at 1/4, 1/8 and 1/16.
    pub aggregation: [usize; 3],
    /// Hidden channels of the up-sampling.
    pub up_sampling: usize,
}

impl NetConfig {
    /// Refuses what describes no network.
    ///
    /// # Errors
    /// Says which field and what it should be.
    pub fn check(&self) -> Result<(), ModelError> {
        let refuse = |message: &str| Err(ModelError::Config(message.into()));
        if self.max_disparity == 0
            || !self.max_disparity.is_multiple_of(4 * SCALE)
            || self.max_disparity > 1024
        {
            return refuse("max_disparity must be a multiple of 16, at most 1024");
        }
        let channels = [
            &self.features[..],
            &self.aggregation[..],
            &[self.matching, self.groups, self.up_sampling],
        ]
        .concat();
        if channels.iter().any(|c| !(1..=1024).contains(c)) {
            return refuse("channels and groups must be 1 to 1024");
        }
        if !self.matching.is_multiple_of(self.groups) {
            return refuse("matching must be a multiple of groups");
        }
        Ok(())
    }

    fn bins(&self) -> usize {
        self.max_disparity / SCALE
    }
}

/// What the network says of a pair, each `[B, 1, H, W]`.
#[derive(Clone, Debug)]
pub struct Prediction<M> {
    /// Disparity of the left image, pixels.
    pub disparity: M,
    /// Standard deviation of the probability distribution, pixels.
    pub sigma: M,
    /// 0..=1: the probability around the answer.
    pub confidence: M,
}

/// Rectified pair in, disparity out: features, cost volume, 3-D convolutions, soft-argmin, learned
/// up-sampling (Hong 2021, 3.2.1, after Zhong 2017).
#[derive(Module, Debug)]
pub struct StereoNet {
    features: Features,
    aggregation: Aggregation,
    regression: Regression,
    #[module(skip)]
    config: NetConfig,
}

static DRAWING: Mutex<()> = Mutex::new(());

/// Burn draws a parameter when it is first looked at: this looks at all, in their order.
struct Draw;

impl ModuleVisitor for Draw {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        param.val();
    }
}

impl StereoNet {
    /// A network with random weights, reproducible by seed.
    ///
    /// # Errors
    /// When the configuration describes no network.
    pub fn init(config: &NetConfig, seed: u64, device: &Device) -> Result<Self, ModelError> {
        config.check()?;
        // The device's generator is the process's: nobody else may draw between seed and last draw.
        let _drawing = DRAWING.lock().unwrap_or_else(PoisonError::into_inner);
        device.seed(seed);
        let input = config.groups + CENSUS_CHANNELS;
        let net = Self {
            features: Features::init(config.features, config.matching, device),
            aggregation: Aggregation::init(input, config.aggregation, device),
            regression: Regression::init(config.features[1], config.up_sampling, device),
            config: config.clone(),
        };
        net.visit(&mut Draw);
        Ok(net)
    }

    /// The same weights searching another range: every layer is a convolution over disparity, so
    /// none depends on how many there are.
    ///
    /// # Errors
    /// When the range is refused.
    pub fn with_max_disparity(mut self, max_disparity: usize) -> Result<Self, ModelError> {
        self.config.max_disparity = max_disparity;
        self.config.check()?;
        Ok(self)
    }

    /// The configuration.
    pub fn config(&self) -> &NetConfig {
        &self.config
    }

    /// Runs on images `[B, 3, H, W]` of any size, RGB in 0..=1.
    pub fn forward(&self, left: Tensor<4>, right: Tensor<4>) -> Prediction<Tensor<4>> {
        self.run(&mut Execute::on(left.device()), &left, &right)
    }

    /// The definition, for whoever interprets it.
    pub fn run<O: Ops>(&self, ops: &mut O, left: &O::Map, right: &O::Map) -> Prediction<O::Map> {
        let NetConfig {
            matching, groups, ..
        } = self.config;
        let bins = self.config.bins();

        // Colour cast and exposure, of each camera on its own, go before anything is compared.
        let prepare = |ops: &mut O, image: &O::Map| {
            let normal = ops.instance_norm(3, 1e-5, image);
            ops.pad_to_multiple(MULTIPLE, &normal)
        };
        let (l, r) = (prepare(ops, left), prepare(ops, right));

        let seen_left = self.features.forward(ops, "features", &l);
        let seen_right = self.features.forward(ops, "features", &r);

        let correlation = correlation_volume(
            ops,
            &seen_left.matching,
            &seen_right.matching,
            matching,
            groups,
            bins,
        );
        let census = census_volume(ops, &l, &r, bins);
        let volume = ops.concat_volumes(&[correlation, census]);

        let logits = self.aggregation.forward(ops, &volume);
        let full = self
            .regression
            .forward(ops, bins, &logits, &seen_left.context);
        Prediction {
            disparity: ops.crop_to(left, &full.disparity),
            sigma: ops.crop_to(left, &full.sigma),
            confidence: ops.crop_to(left, &full.confidence),
        }
    }
}
