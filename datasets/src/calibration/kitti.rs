use std::path::Path;

use barchan_geometry::nalgebra::{Matrix3, Vector3};
use barchan_geometry::{Camera, Rig, Se3};

use super::{known_size, tree};
use crate::DataError;

/// What a KITTI text says of its four cameras: projections of points of the rectified camera 0.
/// Of odometry and stereo 2012, `P0: ` and twelve numbers; of stereo 2015 and raw, `P_rect_00: ` and
/// twelve numbers, with the size of the images in `S_rect_00: `.
pub(crate) struct Projections {
    cameras: [Option<Projection>; 4],
}

#[derive(Clone, Copy)]
struct Projection {
    camera: Camera,
    /// Where the rectified camera 0 stands in this camera: both look the same way, so points of
    /// the one are points of the other moved by it. Metres.
    shift: Vector3<f64>,
    size: Option<(usize, usize)>,
}

/// Reads a KITTI text.
///
/// # Errors
/// When it cannot be read or a projection is no projection.
pub(crate) fn read_projections(path: &Path) -> Result<Projections, DataError> {
    parse(path, &tree::read_text(path)?)
}

/// Whether a text has a line of KITTI's kinds.
pub(super) fn detect(text: &str) -> bool {
    text.lines().any(|line| {
        let known =
            |name: &str| ["P0", "P1", "P2", "P3"].contains(&name) || name.starts_with("P_rect_0");
        line.split_once(':')
            .is_some_and(|(name, rest)| known(name.trim()) && rest.split_whitespace().count() == 12)
    })
}

pub(super) fn parse(path: &Path, text: &str) -> Result<Projections, DataError> {
    let numbers = |name: &str, count: usize| {
        let line = text.lines().find_map(|line| {
            let (key, rest) = line.split_once(':')?;
            (key.trim() == name).then_some(rest)
        });
        let Some(line) = line else { return Ok(None) };
        let numbers: Option<Vec<f64>> = line
            .split_whitespace()
            .map(|w| w.parse().ok().filter(|v: &f64| v.is_finite()))
            .collect();
        match numbers.filter(|n| n.len() == count) {
            Some(numbers) => Ok(Some(numbers)),
            None => {
                let message = format!(
                    "{name} is \"{:.80}\", expected {count} numbers",
                    line.trim()
                );
                Err(DataError::file(path, message))
            }
        }
    };
    let mut cameras = [None; 4];
    for (i, camera) in cameras.iter_mut().enumerate() {
        let p = match numbers(&format!("P{i}"), 12)? {
            Some(p) => p,
            None => match numbers(&format!("P_rect_0{i}"), 12)? {
                Some(p) => p,
                None => continue,
            },
        };
        let size = numbers(&format!("S_rect_0{i}"), 2)?;
        let k = Matrix3::from_fn(|a, b| p[4 * a + b]);
        let shift = k.try_inverse().ok_or_else(|| {
            DataError::file(
                path,
                format!("the projection of camera {i} cannot be inverted"),
            )
        })? * Vector3::new(p[3], p[7], p[11]);
        *camera = Some(Projection {
            camera: Camera::pinhole(k.m11, k.m22, k.m13, k.m23),
            shift,
            size: size.map(|s| (s[0] as usize, s[1] as usize)),
        });
    }
    Ok(Projections { cameras })
}

impl Projections {
    /// The cameras of the first pair that the text has: 0 and 1, else 2 and 3.
    pub fn first_pair(&self, path: &Path) -> Result<(usize, usize), DataError> {
        [(0, 1), (2, 3)]
            .into_iter()
            .find(|(l, r)| self.cameras[*l].is_some() && self.cameras[*r].is_some())
            .ok_or_else(|| {
                DataError::file(
                    path,
                    "has no projections P0 and P1 nor P2 and P3 (P_rect_00 ...)",
                )
            })
    }

    fn camera(&self, path: &Path, index: usize) -> Result<Projection, DataError> {
        self.cameras.get(index).copied().flatten().ok_or_else(|| {
            DataError::file(
                path,
                format!("has no P{index} (or P_rect_0{index}) of image_{index}"),
            )
        })
    }

    /// The rectified rig of two cameras. The few millimetres across the baseline that KITTI's
    /// projections of cameras 2 and 3 differ by are left out: the images are rectified.
    pub fn rig(
        &self,
        path: &Path,
        left: usize,
        right: usize,
        size: Option<(usize, usize)>,
    ) -> Result<Rig, DataError> {
        let (left, right) = (self.camera(path, left)?, self.camera(path, right)?);
        let (width, height) = known_size(path, left.size, size)?;
        let rig = Rig {
            width,
            height,
            left: left.camera,
            right: right.camera,
            T_right_left: Se3::translation(right.shift.x - left.shift.x, 0.0, 0.0),
            rectified: true,
        };
        rig.validate(path)?;
        Ok(rig)
    }

    /// Maps points of a camera to the rectified camera 0, which KITTI's poses are of.
    #[allow(non_snake_case)]
    pub fn T_cam0_cam(&self, path: &Path, index: usize) -> Result<Se3, DataError> {
        let shift = self.camera(path, index)?.shift;
        Ok(Se3::translation(-shift.x, -shift.y, -shift.z))
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{assert_same, load, message, row, straight};
    use super::*;
    use barchan_geometry::nalgebra::Point3;

    /// `P` of a camera that sees camera 0 at `shift`.
    fn projection(camera: &Camera, shift: [f64; 3]) -> String {
        let k = Matrix3::new(
            camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0,
        );
        let mut p = k.insert_column(3, 0.0);
        p.set_column(3, &(k * Vector3::from(shift)));
        row((0..12).map(|i| p[(i / 4, i % 4)]), " ")
    }

    #[test]
    fn both_kinds_give_the_rig_back() {
        let rig = straight();
        let (left, right) = (
            projection(&rig.left, [0.06, 0.001, 0.003]),
            projection(&rig.right, [0.06 - 0.193, -0.002, 0.005]),
        );
        let text = format!("P2: {left}\r\nP3: {right}\r\nTr: 1 2 3");
        let found = load(&[("calib.txt", text.clone())], Some((740, 500))).unwrap();
        assert_same(&found, &rig);
        assert!(message(&[("calib.txt", text)], None).contains("image_width"));

        let size = "7.400000e+02 5.000000e+02";
        let text = format!(
            "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.95e-02\nS_rect_02: {size}\nP_rect_02: {left}\nS_rect_03: {size}\nP_rect_03: {right}\n"
        );
        assert_same(&load(&[("000000.txt", text)], None).unwrap(), &rig);
    }

    #[test]
    fn a_point_of_camera_2_is_found_through_camera_0() {
        let rig = straight();
        let text = format!("P2: {}\n", projection(&rig.left, [0.06, 0.001, 0.003]));
        let path = Path::new("calib.txt");
        let projections = parse(path, &text).unwrap();
        let p_cam0 = projections.T_cam0_cam(path, 2).unwrap() * Point3::new(1.0, 2.0, 5.0);
        assert!((p_cam0 - Point3::new(0.94, 1.999, 4.997)).norm() < 1e-9);
        let message = projections
            .rig(path, 2, 3, Some((1, 1)))
            .unwrap_err()
            .to_string();
        assert!(message.contains("P3"), "{message}");
    }

    #[test]
    fn damaged_projections_are_named() {
        let good = projection(&straight().left, [0.0; 3]);
        let zeros = "0 ".repeat(12);
        for (right, expected) in [
            ("1 2 3", "P1 is"),
            (zeros.as_str(), "inverted"),
            (&good.replacen("e2", "eX", 1), "P1 is"),
            (&good, "baseline"),
        ] {
            let text = format!("P0: {good}\nP1: {right}\n");
            let message = message(&[("calib.txt", text)], Some((740, 500)));
            assert!(
                message.contains("calib.txt") && message.contains(expected),
                "{message}"
            );
        }
    }
}
