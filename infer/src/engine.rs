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
        let known = self
            .disparity
            .as_raw()
            .iter()
            .filter(|d| d.is_finite())
            .count();
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

    /// Disparity of several pairs `(left, right)`, each as [`Self::disparity`] gives it; of any sizes.
    /// Engines that run several at once do so.
    ///
    /// # Errors
    /// When the sizes of a pair differ, or the engine fails.
    fn disparity_batch(&mut self, pairs: &[(&Rgb, &Rgb)]) -> Result<Vec<DisparityMap>, InferError> {
        pairs
            .iter()
            .map(|(left, right)| self.disparity(left, right))
            .collect()
    }

    /// Runs a flat pair of the size that is to come, so that what is done once, for this size, is done
    /// before anybody counts time.
    ///
    /// # Errors
    /// When the size is 0, or the engine fails.
    fn warm_up(&mut self, width: u32, height: u32) -> Result<(), InferError> {
        let flat = Rgb::from_pixel(width, height, image::Rgb([0.5; 3]));
        self.disparity(&flat, &flat).map(drop)
    }
}

impl DisparityMap {
    /// From the three outputs of a network, each one value a pixel, row by row.
    #[cfg(feature = "burn")]
    pub(crate) fn from_network(
        engine: &str,
        (width, height): (u32, u32),
        outputs: [Vec<f32>; 3],
    ) -> Result<Self, InferError> {
        let plane = |data: Vec<f32>| {
            let found = data.len();
            Plane::from_raw(width, height, data)
                .filter(|_| found == (width * height) as usize)
                .ok_or_else(|| InferError::Failed {
                    engine: engine.into(),
                    message: format!(
                        "an output of {found} values for an image of {width} x {height}"
                    ),
                })
        };
        let [disparity, sigma, confidence] = outputs;
        Ok(Self {
            disparity: plane(disparity)?,
            sigma: plane(sigma)?,
            confidence: plane(confidence)?,
        })
    }
}

/// Refuses a pair of two sizes, and an empty one.
pub(crate) fn check_sizes(left: &Rgb, right: &Rgb) -> Result<(), InferError> {
    let (left, right) = (left.dimensions(), right.dimensions());
    if left != right || left.0 == 0 || left.1 == 0 {
        return Err(InferError::Sizes { left, right });
    }
    Ok(())
}

/// Why there is no disparity.
#[derive(Debug, thiserror::Error)]
pub enum InferError {
    /// The two images of a pair have different sizes.
    #[error("the left image is {0} x {1} and the right {2} x {3}: a pair has one size, at least 1 x 1", left.0, left.1, right.0, right.1)]
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
    /// A file beside the model could not be written.
    #[error(transparent)]
    Data(#[from] barchan_datasets::DataError),
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
