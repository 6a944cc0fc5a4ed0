//! Key points and their descriptors.

mod akaze;
mod orb;

use barchan_datasets::Plane;

pub use akaze::Akaze;
pub use orb::Orb;

/// Binary comparisons, a bit each; a detector with fewer than 512 leaves the rest zero.
pub type Descriptor = [u8; 64];

/// Where a feature was seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Keypoint {
    /// Column, pixels.
    pub u: f64,
    /// Row, pixels.
    pub v: f64,
    /// Size against a feature of the finest level; for a pyramid, of a pixel of its level in
    /// pixels of the image.
    pub scale: f64,
    /// Standard deviation of the position, pixels.
    pub sigma: f64,
}

/// The features of an image.
#[derive(Clone, Debug, Default)]
pub struct Features {
    /// Where.
    pub keypoints: Vec<Keypoint>,
    /// What it looks like, one a key point.
    pub descriptors: Vec<Descriptor>,
    /// Bits of a descriptor that are in use.
    pub bits: u32,
}

/// Something that finds features.
pub trait FeatureDetector: Send + Sync {
    /// Features of a grey image in 0..=1; the same image gives the same features, bit by bit.
    ///
    /// # Errors
    /// What the detector says of an image that it cannot take.
    fn detect(&self, grey: &Plane) -> Result<Features, String>;
}
