use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use barchan_geometry::nalgebra::{Quaternion, Translation3, UnitQuaternion, Vector3};
use barchan_geometry::{Se3, StampedPose, Trajectory};

use super::{Format, not_here};
use crate::calibration::{load_rig, sensor_pose};
use crate::pairs::{Calibrated, Pair, PairSource};
use crate::text::read_csv;
use crate::{DataError, ImuSample, Sensors};

/// EuRoC MAV (ASL): a sequence or its `mav0/`, with `cam0/` (left) and `cam1/`, each of `data.csv`, `data/`
/// and `sensor.yaml`. Images are rectified on reading.
///
/// A pair is two images of one time stamp; an image without a partner is left out. Names are time
/// stamps in nanoseconds, times are in seconds.
///
/// Truth is `state_groundtruth_estimate0/`, else `vicon0/`, else `mocap0/`, interpolated at the times of
/// the frames and moved to the rectified left camera by the `T_BS` of both. (`leica0/` has positions of a
/// prism without attitude, so nothing can be moved with it, and it is not taken.) Truth starts
/// after the cameras and ends before them: frames outside it are left out, so that there is
/// one pose a frame; but where it covers less than half of the frames they all stay, without truth.
///
/// `imu0/` gives [`Sensors`].
pub(super) const FORMAT: Format = Format {
    name: "euroc",
    layout: "mav0/ with cam0/ and cam1/, each of data.csv, data/ and sensor.yaml",
    detect,
    open,
};

const TRUTHS: &[&str] = &["state_groundtruth_estimate0", "vicon0", "mocap0"];

fn detect(dir: &Path) -> bool {
    let root = root(dir);
    ["cam0/data.csv", "cam1/data.csv"]
        .iter()
        .all(|f| root.join(f).is_file())
}

fn root(dir: &Path) -> PathBuf {
    let within = dir.join("mav0");
    if within.is_dir() {
        within
    } else {
        dir.to_owned()
    }
}

#[allow(non_snake_case)]
fn open(dir: &Path) -> Result<PairSource, DataError> {
    let root = root(dir);
    if !detect(dir) {
        return Err(not_here(dir, &FORMAT));
    }
    let sensor_files = ["cam0", "cam1"].map(|cam| root.join(cam).join("sensor.yaml"));
    let rig = load_rig(&sensor_files)?;
    let (left, mut right) = (images(&root.join("cam0"))?, images(&root.join("cam1"))?);
    let both = left.into_iter().filter_map(|(stamp, left)| {
        let right = right.remove(&stamp)?;
        Some((stamp, left, right))
    });
    let mut images: Vec<(u64, PathBuf, PathBuf)> = both.collect();
    let Some((_, first, _)) = images.first() else {
        return Err(DataError::file(
            &root.join("cam1/data.csv"),
            "has no time stamp in common with cam0/data.csv: pairs are images of one time stamp",
        ));
    };
    let calibrated = Calibrated::new(&rig, &sensor_files[0], first)?;
    let T_body_rect = sensor_pose(&sensor_files[0])? * calibrated.R_rect_left().inverse();

    let truth = match TRUTHS
        .iter()
        .map(|t| root.join(t))
        .find(|t| t.join("data.csv").is_file())
    {
        Some(folder) => {
            let T_body_sensor = sensor_pose(&folder.join("sensor.yaml"))?;
            let body = read_poses(&folder.join("data.csv"))?;
            let pose = |stamp: u64| {
                let T_world_sensor = body.at(seconds(stamp))?;
                Some(StampedPose {
                    time: seconds(stamp),
                    T_world_cam: T_world_sensor * T_body_sensor.inverse() * T_body_rect,
                })
            };
            let poses: Vec<Option<StampedPose>> = images.iter().map(|i| pose(i.0)).collect();
            let covered = poses.iter().flatten().count();
            if 2 * covered >= images.len() {
                let mut known = poses.iter().map(Option::is_some);
                images.retain(|_| known.next().unwrap_or(false));
                Some(Trajectory {
                    poses: poses.into_iter().flatten().collect(),
                })
            } else {
                None
            }
        }
        None => None,
    };
    let imu_file = root.join("imu0/data.csv");
    let sensors = if imu_file.is_file() {
        let T_body_imu = sensor_pose(&root.join("imu0/sensor.yaml"))?;
        Some(Sensors {
            imu: read_imu(&imu_file)?,
            T_imu_cam: T_body_imu.inverse() * T_body_rect,
            ..Sensors::default()
        })
    } else {
        None
    };
    let pair = |(stamp, left, right): (u64, PathBuf, PathBuf)| Pair {
        name: stamp.to_string(),
        time: seconds(stamp),
        left,
        right,
        calibrated: calibrated.clone(),
        disparity: None,
        disparity_right: None,
    };
    let pairs = images.into_iter().map(pair).collect();
    Ok(PairSource::new(dir, pairs)?
        .with_truth(truth)
        .with_sensors(sensors))
}

fn seconds(nanoseconds: u64) -> f64 {
    nanoseconds as f64 * 1e-9
}

fn stamp(path: &Path, text: &str) -> Result<u64, DataError> {
    text.parse().map_err(|_| {
        let message = format!("\"{text:.40}\" is no time stamp: expected whole nanoseconds");
        DataError::file(path, message)
    })
}

/// The images of a camera by time stamp.
fn images(cam: &Path) -> Result<BTreeMap<u64, PathBuf>, DataError> {
    let path = cam.join("data.csv");
    let text = std::fs::read_to_string(&path).map_err(DataError::io(&path))?;
    let mut images = BTreeMap::new();
    for line in text
        .lines()
        .filter(|l| !l.trim().is_empty() && !l.starts_with('#'))
    {
        let (time, file) = line.split_once(',').ok_or_else(|| {
            DataError::file(
                &path,
                format!("\"{line:.60}\": expected timestamp,filename"),
            )
        })?;
        images.insert(
            stamp(&path, time.trim())?,
            cam.join("data").join(file.trim()),
        );
    }
    Ok(images)
}

/// Poses of a sensor in the world: `timestamp, x, y, z, qw, qx, qy, qz, ...`.
fn read_poses(path: &Path) -> Result<Trajectory, DataError> {
    let mut poses = Vec::new();
    for (time, v) in read_csv(path, 7)? {
        let q = Quaternion::new(v[3], v[4], v[5], v[6]);
        let rotation = UnitQuaternion::try_new(q, 1e-9)
            .ok_or_else(|| DataError::file(path, format!("the quaternion at {time} is zero")))?;
        poses.push(StampedPose {
            time: seconds(stamp(path, &time)?),
            T_world_cam: Se3::from_parts(Translation3::new(v[0], v[1], v[2]), rotation),
        });
    }
    poses.sort_by(|a, b| a.time.total_cmp(&b.time));
    Ok(Trajectory { poses })
}

/// `timestamp, angular rate x y z, specific force x y z`.
fn read_imu(path: &Path) -> Result<Vec<ImuSample>, DataError> {
    let rows = read_csv(path, 6)?.into_iter();
    let mut samples: Vec<ImuSample> = rows
        .map(|(time, v)| {
            Ok(ImuSample {
                time: seconds(stamp(path, &time)?),
                rate: Vector3::new(v[0], v[1], v[2]),
                acceleration: Vector3::new(v[3], v[4], v[5]),
            })
        })
        .collect::<Result<_, DataError>>()?;
    samples.sort_by(|a, b| a.time.total_cmp(&b.time));
    Ok(samples)
}

#[cfg(test)]
#[allow(non_snake_case)]
mod tests {
    use super::super::tests::*;
    use super::*;
    use crate::StereoSource;
    use crate::calibration::sensor_yaml;
    use barchan_geometry::nalgebra::Point3;
    use barchan_geometry::{Camera, Distortion, Rectification, Rig};

    const START: u64 = 1_403_636_579_763_555_584;

    fn rig() -> Rig {
        let camera = |f, k1| Camera {
            distortion: Distortion::RadTan([k1, 0.07, 0.0002, 0.00002, 0.0]),
            ..Camera::pinhole(f, f - 1.0, 40.5, 29.0)
        };
        Rig {
            width: 80,
            height: 60,
            left: camera(60.0, -0.1),
            right: camera(61.0, -0.09),
            T_right_left: Se3::new(
                Vector3::new(-0.11, 0.002, 0.001),
                Vector3::new(0.01, -0.02, 0.0),
            ),
            rectified: false,
        }
    }

    fn T_body_left() -> Se3 {
        Se3::new(
            Vector3::new(-0.02, -0.06, 0.01),
            Vector3::new(0.0, 0.1, 1.5),
        )
    }

    /// The body along a line, turning: at `t` seconds after [`START`].
    fn T_world_body(t: f64) -> Se3 {
        Se3::new(
            Vector3::new(t, 2.0 * t, 0.5),
            Vector3::new(0.0, 0.0, 0.2 * t),
        )
    }

    /// Frames at 0 to 5 s, one of them without a right image, with truth from 0.5 to 4.5 s of a
    /// sensor that is not the body.
    fn sequence(truth_from: f64, truth_to: f64) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        let dir = root.path().join("mav0");
        let T_body_right = T_body_left() * rig().T_right_left.inverse();
        for (cam, camera, pose) in [
            ("cam0", &rig().left, &T_body_left()),
            ("cam1", &rig().right, &T_body_right),
        ] {
            let yaml = sensor_yaml(&rig(), camera, pose);
            save_text(&dir.join(cam).join("sensor.yaml"), &yaml);
            let mut csv = String::from("#timestamp [ns],filename\r\n");
            for i in (0..6u64).filter(|i| cam == "cam0" || *i != 2) {
                let stamp = START + i * 1_000_000_000;
                csv += &format!("{stamp},{stamp}.png\r\n");
                save_image(
                    &dir.join(cam).join(format!("data/{stamp}.png")),
                    (80, 60),
                    100,
                );
            }
            save_text(&dir.join(cam).join("data.csv"), &csv);
        }
        let T_body_sensor = T_body_gt();
        let mut csv = String::from("#timestamp, p_RS_R_x [m], ...\n");
        let mut t = truth_from;
        while t <= truth_to {
            let stamp = START + (t * 1e9) as u64;
            let pose = T_world_body(t) * T_body_sensor;
            let (p, q) = (pose.translation.vector, pose.rotation);
            csv += &format!(
                "{stamp},{},{},{},{},{},{},{},0,0,0\n",
                p.x, p.y, p.z, q.w, q.i, q.j, q.k
            );
            t += 0.001;
        }
        let truth = dir.join("state_groundtruth_estimate0");
        save_text(&truth.join("data.csv"), &csv);
        save_text(&truth.join("sensor.yaml"), &motion_yaml(&T_body_sensor));
        save_text(&dir.join("imu0/sensor.yaml"), &motion_yaml(&T_body_imu()));
        let imu = format!(
            "#timestamp [ns],w,a\n{START},0.1,0.2,0.3,9.1,0.5,-3\n{},0,0,0,9,0,-3\n",
            START + 5_000_000
        );
        save_text(&dir.join("imu0/data.csv"), &imu);
        root
    }

    fn T_body_gt() -> Se3 {
        Se3::new(Vector3::new(0.3, 0.1, -0.2), Vector3::new(0.0, 0.4, 0.0))
    }

    fn T_body_imu() -> Se3 {
        Se3::new(Vector3::new(0.01, 0.0, 0.0), Vector3::new(0.0, 0.0, 0.1))
    }

    fn motion_yaml(motion: &Se3) -> String {
        let m = motion.to_homogeneous();
        let rows: Vec<String> = (0..16).map(|i| m[(i / 4, i % 4)].to_string()).collect();
        format!(
            "sensor_type: any\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{}]\n",
            rows.join(", ")
        )
    }

    #[test]
    fn pairs_truth_and_imu_belong_to_the_rectified_left_camera() {
        let root = sequence(0.5, 4.5);
        for dir in [root.path().to_owned(), root.path().join("mav0")] {
            assert_eq!(detected(&dir), ["euroc"]);
            let source = open(&dir).unwrap();
            // 0 and 5 s lie outside the truth, 2 s has no right image.
            let stamps = [1, 3, 4].map(|i| (START + i * 1_000_000_000).to_string());
            assert_eq!(names(&source), stamps);
            assert!((source.rig().baseline - rig().baseline()).abs() < 1e-9);
            let maps = Rectification::new(&rig());
            let (found, expected) = (source.rig(), &maps.rig);
            assert_eq!((found.width, found.height), (80, 60));
            assert!((found.fx - expected.fx).abs() < 1e-9 && (found.cx - expected.cx).abs() < 1e-9);

            // A world point seen through the truth is where the original left camera sees it.
            let poses = &source.true_trajectory().unwrap().poses;
            assert_eq!(poses.len(), 3);
            let T_world_left = T_world_body(3.0) * T_body_left();
            let p_left = Point3::new(0.3, -0.2, 2.5);
            let p_rect = poses[1].T_world_cam.inverse() * (T_world_left * p_left);
            let expected = maps.R_rect_left * p_left;
            assert!((p_rect - expected).norm() < 1e-3, "{p_rect} {expected}");
            assert!((poses[1].time - source.frame(1).unwrap().time).abs() < 1e-9);

            let sensors = source.sensors().unwrap();
            assert_eq!(sensors.imu.len(), 2);
            assert_eq!(sensors.imu[0].rate, Vector3::new(0.1, 0.2, 0.3));
            assert_eq!(sensors.imu[0].acceleration, Vector3::new(9.1, 0.5, -3.0));
            let p_imu = T_body_imu().inverse() * T_body_left() * p_left;
            assert!((sensors.T_imu_cam * expected - p_imu).norm() < 1e-9);
        }
    }

    #[test]
    fn truth_of_a_small_part_is_none_and_all_frames_stay() {
        let source_dir = sequence(0.5, 2.5);
        let source = open(source_dir.path()).unwrap();
        assert_eq!((source.len(), source.true_trajectory()), (5, None));
    }

    #[test]
    fn opening_reads_no_pixels_and_what_is_broken_is_named() {
        let root = sequence(0.5, 4.5);
        let dir = root.path().join("mav0");
        for entry in std::fs::read_dir(dir.join("cam1/data")).unwrap() {
            cut_image(&entry.unwrap().path());
        }
        let source = open(root.path()).unwrap();
        assert!(
            source
                .frame(0)
                .unwrap_err()
                .to_string()
                .contains("cam1/data")
        );
        for (file, text, expected) in [
            ("imu0/data.csv", "1,2,3\n", "line 1"),
            (
                "state_groundtruth_estimate0/data.csv",
                "5,0,0,0,0,0,0,0\n",
                "quaternion",
            ),
            ("cam1/data.csv", "x,y.png\n", "time stamp"),
            ("cam1/data.csv", "17,17.png\n", "in common"),
            ("cam1/data.csv", "17\n", "filename"),
            ("cam1/sensor.yaml", "T_BS: 3\n", "cam1/sensor.yaml"),
            ("cam0/sensor.yaml", "", "cam0/sensor.yaml"),
        ] {
            let before = std::fs::read_to_string(dir.join(file)).unwrap();
            save_text(&dir.join(file), text);
            let message = message(&FORMAT, root.path());
            assert!(
                message.contains(expected) && message.contains("mav0"),
                "{message}"
            );
            save_text(&dir.join(file), &before);
        }
        std::fs::remove_file(dir.join("cam1/data.csv")).unwrap();
        assert!(message(&FORMAT, root.path()).contains("data.csv"));
    }
}
