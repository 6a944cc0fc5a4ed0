//! Cameras, stereo rigs and the motion of both.
//!
//! What it is for: everything that is pure geometry and that every other crate agrees on: a
//! [`Camera`] with its distortion, a [`Rig`] of two of them read from `rig.toml`, the
//! [`Rectification`] that turns it into a [`RectifiedRig`], back-projection with covariance,
//! SE(3) and [`Trajectory`] files, points searched by a [`KdTree`] and clouds brought together by
//! [`registration`].
//!
//! What it promises: metres, radians, pixels; pixel centres at integers; camera frame x right,
//! y down, z forward; a pose is named `T_world_cam` and maps camera points to the world.
//!
//! What it never does: touch an image, a tensor or a disparity map.

mod camera;
mod error;
mod kd_tree;
mod outliers;
mod rectify;
pub mod registration;
mod rig;
pub mod se3;
mod trajectory;

pub use camera::{Camera, Distortion};
pub use error::GeometryError;
pub use kd_tree::KdTree;
pub use outliers::outliers;
pub use rectify::Rectification;
pub use rig::{RectifiedRig, Rig, StereoPoint};
pub use se3::Se3;
pub use trajectory::{StampedPose, Trajectory};

pub use nalgebra;
