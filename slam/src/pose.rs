//! The pose of one frame from points of known position: robust stereo pose optimisation, and
//! sampling where no guess is near enough.

use barchan_geometry::{RectifiedRig, Se3, StereoPoint, se3};
use nalgebra::{
    Matrix3, Matrix3x6, Matrix6, Point3, Rotation3, SMatrix, UnitQuaternion, Vector3, Vector6,
};
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;

use crate::Keypoint;

/// A point of the world and where a frame sees it.
#[derive(Clone, Copy, Debug)]
pub struct Observation {
    /// World frame, metres.
    pub point: Point3<f64>,
    /// Column in the left image, pixels.
    pub u: f64,
    /// Row, pixels.
    pub v: f64,
    /// Disparity, pixels, where it is known.
    pub d: Option<f64>,
    /// Standard deviation of the position, pixels.
    pub sigma: f64,
    /// Standard deviation of the disparity, pixels.
    pub sigma_d: f64,
}

/// A point in the world and in the camera frame.
type PointPair = (Point3<f64>, Point3<f64>);

/// Squared distances in standard deviations that 5 % of true matches exceed: chi-square of two
/// degrees of freedom, and of three with disparity.
const CHI2: [f64; 2] = [5.991, 7.815];

/// Where Huber's loss turns linear, standard deviations.
pub(crate) const HUBER: f64 = 2.0;

impl Observation {
    /// A point seen by a feature, with a disparity where that is known.
    pub fn new(point: Point3<f64>, at: &Keypoint, d: Option<f64>, sigma_d: f64) -> Self {
        Self {
            point,
            u: at.u,
            v: at.v,
            d,
            sigma: at.sigma,
            sigma_d,
        }
    }

    /// Seen minus projected `(u, v, d)` in standard deviations; the third is zero where no
    /// disparity is known. `None` when the point is behind the camera.
    pub(crate) fn residual(&self, rig: &RectifiedRig, p_cam: &Point3<f64>) -> Option<Vector3<f64>> {
        let seen = rig.project(p_cam)?;
        Some(Vector3::new(
            (self.u - seen.u) / self.sigma,
            (self.v - seen.v) / self.sigma,
            self.d.map_or(0.0, |d| (d - seen.d) / self.sigma_d),
        ))
    }

    /// Whether a squared residual is that of a true match.
    pub(crate) fn accepts(&self, squared: f64) -> bool {
        squared <= CHI2[usize::from(self.d.is_some())]
    }

    /// A derivative of `(u, v, d)` in standard deviations; the row of the disparity is zero where
    /// none is known.
    pub(crate) fn whiten<const N: usize>(
        &self,
        mut jacobian: SMatrix<f64, 3, N>,
    ) -> SMatrix<f64, 3, N> {
        let per_d = self.d.map_or(0.0, |_| 1.0 / self.sigma_d);
        for (row, scale) in [1.0 / self.sigma, 1.0 / self.sigma, per_d]
            .into_iter()
            .enumerate()
        {
            jacobian.row_mut(row).scale_mut(scale);
        }
        jacobian
    }
}

/// Derivative of the projection `(u, v, d)` of `exp(xi) p_cam` with respect to the twist `xi`
/// (translation first), at zero.
pub fn reprojection_jacobian(rig: &RectifiedRig, p_cam: &Point3<f64>) -> Matrix3x6<f64> {
    let mut motion = Matrix3x6::zeros();
    motion.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
    motion
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&-se3::skew(&p_cam.coords));
    rig.projection_jacobian(p_cam) * motion
}

/// What [`optimise_pose`] found.
#[derive(Clone, Debug)]
#[allow(non_snake_case)]
pub struct PoseEstimate {
    /// Maps world points to the left camera.
    pub T_cam_world: Se3,
    /// Which observations agree with it.
    pub inliers: Vec<bool>,
}

impl PoseEstimate {
    /// How many agree.
    pub fn count(&self) -> usize {
        self.inliers.iter().filter(|i| **i).count()
    }
}

/// Minimises the Huber loss of the stereo reprojection errors over the six parameters of the pose,
/// by Levenberg-Marquardt, in four rounds; each round leaves out what the last one contradicts.
#[allow(non_snake_case)]
pub fn optimise_pose(
    rig: &RectifiedRig,
    observations: &[Observation],
    T_guess: &Se3,
) -> PoseEstimate {
    let mut T_cam_world = *T_guess;
    // A guess is often made of poses found before: what rounding made of the length of their quaternions would
    // grow with every round, threefold where it is `T * T_before.inverse() * T`, and be no rotation soon.
    T_cam_world.rotation.renormalize();
    let mut inliers = vec![true; observations.len()];
    for round in 0..4 {
        // The last rounds trust what is left: plain least squares.
        let huber = if round < 2 { HUBER } else { f64::INFINITY };
        T_cam_world = levenberg_marquardt(rig, observations, &inliers, T_cam_world, huber);
        for (observation, inlier) in observations.iter().zip(&mut inliers) {
            let residual = observation.residual(rig, &(T_cam_world * observation.point));
            *inlier = residual.is_some_and(|r| observation.accepts(r.norm_squared()));
        }
        if inliers.iter().filter(|i| **i).count() < 6 {
            break;
        }
    }
    PoseEstimate {
        T_cam_world,
        inliers,
    }
}

#[allow(non_snake_case)]
fn levenberg_marquardt(
    rig: &RectifiedRig,
    observations: &[Observation],
    used: &[bool],
    T_start: Se3,
    huber: f64,
) -> Se3 {
    let active = || {
        observations
            .iter()
            .zip(used)
            .filter(|(_, used)| **used)
            .map(|(o, _)| o)
    };
    let cost = |T: &Se3| -> f64 {
        active()
            .map(|o| {
                o.residual(rig, &(T * o.point))
                    .map_or(1e3, |r| huber_cost(r.norm_squared(), huber))
            })
            .sum()
    };
    let mut T_cam_world = T_start;
    let mut current = cost(&T_cam_world);
    let mut lambda = 1e-3;
    for _ in 0..12 {
        let mut hessian = Matrix6::zeros();
        let mut gradient = Vector6::zeros();
        for o in active() {
            let p_cam = T_cam_world * o.point;
            let Some(residual) = o.residual(rig, &p_cam) else {
                continue;
            };
            let jacobian = o.whiten(reprojection_jacobian(rig, &p_cam));
            let weight = huber_weight(residual.norm_squared(), huber);
            hessian += jacobian.transpose() * jacobian * weight;
            gradient += jacobian.transpose() * residual * weight;
        }
        let damped =
            hessian + Matrix6::from_diagonal(&(hessian.diagonal() * lambda).add_scalar(1e-9));
        let Some(step) = damped.cholesky().map(|c| c.solve(&gradient)) else {
            break;
        };
        let candidate = se3::exp(&step) * T_cam_world;
        let next = cost(&candidate);
        if next < current {
            let gained = current - next;
            (T_cam_world, current, lambda) = (candidate, next, lambda * 0.3);
            if gained < 1e-6 * current || step.norm() < 1e-8 {
                break;
            }
        } else {
            lambda *= 10.0;
        }
    }
    T_cam_world
}

pub(crate) fn huber_cost(squared: f64, huber: f64) -> f64 {
    if squared <= huber * huber {
        squared
    } else {
        2.0 * huber * squared.sqrt() - huber * huber
    }
}

pub(crate) fn huber_weight(squared: f64, huber: f64) -> f64 {
    if squared <= huber * huber {
        1.0
    } else {
        huber / squared.sqrt()
    }
}

/// The pose that most observations agree with, from samples of three whose positions in the camera
/// are known by their disparity. `None` when no sample finds `enough`.
#[allow(non_snake_case)]
pub(crate) fn sample_pose(
    rig: &RectifiedRig,
    observations: &[Observation],
    enough: usize,
    rng: &mut ChaCha8Rng,
) -> Option<Se3> {
    let seen: Vec<PointPair> = observations
        .iter()
        .filter_map(|o| {
            let p_cam = rig.back_project(StereoPoint {
                u: o.u,
                v: o.v,
                d: o.d?,
            })?;
            Some((o.point, p_cam))
        })
        .collect();
    if seen.len() < 3 {
        return None;
    }
    let mut best: Option<(usize, Se3)> = None;
    for _ in 0..1000 {
        let sample: Vec<_> = seen.sample(rng, 3).copied().collect();
        let Some(T_cam_world) = align(&sample) else {
            continue;
        };
        let agree = observations
            .iter()
            // Three-point poses are rough: four standard deviations.
            .filter(|o| {
                o.residual(rig, &(T_cam_world * o.point))
                    .is_some_and(|r| r.norm_squared() < 16.0)
            })
            .count();
        if agree >= enough && best.is_none_or(|(most, _)| agree > most) {
            best = Some((agree, T_cam_world));
        }
    }
    best.map(|(_, pose)| pose)
}

/// The rigid motion that maps the first of each pair to the second, in the least squares sense
/// (Umeyama 1991, without scale). `None` for points on a line.
fn align(pairs: &[PointPair]) -> Option<Se3> {
    let n = pairs.len() as f64;
    let centre = |f: fn(&PointPair) -> Vector3<f64>| pairs.iter().map(f).sum::<Vector3<f64>>() / n;
    let (from, to) = (centre(|p| p.0.coords), centre(|p| p.1.coords));
    let mut covariance = Matrix3::zeros();
    for (a, b) in pairs {
        covariance += (b.coords - to) * (a.coords - from).transpose();
    }
    let svd = covariance.svd(true, true);
    if svd.singular_values[1] < 1e-6 * svd.singular_values[0].max(1e-12) {
        return None;
    }
    let (u, v_t) = (svd.u?, svd.v_t?);
    let sign = (u * v_t).determinant().signum();
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    Some(Se3::from_parts((to - rotation * from).into(), rotation))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};

    pub(crate) fn rig() -> RectifiedRig {
        RectifiedRig {
            width: 512,
            height: 288,
            fx: 220.0,
            fy: 230.0,
            cx: 250.0,
            cy: 140.0,
            doffs: 1.5,
            baseline: 0.09,
        }
    }

    /// Points in view of a pose, and where it sees them.
    pub(crate) fn world(pose: &Se3, count: usize, seed: u64) -> Vec<Observation> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        (0..count)
            .map(|_| {
                let at = StereoPoint {
                    u: rng.random_range(10.0..500.0),
                    v: rng.random_range(10.0..280.0),
                    d: rng.random_range(4.0..40.0),
                };
                let point = pose.inverse() * rig().back_project(at).unwrap();
                Observation {
                    point,
                    u: at.u,
                    v: at.v,
                    d: Some(at.d),
                    sigma: 1.0,
                    sigma_d: 1.0,
                }
            })
            .collect()
    }

    fn truth() -> Se3 {
        se3::exp(&Vector6::new(0.1, -0.05, 0.2, 0.05, -0.1, 0.02))
    }

    fn error(a: &Se3, b: &Se3) -> f64 {
        se3::log(&(a.inverse() * b)).norm()
    }

    #[test]
    fn the_jacobian_matches_finite_differences() {
        let rig = rig();
        let p_cam = Point3::new(0.4, -0.3, 1.7);
        let analytic = reprojection_jacobian(&rig, &p_cam);
        let project = |twist: Vector6<f64>| {
            let s = rig.project(&(se3::exp(&twist) * p_cam)).unwrap();
            Vector3::new(s.u, s.v, s.d)
        };
        for k in 0..6 {
            let mut step = Vector6::zeros();
            step[k] = 1e-6;
            let numeric = (project(step) - project(-step)) / 2e-6;
            assert!(
                (numeric - analytic.column(k)).norm() < 1e-5 * (1.0 + numeric.norm()),
                "column {k}"
            );
        }
    }

    #[test]
    fn the_pose_is_found_among_a_third_of_false_matches() {
        let mut observations = world(&truth(), 150, 1);
        for o in observations.iter_mut().take(50) {
            o.u += 30.0;
            o.d = o.d.map(|d| d * 0.5);
        }
        // Some are seen by one camera only.
        observations.iter_mut().skip(100).for_each(|o| o.d = None);
        let found = optimise_pose(&rig(), &observations, &Se3::identity());
        assert!(error(&found.T_cam_world, &truth()) < 1e-6);
        assert!(found.inliers[..50].iter().all(|i| !i) && found.inliers[50..].iter().all(|i| *i));
    }

    /// Each guess is made of poses found before, as constant velocity does: after a hundred, still a rotation.
    #[test]
    fn poses_made_of_poses_stay_rigid() {
        let step = se3::exp(&Vector6::new(0.01, 0.0, 0.02, 0.01, -0.02, 0.03));
        let (mut before, mut last, mut truth) = (Se3::identity(), Se3::identity(), Se3::identity());
        for frame in 0..100 {
            truth = step * truth;
            let guess = last * before.inverse() * last;
            let found = optimise_pose(&rig(), &world(&truth, 30, frame), &guess);
            let length = found.T_cam_world.rotation.as_vector().norm();
            assert!((length - 1.0).abs() < 1e-12, "{frame}: {length}");
            assert!(error(&found.T_cam_world, &truth) < 1e-6);
            (before, last) = (last, found.T_cam_world);
        }
    }

    #[test]
    fn sampling_needs_no_guess() {
        let far = se3::exp(&Vector6::new(2.0, 0.5, -1.0, 0.3, 1.2, -0.4));
        let mut observations = world(&far, 100, 2);
        observations.iter_mut().take(60).for_each(|o| o.v += 40.0);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let found = sample_pose(&rig(), &observations, 20, &mut rng).unwrap();
        assert!(error(&found, &far) < 1e-3);
        assert!(sample_pose(&rig(), &observations[..2], 1, &mut rng).is_none());
    }

    #[test]
    fn points_on_a_line_fix_no_pose() {
        let line: Vec<_> = (0..3)
            .map(|i| {
                (
                    Point3::new(i as f64, 0.0, 0.0),
                    Point3::new(0.0, i as f64, 1.0),
                )
            })
            .collect();
        assert!(align(&line).is_none());
    }
}
