//! What a probe says.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::InferError;
use crate::onnxruntime::{Contract, Unit};

/// What a probe found.
#[derive(Clone, Debug, Serialize)]
pub struct Verdict {
    /// How the model wants its images and what its output means.
    pub contract: Contract,
    /// Width and height that the model was given.
    pub size: [usize; 2],
    /// Ways of feeding it that were tried, and how many of them it ran with.
    pub tried: [usize; 2],
    /// Mean absolute error over the pairs, pixels of their images; each pixel's is cut at a fortieth of
    /// the width.
    pub error: f64,
    /// The same error of an answer that sees no image.
    pub blind_error: f64,
    /// Correlation of the output with the true disparity, along the sign that was found.
    pub correlation: f64,
    /// By how much the answer moves, in pixels, for each pixel that the right image is moved.
    pub response: f64,
    /// The factor that was measured, before it was taken for a usual one.
    pub measured_factor: f64,
    /// What was decided, and what else could have been.
    pub decisions: Vec<Decision>,
    /// All of this in plain words.
    pub explanation: Vec<String>,
}

/// One question about the inputs.
#[derive(Clone, Debug, Serialize)]
pub struct Decision {
    /// What is asked.
    pub question: &'static str,
    /// What was found.
    pub answer: String,
    /// The next best answer.
    pub alternative: Option<String>,
    /// Its error, pixels; absent where the model does not run with it.
    pub alternative_error: Option<f64>,
    /// Whether the two differ; if not, the usual one is taken.
    pub decided: bool,
}

impl Verdict {
    /// Writes `x.toml` beside `x.onnx`, whole or not at all, and says where.
    ///
    /// # Errors
    /// When it cannot be written, or something else has that name.
    pub fn save(&self, onnx: &Path) -> Result<PathBuf, InferError> {
        let path = Contract::path_beside(onnx);
        self.contract.save(&path, &self.explanation)?;
        Ok(path)
    }
}

/// The verdict in plain words.
pub(super) fn explain(verdict: &Verdict, pairs: usize, own: bool) -> Vec<String> {
    let Verdict { contract, size, .. } = verdict;
    let mut lines = vec![format!(
        "{} ways of feeding it were tried on {pairs} rendered pairs of known disparity, {} x {} to the model; it ran with {}.",
        verdict.tried[0], size[0], size[1], verdict.tried[1]
    )];
    lines.push(format!(
        "It errs by {:.2} px, an answer without images by {:.2} px; correlation with the truth {:.3}; a right image moved by 1 px moves the answer by {:.2} px.",
        verdict.error, verdict.blind_error, verdict.correlation, verdict.response
    ));
    if own {
        lines.push("It is an export of barchan: confidence and sigma are its own.".into());
    }
    for d in &verdict.decisions {
        let beside = match (&d.alternative, d.alternative_error) {
            (Some(other), Some(error)) if d.decided => {
                format!("{error:.2} px with the next best, {other}")
            }
            (Some(other), Some(error)) => {
                format!("{other} makes no difference ({error:.2} px): the usual is taken")
            }
            (Some(other), None) => format!("the model does not run with {other}"),
            (None, _) if own => "as every export of barchan".into(),
            (None, _) => "the shapes of the inputs say so".into(),
        };
        lines.push(format!("{}: {}; {beside}", d.question, d.answer));
    }
    let free = |side: Option<usize>| side.map_or("any".into(), |s| s.to_string());
    let s = &contract.size;
    lines.push(if let (Some(width), Some(height)) = (s.width, s.height) {
        format!("size: {width} x {height} only; images are resized to it and disparities back")
    } else {
        format!(
            "size: {} x {}, padded to multiples of {}, at least {}; {}",
            free(s.width),
            free(s.height),
            s.multiple,
            s.at_least,
            if s.batch {
                "several pairs at once"
            } else {
                "one pair at a time"
            }
        )
    });
    let o = &contract.output;
    lines.push(format!(
        "output: \"{}\", axes {}, channel {}; disparity in {} is {} times the value (measured {:.4} to the pixel)",
        o.name,
        o.layout.letters(),
        o.channel,
        match o.unit {
            Unit::Pixels => "pixels",
            Unit::Width => "widths of the image",
        },
        o.factor,
        verdict.measured_factor
    ));
    lines
}
