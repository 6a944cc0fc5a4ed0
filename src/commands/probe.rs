use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use barchan_infer::{Runtime, Verdict, probe};
use clap::Parser;
use serde::Serialize;

use crate::output::Output;

/// Find out how somebody else's stereo ONNX wants its images and what its output means
#[derive(Parser)]
#[command(
    long_about = "Find out how somebody else's stereo ONNX wants its images and what its output means.\n\n\
        The model is run on rendered pairs of known disparity in every way that the shapes of its inputs \
        allow; the one that errs least is written to x.toml beside x.onnx, which `--model x.onnx` then \
        reads everywhere.",
    after_help = "Examples:\n  \
        barchan probe hitnet.onnx\n  \
        barchan probe crestereo.onnx --json\n  \
        barchan infer --data DATA --model hitnet.onnx --out out"
)]
pub struct Args {
    /// The ONNX file
    model: PathBuf,
    /// Threads that work on one image; 0 leaves it to ONNX Runtime
    #[arg(long, value_name = "N", default_value_t = 0)]
    threads: usize,
}

#[derive(Serialize)]
struct Summary {
    onnx: PathBuf,
    toml: PathBuf,
    #[serde(flatten)]
    verdict: Verdict,
}

pub fn run(args: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    if args.model.extension().is_none_or(|e| e != "onnx") {
        bail!(
            "{}: the model to probe must end in .onnx",
            args.model.display()
        );
    }
    let runtime = Runtime::load(runtime)?;
    let bar = output.progress("ways of feeding it", 0);
    let verdict = probe(&runtime, &args.model, args.threads, &mut |tried, of| {
        bar.set_length(of as u64);
        bar.set_position(tried as u64);
    });
    bar.finish_and_clear();
    let verdict = verdict?;
    let toml = verdict.save(&args.model)?;
    let text = format!(
        "{}\n{}: written",
        verdict.explanation.join("\n"),
        toml.display()
    );
    output.result(
        &Summary {
            onnx: args.model,
            toml,
            verdict,
        },
        &text,
    )
}
