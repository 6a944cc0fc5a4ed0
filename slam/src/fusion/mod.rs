//! Motion from everything but the map: gyro, accelerometer and wheels, corrected by what images show.
//!
//! [`Fusion`] runs an error-state Kalman filter (`filter`) along the streams of a rover's sensors. It
//! says how the camera moved since a frame that was placed by images, and how well that is known; each
//! frame that images place corrects it. So it knows its biases, the scale of its wheels and where
//! ahead is when the images bloom or go dark. [`MotionPrior`] holds it against the poses of the map.
//!
//! The wheels' yaw rate is not used: a gyro is better at it, and wheels that skid turn otherwise than
//! they say. Satellite fixes are not used either: they are what routes are judged by.
//!
//! [`DeadReckoning`] is the motion model of Bai 2019, for comparison.

mod dead_reckoning;
mod filter;
mod prior;
#[cfg(test)]
mod simulation;
#[cfg(test)]
mod tests;

use barchan_datasets::{ImuSample, OdometrySample, Sensors};
use barchan_geometry::Se3;
use barchan_geometry::se3::skew;
use nalgebra::{Matrix6, Vector3};
use serde::{Deserialize, Serialize};

pub use dead_reckoning::{DeadReckoning, ReckoningForm, VibrationGyro};
use filter::Filter;
pub(crate) use prior::MotionPrior;

/// What the filter assumes of the sensors, and whom it believes. Deviations are along each axis; those
/// of white noise are densities (per root hertz), so that they hold for every rate of readings.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FusionConfig {
    /// Whether sensors are used at all.
    pub enabled: bool,
    /// Length of gravity, m/s^2.
    pub gravity: f64,
    /// White noise of the gyro, rad/s/sqrt(Hz). The defaults are twice those of a good MEMS unit.
    pub rate_noise: f64,
    /// White noise of the accelerometer, m/s^2/sqrt(Hz).
    pub force_noise: f64,
    /// How the bias of the gyro wanders, rad/s^2/sqrt(Hz).
    pub rate_bias_walk: f64,
    /// How the bias of the accelerometer wanders, m/s^3/sqrt(Hz).
    pub force_bias_walk: f64,
    /// Deviation of the gyro's bias at the start, rad/s.
    pub rate_bias_sigma: f64,
    /// Deviation of the accelerometer's bias at the start, m/s^2.
    pub force_bias_sigma: f64,
    /// Deviation of roll and pitch at the start, radians.
    pub tilt_sigma: f64,
    /// Deviation of the velocity at the start, m/s.
    pub velocity_sigma: f64,
    /// Deviation of each part of the wheels' velocity per speed at the start: ahead may be anywhere.
    pub wheels_sigma: f64,
    /// How that wanders, 1/sqrt(s): wheels slip, now more, now less.
    pub wheels_walk: f64,
    /// Deviation of the way from the IMU to the wheels' middle, metres.
    pub lever_sigma: f64,
    /// Deviation of the velocity that a reading of the wheels gives, m/s, at rest.
    pub wheels_noise: f64,
    /// The same as a share of the speed, to be added: slip, and wheels that climb.
    pub wheels_noise_share: f64,
    /// Wheels slower than that stand, m/s.
    pub standing_speed: f64,
    /// A gyro that stands reads within that of its mean and of zero, rad/s.
    pub standing_rate: f64,
    /// An accelerometer that stands reads within that of its mean, m/s^2.
    pub standing_force: f64,
    /// Deviation of the velocity when standing, m/s.
    pub standing_noise: f64,
    /// Acceleration and angular rate of a rover that nothing is read of: m/s^2, rad/s.
    pub unseen_force: f64,
    /// See [`FusionConfig::unseen_force`].
    pub unseen_rate: f64,
    /// Least deviation of a visual motion, metres and radians, and what is added as a share of it:
    /// sightings of one point err alike, and calibration is not perfect.
    pub visual_noise: [f64; 2],
    /// See [`FusionConfig::visual_noise`].
    pub visual_noise_share: f64,
    /// Visual motions refused in a row after which the filter doubts itself: it is wrong then.
    pub most_refused: usize,
    /// A filter that was wrong more often has false settings or clocks. It refuses no more: images
    /// have the last word.
    pub most_doubts: usize,
    /// A gap in tracking is joined when the deviation of the way over it is at most this share of the
    /// way, or 5 cm, and that of the turn at most [`FusionConfig::join_turn`].
    pub join_share: f64,
    /// Radians.
    pub join_turn: f64,
}

impl Default for FusionConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            gravity: 9.81,
            rate_noise: 2e-4,
            force_noise: 4e-3,
            rate_bias_walk: 1e-5,
            force_bias_walk: 1e-4,
            rate_bias_sigma: 0.01,
            force_bias_sigma: 0.1,
            tilt_sigma: 0.05,
            velocity_sigma: 1.0,
            wheels_sigma: 1.0,
            wheels_walk: 0.001,
            lever_sigma: 1.0,
            wheels_noise: 0.01,
            wheels_noise_share: 0.05,
            standing_speed: 0.005,
            standing_rate: 0.02,
            standing_force: 0.2,
            standing_noise: 0.005,
            unseen_force: 1.0,
            unseen_rate: 0.5,
            visual_noise: [0.001, 0.0005],
            visual_noise_share: 0.005,
            most_refused: 5,
            most_doubts: 3,
            join_share: 0.02,
            join_turn: 0.035,
        }
    }
}

/// The motion from an anchor to now, and how well it is known.
#[derive(Clone, Copy, Debug)]
#[allow(non_snake_case)]
pub struct Motion {
    /// Maps points of the frame now to the frame of the anchor.
    pub T_anchor_now: Se3,
    /// Of the twist `xi` (translation first) of which `exp(xi) T_anchor_now` is true: along the axes
    /// of the anchor.
    pub covariance: Matrix6<f64>,
}

impl Motion {
    /// The same motion of another frame of the same body.
    #[allow(non_snake_case)]
    fn seen_from(&self, T_other_this: &Se3) -> Self {
        let carry = adjoint(T_other_this);
        Self {
            T_anchor_now: T_other_this * self.T_anchor_now * T_other_this.inverse(),
            covariance: carry * self.covariance * carry.transpose(),
        }
    }

    /// Deviations along the worst axes: metres and radians. The translation is that of the point that
    /// moved, not of the anchor's axes turned about it.
    pub fn sigma(&self) -> (f64, f64) {
        let mut about = Matrix6::identity();
        about
            .fixed_view_mut::<3, 3>(0, 3)
            .copy_from(&-skew(&self.T_anchor_now.translation.vector));
        let covariance = about * self.covariance * about.transpose();
        let worst = |k: usize| {
            let block = covariance.fixed_view::<3, 3>(k, k).into_owned();
            block.symmetric_eigenvalues().max().max(0.0).sqrt()
        };
        (worst(0), worst(3))
    }
}

/// How twists (translation first) of one frame look in another: `T exp(xi) T^-1 = exp(Ad xi)`.
#[allow(non_snake_case)]
pub(crate) fn adjoint(T: &Se3) -> Matrix6<f64> {
    let turn = *T.rotation.to_rotation_matrix().matrix();
    let mut carry = Matrix6::zeros();
    for k in [0, 3] {
        carry.fixed_view_mut::<3, 3>(k, k).copy_from(&turn);
    }
    carry
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&(skew(&T.translation.vector) * turn));
    carry
}

/// How often sensors were believed, and how often not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FusionCounts {
    /// Visual motions that corrected the filter.
    pub visual: usize,
    /// Visual motions that contradicted it.
    pub visual_refused: usize,
    /// How often the filter gave in to them.
    pub doubts: usize,
    /// Readings of the wheels that corrected it.
    pub wheels: usize,
    /// Readings of the wheels that contradicted it: slip.
    pub wheels_refused: usize,
    /// Moments of standing still that corrected it.
    pub standing: usize,
    /// Moments that looked like standing still and contradicted it.
    pub standing_refused: usize,
}

/// Readings farther apart than this are a gap, seconds.
const GAP: f64 = 0.25;
/// Gravity is found in so many seconds before and after the start, and standing still judged over twice
/// as many.
const WINDOW: f64 = 0.5;

/// Fuses the streams of a rover as time goes on.
#[allow(non_snake_case)]
pub struct Fusion {
    imu: Vec<ImuSample>,
    odometry: Vec<OdometrySample>,
    T_cam_imu: Se3,
    config: FusionConfig,
    filter: Option<Filter>,
    /// Up to when the filter has come, seconds.
    time: f64,
    /// The first reading of the wheels that was not used yet.
    next_odometry: usize,
    refused_in_a_row: usize,
    counts: FusionCounts,
}

impl Fusion {
    /// `None` without an IMU, or when fusion is not wanted.
    pub fn new(sensors: &Sensors, config: FusionConfig) -> Option<Self> {
        let finite = |s: &&ImuSample| {
            let mut numbers = s.acceleration.iter().chain(s.rate.iter());
            s.time.is_finite() && numbers.all(|v| v.is_finite())
        };
        let mut imu: Vec<ImuSample> = sensors.imu.iter().filter(finite).copied().collect();
        imu.sort_by(|a, b| a.time.total_cmp(&b.time));
        let mut odometry = sensors.odometry.clone();
        odometry.retain(|s| s.time.is_finite() && s.speed.is_finite());
        odometry.sort_by(|a, b| a.time.total_cmp(&b.time));
        (config.enabled && imu.len() > 1).then(|| Self {
            imu,
            odometry,
            T_cam_imu: sensors.T_imu_cam.inverse(),
            config,
            filter: None,
            time: 0.0,
            next_odometry: 0,
            refused_in_a_row: 0,
            counts: FusionCounts::default(),
        })
    }

    /// How often sensors were believed so far.
    pub fn counts(&self) -> FusionCounts {
        self.counts
    }

    /// Runs along the streams up to a time and gives the motion of the camera since the anchor. `None`
    /// for a time that no readings cover, or that lies before the last one.
    pub fn advance(&mut self, time: f64) -> Option<Motion> {
        let covered = self.reading(time).is_some();
        if !covered || (self.filter.is_some() && time < self.time) {
            return None;
        }
        let Some(mut filter) = self.filter.take() else {
            self.start(time);
            return self.motion();
        };
        // A reading of the wheels is the mean over the interval before it: it holds for its middle.
        while let Some(now) = self.odometry.get(self.next_odometry) {
            if now.time > time {
                break;
            }
            let before = (self.next_odometry.checked_sub(1)).map(|k| self.odometry[k].time);
            let took = now.time - before.unwrap_or(now.time);
            let speed = now.speed;
            self.next_odometry += 1;
            let middle = (now.time - 0.5 * took).max(self.time);
            self.integrate(&mut filter, middle);
            self.use_wheels(&mut filter, speed, took);
        }
        self.integrate(&mut filter, time);
        self.filter = Some(filter);
        self.motion()
    }

    /// Corrects by the motion of the camera since the anchor that images show. `false` when it
    /// contradicts the other sensors and is refused. After some in a row it is the filter that errs,
    /// and doubts itself; when that happens too often, it corrects itself as it can and refuses no more.
    pub fn correct(&mut self, seen: &Motion) -> bool {
        let Some(filter) = &mut self.filter else {
            return true;
        };
        let mut motion = seen.seen_from(&self.T_cam_imu.inverse());
        let way = motion.T_anchor_now.translation.vector.norm();
        let [shift, turn] = self.config.visual_noise;
        let more = self.config.visual_noise_share;
        let angle = motion.T_anchor_now.rotation.angle();
        for k in 0..6 {
            let sigma = match k {
                0..3 => shift + more * way,
                _ => turn + more * angle,
            };
            motion.covariance[(k, k)] += sigma * sigma;
        }
        if self.refused_in_a_row >= self.config.most_refused {
            filter.doubt();
            self.counts.doubts += 1;
            self.refused_in_a_row = 0;
        }
        let agrees = filter.see(&motion);
        if agrees {
            self.counts.visual += 1;
            self.refused_in_a_row = 0;
        } else {
            self.counts.visual_refused += 1;
            self.refused_in_a_row += 1;
        }
        agrees || self.counts.doubts > self.config.most_doubts
    }

    /// Motions are counted from now on.
    pub fn anchor(&mut self) {
        if let Some(filter) = &mut self.filter {
            filter.anchor();
        }
    }

    /// The motion of the camera since the anchor.
    fn motion(&self) -> Option<Motion> {
        let filter = self.filter.as_ref()?;
        Some(filter.motion().seen_from(&self.T_cam_imu))
    }

    /// Finds roll and pitch by gravity, as the mean around a time feels it.
    fn start(&mut self, time: f64) {
        let near = mean(self.between(time - WINDOW, time + WINDOW), |s| {
            s.acceleration
        });
        let force = (near.or(self.reading(time).map(|(_, force)| force))).unwrap_or(Vector3::z());
        self.filter = Some(Filter::new(force, self.config));
        self.time = time;
        self.next_odometry = self.odometry.partition_point(|s| s.time <= time);
    }

    /// The readings from one time to another, both included.
    fn between(&self, start: f64, end: f64) -> &[ImuSample] {
        let first = self.imu.partition_point(|s| s.time < start);
        let beyond = self.imu.partition_point(|s| s.time <= end);
        &self.imu[first..beyond.max(first)]
    }

    /// Angular rate and specific force at a time, between the readings around it. `None` where these
    /// are a gap apart.
    fn reading(&self, time: f64) -> Option<(Vector3<f64>, Vector3<f64>)> {
        let after = self.imu.partition_point(|s| s.time < time);
        let near = |s: &&ImuSample| (s.time - time).abs() <= GAP;
        let next = self.imu.get(after).filter(near);
        let last = (after.checked_sub(1))
            .and_then(|k| self.imu.get(k))
            .filter(near);
        match (last, next) {
            (Some(a), Some(b)) => {
                let share = (time - a.time) / (b.time - a.time).max(1e-9);
                Some((
                    a.rate.lerp(&b.rate, share),
                    a.acceleration.lerp(&b.acceleration, share),
                ))
            }
            (Some(s), None) | (None, Some(s)) => Some((s.rate, s.acceleration)),
            (None, None) => None,
        }
    }

    /// Runs the filter up to a time, from reading to reading; each interval has the mean of both its
    /// ends.
    fn integrate(&mut self, filter: &mut Filter, time: f64) {
        let first = self.imu.partition_point(|s| s.time <= self.time);
        let inner = self.imu[first..].iter().map(|s| s.time);
        let ends: Vec<f64> = inner.take_while(|t| *t < time).chain([time]).collect();
        for end in ends {
            let dt = end - self.time;
            if dt <= 0.0 {
                continue;
            }
            match (self.reading(self.time), self.reading(end)) {
                (Some((rate, force)), Some((rate_then, force_then))) if dt <= GAP => {
                    filter.propagate((rate + rate_then) * 0.5, (force + force_then) * 0.5, dt);
                }
                _ => filter.coast(dt),
            }
            self.time = end;
        }
    }

    /// Corrects by a reading of the wheels over the last `took` seconds, and by standing still where
    /// everything says so.
    fn use_wheels(&mut self, filter: &mut Filter, speed: f64, took: f64) {
        let Some((rate, _)) = self.reading(self.time) else {
            return;
        };
        let count = |agrees: bool, of: [&mut usize; 2]| {
            let [used, refused] = of;
            *(if agrees { used } else { refused }) += 1;
        };
        let counts = &mut self.counts;
        count(
            filter.drive(speed, rate),
            [&mut counts.wheels, &mut counts.wheels_refused],
        );
        if let Some(rate) = self.standing(took) {
            let counts = &mut self.counts;
            count(
                filter.stand(rate, took),
                [&mut counts.standing, &mut counts.standing_refused],
            );
        }
    }

    /// The mean of the gyro over `took` seconds, when wheels, gyro and accelerometer say that the rover
    /// has stood still for a while (Skog 2010 compares such tests). Without wheels nothing does: a glide
    /// feels the same.
    ///
    /// A mast that begins to turn is slow at first. So both halves of the while must read the same, and
    /// the mean is that of its beginning.
    fn standing(&self, took: f64) -> Option<Vector3<f64>> {
        let c = &self.config;
        let (start, middle) = (self.time - 2.0 * WINDOW, self.time - WINDOW);
        let first = self.odometry.partition_point(|s| s.time < start);
        let stood = self.odometry.get(first..self.next_odometry)?;
        let still = stood.iter().all(|s| s.speed.abs() < c.standing_speed);
        let window = self.between(start, self.time);
        if stood.is_empty() || !still || took <= 0.0 {
            return None;
        }
        let rate = mean(window, |s| s.rate)?;
        let force = mean(window, |s| s.acceleration)?;
        let quiet = |s: &ImuSample| {
            (s.rate - rate).norm() < c.standing_rate
                && (s.acceleration - force).norm() < c.standing_force
        };
        let begun = mean(self.between(start, middle), |s| s.rate)?;
        let ended = mean(self.between(middle, self.time), |s| s.rate)?;
        // Four deviations of the difference of two means.
        let steady = (ended - begun).amax() < 4.0 * c.rate_noise * (2.0 / WINDOW).sqrt();
        let stands = rate.norm() < c.standing_rate && window.iter().all(quiet) && steady;
        mean(self.between(start, start + took), |s| s.rate).filter(|_| stands)
    }
}

/// The mean of what is read, where anything is.
fn mean(list: &[ImuSample], of: impl Fn(&ImuSample) -> Vector3<f64>) -> Option<Vector3<f64>> {
    let sum: Vector3<f64> = list.iter().map(of).sum();
    (!list.is_empty()).then(|| sum / list.len() as f64)
}
