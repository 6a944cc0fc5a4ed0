mod matches;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, bail};
use barchan_datasets::{disparity_file, open, read_planar};
use barchan_eval::cloud::{CloudScore, score as score_cloud};
use barchan_eval::disparity::DisparityTally;
use barchan_eval::time_shift::{TimeShift, time_shift};
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, TrajectoryScore, score};
use barchan_eval::{ComparedCell, elevation};
use barchan_geometry::nalgebra::Point3;
use barchan_geometry::registration::{IcpConfig, IcpMethod, Reference, Registration, register};
use barchan_geometry::{Se3, Trajectory};
use barchan_terrain::{Cloud, CloudPoint, Raster};
use clap::{Parser, Subcommand};
use serde::Serialize;

use crate::output::Output;
use crate::preview::turbo;

/// Compare with the truth
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan eval trajectory --est runs/s/trajectory.tum --gt images/gt.csv\n  \
    barchan eval trajectory --est runs/k/trajectory.tum --gt katwijk:part1   fixes; are the images ahead of them?\n  \
    barchan eval cloud --est map/cloud.ply --ref survey.laz\n  \
    barchan eval dem --est map/elevation.tif --ref survey.tif --error-map error.tif\n  \
    barchan eval disparity --pred out/disparity --gt synth:seed=1,frames=40 --json\n  \
    barchan eval matches --data images/ --model rover --out runs/m")]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Disparity images against true disparity
    Disparity {
        /// The folder of predictions, NAME.pfm or NAME.png
        #[arg(long, value_name = "DIR")]
        pred: PathBuf,
        /// Data with true disparity
        #[arg(long, value_name = "DATA")]
        gt: String,
    },
    /// Poses against true poses; both .tum, KITTI text or gt.csv
    Trajectory {
        /// The estimate
        #[arg(long, value_name = "FILE")]
        est: PathBuf,
        /// The truth: a file, or data that has true poses or fixes
        #[arg(long, value_name = "FILE|DATA")]
        gt: String,
        /// Largest difference of the two clocks that is looked for, seconds; 0 looks for none
        #[arg(long, default_value_t = 5.0, value_name = "SECONDS")]
        max_shift: f64,
        /// Largest difference in time of poses that are compared, seconds
        #[arg(long, default_value_t = DEFAULT_TOLERANCE)]
        tolerance: f64,
    },
    /// A cloud against a true one: distances as it lies, then after registration, and the motion of that
    Cloud {
        /// The estimate: .ply, .las or .laz
        #[arg(long, value_name = "FILE")]
        est: PathBuf,
        /// The truth: a cloud, or the cell centres of a GeoTIFF
        #[arg(long = "ref", value_name = "FILE")]
        reference: PathBuf,
        /// Points farther than this from the truth lie outside of it, metres
        #[arg(long, default_value_t = IcpConfig::default().max_distance, value_name = "M")]
        max_distance: f64,
        /// Matches planes with planes (generalised ICP) instead of points with planes
        #[arg(long)]
        generalised: bool,
        /// Writes the registered estimate as a PLY, coloured by distance to the truth: from blue to red at
        /// --max-distance and beyond (Hong 2021, figure 10)
        #[arg(long, value_name = "FILE")]
        error_cloud: Option<PathBuf>,
    },
    /// Elevations against true ones in the same frame, cell by cell; of `elevation.tif` also whether
    /// its bounds hold
    Dem {
        /// The estimate: dem.tif or elevation.tif of `barchan map`, or any GeoTIFF
        #[arg(long, value_name = "FILE")]
        est: PathBuf,
        /// The truth: a GeoTIFF. Where its cells are smaller, their mean over a cell of the estimate
        /// counts; where larger, they are interpolated
        #[arg(long = "ref", value_name = "FILE")]
        reference: PathBuf,
        /// Writes estimate less truth as a GeoTIFF
        #[arg(long, value_name = "FILE")]
        error_map: Option<PathBuf>,
    },
    Matches(matches::Args),
}

pub fn run(args: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    match args.what {
        What::Disparity { pred, gt } => disparity(&pred, &gt, output),
        What::Cloud {
            est,
            reference,
            max_distance,
            generalised,
            error_cloud,
        } => {
            let config = IcpConfig {
                max_distance,
                method: match generalised {
                    true => IcpMethod::Generalised,
                    false => IcpMethod::PointToPlane,
                },
                ..IcpConfig::default()
            };
            cloud(&est, &reference, &config, error_cloud.as_deref(), output)
        }
        What::Dem {
            est,
            reference,
            error_map,
        } => dem(&est, &reference, error_map.as_deref(), output),
        What::Trajectory {
            est,
            gt,
            tolerance,
            max_shift,
        } => trajectory(&est, &gt, tolerance, max_shift, output),
        What::Matches(args) => matches::run(args, output, runtime),
    }
}

fn disparity(pred: &Path, gt: &str, output: &Output) -> Result<()> {
    let source = open(gt)?;
    let mut tally = DisparityTally::new();
    for index in 0..source.len() {
        let Some(truth) = source.true_disparity(index)? else {
            continue;
        };
        let name = source.name(index);
        let file = ["pfm", "png"]
            .map(|e| pred.join(format!("{name}.{e}")))
            .into_iter()
            .find(|f| f.is_file());
        let Some(file) = file else {
            bail!(
                "{}: no prediction {name}.pfm or {name}.png for frame {name} of {gt}",
                pred.display()
            );
        };
        tally
            .add(&disparity_file::read(&file)?, &truth)
            .with_context(|| file.display().to_string())?;
    }
    let score = tally
        .score()
        .with_context(|| format!("{gt}: no true disparity"))?;
    let line = |title: &str, f: &barchan_eval::disparity::DisparityFigures| {
        format!(
            "{title:<10} {:>7.3} {:>7.2} {:>7.2} {:>7.2} {:>7.2} {:>8.1}\n",
            f.epe, f.bad1, f.bad2, f.bad3, f.d1, f.density
        )
    };
    let mut text = format!(
        "{:<10} {:>7} {:>7} {:>7} {:>7} {:>7} {:>8}\n",
        "over", "epe px", "bad1 %", "bad2 %", "bad3 %", "d1 %", "density"
    );
    text += &line("all", &score.all);
    if let Some(estimated) = &score.estimated {
        text += &line("estimated", estimated);
    }
    output.result(&score, &text)
}

#[derive(Serialize)]
struct CloudFigures {
    as_it_lies: CloudScore,
    registration: Registration,
    /// Seconds that registration took, planes of the reference and all, the reading of files not counted.
    seconds: f64,
    /// Rows of the 4 x 4 matrix that maps the estimate to the reference.
    transform: [[f64; 4]; 4],
    registered: CloudScore,
}

/// Points that registration uses at most: more change nothing but the time.
const REGISTERED_POINTS: usize = 100_000;

fn cloud(
    est: &Path,
    reference: &Path,
    config: &IcpConfig,
    error_cloud: Option<&Path>,
    output: &Output,
) -> Result<()> {
    let context = || format!("{} against {}", est.display(), reference.display());
    let estimate = read_points(est)?;
    let truth = read_points(reference)?;
    let begun = Instant::now();
    let truth = Reference::new(&truth).with_context(|| reference.display().to_string())?;
    let step = estimate.len().div_ceil(REGISTERED_POINTS).max(1);
    let sample: Vec<_> = estimate.iter().copied().step_by(step).collect();
    let registration = register(&sample, &truth, &Se3::identity(), config).with_context(context)?;
    let seconds = begun.elapsed().as_secs_f64();
    let as_it_lies = score_cloud(&estimate, &truth, config.max_distance).with_context(context)?;
    let moved: Vec<_> = estimate
        .iter()
        .map(|p| registration.T_ref_est * p)
        .collect();
    let registered = score_cloud(&moved, &truth, config.max_distance).with_context(context)?;
    if let Some(path) = error_cloud {
        let coloured = |p: &Point3<f64>| CloudPoint {
            position: *p,
            colour: turbo((truth.distance(p) / config.max_distance) as f32).0,
            sigma: f32::NAN,
        };
        let points = moved.iter().map(coloured).collect();
        Cloud { points }.write_ply(path)?;
    }
    let matrix = registration.T_ref_est.to_homogeneous();
    let transform = std::array::from_fn(|r| std::array::from_fn(|c| matrix[(r, c)]));

    let mut text = format!(
        "{:<16} {:>8} {:>8} {:>8} {:>8} {:>8} {:>9}\n",
        "", "rmse m", "p50 m", "p68 m", "p95 m", "<0.5 m %", "overlap %"
    );
    for (title, s) in [("as it lies", &as_it_lies), ("registered", &registered)] {
        text += &format!(
            "{title:<16} {:>8.4} {:>8.4} {:>8.4} {:>8.4} {:>8.2} {:>9.2}\n",
            s.rmse,
            s.p50,
            s.p68,
            s.p95,
            100.0 * s.within_half_metre,
            100.0 * s.overlap
        );
    }
    text += &format!(
        "registration moved it by {:.4} m and {:.4} deg in {} iterations{}",
        registration.translation,
        registration.rotation_deg,
        registration.iterations,
        if registration.converged {
            ""
        } else {
            " and did not come to rest"
        }
    );
    let figures = CloudFigures {
        as_it_lies,
        registration,
        seconds,
        transform,
        registered,
    };
    output.result(&figures, &text)
}

/// The points of a cloud, or the centres of the known cells of a raster.
pub fn read_points(path: &Path) -> Result<Vec<Point3<f64>>> {
    let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
    if extension != "tif" && extension != "tiff" {
        let points = Cloud::read(path)?.points;
        return Ok(points.into_iter().map(|p| p.position).collect());
    }
    let dem = Raster::<f32>::read(path)?;
    let known = dem.values.iter().enumerate().filter(|(_, z)| z.is_finite());
    let centre = |(i, z): (usize, &f32)| {
        let (x, y) = dem.grid.centre(i % dem.grid.width, i / dem.grid.width);
        Point3::new(x, y, f64::from(*z))
    };
    Ok(known.map(centre).collect())
}

fn dem(est: &Path, reference: &Path, error_map: Option<&Path>, output: &Output) -> Result<()> {
    let bands = Raster::<f32>::read_bands(est)?;
    let band = |name: &str| bands.iter().find(|(n, _)| n == name).map(|(_, b)| b);
    let estimate = &bands[0].1;
    let truth = Raster::<f32>::read(reference)?.onto(&estimate.grid);
    let bounds = band("lower").zip(band("upper"));
    let cells = (0..truth.values.len()).map(|i| ComparedCell {
        estimate: estimate.values[i].into(),
        truth: truth.values[i].into(),
        bounds: bounds.map(|(low, high)| [low.values[i].into(), high.values[i].into()]),
    });
    let s = elevation::score(cells)
        .with_context(|| format!("{} against {}", est.display(), reference.display()))?;
    if let Some(path) = error_map {
        let error = Raster {
            values: estimate
                .values
                .iter()
                .zip(&truth.values)
                .map(|(e, t)| e - t)
                .collect(),
            ..truth.clone()
        };
        error.write(path)?;
    }
    let mut text = format!(
        "cells            {} ({:.1} % of those in its extent)\nRMSE             {:.4} m\nmean             {:+.4} m\n\
         50, 68, 95 %     {:.4} {:.4} {:.4} m\nlargest          {:.3} m\nwithin 0.5 m     {:.2} %",
        s.cells,
        100.0 * s.known,
        s.rmse,
        s.mean,
        s.p50,
        s.p68,
        s.p95,
        s.max,
        100.0 * s.within_half_metre
    );
    if let Some(b) = &s.bounds {
        text += &format!(
            "\nbounds hold      {:.2} % (99.73 % is what three deviations promise)\nbounds, width    {:.4} m on average, {:.4} m half of them",
            100.0 * b.coverage,
            b.width,
            b.width_p50
        );
    }
    output.result(&s, &text)
}

/// What `--json` prints of a trajectory.
#[derive(Serialize)]
struct TrajectoryFigures {
    #[serde(flatten)]
    score: TrajectoryScore,
    /// None where too little truth lies around the poses.
    time_shift: Option<TimeShift>,
}

fn trajectory(est: &Path, gt: &str, tolerance: f64, max_shift: f64, output: &Output) -> Result<()> {
    let est = read_trajectory(est)?;
    let truth = match Path::new(gt).is_file() {
        true => read_trajectory(Path::new(gt))?,
        false => (open(gt)?.true_trajectory().cloned())
            .with_context(|| format!("{gt}: no true poses and no fixes"))?,
    };
    let s = score(&est, &truth, tolerance)?;
    let shift = (max_shift > 0.0).then(|| time_shift(&est, &truth, max_shift));
    let rotation = s
        .rpe_rot_deg_per_m
        .map_or("truth has no rotation".into(), |r| format!("{r:.3} deg/m"));
    let clocks = match &shift {
        None => "not compared".into(),
        Some(Err(e)) => format!("cannot be compared: {e}"),
        Some(Ok(s)) => format!(
            "the estimate is {:.2} s ahead, give or take {:.2} s (Sim3 ATE {:.4} m, {:.4} m with that mended)",
            s.ahead, s.give_or_take, s.error_before, s.error_after
        ),
    };
    let text = format!(
        "frames           {}\nlength           {:.3} m\nATE, SE3         {:.4} m\nATE, Sim3        {:.4} m (scale {:.4})\n\
         RPE translation  {:.3} %\nRPE rotation     {rotation}\nclocks           {clocks}",
        s.frames, s.length, s.ate_rmse, s.ate_rmse_sim3, s.scale, s.rpe_trans_percent
    );
    let figures = TrajectoryFigures {
        score: s,
        time_shift: shift.and_then(Result::ok),
    };
    output.result(&figures, &text)
}

/// By content: comma-separated with a header, twelve numbers a line (KITTI), or eight (TUM).
pub fn read_trajectory(path: &Path) -> Result<Trajectory> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let first = text
        .lines()
        .map(str::trim)
        .find(|l| !l.is_empty() && !l.starts_with('#'))
        .unwrap_or_default();
    if first.contains(',') {
        return Ok(read_planar(path)?);
    }
    Ok(match first.split_whitespace().count() {
        12 => Trajectory::read_kitti(path, None)?,
        _ => Trajectory::read_tum(path)?,
    })
}
