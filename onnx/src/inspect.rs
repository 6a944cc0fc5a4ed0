//! Is a file safe to hand to a runtime? Read without copying its weights.

use std::collections::HashMap;

use prost::Message;
use prost::bytes::Bytes;

/// Most elements of a tensor that a graph conjures up out of nothing: a gigabyte of floats.
const MOST_ELEMENTS: u64 = 1 << 28;

/// Checks an ONNX file of strangers before any runtime sees it: that it is whole, that every constant
/// has the bytes which its dimensions promise, that none lies in another file, that no shape is
/// absurd, and that the graph has no cycle. Nothing is allocated beyond the list of nodes: weights
/// stay where they are.
///
/// # Errors
/// What is wrong, and the cure where there is one, without the name of the file.
pub fn check(file: Bytes) -> Result<(), String> {
    if file.is_empty() {
        return Err("an empty file".into());
    }
    let model = Model::decode(file)
        .map_err(|e| format!("no ONNX file, or one that was cut short or damaged: {e}"))?;
    let graph = model
        .graph
        .ok_or("holds no graph: no ONNX model, or one that was cut short")?;
    if !model.training.is_empty() {
        return Err("holds training graphs\n  cure: export it for inference".into());
    }
    graph.check()?;
    (model.functions.iter()).try_for_each(|function| acyclic(&function.node))
}

/// The messages of `onnx.proto` once more, with what a check wants and weights as views of the file.
#[derive(Clone, PartialEq, Message)]
struct Model {
    #[prost(message, optional, tag = "7")]
    graph: Option<Graph>,
    #[prost(bytes = "bytes", repeated, tag = "20")]
    training: Vec<Bytes>,
    #[prost(message, repeated, tag = "25")]
    functions: Vec<Function>,
}

#[derive(Clone, PartialEq, Message)]
struct Function {
    #[prost(message, repeated, tag = "7")]
    node: Vec<Node>,
}

#[derive(Clone, PartialEq, Message)]
struct Graph {
    #[prost(message, repeated, tag = "1")]
    node: Vec<Node>,
    #[prost(message, repeated, tag = "5")]
    initializer: Vec<Tensor>,
    #[prost(bytes = "bytes", repeated, tag = "15")]
    sparse_initializer: Vec<Bytes>,
}

#[derive(Clone, PartialEq, Message)]
struct Node {
    #[prost(string, repeated, tag = "1")]
    input: Vec<String>,
    #[prost(string, repeated, tag = "2")]
    output: Vec<String>,
    #[prost(string, tag = "3")]
    name: String,
    #[prost(string, tag = "4")]
    op_type: String,
    #[prost(message, repeated, tag = "5")]
    attribute: Vec<Attribute>,
}

#[derive(Clone, PartialEq, Message)]
struct Attribute {
    #[prost(message, optional, tag = "5")]
    tensor: Option<Tensor>,
    #[prost(message, optional, tag = "6")]
    graph: Option<Graph>,
    #[prost(message, repeated, tag = "10")]
    tensors: Vec<Tensor>,
    #[prost(message, repeated, tag = "11")]
    graphs: Vec<Graph>,
    #[prost(bytes = "bytes", optional, tag = "22")]
    sparse_tensor: Option<Bytes>,
}

/// `onnx.proto` packs numbers, so that each list of them is bytes.
#[derive(Clone, PartialEq, Message)]
struct Tensor {
    #[prost(int64, repeated, tag = "1")]
    dims: Vec<i64>,
    #[prost(int32, tag = "2")]
    data_type: i32,
    #[prost(bytes = "bytes", repeated, tag = "4")]
    float_data: Vec<Bytes>,
    #[prost(bytes = "bytes", repeated, tag = "5")]
    int32_data: Vec<Bytes>,
    #[prost(bytes = "bytes", repeated, tag = "6")]
    string_data: Vec<Bytes>,
    #[prost(bytes = "bytes", repeated, tag = "7")]
    int64_data: Vec<Bytes>,
    #[prost(string, tag = "8")]
    name: String,
    #[prost(bytes = "bytes", optional, tag = "9")]
    raw_data: Option<Bytes>,
    #[prost(bytes = "bytes", repeated, tag = "10")]
    double_data: Vec<Bytes>,
    #[prost(bytes = "bytes", repeated, tag = "11")]
    uint64_data: Vec<Bytes>,
    #[prost(bytes = "bytes", repeated, tag = "13")]
    external_data: Vec<Bytes>,
    #[prost(int32, tag = "14")]
    data_location: i32,
}

impl Graph {
    fn check(&self) -> Result<(), String> {
        if !self.sparse_initializer.is_empty() {
            return Err(
                "holds sparse constants, which are not served\n  cure: export it with dense ones"
                    .into(),
            );
        }
        let mut constants: HashMap<&str, &Tensor> = HashMap::new();
        for tensor in &self.initializer {
            tensor.check(&tensor.name)?;
            constants.insert(&tensor.name, tensor);
        }
        for node in &self.node {
            for attribute in &node.attribute {
                for tensor in attribute.tensor.iter().chain(&attribute.tensors) {
                    tensor.check(&node.name)?;
                }
                if attribute.sparse_tensor.is_some() {
                    return Err(format!(
                        "node \"{}\" holds a sparse constant, which is not served\n  cure: export it with dense ones",
                        node.name
                    ));
                }
                for graph in attribute.graph.iter().chain(&attribute.graphs) {
                    graph.check()?;
                }
            }
            if let ("Constant", Some(name), Some(tensor)) = (
                node.op_type.as_str(),
                node.output.first(),
                node.attribute.iter().find_map(|a| a.tensor.as_ref()),
            ) {
                constants.insert(name, tensor);
            }
        }
        for node in &self.node {
            let shape = match node.op_type.as_str() {
                "ConstantOfShape" => node.input.first(),
                "Expand" | "Tile" | "Reshape" => node.input.get(1),
                _ => None,
            };
            let Some(shape) = shape.and_then(|name| constants.get(name.as_str())) else {
                continue;
            };
            let elements = shape.whole_numbers().map(|n| n.unsigned_abs().max(1));
            if product(elements).is_none_or(|n| n > MOST_ELEMENTS) {
                return Err(format!(
                    "node \"{}\" ({}) makes a tensor of more than {MOST_ELEMENTS} elements: the file is damaged or hostile",
                    node.name, node.op_type
                ));
            }
        }
        acyclic(&self.node)
    }
}

impl Tensor {
    fn check(&self, name: &str) -> Result<(), String> {
        if self.data_location != 0 || !self.external_data.is_empty() {
            return Err(format!(
                "constant \"{name}\" lies in another file, and only files that hold all their weights are read\n  cure: in Python, onnx.save(onnx.load(\"x.onnx\"), \"whole.onnx\", save_as_external_data=False)"
            ));
        }
        let damaged = |what: String| {
            format!(
                "constant \"{name}\" of dimensions {:?} {what}: the file is damaged or hostile",
                self.dims
            )
        };
        if self.dims.iter().any(|d| *d < 0) {
            return Err(damaged("has a negative one".into()));
        }
        let elements = product(self.dims.iter().map(|d| d.unsigned_abs()))
            .ok_or_else(|| damaged("is larger than any memory".into()))?;
        let bytes = |lists: &[Bytes]| lists.iter().map(|l| l.len() as u64).sum::<u64>();
        // The last byte of a varint has no high bit.
        let varints = |lists: &[Bytes]| -> u64 {
            let ends = |l: &Bytes| l.iter().filter(|b| **b < 0x80).count() as u64;
            lists.iter().map(ends).sum()
        };
        // Bits of an element by `TensorProto.DataType`; complex numbers are two.
        let bits: u64 = match self.data_type {
            1 | 6 | 12 => 32,
            2 | 3 | 9 | 17..=20 | 24 => 8,
            4 | 5 | 10 | 16 => 16,
            7 | 11 | 13 | 14 => 64,
            15 => 128,
            21..=23 => 4,
            25 | 26 => 2,
            8 => 0,
            other => return Err(damaged(format!("has the unknown type {other}"))),
        };
        let found = match &self.raw_data {
            Some(raw) if bits > 0 => {
                let wanted = elements.checked_mul(bits).map(|b| b.div_ceil(8));
                return if wanted == Some(raw.len() as u64) {
                    Ok(())
                } else {
                    Err(damaged(format!("has {} bytes", raw.len())))
                };
            }
            _ => match self.data_type {
                1 => bytes(&self.float_data) / 4,
                11 => bytes(&self.double_data) / 8,
                14 => bytes(&self.float_data) / 8,
                15 => bytes(&self.double_data) / 16,
                7 => varints(&self.int64_data),
                12 | 13 => varints(&self.uint64_data),
                8 => self.string_data.len() as u64,
                // Two or four to a number, the last perhaps not full.
                21..=23 | 25 | 26 => {
                    let per = 8 / bits;
                    let numbers = varints(&self.int32_data);
                    if elements.div_ceil(per) == numbers {
                        elements
                    } else {
                        numbers * per
                    }
                }
                _ => varints(&self.int32_data),
            },
        };
        if found == elements {
            Ok(())
        } else {
            Err(damaged(format!("has {found} elements")))
        }
    }

    /// The values of a constant of int64.
    fn whole_numbers(&self) -> impl Iterator<Item = i64> {
        let raw: &[u8] = match &self.raw_data {
            Some(raw) if self.data_type == 7 => raw,
            _ => &[],
        };
        let typed = self.int64_data.iter().flat_map(|list| {
            let mut list = list.clone();
            std::iter::from_fn(move || prost::encoding::decode_varint(&mut list).ok())
        });
        raw.chunks_exact(8)
            .map(|b| i64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]))
            .chain(typed.map(|v| v as i64))
    }
}

/// The product, unless it is beyond 64 bits.
fn product(mut factors: impl Iterator<Item = u64>) -> Option<u64> {
    factors.try_fold(1u64, |product, factor| product.checked_mul(factor))
}

/// Refuses a graph in which a value depends on itself (Kahn 1962: nodes whose inputs are there are
/// taken away until none is left). Files need not be sorted.
fn acyclic(nodes: &[Node]) -> Result<(), String> {
    let mut maker: HashMap<&str, usize> = HashMap::new();
    for (index, node) in nodes.iter().enumerate() {
        for output in node.output.iter().filter(|o| !o.is_empty()) {
            if maker.insert(output, index).is_some() {
                return Err(format!(
                    "two nodes yield \"{output}\": the file is damaged or hostile"
                ));
            }
        }
    }
    let mut waits = vec![0usize; nodes.len()];
    let mut users = vec![Vec::new(); nodes.len()];
    for (index, node) in nodes.iter().enumerate() {
        let mut inputs = Vec::new();
        collect_inputs(node, &mut inputs);
        for from in inputs.iter().filter_map(|name| maker.get(name)) {
            waits[index] += 1;
            users[*from].push(index);
        }
    }
    let mut ready: Vec<usize> = (0..nodes.len()).filter(|n| waits[*n] == 0).collect();
    let mut left = nodes.len();
    while let Some(node) = ready.pop() {
        left -= 1;
        for user in &users[node] {
            waits[*user] -= 1;
            if waits[*user] == 0 {
                ready.push(*user);
            }
        }
    }
    match waits.iter().position(|w| *w > 0) {
        Some(index) if left > 0 => Err(format!(
            "the graph has a cycle through or before node \"{}\": the file is damaged or hostile",
            nodes[index].name
        )),
        _ => Ok(()),
    }
}

/// What a node reads, in its subgraphs too.
fn collect_inputs<'a>(node: &'a Node, inputs: &mut Vec<&'a str>) {
    inputs.extend(node.input.iter().map(String::as_str));
    for attribute in &node.attribute {
        for graph in attribute.graph.iter().chain(&attribute.graphs) {
            graph.node.iter().for_each(|n| collect_inputs(n, inputs));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::GraphBuilder;
    use crate::proto::ValueInfo;

    fn file(change: impl FnOnce(&mut crate::proto::Model)) -> Vec<u8> {
        let mut graph = GraphBuilder::default();
        let weight = graph.floats("weight", &[2, 3], [0.0; 6]);
        let sum = graph.plain("Add", &["x", &weight], vec![]);
        graph.plain("Relu", &[&sum], vec![]);
        let value = |name| ValueInfo::float(name, ["1", "1", "2", "3"]);
        let mut model = graph.finish("g", vec![value("x")], vec![value("relu")], "", []);
        change(&mut model);
        model.encode_to_vec()
    }

    fn verdict(change: impl FnOnce(&mut crate::proto::Model)) -> String {
        check(file(change).into()).err().unwrap_or_default()
    }

    fn graph(model: &mut crate::proto::Model) -> &mut crate::proto::Graph {
        model.graph.as_mut().unwrap()
    }

    #[test]
    fn a_sound_file_passes_and_every_cut_of_it_is_refused() {
        let whole = file(|_| ());
        assert_eq!(check(whole.clone().into()), Ok(()));
        // What follows the graph may go missing: protobuf has no end.
        let graph_ends = {
            let empty = file(|m| m.opset_import.clear());
            let inside = empty.len();
            assert!(inside < whole.len());
            inside
        };
        for length in 0..graph_ends {
            let cut = check(whole[..length].to_vec().into());
            assert!(cut.is_err(), "cut at {length}");
        }
    }

    #[test]
    fn sizes_that_lie_are_refused() {
        for dims in [
            vec![2, 4],
            vec![i64::MAX, i64::MAX],
            vec![-2, -3],
            vec![1 << 40, 1 << 20],
        ] {
            let message = verdict(|m| graph(m).initializer[0].dims = dims);
            assert!(message.contains("\"weight\""), "{message}");
        }
        assert!(verdict(|m| graph(m).initializer[0].data_type = 99).contains("unknown type"));
        let message = verdict(|m| {
            let mut tensor = crate::proto::Tensor::ints("huge", &[1 << 20, 1 << 20]);
            tensor.name = "huge".into();
            graph(m).initializer.push(tensor);
            let node = crate::proto::Node {
                input: vec!["huge".into()],
                output: vec!["big".into()],
                name: "big".into(),
                op_type: "ConstantOfShape".into(),
                attribute: vec![],
            };
            graph(m).node.push(node);
        });
        assert!(message.contains("ConstantOfShape"), "{message}");
    }

    #[test]
    fn cycles_and_doubles_are_refused_and_order_is_free() {
        let message = verdict(|m| graph(m).node[0].input[0] = "relu".into());
        assert!(message.contains("cycle"), "{message}");
        let message = verdict(|m| graph(m).node[1].output[0] = "add".into());
        assert!(message.contains("two nodes"), "{message}");
        assert_eq!(verdict(|m| graph(m).node.reverse()), "");
    }

    #[test]
    fn weights_elsewhere_are_refused() {
        // TensorProto.data_location = EXTERNAL, external_data = { "location": "../secret" }.
        let entry = b"\x0a\x08location\x12\x09../secret";
        let mut tensor = vec![0x0a, 1, 6, 0x10, 1, 0x42, 1, b'w', 0x70, 1, 0x6a];
        tensor.push(entry.len() as u8);
        tensor.extend_from_slice(entry);
        let mut graph = vec![0x2a, tensor.len() as u8];
        graph.extend(tensor);
        let mut model = vec![0x3a, graph.len() as u8];
        model.extend(graph);
        let message = check(model.into()).unwrap_err();
        assert!(
            message.contains("another file") && message.contains("cure"),
            "{message}"
        );
    }
}
