use std::path::PathBuf;

use anyhow::Result;
use barchan_terrain::{Light, Raster, hillshade};
use clap::{Parser, Subcommand};
use serde::Serialize;

use crate::output::Output;

/// Products of any DEM
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  barchan raster hillshade dem.tif --out hillshade.tif\n  barchan raster hillshade dem.tif --out hillshade.tif --azimuth 300 --altitude 30"
)]
pub struct Args {
    #[command(subcommand)]
    product: Product,
}

#[derive(Subcommand)]
enum Product {
    /// Shaded relief, as gdaldem makes it
    Hillshade {
        /// A GeoTIFF of elevations
        input: PathBuf,
        /// The GeoTIFF that is written
        #[arg(long, value_name = "FILE")]
        out: PathBuf,
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
}

#[derive(Serialize)]
struct Summary {
    out: PathBuf,
    width: usize,
    height: usize,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    let Product::Hillshade {
        input,
        out,
        azimuth,
        altitude,
        z,
    } = args.product;
    let dem = Raster::<f32>::read(&input)?;
    let shaded = hillshade(
        &dem,
        &Light {
            azimuth,
            altitude,
            z,
        },
    );
    shaded.write(&out)?;
    let (width, height) = (shaded.grid.width, shaded.grid.height);
    let text = format!("{}: {width} x {height}", out.display());
    output.result(&Summary { out, width, height }, &text)
}
