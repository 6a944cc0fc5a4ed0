//! Poses tied by measured relative motion: a pose graph over SE(3) (Grisetti 2010).

use barchan_geometry::{Se3, se3};
use nalgebra::{Matrix6, Vector6};

use crate::block_cholesky::BlockCholesky;
use crate::pose::{HUBER, huber_cost, huber_weight};

/// One measured motion between two poses.
#[derive(Clone, Copy, Debug)]
#[allow(non_snake_case)]
pub struct PoseEdge {
    /// The pose it leads from.
    pub a: usize,
    /// The pose it leads to.
    pub b: usize,
    /// The motion: maps points of b to a.
    pub T_a_b: Se3,
    /// Standard deviation of the translation along each axis, metres.
    pub sigma_translation: f64,
    /// Standard deviation of the rotation about each axis, radians.
    pub sigma_rotation: f64,
    /// Whether it may be false: it then counts with Huber's loss.
    pub robust: bool,
}

/// A graph of poses.
#[derive(Clone, Debug, Default)]
#[allow(non_snake_case)]
pub struct PoseGraph {
    /// Poses; each maps points of its camera to the world.
    pub T_world_cam: Vec<Se3>,
    /// Which poses stay. At least one of each connected part must, or that part floats.
    pub fixed: Vec<bool>,
    /// Motions between them.
    pub edges: Vec<PoseEdge>,
}

impl PoseGraph {
    /// Minimises the squared errors of all edges in standard deviations, with Huber's loss for
    /// robust edges, by Levenberg-Marquardt. Robust edges that contradict the result by more than
    /// ten deviations are false: Huber's loss lets them pull still, so they go, and the rest is
    /// solved again.
    pub fn solve(&mut self, max_iterations: usize) {
        const CONTRADICTION: f64 = 10.0;
        self.minimise(max_iterations);
        let all = std::mem::take(&mut self.edges);
        let count = all.len();
        let holds = |e: &PoseEdge| !e.robust || self.error(e).norm() < CONTRADICTION;
        self.edges = all.into_iter().filter(holds).collect();
        if self.edges.len() < count {
            self.minimise(max_iterations);
        }
    }

    /// Covariance of each pose, zero for fixed ones: position and rotation vector, both along the axes
    /// of the world, as the edges' deviations make it. `None` when the edges do not hold all poses.
    pub fn covariances(&self) -> Option<Vec<Matrix6<f64>>> {
        let (free, mut system) = self.system();
        self.linearise(&free, &mut system);
        let blocks = system.inverse_diagonal()?;
        let in_world = |(pose, slot): (&Se3, &Option<usize>)| {
            // Poses were moved by T exp(xi): along the axes of the camera.
            let rotation = pose.rotation.to_rotation_matrix();
            let mut turn = Matrix6::zeros();
            for k in [0, 3] {
                let mut block = turn.fixed_view_mut::<3, 3>(k, k);
                block.copy_from(rotation.matrix());
            }
            slot.map_or_else(Matrix6::zeros, |k| turn * blocks[k] * turn.transpose())
        };
        Some(self.T_world_cam.iter().zip(&free).map(in_world).collect())
    }

    /// The number of each pose that is free, and the empty system for these.
    fn system(&self) -> (Vec<Option<usize>>, BlockCholesky) {
        let number = |next: &mut usize, fixed: &bool| {
            let slot = (!fixed).then_some(*next);
            *next += usize::from(!fixed);
            Some(slot)
        };
        let free: Vec<Option<usize>> = self.fixed.iter().scan(0, number).collect();
        let both = |e: &PoseEdge| Some((free[e.a]?, free[e.b]?));
        let pairs = self.edges.iter().filter_map(both);
        let system = BlockCholesky::new(free.iter().flatten().count(), pairs);
        (free, system)
    }

    fn minimise(&mut self, max_iterations: usize) {
        let (free, mut system) = self.system();
        let (mut current, mut lambda) = (self.cost(), 1e-6);
        for _ in 0..max_iterations {
            let gradient = self.linearise(&free, &mut system);
            system.damp(lambda);
            let Some(steps) = system.solve(&gradient) else {
                lambda *= 10.0;
                continue;
            };
            let old = self.T_world_cam.clone();
            for (pose, slot) in self.T_world_cam.iter_mut().zip(&free) {
                if let Some(slot) = slot {
                    *pose *= se3::exp(&-steps[*slot]);
                    pose.rotation.renormalize();
                }
            }
            let next = self.cost();
            if next < current {
                let gained = current - next;
                (current, lambda) = (next, (lambda * 0.1).max(1e-12));
                if gained < 1e-6 * current {
                    break;
                }
            } else {
                self.T_world_cam = old;
                lambda *= 10.0;
                if lambda > 1e6 {
                    break;
                }
            }
        }
    }

    /// What [`PoseGraph::solve`] minimises.
    pub fn cost(&self) -> f64 {
        let cost = |e: &PoseEdge| huber_cost(self.error(e).norm_squared(), e.huber());
        self.edges.iter().map(cost).sum()
    }

    /// Estimated against measured motion of an edge, in standard deviations.
    fn error(&self, edge: &PoseEdge) -> Vector6<f64> {
        let estimated = self.T_world_cam[edge.a].inverse() * self.T_world_cam[edge.b];
        edge.whiten(se3::log(&(edge.T_a_b.inverse() * estimated)))
    }

    /// Sums the Gauss-Newton matrix into `system` and gives half the gradient of the cost, for
    /// poses moved by `T exp(xi)`.
    fn linearise(&self, free: &[Option<usize>], system: &mut BlockCholesky) -> Vec<Vector6<f64>> {
        system.clear();
        let mut gradient = vec![Vector6::zeros(); free.iter().flatten().count()];
        for edge in &self.edges {
            let residual = self.error(edge);
            let weight = huber_weight(residual.norm_squared(), edge.huber());
            let [by_a, by_b] = self.jacobians(edge);
            for (slot, own) in [(free[edge.a], &by_a), (free[edge.b], &by_b)] {
                if let Some(k) = slot {
                    system.add(k, k, &(own.transpose() * own * weight));
                    gradient[k] += own.transpose() * residual * weight;
                }
            }
            if let (Some(a), Some(b)) = (free[edge.a], free[edge.b]) {
                system.add(a, b, &(by_a.transpose() * by_b * weight));
            }
        }
        gradient
    }

    /// Derivatives of [`PoseGraph::error`] with respect to the twists that move both poses, at zero.
    fn jacobians(&self, edge: &PoseEdge) -> [Matrix6<f64>; 2] {
        let estimated = self.T_world_cam[edge.a].inverse() * self.T_world_cam[edge.b];
        let error = se3::log(&(edge.T_a_b.inverse() * estimated));
        let by_b = inverse_right_jacobian(&error);
        let by_a = -by_b * adjoint(&estimated.inverse());
        [by_a, by_b].map(|mut jacobian| {
            for mut column in jacobian.column_iter_mut() {
                column.copy_from(&edge.whiten(column.clone_owned()));
            }
            jacobian
        })
    }
}

impl PoseEdge {
    fn whiten(&self, twist: Vector6<f64>) -> Vector6<f64> {
        let mut whitened = twist / self.sigma_translation;
        let rotation = twist.fixed_rows::<3>(3) / self.sigma_rotation;
        whitened.fixed_rows_mut::<3>(3).copy_from(&rotation);
        whitened
    }

    fn huber(&self) -> f64 {
        if self.robust { HUBER } else { f64::INFINITY }
    }
}

/// The matrix that carries a twist from one end of a motion to the other:
/// `T exp(xi) = exp(Ad xi) T` (Barfoot, State Estimation for Robotics, eq. 7.45).
fn adjoint(pose: &Se3) -> Matrix6<f64> {
    let rotation = pose.rotation.to_rotation_matrix();
    let mut matrix = Matrix6::zeros();
    for k in [0, 3] {
        let mut block = matrix.fixed_view_mut::<3, 3>(k, k);
        block.copy_from(rotation.matrix());
    }
    let lever = se3::skew(&pose.translation.vector) * rotation.matrix();
    matrix.fixed_view_mut::<3, 3>(0, 3).copy_from(&lever);
    matrix
}

/// How `log(exp(twist) exp(xi))` grows with `xi`: the series in the Bernoulli numbers (Barfoot, eq.
/// 7.80, for the right side). What is left away is under 1e-6 for errors up to a radian.
fn inverse_right_jacobian(twist: &Vector6<f64>) -> Matrix6<f64> {
    let (rho, phi) = (twist.fixed_rows::<3>(0), twist.fixed_rows::<3>(3));
    let (turn, lever) = (se3::skew(&phi.clone_owned()), se3::skew(&rho.clone_owned()));
    let mut ad = Matrix6::zeros();
    ad.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn);
    ad.fixed_view_mut::<3, 3>(3, 3).copy_from(&turn);
    ad.fixed_view_mut::<3, 3>(0, 3).copy_from(&lever);
    let squared = ad * ad;
    let fourth = squared * squared;
    Matrix6::identity() + ad / 2.0 + squared / 12.0 - fourth / 720.0 + fourth * squared / 30240.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn edge(a: usize, b: usize, motion: Se3) -> PoseEdge {
        PoseEdge {
            a,
            b,
            T_a_b: motion,
            sigma_translation: 0.02,
            sigma_rotation: 0.004,
            robust: false,
        }
    }

    /// Poses around a circle, edges between successive ones and one that closes the round.
    fn ring(count: usize, radius: f64) -> PoseGraph {
        let poses: Vec<Se3> = (0..count)
            .map(|k| {
                let angle = std::f64::consts::TAU * k as f64 / count as f64;
                let place = Vector3::new(angle.cos(), angle.sin(), 0.1 * angle.sin()) * radius;
                Se3::new(place, Vector3::z() * angle)
            })
            .collect();
        let motion = |a: usize, b: usize| edge(a, b, poses[a].inverse() * poses[b]);
        let mut edges: Vec<PoseEdge> = (1..count).map(|k| motion(k - 1, k)).collect();
        edges.push(PoseEdge {
            robust: true,
            ..motion(0, count - 1)
        });
        PoseGraph {
            fixed: (0..count).map(|k| k == 0).collect(),
            T_world_cam: poses,
            edges,
        }
    }

    /// Follows the first edges of a ring from its first pose: dead reckoning.
    fn dead_reckoned(mut graph: PoseGraph) -> PoseGraph {
        for k in 1..graph.T_world_cam.len() {
            graph.T_world_cam[k] = graph.T_world_cam[k - 1] * graph.edges[k - 1].T_a_b;
        }
        graph
    }

    fn worst(a: &PoseGraph, b: &PoseGraph) -> f64 {
        let distance = |(p, q): (&Se3, &Se3)| (p.inverse() * q).translation.vector.norm();
        let pairs = a.T_world_cam.iter().zip(&b.T_world_cam);
        pairs.map(distance).fold(0.0, f64::max)
    }

    fn jitter(rng: &mut ChaCha8Rng, scale: f64) -> Se3 {
        se3::exp(&Vector6::from_fn(|_, _| rng.random_range(-scale..scale)))
    }

    #[test]
    fn jacobians_and_gradient_match_finite_differences() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut graph = ring(5, 2.0);
        for pose in &mut graph.T_world_cam {
            *pose *= jitter(&mut rng, 0.3);
        }
        let free: Vec<Option<usize>> = (0..5).map(Some).collect();
        let pairs: Vec<_> = graph.edges.iter().map(|e| (e.a, e.b)).collect();
        let mut system = BlockCholesky::new(5, pairs.into_iter());
        let gradient = graph.linearise(&free, &mut system);
        let moved = |k: usize, axis: usize, by: f64| {
            let mut twist = Vector6::zeros();
            twist[axis] = by;
            let mut graph = graph.clone();
            graph.T_world_cam[k] *= se3::exp(&twist);
            graph
        };
        for axis in 0..6 {
            for edge in &graph.edges {
                for (pose, analytic) in [edge.a, edge.b].into_iter().zip(graph.jacobians(edge)) {
                    let [plus, minus] = [1e-6, -1e-6].map(|by| moved(pose, axis, by).error(edge));
                    let numeric = (plus - minus) / 2e-6;
                    let difference = (numeric - analytic.column(axis)).norm();
                    assert!(difference < 1e-5 * (1.0 + numeric.norm()), "{difference}");
                }
            }
            for (k, half) in gradient.iter().enumerate() {
                let [plus, minus] = [1e-6, -1e-6].map(|by| moved(k, axis, by).cost());
                let numeric = (plus - minus) / 2e-6;
                let difference = (numeric - 2.0 * half[axis]).abs();
                assert!(difference < 1e-4 * (1.0 + numeric.abs()), "{k} {axis}");
            }
        }
    }

    #[test]
    fn a_graph_without_noise_is_recovered_exactly() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let truth = ring(60, 8.0);
        let mut disturbed = truth.clone();
        for pose in disturbed.T_world_cam.iter_mut().skip(1) {
            *pose *= jitter(&mut rng, 0.3);
        }
        assert!(disturbed.cost() > 1e3);
        disturbed.solve(50);
        assert!(disturbed.cost() < 1e-9, "{}", disturbed.cost());
        assert!(worst(&disturbed, &truth) < 1e-6);
        assert_eq!(disturbed.T_world_cam[0], truth.T_world_cam[0]);
    }

    #[test]
    fn drift_is_spread_over_the_whole_loop() {
        let truth = ring(100, 10.0);
        let mut drifted = truth.clone();
        // A gyroscope that is off by a little, always the same.
        for edge in drifted.edges.iter_mut().take(99) {
            edge.T_a_b *= Se3::rotation(Vector3::new(0.0, 0.0004, 0.0008));
        }
        let mut drifted = dead_reckoned(drifted);
        let before = worst(&drifted, &truth);
        drifted.solve(50);
        let after = worst(&drifted, &truth);
        assert!(after < 0.1 * before, "{before} -> {after}");
        // Each edge takes its share, none takes it all.
        let errors: Vec<f64> = drifted.edges[..99]
            .iter()
            .map(|e| drifted.error(e).norm())
            .collect();
        let mean = errors.iter().sum::<f64>() / 99.0;
        assert!(errors.iter().all(|e| (0.3..3.0).contains(&(e / mean))));
    }

    #[test]
    fn a_false_loop_edge_does_not_bend_what_many_true_ones_hold() {
        let truth = ring(80, 8.0);
        let poses = &truth.T_world_cam;
        let mut graph = truth.clone();
        // A second lap's worth of true loop edges, and one that is false by metres.
        graph.edges.extend((0..30).map(|k| PoseEdge {
            robust: true,
            ..edge(k, 79 - k, poses[k].inverse() * poses[79 - k])
        }));
        graph.edges.push(PoseEdge {
            robust: true,
            ..edge(5, 40, Se3::translation(1.0, 2.0, 0.0))
        });
        graph.solve(50);
        assert!(worst(&graph, &truth) < 1e-6, "{}", worst(&graph, &truth));
        assert_eq!(graph.edges.len(), truth.edges.len() + 30);
    }

    #[test]
    fn thousands_of_poses_are_solved() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let truth = ring(5000, 50.0);
        let poses = &truth.T_world_cam;
        let mut graph = truth.clone();
        graph.edges.extend((0..500).map(|k| PoseEdge {
            robust: true,
            ..edge(k, 4999 - k, poses[k].inverse() * poses[4999 - k])
        }));
        for pose in graph.T_world_cam.iter_mut().skip(1) {
            *pose *= jitter(&mut rng, 0.02);
        }
        graph.solve(20);
        assert!(worst(&graph, &truth) < 1e-5, "{}", worst(&graph, &truth));
    }
}
