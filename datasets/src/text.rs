//! Numbers out of text files.

use std::path::Path;

use barchan_geometry::{Se3, StampedPose, Trajectory};

use crate::DataError;

/// Seconds, one a line; blank lines and those that start with `#` are passed over.
pub(crate) fn read_times(path: &Path) -> Result<Vec<f64>, DataError> {
    let text = std::fs::read_to_string(path).map_err(DataError::io(path))?;
    let lines = text
        .lines()
        .enumerate()
        .filter(|(_, line)| !line.trim().is_empty() && !line.starts_with('#'));
    lines.map(|(i, line)| number(path, i, line)).collect()
}

/// Planar truth (`gt.csv`): a header, then `time,x,y[,...]` in the order that the header gives. Poses
/// stand with z = 0 and no rotation.
///
/// # Errors
/// When the file cannot be read, a column is missing, or a cell is no number.
pub fn read_planar(path: &Path) -> Result<Trajectory, DataError> {
    let rows = read_columns(path, ["time", "x", "y"])?;
    let pose = |[time, x, y]: [f64; 3]| StampedPose {
        time,
        T_world_cam: Se3::translation(x, y, 0.0),
    };
    Ok(Trajectory {
        poses: rows.into_iter().map(pose).collect(),
    })
}

/// The named columns of a table: a header, then numbers separated by commas. Other columns are
/// passed over.
pub(crate) fn read_columns<const N: usize>(
    path: &Path,
    names: [&str; N],
) -> Result<Vec<[f64; N]>, DataError> {
    let text = std::fs::read_to_string(path).map_err(DataError::io(path))?;
    let mut lines = text
        .lines()
        .enumerate()
        .filter(|(_, line)| !line.trim().is_empty());
    let header: Vec<&str> = lines
        .next()
        .map(|(_, l)| l.split(',').map(str::trim).collect())
        .unwrap_or_default();
    let mut columns = [0; N];
    for (column, name) in columns.iter_mut().zip(names) {
        let message = || {
            format!(
                "the header has no column \"{name}\"; expected {}",
                names.join(",")
            )
        };
        *column = header
            .iter()
            .position(|h| *h == name)
            .ok_or_else(|| DataError::file(path, message()))?;
    }
    let mut rows = Vec::new();
    for (i, line) in lines {
        let cells: Vec<&str> = line.split(',').collect();
        let mut row = [0.0; N];
        for (value, column) in row.iter_mut().zip(columns) {
            *value = number(path, i, cells.get(column).unwrap_or(&"nothing"))?;
        }
        rows.push(row);
    }
    Ok(rows)
}

/// A finite number on line `line`, counted from 0.
pub(crate) fn number(path: &Path, line: usize, text: &str) -> Result<f64, DataError> {
    let message = || {
        format!(
            "line {}: expected a number, found \"{}\"",
            line + 1,
            text.trim()
        )
    };
    text.trim()
        .parse()
        .ok()
        .filter(|v: &f64| v.is_finite())
        .ok_or_else(|| DataError::file(path, message()))
}

/// Rows of numbers, separated by commas: the first cell as text and `columns` numbers after it. Blank
/// lines, and those that start with `#`, are passed over. (A time in nanoseconds is more than `f64`
/// holds: it stays text.)
pub(crate) fn read_csv(path: &Path, columns: usize) -> Result<Vec<(String, Vec<f64>)>, DataError> {
    let text = std::fs::read_to_string(path).map_err(DataError::io(path))?;
    let lines = text
        .lines()
        .enumerate()
        .filter(|(_, line)| !line.trim().is_empty() && !line.starts_with('#'));
    let row = |(i, line): (usize, &str)| {
        let mut cells = line.split(',');
        let first = cells.next().unwrap_or_default().trim().to_owned();
        let mut next = || number(path, i, cells.next().unwrap_or("nothing"));
        let numbers = (0..columns).map(|_| next()).collect::<Result<_, _>>()?;
        Ok((first, numbers))
    };
    lines.map(row).collect()
}
