//! Whether true poses and disparities tell of one rig.

use barchan_geometry::{RectifiedRig, Se3, StereoPoint, Trajectory};
use nalgebra::{Matrix3, Point3, Vector2};
use rayon::prelude::*;
use serde::Serialize;

use super::matching::{View, Window, find_matches};
use super::rows::ENOUGH;
use super::{Fault, Finding, Look, RowModel, median, spread};
use crate::{DataError, StereoSource};

/// By what factor the rig would have to change for its points to move as the true poses say. Either
/// factor alone explains what was seen; `clear` tells whether one of them does so clearly better.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PoseScale {
    /// Of the baseline, were that wrong.
    pub baseline: f64,
    /// Of the focal length, were that wrong.
    pub focal_length: f64,
    /// Which of the two it is; `None` where forward motion leaves both possible.
    #[serde(skip)]
    clear: Option<Fault>,
    /// Points that were followed.
    pub points: usize,
    /// Median distance between where they were seen and where poses and the better factor put them,
    /// pixels.
    pub error: f64,
}

/// A point seen by the rig, and again by its left camera after a known motion.
#[allow(non_snake_case)]
struct Track {
    rig: RectifiedRig,
    first: StereoPoint,
    second: Vector2<f64>,
    T_second_first: Se3,
}

/// Follows the matches of up to six frames to a later frame, and compares. `None` without true
/// poses in space, without motion, and of too few points.
///
/// # Errors
/// When a frame cannot be read.
pub(super) fn pose_scale(
    source: &dyn StereoSource,
    looks: &[Look],
    rows: Option<&RowModel>,
) -> Result<Option<PoseScale>, DataError> {
    let Some(truth) = source.true_trajectory().filter(|truth| in_space(truth)) else {
        return Ok(None);
    };
    let tracks: Vec<Track> = spread(looks.len(), 6)
        .into_par_iter()
        .map(|k| tracks(source, &looks[k], truth, rows))
        .collect::<Result<Vec<_>, _>>()?
        .into_iter()
        .flatten()
        .collect();
    if tracks.len() < ENOUGH {
        return Ok(None);
    }
    let (baseline, by_baseline) = fit_factor(&tracks, |t, factor| scaled(t, factor, 1.0));
    let (focal_length, by_focal) = fit_factor(&tracks, |t, factor| scaled(t, 1.0, factor));
    let spread_of = |residuals: &[f64]| median(&mut residuals.to_vec());
    let error = spread_of(&by_baseline).min(spread_of(&by_focal));
    let sigma = error.max(0.1);
    let cost = |residuals: &[f64]| {
        let capped = residuals.iter().map(|r| (r / sigma).min(4.0).powi(2));
        capped.sum::<f64>() / residuals.len() as f64
    };
    let (cost_baseline, cost_focal) = (cost(&by_baseline), cost(&by_focal));
    // A tenth of a variance a point, whatever their number: neighbours err alike.
    let clear = if cost_baseline < cost_focal - 0.1 {
        Some(Fault::Baseline)
    } else if cost_focal < cost_baseline - 0.1 {
        Some(Fault::FocalLength)
    } else {
        None
    };
    Ok(Some(PoseScale {
        baseline,
        focal_length,
        clear,
        points: tracks.len(),
        error,
    }))
}

impl PoseScale {
    /// Says when the rig contradicts the poses.
    pub(super) fn judge(&self, rig: &RectifiedRig, findings: &mut Vec<Finding>) {
        /// Less than this is the noise of disparities and of most truth.
        const NOTICED: f64 = 0.02;
        /// Farther off, in an image of 640 pixels, no rig explains the motion.
        const EXPLAINED: f64 = 1.0;
        if self.error > EXPLAINED * (rig.width as f64 / 640.0).max(1.0) {
            findings.push(Finding {
                fault: Fault::Poses,
                value: self.error,
                text: format!(
                    "the true poses do not fit the images with any baseline: {} points are {:.1} px off at best; are they poses of the left camera, at the times of the images?",
                    self.points, self.error
                ),
            });
            return;
        }
        let (factor, fault) = match self.clear {
            Some(Fault::FocalLength) => (self.focal_length, Fault::FocalLength),
            _ => (self.baseline, Fault::Baseline),
        };
        if (factor - 1.0).abs() < NOTICED {
            return;
        }
        let baseline = format!(
            "a baseline of {:.4} m instead of {:.4}",
            rig.baseline * self.baseline,
            rig.baseline
        );
        let focal = format!(
            "a focal length of {:.1} px instead of {:.1}",
            rig.fx * self.focal_length,
            rig.fx
        );
        let agrees = match self.clear {
            Some(Fault::Baseline) => baseline,
            Some(_) => focal,
            None => format!("{baseline}, or {focal},"),
        };
        findings.push(Finding {
            fault,
            value: factor,
            text: format!(
                "{agrees} would agree with the true poses ({} points followed): correct the calibration, or the unit of the poses",
                self.points
            ),
        });
    }
}

/// Poses with a rotation or a height; planar truth has neither, nor a camera's orientation.
fn in_space(truth: &Trajectory) -> bool {
    truth.poses.iter().any(|p| {
        p.T_world_cam.rotation.angle() > 1e-9 || p.T_world_cam.translation.vector.z.abs() > 1e-9
    })
}

/// The matches of a frame, followed to the first later frame in which they moved enough.
#[allow(non_snake_case)]
fn tracks(
    source: &dyn StereoSource,
    look: &Look,
    truth: &Trajectory,
    rows: Option<&RowModel>,
) -> Result<Vec<Track>, DataError> {
    let rig = look.rig;
    // Near the identity, so invertible.
    let to_corrected = rows
        .and_then(|rows| rows.homography(&rig).try_inverse())
        .unwrap_or(Matrix3::identity());
    let seen: Vec<StereoPoint> = look
        .matches
        .iter()
        .map(|m| {
            let right = to_corrected * m.to.push(1.0);
            StereoPoint {
                u: m.from.x,
                v: m.from.y,
                d: m.from.x - right.x / right.z,
            }
        })
        .collect();
    let mut depths: Vec<f64> = seen
        .iter()
        .filter_map(|at| rig.back_project(*at).map(|p| p.z))
        .collect();
    let depth = median(&mut depths);
    let pose = |i: usize| truth.poses.get(i).map(|p| p.T_world_cam);
    let motion = |i: usize| Some(pose(i)?.inverse() * pose(look.frame)?);
    // Enough flow to measure against noise, and little enough for patches to look the same.
    let flow = |T: &Se3| rig.fx * T.translation.vector.norm() / depth;
    let enough = rig.width as f64 / 40.0;
    let later = (look.frame + 1..source.len().min(look.frame + 30))
        .find(|i| motion(*i).is_some_and(|T| flow(&T) > enough));
    let Some((second, T_second_first)) = later.and_then(|i| Some((i, motion(i)?))) else {
        return Ok(Vec::new());
    };
    if rig.fx * T_second_first.rotation.angle() > rig.width as f64 / 6.0 {
        return Ok(Vec::new());
    }
    let predict = |at: &StereoPoint| {
        let p_first = rig.back_project(*at)?;
        let seen = rig.project(&(T_second_first * p_first))?;
        Some(Vector2::new(seen.u, seen.v))
    };
    let views = [look.frame, second]
        .into_par_iter()
        .map(|i| source.frame(i).map(|frame| View::new(&frame.left)))
        .collect::<Result<Vec<_>, _>>()?;
    let nearest = |place: Vector2<f64>| {
        seen.iter()
            .find(|at| (at.u - place.x).abs() < 1.0 && (at.v - place.y).abs() < 1.0)
    };
    // The patches of the same view are the same, so each finds its disparity. The reach allows a
    // factor of two between rig and poses.
    let reach = 1.5 * enough;
    let followed = find_matches(&views[0], &views[1], look.patches, |place| {
        let by = predict(nearest(place)?)? - place;
        Some(Window {
            columns: by.x - reach..=by.x + reach,
            rows: by.y - reach..=by.y + reach,
        })
    });
    Ok(followed
        .into_iter()
        .filter_map(|m| {
            Some(Track {
                rig,
                first: *nearest(m.from)?,
                second: m.to,
                T_second_first,
            })
        })
        .collect())
}

/// Distance in pixels between where a track was seen and where a rig with another baseline and
/// focal length would see it.
fn scaled(track: &Track, baseline: f64, focal_length: f64) -> f64 {
    let rig = RectifiedRig {
        fx: track.rig.fx * focal_length,
        fy: track.rig.fy * focal_length,
        baseline: track.rig.baseline * baseline,
        ..track.rig
    };
    let p_first: Option<Point3<f64>> = rig.back_project(track.first);
    p_first
        .and_then(|p| rig.project(&(track.T_second_first * p)))
        .map_or(f64::MAX, |at| {
            (Vector2::new(at.u, at.v) - track.second).norm()
        })
}

/// The factor from 1/2 to 2 with the least sum of distances, each capped so that wrong matches do
/// not vote (a grid, then a golden-section search: one unknown needs no derivatives), and the
/// distances there.
fn fit_factor(tracks: &[Track], distance: impl Fn(&Track, f64) -> f64) -> (f64, Vec<f64>) {
    let distances =
        |log: f64| -> Vec<f64> { tracks.iter().map(|t| distance(t, log.exp())).collect() };
    let cost = |log: f64| -> f64 { distances(log).into_iter().map(|d| d.min(3.0)).sum() };
    let step = 0.02;
    let reach = (2f64.ln() / step) as i32;
    let coarse = (-reach..=reach)
        .map(|k| f64::from(k) * step)
        .min_by(|a, b| cost(*a).total_cmp(&cost(*b)))
        .unwrap_or(0.0);
    let golden = (5f64.sqrt() - 1.0) / 2.0;
    let (mut low, mut high) = (coarse - step, coarse + step);
    while high - low > 1e-5 {
        let (a, b) = (high - golden * (high - low), low + golden * (high - low));
        if cost(a) < cost(b) {
            high = b;
        } else {
            low = a;
        }
    }
    let best = (low + high) / 2.0;
    (best.exp(), distances(best))
}
