//! How a camera moved between two images, up to the length of the way, from matches of which some are false.
#![allow(non_snake_case)] // A pose's name tells its frames: T_second_first.

use barchan_geometry::{Se3, se3};
use nalgebra::{Matrix3, Matrix6, Rotation3, UnitQuaternion, Vector2, Vector3, Vector6};
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;

use super::five_point::five_point;

/// A ray `(x/z, y/z)` in the first and in the second camera.
pub type RayPair = [Vector2<f64>; 2];

/// What [`relative_pose`] found.
#[derive(Clone, Debug)]
pub struct RelativePose {
    /// Maps points of the first camera to the second; its translation has length one.
    pub T_second_first: Se3,
    /// Which pairs agree with it.
    pub inliers: Vec<bool>,
}

impl RelativePose {
    /// The share of the pairs that agree.
    pub fn inlier_share(&self) -> f64 {
        let agree = self.inliers.iter().filter(|i| **i).count();
        agree as f64 / self.inliers.len().max(1) as f64
    }
}

/// The motion that pairs of rays agree with best: M-estimator sample consensus (Torr and Zisserman 2000)
/// over essential matrices of five pairs, which counts a pair's squared distance to its epipolar lines up to
/// that of `threshold`; of the four motions that an essential matrix may be, the one that puts most points
/// before both cameras (Hartley and Zisserman 2004, section 9.6.3); and that motion refined over all pairs that
/// agree. Five pairs of a flat ground, seen from two near places, leave a turn and a way that look alike
/// undecided: all pairs together decide.
///
/// `threshold` is in units of the rays: pixels by the focal length. `None` for fewer than five pairs, or when
/// no sample of five has a solution.
pub fn relative_pose(
    pairs: &[RayPair],
    threshold: f64,
    rng: &mut ChaCha8Rng,
) -> Option<RelativePose> {
    const FEWEST_SAMPLES: f64 = 50.0;
    const MOST_SAMPLES: f64 = 500.0;
    /// Chance that one sample at least is free of false matches.
    const CONFIDENCE: f64 = 0.9999;

    let limit = threshold * threshold;
    let mut best: Option<(f64, Matrix3<f64>)> = None;
    let (mut drawn, mut wanted) = (0.0, MOST_SAMPLES);
    while drawn < wanted {
        drawn += 1.0;
        let sample: Vec<RayPair> = pairs.sample(rng, 5).copied().collect();
        let sample: [RayPair; 5] = sample.try_into().ok()?;
        for essential in five_point(&sample) {
            let (cost, agree) = msac_cost(&essential, pairs, limit);
            if best.is_none_or(|(least, _)| cost < least) {
                best = Some((cost, essential));
                let all_true = (agree as f64 / pairs.len() as f64).powi(5);
                let needed = (1.0 - CONFIDENCE).ln() / (1.0 - all_true).ln().min(-1e-12);
                wanted = needed.clamp(FEWEST_SAMPLES, MOST_SAMPLES);
            }
        }
    }
    let (cost, essential) = best?;
    let agrees =
        |essential: &Matrix3<f64>, pair: &RayPair| sampson_squared(essential, pair) < limit;
    let agreeing: Vec<&RayPair> = pairs.iter().filter(|p| agrees(&essential, p)).collect();
    let in_front = |pose: &Se3| agreeing.iter().filter(|p| is_in_front(pose, p)).count();
    let sampled = motions(&essential)?.into_iter().max_by_key(in_front)?;
    let refined = refine(sampled, pairs, limit);
    let T_second_first = match msac_cost(&essential_of(&refined), pairs, limit).0 < cost {
        true => refined,
        false => sampled,
    };
    let essential = essential_of(&T_second_first);
    Some(RelativePose {
        T_second_first,
        inliers: pairs.iter().map(|pair| agrees(&essential, pair)).collect(),
    })
}

/// Sum of squared distances, each up to the limit, and how many are below it.
fn msac_cost(essential: &Matrix3<f64>, pairs: &[RayPair], limit: f64) -> (f64, usize) {
    let squared = pairs.iter().map(|pair| sampson_squared(essential, pair));
    squared.fold((0.0, 0), |(cost, agree), s| {
        (cost + s.min(limit), agree + usize::from(s < limit))
    })
}

/// `[t]x R`.
fn essential_of(T_second_first: &Se3) -> Matrix3<f64> {
    let rotation = T_second_first.rotation.to_rotation_matrix().into_inner();
    se3::skew(&T_second_first.translation.vector) * rotation
}

/// Gauss-Newton on the squared distances of the pairs below the limit, over the turn and the direction of the
/// way, whose length stays one.
fn refine(mut T_second_first: Se3, pairs: &[RayPair], limit: f64) -> Se3 {
    for _ in 0..10 {
        let essential = essential_of(&T_second_first);
        let way = T_second_first.translation.vector;
        let (mut hessian, mut gradient) = (Matrix6::<f64>::zeros(), Vector6::<f64>::zeros());
        for pair in pairs {
            let (residual, slope) = epipolar_residual(&essential, pair);
            if residual * residual < limit * slope {
                // x2 . (t x (R x1)): by the way R x1 x x2, by a turn of R x1 about itself R x1 x (x2 x t).
                let turned = T_second_first.rotation * pair[0].push(1.0);
                let second = pair[1].push(1.0);
                let mut jacobian = Vector6::zeros();
                jacobian
                    .fixed_rows_mut::<3>(0)
                    .copy_from(&turned.cross(&second));
                let by_turn = turned.cross(&second.cross(&way));
                jacobian.fixed_rows_mut::<3>(3).copy_from(&by_turn);
                hessian += jacobian * jacobian.transpose() / slope;
                gradient -= jacobian * residual / slope;
            }
        }
        // Along itself the way does not change.
        let mut along = hessian.fixed_view_mut::<3, 3>(0, 0);
        let strength = along.trace().max(1.0);
        along += way * way.transpose() * strength;
        let Some(step) = hessian.cholesky().map(|c| c.solve(&gradient)) else {
            break;
        };
        let moved = way + step.fixed_rows::<3>(0);
        let turn = UnitQuaternion::from_scaled_axis(step.fixed_rows::<3>(3).into_owned());
        let rotation = turn * T_second_first.rotation;
        T_second_first = Se3::from_parts(moved.normalize().into(), rotation);
        if step.norm() < 1e-9 {
            break;
        }
    }
    T_second_first
}

/// The squared distance of a pair of rays to the nearest pair that an essential matrix allows, to first order
/// (Sampson 1982).
fn sampson_squared(essential: &Matrix3<f64>, pair: &RayPair) -> f64 {
    let (residual, slope) = epipolar_residual(essential, pair);
    residual * residual / slope
}

/// `x2^T E x1`, and the squared length of its derivative by the four coordinates.
fn epipolar_residual(essential: &Matrix3<f64>, [first, second]: &RayPair) -> (f64, f64) {
    let (first, second) = (first.push(1.0), second.push(1.0));
    let line_in_second = essential * first;
    let line_in_first = essential.tr_mul(&second);
    let slope = line_in_second.xy().norm_squared() + line_in_first.xy().norm_squared();
    (second.dot(&line_in_second), slope.max(1e-300))
}

/// The four motions of an essential matrix.
fn motions(essential: &Matrix3<f64>) -> Option<[Se3; 4]> {
    let svd = essential.svd(true, true);
    let (mut u, mut v_t) = (svd.u?, svd.v_t?);
    // The sign of an essential matrix says nothing: both bases are made right-handed.
    u *= u.determinant().signum();
    v_t *= v_t.determinant().signum();
    let quarter = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    let direction: Vector3<f64> = u.column(2).into_owned();
    let motion = |turn: Matrix3<f64>, way: f64| {
        let rotation = Rotation3::from_matrix_unchecked(u * turn * v_t);
        let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
        Se3::from_parts((direction * way).into(), rotation)
    };
    let back = quarter.transpose();
    Some([
        motion(quarter, 1.0),
        motion(quarter, -1.0),
        motion(back, 1.0),
        motion(back, -1.0),
    ])
}

/// Whether the two rays meet before both cameras: the depths that bring them nearest are positive.
fn is_in_front(T_second_first: &Se3, [first, second]: &RayPair) -> bool {
    let a = T_second_first.rotation * first.push(1.0);
    let b = second.push(1.0);
    let t = T_second_first.translation.vector;
    // Least squares of depth_b b = depth_a a + t.
    let (aa, ab, bb) = (a.norm_squared(), a.dot(&b), b.norm_squared());
    let (at, bt) = (a.dot(&t), b.dot(&t));
    let determinant = aa * bb - ab * ab;
    let depth_a = (ab * bt - bb * at) / determinant;
    let depth_b = (aa * bt - ab * at) / determinant;
    depth_a > 0.0 && depth_b > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Point3, Vector6};
    use rand::{RngExt, SeedableRng};

    fn scene(motion: &Se3, count: usize, noise: f64, rng: &mut ChaCha8Rng) -> Vec<RayPair> {
        let mut number = |scale: f64| match scale > 0.0 {
            true => rng.random_range(-scale..scale),
            false => 0.0,
        };
        (0..count)
            .map(|_| {
                let point = Point3::new(number(3.0), number(2.0), 6.0 + number(3.0));
                [point, motion * point]
                    .map(|p| Vector2::new(p.x / p.z + number(noise), p.y / p.z + number(noise)))
            })
            .collect()
    }

    /// Angles of rotation and of the direction of the way, radians.
    fn errors(found: &Se3, truth: &Se3) -> [f64; 2] {
        let way = found.translation.vector.angle(&truth.translation.vector);
        [found.rotation.angle_to(&truth.rotation), way]
    }

    #[test]
    fn the_motion_is_found_among_two_fifths_of_false_matches() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for twist in [
            Vector6::new(0.5, 0.0, 0.1, 0.0, 0.1, 0.0),
            Vector6::new(0.0, 0.05, 0.6, 0.02, 0.0, 0.0),
            Vector6::new(-0.3, 0.3, -0.4, 0.1, -0.2, 0.3),
        ] {
            let motion = se3::exp(&twist);
            let mut pairs = scene(&motion, 200, 0.0003, &mut rng);
            for pair in pairs.iter_mut().take(80) {
                pair[1] += Vector2::new(rng.random_range(0.05..0.4), rng.random_range(0.05..0.4));
            }
            let found = relative_pose(&pairs, 0.0015, &mut rng).unwrap();
            let [turn, way] = errors(&found.T_second_first, &motion);
            assert!(turn < 0.001 && way < 0.01, "{twist}: {turn} {way}");
            assert!((found.T_second_first.translation.vector.norm() - 1.0).abs() < 1e-9);
            let kept = found.inliers[80..].iter().filter(|i| **i).count();
            let false_ones = found.inliers[..80].iter().filter(|i| **i).count();
            assert!(kept >= 114 && false_ones <= 8, "{kept} {false_ones}");
        }
    }

    /// A rover's view: flat ground below, a small way ahead, places to half a pixel.
    #[test]
    fn a_flat_ground_and_a_small_way_do_not_mislead() {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let motion = se3::exp(&Vector6::new(0.0, -0.05, -0.2, 0.0, 0.02, 0.0));
        let pairs: Vec<RayPair> = (0..300)
            .map(|_| {
                let depth = rng.random_range(1.5..6.0);
                let point = Point3::new(rng.random_range(-0.5..0.5) * depth, 0.8, depth);
                [point, motion * point].map(|p| {
                    let mut noise = || rng.random_range(-0.5..0.5) / 400.0;
                    Vector2::new(p.x / p.z + noise(), p.y / p.z + noise())
                })
            })
            .collect();
        let found = relative_pose(&pairs, 1.5 / 400.0, &mut rng).unwrap();
        let [turn, way] = errors(&found.T_second_first, &motion);
        assert!(turn < 0.003 && way < 0.05, "{turn} {way}");
    }

    #[test]
    fn exact_rays_give_the_exact_motion() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let motion = se3::exp(&Vector6::new(0.2, -0.1, 0.5, 0.1, 0.2, -0.1));
        let pairs = scene(&motion, 30, 0.0, &mut rng);
        let found = relative_pose(&pairs, 1e-6, &mut rng).unwrap();
        let [turn, way] = errors(&found.T_second_first, &motion);
        assert!(turn < 1e-6 && way < 1e-6, "{turn} {way}");
        assert_eq!(found.inlier_share(), 1.0);
    }

    #[test]
    fn four_pairs_say_nothing() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let pairs = scene(&Se3::translation(1.0, 0.0, 0.0), 4, 0.0, &mut rng);
        assert!(relative_pose(&pairs, 0.001, &mut rng).is_none());
        assert!(relative_pose(&[], 0.001, &mut rng).is_none());
    }
}
