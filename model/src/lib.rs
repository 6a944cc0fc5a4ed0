//! The stereo network: its definition, its weights and its ONNX form.
//!
//! What it is for: [`StereoNet`], configured by a [`NetConfig`] that a [`Preset`] names, turns a
//! rectified pair into disparity, its standard deviation and a confidence; [`weights`] reads and
//! writes safetensors; [`onnx`] writes the same network as ONNX.
//!
//! What it promises: one definition, two interpreters. Every block is written once against the
//! small vocabulary [`Ops`]; Burn executes it and the ONNX writer writes it down, so the exported
//! graph cannot drift from the trained one. One block, one file; the blocks follow the order of
//! the data: [`features`], [`volume`], [`planar`] or [`volumetric`], [`regression`].
//!
//! What it never does: read an image, name a dataset, or know a loss.

pub mod features;
mod net;
pub mod onnx;
mod ops;
pub mod planar;
pub mod refinement;
pub mod regression;
pub mod volume;
pub mod volumetric;
pub mod weights;

pub use net::{AggregationConfig, NetConfig, Prediction, Preset, StereoNet};
pub use ops::{Correlated, Execute, Kernel, Ops};
pub use regression::{Argmin, SCALE};

/// Re-exported so that users of this crate need not name Burn.
pub use burn::tensor::{Device, Tensor};

/// Why a network cannot be read or written. Each message names the file and the cure.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: std::path::PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is not a network of this program.
    #[error("{path}: {message}")]
    Weights {
        /// The file.
        path: std::path::PathBuf,
        /// What was expected and what to do.
        message: String,
    },
    /// The configuration describes no network.
    #[error("network configuration: {0}")]
    Config(String),
}
