//! Accelerated KAZE (Alcantarilla, Nuevo and Bartoli 2013): peaks of the Hessian's determinant in a
//! non-linear scale space, described by 486 comparisons.

mod descriptor;
mod extrema;
mod filters;
mod scale_space;

use std::collections::BTreeMap;

use barchan_datasets::Plane;
use rayon::prelude::*;

use self::extrema::{Peak, find_peaks};
use self::scale_space::{FIRST_SIGMA, Level, scale_space};
use super::{FeatureDetector, Features, Keypoint};

/// The detector with the settings of its authors: four octaves of four levels.
#[derive(Clone, Copy, Debug)]
pub struct Akaze {
    /// Least response of a feature: the determinant of the Hessian of an image in 0..=1, normalised
    /// for scale. 1e-3 finds few, 1e-5 many.
    pub threshold: f32,
    /// Most features; the strongest ones of every part of the image are kept.
    pub most: usize,
}

impl Akaze {
    /// Bytes of a descriptor that are in use: 486 bits.
    pub const BYTES: usize = 61;
}

impl FeatureDetector for Akaze {
    fn detect(&self, grey: &Plane) -> Result<Features, String> {
        // The finest descriptor is 60 pixels wide.
        const LEAST: u32 = 60;
        if grey.width().min(grey.height()) < LEAST {
            return Ok(Features::default());
        }
        let levels = scale_space(grey);
        let peaks = find_peaks(&levels, self.threshold, descriptor::REACH);
        let mut peaks = spread(peaks, &levels, self.most);
        // Neighbours in the image are neighbours in memory.
        peaks.sort_by_key(|p| (p.level, p.at.y as u32, p.at.x as u32));
        Ok(Features {
            keypoints: peaks
                .iter()
                .map(|p| keypoint(&levels[p.level], p))
                .collect(),
            descriptors: peaks
                .par_iter()
                .with_min_len(32)
                .map(|p| descriptor::describe(&levels[p.level], p))
                .collect(),
            bits: descriptor::BITS,
        })
    }
}

fn keypoint(level: &Level, peak: &Peak) -> Keypoint {
    // Pixel centres are at integers: the first pixel of a level lies amid the pixels it is made of.
    let full = |c: f32| f64::from((c + 0.5) * level.ratio - 0.5);
    let scale = f64::from(level.sigma / FIRST_SIGMA);
    Keypoint {
        u: full(peak.at.x),
        v: full(peak.at.y),
        scale,
        sigma: scale,
    }
}

/// At most `most` of the peaks, which come strongest first: the strongest of each cell of the image
/// before the second of any.
fn spread(peaks: Vec<Peak>, levels: &[Level], most: usize) -> Vec<Peak> {
    /// Side of a cell, pixels of the image.
    const CELL: f32 = 32.0;
    if peaks.len() <= most {
        return peaks;
    }
    let mut found = BTreeMap::<[u32; 2], usize>::new();
    let mut ranked: Vec<(usize, Peak)> = peaks
        .into_iter()
        .map(|peak| {
            let cell = (peak.at * levels[peak.level].ratio / CELL).map(|c| c as u32);
            let rank = found.entry(cell.into()).or_default();
            *rank += 1;
            (*rank, peak)
        })
        .collect();
    // A stable sort: among equal ranks the strongest stay first.
    ranked.sort_by_key(|(rank, _)| *rank);
    ranked.truncate(most);
    ranked.into_iter().map(|(_, peak)| peak).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::matching::hamming;
    use nalgebra::{Rotation2, Vector2};

    /// Dark and bright blobs of several sizes, seen after a similarity about the middle.
    fn blobs(width: u32, height: u32, turn: f64, zoom: f64, gain: f32) -> Plane {
        let middle = Vector2::new(f64::from(width), f64::from(height)) / 2.0;
        let back = Rotation2::new(-turn);
        Plane::from_fn(width, height, |u, v| {
            let p = back * (Vector2::new(f64::from(u), f64::from(v)) - middle) / zoom;
            // Positions and sizes that do not repeat.
            let mut value = 0.5;
            for k in 0..80 {
                let k = f64::from(k);
                let at = Vector2::new((k * 77.7) % 260.0 - 130.0, (k * 131.3) % 200.0 - 100.0);
                let size = 2.5 + (k * 0.618) % 1.0 * 5.0;
                let sign = if (k * 0.37) % 1.0 < 0.5 { -0.3 } else { 0.3 };
                let squared = (p - at).norm_squared() / (size * size);
                if squared < 30.0 {
                    value += sign * (-0.5 * squared).exp();
                }
            }
            image::Luma([0.2 + gain * value as f32])
        })
    }

    const ALL: Akaze = Akaze {
        threshold: 1e-4,
        most: usize::MAX,
    };

    #[test]
    fn features_come_again_after_rotation_zoom_and_dimming() {
        let (width, height) = (320, 240);
        let before = ALL.detect(&blobs(width, height, 0.0, 1.0, 0.5)).unwrap();
        assert!(before.keypoints.len() > 40, "{}", before.keypoints.len());
        let middle = Vector2::new(f64::from(width), f64::from(height)) / 2.0;
        // With how many of them OpenCV 4.14's AKAZE, on the same images, finds again by looks alone:
        // blobs are round, and so have hardly a direction to be described along.
        for (turn, zoom, known) in [
            (0.0, 1.0, 53),
            (0.7, 1.0, 39),
            (2.5, 1.0, 40),
            (0.0, 1.3, 29),
            (-1.2, 0.8, 28),
        ] {
            let after = ALL.detect(&blobs(width, height, turn, zoom, 0.35)).unwrap();
            let (mut in_view, mut again, mut alike) = (0, 0, 0);
            for (k, look) in before.keypoints.iter().zip(&before.descriptors) {
                let p = Vector2::new(k.u, k.v) - middle;
                let expected = Rotation2::new(turn) * p * zoom + middle;
                let inside = |c: f64, size: u32| (70.0..f64::from(size) - 70.0).contains(&c);
                if !(inside(expected.x, width) && inside(expected.y, height)) {
                    continue;
                }
                in_view += 1;
                let near = |i: &usize| {
                    let q = &after.keypoints[*i];
                    let ratio = q.scale / (k.scale * zoom);
                    (q.u - expected.x).hypot(q.v - expected.y) < 1.0 && (0.7..1.45).contains(&ratio)
                };
                again += usize::from((0..after.keypoints.len()).any(|i| near(&i)));
                let nearest = (0..after.keypoints.len())
                    .min_by_key(|i| hamming(look, &after.descriptors[*i]))
                    .unwrap();
                alike += usize::from(near(&nearest));
            }
            assert!(in_view > 10, "{in_view}");
            assert!(
                again * 10 >= in_view * 8,
                "{turn} {zoom}: {again} of {in_view} come again"
            );
            assert!(
                alike * 5 >= known * 4,
                "{turn} {zoom}: {alike} of {in_view} look alike, {known} to OpenCV"
            );
        }
    }

    #[test]
    fn a_blob_is_found_where_it_is_whatever_its_size() {
        for size in [3.0, 6.0, 12.0, 20.0] {
            let at = Vector2::new(203.3, 178.6);
            let image = Plane::from_fn(400, 360, |u, v| {
                let p = Vector2::new(f64::from(u), f64::from(v));
                let bell = (-0.5 * (p - at).norm_squared() / (size * size)).exp();
                image::Luma([(0.2 + 0.6 * bell) as f32])
            });
            let found = ALL.detect(&image).unwrap();
            let strongest = found
                .keypoints
                .iter()
                .find(|k| (k.u - at.x).hypot(k.v - at.y) < 0.06 * size + 0.1);
            assert!(strongest.is_some(), "{size}: {:?}", found.keypoints);
        }
    }

    #[test]
    fn fewer_features_are_the_strongest_everywhere() {
        let image = blobs(320, 240, 0.0, 1.0, 0.5);
        let all = ALL.detect(&image).unwrap();
        let few = Akaze { most: 20, ..ALL }.detect(&image).unwrap();
        assert_eq!(few.keypoints.len(), 20);
        for (k, look) in few.keypoints.iter().zip(&few.descriptors) {
            let i = all.keypoints.iter().position(|other| other == k).unwrap();
            assert_eq!(all.descriptors[i], *look);
        }
        let cells = |f: &Features| {
            let cell = |k: &Keypoint| ((k.u / 32.0) as u32, (k.v / 32.0) as u32);
            f.keypoints
                .iter()
                .map(cell)
                .collect::<std::collections::BTreeSet<_>>()
                .len()
        };
        assert!(cells(&few) >= 19, "{}", cells(&few));
    }

    #[test]
    fn any_image_is_taken_and_the_same_one_gives_the_same() {
        for (width, height) in [(0, 0), (1, 90), (60, 60), (61, 200), (83, 77), (640, 61)] {
            let noise = Plane::from_fn(width, height, |u, v| {
                image::Luma([((u * 7919 + v * 104_729) % 251) as f32 / 251.0])
            });
            for image in [&noise, &Plane::new(width, height)] {
                let [a, b] = [(); 2].map(|()| ALL.detect(image).unwrap());
                assert_eq!(
                    (&a.keypoints, &a.descriptors),
                    (&b.keypoints, &b.descriptors)
                );
                assert!(
                    a.keypoints
                        .iter()
                        .all(|k| k.u.is_finite() && k.v.is_finite())
                );
            }
        }
    }
}
