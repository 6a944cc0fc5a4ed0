//! Training without ground truth (and with it, for pretraining on renders).
//!
//! What it is for: [`Loss`] is eq. 1-5 of Hong 2021 term by term, with options of later work (see
//! [`mod@loss`]), [`Trainer`] runs them over
//! stereo sources, [`RunDir`] is what a run leaves on disk.
//!
//! What it promises: the same configuration, data and machine give the same weights; a run that
//! was stopped goes on from its last checkpoint as if it had not been; a checkpoint is there whole
//! or not at all; a loss that is no number stops the run and names the frames.
//!
//! What it never does: print, parse arguments, or know a file format of images.

mod augment;
mod batch;
mod error;
pub mod loss;
mod pool;
mod run_dir;
mod trainer;

pub use augment::Augmentation;
pub use batch::Batch;
pub use error::TrainError;
pub use loss::{Loss, LossTerms};
pub use run_dir::{LogLine, RunDir};
pub use trainer::{DeviceName, Schedule, TrainConfig, Trainer, Validation};
