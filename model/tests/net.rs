//! What the network promises before and after training.

use barchan_model::{Device, NetConfig, Preset, StereoNet, Tensor, weights};

fn config() -> NetConfig {
    NetConfig {
        max_disparity: 32,
        ..Preset::Tiny.config()
    }
}

/// A texture seen twice, the second time moved left by `disparity` pixels.
fn pair(width: usize, height: usize, disparity: f32, device: &Device) -> [Tensor<4>; 2] {
    [0.0, disparity].map(|shift| {
        let pixel = |i: usize| {
            let (c, y, x) = (
                i / (width * height),
                (i / width % height) as f32,
                (i % width) as f32 + shift,
            );
            let waves = (0.83 * x + 0.4 * y).sin()
                + (0.37 * x - 0.9 * y).sin()
                + (0.11 * x + 1.3 * y).sin()
                + (0.05 * x).sin();
            0.4 + 0.1 * waves + 0.05 * c as f32
        };
        let data: Vec<f32> = (0..3 * width * height).map(pixel).collect();
        Tensor::<1>::from_floats(data.as_slice(), device).reshape([1, 3, height, width])
    })
}

#[test]
fn any_size_goes_in_and_comes_out() {
    let device = Device::flex();
    let net = StereoNet::init(&config(), 1, &device).unwrap();
    for (width, height) in [(64, 48), (65, 49), (33, 17), (16, 16), (7, 5)] {
        let [left, right] = pair(width, height, 0.0, &device);
        let out = net.forward(left, right);
        for map in [&out.disparity, &out.sigma, &out.confidence] {
            assert_eq!(map.dims(), [1, 1, height, width]);
            assert!(map.to_data().iter::<f32>().all(f32::is_finite));
        }
        let within = |t: &Tensor<4>, low: f32, high: f32| {
            t.to_data().iter::<f32>().all(|v| (low..=high).contains(&v))
        };
        assert!(within(&out.disparity, 0.0, 32.0) && within(&out.confidence, 0.0, 1.001));
        assert!(within(&out.sigma, 0.04, 32.0));
    }
}

#[test]
fn an_untrained_network_matches_blocks() {
    let device = Device::flex();
    let net = StereoNet::init(&config(), 1, &device).unwrap();
    for true_disparity in [8.0, 12.0, 20.0] {
        let [left, right] = pair(160, 96, true_disparity, &device);
        let out = net
            .forward(left, right)
            .disparity
            .narrow(3, 40, 100)
            .narrow(2, 16, 64);
        let mut values: Vec<f32> = out.to_data().iter::<f32>().collect();
        values.sort_by(f32::total_cmp);
        let median = values[values.len() / 2];
        assert!(
            (median - true_disparity).abs() < 2.0,
            "{true_disparity}: {median}"
        );
    }
}

#[test]
fn exposure_and_colour_cast_of_one_camera_change_nothing() {
    let device = Device::flex();
    let net = StereoNet::init(&config(), 1, &device).unwrap();
    let [left, right] = pair(96, 64, 8.0, &device);
    let plain = net.forward(left.clone(), right.clone()).disparity;
    let cast = net.forward(left, right * 0.7 + 0.1).disparity;
    let worst = (plain - cast).abs().max().into_scalar::<f32>();
    assert!(worst < 0.1, "{worst}");
}

#[test]
fn a_batch_is_its_pairs() {
    let device = Device::flex();
    let net = StereoNet::init(&config(), 1, &device).unwrap();
    let [l1, r1] = pair(64, 48, 4.0, &device);
    let [l2, r2] = pair(64, 48, 9.0, &device);
    let both = net
        .forward(
            Tensor::cat(vec![l1, l2.clone()], 0),
            Tensor::cat(vec![r1, r2.clone()], 0),
        )
        .disparity;
    let second = net.forward(l2, r2).disparity;
    let worst = (both.narrow(0, 1, 1) - second)
        .abs()
        .max()
        .into_scalar::<f32>();
    assert!(worst < 1e-3, "{worst}");
}

#[test]
fn weights_come_back_to_the_bit_and_can_search_another_range() {
    let device = Device::flex();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("net.safetensors");
    let net = StereoNet::init(&config(), 3, &device).unwrap();
    weights::save(&net, &path).unwrap();
    let back = weights::load(&path, &device).unwrap();
    assert_eq!(back.config(), net.config());
    assert_eq!(
        weights::to_bytes(&back).unwrap(),
        weights::to_bytes(&net).unwrap()
    );

    let wider = back.with_max_disparity(64).unwrap();
    let [left, right] = pair(160, 48, 44.0, &device);
    let out = wider
        .forward(left, right)
        .disparity
        .narrow(3, 80, 60)
        .narrow(2, 8, 32);
    let mean = out.mean().into_scalar::<f32>();
    assert!((mean - 44.0).abs() < 6.0, "{mean}");
    assert!(wider.with_max_disparity(50).is_err());
}

#[test]
fn the_same_seed_gives_the_same_network() {
    let device = Device::flex();
    let bytes =
        |seed| weights::to_bytes(&StereoNet::init(&config(), seed, &device).unwrap()).unwrap();
    assert_eq!(bytes(5), bytes(5));
    assert_ne!(bytes(5), bytes(6));
}

#[test]
fn damaged_weights_are_refused_by_name() {
    let device = Device::flex();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("bad.safetensors");
    let whole = weights::to_bytes(&StereoNet::init(&config(), 3, &device).unwrap()).unwrap();
    for bytes in [&whole[..whole.len() / 2], &whole[..4], &[]] {
        std::fs::write(&path, bytes).unwrap();
        let message = weights::load(&path, &device).unwrap_err().to_string();
        assert!(
            message.contains("bad.safetensors") && message.contains("cure"),
            "{message}"
        );
    }
}
