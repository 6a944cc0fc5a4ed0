//! Clouds against true ones: registration (iterative closest point) and distances (Hong 2021, 4.3).
//!
//! On smooth ground point-to-point registration stops anywhere, so the planes around points are matched
//! (Chen and Medioni 1992), or planes with planes (generalised ICP, Segal, Haehnel and Thrun 2009). A small
//! distance alone proves no alignment: the motion found stands beside it.

use barchan_geometry::Se3;
use barchan_geometry::nalgebra::{
    Matrix3, Matrix3x6, Matrix6, Point3, SymmetricEigen, Vector3, Vector6,
};
use barchan_geometry::se3;
use rayon::prelude::*;
use serde::Serialize;

use crate::EvalError;
use crate::elevation::quantile;
use crate::kd_tree::KdTree;

/// What is brought together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum IcpMethod {
    /// Points of the estimate with planes of the reference.
    #[default]
    PointToPlane,
    /// Planes with planes.
    Generalised,
}

/// How clouds are registered.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IcpConfig {
    /// What is brought together. Default points with planes.
    pub method: IcpMethod,
    /// Points farther apart than this do not correspond, metres. Default 0.5.
    pub max_distance: f64,
    /// Most iterations. Default 50.
    pub iterations: usize,
    /// Neighbours, the point itself among them, that make a plane. Default 20.
    pub neighbours: usize,
}

impl Default for IcpConfig {
    fn default() -> Self {
        Self {
            method: IcpMethod::default(),
            max_distance: 0.5,
            iterations: 50,
            neighbours: 20,
        }
    }
}

/// What registration found.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[allow(non_snake_case)]
pub struct Registration {
    /// Maps points of the estimate to the reference.
    #[serde(skip)]
    pub T_ref_est: Se3,
    /// Its shift, metres.
    pub translation: f64,
    /// Its angle, degrees.
    pub rotation_deg: f64,
    /// Iterations made.
    pub iterations: usize,
    /// Whether it came to rest.
    pub converged: bool,
    /// Share of the estimate that corresponds to something.
    pub overlap: f64,
}

/// Distances of the points of a cloud to the nearest points of another, metres.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CloudScore {
    /// Points of the estimate.
    pub points: usize,
    /// Share of them that lies within the largest distance of the reference: the rest is left out.
    pub overlap: f64,
    /// Root of the mean square.
    pub rmse: f64,
    /// Mean.
    pub mean: f64,
    /// Half are nearer.
    pub p50: f64,
    /// 68 % are nearer.
    pub p68: f64,
    /// 95 % are nearer.
    pub p95: f64,
    /// Share within 0.5 m, the figure of Hong 2021.
    pub within_half_metre: f64,
    /// Shares in steps of 2 cm, the last open (Hong 2021, figure 10).
    pub histogram: Vec<f64>,
}

/// A cloud made ready to be searched.
pub struct Reference {
    points: Vec<Point3<f64>>,
    tree: KdTree,
}

impl Reference {
    /// # Errors
    /// When the cloud has fewer than six finite points.
    pub fn new(points: &[Point3<f64>]) -> Result<Self, EvalError> {
        let points: Vec<Point3<f64>> = points
            .iter()
            .copied()
            .filter(|p| p.iter().all(|x| x.is_finite()))
            .collect();
        if points.len() < 6 {
            return Err(EvalError::FewPoints {
                points: points.len(),
            });
        }
        let tree = KdTree::new(&points);
        Ok(Self { points, tree })
    }

    /// Index of the nearest point, and its distance; not a number for a point that is none.
    fn nearest(&self, p: &Point3<f64>) -> (usize, f64) {
        let found = self.tree.nearest(p, 1);
        found.first().map_or((0, f64::NAN), |f| (f.1, f.0.sqrt()))
    }

    /// The unit normal at every point: across the plane through its neighbours.
    fn normals(&self, neighbours: usize) -> Vec<Vector3<f64>> {
        let normal = |p: &Point3<f64>| {
            let near = self.tree.nearest(p, neighbours.max(3));
            let n = near.len() as f64;
            // From the point itself: coordinates may be large.
            let offsets = || near.iter().map(|f| self.points[f.1] - p);
            let mean = offsets().sum::<Vector3<f64>>() / n;
            let spread = offsets().fold(Matrix3::zeros(), |sum, o| {
                sum + (o - mean) * (o - mean).transpose()
            });
            let eigen = SymmetricEigen::new(spread);
            eigen.eigenvectors.column(eigen.eigenvalues.imin()).into()
        };
        self.points.par_iter().map(normal).collect()
    }
}

/// Finds the motion that brings `estimate` onto `reference`, from `initial` on: Gauss-Newton steps on
/// the distances between corresponding points, found anew each time.
///
/// # Errors
/// When a cloud has too few points, or fewer than six correspond.
#[allow(non_snake_case)]
pub fn register(
    estimate: &[Point3<f64>],
    reference: &Reference,
    initial: &Se3,
    config: &IcpConfig,
) -> Result<Registration, EvalError> {
    let normals = reference.normals(config.neighbours);
    let own_normals = match config.method {
        IcpMethod::PointToPlane => vec![],
        IcpMethod::Generalised => Reference::new(estimate)?.normals(config.neighbours),
    };
    let mut T_ref_est = *initial;
    let (mut iterations, mut converged, mut overlap) = (0, false, 0.0);
    while iterations < config.iterations && !converged {
        iterations += 1;
        let rotation = T_ref_est.rotation.to_rotation_matrix();
        let equations = estimate.par_iter().enumerate().filter_map(|(k, p)| {
            let p = rotation * p + T_ref_est.translation.vector;
            let (index, distance) = reference.nearest(&p);
            if distance.is_nan() || distance > config.max_distance {
                return None;
            }
            let (q, normal) = (reference.points[index], normals[index]);
            // What the error counts in each direction.
            let weight = match config.method {
                IcpMethod::PointToPlane => normal * normal.transpose(),
                IcpMethod::Generalised => {
                    let own = rotation * own_normals[k];
                    (plane(&normal) + plane(&own)).try_inverse()?
                }
            };
            let error = p - q;
            // A small motion (v, w) about the reference's origin moves p by v + w x p.
            let mut j = Matrix3x6::zeros();
            j.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
            j.fixed_view_mut::<3, 3>(0, 3)
                .copy_from(&-p.coords.cross_matrix());
            let weighted = j.transpose() * weight;
            Some((weighted * j, weighted * error, 1usize))
        });
        let (a, b, count) = equations.reduce(
            || (Matrix6::zeros(), Vector6::zeros(), 0),
            |x, y| (x.0 + y.0, x.1 + y.1, x.2 + y.2),
        );
        overlap = count as f64 / estimate.len() as f64;
        if count < 6 {
            return Err(EvalError::NoOverlap {
                truth: reference.points.len(),
            });
        }
        let Some(step) = a.cholesky().map(|c| -c.solve(&b)) else {
            // The ground is one plane: nothing says how clouds lie along it.
            break;
        };
        T_ref_est = se3::exp(&step) * T_ref_est;
        let far = T_ref_est.translation.vector.norm() + 1.0;
        converged =
            step.fixed_rows::<3>(0).norm() < 1e-7 * far && step.fixed_rows::<3>(3).norm() < 1e-8;
    }
    Ok(Registration {
        T_ref_est,
        translation: T_ref_est.translation.vector.norm(),
        rotation_deg: T_ref_est.rotation.angle().to_degrees(),
        iterations,
        converged,
        overlap,
    })
}

/// The covariance of a point of a plane: sure across it, unsure along it (Segal 2009, with 1e-3).
fn plane(normal: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::identity() - normal * normal.transpose() * (1.0 - 1e-3)
}

/// Distances of `estimate` to `reference`, of those points that lie within `max_distance` of it.
///
/// # Errors
/// When none does.
pub fn score(
    estimate: &[Point3<f64>],
    reference: &Reference,
    max_distance: f64,
) -> Result<CloudScore, EvalError> {
    let mut distances: Vec<f64> = estimate
        .par_iter()
        .map(|p| reference.nearest(p).1)
        .filter(|d| *d <= max_distance)
        .collect();
    if distances.is_empty() {
        return Err(EvalError::NoOverlap {
            truth: reference.points.len(),
        });
    }
    distances.sort_unstable_by(f64::total_cmp);
    let n = distances.len() as f64;
    let mut histogram = vec![0.0; 51];
    for d in &distances {
        histogram[((d / 0.02) as usize).min(50)] += 1.0 / n;
    }
    Ok(CloudScore {
        points: estimate.len(),
        overlap: n / estimate.len() as f64,
        rmse: (distances.iter().map(|d| d * d).sum::<f64>() / n).sqrt(),
        mean: distances.iter().sum::<f64>() / n,
        p50: quantile(&distances, 0.5),
        p68: quantile(&distances, 0.68),
        p95: quantile(&distances, 0.95),
        within_half_metre: distances.partition_point(|d| *d < 0.5) as f64 / n,
        histogram,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ground(x: f64, y: f64) -> f64 {
        0.4 * (1.1 * x).sin() * (0.8 * y).cos() + 0.1 * (2.3 * x + y).sin()
    }

    /// Points of the ground, scattered by a low-discrepancy sequence.
    fn cloud(n: usize, start: usize) -> Vec<Point3<f64>> {
        let share = |i: usize, a: f64| (i as f64 * a).fract();
        (start..start + n)
            .map(|i| (8.0 * share(i, 0.754_877_666), 6.0 * share(i, 0.569_840_296)))
            .map(|(x, y)| Point3::new(x, y, ground(x, y)))
            .collect()
    }

    #[test]
    fn a_moved_cloud_is_brought_back_by_both_methods() {
        let reference = Reference::new(&cloud(12_000, 0)).unwrap();
        let moved = Se3::new(
            Vector3::new(0.08, -0.05, 0.06),
            Vector3::new(0.01, -0.02, 0.03),
        );
        let estimate: Vec<_> = cloud(5000, 50_000).iter().map(|p| moved * p).collect();
        for method in [IcpMethod::PointToPlane, IcpMethod::Generalised] {
            let config = IcpConfig {
                method,
                ..IcpConfig::default()
            };
            let found = register(&estimate, &reference, &Se3::identity(), &config).unwrap();
            let off = found.T_ref_est * moved;
            assert!(found.converged, "{method:?}: {}", found.iterations);
            assert!(off.translation.vector.norm() < 3e-3, "{method:?}: {off}");
            assert!(off.rotation.angle() < 1e-3, "{method:?}: {off}");
        }
    }

    #[test]
    fn distances_are_those_to_the_nearest_points() {
        let grid: Vec<_> = (0..100)
            .map(|i| Point3::new(f64::from(i % 10), f64::from(i / 10), 0.0))
            .collect();
        let reference = Reference::new(&grid).unwrap();
        let above = |h: f64| Point3::new(3.0, 4.0, h);
        let estimate = [above(0.03), above(-0.05), above(0.6), above(50.0)];
        let s = score(&estimate, &reference, 1.0).unwrap();
        assert_eq!((s.points, s.overlap), (4, 0.75));
        assert!((s.mean - 0.68 / 3.0).abs() < 1e-12 && (s.p50 - 0.05).abs() < 1e-12);
        assert!((s.within_half_metre - 2.0 / 3.0).abs() < 1e-12);
        assert!((s.histogram[1] - 1.0 / 3.0).abs() < 1e-12);
        assert!(score(&[above(9.0)], &reference, 1.0).is_err());
    }

    #[test]
    fn odd_clouds_do_no_harm() {
        let nan = Point3::new(f64::NAN, 0.0, 0.0);
        assert!(matches!(
            Reference::new(&[nan; 9]),
            Err(EvalError::FewPoints { points: 0 })
        ));
        // All at one place, all in one plane: no answer, and no harm.
        let same = vec![Point3::new(1.0, 2.0, 3.0); 500];
        let flat: Vec<_> = (0..400)
            .map(|i| Point3::new(f64::from(i % 20), f64::from(i / 20), 0.0))
            .collect();
        for points in [same, flat] {
            if let Ok(reference) = Reference::new(&points) {
                let config = IcpConfig::default();
                if let Ok(found) = register(&points, &reference, &Se3::identity(), &config) {
                    assert!(found.translation < 1e-6);
                }
            }
        }
    }
}
