//! Metres: the length that structure from motion gives to the stereo baseline (de Jong 2020, chapter 7).

use barchan_datasets::Plane;
use barchan_geometry::RectifiedRig;
use serde::Serialize;

use super::follow::Sighting;
use super::follow::TrackId;
use super::scene::Scene;
use crate::matching::{Window, refine_disparity};

/// What a unit of the reconstruction is worth, and what says so.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MetricScale {
    /// Metres in a unit: the thesis's `factor`.
    pub factor: f64,
    /// Frame of each view that tells the length of the baseline, and that length in units.
    pub baselines: Vec<(usize, f64)>,
    /// How many of `baselines` agree and were taken.
    pub used: usize,
}

/// The factor of some views: the mean length of the baseline over them, outliers removed, is the baseline in
/// metres (de Jong 2020, chapter 7). `None` when no view tells.
///
/// The thesis reconstructs right images too, and takes the distance to the left camera that each is found at.
/// Here each view's length follows from points that both cameras see: one at depth `z` of the reconstruction
/// with the disparity `d` is seen by cameras `z (d + doffs) / f` apart; the median over the points is the view's.
/// What is farther from the median of all views than three times their usual distance is an outlier.
pub(super) fn metric_scale(scene: &Scene, piece: usize) -> Option<MetricScale> {
    const FEWEST: usize = 8;
    let rig = &scene.rig;
    let views = scene.views.iter().filter(|v| v.piece == piece);
    let baselines: Vec<(usize, f64)> = views
        .filter_map(|view| {
            let lengths = view.disparities.iter().filter_map(|(track, d)| {
                let depth = (view.T_cam_world * scene.point(*track)?).z;
                Some(rig.baseline * depth / rig.depth(*d)).filter(|length| *length > 0.0)
            });
            let lengths: Vec<f64> = lengths.collect();
            (lengths.len() >= FEWEST).then_some(())?;
            Some((view.frame, median(lengths)?))
        })
        .collect();
    let middle = median(baselines.iter().map(|(_, b)| *b).collect())?;
    let distance = |length: f64| (length - middle).abs();
    // 1.4826 times the median distance is a standard deviation of normal errors.
    let usual = 1.4826 * median(baselines.iter().map(|(_, b)| distance(*b)).collect())?;
    let taken: Vec<f64> = (baselines.iter().map(|(_, b)| *b))
        .filter(|b| distance(*b) <= 3.0 * usual)
        .collect();
    let mean = taken.iter().sum::<f64>() / taken.len() as f64;
    Some(MetricScale {
        factor: rig.baseline / mean,
        used: taken.len(),
        baselines,
    })
}

/// The middle value; `None` of nothing.
pub(super) fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// Stereo disparities of sightings, of those where one place of the right image's row looks like the left and
/// no other does.
pub(super) fn stereo_disparities(
    images: [&Plane; 2],
    sightings: &[Sighting],
    rig: &RectifiedRig,
    min_disparity: f64,
) -> Vec<(TrackId, f64)> {
    let disparity = |s: &Sighting| {
        let d = refine_disparity(images, &s.at, coarse_disparity(images, s, rig)?)?;
        (d + rig.doffs >= min_disparity).then_some((s.track, d))
    };
    sightings.iter().filter_map(disparity).collect()
}

/// The whole disparity at which a row looks most alike, when it clearly does.
fn coarse_disparity([left, right]: [&Plane; 2], s: &Sighting, rig: &RectifiedRig) -> Option<f64> {
    /// Least correlation of the place, and least lead over other places.
    const ALIKE: f32 = 0.8;
    const LEAD: f32 = 0.05;
    let (u, v) = (s.at.u.round() as i64, s.at.v.round() as i64);
    let reference = Window::cut(left, u, v)?;
    let nearest = rig.width as i64 / 4;
    let scores: Vec<(i64, f32)> = (-(rig.doffs.ceil() as i64)..nearest)
        .filter_map(|d| Some((d, reference.correlation(&Window::cut(right, u - d, v)?))))
        .collect();
    let (best, score) = *scores.iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
    let rivals = scores.iter().filter(|(d, _)| (d - best).abs() > 3);
    let rival = rivals.map(|(_, score)| *score).fold(-1.0, f32::max);
    (score >= ALIKE && score >= rival + LEAD).then_some(best as f64)
}
