//! A run as something that a viewer plays: told piece by piece, each at its time.

mod foxglove;
mod mcap;
mod messages;
#[cfg(feature = "rerun")]
mod rerun;

use barchan_geometry::{RectifiedRig, Se3};
use barchan_terrain::CloudPoint;
use image::RgbImage;

#[cfg(feature = "rerun")]
pub use self::rerun::RerunRecording;
use crate::{Relief, ReportError};
pub use foxglove::FoxgloveRecording;

/// What a run is told to. Times are seconds; frames are named, and each hangs in one other by its transforms.
pub trait Recording {
    /// Where a frame is in its parent from this time on: `T_parent_child` maps points of the child to the parent.
    ///
    /// # Errors
    /// When it cannot be written, as all others.
    #[allow(non_snake_case)]
    fn transform(
        &mut self,
        time: f64,
        parent: &str,
        child: &str,
        T_parent_child: &Se3,
    ) -> Result<(), ReportError>;

    /// A way: poses in a frame, all of them known at this time.
    ///
    /// # Errors
    /// As above.
    fn route(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        poses: &[Se3],
    ) -> Result<(), ReportError>;

    /// How the camera of a frame (x right, y down, z forward) makes images: the left one of a rig.
    ///
    /// # Errors
    /// As above.
    fn camera(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        rig: &RectifiedRig,
    ) -> Result<(), ReportError>;

    /// A picture that the camera of a frame took, or that was made of it.
    ///
    /// # Errors
    /// As above.
    fn image(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        picture: &RgbImage,
    ) -> Result<(), ReportError>;

    /// Coloured points in a frame. Points that are not finite are left out.
    ///
    /// # Errors
    /// As above.
    fn cloud(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        points: &[CloudPoint],
    ) -> Result<(), ReportError>;

    /// Heights in a frame whose z is up; at most [`crate::MAX_CELLS`] of them.
    ///
    /// # Errors
    /// As above.
    fn relief(
        &mut self,
        time: f64,
        topic: &str,
        frame: &str,
        relief: &Relief,
    ) -> Result<(), ReportError>;

    /// Writes what is left.
    ///
    /// # Errors
    /// As above.
    fn finish(self: Box<Self>) -> Result<(), ReportError>;
}

#[cfg(test)]
mod tests;
