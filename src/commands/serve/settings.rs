//! What the service is told, by a TOML file and by flags.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_slam::SlamConfig;
use serde::{Deserialize, Serialize};

use crate::engine::DEFAULT_MODEL;
use crate::engine::STREAM_OUTLINES;

/// Everything that decides how the service runs: the TOML file. Paths in it start at its folder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Where to listen.
    pub listen: SocketAddr,
    /// The rig that all pairs are of, rectified.
    pub rig: PathBuf,
    /// As `--model` of `barchan infer`.
    pub model: String,
    /// A file whose first line is the token that requests must bear.
    pub token_file: Option<PathBuf>,
    /// A folder with left/ and right/ where new pairs appear.
    pub watch: Option<PathBuf>,
    /// Whether pairs of the watched folder are removed when they are answered.
    pub consume: bool,
    /// Where runs are written; without it nothing is.
    pub runs: Option<PathBuf>,
    /// How many runs are kept, the newest.
    pub keep_runs: usize,
    /// A run ends after so many pairs, and the next begins.
    pub frames_per_run: usize,
    /// Largest body of a request, MiB.
    pub max_body: u64,
    /// Most pairs a second over a time, of all clients together.
    pub max_rate: f64,
    /// Most connections at a time.
    pub max_clients: usize,
    /// How many answers can be asked for later, the newest.
    pub keep_answers: usize,
    /// Whether the camera is tracked and mapped.
    pub track: bool,
    /// Threads of the disparity engine; 0 leaves it to the engine.
    pub threads: usize,
    /// How often outlines of a network's disparity are sharpened.
    pub outlines: usize,
    /// Edge of a voxel of the map, metres.
    pub voxel: f64,
    /// Edge of a cell of the map's tiles, metres.
    pub cell: f64,
    /// How SLAM runs: `config.toml` of a run.
    pub slam: SlamConfig,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 8484)),
            rig: "rig.toml".into(),
            model: DEFAULT_MODEL.into(),
            token_file: None,
            watch: None,
            consume: false,
            runs: None,
            keep_runs: 10,
            frames_per_run: 3000,
            max_body: 16,
            max_rate: 30.0,
            max_clients: 32,
            keep_answers: 16,
            track: true,
            threads: 0,
            outlines: STREAM_OUTLINES,
            voxel: 0.02,
            cell: 0.05,
            slam: SlamConfig::default(),
        }
    }
}

impl Settings {
    /// # Errors
    /// When the file cannot be read, or a line of it is none of the above.
    pub fn read(path: &Path) -> Result<Self> {
        let context = || path.display().to_string();
        let text = std::fs::read_to_string(path).with_context(context)?;
        let mut settings: Self = toml::from_str(&text).with_context(context)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        settings.rig = folder.join(&settings.rig);
        for file in [
            &mut settings.token_file,
            &mut settings.watch,
            &mut settings.runs,
        ] {
            *file = file.take().map(|f| folder.join(f));
        }
        Ok(settings)
    }

    /// # Errors
    /// When a number makes no sense.
    pub fn check(&self) -> Result<()> {
        let counts = [
            ("keep_runs", self.keep_runs),
            ("frames_per_run", self.frames_per_run),
            ("max_clients", self.max_clients),
            ("keep_answers", self.keep_answers),
        ];
        if let Some((name, _)) = counts.iter().find(|(_, n)| *n == 0) {
            bail!("{name}: is 0, and 1 is the least");
        }
        let sizes = [
            ("max_rate", self.max_rate),
            ("voxel", self.voxel),
            ("cell", self.cell),
        ];
        if let Some((name, value)) = sizes.iter().find(|(_, v)| !(v.is_finite() && *v > 0.0)) {
            bail!("{name}: is {value}, expected a number above 0");
        }
        if !(1..=1024).contains(&self.max_body) {
            bail!("max_body: is {} MiB, expected 1 to 1024", self.max_body);
        }
        Ok(())
    }

    /// The token that requests must bear; `None` when none is needed.
    ///
    /// # Errors
    /// When others than this machine could ask and there is no token.
    pub fn token(&self) -> Result<Option<String>> {
        let token = match &self.token_file {
            Some(file) => {
                let context = || file.display().to_string();
                let text = std::fs::read_to_string(file).with_context(context)?;
                Some(text.lines().next().unwrap_or_default().trim().to_owned())
            }
            None => std::env::var("BARCHAN_TOKEN").ok(),
        };
        match &token {
            None if !self.listen.ip().is_loopback() => bail!(
                "{}: others than this machine can reach it, and there is no token\n  \
                 cure: --token-file FILE, or the variable BARCHAN_TOKEN (`openssl rand -hex 32` makes one), or --listen 127.0.0.1:{}",
                self.listen,
                self.listen.port()
            ),
            Some(token) if token.len() < 16 || !token.bytes().all(|b| b.is_ascii_graphic()) => {
                bail!(
                    "the token must be 16 characters or more, without spaces\n  cure: `openssl rand -hex 32` makes one"
                )
            }
            _ => Ok(token),
        }
    }
}
