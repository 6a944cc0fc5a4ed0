//! How sure one is of a rover's motion between two moments: the four ways of Bai 2019 and of those who
//! came before, reduced to what a map with upright cells can use: (x, y, z, yaw).
//!
//! Covariances of poses are of (position in the map frame, rotation vector in the map frame), the
//! fixed-frame convention of ROS.

use barchan_geometry::Se3;
use nalgebra::{Matrix3, Matrix4, Matrix6, Rotation3, SMatrix, SymmetricEigen, Vector3};

/// Yaw of a rotation about the map's z axis, radians: of the x axis laid into the plane, which holds
/// for tilted robots too (the z component of the rotation vector does not).
pub fn yaw(T_map_robot: &Se3) -> f64 {
    let r = T_map_robot.rotation.to_rotation_matrix();
    r[(1, 0)].atan2(r[(0, 0)])
}

/// The covariance of (x, y, z, yaw) from that of a whole pose (spec 5.1; Bai 2019, eq. 35).
///
/// With `theta` the pitch, a rotation `phi` about fixed axes turns the yaw by
/// `phi_z + tan(theta) (cos(psi) phi_x + sin(psi) phi_y)`. Pitch is held within 80 degrees, beyond
/// which yaw means nothing.
pub fn reduced_covariance(pose: &Matrix6<f64>, T_map_robot: &Se3) -> Matrix4<f64> {
    let r = T_map_robot.rotation.to_rotation_matrix();
    let pitch = (-r[(2, 0)]).clamp(-1.0, 1.0).asin();
    let tan = pitch.clamp(-80f64.to_radians(), 80f64.to_radians()).tan();
    let (sin, cos) = yaw(T_map_robot).sin_cos();
    let mut j = SMatrix::<f64, 4, 6>::zeros();
    for i in 0..3 {
        j[(i, i)] = 1.0;
    }
    j[(3, 3)] = cos * tan;
    j[(3, 4)] = sin * tan;
    j[(3, 5)] = 1.0;
    j * pose * j.transpose()
}

/// The covariance of the motion between two poses of reduced covariances `from` and `to` (spec 5.2,
/// after elevation_mapping): in the earlier robot frame without tilt.
///
/// `displacement` is the way between the two, in that frame; `yaw` is the earlier one's. A
/// difference of covariances turns negative where a closed loop made the later pose surer than the
/// earlier one: negative eigenvalues are set to 0.
pub fn relative_covariance(
    from: &Matrix4<f64>,
    to: &Matrix4<f64>,
    displacement: &Vector3<f64>,
    yaw: f64,
) -> Matrix4<f64> {
    positive_part(&covariance_difference(from, to, displacement, yaw))
}

/// [`relative_covariance`] before it is made positive.
fn covariance_difference(
    from: &Matrix4<f64>,
    to: &Matrix4<f64>,
    displacement: &Vector3<f64>,
    yaw: f64,
) -> Matrix4<f64> {
    let f = yaw_transition(displacement, yaw);
    let into_robot = block(&turn(-yaw));
    into_robot * (to - f * from * f.transpose()) * into_robot.transpose()
}

/// `[I, [e_z]x C v; 0, 1]`: how an error of yaw moves what lies `displacement` ahead.
fn yaw_transition(displacement: &Vector3<f64>, yaw: f64) -> Matrix4<f64> {
    let lever = Vector3::z().cross_matrix() * (turn(yaw) * displacement);
    let mut f = Matrix4::identity();
    f.fixed_view_mut::<3, 1>(0, 3).copy_from(&lever);
    f
}

/// The nearest symmetric matrix without negative eigenvalues.
fn positive_part(m: &Matrix4<f64>) -> Matrix4<f64> {
    let eigen = SymmetricEigen::new((m + m.transpose()) * 0.5);
    let clipped = eigen.eigenvalues.map(|v| v.max(0.0));
    eigen.eigenvectors * Matrix4::from_diagonal(&clipped) * eigen.eigenvectors.transpose()
}

fn turn(yaw: f64) -> Matrix3<f64> {
    *Rotation3::from_axis_angle(&Vector3::z_axis(), yaw).matrix()
}

fn block(rotation: &Matrix3<f64>) -> Matrix4<f64> {
    rotation.to_homogeneous()
}

/// What an inertial unit senses, in the robot frame without tilt.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InertialInput {
    /// Acceleration without gravity, metres a second squared.
    pub acceleration: Vector3<f64>,
    /// Rate of yaw, radians a second; `paper` takes it for an angular acceleration, as printed.
    pub yaw_rate: f64,
}

/// Noise of an inertial unit as densities, which hold at any rate of samples: that of one sample of
/// length `dt` is the density over the root of `dt`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InertialNoise {
    /// Metres a second squared over root hertz.
    pub acceleration: f64,
    /// Radians a second over root hertz.
    pub yaw_rate: f64,
}

impl InertialNoise {
    /// Covariance of one sample of (acceleration, yaw rate).
    fn of_sample(&self, dt: f64) -> Matrix4<f64> {
        let [a, w] = [self.acceleration, self.yaw_rate].map(|d| d * d / dt);
        Matrix4::from_diagonal(&[a, a, a, w].into())
    }
}

/// Bai 2019's motion model as printed (eq. 36 to 55), for comparison: it has no velocity, so a rover
/// at constant speed stands still, and from rest it moves three times too far. Its uncertainty is
/// hundreds of times too small over a minute (spec 6.2). `ins` is the one to use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PaperMotion {
    /// Position in the map frame, metres.
    pub position: Vector3<f64>,
    /// Radians.
    pub yaw: f64,
    /// Of (position, yaw).
    pub covariance: Matrix4<f64>,
}

impl PaperMotion {
    /// At rest at the origin, certain.
    pub fn new() -> Self {
        Self {
            position: Vector3::zeros(),
            yaw: 0.0,
            covariance: Matrix4::zeros(),
        }
    }

    /// One sample (eq. 41 to 44, with the scalar yaw entry that is meant), and the covariance of the
    /// motion during it (eq. 49).
    pub fn step(&mut self, u: &InertialInput, noise: &Matrix4<f64>, dt: f64) -> Matrix4<f64> {
        let gain = 1.5 * dt * dt;
        let displacement = u.acceleration * gain;
        let f = yaw_transition(&displacement, self.yaw);
        let g = block(&turn(self.yaw)) * gain;
        self.covariance = f * self.covariance * f.transpose() + g * noise * g.transpose();
        self.position += turn(self.yaw) * displacement;
        self.yaw += u.yaw_rate * gain;
        noise * (gain * gain)
    }
}

impl Default for PaperMotion {
    fn default() -> Self {
        Self::new()
    }
}

/// Dead reckoning with an inertial unit done right (spec 6.3): position, velocity and yaw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InertialMotion {
    /// Position in the map frame, metres.
    pub position: Vector3<f64>,
    /// Velocity in the map frame, metres a second.
    pub velocity: Vector3<f64>,
    /// Radians.
    pub yaw: f64,
    /// Of (position, velocity, yaw).
    pub covariance: SMatrix<f64, 7, 7>,
}

impl InertialMotion {
    /// At rest at the origin, certain.
    pub fn new() -> Self {
        Self {
            position: Vector3::zeros(),
            velocity: Vector3::zeros(),
            yaw: 0.0,
            covariance: SMatrix::zeros(),
        }
    }

    /// One sample of `dt` seconds.
    pub fn step(&mut self, u: &InertialInput, noise: &InertialNoise, dt: f64) {
        let c = turn(self.yaw);
        let a = c * u.acceleration;
        let turned = Vector3::z().cross_matrix() * a;
        let mut f = SMatrix::<f64, 7, 7>::identity();
        f.fixed_view_mut::<3, 3>(0, 3)
            .copy_from(&(Matrix3::identity() * dt));
        f.fixed_view_mut::<3, 1>(0, 6)
            .copy_from(&(turned * (0.5 * dt * dt)));
        f.fixed_view_mut::<3, 1>(3, 6).copy_from(&(turned * dt));
        let mut g = SMatrix::<f64, 7, 4>::zeros();
        g.fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&(c * (0.5 * dt * dt)));
        g.fixed_view_mut::<3, 3>(3, 0).copy_from(&(c * dt));
        g[(6, 3)] = dt;
        let omega = noise.of_sample(dt);
        self.covariance = f * self.covariance * f.transpose() + g * omega * g.transpose();
        self.position += self.velocity * dt + a * (0.5 * dt * dt);
        self.velocity += a * dt;
        self.yaw += u.yaw_rate * dt;
    }

    /// The wheels stand still: velocity is 0 within `deviation` metres a second (a Kalman update).
    /// Without it position drifts with the power 3/2 of time.
    pub fn stands_still(&mut self, deviation: f64) {
        let p = self.covariance;
        let s = p.fixed_view::<3, 3>(3, 3) + Matrix3::identity() * (deviation * deviation);
        let Some(inverse) = s.try_inverse() else {
            return;
        };
        let gain = p.fixed_view::<7, 3>(0, 3) * inverse;
        let correction = -(gain * self.velocity);
        self.position += correction.fixed_rows::<3>(0);
        self.velocity += correction.fixed_rows::<3>(3);
        self.yaw += correction[6];
        self.covariance = p - gain * p.fixed_view::<3, 7>(3, 0);
    }

    /// The covariance of (position, yaw).
    pub fn reduced(&self) -> Matrix4<f64> {
        let p = &self.covariance;
        let at = |i: usize| if i < 3 { i } else { 6 };
        Matrix4::from_fn(|i, j| p[(at(i), at(j))])
    }
}

impl Default for InertialMotion {
    fn default() -> Self {
        Self::new()
    }
}

/// How a motion update knows its covariance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MotionUpdate {
    /// From the covariances of two poses that something else estimated ([`relative_covariance`]).
    Pose {
        /// Of the earlier pose.
        from: Matrix4<f64>,
        /// Of the later pose.
        to: Matrix4<f64>,
    },
    /// From [`InertialMotion`]: its covariance before and after.
    Ins {
        /// At the earlier moment.
        from: Matrix4<f64>,
        /// At the later moment.
        to: Matrix4<f64>,
    },
    /// Bai 2019's: the sum of what [`PaperMotion::step`] gave in between.
    Paper {
        /// In the earlier robot frame without tilt.
        relative: Matrix4<f64>,
    },
    /// An odometry increment's own covariance, its position part scaled by how much the rover shook:
    /// by the square of `1 + rms / reference`.
    VibrationScaled {
        /// In the earlier robot frame without tilt.
        increment: Matrix4<f64>,
        /// Root mean square of the acceleration without gravity, metres a second squared.
        rms: f64,
        /// The shaking that doubles the deviation, metres a second squared.
        reference: f64,
    },
}

impl MotionUpdate {
    /// Covariance of the motion, in the earlier robot frame without tilt; never negative.
    pub fn relative_covariance(&self, T_map_from: &Se3, T_map_to: &Se3) -> Matrix4<f64> {
        let yaw = yaw(T_map_from);
        let way = T_map_to.translation.vector - T_map_from.translation.vector;
        match self {
            Self::Pose { from, to } | Self::Ins { from, to } => {
                relative_covariance(from, to, &(turn(-yaw) * way), yaw)
            }
            Self::Paper { relative } => positive_part(relative),
            Self::VibrationScaled {
                increment,
                rms,
                reference,
            } => {
                let s = 1.0 + (rms / reference).max(0.0);
                let scale = Matrix4::from_diagonal(&[s, s, s, 1.0].into());
                positive_part(&(scale * increment * scale))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn normal(rng: &mut ChaCha8Rng) -> f64 {
        let (u, v): (f64, f64) = (rng.random(), rng.random());
        (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    }

    fn pose(yaw: f64, pitch: f64, roll: f64) -> Se3 {
        Se3::from_parts(
            nalgebra::Translation3::new(1.0, -2.0, 0.5),
            nalgebra::UnitQuaternion::from_euler_angles(roll, pitch, yaw),
        )
    }

    #[test]
    fn yaw_and_its_covariance_hold_for_tilted_robots() {
        let (psi, theta) = (0.7, 0.4);
        let at = pose(psi, theta, -0.3);
        assert!((yaw(&at) - psi).abs() < 1e-12);
        // The row of J for yaw against central differences of rotations about fixed axes.
        let row = |axis: usize| {
            let mut delta = Vector3::zeros();
            delta[axis] = 1e-6;
            let turned = |d: Vector3<f64>| {
                Se3::from_parts(
                    at.translation,
                    nalgebra::UnitQuaternion::from_scaled_axis(d) * at.rotation,
                )
            };
            (yaw(&turned(delta)) - yaw(&turned(-delta))) / 2e-6
        };
        for axis in 0..3 {
            let mut covariance = Matrix6::zeros();
            covariance[(3 + axis, 3 + axis)] = 1.0;
            let reduced = reduced_covariance(&covariance, &at);
            assert!(
                (reduced[(3, 3)] - row(axis).powi(2)).abs() < 1e-8,
                "{axis}: {} {}",
                reduced[(3, 3)],
                row(axis)
            );
        }
        // Straight up and down there is no yaw, and still no infinity.
        let up = pose(0.1, std::f64::consts::FRAC_PI_2, 0.0);
        assert!(reduced_covariance(&Matrix6::identity(), &up)[(3, 3)] < 40.0);
    }

    #[test]
    fn s3_the_paper_moves_three_times_too_far_from_rest() {
        let u = InertialInput {
            acceleration: Vector3::new(0.5, 0.0, 0.0),
            yaw_rate: 0.0,
        };
        let mut paper = PaperMotion::new();
        paper.step(&u, &Matrix4::zeros(), 0.1);
        assert!((paper.position.x - 0.0075).abs() < 1e-12);
        let none = InertialNoise {
            acceleration: 0.0,
            yaw_rate: 0.0,
        };
        let mut ins = InertialMotion::new();
        ins.step(&u, &none, 0.1);
        assert!((ins.position.x - 0.0025).abs() < 1e-12);
        // At constant speed the paper's rover stands still.
        let still = InertialInput {
            acceleration: Vector3::zeros(),
            yaw_rate: 0.0,
        };
        let before = (paper.position, ins.position);
        paper.step(&still, &Matrix4::zeros(), 0.1);
        ins.step(&still, &none, 0.1);
        assert_eq!(paper.position, before.0);
        assert!((ins.position.x - before.1.x - 0.05 * 0.1).abs() < 1e-12);
    }

    /// S3b: 60 s at 100 Hz with 0.05 m/s^2 and 0.05 deg/s a sample, 400 runs: the drift that is
    /// seen, the covariance that is stated and the theory agree; the paper's is 2400 times too small.
    #[test]
    fn s3b_drift_is_what_the_covariance_says() {
        let (dt, steps, runs) = (0.01, 6000, 400);
        let noise = InertialNoise {
            acceleration: 0.05 * 0.1,
            yaw_rate: 0.05f64.to_radians() * 0.1,
        };
        let rest = InertialInput {
            acceleration: Vector3::zeros(),
            yaw_rate: 0.0,
        };
        let mut stated = InertialMotion::new();
        let mut paper = PaperMotion::new();
        for _ in 0..steps {
            stated.step(&rest, &noise, dt);
            paper.step(&rest, &noise.of_sample(dt), dt);
        }
        // The stated covariance around rest does not depend on the samples: run the states alone.
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (mut x2, mut yaw2) = (0.0, 0.0);
        for _ in 0..runs {
            let (mut x, mut v, mut psi) = (0.0, 0.0, 0.0);
            for _ in 0..steps {
                let a = 0.05 * normal(&mut rng);
                x += v * dt + 0.5 * a * dt * dt;
                v += a * dt;
                psi += 0.05f64.to_radians() * normal(&mut rng) * dt;
            }
            x2 += x * x / f64::from(runs);
            yaw2 += psi * psi / f64::from(runs);
        }
        let p = stated.reduced();
        let theory = 0.05 * dt.sqrt() * (60f64.powi(3) / 3.0).sqrt();
        assert!((p[(0, 0)].sqrt() / theory - 1.0).abs() < 0.01);
        assert!(
            (x2.sqrt() / p[(0, 0)].sqrt() - 1.0).abs() < 0.1,
            "{}",
            x2.sqrt()
        );
        assert!((yaw2.sqrt() / p[(3, 3)].sqrt() - 1.0).abs() < 0.1);
        assert!((p[(3, 3)].sqrt().to_degrees() - 0.04).abs() < 0.002);
        let printed = paper.covariance[(0, 0)].sqrt();
        assert!((printed - 0.0006).abs() < 0.0001, "{printed}");
        assert!((2000.0..2800.0).contains(&(theory / printed)));
        // A stop ends the growth.
        stated.stands_still(1e-4);
        assert!(stated.covariance[(3, 3)].sqrt() < 1.1e-4);
        assert!(stated.covariance[(0, 0)] < p[(0, 0)] * 0.5);
    }

    #[test]
    fn s4_relative_motion_is_recovered_and_never_negative() {
        let noise = Matrix4::from_diagonal(&[0.04, 0.09, 0.01, 0.0025].into());
        let mut state = PaperMotion {
            position: Vector3::new(3.0, 1.0, 0.2),
            yaw: 0.8,
            covariance: Matrix4::from_diagonal(&[4e-4, 9e-4, 1e-4, 3e-4].into()),
        };
        let u = InertialInput {
            acceleration: Vector3::new(0.4, -0.1, 0.05),
            yaw_rate: 0.2,
        };
        let dt = 0.1;
        let before = state;
        let omega_scaled = state.step(&u, &noise, dt);
        let displacement = u.acceleration * (1.5 * dt * dt);
        let recovered = covariance_difference(
            &before.covariance,
            &state.covariance,
            &displacement,
            before.yaw,
        );
        assert!((recovered - omega_scaled).abs().max() < 1e-15);

        // A loop was closed: 2 to 3 cm became 1 cm.
        let unsure = Matrix4::from_diagonal(&[4e-4, 9e-4, 4e-4, 1e-4].into());
        let sure = Matrix4::from_diagonal(&[1e-4, 1e-4, 1e-4, 1e-4].into());
        let way = Vector3::new(0.1, 0.0, 0.0);
        let raw = covariance_difference(&unsure, &sure, &way, 0.3);
        assert!(SymmetricEigen::new(raw).eigenvalues.min() < -1e-4);
        let clipped = relative_covariance(&unsure, &sure, &way, 0.3);
        assert!(SymmetricEigen::new(clipped).eigenvalues.min() > -1e-18);
    }

    #[test]
    fn shaking_makes_the_position_less_sure_and_leaves_the_yaw() {
        let increment = Matrix4::from_diagonal(&[1e-4, 1e-4, 1e-4, 1e-6].into());
        let update = |rms| MotionUpdate::VibrationScaled {
            increment,
            rms,
            reference: 2.0,
        };
        let (a, b) = (pose(0.2, 0.0, 0.0), pose(0.3, 0.0, 0.0));
        let still = update(0.0).relative_covariance(&a, &b);
        assert!((still - increment).norm() < 1e-15);
        let shaken = update(2.0).relative_covariance(&a, &b);
        assert!((shaken[(0, 0)] - 4e-4).abs() < 1e-12 && (shaken[(3, 3)] - 1e-6).abs() < 1e-12);
    }
}
