//! Registration of clouds: iterative closest point.
//!
//! On smooth ground point-to-point registration stops anywhere, so the planes around points are matched
//! (Chen and Medioni 1992), or planes with planes (generalised ICP, Segal, Haehnel and Thrun 2009). A small
//! distance alone proves no alignment: the motion found stands beside it, and how much the shape of the
//! ground has to say.

use std::sync::OnceLock;

use nalgebra::{Matrix3, Matrix3x6, Matrix6, Point3, SymmetricEigen, Vector3, Vector6};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{KdTree, Se3, se3};

/// Why clouds cannot be brought together.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RegistrationError {
    /// A cloud is too small to be searched.
    #[error("a cloud of {points} finite points cannot be compared with: 6 are needed")]
    FewPoints {
        /// Its finite points.
        points: usize,
    },
    /// No place is known to both clouds.
    #[error(
        "{matched} of {points} points have one of the other cloud within {max_distance} m, and 6 are needed"
    )]
    NoOverlap {
        /// Points with a correspondence.
        matched: usize,
        /// Points of the estimate.
        points: usize,
        /// Largest distance of a correspondence, metres.
        max_distance: f64,
    },
}

/// What is brought together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum IcpMethod {
    /// Points of the estimate with planes of the reference.
    #[default]
    PointToPlane,
    /// Planes with planes.
    Generalised,
}

/// How clouds are registered.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct IcpConfig {
    /// What is brought together. Default points with planes.
    pub method: IcpMethod,
    /// Points farther apart than this do not correspond, metres. Default 0.5.
    pub max_distance: f64,
    /// Most iterations. Default 50.
    pub iterations: usize,
    /// Neighbours, the point itself among them, that make a plane. Default 20.
    pub neighbours: usize,
    /// A step of fewer metres, and of a tenth of that in radians, is the last. Default 1e-7, which is rest; an
    /// odometry needs no more than 1e-4.
    pub tolerance: f64,
}

impl Default for IcpConfig {
    fn default() -> Self {
        Self {
            method: IcpMethod::default(),
            max_distance: 0.5,
            iterations: 50,
            neighbours: 20,
            tolerance: 1e-7,
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
    /// Root mean square distance of what corresponds, metres.
    pub rmse: f64,
    /// How much the shape of the ground says of the shift in the direction that it says least of, as a share of what it
    /// says of the best known one (the eigenvalues of the normal equations, after Gelfand 2003): 0 where the
    /// clouds may slide.
    pub constraint: f64,
}

/// A cloud made ready to be searched.
pub struct Reference {
    points: Vec<Point3<f64>>,
    tree: KdTree,
}

impl Reference {
    /// # Errors
    /// When the cloud has fewer than six finite points.
    pub fn new(points: &[Point3<f64>]) -> Result<Self, RegistrationError> {
        let points = finite(points);
        if points.len() < 6 {
            return Err(RegistrationError::FewPoints {
                points: points.len(),
            });
        }
        let tree = KdTree::new(&points);
        Ok(Self { points, tree })
    }

    /// How many points it has.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether it has none, which `new` refuses.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Distance from `p` to the nearest point, metres; not a number for a point that is none.
    pub fn distance(&self, p: &Point3<f64>) -> f64 {
        self.nearest(p).1
    }

    /// Index of the nearest point, and its distance; not a number for a point that is none.
    fn nearest(&self, p: &Point3<f64>) -> (usize, f64) {
        let found = self.tree.nearest_one(p);
        found.map_or((0, f64::NAN), |f| (f.1, f.0.sqrt()))
    }

    /// The unit normal at a point: across the plane through its neighbours.
    fn normal(&self, index: usize, neighbours: usize) -> Vector3<f64> {
        let p = &self.points[index];
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
    }
}

/// [`register`] from afar: with all that lies within `config.max_distance`, and from there with what lies within a quarter of
/// it, so that what is far from the reference no longer draws.
///
/// # Errors
/// As [`register`].
pub fn register_from_afar(
    estimate: &[Point3<f64>],
    reference: &Reference,
    initial: &Se3,
    config: &IcpConfig,
) -> Result<Registration, RegistrationError> {
    let rough = register(estimate, reference, initial, config)?;
    let near = IcpConfig {
        max_distance: 0.25 * config.max_distance,
        ..*config
    };
    register(estimate, reference, &rough.T_ref_est, &near)
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
) -> Result<Registration, RegistrationError> {
    let estimate = finite(estimate);
    // Planes only where points correspond: of a large reference that may be little.
    let normals: Vec<OnceLock<Vector3<f64>>> = vec![OnceLock::new(); reference.len()];
    let normal_at =
        |index: usize| *normals[index].get_or_init(|| reference.normal(index, config.neighbours));
    let own_normals: Vec<Vector3<f64>> = match config.method {
        IcpMethod::PointToPlane => vec![],
        IcpMethod::Generalised => {
            let own = Reference::new(&estimate)?;
            let indices = (0..own.len()).into_par_iter();
            indices.map(|k| own.normal(k, config.neighbours)).collect()
        }
    };
    let mut T_ref_est = *initial;
    let (mut iterations, mut converged) = (0, false);
    let (mut overlap, mut rmse, mut constraint) = (0.0, 0.0, 0.0);
    while iterations < config.iterations && !converged {
        iterations += 1;
        let rotation = T_ref_est.rotation.to_rotation_matrix();
        let equations_of = |k: usize| {
            let p = rotation * estimate[k] + T_ref_est.translation.vector;
            let (index, distance) = reference.nearest(&p);
            if distance.is_nan() || distance > config.max_distance {
                return None;
            }
            let normal = normal_at(index);
            let error = p - reference.points[index];
            // A small motion (v, w) about the reference's origin moves p by v + w x p.
            let (a, b) = match config.method {
                IcpMethod::PointToPlane => {
                    let across = p.coords.cross(&normal);
                    let row = Vector6::from_fn(|i, _| match i {
                        0..3 => normal[i],
                        _ => across[i - 3],
                    });
                    (row * row.transpose(), row * normal.dot(&error))
                }
                IcpMethod::Generalised => {
                    let mut j = Matrix3x6::zeros();
                    j.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
                    j.fixed_view_mut::<3, 3>(0, 3)
                        .copy_from(&-p.coords.cross_matrix());
                    // What the error counts in each direction.
                    let own = rotation * own_normals[k];
                    let weight = (plane(&normal) + plane(&own)).try_inverse()?;
                    let weighted = j.transpose() * weight;
                    (weighted * j, weighted * error)
                }
            };
            Some(Equations {
                a,
                b,
                squares: error.norm_squared(),
                count: 1,
            })
        };
        // Sums of blocks, then their sum in order: the same bits on any number of threads.
        const BLOCK: usize = 1024;
        let blocks: Vec<Equations> = (0..estimate.len().div_ceil(BLOCK))
            .into_par_iter()
            .map(|b| b * BLOCK..((b + 1) * BLOCK).min(estimate.len()))
            .map(|block| block.filter_map(equations_of).sum())
            .collect();
        let sum: Equations = blocks.into_iter().sum();
        if sum.count < 6 {
            return Err(RegistrationError::NoOverlap {
                matched: sum.count,
                points: estimate.len(),
                max_distance: config.max_distance,
            });
        }
        overlap = sum.count as f64 / estimate.len() as f64;
        rmse = (sum.squares / sum.count as f64).sqrt();
        constraint = sum.constraint();
        let Some(step) = sum.a.cholesky().map(|c| -c.solve(&sum.b)) else {
            // The ground is one plane: nothing says how clouds lie along it.
            break;
        };
        T_ref_est = se3::exp(&step) * T_ref_est;
        // Where motions are chained and start from each other, an error of the norm would grow threefold each time.
        T_ref_est.rotation.renormalize();
        let far = T_ref_est.translation.vector.norm() + 1.0;
        converged = step.fixed_rows::<3>(0).norm() < config.tolerance * far
            && step.fixed_rows::<3>(3).norm() < 0.1 * config.tolerance;
    }
    Ok(Registration {
        T_ref_est,
        translation: T_ref_est.translation.vector.norm(),
        rotation_deg: T_ref_est.rotation.angle().to_degrees(),
        iterations,
        converged,
        overlap,
        rmse,
        constraint,
    })
}

/// Normal equations `a step = -b` of a Gauss-Newton step, over some correspondences.
#[derive(Default)]
struct Equations {
    a: Matrix6<f64>,
    b: Vector6<f64>,
    /// Sum of squared distances.
    squares: f64,
    count: usize,
}

impl Equations {
    /// See [`Registration::constraint`].
    fn constraint(&self) -> f64 {
        let shift = SymmetricEigen::new(self.a.fixed_view::<3, 3>(0, 0).into_owned()).eigenvalues;
        match shift.max() > 0.0 {
            true => (shift.min() / shift.max()).max(0.0),
            false => 0.0,
        }
    }
}

impl std::iter::Sum for Equations {
    fn sum<I: Iterator<Item = Self>>(items: I) -> Self {
        items.fold(Self::default(), |x, y| Self {
            a: x.a + y.a,
            b: x.b + y.b,
            squares: x.squares + y.squares,
            count: x.count + y.count,
        })
    }
}

/// The points that are some.
fn finite(points: &[Point3<f64>]) -> Vec<Point3<f64>> {
    let finite = |p: &&Point3<f64>| p.iter().all(|x| x.is_finite());
    points.iter().filter(finite).copied().collect()
}

/// The covariance of a point of a plane: sure across it, unsure along it (Segal 2009, with 1e-3).
fn plane(normal: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::identity() - normal * normal.transpose() * (1.0 - 1e-3)
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
            assert!(found.constraint > 1e-3, "{method:?}: hummocks hold clouds");
            // Neighbours of a cloud of 250 points a square metre are 3 cm apart.
            assert!(found.overlap > 0.99 && found.rmse < 0.04, "{found:?}");
        }
    }

    #[test]
    fn from_afar_ends_in_what_is_near() {
        let reference = Reference::new(&cloud(12_000, 0)).unwrap();
        let moved = Se3::new(
            Vector3::new(0.08, -0.05, 0.06),
            Vector3::new(0.01, -0.02, 0.03),
        );
        // A thing that stands half a metre above the ground, and that the reference does not have.
        let lifted = |(k, p): (usize, &Point3<f64>)| match k % 5 {
            0 => moved * (p + Vector3::new(0.0, 0.0, 0.5)),
            _ => moved * p,
        };
        let estimate: Vec<_> = cloud(5000, 50_000).iter().enumerate().map(lifted).collect();
        let config = IcpConfig {
            max_distance: 1.0,
            ..IcpConfig::default()
        };
        let off = |found: Registration| (found.T_ref_est * moved).translation.vector.norm();
        let once = off(register(&estimate, &reference, &Se3::identity(), &config).unwrap());
        let twice =
            off(register_from_afar(&estimate, &reference, &Se3::identity(), &config).unwrap());
        assert!(once > 0.05 && twice < 0.01, "{once} {twice}");
    }

    #[test]
    fn odd_clouds_do_no_harm() {
        let nan = Point3::new(f64::NAN, 0.0, 0.0);
        assert!(matches!(
            Reference::new(&[nan; 9]),
            Err(RegistrationError::FewPoints { points: 0 })
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
                    assert!(found.translation < 1e-6 && found.constraint < 1e-9);
                }
            }
        }
    }

    #[test]
    fn points_that_are_none_count_for_nothing() {
        let points = cloud(3000, 0);
        let reference = Reference::new(&points).unwrap();
        let mut holes = points[..900].to_vec();
        (0..300).for_each(|i| holes.insert(3 * i, Point3::new(f64::NAN, 0.0, 0.0)));
        for method in [IcpMethod::PointToPlane, IcpMethod::Generalised] {
            let config = IcpConfig {
                method,
                ..IcpConfig::default()
            };
            let shift = Se3::translation(0.02, 0.01, -0.02);
            let with = register(&holes, &reference, &shift, &config).unwrap();
            let without = register(&points[..900], &reference, &shift, &config).unwrap();
            assert_eq!(with, without, "{method:?}");
        }
    }
}
