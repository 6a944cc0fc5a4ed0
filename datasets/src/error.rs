use std::path::{Path, PathBuf};

use barchan_geometry::GeometryError;

/// Why a dataset cannot be read. Each message names the file and the cure.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// The dataset's specification or layout is not understood.
    #[error("{spec}: {message}")]
    Layout {
        /// What was asked for.
        spec: String,
        /// What was looked for and not found, and what to do.
        message: String,
    },
    /// A file of the dataset is missing, damaged or of another size.
    #[error("{path}: {message}")]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it and what to do.
        message: String,
    },
    /// The rig or a trajectory of the dataset is wrong.
    #[error(transparent)]
    Geometry(#[from] GeometryError),
}

impl DataError {
    /// Something is wrong with a file.
    pub(crate) fn file(path: &Path, message: impl Into<String>) -> Self {
        Self::File {
            path: path.to_owned(),
            message: message.into(),
        }
    }

    /// The system refused a file.
    pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |error| Self::file(path, error.to_string())
    }
}
