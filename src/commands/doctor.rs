use std::path::Path;

use anyhow::Result;
use barchan_infer::{BurnEngine, DisparityEngine, Runtime};
use barchan_model::Device;
use barchan_train::DeviceName;
use clap::Parser;
use serde::Serialize;

use crate::engine::{DEFAULT_MODEL, load_net};
use crate::output::Output;

/// Say what is installed, what works, and how to get the rest
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan doctor\n  \
    barchan doctor --onnxruntime /opt/onnxruntime/libonnxruntime.so --json")]
pub struct Args {}

#[derive(Serialize)]
struct Check {
    name: String,
    works: bool,
    detail: String,
}

pub fn run(_: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    let check = |name: &str, result: Result<String>| Check {
        name: name.to_owned(),
        works: result.is_ok(),
        detail: result.unwrap_or_else(|e| format!("{e:#}")),
    };
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut checks = vec![
        check("processor", Ok(format!("{cores} cores"))),
        check("shipped weights with Burn", try_shipped()),
        check(
            "ONNX Runtime",
            Runtime::load(runtime)
                .map(|r| r.path().display().to_string())
                .map_err(Into::into),
        ),
    ];
    checks.extend(DeviceName::ALL.map(|device| {
        check(
            &format!("train --device {}", device.name()),
            device
                .device()
                .map(|d| format!("{d:?}"))
                .map_err(Into::into),
        )
    }));
    let text: String = checks
        .iter()
        .map(|c| {
            format!(
                "{:<26} {:<4} {}\n",
                c.name,
                if c.works { "ok" } else { "no" },
                c.detail
            )
        })
        .collect();
    output.result(&checks, &text)
}

/// Runs the shipped network on a small grey pair.
fn try_shipped() -> Result<String> {
    let device = Device::flex();
    let mut engine = BurnEngine::new(load_net(DEFAULT_MODEL, &device)?, device, DEFAULT_MODEL);
    let grey = barchan_datasets::Rgb::from_pixel(64, 48, image::Rgb([0.5; 3]));
    engine.disparity(&grey, &grey)?;
    Ok(DEFAULT_MODEL.into())
}
