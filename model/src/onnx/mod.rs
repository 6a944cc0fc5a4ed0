//! The network as ONNX: opset 17, dynamic batch, height and width.
//!
//! Inputs `left` and `right`, `[B, 3, H, W]`, RGB in 0..=1, of any size; outputs `disparity`,
//! `confidence` and `sigma`, `[B, 1, H, W]`. Padding and cropping are part of the graph.

mod proto;
mod writer;

use std::path::Path;

use prost::Message;

use crate::weights::write_atomically;
use crate::{ModelError, StereoNet};

/// Version of the operator set that is written; every ONNX Runtime since 1.11 runs it.
const OPSET: i64 = 17;

/// The network as the bytes of an ONNX file.
pub fn to_bytes(net: &StereoNet) -> Vec<u8> {
    let mut graph = writer::GraphWriter::default();
    let (left, right) = ("left".to_owned(), "right".to_owned());
    let prediction = net.run(&mut graph, &left, &right);
    let outputs = [
        ("disparity", prediction.disparity),
        ("confidence", prediction.confidence),
        ("sigma", prediction.sigma),
    ];
    for (name, value) in &outputs {
        graph.output(name, value);
    }
    let image = |name: &str| proto::ValueInfo::float(name, ["batch", "3", "height", "width"]);
    let map = |name: &str| proto::ValueInfo::float(name, ["batch", "1", "height", "width"]);
    let metadata = [
        ("max_disparity", net.config().max_disparity.to_string()),
        (
            "input",
            "RGB in 0..1, rectified, rows corresponding".to_owned(),
        ),
        (
            "disparity",
            "pixels, x_right = x_left - disparity".to_owned(),
        ),
    ];
    let model = proto::Model {
        ir_version: 8,
        producer_name: "barchan".into(),
        producer_version: env!("CARGO_PKG_VERSION").into(),
        doc_string: "Stereo disparity of the left image of a rectified pair.".into(),
        graph: Some(proto::Graph {
            name: "stereo".into(),
            node: graph.nodes,
            initializer: graph.initializers,
            input: vec![image("left"), image("right")],
            output: outputs.iter().map(|(name, _)| map(name)).collect(),
        }),
        opset_import: vec![proto::OperatorSet {
            domain: String::new(),
            version: OPSET,
        }],
        metadata_props: metadata
            .into_iter()
            .map(|(key, value)| proto::StringStringEntry {
                key: key.into(),
                value,
            })
            .collect(),
    };
    model.encode_to_vec()
}

/// Writes an ONNX file, all or nothing.
///
/// # Errors
/// When the file cannot be written.
pub fn save(net: &StereoNet, path: &Path) -> Result<(), ModelError> {
    write_atomically(path, &to_bytes(net))
}
