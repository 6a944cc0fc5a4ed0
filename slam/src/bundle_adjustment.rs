//! Poses and points together: sparse bundle adjustment by the Schur complement (Triggs 2000).

use barchan_geometry::{RectifiedRig, Se3, se3};
use nalgebra::{
    DMatrix, DVector, Matrix3, Matrix3x6, Matrix6, Matrix6x3, Point3, Vector3, Vector6,
};

use crate::block_cholesky::BlockCholesky;
use crate::pose::{HUBER, Observation, huber_cost, huber_weight};

/// A problem: poses of which some are fixed, points, and who sees what.
#[allow(non_snake_case)]
#[derive(Clone, Debug, Default)]
pub struct BundleAdjustment {
    /// Poses, each mapping world points to a left camera.
    pub T_cam_world: Vec<Se3>,
    /// Which poses stay. At least one must, or the whole floats.
    pub fixed: Vec<bool>,
    /// Points, world frame.
    pub points: Vec<Point3<f64>>,
    /// Pose, point, and the sighting (whose own `point` is not looked at).
    pub observations: Vec<(usize, usize, Observation)>,
}

/// A twist for each free pose and a shift for each point.
type Steps = (Vec<Vector6<f64>>, Vec<Vector3<f64>>);

/// How a solution went.
#[derive(Clone, Copy, Debug)]
pub struct Summary {
    /// Huber cost before.
    pub before: f64,
    /// Huber cost after.
    pub after: f64,
    /// Iterations done.
    pub iterations: usize,
}

impl BundleAdjustment {
    /// Minimises the Huber loss of all reprojection errors by Levenberg-Marquardt.
    pub fn solve(&mut self, rig: &RectifiedRig, max_iterations: usize) -> Summary {
        let free = self.numbered();
        let unknown_poses = free.iter().flatten().count();
        let by_point = self.observations_by_point();
        let mut reduced = Reduced::new(unknown_poses, self.coupled_poses(&free, &by_point));
        let before = self.cost(rig);
        let (mut current, mut lambda, mut iterations) = (before, 1e-4, 0);
        while iterations < max_iterations {
            iterations += 1;
            let Some((pose_steps, point_steps)) =
                self.step(rig, &free, &mut reduced, &by_point, lambda)
            else {
                lambda *= 10.0;
                continue;
            };
            let (old_poses, old_points) = (self.T_cam_world.clone(), self.points.clone());
            for (pose, slot) in self.T_cam_world.iter_mut().zip(&free) {
                if let Some(slot) = slot {
                    *pose = se3::exp(&pose_steps[*slot]) * *pose;
                    pose.rotation.renormalize();
                }
            }
            for (point, step) in self.points.iter_mut().zip(&point_steps) {
                *point += step;
            }
            let next = self.cost(rig);
            if next < current {
                let gained = current - next;
                (current, lambda) = (next, (lambda * 0.3).max(1e-9));
                if gained < 1e-4 * current {
                    break;
                }
            } else {
                (self.T_cam_world, self.points) = (old_poses, old_points);
                lambda *= 10.0;
                if lambda > 1e6 {
                    break;
                }
            }
        }
        Summary {
            before,
            after: current,
            iterations,
        }
    }

    /// The number of each pose that is free.
    fn numbered(&self) -> Vec<Option<usize>> {
        let number = |next: &mut usize, fixed: &bool| {
            let slot = (!fixed).then_some(*next);
            *next += usize::from(!fixed);
            Some(slot)
        };
        self.fixed.iter().scan(0, number).collect()
    }

    /// Squared residual of each observation in standard deviations; infinite behind the camera.
    pub fn squared_residuals(&self, rig: &RectifiedRig) -> Vec<f64> {
        let squared = |(pose, point, o): &(usize, usize, Observation)| {
            let p_cam = self.T_cam_world[*pose] * self.points[*point];
            o.residual(rig, &p_cam)
                .map_or(f64::INFINITY, |r| r.norm_squared())
        };
        self.observations.iter().map(squared).collect()
    }

    fn cost(&self, rig: &RectifiedRig) -> f64 {
        self.squared_residuals(rig)
            .into_iter()
            .map(|s| huber_cost(s.min(1e6), HUBER))
            .sum()
    }

    fn observations_by_point(&self) -> Vec<Vec<usize>> {
        let mut by_point = vec![Vec::new(); self.points.len()];
        for (i, (_, point, _)) in self.observations.iter().enumerate() {
            by_point[*point].push(i);
        }
        by_point
    }

    /// Free poses that see one point, all pairs of them.
    fn coupled_poses<'a>(
        &'a self,
        free: &'a [Option<usize>],
        by_point: &'a [Vec<usize>],
    ) -> impl Iterator<Item = (usize, usize)> + 'a {
        by_point.iter().flat_map(|sightings| {
            let slots: Vec<usize> = (sightings.iter())
                .filter_map(|i| free[self.observations[*i].0])
                .collect();
            let pairs =
                |(k, a): (usize, &usize)| slots[..k].iter().map(|b| (*a, *b)).collect::<Vec<_>>();
            slots.iter().enumerate().flat_map(pairs).collect::<Vec<_>>()
        })
    }

    /// One damped Gauss-Newton step. Points are eliminated one by one; what is left is a system over
    /// the free poses; points follow by back-substitution.
    fn step(
        &self,
        rig: &RectifiedRig,
        free: &[Option<usize>],
        reduced: &mut Reduced,
        by_point: &[Vec<usize>],
        lambda: f64,
    ) -> Option<Steps> {
        reduced.clear();
        let unknown_poses = free.iter().flatten().count();
        let mut right = vec![Vector6::<f64>::zeros(); unknown_poses];
        let mut poses = vec![(Matrix6::<f64>::zeros(), Vector6::<f64>::zeros()); unknown_poses];
        let rotations: Vec<Matrix3<f64>> = (self.T_cam_world.iter())
            .map(|pose| pose.rotation.to_rotation_matrix().into_inner())
            .collect();
        // Blocks between points and the free poses that see them, point after point.
        let mut coupled: Vec<(usize, Matrix6x3<f64>)> = Vec::with_capacity(self.observations.len());
        let mut eliminated = Vec::with_capacity(self.points.len());
        for (point, sightings) in by_point.iter().enumerate() {
            let mut h_point = Matrix3::<f64>::zeros();
            let mut g_point = Vector3::<f64>::zeros();
            let first = coupled.len();
            for i in sightings {
                let (pose, _, o) = &self.observations[*i];
                let p_cam = self.T_cam_world[*pose] * self.points[point];
                let Some(residual) = o.residual(rig, &p_cam) else {
                    continue;
                };
                let weight = huber_weight(residual.norm_squared(), HUBER);
                let projection = o.whiten(rig.projection_jacobian(&p_cam));
                let by_position = projection * rotations[*pose];
                let weighted = by_position * weight;
                h_point += weighted.tr_mul(&by_position);
                g_point += weighted.tr_mul(&residual);
                if let Some(slot) = free[*pose] {
                    let mut by_pose = Matrix3x6::<f64>::zeros();
                    by_pose.fixed_columns_mut::<3>(0).copy_from(&projection);
                    let by_turn = -projection * se3::skew(&p_cam.coords);
                    by_pose.fixed_columns_mut::<3>(3).copy_from(&by_turn);
                    let (h_pose, g_pose) = &mut poses[slot];
                    *h_pose += by_pose.tr_mul(&by_pose) * weight;
                    *g_pose += by_pose.tr_mul(&residual) * weight;
                    coupled.push((slot, by_pose.tr_mul(&weighted)));
                }
            }
            let damped =
                h_point + Matrix3::from_diagonal(&(h_point.diagonal() * lambda).add_scalar(1e-9));
            let Some(inverse) = damped.try_inverse() else {
                coupled.truncate(first);
                eliminated.push(None);
                continue;
            };
            let blocks = first..coupled.len();
            for (a, w_a) in &coupled[blocks.clone()] {
                let scaled = w_a * inverse;
                right[*a] -= scaled * g_point;
                for (b, w_b) in coupled[blocks.clone()].iter().filter(|(b, _)| b <= a) {
                    reduced.add(*a, *b, &-(scaled * w_b.transpose()));
                }
            }
            eliminated.push(Some((inverse, g_point, blocks)));
        }
        for (slot, (mut h_pose, g_pose)) in poses.into_iter().enumerate() {
            let damping = (h_pose.diagonal() * lambda).add_scalar(1e-9);
            h_pose += Matrix6::from_diagonal(&damping);
            reduced.add(slot, slot, &h_pose);
            right[slot] += g_pose;
        }
        let pose_steps = reduced.solve(&right)?;
        let point_steps = eliminated
            .into_iter()
            .map(|e| {
                e.map_or_else(Vector3::zeros, |(inverse, g_point, blocks)| {
                    let pulled: Vector3<f64> = coupled[blocks]
                        .iter()
                        .map(|(slot, w)| w.tr_mul(&pose_steps[*slot]))
                        .sum();
                    inverse * (g_point - pulled)
                })
            })
            .collect();
        Some((pose_steps, point_steps))
    }
}

/// The symmetric system over the poses that is left when points are eliminated: dense for the few of a local
/// map, which all see the same points; sparse for a whole map, where few do.
enum Reduced {
    /// Of it the lower triangle is filled, which is what the factorisation reads.
    Dense(DMatrix<f64>),
    Sparse(BlockCholesky),
}

impl Reduced {
    /// Most poses of a dense system.
    const DENSE: usize = 48;

    fn new(poses: usize, pairs: impl Iterator<Item = (usize, usize)>) -> Self {
        match poses {
            ..=Self::DENSE => Self::Dense(DMatrix::zeros(6 * poses, 6 * poses)),
            _ => Self::Sparse(BlockCholesky::new(poses, pairs)),
        }
    }

    fn clear(&mut self) {
        match self {
            Self::Dense(matrix) => matrix.fill(0.0),
            Self::Sparse(matrix) => matrix.clear(),
        }
    }

    /// Adds to the block at row `a` and column `b`, which is no greater.
    fn add(&mut self, a: usize, b: usize, block: &Matrix6<f64>) {
        match self {
            Self::Dense(matrix) => {
                let mut view = matrix.fixed_view_mut::<6, 6>(6 * a, 6 * b);
                view += block;
            }
            Self::Sparse(matrix) => matrix.add(a, b, block),
        }
    }

    /// `None` when it is not positive definite.
    fn solve(&mut self, right: &[Vector6<f64>]) -> Option<Vec<Vector6<f64>>> {
        let matrix = match self {
            Self::Sparse(matrix) => return matrix.solve(right),
            Self::Dense(_) if right.is_empty() => return Some(vec![]),
            Self::Dense(matrix) => matrix,
        };
        let flat = DVector::from_iterator(6 * right.len(), right.iter().flatten().copied());
        let solved = matrix.clone().cholesky()?.solve(&flat);
        let block = |k: usize| solved.fixed_rows::<6>(6 * k).into_owned();
        Some((0..right.len()).map(block).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::tests::{rig, world};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Six cameras along a path, all points seen by all that have them in view; no noise.
    fn problem() -> BundleAdjustment {
        let poses: Vec<Se3> = (0..6)
            .map(|i| {
                se3::exp(&Vector6::new(
                    0.05 * i as f64,
                    0.0,
                    -0.08 * i as f64,
                    0.0,
                    0.02 * i as f64,
                    0.0,
                ))
            })
            .collect();
        let points: Vec<Point3<f64>> = world(&poses[2], 120, 5).iter().map(|o| o.point).collect();
        let mut observations = Vec::new();
        for (i, pose) in poses.iter().enumerate() {
            for (j, point) in points.iter().enumerate() {
                if let Some(s) = rig()
                    .project(&(pose * point))
                    .filter(|s| s.u > 0.0 && s.u < 511.0 && s.v > 0.0 && s.v < 287.0)
                {
                    let d = (j % 4 != 0).then_some(s.d);
                    observations.push((
                        i,
                        j,
                        Observation {
                            point: *point,
                            u: s.u,
                            v: s.v,
                            d,
                            sigma: 1.0,
                            sigma_d: 1.0,
                        },
                    ));
                }
            }
        }
        let fixed = (0..6).map(|i| i == 0).collect();
        BundleAdjustment {
            T_cam_world: poses,
            fixed,
            points,
            observations,
        }
    }

    fn distance(a: &BundleAdjustment, b: &BundleAdjustment) -> f64 {
        let poses = a
            .T_cam_world
            .iter()
            .zip(&b.T_cam_world)
            .map(|(p, q)| se3::log(&(p.inverse() * q)).norm());
        let points = a.points.iter().zip(&b.points).map(|(p, q)| (p - q).norm());
        poses.chain(points).fold(0.0, f64::max)
    }

    #[test]
    fn the_truth_is_a_fixed_point() {
        let truth = problem();
        let mut solved = truth.clone();
        solved.solve(&rig(), 5);
        assert!(distance(&solved, &truth) < 1e-9);
    }

    #[test]
    fn the_sparse_system_gives_the_steps_of_the_dense_one() {
        let mut problem = problem();
        for (k, point) in problem.points.iter_mut().enumerate() {
            point.z += 0.02 * (k as f64).sin();
        }
        let (free, by_point) = (problem.numbered(), problem.observations_by_point());
        let pairs = || problem.coupled_poses(&free, &by_point);
        let mut dense = Reduced::new(5, pairs());
        let mut sparse = Reduced::Sparse(BlockCholesky::new(5, pairs()));
        let steps = |reduced| {
            let (poses, points) = problem
                .step(&rig(), &free, reduced, &by_point, 1e-4)
                .unwrap();
            let poses = poses.iter().flatten().copied();
            let all = poses.chain(points.iter().flatten().copied());
            all.collect::<Vec<f64>>()
        };
        let (dense, sparse) = (steps(&mut dense), steps(&mut sparse));
        let longest = dense.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        assert!(longest > 1e-3);
        for (a, b) in dense.iter().zip(&sparse) {
            assert!((a - b).abs() < 1e-9 * longest, "{a} {b}");
        }
    }

    #[test]
    fn a_perturbed_problem_returns_to_the_truth_despite_false_sightings() {
        let truth = problem();
        let mut disturbed = truth.clone();
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let mut jitter = |scale: f64| rng.random_range(-scale..scale);
        for pose in disturbed.T_cam_world.iter_mut().skip(1) {
            *pose = se3::exp(&Vector6::from_fn(|_, _| jitter(0.02))) * *pose;
        }
        for point in &mut disturbed.points {
            *point += Vector3::from_fn(|_, _| jitter(0.03));
        }
        let summary = disturbed.solve(&rig(), 40);
        assert!(summary.after < 1e-3 * summary.before, "{summary:?}");
        assert!(
            distance(&disturbed, &truth) < 1e-3,
            "{}",
            distance(&disturbed, &truth)
        );
        // Fixed poses do not move at all.
        assert_eq!(disturbed.T_cam_world[0], truth.T_cam_world[0]);

        // A twentieth of the sightings are false: Huber keeps them from deciding.
        let mut spoiled = truth.clone();
        for (i, (_, _, o)) in spoiled.observations.iter_mut().enumerate() {
            if i % 20 == 0 {
                o.u += 25.0;
            }
        }
        spoiled.solve(&rig(), 40);
        let poses = spoiled.T_cam_world.iter().zip(&truth.T_cam_world);
        let worst = poses
            .map(|(p, q)| se3::log(&(p.inverse() * q)).norm())
            .fold(0.0, f64::max);
        assert!(worst < 0.02, "{worst}");
    }
}
