use barchan_datasets::{Plane, Rgb, StereoFrame};
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use crate::loss;

/// How well held-out pairs are explained.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Validation {
    /// How many pairs were held out.
    pub frames: usize,
    /// The photometric part of the loss, `a1 L_SSIM + a2 L_1` and the weighted census term where that
    /// is on, mean over pairs; whole images, without options that choose pixels.
    pub photometric: f32,
    /// Mean (1 - SSIM) / 2.
    pub ssim: f32,
    /// Mean absolute difference.
    pub l1: f32,
    /// Mean census distance, where that is part of the loss.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub census: Option<f32>,
    /// How far the disparity is off, where pairs have truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub accuracy: Option<Accuracy>,
}

/// Disparity against the truth, over all pixels whose truth is known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Accuracy {
    /// Mean absolute error, pixels.
    pub epe: f64,
    /// Percent of pixels that are off by more than two pixels.
    pub bad2: f64,
    /// Percent of pixels that are off by more than three pixels.
    pub bad3: f64,
}

impl Validation {
    /// Whether this is the better explanation: by the mean error where both know the truth, else by
    /// the photometric loss.
    pub fn is_better_than(&self, other: &Self) -> bool {
        match (self.accuracy, other.accuracy) {
            (Some(a), Some(b)) => a.epe < b.epe,
            _ => self.photometric < other.photometric,
        }
    }
}

/// A validation, and after how many steps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scored {
    /// Steps done.
    pub step: usize,
    /// What was found.
    pub validation: Validation,
}

/// A held-out pair as the network explains it: what a picture is made of.
#[derive(Clone, Debug)]
pub struct Explained {
    /// The pair.
    pub frame: StereoFrame,
    /// The disparity of its left image, pixels.
    pub disparity: Plane,
    /// The right image seen from the left camera through that disparity; NaN where it shows nothing.
    pub warped: Rgb,
    /// The true disparity, NaN where not known; where the data has any.
    pub truth: Option<Plane>,
}

impl Explained {
    /// `right` and `disparity` are `[1, 3, H, W]` and `[1, 1, H, W]`, those of `frame`.
    pub(crate) fn new(
        frame: StereoFrame,
        right: &Tensor<4>,
        disparity: &Tensor<4>,
        truth: Option<Plane>,
    ) -> Self {
        let (warped, inside) = loss::warp_right_to_left(right, disparity);
        let [warped, inside]: [Vec<f32>; 2] =
            [warped, inside].map(|t| t.to_data().iter().collect());
        let (width, height) = frame.left.dimensions();
        let plane = (width * height) as usize;
        Self {
            disparity: to_plane(disparity, width, height),
            warped: Rgb::from_fn(width, height, |x, y| {
                let at = (y * width + x) as usize;
                image::Rgb(match inside[at] > 0.0 {
                    true => std::array::from_fn(|c| warped[c * plane + at]),
                    false => [f32::NAN; 3],
                })
            }),
            frame,
            truth,
        }
    }
}

/// A tensor `[1, 1, H, W]` as an image.
pub(crate) fn to_plane(tensor: &Tensor<4>, width: u32, height: u32) -> Plane {
    // One value a pixel: the network's answer has the size of the images.
    Plane::from_raw(width, height, tensor.to_data().iter().collect()).unwrap_or_default()
}

/// Adds up errors over pairs.
#[derive(Default)]
pub(crate) struct Errors {
    known: usize,
    sum: f64,
    above: [usize; 2],
}

impl Errors {
    pub fn add(&mut self, disparity: &Plane, truth: &Plane) {
        for (d, t) in disparity.iter().zip(truth.iter()) {
            if t.is_finite() {
                let error = (d - t).abs();
                self.known += 1;
                self.sum += f64::from(error);
                self.above[0] += usize::from(error > 2.0);
                self.above[1] += usize::from(error > 3.0);
            }
        }
    }

    pub fn accuracy(&self) -> Option<Accuracy> {
        let share = |n| 100.0 * n as f64 / self.known as f64;
        (self.known > 0).then(|| Accuracy {
            epe: self.sum / self.known as f64,
            bad2: share(self.above[0]),
            bad3: share(self.above[1]),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_count_where_the_truth_is_known() {
        let plane = |values: Vec<f32>| Plane::from_raw(values.len() as u32, 1, values).unwrap();
        let mut errors = Errors::default();
        assert_eq!(errors.accuracy(), None);
        errors.add(
            &plane(vec![1.0, 5.0, 9.0, 7.0]),
            &plane(vec![1.5, 2.5, f32::NAN, 3.0]),
        );
        errors.add(&plane(vec![2.0]), &plane(vec![2.0]));
        let found = errors.accuracy().unwrap();
        assert_eq!((found.epe, found.bad2, found.bad3), (1.75, 50.0, 25.0));
    }

    #[test]
    fn the_truth_outweighs_the_images() {
        let validation = |photometric, epe: Option<f64>| Validation {
            frames: 1,
            photometric,
            ssim: 0.0,
            l1: 0.0,
            census: None,
            accuracy: epe.map(|epe| Accuracy {
                epe,
                bad2: 0.0,
                bad3: 0.0,
            }),
        };
        assert!(validation(2.0, Some(1.0)).is_better_than(&validation(1.0, Some(2.0))));
        assert!(validation(1.0, None).is_better_than(&validation(2.0, None)));
        assert!(!validation(1.0, None).is_better_than(&validation(1.0, None)));
    }
}
