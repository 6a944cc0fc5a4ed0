use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use barchan_geometry::{StampedPose, Trajectory};

use super::Format;
use crate::DataError;
use crate::calibration::{find_calibration, load_rig_of_size};
use crate::image_file::image_size;
use crate::listing::{DISPARITIES, IMAGES, list, pair_up};
use crate::pairs::{Calibrated, Coding, Pair, PairSource, TrueDisparity};
use crate::sensor_files::read_sensors;
use crate::text::{read_planar, read_times};

/// Format `folder`: the user's own images.
///
/// `left/` and `right/` hold images of the same stems, or of other names in the same order;
/// `rig.toml` the calibration, or a file of another tool that [`crate::load_rig`] reads: `calib.txt`,
/// `left.yaml` and `right.yaml`, `stereo.yml`, `intrinsics.yml` and `extrinsics.yml` and others
/// (`rig.toml` wins; without any, the error lists the names). When present: `times.txt`
/// (seconds, one a line); truth in `poses.txt` (KITTI rows), `groundtruth.tum` or `gt.csv`
/// (`time,x,y[,...]`, planar); `disparity/` (16-bit PNG or PFM by the stems of `left/`, of the
/// rectified left image) and `disparity_right/` (the same of the right image); `imu.csv`,
/// `odometry.csv` and `gnss.csv` with `imu.tum`.
///
/// Images of an unrectified rig are rectified on reading, and truth moves with the left camera.
pub struct Folder;

pub(super) const FORMAT: Format = Format {
    name: "folder",
    layout: Folder::LAYOUT,
    detect: Folder::detect,
    open: Folder::open,
};

impl Folder {
    /// What [`Folder::detect`] looks for, in words.
    pub const LAYOUT: &str =
        "left/, right/ and rig.toml (or another tool's calibration: calib.txt, stereo.yml, ...)";

    /// Whether a folder has the layout. (That the calibration is missing is for
    /// [`Folder::open`] to say.)
    pub fn detect(dir: &Path) -> bool {
        dir.join("left").is_dir() && dir.join("right").is_dir()
    }

    /// Lists the images and reads everything else. The images themselves are read by frame.
    ///
    /// # Errors
    /// When a folder or the calibration is missing, a folder is empty, an image has no partner, or
    /// times or poses do not match the images in number.
    pub fn open(dir: &Path) -> Result<PairSource, DataError> {
        if !dir.is_dir() {
            return Err(DataError::file(
                dir,
                format!("no such folder; expected {}", Self::LAYOUT),
            ));
        }
        let calibration = find_calibration(dir)?;
        let images = pair_up(
            list(&dir.join("left"), IMAGES)?,
            list(&dir.join("right"), IMAGES)?,
        )?;
        // Both lists hold something, so there is a first pair. Its header tells the size where the
        // calibration does not.
        let [(_, first, _), ..] = images.as_slice() else {
            return Err(DataError::file(dir, "holds no image pair"));
        };
        let size = image_size(first)
            .ok()
            .map(|(w, h)| (w as usize, h as usize));
        let rig = load_rig_of_size(&calibration, size)?;
        let calibrated = Calibrated::new(&rig, &calibration[0], first)?;
        let disparities = |name: &str| -> Result<BTreeMap<String, PathBuf>, DataError> {
            let dir = dir.join(name);
            if !dir.is_dir() {
                return Ok(BTreeMap::new());
            }
            Ok(list(&dir, DISPARITIES)?.into_iter().collect())
        };
        let truth_of = |files: &BTreeMap<String, PathBuf>, name: &String| {
            let path = files.get(name)?.clone();
            let coding = Coding::Plain;
            Some(TrueDisparity { path, coding })
        };
        let (of_left, of_right) = (disparities("disparity")?, disparities("disparity_right")?);
        let (times, mut truth) = times_and_truth(dir, images.len())?;
        for pose in truth.iter_mut().flat_map(|truth| &mut truth.poses) {
            pose.T_world_cam *= calibrated.R_rect_left().inverse();
        }
        let pair = |((name, left, right), time)| Pair {
            disparity: truth_of(&of_left, &name),
            disparity_right: truth_of(&of_right, &name),
            name,
            time,
            left,
            right,
            calibrated: calibrated.clone(),
        };
        let pairs = images.into_iter().zip(times).map(pair).collect();
        Ok(PairSource::new(dir, pairs)?
            .with_truth(truth)
            .with_sensors(read_sensors(dir)?))
    }
}

/// Times from `times.txt`, else `gt.csv`, else the index; and truth when there is any.
fn times_and_truth(dir: &Path, frames: usize) -> Result<(Vec<f64>, Option<Trajectory>), DataError> {
    let [times_file, poses_file, tum_file, csv_file] =
        ["times.txt", "poses.txt", "groundtruth.tum", "gt.csv"].map(|name| dir.join(name));
    let planar = if csv_file.is_file() {
        Some(read_planar(&csv_file)?)
    } else {
        None
    };
    let counted = |path: &Path, found: usize, what: &str| {
        let message =
            format!("{found} {what}, but there are {frames} image pairs: one a pair is needed");
        if found == frames {
            Ok(())
        } else {
            Err(DataError::file(path, message))
        }
    };
    let known_times = if times_file.is_file() {
        let times = read_times(&times_file)?;
        counted(&times_file, times.len(), "times")?;
        Some(times)
    } else if let Some(truth) = &planar {
        counted(&csv_file, truth.poses.len(), "rows")?;
        Some(truth.poses.iter().map(|p| p.time).collect())
    } else {
        None
    };
    let truth = if poses_file.is_file() {
        let truth = Trajectory::read_kitti(&poses_file, None)?;
        counted(&poses_file, truth.poses.len(), "poses")?;
        Some(truth)
    } else if tum_file.is_file() {
        Some(match_by_time(
            &tum_file,
            Trajectory::read_tum(&tum_file)?,
            frames,
            known_times.as_deref(),
        )?)
    } else {
        if let Some(truth) = &planar {
            counted(&csv_file, truth.poses.len(), "rows")?;
        }
        planar
    };
    let times = known_times.unwrap_or_else(|| (0..frames).map(|i| i as f64).collect());
    let truth = truth.map(|mut truth| {
        for (pose, time) in truth.poses.iter_mut().zip(&times) {
            pose.time = *time;
        }
        truth
    });
    Ok((times, truth))
}

/// One pose a frame: in order where the numbers agree, else interpolated at the frames' times.
fn match_by_time(
    path: &Path,
    truth: Trajectory,
    frames: usize,
    times: Option<&[f64]>,
) -> Result<Trajectory, DataError> {
    if truth.poses.len() == frames {
        return Ok(truth);
    }
    let times = times.ok_or_else(|| {
        let found = truth.poses.len();
        DataError::file(
            path,
            format!("{found} poses for {frames} image pairs: times.txt is needed to match them"),
        )
    })?;
    let pose = |time: &f64| {
        let message = || format!("no pose around {time} s, a time of an image pair (times.txt)");
        let pose = truth
            .at(*time)
            .ok_or_else(|| DataError::file(path, message()))?;
        Ok(StampedPose {
            time: *time,
            T_world_cam: pose,
        })
    };
    Ok(Trajectory {
        poses: times.iter().map(pose).collect::<Result<_, DataError>>()?,
    })
}

#[cfg(test)]
#[allow(non_snake_case)]
mod tests {
    use super::*;
    use crate::{Plane, StereoSource, disparity_file};
    use barchan_geometry::nalgebra::{Point3, Vector3};
    use barchan_geometry::{Camera, Distortion, Rig, Se3, se3};

    const RIG: &str = "rectified = true\nwidth = 8\nheight = 6\nbaseline = 0.1\n[left]\nfx = 9.0\nfy = 9.0\ncx = 4.0\ncy = 3.0\n";

    /// A dataset of 8 x 6 images of the given stems.
    fn dataset(left: &[&str], right: &[&str]) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("rig.toml"), RIG).unwrap();
        for (side, stems) in [("left", left), ("right", right)] {
            std::fs::create_dir(dir.path().join(side)).unwrap();
            for (k, stem) in stems.iter().enumerate() {
                let path = dir.path().join(side).join(format!("{stem}.png"));
                image::GrayImage::from_pixel(8, 6, image::Luma([k as u8 + 1]))
                    .save(path)
                    .unwrap();
            }
        }
        dir
    }

    fn error(dir: &Path) -> String {
        Folder::open(dir)
            .err()
            .map(|e| e.to_string())
            .unwrap_or_default()
    }

    /// The grey level of the right image of each frame: which file it came from.
    fn rights(folder: &PairSource) -> Vec<u8> {
        let level = |i| (folder.frame(i).unwrap().right[(0, 0)].0[0] * 255.0).round() as u8;
        (0..folder.len()).map(level).collect()
    }

    #[test]
    fn images_pair_by_stem_or_else_by_natural_order() {
        let dir = dataset(&["img10", "img2"], &["img2", "img10"]);
        let folder = Folder::open(dir.path()).unwrap();
        assert_eq!(
            (folder.name(0), folder.name(1)),
            ("img2".into(), "img10".into())
        );
        assert_eq!(
            (rights(&folder), folder.frame(1).unwrap().time),
            (vec![1, 2], 1.0)
        );
        let dir = dataset(&["l9", "l10", "l011"], &["r7", "r8", "r30"]);
        assert_eq!(rights(&Folder::open(dir.path()).unwrap()), [1, 2, 3]);
    }

    #[test]
    fn a_missing_or_doubled_image_is_named() {
        let dir = dataset(&["a", "b", "c"], &["a", "c"]);
        let message = error(dir.path());
        assert!(message.contains("right/b.png: missing"), "{message}");
        let dir = dataset(&["a", "c"], &["a", "b", "c"]);
        let message = error(dir.path());
        assert!(message.contains("left/b.png: missing"), "{message}");
        let dir = dataset(&["a", "b"], &["x", "y", "z"]);
        let message = error(dir.path());
        assert!(
            message.contains("3 images here and 2 in left/"),
            "{message}"
        );
        let dir = dataset(&["a"], &["a"]);
        std::fs::copy(dir.path().join("left/a.png"), dir.path().join("left/a.tif")).unwrap();
        assert!(error(dir.path()).contains("same stem"));
    }

    #[test]
    fn missing_and_empty_folders_and_a_missing_rig_are_named() {
        assert!(error(Path::new("/no/such/place")).contains("/no/such/place: no such folder"));
        let dir = dataset(&["a"], &[]);
        assert!(error(dir.path()).contains("holds no image"));
        std::fs::remove_dir(dir.path().join("right")).unwrap();
        let message = error(dir.path());
        assert!(message.contains("right: no such folder"), "{message}");
        std::fs::remove_file(dir.path().join("rig.toml")).unwrap();
        assert!(error(dir.path()).contains("rig.toml: missing"));
    }

    #[test]
    fn another_size_and_a_damaged_image_are_named_with_the_frame_that_reads_them() {
        let dir = dataset(&["a", "b", "c"], &["a", "b", "c"]);
        let (wrong, cut) = (
            dir.path().join("right/b.png"),
            dir.path().join("left/c.png"),
        );
        image::GrayImage::new(9, 6).save(&wrong).unwrap();
        let bytes = std::fs::read(&cut).unwrap();
        std::fs::write(&cut, &bytes[..bytes.len() - 20]).unwrap();
        let folder = Folder::open(dir.path()).unwrap();
        assert!(folder.frame(0).is_ok());
        let message = folder.frame(1).unwrap_err().to_string();
        assert!(
            message.contains("right/b.png")
                && message.contains("9 x 6")
                && message.contains("8 x 6"),
            "{message}"
        );
        let message = folder.frame(2).unwrap_err().to_string();
        assert!(message.contains("left/c.png"), "{message}");
        assert!(folder.frame(3).is_err());
    }

    #[test]
    fn times_and_each_kind_of_truth_are_read() {
        let dir = dataset(&["a", "b"], &["a", "b"]);
        let write = |name: &str, text: &str| std::fs::write(dir.path().join(name), text).unwrap();
        assert!(
            Folder::open(dir.path())
                .unwrap()
                .true_trajectory()
                .is_none()
        );

        write("gt.csv", "time,x,y,dx\n5.0,1,2,0\n6.5,3,4,0\n");
        let folder = Folder::open(dir.path()).unwrap();
        let pose = |folder: &PairSource, i: usize| folder.true_trajectory().unwrap().poses[i];
        assert_eq!(folder.frame(1).unwrap().time, 6.5);
        assert_eq!(
            pose(&folder, 1),
            StampedPose {
                time: 6.5,
                T_world_cam: Se3::translation(3.0, 4.0, 0.0)
            }
        );

        // Denser truth is met at the times of the frames.
        write("times.txt", "10\n11.5\n");
        write(
            "groundtruth.tum",
            "9 0 0 0 0 0 0 1\n11 2 0 0 0 0 0 1\n12 4 0 0 0 0 0 1\n",
        );
        let folder = Folder::open(dir.path()).unwrap();
        assert!((pose(&folder, 0).T_world_cam.translation.x - 1.0).abs() < 1e-12);
        assert!((pose(&folder, 1).T_world_cam.translation.x - 3.0).abs() < 1e-12);
        assert_eq!(pose(&folder, 1).time, 11.5);

        write(
            "poses.txt",
            "1 0 0 7 0 1 0 8 0 0 1 9\n1 0 0 7 0 1 0 8 0 0 1 10\n",
        );
        let folder = Folder::open(dir.path()).unwrap();
        assert_eq!(
            pose(&folder, 1).T_world_cam,
            Se3::translation(7.0, 8.0, 10.0)
        );

        for (name, text, expected) in [
            (
                "poses.txt",
                "1 0 0 7 0 1 0 8 0 0 1 9\n",
                "1 poses, but there are 2",
            ),
            ("times.txt", "10\nx\n", "line 2"),
            ("times.txt", "10\n", "1 times, but there are 2"),
        ] {
            let before = std::fs::read_to_string(dir.path().join(name)).unwrap();
            write(name, text);
            let message = error(dir.path());
            assert!(
                message.contains(name) && message.contains(expected),
                "{message}"
            );
            write(name, &before);
        }
    }

    #[test]
    fn gt_csv_without_its_columns_or_rows_is_an_error() {
        let dir = dataset(&["a", "b"], &["a", "b"]);
        for (text, expected) in [
            ("time,x\n1,2\n", "no column \"y\""),
            ("time,x,y\n1,2\n", "line 2"),
            ("time,x,y\n1,2,3\n", "1 rows"),
            ("", "no column"),
        ] {
            std::fs::write(dir.path().join("gt.csv"), text).unwrap();
            let message = error(dir.path());
            assert!(
                message.contains("gt.csv") && message.contains(expected),
                "{message}"
            );
        }
    }

    #[test]
    fn disparity_is_found_by_stem_and_its_size_checked() {
        let dir = dataset(&["a", "b"], &["a", "b"]);
        let disparity = dir.path().join("disparity");
        std::fs::create_dir(&disparity).unwrap();
        let plane = Plane::from_pixel(8, 6, image::Luma([1.5]));
        disparity_file::write_pfm(&disparity.join("b.pfm"), &plane).unwrap();
        let folder = Folder::open(dir.path()).unwrap();
        assert!(folder.true_disparity(0).unwrap().is_none());
        assert_eq!(folder.true_disparity(1).unwrap(), Some(plane));
        disparity_file::write_pfm(&disparity.join("b.pfm"), &Plane::new(4, 4)).unwrap();
        assert!(
            folder
                .true_disparity(1)
                .unwrap_err()
                .to_string()
                .contains("4 x 4")
        );
    }

    #[test]
    fn another_tools_calibration_stands_in_for_rig_toml_with_the_size_of_the_images() {
        let dir = dataset(&["a"], &["a"]);
        let p = |shift: f64| format!("9 0 4 {shift} 0 9 3 0 0 0 1 0");
        let kitti = format!("P0: {}\nP1: {}\n", p(0.0), p(-1.8));
        std::fs::write(dir.path().join("calib.txt"), kitti).unwrap();
        assert_eq!(Folder::open(dir.path()).unwrap().rig().baseline, 0.1);
        std::fs::remove_file(dir.path().join("rig.toml")).unwrap();
        let rig = *Folder::open(dir.path()).unwrap().rig();
        assert!((rig.baseline - 0.2).abs() < 1e-12);
        assert_eq!((rig.width, rig.height, rig.fx, rig.cx), (8, 6, 9.0, 4.0));
        std::fs::remove_file(dir.path().join("calib.txt")).unwrap();
        let message = error(dir.path());
        for name in [
            "rig.toml",
            "calib.txt",
            "left.yaml + right.yaml",
            "stereo.xml",
        ] {
            assert!(message.contains(name), "{message}");
        }
    }

    #[test]
    fn a_calibration_of_another_size_is_refused_before_its_maps_are_made() {
        let dir = dataset(&["a"], &["a"]);
        let text = RIG
            .replace("rectified = true", "rectified = false")
            .replace("width = 8", "width = 65535")
            .replace("height = 6", "height = 65535");
        std::fs::write(dir.path().join("rig.toml"), text).unwrap();
        let message = error(dir.path());
        assert!(
            message.contains("8 x 6") && message.contains("65535 x 65535"),
            "{message}"
        );
    }

    #[test]
    fn the_right_images_disparity_is_found_by_stem() {
        let dir = dataset(&["a", "b"], &["a", "b"]);
        let folder = dir.path().join("disparity_right");
        std::fs::create_dir(&folder).unwrap();
        let plane = Plane::from_pixel(8, 6, image::Luma([2.5]));
        disparity_file::write_png(&folder.join("b.png"), &plane).unwrap();
        let source = Folder::open(dir.path()).unwrap();
        assert!(source.true_disparity_right(0).unwrap().is_none());
        assert_eq!(source.true_disparity_right(1).unwrap(), Some(plane));
        assert!(source.true_disparity(1).unwrap().is_none());
    }

    /// What a camera at a pose sees of a wavy wall: the scene of the test below.
    fn photograph(rig: &Rig, camera: &Camera, T_cam_left: &Se3) -> image::GrayImage {
        image::GrayImage::from_fn(rig.width as u32, rig.height as u32, |u, v| {
            let ray = camera
                .ray(Vector3::new(f64::from(u), f64::from(v), 0.0).xy())
                .push(1.0);
            let T_left_cam = T_cam_left.inverse();
            let (origin, ray) = (T_left_cam * Point3::origin(), T_left_cam.rotation * ray);
            let p_left = origin + ray * ((4.0 - origin.z) / ray.z);
            let grey = 0.5
                + 0.2 * (3.1 * p_left.x + p_left.y).sin()
                + 0.2 * (4.3 * p_left.y - p_left.x).cos();
            image::Luma([(grey * 255.0).round() as u8])
        })
    }

    #[test]
    fn an_unrectified_rig_is_rectified_on_reading_and_its_truth_turned() {
        let lens = |k| Distortion::RadTan([k, 0.05, 0.001, -0.002, 0.0]);
        let turn = Vector3::new(0.02, -0.03, 0.025);
        let rig = Rig {
            width: 160,
            height: 120,
            left: Camera {
                distortion: lens(-0.2),
                ..Camera::pinhole(130.0, 131.0, 78.0, 61.0)
            },
            right: Camera {
                distortion: lens(-0.15),
                ..Camera::pinhole(128.0, 128.0, 81.0, 58.0)
            },
            T_right_left: Se3::new(Vector3::new(-0.3, 0.01, 0.02), turn),
            rectified: false,
        };
        let dir = tempfile::tempdir().unwrap();
        for (side, camera, pose) in [
            ("left", &rig.left, &Se3::identity()),
            ("right", &rig.right, &rig.T_right_left),
        ] {
            std::fs::create_dir(dir.path().join(side)).unwrap();
            photograph(&rig, camera, pose)
                .save(dir.path().join(side).join("0.png"))
                .unwrap();
        }
        std::fs::write(dir.path().join("rig.toml"), rig.to_toml()).unwrap();
        std::fs::write(dir.path().join("poses.txt"), "1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
        let folder = Folder::open(dir.path()).unwrap();
        let frame = folder.frame(0).unwrap();

        // The true pose now belongs to the rectified camera: a point on the wall, found through it
        // at a pixel of the left image, has its right pixel on the same row.
        let T_world_cam = folder.true_trajectory().unwrap().poses[0].T_world_cam;
        assert!(se3::log(&T_world_cam).norm() > 0.005);
        let (mut worst, mut checked) = (0.0f32, 0);
        for (u, v) in (30..110).flat_map(|v| (45..140).map(move |u| (u as u32, v as u32))) {
            let r = folder.rig();
            let ray = T_world_cam.rotation
                * Vector3::new(
                    (f64::from(u) - r.cx) / r.fx,
                    (f64::from(v) - r.cy) / r.fy,
                    1.0,
                );
            let p_world = T_world_cam * Point3::origin() + ray * (4.0 / ray.z);
            let seen = r.project(&(T_world_cam.inverse() * p_world)).unwrap();
            let at = seen.u - seen.d;
            let (x, a) = (at as u32, at.fract() as f32);
            let right = (1.0 - a) * frame.right[(x, v)].0[0] + a * frame.right[(x + 1, v)].0[0];
            worst = worst.max((right - frame.left[(u, v)].0[0]).abs());
            checked += 1;
        }
        assert!(checked > 7000 && worst < 3.0 / 255.0, "{worst}");
    }
}
