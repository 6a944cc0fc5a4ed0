use std::path::Path;

use barchan_geometry::nalgebra::{Translation3, UnitQuaternion, Vector3};
use barchan_geometry::{Camera, Rig, Se3};

use super::known_size;
use super::tree::{Node, Values};
use crate::DataError;

// The names of OpenCV's sample (M1 D1 M2 D2 R T P1 P2) and of what people write after it.
const LEFT_MATRIX: &[&str] = &[
    "M1",
    "K1",
    "cameraMatrix1",
    "camera_matrix_1",
    "left_camera_matrix",
    "camera_matrix_left",
    "K_left",
    "left_K",
    "M_left",
    "KL",
    "mtxL",
];
const RIGHT_MATRIX: &[&str] = &[
    "M2",
    "K2",
    "cameraMatrix2",
    "camera_matrix_2",
    "right_camera_matrix",
    "camera_matrix_right",
    "K_right",
    "right_K",
    "M_right",
    "KR",
    "mtxR",
];
const LEFT_LENS: &[&str] = &[
    "D1",
    "distCoeffs1",
    "dist_coeffs_1",
    "distortion_coefficients_1",
    "left_distortion_coefficients",
    "distortion_coefficients_left",
    "distCoeffsLeft",
    "D_left",
    "left_D",
    "dist1",
    "DL",
    "distL",
];
const RIGHT_LENS: &[&str] = &[
    "D2",
    "distCoeffs2",
    "dist_coeffs_2",
    "distortion_coefficients_2",
    "right_distortion_coefficients",
    "distortion_coefficients_right",
    "distCoeffsRight",
    "D_right",
    "right_D",
    "dist2",
    "DR",
    "distR",
];
const ROTATION: &[&str] = &["R", "rotation", "rotation_matrix", "stereo_R"];
const TRANSLATION: &[&str] = &[
    "T",
    "translation",
    "translation_vector",
    "stereo_T",
    "t_vec",
];
const LEFT_PROJECTION: &[&str] = &[
    "P1",
    "left_projection_matrix",
    "projection_matrix_left",
    "P_left",
    "PL",
];
const RIGHT_PROJECTION: &[&str] = &[
    "P2",
    "right_projection_matrix",
    "projection_matrix_right",
    "P_right",
    "PR",
];

/// Wider than any rover's head by far, metres.
const WIDEST: f64 = 10.0;

/// Two files as one: what `intrinsics.yml` and `extrinsics.yml` hold together.
pub(super) fn merge(first: Node, second: Node) -> Node {
    match (first, second) {
        (Node::Map(mut items), Node::Map(more)) => {
            items.extend(more);
            Node::Map(items)
        }
        (first, _) => first,
    }
}

/// OpenCV's `FileStorage` of a stereo calibration. With camera matrices, images are as the cameras took
/// them, and `R`, `T` map left-camera points to the right camera, as ours do. With `P1` and `P2` alone,
/// images are rectified. `T` is in the unit of the calibration board: only metres are right.
#[allow(non_snake_case)]
pub(super) fn parse(
    path: &Path,
    root: &Node,
    size: Option<(usize, usize)>,
) -> Result<Rig, DataError> {
    let values = Values { path, root };
    let has_cameras = values.has(LEFT_MATRIX) || values.has(RIGHT_MATRIX);
    let has_projections = values.has(LEFT_PROJECTION) && values.has(RIGHT_PROJECTION);
    if !(has_cameras || has_projections) {
        let message = format!(
            "not a calibration that is understood: looked for OpenCV's M1 D1 M2 D2 R T or P1 P2; read are {}",
            super::CALIBRATIONS.join("; ")
        );
        return Err(DataError::file(path, message));
    }
    let fisheye = root
        .get(&["distortion_model", "camera_model", "model"])
        .map(|node| format!("{node:?}").to_lowercase())
        .is_some_and(|m| {
            ["fisheye", "equidistant", "kannala"]
                .iter()
                .any(|f| m.contains(f))
        });
    let (left, right, T_right_left) = if has_cameras {
        let shift = values.numbers(TRANSLATION, &[3])?;
        let turn = match values.try_numbers(ROTATION, &[3, 9])? {
            // A rotation vector, as Rodrigues writes it.
            Some(v) if v.len() == 3 => {
                UnitQuaternion::from_scaled_axis(Vector3::new(v[0], v[1], v[2]))
            }
            _ => values.rotation(ROTATION)?,
        };
        (
            Camera {
                distortion: values.lens(LEFT_LENS, fisheye)?,
                ..values.intrinsics(LEFT_MATRIX)?
            },
            Camera {
                distortion: values.lens(RIGHT_LENS, fisheye)?,
                ..values.intrinsics(RIGHT_MATRIX)?
            },
            Se3::from_parts(Translation3::new(shift[0], shift[1], shift[2]), turn),
        )
    } else {
        let (p1, p2) = (
            values.numbers(LEFT_PROJECTION, &[12])?,
            values.numbers(RIGHT_PROJECTION, &[12])?,
        );
        let camera = |p: &[f64]| Camera::pinhole(p[0], p[5], p[2], p[6]);
        let shift = p2[3] / p2[0] - p1[3] / p1[0];
        (camera(&p1), camera(&p2), Se3::translation(shift, 0.0, 0.0))
    };
    let (width, height) = known_size(path, values.size()?, size)?;
    let rig = Rig {
        width,
        height,
        left,
        right,
        T_right_left,
        rectified: !has_cameras,
    };
    if rig.baseline() > WIDEST {
        let message = format!(
            "the cameras stand {} apart: OpenCV's T is in the unit of the calibration board (millimetres? squares?), and metres are needed; scale T (P2)",
            rig.baseline()
        );
        return Err(DataError::file(path, message));
    }
    Ok(rig)
}

#[cfg(test)]
#[allow(non_snake_case)]
pub(super) mod tests {
    use super::super::tests::{assert_same, crooked, load, message, row, straight};
    use super::*;
    use barchan_geometry::Distortion;

    /// Names with rows, columns and values.
    type Matrices = Vec<(&'static str, usize, usize, Vec<f64>)>;

    fn intrinsics(rig: &Rig) -> Matrices {
        let k = |c: &Camera| vec![c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0];
        let d = |c: &Camera| match c.distortion {
            Distortion::RadTan(k) => k.to_vec(),
            Distortion::Equidistant(k) => k.to_vec(),
            Distortion::Pinhole => vec![0.0; 5],
        };
        let (l, r) = (&rig.left, &rig.right);
        let n = d(l).len();
        vec![
            ("M1", 3, 3, k(l)),
            ("D1", 1, n, d(l)),
            ("M2", 3, 3, k(r)),
            ("D2", 1, n, d(r)),
        ]
    }

    fn extrinsics(rig: &Rig) -> Matrices {
        let turn = rig.T_right_left.rotation.to_rotation_matrix();
        let shift = rig.T_right_left.translation.vector;
        vec![
            ("R", 3, 3, turn.matrix().transpose().as_slice().to_vec()),
            ("T", 3, 1, shift.as_slice().to_vec()),
        ]
    }

    fn yaml(matrices: &Matrices) -> String {
        let mut text = String::from("%YAML:1.0\n---\n");
        for (name, rows, cols, values) in matrices {
            let data = row(values.iter().copied(), ",\n       ");
            text += &format!(
                "{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]\n"
            );
        }
        text
    }

    fn xml(matrices: &Matrices) -> String {
        let mut text = String::from("<?xml version=\"1.0\"?>\n<opencv_storage>\n");
        for (name, rows, cols, values) in matrices {
            let data = row(values.iter().copied(), "\n    ");
            text += &format!(
                "<{name} type_id=\"opencv-matrix\">\n  <rows>{rows}</rows>\n  <cols>{cols}</cols>\n  <dt>d</dt>\n  <data>\n    {data}</data></{name}>\n"
            );
        }
        text + "</opencv_storage>\n"
    }

    /// The same rig as YAML and as XML.
    pub(in super::super) fn samples() -> [String; 2] {
        let mut all = intrinsics(&crooked());
        all.extend(extrinsics(&crooked()));
        [yaml(&all), xml(&all)]
    }

    #[test]
    fn yaml_xml_and_two_files_give_the_rig_back() {
        let rig = crooked();
        let size = Some((640, 480));
        let (inner, outer) = (intrinsics(&rig), extrinsics(&rig));
        let all: Matrices = inner.iter().chain(&outer).cloned().collect();
        let told = yaml(&all) + "image_width: 640\nimage_height: 480\n";
        assert_same(&load(&[("stereo.yml", told)], None).unwrap(), &rig);
        assert_same(&load(&[("stereo.xml", xml(&all))], size).unwrap(), &rig);
        for files in [
            [
                ("intrinsics.yml", yaml(&inner)),
                ("extrinsics.yml", yaml(&outer)),
            ],
            [
                ("extrinsics.xml", xml(&outer)),
                ("intrinsics.yml", yaml(&inner)),
            ],
        ] {
            assert_same(&load(&files, size).unwrap(), &rig);
        }
        let others = yaml(&all)
            .replace("M1:", "cameraMatrix1:")
            .replace("D2:", "distCoeffs2:");
        assert_same(
            &load(&[("calib.yaml", others + "imageSize: [640, 480]\n")], None).unwrap(),
            &rig,
        );
        assert!(message(&[("stereo.yml", yaml(&all))], None).contains("image_width"));
    }

    #[test]
    fn a_fisheye_is_one_when_the_file_says_so_and_a_rotation_may_be_a_vector() {
        let mut rig = crooked();
        for camera in [&mut rig.left, &mut rig.right] {
            camera.distortion = Distortion::Equidistant([0.01, 0.02, -0.003, 0.0004]);
        }
        let mut all: Matrices = intrinsics(&rig)
            .into_iter()
            .chain(extrinsics(&rig))
            .collect();
        all[4] = (
            "R",
            3,
            1,
            rig.T_right_left.rotation.scaled_axis().as_slice().to_vec(),
        );
        let text = yaml(&all) + "camera_model: fisheye\n";
        assert_same(
            &load(&[("stereo.yml", text)], Some((640, 480))).unwrap(),
            &rig,
        );
    }

    #[test]
    fn projections_alone_are_a_rectified_rig() {
        let rig = straight();
        let p = |c: &Camera, shift: f64| {
            vec![
                c.fx,
                0.0,
                c.cx,
                c.fx * shift,
                0.0,
                c.fy,
                c.cy,
                0.0,
                0.0,
                0.0,
                1.0,
                0.0,
            ]
        };
        let all = vec![
            ("P1", 3, 4, p(&rig.left, 0.0)),
            ("P2", 3, 4, p(&rig.right, -0.193)),
        ];
        assert_same(
            &load(&[("stereo.yml", yaml(&all))], Some((740, 500))).unwrap(),
            &rig,
        );
    }

    #[test]
    fn what_is_wrong_is_named() {
        let size = Some((640, 480));
        let broken = |change: &dyn Fn(&mut Matrices)| {
            let mut all: Matrices = intrinsics(&crooked())
                .into_iter()
                .chain(extrinsics(&crooked()))
                .collect();
            change(&mut all);
            message(&[("stereo.yml", yaml(&all))], size)
        };
        for (message, expected) in [
            (
                broken(&|m| {
                    m.remove(2);
                }),
                "M2",
            ),
            (
                broken(&|m| {
                    m.remove(5);
                }),
                "has no T",
            ),
            (broken(&|m| m[4].3[0] = 2.0), "R is no rotation"),
            (broken(&|m| m[0].3[0] = f64::NAN), "M1"),
            (broken(&|m| m[1].3.truncate(3)), "D1"),
            (broken(&|m| m[1].3.extend([0.1, 0.2, 0.3])), "beyond k3"),
            (
                broken(&|m| m[5].3 = vec![-120.0, 0.0, 0.0]),
                "metres are needed",
            ),
            (broken(&|m| m[5].3 = vec![0.12, 0.0, 0.0]), "right camera"),
        ] {
            assert!(
                message.contains("stereo.yml") && message.contains(expected),
                "{message}"
            );
        }
    }
}
