//! Clouds at poses up to scale, over a rendered sequence: true poses in an unknown unit, with noise, stand for
//! structure from motion.

use std::sync::LazyLock;

use barchan_datasets::{StereoFrame, StereoSource, Synth};
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, score};
use barchan_geometry::{Se3, StampedPose, Trajectory, se3};
use barchan_infer::SemiGlobal;
use barchan_slam::{
    Combined, CombinedConfig, CombinedReport, CombinedResult, ScaleForm, SlamError, UpToScale,
};
use nalgebra::Vector6;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The drive, rendered once.
static DRIVE: LazyLock<(Synth, Vec<StereoFrame>)> = LazyLock::new(|| {
    let synth = Synth::parse("seed=1,frames=40").unwrap();
    let frames = (0..synth.len()).map(|i| synth.frame(i).unwrap());
    let frames = frames.collect();
    (synth, frames)
});
/// Metres in a unit.
const FACTOR: f64 = 2.7;

/// Draws about normally distributed twists.
struct Noise(ChaCha8Rng);

impl Noise {
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.0.random_range(-0.5..0.5)).sum()
    }

    /// Deviations in metres and radians.
    fn motion(&mut self, metres: f64, radians: f64) -> Se3 {
        let scale = |k: usize| if k < 3 { metres } else { radians };
        se3::exp(&Vector6::from_fn(|k, _| scale(k) * self.normal()))
    }
}

/// What structure from motion makes of a drive: `unit` says how many metres a unit is at each frame; left cameras are
/// known to 4 mm and 0.03 degrees of where the drive has them, right ones, which nothing ties to the left, to `right` metres.
fn poses(unit: impl Fn(usize) -> f64, right: f64) -> UpToScale {
    let source = &DRIVE.0;
    let truth = &source.true_trajectory().unwrap().poses;
    let mut noise = Noise(ChaCha8Rng::seed_from_u64(7));
    let (mut lefts, mut rights) = (vec![], vec![]);
    let mut place = truth[0].T_world_cam.translation.vector / unit(0);
    for (i, pose) in truth.iter().enumerate() {
        if i > 0 {
            let step =
                pose.T_world_cam.translation.vector - truth[i - 1].T_world_cam.translation.vector;
            place += step / unit(i);
        }
        let camera = |offset: Se3| {
            let offset = Se3::from_parts(
                (offset.translation.vector / unit(i)).into(),
                offset.rotation,
            );
            StampedPose {
                time: pose.time,
                T_world_cam: Se3::from_parts(place.into(), pose.T_world_cam.rotation) * offset,
            }
        };
        lefts.push(camera(noise.motion(0.004, 0.0005)));
        let beside = Se3::translation(source.rig().baseline, 0.0, 0.0);
        rights.push(camera(beside * noise.motion(right, 0.0005)));
    }
    UpToScale {
        left: Trajectory { poses: lefts },
        right: Some(Trajectory { poses: rights }),
    }
}

fn run(
    frames: usize,
    config: CombinedConfig,
    poses: UpToScale,
) -> Result<(Vec<CombinedReport>, CombinedResult), SlamError> {
    let engine = Box::new(SemiGlobal::new(Some(64)));
    let (synth, all) = &*DRIVE;
    let mut combined = Combined::new(*synth.rig(), config, engine, poses)?;
    let reports = all[..frames].iter().map(|f| combined.track(f));
    let reports = reports.collect::<Result<_, _>>()?;
    let result = combined.finish()?;
    println!("{} key frames, {:?}", result.keyframes.len(), result.scale);
    Ok((reports, result))
}

/// Error of the route against the truth, as a share of its length, without any scaling.
fn error(result: &CombinedResult) -> f64 {
    let truth = DRIVE.0.true_trajectory().unwrap();
    let score = score(&result.trajectory, truth, DEFAULT_TOLERANCE).unwrap();
    println!("{score:?}");
    score.ate_rmse / score.length
}

#[test]
fn the_corrected_scale_is_metric_where_the_thesis_comes_out_too_small() {
    // Noise of right cameras: a quarter of the baseline.
    let poses = poses(|_| FACTOR, 0.03);
    let config = CombinedConfig::default();
    let (reports, result) = run(40, config, poses.clone()).unwrap();
    assert!(reports.iter().all(|r| r.tracked));
    assert!(reports.iter().all(|r| r.keyframe == r.dense.is_some()));
    assert!(result.keyframes.len() > 5 && result.map.points.len() > 10_000);
    let [overall, ..] = result.scale.corrected.unwrap();
    assert_eq!(overall, result.scale.factor);
    assert!((overall / FACTOR - 1.0).abs() < 0.01, "{overall}");
    assert!(result.scale.deviation.unwrap() < 0.03);
    // The length of a noisy vector is biased, by noise squared over baseline squared: about 6 % here.
    let thesis = result.scale.thesis.unwrap();
    assert!(thesis < 0.97 * FACTOR && thesis > 0.85 * FACTOR, "{thesis}");
    assert!(error(&result) < 0.005);

    let config = CombinedConfig {
        scale: ScaleForm::Thesis,
        ..CombinedConfig::default()
    };
    let (_, as_in_thesis) = run(40, config, poses).unwrap();
    assert_eq!(as_in_thesis.scale.factor, thesis);
    assert!(error(&as_in_thesis) > 2.0 * error(&result));
}

#[test]
fn a_unit_that_changes_on_the_way_is_followed() {
    let drifting = |i: usize| FACTOR * (1.0 + 0.01 * i as f64);
    let poses = poses(drifting, 0.03);
    let of_window = |window| {
        let config = CombinedConfig {
            window,
            ..CombinedConfig::default()
        };
        run(40, config, poses.clone()).unwrap().1
    };
    let local = of_window(2);
    let [overall, least, greatest] = local.scale.corrected.unwrap();
    assert!(least < 0.95 * overall && greatest > 1.05 * overall);
    let global = of_window(1000);
    let [overall, least, greatest] = global.scale.corrected.unwrap();
    assert_eq!([least, greatest], [overall; 2]);
    assert!(error(&local) < 0.6 * error(&global));
}

#[test]
fn missing_poses_are_said_and_a_scale_that_nothing_tells_is_none() {
    let mut poses = poses(|_| FACTOR, 0.0);
    poses.left.poses.drain(4..6);
    let (reports, result) = run(12, CombinedConfig::default(), poses.clone()).unwrap();
    let lost: Vec<usize> = reports
        .iter()
        .filter(|r| !r.tracked)
        .map(|r| r.frame)
        .collect();
    assert_eq!(lost, [4, 5]);
    assert!(reports[4].reason.contains("no pose"));
    assert_eq!(result.trajectory.poses.len(), 12);
    assert_eq!(
        result.trajectory.poses[5].T_world_cam,
        result.trajectory.poses[3].T_world_cam
    );

    // Another clock: nothing is placed, so nothing is known.
    let mut elsewhere = poses.clone();
    elsewhere.left.poses.iter_mut().for_each(|p| p.time += 1e6);
    let refused = run(12, CombinedConfig::default(), elsewhere);
    assert!(matches!(refused, Err(SlamError::Scale(_))));
    // The thesis's form wants right cameras.
    poses.right = None;
    let config = CombinedConfig {
        scale: ScaleForm::Thesis,
        ..CombinedConfig::default()
    };
    assert!(matches!(run(12, config, poses), Err(SlamError::Scale(_))));
}
