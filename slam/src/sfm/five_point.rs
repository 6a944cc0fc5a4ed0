//! Essential matrices from five pairs of rays (Nister 2004).

use nalgebra::{Matrix3, SMatrix, SVector, Vector2, Vector3};

/// Powers of (x, y, z) in each monomial, in the order of Nister 2004, section 3.2.1.
const MONOMIALS: [[usize; 3]; 20] = [
    [3, 0, 0],
    [0, 3, 0],
    [2, 1, 0],
    [1, 2, 0],
    [2, 0, 1],
    [2, 0, 0],
    [0, 2, 1],
    [0, 2, 0],
    [1, 1, 1],
    [1, 1, 0],
    [1, 0, 2],
    [1, 0, 1],
    [1, 0, 0],
    [0, 1, 2],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 3],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];

/// Where x, y, z and 1 stand among the monomials.
const LINEAR: [usize; 4] = [12, 15, 18, 19];

/// The monomial that each one becomes when multiplied by x, y, z or 1; 20 where the degree is too high.
const PRODUCT: [[usize; 4]; 20] = {
    let mut table = [[20; 4]; 20];
    let mut i = 0;
    while i < 20 {
        let mut by = 0;
        while by < 4 {
            let mut powers = MONOMIALS[i];
            if by < 3 {
                powers[by] += 1;
            }
            let mut j = 0;
            while j < 20 {
                let m = MONOMIALS[j];
                if m[0] == powers[0] && m[1] == powers[1] && m[2] == powers[2] {
                    table[i][by] = j;
                }
                j += 1;
            }
            by += 1;
        }
        i += 1;
    }
    table
};

/// A polynomial of degree three at most in x, y and z: a coefficient for each monomial.
type Polynomial = SVector<f64, 20>;

/// A polynomial, at most quadratic, times a linear one.
fn times(a: &Polynomial, linear: &Polynomial) -> Polynomial {
    let mut product = Polynomial::zeros();
    for (i, value) in a.iter().enumerate().filter(|(_, value)| **value != 0.0) {
        for (by, at) in LINEAR.into_iter().enumerate() {
            if let Some(sum) = product.get_mut(PRODUCT[i][by]) {
                *sum += value * linear[at];
            }
        }
    }
    product
}

/// The matrices `E` with `x_second^T E x_first = 0` for five pairs of rays `(x/z, y/z)`, at most ten.
///
/// The four-dimensional null space of the five equations is `E = x X + y Y + z Z + W`; that `E` is an
/// essential matrix, `det E = 0` and `2 E E^T E = tr(E E^T) E`, are ten cubic equations in (x, y, z), which
/// elimination brings to one of degree ten in z (Nister 2004, section 3.2).
pub fn five_point(pairs: &[[Vector2<f64>; 2]; 5]) -> Vec<Matrix3<f64>> {
    if !pairs.iter().flatten().flatten().all(|v| v.is_finite()) {
        return Vec::new();
    }
    // The null space: right singular vectors of the smallest singular values.
    let mut equations = SMatrix::<f64, 9, 9>::zeros();
    for (row, [first, second]) in pairs.iter().enumerate() {
        let outer = second.push(1.0) * first.push(1.0).transpose();
        equations
            .row_mut(row)
            .copy_from_slice(outer.transpose().as_slice());
    }
    let Some(v_t) = equations.svd(false, true).v_t else {
        return Vec::new();
    };
    let basis: [Matrix3<f64>; 4] =
        std::array::from_fn(|k| Matrix3::from_row_iterator(v_t.row(5 + k).iter().copied()));

    // The ten cubic equations.
    let entry = |row: usize, column: usize| {
        let mut linear = Polynomial::zeros();
        for (at, matrix) in LINEAR.into_iter().zip(&basis) {
            linear[at] = matrix[(row, column)];
        }
        linear
    };
    let e: [[Polynomial; 3]; 3] =
        std::array::from_fn(|row| std::array::from_fn(|column| entry(row, column)));
    let squared: [[Polynomial; 3]; 3] = std::array::from_fn(|i| {
        std::array::from_fn(|j| (0..3).map(|k| times(&e[i][k], &e[j][k])).sum())
    });
    let half_trace = (squared[0][0] + squared[1][1] + squared[2][2]) * 0.5;
    let mut cubic = SMatrix::<f64, 10, 20>::zeros();
    for i in 0..3 {
        for j in 0..3 {
            let product: Polynomial = (0..3).map(|k| times(&squared[i][k], &e[k][j])).sum();
            let constraint = product - times(&half_trace, &e[i][j]);
            cubic.row_mut(3 * i + j).tr_copy_from(&constraint);
        }
    }
    let minor = |a: usize, b: usize| times(&e[1][a], &e[2][b]) - times(&e[1][b], &e[2][a]);
    let determinant = times(&minor(1, 2), &e[0][0]) - times(&minor(0, 2), &e[0][1])
        + times(&minor(0, 1), &e[0][2]);
    cubic.row_mut(9).tr_copy_from(&determinant);

    // Elimination leaves three equations, linear in x, y and 1, with polynomials of z as coefficients.
    let Some(reduced) = cubic
        .fixed_columns::<10>(0)
        .into_owned()
        .lu()
        .solve(&cubic.fixed_columns::<10>(10).into_owned())
    else {
        return Vec::new();
    };
    // Of rows x^2 z and x^2, y^2 z and y^2, x y z and x y: the first less z times the second.
    let linear: [[Vec<f64>; 3]; 3] = std::array::from_fn(|k| {
        let (with_z, without) = (reduced.row(4 + 2 * k), reduced.row(5 + 2 * k));
        std::array::from_fn(|unknown| {
            // Columns x z^2, x z, x; y z^2, y z, y; z^3, z^2, z, 1: highest power first.
            let (first, powers) = [(0, 3), (3, 3), (6, 4)][unknown];
            let mut ascending = vec![0.0; powers + 1];
            for p in 0..powers {
                ascending[powers - 1 - p] += with_z[first + p];
                ascending[powers - p] -= without[first + p];
            }
            ascending
        })
    });
    let cofactor = |a: usize, b: usize| {
        let [left, right] = [(a, b), (b, a)].map(|(p, q)| multiply(&linear[1][p], &linear[2][q]));
        subtract(left, &right)
    };
    let terms =
        [(0, 1, 2), (1, 2, 0), (2, 0, 1)].map(|(k, a, b)| multiply(&linear[0][k], &cofactor(a, b)));
    let mut in_z = vec![0.0; 11];
    for (power, value) in terms.iter().flat_map(|t| t.iter().enumerate()) {
        in_z[power] += value;
    }

    real_roots(&in_z)
        .into_iter()
        .filter_map(|z| {
            // (x, y, 1) is at right angles to the three rows: the cross product of two that differ most.
            let rows: [Vector3<f64>; 3] = std::array::from_fn(|k| {
                Vector3::from_fn(|unknown, _| evaluate(&linear[k][unknown], z))
            });
            let normal = [(0, 1), (0, 2), (1, 2)]
                .map(|(a, b)| rows[a].cross(&rows[b]))
                .into_iter()
                .max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))?;
            let (x, y) = (normal.x / normal.z, normal.y / normal.z);
            let [of_x, of_y, of_z, of_1] = basis;
            let essential = of_x * x + of_y * y + of_z * z + of_1;
            let essential = essential / essential.norm();
            // Far out, where rounding makes roots up, the constraints do not hold.
            let squared = essential * essential.transpose();
            let broken = squared * essential - essential * (0.5 * squared.trace());
            (broken.norm() < 1e-4).then_some(essential)
        })
        .collect()
}

/// The product of two polynomials, coefficients from the lowest power.
fn multiply(a: &[f64], b: &[f64]) -> Vec<f64> {
    let mut product = vec![0.0; a.len() + b.len() - 1];
    for (i, p) in a.iter().enumerate() {
        for (j, q) in b.iter().enumerate() {
            product[i + j] += p * q;
        }
    }
    product
}

fn subtract(mut a: Vec<f64>, b: &[f64]) -> Vec<f64> {
    for (p, q) in a.iter_mut().zip(b) {
        *p -= q;
    }
    a
}

fn evaluate(polynomial: &[f64], at: f64) -> f64 {
    polynomial.iter().rev().fold(0.0, |sum, c| sum * at + c)
}

/// The real roots of a polynomial, coefficients from the lowest power: between two neighbouring roots of its
/// derivative there is one at most.
fn real_roots(polynomial: &[f64]) -> Vec<f64> {
    let degree = polynomial.iter().rposition(|c| *c != 0.0).unwrap_or(0);
    if degree == 0 || !polynomial.iter().all(|c| c.is_finite()) {
        return Vec::new();
    }
    let polynomial = &polynomial[..=degree];
    let derivative: Vec<f64> = (1..=degree).map(|k| k as f64 * polynomial[k]).collect();
    // All roots are within Cauchy's bound; so far out that a coefficient vanishes, none is of use.
    let largest = polynomial[..degree]
        .iter()
        .fold(0.0, |m: f64, c| m.max(c.abs()));
    let bound = (1.0 + largest / polynomial[degree].abs()).min(1e6);
    let mut edges = vec![-bound];
    edges.extend(
        real_roots(&derivative)
            .into_iter()
            .filter(|r| r.abs() < bound),
    );
    edges.push(bound);
    edges
        .windows(2)
        .filter_map(|edge| root_between(polynomial, &derivative, edge[0], edge[1]))
        .collect()
}

/// The root between two places where the signs differ: Newton's steps, halving where one leaves the bracket or
/// is not half as long as the one before. Far out Newton's steps shrink by a tenth only: there are too many.
fn root_between(polynomial: &[f64], derivative: &[f64], low: f64, high: f64) -> Option<f64> {
    let (at_low, at_high) = (evaluate(polynomial, low), evaluate(polynomial, high));
    if at_low * at_high > 0.0 || low == high {
        return None;
    }
    let (mut low, mut high, mut at) = (low, high, 0.5 * (low + high));
    let mut before = high - low;
    for _ in 0..100 {
        let value = evaluate(polynomial, at);
        if (value > 0.0) == (at_low > 0.0) {
            low = at;
        } else {
            high = at;
        }
        let newton = at - value / evaluate(derivative, at);
        let shrinks = (newton - at).abs() < 0.5 * before;
        let next = if newton > low && newton < high && shrinks {
            newton
        } else {
            0.5 * (low + high)
        };
        let moved = (next - at).abs();
        (at, before) = (next, moved);
        if moved <= 1e-15 * at.abs().max(1e-3) {
            break;
        }
    }
    Some(at)
}

#[cfg(test)]
mod tests {
    use super::*;
    use barchan_geometry::{Se3, se3};
    use nalgebra::{Point3, Vector6};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn roots_are_found_near_and_far_and_none_is_invented() {
        // (z - 1)(z + 2)(z - 0.5)(z^2 + 1)
        let factors: [&[f64]; 4] = [&[-1.0, 1.0], &[2.0, 1.0], &[-0.5, 1.0], &[1.0, 0.0, 1.0]];
        let product = factors.iter().fold(vec![1.0], |p, f| multiply(&p, f));
        let roots = real_roots(&product);
        assert_eq!(roots.len(), 3, "{roots:?}");
        for (root, expected) in roots.iter().zip([-2.0, 0.5, 1.0]) {
            assert!((root - expected).abs() < 1e-12, "{root}");
        }
        // Roots of one polynomial that lie a million times as far out as others.
        let factors: [&[f64]; 4] = [&[-3e5, 1.0], &[2e-2, 1.0], &[-0.5, 1.0], &[-7.0, 1.0]];
        let product = factors.iter().fold(vec![1.0], |p, f| multiply(&p, f));
        let roots = real_roots(&product);
        assert_eq!(roots.len(), 4, "{roots:?}");
        for (root, expected) in roots.iter().zip([-2e-2, 0.5, 7.0, 3e5]) {
            assert!((root - expected).abs() < 1e-9 * expected.abs(), "{root}");
        }
        assert!(real_roots(&[1.0, 0.0, 1.0]).is_empty());
        assert!(real_roots(&[0.0, f64::NAN]).is_empty() && real_roots(&[]).is_empty());
    }

    /// Among the solutions is the true one, for any motion; and each is an essential matrix that holds for
    /// the five pairs.
    #[test]
    fn the_true_motion_is_among_the_solutions() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut errors = Vec::new();
        for _ in 0..300 {
            let mut number = |scale: f64| rng.random_range(-scale..scale);
            let motion: Se3 = se3::exp(&Vector6::from_fn(|_, _| number(0.5)));
            let pairs: [[Vector2<f64>; 2]; 5] = std::array::from_fn(|_| {
                let point = Point3::new(number(3.0), number(2.0), 5.0 + number(3.0));
                let ray = |p: Point3<f64>| Vector2::new(p.x / p.z, p.y / p.z);
                [ray(point), ray(motion * point)]
            });
            let truth = se3::skew(&motion.translation.vector)
                * motion.rotation.to_rotation_matrix().into_inner();
            let truth = truth / truth.norm();
            let found = five_point(&pairs);
            assert!((1..=10).contains(&found.len()));
            let error = |e: &Matrix3<f64>| (e - truth).norm().min((e + truth).norm());
            let best = found.iter().map(error).fold(f64::INFINITY, f64::min);
            errors.push(best);
            for e in &found {
                let cubic = 2.0 * e * e.transpose() * e - (e * e.transpose()).trace() * e;
                assert!(
                    cubic.norm() < 1e-3 && e.determinant().abs() < 1e-3,
                    "{cubic}"
                );
                for [first, second] in &pairs {
                    let residual = (second.push(1.0).transpose() * e * first.push(1.0)).x;
                    assert!(residual.abs() < 1e-9, "{residual}");
                }
            }
        }
        // Now and then two solutions nearly coincide: digits are lost, once in hundreds the root with them.
        errors.sort_by(f64::total_cmp);
        assert!(
            errors[150] < 1e-11 && errors[285] < 1e-7,
            "{:?}",
            &errors[280..]
        );
        assert!(errors[297] < 1e-3, "{:?}", &errors[297..]);
    }

    #[test]
    fn rays_that_fix_nothing_give_no_nonsense() {
        let same = [[Vector2::new(0.1, 0.2); 2]; 5];
        assert!(
            five_point(&same)
                .iter()
                .all(|e| e.iter().all(|v| v.is_finite()))
        );
        let broken = [[Vector2::new(f64::NAN, 0.2); 2]; 5];
        assert!(five_point(&broken).is_empty());
    }
}
