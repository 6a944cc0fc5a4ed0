use serde::Serialize;

use crate::{Raster, TerrainError};

/// Earth to be moved to bring one surface to another.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Earthwork {
    /// Where the surface lies above the target, cubic metres.
    pub cut: f64,
    /// Where it lies below, cubic metres.
    pub fill: f64,
    /// Cut less fill, cubic metres.
    pub net: f64,
    /// Ground that both are known on, square metres.
    pub area: f64,
    /// Ground inside the polygon that one of them is unknown on, square metres: not counted.
    pub unknown_area: f64,
    /// Deviation of the net volume if the heights of cells err independently, cubic metres; where
    /// variances are known.
    pub sigma_independent: Option<f64>,
    /// Its deviation if they all err together, cubic metres: the truth lies between the two.
    pub sigma_together: Option<f64>,
}

/// Cut and fill from `surface` to `target` (elevations on the same grid, metres) inside a polygon of
/// x and y; `None` is everywhere. `variance` is that of the difference of each cell, square metres.
///
/// # Errors
/// When the sizes differ, the polygon has fewer than three corners, or nothing is known on both.
pub fn earthwork(
    surface: &Raster<f32>,
    target: &[f32],
    variance: Option<&[f32]>,
    polygon: Option<&[[f64; 2]]>,
) -> Result<Earthwork, TerrainError> {
    let cells = surface.values.len();
    if target.len() != cells || variance.is_some_and(|v| v.len() != cells) {
        return Err(TerrainError::Empty(format!(
            "the surface has {cells} cells and what it is compared with has not"
        )));
    }
    if polygon.is_some_and(|p| p.len() < 3) {
        return Err(TerrainError::Empty(
            "a polygon of fewer than three corners holds no ground".into(),
        ));
    }
    let grid = &surface.grid;
    let cell = grid.cell_x * grid.cell_y;
    let (mut cut, mut fill, mut known, mut unknown) = (0.0, 0.0, 0.0, 0.0);
    let (mut variances, mut deviations) = (0.0, 0.0);
    for i in 0..cells {
        let (x, y) = grid.centre(i % grid.width, i / grid.width);
        if !polygon.is_none_or(|p| contains(p, x, y)) {
            continue;
        }
        let above = f64::from(surface.values[i]) - f64::from(target[i]);
        if !above.is_finite() {
            unknown += cell;
            continue;
        }
        known += cell;
        cut += above.max(0.0) * cell;
        fill += (-above).max(0.0) * cell;
        if let Some(v) = variance {
            variances += f64::from(v[i]);
            deviations += f64::from(v[i]).sqrt();
        }
    }
    if known == 0.0 {
        return Err(TerrainError::Empty(
            "no cell inside is known on both surfaces".into(),
        ));
    }
    Ok(Earthwork {
        cut,
        fill,
        net: cut - fill,
        area: known,
        unknown_area: unknown,
        sigma_independent: variance.map(|_| variances.sqrt() * cell),
        sigma_together: variance.map(|_| deviations * cell),
    })
}

/// Whether a place lies inside a polygon, by the parity of its edges to the east.
fn contains(polygon: &[[f64; 2]], x: f64, y: f64) -> bool {
    let edges = (0..polygon.len()).map(|i| (polygon[i], polygon[(i + 1) % polygon.len()]));
    let crossed = edges.filter(|([x0, y0], [x1, y1])| {
        (*y0 > y) != (*y1 > y) && x < x0 + (y - y0) / (y1 - y0) * (x1 - x0)
    });
    crossed.count() % 2 == 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Grid;

    fn raster(f: impl Fn(f64, f64) -> f64) -> Raster<f32> {
        let grid = Grid {
            width: 200,
            height: 200,
            west: -1.0,
            north: 1.0,
            cell_x: 0.01,
            cell_y: 0.01,
        };
        let centres = (0..200 * 200).map(|i| grid.centre(i % 200, i / 200));
        Raster {
            grid,
            crs: None,
            values: centres.map(|(x, y)| f(x, y) as f32).collect(),
        }
    }

    #[test]
    fn a_cone_and_a_pit_have_their_volumes() {
        // Radius 0.4, height 0.3: a third of the cylinder. The pit is a cylinder of 0.2 by 0.1.
        let site = raster(|x, y| {
            let cone = 0.3 * (1.0 - (x + 0.5).hypot(y) / 0.4).max(0.0);
            cone - if (x - 0.5).hypot(y) < 0.2 { 0.1 } else { 0.0 }
        });
        let flat = vec![0.0f32; 200 * 200];
        let cone = std::f64::consts::PI * 0.16 * 0.3 / 3.0;
        let pit = std::f64::consts::PI * 0.04 * 0.1;
        let work = earthwork(&site, &flat, None, None).unwrap();
        assert!((work.cut / cone - 1.0).abs() < 0.005 && (work.fill / pit - 1.0).abs() < 0.01);
        assert!((work.net - (work.cut - work.fill)).abs() < 1e-12);
        assert!((work.area - 4.0).abs() < 1e-9 && work.sigma_together.is_none());

        let east = [[0.0, -1.0], [1.0, -1.0], [1.0, 1.0], [0.0, 1.0]];
        let variance = vec![1e-4f32; 200 * 200];
        let work = earthwork(&site, &flat, Some(&variance), Some(&east)).unwrap();
        assert!(work.cut == 0.0 && (work.fill / pit - 1.0).abs() < 0.01);
        assert!((work.area - 2.0).abs() < 1e-9);
        // 20 000 cells of 1 cm^2, 1 cm each.
        assert!((work.sigma_together.unwrap() - 0.02).abs() < 1e-6);
        assert!((work.sigma_independent.unwrap() - 0.02 / 20_000f64.sqrt()).abs() < 1e-8);
    }

    #[test]
    fn what_is_unknown_is_not_counted_and_said() {
        let site = raster(|x, _| if x < 0.0 { f64::NAN } else { 1.0 });
        let flat = vec![0.0f32; 200 * 200];
        let work = earthwork(&site, &flat, None, None).unwrap();
        assert!((work.cut - 2.0).abs() < 1e-9 && (work.unknown_area - 2.0).abs() < 1e-9);
        let west = [[-0.9, -0.5], [-0.1, -0.5], [-0.5, 0.5]];
        assert!(earthwork(&site, &flat, None, Some(&west)).is_err());
        assert!(earthwork(&site, &flat, None, Some(&west[..2])).is_err());
        assert!(earthwork(&site, &flat[1..], None, None).is_err());
        // A triangle holds half of its box.
        let full = raster(|_, _| 1.0);
        let work = earthwork(&full, &flat, None, Some(&west)).unwrap();
        assert!((work.area - 0.4).abs() < 0.01, "{}", work.area);
    }
}
