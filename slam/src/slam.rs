//! The whole: frames in, reports and a map out.

use std::sync::Arc;
use std::time::Instant;

use barchan_datasets::{Sensors, StereoFrame};
use barchan_geometry::{RectifiedRig, Se3, StampedPose, Trajectory, se3};
use barchan_infer::DisparityEngine;
use nalgebra::Matrix6;
use serde::Serialize;

use crate::features::FeatureDetector;
use crate::frame::Seen;
use crate::fusion::{Fusion, FusionCounts, MotionPrior};
use crate::local_map::LocalMap;
use crate::loops::{LoopCloser, Way};
use crate::map::{Keyframe, Map};
use crate::mapping::{Candidate, Mapped, Mapper, Mapping, Settled, adjust_all};
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
    /// Milliseconds from images to pose, with what it waited for the map.
    pub ms_track: f64,
    /// Key frames that are through meanwhile: this one, or ones before. Not serialised.
    #[serde(skip)]
    pub mapped: Vec<Mapped>,
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

/// Where a frame should be, before its images were looked at.
#[allow(non_snake_case)]
struct Prediction {
    T_cam_world: Se3,
    /// Whether sensors other than the cameras say so.
    by_sensors: bool,
}

/// Tracks a sequence and builds its map.
///
/// A key frame comes into the map in a thread of its own, while the next
/// [`SlamConfig::map_lag`] frames are tracked in the map as it was; then, or when that does not do, it is
/// waited for. What its dense disparity says comes into the map before the next key frame. So what a frame is tracked
/// against depends on the images and not on the clock.
pub struct Slam {
    rig: RectifiedRig,
    config: SlamConfig,
    detector: Box<dyn FeatureDetector>,
    tracker: Tracker,
    mapping: Mapping,
    /// What frames are tracked against; `None` before the first key frame.
    local: Option<LocalMap>,
    placed: Vec<Placed>,
    /// Time and pose of the newest frame.
    latest: Option<StampedPose>,
    /// Key frames of the map that were there before the first frame.
    known: usize,
    /// Most inliers of a frame since the last key frame, that one included.
    most_inliers: usize,
    /// Frames since the last key frame.
    since_keyframe: usize,
    /// Frames lost in a row.
    lost: usize,
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
        let words = Vocabulary::shipped(config.detector);
        let loops = (config.loops.enabled).then(|| LoopCloser::new(rig, config.clone(), words));
        Self {
            detector: config.feature_detector(),
            tracker: Tracker::new(rig, config.clone()),
            mapping: Mapping::new(Mapper::new(rig, config.clone(), engine, loops)),
            rig,
            config,
            local: None,
            placed: Vec::new(),
            latest: None,
            known: 0,
            most_inliers: 0,
            since_keyframe: 0,
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
    pub fn with_vocabulary(self, words: Vocabulary) -> Self {
        let closer = LoopCloser::new(self.rig, self.config.clone(), Arc::new(words));
        self.mapping.mapper().loops = self.config.loops.enabled.then_some(closer);
        self
    }

    /// Ends without the bundle adjustment of the whole map (`adjust_all`), whose time grows with the cube of the key
    /// frames that see the same points.
    pub fn without_last_adjustment(mut self) -> Self {
        self.config.adjust_all = false;
        self
    }

    /// Goes on in a map made before, by the same rig and detector: the first frames are looked for in
    /// it. To be called before the first frame; then `with_vocabulary` comes before.
    pub fn with_map(mut self, map: Map) -> Self {
        let mut mapper = self.mapping.mapper();
        if let Some(closer) = &mut mapper.loops {
            closer.learn(&map);
        }
        mapper.map = map;
        self.known = mapper.map.keyframes.len();
        drop(mapper);
        self.local = self.newest_local_map();
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
    pub fn track(&mut self, frame: StereoFrame) -> Result<FrameReport, SlamError> {
        let started = Instant::now();
        let seen = Seen::new(&frame, &self.rig, self.detector.as_ref(), &self.config)?;
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
            ms_track: 0.0,
            mapped: Vec::new(),
        };
        let mappable = seen.mappable_count(&self.rig, &self.config);
        let enough_stereo = report.stereo >= self.config.min_inliers;
        if self.since_keyframe >= self.config.map_lag {
            report.mapped.extend(self.settle_map()?);
        }
        let mut prediction = self.predict(frame.time);
        let mut placement = self.place_near(&seen, &prediction);
        let does = |p: &Placement| !self.runs_low(p.sightings.len(), mappable);
        if self.mapping.is_busy() && !placement.as_ref().is_some_and(does) {
            report.mapped.extend(self.settle_map()?);
            prediction = self.predict(frame.time);
            placement = self.place_near(&seen, &prediction);
        }
        let time = frame.time;
        let T_predicted = prediction.T_cam_world;
        let guess = Placement {
            T_cam_world: T_predicted,
            sightings: Vec::new(),
            carried: self.prior.as_ref().and_then(MotionPrior::sigma),
        };

        let contradicts = (placement.as_ref()).is_some_and(|p| !self.agrees(&seen, p));
        let here = self.local.as_ref().map(|local| local.submap);
        self.since_keyframe += 1;
        if let Some(placement) = placement.filter(|_| !contradicts) {
            report.inliers = placement.sightings.len();
            self.lost = 0;
            self.most_inliers = self.most_inliers.max(report.inliers);
            self.tracker.moved_to(placement.T_cam_world, time);
            if self.runs_low(report.inliers, mappable) {
                let submap = here.unwrap_or(0);
                self.make_keyframe(frame, seen, placement, submap, None, &mut report)?;
            } else {
                self.place(time, placement.T_cam_world);
            }
        } else if here.is_none() && enough_stereo {
            report.inliers = report.stereo;
            self.tracker.moved_to(T_predicted, time);
            self.count_from(&seen, &guess);
            self.make_keyframe(frame, seen, guess, 0, None, &mut report)?;
        } else if let Some(found) = (!contradicts).then(|| self.find_again(&seen)).flatten() {
            let (local, placement) = found;
            report.found_again_at = Some(self.mapping.mapper().map.keyframes[local.keyframe].frame);
            report.inliers = placement.sightings.len();
            let way = self.way_to(&local, &prediction);
            let submap = local.submap;
            // What follows is tracked against this place.
            self.local = Some(local);
            self.lost = 0;
            self.tracker.set_down_at(placement.T_cam_world, time);
            self.count_from(&seen, &placement);
            self.make_keyframe(frame, seen, placement, submap, way, &mut report)?;
        } else {
            report.tracked = false;
            report.carried = prediction.by_sensors;
            report.reason = seen.describe();
            if contradicts {
                report.reason += "; the motion that they show contradicts the other sensors";
            }
            self.lost += 1;
            self.tracker.moved_to(T_predicted, time);
            if self.lost > self.config.restart_after && enough_stereo {
                self.lost = 0;
                let joined = self.prior.as_ref().is_some_and(MotionPrior::is_sure);
                let submap = here.filter(|_| joined).unwrap_or_else(|| self.new_submap());
                report.reason += match joined {
                    true => "; the map goes on here, where other sensors say",
                    false => "; the map begins anew here, at a pose that is a guess",
                };
                self.count_from(&seen, &guess);
                self.make_keyframe(frame, seen, guess, submap, None, &mut report)?;
            } else {
                self.place(time, T_predicted);
            }
        }
        report.ms_track = started.elapsed().as_secs_f64() * 1e3;
        Ok(report)
    }

    /// Waits until all key frames are in the map with what their dense disparity says; tracking goes on in what is
    /// around the newest. To be called after the last frame.
    ///
    /// # Errors
    /// When the engine fails.
    pub fn settle(&mut self) -> Result<Vec<Mapped>, SlamError> {
        let before = self.mapping.settle()?;
        let newest = self.mapping.complete()?;
        let settled = before.into_iter().chain([newest]);
        let mapped = settled.filter_map(|s| self.follow(s)).collect();
        self.local = self.newest_local_map();
        Ok(mapped)
    }

    /// Waits until the key frame in hand, if there is one, is in the map; the one before it is through then.
    fn settle_map(&mut self) -> Result<Option<Mapped>, SlamError> {
        let Some(settled) = self.mapping.settle()? else {
            return Ok(None);
        };
        let mapped = self.follow(settled);
        self.local = self.newest_local_map();
        Ok(mapped)
    }

    /// What moves with the map under it.
    #[allow(non_snake_case)]
    fn follow(&mut self, settled: Settled) -> Option<Mapped> {
        let Settled { mapped, T_old_new } = settled;
        self.tracker.map_moved(&T_old_new);
        if let Some(prior) = &mut self.prior {
            prior.map_moved(&T_old_new);
        }
        if let Some(latest) = &mut self.latest {
            latest.T_world_cam = T_old_new.inverse() * latest.T_world_cam;
        }
        mapped
    }

    /// Time and pose of the newest frame as they are known now; of a lost one, as predicted. `None` before
    /// the first.
    pub fn pose(&self) -> Option<StampedPose> {
        self.latest
    }

    /// Every frame through: poses of all frames, following their corrected key frames. What
    /// [`Slam::settle`] would say of the last key frames is not heard.
    #[allow(non_snake_case)]
    pub fn finish(mut self) -> SlamResult {
        // What failed is not in the map.
        let _ = self.settle();
        let mut mapper = self.mapping.mapper();
        let mut map = std::mem::take(&mut mapper.map);
        if self.config.adjust_all {
            adjust_all(&mut map, &self.rig, &self.config);
        }
        let keyframe = |k: &Keyframe| {
            let pose = StampedPose {
                time: k.time,
                T_world_cam: k.T_cam_world.inverse(),
            };
            (k.frame, k.name.clone(), pose)
        };
        let stamped = |placed: &Placed| {
            let keyframe = map.keyframes.get(placed.keyframe);
            let T_keyframe_world = keyframe.map(|k| k.T_cam_world).unwrap_or_default();
            StampedPose {
                time: placed.time,
                T_world_cam: (placed.T_cam_keyframe * T_keyframe_world).inverse(),
            }
        };
        let new = &map.keyframes[self.known..];
        let loops = mapper.loops.as_ref().map_or(&[][..], LoopCloser::edges);
        SlamResult {
            covariances: pose_covariances(&map, loops, &self.rig, &self.config)
                .map(|all| all[self.known..].to_vec()),
            trajectory: Trajectory {
                poses: self.placed.iter().map(stamped).collect(),
            },
            keyframes: new.iter().map(keyframe).collect(),
            submaps: new.iter().map(|k| k.submap).collect(),
            joined: (new.windows(2))
                .filter(|pair| pair[1].carried.is_some() && pair[0].submap == pair[1].submap)
                .count(),
            map,
        }
    }

    /// Where the next frame should be: as other sensors say, or as the camera moved till now.
    #[allow(non_snake_case)]
    fn predict(&mut self, time: f64) -> Prediction {
        let fused = (self.prior.as_mut()).and_then(|prior| prior.predict(time));
        let mut T_cam_world = fused.unwrap_or_else(|| self.tracker.predict(time));
        // Poses that start from each other let an error of the norm grow without bound.
        T_cam_world.rotation.renormalize();
        Prediction {
            T_cam_world,
            by_sensors: fused.is_some(),
        }
    }

    /// Where a frame is in the local map.
    fn place_near(&self, seen: &Seen, prediction: &Prediction) -> Option<Placement> {
        let local = self.local.as_ref()?;
        self.tracker.track(seen, &prediction.T_cam_world, local)
    }

    /// Whether so few inliers want a key frame: few beside the most since the last one, or among all that
    /// the frame could map.
    fn runs_low(&self, inliers: usize, mappable: usize) -> bool {
        let most = self.most_inliers.max(inliers) as f64;
        let inliers = inliers as f64;
        inliers < self.config.keyframe_ratio * most
            || inliers < self.config.keyframe_share * mappable as f64
    }

    /// The surroundings of the newest key frame.
    fn newest_local_map(&self) -> Option<LocalMap> {
        let map = &self.mapping.mapper().map;
        let newest = map.keyframes.len().checked_sub(1)?;
        Some(LocalMap::around(map, newest, self.config.window))
    }

    /// The number of a new part of the map.
    fn new_submap(&self) -> usize {
        let mapper = self.mapping.mapper();
        let parts = mapper.map.keyframes.iter().map(|k| k.submap + 1);
        parts.max().unwrap_or(0)
    }

    /// Where a lost camera is, if it sees a place that the map has.
    fn find_again(&self, seen: &Seen) -> Option<(LocalMap, Placement)> {
        let mapper = self.mapping.mapper();
        let closer = mapper.loops.as_ref()?;
        let places = closer.likeliest(&seen.features[0].descriptors);
        places.into_iter().find_map(|place| {
            let local = LocalMap::around(&mapper.map, place, self.config.window);
            let placement = self.tracker.track_by_looks(seen, &local)?;
            Some((local, placement))
        })
    }

    /// The way to a place where the lost camera is found again: as other sensors say, or as it moved
    /// before, were the place in the same part of the map.
    #[allow(non_snake_case)]
    fn way_to(&self, place: &LocalMap, prediction: &Prediction) -> Option<Way> {
        /// What is not known of a motion that nobody saw, as a share of it, and at least.
        const SHARE: f64 = 0.3;
        const LEAST: (f64, f64) = (0.02, 0.01);
        let before = self.local.as_ref()?;
        let T_keyframe_cam = before.T_keyframe_world * prediction.T_cam_world.inverse();
        let sensed = self.prior.as_ref().and_then(MotionPrior::sigma);
        let sigma = sensed.or_else(|| {
            let twist = se3::log(&T_keyframe_cam);
            let (way, turn) = (
                twist.fixed_rows::<3>(0).norm(),
                twist.fixed_rows::<3>(3).norm(),
            );
            (before.submap == place.submap)
                .then_some((LEAST.0 + SHARE * way, LEAST.1 + SHARE * turn))
        });
        sigma.map(|sigma| Way {
            place: place.keyframe,
            T_keyframe_cam,
            sigma,
        })
    }

    /// Whether the pose of a placement is one that other sensors can believe. If so, motions are
    /// counted from it on.
    fn agrees(&mut self, seen: &Seen, placement: &Placement) -> bool {
        let (Some(prior), Some(local)) = (&mut self.prior, &self.local) else {
            return true;
        };
        let covariance = self.tracker.covariance(seen, local, placement);
        let agrees = prior.agrees(&placement.T_cam_world, &covariance);
        if agrees {
            prior.placed(placement.T_cam_world, covariance);
        }
        agrees
    }

    /// Other sensors count motions from this placement on, whatever they think of it.
    fn count_from(&mut self, seen: &Seen, placement: &Placement) {
        if let Some(prior) = &mut self.prior {
            // Without a map there are no sightings, and the pose is what it is by definition.
            let covariance = (self.local.as_ref()).map_or_else(Matrix6::zeros, |local| {
                self.tracker.covariance(seen, local, placement)
            });
            prior.placed(placement.T_cam_world, covariance);
        }
    }

    /// Has the frame put into the map, and waits for it when no frame may be tracked meanwhile.
    fn make_keyframe(
        &mut self,
        frame: StereoFrame,
        seen: Seen,
        placement: Placement,
        submap: usize,
        way: Option<Way>,
        report: &mut FrameReport,
    ) -> Result<(), SlamError> {
        if self.mapping.is_busy() {
            // The pose is a guess: it was placed, but other sensors contradict.
            report.mapped.extend(self.settle_map()?);
        }
        report.keyframe = true;
        self.most_inliers = report.inliers;
        self.since_keyframe = 0;
        self.placed.push(Placed {
            time: frame.time,
            keyframe: self.mapping.mapper().map.keyframes.len(),
            T_cam_keyframe: Se3::identity(),
        });
        self.latest = Some(StampedPose {
            time: frame.time,
            T_world_cam: placement.T_cam_world.inverse(),
        });
        self.mapping.begin(Candidate {
            frame,
            seen,
            placement,
            submap,
            way,
        });
        if self.config.map_lag == 0 {
            report.mapped.extend(self.settle()?);
        }
        Ok(())
    }

    /// Notes the pose of a frame relative to the key frame that it is tracked against.
    #[allow(non_snake_case)]
    fn place(&mut self, time: f64, T_cam_world: Se3) {
        let local = self.local.as_ref();
        let T_keyframe_world = local.map(|l| l.T_keyframe_world).unwrap_or_default();
        self.placed.push(Placed {
            time,
            keyframe: local.map_or(0, |l| l.keyframe),
            T_cam_keyframe: T_cam_world * T_keyframe_world.inverse(),
        });
        self.latest = Some(StampedPose {
            time,
            T_world_cam: T_cam_world.inverse(),
        });
    }
}
