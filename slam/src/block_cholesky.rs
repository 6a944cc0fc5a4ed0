//! Sparse symmetric systems made of blocks of six, as pose graphs give them.

use std::collections::BTreeSet;

use nalgebra::{Matrix6, Vector6};

/// The Cholesky factor of a sparse symmetric matrix of 6 x 6 blocks. The pattern is analysed once:
/// an order of elimination by least degree (George and Liu 1989), and the blocks that fill in. Then
/// each matrix of that pattern is factored without looking for anything.
#[derive(Clone)]
pub(crate) struct BlockCholesky {
    /// Block column of each unknown in the order of elimination.
    position: Vec<usize>,
    /// Rows below the diagonal of each block column, ascending.
    rows: Vec<Vec<usize>>,
    diagonal: Vec<Matrix6<f64>>,
    /// Blocks below the diagonal, as `rows` has them.
    below: Vec<Vec<Matrix6<f64>>>,
}

impl BlockCholesky {
    /// Analyses a pattern: `unknowns` diagonal blocks, and one block for each pair.
    pub fn new(unknowns: usize, pairs: impl Iterator<Item = (usize, usize)>) -> Self {
        let mut neighbours = vec![BTreeSet::new(); unknowns];
        for (a, b) in pairs.filter(|(a, b)| a != b) {
            neighbours[a].insert(b);
            neighbours[b].insert(a);
        }
        let mut queue: BTreeSet<(usize, usize)> =
            (0..unknowns).map(|k| (neighbours[k].len(), k)).collect();
        let mut position = vec![0; unknowns];
        let mut columns = Vec::with_capacity(unknowns);
        while let Some((_, k)) = queue.pop_first() {
            position[k] = columns.len();
            let around = std::mem::take(&mut neighbours[k]);
            for a in &around {
                queue.remove(&(neighbours[*a].len(), *a));
                neighbours[*a].remove(&k);
                neighbours[*a].extend(around.iter().filter(|b| *b != a));
                queue.insert((neighbours[*a].len(), *a));
            }
            columns.push(around);
        }
        let rows: Vec<Vec<usize>> = columns
            .into_iter()
            .map(|column| {
                let mut rows: Vec<usize> = column.into_iter().map(|k| position[k]).collect();
                rows.sort_unstable();
                rows
            })
            .collect();
        Self {
            diagonal: vec![Matrix6::zeros(); unknowns],
            below: rows
                .iter()
                .map(|r| vec![Matrix6::zeros(); r.len()])
                .collect(),
            position,
            rows,
        }
    }

    /// Sets the matrix to zero.
    pub fn clear(&mut self) {
        self.diagonal.fill(Matrix6::zeros());
        self.below.iter_mut().for_each(|b| b.fill(Matrix6::zeros()));
    }

    /// Adds to the block at row `a` and column `b`; its mirror image follows. The pair must be one of
    /// the pattern.
    pub fn add(&mut self, a: usize, b: usize, block: &Matrix6<f64>) {
        let (row, column) = (self.position[a], self.position[b]);
        if row == column {
            self.diagonal[row] += block;
        } else if row > column {
            self.subtract(row, column, -block);
        } else {
            self.subtract(column, row, -block.transpose());
        }
    }

    /// Multiplies the diagonal by `1 + lambda` (Marquardt 1963).
    pub fn damp(&mut self, lambda: f64) {
        for block in &mut self.diagonal {
            for k in 0..6 {
                block[(k, k)] += lambda * block[(k, k)] + 1e-12;
            }
        }
    }

    fn subtract(&mut self, row: usize, column: usize, block: Matrix6<f64>) {
        if let Ok(at) = self.rows[column].binary_search(&row) {
            self.below[column][at] -= block;
        }
    }

    /// Factors the matrix in place, column by column; `None` when it is not positive definite. The
    /// matrix is lost.
    fn factor(&mut self) -> Option<()> {
        for column in 0..self.rows.len() {
            let factor = self.diagonal[column].cholesky()?.unpack();
            self.diagonal[column] = factor;
            for block in &mut self.below[column] {
                // L_ik = A_ik L_kk^-T
                let mut turned = block.transpose();
                factor.solve_lower_triangular_mut(&mut turned);
                *block = turned.transpose();
            }
            let blocks = std::mem::take(&mut self.below[column]);
            for (j, right) in blocks.iter().enumerate() {
                let to = self.rows[column][j];
                self.diagonal[to] -= right * right.transpose();
                for (i, left) in blocks.iter().enumerate().skip(j + 1) {
                    let row = self.rows[column][i];
                    self.subtract(row, to, left * right.transpose());
                }
            }
            self.below[column] = blocks;
        }
        Some(())
    }

    /// Factors the matrix and solves for one right side; `None` when the matrix is not positive
    /// definite. The matrix is lost.
    pub fn solve(&mut self, right: &[Vector6<f64>]) -> Option<Vec<Vector6<f64>>> {
        self.factor()?;
        let mut x = vec![Vector6::zeros(); right.len()];
        for (k, value) in right.iter().enumerate() {
            x[self.position[k]] = *value;
        }
        for column in 0..x.len() {
            self.diagonal[column].solve_lower_triangular_mut(&mut x[column]);
            let known = x[column];
            for (row, block) in self.rows[column].iter().zip(&self.below[column]) {
                x[*row] -= block * known;
            }
        }
        for column in (0..x.len()).rev() {
            let mut value = x[column];
            for (row, block) in self.rows[column].iter().zip(&self.below[column]) {
                value -= block.transpose() * x[*row];
            }
            self.diagonal[column].tr_solve_lower_triangular_mut(&mut value);
            x[column] = value;
        }
        Some(self.position.iter().map(|p| x[*p]).collect())
    }

    /// Factors the matrix and gives the diagonal blocks of its inverse; `None` when it is not positive
    /// definite. From the last column to the first, those blocks of the inverse that lie where the
    /// factor has blocks follow from each other (Takahashi, Fagan and Chen 1973); no other is needed.
    pub fn inverse_diagonal(&mut self) -> Option<Vec<Matrix6<f64>>> {
        self.factor()?;
        let mut inverse = Self {
            diagonal: vec![Matrix6::zeros(); self.rows.len()],
            below: vec![Vec::new(); self.rows.len()],
            position: self.position.clone(),
            rows: self.rows.clone(),
        };
        for column in (0..self.rows.len()).rev() {
            let mut root = Matrix6::identity();
            self.diagonal[column].solve_lower_triangular_mut(&mut root);
            let scaled: Vec<Matrix6<f64>> = self.below[column].iter().map(|b| b * root).collect();
            let rows = &self.rows[column];
            let below = rows.iter().map(|i| {
                let products = rows.iter().zip(&scaled);
                products.fold(Matrix6::zeros(), |sum, (k, u)| sum - inverse.at(*i, *k) * u)
            });
            let below: Vec<Matrix6<f64>> = below.collect();
            let own = root.transpose() * root;
            let products = scaled.iter().zip(&below);
            inverse.diagonal[column] = products.fold(own, |sum, (u, z)| sum - u.transpose() * z);
            inverse.below[column] = below;
        }
        Some(self.position.iter().map(|p| inverse.diagonal[*p]).collect())
    }

    /// The block at a row and column in the order of elimination; zero outside of the pattern.
    fn at(&self, row: usize, column: usize) -> Matrix6<f64> {
        if row == column {
            return self.diagonal[row];
        }
        let (low, high) = (row.max(column), row.min(column));
        let Ok(k) = self.rows[high].binary_search(&low) else {
            return Matrix6::zeros();
        };
        let block = self.below[high][k];
        if row > column {
            block
        } else {
            block.transpose()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn solutions_are_those_of_the_dense_matrix() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let n = 30;
        let mut pairs: Vec<(usize, usize)> = (1..n).map(|k| (k - 1, k)).collect();
        pairs.extend((0..20).map(|_| (rng.random_range(0..n), rng.random_range(0..n))));
        let mut sparse = BlockCholesky::new(n, pairs.iter().copied());
        let mut dense = DMatrix::<f64>::zeros(6 * n, 6 * n);
        for (a, b) in pairs.into_iter().filter(|(a, b)| a != b) {
            let [p, q] =
                [(); 2].map(|()| Matrix6::<f64>::from_fn(|_, _| rng.random_range(-1.0..1.0)));
            let own = |m: &Matrix6<f64>| m * m.transpose() + Matrix6::identity() * 0.1;
            for (i, j, block) in [(a, a, own(&p)), (b, b, own(&q)), (a, b, p * q.transpose())] {
                sparse.add(i, j, &block);
                let mut view = dense.fixed_view_mut::<6, 6>(6 * i, 6 * j);
                view += block;
                if i != j {
                    let mut view = dense.fixed_view_mut::<6, 6>(6 * j, 6 * i);
                    view += block.transpose();
                }
            }
        }
        let right: Vec<Vector6<f64>> = (0..n)
            .map(|_| Vector6::from_fn(|_, _| rng.random_range(-1.0..1.0)))
            .collect();
        let stacked = DVector::from_iterator(6 * n, right.iter().flatten().copied());
        let whole = dense.cholesky().unwrap();
        let expected = whole.solve(&stacked);
        let found = sparse.clone().solve(&right).unwrap();
        for (k, x) in found.iter().enumerate() {
            assert!((x - expected.fixed_rows::<6>(6 * k)).norm() < 1e-9, "{k}");
        }
        let whole = whole.inverse();
        for (k, block) in sparse.inverse_diagonal().unwrap().iter().enumerate() {
            let expected = whole.fixed_view::<6, 6>(6 * k, 6 * k);
            assert!((block - expected).norm() < 1e-9, "{k}");
        }
    }

    #[test]
    fn a_matrix_that_is_not_positive_definite_has_no_factor() {
        let mut sparse = BlockCholesky::new(1, std::iter::empty());
        assert!(sparse.solve(&[Vector6::zeros()]).is_none());
    }
}
