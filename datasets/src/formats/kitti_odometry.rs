use std::path::{Path, PathBuf};

use barchan_geometry::{StampedPose, Trajectory};

use super::{Format, not_here};
use crate::DataError;
use crate::calibration::read_projections;
use crate::image_file::image_size;
use crate::listing::{IMAGES, list, name_of, natural, pair_up};
use crate::pairs::{Calibrated, Pair, PairSource};
use crate::text::read_times;

/// A sequence of KITTI odometry: `image_2/` and `image_3/` (colour, preferred) or `image_0/` and `image_1/`
/// (grey), `calib.txt`, `times.txt`; truth in `poses.txt` or one `poses_*.txt` within, or where KITTI
/// puts it, in `../../poses/NN.txt`.
///
/// Times and poses belong to the frame whose name is their row, counted from 0, so a few images of a
/// sequence may stand beside its whole truth; a file with a row a frame may also go in order. KITTI's
/// poses are of camera 0: where camera 2 is used they are moved to it. Metres.
pub(super) const FORMAT: Format = Format {
    name: "kitti-odometry",
    layout: "image_2/ and image_3/ (or image_0/ and image_1/), calib.txt and times.txt",
    detect,
    open,
};

fn detect(dir: &Path) -> bool {
    cameras(dir).is_some() && dir.join("calib.txt").is_file() && dir.join("times.txt").is_file()
}

/// The left and right camera whose images there are.
fn cameras(dir: &Path) -> Option<(usize, usize)> {
    let there = |i: usize| dir.join(format!("image_{i}")).is_dir();
    [(2, 3), (0, 1)]
        .into_iter()
        .find(|(l, r)| there(*l) && there(*r))
}

#[allow(non_snake_case)]
fn open(dir: &Path) -> Result<PairSource, DataError> {
    let Some((left, right)) = cameras(dir) else {
        return Err(not_here(dir, &FORMAT));
    };
    let images = |camera: usize| list(&dir.join(format!("image_{camera}")), IMAGES);
    let images = pair_up(images(left)?, images(right)?)?;
    let numbers: Vec<Option<usize>> = images.iter().map(|(name, ..)| name.parse().ok()).collect();

    let calib_file = dir.join("calib.txt");
    let projections = read_projections(&calib_file)?;
    // The size of KITTI's images differs from drive to drive, and no file but the images tells it.
    let [(_, first, _), ..] = images.as_slice() else {
        return Err(not_here(dir, &FORMAT));
    };
    let (width, height) = image_size(first)?;
    let size = Some((width as usize, height as usize));
    let rig = projections.rig(&calib_file, left, right, size)?;
    let calibrated = Calibrated::new(&rig, &calib_file, first)?;

    let times_file = dir.join("times.txt");
    let times = by_number(&times_file, &read_times(&times_file)?, &numbers)?;
    let truth = match poses_file(dir)? {
        None => None,
        Some(path) => {
            let T_cam0_cam = projections.T_cam0_cam(&calib_file, left)?;
            let rows = Trajectory::read_kitti(&path, None)?.poses;
            let poses = by_number(&path, &rows, &numbers)?;
            let moved = poses
                .into_iter()
                .zip(&times)
                .map(|(pose, time)| StampedPose {
                    time: *time,
                    T_world_cam: pose.T_world_cam * T_cam0_cam,
                });
            Some(Trajectory {
                poses: moved.collect(),
            })
        }
    };
    let pair = |((name, left, right), time)| Pair {
        name,
        time,
        left,
        right,
        calibrated: calibrated.clone(),
        disparity: None,
        disparity_right: None,
    };
    let pairs = images.into_iter().zip(times).map(pair).collect();
    Ok(PairSource::new(dir, pairs)?.with_truth(truth))
}

/// The file of true poses, when there is one.
fn poses_file(dir: &Path) -> Result<Option<PathBuf>, DataError> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(DataError::io(dir))? {
        let path = entry.map_err(DataError::io(dir))?.path();
        let name = name_of(&path);
        if name == "poses.txt" || (name.starts_with("poses_") && name.ends_with(".txt")) {
            found.push(path);
        }
    }
    found.sort_by(|a, b| natural(&name_of(a), &name_of(b)));
    if let [first, second, ..] = found.as_slice() {
        let message = format!("and {} are both true poses: keep one", second.display());
        return Err(DataError::file(first, message));
    }
    let beside = dir.join(format!("../../poses/{}.txt", name_of(dir)));
    Ok(found.pop().or_else(|| beside.is_file().then_some(beside)))
}

/// The row of each frame: that of its number, else of its place where there are as many as frames.
fn by_number<T: Copy>(
    path: &Path,
    rows: &[T],
    numbers: &[Option<usize>],
) -> Result<Vec<T>, DataError> {
    let row = |number: &Option<usize>| number.and_then(|i| rows.get(i)).copied();
    if let Some(found) = numbers.iter().map(row).collect() {
        return Ok(found);
    }
    if rows.len() == numbers.len() {
        return Ok(rows.to_vec());
    }
    let message = format!(
        "{} rows for {} image pairs: a row for each frame number (000000.png is the first row), or as many rows as pairs, are needed",
        rows.len(),
        numbers.len()
    );
    Err(DataError::file(path, message))
}

#[cfg(test)]
mod tests {
    use super::super::tests::*;
    use super::*;
    use crate::StereoSource;
    use barchan_geometry::nalgebra::{Point3, Vector3};

    /// fx 100, (cx, cy) (20, 10); cameras at 0, 0.5, -0.06 and 0.44 along the x axis of camera 0.
    const CALIB: &str = "P0: 100 0 20 0 0 100 10 0 0 0 1 0\nP1: 100 0 20 -50 0 100 10 0 0 0 1 0\nP2: 100 0 20 6 0 100 10 0.1 0 0 1 0\nP3: 100 0 20 -44 0 100 10 0.2 0 0 1 0\n";

    /// Frames of the given numbers, with five times and five poses: camera 0 turned by a quarter
    /// to the left about y and moved along x.
    fn sequence(cameras: &[usize], frames: &[usize]) -> (tempfile::TempDir, PathBuf) {
        let root = tempfile::tempdir().unwrap();
        let dir = root.path().join("sequences/07");
        for camera in cameras {
            for frame in frames {
                let file = format!("image_{camera}/{frame:06}.png");
                save_image(&dir.join(file), (40, 20), (10 * camera + frame) as u8);
            }
        }
        save_text(&dir.join("calib.txt"), CALIB);
        save_text(&dir.join("times.txt"), "0\n0.1\n0.2\n0.3\n0.4\n");
        let poses: String = (0..5)
            .map(|i| format!("0 0 1 {i} 0 1 0 0 -1 0 0 0\n"))
            .collect();
        save_text(&root.path().join("poses/07.txt"), &poses);
        (root, dir)
    }

    #[test]
    fn rows_belong_to_frame_numbers_and_poses_to_the_camera_used() {
        for (cameras, expected, x) in [
            (&[0, 1][..], (3, 13), 0.0),
            (&[0, 1, 2, 3], (23, 33), -0.06),
        ] {
            let (_root, dir) = sequence(cameras, &[2, 3]);
            assert_eq!(detected(&dir), ["kitti-odometry"]);
            let source = open(&dir).unwrap();
            assert_eq!(names(&source), ["000002", "000003"]);
            assert_eq!(levels(&source, 1), expected);
            let rig = source.rig();
            assert_eq!(
                (rig.width, rig.height, rig.fx, rig.cx),
                (40, 20, 100.0, 20.0)
            );
            assert!((rig.baseline - 0.5).abs() < 1e-12 && rig.doffs == 0.0);
            assert_eq!(source.frame(1).unwrap().time, 0.3);
            // The point 4 m in front of camera 0, which looks along the world's x axis from x = 3.
            let pose = source.true_trajectory().unwrap().poses[1];
            assert_eq!(pose.time, 0.3);
            let y = if x == 0.0 { 0.0 } else { -0.001 };
            let p_cam = Point3::new(-x, -y, 4.0);
            let p_world = pose.T_world_cam * p_cam;
            assert!(
                (p_world.coords - Vector3::new(7.0, 0.0, 0.0)).norm() < 1e-9,
                "{p_world}"
            );
        }
    }

    #[test]
    fn opening_reads_no_pixels_and_truth_may_lie_within_or_be_absent() {
        let (root, dir) = sequence(&[0, 1], &[0, 1, 2]);
        for frame in 0..3 {
            cut_image(&dir.join(format!("image_0/{frame:06}.png")));
        }
        let source = open(&dir).unwrap();
        assert!(
            source
                .frame(1)
                .unwrap_err()
                .to_string()
                .contains("000001.png")
        );
        std::fs::remove_file(root.path().join("poses/07.txt")).unwrap();
        assert!(open(&dir).unwrap().true_trajectory().is_none());
        // As many rows as frames, whatever their numbers.
        let rows = "1 0 0 5 0 1 0 0 0 0 1 0\n".repeat(3);
        save_text(&dir.join("poses_07_full.txt"), &rows);
        let truth = open(&dir).unwrap().true_trajectory().cloned().unwrap();
        assert_eq!(
            truth.poses[2].T_world_cam,
            barchan_geometry::Se3::translation(5.0, 0.0, 0.0)
        );
        save_text(&dir.join("poses.txt"), &rows);
        assert!(message(&FORMAT, &dir).contains("keep one"));
    }

    #[test]
    fn what_is_missing_is_named() {
        let (_root, dir) = sequence(&[0, 1], &[0, 1, 7]);
        let short = message(&FORMAT, &dir);
        assert!(
            short.contains("times.txt") && short.contains("5 rows for 3"),
            "{short}"
        );
        std::fs::remove_file(dir.join("times.txt")).unwrap();
        assert!(message(&FORMAT, &dir).contains("times.txt"));
        save_text(&dir.join("calib.txt"), "P2: 1 2\n");
        assert!(message(&FORMAT, &dir).contains("calib.txt"));
        std::fs::remove_dir_all(dir.join("image_1")).unwrap();
        assert!(message(&FORMAT, &dir).contains("image_0/ and image_1/"));
    }

    #[test]
    fn the_first_frames_of_sequence_00_open_with_truth() {
        let Some(dir) = shared("kitti00-first21") else {
            return;
        };
        let source = open(&dir).unwrap();
        let rig = source.rig();
        assert_eq!((source.len(), rig.width, rig.height), (21, 1241, 376));
        assert!((rig.baseline - 386.1448 / 718.856).abs() < 1e-6);
        let poses = &source.true_trajectory().unwrap().poses;
        assert_eq!((poses.len(), poses[1].time), (21, 0.1037359));
        // The car drives forwards, 0.9 m a frame and more.
        let forward = (poses[0].T_world_cam.inverse() * poses[20].T_world_cam)
            .translation
            .vector;
        assert!(forward.z > 15.0 && forward.xy().norm() < 2.0, "{forward}");
    }
}
