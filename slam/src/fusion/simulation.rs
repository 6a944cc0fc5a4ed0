//! A drive over hummocks whose pose, velocity and readings are known exactly, for tests.

use barchan_geometry::{Se3, se3};
use nalgebra::{Matrix6, Rotation3, UnitQuaternion, Vector3, Vector6};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::FusionConfig;

/// Seconds between readings of the IMU.
pub(super) const DT: f64 = 0.01;
/// A step for derivatives by time.
const E: f64 = 1e-4;

/// The drive and its instruments.
#[allow(non_snake_case)]
pub(super) struct Drive {
    pub rate_bias: Vector3<f64>,
    pub force_bias: Vector3<f64>,
    pub scale: f64,
    /// Maps the IMU's frame to that of the wheels (x ahead, y left, z up).
    pub T_body_imu: Se3,
    pub gravity: f64,
    /// The rover halts after so many seconds.
    pub halts: f64,
    /// Positions of the wheels' middle every half interval.
    positions: Vec<Vector3<f64>>,
}

impl Drive {
    pub fn new(seed: u64, config: &FusionConfig, duration: f64, halts: f64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut along_axes = |sigma: f64| Vector3::from_fn(|_, _| sigma * gauss(&mut rng));
        let mount = Vector3::new(0.05, 0.35, 0.2) + along_axes(0.1);
        let mut drive = Self {
            rate_bias: along_axes(config.rate_bias_sigma),
            force_bias: along_axes(config.force_bias_sigma),
            scale: 1.0 + along_axes(0.05).x,
            T_body_imu: Se3::from_parts(
                (Vector3::new(0.1, -0.05, 0.8) + along_axes(0.05)).into(),
                UnitQuaternion::from_scaled_axis(mount),
            ),
            gravity: config.gravity,
            halts,
            positions: vec![Vector3::zeros()],
        };
        let half = DT / 2.0;
        for k in 0..(duration / half).ceil() as usize + 8 {
            // Simpson's rule.
            let t = k as f64 * half;
            let [a, b, c] = [0.0, 0.5, 1.0].map(|s| drive.v_body(t + s * half));
            let step = (a + b * 4.0 + c) * (half / 6.0);
            drive.positions.push(drive.positions[k] + step);
        }
        drive
    }

    /// Metres a second; falls to nothing within two seconds before the halt.
    pub fn speed(&self, t: f64) -> f64 {
        let left = ((self.halts - t) / 2.0).clamp(0.0, 1.0);
        (0.4 + 0.1 * (0.5 * t).sin()) * left * left * (3.0 - 2.0 * left)
    }

    fn turn(&self, t: f64) -> UnitQuaternion<f64> {
        // A rover that stands does not rock, and comes to rest gently.
        let rest = 4.0;
        let x = ((t - self.halts + rest) / rest).clamp(0.0, 1.0);
        let t = t.min(self.halts - rest) + rest * (x - x.powi(3) + 0.5 * x.powi(4));
        let yaw = 0.8 * (0.15 * t).sin() + 0.05 * t;
        let (pitch, roll) = (
            0.06 * (0.9 * t).sin() + 0.02 * (2.3 * t).cos(),
            0.05 * (0.7 * t + 1.0).sin(),
        );
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_euler_angles(roll, pitch, yaw))
    }

    fn v_body(&self, t: f64) -> Vector3<f64> {
        self.turn(t) * Vector3::x() * self.speed(t)
    }

    fn v_imu(&self, t: f64) -> Vector3<f64> {
        let lever = self.T_body_imu.translation.vector;
        let swing = (self.turn(t + E) * lever - self.turn(t - E) * lever) / (2.0 * E);
        self.v_body(t) + swing
    }

    /// The pose of the IMU at a multiple of half an interval, in a level frame.
    #[allow(non_snake_case)]
    pub fn T_nav_imu(&self, t: f64) -> Se3 {
        let at = self.positions[(t / (DT / 2.0)).round() as usize];
        Se3::from_parts(at.into(), self.turn(t)) * self.T_body_imu
    }

    pub fn v_nav(&self, t: f64) -> Vector3<f64> {
        self.v_imu(t)
    }

    /// Angular rate and specific force of the IMU without noise and bias.
    pub fn felt(&self, t: f64) -> (Vector3<f64>, Vector3<f64>) {
        let turn = |t: f64| self.turn(t) * self.T_body_imu.rotation;
        let rate = (turn(t - E).inverse() * turn(t + E)).scaled_axis() / (2.0 * E);
        let acceleration = (self.v_imu(t + E) - self.v_imu(t - E)) / (2.0 * E);
        let force = acceleration + Vector3::z() * self.gravity;
        (rate, turn(t).inverse() * force)
    }

    /// The velocity of the wheels per unit of speed that they report, and the way to them, both as
    /// the IMU sees them.
    pub fn wheels_and_lever(&self) -> (Vector3<f64>, Vector3<f64>) {
        let to_imu = self.T_body_imu.inverse();
        (
            to_imu.rotation * Vector3::x() * self.scale,
            to_imu.translation.vector,
        )
    }
}

/// A normal deviate (Box and Muller 1958).
pub(super) fn gauss(rng: &mut ChaCha8Rng) -> f64 {
    let (a, b): (f64, f64) = (1.0 - rng.random::<f64>(), rng.random());
    (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}

pub(super) fn gauss3(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    Vector3::from_fn(|_, _| gauss(rng))
}

/// A motion that images would measure, of this noise (metres, radians) along each axis.
#[allow(non_snake_case)]
pub(super) fn seen(T: &Se3, noise: [f64; 2], rng: &mut ChaCha8Rng) -> super::Motion {
    let sigma = Vector6::from_fn(|k, _| noise[k / 3]);
    let error = sigma.map(|s| s * gauss(rng));
    super::Motion {
        T_anchor_now: se3::exp(&error) * T,
        covariance: Matrix6::from_diagonal(&sigma.map(|s| s * s)),
    }
}
