//! Runs on disk, of which the newest are kept: what `barchan slam` would have left of the same pairs.

use std::fs::File;
use std::io::{BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use barchan_geometry::{RectifiedRig, Rig};
use barchan_slam::{FrameReport, SlamConfig, SlamResult};
use serde::Serialize;

use crate::commands::slam::write_result;
use crate::output::StagedDir;
use crate::slam_run::write_dense;

/// A folder of runs `run-000001`, `run-000002`, ...
pub struct Ring {
    folder: PathBuf,
    keep: usize,
    next: u64,
}

impl Ring {
    /// Opens the folder, made when it is missing. What a killed service left unfinished is removed.
    ///
    /// # Errors
    /// When the folder cannot be made, read or written.
    pub fn open(folder: &Path, keep: usize) -> Result<Self> {
        let context = || folder.display().to_string();
        std::fs::create_dir_all(folder).with_context(context)?;
        for entry in folder.read_dir().with_context(context)? {
            let path = entry.with_context(context)?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if (name.strip_suffix(".part")).is_some_and(|n| number(n).is_some()) {
                std::fs::remove_dir_all(&path).with_context(|| path.display().to_string())?;
            }
        }
        let mut ring = Self {
            folder: folder.to_owned(),
            keep,
            next: 1,
        };
        ring.next = ring.runs()?.last().map_or(1, |n| n + 1);
        Ok(ring)
    }

    /// Begins the next run.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn begin(&mut self, rig: &RectifiedRig, config: &SlamConfig) -> Result<Run> {
        let folder = self.folder.join(format!("run-{:06}", self.next));
        self.next += 1;
        let out = StagedDir::new(&folder, "summary.json")?;
        out.write("config.toml", toml::to_string(config)?)?;
        out.write("rig.toml", Rig::from(*rig).to_toml())?;
        let log = out.path("log.jsonl")?;
        let log = File::create(&log).with_context(|| log.display().to_string())?;
        Ok(Run {
            out,
            log: BufWriter::new(log),
            rig: *rig,
            summary: Summary::default(),
        })
    }

    /// Removes the oldest finished runs.
    ///
    /// # Errors
    /// When one cannot be removed.
    pub fn prune(folder: &Path, keep: usize) -> Result<()> {
        let ring = Self {
            folder: folder.to_owned(),
            keep,
            next: 0,
        };
        let runs = ring.runs()?;
        for old in &runs[..runs.len().saturating_sub(ring.keep)] {
            let path = ring.folder.join(format!("run-{old:06}"));
            match std::fs::remove_dir_all(&path) {
                // Another run ended at the same time and was first.
                Err(e) if e.kind() == ErrorKind::NotFound => {}
                removed => removed.with_context(|| path.display().to_string())?,
            }
        }
        Ok(())
    }

    /// Numbers of the finished runs, ascending.
    fn runs(&self) -> Result<Vec<u64>> {
        let context = || self.folder.display().to_string();
        let mut runs = vec![];
        for entry in self.folder.read_dir().with_context(context)? {
            let path = entry.with_context(context)?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            // Other people's folders are not counted, and never removed.
            if path.join("summary.json").is_file() {
                runs.extend(number(&name));
            }
        }
        runs.sort_unstable();
        Ok(runs)
    }
}

/// The number of a folder that the ring named.
fn number(name: &str) -> Option<u64> {
    let digits = name.strip_prefix("run-")?;
    let all = digits.len() >= 6 && digits.bytes().all(|b| b.is_ascii_digit());
    all.then(|| digits.parse().ok())?
}

/// A run that is being written: it takes its name when it is finished.
pub struct Run {
    out: StagedDir,
    log: BufWriter<File>,
    rig: RectifiedRig,
    summary: Summary,
}

/// The part of the summary of `barchan slam` that a service knows.
#[derive(Default, Serialize)]
struct Summary {
    frames: usize,
    tracked: usize,
    keyframes: usize,
    loops: usize,
    points: usize,
}

impl Run {
    /// Adds what became of a pair.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn add(&mut self, report: &FrameReport) -> Result<()> {
        self.summary.frames += 1;
        self.summary.tracked += usize::from(report.tracked);
        for mapped in &report.mapped {
            self.summary.loops += mapped.loops.iter().filter(|l| l.proved).count();
            if let Some(dense) = &mapped.dense {
                write_dense(&self.out, mapped.frame, &mapped.left, dense)?;
            }
        }
        let line = serde_json::to_string(report)?;
        writeln!(self.log, "{line}").context("log.jsonl")
    }

    /// Gives the run its name. One without a key frame is none, and leaves nothing.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn finish(mut self, result: &SlamResult) -> Result<bool> {
        if result.keyframes.is_empty() {
            return Ok(false);
        }
        self.log.flush().context("log.jsonl")?;
        write_result(&self.out, result)?;
        let map = result.map.to_bytes(&self.rig)?;
        self.out.write("map.safetensors", map)?;
        self.summary.keyframes = result.keyframes.len();
        self.summary.points = result.map.points.len();
        self.out.write_json("summary.json", &self.summary)?;
        self.out.finish()?;
        Ok(true)
    }
}
