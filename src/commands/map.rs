use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_eval::trajectory::{Alignment, DEFAULT_TOLERANCE, align};
use barchan_geometry::registration::{IcpConfig, Reference, register_from_afar};
use barchan_geometry::{Se3, StampedPose, Trajectory};
use barchan_terrain::elevation::{BoundsKind, ElevationConfig};
use barchan_terrain::{
    CellStatistic, DenseKeyframe, Levelling, MapConfig, NoiseModel, StereoErrors, TerrainMap,
    VoxelScene, colour_gains, elevation_of_keyframes,
};
use clap::{Parser, ValueEnum};
use serde::Serialize;

use crate::commands::eval::{read_points, read_trajectory};
use crate::output::{Output, StagedDir};
use crate::slam_run::{RunKeyframe, SlamRun};

/// Turn a SLAM run into terrain: voxel cloud, DEM, hillshade, elevation with bounds
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan map runs/s --out map/\n  \
    barchan map runs/s --voxel 0.02 --cell 0.05 --out map/\n  \
    barchan map runs/s --poses surveyed.tum --out map/     the run's disparity at somebody else's poses")]
pub struct Args {
    /// A run of `barchan slam`
    run: PathBuf,
    /// Edge of a voxel, metres [default: half of the cell, rounded]
    #[arg(long, value_name = "M")]
    voxel: Option<f64>,
    /// Edge of a cell of the DEM, metres [default: twice the voxel where that is given; else five times the
    /// distance of neighbouring points on the ground, to 1, 2 or 5 times a power of ten]
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
    /// Largest deviation of depth over depth of a point of the cloud and of the DEM
    #[arg(long, default_value_t = MapConfig::default().max_relative_sigma, value_name = "SHARE")]
    max_relative_sigma: f64,
    /// Every point counts alike and stays, however unsure, as in Hong 2021 [default: points count by the inverse of
    /// their variance, and voxels go where others are twice as sure of the place]
    #[arg(long)]
    every_point: bool,
    /// How the points of a cell make the height of the DEM
    #[arg(long, value_enum, default_value_t = Statistic::Mean)]
    statistic: Statistic,
    /// How elevation.tif bounds heights: three deviations of the cell, or quantiles of the cells around
    #[arg(long, value_enum, default_value_t = BoundsBy::Sigma3)]
    bounds: BoundsBy,
    /// Deviation of the disparity's error that all looks at a place share, pixels
    #[arg(long, default_value_t = StereoErrors::default().systematic, value_name = "PX")]
    systematic: f64,
    /// How far the sensor is off: noise.toml of `barchan noise` [default: what the disparity says of itself]
    #[arg(long, value_name = "FILE", conflicts_with = "systematic")]
    sensor: Option<PathBuf>,
    /// Fewest key frames that must have measured a cell of elevation.tif: what one gets wholly wrong nothing
    /// contradicts. Of a run with fewer key frames, all of them
    #[arg(long, default_value_t = 3)]
    min_looks: u32,
    /// Poses that replace those of the run, at the times of its key frames: TUM text, of the left
    /// camera in a world whose z is up. The products are then in that world
    #[arg(long, value_name = "FILE")]
    poses: Option<PathBuf>,
    /// Takes the map to the frame of these poses or places, by the rigid motion that fits the key frames
    /// best: TUM text, KITTI text, gt.csv, or gnss.csv (the antenna is taken for the camera)
    #[arg(long, value_name = "FILE", conflicts_with = "poses")]
    align: Option<PathBuf>,
    /// Registers the map to a survey of the same ground, points with planes, from where it lies or --align took it:
    /// .ply, .las, .laz or the GeoTIFF of a DEM. Products are then in the survey's frame
    #[arg(long, value_name = "FILE", conflicts_with = "poses")]
    register: Option<PathBuf>,
    /// Writes cloud.pcd as well
    #[arg(long)]
    pcd: bool,
    /// Removes what other key frames see through, from the cloud and the rasters
    #[arg(long)]
    clear_ghosts: bool,
    /// Colours as the camera saw them: exposure and white balance of key frames are not made equal
    #[arg(long)]
    raw_colours: bool,
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
    /// Voxels that were removed because other key frames saw through them.
    ghosts: usize,
    /// Least and greatest gain of a key frame that was taken from its colours; none with --raw-colours.
    gains: Option<[f64; 2]>,
    notices: Vec<String>,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    let slam = SlamRun::open(&args.run)?;
    let mut keyframes = chosen(&slam, &args)?;
    let mut config = MapConfig {
        voxel: args.voxel,
        cell: args.cell,
        min_points: args.min_points,
        max_relative_sigma: args.max_relative_sigma,
        surest: !args.every_point,
        statistic: args.statistic.into(),
        ..MapConfig::default()
    };
    config.limits.max_depth = args.max_depth;
    let noise = args.sensor.as_deref().map(read_noise).transpose()?;
    if let Some(NoiseModel::Stereo { disparity, .. }) = noise {
        // What was measured of the sensor replaces what is assumed of all.
        config.limits.default_sigma = disparity;
        config.limits.min_sigma = disparity;
    }
    if args.poses.is_some() {
        config.levelling = Levelling::World;
    }
    if let Some(file) = &args.align {
        let run = Trajectory {
            poses: keyframes.iter().map(|k| k.pose).collect(),
        };
        let reference = read_places(file)?;
        let found = align(&run, &reference, DEFAULT_TOLERANCE)
            .with_context(|| format!("{} and {}", file.display(), args.run.display()))?;
        config.levelling = Levelling::Known(found.T_truth_est);
        trust_the_fit(&mut keyframes, &found, &reference);
    }
    let sensor = match noise {
        Some(noise) => noise.sensor(slam.rig.fx, slam.rig.baseline),
        None => StereoErrors {
            systematic: args.systematic,
            ..StereoErrors::default()
        }
        .sensor(&slam.rig),
    };
    let out = StagedDir::new(&args.out, "summary.json")?;

    // The key frames are read again and again rather than kept: what their gains are, what is a ghost and what is
    // up is known when all were seen.
    let passes = 2 + usize::from(args.clear_ghosts) + usize::from(!args.raw_colours);
    let bar = output.progress("map", passes * keyframes.len());
    let (bar, run) = (&bar, &slam);
    let frames = |gains: &[[f64; 3]]| {
        let gains = gains.to_vec();
        keyframes.iter().enumerate().map(move |(i, k)| {
            bar.inc(1);
            let keyframe = run.read(k)?;
            Ok::<DenseKeyframe, anyhow::Error>(match gains.get(i) {
                Some(gain) => keyframe.without_gain(gain),
                None => keyframe,
            })
        })
    };
    let gains = match args.raw_colours {
        true => vec![],
        false => colour_gains(frames(&[]), &slam.rig, &config)?,
    };
    let mut scene = VoxelScene::gather(frames(&gains), &slam.rig, &config)?;
    let ghosts = match args.clear_ghosts {
        true => scene.clear_ghosts(frames(&[]), &slam.rig, &config.limits)?,
        false => 0,
    };
    let mut registered = None;
    if let Some(file) = &args.register {
        let (motion, notice) = registration(&scene.clone().into_terrain(&config)?, file)?;
        config.levelling = Levelling::Known(motion);
        registered = Some(notice);
    }
    let mut map = scene.into_terrain(&config)?;
    map.notices.extend(registered);
    let elevation = elevation_of_keyframes(
        frames(&gains),
        &slam.rig,
        &map.T_level_world,
        &config.limits,
        sensor,
        args.clear_ghosts,
        &ElevationConfig {
            cell: map.cell,
            min_looks: args.min_looks.min(keyframes.len() as u32),
            ..ElevationConfig::default()
        },
    )?;
    bar.finish_and_clear();
    let pose_covariance = keyframes.iter().all(|k| k.covariance.is_some());
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
        ghosts,
        gains: range(&gains),
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

/// The motion that takes the run's world onto a survey of the same ground, and what is to be said of it.
fn registration(map: &TerrainMap, survey: &Path) -> Result<(Se3, String)> {
    /// Farther from the survey than this a point does not correspond, metres: what `--align` may leave.
    const REACH: f64 = 2.0;
    /// Points of the map that are used: more change nothing but the time.
    const POINTS: usize = 50_000;
    /// A smaller share of points near the survey is said to be doubtful: so a false fit looks.
    const OVERLAP: f64 = 0.8;
    let points = map.cloud().points;
    let step = points.len().div_ceil(POINTS).max(1);
    let sample: Vec<_> = points.iter().step_by(step).map(|p| p.position).collect();
    let reference =
        Reference::new(&read_points(survey)?).with_context(|| survey.display().to_string())?;
    let config = IcpConfig {
        max_distance: REACH,
        ..IcpConfig::default()
    };
    let found = register_from_afar(&sample, &reference, &Se3::identity(), &config)
        .with_context(|| survey.display().to_string())?;
    let doubt = match found.overlap < OVERLAP {
        true => {
            "; that is few, and the fit may be false\n  cure: --align brings the map near the survey first"
        }
        false => "",
    };
    let text = format!(
        "registered to {}: moved by {:.3} m and {:.3} degrees, {:.0} % of its points lie within {} m of the survey, RMSE {:.3} m{doubt}",
        survey.display(),
        found.translation,
        found.rotation_deg,
        100.0 * found.overlap,
        0.25 * REACH,
        found.rmse
    );
    Ok((found.T_ref_est * map.T_level_world, text))
}

/// Least and greatest of all gains; none of none.
fn range(gains: &[[f64; 3]]) -> Option<[f64; 2]> {
    let all = || gains.iter().flatten().copied();
    let (least, greatest) = (all().reduce(f64::min)?, all().reduce(f64::max)?);
    Some([least, greatest])
}

/// `noise.toml` of `barchan noise`.
fn read_noise(file: &Path) -> Result<NoiseModel> {
    let text = std::fs::read_to_string(file).with_context(|| file.display().to_string())?;
    let cure = "expected what `barchan noise` writes: kind and its coefficients";
    let model: NoiseModel =
        toml::from_str(&text).with_context(|| format!("{}: {cure}", file.display()))?;
    model.check().with_context(|| file.display().to_string())?;
    Ok(model)
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

/// Makes covariances of what the fit to a reference leaves. A run says how far each key frame may be off against the first;
/// where there are poses to compare with, the fit says how far all are off, which is less where the way was long and
/// more where it began. Key frames beyond the reference may be off by both, and so may all where the reference has so few
/// poses that any motion would fit.
fn trust_the_fit(keyframes: &mut [RunKeyframe], found: &Alignment, reference: &Trajectory) {
    const ENOUGH: usize = 20;
    let times = || reference.poses.iter().map(|pose| pose.time);
    let first = times().fold(f64::INFINITY, f64::min);
    let last = times().fold(f64::NEG_INFINITY, f64::max);
    for keyframe in keyframes {
        let compared = found.poses >= ENOUGH && (first..=last).contains(&keyframe.pose.time);
        if let Some(covariance) = &mut keyframe.covariance {
            *covariance = match compared {
                true => found.residual,
                false => *covariance + found.residual,
            };
        }
    }
}

/// Which of the run's key frames the map is made of, and where they are.
fn chosen(run: &SlamRun, args: &Args) -> Result<Vec<RunKeyframe>> {
    let Some(file) = &args.poses else {
        let part = args.submap.unwrap_or_else(|| run.largest_part());
        let keyframes = run.keyframes.iter().filter(|k| k.submap == part);
        let keyframes: Vec<_> = keyframes.cloned().collect();
        if keyframes.is_empty() {
            bail!(
                "{}: no key frame is of part {part} of the map\n  cure: see submap in keyframes.csv",
                args.run.display()
            );
        }
        return Ok(keyframes);
    };
    // Poses from elsewhere say how the parts lie to each other. The covariances of the run say nothing of
    // them, and key frames that they do not reach are left out.
    let others = Trajectory::read_tum(file)?;
    let placed = run.keyframes.iter().filter_map(|k| {
        let mut k = k.clone();
        k.pose.T_world_cam = others.at(k.pose.time)?;
        k.covariance = None;
        Some(k)
    });
    let keyframes: Vec<_> = placed.collect();
    if keyframes.is_empty() {
        bail!(
            "{}: none of its times is that of a key frame of {}\n  cure: give both the same clock",
            file.display(),
            args.run.display()
        );
    }
    Ok(keyframes)
}
