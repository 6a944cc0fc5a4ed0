use std::path::PathBuf;

use anyhow::{Result, bail};
use barchan_model::{Device, onnx};
use clap::Parser;
use serde::Serialize;

use crate::engine::load_net;
use crate::output::Output;

/// Write a trained network as ONNX, for any image size
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan export runs/a --out a.onnx\n  \
    barchan export tiny --out tiny.onnx     the shipped weights")]
pub struct Args {
    /// A run of `barchan train`, a .safetensors file, or a shipped name
    model: String,
    /// The ONNX file that is written
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

#[derive(Serialize)]
struct Summary {
    onnx: PathBuf,
    bytes: u64,
    max_disparity: usize,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    if args.out.extension().is_none_or(|e| e != "onnx") {
        bail!(
            "{}: the file to write must end in .onnx",
            args.out.display()
        );
    }
    let net = load_net(&args.model, &Device::flex())?;
    onnx::save(&net, &args.out)?;
    let bytes = std::fs::metadata(&args.out)?.len();
    let max_disparity = net.config().max_disparity;
    let text = format!(
        "{}: {} kB; inputs left, right [B,3,H,W] in 0..1; outputs disparity, confidence, sigma [B,1,H,W]; disparities 0 to {}",
        args.out.display(),
        bytes / 1000,
        max_disparity
    );
    output.result(
        &Summary {
            onnx: args.out,
            bytes,
            max_disparity,
        },
        &text,
    )
}
