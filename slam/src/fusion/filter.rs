//! The error-state Kalman filter itself: a state, its covariance, and what readings do to both.
//!
//! The form is that of Sola 2017 (Quaternion kinematics for the error-state Kalman filter, ch. 5 to
//! 7): a nominal state is integrated, a small error is estimated and injected. The error of pose and
//! velocity is the right-invariant one of Barrau and Bonnabel 2017, with biases as in Hartley 2020
//! (Contact-aided invariant extended Kalman filtering, sec. 5): `T_nav_imu = exp(xi) T^_nav_imu`, and
//! likewise for the velocity. In it, a turn about gravity and a shift of the origin are fixed
//! directions whatever the estimate, so the filter never believes to have seen its yaw or position,
//! which nothing here measures. The anchor is a copy of an earlier pose (stochastic cloning,
//! Roumeliotis and Burdick 2002): visual motions are measured against it.

use barchan_geometry::Se3;
use barchan_geometry::se3::{self, skew};
use nalgebra::{Matrix3, Matrix6, SMatrix, SVector, UnitQuaternion, Vector3};

use super::{FusionConfig, Motion, adjoint};

/// Where each error stands in the vector of errors. The pose is a twist, translation first.
const POSE: usize = 0;
const ROTATION: usize = 3;
const VELOCITY: usize = 6;
const RATE_BIAS: usize = 9;
const FORCE_BIAS: usize = 12;
/// What moves by itself ends here.
const CORE: usize = 15;
const WHEELS: usize = 15;
const LEVER: usize = 18;
const ANCHOR: usize = 21;
const ERRORS: usize = 27;

type Errors = SVector<f64, ERRORS>;
type Covariance = SMatrix<f64, ERRORS, ERRORS>;
type Core = SMatrix<f64, CORE, CORE>;

/// Squared distances in standard deviations that one true reading in a thousand exceeds: chi-square of
/// three and of six degrees of freedom.
const CHI2_3: f64 = 16.27;
const CHI2_6: f64 = 22.46;

/// Everything that is estimated.
#[derive(Clone, Debug)]
#[allow(non_snake_case)]
pub(super) struct State {
    /// The pose, in a frame whose z points up and whose origin and yaw are those of the start.
    pub T_nav_imu: Se3,
    /// Metres a second.
    pub v_nav: Vector3<f64>,
    /// Of the gyro, rad/s.
    pub rate_bias: Vector3<f64>,
    /// Of the accelerometer, m/s^2.
    pub force_bias: Vector3<f64>,
    /// The velocity of the wheels' middle per unit of speed that they report, in the IMU's frame:
    /// ahead, as long as the odometry's scale.
    pub wheels: Vector3<f64>,
    /// From the IMU to the wheels' middle, in the IMU's frame, metres.
    pub lever: Vector3<f64>,
    /// Where the IMU was at the frame that motions are counted from.
    pub T_nav_anchor: Se3,
}

impl State {
    /// The state that is off by these errors.
    fn moved_by(&self, errors: &Errors) -> Self {
        let part = |k: usize| errors.fixed_rows::<3>(k).into_owned();
        let turn = UnitQuaternion::from_scaled_axis(part(ROTATION));
        let twist = |k: usize| se3::exp(&errors.fixed_rows::<6>(k).into_owned());
        let mut moved = Self {
            T_nav_imu: twist(POSE) * self.T_nav_imu,
            v_nav: turn * self.v_nav + se3::left_jacobian(&part(ROTATION)) * part(VELOCITY),
            rate_bias: self.rate_bias + part(RATE_BIAS),
            force_bias: self.force_bias + part(FORCE_BIAS),
            wheels: self.wheels + part(WHEELS),
            lever: self.lever + part(LEVER),
            T_nav_anchor: twist(ANCHOR) * self.T_nav_anchor,
        };
        moved.T_nav_imu.rotation.renormalize();
        moved.T_nav_anchor.rotation.renormalize();
        moved
    }

    /// The state after `dt` seconds of a constant angular rate and specific force in the IMU's frame
    /// (Sola 2017, sec. 5.4.1, with the attitude of the middle of the interval).
    fn integrate(&mut self, rate: Vector3<f64>, force: Vector3<f64>, gravity: f64, dt: f64) {
        let half = UnitQuaternion::from_scaled_axis((rate - self.rate_bias) * (0.5 * dt));
        let middle = self.T_nav_imu.rotation * half;
        let acceleration = middle * (force - self.force_bias) - Vector3::z() * gravity;
        self.T_nav_imu.translation.vector += self.v_nav * dt + acceleration * (0.5 * dt * dt);
        self.v_nav += acceleration * dt;
        self.T_nav_imu.rotation = middle * half;
        self.T_nav_imu.rotation.renormalize();
    }

    /// The wheels' middle moves as the IMU and the turn about it say, in the IMU's frame.
    fn velocity_of_wheels(&self, rate: Vector3<f64>) -> Vector3<f64> {
        let own = self.T_nav_imu.rotation.inverse() * self.v_nav;
        own + (rate - self.rate_bias).cross(&self.lever)
    }

    /// From the IMU at the anchor to the IMU now.
    #[allow(non_snake_case)]
    fn T_anchor_imu(&self) -> Se3 {
        self.T_nav_anchor.inverse() * self.T_nav_imu
    }
}

/// The filter.
#[derive(Clone, Debug)]
pub(super) struct Filter {
    pub state: State,
    covariance: Covariance,
    config: FusionConfig,
}

impl Filter {
    /// A filter at rest or nearly so, whose accelerometer reads `force` on average: gravity gives
    /// roll and pitch. Position and yaw are zero by definition, and so certain.
    pub fn new(force: Vector3<f64>, config: FusionConfig) -> Self {
        let up = UnitQuaternion::rotation_between(&force, &Vector3::z());
        // Upside down, any axis across will do.
        let up = up.unwrap_or_else(|| {
            UnitQuaternion::from_scaled_axis(Vector3::x() * std::f64::consts::PI)
        });
        let pose = Se3::from_parts(Vector3::zeros().into(), up);
        let state = State {
            T_nav_imu: pose,
            v_nav: Vector3::zeros(),
            rate_bias: Vector3::zeros(),
            force_bias: Vector3::zeros(),
            wheels: Vector3::zeros(),
            lever: Vector3::zeros(),
            T_nav_anchor: pose,
        };
        let mut filter = Self {
            state,
            covariance: Covariance::zeros(),
            config,
        };
        let tilt = Vector3::new(config.tilt_sigma, config.tilt_sigma, 0.0);
        filter.widen_motion(0.0, tilt, config.velocity_sigma);
        filter.widen(RATE_BIAS, Vector3::repeat(config.rate_bias_sigma));
        filter.widen(FORCE_BIAS, Vector3::repeat(config.force_bias_sigma));
        filter.widen(WHEELS, Vector3::repeat(config.wheels_sigma));
        filter.widen(LEVER, Vector3::repeat(config.lever_sigma));
        filter.anchor();
        filter
    }

    /// Adds to the variances of three errors.
    fn widen(&mut self, first: usize, sigma: Vector3<f64>) {
        for k in 0..3 {
            self.covariance[(first + k, first + k)] += sigma[k] * sigma[k];
        }
    }

    /// Adds to the variances of position, attitude and velocity. A turn is one about where the IMU is,
    /// and errors are about the origin.
    fn widen_motion(&mut self, position: f64, turn: Vector3<f64>, velocity: f64) {
        let mut about = SMatrix::<f64, 9, 9>::identity();
        let mut set = |row: usize, v: Vector3<f64>| {
            about
                .fixed_view_mut::<3, 3>(row, ROTATION)
                .copy_from(&skew(&v));
        };
        set(POSE, self.state.T_nav_imu.translation.vector);
        set(VELOCITY, self.state.v_nav);
        let sigma = |k: usize, _| match k / 3 {
            0 => position,
            1 => turn[k - ROTATION],
            _ => velocity,
        };
        let own = SVector::<f64, 9>::from_fn(|k, j| sigma(k, j).powi(2));
        let mut moving = self.covariance.fixed_view_mut::<9, 9>(0, 0);
        moving += about * SMatrix::from_diagonal(&own) * about.transpose();
    }

    /// Moves on by `dt` seconds of these readings.
    pub fn propagate(&mut self, rate: Vector3<f64>, force: Vector3<f64>, dt: f64) {
        let c = self.config;
        let (transition, by_bias) = self.transition(rate, force, dt);
        self.state.integrate(rate, force, c.gravity, dt);

        let top = transition * self.covariance.fixed_view::<CORE, ERRORS>(0, 0);
        self.covariance
            .fixed_view_mut::<CORE, ERRORS>(0, 0)
            .copy_from(&top);
        let left = self.covariance.fixed_view::<ERRORS, CORE>(0, 0) * transition.transpose();
        self.covariance
            .fixed_view_mut::<ERRORS, CORE>(0, 0)
            .copy_from(&left);

        // White noise acts as a bias would that lasted for the interval (densities: per root hertz).
        let white = |k: usize| [c.rate_noise, c.force_noise][k / 3].powi(2) / dt;
        let density = Matrix6::from_diagonal(&SVector::from_fn(|k, _| white(k)));
        let noise = by_bias * density * by_bias.transpose();
        let mut moving = self.covariance.fixed_view_mut::<9, 9>(0, 0);
        moving += noise;
        let walked = |density: f64| Vector3::repeat(density * dt.sqrt());
        self.widen(RATE_BIAS, walked(c.rate_bias_walk));
        self.widen(FORCE_BIAS, walked(c.force_bias_walk));
        self.widen(WHEELS, walked(c.wheels_walk));
    }

    /// How errors pass over one interval, and what a bias over it does to pose and velocity. Exact
    /// in pose and velocity (the map is group affine), of second order in `dt` in the biases.
    fn transition(
        &self,
        rate: Vector3<f64>,
        force: Vector3<f64>,
        dt: f64,
    ) -> (Core, SMatrix<f64, 9, 6>) {
        let c = self.config;
        let mut after = self.state.clone();
        after.integrate(rate, force, c.gravity, dt);
        let half = UnitQuaternion::from_scaled_axis((rate - self.state.rate_bias) * (0.5 * dt));
        let middle = (self.state.T_nav_imu.rotation * half).to_rotation_matrix();
        let middle = middle.matrix();
        let felt = skew(&(middle * (force - self.state.force_bias)));
        let (position, velocity) = (
            skew(&after.T_nav_imu.translation.vector),
            skew(&after.v_nav),
        );

        let mut by_bias = SMatrix::<f64, 9, 6>::zeros();
        let mut set = |row: usize, column: usize, block: Matrix3<f64>| {
            by_bias
                .fixed_view_mut::<3, 3>(row, column)
                .copy_from(&block);
        };
        set(
            POSE,
            0,
            (felt * (0.25 * dt * dt * dt) - position * dt) * middle,
        );
        set(ROTATION, 0, -middle * dt);
        set(
            VELOCITY,
            0,
            (felt * (0.5 * dt * dt) - velocity * dt) * middle,
        );
        set(POSE, 3, -middle * (0.5 * dt * dt));
        set(VELOCITY, 3, -middle * dt);

        let mut transition = Core::identity();
        let gravity = skew(&Vector3::new(0.0, 0.0, -c.gravity));
        let mut set = |row: usize, column: usize, block: Matrix3<f64>| {
            transition
                .fixed_view_mut::<3, 3>(row, column)
                .copy_from(&block);
        };
        set(POSE, ROTATION, gravity * (0.5 * dt * dt));
        set(POSE, VELOCITY, Matrix3::identity() * dt);
        set(VELOCITY, ROTATION, gravity * dt);
        transition
            .fixed_view_mut::<9, 6>(0, RATE_BIAS)
            .copy_from(&by_bias);
        (transition, by_bias)
    }

    /// Takes note that for `dt` seconds nothing was read: a rover turns and speeds up as it likes.
    pub fn coast(&mut self, dt: f64) {
        let c = self.config;
        let up = self.state.T_nav_imu.rotation.inverse() * Vector3::z() * c.gravity;
        self.propagate(self.state.rate_bias, up + self.state.force_bias, dt);
        let (shift, turn) = (0.5 * c.unseen_force * dt * dt, c.unseen_rate * dt);
        self.widen_motion(shift, Vector3::repeat(turn), c.unseen_force * dt);
    }

    /// Corrects by the speed that the wheels report while the IMU turns at `rate`: the wheels' middle
    /// moves ahead and neither aside nor up. `false` when that is refused.
    pub fn drive(&mut self, speed: f64, rate: Vector3<f64>) -> bool {
        let (residual, by_error) = self.wheels_against(speed, rate);
        let sigma = self.config.wheels_noise + self.config.wheels_noise_share * speed.abs();
        let noise = Matrix3::identity() * (sigma * sigma);
        self.correct(residual, by_error, noise, CHI2_3)
    }

    /// Read minus expected, and the derivative of what is expected.
    fn wheels_against(
        &self,
        speed: f64,
        rate: Vector3<f64>,
    ) -> (Vector3<f64>, SMatrix<f64, 3, ERRORS>) {
        let s = &self.state;
        let to_imu = s.T_nav_imu.rotation.inverse().to_rotation_matrix();
        let mut by_error = SMatrix::<f64, 3, ERRORS>::zeros();
        let mut set = |column: usize, block: Matrix3<f64>| {
            by_error.fixed_view_mut::<3, 3>(0, column).copy_from(&block);
        };
        set(VELOCITY, *to_imu.matrix());
        set(RATE_BIAS, skew(&s.lever));
        set(LEVER, skew(&(rate - s.rate_bias)));
        set(WHEELS, Matrix3::identity() * -speed);
        (s.wheels * speed - s.velocity_of_wheels(rate), by_error)
    }

    /// Corrects by standing still (zero-velocity update, Skog 2010): the IMU does not move, and what the gyro
    /// read on average over `seconds` is its bias. `false` when that is refused.
    pub fn stand(&mut self, rate: Vector3<f64>, seconds: f64) -> bool {
        let s = &self.state;
        let to_imu = s.T_nav_imu.rotation.inverse().to_rotation_matrix();
        let mut by_error = SMatrix::<f64, 6, ERRORS>::zeros();
        by_error
            .fixed_view_mut::<3, 3>(0, VELOCITY)
            .copy_from(to_imu.matrix());
        by_error
            .fixed_view_mut::<3, 3>(3, RATE_BIAS)
            .fill_with_identity();
        let v_imu = to_imu * s.v_nav;
        let mut residual = SVector::<f64, 6>::zeros();
        residual.fixed_rows_mut::<3>(0).copy_from(&-v_imu);
        residual
            .fixed_rows_mut::<3>(3)
            .copy_from(&(rate - s.rate_bias));
        let still = self.config.standing_noise;
        let white = self.config.rate_noise / seconds.sqrt();
        let variance = |k: usize, _| [still, white][k / 3].powi(2);
        let noise = Matrix6::from_diagonal(&SVector::from_fn(variance));
        self.correct(residual, by_error, noise, CHI2_6)
    }

    /// Corrects by the motion since the anchor that images show, in the IMU's frames. `false` when
    /// that is refused.
    ///
    /// Near ground that fills the image leaves a turn and a way that look alike undecided, and points that
    /// are matched alike err alike: a motion may be off by several of the deviations that it states. It
    /// then counts for as much less; refused is only what no such error explains.
    pub fn see(&mut self, motion: &Motion) -> bool {
        const MOST_EXCESS: f64 = 25.0;
        let (residual, by_error) = self.motion_against(&motion.T_anchor_now);
        let mut noise = motion.covariance;
        let spread = by_error * self.covariance * by_error.transpose() + noise;
        let information = spread.try_inverse().unwrap_or_default();
        let excess = residual.dot(&(information * residual)) / CHI2_6;
        if excess > 1.0 && excess < MOST_EXCESS {
            noise += spread * (excess * (1.0 + 1e-9) - 1.0);
        }
        self.correct(residual, by_error, noise, CHI2_6)
    }

    /// Measured minus expected motion as a twist in the frame of the anchor, and the derivative of
    /// what is expected.
    #[allow(non_snake_case)]
    fn motion_against(&self, T_anchor_now: &Se3) -> (SVector<f64, 6>, SMatrix<f64, 6, ERRORS>) {
        let by_error = self.motion_by_error();
        let residual = se3::log(&(T_anchor_now * self.state.T_anchor_imu().inverse()));
        (residual, by_error)
    }

    /// `T_anchor_imu` of a state off by errors is `exp(J errors) T_anchor_imu`: both poses err in the
    /// same frame, and only the difference matters.
    fn motion_by_error(&self) -> SMatrix<f64, 6, ERRORS> {
        let carry = adjoint(&self.state.T_nav_anchor.inverse());
        let mut by_error = SMatrix::<f64, 6, ERRORS>::zeros();
        by_error.fixed_view_mut::<6, 6>(0, POSE).copy_from(&carry);
        by_error
            .fixed_view_mut::<6, 6>(0, ANCHOR)
            .copy_from(&-carry);
        by_error
    }

    /// The motion since the anchor, in the IMU's frames.
    pub fn motion(&self) -> Motion {
        let by_error = self.motion_by_error();
        Motion {
            T_anchor_now: self.state.T_anchor_imu(),
            covariance: by_error * self.covariance * by_error.transpose(),
        }
    }

    /// Motions are counted from the present pose.
    pub fn anchor(&mut self) {
        self.state.T_nav_anchor = self.state.T_nav_imu;
        let rows = self.covariance.fixed_rows::<6>(POSE).into_owned();
        self.covariance.fixed_rows_mut::<6>(ANCHOR).copy_from(&rows);
        let columns = self.covariance.fixed_columns::<6>(POSE).into_owned();
        self.covariance
            .fixed_columns_mut::<6>(ANCHOR)
            .copy_from(&columns);
    }

    /// Trusts pose and velocity no more than at the start: what images say will be believed.
    pub fn doubt(&mut self) {
        let c = self.config;
        self.widen_motion(
            c.velocity_sigma,
            Vector3::repeat(c.tilt_sigma),
            c.velocity_sigma,
        );
    }

    /// The Kalman update (Sola 2017, sec. 6.1, in Joseph's form), unless the squared
    /// Mahalanobis distance of the residual is beyond the gate: then nothing changes.
    fn correct<const M: usize>(
        &mut self,
        residual: SVector<f64, M>,
        by_error: SMatrix<f64, M, ERRORS>,
        noise: SMatrix<f64, M, M>,
        gate: f64,
    ) -> bool {
        let across = self.covariance * by_error.transpose();
        let Some(information) = (by_error * across + noise).try_inverse() else {
            return false;
        };
        let distance = residual.dot(&(information * residual));
        if distance.is_nan() || distance > gate {
            return false;
        }
        let gain = across * information;
        self.state = self.state.moved_by(&(gain * residual));
        let left = Covariance::identity() - gain * by_error;
        let covariance =
            left * self.covariance * left.transpose() + gain * noise * gain.transpose();
        self.covariance = (covariance + covariance.transpose()) * 0.5;
        true
    }
}

#[cfg(test)]
mod tests;
