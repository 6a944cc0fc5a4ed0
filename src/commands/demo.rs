use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Parser;

use crate::commands::{data, eval, map, report, slam, train};
use crate::engine::DEFAULT_MODEL;
use crate::output::Output;

/// The main job with nothing to set up: traverse, trajectory, terrain, report
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan demo\n  \
    barchan demo --data folder:my_images --out day1\n  \
    barchan demo --data folder:my_images --finetune --out day1")]
pub struct Args {
    /// Your images; a rendered traverse without
    #[arg(long, value_name = "DATA")]
    data: Option<String>,
    /// What sees disparity: x.onnx, x.safetensors, sgm, bm or a shipped name
    #[arg(long, default_value = DEFAULT_MODEL)]
    model: String,
    /// Lets the network learn from the images first, one epoch; they need no truth. Some minutes for 300 pairs
    #[arg(long, requires = "data")]
    finetune: bool,
    /// The directory that is written
    #[arg(long, value_name = "DIR", default_value = "demo")]
    out: PathBuf,
}

/// What is rendered where no images are given.
const TRAVERSE: &str = "synth:seed=1,frames=60";

pub fn run(args: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    let inside = |name: &str| args.out.join(name).display().to_string();
    let (rendered, slam_run, map_dir) = (inside("data"), inside("slam"), inside("map"));
    let data = match &args.data {
        Some(data) => {
            std::fs::create_dir_all(&args.out).with_context(|| args.out.display().to_string())?;
            let picture = inside("check.png");
            let check = ["data", "check", data, "--picture", &picture];
            let check: data::Args = typed(output, &check)?;
            if !data::run(check, output)? {
                output.notice(
                    "the check found something, see above; what can be mended is mended on the way",
                );
            }
            data.clone()
        }
        None => {
            let synth = typed(output, &["data", "synth", TRAVERSE, "--out", &rendered])?;
            data::run(synth, output)?;
            format!("folder:{rendered}")
        }
    };
    let weights = inside("train/weights.safetensors");
    let model = match args.finetune {
        true => {
            let words = learn(&args, &data);
            let words: Vec<&str> = words.iter().map(String::as_str).collect();
            if !train::run(typed(output, &words)?, output)? {
                bail!("the training was stopped\n  cure: the same command goes on with it");
            }
            &weights
        }
        false => &args.model,
    };
    let command = [
        "slam", "--data", &data, "--model", model, "--out", &slam_run,
    ];
    slam::run(typed(output, &command)?, output, runtime)?;
    map::run(
        typed(output, &["map", &slam_run, "--out", &map_dir])?,
        output,
    )?;
    let truth = inside("data/groundtruth.tum");
    if args.data.is_none() {
        let estimate = inside("slam/trajectory.tum");
        let command = ["eval", "trajectory", "--est", &estimate, "--gt", &truth];
        eval::run(typed(output, &command)?, output, runtime)?;
    }
    let page = inside("report.html");
    let mut command = vec!["report", &slam_run, "--map", &map_dir, "--out", &page];
    if args.data.is_none() {
        command.extend(["--gt", &truth]);
    }
    report::run(typed(output, &command)?, output)?;

    output.say(&format!(
        "\nWhere to look:\n  {page}  everything on one page (any browser)\n  {map_dir}/cloud.ply  the ground in colour (CloudCompare, MeshLab)\n  \
         {map_dir}/dem.tif  its heights, and hillshade.tif beside it (QGIS)\n  {slam_run}/trajectory.tum  the route (evo)"
    ));
    if args.data.is_some() && !args.finetune {
        output.say(&format!(
            "\nThe network has not seen your ground. To let it learn from these images (they need no truth), and then again:\n  \
             barchan demo --data {data} --finetune --out {}",
            args.out.display()
        ));
    }
    Ok(())
}

/// The training, or what goes on with one that was stopped.
fn learn(args: &Args, data: &str) -> Vec<String> {
    let run = args.out.join("train");
    let (known, run) = (run.join("config.toml").is_file(), run.display().to_string());
    let words = match (known, args.model.as_str()) {
        (true, _) => vec!["train", "--resume", &run],
        (false, DEFAULT_MODEL) => vec!["train", "--finetune", "--data", data, "--out", &run],
        (false, model) => vec![
            "train",
            "--finetune",
            "--init",
            model,
            "--data",
            data,
            "--out",
            &run,
        ],
    };
    words.into_iter().map(str::to_owned).collect()
}

/// A command as anybody could type it, said before it is done.
fn typed<A: Parser>(output: &Output, words: &[&str]) -> Result<A> {
    output.say(&format!("\n$ barchan {}", words.join(" ")));
    Ok(A::try_parse_from(words)?)
}
