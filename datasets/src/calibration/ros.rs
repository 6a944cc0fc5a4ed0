use barchan_geometry::nalgebra::{Matrix3, Translation3};
use barchan_geometry::{Camera, Distortion, Rig, Se3};

use super::known_size;
use super::tree::Values;
use crate::DataError;

const MATRIX: &[&str] = &["camera_matrix", "K"];
const LENS: &[&str] = &["distortion_coefficients", "D"];
const RECTIFICATION: &[&str] = &["rectification_matrix", "R"];
const PROJECTION: &[&str] = &["projection_matrix", "P"];

pub(super) fn detect(values: &Values<'_>) -> bool {
    values.has(MATRIX) && values.has(PROJECTION)
}

/// `camera_info` of both cameras, as `camera_calibration` writes it or as `K D R P` of the message.
/// `R` turns points of a camera into its rectified frame, and the two rectified frames differ by
/// `P[3] / P[0]` along x (minus the baseline, metres, in the right camera): hence the pose between
/// the cameras. Images are as the cameras took them, unless there is nothing to rectify.
#[allow(non_snake_case)]
pub(super) fn parse(
    both: &[Values<'_>; 2],
    size: Option<(usize, usize)>,
) -> Result<Rig, DataError> {
    let [left, right] = both;
    let (width, height) = known_size(left.path, left.size()?, size)?;
    if right.size()?.is_some_and(|other| other != (width, height)) {
        return Err(DataError::file(
            right.path,
            "the size is not that of the other camera; both images must have one size",
        ));
    }
    let (left_camera, right_camera) = (camera(left)?, camera(right)?);
    let (R_rect_left, R_rect_right) = (
        left.rotation(RECTIFICATION)?,
        right.rotation(RECTIFICATION)?,
    );
    let (p_left, p_right) = (
        left.numbers(PROJECTION, &[12])?,
        right.numbers(PROJECTION, &[12])?,
    );
    let shift = p_right[3] / p_right[0] - p_left[3] / p_left[0];
    if shift == 0.0 || !shift.is_finite() {
        return Err(DataError::file(
            right.path,
            "projection_matrix has no baseline: its fourth number is -fx times the baseline in a stereo calibration; calibrate both cameras together",
        ));
    }
    let T_right_left = Se3::from_parts(Translation3::identity(), R_rect_right.inverse())
        * Se3::translation(shift, 0.0, 0.0)
        * Se3::from_parts(Translation3::identity(), R_rect_left);

    let straight = |camera: &Camera, p: &[f64]| {
        camera.distortion == Distortion::Pinhole
            && [
                (camera.fx, p[0]),
                (camera.fy, p[5]),
                (camera.cx, p[2]),
                (camera.cy, p[6]),
            ]
            .iter()
            .all(|(a, b)| (a - b).abs() < 1e-6)
    };
    let rectified = straight(&left_camera, &p_left)
        && straight(&right_camera, &p_right)
        && R_rect_left.angle().max(R_rect_right.angle()) < 1e-9;
    Ok(Rig {
        width,
        height,
        left: left_camera,
        right: right_camera,
        T_right_left,
        rectified,
    })
}

fn camera(values: &Values<'_>) -> Result<Camera, DataError> {
    let model = values.root.get(&["distortion_model"]);
    let model = model
        .map(|node| format!("{node:?}").to_lowercase())
        .unwrap_or_default();
    let fisheye = model.contains("equidistant") || model.contains("fisheye");
    let k: Matrix3<f64> = values.matrix(MATRIX)?;
    Ok(Camera {
        distortion: values.lens(LENS, fisheye)?,
        ..Camera::pinhole(k.m11, k.m22, k.m13, k.m23)
    })
}

#[cfg(test)]
#[allow(non_snake_case)]
pub(super) mod tests {
    use super::super::tests::{assert_same, crooked, load, message, row, straight};
    use super::*;
    use barchan_geometry::Rectification;
    use barchan_geometry::nalgebra::UnitQuaternion;

    fn camera_info(
        rig: &Rig,
        camera: &Camera,
        R: &UnitQuaternion<f64>,
        p: [f64; 4],
        shift: f64,
    ) -> String {
        let (model, d) = match camera.distortion {
            Distortion::RadTan(k) => ("plumb_bob", k.to_vec()),
            Distortion::Equidistant(k) => ("equidistant", k.to_vec()),
            Distortion::Pinhole => ("plumb_bob", vec![0.0; 5]),
        };
        let R = R.to_rotation_matrix().matrix().transpose();
        format!(
            "image_width: {}\nimage_height: {}\ncamera_name: narrow_stereo/left\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [{}]\ndistortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n  cols: {}\n  data: [{}]\nrectification_matrix:\n  rows: 3\n  cols: 3\n  data: [{}]\nprojection_matrix:\n  rows: 3\n  cols: 4\n  data: [{}]\n",
            rig.width,
            rig.height,
            row(
                [
                    camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0
                ],
                ", "
            ),
            d.len(),
            row(d.clone(), ", "),
            row(R.as_slice().iter().copied(), ", "),
            row(
                [
                    p[0],
                    0.0,
                    p[2],
                    p[0] * shift,
                    0.0,
                    p[1],
                    p[3],
                    0.0,
                    0.0,
                    0.0,
                    1.0,
                    0.0
                ],
                ", "
            ),
        )
    }

    pub(in super::super) fn pair(rig: &Rig) -> [(&'static str, String); 2] {
        let r = Rectification::new(rig);
        let p = [r.rig.fx, r.rig.fy, r.rig.cx, r.rig.cy];
        [
            (
                "left.yaml",
                camera_info(rig, &rig.left, &r.R_rect_left, p, 0.0),
            ),
            (
                "right.yaml",
                camera_info(rig, &rig.right, &r.R_rect_right, p, -r.rig.baseline),
            ),
        ]
    }

    #[test]
    fn both_lenses_and_both_spellings_give_the_rig_back() {
        let mut rig = crooked();
        assert_same(&load(&pair(&rig), None).unwrap(), &rig);
        let message_spelling = pair(&rig).map(|(name, text)| {
            let text = text
                .replace("camera_matrix", "K")
                .replace("distortion_coefficients", "D")
                .replace("rectification_matrix", "R")
                .replace("projection_matrix", "P")
                .replace("image_width", "width")
                .replace("image_height", "height");
            (name, text)
        });
        assert_same(&load(&message_spelling, None).unwrap(), &rig);
        rig.left.distortion = Distortion::Equidistant([0.01, 0.02, -0.003, 0.0004]);
        rig.right.distortion = Distortion::Equidistant([0.011, 0.019, -0.002, 0.0003]);
        assert_same(&load(&pair(&rig), None).unwrap(), &rig);
    }

    #[test]
    fn nothing_to_rectify_is_a_rectified_rig() {
        let rig = straight();
        let info = |c: &Camera, shift| {
            let none = UnitQuaternion::identity();
            camera_info(&rig, c, &none, [c.fx, c.fy, c.cx, c.cy], shift)
        };
        let files = [
            ("left.yaml", info(&rig.left, 0.0)),
            ("right.yaml", info(&rig.right, -0.193)),
        ];
        assert_same(&load(&files, None).unwrap(), &rig);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let [left, right] = pair(&crooked());
        let swapped = message(&[right.clone(), left.clone()], None);
        assert!(swapped.contains("right camera"), "{swapped}");
        let alone = message(&[left.clone(), left.clone()], None);
        assert!(alone.contains("no baseline"), "{alone}");
        for (from, to, expected) in [
            ("image_width: 640", "image_width: 64", "size"),
            (
                "cols: 5\n  data: [",
                "cols: 8\n  data: [1, 2, 3, ",
                "beyond k3",
            ),
            (
                "rectification_matrix",
                "something_else",
                "rectification_matrix",
            ),
            (
                "rows: 3\n  cols: 4\n  data: [",
                "rows: 3\n  cols: 4\n  data: [x, ",
                "expected 12",
            ),
        ] {
            assert!(right.1.contains(from), "{from}");
            let broken = ("right.yaml", right.1.replacen(from, to, 1));
            let message = message(&[left.clone(), broken], None);
            assert!(
                message.contains("right.yaml") && message.contains(expected),
                "{message}"
            );
        }
    }
}
