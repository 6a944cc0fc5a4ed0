//! The vocabulary that blocks are written in, and its execution by Burn.

use burn::nn::conv::{Conv2d, Conv3d, ConvTranspose2d, ConvTranspose3d};
use burn::tensor::activation::{relu, softmax};
use burn::tensor::module::conv2d;
use burn::tensor::ops::{ConvOptions, PadMode};
use burn::tensor::{Device, Tensor, TensorData};

/// A convolution kernel that is not learned: `[out, in, height, width]`.
#[derive(Clone, Debug)]
pub struct Kernel {
    /// Output channels, input channels, height, width.
    pub shape: [usize; 4],
    /// The weights, row by row.
    pub data: Vec<f32>,
}

impl Kernel {
    /// A kernel from its value at `(out, in, y, x)`.
    pub fn from_fn(shape: [usize; 4], value: impl Fn(usize, usize, usize, usize) -> f32) -> Self {
        let [o, i, h, w] = shape;
        let mut data = Vec::with_capacity(o * i * h * w);
        for a in 0..o {
            for b in 0..i {
                for y in 0..h {
                    for x in 0..w {
                        data.push(value(a, b, y, x));
                    }
                }
            }
        }
        Self { shape, data }
    }
}

/// What a block may ask for. `Map` is `[batch, channel, height, width]`, `Volume` is
/// `[batch, channel, disparity, height, width]`. Names label ONNX nodes and say which layer of
/// [`crate::StereoNet`] they come from.
///
/// Two-operand arithmetic broadcasts over channels: one operand may have a single channel.
pub trait Ops {
    /// A map of features.
    type Map: Clone;
    /// A volume over disparities.
    type Volume: Clone;

    /// A learned convolution.
    fn conv2d(&mut self, name: &str, layer: &Conv2d, x: &Self::Map) -> Self::Map;
    /// A learned transposed convolution.
    fn conv_transpose2d(&mut self, name: &str, layer: &ConvTranspose2d, x: &Self::Map)
    -> Self::Map;
    /// A learned convolution over disparity, height and width.
    fn conv3d(&mut self, name: &str, layer: &Conv3d, x: &Self::Volume) -> Self::Volume;
    /// A learned transposed convolution over disparity, height and width.
    fn conv_transpose3d(
        &mut self,
        name: &str,
        layer: &ConvTranspose3d,
        x: &Self::Volume,
    ) -> Self::Volume;
    /// A convolution with a given kernel, without padding.
    fn fixed_conv2d(
        &mut self,
        name: &str,
        kernel: &Kernel,
        stride: usize,
        x: &Self::Map,
    ) -> Self::Map;

    /// `max(x, 0)`.
    fn relu(&mut self, x: &Self::Map) -> Self::Map;
    /// `max(x, 0)`.
    fn relu_volume(&mut self, x: &Self::Volume) -> Self::Volume;
    /// Each channel of each image to zero mean and unit variance.
    fn instance_norm(&mut self, channels: usize, epsilon: f64, x: &Self::Map) -> Self::Map;
    /// `a + b`.
    fn add(&mut self, a: &Self::Map, b: &Self::Map) -> Self::Map;
    /// `a - b`.
    fn sub(&mut self, a: &Self::Map, b: &Self::Map) -> Self::Map;
    /// `a b`.
    fn mul(&mut self, a: &Self::Map, b: &Self::Map) -> Self::Map;
    /// `a / b`.
    fn div(&mut self, a: &Self::Map, b: &Self::Map) -> Self::Map;
    /// `scale x + offset`.
    fn affine(&mut self, scale: f32, offset: f32, x: &Self::Map) -> Self::Map;
    /// Square root.
    fn sqrt(&mut self, x: &Self::Map) -> Self::Map;
    /// Exponential.
    fn exp(&mut self, x: &Self::Map) -> Self::Map;
    /// The largest whole number not above.
    fn floor(&mut self, x: &Self::Map) -> Self::Map;
    /// Magnitude.
    fn abs(&mut self, x: &Self::Map) -> Self::Map;
    /// `x` limited to `low..=high`.
    fn clamp(&mut self, low: f32, high: f32, x: &Self::Map) -> Self::Map;
    /// Softmax over channels.
    fn softmax(&mut self, x: &Self::Map) -> Self::Map;
    /// One constant a channel, `[1, n, 1, 1]`.
    fn channel_constant(&mut self, name: &str, values: &[f32]) -> Self::Map;
    /// `a + b`.
    fn add_volume(&mut self, a: &Self::Volume, b: &Self::Volume) -> Self::Volume;

    /// Maps after one another as channels.
    fn concat(&mut self, maps: &[Self::Map]) -> Self::Map;
    /// Volumes after one another as channels.
    fn concat_volumes(&mut self, volumes: &[Self::Volume]) -> Self::Volume;
    /// Maps as the disparities of a volume.
    fn stack(&mut self, maps: &[Self::Map]) -> Self::Volume;
    /// A volume of one channel as a map whose channels are its disparities.
    fn disparities_as_channels(&mut self, x: &Self::Volume) -> Self::Map;
    /// `out(x) = in(x - by)`; zero where that is outside.
    fn shift_right(&mut self, by: usize, x: &Self::Map) -> Self::Map;
    /// The border pixels repeated outwards.
    fn pad_edge(&mut self, by: usize, x: &Self::Map) -> Self::Map;
    /// The last row and column repeated until height and width are multiples.
    fn pad_to_multiple(&mut self, multiple: usize, x: &Self::Map) -> Self::Map;
    /// `x` cut to the height and width of `like`.
    fn crop_to(&mut self, like: &Self::Map, x: &Self::Map) -> Self::Map;
    /// Blocks of `r * r` channels to `r` times the height and width (one channel out).
    fn depth_to_space(&mut self, r: usize, x: &Self::Map) -> Self::Map;
}

/// Executes at once, with Burn.
pub struct Execute {
    device: Device,
}

impl Execute {
    /// Constants are made on the device of the input.
    pub fn on(device: Device) -> Self {
        Self { device }
    }
}

impl Ops for Execute {
    type Map = Tensor<4>;
    type Volume = Tensor<5>;

    fn conv2d(&mut self, _: &str, layer: &Conv2d, x: &Tensor<4>) -> Tensor<4> {
        layer.forward(x.clone())
    }
    fn conv_transpose2d(&mut self, _: &str, layer: &ConvTranspose2d, x: &Tensor<4>) -> Tensor<4> {
        layer.forward(x.clone())
    }
    fn conv3d(&mut self, _: &str, layer: &Conv3d, x: &Tensor<5>) -> Tensor<5> {
        layer.forward(x.clone())
    }
    fn conv_transpose3d(&mut self, _: &str, layer: &ConvTranspose3d, x: &Tensor<5>) -> Tensor<5> {
        layer.forward(x.clone())
    }
    fn fixed_conv2d(
        &mut self,
        _: &str,
        kernel: &Kernel,
        stride: usize,
        x: &Tensor<4>,
    ) -> Tensor<4> {
        let weight = Tensor::<4>::from_data(
            TensorData::new(kernel.data.clone(), kernel.shape),
            &self.device,
        );
        conv2d(
            x.clone(),
            weight,
            None,
            ConvOptions::new([stride; 2], [0; 2], [1; 2], 1),
        )
    }

    fn relu(&mut self, x: &Tensor<4>) -> Tensor<4> {
        relu(x.clone())
    }
    fn relu_volume(&mut self, x: &Tensor<5>) -> Tensor<5> {
        relu(x.clone())
    }
    fn instance_norm(&mut self, _: usize, epsilon: f64, x: &Tensor<4>) -> Tensor<4> {
        let centred = x.clone() - x.clone().mean_dims(&[2, 3]);
        let variance = centred.clone().square().mean_dims(&[2, 3]);
        centred / (variance + epsilon).sqrt()
    }
    fn add(&mut self, a: &Tensor<4>, b: &Tensor<4>) -> Tensor<4> {
        a.clone() + b.clone()
    }
    fn sub(&mut self, a: &Tensor<4>, b: &Tensor<4>) -> Tensor<4> {
        a.clone() - b.clone()
    }
    fn mul(&mut self, a: &Tensor<4>, b: &Tensor<4>) -> Tensor<4> {
        a.clone() * b.clone()
    }
    fn div(&mut self, a: &Tensor<4>, b: &Tensor<4>) -> Tensor<4> {
        a.clone() / b.clone()
    }
    fn affine(&mut self, scale: f32, offset: f32, x: &Tensor<4>) -> Tensor<4> {
        x.clone() * scale + offset
    }
    fn sqrt(&mut self, x: &Tensor<4>) -> Tensor<4> {
        x.clone().sqrt()
    }
    fn exp(&mut self, x: &Tensor<4>) -> Tensor<4> {
        x.clone().exp()
    }
    fn floor(&mut self, x: &Tensor<4>) -> Tensor<4> {
        x.clone().floor()
    }
    fn abs(&mut self, x: &Tensor<4>) -> Tensor<4> {
        x.clone().abs()
    }
    fn clamp(&mut self, low: f32, high: f32, x: &Tensor<4>) -> Tensor<4> {
        x.clone().clamp(low, high)
    }
    fn softmax(&mut self, x: &Tensor<4>) -> Tensor<4> {
        softmax(x.clone(), 1)
    }
    fn channel_constant(&mut self, _: &str, values: &[f32]) -> Tensor<4> {
        Tensor::from_data(
            TensorData::new(values.to_vec(), [1, values.len(), 1, 1]),
            &self.device,
        )
    }
    fn add_volume(&mut self, a: &Tensor<5>, b: &Tensor<5>) -> Tensor<5> {
        a.clone() + b.clone()
    }

    fn concat(&mut self, maps: &[Tensor<4>]) -> Tensor<4> {
        Tensor::cat(maps.to_vec(), 1)
    }
    fn concat_volumes(&mut self, volumes: &[Tensor<5>]) -> Tensor<5> {
        Tensor::cat(volumes.to_vec(), 1)
    }
    fn stack(&mut self, maps: &[Tensor<4>]) -> Tensor<5> {
        Tensor::stack(maps.to_vec(), 2)
    }
    fn disparities_as_channels(&mut self, x: &Tensor<5>) -> Tensor<4> {
        x.clone().squeeze_dim(1)
    }
    fn shift_right(&mut self, by: usize, x: &Tensor<4>) -> Tensor<4> {
        let width = x.dims()[3];
        match by {
            0 => x.clone(),
            by if by >= width => x.zeros_like(),
            by => x
                .clone()
                .narrow(3, 0, width - by)
                .pad((by, 0, 0, 0), PadMode::Constant(0.0)),
        }
    }
    fn pad_edge(&mut self, by: usize, x: &Tensor<4>) -> Tensor<4> {
        x.clone().pad((by, by, by, by), PadMode::Edge)
    }
    fn pad_to_multiple(&mut self, multiple: usize, x: &Tensor<4>) -> Tensor<4> {
        let [_, _, height, width] = x.dims();
        let [below, right] = [height, width].map(|n| n.next_multiple_of(multiple) - n);
        if below + right == 0 {
            return x.clone();
        }
        x.clone().pad((0, right, 0, below), PadMode::Edge)
    }
    fn crop_to(&mut self, like: &Tensor<4>, x: &Tensor<4>) -> Tensor<4> {
        let [_, _, height, width] = like.dims();
        x.clone().narrow(2, 0, height).narrow(3, 0, width)
    }
    fn depth_to_space(&mut self, r: usize, x: &Tensor<4>) -> Tensor<4> {
        let [batch, _, height, width] = x.dims();
        x.clone()
            .reshape([batch, r, r, height, width])
            .permute([0, 3, 1, 4, 2])
            .reshape([batch, 1, height * r, width * r])
    }
}
