use barchan_geometry::{RectifiedRig, Trajectory};
use image::{ImageBuffer, Luma, Rgb32FImage};

use crate::{DataError, Sensors};

/// A colour image, `f32` in 0..=1. Grey sources have three equal channels.
pub type Rgb = Rgb32FImage;

/// One number a pixel: a disparity image, a confidence, a grey image. NaN is "not known".
pub type Plane = ImageBuffer<Luma<f32>, Vec<f32>>;

/// A rectified stereo pair.
#[derive(Clone, Debug)]
pub struct StereoFrame {
    /// Position in its sequence, from 0.
    pub index: usize,
    /// The file stem of its images, or a number of six digits.
    pub name: String,
    /// Seconds; the index where the source knows no times.
    pub time: f64,
    /// The left image.
    pub left: Rgb,
    /// The right image, of the same size, its rows corresponding.
    pub right: Rgb,
}

/// A sequence of rectified stereo pairs. One implementation per format.
pub trait StereoSource: Send + Sync {
    /// The rig that every frame obeys; of a source whose pairs differ in size or calibration
    /// (benchmarks), that of the first.
    fn rig(&self) -> &RectifiedRig;

    /// The rig that frame `index` obeys, without reading it.
    fn frame_rig(&self, index: usize) -> &RectifiedRig {
        let _ = index;
        self.rig()
    }

    /// How many frames there are.
    fn len(&self) -> usize;

    /// Whether there are none. (A source that opens has at least one.)
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The name of frame `index` without reading it, as in [`StereoFrame::name`].
    fn name(&self, index: usize) -> String {
        format!("{index:06}")
    }

    /// Reads (or renders) frame `index`.
    ///
    /// # Errors
    /// When a file is missing, damaged or of another size; the message names it.
    fn frame(&self, index: usize) -> Result<StereoFrame, DataError>;

    /// True disparity of the left image of frame `index`, NaN where not known.
    ///
    /// # Errors
    /// When there is truth but it cannot be read.
    fn true_disparity(&self, index: usize) -> Result<Option<Plane>, DataError> {
        let _ = index;
        Ok(None)
    }

    /// True disparity of the right image of frame `index` (a point at column `x` of it is at
    /// `x + d` in the left one), NaN where not known.
    ///
    /// # Errors
    /// When there is truth but it cannot be read.
    fn true_disparity_right(&self, index: usize) -> Result<Option<Plane>, DataError> {
        let _ = index;
        Ok(None)
    }

    /// The true trajectory of the left camera, one pose a frame, when it is known. Planar truth
    /// (`gt.csv`) stands with z = 0 and no rotation.
    fn true_trajectory(&self) -> Option<&Trajectory> {
        None
    }

    /// What else the rover measured, when the source has any of it.
    fn sensors(&self) -> Option<&Sensors> {
        None
    }
}

/// Luminance by the BT.601 weights.
pub fn luma(image: &Rgb) -> Plane {
    let data = image
        .as_raw()
        .chunks_exact(3)
        .map(|p| 0.299 * p[0] + 0.587 * p[1] + 0.114 * p[2]);
    let (width, height) = image.dimensions();
    // The buffer has one value a pixel by construction.
    Plane::from_raw(width, height, data.collect()).unwrap_or_default()
}

/// A crop of an image as red, green and blue planes one after another: how networks want it. The
/// crop must lie inside the image.
pub fn planar(image: &Rgb, [x0, y0]: [usize; 2], [width, height]: [usize; 2]) -> Vec<f32> {
    let (row, data) = (image.width() as usize, image.as_raw());
    let mut planes = Vec::with_capacity(3 * width * height);
    for channel in 0..3 {
        for y in y0..y0 + height {
            let start = 3 * (y * row + x0) + channel;
            planes.extend(data[start..].iter().step_by(3).take(width));
        }
    }
    planes
}
