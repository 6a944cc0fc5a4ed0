use std::path::Path;

use barchan_geometry::{Camera, Rig, Se3};

use super::known_size;
use super::tree::{Values, read_tree};
use crate::DataError;

pub(super) fn detect(values: &Values<'_>) -> bool {
    values.has(&["T_BS"]) && values.has(&["intrinsics"])
}

/// `sensor.yaml` of both cameras: `T_BS` maps points of the sensor to the body, so the two of them give
/// the pose of the right camera from the left one. Metres.
pub(super) fn parse(both: &[Values<'_>; 2]) -> Result<Rig, DataError> {
    let [left, right] = both;
    let size = known_size(left.path, left.size()?, None)?;
    if right.size()?.is_some_and(|other| other != size) {
        return Err(DataError::file(
            right.path,
            "the resolution is not that of the other camera; both images must have one size",
        ));
    }
    Ok(Rig {
        width: size.0,
        height: size.1,
        left: camera(left)?,
        right: camera(right)?,
        T_right_left: right.motion(&["T_BS"])?.inverse() * left.motion(&["T_BS"])?,
        rectified: false,
    })
}

fn camera(values: &Values<'_>) -> Result<Camera, DataError> {
    let k = values.numbers(&["intrinsics"], &[4])?;
    let model = values
        .root
        .get(&["distortion_model"])
        .map(|node| format!("{node:?}").to_lowercase())
        .unwrap_or_default();
    let fisheye = model.contains("equidistant") || model.contains("kannala");
    Ok(Camera {
        distortion: values.lens(&["distortion_coefficients"], fisheye)?,
        ..Camera::pinhole(k[0], k[1], k[2], k[3])
    })
}

/// `T_BS` of a sensor's `sensor.yaml`: maps points of the sensor to the body. The identity where there
/// is no file.
#[allow(non_snake_case)]
pub(crate) fn sensor_pose(path: &Path) -> Result<Se3, DataError> {
    if !path.is_file() {
        return Ok(Se3::identity());
    }
    let root = read_tree(path)?;
    Values { path, root: &root }.motion(&["T_BS"])
}

#[cfg(test)]
#[allow(non_snake_case)]
pub(crate) mod tests {
    use super::super::tests::{assert_same, crooked, load, message, row};
    use super::*;
    use barchan_geometry::Distortion;
    use barchan_geometry::nalgebra::Vector3;

    /// `sensor.yaml` of a camera that stands at a pose in the body.
    pub(crate) fn sensor_yaml(rig: &Rig, camera: &Camera, T_body_cam: &Se3) -> String {
        let m = T_body_cam.to_homogeneous();
        let (model, k) = match camera.distortion {
            Distortion::RadTan(k) => ("radial-tangential", k[..4].to_vec()),
            Distortion::Equidistant(k) => ("equidistant", k.to_vec()),
            Distortion::Pinhole => ("radial-tangential", vec![0.0; 4]),
        };
        format!(
            "# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam0 (MT9M034)\n\n# extrinsics\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{}]\nrate_hz: 20\nresolution: [{}, {}]\ncamera_model: pinhole\nintrinsics: [{}, {}, {}, {}] #fu, fv, cu, cv\ndistortion_model: {model}\ndistortion_coefficients: [{}]\n",
            row((0..16).map(|i| m[(i / 4, i % 4)]), ",\n         "),
            rig.width,
            rig.height,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            row(k, ", ")
        )
    }

    pub(in super::super) fn pair(rig: &Rig) -> [(&'static str, String); 2] {
        let T_body_left = Se3::new(
            Vector3::new(-0.02, -0.06, 0.01),
            Vector3::new(0.0, 0.1, 1.5),
        );
        let T_body_right = T_body_left * rig.T_right_left.inverse();
        [
            ("cam0.yaml", sensor_yaml(rig, &rig.left, &T_body_left)),
            ("cam1.yaml", sensor_yaml(rig, &rig.right, &T_body_right)),
        ]
    }

    fn without_k3() -> Rig {
        let mut rig = crooked();
        for camera in [&mut rig.left, &mut rig.right] {
            camera.distortion = Distortion::RadTan([-0.28, 0.07, 0.0002, 0.00002, 0.0]);
        }
        rig
    }

    #[test]
    fn two_sensor_files_give_the_rig_back() {
        let mut rig = without_k3();
        assert_same(&load(&pair(&rig), None).unwrap(), &rig);
        rig.right.distortion = Distortion::Equidistant([0.01, 0.02, -0.003, 0.0004]);
        assert_same(&load(&pair(&rig), None).unwrap(), &rig);
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (from, to, expected) in [
            ("resolution: [640", "resolution: [641", "resolution"),
            ("intrinsics: [", "intrinsics: [1, ", "expected 4"),
            ("  data: [", "  data: [9, ", "expected 16"),
            (
                "distortion_coefficients: [",
                "distortion_coefficients: [.nan, ",
                "finite",
            ),
            ("  data: [-", "  data: [-7", "rotation"),
        ] {
            let [left, mut right] = pair(&without_k3());
            assert!(
                right.1.contains(from) || from.contains("data: [-"),
                "{from}"
            );
            right.1 = if right.1.contains(from) {
                right.1.replacen(from, to, 1)
            } else {
                right.1.replacen("  data: [", "  data: [7", 1)
            };
            let message = message(&[left, right], None);
            assert!(
                message.contains("cam1.yaml") && message.contains(expected),
                "{message}"
            );
        }
        let [left, right] = pair(&without_k3());
        assert!(message(&[right, left], None).contains("right camera"));
    }
}
