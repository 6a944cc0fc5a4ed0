use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use barchan_datasets::{StereoSource, prefetch};
use barchan_infer::{QuantizeOptions, Quantized, Runtime, quantize};
use barchan_model::{Device, onnx, weights};
use clap::Parser;
use serde::Serialize;

use crate::data::{Unchecked, open_checked};
use crate::engine::load_net;
use crate::output::Output;

/// What int8 is calibrated on when no data are given: a rendered traverse.
const CALIBRATION: &str = "synth:seed=7,frames=64";

/// Write a trained network as ONNX, for any image size
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan export runs/a --out a.onnx\n  \
    barchan export tiny --out tiny.onnx     the shipped weights\n  \
    barchan export tiny --int8 --out tiny8.onnx     convolutions in 8 bits, ranges from rendered pairs\n  \
    barchan export runs/a --int8 --calibrate images/ --out a8.onnx     ranges from your images")]
pub struct Args {
    /// A run of `barchan train`, a .safetensors file, or a shipped name
    model: String,
    /// The ONNX file that is written
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Run convolutions in 8 bits where that is faster; needs ONNX Runtime
    #[arg(long)]
    int8: bool,
    /// Stereo pairs that set the ranges of int8: PATH or FORMAT:PATH [default: a rendered traverse]
    #[arg(long, value_name = "DATA", requires = "int8")]
    calibrate: Option<String>,
    /// How many pairs of them, spread evenly
    #[arg(long, value_name = "N", default_value_t = 16, requires = "int8",
        value_parser = clap::value_parser!(u32).range(1..))]
    calibrate_frames: u32,
    #[command(flatten)]
    unchecked: Unchecked,
}

#[derive(Serialize)]
struct Summary {
    onnx: PathBuf,
    bytes: u64,
    max_disparity: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    int8: Option<Int8>,
}

/// What was quantised.
#[derive(Serialize)]
struct Int8 {
    calibration: String,
    pairs: usize,
    convolutions: Vec<String>,
    convolutions_in_float: usize,
}

pub fn run(args: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    if args.out.extension().is_none_or(|e| e != "onnx") {
        bail!(
            "{}: the file to write must end in .onnx",
            args.out.display()
        );
    }
    let net = load_net(&args.model, &Device::flex())?;
    let max_disparity = net.config().max_disparity;
    let mut file = onnx::to_bytes(&net);
    let mut int8 = None;
    if args.int8 {
        let calibration = args.calibrate.as_deref().unwrap_or(CALIBRATION);
        let quantized = to_int8(&file, calibration, &args, output, runtime)
            .with_context(|| format!("{}: not written", args.out.display()))?;
        int8 = Some(Int8 {
            calibration: calibration.to_owned(),
            pairs: quantized.pairs,
            convolutions: quantized.int8,
            convolutions_in_float: quantized.float.len(),
        });
        file = quantized.onnx;
    }
    weights::write_atomically(&args.out, &file)?;
    let mut text = format!(
        "{}: {} kB; inputs left, right [B,3,H,W] in 0..1; outputs disparity, confidence, sigma [B,1,H,W]; disparities 0 to {}",
        args.out.display(),
        file.len() / 1000,
        max_disparity
    );
    if let Some(int8) = &int8 {
        text += &format!(
            "\nint8: {} convolutions, {} stay float; ranges from {} pairs of {}",
            int8.convolutions.len(),
            int8.convolutions_in_float,
            int8.pairs,
            int8.calibration
        );
    }
    output.result(
        &Summary {
            onnx: args.out,
            bytes: file.len() as u64,
            max_disparity,
            int8,
        },
        &text,
    )
}

/// The network in int8, its ranges from pairs spread evenly over `calibration`.
fn to_int8(
    file: &[u8],
    calibration: &str,
    args: &Args,
    output: &Output,
    runtime: Option<&Path>,
) -> Result<Quantized> {
    let runtime = Runtime::load(runtime)?;
    let source: Arc<dyn StereoSource> = open_checked(calibration, &args.unchecked, output)?.into();
    let count = (args.calibrate_frames as usize).min(source.len());
    let order = (0..count).map(|i| i * source.len() / count).collect();
    let bar = output.progress("calibrate", count);
    let pairs = prefetch(source, order, 2).inspect(|_| bar.inc(1));
    let quantized = quantize(file, &runtime, pairs, &QuantizeOptions::default());
    bar.finish_and_clear();
    quantized.with_context(|| format!("int8, calibrated on {calibration}"))
}
