//! Disparity images on disk: 16-bit PNG (value = 256 d, 0 where not known, as KITTI) and PFM
//! (`f32`, rows from the bottom up, not finite where not known, as Middlebury and SceneFlow).

use std::path::Path;

use image::{DynamicImage, ImageBuffer, Luma};

use crate::image_file::{decode, encode_png, write_whole};
use crate::{DataError, Plane};

/// Reads a disparity image by its extension, `.png` or `.pfm`. Unknown pixels are NaN.
///
/// # Errors
/// When the file is missing, damaged, or neither a grey 16-bit PNG nor a grey PFM.
pub fn read(path: &Path) -> Result<Plane, DataError> {
    match path
        .extension()
        .and_then(|e| e.to_str())
        .map(str::to_ascii_lowercase)
        .as_deref()
    {
        Some("png") => read_png(path),
        Some("pfm") => {
            let bytes = std::fs::read(path).map_err(DataError::io(path))?;
            parse_pfm(&bytes).map_err(|message| DataError::file(path, message))
        }
        _ => Err(DataError::file(
            path,
            "not a disparity image: 16-bit .png (256 d) and .pfm are read",
        )),
    }
}

fn read_png(path: &Path) -> Result<Plane, DataError> {
    let DynamicImage::ImageLuma16(stored) = decode(path)? else {
        return Err(DataError::file(
            path,
            "a disparity PNG is grey with 16 bits (value = 256 d); this one is not",
        ));
    };
    let (width, height) = stored.dimensions();
    let values = stored.into_raw().into_iter().map(|v| {
        if v == 0 {
            f32::NAN
        } else {
            f32::from(v) / 256.0
        }
    });
    // One value a pixel by construction.
    Ok(Plane::from_raw(width, height, values.collect()).unwrap_or_default())
}

/// Writes a 16-bit PNG: 256 d rounded, clamped to 1..=65535 (255.996 px), 0 where not known or
/// negative. Whole or not at all.
///
/// # Errors
/// When the file cannot be written.
pub fn write_png(path: &Path, disparity: &Plane) -> Result<(), DataError> {
    write_whole(path, &encode_png(path, &as_png(disparity))?)
}

/// The bytes of the file that [`write_png`] writes; `name` is for messages.
///
/// # Errors
/// When the image has no pixels.
pub fn png_bytes(name: &Path, disparity: &Plane) -> Result<Vec<u8>, DataError> {
    encode_png(name, &as_png(disparity))
}

fn as_png(disparity: &Plane) -> DynamicImage {
    // A known disparity never becomes 0, which would read back as not known.
    let store = |d: &f32| {
        if *d >= 0.0 {
            (256.0 * d).round().clamp(1.0, 65535.0) as u16
        } else {
            0
        }
    };
    let (width, height) = disparity.dimensions();
    let values = disparity.as_raw().iter().map(store).collect();
    // One value a pixel by construction.
    let stored: ImageBuffer<Luma<u16>, _> =
        ImageBuffer::from_raw(width, height, values).unwrap_or_default();
    stored.into()
}

/// Writes a little-endian grey PFM, `inf` where not known. Whole or not at all.
///
/// # Errors
/// When the file cannot be written.
pub fn write_pfm(path: &Path, disparity: &Plane) -> Result<(), DataError> {
    write_whole(path, &pfm_bytes(disparity))
}

/// The bytes of the file that [`write_pfm`] writes.
pub fn pfm_bytes(disparity: &Plane) -> Vec<u8> {
    let (width, height) = disparity.dimensions();
    let mut bytes = format!("Pf\n{width} {height}\n-1.0\n").into_bytes();
    for row in disparity.as_raw().chunks_exact(width.max(1) as usize).rev() {
        for d in row {
            bytes.extend_from_slice(&if d.is_finite() { *d } else { f32::INFINITY }.to_le_bytes());
        }
    }
    bytes
}

/// The grey PFM format: `Pf`, width, height, scale (negative: little endian), one white space,
/// then rows from the bottom up.
fn parse_pfm(bytes: &[u8]) -> Result<Plane, String> {
    let mut rest = bytes;
    let mut word = || -> Option<&str> {
        let start = rest.iter().position(|b| !b.is_ascii_whitespace())?;
        let length = rest[start..].iter().position(u8::is_ascii_whitespace)?;
        let found = &rest[start..start + length];
        rest = &rest[start + length + 1..];
        std::str::from_utf8(found).ok()
    };
    match word() {
        Some("Pf") => {}
        Some("PF") => return Err("a colour PFM; a disparity image is grey (Pf)".into()),
        _ => return Err("not a PFM: it does not start with Pf".into()),
    }
    let mut number = |name: &str| {
        let text = word().unwrap_or("nothing");
        text.parse::<f64>()
            .ok()
            .filter(|v| v.is_finite())
            .ok_or(format!("PFM {name} is {text}, expected a number"))
    };
    let (width, height, scale) = (number("width")?, number("height")?, number("scale")?);
    let whole = |v: f64| v >= 1.0 && v <= f64::from(u16::MAX) && v.fract() == 0.0;
    if !whole(width) || !whole(height) || scale == 0.0 {
        return Err(format!(
            "a PFM of {width} x {height} with scale {scale} cannot be"
        ));
    }
    let (w, h) = (width as usize, height as usize);
    if rest.len() < 4 * w * h {
        return Err(format!(
            "truncated: {w} x {h} pixels take {} bytes, {} are there",
            4 * w * h,
            rest.len()
        ));
    }
    let float = |b: &[u8]| {
        let b = [b[0], b[1], b[2], b[3]];
        let d = if scale < 0.0 {
            f32::from_le_bytes(b)
        } else {
            f32::from_be_bytes(b)
        };
        if d.is_finite() { d } else { f32::NAN }
    };
    let rows = rest[..4 * w * h].chunks_exact(4 * w).rev();
    let values = rows
        .flat_map(|row| row.chunks_exact(4).map(float))
        .collect();
    // One value a pixel by construction.
    Ok(Plane::from_raw(w as u32, h as u32, values).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Plane {
        let values = (0..7 * 5).map(|i| {
            if i % 6 == 5 {
                f32::NAN
            } else {
                0.3 + 7.77 * i as f32
            }
        });
        Plane::from_raw(7, 5, values.collect()).unwrap()
    }

    fn same(a: &Plane, b: &Plane, within: f32) -> bool {
        a.dimensions() == b.dimensions()
            && a.iter()
                .zip(b.iter())
                .all(|(p, q)| (p.is_nan() && q.is_nan()) || (p - q).abs() <= within)
    }

    #[test]
    fn pfm_round_trips_exactly_and_png_to_half_a_step() {
        let dir = tempfile::tempdir().unwrap();
        let (pfm, png) = (dir.path().join("a.pfm"), dir.path().join("a.PNG"));
        write_pfm(&pfm, &sample()).unwrap();
        assert!(same(&read(&pfm).unwrap(), &sample(), 0.0));
        write_png(&png, &sample()).unwrap();
        let bound = sample().map_clamp(65535.0 / 256.0);
        assert!(same(&read(&png).unwrap(), &bound, 0.5 / 256.0 + 1e-4));
    }

    trait MapClamp {
        fn map_clamp(self, max: f32) -> Self;
    }
    impl MapClamp for Plane {
        fn map_clamp(mut self, max: f32) -> Self {
            self.iter_mut()
                .for_each(|d| *d = if d.is_nan() { *d } else { d.min(max) });
            self
        }
    }

    #[test]
    fn png_keeps_known_apart_from_unknown_at_both_ends() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let plane = Plane::from_raw(5, 1, vec![1e-6, 0.0, f32::NAN, 1000.0, -3.0]).unwrap();
        write_png(&path, &plane).unwrap();
        let stored = image::open(&path).unwrap().into_luma16().into_raw();
        assert_eq!(stored, [1, 1, 0, 65535, 0]);
    }

    #[test]
    fn big_endian_pfm_with_infinities_reads_from_the_bottom_up() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.pfm");
        let mut bytes = b"Pf\n2 2\n1.0\n".to_vec();
        for v in [1.5f32, f32::NEG_INFINITY, f32::INFINITY, 4.0] {
            bytes.extend_from_slice(&v.to_be_bytes());
        }
        std::fs::write(&path, &bytes).unwrap();
        let plane = read(&path).unwrap();
        let expected = Plane::from_raw(2, 2, vec![f32::NAN, 4.0, 1.5, f32::NAN]).unwrap();
        assert!(same(&plane, &expected, 0.0));
    }

    #[test]
    fn damaged_files_are_errors_that_name_them() {
        let dir = tempfile::tempdir().unwrap();
        let bad: [&[u8]; 6] = [
            b"",
            b"Pf",
            b"Pf\n2 2\n-1.0\nshort",
            b"PF\n1 1\n-1\n123412341234",
            b"Pf\n1e9 99999\n-1\n",
            b"Pf\nx 2\n-1\n",
        ];
        for (i, bytes) in bad.iter().enumerate() {
            let path = dir.path().join(format!("bad{i}.pfm"));
            std::fs::write(&path, bytes).unwrap();
            let message = read(&path).unwrap_err().to_string();
            assert!(message.contains(&format!("bad{i}.pfm")), "{message}");
        }
        let path = dir.path().join("8bit.png");
        image::GrayImage::new(3, 3).save(&path).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("16 bits"));
    }

    #[test]
    fn middlebury_truth_reads() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../shared/data/middlebury2003/cones/disp2.pfm");
        if !path.exists() {
            println!("skipped: {} is absent", path.display());
            return;
        }
        let plane = read(&path).unwrap();
        assert_eq!(plane.dimensions(), (450, 375));
        let known: Vec<f32> = plane.iter().copied().filter(|d| d.is_finite()).collect();
        assert!(known.iter().all(|d| (0.0..64.0).contains(d)));
        // Cones has its near cones at the bottom: a flipped reader would see the back wall there.
        let mean = |rows: std::ops::Range<u32>| {
            let v: Vec<f32> = rows
                .flat_map(|y| (0..450).map(move |x| (x, y)))
                .map(|(x, y)| plane[(x, y)].0[0])
                .filter(|d| d.is_finite())
                .collect();
            v.iter().sum::<f32>() / v.len() as f32
        };
        assert!(mean(300..375) > mean(0..75) + 10.0);
    }
}
