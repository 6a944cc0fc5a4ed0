use std::path::Path;
use std::sync::Arc;

use barchan_geometry::{RectifiedRig, Rig};

use super::{Format, not_here};
use crate::DataError;
use crate::calibration::read_middlebury;
use crate::image_file::image_size;
use crate::listing::{DISPARITIES, IMAGES, folders, name_of, with_stem};
use crate::pairs::{Calibrated, Coding, Pair, PairSource, TrueDisparity};
use crate::text::number;

/// Middlebury stereo: one scene, or a folder of scenes, in the layouts of
///
/// - 2014, 2021 and evaluation version 3: `im0` `im1` `calib.txt` and, with truth, `disp0GT.pfm` or
///   `disp0.pfm` (`disp1...` of the right image);
/// - 2005 and 2006: `view1` `view5` and `disp1` `disp5` (8 bits, times 1, 2 or 3 in full, half and
///   third size; 0 not known) and `dmin.txt`, which is added to the disparity in full size before depth
///   is taken: `doffs` of the rig. Focal length 3740 px in full size, baseline 0.16 m;
/// - 2003: `im2` `im6` and `disp2` `disp6` (8 bits, times 1, 2 or 4 in full, half and quarter size; or
///   PFM in pixels). Middlebury gives no calibration: the usual assumption is taken, that of 2006 (so
///   935 px in quarter size). Metres from 2003 are of that worth.
///
/// The principal point of 2003 and 2006 is not known either; the middle of the image stands in.
pub(super) const FORMAT: Format = Format {
    name: "middlebury",
    layout: "im0, im1 and calib.txt (2014), view1 and view5 (2006) or im2 and im6 (2003), or a folder of such scenes",
    detect,
    open,
};

fn detect(dir: &Path) -> bool {
    is_scene(dir)
        || folders(dir).is_ok_and(|scenes| scenes.iter().any(|(_, scene)| is_scene(scene)))
}

fn is_scene(dir: &Path) -> bool {
    let both = |l, r| with_stem(dir, l, IMAGES).is_some() && with_stem(dir, r, IMAGES).is_some();
    (both("im0", "im1") && dir.join("calib.txt").is_file())
        || both("view1", "view5")
        || both("im2", "im6")
}

fn open(dir: &Path) -> Result<PairSource, DataError> {
    let scenes = if is_scene(dir) {
        vec![(name_of(dir), dir.to_owned())]
    } else {
        let mut scenes = folders(dir)?;
        scenes.retain(|(_, scene)| is_scene(scene));
        scenes
    };
    if scenes.is_empty() {
        return Err(not_here(dir, &FORMAT));
    }
    let pairs = scenes.into_iter().enumerate();
    let pairs = pairs.map(|(i, (name, scene))| read_scene(&scene, name, i as f64));
    PairSource::new(dir, pairs.collect::<Result<_, _>>()?)
}

/// A full-size focal length and baseline, as Middlebury gives for 2005 and 2006.
const FULL_FOCAL: f64 = 3740.0;
const BASELINE: f64 = 0.16;

fn read_scene(dir: &Path, name: String, time: f64) -> Result<Pair, DataError> {
    let image = |stem: &str| with_stem(dir, stem, IMAGES);
    let pair = |stems: [&str; 2]| image(stems[0]).zip(image(stems[1]));
    let truth = |stems: &[&str], coding| {
        let file = |stem: &&str| with_stem(dir, stem, DISPARITIES);
        let path = stems.iter().find_map(file)?;
        Some(TrueDisparity { path, coding })
    };
    let assemble = |left, right, calibrated: Arc<Calibrated>, disparity, disparity_right| Pair {
        name: name.clone(),
        time,
        left,
        right,
        calibrated,
        disparity,
        disparity_right,
    };
    let calib_file = dir.join("calib.txt");
    // Scenes of 2003 have im0 to im8, but no calibration.
    if let Some((left, right)) = pair(["im0", "im1"])
        && calib_file.is_file()
    {
        let size = image_size(&left)?;
        let rig = read_middlebury(&calib_file, Some((size.0 as usize, size.1 as usize)))?;
        let calibrated = Calibrated::new(&rig, &calib_file, &left)?;
        return Ok(assemble(
            left,
            right,
            calibrated,
            truth(&["disp0GT", "disp0"], Coding::Plain),
            truth(&["disp1GT", "disp1"], Coding::Plain),
        ));
    }
    if let Some((left, right)) = pair(["view1", "view5"]) {
        // Every scene of 2005 and 2006 is 1110 rows high in full size.
        let shrunk = shrunk(&left, 1110, &[1, 2, 3])?;
        let dmin_file = dir.join("dmin.txt");
        let dmin = if dmin_file.is_file() {
            let text = std::fs::read_to_string(&dmin_file).map_err(DataError::io(&dmin_file))?;
            number(&dmin_file, 0, &text)?
        } else {
            0.0
        };
        let coding = Coding::Grey {
            factor: shrunk as f32,
        };
        let calibrated = assumed(&left, shrunk, dmin / f64::from(shrunk))?;
        return Ok(assemble(
            left,
            right,
            calibrated,
            truth(&["disp1"], coding),
            truth(&["disp5"], coding),
        ));
    }
    let (left, right) = pair(["im2", "im6"]).ok_or_else(|| not_here(dir, &FORMAT))?;
    let shrunk = shrunk(&left, 1500, &[1, 2, 4])?;
    let coding = Coding::Grey {
        factor: shrunk as f32,
    };
    let calibrated = assumed(&left, shrunk, 0.0)?;
    Ok(assemble(
        left,
        right,
        calibrated,
        truth(&["disp2"], coding),
        truth(&["disp6"], coding),
    ))
}

/// By how much a scene of `full` rows was shrunk.
fn shrunk(image: &Path, full: u32, sizes: &[u32]) -> Result<u32, DataError> {
    let rows = image_size(image)?.1;
    let fits = |s: &&u32| rows.abs_diff(full / **s) <= 1;
    sizes.iter().find(fits).copied().ok_or_else(|| {
        let known: Vec<String> = sizes.iter().map(|s| (full / s).to_string()).collect();
        let message = format!(
            "{rows} rows high: Middlebury's sizes of this layout have {} rows, and the scale of the disparities depends on it; for other images use the layout of format folder",
            known.join(", ")
        );
        DataError::file(image, message)
    })
}

fn assumed(image: &Path, shrunk: u32, doffs: f64) -> Result<Arc<Calibrated>, DataError> {
    let (width, height) = image_size(image)?;
    let rig = Rig::from(RectifiedRig {
        width: width as usize,
        height: height as usize,
        fx: FULL_FOCAL / f64::from(shrunk),
        fy: FULL_FOCAL / f64::from(shrunk),
        cx: (f64::from(width) - 1.0) / 2.0,
        cy: (f64::from(height) - 1.0) / 2.0,
        doffs,
        baseline: BASELINE,
    });
    rig.validate(image)?;
    Calibrated::new(&rig, image, image)
}

#[cfg(test)]
mod tests {
    use super::super::tests::*;
    use super::*;
    use crate::{Plane, StereoSource, disparity_file};

    fn scene_2014(dir: &Path, width: u32, baseline: f64) {
        save_image(&dir.join("im0.png"), (width, 20), 10);
        save_image(&dir.join("im1.png"), (width, 20), 20);
        let text = format!(
            "cam0=[100 0 15; 0 100 9; 0 0 1]\ncam1=[100 0 18.5; 0 100 9; 0 0 1]\ndoffs=3.5\nbaseline={baseline}\nwidth={width}\nheight=20\n"
        );
        save_text(&dir.join("calib.txt"), &text);
        for (name, d) in [("disp0.pfm", 4.5), ("disp1.pfm", 5.5)] {
            let plane = Plane::from_pixel(width, 20, image::Luma([d]));
            disparity_file::write_pfm(&dir.join(name), &plane).unwrap();
        }
    }

    fn grey(path: &Path, (width, height): (u32, u32), value: u8) {
        save_image(path, (width, height), value);
        let mut image = image::open(path).unwrap().into_luma8();
        image[(0, 0)].0[0] = 0;
        image.save(path).unwrap();
    }

    #[test]
    fn scenes_of_2014_differ_and_are_in_metres_with_doffs() {
        let dir = tempfile::tempdir().unwrap();
        scene_2014(&dir.path().join("Piano"), 30, 193.0);
        scene_2014(&dir.path().join("Adirondack"), 34, 80.0);
        save_text(&dir.path().join("notes/readme.txt"), "");
        assert_eq!(detected(dir.path()), ["middlebury"]);
        let source = open(dir.path()).unwrap();
        assert_eq!(names(&source), ["Adirondack", "Piano"]);
        let (a, p) = (source.frame_rig(0), source.frame_rig(1));
        assert_eq!(
            (a.width, a.baseline, p.width, p.baseline),
            (34, 0.08, 30, 0.193)
        );
        assert_eq!((a.doffs, a.cx, a.fx), (3.5, 15.0, 100.0));
        let left = source.true_disparity(1).unwrap().unwrap();
        let right = source.true_disparity_right(1).unwrap().unwrap();
        assert_eq!((left[(3, 3)].0[0], right[(3, 3)].0[0]), (4.5, 5.5));
        // A point at depth f b / (d + doffs) projects to that disparity.
        assert!((p.depth(4.5) - 100.0 * 0.193 / 8.0).abs() < 1e-12);
        let one = open(&dir.path().join("Piano")).unwrap();
        assert_eq!(
            (names(&one), levels(&one, 0)),
            (vec!["Piano".to_owned()], (10, 20))
        );
    }

    #[test]
    fn third_size_of_2006_is_scaled_and_its_dmin_is_doffs() {
        let dir = tempfile::tempdir().unwrap();
        let scene = dir.path().join("Aloe");
        let size = (427, 370);
        save_image(&scene.join("view1.png"), size, 10);
        save_image(&scene.join("view5.png"), size, 20);
        grey(&scene.join("disp1.png"), size, 120);
        grey(&scene.join("disp5.png"), size, 60);
        save_text(&scene.join("dmin.txt"), "270\r\n");
        assert_eq!(detected(&scene), ["middlebury"]);
        let source = open(&scene).unwrap();
        let rig = source.rig();
        assert!((rig.fx - 3740.0 / 3.0).abs() < 1e-9 && rig.baseline == 0.16 && rig.doffs == 90.0);
        let (left, right) = (
            source.true_disparity(0).unwrap().unwrap(),
            source.true_disparity_right(0).unwrap().unwrap(),
        );
        assert_eq!((left[(9, 9)].0[0], right[(9, 9)].0[0]), (40.0, 20.0));
        assert!(left[(0, 0)].0[0].is_nan());
        // Full size: depth f b / (120 + 270), whatever the size of the images.
        assert!((rig.depth(40.0) - 3740.0 * 0.16 / 390.0).abs() < 1e-9);
        save_text(&scene.join("dmin.txt"), "many");
        assert!(message(&FORMAT, &scene).contains("dmin.txt"));
    }

    #[test]
    fn quarter_size_of_2003_is_scaled_and_other_sizes_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let size = (450, 375);
        save_image(&dir.path().join("im2.ppm"), size, 10);
        save_image(&dir.path().join("im6.ppm"), size, 20);
        save_image(&dir.path().join("im0.ppm"), size, 30);
        save_image(&dir.path().join("im1.ppm"), size, 40);
        grey(&dir.path().join("disp2.png"), size, 130);
        let source = open(dir.path()).unwrap();
        assert_eq!((source.rig().fx, source.rig().baseline), (935.0, 0.16));
        assert_eq!(levels(&source, 0), (10, 20));
        assert_eq!(
            source.true_disparity(0).unwrap().unwrap()[(9, 9)].0[0],
            32.5
        );
        assert!(source.true_disparity_right(0).unwrap().is_none());
        save_image(&dir.path().join("im2.ppm"), (450, 300), 10);
        let message = message(&FORMAT, dir.path());
        assert!(
            message.contains("im2.ppm") && message.contains("300 rows"),
            "{message}"
        );
    }

    #[test]
    fn opening_reads_no_pixels_and_a_broken_calibration_is_named() {
        let dir = tempfile::tempdir().unwrap();
        scene_2014(dir.path(), 30, 193.0);
        cut_image(&dir.path().join("im1.png"));
        let source = open(dir.path()).unwrap();
        assert!(source.frame(0).unwrap_err().to_string().contains("im1.png"));
        save_text(&dir.path().join("calib.txt"), "cam0=[1 2 3]\n");
        assert!(message(&FORMAT, dir.path()).contains("calib.txt"));
    }

    #[test]
    fn the_shared_scenes_open_with_truth() {
        if let Some(dir) = shared("middlebury2003/cones") {
            let source = open(&dir).unwrap();
            assert_eq!((source.rig().width, source.rig().height), (450, 375));
            let truth = source.true_disparity(0).unwrap().unwrap();
            let known: Vec<f32> = truth.iter().copied().filter(|d| d.is_finite()).collect();
            assert!(known.len() > 140_000 && known.iter().all(|d| (0.0..64.0).contains(d)));
        }
        if let Some(dir) = shared("middlebury2014/trainingQ") {
            let source = open(&dir).unwrap();
            assert_eq!(names(&source), ["Motorcycle"]);
            let rig = source.rig();
            assert_eq!((rig.width, rig.height, rig.baseline), (741, 497, 0.193001));
            assert!((rig.doffs - 32.778).abs() < 1e-9);
            let truth = source.true_disparity(0).unwrap().unwrap();
            assert!(
                truth
                    .iter()
                    .filter(|d| d.is_finite())
                    .all(|d| (5.0..70.0).contains(d))
            );
        }
    }
}
