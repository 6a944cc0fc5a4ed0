//! What somebody else's stereo network wants and means, found out by running it.

mod hypotheses;
mod pairs;
mod settle;
mod verdict;

use std::path::Path;

use ort::session::Session;

use crate::InferError;
use crate::onnxruntime::run::{Geometry, plane, resolution, run};
use crate::onnxruntime::{
    Contract, OnnxEngine, OutputFormat, OutputLayout, Runtime, Unit, image_inputs, is_own, open,
};
use hypotheses::{Hypothesis, QUESTIONS, hypotheses};
use pairs::{KnownPair, blind_error, correlation, error, fit, render};
use settle::{response, runs_in_batches, settle_size, settle_unit};
use verdict::explain;
pub use verdict::{Decision, Verdict};

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
