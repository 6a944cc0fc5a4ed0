//! Where the camera was, by one of several methods, and what it saw.

mod stereo;

pub use stereo::write_result;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Result, bail};
use barchan_datasets::StereoSource;
use barchan_geometry::Rig;
use clap::{Parser, ValueEnum};

use crate::commands::features::FeatureKind;
use crate::data::{Unchecked, open_checked};
use crate::output::{Output, StagedDir};

/// Track the camera through a sequence and gather dense key frames for `barchan map`
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan slam --data images/ --model a.onnx --out runs/s\n  \
    barchan slam --data images/ --features akaze --out runs/a  features that last longer, and take longer\n  \
    barchan slam --data images/ --no-gate --out runs/plain     features alone decide on matches\n  \
    barchan slam --data tuesday/ --map runs/monday/map.safetensors --out runs/tuesday\n  \
    barchan slam --data images/ --no-loops --out runs/open     places seen before are not looked for")]
pub struct Args {
    /// A stereo sequence: PATH or FORMAT:PATH
    #[arg(long)]
    data: String,
    /// How the camera is followed
    #[arg(long, value_enum, default_value_t = Method::Stereo)]
    method: Method,
    /// Disparity at key frames: x.onnx, x.safetensors, a run of `barchan train`, or a shipped name,
    /// or sgm or bm, which need no network (sgm:192 searches 192 disparities)
    #[arg(long, default_value = "tiny")]
    model: String,
    /// The run directory that is written
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Disparity does not accept or refuse feature matches
    #[arg(long)]
    no_gate: bool,
    /// Places seen before are not looked for: the trajectory drifts
    #[arg(long)]
    no_loops: bool,
    /// Visual words to recognise places by, from `barchan vocabulary` or DBoW2, instead of the shipped
    #[arg(long, value_name = "FILE")]
    vocabulary: Option<PathBuf>,
    /// Goes on in the map of an earlier run: its map.safetensors. The poses are then in that world
    #[arg(long, value_name = "FILE")]
    map: Option<PathBuf>,
    /// All settings from a TOML file, as `config.toml` of an earlier run; flags win
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// What is followed from image to image (default orb)
    #[arg(long, value_enum)]
    features: Option<FeatureKind>,
    /// Key points looked for in each image
    #[arg(long, value_name = "COUNT")]
    keypoints: Option<usize>,
    /// A key frame is made when matches fall under this share
    #[arg(long)]
    keyframe_ratio: Option<f64>,
    /// Threads of the disparity engine; 0 leaves it to the engine
    #[arg(long, default_value_t = 0)]
    threads: usize,
    #[command(flatten)]
    unchecked: Unchecked,
}

/// How the camera is followed.
#[derive(Clone, Copy, ValueEnum)]
enum Method {
    /// Features in both images, a map of points, loops
    Stereo,
}

pub fn run(args: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    let source: Arc<dyn StereoSource> = open_checked(&args.data, &args.unchecked, output)?.into();
    if (0..source.len()).any(|i| source.frame_rig(i) != source.rig()) {
        bail!(
            "{}: the pairs are of several rigs\n  cure: give one sequence of one rig",
            args.data
        );
    }
    let out = StagedDir::new(&args.out, "summary.json")?;
    out.write("rig.toml", Rig::from(*source.rig()).to_toml())?;
    match args.method {
        Method::Stereo => stereo::run(&args, source, out, output, runtime),
    }
}
