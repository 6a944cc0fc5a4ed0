use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Result, anyhow, bail};
use barchan_datasets::{luma, read_rgb};
use barchan_slam::{Akaze, Detector, FeatureDetector, Features, Orb, SlamConfig};
use clap::Parser;
use serde::Serialize;

use crate::output::{Output, StagedDir, percentiles};

/// Key points and descriptors of images, a CSV file each
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan features left.png right.png --out runs/f\n  \
    barchan features images/left/*.png --features akaze --threshold 1e-4 --out runs/f\n\n\
    A line of NAME.csv is u,v,scale,sigma,descriptor: column and row with pixel centres at integers, size against \
    the finest features, standard deviation of the place, and the descriptor's bytes in hexadecimal, the first bit \
    the lowest of the first byte.")]
pub struct Args {
    /// Images
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
    /// The detector
    #[arg(long, value_enum, default_value_t = FeatureKind::Akaze)]
    features: FeatureKind,
    /// Least response: of akaze the Hessian's determinant (default 1e-3), of orb the step of brightness of 255 (default 5)
    #[arg(long)]
    threshold: Option<f32>,
    /// Most key points in an image: akaze keeps the strongest everywhere, orb finds about so many (default 900)
    #[arg(long, value_name = "COUNT")]
    keypoints: Option<usize>,
    /// The directory that is written
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// A detector by its name on the command line.
#[derive(Clone, Copy, clap::ValueEnum)]
pub enum FeatureKind {
    /// Peaks in a non-linear scale space: many matches, in any light
    Akaze,
    /// Corners in an image pyramid: several times as fast
    Orb,
}

impl FeatureKind {
    /// The detector; without a count AKAZE gives all that it finds.
    pub fn detector(self, threshold: Option<f32>, most: Option<usize>) -> Box<dyn FeatureDetector> {
        let config = SlamConfig::default();
        match self {
            Self::Akaze => Box::new(Akaze {
                threshold: threshold.unwrap_or(1e-3),
                most: most.unwrap_or(usize::MAX),
            }),
            Self::Orb => Box::new(Orb::new(
                most.unwrap_or(config.features),
                threshold.unwrap_or(config.corner_threshold),
            )),
        }
    }
}

impl From<FeatureKind> for Detector {
    fn from(kind: FeatureKind) -> Self {
        match kind {
            FeatureKind::Akaze => Self::Akaze,
            FeatureKind::Orb => Self::Orb,
        }
    }
}

#[derive(Serialize)]
struct Summary {
    images: usize,
    keypoints: usize,
    bits: u32,
    ms_median: f64,
    ms_p95: f64,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    let detector = args.features.detector(args.threshold, args.keypoints);
    let out = StagedDir::new(&args.out, "summary.json")?;
    let bar = output.progress("features", args.images.len());
    let (mut milliseconds, mut keypoints, mut bits) = (vec![], 0, 0);
    let mut names = BTreeSet::new();
    for path in &args.images {
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        if !names.insert(name.clone()) {
            bail!(
                "{}: an image named {name} came before\n  cure: give images of one name in runs of their own",
                path.display()
            );
        }
        let grey = luma(&read_rgb(path)?);
        let started = Instant::now();
        let features = detector
            .detect(&grey)
            .map_err(|message| anyhow!("{}: {message}", path.display()))?;
        milliseconds.push(started.elapsed().as_secs_f64() * 1e3);
        out.write(&format!("{name}.csv"), csv(&features)?)?;
        keypoints += features.keypoints.len();
        bits = bits.max(features.bits);
        bar.inc(1);
    }
    bar.finish_and_clear();
    let (ms_median, ms_p95) = percentiles(milliseconds);
    let summary = Summary {
        images: args.images.len(),
        keypoints,
        bits,
        ms_median,
        ms_p95,
    };
    out.write_json("summary.json", &summary)?;
    out.finish()?;
    let text = format!(
        "{keypoints} key points in {} images; {ms_median:.1} ms an image (p95 {ms_p95:.1})\n{}: NAME.csv",
        summary.images,
        args.out.display(),
    );
    output.result(&summary, &text)
}

fn csv(features: &Features) -> Result<String> {
    let mut text = String::from("u,v,scale,sigma,descriptor\n");
    let bytes = features.bits.div_ceil(8) as usize;
    for (k, descriptor) in features.keypoints.iter().zip(&features.descriptors) {
        write!(text, "{:.3},{:.3},{:.4},{:.4},", k.u, k.v, k.scale, k.sigma)?;
        for byte in &descriptor[..bytes] {
            write!(text, "{byte:02x}")?;
        }
        text.push('\n');
    }
    Ok(text)
}
