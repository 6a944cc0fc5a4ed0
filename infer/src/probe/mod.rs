//! What somebody else's stereo network wants and means, found out by running it.

mod hypotheses;
mod pairs;

use std::path::{Path, PathBuf};

use ort::session::Session;
use serde::Serialize;

use crate::onnxruntime::run::{Geometry, plane, resolution, run};
use crate::onnxruntime::{
    Contract, OnnxEngine, OutputFormat, OutputLayout, Runtime, Unit, image_inputs, is_own, open,
};
use crate::{DisparityEngine, InferError};
use hypotheses::{Hypothesis, QUESTIONS, hypotheses};
use pairs::{KnownPair, blind_error, correlation, error, fit, median, render};

/// What [`probe`] found.
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

/// Sizes that are tried with a model that takes any, until it runs with one: multiples of 64, and what
/// models are often exported at.
const SIZES: [[usize; 2]; 5] = [[320, 192], [640, 480], [512, 512], [768, 384], [1280, 768]];
/// Ways of feeding that are tried on all pairs, after all were tried on the first.
const CONTENDERS: usize = 4;

/// Finds out how an ONNX file wants a stereo pair and what its output means, by running it on rendered
/// pairs of known disparity in every way that the shapes of its inputs and outputs allow; what errs
/// least is taken, unless something more usual errs no more. `progress` is told how many of how many
/// ways were tried.
///
/// # Errors
/// When the file is missing, damaged or hostile; when its inputs are not those of a stereo model; when
/// it runs in no way; when no output follows the disparity. The message says what was tried and what to
/// do.
pub fn probe(
    runtime: &Runtime,
    path: &Path,
    threads: usize,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Verdict, InferError> {
    let wrong = |message: String| InferError::Model {
        path: path.to_owned(),
        message,
    };
    let mut session = open(runtime, path, threads)?;
    let inputs = image_inputs(&session).map_err(wrong)?;
    let mut ways = hypotheses(&inputs).map_err(wrong)?;
    let own = is_own(&session);
    if own {
        // What we export is known; it is held to it.
        let known = Contract::own();
        ways.retain(|way| {
            (&way.contract.images, &way.contract.input) == (&known.images, &known.input)
        });
    }

    // Every way of feeding it on one pair, at the first size with which it runs at all.
    let FirstTrials {
        pairs,
        size,
        mut trials,
    } = first_trials(&mut session, &ways, progress).map_err(wrong)?;
    let ran = trials.len();

    // The best of them on all pairs, and to each question the best other answer.
    trials.sort_by(|a, b| a.first.error.total_cmp(&b.first.error));
    let mut contenders: Vec<usize> = (0..trials.len().min(CONTENDERS)).collect();
    for question in 0..QUESTIONS.len() {
        let answer = |trial: &Trial| &ways[trial.way].answers[question];
        let other = (trials.iter()).position(|trial| answer(trial) != answer(&trials[0]));
        contenders.extend(other.filter(|other| !contenders.contains(other)));
    }
    for contender in contenders {
        let trial = &mut trials[contender];
        trial.all = readings(&mut session, &ways[trial.way].contract, &pairs)
            .ok()
            .and_then(|readings| best(readings, &pairs, size));
    }

    // Of those that err alike the most usual.
    let tolerance = Tolerance::of(&pairs);
    let least = trials
        .iter()
        .filter_map(|t| t.all.as_ref())
        .map(|score| score.error)
        .fold(f64::INFINITY, f64::min);
    let usual = trials
        .iter()
        .filter_map(|trial| Some((trial, trial.all.as_ref()?)))
        .filter(|(_, score)| !tolerance.differ(least, score.error))
        .min_by_key(|(trial, _)| trial.way);
    let Some((winner, score)) = usual else {
        return Err(wrong(format!(
            "ran with {ran} of {} ways of feeding it, and no output has a plane of one number a pixel, at the size of the images or a whole fraction of it\n  cure: export the model with its disparity as an output",
            ways.len()
        )));
    };
    let blind = blind_error(&pairs);
    let decisions = decide(&ways, &trials, winner, score, &tolerance);
    let mut contract = ways[winner.way].contract.clone();
    contract.output = score.output.clone();
    let found = Found {
        way: &ways[winner.way],
        score,
        blind,
        ways: ways.len(),
    };
    found.must_explain().map_err(wrong)?;

    // The answer must follow the right image: what sees one image alone can be right by habit.
    if own {
        contract.output.sigma = Some("sigma".into());
        contract.output.confidence = Some("confidence".into());
    }
    let free_batch = inputs.iter().all(|(_, dims)| dims[0] == -1);
    let mut engine = OnnxEngine::with_contract(session, contract, path);
    let response = response(&mut engine, &pairs)?;
    if !(0.6..1.4).contains(&response) {
        return Err(wrong(format!(
            "its output resembles disparity (correlation {:.2}), but a right image moved by one pixel moves it by {response:.2}, where stereo has 1: it does not match the two images\n  cure: give a stereo model; this one seems to judge single images",
            score.correlation
        )));
    }

    settle_size(&mut engine, &pairs, size, score.error);
    settle_unit(&mut engine, &pairs, size);
    if free_batch && runs_in_batches(&mut engine, &pairs) {
        engine.contract.size.batch = true;
    }
    let mut verdict = Verdict {
        contract: engine.contract.clone(),
        size,
        tried: [ways.len(), ran],
        error: score.error,
        blind_error: blind,
        correlation: score.correlation,
        response,
        measured_factor: score.measured,
        decisions,
        explanation: Vec::new(),
    };
    verdict.explanation = explain(&verdict, pairs.len(), own);
    Ok(verdict)
}

/// One way of feeding the model, and how it went.
struct Trial {
    way: usize,
    /// On the first pair.
    first: Score,
    /// On all pairs, of the best few.
    all: Option<Score>,
}

/// What a model was first tried on.
struct FirstTrials {
    pairs: Vec<KnownPair>,
    /// What it was given.
    size: [usize; 2],
    trials: Vec<Trial>,
}

/// How an output does as disparity.
#[derive(Clone)]
struct Score {
    output: OutputFormat,
    measured: f64,
    error: f64,
    correlation: f64,
}

/// A plane of one number a pixel that an output holds, at the size of the image, for each pair.
struct Reading {
    output: usize,
    name: String,
    layout: OutputLayout,
    channel: usize,
    /// The output is 1 / `coarse` of the size of what the model was given.
    coarse: usize,
    planes: Vec<Vec<f32>>,
}

/// Runs the model in all ways on one pair, at the first size with which any works. The pairs, that size,
/// and what ran.
fn first_trials(
    session: &mut Session,
    ways: &[Hypothesis],
    progress: &mut dyn FnMut(usize, usize),
) -> Result<FirstTrials, String> {
    let fixed = ways.first().map_or([None; 2], |w| {
        [w.contract.size.width, w.contract.size.height]
    });
    let mut sizes = SIZES
        .map(|size| [0, 1].map(|axis| fixed[axis].unwrap_or(size[axis])))
        .to_vec();
    sizes.dedup();
    let mut said = String::new();
    let mut answered = false;
    for size in &sizes {
        let pairs = render(rendered(*size)).map_err(|e| e.to_string())?;
        let mut trials = Vec::new();
        for (index, way) in ways.iter().enumerate() {
            match readings(session, &way.contract, &pairs[..1]) {
                Ok(readings) => {
                    answered = true;
                    if let Some(first) = best(readings, &pairs[..1], *size) {
                        trials.push(Trial {
                            way: index,
                            first,
                            all: None,
                        });
                    }
                }
                Err(message) if said.is_empty() => said = message,
                Err(_) => {}
            }
            progress(index + 1, ways.len());
        }
        if !trials.is_empty() {
            return Ok(FirstTrials {
                pairs,
                size: *size,
                trials,
            });
        }
        if answered {
            return Err(format!(
                "runs, and no output holds a number a pixel that varies, at the size of the images or a whole fraction of it: not a stereo model\n  {} ways of feeding it were tried on a rendered pair of {} x {}\n  cure: give a stereo model that was exported with its disparity as an output",
                ways.len(),
                size[0],
                size[1]
            ));
        }
    }
    let sizes: Vec<String> = sizes.iter().map(|[w, h]| format!("{w} x {h}")).collect();
    Err(format!(
        "does not run, with any of {} ways of feeding it, with images of {}; ONNX Runtime says: {said}\n  cure: export the model again, for one size or with axes that are truly free",
        ways.len(),
        sizes.join(", ")
    ))
}

/// The size in which pairs are rendered for a model: its own, or one of nearly its shape within 96 to 768
/// pixels that is rendered soon and shows enough; images are resized as any are.
fn rendered(size: [usize; 2]) -> [usize; 2] {
    let [width, height] = size.map(|side| side as f64);
    let scale = (96.0 / width.min(height)).max(1.0) * (768.0 / width.max(height)).min(1.0);
    size.map(|side| ((side as f64 * scale).round() as usize).clamp(96, 1536))
}

/// Everything in the outputs that could be disparity, over some pairs.
fn readings(
    session: &mut Session,
    way: &Contract,
    pairs: &[KnownPair],
) -> Result<Vec<Reading>, String> {
    let mut found: Vec<Reading> = Vec::new();
    for (k, pair) in pairs.iter().enumerate() {
        let geometry = Geometry::new(way, pair.size());
        let outputs = run(session, way, &geometry, &[(&pair.left, &pair.right)])
            .map_err(|e| e.to_string())?;
        for (index, (name, value)) in outputs.iter().enumerate() {
            let Ok((dims, data)) = value.try_extract_tensor::<f32>() else {
                continue;
            };
            for layout in OutputLayout::ALL {
                // More channels than this are features, not answers.
                for channel in 0..8 {
                    let Some((size, values)) = plane(dims, data, layout, channel, 0) else {
                        break;
                    };
                    let Some(coarse) = resolution(way, &geometry, size) else {
                        break;
                    };
                    let values = geometry.to_image(&values, size, 1.0);
                    if k == 0 {
                        found.push(Reading {
                            output: index,
                            name: name.to_owned(),
                            layout,
                            channel,
                            coarse,
                            planes: vec![values],
                        });
                    } else if let Some(reading) = found
                        .iter_mut()
                        .find(|r| (r.output, r.layout, r.channel) == (index, layout, channel))
                    {
                        reading.planes.push(values);
                    }
                    if !layout.letters().contains('c') {
                        break;
                    }
                }
            }
        }
    }
    found.retain(|reading| reading.planes.len() == pairs.len());
    // The finest first: it is the answer where it errs no more.
    found.sort_by_key(|reading| reading.coarse);
    Ok(found)
}

/// The reading that errs least.
fn best(readings: Vec<Reading>, pairs: &[KnownPair], given: [usize; 2]) -> Option<Score> {
    let mut scores: Vec<Score> = Vec::new();
    for reading in readings {
        let width = pairs.first()?.size()[0];
        // The model's disparities are those of the images as it was given them.
        let resized = given[0] as f32 / width as f32;
        let compared = || {
            (pairs.iter().zip(&reading.planes))
                .flat_map(|(pair, values)| pair.compare(values))
                .map(|(truth, value)| (truth * resized, value))
        };
        let Some(measured) = fit(compared()) else {
            continue;
        };
        let (factor, unit) = usual_factor(measured, given[0]);
        let pixels = match unit {
            Unit::Pixels => factor,
            Unit::Width => factor * given[0] as f64,
        } as f32;
        let error = error(
            compared().map(|(t, v)| (t / resized, v * pixels / resized)),
            width,
        );
        scores.push(Score {
            measured,
            error,
            correlation: correlation(compared()) * measured.signum(),
            output: OutputFormat {
                name: reading.name,
                layout: reading.layout,
                channel: reading.channel,
                unit,
                factor,
                sigma: None,
                confidence: None,
            },
        });
    }
    scores
        .into_iter()
        .min_by(|a, b| a.error.total_cmp(&b.error))
}

/// The factor that is meant where `measured` was found: a power of two or the width, where it is within
/// 6 % of one, else as measured, to three digits.
fn usual_factor(measured: f64, width: usize) -> (f64, Unit) {
    let near = |usual: f64| (measured.abs() / usual - 1.0).abs() < 0.06;
    let power = (-6..=6).map(|k| 2f64.powi(k)).find(|p| near(*p));
    if let Some(power) = power {
        return (power * measured.signum(), Unit::Pixels);
    }
    if near(width as f64) {
        return (measured.signum(), Unit::Width);
    }
    let rounded = format!("{measured:.2e}").parse().unwrap_or(measured);
    (rounded, Unit::Pixels)
}

/// When two errors are the same for all that is known: within 5 % and a ten-thousandth of the width.
struct Tolerance(f64);

impl Tolerance {
    fn of(pairs: &[KnownPair]) -> Self {
        Self(
            pairs
                .first()
                .map_or(0.0, |pair| 1e-4 * pair.size()[0] as f64),
        )
    }

    fn differ(&self, less: f64, more: f64) -> bool {
        more > 1.05 * less + self.0
    }
}

/// The winner's answer to each question, and the next best.
fn decide(
    ways: &[Hypothesis],
    trials: &[Trial],
    winner: &Trial,
    score: &Score,
    tolerance: &Tolerance,
) -> Vec<Decision> {
    let mut decisions = Vec::new();
    for (k, question) in QUESTIONS.iter().enumerate() {
        let answer = &ways[winner.way].answers[k];
        let next = (trials.iter())
            .filter(|trial| ways[trial.way].answers[k] != *answer)
            .filter_map(|trial| Some((trial.all.as_ref()?.error, trial.way)))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        let never_ran = ways.iter().position(|way| way.answers[k] != *answer);
        decisions.push(Decision {
            question,
            answer: answer.clone(),
            alternative: (next.map(|(_, way)| way).or(never_ran))
                .map(|way| ways[way].answers[k].clone()),
            alternative_error: next.map(|(error, _)| error),
            decided: next.is_none_or(|(error, _)| tolerance.differ(score.error, error)),
        });
    }
    decisions
}

/// The best that was found, before it is believed.
struct Found<'a> {
    way: &'a Hypothesis,
    score: &'a Score,
    blind: f64,
    ways: usize,
}

impl Found<'_> {
    /// Refuses a model whose best answer is no disparity.
    fn must_explain(&self) -> Result<(), String> {
        let Self {
            way,
            score,
            blind,
            ways,
        } = self;
        // Half the error of an answer that sees nothing. Wild pixels lower the correlation of good models.
        if score.error < 0.5 * blind && score.correlation > 0.3 {
            return Ok(());
        }
        Err(format!(
            "no output follows the disparity: the best of {ways} ways of feeding it ({}; values {}; {}), reading output \"{}\", channel {}, has correlation {:.2} with the known disparity and errs by {:.2} px where an answer without images errs by {blind:.2}\n  cure: give a stereo model; if it is one, say how it wants its images in a .toml beside it (fields as in any that `barchan probe` writes)",
            way.answers[0],
            way.answers[1],
            way.answers[2],
            score.output.name,
            score.output.channel,
            score.correlation,
            score.error,
        ))
    }
}

/// By how much the answer moves for each pixel that the right image is moved.
fn response(engine: &mut OnnxEngine, pairs: &[KnownPair]) -> Result<f64, InferError> {
    let mut moves = Vec::new();
    for pair in pairs {
        let by = (pair.size()[0] / 40).max(2);
        let moved = pair.moved(by);
        let before = engine.disparity(&pair.left, &pair.right)?.disparity;
        let after = engine.disparity(&moved.left, &moved.right)?.disparity;
        moves.extend(
            (before.iter().zip(after.iter()).zip(&moved.truth))
                .filter(|(_, truth)| truth.is_finite())
                .map(|((before, after), _)| (after - before) / by as f32),
        );
    }
    Ok(f64::from(median(&mut moves)))
}

/// The error through the engine as a user runs it; infinite where it fails.
fn served_error(engine: &mut OnnxEngine, pair: &KnownPair) -> f64 {
    match engine.disparity(&pair.left, &pair.right) {
        Ok(map) => error(pair.compare(map.disparity.as_raw()), pair.size()[0]),
        Err(_) => f64::INFINITY,
    }
}

/// Finds the multiples to which free sides must be padded, and the smallest size; a model that is free
/// by declaration only is fixed to the size with which it ran.
fn settle_size(engine: &mut OnnxEngine, pairs: &[KnownPair], given: [usize; 2], known: f64) {
    let declared = engine.contract.size.clone();
    let Some(pair) = pairs.first() else { return };
    if declared.width.is_some() && declared.height.is_some() {
        return;
    }
    let shrink = engine
        .contract
        .input
        .iter()
        .map(|i| i.shrink)
        .max()
        .unwrap_or(1);
    let size = pair.size();
    let good = |error: f64| error <= 1.5 * known + size[0] as f64 / 800.0;
    for multiple in (0..8)
        .map(|k| 1usize << k)
        .filter(|m| m.is_multiple_of(shrink))
    {
        // Odd multiples, so that no larger power of two divides them.
        let odd = size.map(|side| {
            let times = (side * 15 / 16) / multiple;
            multiple * (times - usize::from(times.is_multiple_of(2) && times > 0))
        });
        if odd.contains(&0) {
            break;
        }
        engine.contract.size.multiple = multiple;
        engine.contract.size.at_least = multiple;
        if !good(served_error(engine, &pair.crop(odd))) {
            continue;
        }
        let smallest = std::iter::successors(Some(multiple), |side| Some(2 * side))
            .take_while(|side| *side <= size[0].min(size[1]))
            .find(|side| served_error(engine, &pair.crop([*side; 2])).is_finite());
        engine.contract.size.at_least = smallest.unwrap_or(size[0].min(size[1]));
        return;
    }
    engine.contract.size.multiple = 1;
    engine.contract.size.at_least = 1;
    engine.contract.size.width = Some(given[0]);
    engine.contract.size.height = Some(given[1]);
}

/// With a free width, tells widths from pixels by another width.
fn settle_unit(engine: &mut OnnxEngine, pairs: &[KnownPair], given: [usize; 2]) {
    let output = engine.contract.output.clone();
    if output.unit == Unit::Pixels || engine.contract.size.width.is_some() {
        return;
    }
    let narrow: Vec<KnownPair> = (pairs.iter())
        .map(|pair| pair.crop([pair.size()[0] * 3 / 5, pair.size()[1]]))
        .collect();
    let as_width: f64 = narrow.iter().map(|p| served_error(engine, p)).sum();
    engine.contract.output.unit = Unit::Pixels;
    engine.contract.output.factor = output.factor * given[0] as f64;
    let as_pixels: f64 = narrow.iter().map(|p| served_error(engine, p)).sum();
    if as_width <= as_pixels {
        engine.contract.output = output;
    }
}

/// Whether two pairs at once give what they give one by one.
fn runs_in_batches(engine: &mut OnnxEngine, pairs: &[KnownPair]) -> bool {
    let pairs: Vec<_> = pairs.iter().take(2).map(|p| (&p.left, &p.right)).collect();
    let alone = engine.disparity_batch(&pairs);
    engine.contract.size.batch = true;
    let together = engine.disparity_batch(&pairs);
    engine.contract.size.batch = false;
    let (Ok(alone), Ok(together)) = (alone, together) else {
        return false;
    };
    alone.iter().zip(&together).all(|(a, b)| {
        let mut apart: Vec<f32> = (a.disparity.iter().zip(b.disparity.iter()))
            .map(|(a, b)| (a - b).abs())
            .filter(|d| d.is_finite())
            .collect();
        median(&mut apart) < 1e-2
    })
}

/// The verdict in plain words.
fn explain(verdict: &Verdict, pairs: usize, own: bool) -> Vec<String> {
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
