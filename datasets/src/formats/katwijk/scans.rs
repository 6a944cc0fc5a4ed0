//! Range images of the archive: those of the time-of-flight camera and of the laser scanner.

use std::path::{Path, PathBuf};

use barchan_geometry::Se3;
use image::DynamicImage;
use nalgebra::{Point3, Vector3};

use super::tables::stamp;
use crate::DataError;
use crate::image_file::decode;
use crate::listing::list;
use crate::sensor_files::read_mount;

/// A sensor of the rover that measures ranges.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RangeSensor {
    /// SwissRanger SR4500: 176 x 144 rays, its frame as that of a camera (x right, y down, z forward). The archive's own
    /// table of its rays is a MATLAB object; here they are those of a pinhole camera of its 69 by 55 degrees.
    Tof,
    /// Velodyne VLP-16: a row a laser, from 15 degrees up to 15 degrees down; x points to azimuth 0, y to azimuth
    /// 90 degrees, z up.
    Velodyne,
}

/// What a range sensor met, ray by ray.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeScan {
    /// Rays in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Where the rays ended, metres, in the frame of the sensor, row by row; `None` where nothing came back.
    pub points: Vec<Option<Point3<f64>>>,
    /// How much light came back: up to 16383 of the time-of-flight camera, 255 of the scanner. `None` where the archive
    /// has no such image.
    pub intensity: Option<Vec<u16>>,
}

/// Columns of a scan of [`RangeSensor::Velodyne`].
const AZIMUTHS: usize = 1808;
const LASERS: usize = 16;
const TOF_SIZE: [usize; 2] = [176, 144];
/// Fields of view, degrees.
const TOF_VIEW: [f64; 2] = [69.0, 55.0];
/// Metres of a range of 2^14 by the time-of-flight camera, as the archive's own script has it; from `TOF_INVALID` on nothing
/// was measured.
const TOF_REACH: f64 = 9.993_081_93;
const TOF_INVALID: u16 = 16380;

impl RangeSensor {
    /// All, in the order of the archive's list.
    pub const ALL: [Self; 2] = [Self::Tof, Self::Velodyne];

    /// The folder of its images, which is what their names begin with.
    pub fn folder(self) -> &'static str {
        match self {
            Self::Tof => "ToF",
            Self::Velodyne => "Velodyne",
        }
    }

    /// Its scans in a part of a traverse, in the order of time: seconds since 1970, and the image of ranges
    /// (`Velodyne/Velodyne_YYYY_MM_DD_hh_mm_ss_mmm_range.png`). None where the part has no such folder.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub fn scans(self, part: &Path) -> Result<Vec<(f64, PathBuf)>, DataError> {
        let folder = part.join(self.folder());
        if !folder.is_dir() {
            return Ok(Vec::new());
        }
        let time = |stem: &str| {
            let rest = stem.strip_prefix(self.folder())?.strip_prefix('_')?;
            stamp(rest.strip_suffix("_range")?)
        };
        let files = list(&folder, &["png"])?.into_iter();
        let mut scans: Vec<(f64, PathBuf)> = files
            .filter_map(|(stem, path)| Some((time(&stem)?, path)))
            .collect();
        scans.sort_by(|a, b| a.0.total_cmp(&b.0));
        Ok(scans)
    }

    /// Reads a scan by its image of ranges; those of azimuth and intensity lie beside it.
    ///
    /// # Errors
    /// When an image is missing (but for intensity), is not grey, or has not the size that the sensor gives.
    pub fn read(self, range: &Path) -> Result<RangeScan, DataError> {
        let (width, height, ranges) = read_grey(range)?;
        let fits = match self {
            Self::Tof => [width, height] == TOF_SIZE,
            Self::Velodyne => height == LASERS,
        };
        if !fits {
            let expected = match self {
                Self::Tof => "176 x 144",
                Self::Velodyne => "1808 x 16",
            };
            let message = format!(
                "{width} x {height} pixels, and the sensor gives {expected}: unpack the archive again"
            );
            return Err(DataError::file(range, message));
        }
        let beside = |what: &str| {
            let name = range.file_name().unwrap_or_default().to_string_lossy();
            range.with_file_name(name.replace("_range.", &format!("_{what}.")))
        };
        let read = |path: &Path| {
            let (w, h, values) = read_grey(path)?;
            if (w, h) != (width, height) {
                let message = format!("{w} x {h} pixels, and ranges have {width} x {height}");
                return Err(DataError::file(path, message));
            }
            Ok(values)
        };
        let azimuths = match self {
            Self::Tof => Vec::new(),
            Self::Velodyne => read(&beside("azimuth"))?,
        };
        let point = |k: usize| {
            let azimuth = azimuths.get(k).copied().unwrap_or_default();
            let range = self.metres(ranges[k])?;
            Some(Point3::from(
                self.ray(k % width, k / width, azimuth) * range,
            ))
        };
        let intensity = Some(beside("intensity")).filter(|path| path.is_file());
        let intensity = intensity.map(|path| read(&path)).transpose()?;
        Ok(RangeScan {
            width,
            height,
            points: (0..ranges.len()).map(point).collect(),
            intensity,
        })
    }

    /// The pose of the rectified left camera of `LocCam` in the frame of the sensor, where `tof.tum` or `velodyne.tum` in
    /// the part tells it, as `imu.tum` does of the IMU. The archive does not.
    ///
    /// # Errors
    /// When the file cannot be read or holds not one pose.
    #[allow(non_snake_case)]
    pub fn T_sensor_cam(self, part: &Path) -> Result<Option<Se3>, DataError> {
        read_mount(&self.mount_file(part))
    }

    /// Where [`RangeSensor::T_sensor_cam`] is read from.
    pub fn mount_file(self, part: &Path) -> PathBuf {
        part.join(format!("{}.tum", self.folder().to_lowercase()))
    }

    /// Size of a scan that the sensor gives: rays in a row, rows.
    pub(crate) fn size(self) -> [usize; 2] {
        match self {
            Self::Tof => TOF_SIZE,
            Self::Velodyne => [AZIMUTHS, LASERS],
        }
    }

    /// The azimuth of a column where the scanner turns evenly, hundredths of a degree.
    pub(crate) fn azimuth(column: usize) -> u16 {
        (column * 36_000 / AZIMUTHS) as u16
    }

    /// The direction of a ray, of length 1; `azimuth` in hundredths of a degree, of the scanner.
    pub(crate) fn ray(self, column: usize, row: usize, azimuth: u16) -> Vector3<f64> {
        match self {
            Self::Tof => {
                let at = [column, row];
                let tangent = |axis: usize| {
                    let half = (TOF_SIZE[axis] as f64) / 2.0;
                    let edge = (TOF_VIEW[axis] / 2.0).to_radians().tan();
                    (at[axis] as f64 + 0.5 - half) / half * edge
                };
                Vector3::new(tangent(0), tangent(1), 1.0).normalize()
            }
            Self::Velodyne => {
                let up = (15.0 - 2.0 * row as f64).to_radians();
                let around = (f64::from(azimuth) / 100.0).to_radians();
                Vector3::new(up.cos() * around.cos(), up.cos() * around.sin(), up.sin())
            }
        }
    }

    /// A range as the images have it.
    pub(crate) fn count(self, metres: Option<f64>) -> u16 {
        match (self, metres) {
            (Self::Tof, Some(r)) if r < TOF_REACH * f64::from(TOF_INVALID - 1) / 16384.0 => {
                (r / TOF_REACH * 16384.0).round() as u16
            }
            (Self::Tof, _) => 16383,
            (Self::Velodyne, Some(r)) if r < 65.535 => (r * 1000.0).round() as u16,
            (Self::Velodyne, _) => 0,
        }
    }

    fn metres(self, count: u16) -> Option<f64> {
        match self {
            Self::Tof => (count < TOF_INVALID).then(|| f64::from(count) / 16384.0 * TOF_REACH),
            Self::Velodyne => (count > 0).then(|| f64::from(count) / 1000.0),
        }
    }
}

/// Width, height and values of a grey image, as they are stored.
fn read_grey(path: &Path) -> Result<(usize, usize, Vec<u16>), DataError> {
    let image = decode(path)?;
    let (width, height) = (image.width() as usize, image.height() as usize);
    let values = match image {
        DynamicImage::ImageLuma16(grey) => grey.into_raw(),
        DynamicImage::ImageLuma8(grey) => grey.into_raw().into_iter().map(u16::from).collect(),
        _ => {
            let message = "in colour, and the sensor's images are grey: unpack the archive again";
            return Err(DataError::file(path, message));
        }
    };
    Ok((width, height, values))
}
