use std::path::Path;

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use crate::error::positive;
use crate::geotiff::{Crs, write_geotiff};
use crate::{TerrainError, Voxel};

/// "No data" in files of `f32` (in memory it is NaN).
pub const NODATA: f32 = -9999.0;

/// Where the cells of a north-up raster lie. Row 0 is the northernmost, column 0 the westernmost;
/// a cell is an area, and its value stands for that area.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// x of the western edge, metres.
    pub west: f64,
    /// y of the northern edge, metres.
    pub north: f64,
    /// Width of a cell, metres.
    pub cell_x: f64,
    /// Height of a cell, metres.
    pub cell_y: f64,
}

/// One value a cell, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct Raster<T> {
    /// The cells.
    pub grid: Grid,
    /// The coordinate system, where a file named one; `None` is a local frame in metres.
    pub crs: Option<Crs>,
    /// The values: `grid.width * grid.height` of them.
    pub values: Vec<T>,
}

/// How the points of a cell make its elevation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CellStatistic {
    /// Their mean.
    #[default]
    Mean,
    /// Their median: keeps a stray point from moving a cell.
    Median,
    /// The height that a tenth of them lie below: the ground between stones and under twigs.
    P10,
    /// The highest: what a wheel or a belly meets first.
    Max,
}

/// A digital elevation model and what was left out of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Dem {
    /// Elevation, metres; NaN where no point fell. Nothing is filled in.
    pub raster: Raster<f32>,
    /// Points of each cell, 0 where none fell; in the order of the raster.
    pub count: Vec<f32>,
    /// Standard deviation of the heights of each cell's voxels, by their weight, metres; NaN where
    /// none fell.
    pub spread: Vec<f32>,
    /// Points that lie far outside the extent of all others and were left out.
    pub outliers: usize,
}

impl Dem {
    /// Writes a GeoTIFF of three bands: elevation, count, spread.
    ///
    /// # Errors
    /// As [`write_geotiff`].
    pub fn write(&self, path: &Path) -> Result<(), TerrainError> {
        let bands: [(&str, &[f32]); 3] = [
            ("elevation", &self.raster.values),
            ("count", &self.count),
            ("spread", &self.spread),
        ];
        write_geotiff(path, &self.raster.grid, self.raster.crs.as_ref(), &bands)
    }
}

impl Grid {
    /// Centre of a cell.
    pub fn centre(&self, column: usize, row: usize) -> (f64, f64) {
        (
            self.west + (column as f64 + 0.5) * self.cell_x,
            self.north - (row as f64 + 0.5) * self.cell_y,
        )
    }

    /// Column and row of the cell in which a place lies; `None` outside.
    pub fn cell_at(&self, x: f64, y: f64) -> Option<(usize, usize)> {
        let column = ((x - self.west) / self.cell_x).floor();
        let row = ((self.north - y) / self.cell_y).floor();
        let inside =
            column >= 0.0 && row >= 0.0 && column < self.width as f64 && row < self.height as f64;
        inside.then_some((column as usize, row as usize))
    }
}

impl<T: Copy> Raster<T> {
    /// The value of a cell.
    ///
    /// # Panics
    /// Outside the grid.
    pub fn at(&self, column: usize, row: usize) -> T {
        self.values[row * self.grid.width + column]
    }
}

impl Raster<f32> {
    /// Its values over the cells of another grid in the same frame. Onto cells at least twice as large:
    /// the mean of the known cells whose centres lie in each, if they cover half of it. Else the
    /// bilinear value between the four centres around. NaN where neither is known.
    pub fn onto(&self, grid: &Grid) -> Self {
        let ratio = [
            grid.cell_x / self.grid.cell_x,
            grid.cell_y / self.grid.cell_y,
        ];
        let cells = grid.width * grid.height;
        let values = if ratio[0] >= 2.0 && ratio[1] >= 2.0 {
            let (mut sums, mut counts) = (vec![0.0; cells], vec![0u32; cells]);
            for (i, value) in self.values.iter().enumerate() {
                let (x, y) = self.grid.centre(i % self.grid.width, i / self.grid.width);
                if let (true, Some((c, r))) = (value.is_finite(), grid.cell_at(x, y)) {
                    sums[r * grid.width + c] += f64::from(*value);
                    counts[r * grid.width + c] += 1;
                }
            }
            let enough = 0.5 * ratio[0] * ratio[1];
            let mean = |(sum, count): (f64, u32)| match f64::from(count) >= enough {
                true => (sum / f64::from(count)) as f32,
                false => f32::NAN,
            };
            sums.into_iter().zip(counts).map(mean).collect()
        } else {
            let centre = |i: usize| grid.centre(i % grid.width, i / grid.width);
            let values = (0..cells).map(centre);
            values.map(|(x, y)| self.bilinear(x, y) as f32).collect()
        };
        Self {
            grid: *grid,
            crs: self.crs.clone(),
            values,
        }
    }

    /// The value between the four cell centres around a place; NaN beyond them or where one is
    /// unknown and counts.
    fn bilinear(&self, x: f64, y: f64) -> f64 {
        let column = (x - self.grid.west) / self.grid.cell_x - 0.5;
        let row = (self.grid.north - y) / self.grid.cell_y - 0.5;
        let (c0, r0) = (column.floor(), row.floor());
        let mut sum = 0.0;
        for (c, r) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
            let weight = (1.0 - (column - c0 - c).abs()) * (1.0 - (row - r0 - r).abs());
            if weight == 0.0 {
                continue;
            }
            let (c, r) = (c0 + c, r0 + r);
            let inside =
                c >= 0.0 && r >= 0.0 && c < self.grid.width as f64 && r < self.grid.height as f64;
            if !inside {
                return f64::NAN;
            }
            sum += weight * f64::from(self.at(c as usize, r as usize));
        }
        sum
    }
}

/// Elevation over the cells of a grid that holds all `voxels`, each weighted by how sure its points are
/// ([`Voxel::weight`]).
///
/// The grid is aligned to multiples of `cell` metres. A few points far away (a wrong match near
/// infinity) would blow it up: those that lie farther outside the middle 99 % of the points than
/// that middle is wide are left out and counted.
///
/// # Errors
/// When there are no points, `cell` is not positive, or the grid would have more than `max_cells`.
pub fn dem(
    voxels: &[Voxel],
    cell: f64,
    statistic: CellStatistic,
    max_cells: usize,
) -> Result<Dem, TerrainError> {
    positive("cell", cell)?;
    let (Some((x0, x1)), Some((y0, y1))) = (extent(voxels, |p| p.x), extent(voxels, |p| p.y))
    else {
        return Err(TerrainError::Empty(
            "there are no points to make a DEM of".into(),
        ));
    };
    let inside = |p: &Point3<f64>| (x0..=x1).contains(&p.x) && (y0..=y1).contains(&p.y);
    let kept: Vec<&Voxel> = voxels.iter().filter(|v| inside(&v.mean)).collect();
    // Counted from the origin, east and south: an edge belongs to the cell east or south of it.
    let cell_of = |v: &Voxel| [(v.mean.x / cell).floor(), (-v.mean.y / cell).floor()];
    let [(west, east), (north, south)] = [0, 1].map(|axis| {
        let cells = kept.iter().map(|v| cell_of(v)[axis]);
        cells.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), c| {
            (a.min(c), b.max(c))
        })
    });
    let (width, height) = (east - west + 1.0, south - north + 1.0);
    // Coordinates that are not finite have no extent either.
    let cells = width * height;
    if cells.is_nan() || cells > max_cells as f64 {
        return Err(TerrainError::TooLarge {
            width,
            height,
            cell,
            limit: max_cells,
        });
    }
    let grid = Grid {
        width: width as usize,
        height: height as usize,
        west: west * cell,
        north: -north * cell,
        cell_x: cell,
        cell_y: cell,
    };

    let mut heights: Vec<Height> = kept
        .iter()
        .map(|v| {
            let [column, row] = cell_of(v);
            let index = (row - north) as usize * grid.width + (column - west) as usize;
            Height {
                cell: index,
                z: v.mean.z,
                weight: v.weight,
                count: v.count,
            }
        })
        .collect();
    heights.sort_unstable_by(|a, b| a.cell.cmp(&b.cell).then(a.z.total_cmp(&b.z)));
    let cells = grid.width * grid.height;
    let (mut values, mut spread) = (vec![f32::NAN; cells], vec![f32::NAN; cells]);
    let mut count = vec![0.0; cells];
    for cell in heights.chunk_by(|a, b| a.cell == b.cell) {
        let index = cell[0].cell;
        let mean = mean(cell);
        let weight: f64 = cell.iter().map(|h| h.weight).sum();
        let squares: f64 = cell.iter().map(|h| h.weight * (h.z - mean).powi(2)).sum();
        count[index] = cell.iter().map(|h| h.count as f32).sum();
        spread[index] = (squares / weight).sqrt() as f32;
        values[index] = match statistic {
            CellStatistic::Mean => mean,
            CellStatistic::Median => quantile(cell, 0.5),
            CellStatistic::P10 => quantile(cell, 0.1),
            CellStatistic::Max => cell[cell.len() - 1].z,
        } as f32;
    }
    Ok(Dem {
        raster: Raster {
            grid,
            crs: None,
            values,
        },
        count,
        spread,
        outliers: voxels.len() - kept.len(),
    })
}

/// The range of a coordinate outside which a point is an outlier; `None` of no points.
fn extent(voxels: &[Voxel], coordinate: impl Fn(&Point3<f64>) -> f64) -> Option<(f64, f64)> {
    let mut values: Vec<f64> = voxels.iter().map(|v| coordinate(&v.mean)).collect();
    values.sort_unstable_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    let margin = (values.len() as f64 * 0.005).ceil() as usize;
    // Of few points none is exceptional.
    let margin = if values.len() < 200 { 0 } else { margin };
    let (low, high) = (values[margin], values[last - margin]);
    Some((low - (high - low), high + (high - low)))
}

/// The height of a voxel, and the cell that it counts for.
struct Height {
    cell: usize,
    z: f64,
    weight: f64,
    count: u32,
}

fn mean(heights: &[Height]) -> f64 {
    let weight: f64 = heights.iter().map(|h| h.weight).sum();
    heights.iter().map(|h| h.z * h.weight).sum::<f64>() / weight
}

/// The height that a share of the weight lies below, of heights in ascending order; where the share
/// ends between two, their mean.
fn quantile(heights: &[Height], share: f64) -> f64 {
    let wanted = share * heights.iter().map(|h| h.weight).sum::<f64>();
    let mut below = 0.0;
    for (i, h) in heights.iter().enumerate() {
        below += h.weight;
        if below > wanted || i + 1 == heights.len() {
            return h.z;
        }
        if below == wanted {
            return 0.5 * (h.z + heights[i + 1].z);
        }
    }
    f64::NAN
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    fn voxel(x: f64, y: f64, z: f64, count: u32) -> Voxel {
        Voxel {
            count,
            weight: f64::from(count),
            mean: Point3::new(x, y, z),
            linear_rgb: Vector3::zeros(),
        }
    }

    #[test]
    fn cells_hold_the_mean_or_median_of_their_points_and_no_others() {
        // Two rows of two columns; the south-west cell is empty.
        let voxels = [
            voxel(0.1, 1.2, 1.0, 1),
            voxel(0.9, 1.9, 4.0, 3),
            voxel(0.5, 1.5, 9.0, 1),
            voxel(1.5, 1.1, -2.0, 7),
            voxel(1.9, 0.5, 5.0, 1),
            voxel(1.1, 0.4, 7.0, 1),
        ];
        let mean = dem(&voxels, 1.0, CellStatistic::Mean, 100).unwrap().raster;
        let grid = Grid {
            width: 2,
            height: 2,
            west: 0.0,
            north: 2.0,
            cell_x: 1.0,
            cell_y: 1.0,
        };
        assert_eq!(mean.grid, grid);
        assert_eq!(
            (mean.at(0, 0), mean.at(1, 0), mean.at(1, 1)),
            (22.0 / 5.0, -2.0, 6.0)
        );
        assert!(mean.at(0, 1).is_nan());
        let median = dem(&voxels, 1.0, CellStatistic::Median, 100)
            .unwrap()
            .raster;
        assert_eq!(
            (median.at(0, 0), median.at(1, 0), median.at(1, 1)),
            (4.0, -2.0, 6.0)
        );
        let p10 = dem(&voxels, 1.0, CellStatistic::P10, 100).unwrap();
        assert_eq!((p10.raster.at(0, 0), p10.raster.at(1, 1)), (1.0, 5.0));
        let max = dem(&voxels, 1.0, CellStatistic::Max, 100).unwrap();
        assert_eq!((max.raster.at(0, 0), max.raster.at(1, 1)), (9.0, 7.0));
        // Count and spread do not depend on the statistic.
        assert_eq!(max.count, [5.0, 7.0, 0.0, 2.0]);
        assert!((max.spread[0] - 6.64f32.sqrt()).abs() < 1e-6 && max.spread[2].is_nan());
        assert_eq!((max.spread[1], max.spread[3]), (0.0, 1.0));
    }

    #[test]
    fn a_plane_stays_a_plane_on_other_grids() {
        let grid = |cell: f64, n: usize| Grid {
            width: n,
            height: n,
            west: -1.0,
            north: 2.0,
            cell_x: cell,
            cell_y: cell,
        };
        let plane = |g: Grid| Raster {
            grid: g,
            crs: None,
            values: (0..g.width * g.height)
                .map(|i| g.centre(i % g.width, i / g.width))
                .map(|(x, y)| (0.5 * x - 0.25 * y + 3.0) as f32)
                .collect(),
        };
        let fine = plane(grid(0.125, 40));
        let (coarse, finer) = (grid(0.5, 10), grid(0.05, 100));
        for wanted in [coarse, finer] {
            let there = fine.onto(&wanted);
            let expected = plane(wanted);
            let known = there.values.iter().filter(|v| v.is_finite()).count();
            assert!(known as f64 > 0.9 * there.values.len() as f64, "{known}");
            for (a, b) in there.values.iter().zip(&expected.values) {
                assert!(a.is_nan() || (a - b).abs() < 1e-5, "{a} {b}");
            }
        }
        // Unknown stays unknown, and so does what lies beyond.
        let mut holed = fine.clone();
        holed.values[..4 * 40].fill(f32::NAN);
        assert!(holed.onto(&coarse).values[..10].iter().all(|v| v.is_nan()));
        let away = Grid {
            west: 100.0,
            ..coarse
        };
        assert!(fine.onto(&away).values.iter().all(|v| v.is_nan()));
    }

    #[test]
    fn centres_fall_into_their_cells() {
        let grid = Grid {
            width: 7,
            height: 5,
            west: -23.5,
            north: 21.5,
            cell_x: 0.094,
            cell_y: 0.1,
        };
        for row in 0..5 {
            for column in 0..7 {
                let (x, y) = grid.centre(column, row);
                assert_eq!(grid.cell_at(x, y), Some((column, row)));
            }
        }
        assert_eq!(grid.cell_at(-23.6, 21.4), None);
        assert_eq!(grid.cell_at(-23.4, 21.6), None);
        assert_eq!(grid.cell_at(f64::NAN, 0.0), None);
    }

    #[test]
    fn points_on_the_edges_of_cells_are_not_lost() {
        // Multiples of a cell that binary numbers do not hold exactly, negative ones among them.
        for cell in [0.1, 0.05, 0.3] {
            let voxels: Vec<_> = (-20..=20)
                .flat_map(|i| (-20..=20).map(move |j| (f64::from(i) * cell, f64::from(j) * cell)))
                .map(|(x, y)| voxel(x, y, 1.0, 1))
                .collect();
            let raster = dem(&voxels, cell, CellStatistic::Mean, 10_000)
                .unwrap()
                .raster;
            // Rounding may put two into one cell and leave the next empty, at the borders too.
            assert!(
                (40..=42).contains(&raster.grid.width) && (40..=42).contains(&raster.grid.height)
            );
            let known = raster.values.iter().filter(|v| v.is_finite()).count();
            assert!((36 * 36..=41 * 41).contains(&known), "{known}");
        }
        let one = dem(&[voxel(0.0, 0.0, 3.0, 1)], 1.0, CellStatistic::Mean, 10)
            .unwrap()
            .raster;
        assert_eq!(
            (one.values, one.grid.west, one.grid.north),
            (vec![3.0], 0.0, 0.0)
        );
    }

    #[test]
    fn an_inclined_plane_is_met_at_the_cell_centres() {
        let voxels: Vec<_> = (0..400)
            .flat_map(|i| (0..300).map(move |j| (0.01 * i as f64 + 0.005, 0.01 * j as f64 + 0.005)))
            .map(|(x, y)| voxel(x, y, 0.3 * x - 0.2 * y + 1.0, 1))
            .collect();
        let raster = dem(&voxels, 0.1, CellStatistic::Mean, 10_000)
            .unwrap()
            .raster;
        assert_eq!((raster.grid.width, raster.grid.height), (40, 30));
        for row in 0..30 {
            for column in 0..40 {
                let (x, y) = raster.grid.centre(column, row);
                let expected = 0.3 * x - 0.2 * y + 1.0;
                assert!((f64::from(raster.at(column, row)) - expected).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn far_points_do_not_blow_up_the_grid() {
        let mut voxels: Vec<_> = (0..1000)
            .map(|i| voxel(0.01 * f64::from(i), 0.5, 0.0, 1))
            .collect();
        voxels.push(voxel(1e7, 0.5, 0.0, 1));
        voxels.push(voxel(3.0, -4e8, 0.0, 1));
        let dem = dem(&voxels, 0.1, CellStatistic::Mean, 1_000_000).unwrap();
        // All y of the line are the same, so only that y is inside.
        assert_eq!(
            (dem.outliers, dem.raster.grid.width, dem.raster.grid.height),
            (2, 100, 1)
        );
    }

    #[test]
    fn a_grid_too_large_is_refused_before_it_is_made() {
        let voxels = [voxel(0.0, 0.0, 0.0, 1), voxel(1e6, 1e6, 0.0, 1)];
        let error = dem(&voxels, 1e-3, CellStatistic::Mean, 1_000_000).unwrap_err();
        assert!(matches!(error, TerrainError::TooLarge { .. }), "{error}");
        assert!(matches!(
            dem(&[], 1.0, CellStatistic::Mean, 10),
            Err(TerrainError::Empty(_))
        ));
        assert!(matches!(
            dem(&voxels, 0.0, CellStatistic::Mean, 10),
            Err(TerrainError::Setting { .. })
        ));
    }
}
