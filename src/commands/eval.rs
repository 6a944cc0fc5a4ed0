use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_datasets::{disparity_file, open, read_planar};
use barchan_eval::disparity::DisparityTally;
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, score};
use barchan_geometry::Trajectory;
use clap::{Parser, Subcommand};

use crate::output::Output;

/// Compare with the truth
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan eval trajectory --est runs/s/trajectory.tum --gt images/gt.csv\n  \
    barchan eval disparity --pred out/disparity --gt synth:seed=1,frames=40 --json")]
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
        /// The truth
        #[arg(long, value_name = "FILE")]
        gt: PathBuf,
        /// Largest difference in time of poses that are compared, seconds
        #[arg(long, default_value_t = DEFAULT_TOLERANCE)]
        tolerance: f64,
    },
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    match args.what {
        What::Disparity { pred, gt } => disparity(&pred, &gt, output),
        What::Trajectory { est, gt, tolerance } => trajectory(&est, &gt, tolerance, output),
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

fn trajectory(est: &Path, gt: &Path, tolerance: f64, output: &Output) -> Result<()> {
    let s = score(&read_trajectory(est)?, &read_trajectory(gt)?, tolerance)?;
    let rotation = s
        .rpe_rot_deg_per_m
        .map_or("truth has no rotation".into(), |r| format!("{r:.3} deg/m"));
    let text = format!(
        "frames           {}\nlength           {:.3} m\nATE, SE3         {:.4} m\nATE, Sim3        {:.4} m (scale {:.4})\n\
         RPE translation  {:.3} %\nRPE rotation     {rotation}",
        s.frames, s.length, s.ate_rmse, s.ate_rmse_sim3, s.scale, s.rpe_trans_percent
    );
    output.result(&s, &text)
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
