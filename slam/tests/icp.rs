//! Odometry by registration of clouds, over rendered and real sequences.

use std::path::Path;

use barchan_datasets::{StereoFrame, StereoSource, open};
use barchan_eval::trajectory::{DEFAULT_TOLERANCE, TrajectoryScore, score};
use barchan_infer::SemiGlobal;
use barchan_slam::{IcpOdometry, IcpOdometryConfig, IcpReport, IcpResult};

fn run(
    source: &dyn StereoSource,
    config: IcpOdometryConfig,
    frames: impl Iterator<Item = StereoFrame>,
) -> (Vec<IcpReport>, IcpResult) {
    let engine = Box::new(SemiGlobal::new(None));
    let mut odometry = IcpOdometry::new(*source.rig(), config, engine).unwrap();
    let reports: Vec<_> = frames.map(|f| odometry.track(&f).unwrap()).collect();
    for r in &reports {
        println!(
            "{} {} points {} fitness {:.3} rmse {:.4} constraint {:.4} iterations {} {:.0}+{:.0} ms",
            r.name,
            r.reason,
            r.points,
            r.fitness,
            r.rmse,
            r.constraint,
            r.iterations,
            r.ms_disparity,
            r.ms_track
        );
    }
    (reports, odometry.finish())
}

fn frames(source: &dyn StereoSource) -> impl Iterator<Item = StereoFrame> + '_ {
    (0..source.len()).map(|i| source.frame(i).unwrap())
}

fn score_of(result: &IcpResult, source: &dyn StereoSource) -> TrajectoryScore {
    let truth = source.true_trajectory().unwrap();
    let score = score(&result.trajectory, truth, DEFAULT_TOLERANCE).unwrap();
    println!(
        "{} key frames, {} points, {score:?}",
        result.keyframes.len(),
        result.map.points.len()
    );
    score
}

#[test]
fn try_it() {
    for spec in std::env::var("SPEC").unwrap().split(' ') {
        let source = open(spec).unwrap();
        for (kf, grid, dist) in [
            (0.2, 0.05, 0.3),
            (0.2, 0.05, 0.15),
            (0.4, 0.05, 0.3),
            (0.2, 0.05, -0.3),
        ] {
            let mut config = IcpOdometryConfig::default();
            config.grid = grid;
            config.keyframe_distance = kf;
            config.registration.max_distance = f64::abs(dist);
            if dist < 0.0 {
                config.registration.method = barchan_geometry::registration::IcpMethod::Generalised;
            }
            let (_, result) = run(source.as_ref(), config, frames(source.as_ref()));
            println!("{spec} {kf} {grid} {dist}");
            score_of(&result, source.as_ref());
        }
    }
    let _ = Path::new("");
}
