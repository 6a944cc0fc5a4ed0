use std::path::PathBuf;

use anyhow::{Context, Result};
use barchan_datasets::check::{Report, check};
use barchan_datasets::{Plane, StereoFrame, StereoSource, open};
use barchan_eval::trajectory::path_length;
use barchan_geometry::{RectifiedRig, StampedPose};
use clap::Parser;
use serde::Serialize;

use crate::output::Output;
use crate::preview::contact_sheet;

/// What a dataset holds: frames, rig, times, truth, the disparities to expect, with a contact sheet
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan data info images/\n  \
    barchan data info kitti-odometry:dataset/sequences/00 --picture 00.png --json")]
pub struct Args {
    /// Stereo pairs: PATH or FORMAT:PATH
    data: String,
    /// Where the contact sheet goes: left, right and true disparity of pairs spread over the sequence
    #[arg(long, value_name = "FILE.png", default_value = "contact-sheet.png")]
    picture: PathBuf,
}

#[derive(Serialize)]
struct Summary {
    frames: usize,
    /// That of the first pair, where pairs differ.
    rig: RectifiedRig,
    /// How many different rigs there are.
    rigs: usize,
    /// Of the first and the last frame, seconds; none where the frames have no times.
    times: Option<[f64; 2]>,
    true_disparity: bool,
    /// Length of the true path, metres.
    true_path: Option<f64>,
    imu_samples: usize,
    odometry_samples: usize,
    gnss_fixes: usize,
    /// 2nd, 50th and 98th percentile by matching, pixels.
    disparity: Option<[f64; 3]>,
    /// Depths of the 98th, 50th and 2nd percentile of disparity, metres; none at infinity.
    depth: Option<[Option<f64>; 3]>,
    findings: usize,
    picture: PathBuf,
}

/// Rows of the contact sheet.
const SHEET: usize = 6;

pub fn run(args: Args, output: &Output) -> Result<()> {
    let source = open(&args.data)?;
    let len = source.len();
    let report = check(source.as_ref())?;
    let shown = SHEET.min(len);
    let mut rows = Vec::with_capacity(shown);
    for k in 0..shown {
        let index = k * len / shown;
        rows.push((source.frame(index)?, source.true_disparity(index)?));
    }
    contact_sheet(&rows)
        .save(&args.picture)
        .with_context(|| args.picture.display().to_string())?;

    let last = source.frame(len - 1)?.time;
    let first = rows.first().map_or(0.0, |(frame, _)| frame.time);
    // A source that knows no times counts its frames.
    let times = (first != 0.0 || last != (len - 1) as f64).then_some([first, last]);
    let summary = summary(source.as_ref(), &report, &rows, times, args.picture);
    let text = text(&args.data, &summary);
    output.result(&summary, &text)
}

fn summary(
    source: &dyn StereoSource,
    report: &Report,
    rows: &[(StereoFrame, Option<Plane>)],
    times: Option<[f64; 2]>,
    picture: PathBuf,
) -> Summary {
    let rig = *source.rig();
    let mut rigs: Vec<&RectifiedRig> = Vec::new();
    for index in 0..source.len() {
        let rig = source.frame_rig(index);
        if !rigs.contains(&rig) {
            rigs.push(rig);
        }
    }
    let depth = |d: f64| Some(rig.depth(d)).filter(|z| z.is_finite() && *z > 0.0);
    let sensors = source.sensors();
    Summary {
        frames: source.len(),
        rigs: rigs.len(),
        times,
        true_disparity: rows.iter().any(|(_, truth)| truth.is_some()),
        true_path: source.true_trajectory().map(|truth| {
            let position = |pose: &StampedPose| pose.T_world_cam.translation.vector;
            path_length(&truth.poses.iter().map(position).collect::<Vec<_>>())
        }),
        imu_samples: sensors.map_or(0, |s| s.imu.len()),
        odometry_samples: sensors.map_or(0, |s| s.odometry.len()),
        gnss_fixes: sensors.map_or(0, |s| s.gnss.len()),
        disparity: report.disparity,
        depth: report
            .disparity
            .map(|[low, middle, high]| [depth(high), depth(middle), depth(low)]),
        findings: report.findings.len(),
        rig,
        picture,
    }
}

fn text(data: &str, s: &Summary) -> String {
    let rig = &s.rig;
    let mut text = format!(
        "{data}\n  pairs        {} of {} x {}{}\n  rig          fx {:.2} fy {:.2} cx {:.2} cy {:.2} px, baseline {:.4} m",
        s.frames,
        rig.width,
        rig.height,
        if s.rigs > 1 {
            format!(" and other sizes: {} rigs, the first is shown", s.rigs)
        } else {
            String::new()
        },
        rig.fx,
        rig.fy,
        rig.cx,
        rig.cy,
        rig.baseline
    );
    if rig.doffs != 0.0 {
        text += &format!(", doffs {:.3} px", rig.doffs);
    }
    text += &match s.times {
        Some([first, last]) if s.frames > 1 => format!(
            "\n  time         {first:.3} to {last:.3} s, {:.2} pairs a second",
            (s.frames - 1) as f64 / (last - first)
        ),
        _ => "\n  time         not known".into(),
    };
    let mut truth = Vec::new();
    if s.true_disparity {
        truth.push("disparity".to_owned());
    }
    if let Some(length) = s.true_path {
        truth.push(format!("poses over {length:.2} m"));
    }
    if truth.is_empty() {
        truth.push("none".into());
    }
    text += &format!("\n  truth        {}", truth.join(", "));
    let sensors: Vec<String> = [
        (s.imu_samples, "IMU samples"),
        (s.odometry_samples, "wheel odometry samples"),
        (s.gnss_fixes, "GNSS fixes"),
    ]
    .into_iter()
    .filter(|(count, _)| *count > 0)
    .map(|(count, what)| format!("{count} {what}"))
    .collect();
    if !sensors.is_empty() {
        text += &format!("\n  sensors      {}", sensors.join(", "));
    }
    if let (Some([low, middle, high]), Some(depth)) = (s.disparity, s.depth) {
        let metres = |z: Option<f64>| z.map_or("infinity".into(), |z| format!("{z:.2}"));
        text += &format!(
            "\n  disparity    {low:.1} to {high:.1} px, half above {middle:.1} (by matching); depth {} to {} m, half nearer than {}",
            metres(depth[0]),
            metres(depth[2]),
            metres(depth[1])
        );
    }
    text += &match s.findings {
        0 => "\n  calibration  nothing is wrong".to_owned(),
        n => format!(
            "\n  calibration  {n} finding{}: `barchan data check {data}` says what",
            if n == 1 { "" } else { "s" }
        ),
    };
    text + &format!("\n{}: left, right and true disparity", s.picture.display())
}
