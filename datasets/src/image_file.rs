use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, ImageError, ImageFormat, ImageReader};

use crate::{DataError, Rgb};

/// Reads a PNG, JPEG, TIFF, PPM or PGM image of 8 or 16 bits as `f32` in 0..=1. Grey is
/// replicated to three channels; alpha is dropped.
///
/// # Errors
/// When the file is missing, of another format, truncated or corrupt; the message names it.
pub fn read_rgb(path: &Path) -> Result<Rgb, DataError> {
    decode(path).map(|image| image.into_rgb32f())
}

/// [`read_rgb`] of bytes that are in memory already; `name` is for messages.
///
/// # Errors
/// As [`read_rgb`].
pub fn parse_rgb(bytes: &[u8], name: &Path) -> Result<Rgb, DataError> {
    decode_bytes(bytes, name).map(|image| image.into_rgb32f())
}

/// Width and height of an image in memory, from its header; `name` is for messages.
///
/// # Errors
/// When the bytes are no image that [`read_rgb`] reads.
pub fn parse_size(bytes: &[u8], name: &Path) -> Result<(u32, u32), DataError> {
    let reader = ImageReader::with_format(Cursor::new(bytes), format_of(bytes, name)?);
    reader.into_dimensions().map_err(broken(name))
}

/// Most pixels of an image that is read: as `f32` in three channels they take half a gigabyte. A few
/// bytes may claim any size.
const MAX_PIXELS: u64 = 40_000_000;

/// Width and height of an image, from its header.
pub(crate) fn image_size(path: &Path) -> Result<(u32, u32), DataError> {
    let reader = ImageReader::open(path)
        .and_then(ImageReader::with_guessed_format)
        .map_err(DataError::io(path))?;
    reader.into_dimensions().map_err(broken(path))
}

/// Reads an image as its file holds it.
pub(crate) fn decode(path: &Path) -> Result<DynamicImage, DataError> {
    decode_bytes(&std::fs::read(path).map_err(DataError::io(path))?, path)
}

fn decode_bytes(bytes: &[u8], path: &Path) -> Result<DynamicImage, DataError> {
    let format = format_of(bytes, path)?;
    // The JPEG decoder fills the missing part of a truncated file with grey and says nothing.
    if format == ImageFormat::Jpeg && !jpeg_is_complete(bytes) {
        return Err(DataError::file(
            path,
            "the JPEG is truncated; copy it again from its origin",
        ));
    }
    let (width, height) = parse_size(bytes, path)?;
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        return Err(DataError::file(
            path,
            format!(
                "{width} x {height} pixels, and at most {MAX_PIXELS} are read; make it smaller, and its calibration with it"
            ),
        ));
    }
    let reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.decode().map_err(broken(path))
}

fn format_of(bytes: &[u8], path: &Path) -> Result<ImageFormat, DataError> {
    if bytes.is_empty() {
        return Err(DataError::file(
            path,
            "the file is empty; copy it again from its origin",
        ));
    }
    image::guess_format(bytes)
        .map_err(|_| DataError::file(path, "not an image; PNG, JPEG, TIFF, PPM and PGM are read"))
}

fn broken(path: &Path) -> impl Fn(ImageError) -> DataError {
    move |error| {
        DataError::file(
            path,
            format!("truncated or corrupt ({error}); copy it again from its origin"),
        )
    }
}

/// Whether an end-of-image marker follows the last start of scan. Neither occurs inside
/// entropy-coded data, where 0xFF is always followed by 0x00 or a restart marker.
fn jpeg_is_complete(bytes: &[u8]) -> bool {
    let scan = bytes.windows(2).rposition(|pair| pair == [0xFF, 0xDA]);
    scan.is_some_and(|at| bytes[at..].windows(2).any(|pair| pair == [0xFF, 0xD9]))
}

/// Writes `bytes` whole or not at all: under another name first, then renamed.
///
/// # Errors
/// When either step fails; nothing is left then.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), DataError> {
    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    let partial = Path::new(&partial);
    std::fs::write(partial, bytes)
        .and_then(|()| std::fs::rename(partial, path))
        .map_err(|error| {
            // Best effort: the first error is the one to tell.
            let _ = std::fs::remove_file(partial);
            DataError::io(path)(error)
        })
}

/// The bytes of an image as a PNG.
pub(crate) fn encode_png(path: &Path, image: &DynamicImage) -> Result<Vec<u8>, DataError> {
    let mut bytes = Cursor::new(Vec::new());
    image
        .write_to(&mut bytes, ImageFormat::Png)
        .map_err(|error| DataError::file(path, format!("cannot be encoded: {error}")))?;
    Ok(bytes.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ImageBuffer, Luma, Rgb as Pixel, RgbImage};

    fn ramp() -> RgbImage {
        RgbImage::from_fn(37, 23, |x, y| {
            Pixel([(x * 6) as u8, (y * 11) as u8, ((x * y) % 256) as u8])
        })
    }

    #[test]
    fn lossless_formats_give_the_exact_values() {
        let dir = tempfile::tempdir().unwrap();
        for extension in ["png", "tif", "ppm"] {
            let path = dir.path().join(format!("a.{extension}"));
            ramp().save(&path).unwrap();
            let read = read_rgb(&path).unwrap();
            assert_eq!(read.dimensions(), (37, 23));
            for (r, w) in read.as_raw().iter().zip(ramp().as_raw()) {
                assert_eq!(*r, f32::from(*w) / 255.0);
            }
        }
    }

    #[test]
    fn grey_of_8_and_16_bits_is_replicated_and_scaled_to_one() {
        let dir = tempfile::tempdir().unwrap();
        let (g8, g16) = (dir.path().join("8.pgm"), dir.path().join("16.png"));
        ImageBuffer::from_fn(5, 4, |x, _| Luma([(x * 60) as u8]))
            .save(&g8)
            .unwrap();
        ImageBuffer::from_fn(5, 4, |x, _| Luma([(x * 60 * 257) as u16]))
            .save(&g16)
            .unwrap();
        let (a, b) = (read_rgb(&g8).unwrap(), read_rgb(&g16).unwrap());
        for (x, _, p) in a.enumerate_pixels() {
            assert!(
                p.0.iter()
                    .all(|v| (v - x as f32 * 60.0 / 255.0).abs() < 1e-6)
            );
        }
        for (p, q) in a.as_raw().iter().zip(b.as_raw()) {
            assert!((p - q).abs() < 1e-6);
        }
    }

    #[test]
    fn sixteen_bits_of_grey_and_colour_are_read_from_every_format_that_has_them() {
        let dir = tempfile::tempdir().unwrap();
        for extension in ["png", "tif", "pgm", "ppm"] {
            let path = dir.path().join(format!("deep.{extension}"));
            let value = |x: u32, y: u32, c: u32| (x * 5003 + y * 977 + c * 211) as u16;
            if extension != "ppm" {
                let grey = ImageBuffer::from_fn(11, 6, |x, y| Luma([value(x, y, 0)]));
                grey.save(&path).unwrap();
                assert_eq!(image_size(&path).unwrap(), (11, 6));
                for (x, y, p) in read_rgb(&path).unwrap().enumerate_pixels() {
                    let expected = f32::from(value(x, y, 0)) / 65535.0;
                    assert!(
                        p.0.iter().all(|v| (v - expected).abs() < 1e-7),
                        "{extension}"
                    );
                }
            }
            if extension != "pgm" {
                let at = |x, y| Pixel([0, 1, 2].map(|c| value(x, y, c)));
                ImageBuffer::from_fn(11, 6, at).save(&path).unwrap();
                for (x, y, p) in read_rgb(&path).unwrap().enumerate_pixels() {
                    for c in 0..3 {
                        let expected = f32::from(value(x, y, c)) / 65535.0;
                        assert!((p.0[c as usize] - expected).abs() < 1e-7, "{extension}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_truncated_file_of_any_format_is_an_error_that_names_it() {
        let dir = tempfile::tempdir().unwrap();
        for extension in ["png", "jpg", "tif", "ppm"] {
            let path = dir.path().join(format!("cut.{extension}"));
            RgbImage::from_fn(120, 80, |x, y| Pixel([((x * 31) ^ (y * 17)) as u8; 3]))
                .save(&path)
                .unwrap();
            let whole = std::fs::read(&path).unwrap();
            for part in [
                0,
                1,
                10,
                whole.len() / 3,
                whole.len() / 2,
                whole.len() * 9 / 10,
            ] {
                std::fs::write(&path, &whole[..part]).unwrap();
                let message = read_rgb(&path).unwrap_err().to_string();
                assert!(
                    message.contains(&format!("cut.{extension}")),
                    "{part} bytes: {message}"
                );
            }
        }
        let message = read_rgb(&dir.path().join("absent.png"))
            .unwrap_err()
            .to_string();
        assert!(message.contains("absent.png"), "{message}");
    }
}
