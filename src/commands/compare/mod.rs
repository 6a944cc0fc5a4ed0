//! Methods and engines side by side, on one sequence: one table, and pictures as in the papers.

mod maps;
mod pictures;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_datasets::StereoSource;
use barchan_eval::time_shift::{TimeShift, time_shift};
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, align, associate, path_length, score};
use barchan_geometry::nalgebra::Vector3;
use barchan_geometry::{Se3, Trajectory};
use barchan_terrain::TerrainMap;
use clap::{Parser, ValueEnum};
use serde::Serialize;
use serde_json::Value;

use self::maps::{Ground, from_above};
use crate::commands::eval::read_trajectory;
use crate::commands::slam::{self, Method};
use crate::data::{Unchecked, open_checked};
use crate::engine::{DEFAULT_MODEL, EngineSettings};
use crate::output::{Output, StagedDir};

/// Compare methods and disparity engines on one sequence: a table, routes, maps, disparities
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan compare --data synth:seed=1,frames=60 --out runs/compare\n  \
    barchan compare --data images/ --method stereo --method icp --model sgm --model rover --out runs/c\n  \
    barchan compare --data images/ --method icp --run fused=runs/f --out runs/c   a run that is there already\n  \
    barchan compare --data images/ --poses sfm.tum --json --out runs/c            with the combined method")]
pub struct Args {
    /// A stereo sequence: PATH or FORMAT:PATH. With true poses routes are scored, with true disparity maps as well
    #[arg(long)]
    data: String,
    /// A method, as of `barchan slam`; may be given several times [default: all]
    #[arg(long = "method", value_enum, value_name = "METHOD")]
    methods: Vec<Method>,
    /// What sees disparity, as of `barchan slam`; may be given several times
    #[arg(long = "model", value_name = "MODEL", default_values = [DEFAULT_MODEL, "sgm", "bm"])]
    models: Vec<String>,
    /// A run of `barchan slam` over the same data that takes part as it is; may be given several times
    #[arg(long = "run", value_name = "NAME=DIR")]
    runs: Vec<String>,
    /// Poses up to scale for the combined method: TUM text [default: those of a run named sfm, else of structure from motion]
    #[arg(long, value_name = "FILE")]
    poses: Option<PathBuf>,
    /// The true trajectory, where the data has none: .tum, KITTI text or gt.csv
    #[arg(long, value_name = "FILE")]
    gt: Option<PathBuf>,
    /// The directory that is written
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    engine: EngineSettings,
    #[command(flatten)]
    unchecked: Unchecked,
}

/// Largest difference of the clocks of images and truth that is looked for, seconds.
const MOST_SHIFT: f64 = 5.0;

/// One line of the table.
#[derive(Debug, Default, Serialize)]
struct Row {
    /// How it is called, in the table and in the pictures.
    name: String,
    /// Where the run is, as seen from the folder that is written.
    run: PathBuf,
    /// Why there are no figures; empty when there are.
    failed: String,
    frames: usize,
    tracked: usize,
    keyframes: usize,
    /// Root mean square error of positions after rigid alignment, metres.
    ate: Option<f64>,
    /// The same over the length of the way, percent.
    ate_percent: Option<f64>,
    /// How far the way from the first to the last frame is off, over its length, percent.
    drift_percent: Option<f64>,
    /// Root mean square difference of heights of the map and of the true ground, metres.
    map_rmse: Option<f64>,
    /// Share of the cells of the true ground (where that is not known, of all maps together) that the map
    /// knows, percent.
    coverage_percent: Option<f64>,
    /// Milliseconds a frame, all together.
    ms: Option<f64>,
    /// By how much the images are ahead of the truth, as this run has it.
    clocks: Option<TimeShift>,
}

/// What `--json` prints and `compare.json` holds.
#[derive(Serialize)]
struct Comparison<'a> {
    data: &'a str,
    /// Length of the true way, metres.
    length: Option<f64>,
    /// What maps are held against.
    ground: &'static str,
    rows: Vec<&'a Row>,
}

/// A run, placed among the others.
#[derive(Default)]
struct Compared {
    row: Row,
    /// Its route from above, beside the true one.
    route: Vec<(f64, f64)>,
    /// Its map, in the frame of all maps.
    map: Option<TerrainMap>,
    /// Its route from above, in that frame.
    route_on_map: Vec<(f64, f64)>,
}

pub fn run(args: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    let source = open_checked(&args.data, &args.unchecked, output)?;
    let given = given_runs(&args)?;
    let truth = match &args.gt {
        Some(file) => Some(read_trajectory(file)?),
        None => source.true_trajectory().cloned(),
    };
    let out = StagedDir::new(&args.out, "compare.json")?;

    // Runs first: each leaves a folder, whatever its method, and all else is read from there.
    let mut rows = given;
    for (name, words) in planned(&args, &rows) {
        let folder = out.path(format!("runs/{name}"))?;
        output.say(&format!("{name} ..."));
        let mut row = Row {
            run: Path::new("runs").join(&name),
            name,
            ..Row::default()
        };
        if let Err(why) = run_slam(&words, &folder, output, runtime) {
            row.failed = format!("{why:#}");
            output.notice(&format!("{}: {}", row.name, row.failed));
        }
        rows.push((row, folder));
    }

    let mut ground = Ground::of_truth(source.as_ref(), truth.as_ref(), output)?;
    let mut compared = vec![];
    for (row, folder) in rows {
        let mut run = Compared {
            row,
            ..Compared::default()
        };
        if run.row.failed.is_empty()
            && let Err(why) = run.judge(&folder, truth.as_ref(), &mut ground)
        {
            run.row.failed = format!("{why:#}");
        }
        compared.push(run);
    }
    ground.cover(&mut compared);

    let true_route = truth.as_ref().map(|t| ground.route(t, &Se3::identity()));
    pictures::routes(&out, &compared, true_route)?;
    pictures::maps(&out, &compared, ground.truth(), truth.as_ref())?;
    let engines = (&args.models[..], &args.engine);
    pictures::disparities(&out, source.as_ref(), engines, runtime)?;
    let comparison = Comparison {
        data: &args.data,
        length: truth.as_ref().map(|t| path_length(&positions(t))),
        ground: ground.name(),
        rows: compared.iter().map(|c| &c.row).collect(),
    };
    let text = table(&comparison);
    out.write_json("compare.json", &comparison)?;
    out.write("compare.txt", &text)?;
    out.finish()?;
    let text = format!(
        "{text}\n{}: compare.txt compare.json routes.svg maps.svg disparities.svg runs/",
        args.out.display()
    );
    output.result(&comparison, &text)?;
    match compared.iter().all(|c| !c.row.failed.is_empty()) {
        true => bail!("{}: no method came to an end", args.data),
        false => Ok(()),
    }
}

/// Runs that are there already.
fn given_runs(args: &Args) -> Result<Vec<(Row, PathBuf)>> {
    let row = |given: &String| {
        let (name, folder) = given
            .split_once('=')
            .with_context(|| format!("--run {given}: expected NAME=DIR"))?;
        let plain = |c: char| c.is_alphanumeric() || "-_.".contains(c);
        if name.is_empty() || !name.chars().all(plain) {
            bail!("--run {given}: a name is of letters, digits, - _ and .");
        }
        let folder = PathBuf::from(folder);
        let row = Row {
            name: name.to_owned(),
            run: folder.clone(),
            ..Row::default()
        };
        Ok((row, folder))
    };
    args.runs.iter().map(row).collect()
}

/// Names of the runs to be made, and what `barchan slam` is told for each besides where to write it.
fn planned(args: &Args, given: &[(Row, PathBuf)]) -> Vec<(String, Vec<String>)> {
    let of_sfm = given.iter().find(|(row, _)| row.name == "sfm");
    let poses =
        (args.poses.clone()).or_else(|| of_sfm.map(|(_, folder)| folder.join("trajectory.tum")));
    let methods = match args.methods.is_empty() {
        true => Method::value_variants(),
        false => &args.methods,
    };
    let mut runs: Vec<(String, Vec<String>)> = vec![];
    for method in methods {
        let value = method.to_possible_value();
        let method_name = value.as_ref().map_or("", |v| v.get_name());
        for model in &args.models {
            let mut words = [
                "--data",
                &args.data,
                "--method",
                method_name,
                "--model",
                model,
            ]
            .map(str::to_owned)
            .to_vec();
            words.extend(["--threads".into(), args.engine.threads.to_string()]);
            if let Some(passes) = args.engine.outlines {
                words.extend(["--outlines".into(), passes.to_string()]);
            }
            if args.unchecked.no_check {
                words.push("--no-check".into());
            }
            if let Method::Combined = method {
                // Without, it makes its own.
                if let Some(poses) = &poses {
                    words.extend(["--poses".into(), poses.display().to_string()]);
                }
            }
            let engine = Path::new(model).file_stem().unwrap_or_default();
            let name = format!("{method_name}-{}", engine.to_string_lossy()).replace(':', "-");
            let one_camera = *method == Method::Sfm;
            let name = if one_camera {
                method_name.to_owned()
            } else {
                name
            };
            let taken = |name: &str| {
                given.iter().any(|(row, _)| row.name == name)
                    || runs.iter().any(|(other, _)| other == name)
            };
            let numbered = (2..).map(|n| format!("{name}-{n}"));
            let free = std::iter::once(name.clone())
                .chain(numbered)
                .find(|n| !taken(n));
            runs.extend(free.map(|name| (name, words)));
            if one_camera {
                break;
            }
        }
    }
    runs
}

/// `barchan slam` as anybody could type it.
fn run_slam(
    words: &[String],
    folder: &Path,
    output: &Output,
    runtime: Option<&Path>,
) -> Result<()> {
    let mut command = vec!["slam".to_owned()];
    command.extend_from_slice(words);
    command.extend(["--out".into(), folder.display().to_string()]);
    slam::run(
        slam::Args::try_parse_from(command)?,
        &output.quiet(),
        runtime,
    )
}

impl Compared {
    /// Reads a run: its figures, its route, its map.
    fn judge(
        &mut self,
        folder: &Path,
        truth: Option<&Trajectory>,
        ground: &mut Ground,
    ) -> Result<()> {
        let file = folder.join("summary.json");
        let text = std::fs::read_to_string(&file)
            .with_context(|| format!("{}: no run of `barchan slam`", folder.display()))?;
        let summary: Value =
            serde_json::from_str(&text).with_context(|| file.display().to_string())?;
        let count = |key: &str| summary[key].as_u64().unwrap_or_default() as usize;
        let row = &mut self.row;
        row.frames = count("frames");
        row.tracked = count("tracked");
        row.keyframes = count("keyframes");
        row.ms = summary["fps"].as_f64().map(|fps| 1e3 / fps);

        let route = Trajectory::read_tum(&folder.join("trajectory.tum"))?;
        let mut motion = Se3::identity();
        if let Some(truth) = truth {
            let found = score(&route, truth, DEFAULT_TOLERANCE)?;
            motion = align(&route, truth, DEFAULT_TOLERANCE)?.T_truth_est;
            row.ate = Some(found.ate_rmse);
            row.ate_percent = Some(100.0 * found.ate_rmse / found.length);
            let off = end_error(&route, truth, &motion)?;
            row.clocks = time_shift(&route, truth, MOST_SHIFT).ok();
            row.drift_percent = Some(100.0 * off / found.length);
        }
        self.map = ground.map(folder, &motion)?;
        self.route = ground.route(&route, &motion);
        if let Some(map) = &self.map {
            row.map_rmse = ground.rmse(map);
            self.route_on_map = from_above(&route, &map.T_level_world, [0, 1]);
        }
        Ok(())
    }
}

/// By how much the way from the first to the last pose is off, metres.
fn end_error(route: &Trajectory, truth: &Trajectory, motion: &Se3) -> Result<f64> {
    let pairs = associate(route, truth, DEFAULT_TOLERANCE)?;
    let whole = |poses: &[Se3]| match (poses.first(), poses.last()) {
        (Some(a), Some(b)) => b.translation.vector - a.translation.vector,
        _ => Vector3::zeros(),
    };
    let estimated = motion.rotation * whole(&pairs.T_world_cam_est);
    Ok((estimated - whole(&pairs.T_world_cam_true)).norm())
}

fn positions(trajectory: &Trajectory) -> Vec<Vector3<f64>> {
    let place = |p: &barchan_geometry::StampedPose| p.T_world_cam.translation.vector;
    trajectory.poses.iter().map(place).collect()
}

fn table(comparison: &Comparison) -> String {
    let number =
        |value: Option<f64>, digits: usize| value.map_or("-".into(), |v| format!("{v:.digits$}"));
    let widest = comparison.rows.iter().map(|r| r.name.chars().count()).max();
    let wide = widest.unwrap_or(0).max(4);
    let mut text = format!(
        "{:<wide$} {:>9} {:>8} {:>7} {:>8} {:>8} {:>8} {:>9}\n",
        "run", "frames", "ATE m", "ATE %", "drift %", "map m", "cover %", "ms/frame"
    );
    for r in &comparison.rows {
        text += &match r.failed.is_empty() {
            false => format!("{:<wide$} failed: {}\n", r.name, r.failed),
            true => format!(
                "{:<wide$} {:>9} {:>8} {:>7} {:>8} {:>8} {:>8} {:>9}\n",
                r.name,
                format!("{}/{}", r.tracked, r.frames),
                number(r.ate, 4),
                number(r.ate_percent, 2),
                number(r.drift_percent, 2),
                number(r.map_rmse, 4),
                number(r.coverage_percent, 1),
                number(r.ms, 1)
            ),
        };
    }
    if let Some(length) = comparison.length {
        text += &format!("the way is {length:.2} m long; ");
    }
    let clocks = comparison.rows.iter().filter_map(|r| r.clocks);
    if let Some(c) = clocks.min_by(|a, b| a.error_after.total_cmp(&b.error_after)) {
        text += &format!(
            "images are {:.2} s ahead of the truth, give or take {:.2} s; ",
            c.ahead, c.give_or_take
        );
    }
    text += &format!("maps are held against {}\n", comparison.ground);
    text
}

/// Frames of a source at even distances, at most `most`.
fn sampled(source: &dyn StereoSource, most: usize) -> impl Iterator<Item = usize> + use<> {
    let every = source.len().div_ceil(most).max(1);
    (0..source.len()).step_by(every)
}
