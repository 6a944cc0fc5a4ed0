//! Where the ground surely lies: the fused map and its bounds (spec 7).

use nalgebra::{Matrix2, SymmetricEigen, Vector2};
use serde::{Deserialize, Serialize};

use super::{ElevationCell, ElevationMap};

/// How bounds are made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BoundsKind {
    /// Height and three deviations of the cell itself (Bai 2019).
    #[default]
    Sigma3,
    /// 1 % and 99 % of what the cells around say, as far as this cell may be one of them
    /// (Fankhauser 2018): right where the map has moved with a robot.
    Quantile,
}

/// A cell's height and what it surely lies between, metres; NaN where nothing is known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// The height.
    pub height: f64,
    /// Surely not lower than this.
    pub lower: f64,
    /// Surely not higher than this.
    pub upper: f64,
}

/// 95 % of a normal distribution of two dimensions lie within so many deviations.
const ELLIPSE_95: f64 = 2.486;

impl ElevationMap {
    /// Heights and bounds of the cells of [`ElevationMap::raster`], in its order; NaN of cells that were measured less
    /// often than [`ElevationConfig::min_looks`](super::ElevationConfig::min_looks).
    pub fn bounds(&self, kind: BoundsKind) -> Vec<Bounds> {
        let (grid, cells) = self.settled();
        let index = |column: usize, row: usize| row * grid.width + column;
        let places = (0..grid.height).flat_map(|row| (0..grid.width).map(move |c| (c, row)));
        places
            .map(|(column, row)| match kind {
                BoundsKind::Sigma3 => three_sigma(cells[index(column, row)]),
                BoundsKind::Quantile => {
                    let cell = cells[index(column, row)];
                    if !cell.is_known() {
                        return three_sigma(cell);
                    }
                    let edge = grid.cell_x;
                    let (axes, deviations) = ellipse(cell);
                    // The ellipse and the diagonal of a cell.
                    let reach = ELLIPSE_95 * deviations.max() + std::f64::consts::SQRT_2 * edge;
                    let reach = (reach / edge)
                        .ceil()
                        .min(grid.width.max(grid.height) as f64);
                    let reach = reach as usize;
                    let mut around = vec![];
                    for r in row.saturating_sub(reach)..(row + reach + 1).min(grid.height) {
                        for c in column.saturating_sub(reach)..(column + reach + 1).min(grid.width)
                        {
                            let neighbour = cells[index(c, r)];
                            if !neighbour.is_known() {
                                continue;
                            }
                            let offset = Vector2::new(
                                (c as f64 - column as f64) * edge,
                                (row as f64 - r as f64) * edge,
                            );
                            // Into the axes of the ellipse: by the transpose.
                            let along = axes.transpose() * offset;
                            let weight: f64 = (0..2)
                                .map(|k| {
                                    let s = deviations[k].max(1e-9);
                                    normal_cdf((along[k] + 0.5 * edge) / s)
                                        - normal_cdf((along[k] - 0.5 * edge) / s)
                                })
                                .product();
                            around.push((neighbour, weight.max(2.0 * f64::EPSILON)));
                        }
                    }
                    quantiles(&around)
                }
            })
            .collect()
    }
}

fn three_sigma(cell: &ElevationCell) -> Bounds {
    let three = 3.0 * cell.variance().sqrt();
    Bounds {
        height: cell.height,
        lower: cell.height - three,
        upper: cell.height + three,
    }
}

/// Axes, as columns, and deviations along them of where a cell is.
fn ellipse(cell: &ElevationCell) -> (Matrix2<f64>, Vector2<f64>) {
    let [xx, yy, xy] = cell.horizontal;
    let eigen = SymmetricEigen::new(Matrix2::new(xx, xy, xy, yy));
    (
        eigen.eigenvectors,
        eigen.eigenvalues.map(|v| v.max(0.0).sqrt()),
    )
}

/// Mean height, and 1 % and 99 % of the heights less and plus two deviations, by weight.
fn quantiles(cells: &[(&ElevationCell, f64)]) -> Bounds {
    let total: f64 = cells.iter().map(|c| c.1).sum();
    let mean: f64 = cells.iter().map(|(c, w)| c.height * w).sum::<f64>() / total;
    let quantile = |share: f64, sign: f64| {
        let mut values: Vec<(f64, f64)> = cells
            .iter()
            .map(|(c, w)| (c.height + sign * 2.0 * c.variance().sqrt(), *w))
            .collect();
        values.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let mut below = 0.0;
        for (value, weight) in &values {
            below += weight;
            if below >= share * total {
                return *value;
            }
        }
        values.last().map_or(f64::NAN, |v| v.0)
    };
    Bounds {
        height: mean,
        lower: quantile(0.01, -1.0),
        upper: quantile(0.99, 1.0),
    }
}

/// The normal distribution function, by Abramowitz and Stegun 26.2.17: 7.5e-8 off at most.
fn normal_cdf(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.231_641_9 * x.abs());
    let polynomial = t
        * (0.319_381_530
            + t * (-0.356_563_782
                + t * (1.781_477_937 + t * (-1.821_255_978 + t * 1.330_274_429))));
    let tail = (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt() * polynomial;
    if x >= 0.0 { 1.0 - tail } else { tail }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distribution_function_has_its_table_values() {
        for (x, p) in [
            (0.0, 0.5),
            (1.0, 0.841_344_7),
            (-2.0, 0.022_750_1),
            (3.0, 0.998_650_1),
        ] {
            assert!((normal_cdf(x) - p).abs() < 1e-6, "{x}: {}", normal_cdf(x));
        }
    }

    #[test]
    fn an_ellipse_keeps_its_direction() {
        // Long towards the north-east: the map of elevation_mapping turns it to the south-east.
        let cell = ElevationCell {
            horizontal: [0.01, 0.01, 0.009],
            ..ElevationCell::EMPTY
        };
        let (axes, deviations) = ellipse(&cell);
        let long = if deviations[0] > deviations[1] { 0 } else { 1 };
        assert!((axes.column(long).dot(&Vector2::new(1.0, 1.0))).abs() > 1.41);
    }
}
