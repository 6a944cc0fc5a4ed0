//! Scores: how far an estimate lies from the truth, by the definitions the field uses.
//!
//! What it is for: [`trajectory`] (absolute and relative pose error, KITTI segment errors) and
//! [`disparity`] (end-point error, bad pixels, density).
//!
//! What it promises: scores serialise to the JSON keys of the command line; a score is made of at
//! least one comparison, so no figure is a division by zero; input that cannot be compared gives an
//! [`EvalError`] that says why and what to do.
//!
//! What it never does: read a file, run an engine, or repair an estimate before judging it.

pub mod disparity;
mod error;
pub mod trajectory;

pub use disparity::{DisparityFigures, DisparityScore, DisparityTally};
pub use error::EvalError;
pub use trajectory::{SegmentScore, Similarity, TrajectoryScore};
