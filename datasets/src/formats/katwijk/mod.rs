mod scans;
mod tables;

use std::path::{Path, PathBuf};

use barchan_geometry::nalgebra::{Quaternion, UnitQuaternion, Vector3};
use barchan_geometry::{Camera, Distortion, Rig, Se3, StampedPose, Trajectory};

use super::{Format, not_here};
use crate::calibration::{find_calibration, load_rig};
use crate::listing::{Named, list};
use crate::pairs::{Calibrated, Pair, PairSource};
use crate::sensor_files::{IMU_MOUNT, read_mount};
use crate::{DataError, GnssFix, ImuSample, OdometrySample, Sensors};
pub use scans::{RangeScan, RangeSensor};
use tables::{Fix, WHEELS, Wheels, read_fixes, read_imu, read_wheels, stamp};
pub use tables::{PanTilt, read_ptu, read_rocks};
pub(crate) use tables::{ZONE, to_utm31};

/// Katwijk beach (ESA 2015): a part of a traverse with the images of the localisation camera in
/// `LocCam/` or beside the text files, as `LocCam_YYYY_MM_DD_hh_mm_ss_mmm_{0,1}.png`, 0 the left one.
/// Images are rectified on reading, by the calibration published with the archive; one that lies
/// with the images, or beside the text files, goes before it.
///
/// Names are time stamps, times are seconds since 1970. Left and right belong together when they
/// are at most [`PAIR_TOLERANCE`] apart.
///
/// Truth is planar, from `gps-latlong.txt`, else `gps-utm31.txt`: east and north of the first fix, in
/// UTM zone 31 north, z = 0, no rotation, interpolated between fixes at most [`FIX_TOLERANCE`]
/// apart. Frames outside it are left out as in format `euroc`: where it covers less than half
/// of the frames they all stay, without truth. It is the antenna that is tracked, not the camera.
///
/// `imu.txt`, `odometry.txt` and the fixes give [`Sensors`]. The IMU is mounted as [`T_imu_loc_cam`] says, or as
/// an `imu.tum` as of format `folder` beside the text files does. The archive does not tell the size of the
/// wheels: speed needs the fixes (see [`odometry`]). `ptu.txt` and the positions of rocks are read by
/// [`read_ptu`](crate::katwijk::read_ptu) and [`read_rocks`](crate::katwijk::read_rocks), range images in `ToF/` and
/// `Velodyne/` by [`RangeSensor`].
pub(super) const FORMAT: Format = Format {
    name: "katwijk",
    layout: "LocCam/ with LocCam_YYYY_MM_DD_hh_mm_ss_mmm_0.png (left) and _1.png (right)",
    detect: |dir| image_folder(dir, "LocCam").is_some(),
    open: |dir| open(dir, "LocCam", &FORMAT, loc_cam()),
};

/// The same with the camera pair on the mast. Its principal points and distortion are not among the
/// published figures: without a calibration in `PanCam/`, the middle of the image and none are taken. The mast
/// turns, so the IMU, which does not, says nothing of these cameras and is left out.
pub(super) const PAN_CAM: Format = Format {
    name: "katwijk-pancam",
    layout: "PanCam/ with PanCam_YYYY_MM_DD_hh_mm_ss_mmm_0.png (left) and _1.png (right)",
    detect: |dir| image_folder(dir, "PanCam").is_some() && !(FORMAT.detect)(dir),
    open: |dir| open(dir, "PanCam", &PAN_CAM, pan_cam()),
};

/// Seconds between the stamps of the two images of a pair, at most.
const PAIR_TOLERANCE: f64 = 0.02;
/// Seconds between two fixes with a frame between them, at most: fixes come about every three
/// seconds (de Jong 2020, section 2.2.2).
const FIX_TOLERANCE: f64 = 10.0;

/// Bumblebee2, 1024 x 768.
fn loc_cam() -> Rig {
    let camera = |[fx, fy, cx, cy]: [f64; 4], k1, k2| Camera {
        distortion: Distortion::RadTan([k1, k2, 0.0, 0.0, 0.0]),
        ..Camera::pinhole(fx, fy, cx, cy)
    };
    Rig {
        width: 1024,
        height: 768,
        left: camera([834.26, 838.96, 497.71, 398.77], -0.360, 0.169),
        right: camera([837.13, 840.82, 481.94, 391.46], -0.353, 0.157),
        T_right_left: Se3::translation(-0.12008, 0.0, 0.0),
        rectified: false,
    }
}

/// Grasshopper2, 1280 x 960.
fn pan_cam() -> Rig {
    let camera = |f| Camera::pinhole(f, f, 639.5, 479.5);
    Rig {
        width: 1280,
        height: 960,
        left: camera(1421.0),
        right: camera(1446.0),
        T_right_left: Se3::translation(-0.5024, 0.0, 0.0),
        rectified: false,
    }
}

/// Where the images of a camera lie: the folder of its name, or the one of the text files.
fn image_folder(dir: &Path, camera: &str) -> Option<PathBuf> {
    let holds_images = |folder: &PathBuf| {
        let entries = folder.read_dir().into_iter().flatten().flatten();
        entries.map(|entry| entry.file_name()).any(|name| {
            name.to_str()
                .is_some_and(|n| parse_name(n.strip_suffix(".png").unwrap_or(""), camera).is_some())
        })
    };
    [dir.join(camera), dir.to_owned()]
        .into_iter()
        .find(holds_images)
}

/// Time and side (0 left, 1 right) of `LocCam_2015_11_26_12_00_00_000_0`.
fn parse_name(stem: &str, camera: &str) -> Option<(f64, u8)> {
    let rest = stem.strip_prefix(camera)?.strip_prefix('_')?;
    let (time, side) = rest.rsplit_once('_')?;
    let side = ["0", "1"].iter().position(|s| *s == side)?;
    Some((stamp(time)?, side as u8))
}

fn open(dir: &Path, camera: &str, format: &Format, built_in: Rig) -> Result<PairSource, DataError> {
    let folder = image_folder(dir, camera).ok_or_else(|| not_here(dir, format))?;
    let mut images = pair_by_time(&folder, list(&folder, &["png"])?, camera)?;
    let first = images[0].1.clone();
    // A calibration beside the text files is that of the localisation camera.
    let beside = [Some(folder.as_path()), (camera == "LocCam").then_some(dir)];
    let (rig, origin) = match beside
        .into_iter()
        .flatten()
        .find_map(|d| find_calibration(d).ok())
    {
        Some(files) => (load_rig(&files)?, files[0].clone()),
        None => (
            built_in,
            PathBuf::from(format!("the published calibration of {camera}")),
        ),
    };
    let calibrated = Calibrated::new(&rig, &origin, &first)?;

    let fixes = ["gps-latlong.txt", "gps-utm31.txt"].map(|f| dir.join(f));
    let fixes = fixes
        .iter()
        .find(|f| f.is_file())
        .map_or(Ok(Vec::new()), |f| read_fixes(f))?;
    let truth = planar_truth(&fixes, &mut images);
    let table = |name: &str| Some(dir.join(name)).filter(|f| f.is_file());
    let mut imu = table("imu.txt").map_or(Ok(Vec::new()), |f| read_imu(&f))?;
    let wheels = table("odometry.txt").map_or(Ok(Vec::new()), |f| read_wheels(&f))?;
    let odometry = odometry(&wheels, &fixes, &imu);
    if camera != "LocCam" {
        imu.clear();
    }
    let mounted = || T_imu_loc_cam() * calibrated.R_rect_left().inverse();
    let sensors = Sensors {
        T_imu_cam: read_mount(&dir.join(IMU_MOUNT))?.unwrap_or_else(mounted),
        odometry,
        gnss: local(&fixes),
        imu,
    };
    let any = !(sensors.imu.is_empty() && sensors.odometry.is_empty() && sensors.gnss.is_empty());
    let pair = |(time, left, right, name): (f64, PathBuf, PathBuf, String)| Pair {
        name,
        time,
        left,
        right,
        calibrated: calibrated.clone(),
        disparity: None,
        disparity_right: None,
    };
    let pairs = images.into_iter().map(pair).collect();
    Ok(PairSource::new(dir, pairs)?
        .with_truth(truth)
        .with_sensors(any.then_some(sensors)))
}

/// Time, left, right and name of every left image with a right one near enough in time, by time.
type Timed = (f64, PathBuf, PathBuf, String);

fn pair_by_time(folder: &Path, files: Vec<Named>, camera: &str) -> Result<Vec<Timed>, DataError> {
    let mut sides = [Vec::new(), Vec::new()];
    for (stem, path) in files {
        if let Some((time, side)) = parse_name(&stem, camera) {
            sides[usize::from(side)].push((time, path, stem));
        }
    }
    sides
        .iter_mut()
        .for_each(|side| side.sort_by(|a, b| a.0.total_cmp(&b.0)));
    let [left, right] = sides;
    // Both sides run on in time, and an image has one partner.
    let mut next = right.into_iter().peekable();
    let mut pairs = Vec::new();
    for (time, path, stem) in left {
        while next.next_if(|r| r.0 < time - PAIR_TOLERANCE).is_some() {}
        if let Some((_, partner, _)) = next.next_if(|r| r.0 <= time + PAIR_TOLERANCE) {
            let name = stem.strip_suffix("_0").unwrap_or(&stem).to_owned();
            pairs.push((time, path, partner, name));
        }
    }
    if pairs.is_empty() {
        let message = format!(
            "no {camera} image ending in _0 (left) has one ending in _1 (right) within {PAIR_TOLERANCE} s: unpack both sides here"
        );
        return Err(DataError::file(folder, message));
    }
    Ok(pairs)
}

/// From the left localisation camera to the IMU, as the tools of other users of the archive have it (transforms.py of
/// plusk01/katwijk_tools), for no file of the archive says it: the IMU has x
/// backwards, y to the right and z up, and the camera looks along its -x, 18 degrees down.
#[allow(non_snake_case)]
fn T_imu_loc_cam() -> Se3 {
    let rotation = UnitQuaternion::new_normalize(Quaternion::new(-0.416, 0.572, 0.572, -0.416));
    Se3::from_parts(Vector3::new(-0.382, -0.078, 0.557).into(), rotation)
}

/// Fixes from the first of them on.
fn local(fixes: &[Fix]) -> Vec<GnssFix> {
    let origin = fixes.first().map_or(Vector3::zeros(), |f| f.p_utm);
    let fix = |f: &Fix| GnssFix {
        time: f.time,
        p_world: f.p_utm - origin,
        sigma: f.sigma,
    };
    fixes.iter().map(fix).collect()
}

/// Where the antenna is in the plane at the time of each frame. Leaves out frames without fixes
/// around them, or gives none where that is more than half of them.
fn planar_truth(fixes: &[Fix], images: &mut Vec<Timed>) -> Option<Trajectory> {
    let fixes = local(fixes);
    let at = |time: f64| {
        let after = fixes.partition_point(|f| f.time < time);
        let next = fixes.get(after)?;
        let last = if next.time == time {
            next
        } else {
            fixes.get(after.checked_sub(1)?)?
        };
        let apart = next.time - last.time;
        let share = if apart > 0.0 {
            (time - last.time) / apart
        } else {
            0.0
        };
        let p = last.p_world.lerp(&next.p_world, share);
        (apart <= FIX_TOLERANCE).then(|| StampedPose {
            time,
            T_world_cam: Se3::translation(p.x, p.y, 0.0),
        })
    };
    let poses: Vec<Option<StampedPose>> = images.iter().map(|i| at(i.0)).collect();
    let covered = poses.iter().flatten().count();
    if covered == 0 || 2 * covered < images.len() {
        return None;
    }
    let mut known = poses.iter().map(Option::is_some);
    images.retain(|_| known.next().unwrap_or(false));
    Some(Trajectory {
        poses: poses.into_iter().flatten().collect(),
    })
}

/// Speed and yaw rate from the mean rate of the wheels and from the difference of its sides. What the
/// archive does not tell is taken from other sensors once for the sequence: the radius of the
/// wheels is the length of the fixes' path by the angle turned while it was driven, and their effective
/// track fits the gyro's yaw rate by least squares. Without fixes there is no odometry; without a turn
/// the yaw rate is 0.
fn odometry(wheels: &[Wheels], fixes: &[Fix], imu: &[ImuSample]) -> Vec<OdometrySample> {
    let mean = |v: &[f64; WHEELS]| v.iter().sum::<f64>() / WHEELS as f64;
    // Columns have the left wheel of each axle first.
    let across = |v: &[f64; WHEELS]| {
        (0..WHEELS / 2)
            .map(|k| v[2 * k + 1] - v[2 * k])
            .sum::<f64>()
            / 3.0
    };
    let (Some(first), Some(last)) = (fixes.first(), fixes.last()) else {
        return Vec::new();
    };
    let during = |w: &&[Wheels]| (first.time..=last.time).contains(&w[1].time);
    let turned: f64 = wheels
        .windows(2)
        .filter(during)
        .map(|w| (mean(&w[1].angle) - mean(&w[0].angle)).abs())
        .sum();
    let driven: f64 = fixes
        .windows(2)
        .map(|f| (f[1].p_utm - f[0].p_utm).xy().norm())
        .sum();
    let radius = driven / turned;
    if !radius.is_finite() {
        return Vec::new();
    }
    let (mut fit, mut power) = (0.0, 0.0);
    for w in wheels {
        let at = imu.partition_point(|s| s.time < w.time);
        if let Some(sample) = imu.get(at) {
            let difference = radius * across(&w.rate);
            fit += difference * sample.rate.z;
            power += difference * difference;
        }
    }
    let by_track = if power > 0.0 { fit / power } else { 0.0 };
    let sample = |w: &Wheels| OdometrySample {
        time: w.time,
        speed: radius * mean(&w.rate),
        yaw_rate: by_track * radius * across(&w.rate),
    };
    wheels.iter().map(sample).collect()
}

#[cfg(test)]
mod tests;
