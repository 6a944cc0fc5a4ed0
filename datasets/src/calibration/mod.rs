//! Calibration in the files that other tools write, read as a [`Rig`]. One file per kind.

mod euroc;
mod kitti;
mod middlebury;
mod opencv;
mod ros;
mod tree;

use std::path::{Path, PathBuf};

use barchan_geometry::Rig;

use crate::DataError;
pub(crate) use euroc::sensor_pose;
#[cfg(test)]
pub(crate) use euroc::tests::sensor_yaml;
pub(crate) use kitti::read_projections;
pub(crate) use middlebury::read_middlebury;

/// What [`load_rig`] reads, for help texts.
const CALIBRATIONS: &[&str] = &[
    "rig.toml",
    "KITTI calib.txt or calib_cam_to_cam.txt",
    "Middlebury calib.txt",
    "EuRoC sensor.yaml of both cameras",
    "OpenCV stereo .yml, .yaml or .xml (also intrinsics and extrinsics in two files)",
    "ROS camera_info .yaml of both cameras",
];

/// The names by which [`find_calibration`] looks for files, the first found first.
const NAMES: &[&[&str]] = &[
    &["rig.toml"],
    &["calib.txt"],
    &["calib_cam_to_cam.txt"],
    &["left/sensor.yaml", "right/sensor.yaml"],
    &["cam0/sensor.yaml", "cam1/sensor.yaml"],
    &["left.yaml", "right.yaml"],
    &["left.yml", "right.yml"],
    &["cam0.yaml", "cam1.yaml"],
    &["stereo.yaml"],
    &["stereo.yml"],
    &["stereo.xml"],
    &["calib.yaml"],
    &["calib.yml"],
    &["calib.xml"],
    &["intrinsics.yml", "extrinsics.yml"],
    &["intrinsics.yaml", "extrinsics.yaml"],
    &["intrinsics.xml", "extrinsics.xml"],
];

/// The calibration beside some images: `rig.toml` before all others.
///
/// # Errors
/// When there is none; the message lists the names.
pub(crate) fn find_calibration(dir: &Path) -> Result<Vec<PathBuf>, DataError> {
    let paths = |names: &&[&str]| names.iter().map(|n| dir.join(n)).collect::<Vec<_>>();
    let found = NAMES
        .iter()
        .map(paths)
        .find(|p| p.iter().all(|p| p.is_file()));
    found.ok_or_else(|| {
        let names: Vec<String> = NAMES.iter().skip(1).map(|n| n.join(" + ")).collect();
        let message = format!(
            "missing: the calibration is needed; the README lists its fields. Also looked for: {}",
            names.join(", ")
        );
        DataError::file(&dir.join("rig.toml"), message)
    })
}

/// Reads a rig from `rig.toml` or from the calibration of another tool, told by its content: one
/// file, or two that belong together (left camera first; intrinsics and extrinsics in any order).
///
/// | kind | rectified | unit of the baseline in the file |
/// |---|---|---|
/// | `rig.toml` | as it says | metres |
/// | KITTI text, `P0: ...` (odometry, stereo 2012) or `P_rect_00: ...` (stereo 2015, raw) | yes | metres |
/// | Middlebury `calib.txt` | yes | millimetres |
/// | EuRoC `sensor.yaml`, two | no | metres |
/// | OpenCV: `M1 D1 M2 D2 R T` and other common names, in one file or two | no | that of the calibration board, which must have been metres |
/// | OpenCV: `P1 P2` alone | yes | the same |
/// | ROS `camera_info`, two | unless they say that there is nothing to rectify | metres |
///
/// Of a KITTI file with four cameras the grey ones, 0 and 1, are taken.
///
/// # Errors
/// When a file is missing, is none of these, lacks a value, or holds one that no rig has. Where
/// the files do not tell the size of the images.
pub fn load_rig(paths: &[PathBuf]) -> Result<Rig, DataError> {
    load_rig_of_size(paths, None)
}

/// [`load_rig`], with the size of the images (width, height) for files that do not tell it (KITTI
/// odometry, some of OpenCV's). What a file tells wins.
///
/// # Errors
/// As [`load_rig`].
pub(crate) fn load_rig_of_size(
    paths: &[PathBuf],
    size: Option<(usize, usize)>,
) -> Result<Rig, DataError> {
    let (first, second) = match paths {
        [one] => (one, None),
        [first, second] => (first, Some(second)),
        _ => {
            return Err(DataError::Layout {
                spec: "calibration".into(),
                message: format!(
                    "{} files given; expected one, or two that belong together: {}",
                    paths.len(),
                    CALIBRATIONS.join("; ")
                ),
            });
        }
    };
    if first
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("toml"))
        && second.is_none()
    {
        return Ok(Rig::load(first)?);
    }
    let text = tree::read_text(first)?;
    let rig = match second {
        None if kitti::detect(&text) => {
            let projections = kitti::parse(first, &text)?;
            let (left, right) = projections.first_pair(first)?;
            projections.rig(first, left, right, size)?
        }
        None if middlebury::detect(&text) => middlebury::parse(first, &text, size)?,
        None => opencv::parse(first, &tree::read_tree(first)?, size)?,
        Some(second) => {
            let (left, right) = (tree::read_tree(first)?, tree::read_tree(second)?);
            let of = |path, root| tree::Values { path, root };
            let both = [of(first, &left), of(second, &right)];
            if both.iter().any(euroc::detect) {
                euroc::parse(&both)?
            } else if both.iter().any(ros::detect) {
                ros::parse(&both, size)?
            } else {
                opencv::parse(first, &opencv::merge(left, right), size)?
            }
        }
    };
    rig.validate(first)?;
    Ok(rig)
}

/// The size of the images, from the calibration or else from whoever knows.
fn known_size(
    path: &Path,
    told: Option<(usize, usize)>,
    size: Option<(usize, usize)>,
) -> Result<(usize, usize), DataError> {
    told.or(size).ok_or_else(|| {
        DataError::file(
            path,
            "does not tell the size of the images: add image_width and image_height, or write a rig.toml with width and height",
        )
    })
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use barchan_geometry::nalgebra::Vector3;
    use barchan_geometry::{Camera, Distortion, RectifiedRig, Se3, se3};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// A rig with both lenses bent and both cameras turned.
    pub(crate) fn crooked() -> Rig {
        let camera = |f, k1| Camera {
            distortion: Distortion::RadTan([k1, 0.08, 0.001, -0.0007, 0.02]),
            ..Camera::pinhole(f, f * 1.01, 310.25, 247.5)
        };
        Rig {
            width: 640,
            height: 480,
            left: camera(520.0, -0.25),
            right: camera(505.0, -0.22),
            T_right_left: Se3::new(
                Vector3::new(-0.12, 0.004, -0.006),
                Vector3::new(0.03, -0.02, 0.01),
            ),
            rectified: false,
        }
    }

    /// A rectified rig with `doffs`.
    pub(crate) fn straight() -> Rig {
        Rig::from(RectifiedRig {
            width: 740,
            height: 500,
            fx: 718.5,
            fy: 718.5,
            cx: 360.25,
            cy: 241.75,
            doffs: 31.5,
            baseline: 0.193,
        })
    }

    pub(crate) fn assert_same(found: &Rig, expected: &Rig) {
        assert_eq!(
            (found.width, found.height, found.rectified),
            (expected.width, expected.height, expected.rectified)
        );
        for (a, b) in [
            (&found.left, &expected.left),
            (&found.right, &expected.right),
        ] {
            let numbers = |c: &Camera| {
                let mut n = vec![c.fx, c.fy, c.cx, c.cy];
                match &c.distortion {
                    Distortion::Pinhole => {}
                    Distortion::RadTan(k) => n.extend(k),
                    Distortion::Equidistant(k) => n.extend(k),
                }
                n
            };
            let (a, b) = (numbers(a), numbers(b));
            assert_eq!(a.len(), b.len());
            assert!(
                a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-6),
                "{a:?} {b:?}"
            );
        }
        let motion = se3::log(&(found.T_right_left.inverse() * expected.T_right_left));
        assert!(motion.norm() < 1e-6, "{motion}");
    }

    /// Writes files and reads the rig that they make.
    pub(crate) fn load(
        files: &[(&str, String)],
        size: Option<(usize, usize)>,
    ) -> Result<Rig, DataError> {
        let dir = tempfile::tempdir().unwrap();
        let mut paths = Vec::new();
        for (name, text) in files {
            paths.push(dir.path().join(name));
            std::fs::write(dir.path().join(name), text).unwrap();
        }
        load_rig_of_size(&paths, size)
    }

    pub(crate) fn message(files: &[(&str, String)], size: Option<(usize, usize)>) -> String {
        load(files, size).unwrap_err().to_string()
    }

    pub(crate) fn row(values: impl IntoIterator<Item = f64>, separator: &str) -> String {
        let words: Vec<String> = values.into_iter().map(|v| format!("{v:.12e}")).collect();
        words.join(separator)
    }

    #[test]
    fn rig_toml_is_read_and_everything_else_is_refused_with_the_list() {
        let rig = load(&[("any.toml", crooked().to_toml())], None).unwrap();
        assert_same(&rig, &crooked());
        assert!(
            load_rig(&[])
                .unwrap_err()
                .to_string()
                .contains("Middlebury")
        );
        assert!(
            load_rig(&["/no/such/place.yml".into()])
                .unwrap_err()
                .to_string()
                .contains("/no/such/place.yml")
        );
        for text in [
            "",
            "hello",
            "a: b",
            "- 1\n- 2\n",
            "<a/>",
            "{",
            "P0: 1 2",
            "cam0=[",
        ] {
            let message = message(&[("stereo.yml", text.into())], Some((64, 48)));
            assert!(message.contains("stereo.yml"), "{text}: {message}");
        }
        let bytes = tempfile::tempdir().unwrap();
        let path = bytes.path().join("calib.txt");
        std::fs::write(&path, [0xff, 0xfe, 0x00, 0x41]).unwrap();
        assert!(
            load_rig(&[path])
                .unwrap_err()
                .to_string()
                .contains("calib.txt")
        );
    }

    #[test]
    fn rig_toml_comes_first_and_what_was_looked_for_is_listed() {
        let dir = tempfile::tempdir().unwrap();
        let message = find_calibration(dir.path()).unwrap_err().to_string();
        assert!(
            message.contains("rig.toml: missing")
                && message.contains("intrinsics.yml + extrinsics.yml"),
            "{message}"
        );
        std::fs::write(dir.path().join("left.yaml"), "").unwrap();
        assert!(find_calibration(dir.path()).is_err());
        for name in ["right.yaml", "calib.txt", "rig.toml"] {
            std::fs::write(dir.path().join(name), "").unwrap();
            let found = find_calibration(dir.path()).unwrap();
            assert!(found.last().unwrap().ends_with(name));
        }
    }

    /// Files cut short, with bytes changed, and with numbers made huge: an error or a possible rig,
    /// never a panic.
    #[test]
    fn damaged_files_never_panic() {
        let [yaml, xml] = opencv::tests::samples();
        let kitti = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -380 0 700 180 0 0 0 1 0\n";
        let single = [yaml, xml, middlebury::tests::text(), kitti.to_owned()];
        let mut samples: Vec<Vec<String>> = single.into_iter().map(|s| vec![s]).collect();
        samples.push(ros::tests::pair(&crooked()).map(|(_, text)| text).to_vec());
        samples.push(
            euroc::tests::pair(&crooked())
                .map(|(_, text)| text)
                .to_vec(),
        );

        let dir = tempfile::tempdir().unwrap();
        let names = [dir.path().join("left.yaml"), dir.path().join("right.yaml")];
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let (mut read, mut refused) = (0, 0);
        for files in &samples {
            let paths = &names[..files.len()];
            for _ in 0..300 {
                for (path, text) in paths.iter().zip(files) {
                    let mut bytes = text.clone().into_bytes();
                    let at = random.random_range(0..bytes.len());
                    match random.random_range(0..4) {
                        0 => bytes.truncate(at),
                        1 => bytes[at] = b" -:[]{}<>&*!%#e9\n\0\xff"[random.random_range(0..19)],
                        2 => drop(bytes.splice(at..at, *b"9999999999e99")),
                        _ => drop(bytes.drain(at..(at + 20).min(text.len()))),
                    }
                    std::fs::write(path, bytes).unwrap();
                }
                match load_rig_of_size(paths, Some((640, 480))) {
                    Ok(rig) => {
                        rig.validate(&paths[0]).unwrap();
                        read += 1;
                    }
                    Err(error) => {
                        assert!(error.to_string().contains(dir.path().to_str().unwrap()));
                        refused += 1;
                    }
                }
            }
        }
        assert!(read > 50 && refused > 500, "{read} {refused}");
    }
}
