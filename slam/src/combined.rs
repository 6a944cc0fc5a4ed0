//! Clouds of stereo at poses of structure from motion (de Jong 2020, chapter 7), and the scale between the two.
//!
//! Structure from motion says where cameras were in a unit of its own; clouds are in metres. The thesis takes the
//! distance between left and right camera for the rule: `factor = baseline / mean(distances)`. Its maps show each
//! rock several times along the route, as clouds do that lie too near to each other or too far apart, and it
//! suspects the factor (10.4). The formula is right, and what goes into it is not:
//!
//! - The distance is what bundle adjustment knows worst. Left and right camera are 0.12 m apart and look at ground 5
//!   to 10 m away; nothing holds them together, so each pair of them ends up with a distance of its own.
//! - The mean of lengths is no length of the mean. Noise of deviation `s` across the baseline `b` makes it
//!   longer, by `s^2 / b^2` as a share, whichever way it points: the factor comes out too small, clouds move
//!   together, and a rock is smeared along the way. It averages out of nothing.
//! - Steps of two views have the length 1 each until bundle adjustment says otherwise (6.2). Where it does not,
//!   the mean tells what a step was given.
//! - One factor cannot serve a route whose unit changes on the way, as that of monocular vision does.
//! - Outliers are judged by a mean that they are part of.
//! - Clouds have their origin in the left camera, and are put where the middle of both cameras was. That bends
//!   nothing on a straight way, and leaves a whole baseline between the maps of a way out and a way back.
//!
//! The corrected form leaves the baseline to stereo, which knows it: points that stereo places in metres are
//! found again in later images, and where they appear there depends on the factor alone once rotation and
//! direction are known. Each gives one linear equation; the weighted median of all solves them in the sense of
//! least absolute deviations, for each stretch of the way anew.

use std::time::Instant;

use barchan_datasets::{StereoFrame, luma};
use barchan_geometry::{RectifiedRig, Se3, StampedPose, StereoPoint, Trajectory};
use barchan_infer::{DisparityEngine, DisparityMap};
use barchan_terrain::{Cloud, Voxel, VoxelMap};
use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::features::{FeatureDetector, Features, Orb};
use crate::matching::match_all;
use crate::stereo_cloud::{StereoCloudConfig, StereoClouds};
use crate::{SlamConfig, SlamError};

/// Where the metre comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ScaleForm {
    /// Points of stereo, found again in later images.
    #[default]
    Corrected,
    /// The mean distance between left and right camera, as the thesis has it; poses are those of the middle
    /// between the cameras.
    Thesis,
}

/// Everything that decides how clouds are put at poses from elsewhere.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CombinedConfig {
    /// Where the metre comes from.
    pub scale: ScaleForm,
    /// Pairs of key frames before and after whose points also say what the factor of a stretch is. Default 15.
    pub window: usize,
    /// Features looked for in each image. Default 900.
    pub features: usize,
    /// A frame is a key frame when half its matches moved by more than this share of the width. Default 0.04.
    pub keyframe_flow: f64,
    /// Or when fewer features than this match. Default 40.
    pub min_matches: usize,
    /// Edge of the cubes that the map is merged in, metres. Default 0.02.
    pub merge_grid: f64,
    /// How a pair becomes a cloud.
    pub cloud: StereoCloudConfig,
}

impl Default for CombinedConfig {
    fn default() -> Self {
        Self {
            scale: ScaleForm::default(),
            window: 15,
            features: 900,
            keyframe_flow: 0.04,
            min_matches: 40,
            merge_grid: 0.02,
            cloud: StereoCloudConfig::default(),
        }
    }
}

/// Poses of a sequence in a unit of their own, by the times of its frames. Frames may be missing.
#[derive(Clone, Debug, Default)]
pub struct UpToScale {
    /// Of the left cameras.
    pub left: Trajectory,
    /// Of the right cameras, in the same unit and world, where they were views of their own. Only
    /// [`ScaleForm::Thesis`] needs them.
    pub right: Option<Trajectory>,
}

/// What became of one frame.
#[derive(Clone, Debug, Serialize)]
pub struct CombinedReport {
    /// Index in the sequence.
    pub frame: usize,
    /// Name of the frame.
    pub name: String,
    /// Whether structure from motion has a pose of it.
    pub tracked: bool,
    /// Why it has none; empty when it has.
    pub reason: String,
    /// Features that match the last key frame.
    pub matches: usize,
    /// Those whose place in metres is known, at key frames.
    pub inliers: usize,
    /// Metres in a unit, by these alone.
    pub factor: Option<f64>,
    /// Whether it became a key frame.
    pub keyframe: bool,
    /// Milliseconds of everything but disparity.
    pub ms_track: f64,
    /// Milliseconds of disparity; 0 where none was asked for.
    pub ms_disparity: f64,
    /// Dense disparity after rejection, at key frames. Not serialised.
    #[serde(skip)]
    pub dense: Option<DisparityMap>,
}

/// Metres in a unit of structure from motion.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scale {
    /// By the form that was asked for, over the whole way.
    pub factor: f64,
    /// By points of stereo: over the whole way, least and greatest of a stretch.
    pub corrected: Option<[f64; 3]>,
    /// What the factors of single pairs of key frames scatter by, over the root of their number, as a share.
    pub deviation: Option<f64>,
    /// By the mean distance of the cameras.
    pub thesis: Option<f64>,
}

/// What is left when all frames are through.
#[derive(Clone, Debug)]
pub struct CombinedResult {
    /// Every frame in order, in metres; one without a pose has that of the frame before.
    pub trajectory: Trajectory,
    /// Frame index, name and pose of each key frame.
    pub keyframes: Vec<(usize, String, StampedPose)>,
    /// The merged clouds of the key frames, in the world: the first left camera.
    pub map: Cloud,
    /// The scale that was used.
    pub scale: Scale,
}

/// Poses further apart in time than this are not of the same frame, seconds. Files round to 1e-6.
const SAME_TIME: f64 = 1e-3;

/// A frame that has a pose.
struct Placed {
    index: usize,
    name: String,
    /// Pose that the chosen form gives the cloud, in units.
    pose: Se3,
    /// Pairs of key frames that were complete before it.
    pairs: usize,
}

/// The key frame that features are matched with.
struct LastKeyframe {
    features: Features,
    /// Where stereo sees each feature, metres, in its camera frame.
    places: Vec<Option<Point3<f64>>>,
    left: Se3,
}

/// Puts clouds at poses known up to scale.
pub struct Combined {
    rig: RectifiedRig,
    config: CombinedConfig,
    matching: SlamConfig,
    detector: Orb,
    clouds: StereoClouds,
    poses: UpToScale,
    last: Option<LastKeyframe>,
    frames: Vec<(f64, Option<Placed>)>,
    /// Of each key frame, which of `frames` it is, and its cloud, thinned.
    keyframes: Vec<(usize, Cloud)>,
    /// Of each pair of successive key frames what its points say of the factor.
    evidence: Vec<Vec<Witness>>,
}

/// What one point says of the factor.
#[derive(Clone, Copy)]
struct Witness {
    factor: f64,
    weight: f64,
}

impl Combined {
    /// For a rig, and poses of its cameras.
    ///
    /// # Errors
    /// When `config` has a grid that is no length, or the thesis's scale is asked for without poses of right
    /// cameras.
    pub fn new(
        rig: RectifiedRig,
        config: CombinedConfig,
        engine: Box<dyn DisparityEngine>,
        poses: UpToScale,
    ) -> Result<Self, SlamError> {
        VoxelMap::new(config.merge_grid)?;
        if config.scale == ScaleForm::Thesis && poses.right.is_none() {
            return Err(SlamError::Scale(
                "the thesis's scale is the distance between left and right cameras, and poses of right cameras are not given"
                    .into(),
            ));
        }
        let matching = SlamConfig {
            features: config.features,
            ..SlamConfig::default()
        };
        Ok(Self {
            detector: Orb::new(config.features, matching.corner_threshold),
            matching,
            clouds: StereoClouds::new(rig, config.cloud.clone(), engine),
            rig,
            config,
            poses,
            last: None,
            frames: vec![],
            keyframes: vec![],
            evidence: vec![],
        })
    }

    /// Takes one frame: its features are matched with those of the last key frame; when they moved enough, its own
    /// disparity is asked for, what the matches say of the factor is noted, and its cloud is kept.
    ///
    /// # Errors
    /// When the frame has not the size of the rig, or the detector or the engine fails.
    pub fn track(&mut self, frame: &StereoFrame) -> Result<CombinedReport, SlamError> {
        let started = Instant::now();
        let mut report = CombinedReport {
            frame: frame.index,
            name: frame.name.clone(),
            tracked: false,
            reason: String::new(),
            matches: 0,
            inliers: 0,
            factor: None,
            keyframe: false,
            ms_track: 0.0,
            ms_disparity: 0.0,
            dense: None,
        };
        let Some((left, pose)) = self.poses_at(frame.time) else {
            report.reason = "structure from motion has no pose of it".into();
            self.frames.push((frame.time, None));
            return Ok(report);
        };
        report.tracked = true;
        let features = self
            .detector
            .detect(&luma(&frame.left))
            .map_err(|message| SlamError::Features {
                frame: frame.name.clone(),
                message,
            })?;
        let matches = self
            .last
            .as_ref()
            .map(|last| match_all(&last.features.descriptors, &features, &self.matching));
        report.matches = matches.as_ref().map_or(0, Vec::len);
        report.keyframe = match (&self.last, &matches) {
            (Some(last), Some(matches)) => {
                let moved = median_flow(&last.features, &features, matches);
                report.matches < self.config.min_matches
                    || moved > self.config.keyframe_flow * self.rig.width as f64
            }
            _ => true,
        };
        if report.keyframe {
            if let (Some(last), Some(matches)) = (&self.last, &matches) {
                let witnesses = self.witnesses(last, &left, &features, matches);
                report.inliers = witnesses.len();
                report.factor = weighted_median(witnesses.clone());
                self.evidence.push(witnesses);
            }
            let seen = self.clouds.cloud(frame)?;
            let mut thinned = VoxelMap::new(self.config.merge_grid)?;
            thinned.insert(&seen.cloud);
            self.keyframes.push((self.frames.len(), merged(&thinned)));
            self.last = Some(LastKeyframe {
                places: self.places(&features, &seen.dense),
                features,
                left,
            });
            report.ms_disparity = seen.ms_disparity;
            report.dense = Some(seen.dense);
        }
        let placed = Placed {
            index: frame.index,
            name: frame.name.clone(),
            pose,
            // A key frame ends a stretch, and what is between two belongs to the one that is to end.
            pairs: self.evidence.len() - usize::from(report.keyframe && !self.evidence.is_empty()),
        };
        self.frames.push((frame.time, Some(placed)));
        report.ms_track = started.elapsed().as_secs_f64() * 1e3 - report.ms_disparity;
        Ok(report)
    }

    /// Every frame through: the factors, the route in metres, the map.
    ///
    /// # Errors
    /// When nothing says what the scale is.
    pub fn finish(self) -> Result<CombinedResult, SlamError> {
        let scale = self.scale()?;
        let factors = match self.config.scale {
            ScaleForm::Thesis => vec![scale.factor; self.evidence.len()],
            ScaleForm::Corrected => self.local_factors(scale.factor),
        };
        // Step by step, each with the factor of its stretch, from the first camera that has a pose.
        let mut route = Trajectory::default();
        let mut before: Option<(Se3, Vector3<f64>)> = None;
        let mut first = Se3::identity();
        for (time, placed) in &self.frames {
            if let Some(placed) = placed {
                if before.is_none() {
                    first = placed.pose.inverse();
                }
                let pose = first * placed.pose;
                let factor = factors.get(placed.pairs).or(factors.last());
                let place = before.map_or(Vector3::zeros(), |(last, place)| {
                    let step = pose.translation.vector - last.translation.vector;
                    place + step * factor.copied().unwrap_or(scale.factor)
                });
                before = Some((pose, place));
            }
            let pose = before.map_or(Se3::identity(), |(pose, place)| {
                Se3::from_parts(place.into(), pose.rotation)
            });
            route.poses.push(StampedPose {
                time: *time,
                T_world_cam: pose,
            });
        }
        let mut map = VoxelMap::new(self.config.merge_grid)?;
        let mut keyframes = vec![];
        for (k, cloud) in self.keyframes {
            let pose = route.poses[k];
            map.insert(&cloud.transform(&pose.T_world_cam));
            keyframes.extend(
                self.frames[k]
                    .1
                    .as_ref()
                    .map(|f| (f.index, f.name.clone(), pose)),
            );
        }
        Ok(CombinedResult {
            trajectory: route,
            keyframes,
            map: merged(&map),
            scale,
        })
    }

    /// The pose of the left camera, and the one that the chosen form gives the cloud.
    fn poses_at(&self, time: f64) -> Option<(Se3, Se3)> {
        let left = pose_at(&self.poses.left, time)?;
        match (self.config.scale, &self.poses.right) {
            (ScaleForm::Thesis, Some(right)) => {
                let right = pose_at(right, time)?;
                Some((left, left.try_lerp_slerp(&right, 0.5, 1e-9)?))
            }
            _ => Some((left, left)),
        }
    }

    /// Where stereo sees features, in metres.
    fn places(&self, features: &Features, dense: &DisparityMap) -> Vec<Option<Point3<f64>>> {
        let (width, height) = dense.disparity.dimensions();
        let place = |k: &crate::Keypoint| {
            let (x, y) = (k.u.round() as u32, k.v.round() as u32);
            let d = (x < width && y < height).then(|| dense.disparity.get_pixel(x, y).0[0])?;
            let at = StereoPoint {
                u: k.u,
                v: k.v,
                d: f64::from(d),
            };
            self.rig.back_project(at)
        };
        features.keypoints.iter().map(place).collect()
    }

    /// What features of the last key frame say of the factor, seen again from `left`: with its rotation `R` and its
    /// shift `t` in units a point `X` comes to lie at `R X + s t`, whose image is where the feature is.
    fn witnesses(
        &self,
        last: &LastKeyframe,
        left: &Se3,
        features: &Features,
        matches: &[(usize, usize)],
    ) -> Vec<Witness> {
        let motion = left.inv_mul(&last.left);
        let shift = motion.translation.vector;
        let mut witnesses = vec![];
        for (earlier, now) in matches {
            let Some(place) = last.places[*earlier] else {
                continue;
            };
            let turned = motion.rotation * place;
            if turned.z <= 0.0 {
                continue;
            }
            let at = features.keypoints[*now];
            let rays = [
                (at.u - self.rig.cx) / self.rig.fx,
                (at.v - self.rig.cy) / self.rig.fy,
            ];
            for (ray, k) in rays.into_iter().zip(0..) {
                // (turned + s shift)[k] = ray (turned + s shift).z, over the depth: errors are then rays.
                let per_unit = (shift[k] - ray * shift.z) / turned.z;
                let rest = (ray * turned.z - turned[k]) / turned.z;
                let factor = rest / per_unit;
                if factor.is_finite() {
                    witnesses.push(Witness {
                        factor,
                        weight: per_unit.abs(),
                    });
                }
            }
        }
        witnesses
    }

    fn scale(&self) -> Result<Scale, SlamError> {
        let all: Vec<Witness> = self.evidence.iter().flatten().copied().collect();
        let overall = weighted_median(all).filter(|factor| *factor > 0.0);
        let local = |overall| {
            let factors = self.local_factors(overall);
            let least = factors.iter().copied().fold(overall, f64::min);
            [
                overall,
                least,
                factors.iter().copied().fold(overall, f64::max),
            ]
        };
        let thesis = self
            .poses
            .right
            .as_ref()
            .and_then(|right| baseline_factor(&self.poses.left, right, self.rig.baseline));
        let factor = match self.config.scale {
            ScaleForm::Corrected => overall.ok_or_else(|| {
                SlamError::Scale(format!(
                    "none of {} key frames sees a point again whose place stereo knows, so nothing says how long a unit of the poses is",
                    self.keyframes.len()
                ))
            }),
            ScaleForm::Thesis => thesis.ok_or_else(|| {
                SlamError::Scale("no left and right camera have poses at one time".into())
            }),
        }?;
        Ok(Scale {
            factor,
            corrected: overall.map(local),
            deviation: overall.and_then(|overall| self.deviation(overall)),
            thesis,
        })
    }

    /// The factor of each pair of key frames, by its points and those of its neighbours.
    fn local_factors(&self, overall: f64) -> Vec<f64> {
        let pairs = self.evidence.len();
        let around = |k: usize| {
            let near = k.saturating_sub(self.config.window)
                ..(k.saturating_add(self.config.window + 1)).min(pairs);
            weighted_median(self.evidence[near].concat()).filter(|f| *f > 0.0)
        };
        (0..pairs).map(|k| around(k).unwrap_or(overall)).collect()
    }

    /// Robust standard deviation of the factors of single pairs, over the root of their number, as a share.
    fn deviation(&self, overall: f64) -> Option<f64> {
        let singles = self
            .evidence
            .iter()
            .filter_map(|e| weighted_median(e.clone()));
        let off: Vec<Witness> = singles
            .map(|f| Witness {
                factor: (f / overall - 1.0).abs(),
                weight: 1.0,
            })
            .collect();
        let root = (off.len() as f64).sqrt();
        // 1.4826: from the median of absolute deviations to the standard deviation of a normal distribution.
        (off.len() >= 3).then(|| weighted_median(off).map(|m| 1.4826 * m / root))?
    }
}

/// The thesis's factor: the baseline over the mean distance of left and right cameras, outliers removed. How far out
/// is not said; three standard deviations, as Matlab's `rmoutliers` by the mean.
pub fn baseline_factor(left: &Trajectory, right: &Trajectory, baseline: f64) -> Option<f64> {
    let distance = |l: &StampedPose| {
        let right = pose_at(right, l.time)?;
        Some((right.translation.vector - l.T_world_cam.translation.vector).norm())
    };
    let distances: Vec<f64> = left.poses.iter().filter_map(distance).collect();
    let mean = |d: &[f64]| d.iter().sum::<f64>() / d.len() as f64;
    let about = mean(&distances);
    let squares: Vec<f64> = distances.iter().map(|d| (d - about).powi(2)).collect();
    let far = 3.0 * mean(&squares).sqrt();
    let kept: Vec<f64> = distances
        .into_iter()
        .filter(|d| (d - about).abs() <= far)
        .collect();
    Some(baseline / mean(&kept)).filter(|factor| factor.is_finite() && *factor > 0.0)
}

/// The pose nearest in time, if it is of the same frame.
fn pose_at(trajectory: &Trajectory, time: f64) -> Option<Se3> {
    let after = trajectory.poses.partition_point(|p| p.time < time);
    let near = &trajectory.poses[after.saturating_sub(1)..(after + 1).min(trajectory.poses.len())];
    let apart = |p: &StampedPose| (p.time - time).abs();
    let nearest = near.iter().min_by(|a, b| apart(a).total_cmp(&apart(b)))?;
    (apart(nearest) <= SAME_TIME).then_some(nearest.T_world_cam)
}

/// How far half the matches moved, pixels.
fn median_flow(earlier: &Features, now: &Features, matches: &[(usize, usize)]) -> f64 {
    let flow = |(a, b): &(usize, usize)| {
        let (a, b) = (earlier.keypoints[*a], now.keypoints[*b]);
        Witness {
            factor: (a.u - b.u).hypot(a.v - b.v),
            weight: 1.0,
        }
    };
    weighted_median(matches.iter().map(flow).collect()).unwrap_or(0.0)
}

/// What has half the weight on either side: the least sum of weighted absolute deviations.
fn weighted_median(mut witnesses: Vec<Witness>) -> Option<f64> {
    witnesses.sort_unstable_by(|a, b| a.factor.total_cmp(&b.factor));
    let half = 0.5 * witnesses.iter().map(|w| w.weight).sum::<f64>();
    let mut sum = 0.0;
    let reached = |w: &&Witness| {
        sum += w.weight;
        sum >= half && w.weight > 0.0
    };
    witnesses.iter().find(reached).map(|w| w.factor)
}

fn merged(map: &VoxelMap) -> Cloud {
    Cloud {
        points: map.voxels(1).iter().map(Voxel::to_point).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_weighted_median_has_half_the_weight_on_either_side() {
        let of = |pairs: &[(f64, f64)]| {
            let witness = |(factor, weight): &(f64, f64)| Witness {
                factor: *factor,
                weight: *weight,
            };
            weighted_median(pairs.iter().map(witness).collect())
        };
        assert_eq!(of(&[]), None);
        assert_eq!(of(&[(5.0, 0.0)]), None);
        assert_eq!(of(&[(5.0, 1.0), (1.0, 1.0), (3.0, 1.0)]), Some(3.0));
        assert_eq!(of(&[(5.0, 3.0), (1.0, 1.0), (3.0, 1.0)]), Some(5.0));
        // An outlier however far moves nothing.
        assert_eq!(of(&[(1e9, 1.0), (1.0, 1.0), (1.1, 1.0)]), Some(1.1));
    }

    #[test]
    fn the_baseline_gives_the_factor_of_poses_without_noise_and_outliers_go() {
        let at = |time: f64, x: f64| StampedPose {
            time,
            T_world_cam: Se3::translation(x, 0.0, time),
        };
        let left = Trajectory {
            poses: (0..40).map(|i| at(f64::from(i), 0.0)).collect(),
        };
        let mut right = Trajectory {
            poses: (0..40).map(|i| at(f64::from(i), 0.3)).collect(),
        };
        let factor = |right: &Trajectory| baseline_factor(&left, right, 0.12);
        assert!((factor(&right).unwrap() - 0.4).abs() < 1e-12);
        right.poses[7] = at(7.0, 20.0);
        assert!((factor(&right).unwrap() - 0.4).abs() < 1e-12);
        assert_eq!(factor(&Trajectory::default()), None);
        assert_eq!(factor(&left), None, "cameras at one place");
    }
}
