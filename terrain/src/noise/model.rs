//! The forms of noise (specification, section 9) and the file that holds one.

use serde::{Deserialize, Serialize};

use super::{NoiseBlock, mean};
use crate::elevation::SensorModel;
use crate::{CloudPoint, TerrainError};

/// Which noise model a study fits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NoiseForm {
    /// Disparity and bearing are off: a stereo camera.
    Stereo {
        /// Focal length, pixels.
        focal: f64,
        /// Metres between the cameras.
        baseline: f64,
    },
    /// `a + b (z - c)^2` along the optical axis, `l z` across.
    StructuredLight,
    /// A deviation along the beam, one that grows with the range across.
    Laser,
}

/// A fitted noise model, as `noise.toml` holds it. What of a sensor it does not say (where that stands, its focal
/// length) comes from the run that it is used with.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum NoiseModel {
    /// A stereo camera and its matcher.
    Stereo {
        /// Deviation of disparity, pixels: noise and systematic part together.
        disparity: f64,
        /// Deviation of where in the image a disparity belongs, pixels.
        pixel: f64,
        /// Systematic part of the deviation of disparity, pixels.
        systematic: f64,
        /// Share of the variance of disparity that is systematic.
        shared: f64,
    },
    /// See [`SensorModel::StructuredLight`].
    StructuredLight {
        /// Constant term, metres.
        a: f64,
        /// Factor of the square, 1/m.
        b: f64,
        /// Depth of least noise, metres.
        c: f64,
        /// Factor of the power.
        #[serde(default)]
        d: f64,
        /// Exponent of the power.
        #[serde(default)]
        e: f64,
        /// Lateral deviation a metre of depth.
        l: f64,
    },
    /// See [`SensorModel::Laser`].
    Laser {
        /// Deviation along the beam, metres.
        range: f64,
        /// Radius of the beam where it starts, metres.
        constant: f64,
        /// Growth of the radius a metre.
        angle: f64,
    },
}

impl NoiseModel {
    /// The sensor model of an elevation map. A stereo model is one of pixels: a focal length in pixels and a
    /// baseline in metres make it one of metres.
    pub fn sensor(&self, focal: f64, baseline: f64) -> SensorModel {
        match *self {
            Self::Stereo {
                pixel,
                systematic,
                shared,
                ..
            } => SensorModel::Stereo {
                focal,
                baseline,
                pixel,
                systematic,
                shared,
            },
            Self::StructuredLight { a, b, c, d, e, l } => {
                SensorModel::StructuredLight { a, b, c, d, e, l }
            }
            Self::Laser {
                range,
                constant,
                angle,
            } => SensorModel::Laser {
                range,
                constant,
                angle,
            },
        }
    }

    /// Refuses what no sensor has.
    ///
    /// # Errors
    /// When a coefficient is negative or not finite; the message names it.
    pub fn check(&self) -> Result<(), TerrainError> {
        let named: Vec<(&'static str, f64)> = match *self {
            Self::Stereo {
                disparity,
                pixel,
                systematic,
                shared,
            } => vec![
                ("disparity", disparity),
                ("pixel", pixel),
                ("systematic", systematic),
                ("shared", shared),
            ],
            Self::StructuredLight { a, b, c, d, e, l } => {
                vec![("a", a), ("b", b), ("c", c), ("d", d), ("e", e), ("l", l)]
            }
            Self::Laser {
                range,
                constant,
                angle,
            } => vec![("range", range), ("constant", constant), ("angle", angle)],
        };
        for (field, value) in named {
            let most = if field == "shared" {
                1.0
            } else {
                f64::INFINITY
            };
            if !(value.is_finite() && (0.0..=most).contains(&value)) {
                return Err(TerrainError::Setting {
                    field,
                    value: value.to_string(),
                    expected: "a number of 0 or more, and a share of at most 1",
                });
            }
        }
        Ok(())
    }
}

impl NoiseForm {
    /// What is fitted: the name of each coefficient, a published value, and whether only tilted looks show it.
    pub(super) fn coefficients(&self) -> &'static [(&'static str, f64, bool)] {
        match self {
            Self::Stereo { .. } => &[("disparity", 0.25, false), ("pixel", 1.0, true)],
            // As `SensorModel::KINECT`.
            Self::StructuredLight => &[
                ("a", 0.0012, false),
                ("b", 0.0019, false),
                ("c", 0.4, false),
                ("l", 0.001_376_915, true),
            ],
            // As `SensorModel::LASER`.
            Self::Laser => &[
                ("range", 0.018, false),
                ("constant", 0.0015, true),
                ("angle", 0.0006, true),
            ],
        }
    }

    /// The model of coefficients in that order; nothing in it is systematic.
    pub(super) fn model(&self, values: &[f64]) -> NoiseModel {
        match self {
            Self::Stereo { .. } => NoiseModel::Stereo {
                disparity: values[0],
                pixel: values[1],
                systematic: 0.0,
                shared: 0.0,
            },
            Self::StructuredLight => NoiseModel::StructuredLight {
                a: values[0],
                b: values[1],
                c: values[2],
                d: 0.0,
                e: 1.0,
                l: values[3],
            },
            Self::Laser => NoiseModel::Laser {
                range: values[0],
                constant: values[1],
                angle: values[2],
            },
        }
    }

    /// Variance, square metres, that a model states for the distance of a block's points from their plane.
    pub(super) fn variance(&self, model: &NoiseModel, block: &NoiseBlock) -> f64 {
        let (focal, baseline) = match *self {
            Self::Stereo { focal, baseline } => (focal, baseline),
            // Models in metres need neither.
            Self::StructuredLight | Self::Laser => (1.0, 1.0),
        };
        let sigma = match *model {
            NoiseModel::Stereo { disparity, .. } => {
                disparity * block.mean.z.powi(2) / (focal * baseline)
            }
            _ => f64::NAN,
        };
        let point = CloudPoint {
            position: block.mean,
            colour: [0; 3],
            sigma: sigma as f32,
        };
        let covariance = model.sensor(focal, baseline).covariance(&point);
        let normal = block.plane.normal;
        normal.dot(&((covariance.random + covariance.systematic) * normal))
    }

    /// A model with what blocks have in common added: to stereo, the others have no word for it.
    pub(super) fn with_systematic(&self, model: NoiseModel, blocks: &[NoiseBlock]) -> NoiseModel {
        let (
            Self::Stereo { focal, baseline },
            NoiseModel::Stereo {
                disparity, pixel, ..
            },
        ) = (*self, model)
        else {
            return model;
        };
        // dz/dd = z^2 / (f b), and a metre across the plane is z / distance of depth.
        let squared = blocks.iter().map(|b| {
            let pixels = focal * baseline / (b.plane.distance * b.mean.z);
            b.systematic() * pixels * pixels
        });
        let systematic = mean(squared).max(0.0);
        let total = disparity * disparity + systematic;
        NoiseModel::Stereo {
            disparity: total.sqrt(),
            pixel,
            systematic: systematic.sqrt(),
            shared: systematic / total,
        }
    }
}
