//! Which convolutions become int8, and which activations share a range.

use std::collections::HashMap;

use barchan_onnx::proto::{Graph, Node, Tensor};

use super::{QuantizeError, QuantizeOptions};

/// Input times output channels below which ONNX Runtime's int8 convolution loses: it gathers its
/// input a pixel at a time, at a cost that does not shrink with the channels. Measured on one thread
/// with VNNI, float over int8 time of a 3x3 layer: 0.4 at 4 x 4 channels, 0.8 at 12 x 12, 1.5 at
/// 16 x 16, 2.4 at 24 x 24, 2.5 at 64 x 64; of a 3x3x3 layer 0.2, 0.5, 1.2, 1.5, and 2.0 at 32 x 32.
const MIN_CHANNELS: usize = 256;

/// Multiplications per channel read and written, of 2-D and of 3-D convolutions, below which int8
/// loses: 0.8 for 1x1 with 16 channels (8 of them), 1.0 to 1.3 with 32 (16); 0.9 for (1, 3, 3) with
/// 16 channels (72), 1.2 to 1.5 with 24 (108).
const MIN_INTENSITY: [usize; 2] = [16, 100];

/// A convolution that becomes int8.
pub(super) struct Convolution {
    /// Its place among the nodes.
    pub node: usize,
    /// The activation it reads.
    pub input: String,
    /// The activation it is rounded at: its output, or that of the `Relu` after it, which costs
    /// nothing where the range begins at zero.
    pub output: String,
}

/// What is to be done to a graph.
pub(super) struct Plan {
    pub convolutions: Vec<Convolution>,
    /// Names of the convolutions that stay float, with the reason.
    pub float: Vec<(String, String)>,
    /// Activations that are rounded, each with its range's index.
    pub activations: Vec<(String, usize)>,
    /// How many ranges there are.
    pub ranges: usize,
}

impl Plan {
    /// The range of an activation, if it is rounded.
    pub fn range(&self, activation: &str) -> Option<usize> {
        (self.activations.iter())
            .find(|(name, _)| name == activation)
            .map(|(_, range)| *range)
    }
}

/// Looks for convolutions with constant weights that are worth it.
pub(super) fn plan(graph: &Graph, options: &QuantizeOptions) -> Result<Plan, QuantizeError> {
    let constants: HashMap<&str, &Tensor> = graph
        .initializer
        .iter()
        .map(|t| (t.name.as_str(), t))
        .collect();
    let mut readers: HashMap<&str, Vec<&Node>> = HashMap::new();
    for node in &graph.node {
        for input in &node.input {
            readers.entry(input).or_default().push(node);
        }
    }
    let is_output = |value: &str| graph.output.iter().any(|o| o.name == value);

    let (mut convolutions, mut float) = (vec![], vec![]);
    for (index, node) in graph.node.iter().enumerate() {
        if node.op_type != "Conv" {
            continue;
        }
        match worth(node, &constants, options)? {
            Some(reason) => float.push((node.name.clone(), reason)),
            None => {
                // A Relu that alone reads the convolution becomes part of it.
                let own = &node.output[0];
                let output = match readers.get(own.as_str()).map(Vec::as_slice) {
                    Some([relu]) if relu.op_type == "Relu" && !is_output(own) => {
                        relu.output.first().unwrap_or(own)
                    }
                    _ => own,
                };
                if is_output(output) {
                    float.push((node.name.clone(), "is an output of the network".into()));
                    continue;
                }
                convolutions.push(Convolution {
                    node: index,
                    input: node.input[0].clone(),
                    output: output.clone(),
                });
            }
        }
    }

    // Convolutions with the same weights are one layer that looks at both images: one range before
    // and one behind it, so that equal features are rounded equally. Layout operators keep the
    // range, so that they run on the 8-bit values.
    let mut tied = Ties::default();
    let mut layer: HashMap<&str, (usize, usize)> = HashMap::new();
    for c in &convolutions {
        let (input, output) = (tied.index(&c.input), tied.index(&c.output));
        let first = *layer
            .entry(graph.node[c.node].input[1].as_str())
            .or_insert((input, output));
        tied.join(first.0, input);
        tied.join(first.1, output);
    }
    for node in graph.node.iter().filter(|n| moves_values(n)) {
        let known = |name: &String| tied.names.iter().position(|n| n == name);
        if let (Some(a), Some(b)) = (
            node.input.first().and_then(known),
            node.output.first().and_then(known),
        ) {
            tied.join(a, b);
        }
    }
    let (activations, ranges) = tied.groups();
    Ok(Plan {
        convolutions,
        float,
        activations,
        ranges,
    })
}

/// Why a convolution stays float, if it does.
fn worth(
    node: &Node,
    constants: &HashMap<&str, &Tensor>,
    options: &QuantizeOptions,
) -> Result<Option<String>, QuantizeError> {
    let wrong = |what: &str| QuantizeError::Model(format!("convolution {}: {what}", node.name));
    if node.input.len() < 2 || node.output.len() != 1 {
        return Err(wrong("expected an input, weights and one output"));
    }
    if options.keep_float.contains(&node.name) {
        return Ok(Some("asked for".into()));
    }
    let bias = node.input.get(2).filter(|name| !name.is_empty());
    let (Some(weights), true) = (
        constants.get(node.input[1].as_str()),
        bias.is_none_or(|bias| constants.contains_key(bias.as_str()))
            && !constants.contains_key(node.input[0].as_str()),
    ) else {
        return Ok(Some("its weights are computed".into()));
    };
    let values = weights.to_floats();
    let Some(values) = values.filter(|v| !v.is_empty() && weights.dims.len() >= 3) else {
        return Err(wrong(
            "its weights are no float tensor [out, in, kernel...]",
        ));
    };
    if let Some(bias) = bias {
        let offsets = constants[bias.as_str()].to_floats();
        let fits =
            |b: &Vec<f32>| b.len() as i64 == weights.dims[0] && b.iter().all(|v| v.is_finite());
        if !offsets.as_ref().is_some_and(fits) {
            return Err(wrong(
                "its bias is no float tensor of one finite value per output",
            ));
        }
    }
    if values.iter().any(|v| !v.is_finite()) {
        return Err(wrong("a weight is not finite"));
    }
    let mut sorted: Vec<u32> = values.iter().map(|v| v.to_bits()).collect();
    sorted.sort_unstable();
    sorted.dedup();
    if sorted.len() < LEARNED_VALUES {
        return Ok(Some("a fixed kernel".into()));
    }
    let (outputs, inputs) = (weights.dims[0] as usize, weights.dims[1] as usize);
    let group = node.attribute.iter().find(|a| a.name == "group");
    let group = group.and_then(|a| a.i).unwrap_or(1).max(1) as usize;
    let intensity = values.len() / (inputs.saturating_mul(group).saturating_add(outputs));
    let volumetric = usize::from(weights.dims.len() > 4);
    Ok(
        (inputs * outputs < MIN_CHANNELS || intensity < MIN_INTENSITY[volumetric])
            .then(|| "too few channels to gain".into()),
    )
}

/// A kernel of fewer different values was not learned. Learned ones repeat theirs too: a band of zeros around
/// a mix over disparity, copies for the groups of a convolution that all bins share.
const LEARNED_VALUES: usize = 16;

/// Operators that rearrange values and change none.
fn moves_values(node: &Node) -> bool {
    [
        "Reshape",
        "Transpose",
        "Squeeze",
        "Unsqueeze",
        "Flatten",
        "SpaceToDepth",
        "DepthToSpace",
    ]
    .contains(&node.op_type.as_str())
}

/// Sets of activations that share a range.
#[derive(Default)]
struct Ties {
    names: Vec<String>,
    set: Vec<usize>,
}

impl Ties {
    fn index(&mut self, name: &str) -> usize {
        let known = self.names.iter().position(|n| n == name);
        known.unwrap_or_else(|| {
            self.names.push(name.to_owned());
            self.set.push(self.names.len() - 1);
            self.names.len() - 1
        })
    }

    fn join(&mut self, a: usize, b: usize) {
        let (keep, gone) = (self.set[a], self.set[b]);
        for set in self.set.iter_mut().filter(|set| **set == gone) {
            *set = keep;
        }
    }

    /// Every name with the number of its set, and how many sets there are.
    fn groups(self) -> (Vec<(String, usize)>, usize) {
        let mut order = vec![];
        let groups = (self.names.into_iter().zip(self.set))
            .map(|(name, set)| {
                let number = order.iter().position(|s| *s == set).unwrap_or_else(|| {
                    order.push(set);
                    order.len() - 1
                });
                (name, number)
            })
            .collect();
        (groups, order.len())
    }
}
