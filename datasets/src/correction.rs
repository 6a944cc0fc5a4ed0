use std::path::Path;

use barchan_geometry::{RectifiedRig, Trajectory};
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use crate::image_file::write_whole;
use crate::pairs::no_frame;
use crate::resample::remap;
use crate::{DataError, Plane, Rgb, Sensors, StereoFrame, StereoSource};

/// What makes the pairs of a dataset fit together; kept in `correction.toml` beside the images.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Correction {
    /// Left and right images change places (before anything else).
    pub swapped: bool,
    /// The left image of frame `i` goes with the right image of frame `i + right_frame_shift`.
    pub right_frame_shift: i64,
    /// Where a pixel of the corrected right image lies in the (rectified) right image.
    pub right_homography: Matrix3<f64>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CorrectionToml {
    #[serde(default)]
    swapped: bool,
    #[serde(default)]
    right_frame_shift: i64,
    #[serde(default = "identity")]
    right_homography: [[f64; 3]; 3],
}

fn identity() -> [[f64; 3]; 3] {
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
}

impl Correction {
    /// The file that [`crate::open`] honours when it lies in a dataset's folder.
    pub const FILE: &str = "correction.toml";

    /// Reads the file.
    ///
    /// # Errors
    /// When it cannot be read, is not TOML of these fields, or the homography is none.
    pub fn load(path: &Path) -> Result<Self, DataError> {
        let text = std::fs::read_to_string(path).map_err(DataError::io(path))?;
        let cure = "`barchan data check DATA --fix` writes this file; delete it to go without";
        let toml: CorrectionToml = toml::from_str(&text)
            .map_err(|e| DataError::file(path, format!("{}\n  cure: {cure}", e.message())))?;
        let right_homography = Matrix3::from_fn(|i, j| toml.right_homography[i][j]);
        if !right_homography.iter().all(|v| v.is_finite()) || !right_homography.is_invertible() {
            return Err(DataError::file(
                path,
                format!("right_homography has no inverse\n  cure: {cure}"),
            ));
        }
        Ok(Self {
            swapped: toml.swapped,
            right_frame_shift: toml.right_frame_shift,
            right_homography,
        })
    }

    /// Writes the file, whole or not at all.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), DataError> {
        let toml = CorrectionToml {
            swapped: self.swapped,
            right_frame_shift: self.right_frame_shift,
            right_homography: std::array::from_fn(|i| {
                std::array::from_fn(|j| self.right_homography[(i, j)])
            }),
        };
        // A struct of numbers always serialises.
        let text = toml::to_string(&toml).unwrap_or_default();
        let header = "# Written by `barchan data check --fix`. Every command honours it; delete it to undo.\n\
             # right_homography: where a pixel of the corrected right image lies in the rectified one.\n";
        write_whole(path, (header.to_owned() + &text).as_bytes())
    }
}

/// A source whose pairs are put right.
pub struct Corrected {
    source: Box<dyn StereoSource>,
    correction: Correction,
    /// Index in `source` of the first frame whose partner exists.
    first: usize,
    len: usize,
    /// Where each pixel of the right image is taken from; `None` for the identity.
    map: Option<Vec<[f32; 2]>>,
    trajectory: Option<Trajectory>,
}

impl Corrected {
    /// Frames of which one image has no partner any more are left out.
    ///
    /// # Errors
    /// When that leaves none, or when the right images must be bent and are not all of one rig.
    pub fn new(source: Box<dyn StereoSource>, correction: Correction) -> Result<Self, DataError> {
        let bad = |message: String| DataError::Layout {
            spec: Correction::FILE.into(),
            message,
        };
        let shift = correction.right_frame_shift;
        let lost = usize::try_from(shift.unsigned_abs()).unwrap_or(usize::MAX);
        let len = source.len().saturating_sub(lost);
        if len == 0 {
            return Err(bad(format!(
                "a shift of {shift} frames leaves none of {}",
                source.len()
            )));
        }
        let first = if shift < 0 { lost } else { 0 };
        let rig = *source.rig();
        let bends = correction.right_homography != Matrix3::identity();
        if bends && (0..source.len()).any(|i| *source.frame_rig(i) != rig) {
            return Err(bad(
                "the pairs are of several rigs, and one homography cannot mend them all: correct the scenes one by one".into(),
            ));
        }
        let trajectory = source.true_trajectory().map(|truth| Trajectory {
            poses: truth.poses.iter().skip(first).take(len).copied().collect(),
        });
        Ok(Self {
            map: bends.then(|| homography_map(&rig, &correction.right_homography)),
            source,
            correction,
            first,
            len,
            trajectory,
        })
    }
}

/// Positions in the image to be sampled, held at its border within a few pixels of it, so that a
/// small correction leaves no black rim.
fn homography_map(rig: &RectifiedRig, homography: &Matrix3<f64>) -> Vec<[f32; 2]> {
    const HELD: f64 = 16.0;
    let last = [rig.width as f64 - 1.0, rig.height as f64 - 1.0];
    let hold = |v: f64, last: f64| {
        if (-HELD..=last + HELD).contains(&v) {
            v.clamp(0.0, last)
        } else {
            v
        }
    };
    (0..rig.height)
        .flat_map(|y| (0..rig.width).map(move |x| (x, y)))
        .map(|(x, y)| {
            let p = homography * Vector3::new(x as f64, y as f64, 1.0);
            [
                hold(p.x / p.z, last[0]) as f32,
                hold(p.y / p.z, last[1]) as f32,
            ]
        })
        .collect()
}

impl StereoSource for Corrected {
    fn rig(&self) -> &RectifiedRig {
        self.source.rig()
    }

    fn frame_rig(&self, index: usize) -> &RectifiedRig {
        self.source.frame_rig(self.first + index)
    }

    fn len(&self) -> usize {
        self.len
    }

    fn name(&self, index: usize) -> String {
        self.source.name(self.first + index)
    }

    fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
        if index >= self.len {
            return Err(no_frame(index, self.len));
        }
        let sides = |frame: StereoFrame| -> (Rgb, Rgb, f64, String) {
            if self.correction.swapped {
                (frame.right, frame.left, frame.time, frame.name)
            } else {
                (frame.left, frame.right, frame.time, frame.name)
            }
        };
        let at = self.first + index;
        let (left, mut right, time, name) = sides(self.source.frame(at)?);
        if self.correction.right_frame_shift != 0 {
            let partner = at as i64 + self.correction.right_frame_shift;
            right = sides(self.source.frame(partner as usize)?).1;
        }
        if let Some(map) = &self.map {
            right = remap(&right, map);
        }
        Ok(StereoFrame {
            index,
            name,
            time,
            left,
            right,
        })
    }

    fn true_disparity(&self, index: usize) -> Result<Option<Plane>, DataError> {
        if self.correction.swapped {
            self.source.true_disparity_right(self.first + index)
        } else {
            self.source.true_disparity(self.first + index)
        }
    }

    fn true_trajectory(&self) -> Option<&Trajectory> {
        self.trajectory.as_ref()
    }

    fn sensors(&self) -> Option<&Sensors> {
        self.source.sensors()
    }
}
