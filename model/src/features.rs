//! 2-D features: what a pixel looks like, at a quarter and an eighth of the resolution.

use burn::module::Module;
use burn::nn::conv::{Conv2d, Conv2dConfig};
use burn::nn::{Initializer, PaddingConfig2d};
use burn::tensor::Device;

use crate::{Kernel, Ops};

/// A 3x3 convolution initialised for a ReLU after it (He 2015).
pub(crate) fn conv3x3(channels: [usize; 2], stride: usize, device: &Device) -> Conv2d {
    Conv2dConfig::new(channels, [3, 3])
        .with_stride([stride, stride])
        .with_padding(PaddingConfig2d::Explicit(1, 1, 1, 1))
        .with_initializer(Initializer::KaimingNormal {
            gain: std::f64::consts::SQRT_2,
            fan_out_only: false,
        })
        .init(device)
}

/// A linear mix of channels at every pixel.
pub(crate) fn conv1x1(channels: [usize; 2], device: &Device) -> Conv2d {
    Conv2dConfig::new(channels, [1, 1]).init(device)
}

/// Down to 1/16 and back up to 1/4 with shortcuts (Lin 2017): a receptive field of about 120 pixels.
#[derive(Module, Debug)]
pub struct Features {
    stem: Conv2d,
    quarter: Conv2d,
    quarter_more: Conv2d,
    eighth: Conv2d,
    eighth_more: Conv2d,
    sixteenth: Conv2d,
    sixteenth_more: Conv2d,
    up_eighth: Conv2d,
    up_quarter: Conv2d,
}

/// What [`Features`] yields.
pub struct FeatureMaps<M> {
    /// At a quarter of the resolution.
    pub quarter: M,
    /// At an eighth.
    pub eighth: M,
}

impl Features {
    /// `channels` at 1/2, 1/4, 1/8 and 1/16.
    pub fn init([half, quarter, eighth, sixteenth]: [usize; 4], device: &Device) -> Self {
        Self {
            stem: conv3x3([3, half], 2, device),
            quarter: conv3x3([half, quarter], 2, device),
            quarter_more: conv3x3([quarter, quarter], 1, device),
            eighth: conv3x3([quarter, eighth], 2, device),
            eighth_more: conv3x3([eighth, eighth], 1, device),
            sixteenth: conv3x3([eighth, sixteenth], 2, device),
            sixteenth_more: conv3x3([sixteenth, sixteenth], 1, device),
            up_eighth: conv1x1([sixteenth, eighth], device),
            up_quarter: conv1x1([eighth, quarter], device),
        }
    }

    /// Features of normalised images `[B, 3, H, W]`, H and W multiples of 16.
    pub fn forward<O: Ops>(&self, ops: &mut O, image: &O::Map) -> FeatureMaps<O::Map> {
        let layer = |ops: &mut O, name: &str, conv: &Conv2d, x: &O::Map| {
            let y = ops.conv2d(&format!("features.{name}"), conv, x);
            ops.relu(&y)
        };
        let half = layer(ops, "stem", &self.stem, image);
        let quarter = layer(ops, "quarter", &self.quarter, &half);
        let quarter = layer(ops, "quarter_more", &self.quarter_more, &quarter);
        let eighth = layer(ops, "eighth", &self.eighth, &quarter);
        let eighth = layer(ops, "eighth_more", &self.eighth_more, &eighth);
        let sixteenth = layer(ops, "sixteenth", &self.sixteenth, &eighth);
        let sixteenth = layer(ops, "sixteenth_more", &self.sixteenth_more, &sixteenth);

        // Channels are mixed below and doubled after: a quarter of the work of a transposed convolution.
        let up = |ops: &mut O, name: &str, conv: &Conv2d, low: &O::Map, high: &O::Map| {
            let y = ops.conv2d(&format!("features.{name}"), conv, low);
            let y = ops.double(&y);
            let y = ops.add(&y, high);
            ops.relu(&y)
        };
        let eighth = up(ops, "up_eighth", &self.up_eighth, &sixteenth, &eighth);
        let quarter = up(ops, "up_quarter", &self.up_quarter, &eighth, &quarter);
        FeatureMaps { quarter, eighth }
    }
}

/// `x` divided by its length over channels, so that bright and faint places match equally well.
pub fn unit_length<O: Ops>(ops: &mut O, channels: usize, x: &O::Map) -> O::Map {
    let square = ops.mul(x, x);
    let sum = Kernel::from_fn([1, channels, 1, 1], |_, _, _, _| 1.0);
    let square = ops.fixed_conv2d("unit_length", &sum, 1, &square);
    let square = ops.affine(1.0, 1e-6, &square);
    let length = ops.sqrt(&square);
    ops.div(x, &length)
}
