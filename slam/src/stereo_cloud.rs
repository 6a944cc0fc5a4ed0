//! What one stereo pair sees, as a cloud that registration can use (de Jong 2020, 5.1): disparity, depth limits,
//! denoising, a height mask.

use std::time::Instant;

use barchan_datasets::StereoFrame;
use barchan_geometry::{RectifiedRig, Se3, outliers};
use barchan_infer::{DisparityEngine, DisparityMap, Rejection};
use barchan_terrain::{Cloud, DepthLimits, VoxelMap, level};
use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::SlamError;

/// How the camera is mounted, where that is known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mount {
    /// How far its axis points below the horizon, radians (de Jong 2020: pi / 10).
    pub tilt: f64,
    /// Metres above the ground.
    pub height: f64,
}

/// How a pair becomes a cloud.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StereoCloudConfig {
    /// Largest accepted dissimilarity of dense disparity, see `barchan_infer::Rejection`. Default 0.4.
    pub max_dissimilarity: f32,
    /// Points below the ground by more than this are noise, metres; negative is below. Default -0.5.
    pub min_height: f64,
    /// Points farther above the ground than this are sky or noise, metres. Default 2.
    pub max_height: f64,
    /// Neighbours whose distance says whether a point lies alone; 0 keeps all. Default 4, as Matlab's.
    pub outlier_neighbours: usize,
    /// Standard deviations of that distance above its mean that are one too many. Default 1, as Matlab's.
    pub outlier_deviations: f64,
    /// How the camera is mounted. Default: not known, the ground is found in each cloud. The thesis turns
    /// all clouds by one angle, and finds out that the rover did not keep to it (9.2.4).
    pub mount: Option<Mount>,
    /// Which pixels become points. Default as for maps, but every second pixel of every second row, and
    /// depth known to 5 %.
    pub limits: DepthLimits,
}

impl Default for StereoCloudConfig {
    fn default() -> Self {
        Self {
            max_dissimilarity: Rejection::default().max_dissimilarity,
            min_height: -0.5,
            max_height: 2.0,
            outlier_neighbours: 4,
            outlier_deviations: 1.0,
            mount: None,
            limits: DepthLimits {
                stride: 2,
                max_relative_sigma: 0.05,
                ..DepthLimits::default()
            },
        }
    }
}

/// What a pair sees.
pub struct StereoCloud {
    /// Its points, in the frame of the left camera.
    pub cloud: Cloud,
    /// Dense disparity after rejection.
    pub dense: DisparityMap,
    /// Milliseconds of disparity.
    pub ms_disparity: f64,
}

/// Makes clouds of the pairs of one rig.
pub struct StereoClouds {
    rig: RectifiedRig,
    config: StereoCloudConfig,
    engine: Box<dyn DisparityEngine>,
    ground: Option<Ground>,
}

/// Where the ground lies below the camera.
#[derive(Clone, Copy)]
struct Ground {
    /// Its normal, in the frame of the camera.
    up: Vector3<f64>,
    /// Height of the camera, metres.
    camera: f64,
}

impl Ground {
    fn of_mount(mount: &Mount) -> Self {
        Self {
            up: -Vector3::new(0.0, mount.tilt.cos(), mount.tilt.sin()),
            camera: mount.height,
        }
    }

    /// Metres above the ground.
    fn height(&self, p: &Point3<f64>) -> f64 {
        self.camera + self.up.dot(&p.coords)
    }
}

impl StereoClouds {
    /// Clouds of a rig, out of the disparity of an engine.
    pub fn new(
        rig: RectifiedRig,
        config: StereoCloudConfig,
        engine: Box<dyn DisparityEngine>,
    ) -> Self {
        Self {
            ground: config.mount.as_ref().map(Ground::of_mount),
            rig,
            config,
            engine,
        }
    }

    /// The cloud of one pair. It may be empty.
    ///
    /// # Errors
    /// When the frame has not the size of the rig, or the engine fails.
    pub fn cloud(&mut self, frame: &StereoFrame) -> Result<StereoCloud, SlamError> {
        let started = Instant::now();
        let mut dense = self
            .engine
            .disparity(&frame.left, &frame.right)
            .map_err(|source| SlamError::Disparity {
                frame: frame.name.clone(),
                source,
            })?;
        let rejection = Rejection {
            max_dissimilarity: self.config.max_dissimilarity,
        };
        rejection.apply(&frame.left, &frame.right, &mut dense);
        let ms_disparity = started.elapsed().as_secs_f64() * 1e3;
        let mut cloud = Cloud::from_disparity(
            &self.rig,
            &frame.left,
            &dense.disparity,
            Some(&dense.sigma),
            &self.config.limits,
        )
        .map_err(|source| SlamError::Cloud {
            frame: frame.name.clone(),
            source,
        })?;
        self.denoise(&mut cloud);
        self.mask_heights(&mut cloud);
        Ok(StereoCloud {
            cloud,
            dense,
            ms_disparity,
        })
    }

    /// Removes points that lie alone.
    fn denoise(&self, cloud: &mut Cloud) {
        if self.config.outlier_neighbours == 0 {
            return;
        }
        let alone = outliers(
            &positions(cloud),
            self.config.outlier_neighbours,
            self.config.outlier_deviations,
        );
        let mut alone = alone.into_iter();
        cloud.points.retain(|_| !alone.next().unwrap_or(false));
    }

    /// Removes what is below the ground or far above it.
    #[allow(non_snake_case)]
    fn mask_heights(&mut self, cloud: &mut Cloud) {
        if self.config.mount.is_none() {
            let levelled = level(&positions(cloud), &Se3::identity());
            // Where no ground is found, that of the pair before is the best guess.
            if levelled.notice.is_none() {
                let T_level_cam = levelled.T_level_world;
                self.ground = Some(Ground {
                    up: T_level_cam.rotation.inverse() * Vector3::z(),
                    camera: T_level_cam.translation.z,
                });
            }
        }
        if let Some(ground) = self.ground {
            let accepted = self.config.min_height..=self.config.max_height;
            let inside = |p: &Point3<f64>| accepted.contains(&ground.height(p));
            cloud.points.retain(|p| inside(&p.position));
        }
    }
}

/// Where the points of a cloud are.
fn positions(cloud: &Cloud) -> Vec<Point3<f64>> {
    cloud.points.iter().map(|p| p.position).collect()
}

/// The mean of the points in each cube of a grid: the box filter of the thesis, 5.2.
///
/// # Errors
/// When `size` is no length.
pub(crate) fn box_filtered(cloud: &Cloud, size: f64) -> Result<Vec<Point3<f64>>, SlamError> {
    let mut grid = VoxelMap::new(size)?;
    grid.insert(cloud);
    Ok(grid.voxels(1).into_iter().map(|v| v.mean).collect())
}
