//! The vocabulary of blocks, written down as ONNX nodes.

use std::collections::HashMap;

use burn::module::Param;
use burn::nn::conv::{Conv2d, Conv3d, ConvTranspose2d, ConvTranspose3d};
use burn::nn::{PaddingConfig2d, PaddingConfig3d};
use burn::tensor::Tensor;

use super::proto::{self, Attribute, Node};
use crate::{Kernel, Ops};

/// Collects nodes and constants; a value is the name of the node's output.
#[derive(Default)]
pub struct GraphWriter {
    pub nodes: Vec<Node>,
    pub initializers: Vec<proto::Tensor>,
    /// How often each name was asked for, to keep names unique: the second `x` is `x.2`.
    names: HashMap<String, usize>,
}

impl GraphWriter {
    fn unique(&mut self, name: &str) -> String {
        let count = self.names.entry(name.to_owned()).or_insert(0);
        *count += 1;
        if *count == 1 {
            name.to_owned()
        } else {
            format!("{name}.{count}")
        }
    }

    fn node(
        &mut self,
        name: &str,
        op: &str,
        inputs: &[&str],
        attributes: Vec<Attribute>,
    ) -> String {
        let name = self.unique(name);
        self.nodes.push(Node {
            input: inputs.iter().map(|i| (*i).to_owned()).collect(),
            output: vec![name.clone()],
            name: name.clone(),
            op_type: op.into(),
            attribute: attributes,
        });
        name
    }

    /// A node named after its operator.
    fn plain(&mut self, op: &str, inputs: &[&str], attributes: Vec<Attribute>) -> String {
        self.node(&op.to_lowercase(), op, inputs, attributes)
    }

    fn ints(&mut self, values: &[i64]) -> String {
        let name = self.unique("shape");
        self.initializers.push(proto::Tensor::ints(&name, values));
        name
    }

    fn scalar(&mut self, value: f32) -> String {
        let name = self.unique("scalar");
        self.initializers
            .push(proto::Tensor::floats(&name, &[], [value]));
        name
    }

    /// A learned tensor. Both images pass the same layer, so it may be there already.
    fn parameter<const D: usize>(&mut self, name: &str, value: &Tensor<D>) -> String {
        if !self.initializers.iter().any(|t| t.name == name) {
            let data = value.to_data();
            self.initializers.push(proto::Tensor::floats(
                name,
                &value.dims(),
                data.iter::<f32>(),
            ));
        }
        name.to_owned()
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
        self.node(name, op, &inputs, attributes)
    }

    fn height_and_width(&mut self, x: &str) -> String {
        let shape = self.plain("Shape", &[x], vec![]);
        let (from, to) = (self.ints(&[2]), self.ints(&[4]));
        self.plain("Slice", &[&shape, &from, &to], vec![])
    }

    /// Gives a value the name of a graph output.
    pub fn output(&mut self, name: &str, value: &str) {
        self.node(name, "Identity", &[value], vec![]);
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
        let weight = self.unique(&format!("{name}.kernel"));
        self.initializers.push(proto::Tensor::floats(
            &weight,
            &kernel.shape,
            kernel.data.iter().copied(),
        ));
        let attributes = vec![
            Attribute::ints("kernel_shape", &kernel.shape[2..]),
            Attribute::ints("strides", &[stride; 2]),
        ];
        self.node(name, "Conv", &[x, &weight], attributes)
    }

    fn relu(&mut self, x: &String) -> String {
        self.plain("Relu", &[x], vec![])
    }
    fn relu_volume(&mut self, x: &String) -> String {
        self.plain("Relu", &[x], vec![])
    }
    fn instance_norm(&mut self, channels: usize, epsilon: f64, x: &String) -> String {
        let (one, zero) = (self.unique("normal.scale"), self.unique("normal.bias"));
        self.initializers.push(proto::Tensor::floats(
            &one,
            &[channels],
            vec![1.0; channels],
        ));
        self.initializers.push(proto::Tensor::floats(
            &zero,
            &[channels],
            vec![0.0; channels],
        ));
        self.node(
            "normal",
            "InstanceNormalization",
            &[x, &one, &zero],
            vec![Attribute::float("epsilon", epsilon as f32)],
        )
    }
    fn add(&mut self, a: &String, b: &String) -> String {
        self.plain("Add", &[a, b], vec![])
    }
    fn sub(&mut self, a: &String, b: &String) -> String {
        self.plain("Sub", &[a, b], vec![])
    }
    fn mul(&mut self, a: &String, b: &String) -> String {
        self.plain("Mul", &[a, b], vec![])
    }
    fn div(&mut self, a: &String, b: &String) -> String {
        self.plain("Div", &[a, b], vec![])
    }
    fn affine(&mut self, scale: f32, offset: f32, x: &String) -> String {
        let mut y = x.clone();
        if scale != 1.0 {
            let scale = self.scalar(scale);
            y = self.plain("Mul", &[&y, &scale], vec![]);
        }
        if offset != 0.0 {
            let offset = self.scalar(offset);
            y = self.plain("Add", &[&y, &offset], vec![]);
        }
        y
    }
    fn sqrt(&mut self, x: &String) -> String {
        self.plain("Sqrt", &[x], vec![])
    }
    fn exp(&mut self, x: &String) -> String {
        self.plain("Exp", &[x], vec![])
    }
    fn floor(&mut self, x: &String) -> String {
        self.plain("Floor", &[x], vec![])
    }
    fn abs(&mut self, x: &String) -> String {
        self.plain("Abs", &[x], vec![])
    }
    fn clamp(&mut self, low: f32, high: f32, x: &String) -> String {
        let (low, high) = (self.scalar(low), self.scalar(high));
        self.plain("Clip", &[x, &low, &high], vec![])
    }
    fn softmax(&mut self, x: &String) -> String {
        self.plain("Softmax", &[x], vec![Attribute::int("axis", 1)])
    }
    fn channel_constant(&mut self, name: &str, values: &[f32]) -> String {
        let name = self.unique(name);
        self.initializers.push(proto::Tensor::floats(
            &name,
            &[1, values.len(), 1, 1],
            values.iter().copied(),
        ));
        name
    }
    fn add_volume(&mut self, a: &String, b: &String) -> String {
        self.plain("Add", &[a, b], vec![])
    }

    fn concat(&mut self, maps: &[String]) -> String {
        let inputs: Vec<&str> = maps.iter().map(String::as_str).collect();
        self.plain("Concat", &inputs, vec![Attribute::int("axis", 1)])
    }
    fn concat_volumes(&mut self, volumes: &[String]) -> String {
        self.concat(volumes)
    }
    fn stack(&mut self, maps: &[String]) -> String {
        let axis = self.ints(&[2]);
        let planes: Vec<String> = maps
            .iter()
            .map(|m| self.plain("Unsqueeze", &[m, &axis], vec![]))
            .collect();
        let inputs: Vec<&str> = planes.iter().map(String::as_str).collect();
        self.plain("Concat", &inputs, vec![Attribute::int("axis", 2)])
    }
    fn disparities_as_channels(&mut self, x: &String) -> String {
        let axis = self.ints(&[1]);
        self.plain("Squeeze", &[x, &axis], vec![])
    }
    fn shift_right(&mut self, by: usize, x: &String) -> String {
        if by == 0 {
            return x.clone();
        }
        // Pad and cut by the same, so that the width, which the graph does not know, stays.
        let by = by as i64;
        let pads = self.ints(&[0, 0, 0, by, 0, 0, 0, 0]);
        let padded = self.plain("Pad", &[x, &pads], vec![]);
        let (from, to, axis) = (self.ints(&[0]), self.ints(&[-by]), self.ints(&[3]));
        self.plain("Slice", &[&padded, &from, &to, &axis], vec![])
    }
    fn pad_edge(&mut self, by: usize, x: &String) -> String {
        let by = by as i64;
        let pads = self.ints(&[0, 0, by, by, 0, 0, by, by]);
        self.plain("Pad", &[x, &pads], vec![Attribute::string("mode", "edge")])
    }
    fn pad_to_multiple(&mut self, multiple: usize, x: &String) -> String {
        let size = self.height_and_width(x);
        let multiple = self.ints(&[multiple as i64; 2]);
        let over = self.plain("Mod", &[&size, &multiple], vec![]);
        let missing = self.plain("Sub", &[&multiple, &over], vec![]);
        let missing = self.plain("Mod", &[&missing, &multiple], vec![]);
        let before = self.ints(&[0; 6]);
        let pads = self.plain(
            "Concat",
            &[&before, &missing],
            vec![Attribute::int("axis", 0)],
        );
        self.plain("Pad", &[x, &pads], vec![Attribute::string("mode", "edge")])
    }
    fn crop_to(&mut self, like: &String, x: &String) -> String {
        let size = self.height_and_width(like);
        let (from, axes) = (self.ints(&[0, 0]), self.ints(&[2, 3]));
        self.plain("Slice", &[x, &from, &size, &axes], vec![])
    }
    fn depth_to_space(&mut self, r: usize, x: &String) -> String {
        let attributes = vec![
            Attribute::int("blocksize", r as i64),
            Attribute::string("mode", "CRD"),
        ];
        self.plain("DepthToSpace", &[x], attributes)
    }
}
