use std::io::Write;
use std::path::Path;

use crate::atomic::write_atomically;
use crate::{Cloud, TerrainError};

impl Cloud {
    /// Writes a binary PCD 0.7: `x y z` and packed `rgb`, as the Point Cloud Library has it.
    ///
    /// # Errors
    /// When the file cannot be written; an older file of that name then stays as it was.
    pub fn write_pcd(&self, path: &Path) -> Result<(), TerrainError> {
        let n = self.points.len();
        let header = format!(
            "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\n\
             TYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
        );
        write_atomically(path, |out| {
            let mut write = || -> std::io::Result<()> {
                out.write_all(header.as_bytes())?;
                for p in &self.points {
                    for x in p.position.iter() {
                        out.write_all(&(*x as f32).to_le_bytes())?;
                    }
                    let [r, g, b] = p.colour;
                    // The bits of a float are those of the number 0x00rrggbb.
                    out.write_all(&[b, g, r, 0])?;
                }
                Ok(())
            };
            write().map_err(TerrainError::io(path))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CloudPoint;

    #[test]
    fn the_bytes_are_those_of_the_format() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.pcd");
        let point = CloudPoint {
            position: [1.5, -2.25, 0.125].into(),
            colour: [10, 20, 30],
            sigma: f32::NAN,
        };
        let cloud = Cloud {
            points: vec![point, point],
        };
        cloud.write_pcd(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let mark = b"DATA binary\n";
        let start = bytes.windows(mark.len()).position(|w| w == mark).unwrap() + mark.len();
        let data = &bytes[start..];
        assert_eq!(data.len(), 2 * 16);
        let float = |k: usize| f32::from_le_bytes(data[4 * k..4 * k + 4].try_into().unwrap());
        assert_eq!([float(4), float(5), float(6)], [1.5, -2.25, 0.125]);
        assert_eq!(float(7).to_bits(), 0x000a_141e);
        let header = String::from_utf8_lossy(&bytes[..start]).into_owned();
        assert!(header.contains("WIDTH 2\n") && header.contains("POINTS 2\n"));
    }
}
