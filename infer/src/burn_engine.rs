use barchan_datasets::{Rgb, planar};
use barchan_model::{Device, StereoNet, Tensor};

use crate::engine::check_sizes;
use crate::{DisparityEngine, DisparityMap, InferError};

/// Runs a network with Burn: nothing to install.
pub struct BurnEngine {
    net: StereoNet,
    device: Device,
    name: String,
}

impl BurnEngine {
    /// Runs `net`, which lives on `device`; `name` is for people.
    pub fn new(net: StereoNet, device: Device, name: &str) -> Self {
        Self {
            net,
            device,
            name: name.into(),
        }
    }
}

impl DisparityEngine for BurnEngine {
    fn name(&self) -> String {
        format!("burn {}", self.name)
    }

    fn disparity(&mut self, left: &Rgb, right: &Rgb) -> Result<DisparityMap, InferError> {
        check_sizes(left, right)?;
        let size = [left.width() as usize, left.height() as usize];
        let [left_tensor, right_tensor] = [left, right].map(|image| {
            Tensor::<1>::from_floats(planar(image, [0, 0], size).as_slice(), &self.device)
                .reshape([1, 3, size[1], size[0]])
        });
        let prediction = self.net.forward(left_tensor, right_tensor);
        let read = |t: Tensor<4>| {
            t.into_data()
                .try_to_vec::<f32>()
                .map_err(|e| InferError::Failed {
                    engine: self.name(),
                    message: format!("{e:?}"),
                })
        };
        let outputs = [
            read(prediction.disparity)?,
            read(prediction.sigma)?,
            read(prediction.confidence)?,
        ];
        DisparityMap::from_network(&self.name(), left.dimensions(), outputs)
    }
}
