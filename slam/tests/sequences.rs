//! Whole sequences with truth: real rover images where they are at hand, rendered ones always.

use std::path::Path;

use barchan_datasets::{StereoSource, open};
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, TrajectoryScore, score};
use barchan_slam::{Slam, SlamConfig};

/// Tracks a source without an engine: how many frames, and how well.
fn track(source: &dyn StereoSource) -> (usize, TrajectoryScore) {
    let mut slam = Slam::new(*source.rig(), SlamConfig::default(), None);
    let (mut tracked, mut milliseconds) = (0, 0.0);
    for index in 0..source.len() {
        let report = slam.track(&source.frame(index).unwrap()).unwrap();
        if !report.tracked {
            println!("{}: {}", report.name, report.reason);
        }
        tracked += usize::from(report.tracked);
        milliseconds += report.ms_track;
    }
    let result = slam.finish();
    let score = score(
        &result.trajectory,
        source.true_trajectory().unwrap(),
        DEFAULT_TOLERANCE,
    )
    .unwrap();
    println!(
        "{tracked} of {} frames, {} key frames, {} points, {:.1} ms a frame, ATE SE3 {:.4} m, Sim3 {:.4} m, scale {:.4}",
        source.len(),
        result.keyframes.len(),
        result.map.points.len(),
        milliseconds / source.len() as f64,
        score.ate_rmse,
        score.ate_rmse_sim3,
        score.scale
    );
    (tracked, score)
}

#[test]
fn a_real_rover_in_a_sand_arena() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/arena-run1");
    if !data.is_dir() {
        println!("skipped: {} is not there", data.display());
        return;
    }
    let source = open(&format!("folder:{}", data.display())).unwrap();
    let (tracked, score) = track(source.as_ref());
    assert_eq!(tracked, 128);
    assert!(score.ate_rmse_sim3 <= 0.06, "{score:?}");
}

#[test]
fn a_rendered_traverse() {
    let source = open("synth:seed=4,frames=30").unwrap();
    let (tracked, score) = track(source.as_ref());
    assert_eq!(tracked, 30);
    assert!(score.ate_rmse <= 0.01 * score.length, "{score:?}");
}
