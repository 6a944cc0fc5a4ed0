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

/// Network, optimiser, and the step and state of the checkpoint they came from.
pub(crate) type Restored<S> = (StereoNet, ModuleOptimizer, Option<(usize, S)>);

/// One line of `log.jsonl`.
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
    /// Seconds the step took.
    pub seconds: f64,
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

    /// Where it is.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Adds a line to `log.jsonl`.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn log(&self, line: &LogLine) -> Result<(), TrainError> {
        let mut text = serde_json::to_string(line).map_err(|e| self.error("log.jsonl", e))?;
        text.push('\n');
        std::fs::OpenOptions::new()
            .create(true)
            .append(true)
            .open(self.path("log.jsonl"))
            .and_then(|mut file| file.write_all(text.as_bytes()))
            .map_err(|e| self.error("log.jsonl", e))
    }

    /// Writes `summary.json`.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn summary(&self, summary: &impl Serialize) -> Result<(), TrainError> {
        let text = serde_json::to_vec_pretty(summary).map_err(|e| self.error("summary.json", e))?;
        self.write("summary.json", &text)
    }

    /// Writes weights and optimiser so that a run can go on after `step`, with whatever else the
    /// caller must remember; older checkpoints go.
    pub(crate) fn checkpoint(
        &self,
        step: usize,
        net: &StereoNet,
        optimizer: &ModuleOptimizer,
        state: &impl Serialize,
    ) -> Result<(), TrainError> {
        let name = format!("checkpoints/{step:08}");
        let (part, done) = (self.path(&format!("{name}.part")), self.path(&name));
        let failed = |e: String| self.error(&name, e);
        if part.exists() {
            std::fs::remove_dir_all(&part).map_err(|e| failed(e.to_string()))?;
        }
        std::fs::create_dir_all(&part).map_err(|e| failed(e.to_string()))?;
        net.clone()
            .into_record()
            .save(part.join("net.bpk"))
            .map_err(|e| failed(e.to_string()))?;
        optimizer
            .save(part.join("optimizer.bpk"))
            .map_err(|e| failed(e.to_string()))?;
        let state = serde_json::to_vec(state).map_err(|e| failed(e.to_string()))?;
        std::fs::write(part.join("state.json"), state).map_err(|e| failed(e.to_string()))?;
        if done.exists() {
            std::fs::remove_dir_all(&done).map_err(|e| failed(e.to_string()))?;
        }
        std::fs::rename(&part, &done).map_err(|e| failed(e.to_string()))?;
        weights::save(net, &self.path("weights.safetensors"))?;
        for old in self.checkpoints()?.into_iter().filter(|s| *s < step) {
            std::fs::remove_dir_all(self.path(&format!("checkpoints/{old:08}")))
                .map_err(|e| failed(e.to_string()))?;
        }
        Ok(())
    }

    /// The newest checkpoint; `None` when the run stopped before its first. Log lines past it go.
    pub(crate) fn restore<S: DeserializeOwned>(
        &self,
        net: StereoNet,
        optimizer: ModuleOptimizer,
    ) -> Result<Restored<S>, TrainError> {
        let step = self.checkpoints()?.into_iter().max();
        self.cut_log(step.unwrap_or(0))?;
        let Some(step) = step else {
            return Ok((net, optimizer, None));
        };
        let name = format!("checkpoints/{step:08}");
        let failed = |e: String| {
            self.error(
                &name,
                format!("{e}\n  cure: delete this checkpoint and resume again"),
            )
        };
        let folder = self.path(&name);
        let record =
            ModuleRecord::load(folder.join("net.bpk")).map_err(|e| failed(e.to_string()))?;
        let net = net.load_record(record);
        let optimizer = optimizer
            .load(folder.join("optimizer.bpk"))
            .map_err(|e| failed(e.to_string()))?;
        let state = std::fs::read(folder.join("state.json")).map_err(|e| failed(e.to_string()))?;
        let state = serde_json::from_slice(&state).map_err(|e| failed(e.to_string()))?;
        Ok((net, optimizer, Some((step, state))))
    }

    fn checkpoints(&self) -> Result<Vec<usize>, TrainError> {
        let entries = std::fs::read_dir(self.path("checkpoints"))
            .map_err(|e| self.error("checkpoints", e))?;
        Ok(entries
            .filter_map(|e| e.ok()?.file_name().to_str()?.parse().ok())
            .collect())
    }

    fn cut_log(&self, step: usize) -> Result<(), TrainError> {
        let Ok(text) = std::fs::read_to_string(self.path("log.jsonl")) else {
            return Ok(());
        };
        let kept: String = text
            .lines()
            .filter(|l| serde_json::from_str::<LogLine>(l).is_ok_and(|l| l.step <= step))
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
