//! Between a coarse answer and its up-sampling: who should copy whom.
//!
//! A matching window that reaches over an outline sees the nearer surface on both sides of it, and what only the
//! left camera sees has no match at all. Both are mended by taking the answer of a pixel further away that lies on
//! the same surface. Which one that is, the image and the answers around tell.

use burn::module::{Module, Param};
use burn::nn::conv::Conv2d;
use burn::tensor::{Device, TensorData};

use crate::Ops;
use crate::features::{conv1x1, conv3x3};
use crate::ops::NEIGHBOURS;
use crate::regression::{MOMENTS, Moments};

/// Reaches of the neighbours that are mixed, one after the other, pixels of the coarse resolution: an answer
/// travels up to 28 pixels of the image in each direction.
const REACHES: [usize; 3] = [4, 2, 1];

/// Mixes each pixel's answer from those around it with positive weights that sum to one (Cheng 2018, "Depth estimation
/// via affinity learned with convolutional spatial propagation network"), which are learned from the image, the
/// disparity and its confidence, seen at two resolutions.
#[derive(Module, Debug)]
pub struct Refinement {
    image: Conv2d,
    answer: Conv2d,
    down: Conv2d,
    down_more: Conv2d,
    up: Conv2d,
    across: Conv2d,
    /// One a reach.
    weights: Vec<Conv2d>,
}

impl Refinement {
    /// `context` channels come in and go out; `hidden` are used.
    pub fn init(context: usize, hidden: usize, device: &Device) -> Self {
        let weights = |_| {
            let mut layer = conv1x1([context, NEIGHBOURS], device);
            // At the start each pixel keeps to itself.
            let mut bias = vec![-5.0f32; NEIGHBOURS];
            bias[NEIGHBOURS / 2] = 1.0;
            let bias = TensorData::new(bias, [NEIGHBOURS]);
            layer.bias = Some(Param::from_data(bias, device));
            layer
        };
        Self {
            image: conv3x3([context, hidden], 1, device),
            answer: conv3x3([2, hidden], 1, device),
            down: conv3x3([hidden, hidden], 2, device),
            down_more: conv3x3([hidden, hidden], 1, device),
            up: conv1x1([hidden, context], device),
            across: conv1x1([hidden, context], device),
            weights: REACHES.map(weights).into(),
        }
    }

    /// Better moments, one channel each, and features that know of them, from the left image's features `[B, context,
    /// h, w]`.
    pub(crate) fn forward<O: Ops>(
        &self,
        ops: &mut O,
        moments: &Moments<O::Map>,
        context: &O::Map,
    ) -> (O::Map, O::Map) {
        let name = |layer: &str| format!("refinement.{layer}");
        // Of the order of one, as the features are.
        let disparity = ops.affine(0.25, 0.0, &moments.mean);
        let answer = ops.concat(&[disparity, moments.confidence.clone()]);
        let answer = ops.conv2d(&name("answer"), &self.answer, &answer);
        let image = ops.conv2d(&name("image"), &self.image, context);
        let high = ops.add(&image, &answer);
        let high = ops.relu(&high);
        let low = ops.conv2d(&name("down"), &self.down, &high);
        let low = ops.relu(&low);
        let low = ops.conv2d(&name("down_more"), &self.down_more, &low);
        let low = ops.relu(&low);
        let up = ops.conv2d(&name("up"), &self.up, &low);
        let up = ops.double(&up);
        let across = ops.conv2d(&name("across"), &self.across, &high);
        let features = ops.add(&up, &across);
        let features = ops.add(context, &features);
        let features = ops.relu(&features);

        let mut mixed = moments.as_channels(ops);
        for (k, (reach, layer)) in REACHES.into_iter().zip(&self.weights).enumerate() {
            let weights = ops.conv2d(&name(&format!("weights.{k}")), layer, &features);
            let weights = ops.sigmoid(&weights);
            let mean = name(&format!("mean.{k}"));
            mixed = ops.mean_of_neighbours(&mean, 1, reach, &weights, MOMENTS, &mixed);
        }
        (mixed, features)
    }
}
