//! Disparity engines: a rectified pair in; disparity, standard deviation and confidence out.
//!
//! What it is for: [`DisparityEngine`], the one trait through which SLAM, mapping and the command
//! line see disparity, whoever makes it; [`SemiGlobal`] and [`BlockMatching`], which need no model;
//! [`Outlines`], which puts the outlines of a
//! network's disparity where the images have them; [`Rejection`], which marks as unknown what the pair itself contradicts. Engines stand behind
//! features: `burn`, `onnxruntime`. With the latter, `probe` finds out what somebody else's ONNX file
//! wants and means, a `Contract` (`x.toml` beside `x.onnx`) keeps it for `OnnxEngine`, and `quantize`
//! makes an int8 network out of a float one.
//!
//! What it promises: any image size; disparity positive (`x_right = x_left - d`), NaN is unknown.
//!
//! What it never does: train, or know where images come from.

#[cfg(feature = "burn")]
mod burn_engine;
mod classical;
mod engine;
#[cfg(feature = "onnxruntime")]
mod onnxruntime;
mod outlines;
#[cfg(feature = "onnxruntime")]
mod probe;
#[cfg(feature = "onnxruntime")]
mod quantize;
mod rejection;
mod threaded;

#[cfg(feature = "burn")]
pub use burn_engine::BurnEngine;
pub use classical::{BlockMatching, SemiGlobal};
pub use engine::{DisparityEngine, DisparityMap, InferError};
#[cfg(feature = "onnxruntime")]
pub use onnxruntime::{
    Channels, Contract, ImageFormat, InputFormat, Layout, ModelSize, OnnxEngine, OutputFormat,
    OutputLayout, Runtime, Side, Unit,
};
pub use outlines::{Outlined, Outlines, SecondOpinion};
#[cfg(feature = "onnxruntime")]
pub use probe::{Decision, Verdict, probe};
#[cfg(feature = "onnxruntime")]
pub use quantize::{QuantizeError, QuantizeOptions, Quantized, quantize};
pub use rejection::{Rejection, structural_dissimilarity, warp_right_to_left};
pub use threaded::Threaded;
