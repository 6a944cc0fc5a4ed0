use std::path::{Path, PathBuf};

/// Why there is no terrain. Each message names the file or the field, and the cure.
#[derive(Debug, thiserror::Error)]
pub enum TerrainError {
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A point cloud file is not what it should be.
    #[error("{path}: not a PLY point cloud: {message}")]
    Ply {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// A point cloud file of another format is not what it should be.
    #[error("{path}: not a point cloud that can be read or written: {message}")]
    Cloud {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// A raster file is not what it should be.
    #[error("{path}: {message}")]
    Raster {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        message: String,
    },
    /// A setting has a value that makes no sense.
    #[error("{field} is {value}, expected {expected}")]
    Setting {
        /// The setting.
        field: &'static str,
        /// What it holds.
        value: String,
        /// What it should hold.
        expected: &'static str,
    },
    /// The images of a key frame have different sizes, or not the size of the rig.
    #[error("the {what} is {found:?} pixels and the rig {rig:?}: they must be equal")]
    Sizes {
        /// Which image.
        what: &'static str,
        /// Its width and height.
        found: (u32, u32),
        /// Width and height of the rig.
        rig: (usize, usize),
    },
    /// No point was left to make terrain of.
    #[error("no terrain: {0}")]
    Empty(String),
    /// The grid would be absurdly large.
    #[error(
        "a grid of {width} x {height} cells of {cell} m is needed, more than the {limit} allowed\n  \
         cure: a larger cell, or a smaller largest depth"
    )]
    TooLarge {
        /// Cells from west to east.
        width: f64,
        /// Cells from north to south.
        height: f64,
        /// Size of a cell, metres.
        cell: f64,
        /// Cells allowed.
        limit: usize,
    },
}

impl TerrainError {
    pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Io {
            path: path.to_owned(),
            source,
        }
    }
}

/// Refuses a setting that is not a positive, finite number.
pub(crate) fn positive(field: &'static str, value: f64) -> Result<(), TerrainError> {
    if value.is_finite() && value > 0.0 {
        return Ok(());
    }
    Err(TerrainError::Setting {
        field,
        value: value.to_string(),
        expected: "a positive number",
    })
}
