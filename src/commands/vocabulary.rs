use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use barchan_datasets::{luma, open, write_whole};
use barchan_slam::{Descriptor, SlamConfig, SlamError, Vocabulary};
use clap::Parser;
use serde::Serialize;

use crate::commands::features::FeatureKind;
use crate::output::Output;

/// Learn the visual words by which `barchan slam` recognises places
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan vocabulary --data images/ --out site.txt\n  \
    barchan vocabulary --data synth:seed=1,frames=200 --data synth:look=moon --every 4 --out words.txt")]
pub struct Args {
    /// Images to learn from, left ones only: PATH or FORMAT:PATH; may be given again
    #[arg(long, required = true)]
    data: Vec<String>,
    /// The file that is written, as DBoW2 writes and reads it
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Whose features are learnt from; `barchan slam --features` must be given the same
    #[arg(long, value_enum, default_value = "orb")]
    features: FeatureKind,
    /// Children of a node of the tree
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u8).range(2..=20))]
    branching: u8,
    /// Levels of the tree: branching to the power of depth words at most
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=6))]
    depth: u8,
    /// Take every so many frames only: neighbours show the same
    #[arg(long, default_value_t = 5)]
    every: usize,
    /// Chooses the first centres
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

#[derive(Serialize)]
struct Summary {
    images: usize,
    features: usize,
    words: usize,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    let config = SlamConfig {
        detector: args.features.into(),
        ..SlamConfig::default()
    };
    let detector = config.feature_detector();
    let mut images: Vec<Vec<Descriptor>> = Vec::new();
    for data in &args.data {
        let source = open(data)?;
        let bar = output.progress(data, source.len());
        for i in (0..source.len()).step_by(args.every.max(1)) {
            let frame = source.frame(i)?;
            let features = detector.detect(&luma(&frame.left));
            let features = features.map_err(|message| SlamError::Features {
                frame: frame.name.clone(),
                message,
            })?;
            images.push(features.descriptors);
            bar.set_position(i as u64);
        }
        bar.finish_and_clear();
    }
    let (branching, depth) = (usize::from(args.branching), usize::from(args.depth));
    let bytes = config.detector.descriptor_bytes();
    let vocabulary = Vocabulary::train(&images, branching, depth, bytes, args.seed);
    if vocabulary.is_empty() {
        bail!("no features in {:?}: are the images blank?", args.data);
    }
    write_whole(&args.out, vocabulary.to_text().as_bytes())
        .with_context(|| args.out.display().to_string())?;
    let summary = Summary {
        images: images.len(),
        features: images.iter().map(Vec::len).sum(),
        words: vocabulary.len(),
    };
    let text = format!(
        "{}: {} words from {} features of {} images",
        args.out.display(),
        summary.words,
        summary.features,
        summary.images
    );
    output.result(&summary, &text)
}
