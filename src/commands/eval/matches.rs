use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow};
use barchan_datasets::{StereoFrame, luma};
use barchan_eval::matches::{MatchFigures, MatchScore, MatchTally, is_correct};
use barchan_infer::Rejection;
use barchan_slam::{Features, MatchRules, RuledMatch, SlamConfig};
use clap::Parser;
use serde::Serialize;

use crate::commands::features::FeatureKind;
use crate::data::{Unchecked, open_checked};
use crate::engine::{DEFAULT_MODEL, EngineSettings, load_engine};
use crate::output::{Output, StagedDir};
use crate::preview::matches_over_pair;

/// Feature matches by the distance ratio and by dense disparity (Hong 2021, table 1)
///
/// Each left feature's nearest neighbour by descriptor is judged by two rules: is it clearly nearer than the second,
/// and does dense disparity agree. Where the data has true disparity, the share of true matches is given too.
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan eval matches --data images/ --model rover --every 10\n  \
    barchan eval matches --data images/ --model sgm --thresholds 0.002 --out runs/m     and figure 7, a picture a pair\n  \
    barchan eval matches --data synth:seed=1,frames=5 --features orb --search rows --json")]
pub struct Args {
    /// Stereo pairs: PATH or FORMAT:PATH
    #[arg(long)]
    data: String,
    /// Dense disparity: x.onnx, x.safetensors, a run of `barchan train`, or a shipped name,
    /// or sgm or bm, which need no network (sgm:192 searches 192 disparities)
    #[arg(long, default_value = DEFAULT_MODEL)]
    model: String,
    /// The detector
    #[arg(long, value_enum, default_value_t = FeatureKind::Akaze)]
    features: FeatureKind,
    /// Its thresholds, a line of the table each (default: akaze 1e-3,1e-4,1e-5; orb 5)
    #[arg(long, value_delimiter = ',', value_name = "T,...")]
    thresholds: Vec<f32>,
    /// Most key points in an image (default: akaze all, orb 900)
    #[arg(long, value_name = "COUNT")]
    keypoints: Option<usize>,
    /// Accepted by looks: distance below this share of the second nearest one's
    #[arg(long, default_value_t = 0.6)]
    nndr: f64,
    /// Accepted by disparity: difference to the dense one below so many pixels
    #[arg(long, default_value_t = SlamConfig::default().gate_px)]
    gate_px: f64,
    /// Where neighbours are looked for
    #[arg(long, value_enum, default_value_t = Search::Image)]
    search: Search,
    /// A match is true within so many pixels of where true disparity puts it
    #[arg(long, default_value_t = 3.0, value_name = "PX")]
    tolerance: f64,
    /// Keep dense disparity that the pair itself contradicts
    #[arg(long)]
    no_reject: bool,
    /// Judge only every so many pairs
    #[arg(long, default_value_t = 1, value_name = "PAIRS", value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,
    /// Write a picture for each pair and threshold: blue is accepted by both rules, green by disparity
    /// alone, yellow by looks where disparity is not known, red by looks against disparity
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    engine: EngineSettings,
    #[command(flatten)]
    unchecked: Unchecked,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Search {
    /// The whole right image, as the paper's table
    Image,
    /// Rows at most 2 pixels away, as SLAM does
    Rows,
}

/// A line of the table.
#[derive(Serialize)]
struct Line {
    threshold: f32,
    #[serde(flatten)]
    score: MatchScore,
}

pub fn run(args: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    let rules = MatchRules {
        nndr: args.nndr,
        gate_px: args.gate_px,
        rows: match args.search {
            Search::Image => None,
            Search::Rows => Some(2.0),
        },
    };
    let thresholds = match (args.thresholds.as_slice(), args.features) {
        ([], FeatureKind::Akaze) => vec![1e-3, 1e-4, 1e-5],
        ([], FeatureKind::Orb) => vec![SlamConfig::default().corner_threshold],
        (given, _) => given.to_vec(),
    };
    let source = open_checked(&args.data, &args.unchecked, output)?;
    let mut engine = load_engine(&args.model, runtime, &args.engine)?;
    let out = (args.out.as_deref())
        .map(|out| StagedDir::new(out, "matches.json"))
        .transpose()?;

    let mut tallies = vec![MatchTally::default(); thresholds.len()];
    let indices = (0..source.len()).step_by(args.every as usize);
    let bar = output.progress("matches", indices.len());
    for index in indices {
        let frame = source.frame(index)?;
        let context = || format!("frame {}", frame.name);
        let mut dense = engine
            .disparity(&frame.left, &frame.right)
            .with_context(context)?;
        if !args.no_reject {
            Rejection::default().apply(&frame.left, &frame.right, &mut dense);
        }
        let truth = source.true_disparity(index)?;
        let grey = [luma(&frame.left), luma(&frame.right)];
        for (threshold, tally) in thresholds.iter().zip(&mut tallies) {
            let detector = args.features.detector(Some(*threshold), args.keypoints);
            let [left, right] = grey.each_ref().map(|image| {
                detector
                    .detect(image)
                    .map_err(|e| anyhow!(e).context(context()))
            });
            let (left, right) = (left?, right?);
            let matches = rules.judge(&left, &right, &dense.disparity);
            tally.add_image(left.keypoints.len());
            for m in &matches {
                let [a, b] = ends(m, &left, &right);
                let correct = (truth.as_ref()).and_then(|t| is_correct(t, a, b, args.tolerance));
                tally.add(m.by_ratio, m.by_disparity, correct);
            }
            if let Some(out) = &out {
                let file = out.path(format!("{}-{threshold}.png", frame.name))?;
                picture(&frame, &matches, &left, &right)
                    .save(&file)
                    .with_context(|| file.display().to_string())?;
            }
        }
        bar.inc(1);
    }
    bar.finish_and_clear();

    let lines = thresholds
        .iter()
        .zip(&tallies)
        .map(|(threshold, tally)| {
            let score = tally.score();
            Ok(Line {
                threshold: *threshold,
                score: score.with_context(|| format!("{}: no pairs", args.data))?,
            })
        })
        .collect::<Result<Vec<Line>>>()?;
    if let Some(out) = out {
        out.write_json("matches.json", &lines)?;
        out.finish()?;
    }
    output.result(&lines, &table(&lines))
}

/// Where a match begins and ends.
fn ends(m: &RuledMatch, left: &Features, right: &Features) -> [[f64; 2]; 2] {
    [left.keypoints[m.left], right.keypoints[m.right]].map(|k| [k.u, k.v])
}

/// Hong's figure 7, with the matches that it leaves away.
fn picture(
    frame: &StereoFrame,
    matches: &[RuledMatch],
    left: &Features,
    right: &Features,
) -> image::RgbImage {
    let lines: Vec<_> = matches
        .iter()
        .map(|m| {
            let colour = match (m.by_ratio, m.by_disparity) {
                (false, _) => [60, 220, 60],
                (true, Some(true)) => [70, 110, 255],
                (true, None) => [250, 220, 40],
                (true, Some(false)) => [255, 50, 40],
            };
            (ends(m, left, right), image::Rgb(colour))
        })
        .collect();
    matches_over_pair(frame, &lines)
}

fn table(lines: &[Line]) -> String {
    type Column = (&'static str, fn(&MatchScore) -> MatchFigures);
    let columns: [Column; 8] = [
        ("ratio only*", |s| s.nndr_contradicted),
        ("ratio only", |s| s.nndr_alone),
        ("both", |s| s.both),
        ("disp. only", |s| s.disparity_alone),
        ("all ratio", |s| s.nndr),
        ("all disp.", |s| s.disparity),
        ("either", |s| s.either),
        ("slam", |s| s.not_contradicted),
    ];
    let mut text = format!("{:>9} {:>9}", "threshold", "features");
    for (title, _) in columns {
        text += &format!(" {title:>12}");
    }
    for Line { threshold, score } in lines {
        text += &format!("\n{threshold:>9} {:>9.0}", score.features);
        for (_, figures) in columns {
            text += &format!(" {:>12.1}", figures(score).matches);
        }
        if score.either.precision.is_some() {
            text += &format!("\n{:>19}", "true, %");
            for (_, figures) in columns {
                let precision = figures(score).precision;
                text += &precision.map_or(format!(" {:>12}", "-"), |p| format!(" {p:>12.1}"));
            }
        }
    }
    text + "\nmatches of an image on average; ratio only*: dense disparity contradicts, ratio only: it is not known;\n\
            either: the paper's rule; slam: either, less what dense disparity contradicts"
}
