use std::path::Path;

use barchan_geometry::{Rig, Se3};
use chrono::{DateTime, Datelike, Timelike};
use image::{DynamicImage, GrayImage, ImageBuffer, Luma};
use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};

use crate::formats::katwijk::{RangeSensor, ZONE, to_utm31};
use crate::image_file::{encode_png, write_whole};
use crate::sensor_files::{IMU_MOUNT, write_mount};
use crate::write_folder::{write_beside, write_rgb};
use crate::{DataError, OdometrySample, StereoSource, Synth};

/// Noon of a day of the campaign, milliseconds since 1970.
const START: f64 = 1_448_539_200_000.0;
/// The beach at Katwijk: latitude and longitude of the middle of the rendered ground.
const BEACH: (f64, f64) = (52.2173, 4.4035);
/// Wheels that would measure what the renderer's odometry says: radius and track, metres.
const RADIUS: f64 = 0.125;
const TRACK: f64 = 0.8;

/// Writes a rendered traverse in the layout of format `katwijk`: `LocCam/`, `gps-latlong.txt`, `gps-utm31.txt`,
/// `imu.txt`, `odometry.txt`, `ptu.txt` and `rocks.txt`, with x east and y north; `ToF/` and `Velodyne/` with a scan of either
/// for every pair, without noise (how much light comes back is that of the sun); and `rig.toml`, `imu.tum`, `tof.tum` and
/// `velodyne.tum`, for the camera and where the others are mounted are not those of the archive. Image and scan
/// stamps are `ahead` seconds early: an image shows a place that the fixes reach so much later, the
/// fault that de Jong 2020 found in the archive (section 9.1).
///
/// Everything is written beside `dir` first and renamed at the end, so `dir` is whole or absent.
///
/// # Errors
/// When `dir` exists and is not empty, the traverse is too long to have sensors, or a file cannot be
/// written.
pub fn write_katwijk(
    synth: &Synth,
    dir: &Path,
    ahead: f64,
    progress: impl FnMut(usize),
) -> Result<(), DataError> {
    write_beside(dir, |partial| write_files(synth, partial, ahead, progress))
}

fn write_files(
    synth: &Synth,
    dir: &Path,
    ahead: f64,
    mut progress: impl FnMut(usize),
) -> Result<(), DataError> {
    let images = dir.join("LocCam");
    let folders = RangeSensor::ALL.map(|sensor| dir.join(sensor.folder()));
    for folder in folders.iter().chain([&images]) {
        std::fs::create_dir_all(folder).map_err(DataError::io(folder))?;
    }
    for sensor in RangeSensor::ALL {
        write_mount(&sensor.mount_file(dir), &T_cam_sensor(sensor).inverse())?;
    }
    for index in 0..synth.len() {
        let stamp = stamp(dir, synth.time(index) - ahead)?;
        for (side, image) in synth.photograph(index)?.iter().enumerate() {
            write_rgb(&images.join(format!("LocCam_{stamp}_{side}.png")), image)?;
        }
        for sensor in RangeSensor::ALL {
            write_scan(synth, index, sensor, dir, &stamp)?;
        }
        progress(index + 1);
    }
    let straight = || Rig::from(*synth.rig());
    let rig = synth.unrectified_rig().cloned().unwrap_or_else(straight);
    write_whole(&dir.join("rig.toml"), rig.to_toml().as_bytes())?;

    let none = || {
        DataError::file(
            dir,
            "a traverse of this length has no sensors: ask for fewer frames",
        )
    };
    let sensors = synth.sensors().ok_or_else(none)?;
    let off = || DataError::file(dir, "the drive leaves the zone of the beach");
    let (east, north) = to_utm31(BEACH.0, BEACH.1).ok_or_else(off)?;
    let [mut degrees, mut metres, mut imu, mut odometry] = [const { String::new() }; 4];
    for fix in &sensors.gnss {
        let (p, s, stamp) = (fix.p_world, fix.sigma, stamp(dir, fix.time)?);
        let (x, y) = (east + p.x, north + p.y);
        let (latitude, longitude) =
            utm::wsg84_utm_to_lat_lon(x, y, ZONE, 'U').map_err(|_| off())?;
        let rest = format!("{} {} {} {}\n", p.z, s.y, s.x, s.z);
        degrees += &format!("{stamp} RTK_FIXED {latitude:.12} {longitude:.12} {rest}");
        metres += &format!("{stamp} RTK_FIXED {y:.6} {x:.6} {rest}");
    }
    for sample in &sensors.imu {
        let (a, w) = (sample.acceleration, sample.rate);
        let [ax, ay, az] = [a.x, a.y, a.z];
        let stamp = stamp(dir, sample.time)?;
        imu += &format!(
            "{stamp} {ax} {ay} {az} {} {} {} {ax} {ay} {az}\n",
            w.x, w.y, w.z
        );
    }
    let (mut angles, mut before) = ([0.0; 6], 0.0);
    for sample in &sensors.odometry {
        odometry += &stamp(dir, sample.time)?;
        for (wheel, angle) in angles.iter_mut().enumerate() {
            let side = if wheel % 2 == 0 { -0.5 } else { 0.5 };
            let rate = (sample.speed + side * TRACK * sample.yaw_rate) / RADIUS;
            *angle += rate * (sample.time - before);
            odometry += &format!(" {angle} {rate} 0");
        }
        before = sample.time;
        // Four steering joints straight ahead, and a level rocker with its bogies.
        odometry += &" 0".repeat(4 * 3 + 3);
        odometry += "\n";
    }
    write_mount(&dir.join(IMU_MOUNT), &sensors.T_imu_cam)?;
    let still = |s: &OdometrySample| Ok(format!("{} 0 0\n", stamp(dir, s.time)?));
    let ptu = sensors.odometry.iter().map(still);
    let ptu = ptu.collect::<Result<String, DataError>>()?;
    let rock = |c: &Point3<f64>| format!("{:.6} {:.6}\n", east + c.x, north + c.y);
    let rocks = synth.rocks().iter().map(|r| rock(&r.centre)).collect();
    for (name, text) in [
        ("ptu.txt", ptu),
        ("rocks.txt", rocks),
        ("gps-latlong.txt", degrees),
        ("gps-utm31.txt", metres),
        ("imu.txt", imu),
        ("odometry.txt", odometry),
    ] {
        write_whole(&dir.join(name), text.as_bytes())?;
    }
    Ok(())
}

/// Where the range sensors are on the mast: the time-of-flight camera under the cameras, looking as they do; the scanner
/// above them.
#[allow(non_snake_case)]
fn T_cam_sensor(sensor: RangeSensor) -> Se3 {
    match sensor {
        RangeSensor::Tof => Se3::translation(0.06, 0.08, 0.0),
        RangeSensor::Velodyne => {
            // Forward, left and up.
            let axes = Matrix3::from_columns(&[Vector3::z(), -Vector3::x(), -Vector3::y()]);
            let turn =
                UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
            Se3::from_parts(Vector3::new(0.06, -0.25, 0.0).into(), turn)
        }
    }
}

/// Writes the images of one scan.
fn write_scan(
    synth: &Synth,
    index: usize,
    sensor: RangeSensor,
    dir: &Path,
    stamp: &str,
) -> Result<(), DataError> {
    /// The brightest of a scan, as the sensors count light.
    const BRIGHTEST: f32 = 150.0;
    let [width, height] = sensor.size();
    let place = |k: usize| (k % width, k / width);
    let azimuth = |k: usize| RangeSensor::azimuth(place(k).0);
    let ray = |k| {
        let (column, row) = place(k);
        sensor.ray(column, row, azimuth(k))
    };
    let rays: Vec<Vector3<f64>> = (0..width * height).map(ray).collect();
    let met = synth.scan(index, &T_cam_sensor(sensor), &rays)?;
    let brightest = met.iter().flatten().map(|(_, light)| *light);
    let gain = BRIGHTEST / brightest.fold(f32::MIN_POSITIVE, f32::max);

    let write = |what: &str, image: DynamicImage| {
        let name = format!("{}_{stamp}_{what}.png", sensor.folder());
        let path = dir.join(sensor.folder()).join(name);
        write_whole(&path, &encode_png(&path, &image)?)
    };
    let (w, h) = (width as u32, height as u32);
    let deep = |value: &dyn Fn(usize) -> u16| {
        let values = (0..width * height).map(value).collect();
        // One value a pixel by construction.
        let grey: Option<ImageBuffer<Luma<u16>, _>> = ImageBuffer::from_raw(w, h, values);
        DynamicImage::ImageLuma16(grey.unwrap_or_default())
    };
    write("range", deep(&|k| sensor.count(met[k].map(|(r, _)| r))))?;
    let light = |k: usize| met[k].map_or(0.0, |(_, light)| gain * light);
    match sensor {
        RangeSensor::Tof => write("intensity", deep(&|k| (4.0 * light(k)) as u16)),
        RangeSensor::Velodyne => {
            write("azimuth", deep(&azimuth))?;
            let levels = (0..width * height).map(|k| light(k) as u8).collect();
            let grey = GrayImage::from_raw(w, h, levels).unwrap_or_default();
            write("intensity", DynamicImage::ImageLuma8(grey))
        }
    }
}

/// The time stamp of the archive, `time` seconds after [`START`].
fn stamp(dir: &Path, time: f64) -> Result<String, DataError> {
    let t = DateTime::from_timestamp_millis((START + time * 1000.0).round() as i64)
        .ok_or_else(|| DataError::file(dir, "a time is beyond every calendar"))?;
    Ok(format!(
        "{:04}_{:02}_{:02}_{:02}_{:02}_{:02}_{:03}",
        t.year(),
        t.month(),
        t.day(),
        t.hour(),
        t.minute(),
        t.second(),
        t.timestamp_subsec_millis()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::open;

    #[test]
    #[allow(non_snake_case)]
    fn what_is_written_reads_back() {
        let synth = Synth::parse("frames=12,width=64,height=48,rectified=false").unwrap();
        let parent = tempfile::tempdir().unwrap();
        let dir = parent.path().join("part1");
        write_katwijk(&synth, &dir, 0.0, |_| ()).unwrap();
        let read = open(dir.to_str().unwrap()).unwrap();
        let (made, found) = (synth.sensors().unwrap(), read.sensors().unwrap());
        // Fixes come every second: the frames up to 2 s have one on either side.
        assert_eq!(read.len(), 11);
        assert_eq!(read.name(0), "LocCam_2015_11_26_12_00_00_000");
        assert!((read.rig().baseline - synth.rig().baseline).abs() < 1e-6);
        let start = START / 1000.0;
        for index in 0..read.len() {
            let time = read.frame(index).unwrap().time;
            assert!((time - start - synth.time(index)).abs() < 1e-6);
        }
        assert_eq!(found.imu.len(), made.imu.len());
        for (a, b) in found.imu.iter().zip(&made.imu) {
            assert!((a.time - start - b.time).abs() < 1e-6);
            assert_eq!((a.acceleration, a.rate), (b.acceleration, b.rate));
        }
        let origin = made.gnss[0].p_world;
        for (a, b) in found.gnss.iter().zip(&made.gnss) {
            assert!((a.p_world - (b.p_world - origin)).norm() < 1e-3);
            assert_eq!(a.sigma, b.sigma);
        }
        let left_over = found.T_imu_cam.inverse() * made.T_imu_cam;
        assert!(left_over.translation.vector.norm() < 1e-8 && left_over.rotation.angle() < 1e-8);
        let ptu = crate::katwijk::read_ptu(&dir.join("ptu.txt")).unwrap();
        assert_eq!(ptu.len(), made.odometry.len());
        let rocks = crate::katwijk::read_rocks(&dir.join("rocks.txt")).unwrap();
        let (east, north) = to_utm31(BEACH.0, BEACH.1).unwrap();
        assert!(!rocks.is_empty() && rocks.len() == synth.rocks().len());
        for (read, rock) in rocks.iter().zip(synth.rocks()) {
            let off = [
                read[0] - east - rock.centre.x,
                read[1] - north - rock.centre.y,
            ];
            assert!(off[0].hypot(off[1]) < 1e-5);
        }
        for sensor in RangeSensor::ALL {
            let scans = sensor.scans(&dir).unwrap();
            assert_eq!(scans.len(), synth.len());
            let T_cam_sensor = sensor.T_sensor_cam(&dir).unwrap().unwrap().inverse();
            let scan = sensor.read(&scans[3].1).unwrap();
            assert!((scans[3].0 - start - synth.time(3)).abs() < 1e-6);
            let T_world_cam = synth.true_trajectory().unwrap().poses[3].T_world_cam;
            let met: Vec<_> = scan.points.iter().flatten().collect();
            assert!(
                met.len() > scan.points.len() / 5,
                "{sensor:?}: {}",
                met.len()
            );
            // What was met is the ground or a rock: no point lies above what is there, and few below, under a rock's side.
            let above = |p: &&Point3<f64>| {
                let p = T_world_cam * T_cam_sensor * **p;
                (p.z - synth.ground_height(p.x, p.y)).abs() < 0.02 + 0.01 * p.coords.norm()
            };
            let on_ground = met.iter().filter(|p| above(p)).count();
            assert!(
                10 * on_ground > 9 * met.len(),
                "{sensor:?}: {on_ground} of {}",
                met.len()
            );
            let light = scan.intensity.unwrap();
            assert_eq!(light.len(), scan.points.len());
            assert!(light.iter().any(|l| *l > 50));
        }
        assert_eq!(found.odometry.len(), made.odometry.len());
        // The radius is what the fixes make of it, but one for all.
        let scale = found.odometry[0].speed / made.odometry[0].speed;
        assert!((scale - 1.0).abs() < 0.2, "{scale}");
        for (a, b) in found.odometry.iter().zip(&made.odometry) {
            assert!((a.speed - scale * b.speed).abs() < 1e-9);
        }
    }

    #[test]
    fn images_ahead_are_stamped_early() {
        let synth = Synth::parse("frames=1,width=32,height=32").unwrap();
        let parent = tempfile::tempdir().unwrap();
        let dir = parent.path().join("part1");
        write_katwijk(&synth, &dir, 1.5, |_| ()).unwrap();
        let read = open(dir.to_str().unwrap()).unwrap();
        assert_eq!(read.name(0), "LocCam_2015_11_26_11_59_58_500");
    }
}
