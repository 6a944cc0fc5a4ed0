//! Training without ground truth (and with it, for pretraining on renders).
//!
//! What it is for: [`Loss`] is eq. 1-5 of Hong 2021 term by term, with options of later work (see
//! [`mod@loss`]); [`Trainer`] runs them over stereo sources as a [`TrainConfig`] says, an [`Observer`]
//! watches and may stop it, [`RunDir`] is what a run leaves on disk; [`Adapter`] learns from a stream as
//! it comes.
//!
//! What it promises: the same configuration, data and machine give the same weights; a run that
//! was stopped or killed goes on from its last checkpoint as if it had not been; a checkpoint is
//! there whole or not at all; a loss, gradient or weight that is no number stops the run and names
//! the frames.
//!
//! What it never does: print, parse arguments, or know a file format of images.

mod adapt;
mod augment;
mod averaging;
mod batch;
mod config;
mod descent;
mod device;
mod error;
mod gradients;
pub mod loss;
mod pool;
mod run_dir;
mod schedule;
mod spread;
mod trainer;
mod validation;

pub use adapt::{AdaptConfig, Adapter, Judgement, Verdict, explain};
pub use augment::Augmentation;
pub use batch::Batch;
pub use config::TrainConfig;
pub use device::DeviceName;
pub use error::TrainError;
pub use loss::{Loss, LossTerms};
pub use run_dir::{LogLine, RunDir};
pub use schedule::Schedule;
pub use trainer::{Ended, Observer, Trainer};
pub use validation::{Accuracy, Explained, Scored, Validation};
