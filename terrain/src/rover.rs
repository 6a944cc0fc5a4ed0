use serde::{Deserialize, Serialize};

use crate::error::positive;
use crate::{Grid, Raster, TerrainError};

/// What a rover can drive over.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RoverLimits {
    /// Radius of its wheels, metres: what it climbs. Default 0.125.
    pub wheel_radius: f64,
    /// Steepest ground, degrees. Default 20.
    pub max_slope: f64,
    /// Edge of the square it stands on, metres: ground is what is even over that. Default 1.
    pub footprint: f64,
}

impl Default for RoverLimits {
    fn default() -> Self {
        Self {
            wheel_radius: 0.125,
            max_slope: 20.0,
            footprint: 1.0,
        }
    }
}

/// What the ground is to a rover, cell by cell; NaN where too little is known.
#[derive(Clone, Debug, PartialEq)]
pub struct RoverLayers {
    /// Where the cells lie.
    pub grid: Grid,
    /// Height above the ground around, metres, never negative.
    pub obstacle: Vec<f32>,
    /// Largest difference of height, less the slope, to a cell within a wheel's radius, metres.
    pub step: Vec<f32>,
    /// Angle of the plane through the footprint, degrees.
    pub slope: Vec<f32>,
    /// 1 where obstacle and step are at most the wheel's radius and the slope at most its limit, else 0.
    pub traversable: Vec<f32>,
}

/// Layers of a DEM for a rover.
///
/// A least-squares plane through the footprint around each cell gives the slope and what is left of
/// each height. Of that, the opening (the highest that a flat square of the footprint's size reaches
/// from below, Serra 1982) is the ground; what stands above is an obstacle. Without the planes a
/// slope at the border of the map would be one.
///
/// # Errors
/// When a limit makes no sense.
pub fn rover_layers(dem: &Raster<f32>, limits: &RoverLimits) -> Result<RoverLayers, TerrainError> {
    positive("wheel radius", limits.wheel_radius)?;
    positive("slope limit", limits.max_slope)?;
    positive("footprint", limits.footprint)?;
    let cell = dem.grid.cell_x.max(dem.grid.cell_y);
    let half = ((0.5 * limits.footprint / cell).round() as usize).max(1);
    let (width, height) = (dem.grid.width, dem.grid.height);

    let planes = planes(dem, half);
    let left_over: Vec<f32> = dem
        .values
        .iter()
        .zip(&planes)
        .map(|(z, plane)| (f64::from(*z) - plane[2]) as f32)
        .collect();
    let eroded = extreme(&left_over, width, height, half, f32::min);
    let ground = extreme(&eroded, width, height, half, f32::max);
    let slope: Vec<f32> = planes
        .iter()
        .map(|[gx, gy, _]| gx.hypot(*gy).atan().to_degrees() as f32)
        .collect();
    let obstacle: Vec<f32> = left_over
        .iter()
        .zip(&ground)
        .map(|(z, g)| {
            if z.is_nan() {
                f32::NAN
            } else {
                (z - g).max(0.0)
            }
        })
        .collect();

    let reach = ((limits.wheel_radius / cell).ceil() as usize).max(1);
    let low = extreme(&left_over, width, height, reach, f32::min);
    let high = extreme(&left_over, width, height, reach, f32::max);
    let step: Vec<f32> = (0..width * height)
        .map(|i| (left_over[i] - low[i]).max(high[i] - left_over[i]))
        .zip(&left_over)
        .map(|(step, z)| if z.is_nan() { f32::NAN } else { step })
        .collect();
    let traversable = (0..width * height)
        .map(|i| {
            if left_over[i].is_nan() {
                return f32::NAN;
            }
            let radius = limits.wheel_radius as f32;
            let fits = obstacle[i] <= radius
                && step[i] <= radius
                && f64::from(slope[i]) <= limits.max_slope;
            f32::from(u8::from(fits))
        })
        .collect();
    Ok(RoverLayers {
        grid: dem.grid,
        obstacle,
        step,
        slope,
        traversable,
    })
}

/// The least-squares plane through the known cells of the square of `half` cells around each known
/// cell: its slopes east and north and its height at the cell; NaN where fewer than six are known, or
/// these lie in a line.
fn planes(dem: &Raster<f32>, half: usize) -> Vec<[f64; 3]> {
    let (w, h) = (dem.grid.width, dem.grid.height);
    let known: Vec<f64> = dem
        .values
        .iter()
        .copied()
        .map(f64::from)
        .filter(|z| z.is_finite())
        .collect();
    let zero = known.iter().sum::<f64>() / known.len().max(1) as f64;
    // Sums over all cells north-west of a corner: of 1, x, y, z, xx, xy, yy, xz, yz.
    let mut sums = vec![[0.0f64; 9]; (w + 1) * (h + 1)];
    let place = |c: usize, r: usize| {
        (
            (c as f64 - 0.5 * w as f64) * dem.grid.cell_x,
            (0.5 * h as f64 - r as f64) * dem.grid.cell_y,
        )
    };
    for r in 0..h {
        let mut row = [0.0; 9];
        for c in 0..w {
            let z = f64::from(dem.at(c, r)) - zero;
            if z.is_finite() {
                let (x, y) = place(c, r);
                let terms = [1.0, x, y, z, x * x, x * y, y * y, x * z, y * z];
                row.iter_mut().zip(terms).for_each(|(s, t)| *s += t);
            }
            let above = sums[r * (w + 1) + c + 1];
            let here = &mut sums[(r + 1) * (w + 1) + c + 1];
            *here = std::array::from_fn(|k| above[k] + row[k]);
        }
    }
    let fit = |i: usize| {
        let (c, r) = (i % w, i / w);
        let unknown = [f64::NAN; 3];
        if !dem.values[i].is_finite() {
            return unknown;
        }
        let (west, east) = (c.saturating_sub(half), (c + half + 1).min(w));
        let (top, bottom) = (r.saturating_sub(half), (r + half + 1).min(h));
        let corner = |c: usize, r: usize| &sums[r * (w + 1) + c];
        let s: [f64; 9] = std::array::from_fn(|k| {
            corner(east, bottom)[k] - corner(west, bottom)[k] - corner(east, top)[k]
                + corner(west, top)[k]
        });
        let n = s[0];
        if n < 5.5 {
            return unknown;
        }
        let (mx, my, mz) = (s[1] / n, s[2] / n, s[3] / n);
        let (xx, xy, yy) = (s[4] / n - mx * mx, s[5] / n - mx * my, s[6] / n - my * my);
        let (xz, yz) = (s[7] / n - mx * mz, s[8] / n - my * mz);
        let determinant = xx * yy - xy * xy;
        // Cells in a line leave the slope across it free.
        let least = (0.25 * dem.grid.cell_x * dem.grid.cell_y).powi(2);
        if determinant < least {
            return unknown;
        }
        let gx = (xz * yy - yz * xy) / determinant;
        let gy = (yz * xx - xz * xy) / determinant;
        let (x, y) = place(c, r);
        [gx, gy, zero + mz + gx * (x - mx) + gy * (y - my)]
    };
    (0..w * h).map(fit).collect()
}

/// The lowest or highest of the known values in the square of `half` cells around each cell; NaN where
/// none is known. Rows, then columns.
fn extreme(
    values: &[f32],
    width: usize,
    height: usize,
    half: usize,
    pick: impl Fn(f32, f32) -> f32,
) -> Vec<f32> {
    // f32::min and f32::max pass over NaN.
    let along = |values: &[f32], n: usize, stride: usize, starts: usize, next: usize| {
        let mut out = vec![f32::NAN; values.len()];
        for s in 0..starts {
            for k in 0..n {
                let window = k.saturating_sub(half)..(k + half + 1).min(n);
                out[s * next + k * stride] = window
                    .map(|j| values[s * next + j * stride])
                    .fold(f32::NAN, &pick);
            }
        }
        out
    };
    let rows = along(values, width, 1, height, width);
    along(&rows, height, width, width, 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dem(f: impl Fn(f64, f64) -> f64) -> Raster<f32> {
        let grid = Grid {
            width: 120,
            height: 100,
            west: 0.0,
            north: 5.0,
            cell_x: 0.05,
            cell_y: 0.05,
        };
        let centres = (0..120 * 100).map(|i| grid.centre(i % 120, i / 120));
        Raster {
            grid,
            crs: None,
            values: centres.map(|(x, y)| f(x, y) as f32).collect(),
        }
    }

    #[test]
    fn a_plane_has_its_slope_no_obstacle_and_no_step_up_to_its_borders() {
        let limits = RoverLimits::default();
        for (gx, gy) in [(0.0, 0.0), (0.3, 0.0), (-0.2, 0.25)] {
            let layers = rover_layers(&dem(|x, y| gx * x + gy * y - 40.0), &limits).unwrap();
            let slope = gx.hypot(gy).atan().to_degrees();
            assert!(
                layers
                    .obstacle
                    .iter()
                    .chain(&layers.step)
                    .all(|v| *v < 1e-4)
            );
            assert!(
                layers
                    .slope
                    .iter()
                    .all(|v| (f64::from(*v) - slope).abs() < 1e-2)
            );
            assert!(layers.traversable.iter().all(|v| *v == 1.0));
        }
        let steep = rover_layers(&dem(|x, _| 0.5 * x), &limits).unwrap();
        assert!(steep.traversable.iter().all(|v| *v == 0.0));
    }

    #[test]
    fn a_stone_on_a_slope_stands_as_high_as_it_is() {
        let stone = |x: f64, y: f64| (x - 3.0).abs() < 0.15 && (y - 2.5).abs() < 0.15;
        let mut ground = dem(|x, y| 0.2 * x + if stone(x, y) { 0.25 } else { 0.0 });
        ground.values[50 * 120 + 20] = f32::NAN;
        let layers = rover_layers(&ground, &RoverLimits::default()).unwrap();
        let at = |v: &[f32], x: f64, y: f64| {
            let (c, r) = ground.grid.cell_at(x, y).unwrap();
            v[r * 120 + c]
        };
        assert!((at(&layers.obstacle, 3.0, 2.5) - 0.25).abs() < 0.05);
        assert!((at(&layers.step, 3.2, 2.5) - 0.25).abs() < 0.05);
        assert_eq!(at(&layers.traversable, 3.0, 2.5), 0.0);
        assert_eq!(at(&layers.traversable, 1.5, 1.5), 1.0);
        assert!(at(&layers.obstacle, 1.5, 1.5) < 0.01);
        // The unknown cell stays unknown and harms no neighbour.
        assert!(
            layers.obstacle[50 * 120 + 20].is_nan() && layers.traversable[50 * 120 + 21] == 1.0
        );
        let none = RoverLimits {
            wheel_radius: 0.0,
            ..RoverLimits::default()
        };
        assert!(rover_layers(&ground, &none).is_err());
    }
}
