use barchan_geometry::Se3;
use nalgebra::Vector3;

/// What a rover measures besides images, each stream in the order of time. A stream that the
/// dataset lacks is empty.
#[derive(Clone, Debug, Default, PartialEq)]
#[allow(non_snake_case)]
pub struct Sensors {
    /// Accelerometer and gyro.
    pub imu: Vec<ImuSample>,
    /// Maps points of the rectified left camera to the frame that `imu` is measured in.
    pub T_imu_cam: Se3,
    /// What the wheels say.
    pub odometry: Vec<OdometrySample>,
    /// Satellite fixes, in the world frame of the true trajectory.
    pub gnss: Vec<GnssFix>,
}

/// One reading of an inertial measurement unit, in its own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuSample {
    /// Seconds.
    pub time: f64,
    /// Specific force, m/s^2: at rest it points up with the length of gravity.
    pub acceleration: Vector3<f64>,
    /// Angular rate, rad/s.
    pub rate: Vector3<f64>,
}

/// Wheel odometry: the motion of the rover's middle since the previous sample, as a speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OdometrySample {
    /// Seconds.
    pub time: f64,
    /// Metres a second, forwards positive.
    pub speed: f64,
    /// Radians a second about the rover's up, to the left positive.
    pub yaw_rate: f64,
}

/// A satellite fix.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GnssFix {
    /// Seconds.
    pub time: f64,
    /// Position of the antenna, metres.
    pub p_world: Vector3<f64>,
    /// Stated standard deviation along each axis, metres.
    pub sigma: Vector3<f64>,
}
