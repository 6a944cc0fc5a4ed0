use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use barchan_datasets::{StereoFrame, StereoSource, disparity_file, load_rig, prefetch, read_rgb};
use barchan_geometry::RectifiedRig;
use barchan_infer::Rejection;
use barchan_terrain::{Cloud, DepthLimits};
use clap::Parser;
use serde::Serialize;

use crate::data::{Unchecked, open_checked};
use crate::engine::{DEFAULT_MODEL, EngineSettings, load_engine};
use crate::output::{Output, StagedDir, percentiles};
use crate::preview::{disparity_beside_image, disparity_range, share};

/// Disparity, confidence, a colour preview and a cloud of points for every pair
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan infer --data images/ --model a.onnx --out out/\n  \
    barchan infer --left l.png --right r.png --rig rig.toml --model sgm --out out/")]
pub struct Args {
    /// Stereo pairs: PATH or FORMAT:PATH
    #[arg(long, required_unless_present = "left", conflicts_with_all = ["left", "right", "rig"])]
    data: Option<String>,
    /// A single left image, rectified
    #[arg(long, requires = "right")]
    left: Option<PathBuf>,
    /// Its right image
    #[arg(long, requires = "left")]
    right: Option<PathBuf>,
    /// The rig of the single pair; without it there is no cloud
    #[arg(long)]
    rig: Option<PathBuf>,
    /// x.onnx, x.safetensors, a run of `barchan train`, or a shipped name,
    /// or sgm or bm, which need no network (sgm:192 searches 192 disparities)
    #[arg(long, default_value = DEFAULT_MODEL)]
    model: String,
    /// Only the frames named in this file, one name a line
    #[arg(long, value_name = "FILE")]
    keyframes: Option<PathBuf>,
    /// The directory that is written
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Keep every pixel, also those that the pair itself contradicts
    #[arg(long)]
    no_reject: bool,
    /// Largest accepted structural dissimilarity (1 - SSIM) / 2 of the warped pair
    #[arg(long, default_value_t = Rejection::default().max_dissimilarity)]
    reject: f32,
    #[command(flatten)]
    engine: EngineSettings,
    #[command(flatten)]
    unchecked: Unchecked,
}

#[derive(Serialize)]
struct Summary {
    frames: usize,
    engine: String,
    ms_median: f64,
    ms_p95: f64,
    density: f64,
}

pub fn run(args: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    let frames = open_frames(&args, output)?;
    let mut engine = load_engine(&args.model, runtime, &args.engine)?;
    let out = StagedDir::new(&args.out, "summary.json")?;
    let rejection = (!args.no_reject).then_some(Rejection {
        max_dissimilarity: args.reject,
    });

    let bar = output.progress("infer", frames.len());
    let (mut milliseconds, mut density, mut colours) = (vec![], 0.0, None);
    let mut clouds = false;
    let several = frames.len() > 1;
    for frame in frames {
        let (frame, rig) = frame?;
        if several && milliseconds.is_empty() {
            // The times are those of a stream: what is done once is not counted.
            let (width, height) = frame.left.dimensions();
            engine
                .warm_up(width, height)
                .with_context(|| format!("frame {}", frame.name))?;
        }
        let started = Instant::now();
        let mut map = engine
            .disparity(&frame.left, &frame.right)
            .with_context(|| format!("frame {}", frame.name))?;
        milliseconds.push(started.elapsed().as_secs_f64() * 1e3);
        density += match rejection {
            Some(rejection) => rejection.apply(&frame.left, &frame.right, &mut map),
            None => map.density(),
        };
        let name = &frame.name;
        disparity_file::write_png(&out.path(format!("disparity/{name}.png"))?, &map.disparity)?;
        disparity_file::write_pfm(&out.path(format!("disparity/{name}.pfm"))?, &map.disparity)?;
        let confidence = out.path(format!("confidence/{name}.png"))?;
        share(&map.confidence)
            .save(&confidence)
            .with_context(|| confidence.display().to_string())?;
        // The full precision, for those who rank pixels by it.
        for (what, plane) in [("confidence", &map.confidence), ("sigma", &map.sigma)] {
            disparity_file::write_pfm(&out.path(format!("{what}/{name}.pfm"))?, plane)?;
        }
        // Colours of the first frame hold for all, so that frames compare.
        let range = *colours.get_or_insert_with(|| disparity_range(&map.disparity));
        let preview = out.path(format!("preview/{name}.png"))?;
        disparity_beside_image(&frame.left, &map.disparity, range)
            .save(&preview)
            .with_context(|| preview.display().to_string())?;
        if let Some(rig) = &rig {
            clouds = true;
            let cloud = Cloud::from_disparity(
                rig,
                &frame.left,
                &map.disparity,
                Some(&map.sigma),
                &DepthLimits::default(),
            )?;
            cloud.write_ply(&out.path(format!("cloud/{name}.ply"))?)?;
        }
        bar.inc(1);
    }
    bar.finish_and_clear();

    let frames = milliseconds.len();
    let (ms_median, ms_p95) = percentiles(milliseconds);
    let summary = Summary {
        frames,
        engine: engine.name(),
        ms_median,
        ms_p95,
        density: density / frames.max(1) as f64,
    };
    out.write_json("summary.json", &summary)?;
    out.finish()?;
    let text = format!(
        "{frames} frames with {}: {ms_median:.1} ms median, {ms_p95:.1} ms p95; {:.1} % of the pixels kept\n{}: disparity/ confidence/ sigma/ preview/{}",
        summary.engine,
        100.0 * summary.density,
        args.out.display(),
        if clouds { " cloud/" } else { "" },
    );
    output.result(&summary, &text)
}

/// Pairs, each with its rig where that is known.
type Frames = Box<dyn ExactSizeIterator<Item = Result<(StereoFrame, Option<RectifiedRig>)>>>;

fn open_frames(args: &Args, output: &Output) -> Result<Frames> {
    if let (Some(left), Some(right)) = (&args.left, &args.right) {
        return single_pair(left, right, args.rig.as_deref(), output);
    }
    let Some(data) = &args.data else {
        bail!("give --data, or --left and --right");
    };
    let source: Arc<dyn StereoSource> = open_checked(data, &args.unchecked, output)?.into();
    let order = match &args.keyframes {
        None => (0..source.len()).collect(),
        Some(list) => select(source.as_ref(), list)?,
    };
    let frames = prefetch(Arc::clone(&source), order, 4);
    Ok(Box::new(frames.map(move |frame| {
        let frame = frame?;
        let rig = *source.frame_rig(frame.index);
        Ok((frame, Some(rig)))
    })))
}

fn single_pair(left: &Path, right: &Path, rig: Option<&Path>, output: &Output) -> Result<Frames> {
    let rig = match rig {
        Some(path) => Some(load_rig(&[path.to_owned()])?.as_rectified().with_context(|| {
            format!("{}: rectified = false\n  cure: put the pair into a folder with this rig, and give --data", path.display())
        })?),
        None => {
            output.notice("no --rig: disparity is written, but no cloud");
            None
        }
    };
    let name = left
        .file_stem()
        .map_or("pair".into(), |s| s.to_string_lossy().into_owned());
    let frame = StereoFrame {
        index: 0,
        name,
        time: 0.0,
        left: read_rgb(left)?,
        right: read_rgb(right)?,
    };
    if let Some(rig) = &rig
        && frame.left.dimensions() != (rig.width as u32, rig.height as u32)
    {
        let (w, h) = frame.left.dimensions();
        bail!(
            "{}: {w} x {h} pixels, but the rig says {} x {}",
            left.display(),
            rig.width,
            rig.height
        );
    }
    Ok(Box::new(std::iter::once(Ok((frame, rig)))))
}

/// Indices of the frames whose names stand in `list`.
fn select(source: &dyn StereoSource, list: &Path) -> Result<Vec<usize>> {
    let text = std::fs::read_to_string(list).with_context(|| list.display().to_string())?;
    let names: Vec<String> = (0..source.len()).map(|i| source.name(i)).collect();
    text.lines()
        .enumerate()
        .map(|(i, line)| (i, line.trim()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
        .map(|(i, line)| {
            names.iter().position(|n| n == line).with_context(|| {
                format!(
                    "{}:{}: there is no frame named \"{line}\"",
                    list.display(),
                    i + 1
                )
            })
        })
        .collect()
}
