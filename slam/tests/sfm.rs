//! Structure from motion over whole sequences with truth: rendered ones always, real ones where they are.

use std::path::Path;

use barchan_datasets::{StereoFrame, StereoSource, open};
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, TrajectoryScore, score};
use barchan_slam::sfm::{Border, SfmConfig, SfmReport, SfmResult, StructureFromMotion, TrackKind};

const SMALL: &str = "synth:seed=1,frames=24,width=288,height=216";

fn by(tracks: TrackKind) -> SfmConfig {
    SfmConfig {
        tracks,
        ..SfmConfig::default()
    }
}

fn frames(source: &dyn StereoSource) -> impl Iterator<Item = StereoFrame> + '_ {
    (0..source.len()).map(|i| source.frame(i).unwrap())
}

/// Tracks frames and prints what was discarded.
fn run(
    source: &dyn StereoSource,
    config: SfmConfig,
    frames: impl Iterator<Item = StereoFrame>,
) -> (Vec<SfmReport>, SfmResult) {
    let mut sfm = StructureFromMotion::new(*source.rig(), config);
    let reports: Vec<SfmReport> = frames.map(|f| sfm.track(&f).unwrap()).collect();
    for discarded in reports.iter().filter(|r| !r.tracked) {
        println!("{}: {}", discarded.name, discarded.reason);
    }
    (reports, sfm.finish())
}

fn score_of(result: &SfmResult, source: &dyn StereoSource) -> TrajectoryScore {
    let truth = source.true_trajectory().unwrap();
    let score = score(&result.trajectory, truth, DEFAULT_TOLERANCE).unwrap();
    println!(
        "{} views, {} points, scale {:?}, {score:?}",
        result.views.len(),
        result.points.len(),
        result.scale.as_ref().map(|s| (s.factor, s.used)),
    );
    score
}

/// In one piece, and how well.
fn whole(source: &dyn StereoSource, config: SfmConfig) -> (SfmResult, TrajectoryScore) {
    let (reports, result) = run(source, config, frames(source));
    assert!(reports.iter().all(|r| r.tracked && r.piece == 0));
    assert!(result.tracked.iter().all(|t| *t));
    assert_eq!(result.trajectory.poses.len(), source.len());
    let score = score_of(&result, source);
    (result, score)
}

#[test]
fn a_rendered_traverse_is_of_one_piece_and_metric() {
    let source = open("synth:seed=1,frames=30").unwrap();
    for tracks in [TrackKind::Sift, TrackKind::Klt] {
        let (result, score) = whole(source.as_ref(), by(tracks));
        // A thousandth of the way, and no coarser by the metre.
        assert!(score.ate_rmse_sim3 <= 0.001 * score.length, "{score:?}");
        assert!(score.ate_rmse <= 0.002 * score.length, "{score:?}");
        assert!((score.scale - 1.0).abs() < 0.005, "{score:?}");

        // The trajectory up to scale is the same but for the factor.
        let scale = result.scale.unwrap();
        assert!(scale.used >= scale.baselines.len() / 2);
        let both = result
            .trajectory
            .poses
            .iter()
            .zip(&result.trajectory_up_to_scale.poses);
        for (metric, plain) in both {
            let [m, p] = [metric, plain].map(|s| s.T_world_cam);
            assert!((m.translation.vector - p.translation.vector * scale.factor).norm() < 1e-12);
            assert_eq!(m.rotation, p.rotation);
        }

        // Points lie on the ground that was rendered: half of them within 3 % of the distance.
        let disparity = source.true_disparity(0).unwrap().unwrap();
        let rig = source.rig();
        let mut errors: Vec<f64> = (result.points.iter())
            .filter_map(|point| {
                let seen = rig.project(&point.position)?;
                let (u, v) = (seen.u.round(), seen.v.round());
                let inside = u >= 0.0 && v >= 0.0;
                let truth = disparity
                    .get_pixel_checked(u as u32, v as u32)
                    .filter(|_| inside)?;
                let depth = rig.depth(f64::from(truth.0[0]));
                Some((point.position.z / depth - 1.0).abs()).filter(|e| e.is_finite())
            })
            .collect();
        errors.sort_by(f64::total_cmp);
        println!(
            "{} points, {:?}",
            errors.len(),
            errors.get(errors.len() / 2)
        );
        assert!(errors.len() > 50 && errors[errors.len() / 2] < 0.03);
    }
}

#[test]
fn the_same_images_give_the_same_bits() {
    let source = open("synth:seed=2,frames=8,speed=1,width=256,height=192").unwrap();
    for tracks in [TrackKind::Sift, TrackKind::Klt] {
        let again = || run(source.as_ref(), by(tracks), frames(source.as_ref())).1;
        let (a, b) = (again(), again());
        assert_eq!(a.trajectory, b.trajectory);
        assert_eq!(a.scale, b.scale);
        let places = |r: &SfmResult| r.points.iter().map(|p| p.position).collect::<Vec<_>>();
        assert!(!places(&a).is_empty() && places(&a) == places(&b));
    }
}

#[test]
fn black_images_are_discarded_with_a_reason_and_lie_between_their_neighbours() {
    let source = open(SMALL).unwrap();
    let covered = frames(source.as_ref()).map(|mut f| {
        if (12..14).contains(&f.index) {
            f.left.iter_mut().for_each(|v| *v = 0.0);
        }
        f
    });
    let (reports, result) = run(source.as_ref(), SfmConfig::default(), covered);
    for report in &reports {
        let black = (12..14).contains(&report.frame);
        assert_eq!(!report.tracked, black, "{report:?}");
        assert_eq!(!result.tracked[report.frame], black);
        assert!(!black || report.reason.contains("are wanted"), "{report:?}");
    }
    let score = score_of(&result, source.as_ref());
    assert!(score.ate_rmse <= 0.01 * score.length, "{score:?}");
}

#[test]
fn what_cannot_be_joined_begins_anew_and_says_so() {
    let source = open(SMALL).unwrap();
    // The second half is of another place.
    let other = open(&SMALL.replace("seed=1", "seed=7")).unwrap();
    let images = frames(source.as_ref())
        .take(16)
        .chain((16..24).map(|i| other.frame(i).unwrap()));
    let (reports, result) = run(source.as_ref(), SfmConfig::default(), images);
    let anew = reports.iter().find(|r| r.piece == 1).unwrap();
    assert!((17..23).contains(&anew.frame), "{anew:?}");
    assert!(anew.reason.contains("anew"), "{}", anew.reason);
    assert!(reports[16..anew.frame].iter().all(|r| !r.tracked));
    assert_eq!(result.views.last().unwrap().piece, 1);
    assert!(
        result
            .trajectory
            .poses
            .iter()
            .all(|p| p.T_world_cam.translation.vector.norm() < 5.0)
    );
}

#[test]
fn a_camera_that_stands_makes_no_second_view() {
    let source = open("synth:seed=2,frames=1,width=256,height=192").unwrap();
    let again = |i: usize| StereoFrame {
        index: i,
        time: 0.1 * i as f64,
        ..source.frame(0).unwrap()
    };
    let (reports, result) = run(source.as_ref(), SfmConfig::default(), (0..5).map(again));
    assert!(reports.iter().all(|r| r.tracked));
    assert!(
        reports[1..]
            .iter()
            .all(|r| r.reason.contains("second view"))
    );
    assert_eq!((result.views.len(), result.points.len()), (1, 0));
    assert!(result.scale.is_none());
    assert!(
        result
            .trajectory
            .poses
            .iter()
            .all(|p| p.T_world_cam.translation.vector.norm() == 0.0)
    );
}

#[test]
fn nothing_is_looked_for_outside_of_the_region_of_interest() {
    let source = open(SMALL).unwrap();
    let border = Border {
        left: 20,
        right: 30,
        top: 60,
        bottom: 10,
    };
    for tracks in [TrackKind::Sift, TrackKind::Klt] {
        let config = SfmConfig {
            border,
            ..by(tracks)
        };
        let (_, masked) = run(source.as_ref(), config, frames(source.as_ref()).take(12));
        assert!(masked.points.len() > 30);
        // The first view's camera is the world.
        for point in masked.points.iter().filter(|p| p.views >= 2) {
            let Some(seen) = source.rig().project(&point.position) else {
                continue;
            };
            // Things come nearer: what a later view saw in the region was above and inside of it before.
            assert!(seen.v > 40.0, "{seen:?}");
        }
    }
    // With nothing left there is nothing to see, and no panic.
    let none = Border {
        left: 200,
        right: 200,
        ..Border::default()
    };
    for tracks in [TrackKind::Sift, TrackKind::Klt] {
        let config = SfmConfig {
            border: none,
            ..by(tracks)
        };
        let (reports, result) = run(source.as_ref(), config, frames(source.as_ref()).take(2));
        assert!(
            reports
                .iter()
                .all(|r| !r.tracked && r.reason.contains("0 things"))
        );
        assert_eq!((result.trajectory.poses.len(), result.views.len()), (2, 0));
    }
}

#[test]
fn a_real_rover_in_a_sand_arena() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/arena-run1");
    if !data.is_dir() {
        println!("skipped: {} is not there", data.display());
        return;
    }
    let source = open(&format!("folder:{}", data.display())).unwrap();
    // The example `sfm_seeds` tells how much of this is chance: of 0.046 m, a millimetre.
    let (_, score) = whole(source.as_ref(), SfmConfig::default());
    assert!(score.ate_rmse_sim3 <= 0.1, "{score:?}");
}
