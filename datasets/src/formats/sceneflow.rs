use std::path::{Path, PathBuf};
use std::sync::Arc;

use barchan_geometry::{RectifiedRig, Rig};

use super::{Format, not_here};
use crate::DataError;
use crate::listing::{IMAGES, Named, folders, list, name_of, pair_up, with_stem};
use crate::pairs::{Calibrated, Coding, Pair, PairSource, TrueDisparity};

/// SceneFlow (Mayer et al. 2016): FlyingThings3D, Driving, Monkaa, their samples and the FlyingThings3D
/// subset. A folder that holds `frames_cleanpass/` (or another of [`PASSES`], also with a name before
/// it, as `driving_frames_cleanpass/`) and `disparity/` (or `driving_disparity/`) with the same folders
/// inside, down to `left/` and `right/`. The clean pass is taken where both are there; a path to a
/// pass, or to a folder inside it (`frames_finalpass/TEST`), opens that.
///
/// Names are those of the folders, joined: `TRAIN-A-0000-0006`. Disparity is PFM of either sign.
/// The rig is Blender's: 35 mm on a sensor of 32 mm is 1050 px at 960x540 (450 px under
/// `15mm_focallength/`), the principal point (479.5, 269.5); the baseline is 1, so a
/// metre is a unit of Blender. Where consecutive frames are from one scene nothing says so: every
/// frame counts as alone, and its time is its index.
pub(super) const FORMAT: Format = Format {
    name: "sceneflow",
    layout: "frames_cleanpass/, frames_finalpass/, RGB_cleanpass/ or image_clean/, and disparity/ beside it, each down to left/ and right/ (FlyingThings3D, Driving, Monkaa)",
    detect,
    open,
};

/// Folders of images by how their names end, and those of disparity in their place.
const PASSES: &[(&str, &[&str])] = &[
    ("frames_cleanpass", &["disparity", "frames_disparity"]),
    ("RGB_cleanpass", &["disparity"]),
    ("image_clean", &["disparity"]),
    ("frames_finalpass", &["disparity", "frames_disparity"]),
    ("RGB_finalpass", &["disparity"]),
    ("image_final", &["disparity"]),
];

/// Deeper than any of these datasets goes, and an end to links in circles.
const MAX_DEPTH: usize = 6;

fn detect(dir: &Path) -> bool {
    passes(dir).is_ok_and(|passes| !passes.is_empty())
}

/// A folder of images, and beside it its disparity, when there is some.
struct Pass {
    images: PathBuf,
    disparity: Option<PathBuf>,
    /// The part of it that is asked for.
    inside: PathBuf,
}

fn as_pass(path: &Path) -> Option<(&'static str, Pass)> {
    let name = name_of(path);
    let (kind, truths) = PASSES.iter().find(|(kind, _)| name.ends_with(kind))?;
    let prefix = name.strip_suffix(kind)?;
    let beside = |truth: &&str| path.join("..").join(format!("{prefix}{truth}"));
    let disparity = truths.iter().map(beside).find(|d| d.is_dir());
    let pass = Pass {
        images: path.to_owned(),
        disparity,
        inside: PathBuf::new(),
    };
    Some((kind, pass))
}

/// The pass that a folder is or lies in; else, of those that it holds, the ones of the preferred kind.
fn passes(dir: &Path) -> Result<Vec<Pass>, DataError> {
    let whole = dir.canonicalize().map_err(DataError::io(dir))?;
    for above in whole.ancestors().take(MAX_DEPTH + 1) {
        if let Some((_, pass)) = as_pass(above) {
            let inside = whole
                .strip_prefix(above)
                .unwrap_or(Path::new(""))
                .to_owned();
            return Ok(vec![Pass { inside, ..pass }]);
        }
    }
    let all: Vec<_> = folders(dir)?
        .iter()
        .filter_map(|(_, path)| as_pass(path))
        .collect();
    let Some((preferred, _)) = PASSES
        .iter()
        .find(|(kind, _)| all.iter().any(|(found, _)| found == kind))
    else {
        return Ok(Vec::new());
    };
    let kept = all.into_iter().filter(|(kind, _)| kind == preferred);
    Ok(kept.map(|(_, pass)| pass).collect())
}

fn open(dir: &Path) -> Result<PairSource, DataError> {
    let passes = passes(dir)?;
    if passes.is_empty() {
        return Err(not_here(dir, &FORMAT));
    }
    let mut rigs: Vec<(f64, Arc<Calibrated>)> = Vec::new();
    let mut pairs: Vec<Pair> = Vec::new();
    for Pass {
        images,
        disparity,
        inside,
    } in passes
    {
        let mut scenes = Vec::new();
        let asked = images.join(&inside);
        let parts = inside.iter().map(|part| part.to_string_lossy() + "-");
        find_scenes(&images, (parts.collect(), inside), 0, &mut scenes)?;
        if scenes.is_empty() {
            return Err(DataError::file(
                &asked,
                "holds no left/ and right/ at any depth; open the folder that holds both",
            ));
        }
        for (prefix, inside) in scenes {
            let scene = images.join(&inside);
            let side = |side: &str| list(&scene.join(side), IMAGES);
            let short = inside.iter().any(|part| part == "15mm_focallength");
            let focal = if short { 450.0 } else { 1050.0 };
            for (name, left, right) in pair_up(side("left")?, side("right")?)? {
                let calibrated = match rigs.iter().find(|(f, _)| *f == focal) {
                    Some((_, calibrated)) => calibrated.clone(),
                    None => {
                        let new = Calibrated::new(&blender(focal), Path::new("SceneFlow"), &left)?;
                        rigs.push((focal, new.clone()));
                        new
                    }
                };
                let truth = |side: &str| {
                    let dir = disparity.as_ref()?.join(&inside).join(side);
                    let path = with_stem(&dir, &name, &["pfm"])?;
                    let coding = Coding::EitherSign;
                    Some(TrueDisparity { path, coding })
                };
                pairs.push(Pair {
                    time: pairs.len() as f64,
                    disparity: truth("left"),
                    disparity_right: truth("right"),
                    name: format!("{prefix}{name}"),
                    left,
                    right,
                    calibrated,
                });
            }
        }
    }
    PairSource::new(dir, pairs)
}

/// The folders under `images/inside` that hold `left/` and `right/`, with the names on the way joined.
fn find_scenes(
    images: &Path,
    (prefix, inside): Named,
    depth: usize,
    found: &mut Vec<Named>,
) -> Result<(), DataError> {
    let here = images.join(&inside);
    if here.join("left").is_dir() && here.join("right").is_dir() {
        found.push((prefix, inside));
        return Ok(());
    }
    if depth == MAX_DEPTH {
        return Ok(());
    }
    for (name, _) in folders(&here)? {
        let below = (format!("{prefix}{name}-"), inside.join(&name));
        find_scenes(images, below, depth + 1, found)?;
    }
    Ok(())
}

fn blender(focal: f64) -> Rig {
    Rig::from(RectifiedRig {
        width: 960,
        height: 540,
        fx: focal,
        fy: focal,
        cx: 479.5,
        cy: 269.5,
        doffs: 0.0,
        baseline: 1.0,
    })
}

#[cfg(test)]
mod tests {
    use super::super::tests::*;
    use super::*;
    use crate::{Plane, StereoSource, disparity_file};

    fn pair(pass: &Path, disparity: &Path, inside: &str, name: &str, level: u8, d: f32) {
        for (side, level) in [("left", level), ("right", level + 1)] {
            let path = pass.join(inside).join(side).join(format!("{name}.png"));
            save_image(&path, (960, 540), level);
            let path = disparity
                .join(inside)
                .join(side)
                .join(format!("{name}.pfm"));
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            let plane = Plane::from_pixel(960, 540, image::Luma([d]));
            disparity_file::write_pfm(&path, &plane).unwrap();
        }
    }

    #[test]
    fn flyingthings_takes_the_clean_pass_and_the_size_of_disparity() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        pair(
            &at("frames_cleanpass"),
            &at("disparity"),
            "TRAIN/A/0000",
            "0006",
            10,
            -12.5,
        );
        pair(
            &at("frames_cleanpass"),
            &at("disparity"),
            "TEST/B/0010",
            "0007",
            20,
            8.0,
        );
        pair(
            &at("frames_finalpass"),
            &at("disparity"),
            "TEST/B/0010",
            "0007",
            30,
            8.0,
        );
        assert_eq!(detected(dir.path()), ["sceneflow"]);
        let source = open(dir.path()).unwrap();
        assert_eq!(names(&source), ["TEST-B-0010-0007", "TRAIN-A-0000-0006"]);
        assert_eq!(levels(&source, 1), (10, 11));
        let rig = source.frame_rig(1);
        assert_eq!(
            (rig.fx, rig.cx, rig.cy, rig.baseline),
            (1050.0, 479.5, 269.5, 1.0)
        );
        for plane in [source.true_disparity(1), source.true_disparity_right(1)] {
            assert_eq!(plane.unwrap().unwrap()[(7, 7)].0[0], 12.5);
        }
        let chosen = open(&at("frames_finalpass")).unwrap();
        assert_eq!((chosen.len(), levels(&chosen, 0)), (1, (30, 31)));
        assert!(chosen.true_disparity(0).unwrap().is_some());
        for part in ["TRAIN", "TRAIN/A/0000"] {
            let part = at("frames_cleanpass").join(part);
            assert_eq!(detected(&part).first(), Some(&"sceneflow"));
            let source = open(&part).unwrap();
            assert_eq!(names(&source), ["TRAIN-A-0000-0006"]);
            assert!(source.true_disparity(0).unwrap().is_some());
        }
    }

    #[test]
    fn driving_has_two_focal_lengths_and_monkaa_a_name_before() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        let (pass, truth) = (at("driving_frames_cleanpass"), at("driving_disparity"));
        pair(
            &pass,
            &truth,
            "15mm_focallength/scene_backwards/fast",
            "0001",
            10,
            3.0,
        );
        pair(
            &pass,
            &truth,
            "35mm_focallength/scene_forwards/slow",
            "0001",
            20,
            3.0,
        );
        pair(
            &at("monkaa_frames_cleanpass"),
            &at("none"),
            "a_rain_of_stones_x2",
            "0000",
            40,
            3.0,
        );
        let source = open(dir.path()).unwrap();
        let focal: Vec<f64> = (0..3).map(|i| source.frame_rig(i).fx).collect();
        assert_eq!(focal, [450.0, 1050.0, 1050.0]);
        assert_eq!(source.name(0), "15mm_focallength-scene_backwards-fast-0001");
        assert!(source.true_disparity(1).unwrap().is_some());
        assert!(source.true_disparity(2).unwrap().is_none());
    }

    #[test]
    fn opening_reads_no_image_and_a_broken_layout_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let pass = dir.path().join("frames_cleanpass");
        for side in ["left", "right"] {
            save_text(
                &pass.join("TRAIN/A/0000").join(side).join("0006.png"),
                "no image",
            );
        }
        let source = open(dir.path()).unwrap();
        assert!(
            source
                .frame(0)
                .unwrap_err()
                .to_string()
                .contains("0006.png")
        );
        std::fs::remove_file(pass.join("TRAIN/A/0000/right/0006.png")).unwrap();
        assert!(message(&FORMAT, dir.path()).contains("right: holds no image"));
        std::fs::remove_dir(pass.join("TRAIN/A/0000/right")).unwrap();
        assert!(message(&FORMAT, dir.path()).contains("holds no left/ and right/"));
    }

    #[test]
    fn the_shared_sample_opens_with_truth() {
        let Some(dir) = shared("sceneflow-sample") else {
            return;
        };
        let source = open(&dir).unwrap();
        assert_eq!(names(&source), ["A-0032-0006"]);
        let truth = source.true_disparity(0).unwrap().unwrap();
        assert!(truth.iter().all(|d| *d > 0.0 && *d < 400.0));
        // Truth warps the right image onto the left one better than the same shift the other way.
        let frame = source.frame(0).unwrap();
        let error = |sign: f32| {
            let (mut sum, mut n) = (0.0, 0);
            for (x, y, d) in truth.enumerate_pixels() {
                let at = x as f32 - sign * d.0[0];
                if (0.0..960.0).contains(&at.round()) {
                    let right = frame.right[(at.round() as u32, y)].0[1];
                    sum += (right - frame.left[(x, y)].0[1]).abs();
                    n += 1;
                }
            }
            sum / n as f32
        };
        assert!(
            error(1.0) < 0.5 * error(-1.0),
            "{} {}",
            error(1.0),
            error(-1.0)
        );
    }
}
