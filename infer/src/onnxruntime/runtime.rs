//! ONNX Runtime, loaded at run time from a shared library the user has.

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use barchan_onnx::{Bytes, inspect};
use ort::environment::Environment;
use ort::logging::LogLevel;
use ort::session::Session;

use crate::InferError;

/// Version of ONNX Runtime that `make onnxruntime` installs.
const VERSION: &str = "1.31.1";

/// The environment is one per process and lives until its end.
static ENVIRONMENT: Mutex<Option<Environment>> = Mutex::new(None);

/// A loaded ONNX Runtime.
pub struct Runtime {
    pub(crate) environment: Environment,
    path: PathBuf,
    /// Whether its threads wait for work within a run without giving up their cores.
    busy_wait: bool,
}

impl Runtime {
    /// Where the library is looked for: the path given, else the environment variable
    /// `BARCHAN_ONNXRUNTIME`, else the cache that `make onnxruntime` fills.
    ///
    /// # Errors
    /// When it is at none of these places; the message names them and the cure.
    pub fn find(given: Option<&Path>) -> Result<PathBuf, InferError> {
        let cure = "cure: run `make onnxruntime`, or give `--onnxruntime PATH`, or use weights (x.safetensors), which need no library";
        let variable = std::env::var_os("BARCHAN_ONNXRUNTIME").map(PathBuf::from);
        if let Some(path) = given.map(Path::to_owned).or(variable) {
            return if path.is_file() {
                Ok(path)
            } else {
                Err(InferError::Unavailable(format!(
                    "{}: no ONNX Runtime library there\n  {cure}",
                    path.display()
                )))
            };
        }
        let cache = std::env::var_os("XDG_CACHE_HOME")
            .map(PathBuf::from)
            .or_else(|| Some(PathBuf::from(std::env::var_os("HOME")?).join(".cache")))
            .unwrap_or_default();
        let path = cache
            .join("barchan/onnxruntime")
            .join(VERSION)
            .join("libonnxruntime.so");
        if path.is_file() {
            return Ok(path);
        }
        Err(InferError::Unavailable(format!(
            "ONNX Runtime is not installed: BARCHAN_ONNXRUNTIME is not set and {} is not there\n  {cure}",
            path.display()
        )))
    }

    /// Loads the library that [`Runtime::find`] finds. A process has one: later calls share the first.
    ///
    /// # Errors
    /// When there is none, or it does not load.
    pub fn load(given: Option<&Path>) -> Result<Self, InferError> {
        let path = Self::find(given)?;
        let failed = |message: String| {
            InferError::Unavailable(format!(
                "{}: does not load as ONNX Runtime 1.17 or later: {message}",
                path.display()
            ))
        };
        let mut shared = ENVIRONMENT.lock().map_err(|e| failed(e.to_string()))?;
        let environment = match shared.as_ref() {
            Some(environment) => environment.clone(),
            None => ort::init_from(&path)
                .map_err(|e| failed(e.to_string()))?
                .with_name("barchan")
                .build()
                .map_err(|e| failed(e.to_string()))?,
        };
        *shared = Some(environment.clone());
        Ok(Self {
            environment,
            path,
            busy_wait: true,
        })
    }

    /// The same, for engines beside other work: their threads give up their cores while they wait. Alone an engine takes a
    /// quarter longer for that.
    pub fn beside_other_work(self) -> Self {
        Self {
            busy_wait: false,
            ..self
        }
    }

    /// The library.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// Opens an ONNX file that may come from anybody: looked through first, and only what was looked
/// through reaches the runtime. `threads` work on one image; 0 leaves it to the runtime.
pub(crate) fn open(runtime: &Runtime, path: &Path, threads: usize) -> Result<Session, InferError> {
    let wrong = |message: String| InferError::Model {
        path: path.to_owned(),
        message,
    };
    let size = std::fs::metadata(path)
        .ok()
        .filter(|file| file.is_file())
        .ok_or_else(|| {
            wrong("no such file\n  cure: `barchan export RUN --out x.onnx` writes one".into())
        })?
        .len();
    if size > MOST_BYTES {
        return Err(wrong(format!(
            "has {size} bytes, and no ONNX file has more than {MOST_BYTES}"
        )));
    }
    let bytes = std::fs::read(path).map_err(|e| wrong(e.to_string()))?;
    open_bytes(runtime, bytes.into(), path, threads)
}

/// Opens the bytes of an ONNX file; `path` names it in errors.
pub(crate) fn open_bytes(
    runtime: &Runtime,
    bytes: Bytes,
    path: &Path,
    threads: usize,
) -> Result<Session, InferError> {
    let wrong = |message: String| InferError::Model {
        path: path.to_owned(),
        message,
    };
    let with_cure = |message: String| match message.contains("cure:") {
        true => wrong(message),
        false => wrong(format!(
            "{message}\n  cure: `barchan export RUN --out x.onnx` writes a file that runs; fetch somebody else's again"
        )),
    };
    inspect::check(bytes.clone()).map_err(with_cure)?;
    let failed = |message: String| with_cure(format!("ONNX Runtime does not take it: {message}"));
    let busy_wait = if runtime.busy_wait { "1" } else { "0" };
    Session::builder(&runtime.environment)
        .map_err(|e| failed(e.to_string()))?
        .with_intra_threads(threads)
        .map_err(|e| failed(e.to_string()))?
        .with_config_entry("session.intra_op.allow_spinning", busy_wait)
        .map_err(|e| failed(e.to_string()))?
        // After a run threads that wait busily would take the cores from us.
        .with_config_entry("session.force_spinning_stop", "1")
        .map_err(|e| failed(e.to_string()))?
        // What fails is returned; the runtime need not print it too.
        .with_log_level(LogLevel::Fatal)
        .map_err(|e| failed(e.to_string()))?
        .commit_from_memory(&bytes)
        .map_err(|e| failed(e.to_string()))
}

/// Protobuf has no larger messages.
const MOST_BYTES: u64 = (1 << 31) - 1;
