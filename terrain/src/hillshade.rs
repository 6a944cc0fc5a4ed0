use serde::{Deserialize, Serialize};

use crate::Raster;

/// Where the light of a hillshade comes from. The defaults are those of `gdaldem hillshade`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Light {
    /// Direction it comes from, degrees clockwise from north. Default 315, north-west.
    pub azimuth: f64,
    /// Height above the horizon, degrees. Default 45.
    pub altitude: f64,
    /// Factor on elevation before shading. Default 1.
    pub z: f64,
}

impl Default for Light {
    fn default() -> Self {
        Self {
            azimuth: 315.0,
            altitude: 45.0,
            z: 1.0,
        }
    }
}

/// Shaded relief as `gdaldem hillshade` makes it: Horn's gradient, Lambert's cosine, 1 (dark) to 255.
/// 0 is no data: at the border, and wherever one of the nine elevations is unknown.
///
/// gdaldem takes an approximate square root whose last digits depend on the processor, and this takes the same: a pixel
/// within 1e-4 of the half between two shades may round otherwise on another machine.
pub fn hillshade(dem: &Raster<f32>, light: &Light) -> Raster<u8> {
    let (w, h) = (dem.grid.width, dem.grid.height);
    let mut values = vec![0; w * h];
    for row in 1..h.saturating_sub(1) {
        for column in 1..w.saturating_sub(1) {
            let shade = shade(dem, column, row, light);
            if !shade.is_nan() {
                // Rounded as gdaldem does, by way of f32.
                values[row * w + column] = (shade as f32 + 0.5) as u8;
            }
        }
    }
    Raster {
        grid: dem.grid,
        crs: dem.crs.clone(),
        values,
    }
}

/// The shade of an inner cell before rounding, 1 to 255; NaN when an elevation is unknown.
fn shade(dem: &Raster<f32>, column: usize, row: usize, light: &Light) -> f64 {
    let at = |dx: usize, dy: usize| dem.at(column + dx - 1, row + dy - 1);
    let (nw, n, ne) = (at(0, 0), at(1, 0), at(2, 0));
    let (west, centre, east) = (at(0, 1), at(1, 1), at(2, 1));
    let (sw, s, se) = (at(0, 2), at(1, 2), at(2, 2));
    if centre.is_nan() {
        return f64::NAN;
    }
    // Horn 1981: how elevation falls east and south, eightfold; in f32 and in gdaldem's order of
    // summation, so that the last bit agrees.
    let (diagonal, other) = (nw - se, sw - ne);
    let falls_east = diagonal + (west - east) + (west - east) + other;
    let falls_south = diagonal + (n - s) + (n - s) - other;
    let x = f64::from(falls_east) * light.z / (8.0 * dem.grid.cell_x);
    let y = f64::from(falls_south) * light.z / (8.0 * dem.grid.cell_y);
    // Cosine between the surface normal and the light.
    let (azimuth, altitude) = (light.azimuth.to_radians(), light.altitude.to_radians());
    let from_light = y * azimuth.cos() - x * azimuth.sin();
    let cosine = over_root(
        altitude.sin() - altitude.cos() * from_light,
        1.0 + x * x + y * y,
    );
    // Not f64::max, which would turn an unknown elevation into a shadow.
    if cosine < 0.0 {
        1.0
    } else {
        1.0 + 254.0 * cosine
    }
}

/// `a` over the root of `b`, as gdaldem has it: the processor's guess of twelve bits and a step of Newton's. With the true
/// root one of 248 004 shades of the mars yard of 2021 is another.
#[cfg(target_arch = "x86_64")]
fn over_root(a: f64, b: f64) -> f64 {
    use std::arch::x86_64::{_mm_cvtss_f32, _mm_rsqrt_ss, _mm_set_ss};
    // SAFETY: SSE is part of every x86-64.
    let guess = f64::from(unsafe { _mm_cvtss_f32(_mm_rsqrt_ss(_mm_set_ss(b as f32))) });
    a * (guess * (1.5 - 0.5 * b * (guess * guess)))
}

/// `a` over the root of `b`; where there is no SSE, gdaldem too divides.
#[cfg(not(target_arch = "x86_64"))]
fn over_root(a: f64, b: f64) -> f64 {
    a / b.sqrt()
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::process::Command;

    use super::*;
    use crate::Grid;

    fn surface(width: usize, height: usize, f: impl Fn(f64, f64) -> f64) -> Raster<f32> {
        let grid = Grid {
            width,
            height,
            west: 0.0,
            north: height as f64 * 0.5,
            cell_x: 0.5,
            cell_y: 0.5,
        };
        let cells = (0..height).flat_map(|row| (0..width).map(move |column| (column, row)));
        let values = cells
            .map(|(c, r)| grid.centre(c, r))
            .map(|(x, y)| f(x, y) as f32)
            .collect();
        Raster {
            grid,
            crs: None,
            values,
        }
    }

    /// Lambert's cosine worked from the normal and light vectors themselves.
    fn lambert(slope_x: f64, slope_y: f64, light: &Light) -> u8 {
        let normal = nalgebra::Vector3::new(-slope_x, -slope_y, 1.0).normalize();
        let (a, e) = (light.azimuth.to_radians(), light.altitude.to_radians());
        let sun = nalgebra::Vector3::new(a.sin() * e.cos(), a.cos() * e.cos(), e.sin());
        (1.0 + 254.0 * normal.dot(&sun).max(0.0)).round() as u8
    }

    #[test]
    fn planes_have_the_shade_of_their_normal() {
        for light in [
            Light::default(),
            Light {
                azimuth: 90.0,
                altitude: 30.0,
                z: 1.0,
            },
            Light {
                azimuth: 200.0,
                altitude: 60.0,
                z: 1.0,
            },
        ] {
            for (gx, gy) in [
                (0.0, 0.0),
                (0.5, 0.0),
                (0.0, 0.5),
                (-1.0, 0.25),
                (3.0, -3.0),
                (0.25, 0.75),
            ] {
                let shade = hillshade(&surface(5, 4, |x, y| gx * x + gy * y), &light);
                for row in 1..3 {
                    for column in 1..4 {
                        assert_eq!(
                            shade.at(column, row),
                            lambert(gx, gy, &light),
                            "{gx} {gy} {light:?}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn values_worked_by_hand() {
        // Flat: 1 + 254 sin 45 = 180.6. A slope of 45 degrees facing the light: full light.
        let flat = hillshade(&surface(3, 3, |_, _| 7.0), &Light::default());
        assert_eq!(flat.at(1, 1), 181);
        let s = 0.5f64.sqrt();
        let facing = hillshade(&surface(3, 3, |x, y| s * x - s * y), &Light::default());
        assert_eq!(facing.at(1, 1), 255);
        // Its back gets none, and dark is 1, not 0.
        let behind = hillshade(&surface(3, 3, |x, y| 2.0 * (y - x)), &Light::default());
        assert_eq!(behind.at(1, 1), 1);
        // z = 2 on half the slope is the slope.
        let doubled = Light {
            z: 2.0,
            ..Light::default()
        };
        let half = hillshade(&surface(3, 3, |x, y| 0.5 * s * (x - y)), &doubled);
        assert_eq!(half.at(1, 1), 255);
    }

    #[test]
    fn the_border_and_the_surroundings_of_a_hole_are_no_data() {
        let mut dem = surface(9, 8, |x, y| (x * y).sin());
        dem.values[4 * 9 + 4] = f32::NAN;
        let shade = hillshade(&dem, &Light::default());
        for row in 0..8usize {
            for column in 0..9usize {
                let border = row == 0 || column == 0 || row == 7 || column == 8;
                let near = row.abs_diff(4) <= 1 && column.abs_diff(4) <= 1;
                assert_eq!(shade.at(column, row) == 0, border || near, "{column} {row}");
            }
        }
        for (w, h) in [(1, 1), (2, 5), (5, 2)] {
            let tiny = hillshade(&surface(w, h, |x, _| x), &Light::default());
            assert!(tiny.values.iter().all(|&v| v == 0));
        }
    }

    #[test]
    fn a_surveyed_yard_is_shaded_as_gdaldem_shades_it() {
        let dem_file = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../shared/data/marsyard2021/elevation.tif");
        if !dem_file.is_file() || Command::new("gdaldem").arg("--version").output().is_err() {
            println!("skipped: needs gdaldem and {}", dem_file.display());
            return;
        }
        let dem = Raster::<f32>::read(&dem_file).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let theirs_file = dir.path().join("gdal.tif");
        for light in [
            Light::default(),
            Light {
                azimuth: 100.0,
                altitude: 20.0,
                z: 1.0,
            },
            Light {
                z: 3.0,
                ..Light::default()
            },
        ] {
            let run = Command::new("gdaldem")
                .args(["hillshade", "-q"])
                .args(["-az", &light.azimuth.to_string()])
                .args(["-alt", &light.altitude.to_string()])
                .args(["-z", &light.z.to_string()])
                .args([&dem_file, &theirs_file])
                .status()
                .unwrap();
            assert!(run.success());
            let theirs = Raster::<u8>::read(&theirs_file).unwrap();
            let ours = hillshade(&dem, &light);
            assert_eq!(ours.grid, theirs.grid);
            let pairs = || ours.values.iter().zip(&theirs.values).enumerate();
            let differ: Vec<usize> = pairs()
                .filter(|(_, (a, b))| a != b)
                .map(|(i, _)| i)
                .collect();
            println!(
                "{light:?}: {} of {} pixels differ",
                differ.len(),
                ours.values.len()
            );
            assert!(differ.len() <= 10, "{differ:?}");
            for i in differ {
                let exact = shade(&dem, i % 500, i / 500, &light);
                println!(
                    "  at {i}: {exact:.7}, ours {}, gdaldem's {}",
                    ours.values[i], theirs.values[i]
                );
                assert!(
                    (exact.fract() - 0.5).abs() < 1e-4,
                    "only ties may fall otherwise"
                );
            }
        }
    }
}
