use std::io::Write;
use std::path::{Path, PathBuf};

use barchan_model::{StereoNet, weights};
use burn::module::Module;
use burn::optim::ModuleOptimizer;
use burn::store::ModuleRecord;
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use crate::{LossTerms, TrainConfig, TrainError};

/// What a run leaves on disk: `config.toml`, `log.jsonl`, `weights.safetensors`, `summary.json`,
/// and under `checkpoints/` what it needs to go on.
pub struct RunDir {
    root: PathBuf,
}

/// What a checkpoint holds beside numbers.
pub(crate) struct Saved {
    pub net: StereoNet,
    /// The moving average of its weights, where there is one.
    pub average: Option<StereoNet>,
    pub optimizer: ModuleOptimizer,
}

/// What was saved, and the step and state of the checkpoint that it came from.
pub(crate) type Restored<S> = (Saved, Option<(usize, S)>);

/// A line of `log.jsonl`: one step. (The lines of a validation are [`Scored`](crate::Scored).)
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct LogLine {
    /// Steps done, this one included.
    pub step: usize,
    /// Which pass over the data, from 0.
    pub epoch: usize,
    /// Learning rate of the step.
    pub lr: f64,
    /// Weighted loss (eq. 1, or eq. 8 when supervised).
    pub loss: f32,
    /// The terms, unweighted; those that are off are absent.
    #[serde(flatten)]
    pub terms: LossTerms,
    /// Euclidean norm of the gradient before it was clipped.
    pub gradient: f32,
    /// Seconds the step took.
    pub seconds: f64,
    /// Seconds it waited for its images before that.
    pub waited: f64,
    /// Its frames, each with its data set.
    pub frames: String,
}

impl RunDir {
    /// Makes a new run directory and writes its configuration.
    ///
    /// # Errors
    /// When there is a run already, or the directory cannot be written.
    pub fn create(root: &Path, config: &TrainConfig) -> Result<Self, TrainError> {
        let run = Self {
            root: root.to_owned(),
        };
        if run.path("config.toml").exists() {
            return Err(run.error(
                "config.toml",
                format!("there is a run here already\n  cure: `--resume {0}` goes on with it; or give another --out", root.display()),
            ));
        }
        std::fs::create_dir_all(run.path("checkpoints")).map_err(|e| run.error("", e))?;
        let text = toml::to_string(config).map_err(|e| run.error("config.toml", e))?;
        run.write("config.toml", text.as_bytes())?;
        Ok(run)
    }

    /// Opens a run to go on with it.
    ///
    /// # Errors
    /// When there is none, or its configuration does not parse.
    pub fn open(root: &Path) -> Result<(Self, TrainConfig), TrainError> {
        let run = Self {
            root: root.to_owned(),
        };
        let text = std::fs::read_to_string(run.path("config.toml"))
            .map_err(|e| run.error("config.toml", format!("no run to go on with ({e})")))?;
        let config = toml::from_str(&text).map_err(|e| run.error("config.toml", e))?;
        Ok((run, config))
    }

    /// The weights of a run directory, or the file itself when `path` is one.
    pub fn weights_of(path: &Path) -> PathBuf {
        if path.is_dir() {
            path.join("weights.safetensors")
        } else {
            path.to_owned()
        }
    }

    /// Whether a run stopped before its first checkpoint, so that there is nothing to go on from.
    pub fn is_without_checkpoint(root: &Path) -> bool {
        Self {
            root: root.to_owned(),
        }
        .checkpoints()
        .is_ok_and(|steps| steps.is_empty())
    }

    /// Removes what a run left, and the directory if nothing else is in it.
    pub fn discard(root: &Path) {
        // What cannot be removed stays: there is an error to be told already.
        for file in [
            "config.toml",
            "log.jsonl",
            "summary.json",
            "weights.safetensors",
        ] {
            let _ = std::fs::remove_file(root.join(file));
        }
        for folder in ["checkpoints", "samples"] {
            let _ = std::fs::remove_dir_all(root.join(folder));
        }
        let _ = std::fs::remove_dir(root);
    }

    /// Where it is.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Adds a line to `log.jsonl`.
    ///
    /// # Errors
    /// When it cannot be written.
    pub(crate) fn log(&self, line: &impl Serialize) -> Result<(), TrainError> {
        let mut text = serde_json::to_string(line).map_err(|e| self.error("log.jsonl", e))?;
        text.push('\n');
        std::fs::OpenOptions::new()
            .create(true)
            .append(true)
            .open(self.path("log.jsonl"))
            .and_then(|mut file| file.write_all(text.as_bytes()))
            .map_err(|e| self.error("log.jsonl", e))
    }

    /// Writes `weights.safetensors` anew.
    ///
    /// # Errors
    /// When it cannot be written.
    pub(crate) fn weights(&self, net: &StereoNet) -> Result<(), TrainError> {
        Ok(weights::save(net, &self.path("weights.safetensors"))?)
    }

    /// Writes `summary.json`.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn summary(&self, summary: &impl Serialize) -> Result<(), TrainError> {
        let text = serde_json::to_vec_pretty(summary).map_err(|e| self.error("summary.json", e))?;
        self.write("summary.json", &text)
    }

    /// Writes a file under `samples/`, all or nothing.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn sample(&self, name: &str, bytes: &[u8]) -> Result<(), TrainError> {
        let folder = self.path("samples");
        std::fs::create_dir_all(&folder).map_err(|e| self.error("samples", e))?;
        Ok(weights::write_atomically(&folder.join(name), bytes)?)
    }

    /// Writes what a run needs to go on after `step`, with whatever else the caller must remember,
    /// and `net` as the weights of the run; older checkpoints go.
    ///
    /// Killed between any two lines, it leaves a checkpoint to go on from, and weights that are those
    /// of the newest checkpoint or newer: going on writes the same weights again.
    pub(crate) fn checkpoint(
        &self,
        step: usize,
        saved: &Saved,
        net: &StereoNet,
        state: &impl Serialize,
    ) -> Result<(), TrainError> {
        let name = format!("checkpoints/{step:08}");
        let (part, done) = (self.path(&format!("{name}.part")), self.path(&name));
        let failed = |e: &dyn std::fmt::Display| self.error(&name, e);
        if part.exists() {
            std::fs::remove_dir_all(&part).map_err(|e| failed(&e))?;
        }
        std::fs::create_dir_all(&part).map_err(|e| failed(&e))?;
        let nets = [
            ("net", Some(&saved.net)),
            ("average", saved.average.as_ref()),
        ];
        for (name, net) in nets {
            if let Some(net) = net {
                net.clone()
                    .into_record()
                    .save(part.join(format!("{name}.bpk")))
                    .map_err(|e| failed(&e))?;
            }
        }
        saved
            .optimizer
            .save(part.join("optimizer.bpk"))
            .map_err(|e| failed(&e))?;
        let state = serde_json::to_vec(state).map_err(|e| failed(&e))?;
        std::fs::write(part.join("state.json"), state).map_err(|e| failed(&e))?;
        self.weights(net)?;
        std::fs::rename(&part, &done).map_err(|e| failed(&e))?;
        for old in self.checkpoints()?.into_iter().filter(|s| *s < step) {
            std::fs::remove_dir_all(self.path(&format!("checkpoints/{old:08}")))
                .map_err(|e| failed(&e))?;
        }
        Ok(())
    }

    /// The newest checkpoint; no step when the run stopped before its first. Log lines past it go.
    pub(crate) fn restore<S: DeserializeOwned>(
        &self,
        mut into: Saved,
    ) -> Result<Restored<S>, TrainError> {
        let step = self.checkpoints()?.into_iter().max();
        self.cut_log(step)?;
        let Some(step) = step else {
            return Ok((into, None));
        };
        let name = format!("checkpoints/{step:08}");
        let failed = |e: &dyn std::fmt::Display| {
            self.error(
                &name,
                format!("{e}\n  cure: delete this checkpoint and resume again"),
            )
        };
        let folder = self.path(&name);
        let load = |net: StereoNet, file| {
            let record = ModuleRecord::load(folder.join(file)).map_err(|e| failed(&e))?;
            Ok::<_, TrainError>(net.load_record(record))
        };
        into.net = load(into.net, "net.bpk")?;
        into.average = into
            .average
            .map(|average| load(average, "average.bpk"))
            .transpose()?;
        into.optimizer = into
            .optimizer
            .load(folder.join("optimizer.bpk"))
            .map_err(|e| failed(&e))?;
        let state = std::fs::read(folder.join("state.json")).map_err(|e| failed(&e))?;
        let state = serde_json::from_slice(&state).map_err(|e| failed(&e))?;
        Ok((into, Some((step, state))))
    }

    fn checkpoints(&self) -> Result<Vec<usize>, TrainError> {
        let entries = std::fs::read_dir(self.path("checkpoints"))
            .map_err(|e| self.error("checkpoints", e))?;
        Ok(entries
            .filter_map(|e| e.ok()?.file_name().to_str()?.parse().ok())
            .collect())
    }

    /// Keeps the log lines of what the checkpoint after `step` holds: its steps, and the validations
    /// before that of the same step, which a run that goes on repeats.
    fn cut_log(&self, step: Option<usize>) -> Result<(), TrainError> {
        /// What both kinds of line have, and what only one has.
        #[derive(Deserialize)]
        struct Line {
            step: usize,
            validation: Option<serde::de::IgnoredAny>,
        }
        let Ok(text) = std::fs::read_to_string(self.path("log.jsonl")) else {
            return Ok(());
        };
        let kept: String = text
            .lines()
            .filter(|text| {
                serde_json::from_str::<Line>(text).is_ok_and(|line| match line.validation {
                    Some(_) => step.is_some_and(|step| line.step < step),
                    None => step.is_some_and(|step| line.step <= step),
                })
            })
            .flat_map(|l| [l, "\n"])
            .collect();
        self.write("log.jsonl", kept.as_bytes())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.root.join(name)
    }

    fn write(&self, name: &str, bytes: &[u8]) -> Result<(), TrainError> {
        Ok(weights::write_atomically(&self.path(name), bytes)?)
    }

    fn error(&self, name: &str, message: impl ToString) -> TrainError {
        TrainError::Run {
            path: self.path(name),
            message: message.to_string(),
        }
    }
}
