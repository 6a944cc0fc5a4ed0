//! Key points and their descriptors.

use barchan_datasets::Plane;
use kornia_image::{Image, ImageSize};
use kornia_imgproc::features::OrbDetector;

/// 256 binary comparisons.
pub type Descriptor = [u8; 32];

/// Where a corner was seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Keypoint {
    /// Column, pixels.
    pub u: f64,
    /// Row, pixels.
    pub v: f64,
    /// Level of the image pyramid, 0 the finest; its position is as coarse as the level.
    pub octave: u8,
}

/// Scale between two levels of the pyramid.
pub(crate) const OCTAVE_SCALE: f64 = 1.2;

impl Keypoint {
    /// Standard deviation of the position, pixels: one pixel of its level.
    pub fn sigma(&self) -> f64 {
        OCTAVE_SCALE.powi(i32::from(self.octave))
    }
}

/// The features of an image.
#[derive(Clone, Debug, Default)]
pub struct Features {
    /// Where.
    pub keypoints: Vec<Keypoint>,
    /// What it looks like, one a key point.
    pub descriptors: Vec<Descriptor>,
}

/// Oriented FAST and rotated BRIEF (Rublee 2011), spread over the image by a quadtree.
pub struct Orb {
    detector: OrbDetector,
}

impl Orb {
    /// Looks for about `features` corners with a brightness step of at least `threshold` of 255.
    pub fn new(features: usize, threshold: f32) -> Self {
        let detector = OrbDetector {
            n_keypoints: features,
            ini_fast_threshold: threshold / 255.0,
            min_fast_threshold: 0.5 * threshold / 255.0,
            downscale: OCTAVE_SCALE as f32,
            ..OrbDetector::default()
        };
        Self { detector }
    }

    /// Features of a grey image in 0..=1.
    ///
    /// # Errors
    /// What the detector says, when the image is too small for it.
    pub fn extract(&self, grey: &Plane) -> Result<Features, String> {
        let bytes = grey
            .iter()
            .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8)
            .collect();
        let size = ImageSize {
            width: grey.width() as usize,
            height: grey.height() as usize,
        };
        let image = Image::<u8, 1>::new(size, bytes).map_err(|e| e.to_string())?;
        let found = self
            .detector
            .detect_and_extract_u8(&image)
            .map_err(|e| e.to_string())?;
        let keypoints = found
            .keypoints_xy
            .iter()
            .zip(&found.octaves)
            .map(|(xy, octave)| Keypoint {
                u: f64::from(xy[0]),
                v: f64::from(xy[1]),
                octave: *octave,
            })
            .collect();
        Ok(Features {
            keypoints,
            descriptors: found.descriptors,
        })
    }
}
