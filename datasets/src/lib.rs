//! Stereo sequences from disk or rendered: one file per format.
//!
//! What it is for: a [`StereoSource`] yields rectified [`StereoFrame`]s and, when it has it, truth.
//! [`open`] finds the format; [`load_rig`] reads the calibration of other
//! tools; [`check`](mod@check) says whether the pairs are fit for stereo, and a [`Correction`] mends
//! them; [`prefetch`] reads ahead on threads; [`disparity_file`] reads and writes disparity images;
//! [`write_folder`] writes any source as images on disk.
//!
//! What it promises: frames are lazy (memory does not grow with the length of a sequence), images
//! are `f32` in 0..=1, and an error names the file and the cure.
//!
//! What it never does: run a network, or judge what one returns.

mod calibration;
pub mod check;
mod correction;
pub mod disparity_file;
mod error;
mod formats;
mod image_file;
mod listing;
mod open;
mod pairs;
mod prefetch;
mod resample;
mod sensor_files;
mod sensors;
mod source;
pub mod synth;
mod text;
mod write_folder;
mod write_katwijk;

/// Files of the Katwijk archive that belong to no frame.
pub mod katwijk {
    pub use crate::formats::katwijk::{PanTilt, RangeScan, RangeSensor, read_ptu, read_rocks};
}

pub use calibration::load_rig;
pub use correction::{Corrected, Correction};
pub use error::DataError;
pub use formats::folder::Folder;
pub use image_file::{parse_rgb, parse_size, read_rgb, write_whole};
pub use open::{dataset_folder, open, open_as_stored};
pub use pairs::PairSource;
pub use prefetch::{Prefetch, prefetch, prefetch_with};
pub use sensors::{GnssFix, ImuSample, OdometrySample, Sensors};
pub use source::{Plane, Rgb, StereoFrame, StereoSource, luma, planar};
pub use synth::Synth;
pub use text::read_planar;
pub use write_folder::{write_folder, write_synth};
pub use write_katwijk::write_katwijk;
