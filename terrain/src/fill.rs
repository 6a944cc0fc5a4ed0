use crate::{Raster, TerrainError};

/// A DEM with small holes filled, and where.
#[derive(Clone, Debug, PartialEq)]
pub struct Filled {
    /// Elevation, metres.
    pub raster: Raster<f32>,
    /// 1 where a cell was filled, 0 where it was not; in the order of the raster.
    pub mask: Vec<f32>,
}

/// The farthest that a value may be carried, cells.
pub const MAX_FILL: usize = 3;

/// Fills holes of a DEM by the mean of the known cells within `reach` cells, weighted by one over
/// their squared distance. A cell is filled only when it lies among known ones, in three of its four
/// quadrants: the border of the map is not carried outwards. What was filled is marked.
///
/// # Errors
/// When `reach` is 0 or more than [`MAX_FILL`].
pub fn fill(dem: &Raster<f32>, reach: usize) -> Result<Filled, TerrainError> {
    if !(1..=MAX_FILL).contains(&reach) {
        return Err(TerrainError::Setting {
            field: "reach of filling",
            value: reach.to_string(),
            expected: "1 to 3 cells",
        });
    }
    let (w, h) = (dem.grid.width, dem.grid.height);
    let mut filled = Filled {
        raster: dem.clone(),
        mask: vec![0.0; w * h],
    };
    for (i, z) in dem.values.iter().enumerate() {
        if z.is_finite() {
            continue;
        }
        let (column, row) = (i % w, i / w);
        let (mut sum, mut weights, mut quadrants) = (0.0, 0.0, [false; 4]);
        for r in row.saturating_sub(reach)..(row + reach + 1).min(h) {
            for c in column.saturating_sub(reach)..(column + reach + 1).min(w) {
                let (dx, dy) = (c as f64 - column as f64, r as f64 - row as f64);
                let distance2 = dx * dx + dy * dy;
                let known = f64::from(dem.at(c, r));
                if !known.is_finite() || distance2 > (reach * reach) as f64 {
                    continue;
                }
                sum += known / distance2;
                weights += 1.0 / distance2;
                // Each half-axis belongs to one quadrant, turning the same way.
                let quadrant = match (dx, dy) {
                    (x, y) if x > 0.0 && y >= 0.0 => 0,
                    (x, y) if x <= 0.0 && y > 0.0 => 1,
                    (x, y) if x < 0.0 && y <= 0.0 => 2,
                    _ => 3,
                };
                quadrants[quadrant] = true;
            }
        }
        if quadrants.into_iter().filter(|q| *q).count() >= 3 {
            filled.raster.values[i] = (sum / weights) as f32;
            filled.mask[i] = 1.0;
        }
    }
    Ok(filled)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Grid;

    #[test]
    fn holes_are_filled_borders_are_not_and_both_are_told_apart() {
        let grid = Grid {
            width: 30,
            height: 20,
            west: 0.0,
            north: 0.0,
            cell_x: 0.1,
            cell_y: 0.1,
        };
        let plane = |i: usize| 0.02 * (i % 30) as f32 - 0.01 * (i / 30) as f32;
        let mut dem = Raster {
            grid,
            crs: None,
            values: (0..600).map(plane).collect(),
        };
        let mut hole = |columns: std::ops::Range<usize>, rows: std::ops::Range<usize>| {
            for r in rows {
                dem.values[r * 30 + columns.start..r * 30 + columns.end].fill(f32::NAN);
            }
        };
        hole(5..7, 5..7); // small
        hole(12..22, 5..15); // too large for its middle
        hole(27..30, 0..20); // the border
        let filled = fill(&dem, 3).unwrap();
        for (i, z) in filled.raster.values.iter().enumerate() {
            let (c, r) = (i % 30, i / 30);
            let was_known = dem.values[i].is_finite();
            assert_eq!(filled.mask[i] == 1.0, !was_known && z.is_finite());
            if was_known {
                assert_eq!(*z, dem.values[i]);
            } else if z.is_finite() {
                assert!((z - plane(i)).abs() < 0.04, "{c} {r}: {z} {}", plane(i));
                assert!(c < 27, "the border at {c} {r}");
            }
        }
        assert_eq!(filled.mask[5 * 30 + 5], 1.0);
        assert!(filled.raster.values[10 * 30 + 17].is_nan());
        assert!(fill(&dem, 0).is_err() && fill(&dem, 4).is_err());
    }
}
