//! Cameras that go dark while other sensors do not, on rendered drives with truth.

use barchan_datasets::{Rgb, StereoFrame, StereoSource, open};
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, score};
use barchan_geometry::nalgebra::{Matrix6, Vector6};
use barchan_geometry::{Se3, se3};
use barchan_slam::{FrameReport, Fusion, FusionCounts, Motion, Slam, SlamConfig, SlamResult};

struct Run {
    reports: Vec<FrameReport>,
    result: SlamResult,
    counts: Option<FusionCounts>,
}

/// Runs over frames of a source.
fn run(source: &dyn StereoSource, fused: bool, frames: impl Iterator<Item = StereoFrame>) -> Run {
    let mut slam = Slam::new(*source.rig(), SlamConfig::default(), None);
    if fused {
        slam = slam.with_sensors(source.sensors().unwrap());
    }
    let reports: Vec<FrameReport> = frames.map(|f| slam.track(f).unwrap()).collect();
    for r in reports
        .iter()
        .filter(|r| !r.tracked && !r.reason.contains("100 % black"))
    {
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

/// A frame of a covered camera.
fn dark(source: &dyn StereoSource, index: usize) -> StereoFrame {
    let black = Rgb::new(source.rig().width as u32, source.rig().height as u32);
    StereoFrame {
        index,
        name: source.name(index),
        time: source.true_trajectory().unwrap().poses[index].time,
        left: black.clone(),
        right: black,
    }
}

fn truth(source: &dyn StereoSource, index: usize) -> Se3 {
    source.true_trajectory().unwrap().poses[index].T_world_cam
}

/// How far the motion between two places of a run is off, metres.
fn off(run: &Run, source: &dyn StereoSource, from: [usize; 2], to: [usize; 2]) -> f64 {
    let poses = &run.result.trajectory.poses;
    let found = poses[from[0]].T_world_cam.inverse() * poses[to[0]].T_world_cam;
    let true_motion = truth(source, from[1]).inverse() * truth(source, to[1]);
    (found.translation.vector - true_motion.translation.vector).norm()
}

/// Metres from one frame to another.
fn way(source: &dyn StereoSource, from: usize, to: usize) -> f64 {
    let steps = (from..to).map(|k| {
        let [a, b] = [k, k + 1].map(|k| truth(source, k).translation.vector);
        (b - a).norm()
    });
    steps.sum()
}

/// What images would say of a motion: to 3 mm and a milliradian, as a wave that never repeats.
#[allow(non_snake_case)]
fn seen(T_anchor_now: Se3, k: usize) -> Motion {
    let wave = |axis: usize| 1.4 * ((k * k) as f64 * 0.7 + axis as f64 * 2.1).sin();
    let sigma = |axis: usize| if axis < 3 { 0.003 } else { 0.001 };
    let error = Vector6::from_fn(|axis, _| sigma(axis) * wave(axis));
    Motion {
        T_anchor_now: se3::exp(&error) * T_anchor_now,
        covariance: Matrix6::from_diagonal(&Vector6::from_fn(|axis, _| sigma(axis).powi(2))),
    }
}

#[test]
fn the_sensors_of_every_route_carry_twenty_seconds() {
    for spec in [
        "route=circle",
        "route=loop,look=moon",
        "route=straight,speed=0.2,pan=30",
        "route=circle,speed=1,stops=5",
        // The mast turns around at each stop, and looks to the right of ahead between.
        "route=survey",
    ] {
        let source = open(&format!(
            "synth:seed=7,width=32,height=32,frames=450,{spec}"
        ))
        .unwrap();
        for dark in [120, 210, 340] {
            let mut fusion = Fusion::new(source.sensors().unwrap(), Default::default()).unwrap();
            for k in 0..=dark {
                fusion.advance(k as f64 * 0.2).unwrap();
                if k > 0 {
                    let motion =
                        truth(source.as_ref(), k - 1).inverse() * truth(source.as_ref(), k);
                    fusion.correct(&seen(motion, k));
                }
                fusion.anchor();
            }
            let end = dark + 100;
            let motion = fusion.advance(end as f64 * 0.2).unwrap();
            let expected = truth(source.as_ref(), dark).inverse() * truth(source.as_ref(), end);
            let gap = motion.T_anchor_now.translation.vector - expected.translation.vector;
            let (gap, way) = (gap.norm(), way(source.as_ref(), dark, end));
            let (sigma, _) = motion.sigma();
            println!(
                "{spec} {dark}: {gap:.3} m of {way:.2}, stated {sigma:.3}; {:?}",
                fusion.counts()
            );
            assert!(gap < (0.02 * way).max(0.05), "{spec}: {gap} m of {way}");
            assert!(gap < 4.0 * sigma, "{spec}: {gap} {sigma}");
            assert_eq!(fusion.counts().visual_refused, 0, "{spec}");
        }
    }
}

#[test]
fn twenty_seconds_of_darkness_are_carried_and_the_map_goes_on() {
    let source = open("synth:seed=3,frames=176,width=256,height=192").unwrap();
    let covered = 60..160;
    let frames = (0..source.len()).map(|k| match covered.contains(&k) {
        true => dark(source.as_ref(), k),
        false => source.frame(k).unwrap(),
    });
    let run = run(source.as_ref(), true, frames);
    assert!(run.reports[covered.clone()].iter().all(|r| r.carried));
    assert!(run.reports[covered.end + 1..].iter().all(|r| r.tracked));
    assert_eq!(run.result.joined, 1);
    assert!(run.result.submaps.iter().all(|s| *s == 0));
    // Carried frames, too, are where they are.
    for k in [80, 110, 159, 170] {
        let (gap, way) = (
            off(&run, source.as_ref(), [59, 59], [k, k]),
            way(source.as_ref(), 59, k),
        );
        println!("{k}: {gap} m of {way}");
        assert!(gap < 0.02 * way, "{k}: {gap} m of {way}");
    }
    // The deviations that the key frames state are as large as that.
    let gap = off(&run, source.as_ref(), [59, 59], [170, 170]);
    let covariances = run.result.covariances.as_ref().unwrap();
    let variance = covariances.last().unwrap().fixed_view::<3, 3>(0, 0).trace();
    println!("stated: {} m", variance.sqrt());
    assert!(
        variance.sqrt() > gap / 4.0 && variance.sqrt() < 0.5,
        "{variance}"
    );
}

#[test]
fn twenty_seconds_of_dropped_frames_are_bridged() {
    let source = open("synth:seed=8,frames=176,width=256,height=192").unwrap();
    let kept: Vec<usize> = (0..60).chain(160..source.len()).collect();
    let frames = kept.iter().map(|k| source.frame(*k).unwrap());
    let fused = run(source.as_ref(), true, frames);
    assert_eq!(fused.result.joined, 1);
    assert!(fused.reports[67..].iter().all(|r| r.tracked));
    let (gap, way) = (
        off(&fused, source.as_ref(), [59, 59], [70, 170]),
        way(source.as_ref(), 59, 170),
    );
    println!("{gap} m of {way}");
    assert!(gap < 0.02 * way, "{gap} m of {way}");
}

#[test]
fn a_clear_drive_is_no_worse_with_sensors() {
    let source = open("synth:seed=4,frames=50,width=256,height=192").unwrap();
    let images: Vec<StereoFrame> = (0..50).map(|k| source.frame(k).unwrap()).collect();
    let ate = |fused: bool| {
        let run = run(source.as_ref(), fused, images.iter().cloned());
        assert!(run.reports.iter().all(|r| r.tracked && !r.carried));
        assert_eq!(run.counts.is_some(), fused);
        if let Some(counts) = run.counts {
            assert_eq!((counts.visual, counts.visual_refused), (49, 0));
            assert!(counts.wheels_refused * 20 < counts.wheels, "{counts:?}");
        }
        let truth = source.true_trajectory().unwrap();
        let score = score(&run.result.trajectory, truth, DEFAULT_TOLERANCE).unwrap();
        score.ate_rmse
    };
    let (with, without) = (ate(true), ate(false));
    println!("{with} {without}");
    assert!(with < 1.2 * without + 0.002, "{with} {without}");
}

#[test]
fn a_camera_that_shows_an_old_picture_is_not_believed() {
    // A frozen image fits the map perfectly, where the rover was.
    let source = open("synth:seed=5,frames=46,width=256,height=192").unwrap();
    let frames = (0..source.len()).map(|k| {
        let frame = source
            .frame(if (36..41).contains(&k) { 35 } else { k })
            .unwrap();
        StereoFrame {
            time: k as f64 * 0.2,
            index: k,
            ..frame
        }
    });
    let run = run(source.as_ref(), true, frames);
    let counts = run.counts.unwrap();
    assert!(counts.visual_refused >= 4, "{counts:?}");
    assert!(run.reports[41..].iter().all(|r| r.tracked));
    for k in 36..46 {
        let gap = off(&run, source.as_ref(), [30, 30], [k, k]);
        assert!(gap < 0.03, "{k}: {gap} m");
    }
}

#[test]
fn half_a_route_in_blooming_light_stays_within_half_a_percent() {
    let source = open("synth:seed=6,speed=1,frames=120,width=256,height=192").unwrap();
    let frames = (0..source.len()).map(|k| {
        let mut frame = source.frame(k).unwrap();
        // Light that swells until nothing is left of the ground, and ebbs, every four seconds.
        let swell = 0.5 - 0.5 * (k as f32 * std::f32::consts::TAU / 20.0).cos();
        let glow = if k < 60 { 0.0 } else { 30.0 * swell.powi(3) };
        for image in [&mut frame.left, &mut frame.right] {
            let bloomed = |v: f32| (v * (1.0 + glow) + 0.02 * glow).min(1.0);
            image.iter_mut().for_each(|v| *v = bloomed(*v));
        }
        frame
    });
    let run = run(source.as_ref(), true, frames);
    let carried = run.reports.iter().filter(|r| r.carried).count();
    assert!(carried >= 15, "{carried}");
    assert!(run.reports.iter().all(|r| r.tracked || r.carried));
    assert!(run.result.submaps.iter().all(|s| *s == 0));
    let truth = source.true_trajectory().unwrap();
    let score = score(&run.result.trajectory, truth, DEFAULT_TOLERANCE).unwrap();
    println!("{carried} carried, {} joined, {score:?}", run.result.joined);
    assert!(score.ate_rmse <= 0.005 * score.length, "{score:?}");
}
