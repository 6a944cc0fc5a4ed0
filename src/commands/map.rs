use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_datasets::{disparity_file, read_rgb};
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, align};
use barchan_geometry::nalgebra::Matrix6;
use barchan_geometry::{RectifiedRig, Rig, Se3, StampedPose, Trajectory};
use barchan_terrain::elevation::{BoundsKind, ElevationConfig};
use barchan_terrain::{
    CellStatistic, DenseKeyframe, Levelling, MapConfig, StereoErrors, elevation_of_keyframes,
    map_keyframes,
};
use clap::{Parser, ValueEnum};
use serde::Serialize;

use crate::commands::eval::read_trajectory;
use crate::output::{Output, StagedDir};

/// Turn a SLAM run into terrain: voxel cloud, DEM, hillshade, elevation with bounds
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan map runs/s --out map/\n  \
    barchan map runs/s --voxel 0.02 --cell 0.05 --out map/
    barchan map runs/s --poses surveyed.tum --out map/     the run's disparity at somebody else's poses")]
pub struct Args {
    /// A run of `barchan slam`
    run: PathBuf,
    /// Edge of a voxel, metres [default: from the size of a pixel on the ground]
    #[arg(long, value_name = "M")]
    voxel: Option<f64>,
    /// Edge of a cell of the DEM, metres [default: twice the voxel, rounded]
    #[arg(long, value_name = "M")]
    cell: Option<f64>,
    /// Fewest points of a voxel that is kept
    #[arg(long, default_value_t = MapConfig::default().min_points)]
    min_points: u32,
    /// Which part of the map, by `submap` in keyframes.csv [default: the one of most key frames]
    #[arg(long)]
    submap: Option<usize>,
    /// Farthest accepted depth, metres [default: where depth is known to 10 %]
    #[arg(long, value_name = "M")]
    max_depth: Option<f64>,
    /// How the points of a cell make the height of the DEM
    #[arg(long, value_enum, default_value_t = Statistic::Mean)]
    statistic: Statistic,
    /// How elevation.tif bounds heights: three deviations of the cell, or quantiles of the cells around
    #[arg(long, value_enum, default_value_t = BoundsBy::Sigma3)]
    bounds: BoundsBy,
    /// Deviation of the disparity's error that all looks at a place share, pixels
    #[arg(long, default_value_t = StereoErrors::default().systematic, value_name = "PX")]
    systematic: f64,
    /// Poses that replace those of the run, at the times of its key frames: TUM text, of the left
    /// camera in a world whose z is up. The products are then in that world
    #[arg(long, value_name = "FILE")]
    poses: Option<PathBuf>,
    /// Takes the map to the frame of these poses or places, by the rigid motion that fits the key frames
    /// best: TUM text, KITTI text, gt.csv, or gnss.csv (the antenna is taken for the camera)
    #[arg(long, value_name = "FILE", conflicts_with = "poses")]
    align: Option<PathBuf>,
    /// Writes cloud.pcd as well
    #[arg(long)]
    pcd: bool,
    /// Removes what later key frames see through
    #[arg(long)]
    clear_ghosts: bool,
    /// The directory that is written
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

#[derive(Clone, Copy, ValueEnum)]
enum Statistic {
    Mean,
    Median,
    P10,
    Max,
}

impl From<Statistic> for CellStatistic {
    fn from(s: Statistic) -> Self {
        match s {
            Statistic::Mean => Self::Mean,
            Statistic::Median => Self::Median,
            Statistic::P10 => Self::P10,
            Statistic::Max => Self::Max,
        }
    }
}

#[derive(Clone, Copy, ValueEnum)]
enum BoundsBy {
    Sigma3,
    Quantile,
}

impl From<BoundsBy> for BoundsKind {
    fn from(b: BoundsBy) -> Self {
        match b {
            BoundsBy::Sigma3 => Self::Sigma3,
            BoundsBy::Quantile => Self::Quantile,
        }
    }
}

#[derive(Serialize)]
struct Summary {
    keyframes: usize,
    points: usize,
    voxels: usize,
    voxel: f64,
    cell: f64,
    width: usize,
    height: usize,
    /// Cells of elevation.tif that are known.
    elevation_cells: usize,
    /// Their mean distance from the lower to the upper bound, metres.
    band_width: f64,
    /// Whether the bounds hold what the poses may be off.
    pose_covariance: bool,
    notices: Vec<String>,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    let (rig, keyframes) = open_run(&args.run, args.submap, args.poses.as_deref())?;
    let mut config = MapConfig {
        voxel: args.voxel,
        cell: args.cell,
        min_points: args.min_points,
        statistic: args.statistic.into(),
        ..MapConfig::default()
    };
    config.limits.max_depth = args.max_depth;
    if args.poses.is_some() {
        config.levelling = Levelling::World;
    }
    if let Some(file) = &args.align {
        let run = Trajectory {
            poses: keyframes.iter().map(|k| k.pose).collect(),
        };
        let reference = read_places(file)?;
        let motion = align(&run, &reference, DEFAULT_TOLERANCE)
            .with_context(|| format!("{} and {}", file.display(), args.run.display()))?;
        config.levelling = Levelling::Known(motion);
    }
    let errors = StereoErrors {
        systematic: args.systematic,
        ..StereoErrors::default()
    };
    let out = StagedDir::new(&args.out, "summary.json")?;

    // The key frames are read twice: what is up is known when all were seen.
    let bar = output.progress("map", 2 * keyframes.len());
    let frames = || {
        keyframes.iter().map(|k| {
            bar.inc(1);
            k.read()
        })
    };
    let mut map = map_keyframes(frames(), &rig, &config)?;
    let elevation = elevation_of_keyframes(
        frames(),
        &rig,
        &map.T_level_world,
        &config.limits,
        &errors,
        args.clear_ghosts,
        &ElevationConfig {
            cell: map.cell,
            ..ElevationConfig::default()
        },
    )?;
    bar.finish_and_clear();
    let pose_covariance = keyframes.iter().all(|k| k.pose_covariance.is_some());
    if !pose_covariance {
        map.notices.push(
            "the run has no covariance.csv: the bounds of elevation.tif hold what disparity may be off, and not what the poses may be off".into(),
        );
    }
    for notice in &map.notices {
        output.notice(notice);
    }
    let bounds = elevation.bounds(args.bounds.into());
    let widths = || {
        bounds
            .iter()
            .map(|b| b.upper - b.lower)
            .filter(|w| w.is_finite())
    };
    let elevation_cells = widths().count();
    let band_width = widths().sum::<f64>() / elevation_cells.max(1) as f64;

    let cloud = map.cloud();
    cloud.write_ply(&out.path("cloud.ply")?)?;
    cloud.write_las(&out.path("cloud.laz")?)?;
    if args.pcd {
        cloud.write_pcd(&out.path("cloud.pcd")?)?;
    }
    map.dem.write(&out.path("dem.tif")?)?;
    elevation.write(&out.path("elevation.tif")?, args.bounds.into())?;
    map.hillshade.write(&out.path("hillshade.tif")?)?;
    let levelled = keyframes.iter().map(|k| StampedPose {
        T_world_cam: map.T_level_world * k.pose.T_world_cam,
        ..k.pose
    });
    let route = Trajectory {
        poses: levelled.collect(),
    };
    out.write("keyframes.tum", route.to_tum())?;
    let summary = Summary {
        keyframes: map.keyframes,
        points: map.points,
        voxels: map.voxels.len(),
        voxel: map.voxel,
        cell: map.cell,
        width: map.dem.raster.grid.width,
        height: map.dem.raster.grid.height,
        elevation_cells,
        band_width,
        pose_covariance,
        notices: map.notices.clone(),
    };
    out.write_json("summary.json", &summary)?;
    out.finish()?;
    let text = format!(
        "{} key frames, {} points in {} voxels of {} m; DEM {} x {} cells of {} m ({:.1} x {:.1} m)\n\
         {} cells of known elevation, bounds {:.3} m wide on average\n{}: cloud.ply cloud.laz dem.tif hillshade.tif elevation.tif keyframes.tum",
        summary.keyframes,
        summary.points,
        summary.voxels,
        summary.voxel,
        summary.width,
        summary.height,
        summary.cell,
        summary.width as f64 * summary.cell,
        summary.height as f64 * summary.cell,
        summary.elevation_cells,
        summary.band_width,
        args.out.display(),
    );
    output.result(&summary, &text)
}

/// Poses, or places alone: what `barchan eval trajectory` reads, and `gnss.csv`.
fn read_places(file: &Path) -> Result<Trajectory> {
    let text = std::fs::read_to_string(file).with_context(|| file.display().to_string())?;
    if !text.starts_with("time,x,y,z") {
        return read_trajectory(file);
    }
    let mut poses = vec![];
    for (number, line) in text.lines().enumerate().skip(1) {
        let fields: Vec<f64> = line
            .split(',')
            .map_while(|f| f.trim().parse().ok())
            .collect();
        let [time, x, y, z, ..] = fields[..] else {
            bail!(
                "{}, line {}: expected time,x,y,z",
                file.display(),
                number + 1
            );
        };
        poses.push(StampedPose {
            time,
            T_world_cam: Se3::translation(x, y, z),
        });
    }
    Ok(Trajectory { poses })
}

/// Where the parts of a key frame lie.
struct KeyframeFiles {
    run: PathBuf,
    name: String,
    pose: StampedPose,
    pose_covariance: Option<Matrix6<f64>>,
}

impl KeyframeFiles {
    fn read(&self) -> Result<DenseKeyframe> {
        let file = |folder: &str| {
            self.run
                .join("keyframes")
                .join(folder)
                .join(format!("{}.png", self.name))
        };
        Ok(DenseKeyframe {
            time: self.pose.time,
            T_world_cam: self.pose.T_world_cam,
            pose_covariance: self.pose_covariance,
            left: read_rgb(&file("left"))?,
            disparity: disparity_file::read(&file("disparity"))?,
            sigma: Some(disparity_file::read(&file("sigma"))?),
        })
    }
}

/// The rig and the key frames of a run: `keyframes.tum` has a line for every name, in order, in
/// `keyframes/left`. `poses` replace those of the run; key frames they do not reach are left out.
fn open_run(
    run: &Path,
    submap: Option<usize>,
    poses: Option<&Path>,
) -> Result<(RectifiedRig, Vec<KeyframeFiles>)> {
    let trajectory = run.join("keyframes.tum");
    if !trajectory.is_file() {
        bail!(
            "{}: no run of `barchan slam` (there is no keyframes.tum)\n  cure: `barchan slam --data DATA --out {0}` makes one",
            run.display()
        );
    }
    let rig_file = run.join("rig.toml");
    let rig = Rig::load(&rig_file)?
        .as_rectified()
        .with_context(|| format!("{}: not rectified", rig_file.display()))?;
    let estimated = Trajectory::read_tum(&trajectory)?.poses;
    let folder = run.join("keyframes/disparity");
    let entries = folder.read_dir().with_context(|| {
        format!(
            "{}: no disparity in this run\n  cure: run `barchan slam` with --model",
            folder.display()
        )
    })?;
    let mut names: Vec<String> = entries
        .filter_map(|e| Some(e.ok()?.path().file_stem()?.to_str()?.to_owned()))
        .collect();
    names.sort();
    if names.len() != estimated.len() {
        bail!(
            "{}: {} poses, but {} disparity images in {}",
            trajectory.display(),
            estimated.len(),
            names.len(),
            folder.display()
        );
    }
    let parts = read_submaps(run, estimated.len())?;
    let largest = || {
        let count = |part: &usize| parts.iter().filter(|p| *p == part).count();
        // Of equals the first.
        (parts.iter().copied().rev()).max_by_key(count).unwrap_or(0)
    };
    let part = submap.unwrap_or_else(largest);
    let others = poses
        .map(|file| Trajectory::read_tum(file).map(|t| (file, t)))
        .transpose()?;
    let covariances = match &others {
        None => read_covariances(run, estimated.len())?,
        // Those of the run say nothing of somebody else's poses.
        Some(_) => None,
    };
    let mut keyframes = vec![];
    for (k, (name, mut pose)) in names.into_iter().zip(estimated).enumerate() {
        // Poses from elsewhere say how the parts lie to each other.
        if others.is_none() && parts[k] != part {
            continue;
        }
        if let Some((_, others)) = &others {
            match others.at(pose.time) {
                Some(other) => pose.T_world_cam = other,
                None => continue,
            }
        }
        keyframes.push(KeyframeFiles {
            run: run.to_owned(),
            name,
            pose,
            pose_covariance: covariances.as_ref().map(|c| c[k]),
        });
    }
    if others.is_none() && keyframes.is_empty() {
        bail!(
            "{}: no key frame is of part {part} of the map\n  cure: see submap in keyframes.csv",
            run.display()
        );
    }
    if let (Some((file, _)), true) = (&others, keyframes.is_empty()) {
        bail!(
            "{}: none of its times is that of a key frame of {}\n  cure: give both the same clock",
            file.display(),
            run.display()
        );
    }
    Ok((rig, keyframes))
}

/// The part of the map that each key frame belongs to: `keyframes.csv` of a run; all to one where
/// there is none.
fn read_submaps(run: &Path, keyframes: usize) -> Result<Vec<usize>> {
    let file = run.join("keyframes.csv");
    if !file.is_file() {
        return Ok(vec![0; keyframes]);
    }
    let text = std::fs::read_to_string(&file).with_context(|| file.display().to_string())?;
    let last_column = |line: &str| line.rsplit(',').next()?.trim().parse().ok();
    let parts: Option<Vec<usize>> = text.lines().skip(1).map(last_column).collect();
    match parts {
        Some(parts) if parts.len() == keyframes => Ok(parts),
        _ => bail!(
            "{}: expected a line for each of {keyframes} key frames, with its submap last",
            file.display()
        ),
    }
}

/// `covariance.csv` of a run, where there is one: a header, then a line for each key frame in order, the
/// time and the 36 numbers of the covariance of (position, rotation vector) about the axes of the world.
fn read_covariances(run: &Path, keyframes: usize) -> Result<Option<Vec<Matrix6<f64>>>> {
    let file = run.join("covariance.csv");
    if !file.is_file() {
        return Ok(None);
    }
    let text = std::fs::read_to_string(&file).with_context(|| file.display().to_string())?;
    let mut covariances = vec![];
    for (number, line) in text.lines().enumerate().skip(1) {
        let fields: Result<Vec<f64>, _> = line.split(',').map(|f| f.trim().parse()).collect();
        let numbers = fields
            .ok()
            .filter(|f| f.len() == 37 && f.iter().all(|v| v.is_finite()));
        let Some(numbers) = numbers else {
            bail!(
                "{}, line {}: expected a time and 36 numbers",
                file.display(),
                number + 1
            );
        };
        covariances.push(Matrix6::from_row_slice(&numbers[1..]));
    }
    if covariances.len() != keyframes {
        bail!(
            "{}: {} lines for {keyframes} key frames",
            file.display(),
            covariances.len()
        );
    }
    Ok(Some(covariances))
}
