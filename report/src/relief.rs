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

impl Relief {
    pub(crate) fn pack(&self) -> Result<Packed, ReportError> {
        let grid = self.elevation.grid;
        let every = ((grid.width * grid.height) as f64 / MAX_CELLS as f64)
            .sqrt()
            .ceil();
        let every = (every as usize).max(1);
        let (width, height) = (grid.width.div_ceil(every), grid.height.div_ceil(every));
        let at = |column: usize, row: usize| row * every * grid.width + column * every;
        let cells = || (0..height).flat_map(|row| (0..width).map(move |column| at(column, row)));

        let (low, high) = spread(&self.elevation.values);
        let picture = RgbImage::from_fn(width as u32, height as u32, |column, row| {
            let cell = at(column as usize, row as usize);
            let known = self.elevation.values.get(cell).filter(|z| z.is_finite());
            let shade = self.shade.values.get(cell).copied().unwrap_or(0);
            known.map_or(Rgb([255; 3]), |z| tinted((z - low) / (high - low), shade))
        });
        let bytes = |raster: &Raster<f32>| -> String {
            let value = |cell| raster.values.get(cell).copied().unwrap_or(f32::NAN);
            base64(
                &cells()
                    .flat_map(|c| value(c).to_le_bytes())
                    .collect::<Vec<u8>>(),
            )
        };
        Ok(Packed {
            width,
            height,
            every,
            west: grid.west,
            north: grid.north,
            cell: [grid.cell_x, grid.cell_y].map(|c| c * every as f64),
            low,
            high,
            picture: data_uri(&picture, ImageFormat::Png)?,
            elevation: bytes(&self.elevation),
            bound: self.bound.as_ref().map(bytes),
        })
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

fn tinted(height: f32, shade: u8) -> Rgb<u8> {
    let colour = colorous::VIRIDIS.eval_continuous(f64::from(height.clamp(0.0, 1.0)));
    // At the rim there is height but no slope.
    let light = match shade {
        0 => 0.9,
        shade => 0.25 + 0.95 * f32::from(shade) / 255.0,
    };
    Rgb([colour.r, colour.g, colour.b].map(|c| (f32::from(c) * light).min(255.0) as u8))
}
