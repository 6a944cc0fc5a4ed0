use std::path::Path;

use anyhow::Result;
use barchan_datasets::StereoSource;
use barchan_geometry::Trajectory;
use barchan_infer::Rejection;
use barchan_report::{Chart, Series, Sheet, Style};
use barchan_terrain::{TerrainMap, Voxel};
use image::RgbImage;

use super::maps::from_above;
use super::{Compared, sampled};
use crate::engine::{EngineSettings, load_engine};
use crate::output::StagedDir;
use crate::preview::{bytes, disparity_picture, disparity_range, dot};

/// `routes.svg`: all routes over the true one.
pub fn routes(
    out: &StagedDir,
    compared: &[Compared],
    truth: Option<Vec<(f64, f64)>>,
) -> Result<()> {
    let line = |name: &str, samples: Vec<(f64, f64)>| Series {
        name: name.into(),
        style: Style::Line,
        samples,
    };
    let estimates = compared.iter().filter(|c| !c.route.is_empty());
    let estimates = estimates.map(|c| line(&c.row.name, c.route.clone()));
    let chart = Chart {
        title: "Routes from above".into(),
        horizontal: "m".into(),
        vertical: "m".into(),
        plan: true,
        series: estimates.chain(truth.map(|t| line("truth", t))).collect(),
    };
    out.write("routes.svg", chart.svg()?)
}

/// `maps.svg`, and each map as `maps/NAME.png`: the ground in colour from above, all over the same place, with the route
/// in red and, where the true ground is known, the true one in white.
pub fn maps(
    out: &StagedDir,
    compared: &[Compared],
    ground: Option<&TerrainMap>,
    truth: Option<&Trajectory>,
) -> Result<()> {
    let true_route = ground
        .zip(truth)
        .map(|(map, t)| from_above(t, &map.T_level_world, [0, 1]));
    let of_truth = ground.map(|map| ("truth", map, None));
    let of_runs = compared.iter().filter_map(|c| {
        let map = c.map.as_ref()?;
        Some((c.row.name.as_str(), map, Some(&c.route_on_map)))
    });
    let all: Vec<_> = of_truth.into_iter().chain(of_runs).collect();
    // What is known for sure says where to look; a run that went astray would make the rest small.
    let Some((_, map, route)) = all.first() else {
        return Ok(());
    };
    let route = route.or(true_route.as_ref());
    let view = View::of(map, route.map_or(&[], |r| r.as_slice()));
    let mut tiles = vec![];
    for (name, map, route) in all {
        let mut picture = view.ground(map);
        if let Some(places) = &true_route {
            view.draw(&mut picture, places, image::Rgb([255; 3]));
        }
        if let Some(places) = route {
            view.draw(&mut picture, places, image::Rgb([230, 20, 20]));
        }
        let file = out.path(format!("maps/{name}.png"))?;
        picture.save(&file)?;
        tiles.push((name.to_owned(), picture));
    }
    let sheet = Sheet {
        title: "The ground from above: route in red, true route in white".into(),
        columns: 4,
        tiles,
    };
    out.write("maps.svg", sheet.svg()?)
}

/// A piece of ground, as a picture shows it.
struct View {
    west: f64,
    north: f64,
    /// Metres a pixel.
    pixel: f64,
    width: u32,
    height: u32,
}

impl View {
    /// Pixels of the longer side.
    const SIDE: f64 = 640.0;

    /// The extent of a map and of a route, and a little around them.
    fn of(map: &TerrainMap, route: &[(f64, f64)]) -> Self {
        let grid = &map.dem.raster.grid;
        let mut west_north = (grid.west, grid.north);
        let mut east_south = (
            grid.west + grid.width as f64 * grid.cell_x,
            grid.north - grid.height as f64 * grid.cell_y,
        );
        for (x, y) in route {
            west_north = (west_north.0.min(*x), west_north.1.max(*y));
            east_south = (east_south.0.max(*x), east_south.1.min(*y));
        }
        let (wide, high) = (east_south.0 - west_north.0, west_north.1 - east_south.1);
        let around = 0.03 * wide.max(high);
        let pixel = (wide.max(high) + 2.0 * around) / Self::SIDE;
        let pixels = |length: f64| ((length + 2.0 * around) / pixel).round().max(1.0) as u32;
        Self {
            west: west_north.0 - around,
            north: west_north.1 + around,
            pixel,
            width: pixels(wide),
            height: pixels(high),
        }
    }

    fn at(&self, x: f64, y: f64) -> (f64, f64) {
        ((x - self.west) / self.pixel, (self.north - y) / self.pixel)
    }

    /// The voxels of a map from above, the higher over the lower.
    fn ground(&self, map: &TerrainMap) -> RgbImage {
        let mut picture = RgbImage::from_pixel(self.width, self.height, image::Rgb([40; 3]));
        let mut voxels: Vec<&Voxel> = map.voxels.iter().collect();
        voxels.sort_by(|a, b| a.mean.z.total_cmp(&b.mean.z));
        let half = (0.5 * map.voxel / self.pixel).round() as i32;
        for voxel in voxels {
            let (x, y) = self.at(voxel.mean.x, voxel.mean.y);
            dot(
                &mut picture,
                x,
                y,
                half,
                image::Rgb(voxel.to_point().colour),
            );
        }
        picture
    }

    /// A line through places.
    fn draw(&self, picture: &mut RgbImage, places: &[(f64, f64)], colour: image::Rgb<u8>) {
        // Beyond the picture by more than its size nothing is to be seen.
        let far = 4.0 * Self::SIDE;
        for ends in places.windows(2) {
            let [(x0, y0), (x1, y1)] = [ends[0], ends[1]].map(|(x, y)| self.at(x, y));
            let steps = (x1 - x0).abs().max((y1 - y0).abs()).ceil().max(1.0);
            if steps > far {
                continue;
            }
            for k in 0..=steps as u32 {
                let share = f64::from(k) / steps;
                dot(
                    picture,
                    x0 + share * (x1 - x0),
                    y0 + share * (y1 - y0),
                    1,
                    colour,
                );
            }
        }
    }
}

/// Frames of `disparities.svg`.
const FRAMES: usize = 4;

/// `disparities.svg`: some left images, what each engine sees in them after rejection, and the truth.
pub fn disparities(
    out: &StagedDir,
    source: &dyn StereoSource,
    (models, settings): (&[String], &EngineSettings),
    runtime: Option<&Path>,
) -> Result<()> {
    let mut engines = vec![];
    for model in models {
        // One that cannot be had has already failed as a run.
        if let Ok(engine) = load_engine(model, runtime, settings) {
            engines.push((model, engine));
        }
    }
    let mut tiles = vec![];
    let mut columns = 1;
    for index in sampled(source, FRAMES) {
        let frame = source.frame(index)?;
        let mut seen = vec![];
        for (model, engine) in &mut engines {
            let mut map = engine.disparity(&frame.left, &frame.right)?;
            Rejection::default().apply(&frame.left, &frame.right, &mut map);
            seen.push((model.to_string(), map.disparity));
        }
        if let Some(truth) = source.true_disparity(index)? {
            seen.push(("truth".into(), truth));
        }
        // One range for a row, of the truth where there is one.
        let range = seen.last().map_or((0.0, 1.0), |(_, d)| disparity_range(d));
        tiles.push((format!("frame {}", frame.name), bytes(&frame.left)));
        columns = 1 + seen.len();
        tiles.extend(
            seen.into_iter()
                .map(|(name, d)| (name, disparity_picture(&d, range))),
        );
    }
    let sheet = Sheet {
        title: "Disparity after rejection: far is blue, near is red, unknown is black".into(),
        columns,
        tiles,
    };
    out.write("disparities.svg", sheet.svg()?)
}
