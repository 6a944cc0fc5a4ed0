//! 3-D convolutions over the cost volume: neighbours in the image and in disparity agree.

use burn::module::{Module, Param};
use burn::nn::conv::{Conv3d, Conv3dConfig, ConvTranspose3d, ConvTranspose3dConfig};
use burn::nn::{Initializer, PaddingConfig3d};
use burn::tensor::{Device, TensorData};

use crate::Ops;
use crate::volume::CENSUS_CHANNELS;

/// How sharply census agreement alone decides at the start: a step of 0.05 in agreement is a factor
/// of e in probability.
const CENSUS_GAIN: f32 = 20.0;

/// An encoder-decoder over 1/4, 1/8 and 1/16 of the resolution (Zhong 2017, of three levels), and
/// beside it one linear convolution of the raw volume, which starts as census matching: an untrained
/// network already matches blocks, and training refines that.
#[derive(Module, Debug)]
pub struct Aggregation {
    quarter: Conv3d,
    eighth: Conv3d,
    eighth_more: Conv3d,
    sixteenth: Conv3d,
    sixteenth_more: Conv3d,
    up_eighth: ConvTranspose3d,
    up_quarter: ConvTranspose3d,
    out: Conv3d,
    matching: Conv3d,
}

/// A 3x3x3 convolution initialised for a ReLU after it (He 2015).
fn conv(channels: [usize; 2], stride: usize, device: &Device) -> Conv3d {
    Conv3dConfig::new(channels, [3; 3])
        .with_stride([stride; 3])
        .with_padding(PaddingConfig3d::Explicit(1, 1, 1))
        .with_initializer(Initializer::KaimingNormal {
            gain: std::f64::consts::SQRT_2,
            fan_out_only: false,
        })
        .init(device)
}

/// Doubles disparities, height and width exactly.
fn up(channels: [usize; 2], device: &Device) -> ConvTranspose3d {
    ConvTranspose3dConfig::new(channels, [4; 3])
        .with_stride([2; 3])
        .with_padding([1; 3])
        .init(device)
}

impl Aggregation {
    /// `channels` at 1/4, 1/8 and 1/16; `input` channels, the last two being the census's.
    pub fn init(input: usize, [quarter, eighth, sixteenth]: [usize; 3], device: &Device) -> Self {
        let mut matching = Conv3dConfig::new([input, 1], [3, 1, 1])
            .with_padding(PaddingConfig3d::Explicit(1, 0, 0))
            .init(device);
        matching.weight = Param::from_data(census_matching(input), device);
        Self {
            quarter: conv([input, quarter], 1, device),
            eighth: conv([quarter, eighth], 2, device),
            eighth_more: conv([eighth, eighth], 1, device),
            sixteenth: conv([eighth, sixteenth], 2, device),
            sixteenth_more: conv([sixteenth, sixteenth], 1, device),
            up_eighth: up([sixteenth, eighth], device),
            up_quarter: up([eighth, quarter], device),
            // Small, so that the matching convolution speaks first.
            out: Conv3dConfig::new([quarter, 1], [1; 3])
                .with_initializer(Initializer::KaimingNormal {
                    gain: 0.1,
                    fan_out_only: false,
                })
                .init(device),
            matching,
        }
    }

    /// Logits over disparities `[B, D, H, W]` from the volume `[B, C, D, H, W]`; D, H and W
    /// multiples of 4.
    pub fn forward<O: Ops>(&self, ops: &mut O, volume: &O::Volume) -> O::Map {
        let layer = |ops: &mut O, name: &str, conv: &Conv3d, x: &O::Volume| {
            let y = ops.conv3d(&format!("aggregation.{name}"), conv, x);
            ops.relu_volume(&y)
        };
        let quarter = layer(ops, "quarter", &self.quarter, volume);
        let eighth = layer(ops, "eighth", &self.eighth, &quarter);
        let eighth = layer(ops, "eighth_more", &self.eighth_more, &eighth);
        let sixteenth = layer(ops, "sixteenth", &self.sixteenth, &eighth);
        let sixteenth = layer(ops, "sixteenth_more", &self.sixteenth_more, &sixteenth);
        let up = ops.conv_transpose3d("aggregation.up_eighth", &self.up_eighth, &sixteenth);
        let up = ops.add_volume(&up, &eighth);
        let up = ops.relu_volume(&up);
        let up = ops.conv_transpose3d("aggregation.up_quarter", &self.up_quarter, &up);
        let up = ops.add_volume(&up, &quarter);
        let up = ops.relu_volume(&up);
        let learned = ops.conv3d("aggregation.out", &self.out, &up);
        let matching = ops.conv3d("aggregation.matching", &self.matching, volume);
        let logits = ops.add_volume(&learned, &matching);
        ops.disparities_as_channels(&logits)
    }
}

/// A kernel over disparity alone: the whole bin fully, the half bins before and behind it by half.
fn census_matching(input: usize) -> TensorData {
    let mut data = vec![0.0f32; input * 3];
    let whole = 3 * (input - CENSUS_CHANNELS);
    data[whole + 1] = 0.5 * CENSUS_GAIN;
    data[whole + 3] = 0.25 * CENSUS_GAIN;
    data[whole + 4] = 0.25 * CENSUS_GAIN;
    TensorData::new(data, [1, input, 3, 1, 1])
}
