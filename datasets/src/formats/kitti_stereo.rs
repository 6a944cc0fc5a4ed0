use std::path::{Path, PathBuf};

use super::{Format, not_here};
use crate::DataError;
use crate::calibration::read_projections;
use crate::image_file::image_size;
use crate::listing::{IMAGES, list, pair_up, with_stem};
use crate::pairs::{Calibrated, Coding, Pair, PairSource, TrueDisparity};

/// KITTI stereo 2012 and 2015: `training/` or `testing/`, or the folder that holds them (then
/// `training/`). Of each scene the pair with truth, `NNNNNN_10`, is taken.
///
/// | | 2012 | 2015 |
/// |---|---|---|
/// | colour, preferred | `colored_0/` `colored_1/` | `image_2/` `image_3/` |
/// | grey | `image_0/` `image_1/` | `image_0/` `image_1/` |
/// | calibration | `calib/NNNNNN.txt` | `calib_cam_to_cam/NNNNNN.txt` |
/// | truth with occluded pixels | `disp_occ/` | `disp_occ_0/` |
/// | without | `disp_noc/` | `disp_noc_0/` |
///
/// Images differ in size, and every pair has a rig of its own. Metres.
pub(super) const FORMAT: Format = Format {
    name: "kitti-stereo",
    layout: "training/ or testing/ with image_2/ and image_3/ (2015), colored_0/ and colored_1/ or image_0/ and image_1/ (2012), of images NNNNNN_10.png, and calib/ or calib_cam_to_cam/",
    detect,
    open,
};

/// Folders of the left and right images, and the numbers of the two cameras.
const SIDES: &[(&str, &str, usize, usize)] = &[
    ("image_2", "image_3", 2, 3),
    ("colored_0", "colored_1", 2, 3),
    ("image_0", "image_1", 0, 1),
];

fn detect(dir: &Path) -> bool {
    let root = root(dir);
    sides(&root).is_some()
        && ["calib", "calib_cam_to_cam"]
            .iter()
            .any(|c| root.join(c).is_dir())
}

fn root(dir: &Path) -> PathBuf {
    let within = ["training", "testing"].map(|part| dir.join(part));
    within
        .into_iter()
        .find(|d| d.is_dir())
        .unwrap_or_else(|| dir.to_owned())
}

fn sides(root: &Path) -> Option<(&'static str, &'static str, usize, usize)> {
    SIDES
        .iter()
        .copied()
        .find(|(left, right, ..)| root.join(left).is_dir() && root.join(right).is_dir())
}

fn open(dir: &Path) -> Result<PairSource, DataError> {
    let root = root(dir);
    let Some((left, right, left_camera, right_camera)) = sides(&root) else {
        return Err(not_here(dir, &FORMAT));
    };
    let of_10 = |side: &str| {
        let mut images = list(&root.join(side), IMAGES)?;
        images.retain(|(name, _)| name.ends_with("_10"));
        if images.is_empty() {
            return Err(DataError::file(
                &root.join(side),
                "holds no image NNNNNN_10.png",
            ));
        }
        Ok(images)
    };
    let mut pairs = Vec::new();
    for (name, left, right) in pair_up(of_10(left)?, of_10(right)?)? {
        let scene = name.trim_end_matches("_10");
        let calib_file = ["calib", "calib_cam_to_cam"]
            .iter()
            .find_map(|calib| with_stem(&root.join(calib), scene, &["txt"]))
            .ok_or_else(|| {
                let missing = root.join("calib_cam_to_cam").join(format!("{scene}.txt"));
                let message = "missing, and calib/ has none of this name: unpack the calibration files of the benchmark here";
                DataError::file(&missing, message)
            })?;
        // A header, not an image: the sizes of 2012 stand nowhere else.
        let (width, height) = image_size(&left)?;
        let mut rig = read_projections(&calib_file)?.rig(
            &calib_file,
            left_camera,
            right_camera,
            Some((width as usize, height as usize)),
        )?;
        // Some calibration files of 2015 are of the drive, a pixel off the image: the image is right.
        (rig.width, rig.height) = (width as usize, height as usize);
        let truth = ["disp_occ_0", "disp_occ", "disp_noc_0", "disp_noc"]
            .iter()
            .find_map(|truth| with_stem(&root.join(truth), &name, &["png"]));
        pairs.push(Pair {
            time: pairs.len() as f64,
            calibrated: Calibrated::new(&rig, &calib_file, &left)?,
            name,
            left,
            right,
            disparity: truth.map(|path| TrueDisparity {
                path,
                coding: Coding::Plain,
            }),
            disparity_right: None,
        });
    }
    PairSource::new(dir, pairs)
}

#[cfg(test)]
mod tests {
    use super::super::tests::*;
    use super::*;
    use crate::{Plane, StereoSource, disparity_file};

    fn truth(path: &Path, (width, height): (u32, u32), disparity: f32) {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let mut plane = Plane::from_pixel(width, height, image::Luma([disparity]));
        plane[(0, 0)].0[0] = f32::NAN;
        disparity_file::write_png(path, &plane).unwrap();
    }

    /// Two scenes of different size and calibration, each with a second pair (`_11`).
    fn benchmark(left: &str, right: &str, calib: &str, line: &str) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        let dir = root.path().join("training");
        for (scene, size) in [(0, (40, 20)), (1, (44, 21))] {
            for (side, level) in [(left, 50), (right, 60)] {
                for part in [10, 11] {
                    let path = dir.join(side).join(format!("{scene:06}_{part}.png"));
                    save_image(&path, size, level + scene + part);
                }
            }
            let (l, r) = if left.ends_with('0') && left.starts_with("image") {
                (0, 1)
            } else {
                (2, 3)
            };
            let f = 100 + scene;
            let text = format!(
                "{line}{l}: {f} 0 20 6 0 {f} 10 0 0 0 1 0\n{line}{r}: {f} 0 20 -{} 0 {f} 10 0 0 0 1 0\n",
                f / 2 - 6
            );
            save_text(&dir.join(calib).join(format!("{scene:06}.txt")), &text);
        }
        root
    }

    #[test]
    fn each_pair_of_2015_has_its_size_rig_and_truth() {
        let root = benchmark("image_2", "image_3", "calib_cam_to_cam", "P_rect_0");
        let dir = root.path().join("training");
        truth(&dir.join("disp_occ_0/000001_10.png"), (44, 21), 7.5);
        truth(&dir.join("disp_noc_0/000001_10.png"), (44, 21), 9.0);
        for path in [root.path(), &dir] {
            assert_eq!(detected(path), ["kitti-stereo"]);
            let source = open(path).unwrap();
            assert_eq!(names(&source), ["000000_10", "000001_10"]);
            assert_eq!(levels(&source, 1), (61, 71));
            let (a, b) = (source.frame_rig(0), source.frame_rig(1));
            assert_eq!((a.width, a.height, a.fx), (40, 20, 100.0));
            assert_eq!((b.width, b.height, b.fx), (44, 21, 101.0));
            assert_eq!(source.rig(), a);
            assert!((a.baseline - 0.5).abs() < 1e-12);
            assert!(source.true_disparity(0).unwrap().is_none());
            let plane = source.true_disparity(1).unwrap().unwrap();
            assert!(plane[(0, 0)].0[0].is_nan());
            assert_eq!(plane[(43, 20)].0[0], 7.5);
        }
    }

    #[test]
    fn grey_and_colour_of_2012_are_told_apart() {
        for (left, right) in [("image_0", "image_1"), ("colored_0", "colored_1")] {
            let root = benchmark(left, right, "calib", "P");
            truth(
                &root.path().join("training/disp_occ/000000_10.png"),
                (40, 20),
                3.25,
            );
            let source = open(root.path()).unwrap();
            assert!((source.frame_rig(0).baseline - 0.5).abs() < 1e-12);
            let plane = source.true_disparity(0).unwrap().unwrap();
            assert_eq!(plane[(5, 5)].0[0], 3.25);
        }
    }

    #[test]
    fn what_is_missing_is_named_and_no_pixels_are_read() {
        let root = benchmark("image_2", "image_3", "calib_cam_to_cam", "P_rect_0");
        let dir = root.path().join("training");
        cut_image(&dir.join("image_2/000001_10.png"));
        let source = open(root.path()).unwrap();
        assert!(
            source
                .frame(1)
                .unwrap_err()
                .to_string()
                .contains("000001_10.png")
        );
        std::fs::remove_file(dir.join("calib_cam_to_cam/000001.txt")).unwrap();
        assert!(message(&FORMAT, &dir).contains("calib_cam_to_cam/000001.txt: missing"));
        std::fs::remove_file(dir.join("image_3/000001_10.png")).unwrap();
        assert!(message(&FORMAT, &dir).contains("image_3/000001_10.png: missing"));
        std::fs::remove_file(dir.join("image_3/000000_10.png")).unwrap();
        assert!(message(&FORMAT, &dir).contains("NNNNNN_10.png"));
    }
}
