use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_terrain::{
    Light, Raster, RoverLimits, earthwork, fill, hillshade, obstacles, roughness, rover_layers,
    slope, write_geotiff,
};
use clap::{Args as ClapArgs, Parser, Subcommand};
use serde::Serialize;
use serde_json::{Value, json};

use crate::output::Output;

/// Products of any DEM
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan raster hillshade dem.tif --out hillshade.tif --azimuth 300 --altitude 30\n  \
    barchan raster rover dem.tif --wheel-radius 0.1 --max-slope 15 --out rover.tif\n  \
    barchan raster obstacles dem.tif --min-height 0.15 --out obstacles.geojson\n  \
    barchan raster earthwork after/elevation.tif --target before/elevation.tif --polygon pit.geojson")]
pub struct Args {
    #[command(subcommand)]
    product: Product,
}

#[derive(ClapArgs)]
struct Files {
    /// A GeoTIFF of elevations, metres; of several bands the first
    input: PathBuf,
    /// The file that is written
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

#[derive(ClapArgs)]
struct Rover {
    /// Radius of the wheels, metres: what they climb
    #[arg(long, default_value_t = RoverLimits::default().wheel_radius, value_name = "M")]
    wheel_radius: f64,
    /// Steepest ground, degrees
    #[arg(long, default_value_t = RoverLimits::default().max_slope, value_name = "DEG")]
    max_slope: f64,
    /// Edge of the square the rover stands on, metres
    #[arg(long, default_value_t = RoverLimits::default().footprint, value_name = "M")]
    footprint: f64,
}

impl From<Rover> for RoverLimits {
    fn from(r: Rover) -> Self {
        Self {
            wheel_radius: r.wheel_radius,
            max_slope: r.max_slope,
            footprint: r.footprint,
        }
    }
}

#[derive(Subcommand)]
enum Product {
    /// Shaded relief, as gdaldem makes it
    Hillshade {
        #[command(flatten)]
        files: Files,
        /// Where the light comes from, degrees clockwise from north
        #[arg(long, default_value_t = Light::default().azimuth)]
        azimuth: f64,
        /// Height of the light above the horizon, degrees
        #[arg(long, default_value_t = Light::default().altitude)]
        altitude: f64,
        /// Vertical exaggeration
        #[arg(long, default_value_t = Light::default().z)]
        z: f64,
    },
    /// Slope in degrees, as gdaldem makes it
    Slope(Files),
    /// Highest less lowest of a cell and its neighbours, as gdaldem makes it
    Roughness(Files),
    /// Small holes filled from their surroundings; a second band marks what was filled
    Fill {
        #[command(flatten)]
        files: Files,
        /// How far values are carried, cells: 1 to 3
        #[arg(long, default_value_t = barchan_terrain::MAX_FILL)]
        reach: usize,
    },
    /// Layers for a rover: obstacle height, step, slope, and 1 where it can drive
    Rover {
        #[command(flatten)]
        files: Files,
        #[command(flatten)]
        rover: Rover,
    },
    /// Obstacles with place, height and outline, as GeoJSON in the coordinates of the DEM
    Obstacles {
        #[command(flatten)]
        files: Files,
        /// Lowest obstacle, metres
        #[arg(long, default_value_t = 0.1, value_name = "M")]
        min_height: f64,
        #[command(flatten)]
        rover: Rover,
    },
    /// Cut and fill against another DEM or a level; with elevation.tif also how far they may be off
    Earthwork {
        /// The surface: a GeoTIFF of elevations
        input: PathBuf,
        /// What it is compared with: another GeoTIFF in the same frame, or a height in metres
        #[arg(long, value_name = "FILE|M", allow_hyphen_values = true)]
        target: String,
        /// Counts inside this polygon only: GeoJSON, the first outer ring
        #[arg(long, value_name = "FILE")]
        polygon: Option<PathBuf>,
    },
}

#[derive(Serialize)]
struct Summary {
    out: PathBuf,
    width: usize,
    height: usize,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    let said = |dem: &Raster<f32>, out: PathBuf| {
        let (width, height) = (dem.grid.width, dem.grid.height);
        let text = format!("{}: {width} x {height}", out.display());
        output.result(&Summary { out, width, height }, &text)
    };
    let read = |path: &Path| Raster::<f32>::read(path);
    match args.product {
        Product::Hillshade {
            files,
            azimuth,
            altitude,
            z,
        } => {
            let dem = read(&files.input)?;
            let light = Light {
                azimuth,
                altitude,
                z,
            };
            hillshade(&dem, &light).write(&files.out)?;
            said(&dem, files.out)
        }
        Product::Slope(files) => {
            let dem = read(&files.input)?;
            slope(&dem).write(&files.out)?;
            said(&dem, files.out)
        }
        Product::Roughness(files) => {
            let dem = read(&files.input)?;
            roughness(&dem).write(&files.out)?;
            said(&dem, files.out)
        }
        Product::Fill { files, reach } => {
            let dem = read(&files.input)?;
            let filled = fill(&dem, reach)?;
            let bands: [(&str, &[f32]); 2] = [
                ("elevation", &filled.raster.values),
                ("filled", &filled.mask),
            ];
            write_geotiff(&files.out, &dem.grid, dem.crs.as_ref(), &bands)?;
            said(&dem, files.out)
        }
        Product::Rover { files, rover } => {
            let dem = read(&files.input)?;
            let layers = rover_layers(&dem, &rover.into())?;
            let bands: [(&str, &[f32]); 4] = [
                ("obstacle", &layers.obstacle),
                ("step", &layers.step),
                ("slope", &layers.slope),
                ("traversable", &layers.traversable),
            ];
            write_geotiff(&files.out, &dem.grid, dem.crs.as_ref(), &bands)?;
            said(&dem, files.out)
        }
        Product::Obstacles {
            files,
            min_height,
            rover,
        } => {
            let dem = read(&files.input)?;
            let layers = rover_layers(&dem, &rover.into())?;
            let found = obstacles(&dem, &layers, min_height);
            let features: Vec<Value> = found
                .iter()
                .map(|o| {
                    // GeoJSON repeats the first corner at the end.
                    let ring: Vec<_> = o.footprint.iter().chain(o.footprint.first()).collect();
                    json!({
                        "type": "Feature",
                        "geometry": {"type": "Polygon", "coordinates": [ring]},
                        "properties": {
                            "x": o.top.x, "y": o.top.y, "z": o.top.z,
                            "height": o.height, "area": o.area,
                        },
                    })
                })
                .collect();
            let text = json!({"type": "FeatureCollection", "features": features}).to_string();
            std::fs::write(&files.out, text + "\n")
                .with_context(|| files.out.display().to_string())?;
            let highest = found.first().map_or(String::new(), |o| {
                format!(", the highest {:.2} m", o.height)
            });
            let text = format!(
                "{}: {} obstacles of at least {min_height} m{highest}",
                files.out.display(),
                found.len()
            );
            output.result(&json!({"out": files.out, "obstacles": found.len()}), &text)
        }
        Product::Earthwork {
            input,
            target,
            polygon,
        } => moved_earth(&input, &target, polygon.as_deref(), output),
    }
}

fn moved_earth(input: &Path, target: &str, polygon: Option<&Path>, output: &Output) -> Result<()> {
    let (surface, surface_variance) = with_variance(input)?;
    let (target, target_variance) = match target.parse::<f32>() {
        Ok(level) => (vec![level; surface.values.len()], None),
        Err(_) => {
            let (other, variance) = with_variance(Path::new(target))?;
            let onto = |r: &Raster<f32>| r.onto(&surface.grid).values;
            (onto(&other), variance.map(|v| onto(&v)))
        }
    };
    let variance = surface_variance.map(|v| match &target_variance {
        None => v.values,
        Some(t) => v.values.iter().zip(t).map(|(a, b)| a + b).collect(),
    });
    let ring = polygon.map(read_ring).transpose()?;
    let work = earthwork(&surface, &target, variance.as_deref(), ring.as_deref())
        .with_context(|| input.display().to_string())?;
    let mut text = format!(
        "cut       {:.3} m3\nfill      {:.3} m3\nnet       {:+.3} m3\narea      {:.2} m2 ({:.2} m2 inside are unknown and not counted)",
        work.cut, work.fill, work.net, work.area, work.unknown_area
    );
    if let (Some(least), Some(most)) = (work.sigma_independent, work.sigma_together) {
        text += &format!(
            "\ndeviation of the net volume: {least:.3} m3 if cells err independently, {most:.3} m3 if they err together"
        );
    }
    output.result(&work, &text)
}

/// The first band, and the band `variance` where there is one.
fn with_variance(path: &Path) -> Result<(Raster<f32>, Option<Raster<f32>>)> {
    let mut bands = Raster::<f32>::read_bands(path)?;
    let variance = bands.iter().position(|(name, _)| name == "variance");
    let variance = variance.map(|k| bands.swap_remove(k).1);
    Ok((bands.swap_remove(0).1, variance))
}

/// The outer ring of the first polygon in a GeoJSON file.
fn read_ring(path: &Path) -> Result<Vec<[f64; 2]>> {
    let context = || path.display().to_string();
    let text = std::fs::read_to_string(path).with_context(context)?;
    let file: Value = serde_json::from_str(&text).with_context(context)?;
    let geometry = [&file["features"][0]["geometry"], &file["geometry"], &file]
        .into_iter()
        .find(|g| g["type"] == "Polygon");
    let ring = geometry.and_then(|g| g["coordinates"][0].as_array());
    let point = |p: &Value| Some([p[0].as_f64()?, p[1].as_f64()?]);
    match ring.and_then(|r| r.iter().map(point).collect()) {
        Some(points) => Ok(points),
        None => bail!(
            "{}: holds no GeoJSON Polygon\n  cure: draw one in QGIS in the frame of the DEM and export it as GeoJSON",
            path.display()
        ),
    }
}
