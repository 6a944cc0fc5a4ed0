//! Terrain out of disparity: clouds, voxels, digital elevation models, shaded relief and their files.
//!
//! What it is for: [`map_keyframes`] turns key frames with disparity into a coloured voxel cloud, a
//! DEM and a hillshade, as Hong 2021, 3.2.2 and 4.3 do; [`elevation`] keeps heights with their
//! uncertainty (Bai 2019); its parts ([`Cloud`], [`VoxelMap`],
//! [`level()`], [`Raster`], [`hillshade()`], PLY and GeoTIFF files) serve alone as well.
//!
//! What it promises: metres; z up in everything levelled; rasters north-up, whose rows run south;
//! NaN is "no data" in memory and -9999 in files; the same input gives the same output, bit by bit;
//! memory bounded by the voxels, not by the length of a sequence; a file appears whole or not at all.
//!
//! What it never does: estimate poses or disparity, fill holes unasked, or invent a coordinate system.

mod atomic;
mod cloud;
mod earthwork;
pub mod elevation;
mod error;
mod fill;
mod geotiff;
mod ghosts;
mod hillshade;
mod las_file;
mod level;
mod map;
mod noise;
mod obstacles;
mod pcd;
mod photometry;
mod ply;
mod raster;
mod rover;
mod slope;
mod surest;
mod voxel;

pub use cloud::{Cloud, CloudPoint, DepthLimits};
pub use earthwork::{Earthwork, earthwork};
pub use error::TerrainError;
pub use fill::{Filled, MAX_FILL, fill};
pub use geotiff::{Crs, Sample, geotiff_bytes, write_geotiff};
pub use hillshade::{Light, hillshade};
pub use level::{Levelled, level};
pub use map::{
    DenseKeyframe, Levelling, MapConfig, StereoErrors, TerrainMap, VoxelScene, colour_gains,
    elevation_of_keyframes, map_keyframes,
};
pub use noise::{
    Coefficient, LookSummary, NoiseBlock, NoiseForm, NoiseModel, NoiseStudy, PlaneLook, PlaneTruth,
    ScenePlane, fit_plane, study_noise,
};
pub use obstacles::{Obstacle, obstacles};
pub use photometry::ColourGains;
pub use raster::{CellStatistic, Dem, Grid, NODATA, Raster, dem};
pub use rover::{RoverLayers, RoverLimits, rover_layers};
pub use slope::{roughness, slope};
pub use voxel::{Voxel, VoxelMap};
