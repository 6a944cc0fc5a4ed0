//! Stereo sequences from disk or rendered: one file per format.
//!
//! What it is for: a [`StereoSource`] yields rectified [`StereoFrame`]s and, when it has it, truth.
//! [`open`] finds the format; [`prefetch`] reads ahead on threads; [`rows`] measures whether the
//! rows of a pair correspond at all; [`disparity_file`] reads and writes disparity images;
//! [`write_folder`] writes any source as images on disk.
//!
//! What it promises: frames are lazy (memory does not grow with the length of a sequence), images
//! are `f32` in 0..=1, and an error names the file and the cure.
//!
//! What it never does: match features, run a network or judge a result.

pub mod disparity_file;
mod error;
mod folder;
mod image_file;
mod open;
mod prefetch;
mod resample;
pub mod rows;
mod sensors;
mod source;
pub mod synth;
mod write_folder;

pub use error::DataError;
pub use folder::{Folder, read_planar};
pub use image_file::read_rgb;
pub use open::{FORMATS, open};
pub use prefetch::{Prefetch, prefetch};
pub use sensors::{GnssFix, ImuSample, OdometrySample, Sensors};
pub use source::{Plane, Rgb, StereoFrame, StereoSource, luma, planar};
pub use synth::{RandomScenes, Synth};
pub use write_folder::{write_folder, write_synth};
