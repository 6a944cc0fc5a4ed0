//! From one pair to the next: where was the camera, and what is new?

use std::time::Instant;

use barchan_datasets::{Plane, Rgb, StereoFrame, luma};
use barchan_geometry::{RectifiedRig, Se3, StampedPose, StereoPoint, Trajectory, se3};
use barchan_infer::{DisparityEngine, DisparityMap, Rejection};
use nalgebra::Point3;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use crate::bundle_adjustment::BundleAdjustment;
use crate::features::{Features, Orb};
use crate::map::{Keyframe, Map, PointId};
use crate::matching::{
    DisparityGate, Grid, MatchCounts, match_all, match_projections, stereo_matches,
};
use crate::pose::{Observation, PoseEstimate, optimise_pose, sample_pose};
use crate::{Keypoint, SlamConfig, SlamError};

/// What became of one frame.
#[derive(Clone, Debug, Serialize)]
pub struct FrameReport {
    /// Index in the sequence.
    pub frame: usize,
    /// Name of the frame.
    pub name: String,
    /// Whether its pose is known.
    pub tracked: bool,
    /// Map points that agree with the pose.
    pub inliers: usize,
    /// Features with a disparity.
    pub stereo: usize,
    /// Why it is lost; empty when it is not.
    pub reason: String,
    /// Whether it became a key frame.
    pub keyframe: bool,
    /// How stereo matches were decided, at key frames.
    pub matches: MatchCounts,
    /// Milliseconds from images to pose and map, without dense disparity.
    pub ms_track: f64,
    /// Milliseconds of dense disparity; 0 where none was asked for.
    pub ms_disparity: f64,
    /// Dense disparity after rejection, at key frames when there is an engine. Not serialised.
    #[serde(skip)]
    pub dense: Option<DisparityMap>,
}

/// What is left when all frames are through.
#[derive(Clone, Debug)]
pub struct SlamResult {
    /// Every frame in order; a lost one has the pose that was predicted for it.
    pub trajectory: Trajectory,
    /// Frame index, name and pose of each key frame.
    pub keyframes: Vec<(usize, String, StampedPose)>,
    /// The map.
    pub map: Map,
}

/// A frame with its features, before anything is known of its pose.
struct Seen {
    grey: [Plane; 2],
    features: [Features; 2],
    disparities: Vec<Option<f64>>,
    matches: MatchCounts,
    grid: Grid,
}

/// The pose of a frame relative to the key frame it was tracked against, so that it follows when
/// that one is corrected.
#[allow(non_snake_case)]
struct Placed {
    time: f64,
    keyframe: usize,
    T_cam_keyframe: Se3,
}

/// Tracks a sequence and builds its map.
#[allow(non_snake_case)]
pub struct Slam {
    rig: RectifiedRig,
    config: SlamConfig,
    orb: Orb,
    engine: Option<Box<dyn DisparityEngine>>,
    map: Map,
    placed: Vec<Placed>,
    /// Pose of the last frame, and the twist and time step that led to it.
    last: Option<(Se3, f64)>,
    velocity: Option<(nalgebra::Vector6<f64>, f64)>,
    /// Most inliers of a frame since the last key frame.
    most_inliers: usize,
}

impl Slam {
    /// SLAM for a rig. Without an engine there is no dense disparity and no gate.
    pub fn new(
        rig: RectifiedRig,
        config: SlamConfig,
        engine: Option<Box<dyn DisparityEngine>>,
    ) -> Self {
        let orb = Orb::new(config.features, config.corner_threshold);
        Self {
            rig,
            config,
            orb,
            engine,
            map: Map::default(),
            placed: Vec::new(),
            last: None,
            velocity: None,
            most_inliers: 0,
        }
    }

    /// Places one frame (Pire 2017, tracking thread): predict, match the local map, optimise the
    /// pose; where that fails, match the last key frames by looks alone and sample; make a key frame
    /// when matches run low.
    ///
    /// # Errors
    /// When the frame has not the size of the rig, or a detector or the engine fails. A frame that
    /// cannot be placed is no error but a report with a reason.
    #[allow(non_snake_case)]
    pub fn track(&mut self, frame: &StereoFrame) -> Result<FrameReport, SlamError> {
        self.check_size(frame)?;
        let started = Instant::now();
        let seen = self.see(frame)?;
        let mut report = FrameReport {
            frame: frame.index,
            name: frame.name.clone(),
            tracked: false,
            inliers: 0,
            stereo: seen.disparities.iter().flatten().count(),
            reason: String::new(),
            keyframe: false,
            matches: seen.matches,
            ms_track: 0.0,
            ms_disparity: 0.0,
            dense: None,
        };

        if self.map.keyframes.is_empty() {
            if report.stereo < self.config.min_inliers {
                report.reason = self.why_lost(&seen, "no map can be started");
                self.place(frame.time, Se3::identity());
            } else {
                self.insert_keyframe(frame, seen, Se3::identity(), &[], &mut report)?;
                (report.tracked, report.inliers) = (true, report.stereo);
            }
            report.ms_track = started.elapsed().as_secs_f64() * 1e3 - report.ms_disparity;
            return Ok(report);
        }

        let T_predicted = self.predict(frame.time);
        let local = self
            .map
            .points_since(self.map.keyframes.len().saturating_sub(self.config.window));
        let found = self
            .track_by_projection(&seen, &local, &T_predicted)
            .or_else(|| self.track_by_looks(&seen, &local, frame.index));

        match found {
            Some((pose, matches)) => {
                let T_cam_world = pose.T_cam_world;
                let inliers: Vec<(PointId, usize)> = matches
                    .iter()
                    .zip(&pose.inliers)
                    .filter(|(_, i)| **i)
                    .map(|(m, _)| *m)
                    .collect();
                (report.tracked, report.inliers) = (true, inliers.len());
                self.learn_velocity(frame.time, &T_cam_world);
                self.most_inliers = self.most_inliers.max(inliers.len());
                if (inliers.len() as f64) < self.config.keyframe_ratio * self.most_inliers as f64 {
                    self.insert_keyframe(frame, seen, T_cam_world, &inliers, &mut report)?;
                } else {
                    self.place(frame.time, T_cam_world);
                }
            }
            None => {
                report.reason = self.why_lost(&seen, "too few of them fit one pose");
                self.velocity = None;
                self.place(frame.time, T_predicted);
            }
        }
        report.ms_track = started.elapsed().as_secs_f64() * 1e3 - report.ms_disparity;
        Ok(report)
    }

    /// Every frame through: poses of all frames, following their corrected key frames.
    #[allow(non_snake_case)]
    pub fn finish(self) -> SlamResult {
        let poses = self
            .placed
            .iter()
            .map(|p| {
                let T_keyframe_world = self
                    .map
                    .keyframes
                    .get(p.keyframe)
                    .map_or_else(Se3::identity, |k| k.T_cam_world);
                StampedPose {
                    time: p.time,
                    T_world_cam: (p.T_cam_keyframe * T_keyframe_world).inverse(),
                }
            })
            .collect();
        let keyframe = |k: &Keyframe| {
            (
                k.frame,
                k.name.clone(),
                StampedPose {
                    time: k.time,
                    T_world_cam: k.T_cam_world.inverse(),
                },
            )
        };
        let keyframes = self.map.keyframes.iter().map(keyframe).collect();
        SlamResult {
            trajectory: Trajectory { poses },
            keyframes,
            map: self.map,
        }
    }

    fn check_size(&self, frame: &StereoFrame) -> Result<(), SlamError> {
        for image in [&frame.left, &frame.right] {
            let (width, height) = image.dimensions();
            if (width as usize, height as usize) != (self.rig.width, self.rig.height) {
                let (rig_width, rig_height) = (self.rig.width, self.rig.height);
                return Err(SlamError::Size {
                    frame: frame.name.clone(),
                    width,
                    height,
                    rig_width,
                    rig_height,
                });
            }
        }
        Ok(())
    }

    fn see(&self, frame: &StereoFrame) -> Result<Seen, SlamError> {
        let grey = [luma(&frame.left), luma(&frame.right)];
        let orb = &self.orb;
        let (left, right) = rayon::join(|| orb.extract(&grey[0]), || orb.extract(&grey[1]));
        let failed = |message| SlamError::Features {
            frame: frame.name.clone(),
            message,
        };
        let features = [left.map_err(failed)?, right.map_err(failed)?];
        let (disparities, matches) = stereo_matches(
            &features[0],
            &features[1],
            [&grey[0], &grey[1]],
            self.max_disparity(),
            None,
            &self.config,
        );
        let grid = Grid::new(&features[0].keypoints, self.rig.width, self.rig.height);
        Ok(Seen {
            grey,
            features,
            disparities,
            matches,
            grid,
        })
    }

    /// A quarter of the width is nearer than any rig of use is focused.
    fn max_disparity(&self) -> f64 {
        self.rig.width as f64 / 4.0
    }

    /// The last pose moved on by the last velocity, scaled to the time that passed.
    fn predict(&self, time: f64) -> Se3 {
        let Some((last, last_time)) = self.last else {
            return Se3::identity();
        };
        match self.velocity {
            Some((twist, step)) if step > 0.0 => {
                // Times of field data jump; a rover does not.
                let share = ((time - last_time) / step).clamp(0.0, 2.0);
                se3::exp(&(twist * share)) * last
            }
            _ => last,
        }
    }

    #[allow(non_snake_case)]
    fn learn_velocity(&mut self, time: f64, T_cam_world: &Se3) {
        if let Some((last, last_time)) = self.last {
            self.velocity = Some((se3::log(&(T_cam_world * last.inverse())), time - last_time));
        }
    }

    /// Matches local points where the predicted pose puts them, in windows that widen until enough
    /// agree, then once more, narrowly, from the pose that came out.
    #[allow(non_snake_case)]
    fn track_by_projection(
        &self,
        seen: &Seen,
        local: &[PointId],
        T_predicted: &Se3,
    ) -> Option<(PoseEstimate, Vec<(PointId, usize)>)> {
        for radius in [12.0, 24.0, 48.0] {
            let matches = self.project_and_match(seen, local, T_predicted, radius);
            if matches.len() < self.config.min_inliers {
                continue;
            }
            let rough = optimise_pose(&self.rig, &self.observations(seen, &matches), T_predicted);
            if rough.count() >= self.config.min_inliers && 3 * rough.count() >= matches.len() {
                return self.refine(seen, local, rough.T_cam_world);
            }
        }
        None
    }

    /// Matches by descriptor alone and samples a pose: for jumps that no prediction covers.
    #[allow(non_snake_case)]
    fn track_by_looks(
        &self,
        seen: &Seen,
        local: &[PointId],
        frame: usize,
    ) -> Option<(PoseEstimate, Vec<(PointId, usize)>)> {
        let descriptors: Vec<_> = local
            .iter()
            .map(|id| self.map.points[id].descriptor)
            .collect();
        let matches: Vec<(PointId, usize)> =
            match_all(&descriptors, &seen.features[0], &self.config)
                .into_iter()
                .map(|(i, f)| (local[i], f))
                .collect();
        let mut rng = ChaCha8Rng::seed_from_u64(self.config.seed);
        rng.set_stream(frame as u64);
        let T_sampled = sample_pose(
            &self.rig,
            &self.observations(seen, &matches),
            self.config.min_inliers,
            &mut rng,
        )?;
        self.refine(seen, local, T_sampled)
    }

    #[allow(non_snake_case)]
    fn refine(
        &self,
        seen: &Seen,
        local: &[PointId],
        T_rough: Se3,
    ) -> Option<(PoseEstimate, Vec<(PointId, usize)>)> {
        let matches = self.project_and_match(seen, local, &T_rough, 6.0);
        let pose = optimise_pose(&self.rig, &self.observations(seen, &matches), &T_rough);
        (pose.count() >= self.config.min_inliers).then_some((pose, matches))
    }

    #[allow(non_snake_case)]
    fn project_and_match(
        &self,
        seen: &Seen,
        local: &[PointId],
        T_cam_world: &Se3,
        radius: f64,
    ) -> Vec<(PointId, usize)> {
        let (mut ids, mut expected) = (Vec::new(), Vec::new());
        for id in local {
            let point = &self.map.points[id];
            let Some(at) = self.rig.project(&(T_cam_world * point.position)) else {
                continue;
            };
            if (0.0..self.rig.width as f64).contains(&at.u)
                && (0.0..self.rig.height as f64).contains(&at.v)
            {
                ids.push(*id);
                expected.push((
                    point.descriptor,
                    Keypoint {
                        u: at.u,
                        v: at.v,
                        octave: point.octave,
                    },
                ));
            }
        }
        match_projections(
            &expected,
            &seen.features[0],
            &seen.grid,
            radius,
            &self.config,
        )
        .into_iter()
        .map(|(i, feature)| (ids[i], feature))
        .collect()
    }

    fn observations(&self, seen: &Seen, matches: &[(PointId, usize)]) -> Vec<Observation> {
        matches
            .iter()
            .map(|(id, feature)| {
                observation(
                    self.map.points[id].position,
                    &seen.features[0].keypoints[*feature],
                    seen.disparities[*feature],
                )
            })
            .collect()
    }

    /// Notes the pose of a frame relative to the newest key frame.
    #[allow(non_snake_case)]
    fn place(&mut self, time: f64, T_cam_world: Se3) {
        let keyframe = self.map.keyframes.len().saturating_sub(1);
        let T_keyframe_world = self
            .map
            .keyframes
            .last()
            .map_or_else(Se3::identity, |k| k.T_cam_world);
        self.placed.push(Placed {
            time,
            keyframe,
            T_cam_keyframe: T_cam_world * T_keyframe_world.inverse(),
        });
        self.last = Some((T_cam_world, time));
    }

    /// Adds a key frame (Pire 2017, mapping thread; Hong 2021, 3.2.3): dense disparity, stereo
    /// matches gated by it, sightings of known points, new points from the rest, local bundle
    /// adjustment, culling.
    #[allow(non_snake_case)]
    fn insert_keyframe(
        &mut self,
        frame: &StereoFrame,
        seen: Seen,
        T_cam_world: Se3,
        inliers: &[(PointId, usize)],
        report: &mut FrameReport,
    ) -> Result<(), SlamError> {
        report.keyframe = true;
        let mut disparities = seen.disparities;
        if let Some(engine) = &mut self.engine {
            let started = Instant::now();
            let mut dense = engine
                .disparity(&frame.left, &frame.right)
                .map_err(|source| SlamError::Disparity {
                    frame: frame.name.clone(),
                    source,
                })?;
            Rejection {
                max_dissimilarity: self.config.max_dissimilarity,
            }
            .apply(&frame.left, &frame.right, &mut dense);
            report.ms_disparity = started.elapsed().as_secs_f64() * 1e3;
            if self.config.gate {
                let gate = DisparityGate {
                    disparity: &dense.disparity,
                    threshold: self.config.gate_px,
                };
                (disparities, report.matches) = stereo_matches(
                    &seen.features[0],
                    &seen.features[1],
                    [&seen.grey[0], &seen.grey[1]],
                    self.max_disparity(),
                    Some(&gate),
                    &self.config,
                );
            }
            report.dense = Some(dense);
        }

        let keyframe = self.map.keyframes.len();
        let [features, _] = seen.features;
        let count = features.keypoints.len();
        self.map.keyframes.push(Keyframe {
            frame: frame.index,
            name: frame.name.clone(),
            time: frame.time,
            T_cam_world,
            features,
            disparities,
            points: vec![None; count],
        });
        for (id, feature) in inliers {
            self.map.observe(keyframe, *feature, *id);
        }
        self.add_new_points(keyframe, &frame.left);
        self.adjust_locally();
        self.cull(keyframe);
        self.most_inliers = 0;
        self.place(frame.time, self.map.keyframes[keyframe].T_cam_world);
        Ok(())
    }

    /// Features with a disparity that see no known point make new ones.
    #[allow(non_snake_case)]
    fn add_new_points(&mut self, keyframe: usize, left: &Rgb) {
        let frame = &self.map.keyframes[keyframe];
        let T_world_cam = frame.T_cam_world.inverse();
        let new: Vec<(usize, Point3<f64>, [u8; 3])> = frame
            .features
            .keypoints
            .iter()
            .enumerate()
            .filter_map(|(feature, k)| {
                let d = frame.disparities[feature].filter(|d| *d >= self.config.min_disparity)?;
                if frame.points[feature].is_some() {
                    return None;
                }
                let p_cam = self.rig.back_project(StereoPoint { u: k.u, v: k.v, d })?;
                let colour = left.get_pixel_checked(k.u.round() as u32, k.v.round() as u32)?;
                Some((
                    feature,
                    T_world_cam * p_cam,
                    colour.0.map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8),
                ))
            })
            .collect();
        for (feature, position, colour) in new {
            self.map.add_point(keyframe, feature, position, colour);
        }
    }

    /// Bundle adjustment over the last key frames and what they see. Older key frames that see the
    /// same points hold the window in place; where there are none, its oldest does.
    fn adjust_locally(&mut self) {
        let first = self.map.keyframes.len().saturating_sub(self.config.window);
        let ids: Vec<PointId> = self
            .map
            .points_since(first)
            .into_iter()
            .filter(|id| self.map.points[id].observations.len() > 1)
            .collect();
        let mut keyframes: Vec<usize> = ids
            .iter()
            .flat_map(|id| self.map.points[id].observations.iter().map(|(k, _)| *k))
            .collect();
        keyframes.sort_unstable();
        keyframes.dedup();
        let Some(oldest) = keyframes.first().copied() else {
            return;
        };
        let border = oldest < first;
        let mut problem = BundleAdjustment {
            T_cam_world: keyframes
                .iter()
                .map(|k| self.map.keyframes[*k].T_cam_world)
                .collect(),
            fixed: keyframes
                .iter()
                .map(|k| if border { *k < first } else { *k == oldest })
                .collect(),
            points: ids.iter().map(|id| self.map.points[id].position).collect(),
            observations: Vec::new(),
        };
        for (point, id) in ids.iter().enumerate() {
            for (k, feature) in &self.map.points[id].observations {
                // Every key frame of an observation is in the list it was collected from.
                let Ok(pose) = keyframes.binary_search(k) else {
                    continue;
                };
                let frame = &self.map.keyframes[*k];
                let sighting = observation(
                    problem.points[point],
                    &frame.features.keypoints[*feature],
                    frame.disparities[*feature],
                );
                problem.observations.push((pose, point, sighting));
            }
        }
        problem.solve(&self.rig, self.config.ba_iterations);

        for (pose, k) in keyframes.iter().enumerate() {
            self.map.keyframes[*k].T_cam_world = problem.T_cam_world[pose];
        }
        let residuals = problem.squared_residuals(&self.rig);
        for (point, id) in ids.iter().enumerate() {
            if let Some(p) = self.map.points.get_mut(id) {
                p.position = problem.points[point];
            }
        }
        for ((pose, point, o), squared) in problem.observations.iter().zip(residuals) {
            if !o.accepts(squared) {
                self.map.forget(ids[*point], keyframes[*pose]);
            }
        }
    }

    /// Points that no second key frame has seen within three were noise.
    fn cull(&mut self, newest: usize) {
        let Some(due) = newest.checked_sub(3) else {
            return;
        };
        let noise: Vec<PointId> = self.map.keyframes[due]
            .points
            .iter()
            .flatten()
            .copied()
            .filter(|id| {
                self.map
                    .points
                    .get(id)
                    .is_some_and(|p| p.observations.len() < 2)
            })
            .collect();
        for id in noise {
            self.map.remove(id);
        }
    }

    /// A sentence for people.
    fn why_lost(&self, seen: &Seen, what: &str) -> String {
        let pixels = seen.grey[0].as_raw();
        let share = |test: fn(f32) -> bool| {
            100 * pixels.iter().filter(|v| test(**v)).count() / pixels.len().max(1)
        };
        format!(
            "{} features, {} with a stereo match; {what}; {} % of the image is saturated, {} % black",
            seen.features[0].keypoints.len(),
            seen.disparities.iter().flatten().count(),
            share(|v| v > 0.98),
            share(|v| v < 0.02),
        )
    }
}

/// A sighting of a point by a feature.
fn observation(point: Point3<f64>, keypoint: &Keypoint, d: Option<f64>) -> Observation {
    Observation {
        point,
        u: keypoint.u,
        v: keypoint.v,
        d,
        sigma: keypoint.sigma(),
    }
}
