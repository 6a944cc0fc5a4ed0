//! Writes the plan into the graph: `QuantizeLinear` and `DequantizeLinear` around convolutions.

use std::collections::{HashMap, HashSet};

use barchan_onnx::proto::{Attribute, Graph, Node, Tensor};

use super::plan::Plan;
use super::range::{Affine, weights_to_int8};

/// The graph with the convolutions of `plan` between levels. Runtimes fold the pattern
/// `DequantizeLinear, Conv, Relu, QuantizeLinear` into one int8 convolution; any other computes it
/// as it stands.
pub(super) fn rewrite(graph: Graph, plan: &Plan, ranges: &[Affine]) -> Graph {
    let Graph {
        node: nodes,
        initializer: constants,
        ..
    } = &graph;
    let mut taken: HashSet<String> = (nodes.iter().flat_map(|n| &n.output))
        .chain(constants.iter().map(|t| &t.name))
        .chain(graph.input.iter().map(|v| &v.name))
        .cloned()
        .collect();
    let mut fresh = |base: String| {
        let mut name = base.clone();
        let mut number = 1;
        while !taken.insert(name.clone()) {
            number += 1;
            name = format!("{base}.{number}");
        }
        name
    };
    let mut initializer = vec![];
    let mut node = vec![];

    // Scale and zero of a range are written once.
    let levels: Vec<[String; 2]> = (ranges.iter().enumerate())
        .map(|(range, affine)| {
            let of = (plan.activations.iter())
                .find(|(_, r)| *r == range)
                .map_or("activation", |(name, _)| name);
            let names = [fresh(format!("{of}.scale")), fresh(format!("{of}.zero"))];
            initializer.push(Tensor::floats(&names[0], &[], [affine.scale]));
            initializer.push(Tensor::uint8s(&names[1], &[], [affine.zero]));
            names
        })
        .collect();
    // What an activation becomes, and the two nodes that make it so.
    let rounded: HashMap<&str, (String, [Node; 2])> = (plan.activations.iter())
        .map(|(name, range)| {
            let [scale, zero] = &levels[*range];
            let quantized = fresh(format!("{name}.quantize"));
            let back = fresh(format!("{name}.dequantize"));
            let nodes = [
                linear("QuantizeLinear", &[name, scale, zero], &quantized),
                linear("DequantizeLinear", &[&quantized, scale, zero], &back),
            ];
            (name.as_str(), (back, nodes))
        })
        .collect();
    // Behind an int8 convolution all read the rounded activation, or the runtime could not fold it;
    // any other is rounded for the int8 convolutions alone.
    let behind: HashSet<&str> = plan
        .convolutions
        .iter()
        .map(|c| c.output.as_str())
        .collect();
    let int8: HashMap<usize, Affine> = (plan.convolutions.iter())
        .filter_map(|c| Some((c.node, ranges[plan.range(&c.input)?])))
        .collect();
    let constant: HashMap<&str, &Tensor> = constants.iter().map(|t| (t.name.as_str(), t)).collect();
    let mut layers: HashMap<[&str; 2], [String; 2]> = HashMap::new();

    for input in &graph.input {
        if let Some((_, nodes)) = rounded.get(input.name.as_str()) {
            node.extend_from_slice(nodes);
        }
    }
    for (index, original) in nodes.iter().enumerate() {
        let mut new = original.clone();
        for (position, input) in new.input.iter_mut().enumerate() {
            if let Some((back, _)) = rounded.get(input.as_str())
                && (behind.contains(input.as_str()) || (position == 0 && int8.contains_key(&index)))
            {
                *input = back.clone();
            }
        }
        if let Some(affine) = int8.get(&index) {
            let weights = original.input[1].as_str();
            let bias = original.input.get(2).map_or("", String::as_str);
            // Both images pass the same layer: its weights are written once.
            let [weights, bias] = layers.entry([weights, bias]).or_insert_with(|| {
                let layer =
                    Layer::new(constant[weights], constant.get(bias).copied(), affine.scale);
                layer.write(&mut fresh, &mut initializer, &mut node)
            });
            new.input[1].clone_from(weights);
            if !bias.is_empty() {
                new.input[2].clone_from(bias);
            }
        }
        let outputs = new.output.clone();
        node.push(new);
        for output in &outputs {
            if let Some((_, nodes)) = rounded.get(output.as_str()) {
                node.extend_from_slice(nodes);
            }
        }
    }

    let used: HashSet<&str> = (node.iter().flat_map(|n| &n.input))
        .chain(graph.output.iter().map(|o| &o.name))
        .map(String::as_str)
        .collect();
    initializer.extend(
        constants
            .iter()
            .filter(|t| used.contains(t.name.as_str()))
            .cloned(),
    );
    drop(used);
    Graph {
        node,
        initializer,
        ..graph
    }
}

/// Weights and bias of a convolution in whole numbers.
struct Layer<'a> {
    weights: &'a Tensor,
    levels: Vec<i8>,
    scales: Vec<f32>,
    /// The bias, its levels, and their scales.
    bias: Option<(&'a Tensor, Vec<i32>, Vec<f32>)>,
}

impl<'a> Layer<'a> {
    /// The plan has seen that the tensors are float and of the right size.
    fn new(weights: &'a Tensor, bias: Option<&'a Tensor>, input_scale: f32) -> Self {
        let values = weights.to_floats().unwrap_or_default();
        let offsets = bias.and_then(Tensor::to_floats);
        let channels = weights.dims[0] as usize;
        let (levels, scales) = weights_to_int8(&values, channels, offsets.as_deref(), input_scale);
        let bias = bias.zip(offsets).map(|(tensor, offsets)| {
            let steps: Vec<f32> = (scales.iter())
                .map(|s| (s * input_scale).max(f32::MIN_POSITIVE))
                .collect();
            let levels = (offsets.iter().zip(&steps))
                .map(|(b, step)| (f64::from(*b) / f64::from(*step)).round() as i32)
                .collect();
            (tensor, levels, steps)
        });
        Self {
            weights,
            levels,
            scales,
            bias,
        }
    }

    /// Adds the constants and the nodes that read them; the names of dequantised weights and bias.
    fn write(
        self,
        fresh: &mut impl FnMut(String) -> String,
        initializer: &mut Vec<Tensor>,
        node: &mut Vec<Node>,
    ) -> [String; 2] {
        let channels = self.scales.len();
        let dims: Vec<usize> = self.weights.dims.iter().map(|d| *d as usize).collect();
        let mut along_outputs = |inputs: &[&str], output: &str| {
            let mut dequantize = linear("DequantizeLinear", inputs, output);
            dequantize.attribute = vec![Attribute::int("axis", 0)];
            node.push(dequantize);
        };
        let name = &self.weights.name;
        let [int8, scale, zero, weights] =
            ["int8", "scale", "zero", "dequantize"].map(|suffix| fresh(format!("{name}.{suffix}")));
        along_outputs(&[&int8, &scale, &zero], &weights);
        initializer.extend([
            Tensor::int8s(&int8, &dims, self.levels),
            Tensor::floats(&scale, &[channels], self.scales),
            Tensor::int8s(&zero, &[channels], vec![0; channels]),
        ]);
        let Some((bias, levels, steps)) = self.bias else {
            return [weights, String::new()];
        };
        let [int32, scale, back] =
            ["int32", "scale", "dequantize"].map(|suffix| fresh(format!("{}.{suffix}", bias.name)));
        along_outputs(&[&int32, &scale], &back);
        initializer.extend([
            Tensor::int32s(&int32, &[channels], levels),
            Tensor::floats(&scale, &[channels], steps),
        ]);
        [weights, back]
    }
}

/// A node of one output, named after it.
fn linear(op: &str, inputs: &[&str], output: &str) -> Node {
    Node {
        input: inputs.iter().map(|i| (*i).to_owned()).collect(),
        output: vec![output.to_owned()],
        name: output.to_owned(),
        op_type: op.into(),
        attribute: vec![],
    }
}
