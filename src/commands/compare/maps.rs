use std::collections::BTreeSet;
use std::path::Path;

use anyhow::Result;
use barchan_datasets::{Plane, StereoSource};
use barchan_eval::{ComparedCell, elevation};
use barchan_geometry::nalgebra::Point3;
use barchan_geometry::{Se3, StampedPose, Trajectory};
use barchan_terrain::{DenseKeyframe, Levelling, MapConfig, Raster, TerrainMap, map_keyframes};

use super::{Compared, sampled};
use crate::output::Output;
use crate::slam_run::SlamRun;

/// Most frames whose true disparity makes the true ground.
const TRUE_FRAMES: usize = 60;

/// The frame that maps are compared in, and what they are held against.
#[allow(non_snake_case)]
pub struct Ground {
    /// The true ground, where the data knows its disparity and its poses.
    truth: Option<TerrainMap>,
    /// Whether the true route is known.
    true_route: bool,
    /// Maps the world (of the truth where there is one, else of the runs) to a frame whose z is up, once it is known.
    T_level_world: Option<Se3>,
    /// The axes of routes that are seen from above.
    axes: [usize; 2],
    config: MapConfig,
}

impl Ground {
    /// The true ground, of the true disparity at the true poses.
    pub fn of_truth(
        source: &dyn StereoSource,
        truth: Option<&Trajectory>,
        output: &Output,
    ) -> Result<Self> {
        let mut ground = Self {
            truth: None,
            true_route: truth.is_some(),
            T_level_world: None,
            axes: [0, 1],
            config: MapConfig::default(),
        };
        let Some(truth) = truth else {
            return Ok(ground);
        };
        let has_rotations = truth.poses.windows(2).any(|w| {
            w[0].T_world_cam
                .rotation
                .angle_to(&w[1].T_world_cam.rotation)
                > 1e-9
        });
        if !has_rotations || source.true_disparity(0)?.is_none() {
            ground.axes = widest_axes(truth);
            return Ok(ground);
        }
        let frames: Vec<usize> = sampled(source, TRUE_FRAMES).collect();
        let bar = output.progress("true ground", frames.len());
        let keyframes = frames.into_iter().filter_map(|index| {
            bar.inc(1);
            true_keyframe(source, truth, index).transpose()
        });
        let map = map_keyframes(keyframes, source.rig(), &ground.config)?;
        bar.finish_and_clear();
        ground.config.voxel = Some(map.voxel);
        ground.config.cell = Some(map.cell);
        ground.T_level_world = Some(map.T_level_world);
        ground.truth = Some(map);
        Ok(ground)
    }

    /// For people.
    pub fn name(&self) -> &'static str {
        match self.truth {
            Some(_) => "the true ground",
            None => "each other: there is no true ground",
        }
    }

    /// The map of a run, whose world `motion` brings to that of the truth; `None` where its key frames have no
    /// disparity. Without a true ground the first map says what is up, and how large cells are.
    #[allow(non_snake_case)]
    pub fn map(&mut self, folder: &Path, motion: &Se3) -> Result<Option<TerrainMap>> {
        if !folder.join("keyframes/disparity").is_dir() {
            return Ok(None);
        }
        let run = SlamRun::open(folder)?;
        let part = run.largest_part();
        // Where the truth is of positions in a plane, runs are brought to it for the routes alone.
        let T_level_run = match (&self.truth, self.T_level_world) {
            (Some(_), Some(T_level_world)) => Some(T_level_world * motion),
            (_, known) => known,
        };
        let config = MapConfig {
            levelling: T_level_run.map_or(Levelling::Ground, Levelling::Known),
            ..self.config.clone()
        };
        let keyframes = run.keyframes.iter().filter(|k| k.submap == part);
        let map = map_keyframes(keyframes.map(|k| run.read(k)), &run.rig, &config)?;
        if self.T_level_world.is_none() {
            self.config.voxel = Some(map.voxel);
            self.config.cell = Some(map.cell);
            self.T_level_world = Some(map.T_level_world);
        }
        Ok(Some(map))
    }

    /// Root mean square difference of heights to the true ground; `None` where there is none.
    pub fn rmse(&self, map: &TerrainMap) -> Option<f64> {
        let truth = &self.truth.as_ref()?.dem.raster;
        let cells = (0..truth.values.len()).map(|i| ComparedCell {
            estimate: height_at(&map.dem.raster, centre(truth, i)),
            truth: truth.values[i].into(),
            bounds: None,
        });
        elevation::score(cells).ok().map(|s| s.rmse)
    }

    /// Fills in how much of the ground each map knows: of the true one, or of what any map knows.
    pub fn cover(&self, compared: &mut [Compared]) {
        let known: BTreeSet<[i64; 2]> = match &self.truth {
            Some(map) => known_cells(&map.dem.raster),
            None => {
                let maps = compared.iter().filter_map(|c| c.map.as_ref());
                maps.flat_map(|m| known_cells(&m.dem.raster)).collect()
            }
        };
        for c in compared.iter_mut() {
            let Some(map) = &c.map else { continue };
            let seen = known_cells(&map.dem.raster).intersection(&known).count();
            c.row.coverage_percent = Some(100.0 * seen as f64 / known.len().max(1) as f64);
        }
    }

    /// A route from above. `motion` brings it to the world of the truth.
    pub fn route(&self, route: &Trajectory, motion: &Se3) -> Vec<(f64, f64)> {
        let (motion, axes) = match (self.T_level_world, &self.truth) {
            (Some(level), Some(_)) => (level * motion, [0, 1]),
            // A true route alone has a frame of its own.
            _ if self.true_route => (*motion, self.axes),
            (Some(level), None) => (level, [0, 1]),
            // Of the first camera: to the right, and ahead.
            (None, _) => (*motion, [0, 2]),
        };
        from_above(route, &motion, axes)
    }

    /// The true ground.
    pub fn truth(&self) -> Option<&TerrainMap> {
        self.truth.as_ref()
    }
}

/// The two axes along which a route is longest.
fn widest_axes(route: &Trajectory) -> [usize; 2] {
    let extent = |axis: usize| {
        let along = route
            .poses
            .iter()
            .map(|p| p.T_world_cam.translation.vector[axis]);
        along.clone().fold(f64::NEG_INFINITY, f64::max) - along.fold(f64::INFINITY, f64::min)
    };
    let flattest = (0..3).min_by(|a, b| extent(*a).total_cmp(&extent(*b)));
    match flattest {
        Some(0) => [1, 2],
        Some(1) => [0, 2],
        _ => [0, 1],
    }
}

/// A frame of true disparity at its true pose; `None` where one of them is not known.
fn true_keyframe(
    source: &dyn StereoSource,
    truth: &Trajectory,
    index: usize,
) -> Result<Option<DenseKeyframe>> {
    let Some(disparity) = source.true_disparity(index)? else {
        return Ok(None);
    };
    let frame = source.frame(index)?;
    // Nothing is surer: as far out as any engine claims to see.
    let (width, height) = disparity.dimensions();
    let sigma = Plane::new(width, height);
    Ok(truth.at(frame.time).map(|pose| DenseKeyframe {
        time: frame.time,
        T_world_cam: pose,
        pose_covariance: None,
        left: frame.left,
        disparity,
        sigma: Some(sigma),
    }))
}

fn centre(raster: &Raster<f32>, i: usize) -> (f64, f64) {
    raster
        .grid
        .centre(i % raster.grid.width, i / raster.grid.width)
}

/// The cells whose height is known, counted in cells from the origin: grids of one frame lie at multiples of a cell.
fn known_cells(raster: &Raster<f32>) -> BTreeSet<[i64; 2]> {
    let known = (0..raster.values.len()).filter(|i| raster.values[*i].is_finite());
    let counted = |i: usize| {
        let (x, y) = centre(raster, i);
        [x / raster.grid.cell_x, y / raster.grid.cell_y].map(|v| v.floor() as i64)
    };
    known.map(counted).collect()
}

/// Places of a route from above.
pub fn from_above(route: &Trajectory, motion: &Se3, axes: [usize; 2]) -> Vec<(f64, f64)> {
    let place = |p: &StampedPose| {
        let place = motion * Point3::from(p.T_world_cam.translation.vector);
        (place[axes[0]], place[axes[1]])
    };
    route.poses.iter().map(place).collect()
}

/// The height of the cell at a place; NaN where it is not known.
fn height_at(raster: &Raster<f32>, (x, y): (f64, f64)) -> f64 {
    let cell = raster.grid.cell_at(x, y);
    cell.map_or(f64::NAN, |(c, r)| {
        raster.values[r * raster.grid.width + c].into()
    })
}
