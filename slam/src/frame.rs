//! A stereo pair as SLAM sees it: features, and the disparity of those that match.

use barchan_datasets::{Plane, StereoFrame, luma};
use barchan_geometry::RectifiedRig;

use crate::features::{FeatureDetector, Features};
use crate::matching::{DisparityGate, Grid, MatchCounts, stereo_matches};
use crate::{SlamConfig, SlamError};

/// A frame with its features, before anything is known of its pose.
pub(crate) struct Seen {
    /// Left and right image.
    pub grey: [Plane; 2],
    /// Features of the left and of the right image.
    pub features: [Features; 2],
    /// Disparity of each left feature, where it was matched in the right image, pixels.
    pub disparities: Vec<Option<f64>>,
    /// How stereo matches were decided.
    pub matches: MatchCounts,
    /// Left features by place.
    pub grid: Grid,
}

/// Says so when the images have not the size of the rig.
pub(crate) fn check_size(frame: &StereoFrame, rig: &RectifiedRig) -> Result<(), SlamError> {
    for image in [&frame.left, &frame.right] {
        let (width, height) = image.dimensions();
        if (width as usize, height as usize) != (rig.width, rig.height) {
            return Err(SlamError::Size {
                frame: frame.name.clone(),
                width,
                height,
                rig_width: rig.width,
                rig_height: rig.height,
            });
        }
    }
    Ok(())
}

impl Seen {
    /// Finds features in both images at once and matches them along rows, on looks alone.
    pub fn new(
        frame: &StereoFrame,
        rig: &RectifiedRig,
        detector: &dyn FeatureDetector,
        config: &SlamConfig,
    ) -> Result<Self, SlamError> {
        check_size(frame, rig)?;
        let grey = [luma(&frame.left), luma(&frame.right)];
        let (left, right) = rayon::join(|| detector.detect(&grey[0]), || detector.detect(&grey[1]));
        let failed = |message| SlamError::Features {
            frame: frame.name.clone(),
            message,
        };
        let features = [left.map_err(failed)?, right.map_err(failed)?];
        let grid = Grid::new(&features[0].keypoints, rig.width, rig.height);
        let mut seen = Self {
            grey,
            features,
            disparities: Vec::new(),
            matches: MatchCounts::default(),
            grid,
        };
        seen.match_stereo(rig, None, config);
        Ok(seen)
    }

    /// Matches left to right anew, with dense disparity as a witness (Hong 2021, 3.2.3).
    pub fn match_stereo(
        &mut self,
        rig: &RectifiedRig,
        gate: Option<&DisparityGate>,
        config: &SlamConfig,
    ) {
        let ([left, right], [left_grey, right_grey]) = (&self.features, &self.grey);
        (self.disparities, self.matches) =
            stereo_matches(left, right, [left_grey, right_grey], rig, gate, config);
    }

    /// How many features have a disparity.
    pub fn stereo_count(&self) -> usize {
        self.disparities.iter().flatten().count()
    }

    /// How many of these a map would take.
    pub fn mappable_count(&self, rig: &RectifiedRig, config: &SlamConfig) -> usize {
        let known = self.disparities.iter().flatten();
        known.filter(|d| config.is_mapped(rig, **d)).count()
    }

    /// What people want to know of a frame that cannot be placed.
    pub fn describe(&self) -> String {
        let pixels = self.grey[0].as_raw();
        let share = |test: fn(f32) -> bool| {
            100 * pixels.iter().filter(|v| test(**v)).count() / pixels.len().max(1)
        };
        format!(
            "{} features, {} with a stereo match; {} % of the image is saturated, {} % black",
            self.features[0].keypoints.len(),
            self.stereo_count(),
            share(|v| v > 0.98),
            share(|v| v < 0.02),
        )
    }
}
