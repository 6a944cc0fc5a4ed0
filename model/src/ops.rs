//! The vocabulary that blocks are written in, and its execution by Burn.

use burn::nn::conv::{Conv2d, Conv3d, ConvTranspose3d};
use burn::tensor::activation::{relu, sigmoid};
use burn::tensor::module::{avg_pool2d, conv2d, interpolate};
use burn::tensor::ops::{
    AvgPoolOptions, ConvOptions, InterpolateMode, InterpolateOptions, PadMode,
};
use burn::tensor::{Device, Tensor, TensorData};

use crate::planar::DisparityMix;

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

/// Two maps whose correlation is asked for.
#[derive(Debug)]
pub struct Correlated<'a, M> {
    /// `[batch, channels, height, width]`.
    pub left: &'a M,
    /// The same of the right image.
    pub right: &'a M,
    /// How many channels there are.
    pub channels: usize,
    /// Channels are summed in this many groups, each one channel of the result.
    pub groups: usize,
}

/// What a block may ask for. `Map` is `[batch, channel, height, width]`, `Volume` is
/// `[batch, channel, disparity, height, width]`. Names label ONNX nodes and say which layer of
/// [`crate::StereoNet`] they come from.
///
/// Where bins of disparity are channels, they count slowest: channel `bin * n + c` of `[batch, bins * n,
/// height, width]`.
///
/// Two-operand arithmetic broadcasts over channels: one operand may have a single channel.
pub trait Ops {
    /// A map of features.
    type Map: Clone;
    /// A volume over disparities.
    type Volume: Clone;

    /// A learned convolution.
    fn conv2d(&mut self, name: &str, layer: &Conv2d, x: &Self::Map) -> Self::Map;
    /// A learned convolution of each of `bins` equal shares of the channels, the same for all.
    fn conv2d_per_bin(
        &mut self,
        name: &str,
        layer: &Conv2d,
        bins: usize,
        x: &Self::Map,
    ) -> Self::Map;
    /// [`Ops::conv2d_per_bin`] of single pixels, then [`Ops::depth_to_space`] of 2: a transposed convolution with a bias
    /// for each of the four pixels.
    fn doubling_conv2d_per_bin(
        &mut self,
        name: &str,
        layer: &Conv2d,
        bins: usize,
        x: &Self::Map,
    ) -> Self::Map;
    /// A learned convolution over `bins` at every pixel, zero outside.
    fn disparity_mix(
        &mut self,
        name: &str,
        layer: &DisparityMix,
        bins: usize,
        x: &Self::Map,
    ) -> Self::Map;
    /// How well left and right match: sums over a group's channels of `left(x) right(x - d)` for the
    /// `bins` whole disparities, near to far (`d = bins - 1` first); zero where `x - d` is outside. Channels
    /// are `bins * (groups of the first, of the second, ...)`.
    fn correlate(
        &mut self,
        name: &str,
        pairs: &[Correlated<'_, Self::Map>],
        bins: usize,
    ) -> Self::Map;
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
    /// `1 / (1 + exp(-x))`.
    fn sigmoid(&mut self, x: &Self::Map) -> Self::Map;
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
    /// Each of `bins` equal shares of the channels of `a` times `b`.
    fn mul_per_bin(&mut self, bins: usize, a: &Self::Map, b: &Self::Map) -> Self::Map;
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
    /// The mean of the channels at every pixel.
    fn channel_mean(&mut self, x: &Self::Map) -> Self::Map;
    /// The mean over windows of `size` x `size`, every `stride` pixels, without padding.
    fn average_pool(&mut self, size: usize, stride: usize, x: &Self::Map) -> Self::Map;
    /// The largest channel at every pixel; a constant to the gradient.
    fn channel_max(&mut self, x: &Self::Map) -> Self::Map;
    /// The number of the largest channel at every pixel.
    fn channel_argmax(&mut self, x: &Self::Map) -> Self::Map;
    /// Weighted means of the 3x3 neighbours of every pixel, `reach` pixels apart (row by row, the border repeated):
    /// channel `n * shares + s` of `weights` is that of neighbour `n` in share `s`. Each of the `channels` of `x`
    /// becomes `shares` channels.
    fn mean_of_neighbours(
        &mut self,
        name: &str,
        shares: usize,
        reach: usize,
        weights: &Self::Map,
        channels: usize,
        x: &Self::Map,
    ) -> Self::Map;
    /// One constant a channel, `[1, n, 1, 1]`.
    fn channel_constant(&mut self, name: &str, values: &[f32]) -> Self::Map;
    /// `a + b`.
    fn add_volume(&mut self, a: &Self::Volume, b: &Self::Volume) -> Self::Volume;

    /// One batch after the other.
    fn join(&mut self, first: &Self::Map, second: &Self::Map) -> Self::Map;
    /// Undoes [`Ops::join`].
    fn halves(&mut self, x: &Self::Map) -> (Self::Map, Self::Map);
    /// Each channel for itself.
    fn split_channels<const N: usize>(&mut self, x: &Self::Map) -> [Self::Map; N];
    /// Maps after one another as channels.
    fn concat(&mut self, maps: &[Self::Map]) -> Self::Map;
    /// Volumes after one another as channels.
    fn concat_volumes(&mut self, volumes: &[Self::Volume]) -> Self::Volume;
    /// Maps as the disparities of a volume.
    fn stack(&mut self, maps: &[Self::Map]) -> Self::Volume;
    /// A map of `bins` bins as a volume.
    fn as_volume(&mut self, bins: usize, x: &Self::Map) -> Self::Volume;
    /// A volume of one channel as a map whose channels are its disparities.
    fn disparities_as_channels(&mut self, x: &Self::Volume) -> Self::Map;
    /// `out(x) = in(x - by)`; zero where that is outside.
    fn shift_right(&mut self, by: usize, x: &Self::Map) -> Self::Map;
    /// The border pixels repeated outwards, `[left, right, top, bottom]` times.
    fn pad_edge(&mut self, by: [usize; 4], x: &Self::Map) -> Self::Map;
    /// The last row and column repeated until height and width are multiples.
    fn pad_to_multiple(&mut self, multiple: usize, x: &Self::Map) -> Self::Map;
    /// `x` cut to the height and width of `like`.
    fn crop_to(&mut self, like: &Self::Map, x: &Self::Map) -> Self::Map;
    /// Every pixel twice in height and in width.
    fn double(&mut self, x: &Self::Map) -> Self::Map;
    /// Every `r * r` channels to one of `r` times the height and width.
    fn depth_to_space(&mut self, r: usize, x: &Self::Map) -> Self::Map;
}

/// Pixels of a 3x3 neighbourhood.
pub(crate) const NEIGHBOURS: usize = 9;
/// What is added to a sum of weights, so that it is never zero.
pub(crate) const LEAST_WEIGHT: f32 = 1e-12;

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
    fn conv2d_per_bin(&mut self, _: &str, layer: &Conv2d, bins: usize, x: &Tensor<4>) -> Tensor<4> {
        let [batch, channels, height, width] = x.dims();
        let y = layer.forward(
            x.clone()
                .reshape([batch * bins, channels / bins, height, width]),
        );
        let [_, channels, height, width] = y.dims();
        y.reshape([batch, bins * channels, height, width])
    }
    fn doubling_conv2d_per_bin(
        &mut self,
        name: &str,
        layer: &Conv2d,
        bins: usize,
        x: &Tensor<4>,
    ) -> Tensor<4> {
        let y = self.conv2d_per_bin(name, layer, bins, x);
        self.depth_to_space(2, &y)
    }
    fn disparity_mix(
        &mut self,
        _: &str,
        layer: &DisparityMix,
        bins: usize,
        x: &Tensor<4>,
    ) -> Tensor<4> {
        let (weight, bias) = layer.banded(bins);
        conv2d(
            x.clone(),
            weight,
            Some(bias),
            ConvOptions::new([1; 2], [0; 2], [1; 2], 1),
        )
    }
    fn correlate(
        &mut self,
        _: &str,
        pairs: &[Correlated<'_, Tensor<4>>],
        bins: usize,
    ) -> Tensor<4> {
        let volumes = pairs.iter().map(|pair| correlation(pair, bins)).collect();
        let volume = Tensor::cat(volumes, 1);
        let [batch, channels, height, width, _] = volume.dims();
        volume
            .permute([0, 4, 1, 2, 3])
            .reshape([batch, bins * channels, height, width])
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
    fn sigmoid(&mut self, x: &Tensor<4>) -> Tensor<4> {
        sigmoid(x.clone())
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
    fn mul_per_bin(&mut self, bins: usize, a: &Tensor<4>, b: &Tensor<4>) -> Tensor<4> {
        a.clone() * b.clone().repeat_dim(1, bins)
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
    fn channel_mean(&mut self, x: &Tensor<4>) -> Tensor<4> {
        x.clone().mean_dim(1)
    }
    fn average_pool(&mut self, size: usize, stride: usize, x: &Tensor<4>) -> Tensor<4> {
        avg_pool2d(
            x.clone(),
            AvgPoolOptions::new([size; 2]).with_stride([stride; 2]),
        )
    }
    fn channel_max(&mut self, x: &Tensor<4>) -> Tensor<4> {
        x.clone().detach().max_dim(1)
    }
    fn channel_argmax(&mut self, x: &Tensor<4>) -> Tensor<4> {
        x.clone().detach().argmax(1).float()
    }
    fn mean_of_neighbours(
        &mut self,
        _: &str,
        shares: usize,
        reach: usize,
        weights: &Tensor<4>,
        channels: usize,
        x: &Tensor<4>,
    ) -> Tensor<4> {
        let [batch, _, height, width] = x.dims();
        let padded = x.clone().pad((reach, reach, reach, reach), PadMode::Edge);
        let around = (0..NEIGHBOURS)
            .map(|n| {
                let row = padded.clone().narrow(2, reach * (n / 3), height);
                row.narrow(3, reach * (n % 3), width)
            })
            .collect();
        let pixels = height * width;
        let around: Tensor<5> =
            Tensor::stack::<5>(around, 2).reshape([batch, channels, NEIGHBOURS, 1, pixels]);
        let weights = (weights.clone()).reshape([batch, 1, NEIGHBOURS, shares, pixels]);
        let total = weights.clone().sum_dim(2) + LEAST_WEIGHT;
        let mean = (weights * around).sum_dim(2) / total;
        mean.reshape([batch, channels * shares, height, width])
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

    fn join(&mut self, first: &Tensor<4>, second: &Tensor<4>) -> Tensor<4> {
        Tensor::cat(vec![first.clone(), second.clone()], 0)
    }
    fn halves(&mut self, x: &Tensor<4>) -> (Tensor<4>, Tensor<4>) {
        let half = x.dims()[0] / 2;
        (
            x.clone().narrow(0, 0, half),
            x.clone().narrow(0, half, half),
        )
    }
    fn split_channels<const N: usize>(&mut self, x: &Tensor<4>) -> [Tensor<4>; N] {
        std::array::from_fn(|k| x.clone().narrow(1, k, 1))
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
    fn as_volume(&mut self, bins: usize, x: &Tensor<4>) -> Tensor<5> {
        let [batch, channels, height, width] = x.dims();
        x.clone()
            .reshape([batch, bins, channels / bins, height, width])
            .swap_dims(1, 2)
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
    fn pad_edge(&mut self, [left, right, top, bottom]: [usize; 4], x: &Tensor<4>) -> Tensor<4> {
        x.clone().pad((left, right, top, bottom), PadMode::Edge)
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
    fn double(&mut self, x: &Tensor<4>) -> Tensor<4> {
        let nearest = InterpolateOptions::new(InterpolateMode::Nearest);
        interpolate(x.clone(), nearest.with_scale_factor([2.0; 2]))
    }
    fn depth_to_space(&mut self, r: usize, x: &Tensor<4>) -> Tensor<4> {
        let [batch, channels, height, width] = x.dims();
        let channels = channels / (r * r);
        x.clone()
            .reshape([batch, channels, r, r, height, width])
            .permute([0, 1, 4, 2, 5, 3])
            .reshape([batch, channels, height * r, width * r])
    }
}

/// One part of [`Ops::correlate`], `[batch, group, height, width, bin]`.
///
/// Rows are cut into blocks of `bins` columns. A block of the left row times the two blocks of the right row
/// that its disparities reach into is a small matrix, whose diagonals are the disparities: written with one
/// column more, row after row, they come to lie below one another.
fn correlation(pair: &Correlated<'_, Tensor<4>>, bins: usize) -> Tensor<5> {
    let [batch, channels, height, width] = pair.left.dims();
    let blocks = width.div_ceil(bins);
    let (whole, size) = (blocks * bins, channels / pair.groups);
    // `[batch, group, height * block, channel, column]` of the map moved right by `by`.
    let cut = |x: &Tensor<4>, by: usize| {
        x.clone()
            .pad((by, whole - width, 0, 0), PadMode::Constant(0.0))
            .narrow(3, 0, whole)
            .reshape([batch, pair.groups, size, height * blocks, bins])
            .swap_dims(2, 3)
    };
    let left = cut(pair.left, 0).swap_dims(3, 4);
    let right = Tensor::cat(vec![cut(pair.right, bins), cut(pair.right, 0)], 4);
    let products = left.matmul(right);
    products
        .reshape([batch, pair.groups, height * blocks, 2 * bins * bins])
        .pad((0, bins, 0, 0), PadMode::Constant(0.0))
        .reshape([batch, pair.groups, height * blocks, bins, 2 * bins + 1])
        .narrow(4, 1, bins)
        .reshape([batch, pair.groups, height, whole, bins])
        .narrow(3, 0, width)
}
