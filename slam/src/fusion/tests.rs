use super::simulation::{DT, Drive, gauss, gauss3, seen};
use super::*;
use nalgebra::{UnitQuaternion, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// The streams of a drive, of noise as the filter assumes it, of an IMU that is not the camera.
fn sensors(drive: &Drive, duration: f64, config: &FusionConfig, seed: u64) -> Sensors {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let count = (duration / DT).round() as usize;
    let imu = (1..count).map(|k| {
        let time = k as f64 * DT;
        let (rate, force) = drive.felt(time);
        ImuSample {
            time,
            acceleration: force
                + drive.force_bias
                + gauss3(&mut rng) * (config.force_noise / DT.sqrt()),
            rate: rate + drive.rate_bias + gauss3(&mut rng) * (config.rate_noise / DT.sqrt()),
        }
    });
    let imu = imu.collect();
    let odometry = (1..count / 10).map(|k| {
        let time = k as f64 * 10.0 * DT;
        OdometrySample {
            time,
            speed: drive.speed(time - 5.0 * DT) / drive.scale * (1.0 + 0.01 * gauss(&mut rng)),
            yaw_rate: 0.0,
        }
    });
    Sensors {
        imu,
        T_imu_cam: Se3::from_parts(
            Vector3::new(0.02, 0.06, 0.01).into(),
            UnitQuaternion::from_scaled_axis(Vector3::new(-1.2, 1.2, -1.2)),
        ),
        odometry: odometry.collect(),
        gnss: Vec::new(),
    }
}

#[allow(non_snake_case)]
fn T_nav_cam(drive: &Drive, sensors: &Sensors, time: f64) -> Se3 {
    drive.T_nav_imu(time) * sensors.T_imu_cam
}

/// Runs along with images every fifth of a second up to `dark`.
fn watch(fusion: &mut Fusion, drive: &Drive, sensors: &Sensors, dark: f64) {
    let mut rng = ChaCha8Rng::seed_from_u64(77);
    let mut anchor: Option<Se3> = None;
    for k in 1..=(dark / 0.2).round() as usize {
        let time = k as f64 * 0.2;
        let here = T_nav_cam(drive, sensors, time);
        fusion.advance(time).unwrap();
        if let Some(anchor) = anchor {
            let motion = anchor.inverse() * here;
            assert!(fusion.correct(&seen(&motion, [0.003, 0.001], &mut rng)));
        }
        fusion.anchor();
        anchor = Some(here);
    }
}

#[test]
fn twenty_seconds_in_the_dark_are_carried_within_two_percent() {
    let config = FusionConfig::default();
    for seed in 0..6 {
        let drive = Drive::new(seed, &config, 60.0, f64::INFINITY);
        let sensors = sensors(&drive, 60.0, &config, seed);
        let mut fusion = Fusion::new(&sensors, config).unwrap();
        watch(&mut fusion, &drive, &sensors, 30.0);
        let motion = fusion.advance(50.0).unwrap();
        let truth = T_nav_cam(&drive, &sensors, 30.0).inverse() * T_nav_cam(&drive, &sensors, 50.0);
        let way: f64 = (0..200)
            .map(|k| drive.speed(30.0 + 0.1 * k as f64) * 0.1)
            .sum();
        let off = (truth.translation.vector - motion.T_anchor_now.translation.vector).norm();
        let (sigma, _) = motion.sigma();
        println!(
            "{seed}: off by {off} m of {way}, stated {sigma}; {:?}",
            fusion.counts()
        );
        assert!(off < 0.02 * way && off < 4.0 * sigma, "{seed}: {off}");
        assert_eq!(fusion.counts().visual_refused, 0);
    }
}

#[test]
fn wheels_that_spin_are_refused_and_counted() {
    let config = FusionConfig::default();
    let drive = Drive::new(3, &config, 40.0, f64::INFINITY);
    let mut sensors = sensors(&drive, 40.0, &config, 3);
    let mut slipped = 0;
    for sample in &mut sensors.odometry {
        if (20.0..24.0).contains(&sample.time) {
            sample.speed *= 1.7;
            slipped += 1;
        }
    }
    let mut fusion = Fusion::new(&sensors, config).unwrap();
    watch(&mut fusion, &drive, &sensors, 30.0);
    let counts = fusion.counts();
    println!("{counts:?} of {slipped}");
    assert!(counts.wheels_refused >= slipped * 9 / 10);
    assert!(counts.wheels_refused <= slipped + 3);
    assert_eq!(counts.visual_refused, 0);
}

#[test]
fn standing_still_is_noticed_and_stops_the_drift() {
    let config = FusionConfig::default();
    let drive = Drive::new(4, &config, 90.0, 20.0);
    let sensors = sensors(&drive, 90.0, &config, 4);
    let mut fusion = Fusion::new(&sensors, config).unwrap();
    watch(&mut fusion, &drive, &sensors, 22.0);
    let motion = fusion.advance(82.0).unwrap();
    let counts = fusion.counts();
    assert!(counts.standing > 550, "{counts:?}");
    // A minute in the dark.
    let off = motion.T_anchor_now.translation.vector.norm();
    let turn = motion.T_anchor_now.rotation.angle();
    assert!(off < 0.02 && turn < 0.004, "{off} {turn}");
    let bias = fusion.filter.as_ref().unwrap().state.rate_bias;
    assert!((bias - drive.rate_bias).norm() < 2e-4, "{bias}");
}

#[test]
fn a_filter_that_is_wrong_gives_in_and_in_the_end_keeps_silent() {
    // An IMU whose clock is a second late.
    let config = FusionConfig::default();
    let drive = Drive::new(2, &config, 70.0, f64::INFINITY);
    let mut sensors = sensors(&drive, 60.0, &config, 2);
    sensors.imu.iter_mut().for_each(|s| s.time += 1.0);
    let mut fusion = Fusion::new(&sensors, config).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut anchor: Option<Se3> = None;
    let (mut refused, mut late) = (0, 0);
    for k in 6..300 {
        let time = k as f64 * 0.2;
        let here = T_nav_cam(&drive, &sensors, time);
        fusion.advance(time).unwrap();
        let agrees = anchor.is_none_or(|a| {
            fusion.correct(&seen(&(a.inverse() * here), [0.001, 0.0005], &mut rng))
        });
        refused += usize::from(!agrees);
        late += usize::from(!agrees && k > 200);
        // A refused frame is not counted from.
        if agrees {
            fusion.anchor();
            anchor = Some(here);
        }
    }
    println!("{refused} refused, {late} late: {:?}", fusion.counts());
    assert!(fusion.counts().doubts > config.most_doubts && late == 0);
    assert!(refused > 10 && refused < 100, "{refused}");
}

#[test]
fn an_imu_alone_carries_a_few_seconds() {
    let config = FusionConfig::default();
    let drive = Drive::new(7, &config, 40.0, f64::INFINITY);
    let mut sensors = sensors(&drive, 40.0, &config, 7);
    sensors.odometry.clear();
    let mut fusion = Fusion::new(&sensors, config).unwrap();
    watch(&mut fusion, &drive, &sensors, 30.0);
    let motion = fusion.advance(33.0).unwrap();
    let truth = T_nav_cam(&drive, &sensors, 30.0).inverse() * T_nav_cam(&drive, &sensors, 33.0);
    let off = (truth.translation.vector - motion.T_anchor_now.translation.vector).norm();
    let (sigma, _) = motion.sigma();
    println!("off by {off} m, stated {sigma}");
    assert!(off < 0.1 && off < 4.0 * sigma, "{off} {sigma}");
}

#[test]
fn without_readings_nothing_is_said_and_gaps_cost_certainty() {
    let config = FusionConfig::default();
    assert!(Fusion::new(&Sensors::default(), config).is_none());
    let drive = Drive::new(6, &config, 30.0, f64::INFINITY);
    let whole = sensors(&drive, 30.0, &config, 6);
    let off = FusionConfig {
        enabled: false,
        ..config
    };
    assert!(Fusion::new(&whole, off).is_none());

    let mut holed = whole.clone();
    holed.imu.retain(|s| !(20.0..21.0).contains(&s.time));
    // Readings that are no numbers, and times that run back.
    holed.imu.push(ImuSample {
        time: 5.0,
        acceleration: Vector3::repeat(f64::NAN),
        rate: Vector3::zeros(),
    });
    holed.odometry.swap(10, 11);
    let sigma = |sensors: &Sensors| {
        let mut fusion = Fusion::new(sensors, config).unwrap();
        watch(&mut fusion, &drive, sensors, 19.0);
        let sigma = fusion.advance(22.0).unwrap().sigma().0;
        assert!(fusion.advance(1000.0).is_none() && fusion.advance(10.0).is_none());
        assert!(fusion.advance(22.0).is_some());
        sigma
    };
    let (good, bad) = (sigma(&whole), sigma(&holed));
    assert!(bad > 3.0 * good && bad.is_finite(), "{good} {bad}");
    let mut fusion = Fusion::new(&holed, config).unwrap();
    assert!(fusion.advance(20.5).is_none());
}
