//! How far a measured point may be off, by the kind of sensor.

use nalgebra::{Matrix3, Point3};
use serde::{Deserialize, Serialize};

use crate::CloudPoint;

/// Covariance of a point, metres squared, in the sensor frame (z is depth).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointCovariance {
    /// What one more look of its own averages away.
    pub random: Matrix3<f64>,
    /// What every look has in common (calibration, matching that favours some fractions of a pixel):
    /// no number of looks makes it smaller.
    pub systematic: Matrix3<f64>,
}

/// A noise model (Fankhauser's elevation_mapping has the same four, Bai 2019 uses structured light).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum SensorModel {
    /// Disparity propagated to first order: its deviation comes with each point
    /// ([`CloudPoint::sigma`], which the network's own sigma makes), so the covariance is full.
    Stereo {
        /// Focal length, pixels.
        focal: f64,
        /// Metres between the cameras.
        baseline: f64,
        /// Deviation of where in the image a point is seen, pixels: matching looks at windows.
        pixel: f64,
        /// Deviation of the disparity's error that all looks share at least, pixels.
        systematic: f64,
        /// Share of the variance of disparity that all looks share: what matching gets wrong at a place
        /// it gets wrong again from a metre on.
        shared: f64,
    },
    /// `normal = a + b (z - c)^2 + d z^e`, `lateral = l z`, metres.
    StructuredLight {
        /// Constant term.
        a: f64,
        /// Factor of the square.
        b: f64,
        /// Depth of least noise.
        c: f64,
        /// Factor of the power.
        d: f64,
        /// Exponent of the power.
        e: f64,
        /// Lateral deviation a metre of depth.
        l: f64,
    },
    /// A beam: deviation `range` along it, `constant + angle * range` across.
    Laser {
        /// Deviation along the beam, metres.
        range: f64,
        /// Radius of the beam where it starts, metres.
        constant: f64,
        /// Growth of the radius a metre.
        angle: f64,
    },
    /// No noise at all, for tests and for rendered truth.
    Perfect,
}

impl SensorModel {
    /// Kinect v1, after Nguyen, Izadi and Lovell 2012; valid from 0.35 to 3 m.
    pub const KINECT: Self = Self::StructuredLight {
        a: 0.0012,
        b: 0.0019,
        c: 0.4,
        d: 0.0,
        e: 1.0,
        l: 0.001_376_915,
    };
    /// RealSense D435 as elevation_mapping ships it; valid from 0.2 to 3.25 m.
    pub const D435: Self = Self::StructuredLight {
        a: 0.000_611,
        b: 0.003_587,
        c: 0.3515,
        d: 0.0,
        e: 1.0,
        l: 0.015_76,
    };
    /// A Hokuyo-like line scanner as elevation_mapping ships it.
    pub const LASER: Self = Self::Laser {
        range: 0.018,
        constant: 0.0015,
        angle: 0.0006,
    };

    /// Covariance of a point of the sensor frame.
    pub fn covariance(&self, point: &CloudPoint) -> PointCovariance {
        let p = point.position;
        let z = p.z;
        let along_sight = |relative: f64| p.coords * p.coords.transpose() * (relative * relative);
        match *self {
            Self::Stereo {
                focal,
                baseline,
                pixel,
                systematic,
                shared,
            } => {
                // dp/dd = -p / d, so an error of disparity moves a point along its line of sight:
                // by sigma_z / z = sigma_d / d of its distance.
                let across = (pixel * z / focal).powi(2);
                let sigma = f64::from(point.sigma) / z;
                let floor = systematic * z / (focal * baseline);
                PointCovariance {
                    random: along_sight(sigma * (1.0 - shared).max(0.0).sqrt())
                        + Matrix3::from_diagonal(&[across, across, 0.0].into()),
                    systematic: along_sight(floor.max(sigma * shared.sqrt())),
                }
            }
            Self::StructuredLight { a, b, c, d, e, l } => {
                let normal = a + b * (z - c).powi(2) + d * z.powf(e);
                let lateral = (l * z).powi(2);
                independent(Matrix3::from_diagonal(
                    &[lateral, lateral, normal * normal].into(),
                ))
            }
            Self::Laser {
                range,
                constant,
                angle,
            } => {
                let beam = beam_direction(&p);
                let across = (constant + angle * p.coords.norm()).powi(2);
                independent(Matrix3::identity() * across + beam * (range * range - across))
            }
            Self::Perfect => independent(Matrix3::zeros()),
        }
    }
}

fn independent(random: Matrix3<f64>) -> PointCovariance {
    PointCovariance {
        random,
        systematic: Matrix3::zeros(),
    }
}

/// The projector onto the line of sight; zero at the sensor itself.
fn beam_direction(p: &Point3<f64>) -> Matrix3<f64> {
    match p.coords.try_normalize(1e-12) {
        Some(beam) => beam * beam.transpose(),
        None => Matrix3::zeros(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use barchan_geometry::RectifiedRig;

    fn at(x: f64, y: f64, z: f64, sigma: f64) -> CloudPoint {
        CloudPoint {
            position: Point3::new(x, y, z),
            colour: [0; 3],
            sigma: sigma as f32,
        }
    }

    #[test]
    fn structured_light_has_the_published_deviation() {
        // Nguyen 2012: 1.9, 6.1 and 14.0 mm at 1, 2 and 3 m.
        for (z, millimetres) in [(1.0, 1.9), (2.0, 6.1), (3.0, 14.0)] {
            let covariance = SensorModel::KINECT.covariance(&at(0.2, 0.1, z, f64::NAN));
            let normal = 1e3 * covariance.random[(2, 2)].sqrt();
            assert!((normal - millimetres).abs() < 0.06, "{z} m: {normal} mm");
        }
    }

    #[test]
    fn stereo_is_the_covariance_of_the_geometry_crate() {
        let rig = RectifiedRig {
            width: 640,
            height: 480,
            fx: 400.0,
            fy: 400.0,
            cx: 320.0,
            cy: 240.0,
            doffs: 0.0,
            baseline: 0.2,
        };
        let model = SensorModel::Stereo {
            focal: 400.0,
            baseline: 0.2,
            pixel: 0.7,
            systematic: 0.0,
            shared: 0.0,
        };
        for (x, y, z) in [(0.0, 0.0, 2.0), (0.8, -0.3, 3.0), (-2.0, 1.0, 9.0)] {
            let sigma_z = 0.5 * z * z / 80.0;
            let ours = model.covariance(&at(x, y, z, sigma_z)).random;
            let theirs = rig.point_covariance(&Point3::new(x, y, z), 0.7, 0.5);
            assert!(
                (ours - theirs).norm() < 1e-6 * theirs.norm(),
                "{ours} {theirs}"
            );
        }
        // Hong 2021's rig: 6 mm at 1 m, 25 mm at 2 m, 0.63 m at 10 m for half a pixel.
        let shared = SensorModel::Stereo {
            focal: 400.0,
            baseline: 0.2,
            pixel: 0.0,
            systematic: 0.5,
            shared: 0.0,
        };
        for (z, metres) in [(1.0, 0.00625), (2.0, 0.025), (10.0, 0.625)] {
            let c = shared.covariance(&at(0.0, 0.0, z, 0.0));
            assert!((c.systematic[(2, 2)].sqrt() - metres).abs() < 1e-12);
            assert_eq!(c.random, Matrix3::zeros());
        }
    }

    #[test]
    fn a_beam_is_uncertain_along_itself() {
        let p = at(3.0, -4.0, 12.0, f64::NAN);
        let c = SensorModel::LASER.covariance(&p).random;
        let beam = p.position.coords.normalize();
        let across = beam.cross(&nalgebra::Vector3::z()).normalize();
        assert!((beam.dot(&(c * beam)).sqrt() - 0.018).abs() < 1e-12);
        assert!((across.dot(&(c * across)).sqrt() - (0.0015 + 0.0006 * 13.0)).abs() < 1e-12);
        assert_eq!(SensorModel::Perfect.covariance(&p).random, Matrix3::zeros());
    }
}
