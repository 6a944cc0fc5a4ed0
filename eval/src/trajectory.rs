//! Trajectory scores: association by time, alignment (Umeyama 1991), absolute and relative pose
//! error (Sturm 2012; as `evo` computes them) and KITTI segment errors (Geiger 2012).
//!
//! Truth may hold positions only (planar survey points carry no rotation). It is recognised by all
//! its rotations being the same, and then no figure uses a true rotation: see [`TrajectoryScore`].

use barchan_geometry::nalgebra::{Matrix3, Matrix6, Rotation3, UnitQuaternion, Vector3, Vector6};
use barchan_geometry::{Se3, StampedPose, Trajectory};
use serde::Serialize;

use crate::EvalError;

/// Largest difference in time at which two poses are taken for the same moment, seconds.
pub const DEFAULT_TOLERANCE: f64 = 0.02;

/// What `barchan eval trajectory` says.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrajectoryScore {
    /// Root mean square of the position error after rigid (SE3) alignment, metres.
    pub ate_rmse: f64,
    /// The same after alignment with scale (Sim3), metres.
    pub ate_rmse_sim3: f64,
    /// Factor that the Sim3 alignment applies to the estimate: above 1, the estimate is too small.
    pub scale: f64,
    /// Relative pose error of consecutive frames, translation: sum of the errors over the path
    /// length, percent. Sums, because a ratio per frame has no meaning where the rover stands.
    ///
    /// Where the truth holds positions only, the error of a frame is the difference of the two
    /// displacements after SE3 alignment, as the true camera frame is not known.
    pub rpe_trans_percent: f64,
    /// Root mean square of the same errors, metres: `evo_rpe -r trans_part -d 1 -u f`.
    pub rpe_trans_rmse: f64,
    /// Relative pose error, rotation: sum of the angles over the path length, degrees per metre.
    /// `None` (JSON `null`) where the truth holds positions only.
    pub rpe_rot_deg_per_m: Option<f64>,
    /// Root mean square of the same angles, degrees: `evo_rpe -r angle_deg -d 1 -u f`.
    pub rpe_rot_rmse_deg: Option<f64>,
    /// Length of the true path through the compared poses, metres.
    pub length: f64,
    /// Poses compared.
    pub frames: usize,
}

/// Mean errors over all segments of 100, 200, ... 800 m (KITTI odometry development kit).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SegmentScore {
    /// Translation error, percent of the segment's length.
    pub translation_percent: f64,
    /// Rotation error, degrees per 100 m.
    pub rotation_deg_per_100m: f64,
    /// Segments averaged.
    pub segments: usize,
}

/// A similarity: `truth = scale * rotation * estimate + translation`.
#[derive(Clone, Debug, PartialEq)]
pub struct Similarity {
    /// The factor.
    pub scale: f64,
    /// The rotation.
    pub rotation: Rotation3<f64>,
    /// The shift, metres.
    pub translation: Vector3<f64>,
}

impl Similarity {
    /// Maps a point of the estimate to the truth.
    pub fn apply(&self, p: &Vector3<f64>) -> Vector3<f64> {
        self.scale * (self.rotation * p) + self.translation
    }
}

/// Poses of an estimate and of the truth at the same moments, in the order of time.
#[derive(Clone, Debug, Default, PartialEq)]
#[allow(non_snake_case)]
pub struct PosePairs {
    /// Estimated poses.
    pub T_world_cam_est: Vec<Se3>,
    /// True poses.
    pub T_world_cam_true: Vec<Se3>,
}

/// Scores `estimate` against `truth`, see [`TrajectoryScore`].
///
/// # Errors
/// When fewer than three poses correspond within `tolerance` seconds, when one side does not move,
/// or when a pose is not finite.
pub fn score(
    estimate: &Trajectory,
    truth: &Trajectory,
    tolerance: f64,
) -> Result<TrajectoryScore, EvalError> {
    let pairs = associate(estimate, truth, tolerance)?;
    let (est, gt) = (
        positions(&pairs.T_world_cam_est),
        positions(&pairs.T_world_cam_true),
    );
    let rigid = umeyama(&est, &gt, false)?;
    let similar = umeyama(&est, &gt, true)?;
    let length = path_length(&gt);
    let positions_only = holds_positions_only(&pairs.T_world_cam_true);

    let mut translations = Vec::with_capacity(est.len());
    let mut angles = Vec::with_capacity(est.len());
    for i in 1..est.len() {
        if positions_only {
            let step_est = rigid.rotation * (est[i] - est[i - 1]);
            translations.push((step_est - (gt[i] - gt[i - 1])).norm());
        } else {
            let error = relative_error(&pairs, i - 1, i);
            translations.push(error.translation.vector.norm());
            angles.push(error.rotation.angle().to_degrees());
        }
    }
    let rotations = (!positions_only).then_some(&angles);
    Ok(TrajectoryScore {
        ate_rmse: rmse(
            est.iter()
                .zip(&gt)
                .map(|(e, g)| (rigid.apply(e) - g).norm()),
        ),
        ate_rmse_sim3: rmse(
            est.iter()
                .zip(&gt)
                .map(|(e, g)| (similar.apply(e) - g).norm()),
        ),
        scale: similar.scale,
        rpe_trans_percent: 100.0 * translations.iter().sum::<f64>() / length,
        rpe_trans_rmse: rmse(translations.iter().copied()),
        rpe_rot_deg_per_m: rotations.map(|a| a.iter().sum::<f64>() / length),
        rpe_rot_rmse_deg: rotations.map(|a| rmse(a.iter().copied())),
        length,
        frames: est.len(),
    })
}

/// Segment errors as the KITTI odometry development kit computes them: from every tenth frame,
/// segments of 100 to 800 m of true path, errors divided by the nominal length, averaged over all.
///
/// # Errors
/// As [`score`]; also when the truth is shorter than 100 m or holds positions only.
pub fn kitti_segments(
    estimate: &Trajectory,
    truth: &Trajectory,
    tolerance: f64,
) -> Result<SegmentScore, EvalError> {
    const LENGTHS: [f64; 8] = [100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0];
    const STEP: usize = 10;
    let pairs = associate(estimate, truth, tolerance)?;
    if holds_positions_only(&pairs.T_world_cam_true) {
        return Err(EvalError::NoRotation);
    }
    let gt = positions(&pairs.T_world_cam_true);
    let mut travelled = vec![0.0; gt.len()];
    for i in 1..gt.len() {
        travelled[i] = travelled[i - 1] + (gt[i] - gt[i - 1]).norm();
    }

    let (mut translation, mut rotation, mut segments) = (0.0, 0.0, 0);
    for first in (0..gt.len()).step_by(STEP) {
        for length in LENGTHS {
            let last = travelled.partition_point(|&d| d <= travelled[first] + length);
            if last == gt.len() {
                break;
            }
            let error = relative_error(&pairs, first, last);
            translation += error.translation.vector.norm() / length;
            rotation += error.rotation.angle() / length;
            segments += 1;
        }
    }
    if segments == 0 {
        return Err(EvalError::TooShort {
            length: path_length(&gt),
            shortest: LENGTHS[0],
        });
    }
    Ok(SegmentScore {
        translation_percent: 100.0 * translation / segments as f64,
        rotation_deg_per_100m: 100.0 * rotation.to_degrees() / segments as f64,
        segments,
    })
}

/// Pairs each estimated pose with the true pose nearest in time, at most `tolerance` seconds away.
/// A true pose wanted by several goes to the nearest of them.
///
/// # Errors
/// When fewer than three pairs are found, or a pose or a time is not finite.
pub fn associate(
    estimate: &Trajectory,
    truth: &Trajectory,
    tolerance: f64,
) -> Result<PosePairs, EvalError> {
    let est = in_order_of_time(estimate, "estimate")?;
    let gt = in_order_of_time(truth, "truth")?;

    // claims[j]: the estimate that holds true pose j, so far the nearest that asked.
    let mut claims: Vec<Option<usize>> = vec![None; gt.len()];
    let gap = |i: usize, j: usize| (est[i].time - gt[j].time).abs();
    for i in 0..est.len() {
        let after = gt.partition_point(|p| p.time < est[i].time);
        let near = after.saturating_sub(1)..(after + 1).min(gt.len());
        let Some(j) = near.min_by(|&a, &b| gap(i, a).total_cmp(&gap(i, b))) else {
            continue;
        };
        if gap(i, j) <= tolerance && claims[j].is_none_or(|holder| gap(i, j) < gap(holder, j)) {
            claims[j] = Some(i);
        }
    }

    let mut pairs = PosePairs::default();
    for (j, claim) in claims.iter().enumerate() {
        if let Some(i) = claim {
            pairs.T_world_cam_est.push(est[*i].T_world_cam);
            pairs.T_world_cam_true.push(gt[j].T_world_cam);
        }
    }
    let matched = pairs.T_world_cam_est.len();
    if matched < 3 {
        return Err(EvalError::TooFewMatches {
            matched,
            estimate: est.len(),
            truth: gt.len(),
            tolerance,
            estimate_span: span(&est),
            truth_span: span(&gt),
        });
    }
    Ok(pairs)
}

/// The rigid motion (or, `with_scale`, the similarity) that brings `est` nearest to `truth` in the
/// least-squares sense (Umeyama 1991, eq. 34-42).
///
/// Points along one line leave the rotation about that line free; the residual does not depend on it.
///
/// # Errors
/// When either side is at one place.
pub fn umeyama(
    est: &[Vector3<f64>],
    truth: &[Vector3<f64>],
    with_scale: bool,
) -> Result<Similarity, EvalError> {
    let (mean_est, mean_truth) = (mean(est), mean(truth));
    let variance_est = variance(est, &mean_est);
    // Rounding leaves about 1e-16 of the distance to the origin.
    let moves = |variance: f64, mean: &Vector3<f64>| variance.sqrt() > 1e-12 * (1.0 + mean.norm());
    if !moves(variance(truth, &mean_truth), &mean_truth) {
        return Err(EvalError::NoMotion { which: "truth" });
    }
    if !moves(variance_est, &mean_est) {
        return Err(EvalError::NoMotion { which: "estimate" });
    }
    let covariance = est.iter().zip(truth).fold(Matrix3::zeros(), |sum, (e, t)| {
        sum + (t - mean_truth) * (e - mean_est).transpose()
    }) / est.len() as f64;
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u.unwrap_or_default(), svd.v_t.unwrap_or_default());
    // A reflection fits a mirrored cloud better than any rotation: eq. 39 forbids it.
    let mut signs = Vector3::repeat(1.0);
    if u.determinant() * v_t.determinant() < 0.0 {
        signs.z = -1.0;
    }
    let rotation = Rotation3::from_matrix_unchecked(u * Matrix3::from_diagonal(&signs) * v_t);
    let scale = if with_scale {
        svd.singular_values.dot(&signs) / variance_est
    } else {
        1.0
    };
    let translation = mean_truth - scale * (rotation * mean_est);
    Ok(Similarity {
        scale,
        rotation,
        translation,
    })
}

/// What brings an estimated trajectory to another.
#[derive(Clone, Copy, Debug)]
#[allow(non_snake_case)]
pub struct Alignment {
    /// The rigid motion.
    pub T_truth_est: Se3,
    /// The mean square of what is left: position and rotation vector of the other about the estimate, along the axes
    /// of the estimate's world. Without rotations in the other, those are zero.
    pub residual: Matrix6<f64>,
    /// How many poses were compared. A motion fits a few poses whatever they are off, and leaves little then.
    pub poses: usize,
}

/// The rigid motion `T_truth_est` that brings an estimated trajectory nearest to another, by positions
/// and, where the other has rotations, by three points a metre along the axes of each camera, which
/// settle the rotation of a straight drive too.
///
/// # Errors
/// As [`associate`] and [`umeyama`].
#[allow(non_snake_case)]
pub fn align(
    estimate: &Trajectory,
    truth: &Trajectory,
    tolerance: f64,
) -> Result<Alignment, EvalError> {
    let pairs = associate(estimate, truth, tolerance)?;
    let rotates = !holds_positions_only(&pairs.T_world_cam_true);
    let axes: &[Vector3<f64>] = match rotates {
        false => &[],
        true => &[
            Vector3::new(1.0, 0.0, 0.0),
            Vector3::new(0.0, 1.0, 0.0),
            Vector3::new(0.0, 0.0, 1.0),
        ],
    };
    let points = |poses: &[Se3]| -> Vec<Vector3<f64>> {
        let around = |p: &Se3| -> Vec<Vector3<f64>> {
            let centre = p.translation.vector;
            let along = axes.iter().map(|a| centre + p.rotation * a);
            std::iter::once(centre).chain(along).collect()
        };
        poses.iter().flat_map(around).collect()
    };
    let found = umeyama(
        &points(&pairs.T_world_cam_est),
        &points(&pairs.T_world_cam_true),
        false,
    )?;
    let T_truth_est = Se3::from_parts(
        found.translation.into(),
        UnitQuaternion::from_rotation_matrix(&found.rotation),
    );
    let T_est_truth = T_truth_est.inverse();
    let poses = pairs.T_world_cam_est.iter().zip(&pairs.T_world_cam_true);
    let squares = poses.map(|(est, truth)| {
        let truth = T_est_truth * truth;
        let moved = truth.translation.vector - est.translation.vector;
        let turned = match rotates {
            true => (truth.rotation * est.rotation.inverse()).scaled_axis(),
            false => Vector3::zeros(),
        };
        let residual = Vector6::new(moved.x, moved.y, moved.z, turned.x, turned.y, turned.z);
        residual * residual.transpose()
    });
    let poses = pairs.T_world_cam_est.len();
    Ok(Alignment {
        T_truth_est,
        residual: squares.sum::<Matrix6<f64>>() / poses as f64,
        poses,
    })
}

/// Whether a trajectory carries no rotation: all are the same.
fn holds_positions_only(poses: &[Se3]) -> bool {
    poses
        .windows(2)
        .all(|w| w[0].rotation.angle_to(&w[1].rotation) < 1e-9)
}

/// How far the estimated motion from pose `i` to `j` is off the true one, in the frame of pose `j`.
fn relative_error(pairs: &PosePairs, i: usize, j: usize) -> Se3 {
    let step_true = pairs.T_world_cam_true[i].inv_mul(&pairs.T_world_cam_true[j]);
    let step_est = pairs.T_world_cam_est[i].inv_mul(&pairs.T_world_cam_est[j]);
    step_true.inv_mul(&step_est)
}

pub(crate) fn in_order_of_time(
    t: &Trajectory,
    which: &'static str,
) -> Result<Vec<StampedPose>, EvalError> {
    let finite = |p: &StampedPose| {
        p.time.is_finite() && p.T_world_cam.to_homogeneous().iter().all(|v| v.is_finite())
    };
    if let Some(index) = t.poses.iter().position(|p| !finite(p)) {
        return Err(EvalError::NotFinite { which, index });
    }
    let mut poses = t.poses.clone();
    poses.sort_by(|a, b| a.time.total_cmp(&b.time));
    Ok(poses)
}

fn span(poses: &[StampedPose]) -> String {
    match (poses.first(), poses.last()) {
        (Some(a), Some(b)) => format!("{:.3} to {:.3} s", a.time, b.time),
        _ => "nothing".into(),
    }
}

fn positions(poses: &[Se3]) -> Vec<Vector3<f64>> {
    poses.iter().map(|p| p.translation.vector).collect()
}

/// Length of the way from point to point, in the unit of the points.
pub fn path_length(points: &[Vector3<f64>]) -> f64 {
    points.windows(2).map(|w| (w[1] - w[0]).norm()).sum()
}

fn mean(points: &[Vector3<f64>]) -> Vector3<f64> {
    points.iter().sum::<Vector3<f64>>() / points.len().max(1) as f64
}

fn variance(points: &[Vector3<f64>], mean: &Vector3<f64>) -> f64 {
    points
        .iter()
        .map(|p| (p - mean).norm_squared())
        .sum::<f64>()
        / points.len().max(1) as f64
}

fn rmse(errors: impl ExactSizeIterator<Item = f64>) -> f64 {
    let n = errors.len().max(1) as f64;
    (errors.map(|e| e * e).sum::<f64>() / n).sqrt()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use barchan_geometry::nalgebra::{Translation3, UnitQuaternion, Vector6};
    use barchan_geometry::se3;

    use super::*;

    fn trajectory(poses: impl IntoIterator<Item = Se3>) -> Trajectory {
        let poses = poses.into_iter().enumerate();
        let stamp = |(i, pose)| StampedPose {
            time: 0.1 * i as f64,
            T_world_cam: pose,
        };
        Trajectory {
            poses: poses.map(stamp).collect(),
        }
    }

    /// A winding drive of `n` poses, none of whose coordinates stays put.
    fn drive(n: usize) -> Trajectory {
        trajectory((0..n).map(|i| {
            let s = i as f64 * 0.1;
            let t = Vector3::new(3.0 * s.sin(), 0.3 * (2.0 * s).cos(), s);
            Se3::from_parts(
                Translation3::from(t),
                UnitQuaternion::from_euler_angles(0.05 * s.sin(), 0.4 * s.cos(), 0.02 * s),
            )
        }))
    }

    fn moved(t: &Trajectory, by: impl Fn(&Se3) -> Se3) -> Trajectory {
        let poses = t.poses.iter();
        Trajectory {
            poses: poses
                .map(|p| StampedPose {
                    T_world_cam: by(&p.T_world_cam),
                    ..*p
                })
                .collect(),
        }
    }

    fn scaled(t: &Trajectory, factor: f64) -> Trajectory {
        moved(t, |p| {
            Se3::from_parts(
                Translation3::from(p.translation.vector * factor),
                p.rotation,
            )
        })
    }

    #[test]
    fn a_planted_similarity_is_recovered_and_scores_zero() {
        let truth = drive(60);
        let motion = se3::exp(&Vector6::new(4.0, -2.0, 7.0, 0.5, 2.0, -0.4));
        let est = moved(&scaled(&truth, 0.8), |p| motion * p);
        let s = score(&est, &truth, DEFAULT_TOLERANCE).unwrap();
        assert!(s.ate_rmse_sim3 < 1e-12, "{s:?}");
        assert!((s.scale - 1.25).abs() < 1e-12, "{s:?}");
        assert!(s.ate_rmse > 0.1, "{s:?}");
        // A shrunk copy of a drive: every step is 20 % short and every rotation right.
        assert!((s.rpe_trans_percent - 20.0).abs() < 1e-9, "{s:?}");
        assert!(s.rpe_rot_deg_per_m.unwrap() < 1e-5, "{s:?}");
        let rigid = score(&moved(&truth, |p| motion * p), &truth, DEFAULT_TOLERANCE).unwrap();
        assert!(
            rigid.ate_rmse < 1e-12 && rigid.rpe_trans_rmse < 1e-12,
            "{rigid:?}"
        );
    }

    #[test]
    fn the_score_does_not_depend_on_either_world() {
        let truth = drive(50);
        let noisy = noise(&truth, 0.03);
        let before = score(&noisy, &truth, DEFAULT_TOLERANCE).unwrap();
        let a = se3::exp(&Vector6::new(1.0, 2.0, 3.0, 1.1, -0.5, 2.2));
        let b = se3::exp(&Vector6::new(-9.0, 0.5, 1.0, -0.7, 0.1, -1.0));
        let after = score(
            &moved(&noisy, |p| a * p),
            &moved(&truth, |p| b * p),
            DEFAULT_TOLERANCE,
        )
        .unwrap();
        assert!((before.ate_rmse - after.ate_rmse).abs() < 1e-10);
        assert!((before.ate_rmse_sim3 - after.ate_rmse_sim3).abs() < 1e-10);
        assert!((before.rpe_trans_rmse - after.rpe_trans_rmse).abs() < 1e-10);
        assert!((before.rpe_rot_rmse_deg.unwrap() - after.rpe_rot_rmse_deg.unwrap()).abs() < 1e-6);
    }

    /// Shifts each position by a vector of length `size` in a direction of a fixed pseudo-random walk.
    fn noise(t: &Trajectory, size: f64) -> Trajectory {
        let mut state = 1u64;
        let mut next = || {
            state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (state >> 33) as f64 / (1u64 << 31) as f64 - 0.5
        };
        let poses = t.poses.iter().map(|p| {
            let shift = Vector3::new(next(), next(), next()).normalize() * size;
            let translation = Translation3::from(p.T_world_cam.translation.vector + shift);
            StampedPose {
                T_world_cam: Se3::from_parts(translation, p.T_world_cam.rotation),
                ..*p
            }
        });
        Trajectory {
            poses: poses.collect(),
        }
    }

    #[test]
    fn noise_of_a_known_size_is_the_error_found() {
        let truth = drive(2000);
        let s = score(&noise(&truth, 0.05), &truth, DEFAULT_TOLERANCE).unwrap();
        // The alignment can only lower it, by about 6 of 6000 degrees of freedom.
        assert!(s.ate_rmse <= 0.05 + 1e-12 && s.ate_rmse > 0.0495, "{s:?}");
        assert!(s.ate_rmse_sim3 <= s.ate_rmse + 1e-12, "{s:?}");
        // Two independent shifts of 0.05 m differ by 0.05 * sqrt 2 in the root mean square.
        assert!(
            (s.rpe_trans_rmse - 0.05 * 2f64.sqrt()).abs() < 0.002,
            "{s:?}"
        );
    }

    #[test]
    fn values_worked_by_hand() {
        // Truth: 1 m steps along x. Estimate: the second of two steps is 0.5 m and turns by 0.1 rad.
        let truth = trajectory([
            Se3::identity(),
            Se3::translation(1.0, 0.0, 0.0),
            Se3::new(Vector3::new(2.0, 0.0, 0.0), Vector3::new(0.0, 0.0, 0.2)),
        ]);
        let est = trajectory([
            Se3::identity(),
            Se3::translation(1.0, 0.0, 0.0),
            Se3::new(Vector3::new(1.5, 0.0, 0.0), Vector3::new(0.0, 0.0, 0.1)),
        ]);
        let s = score(&est, &truth, DEFAULT_TOLERANCE).unwrap();
        assert!((s.length - 2.0).abs() < 1e-12 && s.frames == 3);
        assert!((s.rpe_trans_percent - 25.0).abs() < 1e-9, "{s:?}");
        assert!(
            (s.rpe_trans_rmse - (0.25f64 / 2.0).sqrt()).abs() < 1e-12,
            "{s:?}"
        );
        let angle = 0.1f64.to_degrees();
        assert!(
            (s.rpe_rot_deg_per_m.unwrap() - angle / 2.0).abs() < 1e-6,
            "{s:?}"
        );
        // Centred: est (-5/6, 1/6, 4/6), truth (-1, 0, 1): residuals 1/6, 1/6, -1/3.
        assert!((s.ate_rmse - (1.0f64 / 18.0).sqrt()).abs() < 1e-12, "{s:?}");
        // scale = sum(est truth) / sum(est^2) = 1.5 / (42/36); residual by least squares.
        let scale = 1.5 / (42.0 / 36.0);
        assert!((s.scale - scale).abs() < 1e-12, "{s:?}");
        let left = 2.0 - scale * 1.5;
        assert!(
            (s.ate_rmse_sim3 - (left / 3.0).sqrt()).abs() < 1e-12,
            "{s:?}"
        );
    }

    #[test]
    fn truth_without_rotation_does_not_spoil_the_positions() {
        let drive = drive(60);
        let planar = moved(&drive, |p| {
            Se3::translation(p.translation.vector.x, p.translation.vector.z, 0.0)
        });
        // The estimate follows the same plane, with rotations, in a world of its own.
        let motion = se3::exp(&Vector6::new(4.0, -2.0, 7.0, 0.5, 2.0, -0.4));
        let est = moved(&drive, |p| {
            let t = p.translation.vector;
            motion * Se3::from_parts(Translation3::new(t.x, t.z, 0.0), p.rotation)
        });
        let s = score(&est, &planar, DEFAULT_TOLERANCE).unwrap();
        assert!(s.ate_rmse < 1e-12 && s.rpe_trans_percent < 1e-9, "{s:?}");
        assert_eq!((s.rpe_rot_deg_per_m, s.rpe_rot_rmse_deg), (None, None));
        assert_eq!(
            kitti_segments(&est, &planar, 0.02),
            Err(EvalError::NoRotation)
        );
    }

    #[test]
    fn a_true_pose_is_used_once_and_by_the_nearest() {
        let truth = drive(5);
        let mut est = drive(5);
        // A second estimate 15 ms after the third true pose, where the other is 5 ms away.
        est.poses[2].time += 0.005;
        est.poses.push(StampedPose {
            time: 0.215,
            T_world_cam: Se3::translation(99.0, 0.0, 0.0),
        });
        est.poses.reverse();
        let pairs = associate(&est, &truth, DEFAULT_TOLERANCE).unwrap();
        assert_eq!(pairs.T_world_cam_est, pairs.T_world_cam_true);
        assert_eq!(pairs.T_world_cam_est.len(), 5);
        est.poses
            .retain(|p| p.T_world_cam.translation.vector.x < 98.0);
        for p in &mut est.poses {
            p.time += 0.03;
        }
        let error = associate(&est, &truth, DEFAULT_TOLERANCE)
            .unwrap_err()
            .to_string();
        assert!(error.starts_with("only 0 of 5"), "{error}");
        assert_eq!(
            associate(&est, &truth, 0.04).unwrap().T_world_cam_est.len(),
            5
        );
    }

    #[test]
    fn degenerate_input_is_refused_in_plain_words() {
        let truth = drive(20);
        let still = moved(&truth, |p| {
            Se3::from_parts(Translation3::new(5.0, 1.0, 2.0), p.rotation)
        });
        assert_eq!(
            score(&still, &truth, 0.02),
            Err(EvalError::NoMotion { which: "estimate" })
        );
        assert_eq!(
            score(&truth, &still, 0.02),
            Err(EvalError::NoMotion { which: "truth" })
        );
        let two = Trajectory {
            poses: truth.poses[..2].to_vec(),
        };
        for (a, b) in [
            (&two, &truth),
            (&truth, &two),
            (&Trajectory::default(), &truth),
        ] {
            assert!(matches!(
                score(a, b, 0.02),
                Err(EvalError::TooFewMatches { .. })
            ));
        }
        let broken = moved(&truth, |p| p * Se3::translation(f64::NAN, 0.0, 0.0));
        assert_eq!(
            score(&broken, &truth, 0.02),
            Err(EvalError::NotFinite {
                which: "estimate",
                index: 0
            })
        );
        assert!(matches!(
            kitti_segments(&truth, &truth, 0.02),
            Err(EvalError::TooShort { .. })
        ));
    }

    #[test]
    fn a_straight_line_and_a_mirrored_path_are_aligned_by_a_rotation() {
        let line: Vec<_> = (0..10).map(|i| Vector3::new(i as f64, 0.0, 0.0)).collect();
        let other: Vec<_> = (0..10)
            .map(|i| Vector3::new(0.0, 3.0, 2.0 - i as f64))
            .collect();
        let s = umeyama(&line, &other, true).unwrap();
        assert!((s.rotation.matrix().determinant() - 1.0).abs() < 1e-12);
        for (a, b) in line.iter().zip(&other) {
            assert!((s.apply(a) - b).norm() < 1e-12);
        }
        let path = positions(
            &drive(40)
                .poses
                .iter()
                .map(|p| p.T_world_cam)
                .collect::<Vec<_>>(),
        );
        let mirror: Vec<_> = path.iter().map(|p| Vector3::new(-p.x, p.y, p.z)).collect();
        let s = umeyama(&path, &mirror, true).unwrap();
        assert!((s.rotation.matrix().determinant() - 1.0).abs() < 1e-12 && s.scale > 0.0);
    }

    #[test]
    fn an_alignment_says_what_it_leaves() {
        let truth = drive(40);
        let motion = Se3::new(Vector3::new(3.0, -2.0, 1.0), Vector3::new(0.3, -0.2, 1.0));
        // Every second pose is off by a step and a turn, there and back: the fit stays between.
        let (step, turn) = (
            Vector3::new(0.02, -0.01, 0.05),
            Vector3::new(0.01, 0.0, 0.02),
        );
        let moved = truth.poses.iter().enumerate().map(|(i, pose)| {
            let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
            let mut off = pose.T_world_cam;
            off.translation.vector += sign * step;
            off.rotation = UnitQuaternion::from_scaled_axis(sign * turn) * off.rotation;
            StampedPose {
                T_world_cam: motion.inverse() * off,
                ..*pose
            }
        });
        let estimate = Trajectory {
            poses: moved.collect(),
        };
        let found = align(&estimate, &truth, 0.02).unwrap();
        let off = found.T_truth_est * motion.inverse();
        assert!(off.translation.vector.norm() < 0.01 && off.rotation.angle() < 0.005);
        let back = motion.rotation.inverse();
        let expected: Vec<f64> = (back * step)
            .iter()
            .chain((back * turn).iter())
            .copied()
            .collect();
        let expected = Vector6::from_row_slice(&expected);
        let wanted = expected * expected.transpose();
        assert!(
            (found.residual - wanted).norm() < 0.15 * wanted.norm(),
            "{} {wanted}",
            found.residual
        );
        // Places alone leave no rotation.
        let places = Trajectory {
            poses: (truth.poses.iter())
                .map(|p| StampedPose {
                    T_world_cam: p.T_world_cam.translation.into(),
                    ..*p
                })
                .collect(),
        };
        let found = align(&estimate, &places, 0.02).unwrap();
        assert_eq!(found.residual.fixed_view::<3, 6>(3, 0).norm(), 0.0);
        assert!(found.residual[(2, 2)] > 0.0 && found.poses == 40);
    }

    #[test]
    fn kitti_segments_of_a_shrunk_drive_are_its_shrinkage() {
        let truth = trajectory((0..400).map(|i| {
            let s = i as f64;
            Se3::new(Vector3::new(0.0, 0.0, s), Vector3::new(0.0, 0.0, 0.001 * s))
        }));
        let s = kitti_segments(&scaled(&truth, 0.9), &truth, 0.02).unwrap();
        // A segment is the first stretch longer than its nominal length: here by one frame of 1 m.
        assert!(
            s.translation_percent >= 10.0 && s.translation_percent < 10.11,
            "{s:?}"
        );
        assert!(s.rotation_deg_per_100m < 1e-6, "{s:?}");
        // From frames 0, 10, ...: those before 400 - 101, 400 - 201 and 400 - 301.
        assert_eq!(s.segments, 30 + 20 + 10);
    }

    #[test]
    fn the_json_has_the_keys_of_the_contract() {
        let truth = drive(10);
        let json = serde_json::to_value(score(&truth, &truth, 0.02).unwrap()).unwrap();
        for key in [
            "ate_rmse",
            "ate_rmse_sim3",
            "rpe_trans_percent",
            "rpe_rot_deg_per_m",
            "length",
            "frames",
        ] {
            assert!(json[key].is_number(), "{key}: {json}");
        }
    }

    #[test]
    fn published_kitti_estimates_score_as_published() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/trajectories");
        if !folder.is_dir() {
            println!("skipped: no {}", folder.display());
            return;
        }
        let read = |name: &str| Trajectory::read_kitti(&folder.join(name), None).unwrap();
        let truth = read("KITTI_00_gt.txt");
        for (name, translation, rotation, ate) in [
            ("KITTI_00_SPTAM.txt", 1.487, 0.558, 3.74),
            ("KITTI_00_ORB.txt", 0.700, 0.253, 1.30),
        ] {
            let est = read(name);
            let segments = kitti_segments(&est, &truth, DEFAULT_TOLERANCE).unwrap();
            let whole = score(&est, &truth, DEFAULT_TOLERANCE).unwrap();
            println!("{name}: {segments:?} {whole:?}");
            assert!(
                (segments.translation_percent - translation).abs() < 0.0006,
                "{segments:?}"
            );
            assert!(
                (segments.rotation_deg_per_100m - rotation).abs() < 0.0006,
                "{segments:?}"
            );
            assert!((whole.ate_rmse - ate).abs() < 0.006, "{whole:?}");
        }
    }
}
