use std::path::PathBuf;

use barchan_datasets::DataError;
use barchan_infer::InferError;
use barchan_model::ModelError;

/// Why training cannot start or go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// The data cannot be read.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The network cannot be made, read or written.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// Semi-global matching fails on a pair.
    #[error(transparent)]
    Proxies(#[from] InferError),
    /// A file of the run directory.
    #[error("{path}: {message}")]
    Run {
        /// The file or directory.
        path: PathBuf,
        /// What is wrong and what to do.
        message: String,
    },
    /// The configuration asks for what cannot be.
    #[error("{0}")]
    Config(String),
    /// What training computes is no longer a number.
    #[error(
        "step {step}: {what} is {value} on {frames}\n  cure: look at these frames; resume from the last checkpoint, or start again with a lower --lr"
    )]
    NotFinite {
        /// The step, from 1.
        step: usize,
        /// What is no number: the loss, the gradient, the weights.
        what: &'static str,
        /// What it is instead.
        value: f32,
        /// The frames of the batch, each with its data set.
        frames: String,
    },
}
