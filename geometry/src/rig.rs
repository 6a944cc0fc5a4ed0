use std::path::Path;

use nalgebra::{Matrix2x3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::camera::{Camera, CameraToml, Distortion};
use crate::{GeometryError, Se3};

/// Two cameras and their relative pose, as calibrated.
#[derive(Clone, Debug, PartialEq)]
#[allow(non_snake_case)]
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

const BASELINE: &str = "the distance between the cameras in metres, above zero";

impl Rig {
    /// Reads `rig.toml`.
    ///
    /// # Errors
    /// When the file is missing, is not TOML, or holds a value no rig has (a zero baseline, a
    /// negative focal length, a rotation that is none); the message names file and field.
    pub fn load(path: &Path) -> Result<Self, GeometryError> {
        let text = std::fs::read_to_string(path).map_err(GeometryError::io(path))?;
        let toml: RigToml = toml::from_str(&text).map_err(|e| GeometryError::RigSyntax {
            path: path.to_owned(),
            message: e.to_string(),
        })?;
        let bad = |field, value: String, expected| GeometryError::RigValue {
            path: path.to_owned(),
            field,
            value,
            expected,
        };
        let camera = |field, c: &CameraToml| {
            Camera::from_toml(c).map_err(|value| bad(field, value, "a known camera model"))
        };
        let left = camera("[left]", &toml.left)?;
        let right = toml
            .right
            .as_ref()
            .map_or(Ok(left), |c| camera("[right]", c))?;
        let t_right_left = match (&toml.right_from_left, toml.baseline) {
            (Some(pose), _) => pose.to_se3().ok_or_else(|| {
                bad(
                    "[right_from_left] rotation",
                    format!("{:?}", pose.rotation),
                    "an orthonormal matrix of determinant 1",
                )
            })?,
            (None, Some(baseline)) => Se3::translation(-baseline, 0.0, 0.0),
            (None, None) => {
                return Err(bad(
                    "baseline",
                    "missing".into(),
                    "metres between the cameras, or [right_from_left]",
                ));
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
        if let Some(baseline) = toml.baseline.filter(|b| *b <= 0.0) {
            return Err(bad("baseline", baseline.to_string(), BASELINE));
        }
        rig.validate(path)?;
        Ok(rig)
    }

    /// Says no to values that no rig has, whatever file they were read from.
    ///
    /// # Errors
    /// When the size is zero or beyond 65535, a number is not finite, a focal length or the
    /// baseline is not positive, the right camera does not stand to the right of the left one, or
    /// a rig called rectified is not; the message names `path` and the field.
    pub fn validate(&self, path: &Path) -> Result<(), GeometryError> {
        let bad = |field, value: String, expected| {
            Err(GeometryError::RigValue {
                path: path.to_owned(),
                field,
                value,
                expected,
            })
        };
        let size = 1..=usize::from(u16::MAX);
        if !size.contains(&self.width) || !size.contains(&self.height) {
            let value = format!("{} x {}", self.width, self.height);
            return bad("width, height", value, "an image size");
        }
        for (field, camera) in [("[left]", &self.left), ("[right]", &self.right)] {
            for value in [camera.fx, camera.fy] {
                if !(value.is_finite() && value > 0.0) {
                    let value = format!("focal length {value}");
                    return bad(field, value, "a positive number of pixels");
                }
            }
            let lens: &[f64] = match &camera.distortion {
                Distortion::Pinhole => &[],
                Distortion::RadTan(k) => k,
                Distortion::Equidistant(k) => k,
            };
            if !([camera.cx, camera.cy].iter().chain(lens)).all(|v| v.is_finite()) {
                return bad(field, "not finite".into(), "finite numbers");
            }
        }
        let baseline = self.baseline();
        if !(baseline.is_finite() && baseline > 1e-6) {
            return bad("baseline", baseline.to_string(), BASELINE);
        }
        let across = -self.T_right_left.translation.x / baseline;
        if across < 0.7 {
            let value = format!("{:?}", self.T_right_left.translation.vector.as_slice());
            return bad(
                "[right_from_left] translation",
                value,
                "mostly along -x: it maps left-camera points to a right camera that stands to the right",
            );
        }
        if self.rectified && (self.T_right_left.rotation.angle() > 1e-6 || across < 1.0 - 1e-9) {
            let value = format!(
                "{:.3} degrees of rotation",
                self.T_right_left.rotation.angle().to_degrees()
            );
            return bad(
                "[right_from_left]",
                value,
                "a shift along x, as rectified = true",
            );
        }
        if self.rectified && self.left.fy != self.right.fy {
            return bad(
                "[right] fy",
                self.right.fy.to_string(),
                "that of [left], as rectified = true",
            );
        }
        Ok(())
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
        let orthonormal =
            (r * r.transpose() - Matrix3::identity()).norm() < 1e-4 && r.determinant() > 0.0;
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
        (z.is_finite() && z > 0.0).then(|| {
            Point3::new(
                (at.u - self.cx) / self.fx * z,
                (at.v - self.cy) / self.fy * z,
                z,
            )
        })
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
            self.fx * iz,
            0.0,
            -self.fx * p_cam.x * iz * iz,
            0.0,
            self.fy * iz,
            -self.fy * p_cam.y * iz * iz,
        );
        Matrix3::new(
            uv[(0, 0)],
            uv[(0, 1)],
            uv[(0, 2)],
            uv[(1, 0)],
            uv[(1, 1)],
            uv[(1, 2)],
            0.0,
            0.0,
            -self.fx * self.baseline * iz * iz,
        )
    }

    /// Covariance of [`RectifiedRig::back_project`] in the left camera frame, from the standard
    /// deviations of the pixel position and of the disparity, all in pixels.
    ///
    /// `dz/dd = -z^2/(f b)`, `dx/dd = x/z dz/dd`, `dx/du = z/f`: first order, so honest while
    /// `sigma_d` is small against `d`.
    pub fn point_covariance(
        &self,
        p_cam: &Point3<f64>,
        sigma_px: f64,
        sigma_d: f64,
    ) -> Matrix3<f64> {
        let z = p_cam.z;
        let dz = -z * z / (self.fx * self.baseline);
        let jacobian = Matrix3::new(
            z / self.fx,
            0.0,
            p_cam.x / z * dz,
            0.0,
            z / self.fy,
            p_cam.y / z * dz,
            0.0,
            0.0,
            dz,
        );
        let noise = Matrix3::from_diagonal(&Vector3::new(
            sigma_px * sigma_px,
            sigma_px * sigma_px,
            sigma_d * sigma_d,
        ));
        jacobian * noise * jacobian.transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rectified() -> RectifiedRig {
        RectifiedRig {
            width: 640,
            height: 480,
            fx: 500.0,
            fy: 510.0,
            cx: 321.5,
            cy: 236.25,
            doffs: 7.5,
            baseline: 0.2,
        }
    }

    fn points() -> Vec<Point3<f64>> {
        vec![
            Point3::new(0.4, -0.3, 2.5),
            Point3::new(-3.0, 1.0, 12.0),
            Point3::new(0.0, 0.0, 0.7),
        ]
    }

    #[test]
    fn back_projection_inverts_projection() {
        for p_cam in points() {
            let seen = rectified().project(&p_cam).unwrap();
            let back = rectified().back_project(seen).unwrap();
            assert!(
                (back - p_cam).norm() < 1e-12 * p_cam.coords.norm(),
                "{back}"
            );
        }
        assert!(rectified().project(&Point3::new(0.0, 0.0, -1.0)).is_none());
        for d in [-7.5, -20.0, f64::NAN] {
            assert!(
                rectified()
                    .back_project(StereoPoint { u: 0.0, v: 0.0, d })
                    .is_none(),
                "{d}"
            );
        }
    }

    #[test]
    fn disparity_is_the_left_column_less_the_right() {
        let rig = Rig::from(rectified());
        for p_cam in points() {
            let seen = rectified().project(&p_cam).unwrap();
            let left = rig.left.project(&p_cam).unwrap();
            let right = rig.right.project(&(rig.T_right_left * p_cam)).unwrap();
            assert!((left.x - right.x - seen.d).abs() < 1e-9 && (left.y - right.y).abs() < 1e-9);
            assert!((left.x - seen.u).abs() < 1e-9 && (left.y - seen.v).abs() < 1e-9);
        }
    }

    #[test]
    fn projection_jacobian_is_the_derivative() {
        let rig = rectified();
        let uvd = |p: Point3<f64>| {
            rig.project(&p)
                .map(|s| Vector3::new(s.u, s.v, s.d))
                .unwrap()
        };
        for p_cam in points() {
            let jacobian = rig.projection_jacobian(&p_cam);
            for axis in 0..3 {
                let step = Vector3::ith(axis, 1e-6);
                let numeric = (uvd(p_cam + step) - uvd(p_cam - step)) / 2e-6;
                assert!(
                    (jacobian.column(axis) - numeric).norm() < 1e-5 * jacobian.norm(),
                    "{axis}"
                );
            }
        }
    }

    #[test]
    fn covariance_is_the_derivative_of_back_projection_squared() {
        let rig = rectified();
        let (sigma_px, sigma_d) = (0.4, 0.7);
        for p_cam in points() {
            let at = rig.project(&p_cam).unwrap();
            let moved = |axis: usize, by: f64| {
                let by = Vector3::ith(axis, by);
                rig.back_project(StereoPoint {
                    u: at.u + by.x,
                    v: at.v + by.y,
                    d: at.d + by.z,
                })
                .unwrap()
            };
            let mut numeric = Matrix3::zeros();
            for (axis, sigma) in [sigma_px, sigma_px, sigma_d].into_iter().enumerate() {
                let column = (moved(axis, 1e-6) - moved(axis, -1e-6)) / 2e-6 * sigma;
                numeric += column * column.transpose();
            }
            let covariance = rig.point_covariance(&p_cam, sigma_px, sigma_d);
            assert!(
                (covariance - numeric).norm() < 1e-6 * numeric.norm(),
                "{covariance} {numeric}"
            );
        }
    }

    fn load(text: &str) -> Result<Rig, GeometryError> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("rig.toml");
        std::fs::write(&path, text).unwrap();
        Rig::load(&path)
    }

    #[test]
    fn rig_toml_round_trips() {
        let bent = |k| Camera {
            distortion: k,
            ..Camera::pinhole(400.5, 401.0, 300.0, 200.0)
        };
        let unrectified = Rig {
            width: 600,
            height: 400,
            left: bent(Distortion::RadTan([-0.3, 0.1, 0.001, -0.002, 0.01])),
            right: bent(Distortion::Equidistant([0.01, 0.02, 0.003, 0.004])),
            T_right_left: Se3::new(
                Vector3::new(-0.12, 0.003, 0.004),
                Vector3::new(0.01, -0.02, 0.03),
            ),
            rectified: false,
        };
        for rig in [
            unrectified,
            Rig::from(rectified()),
            Rig::from(RectifiedRig {
                doffs: 0.0,
                ..rectified()
            }),
        ] {
            let back = load(&rig.to_toml()).unwrap();
            assert_eq!(
                (back.width, back.height, back.left, back.right),
                (rig.width, rig.height, rig.left, rig.right)
            );
            let motion = crate::se3::log(&(back.T_right_left.inverse() * rig.T_right_left));
            assert!(
                motion.norm() < 1e-9 && back.rectified == rig.rectified,
                "{motion}"
            );
        }
    }

    #[test]
    fn errors_name_the_file_and_the_field() {
        let camera = "[left]\nfx = 100.0\nfy = 100.0\ncx = 50.0\ncy = 40.0\n";
        let size = "width = 100\nheight = 80\n";
        let turned =
            "[right_from_left]\nrotation = [[1,0,0],[0,2,0],[0,0,1]]\ntranslation = [-0.1,0,0]\n";
        let swapped =
            "[right_from_left]\nrotation = [[1,0,0],[0,1,0],[0,0,1]]\ntranslation = [0.1,0,0]\n";
        let cases = [
            (
                format!("rectified = true\nbaseline = 0.0\n{size}{camera}"),
                "baseline",
            ),
            (
                format!("rectified = true\nbaseline = -0.1\n{size}{camera}"),
                "baseline",
            ),
            (format!("rectified = true\n{size}{camera}"), "baseline"),
            (
                format!("rectified = true\nbaseline = 0.1\nfocal = 3\n{size}{camera}"),
                "focal",
            ),
            (format!("rectified = true\nbaseline = 0.1\n{size}"), "left"),
            (
                format!("rectified = true\nbaseline = 0.1\nwidth = 0\nheight = 80\n{camera}"),
                "width",
            ),
            (
                format!(
                    "rectified = true\nbaseline = 0.1\n{size}{}",
                    camera.replace("fx = 100", "fx = -1")
                ),
                "focal length -1",
            ),
            (
                format!("rectified = true\nbaseline = 0.1\n{size}{camera}model = \"fish\"\n"),
                "fish",
            ),
            (
                format!("rectified = false\n{size}{camera}{turned}"),
                "rotation",
            ),
            (
                format!("rectified = false\n{size}{camera}{swapped}"),
                "translation",
            ),
        ];
        for (text, field) in cases {
            let message = load(&text).unwrap_err().to_string();
            assert!(
                message.contains("rig.toml") && message.contains(field),
                "{field}: {message}"
            );
        }
        let absent = Rig::load(Path::new("/absent/rig.toml"))
            .unwrap_err()
            .to_string();
        assert!(absent.contains("/absent/rig.toml"), "{absent}");
    }
}
