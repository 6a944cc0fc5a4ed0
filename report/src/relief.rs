use barchan_terrain::Raster;
use image::{ImageFormat, Rgb, RgbImage};
use serde::Serialize;

use crate::{ReportError, base64, data_uri};

/// Most cells whose heights a page holds: 4 bytes each, 8 with bounds.
pub const MAX_CELLS: usize = 1_000_000;

/// A shaded relief that tells heights under the pointer. All rasters have the same grid.
#[derive(Clone, Debug)]
pub struct Relief {
    /// Elevation, metres; NaN where unknown.
    pub elevation: Raster<f32>,
    /// Brightness of the shaded relief, 0 where unknown.
    pub shade: Raster<u8>,
    /// Half the width of the 3-sigma band, metres; NaN where unknown.
    pub bound: Option<Raster<f32>>,
}

/// As the page's script reads it.
#[derive(Serialize)]
pub(crate) struct Packed {
    pub width: usize,
    pub height: usize,
    /// Cells of the raster that became one here, in each direction.
    pub every: usize,
    pub west: f64,
    pub north: f64,
    pub cell: [f64; 2],
    pub low: f32,
    pub high: f32,
    pub picture: String,
    /// Little-endian `f32`.
    pub elevation: String,
    pub bound: Option<String>,
}

/// Every n-th cell in each direction, so that they are at most [`MAX_CELLS`].
pub(crate) struct Thinned<'a> {
    relief: &'a Relief,
    every: usize,
    pub width: usize,
    pub height: usize,
    pub west: f64,
    pub north: f64,
    pub cell: [f64; 2],
    pub low: f32,
    pub high: f32,
}

impl Relief {
    pub(crate) fn thinned(&self) -> Thinned<'_> {
        let grid = self.elevation.grid;
        let every = ((grid.width * grid.height) as f64 / MAX_CELLS as f64)
            .sqrt()
            .ceil();
        let every = (every as usize).max(1);
        let (low, high) = spread(&self.elevation.values);
        Thinned {
            relief: self,
            every,
            width: grid.width.div_ceil(every),
            height: grid.height.div_ceil(every),
            west: grid.west,
            north: grid.north,
            cell: [grid.cell_x, grid.cell_y].map(|c| c * every as f64),
            low,
            high,
        }
    }

    pub(crate) fn pack(&self) -> Result<Packed, ReportError> {
        let cells = self.thinned();
        let picture = RgbImage::from_fn(cells.width as u32, cells.height as u32, |column, row| {
            Rgb(cells.colour_at(column as usize, row as usize))
        });
        let places = || (0..cells.height).flat_map(|row| (0..cells.width).map(move |c| (c, row)));
        let bytes = |raster: &Raster<f32>| -> String {
            let values = places().flat_map(|(c, r)| cells.value(raster, c, r).to_le_bytes());
            base64(&values.collect::<Vec<u8>>())
        };
        Ok(Packed {
            width: cells.width,
            height: cells.height,
            every: cells.every,
            west: cells.west,
            north: cells.north,
            cell: cells.cell,
            low: cells.low,
            high: cells.high,
            picture: data_uri(&picture, ImageFormat::Png)?,
            elevation: bytes(&self.elevation),
            bound: self.bound.as_ref().map(bytes),
        })
    }
}

impl Thinned<'_> {
    fn index(&self, column: usize, row: usize) -> usize {
        row * self.every * self.relief.elevation.grid.width + column * self.every
    }

    fn value(&self, raster: &Raster<f32>, column: usize, row: usize) -> f32 {
        let value = raster.values.get(self.index(column, row));
        value.copied().unwrap_or(f32::NAN)
    }

    /// Elevation, metres; NaN where unknown.
    pub fn height_at(&self, column: usize, row: usize) -> f32 {
        self.value(&self.relief.elevation, column, row)
    }

    /// Coloured by height and shaded; white where unknown.
    pub fn colour_at(&self, column: usize, row: usize) -> [u8; 3] {
        let height = self.height_at(column, row);
        if !height.is_finite() {
            return [u8::MAX; 3];
        }
        let shade = self.relief.shade.values.get(self.index(column, row));
        let share = (height - self.low) / (self.high - self.low);
        tinted(share, shade.copied().unwrap_or(0))
    }
}

/// Where all but the lowest and the highest hundredth lie.
fn spread(values: &[f32]) -> (f32, f32) {
    let mut known: Vec<f32> = values.iter().copied().filter(|v| v.is_finite()).collect();
    known.sort_by(f32::total_cmp);
    let at = |share: f64| known.get(((known.len().max(1) - 1) as f64 * share) as usize);
    match (at(0.01), at(0.99)) {
        (Some(low), Some(high)) => (*low, high.max(low + 1e-3)),
        _ => (0.0, 1.0),
    }
}

fn tinted(height: f32, shade: u8) -> [u8; 3] {
    let colour = colorous::VIRIDIS.eval_continuous(f64::from(height.clamp(0.0, 1.0)));
    // At the rim there is height but no slope.
    let light = match shade {
        0 => 0.9,
        shade => 0.25 + 0.95 * f32::from(shade) / 255.0,
    };
    [colour.r, colour.g, colour.b].map(|c| (f32::from(c) * light).min(255.0) as u8)
}
