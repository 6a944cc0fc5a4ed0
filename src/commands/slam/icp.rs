use std::path::Path;
use std::sync::Arc;

use anyhow::{Result, bail};
use barchan_datasets::{StereoSource, prefetch};
use barchan_slam::{IcpOdometry, IcpOdometryConfig};
use serde::Serialize;

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
    fitness_median: f64,
    rmse_median: f64,
    ms_track_median: f64,
    ms_track_p95: f64,
    ms_disparity_median: f64,
    fps: f64,
}

/// Registration of the clouds of successive pairs (`barchan_slam::IcpOdometry`) over a whole sequence.
pub fn run(
    args: &Args,
    source: Arc<dyn StereoSource>,
    out: StagedDir,
    output: &Output,
    runtime: Option<&Path>,
) -> Result<()> {
    let config: IcpOdometryConfig = configured(args.config.as_deref())?;
    let engine = load_engine(&args.model, runtime, &args.engine)?;
    let engine_name = engine.name();
    out.write("config.toml", toml::to_string(&config)?)?;
    let mut log = RunLog::create(&out)?;
    let mut odometry = IcpOdometry::new(*source.rig(), config, engine)?;
    let frames = source.len();
    let bar = output.progress("slam", frames);
    let (mut track_ms, mut disparity_ms) = (vec![], vec![]);
    let (mut fitness, mut rmse) = (vec![], vec![]);
    for frame in prefetch(source, (0..frames).collect(), 4) {
        let frame = frame?;
        let report = odometry.track(&frame)?;
        if report.tracked {
            fitness.push(report.fitness);
            rmse.push(report.rmse);
        } else {
            output.notice(&format!("frame {} is lost: {}", report.name, report.reason));
        }
        if report.keyframe {
            write_dense(&out, report.frame, &frame.left, &report.dense)?;
        }
        track_ms.push(report.ms_track);
        disparity_ms.push(report.ms_disparity);
        log.add(&report)?;
        bar.inc(1);
    }
    log.finish()?;
    bar.finish_and_clear();
    let tracked = fitness.len();
    if tracked == 0 {
        bail!(
            "{}: no frame could be tracked; the notes above say why",
            args.data
        );
    }

    let result = odometry.finish();
    let submaps = result.submaps.last().map_or(0, |last| last + 1);
    if submaps > 1 {
        output.notice(&format!(
            "the map is of {submaps} parts, and how they lie to each other is a guess: keyframes.csv says what belongs to which, and `barchan map` takes the largest"
        ));
    }
    let keyframes = result.keyframes.into_iter().zip(&result.submaps);
    let keyframes: Vec<RunKeyframe> = keyframes
        .map(|((frame, name, pose), submap)| RunKeyframe {
            frame,
            name,
            pose,
            submap: *submap,
            covariance: None,
        })
        .collect();
    write_poses(&out, &result.trajectory, &keyframes)?;
    result.map.write_ply(&out.path("map.ply")?)?;
    let total_ms = track_ms.iter().chain(&disparity_ms).sum::<f64>();
    let (ms_track_median, ms_track_p95) = percentiles(track_ms);
    let summary = Summary {
        method: "icp",
        engine: engine_name,
        frames,
        tracked,
        keyframes: keyframes.len(),
        loops: 0,
        submaps,
        points: result.map.points.len(),
        fitness_median: percentiles(fitness).0,
        rmse_median: percentiles(rmse).0,
        ms_track_median,
        ms_track_p95,
        ms_disparity_median: percentiles(disparity_ms).0,
        fps: 1e3 * frames as f64 / total_ms,
    };
    out.write_json("summary.json", &summary)?;
    out.finish()?;
    let text = format!(
        "{tracked} of {frames} frames tracked, {} key frames, {} points; {ms_track_median:.1} ms a frame (p95 {ms_track_p95:.1}), \
         {:.1} ms disparity, {:.1} frames/s\n{:.0} % of a cloud correspond to the one before, {:.3} m apart (medians)\n\
         {}: trajectory.tum trajectory.kitti keyframes.tum map.ply",
        summary.keyframes,
        summary.points,
        summary.ms_disparity_median,
        summary.fps,
        100.0 * summary.fitness_median,
        summary.rmse_median,
        args.out.display(),
    );
    output.result(&summary, &text)
}
