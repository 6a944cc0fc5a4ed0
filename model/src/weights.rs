//! Weights on disk: safetensors whose header carries the full configuration.
//!
//! Names are the paths of the layers (`features.half.weight`), layouts those of PyTorch's
//! convolutions, so other programs read them without this one.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Device, Tensor, TensorData};
use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};

use crate::{ModelError, NetConfig, StereoNet};

/// The header's key for the configuration, as JSON.
const CONFIG_KEY: &str = "barchan.config";

/// The bytes of a safetensors file.
///
/// # Errors
/// When the tensors cannot be read back from their device.
pub fn to_bytes(net: &StereoNet) -> Result<Vec<u8>, ModelError> {
    let failed = |message: String| ModelError::Weights {
        path: "weights".into(),
        message,
    };
    let mut collect = Collect::default();
    net.visit(&mut collect);
    let mut tensors = Vec::with_capacity(collect.tensors.len());
    for (name, (shape, values)) in &collect.tensors {
        let view = TensorView::new(Dtype::F32, shape.clone(), values)
            .map_err(|e| failed(e.to_string()))?;
        tensors.push((name.as_str(), view));
    }
    let config = serde_json::to_string(net.config()).map_err(|e| failed(e.to_string()))?;
    serialize(
        tensors,
        Some(HashMap::from([(CONFIG_KEY.to_owned(), config)])),
    )
    .map_err(|e| failed(e.to_string()))
}

/// Writes a safetensors file, all or nothing.
///
/// # Errors
/// When the file cannot be written.
pub fn save(net: &StereoNet, path: &Path) -> Result<(), ModelError> {
    write_atomically(path, &to_bytes(net)?)
}

/// Reads a network that [`save`] wrote.
///
/// # Errors
/// When the file is missing, is not safetensors, or lacks the configuration or a layer.
pub fn load(path: &Path, device: &Device) -> Result<StereoNet, ModelError> {
    let bytes = std::fs::read(path).map_err(|source| ModelError::Io {
        path: path.to_owned(),
        source,
    })?;
    from_bytes(&bytes, path, device)
}

/// [`load`] from memory; `name` stands for the file in messages.
///
/// # Errors
/// As [`load`].
pub fn from_bytes(bytes: &[u8], name: &Path, device: &Device) -> Result<StereoNet, ModelError> {
    let wrong = |message: String| ModelError::Weights {
        path: name.to_owned(),
        message,
    };
    let not_ours = |e: String| {
        wrong(format!(
            "not weights of barchan ({e})\n  cure: give a file that `barchan train` wrote"
        ))
    };
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|e| not_ours(e.to_string()))?;
    let file = SafeTensors::deserialize(bytes).map_err(|e| not_ours(e.to_string()))?;
    let config = metadata
        .metadata()
        .as_ref()
        .and_then(|m| m.get(CONFIG_KEY))
        .ok_or_else(|| not_ours(format!("no {CONFIG_KEY} in its header")))?;
    let config: NetConfig = serde_json::from_str(config).map_err(|e| not_ours(e.to_string()))?;

    let mut tensors = BTreeMap::new();
    for (name, view) in file.tensors() {
        if view.dtype() != Dtype::F32 {
            return Err(wrong(format!("{name} is {:?}, expected F32", view.dtype())));
        }
        let values: Vec<f32> = view
            .data()
            .as_chunks::<4>()
            .0
            .iter()
            .map(|b| f32::from_le_bytes(*b))
            .collect();
        tensors.insert(name, TensorData::new(values, view.shape().to_vec()));
    }
    let mut apply = Apply {
        path: vec![],
        tensors,
        problem: None,
    };
    // The seed is of no account: every parameter is replaced.
    let net = StereoNet::init(&config, 0, device)?.map(&mut apply);
    match (apply.problem, apply.tensors.keys().next()) {
        (Some(problem), _) => Err(wrong(problem)),
        (None, Some(unused)) => Err(wrong(format!(
            "{unused} belongs to no layer of this network"
        ))),
        (None, None) => Ok(net),
    }
}

/// Writes to a neighbour, then renames: a reader sees the old file or the new one.
///
/// # Errors
/// When either step fails; nothing is left then.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), ModelError> {
    let failed = |source| ModelError::Io {
        path: path.to_owned(),
        source,
    };
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    std::fs::write(&part, bytes)
        .and_then(|()| std::fs::rename(&part, path))
        .map_err(|error| {
            // Best effort: the first error is the one to tell.
            let _ = std::fs::remove_file(&part);
            failed(error)
        })
}

/// Burn names the variant of an enum too, as Rust does, in capitals; a file's names should not change with it.
fn is_layer(name: &str) -> bool {
    !name.starts_with(char::is_uppercase)
}

/// Every parameter by name: shape and little-endian bytes.
#[derive(Default)]
struct Collect {
    path: Vec<String>,
    tensors: BTreeMap<String, (Vec<usize>, Vec<u8>)>,
}

impl ModuleVisitor for Collect {
    fn enter_module(&mut self, name: &str, _: &str) {
        if is_layer(name) {
            self.path.push(name.to_owned());
        }
    }
    fn exit_module(&mut self, name: &str, _: &str) {
        if is_layer(name) {
            self.path.pop();
        }
    }
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let data = param.val().into_data();
        let bytes = data.iter::<f32>().flat_map(f32::to_le_bytes).collect();
        self.tensors
            .insert(self.path.join("."), (param.val().dims().to_vec(), bytes));
    }
}

struct Apply {
    path: Vec<String>,
    tensors: BTreeMap<String, TensorData>,
    problem: Option<String>,
}

impl ModuleMapper for Apply {
    fn enter_module(&mut self, name: &str, _: &str) {
        if is_layer(name) {
            self.path.push(name.to_owned());
        }
    }
    fn exit_module(&mut self, name: &str, _: &str) {
        if is_layer(name) {
            self.path.pop();
        }
    }
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let name = self.path.join(".");
        let expected = param.val().dims().to_vec();
        match self.tensors.remove(&name) {
            Some(data) if data.shape().to_vec() == expected => {
                let device = param.val().device();
                let id = param.id;
                param.transform_for_load(Tensor::from_data(data, &device), id)
            }
            Some(data) => {
                self.problem = Some(format!(
                    "{name} has shape {:?}, expected {expected:?}",
                    data.shape()
                ));
                param
            }
            None => {
                self.problem = Some(format!("{name} is missing"));
                param
            }
        }
    }
}
