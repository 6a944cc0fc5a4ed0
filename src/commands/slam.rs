use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use barchan_datasets::{Rgb, StereoSource, disparity_file, prefetch};
use barchan_geometry::{RectifiedRig, Rig, Trajectory};
use barchan_infer::DisparityMap;
use barchan_slam::{
    Detector, LoopEvent, Map, MatchCounts, Slam, SlamConfig, SlamResult, Vocabulary,
};
use barchan_terrain::{Cloud, CloudPoint};
use clap::Parser;
use serde::Serialize;

use crate::commands::features::FeatureKind;
use crate::data::{Unchecked, open_checked};
use crate::engine::load_engine;
use crate::output::{Output, StagedDir, percentiles};

/// Track the camera through a sequence and gather dense key frames for `barchan map`
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan slam --data images/ --model a.onnx --out runs/s\n  \
    barchan slam --data images/ --features akaze --out runs/a  features that last longer, and take longer\n  \
    barchan slam --data images/ --no-gate --out runs/plain     features alone decide on matches\n  \
    barchan slam --data tuesday/ --map runs/monday/map.safetensors --out runs/tuesday
  \
    barchan slam --data images/ --no-loops --out runs/open     places seen before are not looked for")]
pub struct Args {
    /// A stereo sequence: PATH or FORMAT:PATH
    #[arg(long)]
    data: String,
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

#[derive(Serialize)]
struct Summary {
    frames: usize,
    tracked: usize,
    keyframes: usize,
    loops: usize,
    loop_events: Vec<LoopEvent>,
    submaps: usize,
    found_again: usize,
    points: usize,
    ms_track_median: f64,
    ms_track_p95: f64,
    ms_disparity_median: f64,
    fps: f64,
    matches: MatchCounts,
}

pub fn run(args: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    let config = configuration(&args)?;
    let source: Arc<dyn StereoSource> = open_checked(&args.data, &args.unchecked, output)?.into();
    if (0..source.len()).any(|i| source.frame_rig(i) != source.rig()) {
        bail!(
            "{}: the pairs are of several rigs\n  cure: give one sequence of one rig",
            args.data
        );
    }
    let words = (args.vocabulary.as_deref())
        .map(|path| vocabulary(path, config.detector))
        .transpose()?;
    let engine = load_engine(&args.model, runtime, args.threads)?;
    let out = StagedDir::new(&args.out, "summary.json")?;
    out.write("config.toml", toml::to_string(&config)?)?;
    out.write("rig.toml", Rig::from(*source.rig()).to_toml())?;
    let log = out.path("log.jsonl")?;
    let mut log = std::io::BufWriter::new(
        std::fs::File::create(&log).with_context(|| log.display().to_string())?,
    );

    let (rig, detector) = (*source.rig(), config.detector);
    let mut slam = Slam::new(rig, config, Some(engine));
    if let Some(words) = words {
        slam = slam.with_vocabulary(words);
    }
    if let Some(file) = &args.map {
        slam = slam.with_map(read_map(file, &rig, detector)?);
    }
    let frames = source.len();
    let bar = output.progress("slam", frames);
    let (mut tracked, mut track_ms, mut disparity_ms, mut matches) =
        (0, vec![], vec![], MatchCounts::default());
    let mut total_ms = 0.0;
    let (mut loops, mut found_again) = (Vec::<LoopEvent>::new(), 0);
    for frame in prefetch(source, (0..frames).collect(), 4) {
        let frame = frame?;
        let mut report = slam.track(&frame)?;
        if !report.tracked {
            output.notice(&format!("frame {} is lost: {}", report.name, report.reason));
        }
        if let Some(dense) = report.dense.take() {
            write_keyframe(&out, report.frame, &frame.left, &dense)?;
            disparity_ms.push(report.ms_disparity);
            matches.ratio += report.matches.ratio;
            matches.gate += report.matches.gate;
            matches.refused += report.matches.refused;
        }
        report.loops.iter().filter(|l| l.proved).for_each(|event| {
            output.notice(&format!(
                "frame {} sees the place of frame {} again: {} map points agree, the loop moves it by {:.3} m",
                event.frame, event.earlier_frame, event.map_points[1], event.moved
            ));
            loops.push(event.clone());
        });
        if let Some(place) = report.found_again_at {
            found_again += 1;
            output.notice(&format!(
                "frame {}: the camera was lost, and is found again at the place of frame {place}",
                report.name
            ));
        }
        tracked += usize::from(report.tracked);
        track_ms.push(report.ms_track);
        total_ms += report.ms_track + report.ms_disparity;
        writeln!(log, "{}", serde_json::to_string(&report)?)?;
        bar.inc(1);
    }
    log.flush()?;
    drop(log);
    bar.finish_and_clear();
    if tracked == 0 {
        bail!(
            "{}: no frame could be tracked; the notes above say why",
            args.data
        );
    }

    let result = slam.finish();
    let submaps = result.submaps.iter().collect::<BTreeSet<_>>().len();
    if submaps > 1 {
        output.notice(&format!(
            "the map is of {submaps} parts, and how they lie to each other is a guess: keyframes.csv says what belongs to which, and `barchan map` takes the largest"
        ));
    }
    if result.covariances.is_none() {
        output.notice("how well the poses are known cannot be told: there is no covariance.csv");
    }
    write_result(&out, &result)?;
    let map = result.map.to_bytes(&rig)?;
    out.write("map.safetensors", map)?;
    let (ms_track_median, ms_track_p95) = percentiles(track_ms);
    let summary = Summary {
        frames,
        tracked,
        keyframes: result.keyframes.len(),
        loops: loops.len(),
        loop_events: loops,
        submaps,
        found_again,
        points: result.map.points.len(),
        ms_track_median,
        ms_track_p95,
        ms_disparity_median: percentiles(disparity_ms).0,
        fps: 1e3 * frames as f64 / total_ms,
        matches,
    };
    out.write_json("summary.json", &summary)?;
    out.finish()?;
    let text = format!(
        "{tracked} of {frames} frames tracked, {} key frames, {} loops, {} points; {ms_track_median:.1} ms a frame (p95 {ms_track_p95:.1}), \
         {:.1} ms disparity a key frame, {:.1} frames/s\nstereo matches at key frames: {} by ratio, {} more by disparity, {} refused by disparity\n\
         {}: trajectory.tum trajectory.kitti keyframes.tum map.ply",
        summary.keyframes,
        summary.loops,
        summary.points,
        summary.ms_disparity_median,
        summary.fps,
        matches.ratio,
        matches.gate,
        matches.refused,
        args.out.display(),
    );
    output.result(&summary, &text)
}

fn configuration(args: &Args) -> Result<SlamConfig> {
    let mut config = match &args.config {
        None => SlamConfig::default(),
        Some(path) => {
            let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
            toml::from_str(&text).with_context(|| path.display().to_string())?
        }
    };
    config.gate &= !args.no_gate;
    config.loops.enabled &= !args.no_loops;
    config.detector = args.features.map_or(config.detector, FeatureKind::into);
    config.features = args.keypoints.unwrap_or(config.features);
    config.keyframe_ratio = args.keyframe_ratio.unwrap_or(config.keyframe_ratio);
    Ok(config)
}

fn vocabulary(path: &Path, detector: Detector) -> Result<Vocabulary> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let words: Vocabulary = text.parse().with_context(|| path.display().to_string())?;
    let bytes = detector.descriptor_bytes();
    if words.bytes() != bytes {
        bail!(
            "{}: its words are {} bytes long, but descriptors of the features {bytes}\n  cure: make one with `barchan vocabulary --features`",
            path.display(),
            words.bytes()
        );
    }
    Ok(words)
}

fn read_map(file: &Path, rig: &RectifiedRig, detector: Detector) -> Result<Map> {
    let context = || file.display().to_string();
    let bytes = std::fs::read(file).with_context(context)?;
    let map = Map::from_bytes(&bytes, rig).with_context(context)?;
    let bits = map.keyframes.iter().map(|k| k.features.bits.div_ceil(8));
    if bits
        .max()
        .is_some_and(|b| b as usize != detector.descriptor_bytes())
    {
        bail!(
            "{}: its features are of another kind\n  cure: give --features as in the run that made it",
            file.display()
        );
    }
    Ok(map)
}

/// Files that sort as their key frames follow each other.
fn write_keyframe(out: &StagedDir, frame: usize, left: &Rgb, dense: &DisparityMap) -> Result<()> {
    let path = |folder: &str| out.path(format!("keyframes/{folder}/{frame:06}.png"));
    disparity_file::write_png(&path("disparity")?, &dense.disparity)?;
    disparity_file::write_png(&path("sigma")?, &dense.sigma)?;
    let file = path("left")?;
    image::DynamicImage::from(left.clone())
        .to_rgb8()
        .save(&file)
        .with_context(|| file.display().to_string())
}

fn write_result(out: &StagedDir, result: &SlamResult) -> Result<()> {
    out.write("trajectory.tum", result.trajectory.to_tum())?;
    out.write("trajectory.kitti", result.trajectory.to_kitti())?;
    let keyframes = Trajectory {
        poses: result.keyframes.iter().map(|(_, _, pose)| *pose).collect(),
    };
    out.write("keyframes.tum", keyframes.to_tum())?;
    let mut table = String::from("frame,name,time,submap\n");
    for ((frame, name, pose), submap) in result.keyframes.iter().zip(&result.submaps) {
        writeln!(table, "{frame},{name},{},{submap}", pose.time)?;
    }
    out.write("keyframes.csv", table)?;
    if let Some(covariances) = &result.covariances {
        let mut table = String::from("time");
        for (row, column) in (0..36).map(|k| (k / 6, k % 6)) {
            write!(table, ",c{row}{column}")?;
        }
        for ((_, _, pose), covariance) in result.keyframes.iter().zip(covariances) {
            write!(table, "\n{}", pose.time)?;
            // Symmetric: rows are columns.
            covariance
                .iter()
                .try_for_each(|c| write!(table, ",{c:e}"))?;
        }
        out.write("covariance.csv", table + "\n")?;
    }
    let point = |p: &barchan_slam::MapPoint| CloudPoint {
        position: p.position,
        colour: p.colour,
        sigma: f32::NAN,
    };
    let cloud = Cloud {
        points: result.map.points.values().map(point).collect(),
    };
    cloud.write_ply(&out.path("map.ply")?)?;
    Ok(())
}
