use std::path::Path;

use barchan_geometry::Rig;
use chrono::{DateTime, Datelike, Timelike};
use nalgebra::Point3;

use crate::formats::katwijk::{ZONE, to_utm31};
use crate::image_file::write_whole;
use crate::sensor_files::write_imu_pose;
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
/// `imu.txt`, `odometry.txt`, `ptu.txt` and `rocks.txt`, with x east and y north; and `rig.toml` and `imu.tum`, for
/// camera and IMU are not those of the archive. Image
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
    std::fs::create_dir_all(&images).map_err(DataError::io(&images))?;
    for index in 0..synth.len() {
        let stamp = stamp(dir, synth.time(index) - ahead)?;
        for (side, image) in synth.photograph(index)?.iter().enumerate() {
            write_rgb(&images.join(format!("LocCam_{stamp}_{side}.png")), image)?;
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
    write_imu_pose(dir, &sensors.T_imu_cam)?;
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
