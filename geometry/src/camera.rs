use nalgebra::{Point3, Vector2};
use serde::{Deserialize, Serialize};

/// How a lens bends rays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Distortion {
    /// None: an ideal pinhole, or an image already rectified.
    Pinhole,
    /// Brown-Conrady, as OpenCV: `k1 k2 p1 p2 k3`.
    RadTan([f64; 5]),
    /// Kannala-Brandt fisheye, as OpenCV: `k1 k2 k3 k4`.
    Equidistant([f64; 4]),
}

/// One camera: focal lengths and principal point in pixels, and its lens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point x, pixels, pixel centres at integers.
    pub cx: f64,
    /// Principal point y, pixels.
    pub cy: f64,
    /// The lens.
    pub distortion: Distortion,
}

/// A camera as `rig.toml` spells it.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CameraToml {
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
    #[serde(default = "pinhole")]
    pub model: String,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub distortion: Vec<f64>,
}

fn pinhole() -> String {
    "pinhole".into()
}

impl Camera {
    /// A camera without distortion.
    pub fn pinhole(fx: f64, fy: f64, cx: f64, cy: f64) -> Self {
        Self {
            fx,
            fy,
            cx,
            cy,
            distortion: Distortion::Pinhole,
        }
    }

    /// The pixel at which a point of the camera frame appears; `None` behind the camera.
    pub fn project(&self, p_cam: &Point3<f64>) -> Option<Vector2<f64>> {
        if p_cam.z <= 0.0 {
            return None;
        }
        let bent = self.distort(Vector2::new(p_cam.x / p_cam.z, p_cam.y / p_cam.z));
        Some(Vector2::new(
            self.fx * bent.x + self.cx,
            self.fy * bent.y + self.cy,
        ))
    }

    /// Bends normalised image coordinates as the lens does.
    pub fn distort(&self, n: Vector2<f64>) -> Vector2<f64> {
        match self.distortion {
            Distortion::Pinhole => n,
            Distortion::RadTan([k1, k2, p1, p2, k3]) => {
                let r2 = n.norm_squared();
                let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                Vector2::new(
                    n.x * radial + 2.0 * p1 * n.x * n.y + p2 * (r2 + 2.0 * n.x * n.x),
                    n.y * radial + p1 * (r2 + 2.0 * n.y * n.y) + 2.0 * p2 * n.x * n.y,
                )
            }
            Distortion::Equidistant([k1, k2, k3, k4]) => {
                let r = n.norm();
                if r < 1e-12 {
                    return n;
                }
                let theta = r.atan();
                let t2 = theta * theta;
                let bent = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
                n * (bent / r)
            }
        }
    }

    /// The radius of normalised coordinates up to which the lens model is one to one: beyond it
    /// the radial polynomial folds back and far rays would appear inside the image.
    pub(crate) fn folds_at(&self) -> f64 {
        let slope = |r: f64| match self.distortion {
            Distortion::Pinhole => 1.0,
            Distortion::RadTan([k1, k2, _, _, k3]) => {
                let r2 = r * r;
                1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3))
            }
            Distortion::Equidistant([k1, k2, k3, k4]) => {
                let t2 = r.atan().powi(2);
                1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
            }
        };
        // A ray of radius 10 stands 84 degrees off the axis: no rectified image reaches further.
        (0..1000)
            .map(|i| f64::from(i) * 0.01)
            .find(|r| slope(*r) <= 0.0)
            .unwrap_or(f64::INFINITY)
    }

    /// The normalised coordinates whose [`Camera::distort`] is `bent`, by fixed-point iteration
    /// (as OpenCV's `undistortPoints`). Converges for lenses that are one to one over the image.
    pub fn undistort(&self, bent: Vector2<f64>) -> Vector2<f64> {
        let mut n = bent;
        for _ in 0..50 {
            let step = bent - self.distort(n);
            n += step;
            if step.norm() < 1e-14 {
                break;
            }
        }
        n
    }

    /// The normalised ray (z = 1) through a pixel.
    pub fn ray(&self, pixel: Vector2<f64>) -> Vector2<f64> {
        self.undistort(Vector2::new(
            (pixel.x - self.cx) / self.fx,
            (pixel.y - self.cy) / self.fy,
        ))
    }

    pub(crate) fn from_toml(toml: &CameraToml) -> Result<Self, String> {
        let d = &toml.distortion;
        let distortion = match (toml.model.as_str(), d.len()) {
            ("pinhole", 0) => Distortion::Pinhole,
            ("radtan", 4) => Distortion::RadTan([d[0], d[1], d[2], d[3], 0.0]),
            ("radtan", 5) => Distortion::RadTan([d[0], d[1], d[2], d[3], d[4]]),
            ("equidistant", 4) => Distortion::Equidistant([d[0], d[1], d[2], d[3]]),
            ("pinhole" | "radtan" | "equidistant", n) => {
                return Err(format!(
                    "model \"{}\" with {n} distortion coefficients; pinhole takes 0, radtan 4 or 5, equidistant 4",
                    toml.model
                ));
            }
            (other, _) => {
                return Err(format!(
                    "model \"{other}\" is not one of pinhole, radtan, equidistant"
                ));
            }
        };
        Ok(Self {
            fx: toml.fx,
            fy: toml.fy,
            cx: toml.cx,
            cy: toml.cy,
            distortion,
        })
    }

    pub(crate) fn to_toml(self) -> CameraToml {
        let (model, distortion) = match self.distortion {
            Distortion::Pinhole => ("pinhole", vec![]),
            Distortion::RadTan(k) => ("radtan", k.to_vec()),
            Distortion::Equidistant(k) => ("equidistant", k.to_vec()),
        };
        CameraToml {
            fx: self.fx,
            fy: self.fy,
            cx: self.cx,
            cy: self.cy,
            model: model.into(),
            distortion,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undistort_inverts_distort() {
        let katwijk = Distortion::RadTan([-0.360, 0.169, 0.001, -0.0005, -0.02]);
        let fisheye = Distortion::Equidistant([-0.01, 0.02, -0.003, 0.0005]);
        for distortion in [Distortion::Pinhole, katwijk, fisheye] {
            let camera = Camera {
                distortion,
                ..Camera::pinhole(800.0, 810.0, 500.0, 400.0)
            };
            for (x, y) in [(0.0, 0.0), (0.3, -0.2), (-0.5, 0.4)] {
                let n = Vector2::new(x, y);
                let back = camera.undistort(camera.distort(n));
                assert!((back - n).norm() < 1e-10, "{distortion:?} {n} {back}");
            }
        }
    }

    #[test]
    fn radtan_matches_a_value_worked_by_hand() {
        // x=0.5 y=0.25, r2=0.3125, radial=1+0.1*0.3125-0.05*0.3125^2
        let camera = Camera {
            distortion: Distortion::RadTan([0.1, -0.05, 0.01, 0.02, 0.0]),
            ..Camera::pinhole(1.0, 1.0, 0.0, 0.0)
        };
        let radial: f64 = 1.0 + 0.03125 - 0.05 * 0.09765625;
        let x = 0.5 * radial + 2.0 * 0.01 * 0.125 + 0.02 * (0.3125 + 0.5);
        let y = 0.25 * radial + 0.01 * (0.3125 + 0.125) + 2.0 * 0.02 * 0.125;
        let got = camera.distort(Vector2::new(0.5, 0.25));
        assert!((got - Vector2::new(x, y)).norm() < 1e-15);
    }

    #[test]
    fn a_lens_folds_where_its_radius_turns_back() {
        let camera = |k| Camera {
            distortion: Distortion::RadTan([k, 0.0, 0.0, 0.0, 0.0]),
            ..Camera::pinhole(1.0, 1.0, 0.0, 0.0)
        };
        // d/dr (r + k r^3) = 0 at r = 1/sqrt(-3 k).
        assert!((camera(-0.3).folds_at() - (1.0f64 / 0.9).sqrt()).abs() < 0.011);
        assert_eq!(camera(0.3).folds_at(), f64::INFINITY);
    }

    #[test]
    fn nothing_projects_from_behind() {
        let camera = Camera::pinhole(1.0, 1.0, 0.0, 0.0);
        assert!(camera.project(&Point3::new(0.0, 0.0, -1.0)).is_none());
        assert!(camera.project(&Point3::new(0.0, 0.0, 0.0)).is_none());
    }
}
