//! Odometry by registration of clouds, over rendered sequences with truth.

use barchan_datasets::{Rgb, StereoFrame, StereoSource, Synth, open};
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, score};
use barchan_infer::SemiGlobal;
use barchan_slam::{IcpOdometry, IcpOdometryConfig, IcpReport, IcpResult};

fn odometry(source: &dyn StereoSource) -> IcpOdometry {
    let engine = Box::new(SemiGlobal::new(Some(64)));
    IcpOdometry::new(*source.rig(), IcpOdometryConfig::default(), engine).unwrap()
}

fn run(
    mut odometry: IcpOdometry,
    frames: impl Iterator<Item = StereoFrame>,
) -> (Vec<IcpReport>, IcpResult) {
    let reports: Vec<_> = frames.map(|f| odometry.track(&f).unwrap()).collect();
    for r in &reports {
        println!(
            "{} {} points {} fitness {:.3} rmse {:.4} constraint {:.4} iterations {}",
            r.name, r.reason, r.points, r.fitness, r.rmse, r.constraint, r.iterations
        );
    }
    (reports, odometry.finish())
}

#[test]
fn a_rendered_traverse_is_followed_and_its_ground_mapped() {
    let source = open("synth:seed=1,frames=20").unwrap();
    let frames = || (0..source.len()).map(|i| source.frame(i).unwrap());
    let (reports, result) = run(odometry(source.as_ref()), frames());
    assert!(reports.iter().all(|r| r.tracked && r.reason.is_empty()));
    // The first has nothing to be brought onto.
    assert!(reports[1..].iter().all(|r| r.fitness > 0.9 && r.rmse > 0.0));
    let truth = source.true_trajectory().unwrap();
    let score = score(&result.trajectory, truth, DEFAULT_TOLERANCE).unwrap();
    println!("{score:?}");
    assert_eq!(score.frames, 20);
    assert!(score.ate_rmse < 0.015 * score.length, "{score:?}");

    // The map lies where the ground is. Its world is the first camera.
    let synth = Synth::parse("seed=1,frames=20").unwrap();
    let first = truth.poses[0].T_world_cam;
    let mut off: Vec<f64> = (result.map.points.iter())
        .map(|p| first * p.position)
        .map(|p| (p.z - synth.ground_height(p.x, p.y)).abs())
        .collect();
    off.sort_unstable_by(f64::total_cmp);
    println!("{} points, {:.4} m off", off.len(), off[off.len() / 2]);
    assert!(off.len() > 10_000 && off[off.len() / 2] < 0.03);

    let (_, again) = run(odometry(source.as_ref()), frames().take(4));
    assert_eq!(again.trajectory.poses[..], result.trajectory.poses[..4]);
}

#[test]
fn what_cannot_be_placed_is_said_and_what_follows_goes_on() {
    let source = open("synth:seed=2,frames=6").unwrap();
    // A blank pair, and one of a camera that stands on its head.
    let frames = (0..6).map(|i| {
        let mut frame = source.frame(i).unwrap();
        if i == 2 {
            let (width, height) = frame.left.dimensions();
            frame.left = Rgb::from_pixel(width, height, image::Rgb([0.5; 3]));
            frame.right = frame.left.clone();
        }
        if i == 4 {
            frame.left = image::imageops::flip_vertical(&frame.left);
            frame.right = image::imageops::flip_vertical(&frame.right);
        }
        frame
    });
    let (reports, result) = run(odometry(source.as_ref()), frames);
    let tracked: Vec<bool> = reports.iter().map(|r| r.tracked).collect();
    assert_eq!(tracked, [true, true, false, true, false, false]);
    assert!(reports.iter().all(|r| r.tracked == r.reason.is_empty()));
    assert!(
        reports[2].reason.contains("6 are needed"),
        "{}",
        reports[2].reason
    );
    // What sees nothing is passed over; what sees something else begins a part of its own.
    assert!(!reports[2].keyframe && reports[4].keyframe && reports[5].keyframe);
    assert_eq!(result.submaps, [0, 0, 1, 2]);
    assert_eq!(result.trajectory.poses.len(), 6);
}

#[test]
fn settings_are_toml_and_senseless_ones_refused() {
    let config = IcpOdometryConfig::default();
    let text = toml::to_string(&config).unwrap();
    assert_eq!(toml::from_str::<IcpOdometryConfig>(&text).unwrap(), config);
    let part: IcpOdometryConfig =
        toml::from_str("grid = 0.1\n[cloud.mount]\ntilt = 0.314\nheight = 1.2").unwrap();
    assert_eq!(part.merge_grid, config.merge_grid);
    assert_eq!(part.cloud.mount.unwrap().height, 1.2);
    assert!(toml::from_str::<IcpOdometryConfig>("gird = 0.1").is_err());
    let source = open("synth:frames=1").unwrap();
    for grid in [0.0, -1.0, f64::NAN] {
        let config = IcpOdometryConfig {
            grid,
            ..config.clone()
        };
        let engine = Box::new(SemiGlobal::new(None));
        assert!(IcpOdometry::new(*source.rig(), config, engine).is_err());
    }
}
