use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use barchan_datasets::{StereoFrame, StereoSource, disparity_file, prefetch};
use barchan_geometry::RectifiedRig;
use barchan_model::{Device, StereoNet, weights};
use barchan_train::{AdaptConfig, Adapter, Judgement, TrainError, Verdict, explain};
use clap::Parser;
use serde::Serialize;

use crate::data::{Unchecked, open_checked};
use crate::engine::load_net;
use crate::output::{Output, StagedDir, percentiles};

/// Keep learning from a stream of pairs while it is matched, and take back what does not help
///
/// Every pair gets its disparity from the weights trusted at that moment, while the pair before is learned from in
/// the background. Every fourth pair is not learned from: on the latest of these the learned weights, those
/// trusted so far and the first ones are compared now and then, and the best are trusted from then on.
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan adapt --data images/ --out runs/adapted\n  \
    barchan adapt --data images/ --model runs/a --steps 4 --compare --out runs/b     and say what it gained\n  \
    barchan infer --data more/ --model runs/b/weights.safetensors --out out/     go on with what was learned")]
pub struct Args {
    /// Stereo pairs in the order of time: PATH or FORMAT:PATH
    #[arg(long)]
    data: Vec<String>,
    /// Weights to start from: a run, a .safetensors file or a shipped name
    #[arg(long, default_value = "rover")]
    model: String,
    /// The directory that is written
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Steps after each pair that is learned from
    #[arg(long, default_value_t = AdaptConfig::default().steps)]
    steps: usize,
    /// Learning rate
    #[arg(long, default_value_t = AdaptConfig::default().lr)]
    lr: f64,
    /// Height and width of the crops, pixels; larger crops than the images shrink to them
    #[arg(long, num_args = 2, value_names = ["H", "W"])]
    crop: Option<Vec<usize>>,
    /// Pairs between two judgements
    #[arg(long, value_name = "PAIRS", default_value_t = AdaptConfig::default().every)]
    judge_every: usize,
    /// Seeds crops, augmentation and the choice of pairs
    #[arg(long, default_value_t = AdaptConfig::default().seed)]
    seed: u64,
    /// Match every pair with the first weights too, and say how much better the adapting ones did
    #[arg(long)]
    compare: bool,
    #[command(flatten)]
    unchecked: Unchecked,
}

/// A line of `log.jsonl`.
#[derive(Serialize)]
struct Line {
    frame: String,
    /// Photometric loss of the disparity that was given out.
    photometric: f32,
    /// The same for the first weights.
    #[serde(skip_serializing_if = "Option::is_none")]
    photometric_first: Option<f32>,
    /// Of matching alone, while the pair before was learned from.
    milliseconds: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    judgement: Option<Judgement>,
}

#[derive(Serialize)]
struct Summary {
    pairs: usize,
    /// Judgements after which the learned weights were trusted, the old ones kept, and the first ones taken again.
    learned: usize,
    kept: usize,
    forgotten: usize,
    /// Mean photometric loss of what was given out, over all pairs and over the last quarter of them.
    photometric: f32,
    photometric_late: f32,
    /// The same for the first weights.
    #[serde(skip_serializing_if = "Option::is_none")]
    photometric_first: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    photometric_first_late: Option<f32>,
    ms_median: f64,
    ms_p95: f64,
    weights: PathBuf,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    if args.data.is_empty() {
        bail!("give --data: the stereo pairs to adapt to");
    }
    let mut config = AdaptConfig {
        steps: args.steps,
        lr: args.lr,
        every: args.judge_every,
        seed: args.seed,
        ..AdaptConfig::default()
    };
    if let Some([height, width]) = args.crop.as_deref() {
        config.crop = [*height, *width];
    }
    let device = Device::flex();
    let first = load_net(&args.model, &device)?;
    let learning = load_net(&args.model, &device.clone().autodiff())?;
    let loss = config.loss;
    let adapter = Adapter::new(learning, &device, config)?;
    let sources = (args.data.iter())
        .map(|data| Ok(open_checked(data, &args.unchecked, output)?.into()))
        .collect::<Result<Vec<Arc<dyn StereoSource>>>>()?;
    let out = StagedDir::new(&args.out, "summary.json")?;

    let bar = output.progress("adapt", sources.iter().map(|s| s.len()).sum());
    let (pairs, taken) = sync_channel(1);
    let (tell, told) = sync_channel(1);
    let learner = thread::spawn(move || learn(adapter, &taken, &tell));
    let mut trusted = first.clone();
    let mut lines: Vec<Line> = vec![];
    for (number, source) in sources.iter().enumerate() {
        for frame in prefetch(Arc::clone(source), (0..source.len()).collect(), 4) {
            let frame = frame?;
            let started = Instant::now();
            let (disparity, photometric) = explain(&trusted, &loss, &frame, &device)?;
            let milliseconds = started.elapsed().as_secs_f64() * 1e3;
            let name = match sources.len() {
                1 => frame.name.clone(),
                _ => format!("{number}/{}", frame.name),
            };
            disparity_file::write_png(&out.path(format!("disparity/{name}.png"))?, &disparity)?;
            let compared = args
                .compare
                .then(|| explain(&first, &loss, &frame, &device))
                .transpose()?;
            // What was learned from the pair before: waiting here makes a run repeatable.
            if let Some(last) = lines.last_mut() {
                trusted = hear(&told, last)?.unwrap_or(trusted);
            }
            lines.push(Line {
                frame: name,
                photometric,
                photometric_first: compared.map(|(_, loss)| loss),
                milliseconds,
                judgement: None,
            });
            let rig = *source.frame_rig(frame.index);
            pairs
                .send((frame, rig))
                .context("the learner has stopped")?;
            bar.inc(1);
        }
    }
    if let Some(last) = lines.last_mut() {
        trusted = hear(&told, last)?.unwrap_or(trusted);
    }
    drop(pairs);
    // It ended with the channel; a panic of its own is not hidden.
    if let Err(panic) = learner.join() {
        std::panic::resume_unwind(panic);
    }
    bar.finish_and_clear();

    weights::save(&trusted, &out.path("weights.safetensors")?)?;
    let log = lines.iter().map(serde_json::to_string);
    out.write(
        "log.jsonl",
        log.collect::<Result<Vec<_>, _>>()?.join("\n") + "\n",
    )?;
    let summary = summary(&lines, args.out.join("weights.safetensors"));
    out.write_json("summary.json", &summary)?;
    out.finish()?;
    output.result(&summary, &text(&summary))
}

type Pair = (StereoFrame, RectifiedRig);
/// A judgement, and the weights to trust when they are others now.
type Learned = Result<(Option<Judgement>, Option<StereoNet>), TrainError>;

/// Learns from one pair after the other until there are no more, and tells after each.
fn learn(mut adapter: Adapter, pairs: &Receiver<Pair>, tell: &SyncSender<Learned>) {
    while let Ok((frame, rig)) = pairs.recv() {
        let learned = adapter.see(frame, &rig).map(|judgement| {
            let other = judgement.filter(|j| j.verdict != Verdict::Trusted);
            (judgement, other.map(|_| adapter.trusted().clone()))
        });
        // Nobody listens any more: the command ended early.
        if tell.send(learned).is_err() {
            return;
        }
    }
}

/// Waits for what was learned from the pair of `line`, notes the judgement there, and returns the weights
/// to trust when they are others now.
fn hear(told: &Receiver<Learned>, line: &mut Line) -> Result<Option<StereoNet>> {
    let (judgement, net) = told.recv().context("the learner has stopped")??;
    line.judgement = judgement;
    Ok(net)
}

fn summary(lines: &[Line], weights: PathBuf) -> Summary {
    let verdicts = |verdict: Verdict| {
        let of = lines.iter().filter_map(|line| line.judgement);
        of.filter(|j| j.verdict == verdict).count()
    };
    let mean = |lines: &[Line], of: fn(&Line) -> Option<f32>| {
        let values: Option<Vec<f32>> = lines.iter().map(of).collect();
        values.map(|v| v.iter().sum::<f32>() / v.len().max(1) as f32)
    };
    let late = &lines[lines.len() - lines.len().div_ceil(4)..];
    let given = |lines| mean(lines, |line| Some(line.photometric)).unwrap_or(0.0);
    let (ms_median, ms_p95) = percentiles(lines.iter().map(|line| line.milliseconds).collect());
    Summary {
        pairs: lines.len(),
        learned: verdicts(Verdict::Learned),
        kept: verdicts(Verdict::Trusted),
        forgotten: verdicts(Verdict::First),
        photometric: given(lines),
        photometric_late: given(late),
        photometric_first: mean(lines, |line| line.photometric_first),
        photometric_first_late: mean(late, |line| line.photometric_first),
        ms_median,
        ms_p95,
        weights,
    }
}

fn text(summary: &Summary) -> String {
    let against = |first: Option<f32>| match first {
        Some(first) => format!(" (the first weights: {first:.4})"),
        None => String::new(),
    };
    format!(
        "{} pairs; photometric loss {:.4}{}, over the last quarter {:.4}{}\nwhat was learned was trusted {} times, taken back {} times, and all of it {} times; {:.1} ms median, {:.1} ms p95\nweights: {}",
        summary.pairs,
        summary.photometric,
        against(summary.photometric_first),
        summary.photometric_late,
        against(summary.photometric_first_late),
        summary.learned,
        summary.kept,
        summary.forgotten,
        summary.ms_median,
        summary.ms_p95,
        summary.weights.display(),
    )
}
