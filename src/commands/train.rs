mod live;
mod loss_args;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result, bail};
use barchan_datasets::StereoSource;
use barchan_model::{NetConfig, Preset, StereoNet};
use barchan_train::{
    DeviceName, Ended, Explained, LogLine, Observer, RunDir, Schedule, Scored, TrainConfig,
    TrainError, Trainer,
};
use clap::{Parser, ValueEnum};
use serde::Serialize;
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

use crate::data::{Unchecked, open_checked};
use crate::engine::load_net;
use crate::output::Output;
use crate::preview::{explained_sheet, png};
use live::Live;
use loss_args::LossArgs;

/// Exit status after Ctrl-C, as shells have it: scripts that go on after success stop here.
pub const INTERRUPTED: u8 = 130;

/// Disparity that augmentation adds in supervised training, pixels.
const SUPERVISED_DISPARITY: usize = 48;

/// Train the stereo network on images alone
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan train --data images/ --epochs 1 --finetune --out runs/a     adapt the shipped weights to your images\n  \
    barchan train --data synth:seed=2,frames=500 --supervised --out runs/b     from nothing, on renders with truth\n  \
    barchan train --config runs/b/config.toml --lr 5e-4 --out runs/c     as runs/b, but slower\n  \
    barchan train --resume runs/b     go on after a stop\n\n\
    Ctrl-C (or SIGTERM) ends the running step, saves a checkpoint and exits with status 130; a second one exits at \
    once. After that, after kill -9 and after a power cut, --resume gives the weights that an uninterrupted run \
    would have given.")]
pub struct Args {
    /// Go on with this run from its last checkpoint; its own settings hold
    #[arg(long, value_name = "DIR", conflicts_with_all = ["out", "Settings", "LossArgs", "AugmentationArgs"])]
    resume: Option<PathBuf>,
    /// The run directory that is written [default: runs/train]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    settings: Settings,
    #[command(flatten)]
    loss: LossArgs,
    #[command(flatten)]
    augmentation: AugmentationArgs,
    #[command(flatten)]
    unchecked: Unchecked,
}

#[derive(clap::Args)]
struct Settings {
    /// Stereo pairs: PATH or FORMAT:PATH; may be given again [default: synth:seed=1,frames=200]
    #[arg(long)]
    data: Vec<String>,
    /// Start from these settings: the config.toml of a run, or any part of one; other flags come on top
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Any setting by its name in config.toml, such as schedule.lr=2e-4; may be given again
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Passes over the data [default: 10, or 1 with --finetune]
    #[arg(long)]
    epochs: Option<usize>,
    /// Start from the preset's shipped weights, with the paper's rate and crops for fine-tuning
    #[arg(long)]
    finetune: bool,
    /// Learn from true disparity where the data has it, instead of from the images alone
    #[arg(long)]
    supervised: bool,
    /// Start from these weights: a run, a .safetensors file or a shipped name
    #[arg(long, value_name = "MODEL")]
    init: Option<String>,
    /// Which network [default: rover]
    #[arg(long, value_enum)]
    preset: Option<PresetArg>,
    /// Where to compute [default: flex]
    #[arg(long, value_enum)]
    device: Option<DeviceArg>,
    /// Stop after this many steps
    #[arg(long)]
    steps: Option<usize>,
    /// Pairs a step [default: 1]
    #[arg(long)]
    batch: Option<usize>,
    /// Height and width of the crops, pixels; larger crops than the images shrink to them [default: 256 512, or 320 384 with --finetune]
    #[arg(long, value_names = ["H", "W"], num_args = 2)]
    crop: Option<Vec<usize>>,
    /// Learning rate [default: 1e-3, or 1e-4 with --finetune]
    #[arg(long)]
    lr: Option<f64>,
    /// The learning rate is divided by ten from this epoch on [default: 7, or never with --finetune]
    #[arg(long)]
    drop_epoch: Option<usize>,
    /// Let the learning rate fall along half a cosine to a hundredth at the last step, instead of dropping it
    #[arg(long, conflicts_with = "drop_epoch")]
    cosine: bool,
    /// Longest gradient, Euclidean norm over all weights; 0 does not clip [default: 1]
    #[arg(long)]
    clip: Option<f32>,
    /// Decay of a moving average of the weights, which is then validated, saved and exported, such as 0.99; 0 is none [default: 0]
    #[arg(long, value_name = "DECAY")]
    average: Option<f64>,
    /// Seeds the network, the order of the frames, crops and augmentation [default: 1]
    #[arg(long)]
    seed: Option<u64>,
    /// Steps between checkpoints [default: 100]
    #[arg(long)]
    checkpoint_every: Option<usize>,
    /// Steps between looks at the held-out pairs; 0 is after every epoch [default: 0]
    #[arg(long)]
    validate_every: Option<usize>,
    /// Largest disparity searched, pixels, a multiple of 16 [default: the preset's]
    #[arg(long)]
    max_disparity: Option<usize>,
}

#[derive(clap::Args)]
#[command(next_help_heading = "Augmentation")]
struct AugmentationArgs {
    /// Standard deviation of the noise [default: 0.01]
    #[arg(long)]
    noise: Option<f32>,
    /// Largest change of brightness [default: 0.1]
    #[arg(long)]
    brightness: Option<f32>,
    /// Largest relative change of contrast [default: 0.2]
    #[arg(long)]
    contrast: Option<f32>,
    /// Largest shift of a colour channel [default: 0.05]
    #[arg(long)]
    channel: Option<f32>,
    /// Largest standard deviation of a blur, pixels [default: 0]
    #[arg(long)]
    blur: Option<f32>,
    /// Share of the pairs whose two images change each in its own way [default: 0]
    #[arg(long, value_name = "SHARE")]
    asymmetric: Option<f32>,
    /// Share of the pairs that lose patches of the right image; for --supervised [default: 0]
    #[arg(long, value_name = "SHARE")]
    erase: Option<f32>,
    /// Share of the pairs that are turned upside down [default: 0]
    #[arg(long, value_name = "SHARE")]
    flip_vertical: Option<f32>,
    /// Share of the pairs that are mirrored, left and right swapped [default: 0]
    #[arg(long, value_name = "SHARE")]
    flip_swap: Option<f32>,
    /// Most pixels that are added to every disparity [default: 48 with --supervised, else 0]
    #[arg(long)]
    add_disparity: Option<usize>,
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
    /// CPU, libtorch; in builds of `make tch`
    Tch,
    /// A graphics card; in builds with `--features vulkan`
    Vulkan,
}

/// `summary.json` of a run; written at every validation, so that it is there before the end.
#[derive(Serialize)]
struct Summary {
    finished: bool,
    /// Steps done.
    steps: usize,
    held_out: usize,
    photometric_before: f32,
    photometric_after: f32,
    before: Scored,
    /// The last validation, and the best.
    after: Scored,
    best: Scored,
    seconds_per_step: f64,
    weights: PathBuf,
}

/// Trains; `false` when a signal ended it before the last step.
pub fn run(args: Args, output: &Output) -> Result<bool> {
    let (mut trainer, root, fresh) = match &args.resume {
        Some(root) => (resume(root, &args.unchecked, output)?, root.clone(), false),
        None => {
            let root = args.out.clone().unwrap_or_else(|| "runs/train".into());
            (create(&args, &root, output)?, root, true)
        }
    };
    let (done, total) = trainer.progress();
    let mut watch = Watch {
        output,
        live: Live::new(output, [done, total], trainer.before()),
        total,
        run: RunDir::open(&root)?.0,
        before: trainer.before(),
        seconds: 0.0,
        steps: 0,
        stop: stop_at_signal()?,
    };
    let outcome = trainer.run(&mut watch);
    watch.live.finish();
    match outcome {
        Ok(Ended::Finished {
            before,
            after,
            best,
        }) => {
            let summary = watch.summary(before, after, best, true);
            watch.run.summary(&summary)?;
            output.result(&summary, &told(&summary))?;
            Ok(true)
        }
        Ok(Ended::Stopped { step }) => {
            output.notice(&format!(
                "stopped after step {step} of {total}, all saved; `barchan train --resume {}` goes on",
                root.display()
            ));
            Ok(false)
        }
        Err(error) => {
            if fresh && RunDir::is_without_checkpoint(&root) {
                // Nothing to go on from: leave no half of a run.
                RunDir::discard(&root);
            }
            Err(error.into())
        }
    }
}

/// A flag that Ctrl-C and SIGTERM raise; the second signal ends the process.
fn stop_at_signal() -> Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        // In this order: what ends the process must find the flag as the signal before left it.
        flag::register_conditional_shutdown(signal, INTERRUPTED.into(), Arc::clone(&stop))?;
        flag::register(signal, Arc::clone(&stop))?;
    }
    Ok(stop)
}

/// Tells the user, draws pictures, and listens for Ctrl-C.
struct Watch<'a> {
    output: &'a Output,
    live: Live,
    total: usize,
    run: RunDir,
    before: Option<Scored>,
    /// Of the steps made by this process.
    seconds: f64,
    steps: usize,
    stop: Arc<AtomicBool>,
}

impl Watch<'_> {
    fn seconds_per_step(&self) -> f64 {
        self.seconds / self.steps.max(1) as f64
    }

    fn summary(&self, before: Scored, after: Scored, best: Scored, finished: bool) -> Summary {
        Summary {
            finished,
            steps: after.step,
            held_out: after.validation.frames,
            photometric_before: before.validation.photometric,
            photometric_after: after.validation.photometric,
            before,
            after,
            best,
            seconds_per_step: self.seconds_per_step(),
            weights: RunDir::weights_of(self.run.root()),
        }
    }
}

impl Observer for Watch<'_> {
    fn step(&mut self, line: &LogLine) {
        self.seconds += line.seconds + line.waited;
        self.steps += 1;
        self.live.step(line);
        if self.live.is_hidden() && (line.step.is_multiple_of(50) || line.step == self.total) {
            let (step, total, terms) = (line.step, self.total, &line.terms);
            let (loss, seconds) = (line.loss, self.seconds_per_step());
            self.output.say(&format!(
                "step {step}/{total}  loss {loss:.4}  {seconds:.2} s/step  {terms}"
            ));
        }
    }

    fn validated(
        &mut self,
        scored: &Scored,
        best: &Scored,
        pairs: &[Explained],
    ) -> Result<(), TrainError> {
        let before = *self.before.get_or_insert(*scored);
        self.run
            .summary(&self.summary(before, *scored, *best, false))?;
        let sheet = png(&explained_sheet(pairs))
            .map_err(|e| TrainError::Config(format!("samples: {e}")))?;
        self.run
            .sample(&format!("{:08}.png", scored.step), &sheet)?;
        if scored.step > 0 && scored.step < self.total {
            let told = format!("step {}  held-out {}", scored.step, told_of(scored));
            match self.live.is_hidden() {
                true => self.output.say(&told),
                false => self.live.say(&told),
            }
        }
        self.live.validated(scored, best, pairs);
        Ok(())
    }

    fn stop(&mut self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

fn told_of(scored: &Scored) -> String {
    let photometric = format!("photometric loss {:.4}", scored.validation.photometric);
    match scored.validation.accuracy {
        Some(a) => format!(
            "{photometric}, error {:.3} px, {:.1} % off by more than 2 px",
            a.epe, a.bad2
        ),
        None => photometric,
    }
}

fn told(summary: &Summary) -> String {
    format!(
        "held-out pairs ({}) before: {}\nafter {} steps: {}\nbest, after {} steps: {}\nweights: {}\n",
        summary.held_out,
        told_of(&summary.before),
        summary.steps,
        told_of(&summary.after),
        summary.best.step,
        told_of(&summary.best),
        summary.weights.display()
    )
}

fn create(args: &Args, root: &Path, output: &Output) -> Result<Trainer> {
    let mut config = configure(&args.settings, &args.loss, &args.augmentation)?;
    config.check()?;
    config.device.device()?;
    let sources = open_all(&config.data, &args.unchecked, output)?;
    let range = args.settings.max_disparity;
    let net = initial_net(&mut config, range)?;
    Ok(Trainer::create(root, config, sources, net)?)
}

fn resume(root: &Path, unchecked: &Unchecked, output: &Output) -> Result<Trainer> {
    let (_, mut config) = RunDir::open(root)?;
    let sources = open_all(&config.data, unchecked, output)?;
    let range = config.net.max_disparity;
    let net = initial_net(&mut config, Some(range))?;
    Ok(Trainer::resume(root, sources, net)?)
}

/// The network started from, if not a random one; the configuration takes its shape, and it the range
/// that is asked for.
fn initial_net(
    config: &mut TrainConfig,
    max_disparity: Option<usize>,
) -> Result<Option<StereoNet>> {
    let Some(init) = &config.init else {
        return Ok(None);
    };
    let net = load_net(init, &config.device.device()?.autodiff())?;
    config.net = NetConfig {
        max_disparity: max_disparity.unwrap_or(net.config().max_disparity),
        ..net.config().clone()
    };
    Ok(Some(net.with_max_disparity(config.net.max_disparity)?))
}

/// The paper's training, changed by `--config`, by `--set`, by `--preset`, `--finetune` and `--supervised`, and
/// at last by every flag that names one setting.
fn configure(
    args: &Settings,
    loss: &LossArgs,
    augmentation: &AugmentationArgs,
) -> Result<TrainConfig> {
    let mut config = TrainConfig::new(Preset::Rover.config());
    if let Some(path) = &args.config {
        let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
        config = config.overlay(&text, path)?;
    }
    if let Some(preset) = args.preset {
        config.net = Preset::from(preset).config();
    }
    if args.finetune {
        config.schedule = Schedule::FINETUNE;
        config.crop = TrainConfig::FINETUNE_CROP;
        let preset = args.preset.map_or(Preset::Rover, Preset::from);
        config.init = Some(preset.name().to_owned());
    }
    if args.supervised {
        config.supervised = true;
        config.augmentation.disparity = SUPERVISED_DISPARITY;
    }
    for setting in &args.set {
        let Some((key, value)) = setting.split_once('=') else {
            bail!("--set {setting}: KEY=VALUE is wanted, such as --set schedule.lr=2e-4");
        };
        // A word is text, as nobody quotes twice on a command line.
        let quoted = format!("{key} = \"{}\"", value.escape_default());
        let plain = format!("{key} = {value}");
        let text = match plain.parse::<toml::Table>() {
            Ok(_) => plain,
            Err(_) => quoted,
        };
        config = config.overlay(&text, Path::new(&format!("--set {setting}")))?;
    }

    fn set<T: Clone>(field: &mut T, flag: &Option<T>) {
        if let Some(value) = flag {
            *field = value.clone();
        }
    }
    if !args.data.is_empty() {
        config.data = args.data.clone();
    }
    if config.data.is_empty() {
        config.data = vec!["synth:seed=1,frames=200".to_owned()];
    }
    if let Some(device) = args.device {
        config.device = match device {
            DeviceArg::Flex => DeviceName::Flex,
            DeviceArg::Ndarray => DeviceName::Ndarray,
            DeviceArg::Tch => DeviceName::Tch,
            DeviceArg::Vulkan => DeviceName::Vulkan,
        };
    }
    if let Some(crop) = &args.crop {
        config.crop = [crop[0], crop[1]];
    }
    if args.init.is_some() {
        config.init = args.init.clone();
    }
    if args.steps.is_some() {
        config.schedule.steps = args.steps;
    }
    set(&mut config.seed, &args.seed);
    set(&mut config.batch, &args.batch);
    set(&mut config.clip, &args.clip);
    set(&mut config.average, &args.average);
    set(&mut config.checkpoint_every, &args.checkpoint_every);
    set(&mut config.validate_every, &args.validate_every);
    set(&mut config.net.max_disparity, &args.max_disparity);
    set(&mut config.schedule.epochs, &args.epochs);
    set(&mut config.schedule.lr, &args.lr);
    set(&mut config.schedule.drop_epoch, &args.drop_epoch);
    config.schedule.cosine |= args.cosine;
    loss.apply(&mut config.loss);
    let (to, from) = (&mut config.augmentation, augmentation);
    set(&mut to.noise, &from.noise);
    set(&mut to.brightness, &from.brightness);
    set(&mut to.contrast, &from.contrast);
    set(&mut to.channel, &from.channel);
    set(&mut to.blur, &from.blur);
    set(&mut to.asymmetric, &from.asymmetric);
    set(&mut to.erase, &from.erase);
    set(&mut to.flip_vertical, &from.flip_vertical);
    set(&mut to.flip_swap, &from.flip_swap);
    set(&mut to.disparity, &from.add_disparity);
    Ok(config)
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
