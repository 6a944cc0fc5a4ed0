use barchan_datasets::{Plane, Rgb};
use barchan_geometry::{RectifiedRig, Se3};
use nalgebra::{Matrix6, Point3};
use serde::{Deserialize, Serialize};

use crate::elevation::{ElevationConfig, ElevationMap, Scan, SensorModel};
use crate::error::positive;
use crate::ghosts::Sightlines;
use crate::photometry::{ColourGains, without_gain};
use crate::raster::dem;
use crate::surest::superseded;
use crate::{
    CellStatistic, Cloud, CloudPoint, Dem, DepthLimits, Light, Raster, TerrainError, Voxel,
    VoxelMap, fit_plane, hillshade, level,
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
    /// Edge of a voxel, metres. Default: half of the cell, rounded likewise.
    pub voxel: Option<f64>,
    /// Fewest points of a voxel that is kept. Default 2.
    pub min_points: u32,
    /// Edge of a cell of the DEM, metres. Default: twice the voxel where that is given; else five times the
    /// median distance of neighbouring samples on the ground in the first key frame, so that one look puts
    /// 25 points into a cell and the elevation map has enough of them; rounded to 1, 2 or 5 times a power of ten (0.02 m for a rover 0.3 m
    /// high, 0.2 m for one of 0.8 m and for a car).
    pub cell: Option<f64>,
    /// Largest deviation of depth over depth of a point that goes into a voxel. Default 0.025: on flat ground such a
    /// point is off by that share of the camera's height, however far away it is. What is less sure hangs
    /// before and behind the ground. The elevation map weighs for itself and takes what `limits` let in.
    pub max_relative_sigma: f64,
    /// Whether points count by how sure they are, and unsure voxels go where a surer one tells of the same
    /// place. Default true; false is Hong 2021's cloud, in which a point is a point.
    pub surest: bool,
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
            max_relative_sigma: 0.025,
            surest: true,
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

impl DenseKeyframe {
    /// The key frame as it would have been seen with gains of 1; see [`colour_gains`].
    pub fn without_gain(mut self, gain: &[f64; 3]) -> Self {
        self.left = without_gain(&self.left, gain);
        self
    }

    /// What it measured, in its camera frame.
    fn cloud(&self, rig: &RectifiedRig, limits: &DepthLimits) -> Result<Cloud, TerrainError> {
        Cloud::from_disparity(
            rig,
            &self.left,
            &self.disparity,
            self.sigma.as_ref(),
            limits,
        )
    }
}

/// Red, green and blue gains of key frames, as exposure and white balance made them, in their order: the light of
/// places that several key frames see is one (Hong 2021's clouds change colour with the weather).
/// [`DenseKeyframe::without_gain`] takes a gain away. See [`ColourGains`] for what is assumed.
///
/// # Errors
/// The first error of `keyframes`; when images and rig differ in size or a setting makes no sense.
pub fn colour_gains<E: From<TerrainError>>(
    keyframes: impl IntoIterator<Item = Result<DenseKeyframe, E>>,
    rig: &RectifiedRig,
    config: &MapConfig,
) -> Result<Vec<[f64; 3]>, E> {
    // Larger than voxels: what a pixel is off does not matter then, and every other pixel is enough.
    const VOXELS: f64 = 4.0;
    let limits = DepthLimits {
        stride: 2 * config.limits.stride,
        ..config.limits
    };
    let mut gains = None;
    let mut empty = 0;
    for keyframe in keyframes {
        let k = keyframe?;
        let cloud = k.cloud(rig, &limits)?.transform(&k.T_world_cam);
        let gains = match &mut gains {
            Some(gains) => gains,
            None if cloud.points.is_empty() => {
                empty += 1;
                continue;
            }
            none => {
                let seen = k.cloud(rig, &config.limits)?;
                let mut gains = ColourGains::new(VOXELS * sizes(rig, &seen, config)[0])?;
                (0..empty).for_each(|_| gains.add(&Cloud::default(), &Point3::origin()));
                none.insert(gains)
            }
        };
        gains.add(&cloud, &k.T_world_cam.translation.vector.into());
    }
    Ok(gains.map_or_else(|| vec![[1.0; 3]; empty], |g| g.solve()))
}

/// Makes terrain of key frames, one at a time (Hong 2021, 3.2.2): every pixel of known disparity is
/// re-projected (eq. 6) and put into the world by its key frame's pose (eq. 7); voxels gather what
/// falls into the same place and drop what is seen too seldom; the ground is levelled; cells of a grid
/// take the elevation of their voxels.
///
/// `keyframes` may come from an engine that runs while this function pulls: its error ends the map. Whoever can
/// read key frames twice may use [`VoxelScene`], which can look for ghosts in between.
///
/// # Errors
/// The first error of `keyframes`; when images and rig differ in size, a setting makes no sense, no
/// point is left, or the grid would be absurdly large.
pub fn map_keyframes<E: From<TerrainError>>(
    keyframes: impl IntoIterator<Item = Result<DenseKeyframe, E>>,
    rig: &RectifiedRig,
    config: &MapConfig,
) -> Result<TerrainMap, E> {
    Ok(VoxelScene::gather(keyframes, rig, config)?.into_terrain(config)?)
}

/// The voxels of key frames in their world, before anybody asks what is up.
#[derive(Clone, Debug)]
pub struct VoxelScene {
    /// Voxels of enough points, in a fixed order.
    voxels: Vec<Voxel>,
    /// Edges of a voxel and of a cell, metres.
    sizes: [f64; 2],
    first_pose: Se3,
    keyframes: usize,
    points: usize,
    notices: Vec<String>,
}

impl VoxelScene {
    /// The first half of [`map_keyframes`].
    ///
    /// # Errors
    /// As [`map_keyframes`].
    pub fn gather<E: From<TerrainError>>(
        keyframes: impl IntoIterator<Item = Result<DenseKeyframe, E>>,
        rig: &RectifiedRig,
        config: &MapConfig,
    ) -> Result<Self, E> {
        let max_sigma = config.max_relative_sigma;
        for (field, value) in [
            ("voxel", config.voxel),
            ("cell", config.cell),
            ("max_relative_sigma", Some(max_sigma)),
        ] {
            value.map_or(Ok(()), |value| positive(field, value))?;
        }
        let mut gathered = None;
        let mut first_pose = None;
        let (mut count, mut points, mut unsure) = (0, 0, 0);
        for keyframe in keyframes {
            let k = keyframe?;
            let mut cloud = k.cloud(rig, &config.limits)?;
            first_pose.get_or_insert(k.T_world_cam);
            count += 1;
            if cloud.points.is_empty() {
                continue;
            }
            let (map, _) = match &mut gathered {
                Some(gathered) => gathered,
                none => {
                    let sizes = sizes(rig, &cloud, config);
                    none.insert((VoxelMap::new(sizes[0])?, sizes))
                }
            };
            let seen = cloud.points.len();
            let is_sure = |p: &CloudPoint| f64::from(p.sigma) <= max_sigma * p.position.z;
            cloud.points.retain(is_sure);
            points += cloud.points.len();
            unsure += seen - cloud.points.len();
            if !config.surest {
                // What nobody knows of any point makes all alike.
                cloud.points.iter_mut().for_each(|p| p.sigma = f32::NAN);
            }
            map.insert(&cloud.transform(&k.T_world_cam));
        }

        let (Some((map, sizes)), Some(first_pose)) =
            (gathered.filter(|(map, _)| !map.is_empty()), first_pose)
        else {
            return Err(nothing(count, config).into());
        };
        let mut notices = Vec::new();
        if unsure > 0 {
            notices.push(format!(
                "{unsure} of {} points ({:.0} %) are too far away for depth to be known to {:.1} % and were left out of the cloud",
                points + unsure,
                100.0 * unsure as f64 / (points + unsure) as f64,
                100.0 * max_sigma
            ));
        }
        let voxels = map.voxels(config.min_points);
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
        Ok(Self {
            voxels,
            sizes,
            first_pose,
            keyframes: count,
            points,
            notices,
        })
    }

    /// Removes voxels that more key frames look through than see, if at least two do: what moved, and points that hang
    /// in the air. From each voxel a ray is cast to each key frame that has it in its image. Returns how many went.
    ///
    /// `keyframes` are those that were gathered.
    ///
    /// # Errors
    /// The first error of `keyframes`; when images and rig differ in size.
    pub fn clear_ghosts<E: From<TerrainError>>(
        &mut self,
        keyframes: impl IntoIterator<Item = Result<DenseKeyframe, E>>,
        rig: &RectifiedRig,
        limits: &DepthLimits,
    ) -> Result<usize, E> {
        let middles: Vec<Point3<f64>> = self.voxels.iter().map(|v| v.mean).collect();
        let mut sightlines = Sightlines::new(&middles, self.sizes[0]);
        for keyframe in keyframes {
            let k = keyframe?;
            sightlines.look(&k.cloud(rig, limits)?, &k.T_world_cam, rig);
        }
        let before = self.voxels.len();
        let mut ghosts = sightlines.ghosts().into_iter();
        self.voxels.retain(|_| ghosts.next() != Some(true));
        Ok(before - self.voxels.len())
    }

    /// The second half of [`map_keyframes`].
    ///
    /// # Errors
    /// When no voxel is left, or the grid would be absurdly large.
    pub fn into_terrain(self, config: &MapConfig) -> Result<TerrainMap, TerrainError> {
        let Self {
            mut voxels,
            sizes: [voxel, cell],
            mut notices,
            ..
        } = self;
        let levelled = match config.levelling {
            Levelling::Ground => {
                let positions: Vec<Point3<f64>> = voxels.iter().map(|v| v.mean).collect();
                let levelled = level(&positions, &self.first_pose);
                notices.extend(levelled.notice);
                levelled.T_level_world
            }
            Levelling::World => Se3::identity(),
            Levelling::Known(known) => known,
        };
        for v in &mut voxels {
            v.mean = levelled * v.mean;
        }
        let before = voxels.len();
        let mut superseded = superseded(&voxels, cell).into_iter();
        voxels.retain(|_| superseded.next() != Some(true));
        if voxels.len() < before {
            let gone = before - voxels.len();
            notices.push(format!(
                "{gone} of {before} voxels ({:.0} %) were left out: a nearer look knows their place better",
                100.0 * gone as f64 / before as f64
            ));
        }
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
            keyframes: self.keyframes,
            points: self.points,
            voxel,
            cell,
            voxels,
            notices,
        })
    }
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

/// Edges of voxels and cells: see [`MapConfig::cell`].
fn sizes(rig: &RectifiedRig, cloud: &Cloud, config: &MapConfig) -> [f64; 2] {
    /// Samples along the edge of a cell.
    const SAMPLES: f64 = 5.0;
    match (config.voxel, config.cell) {
        (Some(voxel), Some(cell)) => [voxel, cell],
        (Some(voxel), None) => [voxel, round_to_125(2.0 * voxel)],
        (None, Some(cell)) => [round_to_125(0.5 * cell), cell],
        (None, None) => {
            let cell = round_to_125(SAMPLES * ground_spacing(rig, cloud, config.limits.stride));
            [round_to_125(0.5 * cell), cell]
        }
    }
}

/// Median distance of neighbouring samples on the ground, metres: the root of the area that a pixel covers on the plane
/// that fits the points, `z^3 / (fx fy h)` for a plane at the distance `h`.
fn ground_spacing(rig: &RectifiedRig, cloud: &Cloud, stride: usize) -> f64 {
    let positions: Vec<Point3<f64>> = cloud.points.iter().map(|p| p.position).collect();
    let plane = fit_plane(&positions);
    let mut spacings: Vec<f64> = positions
        .iter()
        .map(|p| {
            // Of no plane: as if it faced the camera.
            let height = plane.map_or(p.z, |plane| plane.distance);
            stride as f64 * (p.z.powi(3) / (rig.fx * rig.fy * height)).sqrt()
        })
        .collect();
    let middle = spacings.len() / 2;
    *spacings.select_nth_unstable_by(middle, f64::total_cmp).1
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
            "none of {keyframes} key frames has a pixel that passes the depth limits {:?} and whose depth is known to {:.1} %\n  \
             cure: look at the disparity (barchan infer), or loosen the limits",
            config.limits,
            100.0 * config.max_relative_sigma
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::tests::{chequered, rig};
    use crate::voxel::linear_to_srgb;
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
            // The small rig of these tests knows little of depth.
            max_relative_sigma: 0.1,
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
    fn a_given_size_decides_the_other() {
        let sized = |voxel, cell| {
            let config = MapConfig {
                voxel,
                cell,
                ..MapConfig::default()
            };
            let cloud = keyframe(&rig(), pose(0.0, 0.0, 0.5, 0.6), |_, _| 0.0)
                .and_then(|k| k.cloud(&rig(), &config.limits));
            sizes(&rig(), &cloud.unwrap(), &config)
        };
        assert_eq!(sized(Some(0.03), Some(0.04)), [0.03, 0.04]);
        assert_eq!(sized(Some(0.05), None), [0.05, 0.1]);
        assert_eq!(sized(None, Some(0.2)), [0.1, 0.2]);
        // 25 points a cell: neither a sieve nor a sandwich.
        let [voxel, cell] = sized(None, None);
        assert!(
            voxel < cell && (0.02..=0.1).contains(&cell),
            "{voxel} {cell}"
        );
    }

    /// A drive of eight key frames over flat ground; a box stands on it while the first three are taken. Key frames
    /// have gains where these are given.
    #[allow(non_snake_case)]
    fn drive_past_a_ghost(gains: Option<&[[f64; 3]]>) -> Vec<DenseKeyframe> {
        let rig = rig();
        let on_box = |x: f64, y: f64| (1.0..1.25).contains(&x) && y.abs() < 0.12;
        let frames = (0..8).map(|i| {
            let ground = move |x: f64, y: f64| if i < 3 && on_box(x, y) { 0.2 } else { 0.0 };
            let T_world_cam = pose(0.06 * f64::from(i), 0.0, 0.5, 0.5);
            let mut k = keyframe(&rig, T_world_cam, ground).unwrap();
            k.time = f64::from(i);
            // What the ground looks like depends on where it is.
            k.left = Rgb::from_fn(rig.width as u32, rig.height as u32, |u, v| {
                let d = f64::from(k.disparity.get_pixel(u, v).0[0]);
                let at = barchan_geometry::StereoPoint {
                    u: f64::from(u),
                    v: f64::from(v),
                    d,
                };
                let light = rig.back_project(at).map_or([0.2; 3], |p| {
                    let p = T_world_cam * p;
                    let wave = |a: f64| 0.22 + 0.12 * (a * p.x).sin() * (0.8 * a * p.y).cos();
                    [wave(23.0), wave(31.0), wave(41.0)]
                });
                let gain = gains.map_or([1.0; 3], |g| g[i as usize]);
                let level = |c: usize| {
                    f32::from(linear_to_srgb((light[c] * gain[c]).clamp(0.0, 1.0))) / 255.0
                };
                image::Rgb([level(0), level(1), level(2)])
            });
            k
        });
        frames.collect()
    }

    fn all(frames: &[DenseKeyframe]) -> impl Iterator<Item = Result<DenseKeyframe, TerrainError>> {
        frames.iter().cloned().map(Ok)
    }

    #[test]
    fn a_ghost_is_looked_through_and_goes_and_the_ground_and_a_wall_stay() {
        let rig = rig();
        let frames = drive_past_a_ghost(None);
        // Depths as sure as disparities of 0.1 px: 1.4 cm at 1.2 m.
        let config = MapConfig {
            levelling: Levelling::World,
            limits: DepthLimits {
                default_sigma: 0.1,
                min_sigma: 0.1,
                ..DepthLimits::default()
            },
            ..fine()
        };
        let mut scene = VoxelScene::gather(all(&frames), &rig, &config).unwrap();
        let high = |scene: &VoxelScene| scene.voxels.iter().filter(|v| v.mean.z > 0.05).count();
        let (ghost, ground) = (high(&scene), scene.voxels.len() - high(&scene));
        assert!(ghost > 50, "{ghost}");
        let gone = scene
            .clear_ghosts(all(&frames), &rig, &config.limits)
            .unwrap();
        let left = high(&scene);
        println!("{ghost} voxels of the ghost, {left} left; {ground} of the ground, {gone} gone");
        assert!(left * 20 < ghost, "{left} of {ghost}");
        let kept = scene.voxels.len() - left;
        assert!(kept * 100 > ground * 99, "{kept} of {ground}");
        // What stands in all key frames is no ghost.
        let standing: Vec<DenseKeyframe> = (0..8)
            .map(|i| {
                let wall = |x: f64, _: f64| if x > 1.3 { 0.3 } else { 0.0 };
                keyframe(&rig, pose(0.06 * f64::from(i), 0.0, 0.5, 0.5), wall).unwrap()
            })
            .collect();
        let mut scene = VoxelScene::gather(all(&standing), &rig, &config).unwrap();
        let before = scene.voxels.len();
        let gone = scene
            .clear_ghosts(all(&standing), &rig, &config.limits)
            .unwrap();
        assert!(gone * 200 < before, "{gone} of {before}");
    }

    #[test]
    fn colours_of_key_frames_with_planted_gains_agree() {
        let rig = rig();
        let gain = |i: f64| {
            [
                1.0 + 0.4 * (1.1 * i).sin(),
                1.0 + 0.3 * (0.7 * i).cos(),
                1.1 - 0.06 * i,
            ]
        };
        let planted: Vec<[f64; 3]> = (0..8).map(|i| gain(f64::from(i))).collect();
        let frames = drive_past_a_ghost(Some(&planted));
        // The contrast of dark key frames falls below the limit in places.
        let config = MapConfig {
            levelling: Levelling::World,
            limits: DepthLimits {
                min_contrast: 0.0,
                ..DepthLimits::default()
            },
            ..fine()
        };
        let gains = colour_gains(all(&frames), &rig, &config).unwrap();
        // Up to a gain that all have in common.
        for c in 0..3 {
            let off: Vec<f64> = (gains.iter().zip(&planted))
                .map(|(found, planted)| (found[c] / planted[c]).ln())
                .collect();
            let mean = off.iter().sum::<f64>() / off.len() as f64;
            let worst = off.iter().fold(0.0, |w: f64, o| w.max((o - mean).abs()));
            assert!(worst < 0.03, "channel {c}: {worst}");
        }
        // Voxels are as bright as the ground was without gains, but for what is common.
        let brightness = |frames: &[DenseKeyframe], gains: Option<&[[f64; 3]]>| {
            let freed = frames.iter().enumerate().map(|(i, k)| {
                let k = k.clone();
                Ok::<_, TerrainError>(match gains {
                    Some(gains) => k.without_gain(&gains[i]),
                    None => k,
                })
            });
            let scene = VoxelScene::gather(freed, &rig, &config).unwrap();
            let ground = scene.voxels.into_iter().filter(|v| v.mean.z < 0.01);
            ground.map(|v| v.linear_rgb).collect::<Vec<_>>()
        };
        let truth = brightness(&drive_past_a_ghost(None), None);
        let spread = |seen: &[nalgebra::Vector3<f64>]| {
            assert_eq!(seen.len(), truth.len());
            let ratios: Vec<f64> = seen
                .iter()
                .zip(&truth)
                .map(|(a, b)| (a.x / b.x).ln())
                .collect();
            let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
            (ratios.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / ratios.len() as f64).sqrt()
        };
        let (raw, even) = (
            spread(&brightness(&frames, None)),
            spread(&brightness(&frames, Some(&gains))),
        );
        println!("deviation of colour {raw:.3} as seen, {even:.3} without gains");
        assert!(even < 0.02 && raw > 5.0 * even, "{raw} {even}");
    }

    /// A near and a far look at one place, of which the far one is half a pixel off: it supersedes nothing, and Hong's cloud
    /// keeps both.
    #[test]
    fn the_far_says_nothing_where_the_near_is_known() {
        let rig = rig();
        let look = |x: f64, off: f32| {
            let mut k = keyframe(&rig, pose(x, 0.0, 0.5, 0.6), |_, _| 0.0).unwrap();
            k.disparity.iter_mut().for_each(|d| *d += off);
            k.sigma = Some(Plane::from_pixel(160, 120, image::Luma([0.3])));
            k
        };
        let frames = [look(0.0, -0.5), look(0.9, 0.0)];
        let high = |surest| {
            let config = MapConfig {
                surest,
                levelling: Levelling::World,
                ..fine()
            };
            let map = map_keyframes(all(&frames), &rig, &config).unwrap();
            // Ground that the second look sees from less than a metre.
            let near = map.voxels.iter().filter(|v| {
                (1.35..1.6).contains(&v.mean.x) && v.mean.y.abs() < 0.15 && v.mean.z.abs() > 0.03
            });
            near.count()
        };
        assert_eq!(high(true), 0);
        assert!(high(false) > 20, "{}", high(false));
        // A tight bound leaves the near alone.
        let config = MapConfig {
            max_relative_sigma: 0.03,
            ..fine()
        };
        let map = map_keyframes([Ok(look(0.0, 0.0))], &rig, &config);
        let map: TerrainMap = map.map_err(|e: TerrainError| e).unwrap();
        assert!(
            map.notices.iter().any(|n| n.contains("too far away")),
            "{:?}",
            map.notices
        );
        // 0.3 px of a rig of 10 px m are 3 % at a metre.
        let farthest = map.voxels.iter().map(|v| v.mean.x).fold(0.0, f64::max);
        assert!((0.5..1.1).contains(&farthest), "{farthest}");
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
