use std::path::{Path, PathBuf};

/// What can be wrong with a rig or a trajectory. Each message names the file and the cure.
#[derive(Debug, thiserror::Error)]
pub enum GeometryError {
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// `rig.toml` is not TOML, or lacks a field.
    #[error(
        "{path}: not a rig file: {message}\n  cure: see `rig.toml` in the README for every field"
    )]
    RigSyntax {
        /// The file.
        path: PathBuf,
        /// The parser's message, with line and field.
        message: String,
    },
    /// A field of a rig has a value that no camera has.
    #[error("{path}: {field} is {value}, expected {expected}")]
    RigValue {
        /// The file.
        path: PathBuf,
        /// The field.
        field: &'static str,
        /// What it holds.
        value: String,
        /// What it should hold.
        expected: &'static str,
    },
    /// A line of a trajectory file does not parse.
    #[error("{path}:{line}: {message}")]
    Trajectory {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What was expected.
        message: String,
    },
}

impl GeometryError {
    pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Io {
            path: path.to_owned(),
            source,
        }
    }
}
