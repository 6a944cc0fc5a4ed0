//! Cost volume and aggregation of the paper: features side by side, 3-D convolutions.

use burn::module::{Module, Param};
use burn::nn::conv::{Conv2d, Conv3d, Conv3dConfig, ConvTranspose3d, ConvTranspose3dConfig};
use burn::nn::{Initializer, PaddingConfig3d};
use burn::tensor::{Device, TensorData};
use serde::{Deserialize, Serialize};

use crate::Ops;
use crate::features::{FeatureMaps, conv3x3};
use crate::volume::{CENSUS_CHANNELS, Census, census_matching, concatenation_volume};

/// What shapes [`Volumetric`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VolumetricConfig {
    /// Channels of the features that are put side by side.
    pub matching: usize,
    /// Channels of the 3-D convolutions at 1/4, 1/8 and 1/16.
    pub channels: [usize; 3],
    /// Whether the census costs stand beside the features. The paper has none; without them it takes
    /// hours of training to be right about anything.
    pub census: bool,
}

/// A concatenation volume at 1/4 and an encoder-decoder over 1/4, 1/8 and 1/16 of the resolution (Zhong 2017, of
/// three levels). With census costs, one linear convolution of them runs beside it and starts as census
/// matching.
#[derive(Module, Debug)]
pub struct Volumetric {
    match_quarter: Conv2d,
    quarter: Conv3d,
    quarter_more: Conv3d,
    eighth: Conv3d,
    eighth_more: Conv3d,
    sixteenth: Conv3d,
    sixteenth_more: Conv3d,
    up_eighth: ConvTranspose3d,
    up_quarter: ConvTranspose3d,
    out: Conv3d,
    matching: Option<Conv3d>,
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

impl Volumetric {
    /// `features` are the channels of the 2-D features at 1/4.
    pub fn init(config: &VolumetricConfig, features: usize, device: &Device) -> Self {
        let [quarter, eighth, sixteenth] = config.channels;
        let census = if config.census { CENSUS_CHANNELS } else { 0 };
        let raw = 2 * config.matching + census;
        let matching = config.census.then(|| {
            let mut layer = Conv3dConfig::new([raw, 1], [3, 1, 1])
                .with_padding(PaddingConfig3d::Explicit(1, 0, 0))
                .init(device);
            layer.weight = Param::from_data(
                TensorData::new(census_matching(raw), [1, raw, 3, 1, 1]),
                device,
            );
            layer
        });
        Self {
            match_quarter: conv3x3([features, config.matching], 1, device),
            quarter: conv([raw, quarter], 1, device),
            quarter_more: conv([quarter, quarter], 1, device),
            eighth: conv([quarter, eighth], 2, device),
            eighth_more: conv([eighth, eighth], 1, device),
            sixteenth: conv([eighth, sixteenth], 2, device),
            sixteenth_more: conv([sixteenth, sixteenth], 1, device),
            up_eighth: up([sixteenth, eighth], device),
            up_quarter: up([eighth, quarter], device),
            // Small, so that matching speaks first.
            out: Conv3dConfig::new([quarter, 1], [3; 3])
                .with_padding(PaddingConfig3d::Explicit(1, 1, 1))
                .with_initializer(Initializer::KaimingNormal {
                    gain: 0.1,
                    fan_out_only: false,
                })
                .init(device),
            matching,
        }
    }

    /// Whether [`Volumetric::forward`] wants census descriptors.
    pub fn needs_census(&self) -> bool {
        self.matching.is_some()
    }

    /// Logits over bins `[B, bins, H/4, W/4]`, near to far; `bins` a multiple of 4.
    pub fn forward<O: Ops>(
        &self,
        ops: &mut O,
        bins: usize,
        features: &FeatureMaps<O::Map>,
        census: Option<&Census<O::Map>>,
    ) -> O::Map {
        let matchable = ops.conv2d(
            "aggregation.match_quarter",
            &self.match_quarter,
            &features.quarter,
        );
        let (left, right) = ops.halves(&matchable);
        let mut volume = concatenation_volume(ops, &left, &right, bins);
        if let Some(census) = census {
            let costs = ops.correlate("volume.census", &census.correlated(), bins);
            let costs = ops.as_volume(bins, &costs);
            volume = ops.concat_volumes(&[volume, costs]);
        }

        let layer = |ops: &mut O, name: &str, conv: &Conv3d, x: &O::Volume| {
            let y = ops.conv3d(&format!("aggregation.{name}"), conv, x);
            ops.relu_volume(&y)
        };
        let quarter = layer(ops, "quarter", &self.quarter, &volume);
        let quarter = layer(ops, "quarter_more", &self.quarter_more, &quarter);
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
        let mut logits = ops.conv3d("aggregation.out", &self.out, &up);
        if let Some(layer) = &self.matching {
            let matching = ops.conv3d("aggregation.matching", layer, &volume);
            logits = ops.add_volume(&logits, &matching);
        }
        ops.disparities_as_channels(&logits)
    }
}
