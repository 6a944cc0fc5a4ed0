//! The motion model of Bai 2019 (Uncertainty-based vibration/gyro composite planetary terrain mapping,
//! 2.4): position and yaw from acceleration and one gyro, nothing else; as printed, and corrected.
//!
//! As printed, eq. 36 to 39 count twice and have no velocity: every interval begins at rest, its way is
//! `3/2 a dt^2` where `1/2 a dt^2` would be right, the gyro is integrated twice, and a rover at
//! constant speed never moves. Its uncertainty (eq. 44) comes out about as much too small. The
//! corrected form keeps the velocity, and integrates a rate once. In eq. 42 the derivative of yaw by
//! yaw is a slip of the pen in both: it is one.

use barchan_datasets::ImuSample;
use barchan_geometry::Se3;
use nalgebra::{Matrix3, Matrix4, Rotation3, SMatrix, Vector3};
use serde::{Deserialize, Serialize};

/// Which form of the model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ReckoningForm {
    /// Eq. 36 to 44 as they stand.
    Printed,
    /// With a velocity, and a gyro that reads a rate.
    Corrected,
}

/// Where position, velocity and yaw stand in the covariance.
const VELOCITY: usize = 3;
const YAW: usize = 6;

/// Position and yaw by dead reckoning. The frame is level, z up, and begins at the first pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VibrationGyro {
    form: ReckoningForm,
    /// Metres.
    pub position: Vector3<f64>,
    /// Metres a second; stays zero as printed.
    pub velocity: Vector3<f64>,
    /// Radians, to the left positive.
    pub yaw: f64,
    /// Of position, velocity and yaw.
    pub covariance: SMatrix<f64, 7, 7>,
}

impl VibrationGyro {
    /// At rest at the origin, which is certain.
    pub fn new(form: ReckoningForm) -> Self {
        Self {
            form,
            position: Vector3::zeros(),
            velocity: Vector3::zeros(),
            yaw: 0.0,
            covariance: SMatrix::zeros(),
        }
    }

    /// Moves on by `dt` seconds. `acceleration` is along the axes of the levelled rover and free of
    /// gravity, m/s^2; `turn` about up is what the paper calls angular acceleration, and a gyro's rate,
    /// rad/s. `noise` are the deviations of one reading of each.
    pub fn step(&mut self, acceleration: Vector3<f64>, turn: f64, dt: f64, noise: [f64; 2]) {
        let heading = *Rotation3::from_axis_angle(&Vector3::z_axis(), self.yaw).matrix();
        let a = heading * acceleration;
        let aside = Vector3::z().cross(&a);
        // By how much an acceleration moves the position, and a reading of the gyro the yaw.
        let (way, yaw) = match self.form {
            ReckoningForm::Printed => (1.5 * dt * dt, 1.5 * dt * dt),
            ReckoningForm::Corrected => (0.5 * dt * dt, dt),
        };
        let mut by_state = SMatrix::<f64, 7, 7>::identity();
        let mut by_noise = SMatrix::<f64, 7, 4>::zeros();
        by_state
            .fixed_view_mut::<3, 1>(0, YAW)
            .copy_from(&(aside * way));
        by_noise
            .fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&(heading * way));
        by_noise[(YAW, 3)] = yaw;
        self.position += a * way;
        if self.form == ReckoningForm::Corrected {
            self.position += self.velocity * dt;
            self.velocity += a * dt;
            by_state
                .fixed_view_mut::<3, 3>(0, VELOCITY)
                .copy_from(&(Matrix3::identity() * dt));
            by_state
                .fixed_view_mut::<3, 1>(VELOCITY, YAW)
                .copy_from(&(aside * dt));
            by_noise
                .fixed_view_mut::<3, 3>(VELOCITY, 0)
                .copy_from(&(heading * dt));
        }
        self.yaw += turn * yaw;
        let [s_a, s_w] = noise.map(|s| s * s);
        let omega = Matrix4::from_diagonal(&[s_a, s_a, s_a, s_w].into());
        self.covariance = by_state * self.covariance * by_state.transpose()
            + by_noise * omega * by_noise.transpose();
    }
}

/// Runs the model along the stream of an IMU.
#[derive(Clone, Debug)]
pub struct DeadReckoning {
    imu: Vec<ImuSample>,
    /// Densities of the noise of accelerometer and gyro.
    noise: [f64; 2],
    /// The mean force while at rest.
    rest: Vector3<f64>,
    /// Turns the IMU's axes to level ones at the start.
    level: Rotation3<f64>,
    state: VibrationGyro,
    /// The first reading that was not used yet.
    next: usize,
}

impl DeadReckoning {
    /// From rest at the first reading. The mean force of the first second says what is up and is taken
    /// away: a vibration sensor feels no gravity, and the paper never names it. Tilt later on is not
    /// known and leaks gravity, as it does in the paper. `noise` are densities of accelerometer
    /// (m/s^2/sqrt(Hz)) and gyro (rad/s/sqrt(Hz)).
    ///
    /// `None` without readings.
    pub fn new(imu: &[ImuSample], form: ReckoningForm, noise: [f64; 2]) -> Option<Self> {
        let start = imu.first()?.time;
        let first = &imu[..imu.partition_point(|s| s.time <= start + 1.0).max(1)];
        let sum: Vector3<f64> = first.iter().map(|s| s.acceleration).sum();
        let rest = sum / first.len() as f64;
        Some(Self {
            imu: imu.to_vec(),
            noise,
            rest,
            level: Rotation3::rotation_between(&rest, &Vector3::z()).unwrap_or_default(),
            state: VibrationGyro::new(form),
            next: 0,
        })
    }

    /// The state after all readings up to a time. `None` before the first.
    pub fn advance(&mut self, time: f64) -> Option<&VibrationGyro> {
        while let Some(sample) = self.imu.get(self.next) {
            // Times are written with rounded digits.
            if sample.time > time + 1e-6 {
                break;
            }
            let last = self.next.checked_sub(1).map(|k| self.imu[k].time);
            let dt = sample.time - last.unwrap_or(sample.time);
            if dt > 0.0 {
                let acceleration = self.level * (sample.acceleration - self.rest);
                let turn = (self.level * sample.rate).z;
                let noise = self.noise.map(|s| s / dt.sqrt());
                self.state.step(acceleration, turn, dt, noise);
            }
            self.next += 1;
        }
        (self.next > 0).then_some(&self.state)
    }

    /// The pose of the IMU now: maps its points to the level frame of the start.
    #[allow(non_snake_case)]
    pub fn T_start_imu(&self) -> Se3 {
        let heading = Rotation3::from_axis_angle(&Vector3::z_axis(), self.state.yaw);
        Se3::from_parts(self.state.position.into(), (heading * self.level).into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT: f64 = 0.01;

    fn driven(form: ReckoningForm, steps: usize, of: impl Fn(f64) -> (f64, f64)) -> VibrationGyro {
        let mut state = VibrationGyro::new(form);
        for k in 0..steps {
            let (ahead, turn) = of(k as f64 * DT);
            state.step(Vector3::x() * ahead, turn, DT, [0.05, 0.001]);
        }
        state
    }

    #[test]
    fn the_corrected_form_follows_the_laws_of_motion() {
        // From rest, one second of 0.5 m/s^2, then coasting.
        let pushed = |t: f64| (if t < 1.0 - 1e-9 { 0.5 } else { 0.0 }, 0.0);
        let state = driven(ReckoningForm::Corrected, 300, pushed);
        assert!((state.position.x - (0.25 + 2.0 * 0.5)).abs() < 1e-9);
        let turned = driven(ReckoningForm::Corrected, 100, |_| (0.0, 0.3));
        assert!((turned.yaw - 0.3).abs() < 1e-9);
        // Covariance of a random walk of the velocity (specs: s_a sqrt(dt) sqrt(T^3 / 3)).
        let still = driven(ReckoningForm::Corrected, 6000, |_| (0.0, 0.0));
        let expected = 0.05 * DT.sqrt() * (60.0f64.powi(3) / 3.0).sqrt();
        let sigma = still.covariance[(0, 0)].sqrt();
        assert!((sigma / expected - 1.0).abs() < 0.01, "{sigma} {expected}");
    }

    #[test]
    fn as_printed_constant_speed_stands_and_uncertainty_is_far_too_small() {
        let pushed = |t: f64| (if t < 1.0 - 1e-9 { 0.5 } else { 0.0 }, 0.0);
        let at_one = driven(ReckoningForm::Printed, 100, pushed);
        let later = driven(ReckoningForm::Printed, 300, pushed);
        assert_eq!(at_one.position, later.position);
        // One interval from rest: three times the way.
        let once = |form| driven(form, 1, |_| (0.5, 0.0)).position.x;
        let ratio = once(ReckoningForm::Printed) / once(ReckoningForm::Corrected);
        assert!((ratio - 3.0).abs() < 1e-9);
        let sigma = |form| driven(form, 6000, |_| (0.0, 0.0)).covariance[(0, 0)].sqrt();
        assert!(sigma(ReckoningForm::Corrected) > 1000.0 * sigma(ReckoningForm::Printed));
    }

    #[test]
    fn a_stream_is_levelled_and_free_of_gravity() {
        // An IMU that lies on its side, at rest for a second, then pushed along its own y, which is
        // level, while it turns about its own x, which is up.
        let sample = |k: usize| {
            let moving = k > 100;
            let push = if moving { 0.2 } else { 0.0 };
            ImuSample {
                time: 7.0 + k as f64 * DT,
                acceleration: Vector3::new(9.81, push, 0.0),
                rate: Vector3::x() * if moving { 0.1 } else { 0.0 },
            }
        };
        let imu: Vec<ImuSample> = (0..=200).map(sample).collect();
        assert!(DeadReckoning::new(&[], ReckoningForm::Corrected, [0.0; 2]).is_none());
        let mut drive = DeadReckoning::new(&imu, ReckoningForm::Corrected, [0.01, 0.001]).unwrap();
        assert!(drive.advance(6.9).is_none());
        assert!(drive.advance(7.995).unwrap().position.norm() < 1e-9);
        let end = *drive.advance(9.0).unwrap();
        assert!((end.position.norm() - 0.1).abs() < 1e-3, "{end:?}");
        assert!(end.position.z.abs() < 1e-9 && (end.yaw - 0.1).abs() < 1e-9);
        let up = drive.T_start_imu().rotation * Vector3::x();
        assert!((up - Vector3::z()).norm() < 1e-9, "{up}");
        // Times that run back change nothing.
        assert_eq!(drive.advance(8.0).copied(), Some(end));
    }

    #[test]
    fn the_noise_of_one_step_can_be_read_back_from_covariances() {
        // Eq. 50 and 51 undo eq. 44.
        let mut state = VibrationGyro::new(ReckoningForm::Printed);
        let noise = [0.05, 0.01];
        state.step(Vector3::new(0.2, -0.1, 0.3), 0.4, 0.1, noise);
        let before = state;
        state.step(Vector3::new(0.1, 0.2, -0.3), 0.2, 0.1, noise);
        let heading = Rotation3::from_axis_angle(&Vector3::z_axis(), before.yaw);
        let aside = Vector3::z().cross(&(heading * Vector3::new(0.1, 0.2, -0.3)));
        let mut by_state = SMatrix::<f64, 7, 7>::identity();
        by_state
            .fixed_view_mut::<3, 1>(0, YAW)
            .copy_from(&(aside * 0.015));
        let gained = state.covariance - by_state * before.covariance * by_state.transpose();
        for k in 0..3 {
            let omega: f64 = gained[(k, k)] / 0.015f64.powi(2);
            assert!((omega - 0.0025).abs() < 1e-12, "{omega}");
        }
        let omega: f64 = gained[(YAW, YAW)] / 0.015f64.powi(2);
        assert!((omega - 1e-4).abs() < 1e-12, "{omega}");
    }
}
