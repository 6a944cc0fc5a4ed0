//! ONNX files, our own exports and those of others, run by ONNX Runtime.

mod contract;
mod photometric;
pub(crate) mod run;
mod runtime;

use std::path::{Path, PathBuf};

use barchan_datasets::{Plane, Rgb};
use ort::session::Session;
use ort::value::{TensorElementType, ValueType};

pub use contract::{
    Channels, Contract, ImageFormat, InputFormat, Layout, ModelSize, OutputFormat, OutputLayout,
    Side, Unit,
};
pub(crate) use contract::{MOST_AREA, MOST_SIDE};
pub use runtime::Runtime;
pub(crate) use runtime::{open, open_bytes};

use crate::engine::check_sizes;
use crate::{DisparityEngine, DisparityMap, InferError};
use run::{Geometry, plane, resolution, run};

/// Runs an ONNX file: one that `barchan export` wrote, or anybody's whose [`Contract`] lies beside it.
///
/// A model that gives no standard deviation and no confidence has them made up from the pair: sigma
/// is that of least-squares matching at the disparity found, confidence the probability of an error
/// below a pixel times the similarity of the matched windows.
pub struct OnnxEngine {
    session: Session,
    pub(crate) contract: Contract,
    path: PathBuf,
}

/// Most pixels that run at once in a batch.
const MOST_PIXELS: usize = 1 << 22;

impl OnnxEngine {
    /// Reads an ONNX file, and `x.toml` beside it if it is there. `threads` work on one image; 0 leaves it
    /// to the runtime.
    ///
    /// # Errors
    /// When the file is missing, damaged or hostile, when `x.toml` is damaged or speaks of another
    /// model, and when there is none and the file is not to our own contract.
    pub fn load(runtime: &Runtime, path: &Path, threads: usize) -> Result<Self, InferError> {
        let session = open(runtime, path, threads)?;
        let wrong = |message: String| InferError::Model {
            path: path.to_owned(),
            message,
        };
        let inputs: Vec<&str> = session.inputs().iter().map(|i| i.name()).collect();
        let outputs: Vec<&str> = session.outputs().iter().map(|o| o.name()).collect();
        let beside = Contract::path_beside(path);
        let contract = if beside.exists() {
            let contract = Contract::load(&beside)?;
            contract
                .fits(&session)
                .map_err(|message| InferError::Model {
                    path: beside,
                    message: format!(
                        "{message}\n  cure: `barchan probe {}` writes it anew",
                        path.display()
                    ),
                })?;
            contract
        } else if is_own(&session) {
            Contract::own()
        } else {
            return Err(wrong(format!(
                "inputs {inputs:?} and outputs {outputs:?} are not those of `barchan export`\n  cure: `barchan probe {}` finds out what they mean",
                path.display()
            )));
        };
        Ok(Self::with_contract(session, contract, path))
    }

    /// Runs the bytes of a file that `barchan export` would write; `name` stands in results and errors.
    ///
    /// # Errors
    /// When ONNX Runtime does not take them.
    pub fn of_export(
        runtime: &Runtime,
        bytes: Vec<u8>,
        name: &str,
        threads: usize,
    ) -> Result<Self, InferError> {
        let path = Path::new(name);
        let session = open_bytes(runtime, bytes.into(), path, threads)?;
        Ok(Self::with_contract(session, Contract::own(), path))
    }

    /// An engine on a session that is open.
    pub(crate) fn with_contract(session: Session, contract: Contract, path: &Path) -> Self {
        Self {
            session,
            contract,
            path: path.to_owned(),
        }
    }

    /// How the file wants its images and what its output means.
    pub fn contract(&self) -> &Contract {
        &self.contract
    }

    /// Pairs of one size, at once.
    fn together(&mut self, pairs: &[(&Rgb, &Rgb)]) -> Result<Vec<DisparityMap>, InferError> {
        let engine = self.name();
        let failed = |message: String| InferError::Failed {
            engine: engine.clone(),
            message,
        };
        let Some(size) = pairs.first().map(|(left, _)| left.dimensions()) else {
            return Ok(Vec::new());
        };
        let contract = &self.contract;
        let geometry = Geometry::new(contract, [size.0 as usize, size.1 as usize]);
        let format = &contract.output;
        let outputs = run(&mut self.session, contract, &geometry, pairs)
            .map_err(|e| failed(e.to_string()))?;
        let read = |name: &str, pair: usize, factor: f64| {
            let (dims, data) = outputs
                .get(name)
                .ok_or_else(|| failed(format!("there is no output \"{name}\"")))?
                .try_extract_tensor::<f32>()
                .map_err(|e| failed(e.to_string()))?;
            let (columns_rows, values) = plane(dims, data, format.layout, format.channel, pair)
                .ok_or_else(|| {
                    failed(format!(
                        "output \"{name}\" is {dims:?}, expected axes {} and channel {} for {} pairs\n  cure: `barchan probe {}`",
                        format.layout.letters(),
                        format.channel,
                        pairs.len(),
                        self.path.display()
                    ))
                })?;
            if resolution(contract, &geometry, columns_rows).is_none() {
                return Err(failed(format!(
                    "output \"{name}\" is {dims:?} for images of {:?}, which is no whole fraction\n  cure: `barchan probe {}`",
                    geometry.given,
                    self.path.display()
                )));
            }
            let values = geometry.to_image(&values, columns_rows, factor as f32);
            // One value a pixel by construction.
            Ok(Plane::from_raw(size.0, size.1, values).unwrap_or_default())
        };
        let factor = format.factor * geometry.pixels(format.unit);
        pairs
            .iter()
            .enumerate()
            .map(|(pair, (left, right))| {
                let disparity = read(&format.name, pair, factor)?;
                Ok(match (&format.sigma, &format.confidence) {
                    (Some(sigma), Some(confidence)) => DisparityMap {
                        disparity,
                        sigma: read(sigma, pair, factor.abs())?,
                        confidence: read(confidence, pair, 1.0)?,
                    },
                    _ => photometric::judge(left, right, disparity),
                })
            })
            .collect()
    }
}

impl DisparityEngine for OnnxEngine {
    fn name(&self) -> String {
        format!("onnxruntime {}", self.path.display())
    }

    fn disparity(&mut self, left: &Rgb, right: &Rgb) -> Result<DisparityMap, InferError> {
        check_sizes(left, right)?;
        let mut maps = self.together(&[(left, right)])?;
        maps.pop().ok_or_else(|| InferError::Failed {
            engine: self.name(),
            message: "no answer".into(),
        })
    }

    fn disparity_batch(&mut self, pairs: &[(&Rgb, &Rgb)]) -> Result<Vec<DisparityMap>, InferError> {
        for (left, right) in pairs {
            check_sizes(left, right)?;
        }
        let mut maps = Vec::with_capacity(pairs.len());
        let size = |pair: &(&Rgb, &Rgb)| pair.0.dimensions();
        // Neighbours of one size run together, as many as memory takes.
        for same in pairs.chunk_by(|a, b| size(a) == size(b)) {
            let (width, height) = size(&same[0]);
            let most = match self.contract.size.batch {
                true => (MOST_PIXELS / (width as usize * height as usize)).max(1),
                false => 1,
            };
            for together in same.chunks(most) {
                maps.append(&mut self.together(together)?);
            }
        }
        Ok(maps)
    }
}

/// Whether a file is to the contract of `barchan export`.
pub(crate) fn is_own(session: &Session) -> bool {
    let inputs: Vec<&str> = session.inputs().iter().map(|i| i.name()).collect();
    inputs == ["left", "right"]
        && ["disparity", "confidence", "sigma"]
            .iter()
            .all(|name| session.outputs().iter().any(|o| o.name() == *name))
}

/// Name and dimensions of each input, -1 for a free one, if all are images: four axes of floats.
pub(crate) fn image_inputs(session: &Session) -> Result<Vec<(String, [i64; 4])>, String> {
    let mut inputs = Vec::new();
    for input in session.inputs() {
        let kind = match input.dtype() {
            ValueType::Tensor {
                ty: TensorElementType::Float32,
                shape,
                ..
            } => <[i64; 4]>::try_from(&shape[..]).ok(),
            _ => None,
        };
        let Some(dims) = kind else {
            return Err(format!(
                "input \"{}\" is {}, expected images: four axes of 32-bit floats\n  cure: export the model with such inputs alone",
                input.name(),
                input.dtype()
            ));
        };
        inputs.push((input.name().to_owned(), dims));
    }
    Ok(inputs)
}

impl Contract {
    /// Whether the names are those of the model, and its fixed dimensions those of the contract.
    fn fits(&self, session: &Session) -> Result<(), String> {
        let inputs = image_inputs(session)?;
        for (name, dims) in &inputs {
            let Some(input) = self.input.iter().find(|i| i.name == *name) else {
                return Err(format!("does not tell of the model's input \"{name}\""));
            };
            let channels = input.images.len() * self.images.channels.count();
            let [width, height] =
                [self.size.width, self.size.height].map(|side| side.map(|s| s / input.shrink));
            let wanted = match self.images.layout {
                Layout::Nchw => [None, Some(channels), height, width],
                Layout::Nhwc => [None, height, width, Some(channels)],
            };
            for (axis, (found, wanted)) in dims.iter().zip(wanted).enumerate().skip(1) {
                // A free axis of the model may be fixed by the contract, never the other way.
                if *found >= 0 && wanted.is_none_or(|w| w as i64 != *found) {
                    return Err(format!(
                        "input \"{name}\" of the model has dimensions {dims:?}, and axis {axis} is {} here",
                        wanted.map_or("free".into(), |w| w.to_string())
                    ));
                }
            }
        }
        if let Some(input) = self
            .input
            .iter()
            .find(|i| inputs.iter().all(|(name, _)| *name != i.name))
        {
            return Err(format!("input \"{}\" is not in the model", input.name));
        }
        let named = [
            Some(&self.output.name),
            self.output.sigma.as_ref(),
            self.output.confidence.as_ref(),
        ];
        for name in named.into_iter().flatten() {
            if session.outputs().iter().all(|o| o.name() != name) {
                return Err(format!("output \"{name}\" is not in the model"));
            }
        }
        Ok(())
    }
}
