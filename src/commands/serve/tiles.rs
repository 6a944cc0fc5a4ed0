//! The map so far, in tiles. What was seen lies where it was thought to be then: a loop closed later moves
//! the camera, and only `barchan map` of the finished run moves the ground with it.

use anyhow::Result;
use barchan_geometry::Se3;
use barchan_terrain::{
    CellStatistic, Grid, Light, Raster, Sample, Voxel, dem, geotiff_bytes, hillshade, level,
};
use serde_json::{Value, json};

/// Cells along the edge of a tile.
const EDGE: i64 = 256;
/// Most cells of the whole map.
const MAX_CELLS: usize = 16_000_000;

/// Elevation and its shading, over one grid.
#[allow(non_snake_case)]
pub struct Terrain {
    /// How many key frames it is made of: it is another map when this is another number.
    pub keyframes: usize,
    T_level_world: Se3,
    elevation: Raster<f32>,
    shade: Raster<u8>,
}

impl Terrain {
    /// Levels the voxels, as `barchan map` does, and makes a grid of them.
    ///
    /// # Errors
    /// When nothing was seen yet, or the grid would be absurdly large.
    pub fn new(
        mut voxels: Vec<Voxel>,
        first_pose: &Se3,
        cell: f64,
        keyframes: usize,
    ) -> Result<Self> {
        let positions: Vec<_> = voxels.iter().map(|v| v.mean).collect();
        let levelled = level(&positions, first_pose);
        for v in &mut voxels {
            v.mean = levelled.T_level_world * v.mean;
        }
        let elevation = dem(&voxels, cell, CellStatistic::Mean, MAX_CELLS)?.raster;
        Ok(Self {
            keyframes,
            T_level_world: levelled.T_level_world,
            shade: hillshade(&elevation, &Light::default()),
            elevation,
        })
    }

    /// What there is, in words for programs.
    pub fn describe(&self) -> Value {
        let grid = &self.elevation.grid;
        let [column, row] = origin(grid);
        let (last_column, last_row) =
            (column + grid.width as i64 - 1, row + grid.height as i64 - 1);
        let matrix = self.T_level_world.to_homogeneous();
        let rows: Vec<Vec<f64>> = (0..3)
            .map(|r| matrix.row(r).iter().copied().collect())
            .collect();
        json!({
            "keyframes": self.keyframes,
            "cell": grid.cell_x,
            "tile_cells": EDGE,
            "columns": [column.div_euclid(EDGE), last_column.div_euclid(EDGE)],
            "rows": [row.div_euclid(EDGE), last_row.div_euclid(EDGE)],
            "T_level_world": rows,
            "tile": "/map/COLUMN/ROW.tif is elevation, .png is shaded; x of its western edge is COLUMN * tile_cells * cell, y of its northern edge -ROW * tile_cells * cell",
        })
    }

    /// Elevation of a tile as a GeoTIFF; `None` outside the map.
    pub fn elevation(&self, column: i64, row: i64) -> Option<Result<Vec<u8>>> {
        let tile = tile(&self.elevation, column, row, f32::NAN)?;
        let bytes = geotiff_bytes(&tile.grid, None, &[("elevation", &tile.values)]);
        Some(bytes.map_err(Into::into))
    }

    /// The shaded tile as a grey PNG, 0 where nothing is known; `None` outside the map.
    pub fn shaded(&self, column: i64, row: i64) -> Option<Result<Vec<u8>>> {
        let tile = tile(&self.shade, column, row, 0)?;
        let image = image::GrayImage::from_raw(EDGE as u32, EDGE as u32, tile.values)?;
        let mut bytes = std::io::Cursor::new(vec![]);
        let written = image.write_to(&mut bytes, image::ImageFormat::Png);
        Some(written.map(|()| bytes.into_inner()).map_err(Into::into))
    }
}

/// Cells east and south of the world's origin at which the grid begins, which is aligned to it.
fn origin(grid: &Grid) -> [i64; 2] {
    [grid.west / grid.cell_x, -grid.north / grid.cell_y].map(|cells| cells.round() as i64)
}

fn tile<T: Sample>(raster: &Raster<T>, column: i64, row: i64, unknown: T) -> Option<Raster<T>> {
    let grid = &raster.grid;
    let [west, north] = origin(grid);
    // Where the tile begins in the raster; a number from a client may be any.
    let x0 = column.checked_mul(EDGE)?.checked_sub(west)?;
    let y0 = row.checked_mul(EDGE)?.checked_sub(north)?;
    let beside = |begin: i64, length: usize| begin <= -EDGE || begin >= length as i64;
    if beside(x0, grid.width) || beside(y0, grid.height) {
        return None;
    }
    let value = |i: i64| {
        let (x, y) = (x0 + i % EDGE, y0 + i / EDGE);
        let inside = (0..grid.width as i64).contains(&x) && (0..grid.height as i64).contains(&y);
        match inside {
            true => raster.at(x as usize, y as usize),
            false => unknown,
        }
    };
    Some(Raster {
        grid: Grid {
            width: EDGE as usize,
            height: EDGE as usize,
            west: (column * EDGE) as f64 * grid.cell_x,
            north: -(row * EDGE) as f64 * grid.cell_y,
            ..*grid
        },
        crs: None,
        values: (0..EDGE * EDGE).map(value).collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_cover_the_raster_once_and_nothing_else() {
        let grid = Grid {
            width: 300,
            height: 270,
            west: -0.5 * 10.0,
            north: 0.5 * 7.0,
            cell_x: 0.5,
            cell_y: 0.5,
        };
        let raster = Raster {
            grid,
            crs: None,
            values: (0..300 * 270).map(|i| i as f32).collect(),
        };
        let mut seen = vec![0; 300 * 270];
        for (column, row) in (-3..4).flat_map(|c| (-3..4).map(move |r| (c, r))) {
            let Some(tile) = tile(&raster, column, row, f32::NAN) else {
                continue;
            };
            for (i, value) in tile.values.iter().enumerate().filter(|(_, v)| !v.is_nan()) {
                seen[*value as usize] += 1;
                let place = tile.grid.centre(i % 256, i / 256);
                let (c, r) = grid.cell_at(place.0, place.1).unwrap();
                assert_eq!(raster.at(c, r), *value);
            }
        }
        assert!(seen.iter().all(|n| *n == 1));
        for far in [i64::MAX, i64::MIN, i64::MAX / EDGE] {
            assert!(tile(&raster, far, 0, 0.0).is_none());
            assert!(tile(&raster, 0, far, 0.0).is_none());
        }
    }
}
