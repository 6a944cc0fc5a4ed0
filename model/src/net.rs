use std::sync::{Mutex, PoisonError};

use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};

use crate::ModelError;
use crate::features::Features;
use crate::ops::{Execute, Ops};
use crate::planar::{Planar, PlanarConfig};
use crate::refinement::Refinement;
use crate::regression::{Argmin, Regression, SCALE};
use crate::volume::census_descriptors;
use crate::volumetric::{Volumetric, VolumetricConfig};

/// Images are padded inside the network to a multiple of this.
const MULTIPLE: usize = 16;

/// A named configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// 0.1 M parameters: trains on a laptop in minutes, every stage of `rover`.
    Tiny,
    /// Real time on two CPU cores.
    Rover,
    /// The network of Hong 2021 (3.2.1) after Zhong 2017: accuracy first.
    Paper,
}

impl Preset {
    /// All, smallest first.
    pub const ALL: [Self; 3] = [Self::Tiny, Self::Rover, Self::Paper];

    /// What the preset stands for.
    pub fn config(self) -> NetConfig {
        match self {
            Self::Tiny => NetConfig {
                max_disparity: 96,
                features: [16, 16, 24, 32],
                aggregation: AggregationConfig::Planar(PlanarConfig {
                    matching: [16, 16],
                    groups: [2, 4],
                    channels: [16, 16],
                    blocks: [0, 1, 1],
                    finest: 0,
                }),
                up_sampling: 16,
                refinement: 0,
                spread: as_stated(),
            },
            Self::Rover => NetConfig {
                max_disparity: 96,
                features: [16, 32, 48, 64],
                aggregation: AggregationConfig::Planar(PlanarConfig {
                    matching: [32, 48],
                    groups: [2, 8],
                    channels: [32, 48],
                    blocks: [0, 2, 1],
                    finest: 16,
                }),
                up_sampling: 32,
                refinement: 48,
                spread: as_stated(),
            },
            Self::Paper => NetConfig {
                max_disparity: 96,
                features: [32, 32, 64, 96],
                aggregation: AggregationConfig::Volumetric(VolumetricConfig {
                    matching: 16,
                    channels: [24, 32, 48],
                    census: true,
                }),
                up_sampling: 32,
                refinement: 48,
                spread: as_stated(),
            },
        }
    }

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tiny => "tiny",
            Self::Rover => "rover",
            Self::Paper => "paper",
        }
    }
}

/// Everything that shapes a network; stored with its weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetConfig {
    /// Disparities are searched in `0..max_disparity` pixels; a multiple of 16.
    pub max_disparity: usize,
    /// Channels of the 2-D features at 1/2, 1/4, 1/8 and 1/16 of the resolution.
    pub features: [usize; 4],
    /// Hidden channels of the up-sampling.
    pub up_sampling: usize,
    /// Hidden channels of the refinement before it; 0 is none.
    #[serde(default)]
    pub refinement: usize,
    /// `[c, a, b]`: `c + a v + b v^2` is the variance of the error where the distribution says `v`, in bins squared. Fitted
    /// to true disparity at the end of supervised training; as stated where not.
    #[serde(default = "as_stated")]
    pub spread: [f32; 3],
    /// How costs become logits.
    pub aggregation: AggregationConfig,
}

/// The variance of the distribution as that of the error.
fn as_stated() -> [f32; 3] {
    [0.0, 1.0, 0.0]
}

/// From features to logits over disparities.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AggregationConfig {
    /// Correlation, 2-D convolutions: fast.
    Planar(PlanarConfig),
    /// Concatenation, 3-D convolutions: the paper's.
    Volumetric(VolumetricConfig),
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
        let mut channels = self.features.to_vec();
        channels.push(self.up_sampling);
        channels.push(self.refinement.max(1));
        match &self.aggregation {
            AggregationConfig::Planar(c) => {
                channels.extend(c.matching.iter().chain(&c.groups).chain(&c.channels));
                channels.push(c.finest.max(1));
                let divides = |level: usize| {
                    c.groups[level] > 0 && c.matching[level].is_multiple_of(c.groups[level])
                };
                if !divides(0) || !divides(1) {
                    return refuse("matching must be a multiple of groups");
                }
                if c.blocks.iter().any(|n| *n > 64) {
                    return refuse("blocks must be at most 64");
                }
            }
            AggregationConfig::Volumetric(c) => {
                channels.extend(&c.channels);
                channels.push(c.matching);
            }
        }
        if !(self.spread.iter().all(|v| v.is_finite() && *v >= 0.0) && self.spread[1] > 0.0) {
            return refuse("spread must be three numbers not below zero, the second above it");
        }
        if channels.iter().any(|c| !(1..=1024).contains(c)) {
            return refuse("channels and groups must be 1 to 1024");
        }
        Ok(())
    }

    fn bins(&self) -> usize {
        self.max_disparity / SCALE
    }
}

/// What the network says of a pair; maps are `[B, 1, H, W]` but for the logits.
#[derive(Clone, Debug)]
pub struct Prediction<M> {
    /// Logits of the distribution that all else is made of: `[B, bins, h, w]` at a quarter of the
    /// resolution of the padded images, near to far. Bin `k` stands for `4 (bins - 1 - k)` pixels.
    pub logits: M,
    /// Disparity of the left image, pixels.
    pub disparity: M,
    /// Standard deviation of the probability distribution, pixels.
    pub sigma: M,
    /// 0..=1: the probability around the answer.
    pub confidence: M,
}

/// Rectified pair in, disparity out: features, cost volume, convolutions over it, soft-argmin, learned
/// up-sampling (Hong 2021, 3.2.1, after Zhong 2017).
#[derive(Module, Debug)]
pub struct StereoNet {
    features: Features,
    aggregation: Aggregation,
    refinement: Option<Refinement>,
    regression: Regression,
    #[module(skip)]
    config: NetConfig,
}

/// As [`AggregationConfig`] says.
#[derive(Module, Debug)]
#[allow(clippy::large_enum_variant)] // There is one of it.
enum Aggregation {
    Planar(Planar),
    Volumetric(Volumetric),
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
        let [_, quarter, eighth, _] = config.features;
        let net = Self {
            features: Features::init(config.features, device),
            aggregation: match &config.aggregation {
                AggregationConfig::Planar(c) => {
                    Aggregation::Planar(Planar::init(c, [quarter, eighth], device))
                }
                AggregationConfig::Volumetric(c) => {
                    Aggregation::Volumetric(Volumetric::init(c, quarter, device))
                }
            },
            refinement: (config.refinement > 0)
                .then(|| Refinement::init(quarter, config.refinement, device)),
            regression: Regression::init(quarter, config.up_sampling, device),
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

    /// The same weights, with another [`NetConfig::spread`].
    ///
    /// # Errors
    /// When it is refused.
    pub fn with_spread(mut self, spread: Option<[f32; 3]>) -> Result<Self, ModelError> {
        self.config.spread = spread.unwrap_or_else(as_stated);
        self.config.check()?;
        Ok(self)
    }

    /// The configuration.
    pub fn config(&self) -> &NetConfig {
        &self.config
    }

    /// Runs on images `[B, 3, H, W]` of any size, RGB in 0..=1.
    pub fn forward(&self, left: Tensor<4>, right: Tensor<4>) -> Prediction<Tensor<4>> {
        self.run(
            &mut Execute::on(left.device()),
            Argmin::AroundPeak,
            &left,
            &right,
        )
    }

    /// [`StereoNet::forward`] with the mean over the bins that `argmin` says.
    pub fn forward_training(
        &self,
        argmin: Argmin,
        left: &Tensor<4>,
        right: &Tensor<4>,
    ) -> Prediction<Tensor<4>> {
        self.run(&mut Execute::on(left.device()), argmin, left, right)
    }

    /// The definition, for whoever interprets it.
    pub fn run<O: Ops>(
        &self,
        ops: &mut O,
        argmin: Argmin,
        left: &O::Map,
        right: &O::Map,
    ) -> Prediction<O::Map> {
        let bins = self.config.bins();

        // Both images pass the same layers, one after the other in the batch. Colour cast and exposure, of
        // each camera on its own, go before anything is compared.
        let images = ops.join(left, right);
        let images = ops.instance_norm(3, 1e-5, &images);
        let images = ops.pad_to_multiple(MULTIPLE, &images);

        let features = self.features.forward(ops, &images);
        let logits = match &self.aggregation {
            Aggregation::Planar(planar) => {
                let census = census_descriptors(ops, &images);
                planar.forward(ops, bins, &features, &census)
            }
            Aggregation::Volumetric(volumetric) => {
                let census = volumetric
                    .needs_census()
                    .then(|| census_descriptors(ops, &images));
                volumetric.forward(ops, bins, &features, census.as_ref())
            }
        };
        let (context, _) = ops.halves(&features.quarter);
        let full = self.regression.forward(
            ops,
            bins,
            argmin,
            &logits,
            &context,
            self.refinement.as_ref(),
        );
        let sigma = self.calibrated(ops, full.sigma);
        Prediction {
            logits: full.logits,
            disparity: ops.crop_to(left, &full.disparity),
            sigma: ops.crop_to(left, &sigma),
            confidence: ops.crop_to(left, &full.confidence),
        }
    }

    /// `sigma` in pixels as [`NetConfig::spread`] corrects it.
    fn calibrated<O: Ops>(&self, ops: &mut O, sigma: O::Map) -> O::Map {
        let spread = self.config.spread;
        if spread == as_stated() {
            return sigma;
        }
        let [c, a, b] = spread;
        let bins = ops.affine(1.0 / SCALE as f32, 0.0, &sigma);
        let variance = ops.mul(&bins, &bins);
        let factor = ops.affine(b, a, &variance);
        let variance = ops.mul(&variance, &factor);
        let variance = ops.affine(1.0, c, &variance);
        let sigma = ops.sqrt(&variance);
        ops.affine(SCALE as f32, 0.0, &sigma)
    }
}
