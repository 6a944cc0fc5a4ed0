use barchan_datasets::{Plane, Rgb};
use barchan_geometry::{RectifiedRig, Se3};
use nalgebra::{Matrix6, Point3};
use serde::{Deserialize, Serialize};

use crate::elevation::{ElevationConfig, ElevationMap, Scan, SensorModel};
use crate::error::positive;
use crate::raster::dem;
use crate::{
    CellStatistic, Cloud, Dem, DepthLimits, Light, Raster, TerrainError, Voxel, VoxelMap,
    hillshade, level,
};

/// A key frame whose disparity is known.
#[derive(Clone, Debug)]
#[allow(non_snake_case)]
pub struct DenseKeyframe {
    /// Seconds.
    pub time: f64,
    /// Maps points of the left camera frame to the world.
    pub T_world_cam: Se3,
    /// Covariance of that pose, of its position and of its rotation vector, both about the axes of the
    /// world; `None` where nobody knows.
    pub pose_covariance: Option<Matrix6<f64>>,
    /// The left image, which gives the colours.
    pub left: Rgb,
    /// Disparity of the left image, pixels; NaN is unknown.
    pub disparity: Plane,
    /// Standard deviation of the disparity, pixels, when the engine knows it.
    pub sigma: Option<Plane>,
}

/// What "up" is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Levelling {
    /// The normal of the ground, see [`level()`].
    #[default]
    Ground,
    /// The z axis of the world: poses are gravity-aligned already. Nothing is moved.
    World,
    /// This motion, which maps the world to a frame whose z is up: the run was aligned to something.
    Known(Se3),
}

/// How key frames become terrain.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MapConfig {
    /// Edge of a voxel, metres. Default: twice the size of a pixel on the ground, or the deviation of
    /// depth if that is larger, at the median depth of the first key frame, rounded to 1, 2 or 5 times
    /// a power of ten (0.02 m for a rover 0.3 m high; 0.1 m for a car).
    pub voxel: Option<f64>,
    /// Fewest points of a voxel that is kept. Default 2.
    pub min_points: u32,
    /// Edge of a cell of the DEM, metres. Default: twice the voxel, rounded likewise.
    pub cell: Option<f64>,
    /// How the points of a cell make its elevation. Default: their mean.
    pub statistic: CellStatistic,
    /// Which pixels become points.
    pub limits: DepthLimits,
    /// What "up" is. Default: the normal of the ground.
    pub levelling: Levelling,
    /// The light of the hillshade.
    pub light: Light,
    /// Most cells of the DEM. Default 25 million, 100 MB.
    pub max_cells: usize,
}

impl Default for MapConfig {
    fn default() -> Self {
        Self {
            voxel: None,
            min_points: 2,
            cell: None,
            statistic: CellStatistic::default(),
            limits: DepthLimits::default(),
            levelling: Levelling::default(),
            light: Light::default(),
            max_cells: 25_000_000,
        }
    }
}

/// The terrain of a traverse, in its levelled frame.
#[derive(Clone, Debug)]
#[allow(non_snake_case)]
pub struct TerrainMap {
    /// Voxels of enough points, in a fixed order.
    pub voxels: Vec<Voxel>,
    /// Elevation, count and spread.
    pub dem: Dem,
    /// The DEM, shaded.
    pub hillshade: Raster<u8>,
    /// Maps points of the world to the frame of all the above: z up.
    pub T_level_world: Se3,
    /// Key frames used.
    pub keyframes: usize,
    /// Points that went into voxels.
    pub points: usize,
    /// Edge of a voxel, metres, as used.
    pub voxel: f64,
    /// Edge of a cell, metres, as used.
    pub cell: f64,
    /// What the user should know: a guess that was made, points left out.
    pub notices: Vec<String>,
}

impl TerrainMap {
    /// The voxels as a cloud of coloured points.
    pub fn cloud(&self) -> Cloud {
        Cloud {
            points: self.voxels.iter().map(Voxel::to_point).collect(),
        }
    }
}

/// Makes terrain of key frames, one at a time (Hong 2021, 3.2.2): every pixel of known disparity is
/// re-projected (eq. 6) and put into the world by its key frame's pose (eq. 7); voxels gather what
/// falls into the same place and drop what is seen too seldom; the ground is levelled; cells of a grid
/// take the elevation of their voxels.
///
/// `keyframes` may come from an engine that runs while this function pulls: its error ends the map.
///
/// # Errors
/// The first error of `keyframes`; when images and rig differ in size, a setting makes no sense, no
/// point is left, or the grid would be absurdly large.
pub fn map_keyframes<E: From<TerrainError>>(
    keyframes: impl IntoIterator<Item = Result<DenseKeyframe, E>>,
    rig: &RectifiedRig,
    config: &MapConfig,
) -> Result<TerrainMap, E> {
    if let Some(cell) = config.cell {
        positive("cell", cell)?;
    }
    let mut map = config.voxel.map(VoxelMap::new).transpose()?;
    let mut first_pose = None;
    let (mut count, mut points) = (0, 0);
    for keyframe in keyframes {
        let k = keyframe?;
        let cloud =
            Cloud::from_disparity(rig, &k.left, &k.disparity, k.sigma.as_ref(), &config.limits)?;
        first_pose.get_or_insert(k.T_world_cam);
        count += 1;
        points += cloud.points.len();
        if cloud.points.is_empty() {
            continue;
        }
        let map = match &mut map {
            Some(map) => map,
            none => none.insert(VoxelMap::new(suitable_voxel(
                rig,
                &cloud,
                config.limits.stride,
            ))?),
        };
        map.insert(&cloud.transform(&k.T_world_cam));
    }

    let (Some(map), Some(first_pose)) = (map.filter(|m| !m.is_empty()), first_pose) else {
        return Err(nothing(count, config).into());
    };
    let mut notices = Vec::new();
    let mut voxels = map.voxels(config.min_points);
    if voxels.len() < map.len() {
        let dropped = map.len() - voxels.len();
        notices.push(format!(
            "{dropped} of {} voxels ({:.0} %) held fewer than {} points and were left out as noise",
            map.len(),
            100.0 * dropped as f64 / map.len() as f64,
            config.min_points
        ));
    }
    if voxels.is_empty() {
        return Err(TerrainError::Empty(format!(
            "none of {} voxels of {} m holds {} points\n  cure: larger voxels, or fewer points asked of each",
            map.len(),
            map.size(),
            config.min_points
        ))
        .into());
    }

    let levelled = match config.levelling {
        Levelling::Ground => {
            let positions: Vec<Point3<f64>> = voxels.iter().map(|v| v.mean).collect();
            let levelled = level(&positions, &first_pose);
            notices.extend(levelled.notice);
            levelled.T_level_world
        }
        Levelling::World => Se3::identity(),
        Levelling::Known(known) => known,
    };
    for v in &mut voxels {
        v.mean = levelled * v.mean;
    }

    let cell = config
        .cell
        .unwrap_or_else(|| round_to_125(2.0 * map.size()));
    let dem = dem(&voxels, cell, config.statistic, config.max_cells)?;
    if dem.outliers > 0 {
        notices.push(format!(
            "{} points far outside the others were left out of the DEM",
            dem.outliers
        ));
    }
    Ok(TerrainMap {
        hillshade: hillshade(&dem.raster, &config.light),
        dem,
        T_level_world: levelled,
        keyframes: count,
        points,
        voxel: map.size(),
        cell,
        voxels,
        notices,
    })
}

/// How the sensor of key frames may be off, where their disparity does not say it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StereoErrors {
    /// Deviation of where in the image a disparity belongs, pixels. Default 1: matching looks at
    /// windows.
    pub pixel: f64,
    /// Deviation of the disparity's error that all looks at a place share, pixels. Default 0.1: a
    /// calibration, and a preference of matching for some fractions of a pixel.
    pub systematic: f64,
    /// Share of the stated variance of disparity that all looks share. Default 1, all of it: what
    /// matching gets wrong at a place it gets wrong from a metre on as well.
    pub shared: f64,
}

impl Default for StereoErrors {
    fn default() -> Self {
        Self {
            pixel: 1.0,
            systematic: 0.1,
            shared: 1.0,
        }
    }
}

impl StereoErrors {
    /// The sensor model of a rig that errs so.
    pub fn sensor(&self, rig: &RectifiedRig) -> SensorModel {
        SensorModel::Stereo {
            focal: rig.fx,
            baseline: rig.baseline,
            pixel: self.pixel,
            systematic: self.systematic,
            shared: self.shared,
        }
    }
}

/// Makes an elevation map of key frames, one at a time, in the frame that `T_level_world` maps the world
/// to (see [`TerrainMap::T_level_world`]): sigma of the disparity -> by `sensor` ([`StereoErrors::sensor`],
/// [`NoiseModel::sensor`](crate::NoiseModel::sensor)) covariance of points -> with that of the pose -> variance of
/// heights ([`ElevationMap::add`]). With `clear_ghosts` what a key frame sees
/// through is removed ([`ElevationMap::clear_ghosts`]).
///
/// # Errors
/// The first error of `keyframes`; when images and rig differ in size, a setting makes no sense, or
/// the map would be absurdly large.
#[allow(non_snake_case)]
pub fn elevation_of_keyframes<E: From<TerrainError>>(
    keyframes: impl IntoIterator<Item = Result<DenseKeyframe, E>>,
    rig: &RectifiedRig,
    T_level_world: &Se3,
    limits: &DepthLimits,
    sensor: SensorModel,
    clear_ghosts: bool,
    config: &ElevationConfig,
) -> Result<ElevationMap, E> {
    // How the levelled frame's axes lie to the world's, for shift and rotation alike.
    let rotation = T_level_world.rotation.to_rotation_matrix();
    let mut turn = Matrix6::zeros();
    turn.fixed_view_mut::<3, 3>(0, 0)
        .copy_from(rotation.matrix());
    turn.fixed_view_mut::<3, 3>(3, 3)
        .copy_from(rotation.matrix());
    let mut map = ElevationMap::new(*config)?;
    for keyframe in keyframes {
        let k = keyframe?;
        let cloud = Cloud::from_disparity(rig, &k.left, &k.disparity, k.sigma.as_ref(), limits)?;
        map.add_growing(&Scan {
            cloud: &cloud,
            T_map_sensor: T_level_world * k.T_world_cam,
            pose_covariance: k.pose_covariance.map(|c| turn * c * turn.transpose()),
            sensor,
            time: k.time,
        })?;
        if clear_ghosts {
            map.clear_ghosts(k.time);
        }
    }
    Ok(map)
}

/// See [`MapConfig::voxel`].
fn suitable_voxel(rig: &RectifiedRig, cloud: &Cloud, stride: usize) -> f64 {
    let median = |mut values: Vec<f64>| {
        let middle = values.len() / 2;
        *values.select_nth_unstable_by(middle, f64::total_cmp).1
    };
    let depth = median(cloud.points.iter().map(|p| p.position.z).collect());
    let deviation = median(cloud.points.iter().map(|p| f64::from(p.sigma)).collect());
    round_to_125((2.0 * stride as f64 * depth / rig.fx).max(deviation))
}

/// The nearest, as a ratio, of 1, 2 and 5 times a power of ten.
fn round_to_125(value: f64) -> f64 {
    let power = 10f64.powf(value.log10().floor());
    let mantissa = value / power;
    let nearest = [1.0, 2.0, 5.0, 10.0].into_iter().min_by(|a: &f64, b| {
        (mantissa / a)
            .ln()
            .abs()
            .total_cmp(&(mantissa / b).ln().abs())
    });
    nearest.unwrap_or(1.0) * power
}

fn nothing(keyframes: usize, config: &MapConfig) -> TerrainError {
    TerrainError::Empty(if keyframes == 0 {
        "there are no key frames".into()
    } else {
        format!(
            "none of {keyframes} key frames has a pixel that passes the depth limits {:?}\n  \
             cure: look at the disparity (barchan infer), or loosen the limits",
            config.limits
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::tests::{chequered, rig};
    use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

    /// A camera `height` above z = 0 at (x, y), looking along +x, pitched down.
    fn pose(x: f64, y: f64, height: f64, pitch: f64) -> Se3 {
        let (c, s) = (pitch.cos(), pitch.sin());
        let axes = Matrix3::new(0.0, -s, c, -1.0, 0.0, 0.0, 0.0, -c, -s);
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
        Se3::from_parts(Translation3::new(x, y, height), rotation)
    }

    /// Disparity of the surface z = f(x, y) by marching along each ray in steps of 2 mm; f may jump.
    #[allow(non_snake_case)]
    fn render(rig: &RectifiedRig, T_world_cam: &Se3, f: impl Fn(f64, f64) -> f64) -> Plane {
        Plane::from_fn(rig.width as u32, rig.height as u32, |u, v| {
            let ray_cam = Vector3::new(
                (f64::from(u) - rig.cx) / rig.fx,
                (f64::from(v) - rig.cy) / rig.fy,
                1.0,
            );
            let ray = T_world_cam.rotation * ray_cam;
            let at = |depth: f64| T_world_cam.translation.vector + ray * depth;
            let under = |depth: f64| at(depth).z <= f(at(depth).x, at(depth).y);
            let hit = (1..2500).map(|i| 0.002 * f64::from(i)).find(|&d| under(d));
            let Some(mut far) = hit else {
                return image::Luma([f32::NAN]);
            };
            let mut near = far - 0.002;
            for _ in 0..30 {
                let middle = 0.5 * (near + far);
                if under(middle) {
                    far = middle
                } else {
                    near = middle
                }
            }
            image::Luma([(rig.fx * rig.baseline / far) as f32])
        })
    }

    #[allow(non_snake_case)]
    fn keyframe(
        rig: &RectifiedRig,
        T_world_cam: Se3,
        f: impl Fn(f64, f64) -> f64,
    ) -> Result<DenseKeyframe, TerrainError> {
        let disparity = render(rig, &T_world_cam, f);
        Ok(DenseKeyframe {
            time: 0.0,
            T_world_cam,
            pose_covariance: None,
            left: chequered(rig),
            disparity,
            sigma: None,
        })
    }

    fn fine() -> MapConfig {
        MapConfig {
            voxel: Some(0.02),
            cell: Some(0.05),
            min_points: 1,
            ..MapConfig::default()
        }
    }

    #[test]
    fn a_rendered_plane_comes_out_flat_and_level() {
        let rig = rig();
        // The world is tilted: levelling must undo it.
        let tilt = Se3::rotation(Vector3::new(0.2, -0.1, 0.6));
        let frames = (0..4).map(|i| {
            let mut k = keyframe(&rig, pose(0.2 * f64::from(i), 0.0, 0.5, 0.5), |_, _| 0.0)?;
            k.T_world_cam = tilt * k.T_world_cam;
            Ok::<_, TerrainError>(k)
        });
        let map = map_keyframes(frames, &rig, &fine()).unwrap();
        let known: Vec<f32> = map
            .dem
            .raster
            .values
            .iter()
            .copied()
            .filter(|z| z.is_finite())
            .collect();
        assert!(known.len() > 300, "{}", known.len());
        assert!(
            known.iter().all(|z| z.abs() < 1e-4),
            "{:?}",
            known.iter().fold(0f32, |a, z| a.max(z.abs()))
        );
        // Flat ground is shaded with one value.
        assert!(map.hillshade.values.iter().all(|&v| v == 0 || v == 181));
        let up = (map.T_level_world * tilt).rotation * Vector3::z();
        assert!((up - Vector3::z()).norm() < 1e-6, "{up}");
    }

    #[test]
    fn a_rendered_step_has_its_height_on_both_sides() {
        let rig = rig();
        let step = |x: f64, _: f64| if x > 1.2 { 0.08 } else { 0.0 };
        let frames = (0..5).map(|i| {
            keyframe(
                &rig,
                pose(0.1 * f64::from(i), 0.05 * f64::from(i), 0.5, 0.6),
                step,
            )
        });
        let config = MapConfig {
            levelling: Levelling::World,
            ..fine()
        };
        let map = map_keyframes(frames, &rig, &config).unwrap();
        let (mut low, mut high) = (0, 0);
        for row in 0..map.dem.raster.grid.height {
            for column in 0..map.dem.raster.grid.width {
                let ((x, _), z) = (
                    map.dem.raster.grid.centre(column, row),
                    f64::from(map.dem.raster.at(column, row)),
                );
                // Cells that the edge runs through, or that see its riser, hold both heights.
                if z.is_nan() || (x - 1.2).abs() < 0.05 {
                    continue;
                }
                assert!((z - step(x, 0.0)).abs() < 0.002, "{x} {z}");
                if x < 1.2 { low += 1 } else { high += 1 }
            }
        }
        assert!(low > 50 && high > 50, "{low} {high}");
    }

    #[test]
    fn noise_of_the_disparity_leaves_the_dem_within_its_deviation() {
        let rig = rig();
        let mut state = 7u64;
        let mut uniform = move || {
            state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (state >> 33) as f32 / (1u64 << 31) as f32 - 0.5
        };
        let frames = (0..6).map(|i| {
            let mut k = keyframe(&rig, pose(0.1 * f64::from(i), 0.0, 0.5, 0.6), |_, _| 0.0)?;
            // Uniform over 0.6 px: a deviation of 0.17 px, 3 mm of height at 0.7 m.
            k.disparity.iter_mut().for_each(|d| *d += 0.6 * uniform());
            Ok::<_, TerrainError>(k)
        });
        let map = map_keyframes(
            frames,
            &rig,
            &MapConfig {
                levelling: Levelling::World,
                ..fine()
            },
        )
        .unwrap();
        let near: Vec<f64> = (0..map.dem.raster.values.len())
            .filter(|i| {
                map.dem
                    .raster
                    .grid
                    .centre(i % map.dem.raster.grid.width, 0)
                    .0
                    < 1.0
            })
            .map(|i| f64::from(map.dem.raster.values[i]))
            .filter(|z| z.is_finite())
            .collect();
        let rmse = (near.iter().map(|z| z * z).sum::<f64>() / near.len() as f64).sqrt();
        assert!(near.len() > 100 && rmse < 0.003, "{} {rmse}", near.len());
    }

    #[test]
    fn sizes_are_derived_from_the_rig_and_the_scene() {
        // f 220 px, baseline 0.09 m, ground 0.3 m below: voxels of centimetres.
        let rover = RectifiedRig {
            fx: 220.0,
            fy: 220.0,
            baseline: 0.09,
            ..rig()
        };
        let frame = keyframe(&rover, pose(0.0, 0.0, 0.3, 0.3), |_, _| 0.0);
        let map = map_keyframes([frame], &rover, &MapConfig::default()).unwrap();
        assert!([0.01, 0.02].contains(&map.voxel), "{}", map.voxel);
        assert!([0.02, 0.05].contains(&map.cell), "{}", map.cell);
        for (value, rounded) in [
            (0.0137, 0.01),
            (0.0142, 0.02),
            (0.03, 0.02),
            (0.04, 0.05),
            (0.08, 0.1),
            (3.0, 2.0),
        ] {
            assert!((round_to_125(value) - rounded).abs() < 1e-12, "{value}");
        }
    }

    #[test]
    fn nothing_to_map_is_said_in_plain_words() {
        let rig = rig();
        let none: [Result<DenseKeyframe, TerrainError>; 0] = [];
        let error = map_keyframes(none, &rig, &MapConfig::default())
            .unwrap_err()
            .to_string();
        assert!(error.contains("no key frames"), "{error}");
        let blind = || keyframe(&rig, pose(0.0, 0.0, 0.5, -1.0), |_, _| 0.0);
        let error = map_keyframes([blind()], &rig, &MapConfig::default())
            .unwrap_err()
            .to_string();
        assert!(error.contains("1 key frames"), "{error}");
        let seen = || keyframe(&rig, pose(0.0, 0.0, 0.5, 0.6), |_, _| 0.0);
        let strict = MapConfig {
            min_points: 1_000_000,
            ..MapConfig::default()
        };
        let error = map_keyframes([seen()], &rig, &strict)
            .unwrap_err()
            .to_string();
        assert!(error.contains("larger voxels"), "{error}");
        for bad in [
            MapConfig {
                cell: Some(0.0),
                ..fine()
            },
            MapConfig {
                voxel: Some(-1.0),
                ..fine()
            },
        ] {
            assert!(matches!(
                map_keyframes([seen()], &rig, &bad),
                Err(TerrainError::Setting { .. })
            ));
        }
        let broken = [seen(), Err(TerrainError::Empty("the engine failed".into()))];
        let error = map_keyframes(broken, &rig, &fine())
            .unwrap_err()
            .to_string();
        assert!(error.contains("the engine failed"), "{error}");
    }
}
