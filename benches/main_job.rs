//! The parts of the main job that a rover waits for. Ratios within one run are what counts:
//! `disparity_burn` against `disparity_onnxruntime`, tracking against the camera's period.

use barchan_datasets::{StereoFrame, open};
use barchan_geometry::nalgebra::{Point3, Vector3, Vector6};
use barchan_geometry::{Se3, se3};
use barchan_infer::{BurnEngine, DisparityEngine, OnnxEngine, Outlines, Rejection, Runtime};
use barchan_model::{Device, Preset, StereoNet, onnx};
use barchan_slam::{BundleAdjustment, Observation, PoseEdge, PoseGraph, Slam, SlamConfig};
use barchan_terrain::elevation::{ElevationConfig, ElevationMap, Scan};
use barchan_terrain::{Cloud, DepthLimits, StereoErrors, VoxelMap};
use divan::Bencher;

/// Frames of Hong's rover: 484 x 366 pixels.
fn frames(count: usize) -> (Vec<StereoFrame>, barchan_geometry::RectifiedRig) {
    let source = open(&format!("synth:seed=5,frames={count},width=484,height=366"))
        .expect("a valid specification");
    let frames = (0..count)
        .map(|i| source.frame(i).expect("rendering reads no file"))
        .collect();
    (frames, *source.rig())
}

fn main() {
    divan::main();
}

fn net() -> (StereoNet, Device) {
    let device = Device::flex();
    let net = StereoNet::init(&Preset::Tiny.config(), 1, &device).expect("a preset is valid");
    (net, device)
}

fn onnxruntime() -> OnnxEngine {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = dir.path().join("net.onnx");
    onnx::save(&net().0, &path).expect("a temporary file");
    let runtime = Runtime::load(None).expect("`make bench` installs ONNX Runtime");
    OnnxEngine::load(&runtime, &path, 0).expect("our own file")
}

#[divan::bench(sample_count = 10)]
fn disparity_onnxruntime(bencher: Bencher) {
    let (frames, _) = frames(1);
    let mut engine = onnxruntime();
    bencher.bench_local(|| engine.disparity(&frames[0].left, &frames[0].right));
}

#[divan::bench(sample_count = 10)]
fn disparity_burn(bencher: Bencher) {
    let (frames, _) = frames(1);
    let (net, device) = net();
    let mut engine = BurnEngine::new(net, device, "tiny");
    bencher.bench_local(|| engine.disparity(&frames[0].left, &frames[0].right));
}

#[divan::bench(sample_count = 10)]
fn rejection(bencher: Bencher) {
    let (frames, _) = frames(1);
    let map = onnxruntime()
        .disparity(&frames[0].left, &frames[0].right)
        .expect("our own file");
    bencher
        .with_inputs(|| map.clone())
        .bench_local_values(|mut map| {
            Rejection::default().apply(&frames[0].left, &frames[0].right, &mut map)
        });
}

#[divan::bench(sample_count = 10)]
fn outlines(bencher: Bencher) {
    let (frames, _) = frames(1);
    let map = onnxruntime()
        .disparity(&frames[0].left, &frames[0].right)
        .expect("our own file");
    bencher
        .with_inputs(|| map.clone())
        .bench_local_values(|mut map| {
            Outlines::default().sharpen(&frames[0].left, &frames[0].right, None, &mut map);
            map
        });
}

#[divan::bench(sample_count = 10)]
fn slam_track_8_frames(bencher: Bencher) {
    let (frames, rig) = frames(8);
    bencher.bench_local(|| {
        let mut slam = Slam::new(rig, SlamConfig::default(), None);
        frames
            .iter()
            .filter(|f| slam.track((*f).clone()).is_ok_and(|r| r.tracked))
            .count()
    });
}

/// A rover's drive of two laps: 5000 poses, and 500 of the second lap know where they are by loops.
#[divan::bench(sample_count = 10)]
#[allow(non_snake_case)]
fn pose_graph_5000_poses_5500_edges(bencher: Bencher) {
    let pose = |k: usize| {
        let angle = std::f64::consts::TAU * k as f64 / 2500.0;
        let place = Vector3::new(angle.cos(), angle.sin(), 0.0) * 80.0;
        Se3::new(place, Vector3::z() * angle)
    };
    // Every motion is turned by a little: drift.
    let drift = Se3::rotation(Vector3::new(1e-5, 0.0, 3e-5));
    let edge = |a: usize, b: usize, drift: Se3| PoseEdge {
        a,
        b,
        T_a_b: pose(a).inverse() * pose(b) * drift,
        sigma_translation: 0.005,
        sigma_rotation: 0.0005,
        robust: b > a + 1,
    };
    let successive = (1..5000).map(|k| edge(k - 1, k, drift));
    let loops = (0..501).map(|k| edge(4 * k, 4 * k + 2500, Se3::identity()));
    let mut graph = PoseGraph {
        T_world_cam: vec![pose(0)],
        fixed: (0..5000).map(|k| k == 0).collect(),
        edges: successive.chain(loops).collect(),
    };
    for k in 1..5000 {
        let next = graph.T_world_cam[k - 1] * graph.edges[k - 1].T_a_b;
        graph.T_world_cam.push(next);
    }
    bencher
        .with_inputs(|| graph.clone())
        .bench_local_values(|mut graph| {
            graph.solve(30);
            graph
        });
}

/// The cloud of one frame, 177 thousand pixels of true disparity, in the camera's frame.
fn cloud() -> (
    Cloud,
    barchan_geometry::StampedPose,
    barchan_geometry::RectifiedRig,
) {
    let source = open("synth:seed=5,frames=1,width=484,height=366").expect("a valid specification");
    let frame = source.frame(0).expect("rendering reads no file");
    let truth = source
        .true_disparity(0)
        .ok()
        .flatten()
        .expect("renders have truth");
    let limits = DepthLimits::default();
    let cloud = Cloud::from_disparity(source.rig(), &frame.left, &truth, None, &limits)
        .expect("sizes agree");
    let pose = source.true_trajectory().expect("renders have truth").poses[0];
    (cloud, pose, *source.rig())
}

#[divan::bench(sample_count = 20)]
fn voxels_of_one_frame(bencher: Bencher) {
    let (cloud, _, _) = cloud();
    bencher.bench_local(|| {
        let mut map = VoxelMap::new(0.02).expect("above zero");
        map.insert(&cloud);
        map.len()
    });
}

/// Local bundle adjustment: 20 key frames, two of them fixed, 2000 points, 8000 stereo sightings, ten iterations.
#[divan::bench(sample_count = 20)]
fn bundle_adjustment(bencher: Bencher) {
    let (_, rig) = frames(1);
    // Each point is seen by four key frames in a row.
    let point = |k: usize| {
        let share = |step: usize| (k * step % 1009) as f64 / 1009.0 - 0.5;
        Point3::new(
            4.0 * share(389),
            1.0 + share(613),
            4.0 + 3.0 * share(151) + 0.1 * (k % 17) as f64,
        )
    };
    let poses: Vec<Se3> = (0..20)
        .map(|k| se3::exp(&Vector6::new(0.0, 0.0, -0.1 * f64::from(k), 0.0, 0.0, 0.0)))
        .collect();
    let mut observations = Vec::new();
    for k in 0..2000 {
        for pose in k % 17..k % 17 + 4 {
            let seen = rig
                .project(&(poses[pose] * point(k)))
                .expect("all points lie ahead");
            let noise = ((k * 7919 + pose * 104_729) % 101) as f64 / 101.0 - 0.5;
            let sighting = Observation {
                point: point(k),
                u: seen.u + noise,
                v: seen.v - noise,
                d: Some(seen.d + 0.5 * noise),
                sigma: 1.0,
                sigma_d: 2.0,
            };
            observations.push((pose, k, sighting));
        }
    }
    let problem = BundleAdjustment {
        T_cam_world: poses,
        fixed: (0..20).map(|k| k < 2).collect(),
        points: (0..2000)
            .map(|k| point(k) + Vector3::repeat(0.02))
            .collect(),
        observations,
    };
    bencher
        .with_inputs(|| problem.clone())
        .bench_local_values(|mut problem| problem.solve(&rig, 10));
}

#[divan::bench(sample_count = 20)]
fn elevation_of_one_frame(bencher: Bencher) {
    let (cloud, pose, rig) = cloud();
    let mut map = ElevationMap::new(ElevationConfig::default()).expect("defaults are valid");
    let scan = Scan {
        cloud: &cloud,
        T_map_sensor: pose.T_world_cam,
        pose_covariance: None,
        sensor: StereoErrors::default().sensor(&rig),
        time: pose.time,
    };
    bencher.bench_local(|| map.add_growing(&scan).is_ok());
}
