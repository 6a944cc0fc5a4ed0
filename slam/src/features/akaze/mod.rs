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
