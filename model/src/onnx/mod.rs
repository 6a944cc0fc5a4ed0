//! The network as ONNX: opset 17, dynamic batch, height and width.
//!
//! Inputs `left` and `right`, `[B, 3, H, W]`, RGB in 0..=1, of any size; outputs `disparity`,
//! `confidence` and `sigma`, `[B, 1, H, W]`. Padding and cropping are part of the graph.

mod writer;

use std::path::Path;

use barchan_onnx::{Message, proto};

use crate::weights::write_atomically;
use crate::{Argmin, ModelError, StereoNet};

/// The network as the bytes of an ONNX file.
pub fn to_bytes(net: &StereoNet) -> Vec<u8> {
    let mut writer = writer::GraphWriter::default();
    let (left, right) = ("left".to_owned(), "right".to_owned());
    let prediction = net.run(&mut writer, Argmin::AroundPeak, &left, &right);
    let outputs = [
        ("disparity", prediction.disparity),
        ("confidence", prediction.confidence),
        ("sigma", prediction.sigma),
    ];
    for (name, value) in &outputs {
        writer.graph.node(name, "Identity", &[value], vec![]);
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
    let metadata = metadata.map(|(key, value)| (key.to_owned(), value));
    writer
        .graph
        .finish(
            "stereo",
            vec![image("left"), image("right")],
            outputs.iter().map(|(name, _)| map(name)).collect(),
            "Stereo disparity of the left image of a rectified pair.",
            metadata,
        )
        .encode_to_vec()
}

/// Writes an ONNX file, all or nothing.
///
/// # Errors
/// When the file cannot be written.
pub fn save(net: &StereoNet, path: &Path) -> Result<(), ModelError> {
    write_atomically(path, &to_bytes(net))
}
