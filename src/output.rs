//! What a user sees and what a command leaves: progress, summaries, output directories.

use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

/// How to talk.
pub struct Output {
    /// JSON on standard output, and nothing else there.
    pub json: bool,
    /// No result on standard output: the command is a part of another.
    pub quiet: bool,
}

impl Output {
    /// For a command that is a part of another, whose result is not to be printed.
    pub fn quiet(&self) -> Self {
        Self {
            json: self.json,
            quiet: true,
        }
    }

    /// Prints the result of a command: `text` for people, `value` with `--json`.
    pub fn result(&self, value: &impl Serialize, text: &str) -> Result<()> {
        if self.quiet {
            return Ok(());
        }
        let text = if self.json {
            serde_json::to_string_pretty(value)?
        } else {
            text.trim_end().to_owned()
        };
        print_line(&text)
    }

    /// Says something along the way, to people only.
    pub fn say(&self, text: &str) {
        if !self.json {
            // A closed pipe ends the talk, not the work.
            let _ = print_line(text);
        }
    }

    /// Says what a user should know although nothing failed.
    pub fn notice(&self, text: &str) {
        let _ = writeln!(std::io::stderr(), "note: {text}");
    }

    /// A progress bar of `length` steps on standard error; nothing when that is no terminal.
    pub fn progress(&self, what: &str, length: usize) -> ProgressBar {
        if !std::io::stderr().is_terminal() {
            return ProgressBar::hidden();
        }
        let bar = ProgressBar::new(length as u64).with_prefix(what.to_owned());
        if let Ok(style) =
            ProgressStyle::with_template("{prefix} [{bar:30}] {pos}/{len} {eta} {msg}")
        {
            bar.set_style(style.progress_chars("=> "));
        }
        bar
    }
}

fn print_line(text: &str) -> Result<()> {
    match writeln!(std::io::stdout(), "{text}") {
        // `barchan ... | head` closes the pipe: no error of ours.
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(e).context("standard output"),
        _ => Ok(()),
    }
}

/// An output directory that appears whole or not at all: files go to a neighbour, which takes the
/// name at the end and is removed when that end is not reached.
pub struct StagedDir {
    stage: PathBuf,
    target: PathBuf,
}

impl StagedDir {
    /// Prepares to write `target`. What is there already is replaced only if an earlier run of the
    /// same kind left it, which `mark` (a file every such run writes) tells.
    pub fn new(target: &Path, mark: &str) -> Result<Self> {
        if target.is_file() {
            bail!(
                "{}: is a file, and a directory is to be written\n  cure: give another --out",
                target.display()
            );
        }
        let occupied = target
            .read_dir()
            .is_ok_and(|mut entries| entries.next().is_some());
        if occupied && !target.join(mark).is_file() {
            bail!(
                "{}: holds other files, and no {mark} of an earlier run that could be replaced\n  cure: give another --out",
                target.display()
            );
        }
        let staged = Self {
            stage: beside(target, ".part"),
            target: target.to_owned(),
        };
        // A run that was ended between the two names of `finish`: what was there before is back.
        let old = beside(target, ".barchan-old");
        if !target.exists() && old.join(mark).is_file() {
            std::fs::rename(&old, target).with_context(|| old.display().to_string())?;
        }
        if staged.stage.exists() {
            std::fs::remove_dir_all(&staged.stage)
                .with_context(|| staged.stage.display().to_string())?;
        }
        std::fs::create_dir_all(&staged.stage)
            .with_context(|| staged.stage.display().to_string())?;
        Ok(staged)
    }

    /// A path inside, its folder made.
    pub fn path(&self, name: impl AsRef<Path>) -> Result<PathBuf> {
        let path = self.stage.join(name);
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent).with_context(|| parent.display().to_string())?;
        }
        Ok(path)
    }

    /// Writes a file inside.
    pub fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> Result<()> {
        let path = self.path(name)?;
        std::fs::write(&path, bytes).with_context(|| path.display().to_string())
    }

    /// Writes a JSON file inside.
    pub fn write_json(&self, name: &str, value: &impl Serialize) -> Result<()> {
        self.write(name, serde_json::to_string_pretty(value)? + "\n")
    }

    /// Gives the directory its name.
    pub fn finish(self) -> Result<()> {
        let context = || self.target.display().to_string();
        // To remove what was there takes a while, in which the end of the process would lose both.
        let old = beside(&self.target, ".barchan-old");
        if old.exists() {
            std::fs::remove_dir_all(&old).with_context(|| old.display().to_string())?;
        }
        if self.target.exists() {
            std::fs::rename(&self.target, &old).with_context(context)?;
        }
        std::fs::rename(&self.stage, &self.target).with_context(context)?;
        match std::fs::remove_dir_all(&old) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                Err(e).with_context(|| old.display().to_string())
            }
            _ => Ok(()),
        }
    }
}

/// An output file that appears whole or not at all: written under a neighbouring name, which is removed when the
/// end is not reached.
pub struct StagedFile {
    stage: PathBuf,
    target: PathBuf,
}

impl StagedFile {
    /// Prepares to write `target`.
    pub fn new(target: &Path) -> Self {
        Self {
            stage: beside(target, ".part"),
            target: target.to_owned(),
        }
    }

    /// Where it is written till then.
    pub fn path(&self) -> &Path {
        &self.stage
    }

    /// Gives the file its name, when all of it is on disk; its size in bytes.
    pub fn finish(self) -> Result<u64> {
        let context = || self.target.display().to_string();
        let file = std::fs::File::open(&self.stage).with_context(context)?;
        file.sync_all().with_context(context)?;
        std::fs::rename(&self.stage, &self.target).with_context(context)?;
        Ok(file.metadata().with_context(context)?.len())
    }
}

impl Drop for StagedFile {
    fn drop(&mut self) {
        // After `finish` there is nothing left here.
        let _ = std::fs::remove_file(&self.stage);
    }
}

/// The path with `ending` after its last name.
fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.components().as_path().as_os_str().to_owned();
    name.push(ending);
    name.into()
}

impl Drop for StagedDir {
    fn drop(&mut self) {
        // After `finish` there is nothing left here.
        let _ = std::fs::remove_dir_all(&self.stage);
    }
}

/// Median and 95th percentile of times in milliseconds; zero of none.
pub fn percentiles(mut milliseconds: Vec<f64>) -> (f64, f64) {
    milliseconds.sort_by(f64::total_cmp);
    let at = |share: f64| {
        milliseconds
            .get(((milliseconds.len() as f64 - 1.0) * share).round() as usize)
            .copied()
            .unwrap_or(0.0)
    };
    (at(0.5), at(0.95))
}
