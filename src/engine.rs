//! `MODEL`: a file or a shipped name becomes a disparity engine.

use std::path::Path;

use anyhow::{Context, Result, bail};
use barchan_infer::{
    BlockMatching, BurnEngine, Contract, DisparityEngine, InferError, OnnxEngine, Outlined,
    Outlines, Runtime, SecondOpinion, SemiGlobal, Threaded,
};
use barchan_model::{Device, StereoNet, onnx, weights};
use barchan_train::RunDir;

/// Weights that are part of this program.
const SHIPPED: [(&str, &[u8]); 2] = [
    ("rover", include_bytes!("../checkpoints/rover.safetensors")),
    ("tiny", include_bytes!("../checkpoints/tiny.safetensors")),
];

/// Where no `--model` is given: real time on two cores where ONNX Runtime is installed.
pub const DEFAULT_MODEL: &str = "rover";

/// What `--outlines` is where pairs come as a stream.
pub const STREAM_OUTLINES: usize = 1;

/// How engines run; flags that all commands with `--model` share.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct EngineSettings {
    /// Threads that work on one image; 0 leaves it to the engine
    #[arg(long, default_value_t = 0)]
    pub threads: usize,
    /// How often the outlines of a network's disparity are moved to where the images have them; each time
    /// by up to ten pixels. 0 leaves the network's answer as it is [default: 2; 1 where pairs come as a stream]
    #[arg(long, value_name = "PASSES")]
    pub outlines: Option<usize>,
    /// Where else outlines get surfaces from that the network missed: semi-global matching, of the whole images or of
    /// half their size [default: full; half where pairs come as a stream]
    #[arg(long, value_enum, value_name = "SIZE")]
    pub second_opinion: Option<OpinionSize>,
    /// Whether other work goes on meanwhile
    #[arg(skip)]
    pub beside_other_work: bool,
}

/// `--second-opinion`.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
pub enum OpinionSize {
    Full,
    Half,
    None,
}

impl EngineSettings {
    /// These, for pairs that come as a stream: what was not asked for is what is fast.
    pub fn streaming(self) -> Self {
        Self {
            outlines: self.outlines.or(Some(STREAM_OUTLINES)),
            second_opinion: self.second_opinion.or(Some(OpinionSize::Half)),
            ..self
        }
    }

    /// These, beside other work, which then does not wait for them.
    pub fn beside_other_work(self) -> Self {
        Self {
            beside_other_work: true,
            ..self
        }
    }
}

/// The network of a shipped name, a safetensors file, or a run directory of `barchan train`; with
/// `:192` after it, searching 192 disparities.
pub fn load_net(model: &str, device: &Device) -> Result<StereoNet> {
    if let Some((name, range)) = model.rsplit_once(':')
        && let Ok(range) = range.parse()
        && !Path::new(model).exists()
    {
        let net = load_net(name, device)?.with_max_disparity(range);
        return net.with_context(|| model.to_owned());
    }
    if let Some((name, bytes)) = SHIPPED.iter().find(|(name, _)| *name == model) {
        return Ok(weights::from_bytes(bytes, Path::new(name), device)?);
    }
    let path = RunDir::weights_of(Path::new(model));
    if path.extension().is_some_and(|e| e == "onnx") {
        bail!(
            "{model}: an ONNX file cannot be trained or exported again\n  cure: give the run directory or the .safetensors it came from"
        );
    }
    if !path.is_file() {
        bail!(
            "{}: no such weights\n  cure: give a run of `barchan train`, a .safetensors file, or one of: {}",
            path.display(),
            names()
        );
    }
    Ok(weights::load(&path, device)?)
}

/// The engine for a model: ONNX Runtime for `x.onnx`, and for shipped names where it is installed, which is
/// several times as fast; Burn for weights, and for shipped names elsewhere; `sgm` and `bm` without any
/// network; `rover:192` and `sgm:192` search 192 disparities.
///
/// Outlines of our own networks are sharpened; other people's and the classical matchers' are theirs.
pub fn load_engine(
    model: &str,
    runtime: Option<&Path>,
    settings: &EngineSettings,
) -> Result<Box<dyn DisparityEngine>> {
    let engine = load_unlimited(model, runtime, settings)?;
    if settings.threads == 0 && !settings.beside_other_work {
        return Ok(engine);
    }
    Ok(Box::new(Threaded::new(engine, settings.threads)?))
}

/// [`load_engine`], where all but ONNX Runtime takes as many threads as there are.
fn load_unlimited(
    model: &str,
    runtime: Option<&Path>,
    settings: &EngineSettings,
) -> Result<Box<dyn DisparityEngine>> {
    if let Some(engine) = classical(model)? {
        return Ok(engine);
    }
    let threads = settings.threads;
    let load_runtime = || {
        let runtime = Runtime::load(runtime)?;
        Ok::<_, InferError>(match settings.beside_other_work {
            true => runtime.beside_other_work(),
            false => runtime,
        })
    };
    let outlined = |engine: Box<dyn DisparityEngine>| -> Box<dyn DisparityEngine> {
        let opinion = match settings.second_opinion {
            None | Some(OpinionSize::Full) => SecondOpinion::Full,
            Some(OpinionSize::Half) => SecondOpinion::Half,
            Some(OpinionSize::None) => SecondOpinion::None,
        };
        let outlines =
            (settings.outlines).map_or_else(Outlines::default, |passes| Outlines { passes });
        match outlines.passes {
            0 => engine,
            _ => Box::new(Outlined::new(engine, outlines, opinion)),
        }
    };
    let path = Path::new(model);
    if path.extension().is_some_and(|e| e == "onnx") {
        // A missing file is the more likely mistake, and the cheaper to find.
        std::fs::metadata(path).with_context(|| format!("{model}: no such model"))?;
        let runtime = load_runtime()?;
        let engine = OnnxEngine::load(&runtime, path, threads)?;
        let own = *engine.contract() == Contract::own();
        let engine = Box::new(engine);
        return Ok(if own { outlined(engine) } else { engine });
    }
    let device = Device::flex();
    let net = load_net(model, &device)?;
    let shipped = SHIPPED
        .iter()
        .any(|(name, _)| model.split(':').next() == Some(name));
    if shipped && (runtime.is_some() || Runtime::find(None).is_ok()) {
        let runtime = load_runtime()?;
        let bytes = onnx::to_bytes(&net);
        let engine = OnnxEngine::of_export(&runtime, bytes, model, threads)?;
        return Ok(outlined(Box::new(engine)));
    }
    Ok(outlined(Box::new(BurnEngine::new(net, device, model))))
}

/// The matcher without a network that `model` names, if it does.
fn classical(model: &str) -> Result<Option<Box<dyn DisparityEngine>>> {
    let (name, range) = match model.split_once(':') {
        Some((name, range)) => (name, Some(range)),
        None => (model, None),
    };
    if !["sgm", "bm"].contains(&name) {
        return Ok(None);
    }
    let range = range
        .map(|text| {
            text.parse()
                .ok()
                .filter(|range| (1..=2048).contains(range))
                .with_context(|| {
                    format!("{model}: \"{text}\" is no number of disparities, 1 to 2048")
                })
        })
        .transpose()?;
    Ok(Some(if name == "sgm" {
        Box::new(SemiGlobal::new(range))
    } else {
        Box::new(BlockMatching::new(range))
    }))
}

/// Shipped names, for messages.
pub fn names() -> String {
    SHIPPED.map(|(name, _)| name).join(", ")
}
