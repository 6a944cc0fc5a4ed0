mod loss_args;

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use barchan_datasets::StereoSource;
use barchan_model::{NetConfig, Preset, StereoNet};
use barchan_train::{Augmentation, DeviceName, RunDir, Schedule, TrainConfig, Trainer};
use clap::{Parser, ValueEnum};
use serde::Serialize;

use crate::data::{Unchecked, open_checked};
use crate::engine::load_net;
use crate::output::Output;
use loss_args::LossArgs;

/// Train the stereo network on images alone
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan train --data images/ --epochs 1 --finetune --out runs/a     adapt the shipped weights to your images\n  \
    barchan train --data synth:seed=2,frames=500 --supervised --out runs/b     from nothing, on renders with truth\n  \
    barchan train --resume runs/b     go on after a stop")]
pub struct Args {
    /// Stereo pairs: PATH or FORMAT:PATH; may be given again [default: synth:seed=1,frames=200]
    #[arg(long)]
    data: Vec<String>,
    /// Passes over the data [default: 10, or 1 with --finetune]
    #[arg(long)]
    epochs: Option<usize>,
    /// Start from the preset's shipped weights, at the fine-tuning rate
    #[arg(long)]
    finetune: bool,
    /// Learn from true disparity where the data has it, instead of from the images alone
    #[arg(long)]
    supervised: bool,
    /// Start from these weights: a run, a .safetensors file or a shipped name
    #[arg(long, value_name = "MODEL")]
    init: Option<String>,
    /// Which network
    #[arg(long, value_enum, default_value = "tiny")]
    preset: PresetArg,
    /// Where to compute
    #[arg(long, value_enum, default_value = "flex")]
    device: DeviceArg,
    /// The run directory that is written [default: runs/train]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Go on with this run from its last checkpoint; its own configuration holds
    #[arg(long, value_name = "DIR", conflicts_with_all = ["data", "init", "out", "finetune", "supervised"])]
    resume: Option<PathBuf>,
    /// Stop after this many steps
    #[arg(long)]
    steps: Option<usize>,
    /// Pairs a step
    #[arg(long, default_value_t = 1)]
    batch: usize,
    /// Height and width of the crops, pixels; larger crops than the images shrink to them
    #[arg(long, value_names = ["H", "W"], num_args = 2, default_values_t = [192, 320])]
    crop: Vec<usize>,
    /// Learning rate [default: 1e-3, or 1e-4 with --finetune]
    #[arg(long)]
    lr: Option<f64>,
    /// The learning rate is divided by ten from this epoch on [default: 7, or never with --finetune]
    #[arg(long)]
    drop_epoch: Option<usize>,
    /// Seeds the network, the order of the frames, crops and augmentation
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Steps between checkpoints
    #[arg(long, default_value_t = 100)]
    checkpoint_every: usize,
    /// Largest disparity searched, pixels, a multiple of 16 [default: the preset's]
    #[arg(long)]
    max_disparity: Option<usize>,
    /// Augmentation: standard deviation of the noise
    #[arg(long, default_value_t = Augmentation::default().noise)]
    noise: f32,
    /// Augmentation: largest change of brightness
    #[arg(long, default_value_t = Augmentation::default().brightness)]
    brightness: f32,
    /// Augmentation: largest relative change of contrast
    #[arg(long, default_value_t = Augmentation::default().contrast)]
    contrast: f32,
    /// Augmentation: largest shift of a colour channel
    #[arg(long, default_value_t = Augmentation::default().channel)]
    channel: f32,
    /// Augmentation: most pixels that are added to every disparity [default: 48 with --supervised, else 0]
    #[arg(long)]
    add_disparity: Option<usize>,
    #[command(flatten)]
    unchecked: Unchecked,
    #[command(flatten)]
    loss: LossArgs,
}

#[derive(Clone, Copy, ValueEnum)]
enum PresetArg {
    /// Trains on a laptop in minutes
    Tiny,
    /// Real time on two CPU cores
    Rover,
    /// The network of Hong 2021, with 3-D convolutions: accuracy first
    Paper,
}

impl From<PresetArg> for Preset {
    fn from(preset: PresetArg) -> Self {
        match preset {
            PresetArg::Tiny => Self::Tiny,
            PresetArg::Rover => Self::Rover,
            PresetArg::Paper => Self::Paper,
        }
    }
}

#[derive(Clone, Copy, ValueEnum)]
enum DeviceArg {
    /// CPU, Burn's own kernels
    Flex,
    /// CPU, the ndarray crate: slower, a second opinion
    Ndarray,
}

/// `summary.json` of a run.
#[derive(Serialize)]
struct Summary {
    steps: usize,
    held_out: usize,
    photometric_before: f32,
    photometric_after: f32,
    seconds_per_step: f64,
    weights: PathBuf,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    let (mut trainer, root, fresh) = match &args.resume {
        Some(root) => (resume(root, &args.unchecked, output)?, root.clone(), false),
        None => {
            let root = args.out.clone().unwrap_or_else(|| "runs/train".into());
            (create(&args, &root, output)?, root, true)
        }
    };
    let (done, total) = trainer.progress();
    let bar = output.progress("train", total);
    bar.set_position(done as u64);
    let (mut seconds, mut steps) = (0.0, 0);
    let outcome = trainer.run(|line| {
        seconds += line.seconds;
        steps += 1;
        bar.set_message(format!(
            "loss {:.4}  {:.2} s/step",
            line.loss,
            seconds / steps as f64
        ));
        bar.inc(1);
        if bar.is_hidden() && (line.step.is_multiple_of(50) || line.step == total) {
            output.say(&format!(
                "step {}/{total}  loss {:.4}  {:.2} s/step  {}",
                line.step,
                line.loss,
                seconds / steps as f64,
                line.terms
            ));
        }
    });
    bar.finish_and_clear();
    let (before, after) = match outcome {
        Ok(both) => both,
        Err(error) => {
            if fresh && RunDir::is_without_checkpoint(&root) {
                // Nothing to go on from: leave no half of a run.
                let _ = std::fs::remove_dir_all(&root);
            }
            return Err(error.into());
        }
    };
    let summary = Summary {
        steps: total,
        held_out: after.frames,
        photometric_before: before.photometric,
        photometric_after: after.photometric,
        seconds_per_step: seconds / steps.max(1) as f64,
        weights: RunDir::weights_of(&root),
    };
    trainer.run_dir().summary(&summary)?;
    output.result(
        &summary,
        &format!(
            "held-out photometric loss over {} pairs: {:.4} before, {:.4} after {} steps\nweights: {}",
            after.frames,
            before.photometric,
            after.photometric,
            total,
            summary.weights.display()
        ),
    )
}

fn create(args: &Args, root: &Path, output: &Output) -> Result<Trainer> {
    let data = if args.data.is_empty() {
        vec!["synth:seed=1,frames=200".to_owned()]
    } else {
        args.data.clone()
    };
    let sources = open_all(&data, &args.unchecked, output)?;
    let preset = Preset::from(args.preset);
    let init = match (&args.init, args.finetune) {
        (Some(init), _) => Some(init.clone()),
        (None, true) => Some(preset.name().to_owned()),
        (None, false) => None,
    };
    let schedule = if args.finetune {
        Schedule::FINETUNE
    } else {
        Schedule::PRETRAIN
    };
    let device = match args.device {
        DeviceArg::Flex => DeviceName::Flex,
        DeviceArg::Ndarray => DeviceName::Ndarray,
    };
    let mut config = TrainConfig {
        data,
        init,
        device,
        seed: args.seed,
        supervised: args.supervised,
        batch: args.batch,
        crop: [args.crop[0], args.crop[1]],
        checkpoint_every: args.checkpoint_every,
        net: preset.config(),
        schedule: Schedule {
            epochs: args.epochs.unwrap_or(schedule.epochs),
            lr: args.lr.unwrap_or(schedule.lr),
            drop_epoch: args.drop_epoch.unwrap_or(schedule.drop_epoch),
            steps: args.steps,
        },
        loss: args.loss.loss(),
        augmentation: Augmentation {
            noise: args.noise,
            brightness: args.brightness,
            contrast: args.contrast,
            channel: args.channel,
            disparity: args
                .add_disparity
                .unwrap_or(if args.supervised { 48 } else { 0 }),
        },
    };
    let net = initial_net(&mut config, args.max_disparity)?;
    Ok(Trainer::create(root, config, sources, net)?)
}

fn resume(root: &Path, unchecked: &Unchecked, output: &Output) -> Result<Trainer> {
    let (_, mut config) = RunDir::open(root)?;
    let sources = open_all(&config.data, unchecked, output)?;
    let range = config.net.max_disparity;
    let net = initial_net(&mut config, Some(range))?;
    Ok(Trainer::resume(root, sources, net)?)
}

/// The network started from, if not a random one; the configuration takes its shape.
fn initial_net(
    config: &mut TrainConfig,
    max_disparity: Option<usize>,
) -> Result<Option<StereoNet>> {
    let net = match &config.init {
        Some(init) => Some(load_net(init, &config.device.device().autodiff())?),
        None => None,
    };
    if let Some(net) = &net {
        config.net = net.config().clone();
    }
    if let Some(max_disparity) = max_disparity {
        config.net = NetConfig {
            max_disparity,
            ..config.net.clone()
        };
    }
    Ok(net
        .map(|net| net.with_max_disparity(config.net.max_disparity))
        .transpose()?)
}

fn open_all(
    data: &[String],
    unchecked: &Unchecked,
    output: &Output,
) -> Result<Vec<Box<dyn StereoSource>>> {
    let sources: Vec<_> = data
        .iter()
        .map(|spec| open_checked(spec, unchecked, output))
        .collect::<Result<_>>()?;
    if sources.iter().all(|s| s.is_empty()) {
        bail!("{}: no frames", data.join(", "));
    }
    Ok(sources)
}
