//! The parts of the main job that a rover waits for. Ratios within one run are what counts:
//! `disparity_burn` against `disparity_onnxruntime`, tracking against the camera's period.

use barchan_datasets::{StereoFrame, open};
use barchan_infer::{BurnEngine, DisparityEngine, OnnxEngine, Rejection, Runtime};
use barchan_model::{Device, Preset, StereoNet, onnx};
use barchan_slam::{Slam, SlamConfig};
use barchan_terrain::{Cloud, DepthLimits, VoxelMap};
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
fn slam_track_8_frames(bencher: Bencher) {
    let (frames, rig) = frames(8);
    bencher.bench_local(|| {
        let mut slam = Slam::new(rig, SlamConfig::default(), None);
        frames
            .iter()
            .filter(|f| slam.track(f).is_ok_and(|r| r.tracked))
            .count()
    });
}

#[divan::bench(sample_count = 20)]
fn voxels_of_one_frame(bencher: Bencher) {
    let source = open("synth:seed=5,frames=1,width=484,height=366").expect("a valid specification");
    let frame = source.frame(0).expect("rendering reads no file");
    let truth = source
        .true_disparity(0)
        .ok()
        .flatten()
        .expect("renders have truth");
    let cloud = Cloud::from_disparity(
        source.rig(),
        &frame.left,
        &truth,
        None,
        &DepthLimits::default(),
    )
    .expect("sizes agree");
    bencher.bench_local(|| {
        let mut map = VoxelMap::new(0.02).expect("above zero");
        map.insert(&cloud);
        map.len()
    });
}
