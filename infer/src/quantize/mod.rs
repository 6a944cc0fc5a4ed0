//! A float network as ONNX becomes an int8 one.
//!
//! Static quantisation in the QDQ form: weights int8, symmetric, one scale per output channel; biases
//! int32; activations uint8 with one scale and zero point each, from the ranges seen on calibration
//! pairs (Jacob et al. 2018, "Quantization and Training of Neural Networks for Efficient
//! Integer-Arithmetic-Only Inference"; per-channel weights after Krishnamoorthi 2018).
//!
//! What is rounded is what ONNX Runtime runs faster for it on a CPU: convolutions, 2-D and 3-D, of
//! enough channels. Small ones stay float, and transposed convolutions and matrix products, of which
//! it has no faster int8 kernel (ratios of 1.04 and 1.1). Fixed kernels (sums, expectations,
//! differences), told by their few different values, stay float too: disparity depends on their precision.
//!
//! Processors of x86-64 without VNNI add products of uint8 and int8 in 16 bits that overflow at large
//! weights. ONNX Runtime's remedy, the session entry `session.x64quantprecision`, fails in 1.31 where convolutions
//! share weights, so there int8 is at its user's risk.

mod calibrate;
mod plan;
mod range;
mod rewrite;

use barchan_datasets::{DataError, StereoFrame};
use barchan_onnx::Message;
use barchan_onnx::proto::{Graph, Model, StringStringEntry};

use crate::{InferError, Runtime};

/// What is rounded, and how.
#[derive(Clone, Debug)]
pub struct QuantizeOptions {
    /// The range of an activation lies between this percentile of its values that are not zero
    /// and the same share from below; values beyond are clipped. 100 clips none.
    pub percentile: f64,
    /// Names of convolutions that stay float.
    pub keep_float: Vec<String>,
}

impl Default for QuantizeOptions {
    fn default() -> Self {
        Self {
            // Of 99.9, 99.99, 99.999, 100 and the range of least squared error, the one that moves
            // the disparity least on data unlike the calibration pairs.
            percentile: 99.99,
            keep_float: vec![],
        }
    }
}

/// An int8 network, and what was done to it.
#[derive(Clone, Debug)]
pub struct Quantized {
    /// The ONNX file.
    pub onnx: Vec<u8>,
    /// How many pairs the ranges come from.
    pub pairs: usize,
    /// Names of the convolutions that run in int8.
    pub int8: Vec<String>,
    /// Names of the convolutions that stay float, each with the reason.
    pub float: Vec<(String, String)>,
}

/// Why a network was not quantised.
#[derive(Debug, thiserror::Error)]
pub enum QuantizeError {
    /// A calibration pair cannot be read.
    #[error(transparent)]
    Data(#[from] DataError),
    /// There was no calibration pair.
    #[error(
        "no calibration pairs: the ranges of int8 come from images\n  cure: give data with at least one pair"
    )]
    NoPairs,
    /// The model is not one that can be quantised.
    #[error("{0}")]
    Model(String),
    /// The network computes infinity or NaN.
    #[error(
        "{activation} is not finite on frame {frame}\n  cure: give other calibration pairs, or weights that work on these"
    )]
    NotFinite {
        /// The value in the graph.
        activation: String,
        /// The calibration pair.
        frame: String,
    },
    /// ONNX Runtime refused.
    #[error(transparent)]
    Engine(#[from] InferError),
}

/// Quantises the ONNX file `model`, one that `barchan export` wrote: inputs `left` and `right`,
/// `[B, 3, H, W]`, RGB in 0..=1. The ranges come from running it on `pairs`, one after another.
///
/// # Errors
/// When the model is another's, already quantised, or has no convolution worth it; when there is no
/// pair, or one cannot be read; when ONNX Runtime fails.
pub fn quantize(
    model: &[u8],
    runtime: &Runtime,
    pairs: impl IntoIterator<Item = Result<StereoFrame, DataError>>,
    options: &QuantizeOptions,
) -> Result<Quantized, QuantizeError> {
    let (mut model, graph) = read(model)?;
    let plan = plan::plan(&graph, options)?;
    if plan.convolutions.is_empty() {
        return Err(QuantizeError::Model(
            "no convolution that int8 would speed up: the network stays float".into(),
        ));
    }
    model.graph = Some(graph);
    let (ranges, pairs) = calibrate::calibrate(&model, &plan, runtime, pairs, options.percentile)?;
    let name = |c: &plan::Convolution| Some(model.graph.as_ref()?.node.get(c.node)?.name.clone());
    let int8 = plan.convolutions.iter().filter_map(name).collect();
    model.graph = (model.graph.take()).map(|graph| rewrite::rewrite(graph, &plan, &ranges));
    model.metadata_props.push(StringStringEntry {
        key: "quantization".into(),
        value: format!("int8 QDQ, {pairs} calibration pairs"),
    });
    Ok(Quantized {
        onnx: model.encode_to_vec(),
        pairs,
        int8,
        float: plan.float,
    })
}

/// The messages of a file, if nothing of it would be lost.
fn read(bytes: &[u8]) -> Result<(Model, Graph), QuantizeError> {
    let cure = "cure: give a float file that `barchan export` wrote";
    let wrong = |what: String| QuantizeError::Model(format!("{what}\n  {cure}"));
    let mut model = Model::decode(bytes).map_err(|e| wrong(format!("not an ONNX file: {e}")))?;
    let marks = ["QuantizeLinear", "DequantizeLinear", "QLinear", "Integer"];
    if let Some(node) = (model.graph.iter().flat_map(|g| &g.node))
        .find(|n| marks.iter().any(|mark| n.op_type.contains(mark)))
    {
        return Err(wrong(format!(
            "already quantised: node {} is {}",
            node.name, node.op_type
        )));
    }
    if !(model.opset_import.iter()).any(|set| set.domain.is_empty() && set.version >= 13) {
        return Err(wrong(
            "operator set older than 13, which has no scale per channel".into(),
        ));
    }
    if model.encode_to_vec() != bytes {
        return Err(wrong(
            "an ONNX file of another program, parts of which are not read here".into(),
        ));
    }
    let graph = model
        .graph
        .take()
        .ok_or_else(|| wrong("an ONNX file without a graph".into()))?;
    let inputs: Vec<&str> = graph.input.iter().map(|i| i.name.as_str()).collect();
    if inputs != ["left", "right"] {
        return Err(wrong(format!("inputs {inputs:?}; expected left and right")));
    }
    Ok((model, graph))
}
