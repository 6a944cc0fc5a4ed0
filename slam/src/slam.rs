//! The whole: frames in, reports and a map out.

use std::sync::Arc;
use std::time::Instant;

use barchan_datasets::{Sensors, StereoFrame};
use barchan_geometry::{RectifiedRig, Se3, StampedPose, Trajectory};
use barchan_infer::{DisparityEngine, DisparityMap, Rejection};
use nalgebra::Matrix6;
use serde::Serialize;

use crate::features::FeatureDetector;
use crate::frame::Seen;
use crate::fusion::{Fusion, FusionCounts, MotionPrior};
use crate::loops::{LoopCloser, LoopEvent};
use crate::map::{Keyframe, Map};
use crate::mapping::insert_keyframe;
use crate::matching::{DisparityGate, MatchCounts};
use crate::tracker::{Placement, Tracker};
use crate::uncertainty::pose_covariances;
use crate::vocabulary::Vocabulary;
use crate::{SlamConfig, SlamError};

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
    /// Index of the frame at whose place the camera was found again, after it was lost.
    pub found_again_at: Option<usize>,
    /// Why it is lost; empty when it is not.
    pub reason: String,
    /// Whether its pose is that of sensors other than the cameras, from the last tracked frame on.
    pub carried: bool,
    /// Whether it became a key frame.
    pub keyframe: bool,
    /// How stereo matches were decided, at key frames.
    pub matches: MatchCounts,
    /// Milliseconds from images to pose and map, without dense disparity.
    pub ms_track: f64,
    /// Milliseconds of dense disparity; 0 where none was asked for.
    pub ms_disparity: f64,
    /// Places that the key frame looked like; a closed loop moved the map.
    pub loops: Vec<LoopEvent>,
    /// Dense disparity after rejection, at key frames when there is an engine. Not serialised.
    #[serde(skip)]
    pub dense: Option<DisparityMap>,
}

/// What is left when all frames are through.
#[derive(Clone, Debug)]
pub struct SlamResult {
    /// Every frame in order; a lost one has the pose that was predicted for it, by sensors where there
    /// are any.
    pub trajectory: Trajectory,
    /// Frame index, name and pose of each key frame that was made of these frames.
    pub keyframes: Vec<(usize, String, StampedPose)>,
    /// Covariance of each of `keyframes` against the first of its part of the map, position and
    /// rotation vector, along the axes of the world; `None` when there is no telling.
    pub covariances: Option<Vec<Matrix6<f64>>>,
    /// The part of the map that each of `keyframes` belongs to. A part begins where the map was begun
    /// anew after the camera was lost: how parts lie to each other is a guess. A loop that joins two
    /// makes them one.
    pub submaps: Vec<usize>,
    /// How many of `keyframes` follow the one before over a gap that only other sensors led over, in
    /// the same part of the map.
    pub joined: usize,
    /// The map, with what was there before.
    pub map: Map,
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
pub struct Slam {
    rig: RectifiedRig,
    config: SlamConfig,
    detector: Box<dyn FeatureDetector>,
    engine: Option<Box<dyn DisparityEngine>>,
    tracker: Tracker,
    map: Map,
    placed: Vec<Placed>,
    /// Key frames of the map that were there before the first frame.
    known: usize,
    /// Most inliers of a frame since the last key frame, that one included.
    most_inliers: usize,
    /// Frames lost in a row.
    lost: usize,
    loops: Option<LoopCloser>,
    /// What other sensors say of the motion.
    prior: Option<MotionPrior>,
}

impl Slam {
    /// SLAM for a rig. Without an engine there is no dense disparity and no gate.
    pub fn new(
        rig: RectifiedRig,
        config: SlamConfig,
        engine: Option<Box<dyn DisparityEngine>>,
    ) -> Self {
        Self {
            detector: config.feature_detector(),
            loops: config.loops.enabled.then(|| {
                LoopCloser::new(rig, config.clone(), Vocabulary::shipped(config.detector))
            }),
            tracker: Tracker::new(rig, config.clone()),
            rig,
            config,
            engine,
            map: Map::default(),
            placed: Vec::new(),
            known: 0,
            most_inliers: 0,
            lost: 0,
            prior: None,
        }
    }

    /// Listens to a rover's other sensors: with an IMU, the fused motion ([`Fusion`]) predicts where
    /// frames are, carries the camera through images that show nothing, and refuses poses that
    /// contradict it. Without one nothing changes. To be called before the first frame.
    pub fn with_sensors(mut self, sensors: &Sensors) -> Self {
        let config = self.config.fusion;
        self.prior = Fusion::new(sensors, config).map(|fusion| MotionPrior::new(fusion, config));
        self
    }

    /// How often other sensors were believed so far, where there are any.
    pub fn fusion_counts(&self) -> Option<FusionCounts> {
        self.prior.as_ref().map(MotionPrior::counts)
    }

    /// Recognises places by these words instead of the shipped ones.
    pub fn with_vocabulary(mut self, words: Vocabulary) -> Self {
        self.loops = (self.config.loops.enabled)
            .then(|| LoopCloser::new(self.rig, self.config.clone(), Arc::new(words)));
        self
    }

    /// Goes on in a map made before, by the same rig and detector: the first frames are looked for in
    /// it. To be called before the first frame; then `with_vocabulary` comes before.
    pub fn with_map(mut self, map: Map) -> Self {
        if let Some(closer) = &mut self.loops {
            closer.learn(&map);
        }
        self.known = map.keyframes.len();
        self.map = map;
        self
    }

    /// Places one frame against the map, and makes it a key frame when matches run low: under a
    /// share of the most since the last key frame (Pire 2017). The first frame with enough stereo
    /// matches is the world; one that comes after many lost ones begins the map anew, or goes on in it
    /// where other sensors know the way over the gap well enough.
    ///
    /// # Errors
    /// When the frame has not the size of the rig, or a detector or the engine fails. A frame that
    /// cannot be placed is no error but a report with a reason.
    #[allow(non_snake_case)]
    pub fn track(&mut self, frame: &StereoFrame) -> Result<FrameReport, SlamError> {
        let started = Instant::now();
        let seen = Seen::new(frame, &self.rig, self.detector.as_ref(), &self.config)?;
        let mut report = FrameReport {
            frame: frame.index,
            name: frame.name.clone(),
            tracked: true,
            inliers: 0,
            found_again_at: None,
            stereo: seen.stereo_count(),
            reason: String::new(),
            carried: false,
            keyframe: false,
            matches: seen.matches,
            ms_track: 0.0,
            ms_disparity: 0.0,
            loops: Vec::new(),
            dense: None,
        };
        let enough_stereo = report.stereo >= self.config.min_inliers;
        let fused = (self.prior.as_mut()).and_then(|prior| prior.predict(frame.time));
        let T_predicted = fused.unwrap_or_else(|| self.tracker.predict(frame.time));
        let guess = Placement {
            T_cam_world: T_predicted,
            sightings: Vec::new(),
            carried: self.prior.as_ref().and_then(MotionPrior::sigma),
        };

        let newest = self.map.keyframes.len().checked_sub(1);
        let local = newest.map_or(vec![], |k| self.map.around(k, self.config.window));
        let placement = (self.tracker).track(&seen, &T_predicted, &self.map, &local);
        let contradicts = (placement.as_ref()).is_some_and(|p| !self.agrees(&seen, p));
        if let Some(placement) = placement.filter(|_| !contradicts) {
            report.inliers = placement.sightings.len();
            self.lost = 0;
            self.most_inliers = self.most_inliers.max(report.inliers);
            self.tracker.moved_to(placement.T_cam_world, frame.time);
            let few = self.config.keyframe_ratio * self.most_inliers as f64;
            if (report.inliers as f64) < few {
                let submap = newest.map_or(0, |k| self.map.keyframes[k].submap);
                self.make_keyframe(frame, seen, &placement, submap, &mut report)?;
            } else {
                self.place(frame.time, placement.T_cam_world);
            }
        } else if newest.is_none() && enough_stereo {
            report.inliers = report.stereo;
            self.tracker.moved_to(T_predicted, frame.time);
            self.count_from(&seen, &guess);
            self.make_keyframe(frame, seen, &guess, 0, &mut report)?;
        } else if let Some((place, placement)) =
            (!contradicts).then(|| self.find_again(&seen)).flatten()
        {
            // What follows is tracked against this place: it is the newest key frame at once.
            let submap = self.map.keyframes[place].submap;
            report.found_again_at = Some(self.map.keyframes[place].frame);
            report.inliers = placement.sightings.len();
            self.lost = 0;
            self.tracker.lost_at(placement.T_cam_world, frame.time);
            self.count_from(&seen, &placement);
            self.make_keyframe(frame, seen, &placement, submap, &mut report)?;
        } else {
            report.tracked = false;
            report.carried = fused.is_some();
            report.reason = seen.describe();
            if contradicts {
                report.reason += "; the motion that they show contradicts the other sensors";
            }
            self.lost += 1;
            self.tracker.lost_at(T_predicted, frame.time);
            if self.lost > self.config.restart_after && enough_stereo {
                self.lost = 0;
                let joined = self.prior.as_ref().is_some_and(MotionPrior::is_sure);
                let parts = self.map.keyframes.iter().map(|k| k.submap + 1);
                let new = parts.max().unwrap_or(0);
                let last = newest.filter(|_| joined);
                let submap = last.map_or(new, |k| self.map.keyframes[k].submap);
                report.reason += match joined {
                    true => "; the map goes on here, where other sensors say",
                    false => "; the map begins anew here, at a pose that is a guess",
                };
                self.count_from(&seen, &guess);
                self.make_keyframe(frame, seen, &guess, submap, &mut report)?;
            } else {
                self.place(frame.time, T_predicted);
            }
        }
        report.ms_track = started.elapsed().as_secs_f64() * 1e3 - report.ms_disparity;
        Ok(report)
    }

    /// Time and pose of the newest frame as they are known now; of a lost one, as predicted. `None` before
    /// the first.
    pub fn pose(&self) -> Option<StampedPose> {
        self.placed.last().map(|p| self.stamped(p))
    }

    /// The pose of a frame, following its key frame as that is now.
    #[allow(non_snake_case)]
    fn stamped(&self, placed: &Placed) -> StampedPose {
        let keyframe = self.map.keyframes.get(placed.keyframe);
        let T_keyframe_world = keyframe.map(|k| k.T_cam_world).unwrap_or_default();
        StampedPose {
            time: placed.time,
            T_world_cam: (placed.T_cam_keyframe * T_keyframe_world).inverse(),
        }
    }

    /// Every frame through: poses of all frames, following their corrected key frames.
    pub fn finish(self) -> SlamResult {
        let keyframe = |k: &Keyframe| {
            let pose = StampedPose {
                time: k.time,
                T_world_cam: k.T_cam_world.inverse(),
            };
            (k.frame, k.name.clone(), pose)
        };
        let new = &self.map.keyframes[self.known..];
        let loops = self.loops.as_ref().map_or(&[][..], LoopCloser::edges);
        SlamResult {
            covariances: pose_covariances(&self.map, loops, &self.rig, &self.config)
                .map(|all| all[self.known..].to_vec()),
            trajectory: Trajectory {
                poses: self.placed.iter().map(|p| self.stamped(p)).collect(),
            },
            keyframes: new.iter().map(keyframe).collect(),
            submaps: new.iter().map(|k| k.submap).collect(),
            joined: (new.windows(2))
                .filter(|pair| pair[1].carried.is_some() && pair[0].submap == pair[1].submap)
                .count(),
            map: self.map,
        }
    }

    /// Where a lost camera is, if it sees a place that the map has: the key frame of that place, and
    /// the pose.
    fn find_again(&self, seen: &Seen) -> Option<(usize, Placement)> {
        let places = self
            .loops
            .as_ref()?
            .likeliest(&seen.features[0].descriptors);
        places.into_iter().find_map(|place| {
            let local = self.map.around(place, self.config.window);
            let placement = self.tracker.track_by_looks(seen, &self.map, &local)?;
            Some((place, placement))
        })
    }

    /// Whether the pose of a placement is one that other sensors can believe. If so, motions are
    /// counted from it on.
    fn agrees(&mut self, seen: &Seen, placement: &Placement) -> bool {
        let Some(prior) = &mut self.prior else {
            return true;
        };
        let covariance = self.tracker.covariance(seen, &self.map, placement);
        let agrees = prior.agrees(&placement.T_cam_world, &covariance);
        if agrees {
            prior.placed(placement.T_cam_world, covariance);
        }
        agrees
    }

    /// Other sensors count motions from this placement on, whatever they think of it.
    fn count_from(&mut self, seen: &Seen, placement: &Placement) {
        if let Some(prior) = &mut self.prior {
            let covariance = self.tracker.covariance(seen, &self.map, placement);
            prior.placed(placement.T_cam_world, covariance);
        }
    }

    /// Dense disparity of the frame, stereo matches gated by it (Hong 2021, 3.2.3), and the frame
    /// into the map.
    fn make_keyframe(
        &mut self,
        frame: &StereoFrame,
        mut seen: Seen,
        placement: &Placement,
        submap: usize,
        report: &mut FrameReport,
    ) -> Result<(), SlamError> {
        report.keyframe = true;
        report.dense = self.dense_disparity(frame, report)?;
        if let Some(dense) = report.dense.as_ref().filter(|_| self.config.gate) {
            let gate = DisparityGate {
                disparity: &dense.disparity,
                threshold: self.config.gate_px,
            };
            seen.match_stereo(&self.rig, Some(&gate), &self.config);
            report.matches = seen.matches;
        }
        let keyframe = self.map.keyframes.len();
        insert_keyframe(
            &mut self.map,
            frame,
            seen,
            placement,
            submap,
            &self.rig,
            &self.config,
        );
        if let Some(closer) = &mut self.loops {
            let dense = report.dense.as_ref().map(|d| &d.disparity);
            report.loops = closer.close(&mut self.map, dense);
        }
        self.most_inliers = report.inliers;
        let settled = self.map.keyframes[keyframe].T_cam_world;
        self.tracker.corrected_to(settled);
        if let Some(prior) = &mut self.prior {
            prior.corrected_to(settled);
        }
        self.place(frame.time, settled);
        Ok(())
    }

    /// Dense disparity less what the pair itself contradicts; `None` without an engine.
    fn dense_disparity(
        &mut self,
        frame: &StereoFrame,
        report: &mut FrameReport,
    ) -> Result<Option<DisparityMap>, SlamError> {
        let Some(engine) = &mut self.engine else {
            return Ok(None);
        };
        let started = Instant::now();
        let mut dense = engine
            .disparity(&frame.left, &frame.right)
            .map_err(|source| SlamError::Disparity {
                frame: frame.name.clone(),
                source,
            })?;
        let rejection = Rejection {
            max_dissimilarity: self.config.max_dissimilarity,
        };
        rejection.apply(&frame.left, &frame.right, &mut dense);
        report.ms_disparity = started.elapsed().as_secs_f64() * 1e3;
        Ok(Some(dense))
    }

    /// Notes the pose of a frame relative to the newest key frame.
    #[allow(non_snake_case)]
    fn place(&mut self, time: f64, T_cam_world: Se3) {
        let T_keyframe_world = self.map.keyframes.last().map(|k| k.T_cam_world);
        self.placed.push(Placed {
            time,
            keyframe: self.map.keyframes.len().saturating_sub(1),
            T_cam_keyframe: T_cam_world * T_keyframe_world.unwrap_or_default().inverse(),
        });
    }
}
