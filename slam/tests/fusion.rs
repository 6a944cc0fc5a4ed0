//! Cameras that go dark while other sensors do not, on rendered drives with truth.

use barchan_datasets::{StereoFrame, StereoSource, open};
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, score};
use barchan_geometry::Se3;
use barchan_slam::{FrameReport, FusionCounts, Slam, SlamConfig, SlamResult};

struct Run {
    reports: Vec<FrameReport>,
    result: SlamResult,
    counts: Option<FusionCounts>,
}

/// Runs over a source whose frames `spoil` changes.
fn run(source: &dyn StereoSource, fused: bool, spoil: impl Fn(&mut StereoFrame)) -> Run {
    let mut slam = Slam::new(*source.rig(), SlamConfig::default(), None);
    if fused {
        slam = slam.with_sensors(source.sensors().unwrap());
    }
    let mut reports = Vec::new();
    for i in 0..source.len() {
        let mut frame = source.frame(i).unwrap();
        spoil(&mut frame);
        reports.push(slam.track(&frame).unwrap());
    }
    for r in reports.iter().filter(|r| !r.tracked) {
        println!("{}: {}", r.name, r.reason);
    }
    let counts = slam.fusion_counts();
    println!("{counts:?}");
    Run {
        reports,
        result: slam.finish(),
        counts,
    }
}

fn darken(frame: &mut StereoFrame) {
    for image in [&mut frame.left, &mut frame.right] {
        image.iter_mut().for_each(|v| *v = 0.0);
    }
}

fn truth(source: &dyn StereoSource, index: usize) -> Se3 {
    source.true_trajectory().unwrap().poses[index].T_world_cam
}

/// How far the motion between two frames is off, metres, and how long the way was.
fn off(run: &Run, source: &dyn StereoSource, from: usize, to: usize) -> (f64, f64) {
    let poses = &run.result.trajectory.poses;
    let found = poses[from].T_world_cam.inverse() * poses[to].T_world_cam;
    let true_motion = truth(source, from).inverse() * truth(source, to);
    let way = (from..to).map(|k| {
        let [a, b] = [k, k + 1].map(|k| truth(source, k).translation.vector);
        (b - a).norm()
    });
    let gap = found.translation.vector - true_motion.translation.vector;
    (gap.norm(), way.sum())
}

fn is_whole(run: &Run) -> bool {
    run.result.submaps.iter().all(|s| *s == 0)
}

#[test]
fn twenty_seconds_of_darkness_are_carried_and_the_map_goes_on() {
    for seed in [3, 8] {
        let spec = format!("synth:seed={seed},frames=190,width=256,height=192");
        let source = open(&spec).unwrap();
        let dark = 60..160;
        let fused = run(source.as_ref(), true, |f| {
            if dark.contains(&f.index) {
                darken(f);
            }
        });
        assert!(dark.clone().all(|k| fused.reports[k].carried));
        assert!(is_whole(&fused));
        assert!(fused.reports[170..].iter().all(|r| r.tracked));
        let (gap, way) = off(&fused, source.as_ref(), 59, 170);
        println!("{seed}: {gap} m of {way}");
        assert!(gap < 0.02 * way, "{seed}: {gap} m of {way}");
        // The deviations that the key frames state are as large as that.
        let covariances = fused.result.covariances.as_ref().unwrap();
        let last = covariances.last().unwrap().fixed_view::<3, 3>(0, 0).trace();
        assert!((last / 3.0).sqrt() > gap / 6.0 && last.sqrt() < 0.5, "{last}");
    }
}

#[test]
fn a_clear_drive_is_no_worse_with_sensors() {
    let source = open("synth:seed=4,frames=60,width=256,height=192").unwrap();
    let ate = |fused: bool| {
        let run = run(source.as_ref(), fused, |_| {});
        assert!(run.reports.iter().all(|r| r.tracked && !r.carried));
        assert_eq!(run.counts.is_some(), fused);
        if let Some(counts) = run.counts {
            assert_eq!((counts.visual, counts.visual_refused), (59, 0));
            assert!(counts.wheels_refused * 20 < counts.wheels, "{counts:?}");
        }
        let truth = source.true_trajectory().unwrap();
        score(&run.result.trajectory, truth, DEFAULT_TOLERANCE).unwrap().ate_rmse
    };
    let (with, without) = (ate(true), ate(false));
    println!("{with} {without}");
    assert!(with < 1.2 * without + 0.002, "{with} {without}");
}
