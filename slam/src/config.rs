use barchan_geometry::RectifiedRig;
use serde::{Deserialize, Serialize};

use crate::features::{Akaze, FeatureDetector, Orb};
use crate::fusion::FusionConfig;
use crate::loops::LoopConfig;

/// Which features SLAM follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Detector {
    /// [`Orb`]: the fast choice.
    Orb,
    /// [`Akaze`]: what Hong 2021 uses.
    Akaze,
}

impl Detector {
    /// Bytes of a descriptor that it fills.
    pub fn descriptor_bytes(self) -> usize {
        match self {
            Self::Orb => Orb::BYTES,
            Self::Akaze => Akaze::BYTES,
        }
    }
}

/// Everything that decides how SLAM runs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SlamConfig {
    /// The detector.
    pub detector: Detector,
    /// Key points asked for in each image. The quadtree that spreads ORB's gives up to half as many more.
    pub features: usize,
    /// Smallest brightness step of a corner of ORB, of 255.
    pub corner_threshold: f32,
    /// Least response of AKAZE, see [`Akaze::threshold`].
    pub akaze_threshold: f32,
    /// Nearest-neighbour distance ratio below which a stereo match is accepted on looks alone.
    pub nndr: f64,
    /// Most differing bits of two ORB descriptors that match, as a share of all.
    pub max_hamming_share: f64,
    /// The same of AKAZE, whose bits come again more surely.
    pub akaze_max_hamming_share: f64,
    /// Largest row difference of a stereo match, pixels, at the finest scale.
    pub row_tolerance: f64,
    /// Smallest disparity of a point that is mapped, pixels; smaller ones say too little of depth.
    pub min_disparity: f64,
    /// Standard deviation of a disparity in the optimisations, pixels. A match is better than that;
    /// but a shift of all disparities, which calibration leaves, is no noise that averages out, and
    /// motion is better taken from where points go than from how their disparity changes.
    pub disparity_sigma: f64,
    /// Standard deviation of the disparity of a match, pixels, from which follows how well the poses
    /// are known; two successive key frames see a point with about the same error.
    pub match_sigma: f64,
    /// Standard deviation of a sighting found by alignment with the point's first picture, in pixels
    /// of its scale.
    pub alignment_sigma: f64,
    /// Whether dense disparity at key frames accepts and refuses matches (Hong 2021, 3.2.3).
    pub gate: bool,
    /// Largest difference between feature disparity and dense disparity, pixels (Hong 2021, 4.2.2).
    pub gate_px: f64,
    /// Largest accepted dissimilarity of dense disparity, see `barchan_infer::Rejection`.
    pub max_dissimilarity: f32,
    /// A key frame is made when matches fall under this share of the most since the last one.
    pub keyframe_ratio: f64,
    /// It is made, too, when so small a share of what a frame could map is in the map: most of what it
    /// sees is new, as behind the crest of a hill, and the map must have it before the old is out of sight.
    pub keyframe_share: f64,
    /// Frames that may be tracked in the map as it was while a key frame comes into it; 0 waits for it, and for its dense
    /// disparity.
    pub map_lag: usize,
    /// Key frames that bundle adjustment moves.
    pub window: usize,
    /// Whether bundle adjustment moves the whole map at the end.
    pub adjust_all: bool,
    /// Most iterations of a bundle adjustment.
    pub ba_iterations: usize,
    /// Fewest map points that must agree with the pose of a frame that counts as tracked.
    pub min_inliers: usize,
    /// Least share of the matches that must agree with the pose.
    pub min_match_share: f64,
    /// Least share of the map points in view that must agree with the pose.
    pub min_view_share: f64,
    /// Frames lost in a row after which the map is begun anew at the predicted pose.
    pub restart_after: usize,
    /// Seeds the sampling of the fall-back.
    pub seed: u64,
    /// Places seen before.
    pub loops: LoopConfig,
    /// What sensors besides the cameras are worth.
    pub fusion: FusionConfig,
}

impl Default for SlamConfig {
    fn default() -> Self {
        Self {
            detector: Detector::Orb,
            features: 900,
            corner_threshold: 5.0,
            akaze_threshold: 1e-5,
            nndr: 0.75,
            max_hamming_share: 0.25,
            akaze_max_hamming_share: 0.16,
            row_tolerance: 1.5,
            min_disparity: 0.7,
            disparity_sigma: 2.0,
            match_sigma: 0.5,
            alignment_sigma: 0.5,
            gate: true,
            gate_px: 3.0,
            max_dissimilarity: 0.4,
            keyframe_ratio: 0.9,
            keyframe_share: 0.35,
            map_lag: 2,
            window: 8,
            adjust_all: true,
            ba_iterations: 8,
            min_inliers: 15,
            min_match_share: 0.6,
            min_view_share: 0.08,
            restart_after: 5,
            seed: 1,
            loops: LoopConfig::default(),
            fusion: FusionConfig::default(),
        }
    }
}

impl SlamConfig {
    /// The detector with its settings.
    pub fn feature_detector(&self) -> Box<dyn FeatureDetector> {
        match self.detector {
            Detector::Orb => Box::new(Orb::new(self.features, self.corner_threshold)),
            Detector::Akaze => Box::new(Akaze {
                threshold: self.akaze_threshold,
                most: self.features,
            }),
        }
    }

    /// Whether a point of such a disparity says enough of depth to be mapped.
    pub(crate) fn is_mapped(&self, rig: &RectifiedRig, d: f64) -> bool {
        d + rig.doffs >= self.min_disparity
    }

    /// Most differing bits of two descriptors of `bits` bits that match.
    pub(crate) fn max_hamming(&self, bits: u32) -> u32 {
        let share = match self.detector {
            Detector::Orb => self.max_hamming_share,
            Detector::Akaze => self.akaze_max_hamming_share,
        };
        (share * f64::from(bits)) as u32
    }
}
