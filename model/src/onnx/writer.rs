//! The vocabulary of blocks, written down as ONNX nodes.

use barchan_onnx::GraphBuilder;
use barchan_onnx::proto::{Attribute, FLOAT};
use burn::module::Param;
use burn::nn::conv::{Conv2d, Conv3d, ConvTranspose3d};
use burn::nn::{PaddingConfig2d, PaddingConfig3d};
use burn::tensor::Tensor;

use crate::ops::{LEAST_WEIGHT, NEIGHBOURS};
use crate::planar::DisparityMix;
use crate::{Correlated, Kernel, Ops};

/// Writes what blocks ask for into a graph; a value is the name of the node's output.
#[derive(Default)]
pub struct GraphWriter {
    pub graph: GraphBuilder,
}

impl GraphWriter {
    /// A learned tensor. Both images pass the same layer, so it may be there already.
    fn parameter<const D: usize>(&mut self, name: &str, value: &Tensor<D>) -> String {
        self.graph.shared(name, &value.dims(), || values(value))
    }

    /// A learned convolution; `pads` are those before every axis, then those after.
    fn convolution<const D: usize>(
        &mut self,
        op: &str,
        name: &str,
        weight: &Param<Tensor<D>>,
        bias: &Option<Param<Tensor<1>>>,
        [kernel, stride, pads]: [&[usize]; 3],
        x: &str,
    ) -> String {
        let mut inputs = vec![
            x.to_owned(),
            self.parameter(&format!("{name}.weight"), &weight.val()),
        ];
        if let Some(bias) = bias {
            inputs.push(self.parameter(&format!("{name}.bias"), &bias.val()));
        }
        let inputs: Vec<&str> = inputs.iter().map(String::as_str).collect();
        let attributes = vec![
            Attribute::ints("kernel_shape", kernel),
            Attribute::ints("strides", stride),
            Attribute::ints("pads", pads),
        ];
        self.graph.node(name, op, &inputs, attributes)
    }

    fn height_and_width(&mut self, x: &str) -> String {
        let shape = self.graph.plain("Shape", &[x], vec![]);
        let (from, to) = (self.graph.ints(&[2]), self.graph.ints(&[4]));
        self.graph.plain("Slice", &[&shape, &from, &to], vec![])
    }

    /// Height and width, each a list of one.
    fn sides(&mut self, x: &str) -> [String; 2] {
        let shape = self.graph.plain("Shape", &[x], vec![]);
        [2, 3].map(|axis| {
            let (from, to) = (self.graph.ints(&[axis]), self.graph.ints(&[axis + 1]));
            self.graph.plain("Slice", &[&shape, &from, &to], vec![])
        })
    }

    /// What `sizes` lack to the next multiple.
    fn missing(&mut self, sizes: &str, multiple: i64) -> String {
        let multiple = self.graph.ints(&[multiple]);
        let over = self.graph.plain("Mod", &[sizes, &multiple], vec![]);
        let missing = self.graph.plain("Sub", &[&multiple, &over], vec![]);
        self.graph.plain("Mod", &[&missing, &multiple], vec![])
    }

    /// Lists of whole numbers after one another.
    fn concat_shape(&mut self, parts: &[&str]) -> String {
        self.graph
            .plain("Concat", parts, vec![Attribute::int("axis", 0)])
    }

    /// The channels of `x` counted anew, the batch following.
    fn channels_reshaped(&mut self, name: &str, channels: usize, x: &str) -> String {
        let size = self.height_and_width(x);
        let start = self.graph.ints(&[-1, channels as i64]);
        let shape = self.concat_shape(&[&start, &size]);
        self.graph.node(name, "Reshape", &[x, &shape], vec![])
    }
}

fn values<const D: usize>(tensor: &Tensor<D>) -> Vec<f32> {
    tensor.to_data().iter::<f32>().collect()
}

fn padding_2d(padding: &PaddingConfig2d) -> [usize; 4] {
    match padding {
        PaddingConfig2d::Explicit(top, left, bottom, right) => [*top, *left, *bottom, *right],
        PaddingConfig2d::Valid | PaddingConfig2d::Same => [0; 4],
    }
}

fn padding_3d(padding: &PaddingConfig3d) -> [usize; 3] {
    match padding {
        PaddingConfig3d::Explicit(depth, height, width) => [*depth, *height, *width],
        PaddingConfig3d::Valid | PaddingConfig3d::Same => [0; 3],
    }
}

/// Both ends of every axis.
fn both_ends(padding: &[usize]) -> Vec<usize> {
    padding.iter().chain(padding).copied().collect()
}

impl Ops for GraphWriter {
    type Map = String;
    type Volume = String;

    fn conv2d(&mut self, name: &str, layer: &Conv2d, x: &String) -> String {
        let shape = [
            &layer.kernel_size[..],
            &layer.stride,
            &padding_2d(&layer.padding),
        ];
        self.convolution("Conv", name, &layer.weight, &layer.bias, shape, x)
    }
    fn conv2d_per_bin(&mut self, name: &str, layer: &Conv2d, bins: usize, x: &String) -> String {
        /// Channels in which ONNX Runtime's fast convolutions on AVX-512 count.
        const LANES: usize = 16;
        let [output, input, ..] = layer.weight.dims();
        if !input.is_multiple_of(LANES) {
            let apart = self.channels_reshaped(&format!("{name}.apart"), input, x);
            let y = self.conv2d(name, layer, &apart);
            return self.channels_reshaped(&format!("{name}.together"), bins * output, &y);
        }
        // A grouped convolution moves no number; its groups are copies of one kernel.
        let copies = |values: Vec<f32>| values.repeat(bins);
        let mut shape = layer.weight.dims();
        shape[0] *= bins;
        let weight = self.graph.shared(&format!("{name}.weight"), &shape, || {
            copies(values(&layer.weight.val()))
        });
        let mut inputs = vec![x.clone(), weight];
        if let Some(bias) = &layer.bias {
            inputs.push(
                self.graph
                    .shared(&format!("{name}.bias"), &[bins * output], || {
                        copies(values(&bias.val()))
                    }),
            );
        }
        let inputs: Vec<&str> = inputs.iter().map(String::as_str).collect();
        let attributes = vec![
            Attribute::ints("kernel_shape", &layer.kernel_size),
            Attribute::ints("strides", &layer.stride),
            Attribute::ints("pads", &padding_2d(&layer.padding)),
            Attribute::int("group", bins as i64),
        ];
        self.graph.node(name, "Conv", &inputs, attributes)
    }
    /// A transposed convolution, which is several times faster than `DepthToSpace`. It has one bias for all four
    /// pixels; theirs are the weights of one more channel, of ones.
    fn doubling_conv2d_per_bin(
        &mut self,
        name: &str,
        layer: &Conv2d,
        bins: usize,
        x: &String,
    ) -> String {
        let [output, input, ..] = layer.weight.dims();
        let apart = self.channels_reshaped(&format!("{name}.apart"), input, x);
        let (pads, one) = (
            self.graph.ints(&[0, 0, 0, 0, 0, 1, 0, 0]),
            self.graph.scalar(1.0),
        );
        let with_ones = self.graph.plain("Pad", &[&apart, &pads, &one], vec![]);
        let weight = self.graph.shared(
            &format!("{name}.weight"),
            &[input + 1, output / 4, 2, 2],
            || {
                let weight = layer.weight.val().reshape([output, input]).transpose();
                let bias = (layer.bias.as_ref())
                    .map_or_else(|| vec![0.0; output], |bias| values(&bias.val()));
                [values(&weight), bias].concat()
            },
        );
        let attributes = vec![
            Attribute::ints("kernel_shape", &[2, 2]),
            Attribute::ints("strides", &[2, 2]),
        ];
        let y = self
            .graph
            .node(name, "ConvTranspose", &[&with_ones, &weight], attributes);
        self.channels_reshaped(&format!("{name}.together"), bins * output / 4, &y)
    }
    fn disparity_mix(
        &mut self,
        name: &str,
        layer: &DisparityMix,
        bins: usize,
        x: &String,
    ) -> String {
        let (weight, bias) = layer.banded(bins);
        let inputs = [
            x.clone(),
            self.parameter(&format!("{name}.weight"), &weight),
            self.parameter(&format!("{name}.bias"), &bias),
        ];
        let inputs: Vec<&str> = inputs.iter().map(String::as_str).collect();
        let attributes = vec![Attribute::ints("kernel_shape", &[1, 1])];
        self.graph.node(name, "Conv", &inputs, attributes)
    }
    /// As [`crate::Execute`] does it; see there for how the diagonals are read off.
    fn correlate(&mut self, name: &str, pairs: &[Correlated<'_, String>], bins: usize) -> String {
        let d = bins as i64;
        let volumes: Vec<String> = pairs
            .iter()
            .map(|pair| {
                let (groups, size) = (pair.groups as i64, (pair.channels / pair.groups) as i64);
                let [height, width] = self.sides(pair.left);
                let blocks = self.graph.ints(&[0, groups, size, -1, d]);
                let cut = |this: &mut Self, x: &String, by: i64| {
                    let missing = this.missing(&width, d);
                    let by_end = this.graph.ints(&[by]);
                    let after = this.graph.plain("Sub", &[&missing, &by_end], vec![]);
                    let before = this.graph.ints(&[0, 0, 0, by, 0, 0, 0]);
                    let pads = this.concat_shape(&[&before, &after]);
                    let x = this.graph.plain("Pad", &[x, &pads], vec![]);
                    this.graph.plain("Reshape", &[&x, &blocks], vec![])
                };
                let transpose = |this: &mut Self, perm: [usize; 5], x: &String| {
                    let perm = vec![Attribute::ints("perm", &perm)];
                    this.graph.plain("Transpose", &[x], perm)
                };
                // `[batch, group, height * block, ...]`: left by column and channel, right by channel and column.
                let left = cut(self, pair.left, 0);
                let left = transpose(self, [0, 1, 3, 4, 2], &left);
                let [near, far] = [d, 0].map(|by| {
                    let right = cut(self, pair.right, by);
                    transpose(self, [0, 1, 3, 2, 4], &right)
                });
                let side_by_side = vec![Attribute::int("axis", 4)];
                // Whichever is the smaller is put together: what is multiplied, or the products.
                let products = if size <= d {
                    let right = self.graph.plain("Concat", &[&near, &far], side_by_side);
                    self.graph.node(name, "MatMul", &[&left, &right], vec![])
                } else {
                    let [near, far] = [near, far]
                        .map(|right| self.graph.node(name, "MatMul", &[&left, &right], vec![]));
                    self.graph.plain("Concat", &[&near, &far], side_by_side)
                };
                let flat = self.graph.ints(&[0, 0, 0, 2 * d * d]);
                let flat = self.graph.plain("Reshape", &[&products, &flat], vec![]);
                let pads = self.graph.ints(&[0, 0, 0, 0, 0, 0, 0, d]);
                let flat = self.graph.plain("Pad", &[&flat, &pads], vec![]);
                let skewed = self.graph.ints(&[0, 0, 0, d, 2 * d + 1]);
                let skewed = self.graph.plain("Reshape", &[&flat, &skewed], vec![]);
                let (from, to, axis) = (
                    self.graph.ints(&[1]),
                    self.graph.ints(&[d + 1]),
                    self.graph.ints(&[4]),
                );
                let diagonals = self
                    .graph
                    .plain("Slice", &[&skewed, &from, &to, &axis], vec![]);
                let (start, end) = (self.graph.ints(&[0, groups]), self.graph.ints(&[-1, d]));
                let rows = self.concat_shape(&[&start, &height, &end]);
                let rows = self.graph.plain("Reshape", &[&diagonals, &rows], vec![]);
                let (from, axis) = (self.graph.ints(&[0]), self.graph.ints(&[3]));
                self.graph
                    .plain("Slice", &[&rows, &from, &width, &axis], vec![])
            })
            .collect();
        let volume = self.concat(&volumes);
        let perm = vec![Attribute::ints("perm", &[0, 4, 1, 2, 3])];
        let volume = self.graph.plain("Transpose", &[&volume], perm);
        let groups: usize = pairs.iter().map(|p| p.groups).sum();
        let size = self.height_and_width(pairs[0].left);
        let start = self.graph.ints(&[0, (bins * groups) as i64]);
        let shape = self.concat_shape(&[&start, &size]);
        self.graph.plain("Reshape", &[&volume, &shape], vec![])
    }
    fn conv3d(&mut self, name: &str, layer: &Conv3d, x: &String) -> String {
        let shape = [
            &layer.kernel_size[..],
            &layer.stride,
            &both_ends(&padding_3d(&layer.padding)),
        ];
        self.convolution("Conv", name, &layer.weight, &layer.bias, shape, x)
    }
    fn conv_transpose3d(&mut self, name: &str, layer: &ConvTranspose3d, x: &String) -> String {
        let shape = [
            &layer.kernel_size[..],
            &layer.stride,
            &both_ends(&layer.padding),
        ];
        self.convolution("ConvTranspose", name, &layer.weight, &layer.bias, shape, x)
    }
    fn fixed_conv2d(&mut self, name: &str, kernel: &Kernel, stride: usize, x: &String) -> String {
        let weight = self.graph.floats(
            &format!("{name}.kernel"),
            &kernel.shape,
            kernel.data.iter().copied(),
        );
        let attributes = vec![
            Attribute::ints("kernel_shape", &kernel.shape[2..]),
            Attribute::ints("strides", &[stride; 2]),
        ];
        self.graph.node(name, "Conv", &[x, &weight], attributes)
    }

    fn relu(&mut self, x: &String) -> String {
        self.graph.plain("Relu", &[x], vec![])
    }
    fn sigmoid(&mut self, x: &String) -> String {
        self.graph.plain("Sigmoid", &[x], vec![])
    }
    fn relu_volume(&mut self, x: &String) -> String {
        self.graph.plain("Relu", &[x], vec![])
    }
    fn instance_norm(&mut self, channels: usize, epsilon: f64, x: &String) -> String {
        let one = self
            .graph
            .floats("normal.scale", &[channels], vec![1.0; channels]);
        let zero = self
            .graph
            .floats("normal.bias", &[channels], vec![0.0; channels]);
        self.graph.node(
            "normal",
            "InstanceNormalization",
            &[x, &one, &zero],
            vec![Attribute::float("epsilon", epsilon as f32)],
        )
    }
    fn add(&mut self, a: &String, b: &String) -> String {
        self.graph.plain("Add", &[a, b], vec![])
    }
    fn sub(&mut self, a: &String, b: &String) -> String {
        self.graph.plain("Sub", &[a, b], vec![])
    }
    fn mul(&mut self, a: &String, b: &String) -> String {
        self.graph.plain("Mul", &[a, b], vec![])
    }
    fn mul_per_bin(&mut self, bins: usize, a: &String, b: &String) -> String {
        let size = self.height_and_width(a);
        let bins = bins as i64;
        let [apart, one, together] = [&[0, bins, -1][..], &[0, 1, -1], &[0, -1]].map(|counts| {
            let counts = self.graph.ints(counts);
            self.concat_shape(&[&counts, &size])
        });
        let a = self.graph.plain("Reshape", &[a, &apart], vec![]);
        let b = self.graph.plain("Reshape", &[b, &one], vec![]);
        let product = self.graph.plain("Mul", &[&a, &b], vec![]);
        self.graph.plain("Reshape", &[&product, &together], vec![])
    }
    fn div(&mut self, a: &String, b: &String) -> String {
        self.graph.plain("Div", &[a, b], vec![])
    }
    fn affine(&mut self, scale: f32, offset: f32, x: &String) -> String {
        let mut y = x.clone();
        if scale != 1.0 {
            let scale = self.graph.scalar(scale);
            y = self.graph.plain("Mul", &[&y, &scale], vec![]);
        }
        if offset != 0.0 {
            let offset = self.graph.scalar(offset);
            y = self.graph.plain("Add", &[&y, &offset], vec![]);
        }
        y
    }
    fn sqrt(&mut self, x: &String) -> String {
        self.graph.plain("Sqrt", &[x], vec![])
    }
    fn exp(&mut self, x: &String) -> String {
        self.graph.plain("Exp", &[x], vec![])
    }
    fn floor(&mut self, x: &String) -> String {
        self.graph.plain("Floor", &[x], vec![])
    }
    fn abs(&mut self, x: &String) -> String {
        self.graph.plain("Abs", &[x], vec![])
    }
    fn clamp(&mut self, low: f32, high: f32, x: &String) -> String {
        let (low, high) = (self.graph.scalar(low), self.graph.scalar(high));
        self.graph.plain("Clip", &[x, &low, &high], vec![])
    }
    fn channel_mean(&mut self, x: &String) -> String {
        let axis = vec![Attribute::ints("axes", &[1])];
        self.graph.plain("ReduceMean", &[x], axis)
    }
    fn average_pool(&mut self, size: usize, stride: usize, x: &String) -> String {
        let attributes = vec![
            Attribute::ints("kernel_shape", &[size; 2]),
            Attribute::ints("strides", &[stride; 2]),
        ];
        self.graph.plain("AveragePool", &[x], attributes)
    }
    fn channel_max(&mut self, x: &String) -> String {
        let axis = vec![Attribute::ints("axes", &[1])];
        self.graph.plain("ReduceMax", &[x], axis)
    }
    fn channel_argmax(&mut self, x: &String) -> String {
        let largest = self
            .graph
            .plain("ArgMax", &[x], vec![Attribute::int("axis", 1)]);
        let to = vec![Attribute::int("to", FLOAT.into())];
        self.graph.plain("Cast", &[&largest], to)
    }
    fn mean_of_neighbours(
        &mut self,
        name: &str,
        shares: usize,
        reach: usize,
        weights: &String,
        channels: usize,
        x: &String,
    ) -> String {
        let side = 2 * reach + 1;
        let around = Kernel::from_fn(
            [channels * NEIGHBOURS, channels, side, side],
            |c, from, y, x| {
                let n = c % NEIGHBOURS;
                f32::from(c / NEIGHBOURS == from && (y, x) == (reach * (n / 3), reach * (n % 3)))
            },
        );
        let padded = self.pad_edge([reach; 4], x);
        let around = self.fixed_conv2d(&format!("{name}.around"), &around, 1, &padded);
        // `[batch, channel, neighbour, share, pixel]`.
        let neighbours = NEIGHBOURS as i64;
        let apart = self.graph.ints(&[0, channels as i64, neighbours, 1, -1]);
        let around = self.graph.plain("Reshape", &[&around, &apart], vec![]);
        let apart = self.graph.ints(&[0, 1, neighbours, shares as i64, -1]);
        let weights = self.graph.plain("Reshape", &[weights, &apart], vec![]);
        let sum = |this: &mut Self, what: &str, x: &String| {
            let axis = this.graph.ints(&[2]);
            let keep = vec![Attribute::int("keepdims", 1)];
            this.graph
                .node(&format!("{name}.{what}"), "ReduceSum", &[x, &axis], keep)
        };
        let total = sum(self, "total", &weights);
        let total = self.affine(1.0, LEAST_WEIGHT, &total);
        let weighted = self.mul(&weights, &around);
        let mixed = sum(self, "mix", &weighted);
        let mean = self.div(&mixed, &total);
        let size = self.height_and_width(x);
        let start = self.graph.ints(&[0, (channels * shares) as i64]);
        let shape = self.concat_shape(&[&start, &size]);
        self.graph.plain("Reshape", &[&mean, &shape], vec![])
    }
    fn channel_constant(&mut self, name: &str, values: &[f32]) -> String {
        self.graph
            .floats(name, &[1, values.len(), 1, 1], values.iter().copied())
    }
    fn add_volume(&mut self, a: &String, b: &String) -> String {
        self.graph.plain("Add", &[a, b], vec![])
    }

    fn join(&mut self, first: &String, second: &String) -> String {
        let axis = vec![Attribute::int("axis", 0)];
        self.graph.plain("Concat", &[first, second], axis)
    }
    fn halves(&mut self, x: &String) -> (String, String) {
        self.graph.split("halves", 0, x).into()
    }
    fn split_channels<const N: usize>(&mut self, x: &String) -> [String; N] {
        self.graph.split("channels", 1, x)
    }
    fn concat(&mut self, maps: &[String]) -> String {
        let inputs: Vec<&str> = maps.iter().map(String::as_str).collect();
        self.graph
            .plain("Concat", &inputs, vec![Attribute::int("axis", 1)])
    }
    fn concat_volumes(&mut self, volumes: &[String]) -> String {
        self.concat(volumes)
    }
    fn stack(&mut self, maps: &[String]) -> String {
        let axis = self.graph.ints(&[2]);
        let planes: Vec<String> = maps
            .iter()
            .map(|m| self.graph.plain("Unsqueeze", &[m, &axis], vec![]))
            .collect();
        let inputs: Vec<&str> = planes.iter().map(String::as_str).collect();
        self.graph
            .plain("Concat", &inputs, vec![Attribute::int("axis", 2)])
    }
    fn as_volume(&mut self, bins: usize, x: &String) -> String {
        let size = self.height_and_width(x);
        let start = self.graph.ints(&[0, bins as i64, -1]);
        let shape = self.concat_shape(&[&start, &size]);
        let y = self.graph.plain("Reshape", &[x, &shape], vec![]);
        let perm = vec![Attribute::ints("perm", &[0, 2, 1, 3, 4])];
        self.graph.plain("Transpose", &[&y], perm)
    }
    fn disparities_as_channels(&mut self, x: &String) -> String {
        let axis = self.graph.ints(&[1]);
        self.graph.plain("Squeeze", &[x, &axis], vec![])
    }
    fn shift_right(&mut self, by: usize, x: &String) -> String {
        if by == 0 {
            return x.clone();
        }
        // Pad and cut by the same, so that the width, which the graph does not know, stays.
        let by = by as i64;
        let pads = self.graph.ints(&[0, 0, 0, by, 0, 0, 0, 0]);
        let padded = self.graph.plain("Pad", &[x, &pads], vec![]);
        let (from, to, axis) = (
            self.graph.ints(&[0]),
            self.graph.ints(&[-by]),
            self.graph.ints(&[3]),
        );
        self.graph
            .plain("Slice", &[&padded, &from, &to, &axis], vec![])
    }
    fn pad_edge(&mut self, by: [usize; 4], x: &String) -> String {
        let [left, right, top, bottom] = by.map(|n| n as i64);
        let pads = self.graph.ints(&[0, 0, top, left, 0, 0, bottom, right]);
        let edge = vec![Attribute::string("mode", "edge")];
        self.graph.plain("Pad", &[x, &pads], edge)
    }
    fn pad_to_multiple(&mut self, multiple: usize, x: &String) -> String {
        let size = self.height_and_width(x);
        let missing = self.missing(&size, multiple as i64);
        let before = self.graph.ints(&[0; 6]);
        let pads = self.concat_shape(&[&before, &missing]);
        let edge = vec![Attribute::string("mode", "edge")];
        self.graph.plain("Pad", &[x, &pads], edge)
    }
    fn crop_to(&mut self, like: &String, x: &String) -> String {
        let size = self.height_and_width(like);
        let (from, axes) = (self.graph.ints(&[0, 0]), self.graph.ints(&[2, 3]));
        self.graph.plain("Slice", &[x, &from, &size, &axes], vec![])
    }
    fn double(&mut self, x: &String) -> String {
        let scales = self.graph.floats("scales", &[4], [1.0, 1.0, 2.0, 2.0]);
        let attributes = vec![
            Attribute::string("mode", "nearest"),
            Attribute::string("nearest_mode", "floor"),
            Attribute::string("coordinate_transformation_mode", "asymmetric"),
        ];
        self.graph.plain("Resize", &[x, "", &scales], attributes)
    }
    fn depth_to_space(&mut self, r: usize, x: &String) -> String {
        let attributes = vec![
            Attribute::int("blocksize", r as i64),
            Attribute::string("mode", "CRD"),
        ];
        self.graph.plain("DepthToSpace", &[x], attributes)
    }
}
