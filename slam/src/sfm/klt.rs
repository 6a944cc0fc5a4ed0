//! Tracks by optical flow: corners followed by Kanade, Lucas and Tomasi's method in a pyramid (Bouguet 2000).

use barchan_datasets::Plane;
use kornia_image::{Image, ImageSize};
use kornia_imgproc::optical_flow_pyr_lk::{PyrLKParams, PyrLKResult, calc_optical_flow_pyr_lk};

use super::follow::{Border, Follow, Sighting, TrackId};
use crate::Keypoint;
use crate::features::{FeatureDetector, Orb};

/// Follows corners from image to image: what de Jong 2020 names as future work (section 11.2).
///
/// A track ends where flow there and back again does not end where it began.
pub(super) struct KltTracks {
    corners: Orb,
    /// Most tracks in an image.
    most: usize,
    border: Border,
    /// Standard deviation of a place, pixels.
    sigma: f64,
    next: TrackId,
    /// The image last accepted, and where its tracks are.
    last: Option<(Image<f32, 1>, Vec<Sighting>)>,
    /// The image last followed, twice: for the flow, and for the corners.
    current: Option<(Image<f32, 1>, Plane)>,
}

impl KltTracks {
    pub fn new(most: usize, corner_threshold: f32, border: Border, sigma: f64) -> Self {
        Self {
            corners: Orb::new(most, corner_threshold),
            most,
            border,
            sigma,
            next: 0,
            last: None,
            current: None,
        }
    }
}

impl Follow for KltTracks {
    fn follow(&mut self, grey: &Plane) -> Result<Vec<Sighting>, String> {
        /// Most pixels between where a track began and where flow back leads.
        const ROUND_TRIP: f32 = 0.5;
        let size = ImageSize {
            width: grey.width() as usize,
            height: grey.height() as usize,
        };
        let image = Image::new(size, grey.as_raw().clone()).map_err(|e| e.to_string())?;
        let mut sightings = Vec::new();
        if let Some((last, tracks)) = &self.last {
            let from: Vec<[f32; 2]> = (tracks.iter())
                .map(|s| [s.at.u as f32, s.at.v as f32])
                .collect();
            let there = flow(last, &image, &from)?;
            let back = flow(&image, last, &there.next_pts)?;
            for (k, track) in tracks.iter().enumerate() {
                let [du, dv] = [0, 1].map(|axis| back.next_pts[k][axis] - from[k][axis]);
                let [u, v] = there.next_pts[k].map(f64::from);
                if there.status[k] == 1
                    && back.status[k] == 1
                    && du.hypot(dv) < ROUND_TRIP
                    && self.border.contains(grey, [u, v])
                {
                    let at = Keypoint { u, v, ..track.at };
                    sightings.push(Sighting { at, ..*track });
                }
            }
        }
        self.current = Some((image, grey.clone()));
        Ok(sightings)
    }

    fn accept(&mut self, kept: &[Sighting]) {
        if let Some((image, _)) = self.current.take() {
            self.last = Some((image, kept.to_vec()));
        }
    }

    fn begin(&mut self, kept: &[Sighting]) -> Result<Vec<Sighting>, String> {
        /// Least distance of a new track to the others, pixels.
        const APART: f64 = 6.0;
        let Some((image, grey)) = self.current.take() else {
            return Ok(Vec::new());
        };
        let mut sightings = kept.to_vec();
        if let Some((region, [left, top])) = self.border.crop(&grey) {
            for corner in self.corners.detect(&region)?.keypoints {
                let (u, v) = (corner.u + left, corner.v + top);
                let free = |s: &Sighting| (s.at.u - u).abs() > APART || (s.at.v - v).abs() > APART;
                if sightings.len() < self.most && sightings.iter().all(free) {
                    let at = Keypoint {
                        u,
                        v,
                        scale: 1.0,
                        sigma: self.sigma,
                    };
                    sightings.push(Sighting {
                        track: self.next,
                        at,
                    });
                    self.next += 1;
                }
            }
        }
        self.last = Some((image, sightings.clone()));
        Ok(sightings)
    }
}

fn flow(
    from: &Image<f32, 1>,
    to: &Image<f32, 1>,
    places: &[[f32; 2]],
) -> Result<PyrLKResult, String> {
    let params = PyrLKParams {
        // Sand in the dark: a grey level in a pixel is enough.
        min_eigen_threshold: 1e-6,
        ..PyrLKParams::default()
    };
    calc_optical_flow_pyr_lk(from, to, places, None, &params).map_err(|e| e.to_string())
}
