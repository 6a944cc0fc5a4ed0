//! Rigid motion: exponential and logarithm of SE(3), after Barfoot, State Estimation for Robotics, ch. 7.

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector3, Vector6};

/// A rigid motion. A value named `T_a_b` maps points of frame b to frame a.
pub type Se3 = Isometry3<f64>;

/// The cross-product matrix `[v]x`.
pub fn skew(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// Left Jacobian of SO(3): integrates a rotation vector's effect on a translation.
pub fn left_jacobian(phi: &Vector3<f64>) -> Matrix3<f64> {
    let angle2 = phi.norm_squared();
    let k = skew(phi);
    // Below 1e-4 rad the closed form cancels; the series is exact to f64 there.
    let (a, b) = if angle2 < 1e-8 {
        (0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0)
    } else {
        let angle = angle2.sqrt();
        (
            (1.0 - angle.cos()) / angle2,
            (angle - angle.sin()) / (angle2 * angle),
        )
    };
    Matrix3::identity() + k * a + k * k * b
}

/// Exponential of a twist (translation first, then rotation vector).
pub fn exp(twist: &Vector6<f64>) -> Se3 {
    let rho = twist.fixed_rows::<3>(0).into_owned();
    let phi = twist.fixed_rows::<3>(3).into_owned();
    Se3::from_parts(
        Translation3::from(left_jacobian(&phi) * rho),
        UnitQuaternion::from_scaled_axis(phi),
    )
}

/// Logarithm: the twist whose [`exp`] is `pose`.
pub fn log(pose: &Se3) -> Vector6<f64> {
    let phi = pose.rotation.scaled_axis();
    // The left Jacobian is singular only at a full turn, which scaled_axis never returns.
    let rho = left_jacobian(&phi)
        .lu()
        .solve(&pose.translation.vector)
        .unwrap_or(pose.translation.vector);
    Vector6::new(rho.x, rho.y, rho.z, phi.x, phi.y, phi.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_inverts_exp_from_tiny_to_large_angles() {
        for scale in [1e-9, 1e-5, 1e-4, 1e-2, 0.5, 3.0] {
            let twist = Vector6::new(0.3, -0.2, 0.9, 0.4, -0.6, 0.5) * scale;
            let back = log(&exp(&twist));
            assert!(
                (back - twist).norm() <= 1e-12 * scale.max(1.0),
                "{scale}: {back} {twist}"
            );
        }
    }

    #[test]
    fn exp_of_a_sum_along_one_axis_composes() {
        let twist = Vector6::new(0.1, 0.2, 0.3, 0.05, -0.02, 0.4);
        let whole = exp(&twist);
        let halves = exp(&(twist * 0.5)) * exp(&(twist * 0.5));
        assert!((whole.to_homogeneous() - halves.to_homogeneous()).norm() < 1e-12);
    }
}
