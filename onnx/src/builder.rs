use std::collections::HashMap;

use crate::proto::{
    Attribute, Graph, Model, Node, OperatorSet, StringStringEntry, Tensor, ValueInfo,
};

/// Version of the operator set that is written; every ONNX Runtime since 1.11 runs it.
pub const OPSET: i64 = 17;

/// Collects nodes and constants. A value is the name of the node that yields it.
#[derive(Default)]
pub struct GraphBuilder {
    nodes: Vec<Node>,
    initializers: Vec<Tensor>,
    /// How often each name was asked for, to keep names unique: the second `x` is `x.2`.
    names: HashMap<String, usize>,
}

impl GraphBuilder {
    /// `name`, or `name.2`, `name.3`, ... where it was asked for before.
    pub fn unique(&mut self, name: &str) -> String {
        let count = self.names.entry(name.to_owned()).or_insert(0);
        *count += 1;
        if *count == 1 {
            name.to_owned()
        } else {
            format!("{name}.{count}")
        }
    }

    /// Adds a node of one output, and gives that output's name.
    pub fn node(
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

    /// Splits an axis into `N` equal parts. Nodes and outputs are named after `name`.
    pub fn split<const N: usize>(&mut self, name: &str, axis: i64, x: &str) -> [String; N] {
        let first = self.node(name, "Split", &[x], vec![Attribute::int("axis", axis)]);
        let outputs: [String; N] = std::array::from_fn(|k| match k {
            0 => first.clone(),
            k => self.unique(&format!("{name}.{k}")),
        });
        if let Some(node) = self.nodes.last_mut() {
            node.output = outputs.to_vec();
        }
        outputs
    }

    /// A node named after its operator.
    pub fn plain(&mut self, op: &str, inputs: &[&str], attributes: Vec<Attribute>) -> String {
        self.node(&op.to_lowercase(), op, inputs, attributes)
    }

    /// A constant list of whole numbers, as shapes and axes want.
    pub fn ints(&mut self, values: &[i64]) -> String {
        let name = self.unique("shape");
        self.initializers.push(Tensor::ints(&name, values));
        name
    }

    /// A constant number.
    pub fn scalar(&mut self, value: f32) -> String {
        self.floats("scalar", &[], [value])
    }

    /// A constant tensor under a name of its own.
    pub fn floats(
        &mut self,
        name: &str,
        dims: &[usize],
        values: impl IntoIterator<Item = f32>,
    ) -> String {
        let name = self.unique(name);
        self.initializers.push(Tensor::floats(&name, dims, values));
        name
    }

    /// A constant tensor under exactly this name, made by `values` where it is not there yet.
    pub fn shared<I: IntoIterator<Item = f32>>(
        &mut self,
        name: &str,
        dims: &[usize],
        values: impl FnOnce() -> I,
    ) -> String {
        if !self.initializers.iter().any(|t| t.name == name) {
            self.initializers.push(Tensor::floats(name, dims, values()));
        }
        name.to_owned()
    }

    /// The file: this graph with its inputs and outputs. `doc` and `metadata` are for people and tools.
    pub fn finish(
        self,
        name: &str,
        input: Vec<ValueInfo>,
        output: Vec<ValueInfo>,
        doc: &str,
        metadata: impl IntoIterator<Item = (String, String)>,
    ) -> Model {
        Model {
            ir_version: 8,
            producer_name: "barchan".into(),
            producer_version: env!("CARGO_PKG_VERSION").into(),
            doc_string: doc.into(),
            graph: Some(Graph {
                name: name.into(),
                node: self.nodes,
                initializer: self.initializers,
                input,
                output,
            }),
            opset_import: vec![OperatorSet {
                domain: String::new(),
                version: OPSET,
            }],
            metadata_props: metadata
                .into_iter()
                .map(|(key, value)| StringStringEntry { key, value })
                .collect(),
        }
    }
}
