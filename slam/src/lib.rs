//! Stereo SLAM in the manner of S-PTAM (Pire 2017), helped by dense disparity (Hong 2021, 3.2.3); and what it is
//! compared with, [`IcpOdometry`] and [`Combined`] (de Jong 2020, chapters 5 and 7).
//!
//! What it is for: [`Slam::track`] takes rectified pairs one by one and says where the left camera
//! was; at key frames it asks a [`DisparityEngine`](barchan_infer::DisparityEngine) for dense
//! disparity, uses it to accept more feature matches, and hands it out for mapping.
//! [`sfm`] follows the left camera alone, as de Jong 2020 does.
//!
//! What it promises: the world is the first left camera (x right, y down, z forward); the same
//! images give the same result, bit by bit; a frame that cannot be placed is reported as lost with a
//! reason, and the next one is tried again; memory grows with the map, not with the images.
//!
//! What it never does: read files, name a network library, or make terrain.

mod block_cholesky;
mod bundle_adjustment;
mod combined;
mod config;
mod features;
mod frame;
mod fusion;
mod icp_odometry;
mod lanes;
mod local_map;
mod loops;
mod map;
mod map_file;
mod mapping;
mod matching;
mod patch;
mod places;
mod pose;
mod pose_graph;
mod rules;
pub mod sfm;
mod slam;
mod stereo_cloud;
mod tracker;
mod uncertainty;
mod vocabulary;

pub use bundle_adjustment::{BundleAdjustment, Summary as BundleSummary};
pub use combined::{
    Combined, CombinedConfig, CombinedReport, CombinedResult, Scale, ScaleForm, UpToScale,
    baseline_factor,
};
pub use config::{Detector, SlamConfig};
pub use features::{Akaze, Descriptor, FeatureDetector, Features, Keypoint, Orb};
pub use fusion::{
    DeadReckoning, Fusion, FusionConfig, FusionCounts, Motion, ReckoningForm, VibrationGyro,
};
pub use icp_odometry::{IcpOdometry, IcpOdometryConfig, IcpReport, IcpResult};
pub use loops::{LoopConfig, LoopEvent, LoopPoints};
pub use map::{Keyframe, Map, MapPoint, PointId};
pub use map_file::MapFileError;
pub use mapping::Mapped;
pub use matching::{DisparityGate, MatchCounts, hamming};
pub use patch::Patch;
pub use pose::{Observation, PoseEstimate, optimise_pose, reprojection_jacobian};
pub use pose_graph::{PoseEdge, PoseGraph};
pub use rules::{MatchRules, RuledMatch};
pub use slam::{FrameReport, Slam, SlamResult};
pub use stereo_cloud::{Mount, StereoCloud, StereoCloudConfig, StereoClouds};
pub use vocabulary::{BagOfWords, Vocabulary, VocabularyError};

/// Why SLAM cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum SlamError {
    /// Features could not be found in an image.
    #[error("frame {frame}: {message}")]
    Features {
        /// The frame.
        frame: String,
        /// What the detector said.
        message: String,
    },
    /// The disparity engine failed at a key frame.
    #[error("frame {frame}: {source}")]
    Disparity {
        /// The frame.
        frame: String,
        /// What the engine said.
        source: barchan_infer::InferError,
    },
    /// No cloud could be made of a frame.
    #[error("frame {frame}: {source}")]
    Cloud {
        /// The frame.
        frame: String,
        /// What is wrong with it.
        source: barchan_terrain::TerrainError,
    },
    /// A setting makes no sense.
    #[error(transparent)]
    Setting(#[from] barchan_terrain::TerrainError),
    /// Nothing says what the scale of poses is, or what should is not there.
    #[error("no scale: {0}")]
    Scale(String),
    /// A frame has not the size of the rig.
    #[error(
        "frame {frame}: {width} x {height} pixels, but the rig says {rig_width} x {rig_height}"
    )]
    Size {
        /// The frame.
        frame: String,
        /// Its width.
        width: u32,
        /// Its height.
        height: u32,
        /// Width of the rig.
        rig_width: usize,
        /// Height of the rig.
        rig_height: usize,
    },
}
