//! Where the camera was, by one of several methods, and what it saw.

mod combined;
mod dead_reckoning;
mod icp;
mod sfm;
mod stereo;

pub use stereo::write_result;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use barchan_datasets::StereoSource;
use barchan_geometry::Rig;
use barchan_slam::ScaleForm;
use barchan_slam::sfm::TrackKind;
use clap::{Parser, ValueEnum};
use serde::de::DeserializeOwned;

use crate::commands::features::FeatureKind;
use crate::data::{Unchecked, open_checked};
use crate::engine::{DEFAULT_MODEL, EngineSettings};
use crate::output::{Output, StagedDir};

/// Track the camera through a sequence and gather dense key frames for `barchan map`
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan slam --data images/ --model a.onnx --out runs/s\n  \
    barchan slam --data images/ --features akaze --out runs/a  features that last longer, and take longer\n  \
    barchan slam --data images/ --no-gate --out runs/plain     features alone decide on matches\n  \
    barchan slam --data tuesday/ --map runs/monday/map.safetensors --out runs/tuesday\n  \
    barchan slam --data images/ --no-loops --out runs/open     places seen before are not looked for\n  \
    barchan slam --data images/ --method icp --model sgm --out runs/icp        clouds brought onto each other\n  \
    barchan slam --data images/ --method combined --out runs/c              clouds at the poses of structure from motion\n  \
    barchan slam --data images/ --no-fusion --out runs/blind   IMU and wheels are not listened to\n  \
    barchan slam --data images/ --method sfm --out runs/sfm    one camera and bundle adjustment; sparse points, no --model")]
pub struct Args {
    /// A stereo sequence: PATH or FORMAT:PATH
    #[arg(long)]
    data: String,
    /// How the camera is followed
    #[arg(long, value_enum, default_value_t = Method::Stereo)]
    method: Method,
    /// Disparity at key frames: x.onnx, x.safetensors, a run of `barchan train`, or a shipped name,
    /// or sgm or bm, which need no network (sgm:192 searches 192 disparities)
    #[arg(long, default_value = DEFAULT_MODEL)]
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
    /// IMU and wheels are not listened to: what the images do not show is lost
    #[arg(long)]
    no_fusion: bool,
    /// Writes the path by acceleration and gyro alone (Bai 2019) beside: dead_reckoning.tum and .csv
    #[arg(long, value_enum, value_name = "FORM")]
    dead_reckoning: Option<dead_reckoning::Form>,
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
    #[command(flatten)]
    engine: EngineSettings,
    /// With --method combined: poses of the left cameras at the times of the frames, in any unit, instead of
    /// those of --method sfm: TUM text
    #[arg(long, value_name = "FILE")]
    poses: Option<PathBuf>,
    /// With --method combined: poses of the right cameras in the same unit, for the thesis's scale
    #[arg(long, value_name = "FILE")]
    right_poses: Option<PathBuf>,
    /// With --method combined: where the metre comes from (default corrected)
    #[arg(long, value_enum)]
    scale: Option<ScaleBy>,
    /// How --method sfm follows things from image to image (default sift)
    #[arg(long, value_enum)]
    tracks: Option<Tracks>,
    #[command(flatten)]
    unchecked: Unchecked,
}

/// How the camera is followed.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Method {
    /// Features in both images, a map of points, loops
    Stereo,
    /// The cloud of each pair brought onto that of the pair before (de Jong 2020, chapter 5)
    Icp,
    /// Clouds at the poses of structure from motion (de Jong 2020, chapter 7)
    Combined,
    /// Structure from motion by the left camera alone; the right one tells the metre
    Sfm,
}

/// Where the metre of `--method combined` comes from.
#[derive(Clone, Copy, ValueEnum)]
enum ScaleBy {
    /// Points of stereo, found again in later images
    Corrected,
    /// The mean distance between left and right camera
    Thesis,
}

impl From<ScaleBy> for ScaleForm {
    fn from(scale: ScaleBy) -> Self {
        match scale {
            ScaleBy::Corrected => Self::Corrected,
            ScaleBy::Thesis => Self::Thesis,
        }
    }
}

/// How `--method sfm` follows things from image to image.
#[derive(Clone, Copy, ValueEnum)]
enum Tracks {
    /// Key points and descriptors
    Sift,
    /// Optical flow: more tracks, which last longer, but are lost when the camera jumps
    Klt,
}

impl From<Tracks> for TrackKind {
    fn from(tracks: Tracks) -> Self {
        match tracks {
            Tracks::Sift => Self::Sift,
            Tracks::Klt => Self::Klt,
        }
    }
}

pub fn run(args: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    refuse_strangers(&args)?;
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
        Method::Icp => icp::run(&args, source, out, output, runtime),
        Method::Combined => combined::run(&args, source, out, output, runtime),
        Method::Sfm => sfm::run(&args, source, out, output),
    }
}

/// Refuses flags that the method would pass over in silence.
fn refuse_strangers(args: &Args) -> Result<()> {
    use Method::{Combined, Sfm, Stereo};
    let flags: [(&str, bool, &[Method]); 13] = [
        ("--no-gate", args.no_gate, &[Stereo]),
        ("--no-loops", args.no_loops, &[Stereo]),
        ("--no-fusion", args.no_fusion, &[Stereo]),
        ("--dead-reckoning", args.dead_reckoning.is_some(), &[Stereo]),
        ("--vocabulary", args.vocabulary.is_some(), &[Stereo]),
        ("--map", args.map.is_some(), &[Stereo]),
        ("--features", args.features.is_some(), &[Stereo]),
        ("--keypoints", args.keypoints.is_some(), &[Stereo, Sfm]),
        ("--keyframe-ratio", args.keyframe_ratio.is_some(), &[Stereo]),
        ("--tracks", args.tracks.is_some(), &[Sfm]),
        ("--poses", args.poses.is_some(), &[Combined]),
        ("--right-poses", args.right_poses.is_some(), &[Combined]),
        ("--scale", args.scale.is_some(), &[Combined]),
    ];
    for (flag, given, owners) in flags {
        if given && !owners.contains(&args.method) {
            let owners = owners.iter().filter_map(Method::to_possible_value);
            let names: Vec<String> = owners.map(|v| v.get_name().to_owned()).collect();
            bail!(
                "{flag} is of --method {0}\n  cure: leave it out, or give --method {0}",
                names.join(" or ")
            );
        }
    }
    Ok(())
}

/// The settings of a method: the defaults, changed by a file where one is given.
fn configured<T: DeserializeOwned + Default>(file: Option<&Path>) -> Result<T> {
    let Some(path) = file else {
        return Ok(T::default());
    };
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    toml::from_str(&text).with_context(|| path.display().to_string())
}
