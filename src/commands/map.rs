use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_datasets::{disparity_file, read_rgb};
use barchan_geometry::{Rig, StampedPose, Trajectory};
use barchan_terrain::{DenseKeyframe, MapConfig, map_keyframes};
use clap::Parser;
use serde::Serialize;

use crate::output::{Output, StagedDir};

/// Turn a SLAM run into terrain: voxel cloud, DEM, hillshade
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan map runs/s --out map/\n  \
    barchan map runs/s --voxel 0.02 --cell 0.05 --out map/")]
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
    /// Farthest accepted depth, metres [default: where depth is known to 10 %]
    #[arg(long, value_name = "M")]
    max_depth: Option<f64>,
    /// The directory that is written
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
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
    notices: Vec<String>,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    let (rig, keyframes) = open_run(&args.run)?;
    let mut config = MapConfig {
        voxel: args.voxel,
        cell: args.cell,
        min_points: args.min_points,
        ..MapConfig::default()
    };
    config.limits.max_depth = args.max_depth;
    let out = StagedDir::new(&args.out, "summary.json")?;

    let poses: Vec<StampedPose> = keyframes.iter().map(|k| k.pose).collect();
    let bar = output.progress("map", keyframes.len());
    let frames = keyframes.into_iter().map(|k| {
        bar.inc(1);
        k.read()
    });
    let map = map_keyframes(frames, &rig, &config)?;
    bar.finish_and_clear();
    for notice in &map.notices {
        output.notice(notice);
    }

    map.cloud().write_ply(&out.path("cloud.ply")?)?;
    map.dem.write(&out.path("dem.tif")?)?;
    map.hillshade.write(&out.path("hillshade.tif")?)?;
    let levelled = poses.into_iter().map(|pose| StampedPose {
        T_world_cam: map.T_level_world * pose.T_world_cam,
        ..pose
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
        width: map.dem.grid.width,
        height: map.dem.grid.height,
        notices: map.notices.clone(),
    };
    out.write_json("summary.json", &summary)?;
    out.finish()?;
    let text = format!(
        "{} key frames, {} points in {} voxels of {} m; DEM {} x {} cells of {} m ({:.1} x {:.1} m)\n{}: cloud.ply dem.tif hillshade.tif keyframes.tum",
        summary.keyframes,
        summary.points,
        summary.voxels,
        summary.voxel,
        summary.width,
        summary.height,
        summary.cell,
        summary.width as f64 * summary.cell,
        summary.height as f64 * summary.cell,
        args.out.display(),
    );
    output.result(&summary, &text)
}

/// Where the parts of a key frame lie.
struct KeyframeFiles {
    run: PathBuf,
    name: String,
    pose: StampedPose,
}

impl KeyframeFiles {
    fn read(self) -> Result<DenseKeyframe> {
        let file = |folder: &str| {
            self.run
                .join("keyframes")
                .join(folder)
                .join(format!("{}.png", self.name))
        };
        Ok(DenseKeyframe {
            T_world_cam: self.pose.T_world_cam,
            left: read_rgb(&file("left"))?,
            disparity: disparity_file::read(&file("disparity"))?,
            sigma: Some(disparity_file::read(&file("sigma"))?),
        })
    }
}

/// The rig and the key frames of a run: `keyframes.tum` has a line for every name, in order, in
/// `keyframes/left`.
fn open_run(run: &Path) -> Result<(barchan_geometry::RectifiedRig, Vec<KeyframeFiles>)> {
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
    let poses = Trajectory::read_tum(&trajectory)?.poses;
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
    if names.len() != poses.len() {
        bail!(
            "{}: {} poses, but {} disparity images in {}",
            trajectory.display(),
            poses.len(),
            names.len(),
            folder.display()
        );
    }
    let keyframes = names
        .into_iter()
        .zip(poses)
        .map(|(name, pose)| KeyframeFiles {
            run: run.to_owned(),
            name,
            pose,
        })
        .collect();
    Ok((rig, keyframes))
}
