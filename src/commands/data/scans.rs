use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_datasets::katwijk::{RangeScan, RangeSensor};
use barchan_geometry::{Se3, Trajectory};
use barchan_terrain::{Cloud, CloudPoint, VoxelMap};
use clap::Parser;
use serde::Serialize;

use crate::output::Output;

/// Turn the range images of a part of the Katwijk archive into point clouds
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan data scans part1 --out scans     a cloud a scan, in the frame of its sensor\n  \
    barchan data scans part1 --poses map/keyframes.tum --out scans     one cloud a sensor, in the frame of the map\n\n\
    Read are ToF/ToF_TIME_range.png and Velodyne/Velodyne_TIME_range.png, with _azimuth and _intensity beside them.\n\
    --poses wants to know how a sensor is mounted: tof.tum or velodyne.tum in PART, the pose of the rectified left\n\
    camera in the frame of the sensor, as one line 0 tx ty tz qx qy qz qw.")]
pub struct Args {
    /// The part of a traverse: the folder of ToF/ and Velodyne/
    part: PathBuf,
    /// The poses of the left camera, TUM: scans between them are joined to one cloud a sensor
    #[arg(long, value_name = "FILE.tum")]
    poses: Option<PathBuf>,
    /// With --poses: edge of a voxel of the joined cloud, metres
    #[arg(long, value_name = "M", default_value_t = 0.05)]
    voxel: f64,
    /// The directory that is written: tof/ToF_TIME.ply and velodyne/Velodyne_TIME.ply, or tof.ply and velodyne.ply
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

#[derive(Serialize)]
struct Summary {
    sensor: &'static str,
    scans: usize,
    points: usize,
    out: PathBuf,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    let Args {
        part,
        poses,
        voxel,
        out,
    } = args;
    let poses = (poses.as_deref()).map(Trajectory::read_tum).transpose()?;
    let mut summaries = Vec::new();
    for sensor in RangeSensor::ALL {
        let scans = sensor.scans(&part)?;
        if scans.is_empty() {
            continue;
        }
        let bar = output.progress(sensor.folder(), scans.len());
        let summary = match &poses {
            None => each(sensor, &scans, &out, || bar.inc(1))?,
            Some(poses) => joined(sensor, &part, &scans, poses, voxel, &out, || bar.inc(1))?,
        };
        bar.finish_and_clear();
        summaries.push(summary);
    }
    if summaries.is_empty() {
        bail!(
            "{}: holds neither ToF/ToF_TIME_range.png nor Velodyne/Velodyne_TIME_range.png: unpack them from the archive",
            part.display()
        );
    }
    let line = |s: &Summary| {
        format!(
            "{}: {} points of {} scans in {}",
            s.sensor,
            s.points,
            s.scans,
            s.out.display()
        )
    };
    let lines: Vec<String> = summaries.iter().map(line).collect();
    output.result(&summaries, &lines.join("\n"))
}

/// A cloud a scan, in the frame of the sensor.
fn each(
    sensor: RangeSensor,
    scans: &[(f64, PathBuf)],
    out: &Path,
    done: impl Fn(),
) -> Result<Summary> {
    let folder = out.join(sensor.folder().to_lowercase());
    std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    let mut points = 0;
    for (_, file) in scans {
        let cloud = cloud(sensor, &sensor.read(file)?);
        points += cloud.points.len();
        let stem = file.file_stem().unwrap_or_default().to_string_lossy();
        let name = stem.trim_end_matches("_range");
        cloud.write_ply(&folder.join(format!("{name}.ply")))?;
        done();
    }
    Ok(Summary {
        sensor: sensor.folder(),
        scans: scans.len(),
        points,
        out: folder,
    })
}

/// One cloud of all scans between the poses, in the world's frame.
#[allow(non_snake_case)]
fn joined(
    sensor: RangeSensor,
    part: &Path,
    scans: &[(f64, PathBuf)],
    poses: &Trajectory,
    voxel: f64,
    out: &Path,
    done: impl Fn(),
) -> Result<Summary> {
    let T_sensor_cam = sensor.T_sensor_cam(part)?.with_context(|| {
        format!(
            "{}: is not there, and tells where the sensor is: write the pose of the rectified left camera in the frame \
             of the sensor, as one line 0 tx ty tz qx qy qz qw",
            sensor.mount_file(part).display()
        )
    })?;
    let mut map = VoxelMap::new(voxel)?;
    let mut taken = 0;
    for (time, file) in scans {
        if let Some(T_world_cam) = poses.at(*time) {
            let T_world_sensor: Se3 = T_world_cam * T_sensor_cam.inverse();
            let cloud = cloud(sensor, &sensor.read(file)?);
            map.insert(&cloud.transform(&T_world_sensor));
            taken += 1;
        }
        done();
    }
    if taken == 0 {
        bail!(
            "no scan of {} was taken between the first and the last of the poses: are they of this part? Scans have the \
             time of the archive, seconds since 1970",
            sensor.folder()
        );
    }
    std::fs::create_dir_all(out).with_context(|| out.display().to_string())?;
    let file = out.join(format!("{}.ply", sensor.folder().to_lowercase()));
    let points = map.voxels(1).iter().map(|v| v.to_point()).collect();
    let cloud = Cloud { points };
    cloud.write_ply(&file)?;
    Ok(Summary {
        sensor: sensor.folder(),
        scans: taken,
        points: cloud.points.len(),
        out: file,
    })
}

/// The points of a scan in the frame of its sensor, as bright as the light that came back.
fn cloud(sensor: RangeSensor, scan: &RangeScan) -> Cloud {
    let light = |k: usize| scan.intensity.as_ref().map_or(128, |i| i[k]);
    // As the archive's own script shows the 14 bits of the time-of-flight camera, too.
    let level = |k: usize| match sensor {
        RangeSensor::Tof => light(k) / 4,
        RangeSensor::Velodyne => light(k),
    };
    let point = |(k, position)| CloudPoint {
        position,
        colour: [level(k).min(255) as u8; 3],
        sigma: f32::NAN,
    };
    let met = scan.points.iter().enumerate();
    Cloud {
        points: met.filter_map(|(k, p)| Some(point((k, (*p)?)))).collect(),
    }
}
