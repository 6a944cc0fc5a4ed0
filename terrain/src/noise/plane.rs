//! The plane that a cloud of one sensor shows.

use nalgebra::{Matrix3, Point3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{SIGMA_PER_MAD, median};

/// Points p of the sensor frame with `normal . p = distance`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScenePlane {
    /// Of length 1, away from the sensor.
    pub normal: Vector3<f64>,
    /// From the sensor to the plane, metres; positive.
    pub distance: f64,
}

impl ScenePlane {
    /// The plane of a normal, of any length and either sign, that the optical axis meets at a depth; `None` when it
    /// does not, or that depth is not positive.
    pub fn new(normal: Vector3<f64>, axis_distance: f64) -> Option<Self> {
        let normal = normal.try_normalize(1e-12)?;
        let normal = normal * normal.z.signum();
        let distance = axis_distance * normal.z;
        (distance.is_finite() && distance > 1e-6).then_some(Self { normal, distance })
    }

    /// Angle between the normal and the optical axis, radians.
    pub fn tilt(&self) -> f64 {
        self.normal.z.clamp(-1.0, 1.0).acos()
    }

    /// Depth at which the optical axis meets the plane, metres.
    pub fn axis_distance(&self) -> f64 {
        self.distance / self.normal.z
    }

    /// How far beyond the plane a point is, metres.
    pub fn error(&self, p: &Point3<f64>) -> f64 {
        self.normal.dot(&p.coords) - self.distance
    }

    /// How much nearer, in reciprocal metres, the plane is than the point that is seen there: what stereo sensors
    /// and those with structured light err by about equally at all depths.
    pub(super) fn inverse_depth_error(&self, p: &Point3<f64>) -> f64 {
        self.error(p) / (self.distance * p.z)
    }

    /// Robust deviation of [`ScenePlane::inverse_depth_error`].
    pub(super) fn spread(&self, points: &[Point3<f64>]) -> f64 {
        let errors = points.iter().map(|p| self.inverse_depth_error(p).abs());
        // The floor keeps the exact planes of renders.
        SIGMA_PER_MAD * median(errors.collect()).unwrap_or(0.0) + 1e-9
    }
}

/// The plane that most of a cloud lies on: least median of the errors of inverse depth over random triples
/// (Rousseeuw 1984), then least squares over what is near. Inverse depth is linear in the bearing, and disparity's
/// noise in it is the same everywhere. The same points give the same plane. `None` when there is none in front
/// of the sensor.
pub fn fit_plane(points: &[Point3<f64>]) -> Option<ScenePlane> {
    const TRIALS: usize = 300;
    const ROUNDS: usize = 6;
    let sample: Vec<Point3<f64>> = (points.iter().step_by(points.len() / 2000 + 1).copied())
        .filter(|p| p.z > 0.0 && p.coords.iter().all(|c| c.is_finite()))
        .collect();
    if sample.len() < 10 {
        return None;
    }
    let mut rng = ChaCha8Rng::seed_from_u64(2019);
    let mut best: Option<(f64, ScenePlane)> = None;
    for _ in 0..TRIALS {
        let triple = [(); 3].map(|()| sample[rng.random_range(0..sample.len())]);
        if let Some(plane) = least_squares(triple.iter()) {
            let spread = plane.spread(&sample);
            if best.is_none_or(|(least, _)| spread < least) {
                best = Some((spread, plane));
            }
        }
    }
    let (_, mut plane) = best?;
    for _ in 0..ROUNDS {
        let near = 4.0 * plane.spread(&sample);
        plane = least_squares(
            points
                .iter()
                .filter(|p| plane.inverse_depth_error(p).abs() <= near),
        )?;
    }
    Some(plane)
}

/// The w of least `sum (w . (x/z, y/z, 1) - 1/z)^2`, as a plane.
fn least_squares<'a>(points: impl Iterator<Item = &'a Point3<f64>>) -> Option<ScenePlane> {
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for p in points {
        let bearing = p.coords / p.z;
        normal += bearing * bearing.transpose();
        right += bearing / p.z;
    }
    let w = normal.cholesky()?.solve(&right);
    let plane = ScenePlane {
        normal: w.normalize(),
        distance: 1.0 / w.norm(),
    };
    (plane.distance.is_finite() && plane.normal.z > 0.0).then_some(plane)
}
