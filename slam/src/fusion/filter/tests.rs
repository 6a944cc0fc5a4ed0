use super::super::simulation::{DT, Drive, gauss, gauss3, seen};
use super::*;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// What makes `truth` of `estimate`: the inverse of [`State::moved_by`].
fn difference(truth: &State, estimate: &State) -> Errors {
    let mut errors = Errors::zeros();
    let twist = |a: &Se3, b: &Se3| se3::log(&(a * b.inverse()));
    let pose = twist(&truth.T_nav_imu, &estimate.T_nav_imu);
    let phi = pose.fixed_rows::<3>(3).into_owned();
    let turned = UnitQuaternion::from_scaled_axis(phi) * estimate.v_nav;
    let velocity = (se3::left_jacobian(&phi).try_inverse().unwrap()) * (truth.v_nav - turned);
    errors.fixed_rows_mut::<6>(POSE).copy_from(&pose);
    let mut set = |k: usize, v: Vector3<f64>| errors.fixed_rows_mut::<3>(k).copy_from(&v);
    set(VELOCITY, velocity);
    set(RATE_BIAS, truth.rate_bias - estimate.rate_bias);
    set(FORCE_BIAS, truth.force_bias - estimate.force_bias);
    set(WHEELS, truth.wheels - estimate.wheels);
    set(LEVER, truth.lever - estimate.lever);
    let anchor = twist(&truth.T_nav_anchor, &estimate.T_nav_anchor);
    errors.fixed_rows_mut::<6>(ANCHOR).copy_from(&anchor);
    errors
}

fn some_filter() -> Filter {
    let mut filter = Filter::new(Vector3::new(2.0, -1.0, 9.0), FusionConfig::default());
    let s = &mut filter.state;
    s.T_nav_imu = se3::exp(&nalgebra::Vector6::new(3.0, -2.0, 0.5, 0.3, -0.2, 0.9));
    s.T_nav_anchor = se3::exp(&nalgebra::Vector6::new(2.5, -1.0, 0.4, 0.2, -0.3, 0.7));
    s.v_nav = Vector3::new(0.4, -0.1, 0.05);
    s.rate_bias = Vector3::new(0.01, -0.02, 0.005);
    s.force_bias = Vector3::new(0.1, -0.05, 0.08);
    s.wheels = Vector3::new(0.9, 0.1, -0.3);
    s.lever = Vector3::new(0.1, -0.2, -0.8);
    filter
}

#[test]
fn errors_are_added_and_found_again() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let state = some_filter().state;
    let errors = Errors::from_fn(|_, _| 0.3 * gauss(&mut rng));
    let found = difference(&state.moved_by(&errors), &state);
    assert!((found - errors).norm() < 1e-9, "{found} {errors}");
}

#[test]
fn the_transition_matches_finite_differences() {
    let filter = some_filter();
    let (rate, force) = (Vector3::new(0.3, -0.5, 0.8), Vector3::new(1.0, -2.0, 9.5));
    for dt in [0.01, 0.05] {
        let (transition, by_bias) = filter.transition(rate, force, dt);
        let after = |state: &State| {
            let mut after = state.clone();
            after.integrate(rate, force, filter.config.gravity, dt);
            after
        };
        let here = after(&filter.state);
        for k in 0..CORE {
            let step = |e: f64| {
                let mut errors = Errors::zeros();
                errors[k] = e;
                difference(&after(&filter.state.moved_by(&errors)), &here)
            };
            let numeric = (step(1e-6) - step(-1e-6)) / 2e-6;
            let gap = numeric.fixed_rows::<CORE>(0) - transition.column(k);
            // Pose and velocity exactly, biases up to the third order of the interval.
            let least = if k < RATE_BIAS {
                1e-8
            } else {
                3.0 * dt.powi(3)
            };
            assert!(gap.norm() < least, "column {k} at {dt}: {gap}");
        }
        let biases = transition.fixed_view::<9, 6>(0, RATE_BIAS).into_owned();
        assert_eq!(biases, by_bias);
    }
}

#[test]
fn measurement_jacobians_match_finite_differences() {
    let filter = some_filter();
    let rate = Vector3::new(0.3, -0.5, 0.8);
    let seen = se3::exp(&nalgebra::Vector6::new(0.2, 0.1, -0.3, 0.1, 0.2, -0.1))
        * filter.state.T_anchor_imu();
    let at = |errors: &Errors| Filter {
        state: filter.state.moved_by(errors),
        ..filter.clone()
    };
    let (_, wheels) = filter.wheels_against(0.37, rate);
    // The motion itself: a residual of nothing.
    let expected = filter.state.T_anchor_imu();
    let (_, motion) = filter.motion_against(&expected);
    for k in 0..ERRORS {
        let mut step = Errors::zeros();
        step[k] = 1e-6;
        // A residual is read minus expected.
        let numeric = (at(&-step).wheels_against(0.37, rate).0
            - at(&step).wheels_against(0.37, rate).0)
            / 2e-6;
        assert!((numeric - wheels.column(k)).norm() < 1e-8, "wheels {k}");
        let numeric =
            (at(&-step).motion_against(&expected).0 - at(&step).motion_against(&expected).0) / 2e-6;
        assert!((numeric - motion.column(k)).norm() < 1e-7, "motion {k}");
    }
    // And a residual is the twist that leads from what is expected to what was seen.
    let (residual, _) = filter.motion_against(&seen);
    let reached = se3::exp(&residual) * expected;
    assert!(se3::log(&(reached.inverse() * seen)).norm() < 1e-9);
}

/// Noise of visual motions, metres and radians, in simulations.
const SEEN: [f64; 2] = [0.003, 0.001];

/// A filter that starts off the truth as its covariance says, and the truth.
fn started(drive: &Drive, config: FusionConfig, rng: &mut ChaCha8Rng) -> (Filter, State) {
    let (wheels, lever) = drive.wheels_and_lever();
    let mut filter = Filter::new(Vector3::z(), config);
    let truth = truth_at(drive, 0.0, drive.T_nav_imu(0.0), (wheels, lever));
    let sigma = filter.covariance.diagonal().map(f64::sqrt);
    let drawn = sigma.map(|s| s * gauss(rng));
    let mut errors = drawn;
    let pose = drawn.fixed_rows::<6>(POSE).into_owned();
    errors.fixed_rows_mut::<6>(ANCHOR).copy_from(&pose);
    filter.state = truth.moved_by(&errors);
    // Where the IMU is at the start is the origin of its errors.
    (filter, truth)
}

#[allow(non_snake_case)]
fn truth_at(
    drive: &Drive,
    t: f64,
    T_nav_anchor: Se3,
    (wheels, lever): (Vector3<f64>, Vector3<f64>),
) -> State {
    State {
        T_nav_imu: drive.T_nav_imu(t),
        v_nav: drive.v_nav(t),
        rate_bias: drive.rate_bias,
        force_bias: drive.force_bias,
        wheels,
        lever,
        T_nav_anchor,
    }
}

/// Drives the filter along; images are there up to `dark`. Gives the truth at the end, and how often
/// anything was refused.
fn drive_along(
    drive: &Drive,
    filter: &mut Filter,
    truth: &State,
    (dark, end): (f64, f64),
    rng: &mut ChaCha8Rng,
) -> (State, usize) {
    let c = filter.config;
    let known = (truth.wheels, truth.lever);
    let mut anchor = truth.T_nav_anchor;
    let mut refused = 0;
    for k in 0..(end / DT).round() as usize {
        let middle = (k as f64 + 0.5) * DT;
        let (rate, force) = drive.felt(middle);
        let rate_read = rate + drive.rate_bias + gauss3(rng) * (c.rate_noise / DT.sqrt());
        let force_read = force + drive.force_bias + gauss3(rng) * (c.force_noise / DT.sqrt());
        filter.propagate(rate_read, force_read, DT);
        let t = (k + 1) as f64 * DT;
        if (k + 1) % 10 == 0 {
            // The noise of the wheels, along all axes; the speed is what is left along the wheels.
            let (wheels, _) = known;
            let speed = drive.speed(t) / wheels.norm();
            let sigma = c.wheels_noise + c.wheels_noise_share * speed.abs();
            let (rate, _) = drive.felt(t);
            // A velocity aside cannot be told by a speed: add it where the filter looks.
            let off = gauss3(rng) * sigma;
            let rate = rate + drive.rate_bias;
            refused += usize::from(!filter.drive_off(speed, rate, off));
        }
        if (k + 1) % 20 == 0 && t <= dark + 1e-9 {
            let here = drive.T_nav_imu(t);
            let motion = seen(&(anchor.inverse() * here), SEEN, rng);
            refused += usize::from(!filter.see(&motion));
            filter.anchor();
            anchor = here;
        }
    }
    (truth_at(drive, end, anchor, known), refused)
}

impl Filter {
    /// As [`Filter::drive`], of wheels that also move aside and up.
    fn drive_off(&mut self, speed: f64, rate: Vector3<f64>, off: Vector3<f64>) -> bool {
        let (residual, by_error) = self.wheels_against(speed, rate);
        let sigma = self.config.wheels_noise + self.config.wheels_noise_share * speed.abs();
        let noise = Matrix3::identity() * (sigma * sigma);
        self.correct(residual + off, by_error, noise, CHI2_3)
    }
}

/// Without random walks, so that the truth of a simulation is what the filter assumes.
fn steady() -> FusionConfig {
    FusionConfig {
        rate_bias_walk: 0.0,
        force_bias_walk: 0.0,
        wheels_walk: 0.0,
        ..FusionConfig::default()
    }
}

#[test]
fn errors_are_as_large_as_stated_over_many_drives() {
    let config = steady();
    let runs = 40;
    let (mut whole, mut carried, mut refused, mut updates) = (0.0, 0.0, 0, 0);
    for seed in 0..runs {
        let mut rng = ChaCha8Rng::seed_from_u64(100 + seed);
        let drive = Drive::new(seed, &config, 30.0, f64::INFINITY);
        let (mut filter, truth) = started(&drive, config, &mut rng);
        let (truth, count) = drive_along(&drive, &mut filter, &truth, (20.0, 30.0), &mut rng);
        refused += count;
        updates += 300 + 100;
        let errors = difference(&truth, &filter.state);
        let own = errors.fixed_rows::<ANCHOR>(0).into_owned();
        let covariance = filter
            .covariance
            .fixed_view::<ANCHOR, ANCHOR>(0, 0)
            .into_owned();
        let solved = covariance.cholesky().unwrap().solve(&own);
        whole += own.dot(&solved) / runs as f64;
        // The motion over ten seconds in the dark.
        let motion = filter.motion();
        let off = se3::log(&(truth.T_anchor_imu() * motion.T_anchor_now.inverse()));
        let solved = motion.covariance.cholesky().unwrap().solve(&off);
        carried += off.dot(&solved) / runs as f64;
    }
    println!("NEES {whole} of 21, {carried} of 6; {refused} of {updates} refused");
    // The mean over runs of chi-square: four of its deviations to either side.
    let within = |mean: f64, freedom: f64| {
        (mean - freedom).abs() < 4.0 * (2.0 * freedom / runs as f64).sqrt()
    };
    assert!(within(whole, 21.0), "{whole}");
    assert!(within(carried, 6.0), "{carried}");
    // The gates let one true reading in a thousand not pass.
    assert!(refused * 200 < updates, "{refused}");
}

#[test]
fn gravity_gives_roll_and_pitch_and_nothing_gives_yaw_or_position() {
    let config = steady();
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let drive = Drive::new(5, &config, 30.0, f64::INFINITY);
    let (mut filter, truth) = started(&drive, config, &mut rng);
    // Not known by definition now: what is not seen must stay so.
    let (yaw, place) = (0.3, 2.0);
    filter.widen(POSE, Vector3::repeat(place));
    filter.widen(ROTATION, Vector3::z() * yaw);
    filter.anchor();
    let before = filter.covariance;
    let (truth, _) = drive_along(&drive, &mut filter, &truth, (30.0, 30.0), &mut rng);
    let after = filter.covariance;
    for k in [POSE, POSE + 1, POSE + 2, ROTATION + 2] {
        assert!(after[(k, k)] > before[(k, k)] * (1.0 - 1e-6), "{k}");
    }
    for k in [ROTATION, ROTATION + 1] {
        assert!(after[(k, k)] < 0.1 * before[(k, k)], "{k}");
    }
    let up = |s: &State| s.T_nav_imu.rotation.inverse() * Vector3::z();
    let tilt = up(&truth).angle(&up(&filter.state));
    // A bias of the accelerometer of 0.1 m/s^2 alone is 0.01 rad.
    assert!(tilt < 0.006, "{tilt}");
}

#[test]
fn a_start_on_a_slope_is_levelled_by_what_is_felt() {
    for force in [
        Vector3::new(3.0, -2.0, 9.0),
        Vector3::new(0.0, 0.0, -9.81),
        Vector3::new(9.81, 0.0, 0.0),
    ] {
        let filter = Filter::new(force, FusionConfig::default());
        let up = filter.state.T_nav_imu.rotation * force.normalize();
        assert!((up - Vector3::z()).norm() < 1e-9, "{up}");
    }
}

#[test]
fn slipping_wheels_and_false_motions_are_refused() {
    let config = steady();
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let drive = Drive::new(9, &config, 30.0, f64::INFINITY);
    let (mut filter, truth) = started(&drive, config, &mut rng);
    let (truth, _) = drive_along(&drive, &mut filter, &truth, (20.0, 20.0), &mut rng);
    let t = 20.0;
    let (rate, _) = drive.felt(t);
    let rate = rate + drive.rate_bias;
    let speed = drive.speed(t) / truth.wheels.norm();
    let before = filter.clone();
    // Spinning on the spot, and stuck.
    assert!(!filter.drive(speed * 1.6, rate) && !filter.drive(0.0, rate));
    // Not standing either.
    assert!(!filter.stand(rate, 0.1));
    let mut motion = seen(&truth.T_anchor_imu(), SEEN, &mut rng);
    motion.T_anchor_now.translation.vector.x += 0.1;
    assert!(!filter.see(&motion));
    motion.T_anchor_now.translation.vector.x = f64::NAN;
    assert!(!filter.see(&motion) && !filter.drive(f64::NAN, rate));
    assert_eq!(filter.covariance, before.covariance);
    assert_eq!(filter.state.T_nav_imu, before.state.T_nav_imu);
    assert!(filter.drive(speed, rate));
    // A filter that doubts itself believes what it refused.
    motion.T_anchor_now = truth.T_anchor_imu();
    motion.T_anchor_now.translation.vector.x += 0.1;
    filter.doubt();
    assert!(filter.see(&motion));
}
