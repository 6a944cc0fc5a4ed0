use serde::{Deserialize, Serialize};

use super::follow::{Border, Follow};
use super::klt::KltTracks;
use super::sift::SiftTracks;

/// How things are followed from image to image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TrackKind {
    /// Key points and descriptors; SIFT stands in for the SURF of de Jong 2020.
    Sift,
    /// Optical flow: more tracks that last longer, lost when the camera jumps.
    Klt,
}

/// Everything that decides how structure from motion runs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SfmConfig {
    /// How things are followed.
    pub tracks: TrackKind,
    /// Most key points, or tracks, of an image.
    pub features: usize,
    /// Least contrast of a SIFT key point, of full scale.
    pub contrast: f64,
    /// Smallest brightness step of a corner where a KLT track begins, of 255.
    pub corner_threshold: f32,
    /// Nearest-neighbour distance ratio below which a SIFT match is accepted.
    pub nndr: f64,
    /// What of the image is not looked at.
    pub border: Border,
    /// Standard deviation of where a thing is seen, pixels at the finest scale.
    pub sigma: f64,
    /// Largest distance of a match to its epipolar lines, pixels.
    pub epipolar_px: f64,
    /// Fewest matches of a pair of images.
    pub min_matches: usize,
    /// Least share of the matches that agree with one motion; with fewer the image is discarded.
    pub min_inlier_share: f64,
    /// An image becomes a view when things moved by so much of its width, rotation aside.
    pub view_shift: f64,
    /// It becomes one as well when fewer than this share of the newest view's points are seen.
    pub view_share: f64,
    /// Least angle under which two views see a point that is placed, degrees.
    pub min_angle: f64,
    /// Fewest points to begin with, and to place an image by.
    pub min_points: usize,
    /// Views that windowed bundle adjustment moves.
    pub window: usize,
    /// Most iterations of a windowed bundle adjustment.
    pub window_iterations: usize,
    /// Most iterations of the last one, over all views; 0 leaves it out.
    pub global_iterations: usize,
    /// Discarded images in a row after which all begins anew.
    pub restart_after: usize,
    /// Least disparity of a point that metric scale is taken from, pixels.
    pub min_disparity: f64,
    /// Seeds the sampling.
    pub seed: u64,
}

impl Default for SfmConfig {
    fn default() -> Self {
        Self {
            tracks: TrackKind::Sift,
            features: 1000,
            contrast: 0.004,
            corner_threshold: 5.0,
            nndr: 0.8,
            border: Border::default(),
            sigma: 1.2,
            epipolar_px: 1.5,
            min_matches: 30,
            min_inlier_share: 0.5,
            view_shift: 0.03,
            view_share: 0.8,
            min_angle: 1.0,
            min_points: 20,
            window: 10,
            window_iterations: 8,
            global_iterations: 30,
            restart_after: 5,
            min_disparity: 3.0,
            seed: 1,
        }
    }
}

impl SfmConfig {
    /// What follows things, with its settings.
    pub(super) fn follower(&self) -> Box<dyn Follow> {
        match self.tracks {
            TrackKind::Sift => Box::new(SiftTracks::new(
                self.features,
                self.contrast,
                self.nndr,
                self.border,
                self.sigma,
            )),
            TrackKind::Klt => Box::new(KltTracks::new(
                self.features,
                self.corner_threshold,
                self.border,
                self.sigma,
            )),
        }
    }
}
