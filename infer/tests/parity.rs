//! ONNX Runtime runs the exported graph as Burn runs the network, at any size.
#![cfg(all(feature = "burn", feature = "onnxruntime"))]

use barchan_datasets::Rgb;
use barchan_infer::{BurnEngine, DisparityEngine, OnnxEngine, Runtime};
use barchan_model::{Device, Preset, StereoNet, onnx};

#[test]
fn burn_and_onnx_runtime_agree_at_five_sizes_on_every_preset() {
    let runtime = match Runtime::load(None) {
        Ok(runtime) => runtime,
        Err(error) => panic!("`make test` installs ONNX Runtime first: {error}"),
    };
    for preset in Preset::ALL {
        agree(&runtime, preset);
    }
}

fn agree(runtime: &Runtime, preset: Preset) {
    let name = preset.name();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("net.onnx");
    let device = Device::flex();
    let net = StereoNet::init(&preset.config(), 2, &device).unwrap();
    onnx::save(&net, &path).unwrap();
    let mut burn = BurnEngine::new(net, device, "random");
    let mut ort = OnnxEngine::load(runtime, &path, 0).unwrap();

    for (width, height) in [(128, 96), (200, 150), (97, 61), (33, 40), (320, 16)] {
        let image = |shift: f32| {
            Rgb::from_fn(width, height, |x, y| {
                let (x, y) = (x as f32 + shift, y as f32);
                let v = 0.5 + 0.2 * (0.7 * x + 0.3 * y).sin() + 0.2 * (0.23 * x - 0.8 * y).sin();
                image::Rgb([v, 0.9 * v, 0.7 * v])
            })
        };
        let (left, right) = (image(0.0), image(6.0));
        let (a, b) = (
            burn.disparity(&left, &right).unwrap(),
            ort.disparity(&left, &right).unwrap(),
        );
        for (what, a, b, median_bound, max_bound) in [
            ("disparity", &a.disparity, &b.disparity, 1e-3, 1e-2),
            ("sigma", &a.sigma, &b.sigma, 1e-2, 5e-2),
            ("confidence", &a.confidence, &b.confidence, 1e-3, 1e-2),
        ] {
            assert_eq!(a.dimensions(), (width, height));
            let mut difference: Vec<f32> =
                a.iter().zip(b.iter()).map(|(a, b)| (a - b).abs()).collect();
            difference.sort_by(f32::total_cmp);
            let (median, maximum) = (
                difference[difference.len() / 2],
                difference[difference.len() - 1],
            );
            println!("{name} {width}x{height} {what}: median {median:.1e}, maximum {maximum:.1e}");
            assert!(
                median <= median_bound && maximum <= max_bound,
                "{name} {width}x{height} {what}: {median} {maximum}"
            );
        }
    }
}
