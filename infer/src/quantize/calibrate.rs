//! Runs the float network on calibration pairs and looks at its activations.

use barchan_datasets::{DataError, StereoFrame, planar};
use barchan_onnx::Message;
use barchan_onnx::proto::{Model, ValueInfo};
use ort::session::{OutputSelector, RunOptions, Session};
use ort::value::TensorRef;

use super::QuantizeError;
use super::plan::Plan;
use super::range::{Affine, Histogram};
use crate::engine::check_sizes;
use crate::{InferError, Runtime};

/// Activations looked at in one run: bounds the memory that their copies take.
const AT_ONCE: usize = 16;

/// The levels of every range of `plan`, and how many pairs they come from. One pass over the pairs;
/// of each pair, [`AT_ONCE`] activations are held at a time.
pub(super) fn calibrate(
    model: &Model,
    plan: &Plan,
    runtime: &Runtime,
    pairs: impl IntoIterator<Item = Result<StereoFrame, DataError>>,
    percentile: f64,
) -> Result<(Vec<Affine>, usize), QuantizeError> {
    // Inputs are at hand; of the rest every one becomes an output.
    let (inputs, inner): (Vec<_>, Vec<_>) =
        (plan.activations.iter()).partition(|(name, _)| ["left", "right"].contains(&name.as_str()));
    let mut tapped = model.clone();
    if let Some(graph) = &mut tapped.graph {
        graph.output.extend(
            inner
                .iter()
                .map(|(name, _)| ValueInfo::float_of_any_shape(name)),
        );
    }
    let mut session = Session::builder(&runtime.environment)
        .and_then(|mut builder| builder.commit_from_memory(&tapped.encode_to_vec()))
        .map_err(failed)?;
    drop(tapped);

    let mut histograms: Vec<Histogram> = (0..plan.ranges).map(|_| Histogram::default()).collect();
    let mut count = 0;
    for frame in pairs {
        let frame = frame?;
        check_sizes(&frame.left, &frame.right)?;
        let size = [frame.left.width() as usize, frame.left.height() as usize];
        let shape = [1, 3, size[1], size[0]];
        let [left, right] = [&frame.left, &frame.right].map(|image| planar(image, [0, 0], size));
        let mut look = |(name, range): &(String, usize), values: &[f32]| {
            if histograms[*range].add(values) {
                Ok(())
            } else {
                Err(QuantizeError::NotFinite {
                    activation: name.clone(),
                    frame: frame.name.clone(),
                })
            }
        };
        for activation in &inputs {
            look(
                activation,
                if activation.0 == "left" {
                    &left
                } else {
                    &right
                },
            )?;
        }
        for chunk in inner.chunks(AT_ONCE) {
            let wanted = (chunk.iter()).fold(OutputSelector::no_default(), |wanted, (name, _)| {
                wanted.with(name)
            });
            let options = RunOptions::new().map_err(failed)?.with_outputs(wanted);
            let tensor = |data| TensorRef::from_array_view((shape, data)).map_err(failed);
            let images =
                ort::inputs! { "left" => tensor(&left[..])?, "right" => tensor(&right[..])? };
            let outputs = session.run_with_options(images, &options).map_err(failed)?;
            for activation in chunk {
                let (_, values) = outputs[activation.0.as_str()]
                    .try_extract_tensor::<f32>()
                    .map_err(failed)?;
                look(activation, values)?;
            }
        }
        count += 1;
    }
    if count == 0 {
        return Err(QuantizeError::NoPairs);
    }
    Ok((
        histograms.iter().map(|h| h.affine(percentile)).collect(),
        count,
    ))
}

fn failed<T>(error: ort::Error<T>) -> QuantizeError {
    QuantizeError::Engine(InferError::Failed {
        engine: "onnxruntime, for calibration".into(),
        message: error.to_string(),
    })
}
