//! What a run of `barchan slam` leaves, whatever its method: written here, and read here.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_datasets::{Rgb, disparity_file, read_rgb};
use barchan_geometry::nalgebra::Matrix6;
use barchan_geometry::{RectifiedRig, Rig, StampedPose, Trajectory};
use barchan_infer::DisparityMap;
use barchan_terrain::DenseKeyframe;
use serde::Serialize;

use crate::output::StagedDir;

/// One key frame of a run.
#[derive(Clone, Debug)]
pub struct RunKeyframe {
    /// Index of its frame in the sequence.
    pub frame: usize,
    /// Name of its frame.
    pub name: String,
    pub pose: StampedPose,
    /// The part of the map that it belongs to: how parts lie to each other is a guess.
    pub submap: usize,
    /// Covariance of (position, rotation vector) about the axes of the world.
    pub covariance: Option<Matrix6<f64>>,
}

/// Writes `trajectory.tum`, `trajectory.kitti`, `keyframes.tum`, `keyframes.csv` and, where every key
/// frame has one, `covariance.csv`.
pub fn write_poses(
    out: &StagedDir,
    trajectory: &Trajectory,
    keyframes: &[RunKeyframe],
) -> Result<()> {
    out.write("trajectory.tum", trajectory.to_tum())?;
    out.write("trajectory.kitti", trajectory.to_kitti())?;
    let route = Trajectory {
        poses: keyframes.iter().map(|k| k.pose).collect(),
    };
    out.write("keyframes.tum", route.to_tum())?;
    let mut table = String::from("frame,name,time,submap\n");
    for k in keyframes {
        writeln!(table, "{},{},{},{}", k.frame, k.name, k.pose.time, k.submap)?;
    }
    out.write("keyframes.csv", table)?;
    let covariances: Option<Vec<_>> = keyframes.iter().map(|k| k.covariance).collect();
    if let Some(covariances) = covariances {
        let mut table = String::from("time");
        for (row, column) in (0..36).map(|k| (k / 6, k % 6)) {
            write!(table, ",c{row}{column}")?;
        }
        for (keyframe, covariance) in keyframes.iter().zip(covariances) {
            write!(table, "\n{}", keyframe.pose.time)?;
            // Symmetric: rows are columns.
            covariance
                .iter()
                .try_for_each(|c| write!(table, ",{c:e}"))?;
        }
        out.write("covariance.csv", table + "\n")?;
    }
    Ok(())
}

/// Writes the left image and the disparity of a key frame. The files sort as their frames follow each other.
pub fn write_dense(out: &StagedDir, frame: usize, left: &Rgb, dense: &DisparityMap) -> Result<()> {
    let path = |folder: &str| out.path(format!("keyframes/{folder}/{frame:06}.png"));
    disparity_file::write_png(&path("disparity")?, &dense.disparity)?;
    disparity_file::write_png(&path("sigma")?, &dense.sigma)?;
    let file = path("left")?;
    image::DynamicImage::from(left.clone())
        .to_rgb8()
        .save(&file)
        .with_context(|| file.display().to_string())
}

/// What became of each frame: a line of `log.jsonl` each.
pub struct RunLog {
    file: BufWriter<File>,
}

impl RunLog {
    /// Begins the log of a run.
    pub fn create(out: &StagedDir) -> Result<Self> {
        let path = out.path("log.jsonl")?;
        let file = File::create(&path).with_context(|| path.display().to_string())?;
        Ok(Self {
            file: BufWriter::new(file),
        })
    }

    /// Adds the report of a frame, and what the program has of memory after it.
    pub fn add(&mut self, report: &impl Serialize) -> Result<()> {
        #[derive(Serialize)]
        struct Line<'a, R> {
            #[serde(flatten)]
            report: &'a R,
            #[serde(skip_serializing_if = "Option::is_none")]
            mb_resident: Option<f64>,
        }
        let line = Line {
            report,
            mb_resident: resident_megabytes(),
        };
        writeln!(self.file, "{}", serde_json::to_string(&line)?).context("log.jsonl")
    }

    /// Writes what is left.
    pub fn finish(mut self) -> Result<()> {
        self.file.flush().context("log.jsonl")
    }
}

/// What this process has of memory, where the system tells.
fn resident_megabytes() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmRSS:"))?;
    let kib: f64 = line.split_whitespace().next()?.parse().ok()?;
    Some((kib * 1.024).round() / 1e3)
}

/// A run on disk whose key frames have disparity.
pub struct SlamRun {
    folder: PathBuf,
    pub rig: RectifiedRig,
    pub keyframes: Vec<RunKeyframe>,
}

impl SlamRun {
    /// Opens a run.
    ///
    /// # Errors
    /// When the folder holds no run, its key frames have no disparity, or its files do not agree.
    pub fn open(run: &Path) -> Result<Self> {
        let trajectory = run.join("keyframes.tum");
        if !trajectory.is_file() {
            bail!(
                "{}: no run of `barchan slam` (there is no keyframes.tum)\n  cure: `barchan slam --data DATA --out {0}` makes one",
                run.display()
            );
        }
        let rig_file = run.join("rig.toml");
        let rig = Rig::load(&rig_file)?
            .as_rectified()
            .with_context(|| format!("{}: not rectified", rig_file.display()))?;
        let poses = Trajectory::read_tum(&trajectory)?.poses;
        let names = disparity_names(run)?;
        if names.len() != poses.len() {
            bail!(
                "{}: {} poses, but {} disparity images in keyframes/disparity",
                trajectory.display(),
                poses.len(),
                names.len(),
            );
        }
        let parts = read_submaps(run, poses.len())?;
        let covariances = read_covariances(run, poses.len())?;
        let keyframes = poses.into_iter().zip(names).enumerate();
        let keyframes = keyframes.map(|(k, (pose, name))| RunKeyframe {
            frame: name.parse().unwrap_or(k),
            name,
            pose,
            submap: parts[k],
            covariance: covariances.as_ref().map(|c| c[k]),
        });
        Ok(Self {
            folder: run.to_owned(),
            rig,
            keyframes: keyframes.collect(),
        })
    }

    /// The part of the map with most key frames; of equals the first.
    pub fn largest_part(&self) -> usize {
        let parts = || self.keyframes.iter().map(|k| k.submap);
        let count = |part: &usize| parts().filter(|p| p == part).count();
        parts().rev().max_by_key(count).unwrap_or(0)
    }

    /// Reads the images of one of the key frames.
    ///
    /// # Errors
    /// When one of the files is missing or broken.
    pub fn read(&self, keyframe: &RunKeyframe) -> Result<DenseKeyframe> {
        let file = |folder: &str| {
            let folder = self.folder.join("keyframes").join(folder);
            folder.join(format!("{}.png", keyframe.name))
        };
        Ok(DenseKeyframe {
            time: keyframe.pose.time,
            T_world_cam: keyframe.pose.T_world_cam,
            pose_covariance: keyframe.covariance,
            left: read_rgb(&file("left"))?,
            disparity: disparity_file::read(&file("disparity"))?,
            sigma: Some(disparity_file::read(&file("sigma"))?),
        })
    }
}

/// Names of the disparity images in order, without their endings: a line of `keyframes.tum` each.
fn disparity_names(run: &Path) -> Result<Vec<String>> {
    let folder = run.join("keyframes/disparity");
    let entries = folder.read_dir().with_context(|| {
        format!(
            "{}: no disparity in this run\n  cure: run `barchan slam` with --model",
            folder.display()
        )
    })?;
    let mut names: Vec<String> = entries
        .filter_map(|e| Some(e.ok()?.path().file_stem()?.to_str()?.to_owned()))
        .collect();
    names.sort();
    Ok(names)
}

/// The part of the map that each key frame belongs to: `keyframes.csv` of a run; all to one where
/// there is none.
fn read_submaps(run: &Path, keyframes: usize) -> Result<Vec<usize>> {
    let file = run.join("keyframes.csv");
    if !file.is_file() {
        return Ok(vec![0; keyframes]);
    }
    let text = std::fs::read_to_string(&file).with_context(|| file.display().to_string())?;
    let last_column = |line: &str| line.rsplit(',').next()?.trim().parse().ok();
    let parts: Option<Vec<usize>> = text.lines().skip(1).map(last_column).collect();
    match parts {
        Some(parts) if parts.len() == keyframes => Ok(parts),
        _ => bail!(
            "{}: expected a line for each of {keyframes} key frames, with its submap last",
            file.display()
        ),
    }
}

/// `covariance.csv` of a run, where there is one: a header, then a line for each key frame in order, the
/// time and the 36 numbers of the covariance of (position, rotation vector) about the axes of the world.
fn read_covariances(run: &Path, keyframes: usize) -> Result<Option<Vec<Matrix6<f64>>>> {
    let file = run.join("covariance.csv");
    if !file.is_file() {
        return Ok(None);
    }
    let text = std::fs::read_to_string(&file).with_context(|| file.display().to_string())?;
    let mut covariances = vec![];
    for (number, line) in text.lines().enumerate().skip(1) {
        let fields: Result<Vec<f64>, _> = line.split(',').map(|f| f.trim().parse()).collect();
        let numbers = fields
            .ok()
            .filter(|f| f.len() == 37 && f.iter().all(|v| v.is_finite()));
        let Some(numbers) = numbers else {
            bail!(
                "{}, line {}: expected a time and 36 numbers",
                file.display(),
                number + 1
            );
        };
        covariances.push(Matrix6::from_row_slice(&numbers[1..]));
    }
    if covariances.len() != keyframes {
        bail!(
            "{}: {} lines for {keyframes} key frames",
            file.display(),
            covariances.len()
        );
    }
    Ok(Some(covariances))
}
