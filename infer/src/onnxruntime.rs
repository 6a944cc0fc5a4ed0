//! ONNX Runtime, loaded at run time from a shared library the user has.

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use barchan_datasets::{Rgb, planar};
use ort::environment::Environment;
use ort::session::Session;
use ort::value::TensorRef;

use crate::engine::check_sizes;
use crate::{DisparityEngine, DisparityMap, InferError};

/// Version of ONNX Runtime that `make onnxruntime` installs.
const VERSION: &str = "1.31.1";

/// The environment is one per process and lives until its end.
static ENVIRONMENT: Mutex<Option<Environment>> = Mutex::new(None);

/// A loaded ONNX Runtime.
pub struct Runtime {
    pub(crate) environment: Environment,
    path: PathBuf,
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
        Ok(Self { environment, path })
    }

    /// The library.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// Runs an ONNX file to Barchan's contract: inputs `left` and `right` `[B, 3, H, W]`, RGB in 0..=1;
/// outputs `disparity`, `confidence` and `sigma`, `[B, 1, H, W]`.
pub struct OnnxEngine {
    session: Session,
    path: PathBuf,
}

impl OnnxEngine {
    /// Reads an ONNX file. `threads` work on one image; 0 leaves it to the runtime.
    ///
    /// # Errors
    /// When the file is missing, is no ONNX, or has other inputs or outputs.
    pub fn load(runtime: &Runtime, path: &Path, threads: usize) -> Result<Self, InferError> {
        let wrong = |message: String| InferError::Model {
            path: path.to_owned(),
            message,
        };
        if !path.is_file() {
            return Err(wrong(
                "no such file\n  cure: `barchan export RUN --out x.onnx` writes one".into(),
            ));
        }
        let cure = "cure: give a file that `barchan export` wrote";
        let session = Session::builder(&runtime.environment)
            .map_err(|e| wrong(e.to_string()))?
            .with_intra_threads(threads)
            .map_err(|e| wrong(e.to_string()))?
            .commit_from_file(path)
            .map_err(|e| wrong(format!("not a usable ONNX file: {e}\n  {cure}")))?;
        let inputs: Vec<&str> = session.inputs().iter().map(|i| i.name()).collect();
        let outputs: Vec<&str> = session.outputs().iter().map(|o| o.name()).collect();
        if inputs != ["left", "right"]
            || !["disparity", "confidence", "sigma"]
                .iter()
                .all(|o| outputs.contains(o))
        {
            return Err(wrong(format!(
                "inputs {inputs:?} and outputs {outputs:?}; expected left, right and disparity, confidence, sigma\n  {cure}"
            )));
        }
        Ok(Self {
            session,
            path: path.to_owned(),
        })
    }
}

impl DisparityEngine for OnnxEngine {
    fn name(&self) -> String {
        format!("onnxruntime {}", self.path.display())
    }

    fn disparity(&mut self, left: &Rgb, right: &Rgb) -> Result<DisparityMap, InferError> {
        check_sizes(left, right)?;
        let engine = self.name();
        let failed = |message: String| InferError::Failed {
            engine: engine.clone(),
            message,
        };
        let size = [left.width() as usize, left.height() as usize];
        let shape = [1, 3, size[1], size[0]];
        let pixels = [left, right].map(|image| planar(image, [0, 0], size));
        let tensor =
            |data| TensorRef::from_array_view((shape, data)).map_err(|e| failed(e.to_string()));
        let inputs =
            ort::inputs! { "left" => tensor(&pixels[0][..])?, "right" => tensor(&pixels[1][..])? };
        let outputs = self
            .session
            .run(inputs)
            .map_err(|e| failed(e.to_string()))?;
        let read = |name: &str| {
            outputs[name]
                .try_extract_tensor::<f32>()
                .map(|(_, data)| data.to_vec())
                .map_err(|e| failed(e.to_string()))
        };
        let maps = [read("disparity")?, read("sigma")?, read("confidence")?];
        DisparityMap::from_network(&engine, left.dimensions(), maps)
    }
}
