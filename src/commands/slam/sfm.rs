use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Result, bail};
use barchan_datasets::{StereoSource, prefetch};
use barchan_slam::sfm::{MetricScale, SfmConfig, SfmPoint, SfmResult, StructureFromMotion};
use barchan_terrain::{Cloud, CloudPoint};
use serde::Serialize;

use super::{Args, configured};
use crate::output::{Output, StagedDir, percentiles};
use crate::slam_run::{RunKeyframe, RunLog, write_poses};

#[derive(Serialize)]
struct Summary {
    method: &'static str,
    frames: usize,
    /// Placed by what they see.
    tracked: usize,
    keyframes: usize,
    /// None are looked for.
    loops: usize,
    submaps: usize,
    points: usize,
    /// Metres in a unit; null when stereo does not tell.
    scale: Option<f64>,
    /// Views that tell the length of the baseline, and how many of them agree.
    scale_views: usize,
    scale_views_used: usize,
    ms_track_median: f64,
    ms_track_p95: f64,
    ms_finish: f64,
    fps: f64,
}

/// Structure from motion by the left camera (`barchan_slam::sfm`) over a whole sequence.
pub fn run(
    args: &Args,
    source: Arc<dyn StereoSource>,
    out: StagedDir,
    output: &Output,
) -> Result<()> {
    let config = configuration(args)?;
    out.write("config.toml", toml::to_string(&config)?)?;
    let mut log = RunLog::create(&out)?;
    let frames = source.len();
    let Reconstruction {
        result,
        track_ms,
        ms_finish,
    } = reconstruct(&source, config, output, Some(&mut log))?;
    log.finish()?;
    let tracked = result.tracked.iter().filter(|t| **t).count();
    if result.points.is_empty() {
        bail!(
            "{}: nothing could be reconstructed: too little motion, or too little to see\n  cure: the notes above and the images say which; --keypoints 3000 finds more to follow",
            args.data
        );
    }
    let submaps = result.views.iter().map(|v| v.piece);
    let submaps = submaps.collect::<BTreeSet<_>>().len();
    if submaps > 1 {
        output.notice(&format!(
            "the reconstruction is of {submaps} pieces, and how they lie to each other is a guess: keyframes.csv says what belongs to which"
        ));
    }
    if result.scale.is_none() {
        output.notice(
            "how long a metre is cannot be told from the right images: all is in units of its own",
        );
    }
    write_result(&out, &result)?;
    let total_ms = track_ms.iter().sum::<f64>() + ms_finish;
    let (ms_track_median, ms_track_p95) = percentiles(track_ms);
    let told = |count: fn(&MetricScale) -> usize| result.scale.as_ref().map_or(0, count);
    let summary = Summary {
        method: "sfm",
        frames,
        tracked,
        keyframes: result.views.len(),
        loops: 0,
        submaps,
        points: result.points.len(),
        scale: result.scale.as_ref().map(|s| s.factor),
        scale_views: told(|s| s.baselines.len()),
        scale_views_used: told(|s| s.used),
        ms_track_median,
        ms_track_p95,
        ms_finish,
        fps: 1e3 * frames as f64 / total_ms,
    };
    out.write_json("summary.json", &summary)?;
    out.finish()?;
    let metre = match summary.scale {
        Some(scale) => format!(
            "{scale:.4} m in a unit by {} of {} views",
            summary.scale_views_used, summary.scale_views
        ),
        None => "no metric scale".into(),
    };
    let text = format!(
        "{tracked} of {frames} frames placed, {} views in {submaps} piece(s), {} points; {metre}; \
         {ms_track_median:.1} ms a frame (p95 {ms_track_p95:.1}), {ms_finish:.0} ms at the end, {:.1} frames/s\n\
         {}: trajectory.tum trajectory.kitti trajectory-units.tum keyframes.tum map.ply",
        summary.keyframes,
        summary.points,
        summary.fps,
        args.out.display(),
    );
    output.result(&summary, &text)
}

/// What structure from motion made of a sequence, and how long it took.
pub(super) struct Reconstruction {
    pub result: SfmResult,
    track_ms: Vec<f64>,
    ms_finish: f64,
}

/// Structure from motion over a whole sequence.
pub(super) fn reconstruct(
    source: &Arc<dyn StereoSource>,
    config: SfmConfig,
    output: &Output,
    mut log: Option<&mut RunLog>,
) -> Result<Reconstruction> {
    let frames = source.len();
    let mut sfm = StructureFromMotion::new(*source.rig(), config);
    let bar = output.progress("sfm", frames);
    let mut track_ms = vec![];
    for frame in prefetch(source.clone(), (0..frames).collect(), 4) {
        let report = sfm.track(&frame?)?;
        if !report.tracked {
            let (name, reason) = (&report.name, &report.reason);
            output.notice(&format!("frame {name} is discarded: {reason}"));
        }
        track_ms.push(report.ms);
        if let Some(log) = &mut log {
            log.add(&report)?;
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    let started = Instant::now();
    let result = sfm.finish();
    Ok(Reconstruction {
        result,
        track_ms,
        ms_finish: started.elapsed().as_secs_f64() * 1e3,
    })
}

fn configuration(args: &Args) -> Result<SfmConfig> {
    let mut config: SfmConfig = configured(args.config.as_deref())?;
    config.tracks = args.tracks.map_or(config.tracks, Into::into);
    config.features = args.keypoints.unwrap_or(config.features);
    Ok(config)
}

fn write_result(out: &StagedDir, result: &SfmResult) -> Result<()> {
    let keyframe = |view: &barchan_slam::sfm::SfmView| RunKeyframe {
        frame: view.frame,
        name: view.name.clone(),
        pose: view.pose,
        submap: view.piece,
        covariance: None,
    };
    let keyframes: Vec<_> = result.views.iter().map(keyframe).collect();
    write_poses(out, &result.trajectory, &keyframes)?;
    out.write(
        "trajectory-units.tum",
        result.trajectory_up_to_scale.to_tum(),
    )?;
    if let Some(scale) = &result.scale {
        let lines = scale
            .baselines
            .iter()
            .map(|(frame, b)| format!("{frame},{b}\n"));
        let table: String = lines.collect();
        out.write("scale.csv", "frame,baseline_units\n".to_owned() + &table)?;
    }
    let point = |p: &SfmPoint| CloudPoint {
        position: p.position,
        colour: p.colour,
        sigma: f32::NAN,
    };
    let cloud = Cloud {
        points: result.points.iter().map(point).collect(),
    };
    cloud.write_ply(&out.path("map.ply")?)?;
    Ok(())
}
