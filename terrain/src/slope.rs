use crate::Raster;

/// Slope as `gdaldem slope` makes it: the angle of Horn's gradient, degrees. NaN at the border, and
/// wherever one of the nine elevations is unknown.
pub fn slope(dem: &Raster<f32>) -> Raster<f32> {
    dem.over_windows(|[nw, n, ne, w, _, e, sw, s, se]| {
        // Horn 1981: eight times how elevation falls east and south.
        let east = (nw + 2.0 * w + sw) - (ne + 2.0 * e + se);
        let south = (nw + 2.0 * n + ne) - (sw + 2.0 * s + se);
        let rise = (east / (8.0 * dem.grid.cell_x)).hypot(south / (8.0 * dem.grid.cell_y));
        rise.atan().to_degrees()
    })
}

/// Roughness as `gdaldem roughness` makes it: highest less lowest of a cell and its eight neighbours,
/// metres. NaN at the border, and wherever one of the nine is unknown.
pub fn roughness(dem: &Raster<f32>) -> Raster<f32> {
    dem.over_windows(|nine| {
        let (low, high) = nine
            .iter()
            .fold((f64::MAX, f64::MIN), |(a, b), z| (a.min(*z), b.max(*z)));
        high - low
    })
}

impl Raster<f32> {
    /// A value for every cell that has eight known neighbours, of the nine: from north-west to
    /// south-east.
    fn over_windows(&self, value: impl Fn([f64; 9]) -> f64) -> Self {
        let (w, h) = (self.grid.width, self.grid.height);
        let mut values = vec![f32::NAN; w * h];
        for row in 1..h.saturating_sub(1) {
            for column in 1..w.saturating_sub(1) {
                let nine: [f64; 9] =
                    std::array::from_fn(|k| self.at(column + k % 3 - 1, row + k / 3 - 1).into());
                if nine.iter().all(|z| z.is_finite()) {
                    values[row * w + column] = value(nine) as f32;
                }
            }
        }
        Self {
            grid: self.grid,
            crs: self.crs.clone(),
            values,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::process::Command;

    use super::*;
    use crate::Grid;

    #[test]
    fn planes_have_their_slope_and_the_roughness_of_their_diagonal() {
        let grid = Grid {
            width: 6,
            height: 5,
            west: 0.0,
            north: 0.0,
            cell_x: 0.5,
            cell_y: 0.25,
        };
        for (gx, gy) in [(0.0, 0.0), (1.0, 0.0), (0.3, -0.4)] {
            let centres = (0..30).map(|i| grid.centre(i % 6, i / 6));
            let mut dem = Raster {
                grid,
                crs: None,
                values: centres.map(|(x, y)| (gx * x + gy * y) as f32).collect(),
            };
            let expected = gx.hypot(gy).atan().to_degrees();
            let diagonal = 2.0 * (0.5 * gx.abs() + 0.25 * gy.abs());
            assert!((f64::from(slope(&dem).at(2, 2)) - expected).abs() < 1e-4);
            assert!((f64::from(roughness(&dem).at(2, 2)) - diagonal).abs() < 1e-6);
            dem.values[3 * 6 + 3] = f32::NAN;
            let holed = slope(&dem);
            assert!(holed.at(2, 2).is_nan() && holed.at(0, 0).is_nan() && !holed.at(1, 1).is_nan());
        }
    }

    #[test]
    fn a_surveyed_yard_has_the_slope_and_roughness_of_gdaldem() {
        let yard = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../shared/data/marsyard2021/elevation.tif");
        if !yard.is_file() || Command::new("gdaldem").arg("--version").output().is_err() {
            println!("skipped: needs gdaldem and {}", yard.display());
            return;
        }
        let dem = Raster::<f32>::read(&yard).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("gdal.tif");
        for (product, ours) in [("slope", slope(&dem)), ("roughness", roughness(&dem))] {
            let run = Command::new("gdaldem")
                .args([product, "-q"])
                .args([&yard, &file])
                .status()
                .unwrap();
            assert!(run.success());
            let theirs = Raster::<f32>::read(&file).unwrap();
            let known = |r: &Raster<f32>| r.values.iter().filter(|v| v.is_finite()).count();
            assert_eq!(known(&ours), known(&theirs), "{product}");
            for (a, b) in ours.values.iter().zip(&theirs.values) {
                assert_eq!(a.is_nan(), b.is_nan());
                assert!(
                    a.is_nan() || (a - b).abs() < 1e-4 * b.abs().max(1.0),
                    "{product}: {a} {b}"
                );
            }
        }
    }
}
