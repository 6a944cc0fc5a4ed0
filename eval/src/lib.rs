//! Scores: how far an estimate lies from the truth, by the definitions the field uses.
//!
//! What it is for: [`trajectory`] (absolute and relative pose error, KITTI segment errors),
//! [`mod@time_shift`] (clocks that differ),
//! [`disparity`] (end-point error, bad pixels, density), [`mod@matches`] (how many each rule accepts,
//! how many are true), [`elevation`] (differences of heights, whether stated bounds hold) and
//! [`cloud`] (distances of points).
//!
//! What it promises: scores serialise to the JSON keys of the command line; a score is made of at
//! least one comparison, so no figure is a division by zero; input that cannot be compared gives an
//! [`EvalError`] that says why and what to do.
//!
//! What it never does: read a file, run an engine, or repair an estimate before judging it.

pub mod cloud;
pub mod disparity;
pub mod elevation;
mod error;
pub mod matches;
pub mod time_shift;
pub mod trajectory;

pub use disparity::{DisparityFigures, DisparityScore, DisparityTally};
pub use elevation::{BoundsScore, ComparedCell, ElevationScore};
pub use error::EvalError;
pub use matches::{MatchFigures, MatchScore, MatchTally};
pub use trajectory::{SegmentScore, Similarity, TrajectoryScore};
