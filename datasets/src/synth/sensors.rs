use barchan_geometry::Se3;
use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};
use rand::{Rng, RngExt};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

use super::rover::Plan;
use super::surface::Surface;
use crate::{GnssFix, ImuSample, OdometrySample, Sensors};

/// Metres a second squared.
pub(super) const GRAVITY: f64 = 9.81;
/// Seconds between IMU samples; odometry comes every tenth, GNSS every hundredth of them.
pub(super) const IMU_INTERVAL: f64 = 0.01;
const ODOMETRY_EVERY: usize = 10;
const GNSS_EVERY: usize = 100;

/// Standard deviations, of a good MEMS unit at 100 Hz: white noise of a sample, and the constant bias
/// of a sequence, along each axis. Metres a second squared and radians a second.
const ACCELERATION: (f64, f64) = (0.02, 0.03);
const RATE: (f64, f64) = (0.001, 0.0005);
/// Odometry: a scale error of the sequence (slip), and noise of a sample as a share of the speed and
/// in radians a second.
const SPEED: (f64, f64) = (0.02, 0.01);
const YAW_RATE: f64 = 0.01;
/// GNSS with corrections: horizontal and vertical, metres.
const FIX: [f64; 3] = [0.02, 0.02, 0.04];

/// From the rectified left camera to the IMU in the middle between the cameras, x ahead, y left, z up.
#[allow(non_snake_case)]
fn T_imu_cam(baseline: f64) -> Se3 {
    let axes = Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    Se3::from_parts(Vector3::new(0.0, baseline / 2.0, 0.0).into(), rotation)
}

/// What an IMU on the camera bar, the wheels and a GNSS antenna on the left camera measure over
/// `duration` seconds. Without noise, readings are exact up to the differences of poses half an
/// interval before and after that they are taken from.
#[allow(non_snake_case)]
pub(super) fn measure(
    plan: &Plan,
    surface: &Surface,
    duration: f64,
    baseline: f64,
    noise_seed: Option<u64>,
) -> Sensors {
    let T_imu_cam = T_imu_cam(baseline);
    let T_cam_imu = T_imu_cam.inverse();
    // Poses at every half interval, one before the start and one beyond the end.
    let count = (duration / IMU_INTERVAL).round() as usize + 1;
    let half = IMU_INTERVAL / 2.0;
    let poses: Vec<Se3> = (0..2 * count + 1)
        .into_par_iter()
        .map(|k| plan.T_world_cam(surface, (k as f64 - 1.0) * half) * T_cam_imu)
        .collect();

    let mut rng = noise_seed.map(ChaCha8Rng::seed_from_u64);
    let mut normal = |sigma: f64| rng.as_mut().map_or(0.0, |rng| sigma * gauss(rng));
    let mut along_axes = |sigma: f64| Vector3::from_fn(|_, _| normal(sigma));
    let (acceleration_bias, rate_bias) = (along_axes(ACCELERATION.1), along_axes(RATE.1));
    let imu = (0..count)
        .map(|k| {
            let [before, here, after] = [poses[2 * k], poses[2 * k + 1], poses[2 * k + 2]];
            let [a, b, c] = [before, here, after].map(|T| T.translation.vector);
            let acceleration = (c - b * 2.0 + a) / (half * half) + Vector3::z() * GRAVITY;
            let turned = before.rotation.inverse() * after.rotation;
            ImuSample {
                time: k as f64 * IMU_INTERVAL,
                acceleration: here.rotation.inverse() * acceleration
                    + acceleration_bias
                    + along_axes(ACCELERATION.0),
                rate: turned.scaled_axis() / IMU_INTERVAL + rate_bias + along_axes(RATE.0),
            }
        })
        .collect();

    let slip = 1.0 + normal(SPEED.0);
    let body = |k: usize| plan.T_world_body(surface, k as f64 * IMU_INTERVAL);
    let odometry = (ODOMETRY_EVERY..count)
        .step_by(ODOMETRY_EVERY)
        .map(|k| {
            let interval = ODOMETRY_EVERY as f64 * IMU_INTERVAL;
            let moved = body(k - ODOMETRY_EVERY).inverse() * body(k);
            let speed = moved.translation.x / interval * slip;
            OdometrySample {
                time: k as f64 * IMU_INTERVAL,
                speed: speed * (1.0 + normal(SPEED.1)),
                yaw_rate: moved.rotation.scaled_axis().z / interval + normal(YAW_RATE),
            }
        })
        .collect();

    let gnss = (0..count)
        .step_by(GNSS_EVERY)
        .map(|k| {
            let antenna = poses[2 * k + 1] * T_imu_cam * Point3::origin();
            GnssFix {
                time: k as f64 * IMU_INTERVAL,
                p_world: antenna.coords + Vector3::from_fn(|axis, _| normal(FIX[axis])),
                sigma: Vector3::from(FIX),
            }
        })
        .collect();
    Sensors {
        imu,
        T_imu_cam,
        odometry,
        gnss,
    }
}

/// A normal deviate (Box and Muller 1958).
fn gauss(rng: &mut impl Rng) -> f64 {
    let (a, b): (f64, f64) = (1.0 - rng.random::<f64>(), rng.random());
    (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}

#[cfg(test)]
#[allow(non_snake_case)]
mod tests {
    use super::*;
    use crate::{StereoSource, Synth};

    fn synth(spec: &str) -> Synth {
        Synth::parse(spec).unwrap()
    }

    #[test]
    fn the_imu_integrates_to_the_poses() {
        for route in ["circle", "loop", "survey,stops=2"] {
            let synth = synth(&format!(
                "seed=3,frames=150,width=32,height=32,sensor_noise=false,route={route}"
            ));
            let truth = &synth.true_trajectory().unwrap().poses;
            let sensors = synth.sensors().unwrap();
            let T_world_imu = |i: usize| truth[i].T_world_cam * sensors.T_imu_cam.inverse();
            // From rest a second after the start, by the midpoint rule, for 10 s.
            let (start, frames) = (5, 50);
            let mut T = T_world_imu(start);
            let at = |k: usize| &sensors.imu[k];
            let first = start * 20;
            // The velocity half a sample on, from truth: poses a frame apart are too coarse.
            let plan_pose = |t: f64| {
                synth.plan.T_world_cam(&synth.site.surface, t) * sensors.T_imu_cam.inverse()
            };
            let time = start as f64 * 0.2;
            let mut velocity = (plan_pose(time + 0.005).translation.vector
                - plan_pose(time - 0.005).translation.vector)
                / 0.01;
            let mut position = T.translation.vector;
            for k in first..first + frames * 20 {
                assert!((at(k).time - k as f64 * IMU_INTERVAL).abs() < 1e-9);
                let force = T.rotation * at(k).acceleration - Vector3::z() * GRAVITY;
                position += velocity * IMU_INTERVAL + force * (IMU_INTERVAL.powi(2) / 2.0);
                let rate = (at(k).rate + at(k + 1).rate) / 2.0;
                T.rotation *= UnitQuaternion::from_scaled_axis(rate * IMU_INTERVAL);
                let next = T.rotation * at(k + 1).acceleration - Vector3::z() * GRAVITY;
                velocity += (force + next) * (IMU_INTERVAL / 2.0);
            }
            let expected = T_world_imu(start + frames);
            let turn = (expected.rotation.inverse() * T.rotation).angle();
            let off = (position - expected.translation.vector).norm();
            println!("{route}: {turn} rad, {off} m after 10 s");
            assert!(turn < 1e-3 && off < 0.03, "{route}: {turn} {off}");
        }
    }

    #[test]
    fn odometry_and_fixes_follow_the_route_within_their_stated_noise() {
        let (exact, noisy) = (
            synth("seed=4,frames=100,width=32,height=32,sensor_noise=false"),
            synth("seed=4,frames=100,width=32,height=32"),
        );
        let truth = exact.true_trajectory().unwrap();
        let sensors = exact.sensors().unwrap();
        let driven: f64 = sensors.odometry.iter().map(|s| s.speed * 0.1).sum();
        let path: f64 = (truth.poses.windows(2))
            .map(|p| {
                let [a, b] = [p[0], p[1]].map(|p| p.T_world_cam.translation.vector);
                (b - a).norm()
            })
            .sum();
        assert!((driven / path - 1.0).abs() < 0.05, "{driven} {path}");
        for fix in &sensors.gnss {
            let pose = truth.at(fix.time).unwrap();
            assert!((pose.translation.vector - fix.p_world).norm() < 1e-9);
        }
        // Noise: as large as stated, and the same again.
        let (site, seed) = (&noisy.site, noisy.options.seed ^ 0x1305);
        let again = measure(&noisy.plan, &site.surface, 99.0 * 0.2, 0.12, Some(seed));
        let noisy = noisy.sensors().unwrap();
        assert_eq!(*noisy, again);
        let power = |of: &dyn Fn(&ImuSample) -> f64| {
            let differences = sensors
                .imu
                .iter()
                .zip(&noisy.imu)
                .map(|(a, b)| of(b) - of(a));
            let list: Vec<f64> = differences.collect();
            let mean = list.iter().sum::<f64>() / list.len() as f64;
            let spread = list.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / list.len() as f64;
            (mean, spread.sqrt())
        };
        let (bias, spread) = power(&|s| s.acceleration.y);
        assert!(bias.abs() < 4.0 * ACCELERATION.1 && (spread / ACCELERATION.0 - 1.0).abs() < 0.1);
        let (bias, spread) = power(&|s| s.rate.z);
        assert!(bias.abs() < 4.0 * RATE.1 && (spread / RATE.0 - 1.0).abs() < 0.1);
        assert_eq!(noisy.imu.len(), 99 * 20 + 1);
    }
}
