//! What a rover measured besides images, as tables in SI units beside them: `imu.csv`, `odometry.csv`,
//! `gnss.csv`, and `imu.tum`, one line: the pose of the rectified left camera in the IMU's frame.

use std::path::Path;

use barchan_geometry::{Se3, StampedPose, Trajectory};
use nalgebra::Vector3;

use crate::image_file::write_whole;
use crate::text::read_columns;
use crate::{DataError, GnssFix, ImuSample, OdometrySample, Sensors};

const IMU: (&str, [&str; 7]) = ("imu.csv", ["time", "ax", "ay", "az", "wx", "wy", "wz"]);
const ODOMETRY: (&str, [&str; 3]) = ("odometry.csv", ["time", "speed", "yaw_rate"]);
const GNSS: (&str, [&str; 7]) = ("gnss.csv", ["time", "x", "y", "z", "sx", "sy", "sz"]);
/// How the IMU is mounted.
pub(crate) const IMU_MOUNT: &str = "imu.tum";

/// Writes the streams that are there.
pub(crate) fn write_sensors(dir: &Path, sensors: &Sensors) -> Result<(), DataError> {
    let imu = sensors.imu.iter().map(|s| {
        let (a, w) = (s.acceleration, s.rate);
        [s.time, a.x, a.y, a.z, w.x, w.y, w.z]
    });
    write_table(dir, IMU, imu)?;
    let odometry = sensors.odometry.iter();
    write_table(
        dir,
        ODOMETRY,
        odometry.map(|s| [s.time, s.speed, s.yaw_rate]),
    )?;
    let gnss = sensors.gnss.iter().map(|s| {
        let (p, e) = (s.p_world, s.sigma);
        [s.time, p.x, p.y, p.z, e.x, e.y, e.z]
    });
    write_table(dir, GNSS, gnss)?;
    write_mount(&dir.join(IMU_MOUNT), &sensors.T_imu_cam)
}

/// Writes how a sensor is mounted: the pose of the rectified left camera in its frame.
#[allow(non_snake_case)]
pub(crate) fn write_mount(file: &Path, T_sensor_cam: &Se3) -> Result<(), DataError> {
    let pose = Trajectory {
        poses: vec![StampedPose {
            time: 0.0,
            T_world_cam: *T_sensor_cam,
        }],
    };
    write_whole(file, pose.to_tum().as_bytes())
}

/// Reads how a sensor is mounted, where the file is there.
pub(crate) fn read_mount(file: &Path) -> Result<Option<Se3>, DataError> {
    if !file.is_file() {
        return Ok(None);
    }
    let poses = Trajectory::read_tum(file)?.poses;
    let [pose] = poses.as_slice() else {
        let message = format!("{} lines; one pose is expected", poses.len());
        return Err(DataError::file(file, message));
    };
    Ok(Some(pose.T_world_cam))
}

fn write_table<const N: usize>(
    dir: &Path,
    (name, header): (&str, [&str; N]),
    rows: impl ExactSizeIterator<Item = [f64; N]>,
) -> Result<(), DataError> {
    if rows.len() == 0 {
        return Ok(());
    }
    let line = |row: [f64; N]| row.map(|v| v.to_string()).join(",") + "\n";
    let table: String = std::iter::once(header.join(",") + "\n")
        .chain(rows.map(line))
        .collect();
    write_whole(&dir.join(name), table.as_bytes())
}

/// Reads the streams that are there; `None` where there is none.
#[allow(non_snake_case)]
pub(crate) fn read_sensors(dir: &Path) -> Result<Option<Sensors>, DataError> {
    let imu = read_table(dir, IMU)?.into_iter().map(|r| ImuSample {
        time: r[0],
        acceleration: Vector3::new(r[1], r[2], r[3]),
        rate: Vector3::new(r[4], r[5], r[6]),
    });
    let odometry = read_table(dir, ODOMETRY)?.into_iter();
    let odometry = odometry.map(|[time, speed, yaw_rate]| OdometrySample {
        time,
        speed,
        yaw_rate,
    });
    let gnss = read_table(dir, GNSS)?.into_iter().map(|r| GnssFix {
        time: r[0],
        p_world: Vector3::new(r[1], r[2], r[3]),
        sigma: Vector3::new(r[4], r[5], r[6]),
    });
    let mut sensors = Sensors {
        imu: imu.collect(),
        odometry: odometry.collect(),
        gnss: gnss.collect(),
        ..Sensors::default()
    };
    if let Some(T_imu_cam) = read_mount(&dir.join(IMU_MOUNT))? {
        sensors.T_imu_cam = T_imu_cam;
    } else if !sensors.imu.is_empty() {
        return Err(DataError::file(
            &dir.join(IMU_MOUNT),
            "missing: imu.csv needs the pose of the left camera in the IMU's frame, as one TUM line",
        ));
    }
    let none = sensors.imu.is_empty() && sensors.odometry.is_empty() && sensors.gnss.is_empty();
    Ok((!none).then_some(sensors))
}

fn read_table<const N: usize>(
    dir: &Path,
    (name, header): (&str, [&str; N]),
) -> Result<Vec<[f64; N]>, DataError> {
    let path = dir.join(name);
    if path.is_file() {
        read_columns(&path, header)
    } else {
        Ok(Vec::new())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{StereoSource, Synth};

    #[test]
    fn what_is_written_reads_back() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(read_sensors(dir.path()).unwrap(), None);
        let synth = Synth::parse("frames=12,width=32,height=32").unwrap();
        let sensors = synth.sensors().unwrap();
        assert!(sensors.imu.len() > 100 && sensors.odometry.len() > 10 && !sensors.gnss.is_empty());
        write_sensors(dir.path(), sensors).unwrap();
        let read = read_sensors(dir.path()).unwrap().unwrap();
        assert_eq!(
            (&read.imu, &read.odometry, &read.gnss),
            (&sensors.imu, &sensors.odometry, &sensors.gnss)
        );
        let left_over = read.T_imu_cam.inverse() * sensors.T_imu_cam;
        assert!(barchan_geometry::se3::log(&left_over).norm() < 1e-7);
    }

    #[test]
    fn broken_tables_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let refused = || read_sensors(dir.path()).unwrap_err().to_string();
        std::fs::write(dir.path().join("imu.csv"), "time,ax,ay,az,wx,wy\n").unwrap();
        assert!(refused().contains("imu.csv") && refused().contains("wz"));
        std::fs::write(
            dir.path().join("imu.csv"),
            "time,ax,ay,az,wx,wy,wz\n0,0,0,9.8,0,0,0\n",
        )
        .unwrap();
        assert!(refused().contains("imu.tum"), "{}", refused());
        std::fs::remove_file(dir.path().join("imu.csv")).unwrap();
        std::fs::write(dir.path().join("gnss.csv"), "time,x,y,z,sx,sy,sz\n0,1,x\n").unwrap();
        assert!(refused().contains("line 2"), "{}", refused());
    }
}
