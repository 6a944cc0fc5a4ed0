use crate::{RectifiedRig, Rig};

/// The maps that turn the images of an unrectified [`Rig`] into a rectified pair.
#[derive(Clone, Debug)]
pub struct Rectification {
    /// The rig that the rectified images obey.
    pub rig: RectifiedRig,
    /// For each pixel of the rectified left image, row by row, where it lies in the original.
    pub left_map: Vec<[f32; 2]>,
    /// The same for the right image.
    pub right_map: Vec<[f32; 2]>,
}

impl Rectification {
    /// See the struct.
    pub fn new(_rig: &Rig) -> Self {
        unimplemented!("helper A writes this")
    }
}
