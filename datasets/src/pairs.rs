use std::path::{Path, PathBuf};
use std::sync::Arc;

use barchan_geometry::nalgebra::UnitQuaternion;
use barchan_geometry::{Rectification, RectifiedRig, Rig, Trajectory};
use image::DynamicImage;

use crate::image_file::{decode, image_size};
use crate::resample::remap;
use crate::{DataError, Plane, Rgb, Sensors, StereoFrame, StereoSource, disparity_file, read_rgb};

/// What every format on disk opens to: a list of image pairs, each read when it is asked for,
/// with the rig of each pair and what truth there is. Images of a rig that is not rectified are
/// rectified on reading.
pub struct PairSource {
    pairs: Vec<Pair>,
    /// Calibration of the first pair.
    calibrated: Arc<Calibrated>,
    truth: Option<Trajectory>,
    sensors: Option<Sensors>,
}

/// The files of one pair.
pub(crate) struct Pair {
    pub name: String,
    /// Seconds.
    pub time: f64,
    pub left: PathBuf,
    pub right: PathBuf,
    pub calibrated: Arc<Calibrated>,
    pub disparity: Option<TrueDisparity>,
    pub disparity_right: Option<TrueDisparity>,
}

/// A file of true disparity, and how its values are meant.
pub(crate) struct TrueDisparity {
    pub path: PathBuf,
    pub coding: Coding,
}

/// How a file stores disparity.
#[derive(Clone, Copy)]
pub(crate) enum Coding {
    /// As [`disparity_file`] reads it.
    Plain,
    /// The same, of either sign (SceneFlow).
    EitherSign,
    /// Grey of 8 bits: disparity times a factor, 0 where not known (Middlebury 2003 and 2006).
    /// PFM files of the same place hold the disparity itself.
    Grey { factor: f32 },
}

/// A rig, and the maps that rectify its images where they need it.
pub(crate) struct Calibrated {
    /// The file that the size of the images was read from, for messages.
    origin: PathBuf,
    /// Size of the images on disk.
    stored: (u32, u32),
    rig: RectifiedRig,
    rectification: Option<Rectification>,
}

impl Calibrated {
    /// `origin` is the file that the rig comes from, `image` any image that it took.
    ///
    /// # Errors
    /// When the rig is not rectified and the image is of another size.
    pub fn new(rig: &Rig, origin: &Path, image: &Path) -> Result<Arc<Self>, DataError> {
        let stored = (rig.width as u32, rig.height as u32);
        let (rectified, rectification) = match rig.as_rectified() {
            Some(rectified) => (rectified, None),
            None => {
                // The maps are as large as the calibration says: it had better be true.
                same_size(image, image_size(image)?, stored, origin)?;
                let rectification = Rectification::new(rig);
                (rectification.rig, Some(rectification))
            }
        };
        Ok(Arc::new(Self {
            origin: origin.to_owned(),
            stored,
            rig: rectified,
            rectification,
        }))
    }

    /// Turns points of the left camera as calibrated into the rectified left camera.
    #[allow(non_snake_case)]
    pub fn R_rect_left(&self) -> UnitQuaternion<f64> {
        self.rectification
            .as_ref()
            .map_or_else(UnitQuaternion::identity, |r| r.R_rect_left)
    }

    fn read(&self, path: &Path) -> Result<Rgb, DataError> {
        let image = read_rgb(path)?;
        same_size(path, image.dimensions(), self.stored, &self.origin)?;
        Ok(image)
    }
}

impl PairSource {
    /// # Errors
    /// When there is no pair; `dir` is what was opened.
    pub(crate) fn new(dir: &Path, pairs: Vec<Pair>) -> Result<Self, DataError> {
        let first = pairs
            .first()
            .ok_or_else(|| DataError::file(dir, "holds no image pair"))?;
        Ok(Self {
            calibrated: first.calibrated.clone(),
            pairs,
            truth: None,
            sensors: None,
        })
    }

    /// Adds the true trajectory: one pose a pair, of the rectified left camera.
    pub(crate) fn with_truth(self, truth: Option<Trajectory>) -> Self {
        Self { truth, ..self }
    }

    /// Adds what else was measured.
    pub(crate) fn with_sensors(self, sensors: Option<Sensors>) -> Self {
        Self { sensors, ..self }
    }

    fn pair(&self, index: usize) -> Result<&Pair, DataError> {
        self.pairs
            .get(index)
            .ok_or_else(|| no_frame(index, self.pairs.len()))
    }
}

/// Nobody should ask for a frame beyond the end, but asking must not panic.
pub(crate) fn no_frame(index: usize, len: usize) -> DataError {
    DataError::Layout {
        spec: format!("frame {index}"),
        message: format!("there are {len} frames, counted from 0"),
    }
}

impl StereoSource for PairSource {
    fn rig(&self) -> &RectifiedRig {
        &self.calibrated.rig
    }

    fn frame_rig(&self, index: usize) -> &RectifiedRig {
        self.pairs
            .get(index)
            .map_or(self.rig(), |pair| &pair.calibrated.rig)
    }

    fn len(&self) -> usize {
        self.pairs.len()
    }

    fn name(&self, index: usize) -> String {
        self.pairs
            .get(index)
            .map_or_else(String::new, |pair| pair.name.clone())
    }

    fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
        let pair = self.pair(index)?;
        let mut left = pair.calibrated.read(&pair.left)?;
        let mut right = pair.calibrated.read(&pair.right)?;
        if let Some(maps) = &pair.calibrated.rectification {
            left = remap(&left, &maps.left_map);
            right = remap(&right, &maps.right_map);
        }
        Ok(StereoFrame {
            index,
            name: pair.name.clone(),
            time: pair.time,
            left,
            right,
        })
    }

    fn true_disparity(&self, index: usize) -> Result<Option<Plane>, DataError> {
        let pair = self.pair(index)?;
        read_disparity(pair.disparity.as_ref(), &pair.calibrated)
    }

    fn true_disparity_right(&self, index: usize) -> Result<Option<Plane>, DataError> {
        let pair = self.pair(index)?;
        read_disparity(pair.disparity_right.as_ref(), &pair.calibrated)
    }

    fn true_trajectory(&self) -> Option<&Trajectory> {
        self.truth.as_ref()
    }

    fn sensors(&self) -> Option<&Sensors> {
        self.sensors.as_ref()
    }
}

fn read_disparity(
    truth: Option<&TrueDisparity>,
    calibrated: &Calibrated,
) -> Result<Option<Plane>, DataError> {
    let Some(TrueDisparity { path, coding }) = truth else {
        return Ok(None);
    };
    let is_pfm = path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("pfm"));
    let plane = match coding {
        Coding::Grey { factor } if !is_pfm => read_grey(path, *factor)?,
        Coding::Plain | Coding::Grey { .. } => disparity_file::read(path)?,
        Coding::EitherSign => {
            let mut plane = disparity_file::read(path)?;
            plane.iter_mut().for_each(|d| *d = d.abs());
            plane
        }
    };
    same_size(
        path,
        plane.dimensions(),
        (calibrated.rig.width as u32, calibrated.rig.height as u32),
        &calibrated.origin,
    )?;
    Ok(Some(plane))
}

fn read_grey(path: &Path, factor: f32) -> Result<Plane, DataError> {
    let DynamicImage::ImageLuma8(stored) = decode(path)? else {
        return Err(DataError::file(
            path,
            "this disparity image is grey with 8 bits in the layout of Middlebury; this one is not",
        ));
    };
    let (width, height) = stored.dimensions();
    let values = stored.into_raw().into_iter().map(|v| {
        if v == 0 {
            f32::NAN
        } else {
            f32::from(v) / factor
        }
    });
    // One value a pixel by construction.
    Ok(Plane::from_raw(width, height, values.collect()).unwrap_or_default())
}

fn same_size(
    path: &Path,
    found: (u32, u32),
    rig: (u32, u32),
    origin: &Path,
) -> Result<(), DataError> {
    if found == rig {
        return Ok(());
    }
    let message = format!(
        "the image is {} x {}, but {} says {} x {}: every image of both sides has the size of the calibration",
        found.0,
        found.1,
        origin.display(),
        rig.0,
        rig.1
    );
    Err(DataError::file(path, message))
}
