mod check;
mod info;
mod scans;
mod synth;

use std::path::PathBuf;

use anyhow::{Context, Result};
use barchan_datasets::{StereoSource, load_rig, open, write_folder};
use clap::{Parser, Subcommand};
use serde::Serialize;

use crate::output::Output;

/// Look at data, check its calibration, convert it, or make some
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan data info images/     what is there\n  \
    barchan data check images/ --fix     is the rig true? if not, mend it\n  \
    barchan data synth synth:seed=1,frames=40 --out data     a rendered rover traverse with truth")]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    Info(info::Args),
    Check(check::Args),
    /// Write any data rectified and corrected, in `folder` layout
    #[command(after_help = "Example:\n  \
        barchan data rectify euroc:MH_01_easy --out rectified")]
    Rectify {
        /// Stereo pairs: PATH or FORMAT:PATH
        data: String,
        /// The directory that is written
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
    },
    /// Turn a calibration of OpenCV, ROS, KITTI, EuRoC or Middlebury into rig.toml
    #[command(after_help = "Examples:\n  \
        barchan data rig left.yaml right.yaml --out images/rig.toml     ROS camera_info\n  \
        barchan data rig intrinsics.yml extrinsics.yml --out images/rig.toml     OpenCV stereo_calib")]
    Rig {
        /// The file or files
        #[arg(required = true)]
        files: Vec<PathBuf>,
        /// The file that is written
        #[arg(long, value_name = "FILE.toml")]
        out: PathBuf,
    },
    Scans(scans::Args),
    Synth(synth::Args),
}

#[derive(Serialize)]
struct Written {
    frames: usize,
    out: PathBuf,
}

/// Whether all is well: false when a check found what is wrong.
pub fn run(args: Args, output: &Output) -> Result<bool> {
    match args.what {
        What::Info(args) => info::run(args, output)?,
        What::Check(args) => return check::run(args, output),
        What::Rectify { data, out } => rectify(&data, out, output)?,
        What::Scans(args) => scans::run(args, output)?,
        What::Synth(args) => synth::run(args, output)?,
        What::Rig { files, out } => import_rig(&files, out, output)?,
    }
    Ok(true)
}

fn rectify(data: &str, out: PathBuf, output: &Output) -> Result<()> {
    let source = open(data)?;
    let bar = output.progress("rectify", source.len());
    write_folder(source.as_ref(), &out, |done| bar.set_position(done as u64))?;
    bar.finish_and_clear();
    written(source.as_ref(), out, "", output)
}

/// Says what a folder holds now.
fn written(source: &dyn StereoSource, out: PathBuf, more: &str, output: &Output) -> Result<()> {
    let (rig, frames) = (source.rig(), source.len());
    let text = format!(
        "{frames} pairs of {} x {} in {}: left/ right/ rig.toml times.txt, and truth where it is known{more}",
        rig.width,
        rig.height,
        out.display()
    );
    output.result(&Written { frames, out }, &text)
}

fn import_rig(files: &[PathBuf], out: PathBuf, output: &Output) -> Result<()> {
    let rig = load_rig(files)?;
    std::fs::write(&out, rig.to_toml()).with_context(|| out.display().to_string())?;
    let text = format!(
        "{}: {} x {} pixels, baseline {:.4} m, {}",
        out.display(),
        rig.width,
        rig.height,
        rig.baseline(),
        if rig.rectified {
            "rectified"
        } else {
            "not rectified: images are rectified when they are read"
        }
    );
    output.result(
        &serde_json::json!({ "out": out, "baseline": rig.baseline(), "rectified": rig.rectified }),
        &text,
    )
}
