use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_datasets::{disparity_file, read_rgb};
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, associate, umeyama};
use barchan_geometry::Trajectory;
use barchan_geometry::nalgebra::{Point3, Vector3};
use barchan_report::{Chart, Cloud3d, Relief, Report, Series, Style};
use barchan_terrain::{Cloud, Grid, Raster};
use clap::Parser;
use image::RgbImage;
use image::imageops::replace;
use serde::Serialize;
use serde_json::Value;

use crate::commands::eval::read_trajectory;
use crate::output::Output;
use crate::preview::{certainty_picture, disparity_beside_image, disparity_range};

/// A run as one HTML file that needs no network
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan report runs/s --map runs/map\n  \
    barchan report runs/s --map runs/map --gt images/groundtruth.tum --out day1.html")]
pub struct Args {
    /// A run of `barchan slam`, or the folder of a demo with `slam` and `map` in it
    run: PathBuf,
    /// What `barchan map` made of it
    #[arg(long, value_name = "DIR")]
    map: Option<PathBuf>,
    /// The true trajectory
    #[arg(long, value_name = "FILE")]
    gt: Option<PathBuf>,
    /// The file that is written [default: report.html in RUN]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

#[derive(Serialize)]
struct Summary {
    out: PathBuf,
    bytes: usize,
}

/// Most key frames that are shown.
const PICTURES: usize = 6;

pub fn run(args: Args, output: &Output) -> Result<()> {
    let (slam, map) = parts(&args.run, args.map.clone())?;
    let truth = args.run.join("data/groundtruth.tum");
    let truth = (args.gt.clone()).or_else(|| truth.is_file().then_some(truth));
    let out = args.out.unwrap_or_else(|| args.run.join("report.html"));
    let mut report = Report {
        title: format!("Barchan: {}", name_of(out.parent().unwrap_or(&out))),
        source: slam.display().to_string(),
        config: std::fs::read_to_string(slam.join("config.toml")).unwrap_or_default(),
        ..Report::default()
    };
    add_run(&mut report, &slam)?;
    add_route(&mut report, &slam, truth.as_deref())?;
    add_pictures(&mut report, &slam)?;
    if let Some(map) = &map {
        add_map(&mut report, map, &slam)?;
    }
    let html = report.html()?;
    barchan_model::weights::write_atomically(&out, html.as_bytes())?;
    let text = format!("{}: {:.1} MB", out.display(), html.len() as f64 / 1e6);
    let bytes = html.len();
    output.result(&Summary { out, bytes }, &text)
}

fn name_of(path: &Path) -> String {
    let whole = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let name = whole.file_name().unwrap_or_default();
    name.to_string_lossy().into_owned()
}

fn read_json(path: &Path) -> Result<Value> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    serde_json::from_str(&text).with_context(|| path.display().to_string())
}

/// Figures, what happened at which frame, and how long frames took.
fn add_run(report: &mut Report, slam: &Path) -> Result<()> {
    let summary = read_json(&slam.join("summary.json"))?;
    let number = |key: &str| summary.get(key).and_then(Value::as_f64);
    let mut figure = |name: &str, key: &str, unit: &str, digits: usize| {
        if let Some(value) = number(key) {
            let text = format!("{value:.digits$} {unit}");
            let text = text.trim_end().to_owned();
            report.figures.push((name.into(), text));
        }
    };
    figure("frames", "frames", "", 0);
    figure("tracked", "tracked", "", 0);
    figure("key frames", "keyframes", "", 0);
    figure("loops closed", "loops", "", 0);
    figure("points of the map", "points", "", 0);
    figure("a frame, median", "ms_track_median", "ms", 1);
    figure("a frame, 95th percentile", "ms_track_p95", "ms", 1);
    figure("disparity of a key frame", "ms_disparity_median", "ms", 1);
    figure("sustained", "fps", "frames/s", 1);
    if let (Some(frames), Some(tracked)) = (number("frames"), number("tracked"))
        && tracked < frames
    {
        let lost = frames - tracked;
        report.warnings.push(format!(
            "{lost} of {frames} frames are lost: where the camera was then is a guess."
        ));
    }
    if let Some(parts) = number("submaps").filter(|parts| *parts > 1.0) {
        report.warnings.push(format!(
            "The map is of {parts} parts that are not joined: how they lie to each other is a guess."
        ));
    }

    let frames = read_lines(&slam.join("log.jsonl"))?;
    // Other methods than `stereo` have no such file: their key frames are made at once.
    let of_keyframes = slam.join("keyframes.jsonl");
    let mapped = match of_keyframes.is_file() {
        true => read_lines(&of_keyframes)?,
        false => (frames.iter().filter(|f| f["keyframe"] == true))
            .cloned()
            .collect(),
    };
    let at = |f: &Value, key: &str| Some((f["frame"].as_f64()?, f[key].as_f64()?));
    let samples = |key: &str, only_keyframes: bool| {
        let is_keyframe = |f: &&Value| f["keyframe"] == true || !only_keyframes;
        let frames = frames.iter().filter(is_keyframe);
        frames.filter_map(|f| at(f, key)).collect::<Vec<_>>()
    };
    let line = |name: &str, key: &str| Series {
        name: name.into(),
        style: Style::Line,
        samples: samples(key, false),
    };
    report.charts.push(Chart {
        title: "Time".into(),
        horizontal: "frame".into(),
        vertical: "ms".into(),
        plan: false,
        series: vec![
            line("from images to pose", "ms_track"),
            Series {
                name: "disparity, at key frames".into(),
                style: Style::Marks,
                samples: mapped
                    .iter()
                    .filter_map(|f| at(f, "ms_disparity"))
                    .collect(),
            },
        ],
    });
    report.charts.push(Chart {
        title: "What frames agree on".into(),
        horizontal: "frame".into(),
        vertical: "features or points".into(),
        plan: false,
        // Each method has some of these.
        series: [
            line("features with a disparity", "stereo"),
            line("points of the cloud", "points"),
            line("features that match the last key frame", "matches"),
            line("points that agree", "inliers"),
            Series {
                name: "key frames".into(),
                style: Style::Marks,
                samples: samples("inliers", true),
            },
        ]
        .into_iter()
        .filter(|s| !s.samples.is_empty())
        .collect(),
    });
    let memory = line("of the whole program", "mb_resident");
    if !memory.samples.is_empty() {
        report.charts.push(Chart {
            title: "Memory".into(),
            horizontal: "frame".into(),
            vertical: "MB".into(),
            plan: false,
            series: vec![memory],
        });
    }
    for event in summary["loop_events"].as_array().into_iter().flatten() {
        let place = &event["earlier_frame"];
        let moved = event["moved"].as_f64().unwrap_or_default();
        let what = format!(
            "sees the place of frame {place} again: {} points agree, the loop moves it by {moved:.3} m",
            event["map_points"][1]
        );
        report.events.push((
            format!("{:06}", event["frame"].as_u64().unwrap_or_default()),
            what,
        ));
    }
    // The first frame of each stretch that is lost.
    let mut before = true;
    for frame in &frames {
        let tracked = frame["tracked"] == true;
        if before != tracked {
            let name = frame["name"].as_str().unwrap_or_default().to_owned();
            let reason = frame["reason"].as_str().unwrap_or_default();
            let what = if tracked {
                "found again".into()
            } else {
                format!("lost: {reason}")
            };
            report.events.push((name, what));
        }
        before = tracked;
    }
    Ok(())
}

/// The values that a file has, one a line.
fn read_lines(path: &Path) -> Result<Vec<Value>> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let values: Result<_, _> = text.lines().map(serde_json::from_str).collect();
    values.with_context(|| path.display().to_string())
}

/// The way from above, over the truth where it is known. From above is along the vertical of the first camera.
fn add_route(report: &mut Report, slam: &Path, truth: Option<&Path>) -> Result<()> {
    let estimate = Trajectory::read_tum(&slam.join("trajectory.tum"))?;
    let positions = |poses: &[barchan_geometry::StampedPose]| -> Vec<Vector3<f64>> {
        poses
            .iter()
            .map(|p| p.T_world_cam.translation.vector)
            .collect()
    };
    let from_above = |name: &str, style: Style, places: Vec<Vector3<f64>>| Series {
        name: name.into(),
        style,
        samples: places.into_iter().map(|p| (p.x, p.z)).collect(),
    };
    let keyframes = Trajectory::read_tum(&slam.join("keyframes.tum"))?;
    let mut series = vec![
        from_above("estimate", Style::Line, positions(&estimate.poses)),
        from_above("key frames", Style::Marks, positions(&keyframes.poses)),
    ];
    if let Some(path) = truth {
        let truth = read_trajectory(path)?;
        let pairs = associate(&estimate, &truth, DEFAULT_TOLERANCE)
            .with_context(|| path.display().to_string())?;
        let places = |poses: &[barchan_geometry::Se3]| -> Vec<Vector3<f64>> {
            poses.iter().map(|p| p.translation.vector).collect()
        };
        let (est, gt) = (
            places(&pairs.T_world_cam_est),
            places(&pairs.T_world_cam_true),
        );
        // The truth is brought to the estimate, so that the picture is that of the map.
        let motion = umeyama(&gt, &est, false).with_context(|| path.display().to_string())?;
        let aligned: Vec<Vector3<f64>> = gt.iter().map(|p| motion.apply(p)).collect();
        let squares = aligned
            .iter()
            .zip(&est)
            .map(|(a, b)| (a - b).norm_squared());
        let ate = (squares.sum::<f64>() / est.len() as f64).sqrt();
        let length = barchan_eval::trajectory::path_length(&gt);
        report.figures.push((
            "error of the route (ATE)".into(),
            format!("{ate:.3} m of {length:.1} m"),
        ));
        series.push(from_above("truth", Style::Line, aligned));
    }
    report.charts.insert(
        0,
        Chart {
            title: "Route from above".into(),
            horizontal: "right of the first camera, m".into(),
            vertical: "ahead of it, m".into(),
            plan: true,
            series,
        },
    );
    Ok(())
}

/// Some key frames: image, disparity, and how sure that is.
fn add_pictures(report: &mut Report, slam: &Path) -> Result<()> {
    let folder = slam.join("keyframes/disparity");
    let Ok(entries) = folder.read_dir() else {
        return Ok(());
    };
    let mut files: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
    files.sort();
    let every = files.len().div_ceil(PICTURES).max(1);
    for file in files.iter().step_by(every) {
        let beside = |folder: &str| {
            let name = file.file_name().unwrap_or_default();
            slam.join("keyframes").join(folder).join(name)
        };
        let left = read_rgb(&beside("left"))?;
        let disparity = disparity_file::read(file)?;
        let both = disparity_beside_image(&left, &disparity, disparity_range(&disparity));
        let name = file.file_stem().unwrap_or_default().to_string_lossy();
        let mut caption =
            format!("frame {name}: image, disparity (red is near, black is rejected)");
        let sigma = beside("sigma");
        let picture = match sigma.is_file() {
            false => both,
            true => {
                let sure = certainty_picture(&disparity, &disparity_file::read(&sigma)?);
                caption += ", confidence (white is right to a pixel)";
                let mut three = RgbImage::new(both.width() + sure.width(), both.height());
                replace(&mut three, &both, 0, 0);
                replace(&mut three, &sure, both.width().into(), 0);
                three
            }
        };
        report.pictures.push((caption, picture));
    }
    Ok(())
}

/// Half the distance from the lower to the upper bound, in the cells of a grid; `None` where the file is
/// not there or has no bounds.
fn half_bands(file: &Path, grid: &Grid) -> Result<Option<Raster<f32>>> {
    if !file.is_file() {
        return Ok(None);
    }
    let bands = Raster::<f32>::read_bands(file)?;
    let band = |name: &str| bands.iter().find(|(n, _)| n == name).map(|(_, b)| b);
    let (Some(lower), Some(upper)) = (band("lower"), band("upper")) else {
        return Ok(None);
    };
    let half = lower.values.iter().zip(&upper.values);
    let half = Raster {
        grid: lower.grid,
        crs: lower.crs.clone(),
        values: half.map(|(low, high)| 0.5 * (high - low)).collect(),
    };
    Ok(Some(half.onto(grid)))
}

/// The heights of a map of `barchan map`.
pub fn relief(map: &Path) -> Result<Relief> {
    let elevation = Raster::read(&map.join("dem.tif"))?;
    Ok(Relief {
        bound: half_bands(&map.join("elevation.tif"), &elevation.grid)?,
        shade: Raster::read(&map.join("hillshade.tif"))?,
        elevation,
    })
}

/// Where the run and the map of a folder are: the folder itself or `slam` in it, what is given or `map` in it.
pub fn parts(folder: &Path, map: Option<PathBuf>) -> Result<(PathBuf, Option<PathBuf>)> {
    let inside = |name: &str| Some(folder.join(name)).filter(|p| p.exists());
    let slam = inside("slam").unwrap_or_else(|| folder.to_owned());
    if !slam.join("trajectory.tum").is_file() {
        bail!(
            "{}: no run of `barchan slam` (there is no trajectory.tum)\n  cure: `barchan slam --data DATA --out {0}` makes one",
            slam.display()
        );
    }
    Ok((slam, map.or_else(|| inside("map"))))
}

/// Cloud and relief.
fn add_map(report: &mut Report, map: &Path, slam: &Path) -> Result<()> {
    let summary = read_json(&map.join("summary.json"))?;
    for notice in summary["notices"].as_array().into_iter().flatten() {
        report.warnings.extend(notice.as_str().map(str::to_owned));
    }
    let text = |key: &str| summary[key].as_f64().map(|v| format!("{v}"));
    if let (Some(voxel), Some(cell)) = (text("voxel"), text("cell")) {
        let sizes = format!("{voxel} m, {cell} m");
        report
            .figures
            .push(("voxel, cell of the relief".into(), sizes));
    }
    let route = map.join("keyframes.tum");
    let route = match route.is_file() {
        true => Trajectory::read_tum(&route)?.poses,
        false => vec![],
    };
    let place =
        |p: &barchan_geometry::StampedPose| Point3::from(p.T_world_cam.translation.vector).into();
    report.cloud = Some(Cloud3d {
        points: Cloud::read_ply(&map.join("cloud.ply"))?.points,
        route: route.iter().map(place).collect(),
    });
    report.relief = Some(relief(map)?);
    report.source = format!("{} and {}", slam.display(), map.display());
    Ok(())
}
