use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_datasets::{
    StereoSource, Synth, open, synth, write_folder, write_katwijk, write_synth,
};
use barchan_terrain::{Grid, Raster};
use clap::{Parser, ValueEnum};

use super::written;
use crate::output::Output;

/// Write a rendered traverse (or any other data) in `folder` layout
#[derive(Parser)]
#[command(after_help = format!("Examples:\n  \
    barchan data synth synth:seed=1,frames=40 --out data\n  \
    barchan data synth synth:route=survey,look=moon,frames=300 --out survey\n  \
    barchan data synth synth:dem=yard.tif,frames=100 --out yard\n  \
    barchan data synth synth:frames=1000,width=256,height=192 --random-scenes --out shapes\n  \
    barchan data synth synth:width=1024,height=768,rectified=false,bloom=1 --layout katwijk --out part1\n\n\
    Options after synth:, by commas\n{}", synth::OPTIONS))]
pub struct Args {
    /// What to render: synth:seed=N,frames=N,... as below
    data: String,
    /// Random shapes for pretraining instead of a traverse, as synth:scenes,... gives any command
    #[arg(long)]
    random_scenes: bool,
    /// Which files a traverse is written as
    #[arg(long, value_enum, default_value = "folder")]
    layout: Layout,
    /// With --layout katwijk: seconds that images are ahead of the fixes
    #[arg(
        long,
        value_name = "SECONDS",
        default_value_t = 0.0,
        allow_negative_numbers = true
    )]
    images_ahead: f64,
    /// The directory that is written
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Layout {
    Folder,
    Katwijk,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    let Args {
        data,
        random_scenes,
        layout,
        images_ahead,
        out,
    } = args;
    let options = match data.as_str() {
        "synth" => Some(""),
        other => other.strip_prefix("synth:"),
    };
    let kind = options.and_then(|options| options.split(',').next());
    let scenes = matches!(kind, Some("scenes" | "planes"));
    let data = match options {
        Some(options) if random_scenes && !scenes => format!("synth:scenes,{options}"),
        None if random_scenes => {
            bail!("{data}: --random-scenes goes with synth:seed=N,frames=N,...")
        }
        _ => data.clone(),
    };
    let traverse = options.filter(|_| !scenes && !random_scenes);
    let Some(options) = traverse else {
        if layout != Layout::Folder {
            bail!("{data}: --layout katwijk goes with synth:seed=N,frames=N,...");
        }
        let source = open(&data)?;
        let bar = output.progress("render", source.len());
        write_folder(source.as_ref(), &out, |done| bar.set_position(done as u64))?;
        bar.finish_and_clear();
        return written(source.as_ref(), out, "", output);
    };
    let traverse = Synth::parse(options)?;
    let bar = output.progress("render", traverse.len());
    let tell = |done| bar.set_position(done as u64);
    if layout == Layout::Katwijk {
        write_katwijk(&traverse, &out, images_ahead, tell)?;
        bar.finish_and_clear();
        let frames = traverse.len();
        let text = format!(
            "{frames} pairs in {}: a part of the Katwijk archive",
            out.display()
        );
        return output.result(&super::Written { frames, out }, &text);
    }
    write_synth(&traverse, &out, tell)?;
    bar.finish_and_clear();
    write_ground(&traverse, &out.join("dem.tif"))?;
    written(&traverse, out, ", the ground as dem.tif", output)
}

/// The true ground, rocks and all, around the drive.
fn write_ground(traverse: &Synth, path: &Path) -> Result<()> {
    /// Metres around the drive.
    const AROUND: f64 = 8.0;
    /// Most cells along a side; larger ground has larger cells.
    const MOST: f64 = 2000.0;
    let Some(truth) = traverse.true_trajectory() else {
        return Ok(());
    };
    let (mut low, mut high) = ([f64::MAX; 2], [f64::MIN; 2]);
    for pose in &truth.poses {
        let at = pose.T_world_cam.translation.vector;
        for (axis, value) in [at.x, at.y].into_iter().enumerate() {
            low[axis] = low[axis].min(value - AROUND);
            high[axis] = high[axis].max(value + AROUND);
        }
    }
    let extent = (high[0] - low[0]).max(high[1] - low[1]);
    // Whole centimetres, and the borders on whole cells.
    let cell = (extent / MOST * 100.0).ceil().max(2.0) / 100.0;
    let (west, north) = (
        (low[0] / cell).floor() * cell,
        (high[1] / cell).ceil() * cell,
    );
    let grid = Grid {
        width: ((high[0] - west) / cell).ceil() as usize,
        height: ((north - low[1]) / cell).ceil() as usize,
        west,
        north,
        cell_x: cell,
        cell_y: cell,
    };
    let cells = (0..grid.height).flat_map(|row| (0..grid.width).map(move |column| (column, row)));
    let height = |(column, row)| {
        let (x, y) = grid.centre(column, row);
        traverse.ground_height(x, y) as f32
    };
    let raster = Raster {
        values: cells.map(height).collect(),
        crs: None,
        grid,
    };
    raster
        .write(path)
        .with_context(|| path.display().to_string())
}
