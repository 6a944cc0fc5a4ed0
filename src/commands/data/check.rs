use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use barchan_datasets::check::{Fault, Report, check};
use barchan_datasets::{Correction, dataset_folder, open, open_as_stored};
use clap::Parser;
use serde::Serialize;

use crate::output::Output;
use crate::preview::row_errors;

/// Are the pairs fit for stereo? Says in words what is wrong with the rig, with a picture
#[derive(Parser)]
#[command(
    after_help = "Exit status 1 when something is wrong and --fix was not given.\n\nExamples:\n  \
    barchan data check images/ --picture check.png     the picture shows rows before and after correction, errors ten times as long\n  \
    barchan data check images/ --fix     writes correction.toml beside the images, which every command honours"
)]
pub struct Args {
    /// Stereo pairs: PATH or FORMAT:PATH
    data: String,
    /// Write what mends the pairs beside them, as correction.toml
    #[arg(long)]
    fix: bool,
    /// Where the picture goes
    #[arg(long, value_name = "FILE.png", default_value = "check.png")]
    picture: PathBuf,
}

#[derive(Serialize)]
struct Summary<'a> {
    #[serde(flatten)]
    report: &'a Report,
    /// Whether a correction that was there already was applied before the check.
    corrected: bool,
    fixed: Option<PathBuf>,
    picture: &'a PathBuf,
}

/// Whether the pairs are healthy, or were mended.
pub fn run(args: Args, output: &Output) -> Result<bool> {
    let folder = dataset_folder(&args.data);
    let file = folder.map(|folder| folder.join(Correction::FILE));
    // With --fix everything is measured anew, so that corrections do not pile up.
    let source = if args.fix {
        open_as_stored(&args.data)?
    } else {
        open(&args.data)?
    };
    let corrected = !args.fix && file.as_ref().is_some_and(|file| file.is_file());
    let report = check(source.as_ref())?;

    let frame = source.frame(report.sample.frame)?;
    row_errors(&frame, &report)
        .save(&args.picture)
        .with_context(|| args.picture.display().to_string())?;

    let mut fixed = None;
    if args.fix {
        let Some(file) = file else {
            bail!("{}: rendered pairs need no correction", args.data);
        };
        match &report.correction {
            Some(correction) => {
                correction.save(&file).with_context(|| {
                    format!("--fix writes beside the images; `barchan data rectify {} --out DIR` writes corrected copies elsewhere", args.data)
                })?;
                fixed = Some(file);
            }
            None if file.is_file() => {
                std::fs::remove_file(&file).with_context(|| file.display().to_string())?;
                output.notice(&format!("{}: removed, nothing needs it", file.display()));
            }
            None => {}
        }
    }

    let summary = Summary {
        report: &report,
        corrected,
        fixed: fixed.clone(),
        picture: &args.picture,
    };
    output.result(&summary, &text(&args, &report, corrected, &fixed))?;
    Ok(report.findings.is_empty() || fixed.is_some())
}

fn text(args: &Args, report: &Report, corrected: bool, fixed: &Option<PathBuf>) -> String {
    let mut text = format!("{}: {} pairs looked at", args.data, report.frames);
    if corrected {
        text += &format!(", as {} corrects them", Correction::FILE);
    }
    if let Some(rows) = &report.rows {
        text += &format!(
            "; {} matches, rows agree to {:.2} px about {:+.2} px",
            rows.matches, rows.spread, rows.offset
        );
    }
    if let Some([low, _, high]) = report.disparity {
        text += &format!("; disparities from {low:.0} to {high:.0} px");
    }
    if let Some(poses) = &report.poses
        && !report.has(Fault::Poses)
    {
        text += &format!(
            "; baseline {:.3} times what true poses say",
            1.0 / poses.baseline
        );
    }
    text += "\n";
    if report.findings.is_empty() {
        text += "  nothing is wrong\n";
    }
    for finding in &report.findings {
        text += &format!("  - {finding}\n");
    }
    if let Some(file) = fixed {
        text += &format!("{}: written; every command honours it\n", file.display());
    } else if report.correction.is_some() {
        text += "--fix writes a correction that every command honours\n";
    }
    text + &format!("{}: rows before and after", args.picture.display())
}
