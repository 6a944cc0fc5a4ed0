//! Cost volume and aggregation in real time: bins are channels, every convolution is two-dimensional.
//!
//! A 3-D convolution over (disparity, height, width) is split into one over height and width, shared by
//! all bins, and one over disparity. As the bins lie side by side in the channels, the first is a grouped
//! 2-D convolution and the second a 1x1 convolution with a banded matrix; two bins become one, and one two, by
//! counting channels differently, without moving a number. That is what runs near the peak of a CPU: the same
//! operations as 3-D convolutions took three times as long.

use burn::module::{Module, Param};
use burn::nn::Initializer;
use burn::nn::conv::{Conv2d, Conv2dConfig};
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};

use crate::features::{FeatureMaps, conv1x1, conv3x3, unit_length};
use crate::volume::{CENSUS_CHANNELS, Census, census_matching};
use crate::{Correlated, Ops};

/// What shapes [`Planar`]. Pairs stand for 1/4 and 1/8 of the resolution, or 1/8 and 1/16.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanarConfig {
    /// Channels of the correlated features at 1/4 and 1/8; multiples of `groups`.
    pub matching: [usize; 2],
    /// Groups of the correlation at 1/4 and 1/8.
    pub groups: [usize; 2],
    /// Channels a bin at 1/8 and 1/16. Multiples of 16 suit the machine.
    pub channels: [usize; 2],
    /// Residual blocks at 1/8 on the way down, at 1/16, and at 1/8 on the way up.
    pub blocks: [usize; 3],
    /// Channels of two bins at 1/4 on the way up; 0 stops at 1/8. Multiples of 16 suit the machine.
    #[serde(default)]
    pub finest: usize,
}

/// A convolution over disparity alone, as `Conv1d` of PyTorch has it.
#[derive(Module, Debug)]
pub struct DisparityMix {
    /// `[out, in, taps]`.
    pub weight: Param<Tensor<3>>,
    /// `[out]`.
    pub bias: Param<Tensor<1>>,
}

impl DisparityMix {
    fn init(channels: [usize; 2], taps: usize, gain: f64, device: &Device) -> Self {
        let [input, output] = channels;
        let weight = Initializer::KaimingNormal {
            gain,
            fan_out_only: false,
        };
        Self {
            weight: weight.init_with([output, input, taps], Some(input * taps), None, device),
            bias: Initializer::Zeros.init([output], device),
        }
    }
}

impl DisparityMix {
    /// The same as a 1x1 convolution over `bins` bins that are channels: weight `[bins * out, bins * in, 1, 1]`,
    /// zero but for the band, and bias `[bins * out]`.
    pub fn banded(&self, bins: usize) -> (Tensor<4>, Tensor<1>) {
        let weight = self.weight.val();
        let [output, input, taps] = weight.dims();
        // 1 where the tap leads from one bin (`from`) to another (`to`).
        let mut band = vec![0.0f32; taps * bins * bins];
        for tap in 0..taps {
            for to in 0..bins {
                let from = (to + tap).checked_sub(taps / 2);
                if let Some(from) = from.filter(|from| *from < bins) {
                    band[(tap * bins + to) * bins + from] = 1.0;
                }
            }
        }
        let band =
            Tensor::<2>::from_data(TensorData::new(band, [taps, bins * bins]), &weight.device());
        let banded = weight
            .reshape([output * input, taps])
            .matmul(band)
            .reshape([output, input, bins, bins])
            .permute([2, 0, 3, 1])
            .reshape([bins * output, bins * input, 1, 1]);
        (banded, self.bias.val().repeat_dim(0, bins))
    }
}

/// `x + mix(relu(convolve(x)))`: over height and width, then over disparity.
#[derive(Module, Debug)]
struct Block {
    spatial: Conv2d,
    mix: DisparityMix,
}

impl Block {
    fn init(channels: usize, device: &Device) -> Self {
        Self {
            spatial: conv3x3([channels, channels], 1, device),
            // Small, so that a deep stack starts as the identity.
            mix: DisparityMix::init([channels, channels], 5, 0.3, device),
        }
    }

    fn forward<O: Ops>(&self, ops: &mut O, name: &str, bins: usize, x: &O::Map) -> O::Map {
        let y = ops.conv2d_per_bin(&format!("{name}.spatial"), &self.spatial, bins, x);
        let y = ops.relu(&y);
        let y = ops.disparity_mix(&format!("{name}.mix"), &self.mix, bins, &y);
        let y = ops.add(x, &y);
        ops.relu(&y)
    }
}

/// The last step of the way up: sharp outlines are decided at 1/4 of the resolution, where the costs and the image
/// both still have them. Two bins share their channels, as at 1/8, so that all layers work on wide groups.
#[derive(Module, Debug)]
struct Finest {
    up: Conv2d,
    raw: Conv2d,
    around: Conv2d,
    gate: Conv2d,
    out: DisparityMix,
}

impl Finest {
    /// From `eighth` channels a bin at 1/8, `raw` costs a bin and `context` features at 1/4.
    fn init(channels: usize, eighth: usize, raw: usize, context: usize, device: &Device) -> Self {
        Self {
            up: conv1x1([eighth, 4 * channels], device),
            raw: conv1x1([2 * raw, channels], device),
            around: conv3x3([channels, channels], 1, device),
            gate: conv1x1([context, channels], device),
            // Small, so that what is known at 1/8 speaks first.
            out: DisparityMix::init([channels, 2], 3, 0.1, device),
        }
    }

    /// What is added to the logits `[B, 2 bins, H/4, W/4]`.
    fn forward<O: Ops>(
        &self,
        ops: &mut O,
        bins: usize,
        eighth: &O::Map,
        raw: &O::Map,
        seen: &O::Map,
    ) -> O::Map {
        let name = |layer: &str| format!("aggregation.finest.{layer}");
        let up = ops.doubling_conv2d_per_bin(&name("up"), &self.up, bins, eighth);
        let raw = ops.conv2d_per_bin(&name("raw"), &self.raw, bins, raw);
        let x = ops.add(&up, &raw);
        let x = ops.relu(&x);
        let around = ops.conv2d_per_bin(&name("around"), &self.around, bins, &x);
        let x = ops.add(&x, &around);
        let x = ops.relu(&x);
        // The image says on which side of a pixel its surface goes on.
        let gate = ops.conv2d(&name("gate"), &self.gate, seen);
        let gate = ops.sigmoid(&gate);
        let x = ops.mul_per_bin(bins, &x, &gate);
        ops.disparity_mix(&name("out"), &self.out, bins, &x)
    }
}

/// Correlation at 1/4 and 1/8, census beside it, an encoder-decoder over 1/8 and 1/16, and beside it one
/// linear mix of the raw costs, which starts as census matching: an untrained network already matches blocks,
/// and training refines that.
#[derive(Module, Debug)]
pub struct Planar {
    match_quarter: Conv2d,
    match_eighth: Conv2d,
    down_eighth: Conv2d,
    join_eighth: Conv2d,
    encoder: Vec<Block>,
    down_sixteenth: Conv2d,
    bottom: Vec<Block>,
    up_eighth: Conv2d,
    gate: Conv2d,
    decoder: Vec<Block>,
    out: DisparityMix,
    finest: Option<Finest>,
    matching: DisparityMix,
    #[module(skip)]
    config: PlanarConfig,
}

impl Planar {
    /// `features` are the channels of the 2-D features at 1/4 and 1/8.
    pub fn init(config: &PlanarConfig, features: [usize; 2], device: &Device) -> Self {
        let [eighth, sixteenth] = config.channels;
        let raw = config.groups[0] + CENSUS_CHANNELS;
        let blocks = |n: usize, channels: usize| {
            (0..n)
                .map(|_| Block::init(channels, device))
                .collect::<Vec<_>>()
        };
        let mut matching = DisparityMix::init([raw, 1], 3, 1.0, device);
        matching.weight =
            Param::from_data(TensorData::new(census_matching(raw), [1, raw, 3]), device);
        Self {
            // A 3x3 one costs as much as a block of the aggregation.
            match_quarter: conv1x1([features[0], config.matching[0]], device),
            match_eighth: conv3x3([features[1], config.matching[1]], 1, device),
            down_eighth: conv3x3([2 * raw, eighth], 2, device),
            join_eighth: conv1x1([config.groups[1], eighth], device),
            encoder: blocks(config.blocks[0], eighth),
            down_sixteenth: conv3x3([2 * eighth, sixteenth], 2, device),
            bottom: blocks(config.blocks[1], sixteenth),
            up_eighth: Conv2dConfig::new([sixteenth, 2 * eighth], [1, 1]).init(device),
            gate: conv1x1([features[1], eighth], device),
            decoder: blocks(config.blocks[2], eighth),
            // Two bins of 2x2 pixels. Small, so that matching speaks first.
            out: DisparityMix::init([eighth, 8], 3, 0.1, device),
            finest: (config.finest > 0)
                .then(|| Finest::init(config.finest, eighth, raw, features[0], device)),
            matching,
            config: config.clone(),
        }
    }

    /// Logits over bins `[B, bins, H/4, W/4]`, near to far; `bins` a multiple of 4.
    pub fn forward<O: Ops>(
        &self,
        ops: &mut O,
        bins: usize,
        features: &FeatureMaps<O::Map>,
        census: &Census<O::Map>,
    ) -> O::Map {
        let [left4, right4] =
            self.matchable(ops, "quarter", &self.match_quarter, &features.quarter);
        let [left8, right8] = self.matchable(ops, "eighth", &self.match_eighth, &features.eighth);
        let learned = |level: usize, left, right| Correlated {
            left,
            right,
            channels: self.config.matching[level],
            groups: self.config.groups[level],
        };
        let [whole, half] = census.correlated();
        let raw = ops.correlate(
            "volume.quarter",
            &[learned(0, &left4, &right4), whole, half],
            bins,
        );
        let coarse = ops.correlate("volume.eighth", &[learned(1, &left8, &right8)], bins / 2);

        let name = |layer: &str| format!("aggregation.{layer}");
        let (bins8, bins16) = (bins / 2, bins / 4);
        let down = ops.conv2d_per_bin(&name("down_eighth"), &self.down_eighth, bins8, &raw);
        let join = ops.conv2d_per_bin(&name("join_eighth"), &self.join_eighth, bins8, &coarse);
        let eighth = ops.add(&down, &join);
        let mut eighth = ops.relu(&eighth);
        for (i, block) in self.encoder.iter().enumerate() {
            eighth = block.forward(ops, &name(&format!("encoder.{i}")), bins8, &eighth);
        }
        let down = ops.conv2d_per_bin(
            &name("down_sixteenth"),
            &self.down_sixteenth,
            bins16,
            &eighth,
        );
        let mut sixteenth = ops.relu(&down);
        for (i, block) in self.bottom.iter().enumerate() {
            sixteenth = block.forward(ops, &name(&format!("bottom.{i}")), bins16, &sixteenth);
        }
        let up = ops.conv2d_per_bin(&name("up_eighth"), &self.up_eighth, bins16, &sixteenth);
        let up = ops.double(&up);
        let up = ops.add(&up, &eighth);
        let up = ops.relu(&up);

        // What the image shows decides which of the costs count there (Bangunharcana 2021, CoEx).
        let (seen, _) = ops.halves(&features.eighth);
        let gate = ops.conv2d(&name("gate"), &self.gate, &seen);
        let gate = ops.sigmoid(&gate);
        let mut up = ops.mul_per_bin(bins8, &up, &gate);
        for (i, block) in self.decoder.iter().enumerate() {
            up = block.forward(ops, &name(&format!("decoder.{i}")), bins8, &up);
        }
        let learned = ops.disparity_mix(&name("out"), &self.out, bins8, &up);
        let mut learned = ops.depth_to_space(2, &learned);
        if let Some(finest) = &self.finest {
            let (seen, _) = ops.halves(&features.quarter);
            let finer = finest.forward(ops, bins8, &up, &raw, &seen);
            learned = ops.add(&learned, &finer);
        }
        let matching = ops.disparity_mix(&name("matching"), &self.matching, bins, &raw);
        ops.add(&learned, &matching)
    }

    /// Unit features of the left and of the right image.
    fn matchable<O: Ops>(
        &self,
        ops: &mut O,
        level: &str,
        layer: &Conv2d,
        features: &O::Map,
    ) -> [O::Map; 2] {
        let channels = layer.weight.dims()[0];
        let y = ops.conv2d(&format!("aggregation.match_{level}"), layer, features);
        let y = unit_length(ops, channels, &y);
        ops.halves(&y).into()
    }
}
