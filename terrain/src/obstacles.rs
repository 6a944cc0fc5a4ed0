use nalgebra::Point3;

use crate::{Raster, RoverLayers};

/// Something that stands on the ground.
#[derive(Clone, Debug, PartialEq)]
pub struct Obstacle {
    /// Its highest cell: centre and elevation, metres.
    pub top: Point3<f64>,
    /// Height above the ground around, metres.
    pub height: f64,
    /// Ground that it covers, square metres.
    pub area: f64,
    /// Convex outline of its cells, counter-clockwise, first point not repeated, metres.
    pub footprint: Vec<[f64; 2]>,
}

/// The obstacles of a DEM that are at least `min_height` high: cells that stand half as high and touch,
/// by edges or corners, are one. Highest first.
pub fn obstacles(dem: &Raster<f32>, layers: &RoverLayers, min_height: f64) -> Vec<Obstacle> {
    let (w, h) = (dem.grid.width, dem.grid.height);
    let stands = |i: usize| f64::from(layers.obstacle[i]) >= 0.5 * min_height;
    let mut seen = vec![false; w * h];
    let mut found = vec![];
    for start in 0..w * h {
        if seen[start] || !stands(start) {
            continue;
        }
        seen[start] = true;
        let mut cells = vec![start];
        let mut next = 0;
        while next < cells.len() {
            let (c, r) = (cells[next] % w, cells[next] / w);
            next += 1;
            for row in r.saturating_sub(1)..(r + 2).min(h) {
                for column in c.saturating_sub(1)..(c + 2).min(w) {
                    let i = row * w + column;
                    if !seen[i] && stands(i) {
                        seen[i] = true;
                        cells.push(i);
                    }
                }
            }
        }
        let highest = |a: &usize, b: &usize| layers.obstacle[*a].total_cmp(&layers.obstacle[*b]);
        let Some(top) = cells.iter().copied().max_by(highest) else {
            continue;
        };
        let height = f64::from(layers.obstacle[top]);
        if height < min_height {
            continue;
        }
        let (x, y) = dem.grid.centre(top % w, top / w);
        let corners = cells.iter().flat_map(|i| {
            let (west, north) = (
                dem.grid.west + (i % w) as f64 * dem.grid.cell_x,
                dem.grid.north - (i / w) as f64 * dem.grid.cell_y,
            );
            let (east, south) = (west + dem.grid.cell_x, north - dem.grid.cell_y);
            [[west, north], [east, north], [east, south], [west, south]]
        });
        found.push(Obstacle {
            top: Point3::new(x, y, dem.values[top].into()),
            height,
            area: cells.len() as f64 * dem.grid.cell_x * dem.grid.cell_y,
            footprint: convex_hull(corners.collect()),
        });
    }
    found.sort_by(|a, b| b.height.total_cmp(&a.height));
    found
}

/// Andrew's monotone chain (1979), counter-clockwise.
fn convex_hull(mut points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    points.dedup();
    let turns_left = |a: [f64; 2], b: [f64; 2], c: [f64; 2]| {
        (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 1e-12
    };
    let half = |points: &mut dyn Iterator<Item = [f64; 2]>| {
        let mut chain: Vec<[f64; 2]> = vec![];
        for p in points {
            while chain.len() >= 2 && !turns_left(chain[chain.len() - 2], chain[chain.len() - 1], p)
            {
                chain.pop();
            }
            chain.push(p);
        }
        chain.pop();
        chain
    };
    let mut hull = half(&mut points.iter().copied());
    hull.extend(half(&mut points.iter().rev().copied()));
    hull
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Grid, RoverLimits, rover_layers};

    #[test]
    fn stones_are_found_with_place_height_and_size() {
        let grid = Grid {
            width: 200,
            height: 160,
            west: -3.0,
            north: 5.0,
            cell_x: 0.05,
            cell_y: 0.05,
        };
        // Two stones of 30 and 20 cm, a bump of 5 cm, all on a slope.
        let stones = [
            (0.0, 2.0, 0.3, 0.2),
            (4.0, -1.0, 0.2, 0.15),
            (2.0, 0.0, 0.05, 0.2),
        ];
        let height = |x: f64, y: f64| {
            let on = stones
                .iter()
                .find(|s| (x - s.0).abs() < s.3 && (y - s.1).abs() < s.3);
            0.1 * x + on.map_or(0.0, |s| s.2)
        };
        let centres = (0..200 * 160).map(|i| grid.centre(i % 200, i / 200));
        let dem = Raster {
            grid,
            crs: None,
            values: centres.map(|(x, y)| height(x, y) as f32).collect(),
        };
        let layers = rover_layers(&dem, &RoverLimits::default()).unwrap();
        let found = obstacles(&dem, &layers, 0.1);
        assert_eq!(found.len(), 2, "{found:?}");
        for (found, (x, y, height, half)) in found.iter().zip(stones) {
            assert!((found.top.x - x).abs() <= half && (found.top.y - y).abs() <= half);
            assert!((found.height - height).abs() < 0.05, "{}", found.height);
            assert!(
                (found.area - 4.0 * half * half).abs() < 0.03,
                "{}",
                found.area
            );
            assert_eq!(found.footprint.len(), 4, "{:?}", found.footprint);
        }
    }
}
