//! Tracks: the places of one thing in many images, and who follows them.

use barchan_datasets::Plane;
use nalgebra::Vector2;

use crate::Keypoint;

/// Names a track for good; a new track takes the next number.
pub type TrackId = usize;

/// Where an image sees the thing of a track.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// Of which track.
    pub track: TrackId,
    /// Where.
    pub at: Keypoint,
}

/// Pixels at each side of an image where nothing is looked for: the region of interest of de Jong 2020,
/// section 6.1, is what is left.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Border {
    /// Columns.
    pub left: u32,
    /// Columns.
    pub right: u32,
    /// Rows.
    pub top: u32,
    /// Rows.
    pub bottom: u32,
}

impl Border {
    /// The region of interest of an image, and where its first pixel is; `None` when nothing is left.
    pub fn crop(&self, image: &Plane) -> Option<(Plane, [f64; 2])> {
        let rest = |size: u32, a: u32, b: u32| size.checked_sub(a)?.checked_sub(b);
        let width = rest(image.width(), self.left, self.right).filter(|w| *w > 0)?;
        let height = rest(image.height(), self.top, self.bottom).filter(|h| *h > 0)?;
        let view = image::imageops::crop_imm(image, self.left, self.top, width, height);
        Some((view.to_image(), [f64::from(self.left), f64::from(self.top)]))
    }

    /// Whether a place is in the region of interest of an image.
    pub fn contains(&self, image: &Plane, [u, v]: [f64; 2]) -> bool {
        u >= f64::from(self.left)
            && v >= f64::from(self.top)
            && u + f64::from(self.right) < f64::from(image.width())
            && v + f64::from(self.bottom) < f64::from(image.height())
    }
}

/// Follows tracks from image to image.
pub(super) trait Follow: Send {
    /// Where the tracks are in another image.
    ///
    /// # Errors
    /// What the detector says of an image that it cannot take.
    fn follow(&mut self, grey: &Plane) -> Result<Vec<Sighting>, String>;

    /// More sightings in the image last followed, of tracks that are expected at some places (pixels) and were
    /// not found: what is within `radius` and looks like them. Flow, which starts from places, finds no more.
    fn find(&mut self, _expected: &[(TrackId, Vector2<f64>)], _radius: f64) -> Vec<Sighting> {
        Vec::new()
    }

    /// The image that was last followed is taken: `kept` of its sightings are true. What is followed next is
    /// followed from there on.
    fn accept(&mut self, kept: &[Sighting]);

    /// As [`Follow::accept`], and new tracks begin where the image shows things that none is of: all
    /// sightings of the image, of new tracks too. With nothing kept, nothing from before is followed any more.
    ///
    /// # Errors
    /// As [`Follow::follow`].
    fn begin(&mut self, kept: &[Sighting]) -> Result<Vec<Sighting>, String>;
}
