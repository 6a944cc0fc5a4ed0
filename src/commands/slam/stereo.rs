use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use barchan_datasets::{StereoSource, prefetch};
use barchan_geometry::RectifiedRig;
use barchan_slam::{
    Detector, FusionCounts, LoopEvent, Map, Mapped, MatchCounts, Slam, SlamConfig, SlamResult,
    Vocabulary,
};
use barchan_terrain::{Cloud, CloudPoint};
use serde::Serialize;

use super::dead_reckoning::Reckoning;
use super::{Args, configured};
use crate::commands::features::FeatureKind;
use crate::engine::load_engine;
use crate::output::{Output, StagedDir, percentiles};
use crate::slam_run::{RunKeyframe, RunLog, write_dense, write_poses};

#[derive(Serialize)]
struct Summary {
    frames: usize,
    tracked: usize,
    keyframes: usize,
    loops: usize,
    loop_events: Vec<LoopEvent>,
    submaps: usize,
    found_again: usize,
    /// Frames whose pose is that of IMU and wheels.
    carried: usize,
    /// Gaps over which these led on in the same part of the map.
    joined: usize,
    /// How often they were believed; none where there are none.
    fusion: Option<FusionCounts>,
    points: usize,
    ms_track_median: f64,
    ms_track_p95: f64,
    ms_disparity_median: f64,
    /// The rest of a key frame's way into the map.
    ms_map_median: f64,
    /// Frames a second from first to last, with reading and writing.
    fps: f64,
    matches: MatchCounts,
}

/// Features, a map of points, loops (`barchan_slam::Slam`) over a whole sequence.
pub fn run(
    args: &Args,
    source: Arc<dyn StereoSource>,
    out: StagedDir,
    output: &Output,
    runtime: Option<&Path>,
) -> Result<()> {
    let config = configuration(args)?;
    let words = (args.vocabulary.as_deref())
        .map(|path| vocabulary(path, config.detector))
        .transpose()?;
    let reckoning = (args.dead_reckoning)
        .map(|form| Reckoning::new(source.sensors(), form, &config.fusion, &args.data))
        .transpose()?;
    // Frames are tracked meanwhile.
    let engines = args.engine.streaming().beside_other_work();
    let engine = load_engine(&args.model, runtime, &engines)?;
    out.write("config.toml", toml::to_string(&config)?)?;
    let mut log = RunLog::create(&out)?;

    let (rig, detector, listen) = (*source.rig(), config.detector, config.fusion.enabled);
    let mut slam = Slam::new(rig, config, Some(engine));
    if let Some(words) = words {
        slam = slam.with_vocabulary(words);
    }
    // A rendered drive makes its sensors when asked for them.
    if let Some(sensors) = listen.then(|| source.sensors()).flatten() {
        slam = slam.with_sensors(sensors);
    }
    if let Some(file) = &args.map {
        slam = slam.with_map(read_map(file, &rig, detector)?);
    }
    let frames = source.len();
    let bar = output.progress("slam", frames);
    let (mut tracked, mut track_ms, mut found_again, mut carried) = (0, vec![], 0, 0);
    let mut map = MapRecord::default();
    let started = Instant::now();
    for frame in prefetch(source, (0..frames).collect(), 4) {
        let mut report = slam.track(frame?)?;
        if !report.tracked {
            let what = if report.carried {
                "shows no place, and IMU and wheels carry on"
            } else {
                "is lost"
            };
            output.notice(&format!("frame {} {what}: {}", report.name, report.reason));
        }
        for mapped in report.mapped.drain(..) {
            map.add(mapped, &out, output)?;
        }
        if let Some(place) = report.found_again_at {
            found_again += 1;
            output.notice(&format!(
                "frame {}: the camera was lost, and is found again at the place of frame {place}",
                report.name
            ));
        }
        tracked += usize::from(report.tracked);
        carried += usize::from(report.carried);
        track_ms.push(report.ms_track);
        log.add(&report)?;
        bar.inc(1);
    }
    for mapped in slam.settle()? {
        map.add(mapped, &out, output)?;
    }
    let seconds = started.elapsed().as_secs_f64();
    log.finish()?;
    out.write("keyframes.jsonl", map.lines)?;
    bar.finish_and_clear();
    if tracked == 0 {
        bail!(
            "{}: no frame could be tracked; the notes above say why",
            args.data
        );
    }

    let counts = slam.fusion_counts();
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
    if let Some(reckoning) = reckoning {
        reckoning.write(&out, result.trajectory.poses.iter().map(|p| p.time))?;
    }
    let bytes = result.map.to_bytes(&rig)?;
    out.write("map.safetensors", bytes)?;
    let (ms_track_median, ms_track_p95) = percentiles(track_ms);
    let summary = Summary {
        frames,
        tracked,
        keyframes: result.keyframes.len(),
        loops: map.loops.len(),
        loop_events: map.loops,
        submaps,
        found_again,
        carried,
        joined: result.joined,
        fusion: counts,
        points: result.map.points.len(),
        ms_track_median,
        ms_track_p95,
        ms_disparity_median: percentiles(map.ms_disparity).0,
        ms_map_median: percentiles(map.ms_map).0,
        fps: frames as f64 / seconds,
        matches: map.matches,
    };
    out.write_json("summary.json", &summary)?;
    out.finish()?;
    let fused = counts.map_or(String::new(), |c| {
        format!(
            "IMU and wheels: {carried} frames carried, {} gaps joined; refused {} of {} motions in images, {} of {} readings of wheels\n",
            summary.joined,
            c.visual_refused,
            c.visual_refused + c.visual,
            c.wheels_refused,
            c.wheels_refused + c.wheels,
        )
    });
    let text = format!(
        "{tracked} of {frames} frames tracked, {} key frames, {} loops, {} points; {ms_track_median:.1} ms a frame (p95 {ms_track_p95:.1}), \
         a key frame's disparity {:.1} ms and map {:.1} ms, {:.1} frames/s\nstereo matches at key frames: {} by ratio, {} more by disparity, {} refused by disparity\n\
         {fused}{}: trajectory.tum trajectory.kitti keyframes.tum map.ply",
        summary.keyframes,
        summary.loops,
        summary.points,
        summary.ms_disparity_median,
        summary.ms_map_median,
        summary.fps,
        summary.matches.ratio,
        summary.matches.gate,
        summary.matches.refused,
        args.out.display(),
    );
    output.result(&summary, &text)
}

/// What the key frames came to.
#[derive(Default)]
struct MapRecord {
    loops: Vec<LoopEvent>,
    matches: MatchCounts,
    ms_disparity: Vec<f64>,
    ms_map: Vec<f64>,
    /// A line of JSON each.
    lines: String,
}

impl MapRecord {
    /// Writes the images of a key frame, and notes what else is known of it.
    fn add(&mut self, mapped: Mapped, out: &StagedDir, output: &Output) -> Result<()> {
        if let Some(dense) = &mapped.dense {
            write_dense(out, mapped.frame, &mapped.left, dense)?;
            self.ms_disparity.push(mapped.ms_disparity);
            self.matches.ratio += mapped.matches.ratio;
            self.matches.gate += mapped.matches.gate;
            self.matches.refused += mapped.matches.refused;
        }
        self.ms_map.push(mapped.ms_map);
        self.lines += &serde_json::to_string(&mapped)?;
        self.lines.push('\n');
        for event in mapped.loops.into_iter().filter(|l| l.proved) {
            output.notice(&format!(
                "frame {} sees the place of frame {} again: {} map points agree, the loop moves it by {:.3} m",
                event.frame, event.earlier_frame, event.map_points[1], event.moved
            ));
            self.loops.push(event);
        }
        Ok(())
    }
}

fn configuration(args: &Args) -> Result<SlamConfig> {
    let mut config: SlamConfig = configured(args.config.as_deref())?;
    config.gate &= !args.no_gate;
    config.loops.enabled &= !args.no_loops;
    config.fusion.enabled &= !args.no_fusion;
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

/// Poses, key frames and the points of the map.
pub fn write_result(out: &StagedDir, result: &SlamResult) -> Result<()> {
    let keyframes: Vec<_> = (result.keyframes.iter().zip(&result.submaps).enumerate())
        .map(|(k, ((frame, name, pose), submap))| RunKeyframe {
            frame: *frame,
            name: name.clone(),
            pose: *pose,
            submap: *submap,
            covariance: result.covariances.as_ref().map(|c| c[k]),
        })
        .collect();
    write_poses(out, &result.trajectory, &keyframes)?;
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
