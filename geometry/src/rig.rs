use std::path::Path;

use nalgebra::{Matrix2x3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::camera::{Camera, CameraToml};
use crate::{GeometryError, Se3};

/// Two cameras and their relative pose, as calibrated.
#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// The left camera; the body frame of everything downstream.
    pub left: Camera,
    /// The right camera.
    pub right: Camera,
    /// Maps left-camera points to the right camera.
    #[allow(non_snake_case)]
    pub T_right_left: Se3,
    /// Whether images of this rig are rectified: rows correspond, and the relative pose is a shift along x.
    pub rectified: bool,
}

/// A rectified rig: two equal pinholes a baseline apart along x. What every algorithm after
/// rectification works with.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RectifiedRig {
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point x of the left camera, pixels.
    pub cx: f64,
    /// Principal point y, pixels.
    pub cy: f64,
    /// `cx_right - cx`, pixels (Middlebury's `doffs`): added to a disparity before depth is taken.
    pub doffs: f64,
    /// Distance between the optical centres, metres.
    pub baseline: f64,
}

/// A pixel of the left image with its disparity: where a point is seen by a rectified rig.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StereoPoint {
    /// Column in the left image, pixels.
    pub u: f64,
    /// Row, pixels.
    pub v: f64,
    /// Disparity `u - u_right`, pixels.
    pub d: f64,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RigToml {
    rectified: bool,
    width: usize,
    height: usize,
    baseline: Option<f64>,
    left: CameraToml,
    right: Option<CameraToml>,
    right_from_left: Option<PoseToml>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseToml {
    rotation: [[f64; 3]; 3],
    translation: [f64; 3],
}

impl Rig {
    /// Reads `rig.toml`.
    ///
    /// # Errors
    /// When the file is missing, is not TOML, or holds a value no rig has (a zero baseline, a
    /// negative focal length, a rotation that is none); the message names file and field.
    pub fn load(path: &Path) -> Result<Self, GeometryError> {
        let text = std::fs::read_to_string(path).map_err(GeometryError::io(path))?;
        let toml: RigToml = toml::from_str(&text)
            .map_err(|e| GeometryError::RigSyntax { path: path.to_owned(), message: e.to_string() })?;
        let bad = |field, value: String, expected| GeometryError::RigValue {
            path: path.to_owned(),
            field,
            value,
            expected,
        };
        let camera = |field, c: &CameraToml| {
            for value in [c.fx, c.fy] {
                if !(value.is_finite() && value > 0.0) {
                    return Err(bad(field, format!("focal length {value}"), "a positive number of pixels"));
                }
            }
            if !(c.cx.is_finite() && c.cy.is_finite() && c.distortion.iter().all(|k| k.is_finite())) {
                return Err(bad(field, "not finite".into(), "finite numbers"));
            }
            Camera::from_toml(c).map_err(|value| bad(field, value, "a known camera model"))
        };
        if toml.width == 0 || toml.height == 0 {
            return Err(bad("width, height", format!("{} x {}", toml.width, toml.height), "an image size"));
        }
        let left = camera("[left]", &toml.left)?;
        let right = toml.right.as_ref().map_or(Ok(left), |c| camera("[right]", c))?;
        let t_right_left = match (&toml.right_from_left, toml.baseline) {
            (Some(pose), _) => pose.to_se3().ok_or_else(|| {
                bad("[right_from_left] rotation", format!("{:?}", pose.rotation), "an orthonormal matrix of determinant 1")
            })?,
            (None, Some(baseline)) => Se3::translation(-baseline, 0.0, 0.0),
            (None, None) => {
                return Err(bad("baseline", "missing".into(), "metres between the cameras, or [right_from_left]"));
            }
        };
        let rig = Self {
            width: toml.width,
            height: toml.height,
            left,
            right,
            T_right_left: t_right_left,
            rectified: toml.rectified,
        };
        let baseline = rig.baseline();
        if !(baseline.is_finite() && baseline > 1e-6) || toml.baseline.is_some_and(|b| b <= 0.0) {
            let value = toml.baseline.unwrap_or(baseline);
            return Err(bad("baseline", value.to_string(), "the distance between the cameras in metres, above zero"));
        }
        if rig.rectified && rig.left.fy != rig.right.fy {
            return Err(bad("[right] fy", rig.right.fy.to_string(), "that of [left], as rectified = true"));
        }
        Ok(rig)
    }

    /// Distance between the optical centres, metres.
    pub fn baseline(&self) -> f64 {
        self.T_right_left.translation.vector.norm()
    }

    /// The rectified form of a rig whose images are rectified already; `None` for any other.
    pub fn as_rectified(&self) -> Option<RectifiedRig> {
        self.rectified.then(|| RectifiedRig {
            width: self.width,
            height: self.height,
            fx: self.left.fx,
            fy: self.left.fy,
            cx: self.left.cx,
            cy: self.left.cy,
            doffs: self.right.cx - self.left.cx,
            baseline: self.baseline(),
        })
    }

    /// Text of a `rig.toml` that [`Rig::load`] reads back.
    pub fn to_toml(&self) -> String {
        let r = self.T_right_left.rotation.to_rotation_matrix();
        let t = self.T_right_left.translation.vector;
        let pose = PoseToml {
            rotation: std::array::from_fn(|i| std::array::from_fn(|j| r[(i, j)])),
            translation: [t.x, t.y, t.z],
        };
        let toml = RigToml {
            rectified: self.rectified,
            width: self.width,
            height: self.height,
            baseline: self.rectified.then(|| self.baseline()),
            left: self.left.to_toml(),
            right: (self.left != self.right).then(|| self.right.to_toml()),
            right_from_left: (!self.rectified).then_some(pose),
        };
        // A struct of numbers and strings always serialises.
        toml::to_string(&toml).unwrap_or_default()
    }
}

impl PoseToml {
    fn to_se3(&self) -> Option<Se3> {
        let r = Matrix3::from_fn(|i, j| self.rotation[i][j]);
        let t = Vector3::from(self.translation);
        let orthonormal = (r * r.transpose() - Matrix3::identity()).norm() < 1e-4 && r.determinant() > 0.0;
        (orthonormal && t.iter().all(|v| v.is_finite())).then(|| {
            let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&r));
            Se3::from_parts(Translation3::from(t), rotation)
        })
    }
}

impl From<RectifiedRig> for Rig {
    fn from(r: RectifiedRig) -> Self {
        Self {
            width: r.width,
            height: r.height,
            left: Camera::pinhole(r.fx, r.fy, r.cx, r.cy),
            right: Camera::pinhole(r.fx, r.fy, r.cx + r.doffs, r.cy),
            T_right_left: Se3::translation(-r.baseline, 0.0, 0.0),
            rectified: true,
        }
    }
}

impl RectifiedRig {
    /// Depth of a disparity, metres: `z = f b / (d + doffs)` (Hong 2021, eq. 6).
    pub fn depth(&self, disparity: f64) -> f64 {
        self.fx * self.baseline / (disparity + self.doffs)
    }

    /// The point of the left camera frame seen at a pixel with a disparity (Hong 2021, eq. 6);
    /// `None` where the disparity puts it at infinity or behind.
    pub fn back_project(&self, at: StereoPoint) -> Option<Point3<f64>> {
        let z = self.depth(at.d);
        (z.is_finite() && z > 0.0)
            .then(|| Point3::new((at.u - self.cx) / self.fx * z, (at.v - self.cy) / self.fy * z, z))
    }

    /// Where a point of the left camera frame is seen; `None` behind the camera.
    pub fn project(&self, p_cam: &Point3<f64>) -> Option<StereoPoint> {
        (p_cam.z > 0.0).then(|| StereoPoint {
            u: self.fx * p_cam.x / p_cam.z + self.cx,
            v: self.fy * p_cam.y / p_cam.z + self.cy,
            d: self.fx * self.baseline / p_cam.z - self.doffs,
        })
    }

    /// Derivative of [`RectifiedRig::project`] (rows u, v, d) with respect to the point.
    pub fn projection_jacobian(&self, p_cam: &Point3<f64>) -> Matrix3<f64> {
        let iz = 1.0 / p_cam.z;
        let uv = Matrix2x3::new(
            self.fx * iz, 0.0, -self.fx * p_cam.x * iz * iz,
            0.0, self.fy * iz, -self.fy * p_cam.y * iz * iz,
        );
        Matrix3::new(
            uv[(0, 0)], uv[(0, 1)], uv[(0, 2)],
            uv[(1, 0)], uv[(1, 1)], uv[(1, 2)],
            0.0, 0.0, -self.fx * self.baseline * iz * iz,
        )
    }

    /// Covariance of [`RectifiedRig::back_project`] in the left camera frame, from the standard
    /// deviations of the pixel position and of the disparity, all in pixels.
    ///
    /// `dz/dd = -z^2/(f b)`, `dx/dd = x/z dz/dd`, `dx/du = z/f`: first order, so honest while
    /// `sigma_d` is small against `d`.
    pub fn point_covariance(&self, p_cam: &Point3<f64>, sigma_px: f64, sigma_d: f64) -> Matrix3<f64> {
        let z = p_cam.z;
        let dz = -z * z / (self.fx * self.baseline);
        let jacobian = Matrix3::new(
            z / self.fx, 0.0, p_cam.x / z * dz,
            0.0, z / self.fy, p_cam.y / z * dz,
            0.0, 0.0, dz,
        );
        let noise = Matrix3::from_diagonal(&Vector3::new(sigma_px * sigma_px, sigma_px * sigma_px, sigma_d * sigma_d));
        jacobian * noise * jacobian.transpose()
    }
}
