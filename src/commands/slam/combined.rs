use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use barchan_datasets::{StereoSource, prefetch};
use barchan_geometry::Trajectory;
use barchan_slam::sfm::SfmConfig;
use barchan_slam::{Combined, CombinedConfig, Scale, ScaleForm, UpToScale};
use serde::Serialize;

use super::sfm::reconstruct;
use super::{Args, configured};
use crate::engine::load_engine;
use crate::output::{Output, StagedDir, percentiles};
use crate::slam_run::{RunKeyframe, RunLog, write_dense, write_poses};

#[derive(Serialize)]
struct Summary {
    method: &'static str,
    engine: String,
    frames: usize,
    tracked: usize,
    keyframes: usize,
    loops: usize,
    submaps: usize,
    points: usize,
    scale_form: ScaleForm,
    scale: Scale,
    ms_track_median: f64,
    ms_track_p95: f64,
    ms_disparity_median: f64,
    fps: f64,
}

/// Clouds of stereo at the poses of structure from motion (`barchan_slam::Combined`) over a whole sequence.
pub fn run(
    args: &Args,
    source: Arc<dyn StereoSource>,
    out: StagedDir,
    output: &Output,
    runtime: Option<&Path>,
) -> Result<()> {
    let mut config: CombinedConfig = configured(args.config.as_deref())?;
    config.scale = args.scale.map_or(config.scale, super::ScaleBy::into);
    let poses = poses_up_to_scale(args, &source, output)?;
    let scale_form = config.scale;
    let engine = load_engine(&args.model, runtime, &args.engine)?;
    let engine_name = engine.name();
    out.write("config.toml", toml::to_string(&config)?)?;
    let mut log = RunLog::create(&out)?;
    let mut combined = Combined::new(*source.rig(), config, engine, poses)
        .context("with --poses, --right-poses and --scale as given")?;
    let frames = source.len();
    let bar = output.progress("slam", frames);
    let (mut tracked, mut track_ms, mut disparity_ms) = (0, vec![], vec![]);
    let mut total_ms = 0.0;
    for frame in prefetch(source, (0..frames).collect(), 4) {
        let frame = frame?;
        let mut report = combined.track(&frame)?;
        if report.tracked {
            tracked += 1;
            track_ms.push(report.ms_track);
        } else {
            output.notice(&format!("frame {} is lost: {}", report.name, report.reason));
        }
        if let Some(dense) = report.dense.take() {
            write_dense(&out, report.frame, &frame.left, &dense)?;
            disparity_ms.push(report.ms_disparity);
        }
        total_ms += report.ms_track + report.ms_disparity;
        log.add(&report)?;
        bar.inc(1);
    }
    log.finish()?;
    bar.finish_and_clear();
    if tracked == 0 {
        bail!(
            "no frame of {} has a pose\n  cure: give --poses, the trajectory.tum of a run over the same data",
            args.data
        );
    }

    let result = combined.finish().with_context(|| args.data.clone())?;
    let keyframes: Vec<RunKeyframe> = (result.keyframes.into_iter())
        .map(|(frame, name, pose)| RunKeyframe {
            frame,
            name,
            pose,
            submap: 0,
            covariance: None,
        })
        .collect();
    write_poses(&out, &result.trajectory, &keyframes)?;
    result.map.write_ply(&out.path("map.ply")?)?;
    let (ms_track_median, ms_track_p95) = percentiles(track_ms);
    let summary = Summary {
        method: "combined",
        engine: engine_name,
        frames,
        tracked,
        keyframes: keyframes.len(),
        loops: 0,
        submaps: 1,
        points: result.map.points.len(),
        scale_form,
        scale: result.scale,
        ms_track_median,
        ms_track_p95,
        ms_disparity_median: percentiles(disparity_ms).0,
        fps: 1e3 * frames as f64 / total_ms,
    };
    out.write_json("summary.json", &summary)?;
    out.finish()?;
    let text = format!(
        "{tracked} of {frames} frames have a pose, {} key frames, {} points; {ms_track_median:.1} ms a frame (p95 {ms_track_p95:.1}), \
         {:.1} ms disparity a key frame, {:.1} frames/s\n{}\n{}: trajectory.tum trajectory.kitti keyframes.tum map.ply",
        summary.keyframes,
        summary.points,
        summary.ms_disparity_median,
        summary.fps,
        describe(&summary.scale),
        args.out.display(),
    );
    output.result(&summary, &text)
}

/// Those that are given, or those of structure from motion: of the frames that it placed.
fn poses_up_to_scale(
    args: &Args,
    source: &Arc<dyn StereoSource>,
    output: &Output,
) -> Result<UpToScale> {
    let right = (args.right_poses.as_deref())
        .map(Trajectory::read_tum)
        .transpose()?;
    if let Some(left) = &args.poses {
        let left = Trajectory::read_tum(left)?;
        return Ok(UpToScale { left, right });
    }
    let result = reconstruct(source, SfmConfig::default(), output, None)?.result;
    let poses = (result.trajectory_up_to_scale.poses.into_iter()).zip(result.tracked);
    let placed = poses.filter_map(|(pose, tracked)| tracked.then_some(pose));
    let left = Trajectory {
        poses: placed.collect(),
    };
    Ok(UpToScale { left, right })
}

fn describe(scale: &Scale) -> String {
    let mut text = format!("a unit of the poses is {:.5} m", scale.factor);
    if let Some([overall, least, greatest]) = scale.corrected {
        text += &format!(
            "; by points of stereo {overall:.5} m, {least:.5} to {greatest:.5} along the way"
        );
    }
    if let Some(deviation) = scale.deviation {
        text += &format!(", known to {:.2} %", 100.0 * deviation);
    }
    if let Some(thesis) = scale.thesis {
        text += &format!("; by the distance of the cameras {thesis:.5} m");
    }
    text
}
