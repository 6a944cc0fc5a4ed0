use std::path::PathBuf;

use anyhow::Result;
use barchan_datasets::{open, write_folder};
use clap::{Parser, Subcommand};
use serde::Serialize;

use crate::output::Output;

/// Look at data, or make some
#[derive(Parser)]
#[command(
    after_help = "Example:\n  barchan data synth synth:seed=1,frames=40 --out data     a rendered rover traverse with truth"
)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Write a rendered traverse (or any other data) in `folder` layout
    Synth {
        /// What to render: synth:seed=N,frames=N[,width=W,height=H]
        data: String,
        /// The directory that is written
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
    },
}

#[derive(Serialize)]
struct Summary {
    frames: usize,
    out: PathBuf,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    let What::Synth { data, out } = args.what;
    let source = open(&data)?;
    let bar = output.progress("render", source.len());
    write_folder(source.as_ref(), &out, |done| bar.set_position(done as u64))?;
    bar.finish_and_clear();
    let rig = source.rig();
    let text = format!(
        "{} pairs of {} x {} in {}: left/ right/ rig.toml times.txt, and truth where it is known",
        source.len(),
        rig.width,
        rig.height,
        out.display()
    );
    output.result(
        &Summary {
            frames: source.len(),
            out,
        },
        &text,
    )
}
