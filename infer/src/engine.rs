use barchan_datasets::{Plane, Rgb};

/// What an engine says of a pair, at the size of the left image.
#[derive(Clone, Debug)]
pub struct DisparityMap {
    /// Disparity in pixels, `x_right = x_left - d`; NaN is unknown.
    pub disparity: Plane,
    /// Standard deviation of the disparity, pixels.
    pub sigma: Plane,
    /// 0..=1; how much of the probability lies around the answer.
    pub confidence: Plane,
}

impl DisparityMap {
    /// Share of pixels whose disparity is known.
    pub fn density(&self) -> f64 {
        let known = self.disparity.as_raw().iter().filter(|d| d.is_finite()).count();
        known as f64 / self.disparity.as_raw().len().max(1) as f64
    }
}

/// Makes disparity out of a rectified pair.
pub trait DisparityEngine: Send {
    /// For people: `onnxruntime a.onnx`.
    fn name(&self) -> String;

    /// Disparity of the left image, dense, before any rejection.
    ///
    /// # Errors
    /// When the sizes differ, or the engine fails.
    fn disparity(&mut self, left: &Rgb, right: &Rgb) -> Result<DisparityMap, InferError>;
}

/// Why there is no disparity.
#[derive(Debug, thiserror::Error)]
pub enum InferError {
    /// The two images of a pair have different sizes.
    #[error("the left image is {left:?} and the right {right:?}: a pair has one size")]
    Sizes {
        /// Width and height of the left image.
        left: (u32, u32),
        /// Width and height of the right image.
        right: (u32, u32),
    },
    /// The model file is not what it should be.
    #[error("{path}: {message}")]
    Model {
        /// The file.
        path: std::path::PathBuf,
        /// What is wrong and what to do.
        message: String,
    },
    /// The engine cannot be had on this machine.
    #[error("{0}")]
    Unavailable(String),
    /// The engine ran and failed.
    #[error("{engine}: {message}")]
    Failed {
        /// Which engine.
        engine: String,
        /// What it said.
        message: String,
    },
}
