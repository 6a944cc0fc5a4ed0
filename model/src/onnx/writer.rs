//! The vocabulary of blocks, written down as ONNX nodes.

use barchan_onnx::GraphBuilder;
use barchan_onnx::proto::Attribute;
use burn::module::Param;
use burn::nn::conv::{Conv2d, Conv3d, ConvTranspose2d, ConvTranspose3d};
use burn::nn::{PaddingConfig2d, PaddingConfig3d};
use burn::tensor::Tensor;

use crate::{Kernel, Ops};

/// Writes what blocks ask for into a graph; a value is the name of the node's output.
#[derive(Default)]
pub struct GraphWriter {
    pub graph: GraphBuilder,
}

impl GraphWriter {
    /// A learned tensor. Both images pass the same layer, so it may be there already.
    fn parameter<const D: usize>(&mut self, name: &str, value: &Tensor<D>) -> String {
        self.graph.shared(name, &value.dims(), || {
            value.to_data().iter::<f32>().collect::<Vec<_>>()
        })
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
    fn conv_transpose2d(&mut self, name: &str, layer: &ConvTranspose2d, x: &String) -> String {
        let shape = [
            &layer.kernel_size[..],
            &layer.stride,
            &both_ends(&layer.padding),
        ];
        self.convolution("ConvTranspose", name, &layer.weight, &layer.bias, shape, x)
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
    fn softmax(&mut self, x: &String) -> String {
        self.graph
            .plain("Softmax", &[x], vec![Attribute::int("axis", 1)])
    }
    fn channel_constant(&mut self, name: &str, values: &[f32]) -> String {
        self.graph
            .floats(name, &[1, values.len(), 1, 1], values.iter().copied())
    }
    fn add_volume(&mut self, a: &String, b: &String) -> String {
        self.graph.plain("Add", &[a, b], vec![])
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
    fn pad_edge(&mut self, by: usize, x: &String) -> String {
        let by = by as i64;
        let pads = self.graph.ints(&[0, 0, by, by, 0, 0, by, by]);
        self.graph
            .plain("Pad", &[x, &pads], vec![Attribute::string("mode", "edge")])
    }
    fn pad_to_multiple(&mut self, multiple: usize, x: &String) -> String {
        let size = self.height_and_width(x);
        let multiple = self.graph.ints(&[multiple as i64; 2]);
        let over = self.graph.plain("Mod", &[&size, &multiple], vec![]);
        let missing = self.graph.plain("Sub", &[&multiple, &over], vec![]);
        let missing = self.graph.plain("Mod", &[&missing, &multiple], vec![]);
        let before = self.graph.ints(&[0; 6]);
        let pads = self.graph.plain(
            "Concat",
            &[&before, &missing],
            vec![Attribute::int("axis", 0)],
        );
        self.graph
            .plain("Pad", &[x, &pads], vec![Attribute::string("mode", "edge")])
    }
    fn crop_to(&mut self, like: &String, x: &String) -> String {
        let size = self.height_and_width(like);
        let (from, axes) = (self.graph.ints(&[0, 0]), self.graph.ints(&[2, 3]));
        self.graph.plain("Slice", &[x, &from, &size, &axes], vec![])
    }
    fn depth_to_space(&mut self, r: usize, x: &String) -> String {
        let attributes = vec![
            Attribute::int("blocksize", r as i64),
            Attribute::string("mode", "CRD"),
        ];
        self.graph.plain("DepthToSpace", &[x], attributes)
    }
}
