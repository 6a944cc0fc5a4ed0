use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use crate::TerrainError;

/// Writes a file under a temporary name beside `path` and renames it when whole, so that whoever
/// looks finds the old file, none, or all of the new one.
pub(crate) fn write_atomically(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<(), TerrainError>,
) -> Result<(), TerrainError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let part = path.with_file_name(format!(".{name}.{}.part", std::process::id()));
    let file = File::create(&part).map_err(TerrainError::io(path))?;
    let mut out = BufWriter::with_capacity(1 << 20, file);
    let written = write(&mut out)
        .and_then(|()| out.flush().map_err(TerrainError::io(path)))
        .and_then(|()| out.get_ref().sync_all().map_err(TerrainError::io(path)))
        .and_then(|()| std::fs::rename(&part, path).map_err(TerrainError::io(path)));
    if written.is_err() {
        // The first error is the one to report; a leftover that cannot be removed adds nothing.
        let _ = std::fs::remove_file(&part);
    }
    written
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        write_atomically(&path, |w| {
            w.write_all(b"old").map_err(TerrainError::io(&path))
        })
        .unwrap();
        let failed = write_atomically(&path, |w| {
            w.write_all(b"half").map_err(TerrainError::io(&path))?;
            Err(TerrainError::Empty("stopped".into()))
        });
        assert!(failed.is_err());
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
        let nowhere = dir.path().join("none/a.txt");
        let error = write_atomically(&nowhere, |_| Ok(()))
            .unwrap_err()
            .to_string();
        assert!(error.contains("a.txt"), "{error}");
    }
}
