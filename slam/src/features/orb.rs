use barchan_datasets::Plane;
use kornia_image::{Image, ImageSize};
use kornia_imgproc::features::OrbDetector;

use super::{Descriptor, FeatureDetector, Features, Keypoint};

/// Scale between two levels of the pyramid.
const OCTAVE_SCALE: f64 = 1.2;

/// Size of a pixel of a pyramid level, in pixels of the image.
fn octave_scale(octave: u8) -> f64 {
    OCTAVE_SCALE.powi(i32::from(octave))
}

/// Oriented FAST and rotated BRIEF (Rublee 2011), spread over the image by a quadtree.
pub struct Orb {
    detector: OrbDetector,
}

impl Orb {
    /// Bytes of a descriptor that say something.
    pub const BYTES: usize = 32;

    /// Looks for about `features` corners with a brightness step of at least `threshold` of 255.
    pub fn new(features: usize, threshold: f32) -> Self {
        let detector = OrbDetector {
            n_keypoints: features,
            ini_fast_threshold: threshold / 255.0,
            min_fast_threshold: 0.5 * threshold / 255.0,
            downscale: OCTAVE_SCALE as f32,
            ..OrbDetector::default()
        };
        Self { detector }
    }
}

impl FeatureDetector for Orb {
    fn detect(&self, grey: &Plane) -> Result<Features, String> {
        let bytes = grey
            .iter()
            .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8)
            .collect();
        let size = ImageSize {
            width: grey.width() as usize,
            height: grey.height() as usize,
        };
        let image = Image::<u8, 1>::new(size, bytes).map_err(|e| e.to_string())?;
        let found = self
            .detector
            .detect_and_extract_u8(&image)
            .map_err(|e| e.to_string())?;
        let keypoints = found
            .keypoints_xy
            .iter()
            .zip(&found.octaves)
            .map(|(xy, octave)| {
                let [u, v] = full_resolution(*xy, *octave, [grey.width(), grey.height()]);
                let scale = octave_scale(*octave);
                // A corner is found to a pixel of its level.
                Keypoint {
                    u,
                    v,
                    scale,
                    sigma: scale,
                }
            })
            .collect();
        Ok(Features {
            keypoints,
            descriptors: found.descriptors.iter().map(padded).collect(),
            bits: 256,
        })
    }
}

fn padded(bits: &[u8; 32]) -> Descriptor {
    let mut descriptor = [0; 64];
    descriptor[..32].copy_from_slice(bits);
    descriptor
}

/// Where a corner of a pyramid level lies in the image. The detector multiplies by the nominal
/// scale, but levels have whole numbers of pixels and pixel centres are at integers: taken as it
/// comes, a corner found at two levels would lie more than a pixel apart.
fn full_resolution(nominal: [f32; 2], octave: u8, size: [u32; 2]) -> [f64; 2] {
    let scale = octave_scale(octave);
    std::array::from_fn(|k| {
        let full = f64::from(size[k]);
        let level = (full / scale).round_ties_even();
        let at = (f64::from(nominal[k]) / scale).round();
        (at + 0.5) * full / level - 0.5
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The corner of a dark square is found at many levels: all must say the same place.
    #[test]
    fn levels_of_the_pyramid_agree_on_where_a_corner_is() {
        let (x, y) = (130, 90);
        let image = Plane::from_fn(300, 200, |u, v| {
            image::Luma([if u >= x && v >= y { 0.1 } else { 0.8 }])
        });
        let features = Orb::new(300, 20.0).detect(&image).unwrap();
        let mut levels = std::collections::BTreeSet::new();
        for k in &features.keypoints {
            let (du, dv) = (k.u - (f64::from(x) - 0.5), k.v - (f64::from(y) - 0.5));
            if du.hypot(dv) < 12.0 {
                assert!(du.hypot(dv) < 2.0 * k.sigma, "scale {}: {du} {dv}", k.scale);
                levels.insert(k.scale.to_bits());
            }
        }
        assert!(levels.len() >= 5, "{levels:?}");
    }

    #[test]
    fn an_image_smaller_than_a_descriptor_has_no_features() {
        for (width, height) in [(1, 1), (16, 16), (39, 200), (60, 40)] {
            let image = Plane::from_fn(width, height, |u, v| {
                image::Luma([((u * v) % 7) as f32 / 7.0])
            });
            let found = Orb::new(100, 5.0).detect(&image);
            assert!(
                found.is_ok_and(|f| f.keypoints.len() == f.descriptors.len()),
                "{width} x {height}"
            );
        }
    }
}
