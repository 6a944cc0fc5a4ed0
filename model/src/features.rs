//! 2-D features: what a pixel looks like, at a quarter of the resolution.

use burn::module::Module;
use burn::nn::conv::{Conv2d, Conv2dConfig, ConvTranspose2d, ConvTranspose2dConfig};
use burn::nn::{Initializer, PaddingConfig2d};
use burn::tensor::Device;

use crate::Ops;

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

/// Down to 1/8 and back to 1/4, with a shortcut: a receptive field of about 60 pixels.
#[derive(Module, Debug)]
pub struct Features {
    half: Conv2d,
    half_more: Conv2d,
    quarter: Conv2d,
    quarter_more: Conv2d,
    eighth: Conv2d,
    eighth_more: Conv2d,
    up: ConvTranspose2d,
    matching: Conv2d,
}

/// What [`Features`] yields, both at a quarter of the resolution.
pub struct FeatureMaps<M> {
    /// For matching: unit length over its channels at every pixel.
    pub matching: M,
    /// What the image looks like there, for up-sampling.
    pub context: M,
}

impl Features {
    /// `channels` at 1/2, 1/4 and 1/8, and of the matching features.
    pub fn init([half, quarter, eighth]: [usize; 3], matching: usize, device: &Device) -> Self {
        Self {
            half: conv3x3([3, half], 2, device),
            half_more: conv3x3([half, half], 1, device),
            quarter: conv3x3([half, quarter], 2, device),
            quarter_more: conv3x3([quarter, quarter], 1, device),
            eighth: conv3x3([quarter, eighth], 2, device),
            eighth_more: conv3x3([eighth, eighth], 1, device),
            // Kernel 4, stride 2, padding 1 doubles exactly and overlaps evenly.
            up: ConvTranspose2dConfig::new([eighth, quarter], [4, 4])
                .with_stride([2, 2])
                .with_padding([1, 1])
                .init(device),
            matching: conv3x3([quarter, matching], 1, device),
        }
    }

    /// Features of normalised images `[B, 3, H, W]`, H and W multiples of 8.
    pub fn forward<O: Ops>(&self, ops: &mut O, scope: &str, image: &O::Map) -> FeatureMaps<O::Map> {
        let layer = |ops: &mut O, name: &str, conv: &Conv2d, x: &O::Map| {
            let y = ops.conv2d(&format!("{scope}.{name}"), conv, x);
            ops.relu(&y)
        };
        let half = layer(ops, "half", &self.half, image);
        let half = layer(ops, "half_more", &self.half_more, &half);
        let quarter = layer(ops, "quarter", &self.quarter, &half);
        let quarter = layer(ops, "quarter_more", &self.quarter_more, &quarter);
        let eighth = layer(ops, "eighth", &self.eighth, &quarter);
        let eighth = layer(ops, "eighth_more", &self.eighth_more, &eighth);
        let up = ops.conv_transpose2d(&format!("{scope}.up"), &self.up, &eighth);
        let context = ops.add(&quarter, &up);
        let context = ops.relu(&context);
        let matching = ops.conv2d(&format!("{scope}.matching"), &self.matching, &context);
        FeatureMaps {
            matching: unit_length(ops, scope, &matching, self.matching.weight.dims()[0]),
            context,
        }
    }
}

/// `x / |x|` over channels, so that correlation compares direction and not brightness.
fn unit_length<O: Ops>(ops: &mut O, scope: &str, x: &O::Map, channels: usize) -> O::Map {
    let squared = ops.mul(x, x);
    let sum = crate::Kernel::from_fn([1, channels, 1, 1], |_, _, _, _| 1.0);
    let norm2 = ops.fixed_conv2d(&format!("{scope}.norm"), &sum, 1, &squared);
    let norm2 = ops.affine(1.0, 1e-4, &norm2);
    let norm = ops.sqrt(&norm2);
    ops.div(x, &norm)
}
