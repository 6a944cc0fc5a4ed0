use std::fs::File;
use std::io::{BufReader, Cursor, Read, Seek, SeekFrom, Write};
use std::path::Path;

use laz::{LasZipCompressor, LasZipDecompressor, LazItem, LazItemRecordBuilder, LazVlr};
use nalgebra::Point3;

use crate::atomic::write_atomically;
use crate::{Cloud, CloudPoint, TerrainError};

/// Coordinates in LAS files are whole multiples of this, metres.
const RESOLUTION: f64 = 1e-4;
/// Bytes of a LAS 1.2 header.
const HEADER: usize = 227;
/// Bytes before the content of a variable length record.
const RECORD_HEADER: usize = 54;
/// Bytes of a point of format 2: coordinates, intensity, flags, colour.
const POINT: usize = 26;
/// Bytes of points read at once, about.
const CHUNK: usize = 1 << 21;

impl Cloud {
    /// Writes LAS 1.2, point format 2: coordinates to 0.1 mm, colour in 16 bits; compressed (LAZ) when
    /// the name ends in `.laz`. Opens in CloudCompare, QGIS and PDAL.
    ///
    /// # Errors
    /// When the file cannot be written (an older one of that name then stays as it was), or a point
    /// lies farther than 200 km from the first.
    pub fn write_las(&self, path: &Path) -> Result<(), TerrainError> {
        let bad = |message: String| file_error(path, message);
        let count = u32::try_from(self.points.len())
            .map_err(|_| bad("more than 4294967295 points".into()))?;
        // Whole metres, so that the same place is the same number in every file.
        let origin = self
            .points
            .first()
            .map_or(Point3::origin(), |p| p.position.map(f64::round));
        let (mut low, mut high) = ([i32::MAX; 3], [i32::MIN; 3]);
        let mut points = Vec::with_capacity(POINT * self.points.len());
        for p in &self.points {
            let steps = (p.position - origin) / RESOLUTION;
            for (k, step) in steps.iter().enumerate() {
                let step = step.round();
                if step.is_nan() || step.abs() >= f64::from(i32::MAX) {
                    return Err(bad(format!(
                        "{} is too far from the first point",
                        p.position
                    )));
                }
                let step = step as i32;
                low[k] = low[k].min(step);
                high[k] = high[k].max(step);
                points.extend(step.to_le_bytes());
            }
            // Intensity 0; return 1 of 1; never classified; no angle, user data and source.
            points.extend([0, 0, 0b0000_1001, 0, 0, 0, 0, 0]);
            // Upper and lower halves agree: both ways of making 8 bits of them are exact.
            points.extend(p.colour.iter().flat_map(|c| [*c, *c]));
        }
        let compressed = path
            .extension()
            .is_some_and(|e| e.eq_ignore_ascii_case("laz"));
        let mut record = vec![];
        let vlr = compressed
            .then(|| LazItemRecordBuilder::default_for_point_format_id(2, 0))
            .transpose()
            .map_err(|e| bad(e.to_string()))?
            .map(LazVlr::from_laz_items);
        if let Some(vlr) = &vlr {
            vlr.write_to(&mut record).map_err(TerrainError::io(path))?;
        }

        let start = HEADER
            + if compressed {
                RECORD_HEADER + record.len()
            } else {
                0
            };
        let mut file = Vec::with_capacity(start + points.len());
        file.extend(b"LASF");
        file.extend([0; 20]); // source, encoding, no GUID
        file.extend([1, 2]);
        file.extend(padded::<32>(b"OTHER"));
        file.extend(padded::<32>(b"Barchan"));
        // No date: the same cloud is the same file.
        file.extend([0; 4]);
        file.extend((HEADER as u16).to_le_bytes());
        file.extend((start as u32).to_le_bytes());
        file.extend(u32::from(compressed).to_le_bytes());
        file.push(if compressed { 2 | 0x80 } else { 2 });
        file.extend((POINT as u16).to_le_bytes());
        file.extend(
            [count, count, 0, 0, 0, 0]
                .iter()
                .flat_map(|n| n.to_le_bytes()),
        );
        file.extend([RESOLUTION; 3].iter().flat_map(|x| x.to_le_bytes()));
        file.extend(origin.iter().flat_map(|x| x.to_le_bytes()));
        for k in 0..3 {
            for step in [high[k], low[k]] {
                let step = if count == 0 { 0 } else { step };
                file.extend((origin[k] + f64::from(step) * RESOLUTION).to_le_bytes());
            }
        }
        if compressed {
            file.extend([0; 2]);
            file.extend(padded::<16>(LazVlr::USER_ID.as_bytes()));
            file.extend(LazVlr::RECORD_ID.to_le_bytes());
            file.extend((record.len() as u16).to_le_bytes());
            file.extend(padded::<32>(LazVlr::DESCRIPTION.as_bytes()));
            file.extend(&record);
        }
        if let Some(vlr) = vlr {
            let mut cursor = Cursor::new(file);
            cursor.set_position(start as u64);
            let mut compressor =
                LasZipCompressor::new(cursor, vlr).map_err(|e| bad(e.to_string()))?;
            compressor
                .compress_many(&points)
                .and_then(|()| compressor.done())
                .map_err(TerrainError::io(path))?;
            file = compressor.into_inner().into_inner();
        } else {
            file.extend(points);
        }
        write_atomically(path, |out| {
            out.write_all(&file).map_err(TerrainError::io(path))
        })
    }

    /// Reads coordinates and colour of a LAS or LAZ file, versions 1.0 to 1.4.
    ///
    /// # Errors
    /// When the file cannot be read or is damaged.
    pub fn read_las(path: &Path) -> Result<Self, TerrainError> {
        let bad = |message: &str| file_error(path, message.to_owned());
        let io = |_| bad("it ends too early");
        let mut file = File::open(path).map_err(TerrainError::io(path))?;
        let mut header = [0; HEADER];
        file.read_exact(&mut header).map_err(io)?;
        if &header[..4] != b"LASF" {
            return Err(bad("it does not begin with LASF"));
        }
        let u16_at = |b: &[u8], k: usize| u16::from_le_bytes([b[k], b[k + 1]]);
        let u32_at = |b: &[u8], k: usize| u32::from_le_bytes([b[k], b[k + 1], b[k + 2], b[k + 3]]);
        let f64_at = |k: usize| f64::from_le_bytes(std::array::from_fn(|i| header[k + i]));
        let header_size = u64::from(u16_at(&header, 94));
        let (start, records) = (u64::from(u32_at(&header, 96)), u32_at(&header, 100));
        let (format, compressed) = (header[104] & 0x3f, header[104] & 0x80 != 0);
        let size = usize::from(u16_at(&header, 105));
        let mut left = u64::from(u32_at(&header, 107));
        if header[25] >= 4 && left == 0 {
            // LAS 1.4 counts in 64 bits at byte 247.
            let mut wide = [0; 8];
            file.seek(SeekFrom::Start(247)).map_err(io)?;
            file.read_exact(&mut wide).map_err(io)?;
            left = u64::from_le_bytes(wide);
        }
        let colour_at = match format {
            2 => Some(20),
            3 | 5 => Some(28),
            7 | 8 | 10 => Some(30),
            0 | 1 | 4 | 6 | 9 => None,
            _ => return Err(bad("its point format is unknown")),
        };
        if size < colour_at.map_or(12, |c| c + 6) {
            return Err(bad("its points are shorter than their format"));
        }
        let mut laszip = None;
        file.seek(SeekFrom::Start(header_size)).map_err(io)?;
        for _ in 0..records {
            let mut head = [0; RECORD_HEADER];
            file.read_exact(&mut head).map_err(io)?;
            let mut content = vec![0; usize::from(u16_at(&head, 20))];
            file.read_exact(&mut content).map_err(io)?;
            let user = LazVlr::USER_ID.as_bytes();
            if &head[2..2 + user.len()] == user && u16_at(&head, 18) == LazVlr::RECORD_ID {
                laszip = Some(content);
            }
        }
        let length = file.metadata().map_err(TerrainError::io(path))?.len();
        // The decompressor would make room for as many as the file claims. A chunk begins with a whole point.
        if compressed && chunks(&mut file, start).map_err(io)? > length / size as u64 {
            return Err(bad("it claims more chunks than it has bytes for"));
        }
        file.seek(SeekFrom::Start(start)).map_err(io)?;
        let source = BufReader::with_capacity(1 << 20, file);
        let mut source = match (compressed, laszip) {
            (false, _) => Points::Plain(source),
            (true, None) => return Err(bad("it is compressed and does not say how")),
            (true, Some(content)) => {
                let vlr = LazVlr::from_buffer(&content).map_err(|e| bad(&e.to_string()))?;
                if !items_are_those_of(&vlr, format, size) {
                    return Err(bad(
                        "its compressed points are not those of its point format",
                    ));
                }
                Points::Packed(
                    LasZipDecompressor::new(source, vlr).map_err(|e| bad(&e.to_string()))?,
                )
            }
        };
        let mut points = vec![];
        while left > 0 {
            let count = left.min((CHUNK / size).max(1) as u64) as usize;
            let mut bytes = vec![0; count * size];
            match &mut source {
                Points::Plain(file) => file.read_exact(&mut bytes).map_err(io)?,
                Points::Packed(packed) => packed.decompress_many(&mut bytes).map_err(io)?,
            }
            for p in bytes.chunks_exact(size) {
                let axis = |k: usize| {
                    let step = u32_at(p, 4 * k) as i32;
                    f64::from(step) * f64_at(131 + 8 * k) + f64_at(155 + 8 * k)
                };
                let colour = colour_at.map_or([0; 3], |c| [0, 1, 2].map(|k| p[c + 2 * k + 1]));
                points.push(CloudPoint {
                    position: Point3::new(axis(0), axis(1), axis(2)),
                    colour,
                    sigma: f32::NAN,
                });
            }
            left -= count as u64;
        }
        Ok(Self { points })
    }
}

/// Whether a file is compressed as its point format says: the decompressor believes every item its size.
fn items_are_those_of(vlr: &LazVlr, format: u8, size: usize) -> bool {
    let of = |extra| LazItemRecordBuilder::default_for_point_format_id(format, extra);
    let sizes = |items: &[LazItem]| items.iter().map(|i| usize::from(i.size())).sum::<usize>();
    let extra = of(0).map(|plain| size.checked_sub(sizes(&plain)));
    let Ok(Some(Ok(expected))) = extra.map(|e| e.map(|e| of(e as u16))) else {
        return false;
    };
    // Versions of an item differ between writers, its kind and size do not.
    let kind = |i: &LazItem| (i.item_type(), i.size());
    expected.iter().map(kind).eq(vlr.items().iter().map(kind))
}

/// Where points are read from.
enum Points<'a> {
    Plain(BufReader<File>),
    Packed(LasZipDecompressor<'a, BufReader<File>>),
}

/// A text in a field of `N` bytes, the rest of them 0.
fn padded<const N: usize>(text: &[u8]) -> [u8; N] {
    std::array::from_fn(|i| text.get(i).copied().unwrap_or(0))
}

fn file_error(path: &Path, message: String) -> TerrainError {
    TerrainError::Cloud {
        path: path.to_owned(),
        message,
    }
}

/// How many chunks a compressed file claims to have: beside their table, whose place stands before the points,
/// or at the end of the file where a writer could not go back. 0 where there is no table.
fn chunks(file: &mut File, start: u64) -> std::io::Result<u64> {
    let mut place = [0; 8];
    file.seek(SeekFrom::Start(start))?;
    file.read_exact(&mut place)?;
    if i64::from_le_bytes(place) <= start as i64 {
        file.seek(SeekFrom::End(-8))?;
        file.read_exact(&mut place)?;
    }
    let table = i64::from_le_bytes(place);
    if table <= start as i64 {
        return Ok(0);
    }
    // A version stands first.
    file.seek(SeekFrom::Start(table as u64 + 4))?;
    let mut count = [0; 4];
    file.read_exact(&mut count)?;
    Ok(u64::from(u32::from_le_bytes(count)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clouds_round_trip_to_a_tenth_of_a_millimetre() {
        let dir = tempfile::tempdir().unwrap();
        let points = (0..5000).map(|i| {
            let t = f64::from(i);
            CloudPoint {
                position: [4e5 + t.sin() * 30.0, 5e6 - t * 0.01, 100.0 + t.cos()].into(),
                colour: [(i % 256) as u8, (i / 7 % 256) as u8, 255],
                sigma: f32::NAN,
            }
        });
        let cloud = Cloud {
            points: points.collect(),
        };
        let mut sizes = vec![];
        for name in ["a.las", "a.LAZ"] {
            let path = dir.path().join(name);
            cloud.write_las(&path).unwrap();
            sizes.push(std::fs::metadata(&path).unwrap().len());
            let back = Cloud::read_las(&path).unwrap();
            assert_eq!(back.points.len(), 5000);
            for (a, b) in cloud.points.iter().zip(&back.points) {
                assert!((a.position - b.position).abs().max() <= 0.51 * RESOLUTION);
                assert_eq!(a.colour, b.colour);
            }
        }
        assert!(sizes[1] * 2 < sizes[0], "{sizes:?}");
    }

    #[test]
    fn what_is_no_las_file_is_refused_by_name() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("broken.laz");
        let one = CloudPoint {
            position: [1.0, 2.0, 3.0].into(),
            colour: [0; 3],
            sigma: f32::NAN,
        };
        Cloud {
            points: vec![one; 99],
        }
        .write_las(&path)
        .unwrap();
        let whole = std::fs::read(&path).unwrap();
        for length in [0, 3, 100, 230, 300, whole.len() / 2] {
            std::fs::write(&path, &whole[..length]).unwrap();
            let error = Cloud::read_las(&path).unwrap_err().to_string();
            assert!(error.contains("broken.laz"), "{length}: {error}");
        }
        std::fs::write(&path, b"LASF, but no more").unwrap();
        let far = Cloud {
            points: vec![
                CloudPoint {
                    position: [0.0; 3].into(),
                    colour: [0; 3],
                    sigma: f32::NAN,
                },
                CloudPoint {
                    position: [1e9, 0.0, 0.0].into(),
                    colour: [0; 3],
                    sigma: f32::NAN,
                },
            ],
        };
        assert!(far.write_las(&path).is_err());
        assert_eq!(std::fs::read(&path).unwrap(), b"LASF, but no more");
        // No point at all is a file too.
        Cloud::default().write_las(&path).unwrap();
        assert!(Cloud::read_las(&path).unwrap().points.is_empty());
    }
}
