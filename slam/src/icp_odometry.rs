//! Odometry by registration of clouds (de Jong 2020, chapter 5): a cloud for each pair, brought onto an earlier
//! one, motions chained, clouds merged.
//!
//! Nothing here corrects an error once made, and on even ground nothing tells of one: seen from a rover, ground looks
//! the same a few metres on, and a cloud brought to the wrong place there fits as well. It is the thesis's baseline, with what it says was missing: planes
//! instead of points, a start at constant velocity, and a word about each frame that went wrong.

use std::time::Instant;

use barchan_datasets::StereoFrame;
use barchan_geometry::registration::{IcpConfig, IcpMethod, Reference, Registration, register};
use barchan_geometry::{RectifiedRig, Se3, StampedPose, Trajectory, se3};
use barchan_infer::{DisparityEngine, DisparityMap};
use barchan_terrain::{Cloud, Voxel, VoxelMap};
use nalgebra::Vector6;
use serde::{Deserialize, Serialize};

use crate::SlamError;
use crate::stereo_cloud::{StereoCloudConfig, StereoClouds, box_filtered};

/// Everything that decides how ICP odometry runs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct IcpOdometryConfig {
    /// Edge of the cubes that clouds are thinned to before registration, metres. Default 0.05; the thesis 0.1.
    pub grid: f64,
    /// Least share of a cloud that must correspond to that of the last key frame. Default 0.85.
    pub min_fitness: f64,
    /// Farthest that registration may lead from where constant velocity puts a frame, metres. Default 0.5.
    pub max_jump: f64,
    /// The same of rotation, degrees. Default 15.
    pub max_jump_deg: f64,
    /// Metres of motion after which a frame is a key frame: the next ones are brought onto it, and its cloud is
    /// merged. Default 0.2. 0 is the thesis's chain from each frame to the next: errors add up the faster, and the noise
    /// of stereo, which stays where it is in the image, makes motions come out too short.
    pub keyframe_distance: f64,
    /// Degrees of rotation after which a frame is a key frame. Default 5.
    pub keyframe_angle_deg: f64,
    /// Edge of the cubes that the map is merged in, metres. Default 0.02.
    pub merge_grid: f64,
    /// How clouds are registered. Default planes with planes, at most 0.3 m apart: clouds of stereo are noisy on
    /// both sides.
    pub registration: IcpConfig,
    /// How a pair becomes a cloud.
    pub cloud: StereoCloudConfig,
}

impl Default for IcpOdometryConfig {
    fn default() -> Self {
        Self {
            grid: 0.05,
            min_fitness: 0.85,
            max_jump: 0.5,
            max_jump_deg: 15.0,
            keyframe_distance: 0.2,
            keyframe_angle_deg: 5.0,
            merge_grid: 0.02,
            registration: IcpConfig {
                method: IcpMethod::Generalised,
                max_distance: 0.3,
                iterations: 30,
                tolerance: 1e-4,
                ..IcpConfig::default()
            },
            cloud: StereoCloudConfig::default(),
        }
    }
}

/// What became of one frame.
#[derive(Clone, Debug, Serialize)]
pub struct IcpReport {
    /// Index in the sequence.
    pub frame: usize,
    /// Name of the frame.
    pub name: String,
    /// Whether its pose is known.
    pub tracked: bool,
    /// Why it is not; empty when it is.
    pub reason: String,
    /// Points of its cloud, thinned.
    pub points: usize,
    /// Those of them that correspond to a point of the last key frame.
    pub inliers: usize,
    /// Share of the points that correspond.
    pub fitness: f64,
    /// Root mean square distance of what corresponds, metres. A small one proves no alignment.
    pub rmse: f64,
    /// See [`Registration::constraint`].
    pub constraint: f64,
    /// Iterations of registration.
    pub iterations: usize,
    /// Whether it became a key frame.
    pub keyframe: bool,
    /// Milliseconds from disparity to pose and map.
    pub ms_track: f64,
    /// Milliseconds of disparity.
    pub ms_disparity: f64,
    /// Dense disparity after rejection. Not serialised.
    #[serde(skip)]
    pub dense: DisparityMap,
}

/// What is left when all frames are through.
#[derive(Clone, Debug)]
pub struct IcpResult {
    /// Every frame in order; a lost one has the pose that was predicted for it.
    pub trajectory: Trajectory,
    /// Frame index, name and pose of each key frame.
    pub keyframes: Vec<(usize, String, StampedPose)>,
    /// The part of the map that each of `keyframes` belongs to. A part begins at a frame that was lost: how
    /// parts lie to each other is a guess.
    pub submaps: Vec<usize>,
    /// The merged clouds of the key frames, in the world: the first left camera.
    pub map: Cloud,
}

/// Chains registrations of clouds.
pub struct IcpOdometry {
    clouds: StereoClouds,
    config: IcpOdometryConfig,
    /// The cloud of the last key frame, and its pose.
    reference: Option<(Reference, Se3)>,
    /// The twist that led to the last frame, in the frame of the one before, and how long it took.
    velocity: Option<(Vector6<f64>, f64)>,
    trajectory: Trajectory,
    keyframes: Vec<(usize, String, StampedPose)>,
    submaps: Vec<usize>,
    map: VoxelMap,
}

impl IcpOdometry {
    /// Odometry for a rig.
    ///
    /// # Errors
    /// When `config` has a grid that is no length.
    pub fn new(
        rig: RectifiedRig,
        config: IcpOdometryConfig,
        engine: Box<dyn DisparityEngine>,
    ) -> Result<Self, SlamError> {
        VoxelMap::new(config.grid)?;
        Ok(Self {
            clouds: StereoClouds::new(rig, config.cloud.clone(), engine),
            map: VoxelMap::new(config.merge_grid)?,
            config,
            reference: None,
            velocity: None,
            trajectory: Trajectory::default(),
            keyframes: vec![],
            submaps: vec![],
        })
    }

    /// Places one frame against the last key frame: its cloud, thinned, is registered from where constant velocity
    /// puts it, and the motion chained to those before; a frame that moved enough becomes a key frame, and is
    /// merged into the map.
    ///
    /// # Errors
    /// When the frame has not the size of the rig, or the engine fails. A frame that cannot be placed is no
    /// error but a report with a reason.
    #[allow(non_snake_case)]
    pub fn track(&mut self, frame: &StereoFrame) -> Result<IcpReport, SlamError> {
        let started = Instant::now();
        let seen = self.clouds.cloud(frame)?;
        let points = box_filtered(&seen.cloud, self.config.grid)?;
        let mut report = IcpReport {
            frame: frame.index,
            name: frame.name.clone(),
            tracked: true,
            reason: String::new(),
            points: points.len(),
            inliers: 0,
            fitness: 0.0,
            rmse: 0.0,
            constraint: 0.0,
            iterations: 0,
            keyframe: false,
            ms_track: 0.0,
            ms_disparity: seen.ms_disparity,
            dense: seen.dense,
        };

        let mut T_world_cam = self.predict(frame.time);
        if let Some((cloud, T_world_ref)) = &self.reference {
            let T_start = T_world_ref.inv_mul(&T_world_cam);
            match register(&points, cloud, &T_start, &self.config.registration) {
                Ok(found) => {
                    report.take(&found);
                    report.reason = self.doubt(&found, &T_start);
                    if report.reason.is_empty() {
                        T_world_cam = T_world_ref * found.T_ref_est;
                        // Poses that start from each other let an error of the norm grow without bound.
                        T_world_cam.rotation.renormalize();
                    }
                }
                Err(why) => report.reason = why.to_string(),
            }
        }
        let placed = report.reason.is_empty();
        self.velocity = self.trajectory.poses.last().filter(|_| placed).map(|last| {
            let motion = last.T_world_cam.inv_mul(&T_world_cam);
            (se3::log(&motion), frame.time - last.time)
        });
        let pose = StampedPose {
            time: frame.time,
            T_world_cam,
        };
        self.trajectory.poses.push(pose);
        let part = self.submaps.last().copied().unwrap_or(0) + usize::from(!placed);
        if self.is_keyframe(&pose, part) {
            match Reference::new(&points) {
                Ok(cloud) => {
                    report.keyframe = true;
                    self.reference = Some((cloud, T_world_cam));
                    self.keyframes.push((frame.index, frame.name.clone(), pose));
                    self.submaps.push(part);
                    self.map.insert(&seen.cloud.transform(&T_world_cam));
                }
                // Too little is seen to go on from: the next frame is brought onto the same key frame.
                Err(why) => report.reason = why.to_string(),
            }
        }
        report.tracked = report.reason.is_empty();
        report.ms_track = started.elapsed().as_secs_f64() * 1e3 - report.ms_disparity;
        Ok(report)
    }

    /// Every frame through.
    pub fn finish(self) -> IcpResult {
        IcpResult {
            trajectory: self.trajectory,
            keyframes: self.keyframes,
            submaps: self.submaps,
            map: Cloud {
                points: self.map.voxels(1).iter().map(Voxel::to_point).collect(),
            },
        }
    }

    /// The last pose moved on by the last velocity, scaled to the time that passed.
    fn predict(&self, time: f64) -> Se3 {
        let Some(last) = self.trajectory.poses.last() else {
            return Se3::identity();
        };
        match self.velocity {
            Some((twist, took)) if took > 0.0 => {
                // Times of field data jump; a rover does not.
                let share = ((time - last.time) / took).clamp(0.0, 2.0);
                last.T_world_cam * se3::exp(&(twist * share))
            }
            _ => last.T_world_cam,
        }
    }

    /// Why a registration is not believed; empty when it is.
    #[allow(non_snake_case)]
    fn doubt(&self, found: &Registration, T_start: &Se3) -> String {
        let IcpOdometryConfig {
            min_fitness,
            max_jump,
            max_jump_deg,
            registration,
            ..
        } = &self.config;
        let jump = T_start.inv_mul(&found.T_ref_est);
        let (far, angle) = (
            jump.translation.vector.norm(),
            jump.rotation.angle().to_degrees(),
        );
        if found.overlap < *min_fitness {
            format!(
                "{:.0} % of its points lie within {} m of the last key frame's, and {:.0} % are asked for",
                100.0 * found.overlap,
                registration.max_distance,
                100.0 * min_fitness
            )
        } else if far > *max_jump || angle > *max_jump_deg {
            format!(
                "registration leads {far:.2} m and {angle:.0} degrees away from where constant velocity puts it, and {max_jump} m and {max_jump_deg} degrees are allowed"
            )
        } else {
            String::new()
        }
    }

    /// Whether a pose is far enough from the last key frame, or in another part of the map.
    fn is_keyframe(&self, pose: &StampedPose, part: usize) -> bool {
        let (Some((_, _, last)), Some(last_part)) = (self.keyframes.last(), self.submaps.last())
        else {
            return true;
        };
        let moved = last.T_world_cam.inv_mul(&pose.T_world_cam);
        part != *last_part
            || moved.translation.vector.norm() >= self.config.keyframe_distance
            || moved.rotation.angle().to_degrees() >= self.config.keyframe_angle_deg
    }
}

impl IcpReport {
    fn take(&mut self, found: &Registration) {
        self.inliers = (found.overlap * self.points as f64).round() as usize;
        self.fitness = found.overlap;
        self.rmse = found.rmse;
        self.constraint = found.constraint;
        self.iterations = found.iterations;
    }
}
