use std::collections::HashMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_datasets::StereoSource;
use barchan_geometry::StereoPoint;
use barchan_geometry::nalgebra::{Point3, Vector3};
use barchan_infer::{DisparityEngine, Rejection};
use barchan_report::{Chart, Series, Style};
use barchan_terrain::{
    Cloud, DepthLimits, NoiseForm, NoiseModel, NoiseStudy, PlaneLook, PlaneTruth, ScenePlane,
    fit_plane, study_noise,
};
use clap::{Parser, ValueEnum};
use serde::Serialize;

use crate::data::{Unchecked, open_checked};
use crate::engine::{EngineSettings, load_engine};
use crate::output::{Output, StagedDir};

/// Learn how far a depth sensor is off from looks at flat walls; `barchan map --sensor` takes what comes out
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan noise --model sgm --out n     rendered walls: how far the matcher is off\n  \
    barchan noise --data walls/ --model rover --planes planes.csv --out n\n  \
    barchan noise --data kinect/ --form structured-light --out n     disparity/ of the folder is what was measured\n  \
    barchan noise --clouds scans/*.ply --form laser --planes planes.csv --out n\n  \
    barchan map runs/s --sensor n/noise.toml --out map\n\n\
    Each frame or cloud shows one flat board or wall that fills most of it: several distances over the range in use, \
    and at each some tilts up to 60 degrees. Clouds are PLY, LAS or LAZ in the sensor's frame (x right, y down, z ahead). \
    planes.csv says what is true, a line for each that is known: name,distance or name,distance,nx,ny,nz, where distance \
    is the depth at which the optical axis meets the plane, in metres, and n its normal in the sensor's frame. Without \
    it, --model is held against the disparity of DATA where there is one, and everything else against the plane that fits.")]
pub struct Args {
    /// Looks at planes: PATH or FORMAT:PATH [default: rendered walls, synth:planes]
    #[arg(long, conflicts_with = "clouds")]
    data: Option<String>,
    /// What makes disparity: as in `barchan infer` [default: the disparity of DATA; of rendered walls, rover]
    #[arg(long, conflicts_with = "clouds")]
    model: Option<String>,
    /// Clouds in the sensor's frame, one plane each
    #[arg(long, num_args = 1.., value_name = "FILE")]
    clouds: Vec<PathBuf>,
    /// The true planes
    #[arg(long, value_name = "FILE.csv")]
    planes: Option<PathBuf>,
    /// What kind of noise is fitted [default: stereo; of clouds, structured-light]
    #[arg(long, value_enum)]
    form: Option<Form>,
    /// The directory that is written
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    engine: EngineSettings,
    #[command(flatten)]
    unchecked: Unchecked,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Form {
    /// Of disparity and of where it belongs, in pixels
    Stereo,
    /// a + b (z - c)^2 along the optical axis, l z across
    StructuredLight,
    /// One along the beam, a growing one across
    Laser,
}

/// Walls that are rendered where no data are given, at the size of Hong's cameras.
const RENDERED: &str = "synth:planes,seed=7,frames=35,width=484,height=366";

#[derive(Serialize)]
struct Summary {
    looks: usize,
    points: usize,
    outliers: usize,
    model: NoiseModel,
    coefficients: Vec<FittedNumber>,
    /// Root mean square of the logarithm of noise over model.
    misfit: f64,
    /// Metres along the line of sight.
    systematic: f64,
    depths: [f64; 2],
    notices: Vec<String>,
}

#[derive(Serialize)]
struct FittedNumber {
    name: &'static str,
    value: f64,
    /// None where no look could tell and a published value stands.
    deviation: Option<f64>,
}

pub fn run(args: Args, output: &Output, runtime: Option<&Path>) -> Result<()> {
    let truth = args.planes.as_deref().map(read_planes).transpose()?;
    let truth = truth.unwrap_or_default();
    let study = if args.clouds.is_empty() {
        study_of_data(&args, &truth, output, runtime)?
    } else {
        study_of_clouds(&args, &truth)?
    };
    for notice in &study.notices {
        output.notice(notice);
    }

    let out = StagedDir::new(&args.out, "noise.toml")?;
    let rows = rows(&study);
    out.write("noise.toml", file(&study)?)?;
    out.write("noise.csv", table(&rows)?)?;
    out.write("noise.svg", noise_chart(&rows).svg()?)?;
    out.write("systematic.svg", error_chart(&rows).svg()?)?;
    let summary = Summary {
        looks: study.looks.len(),
        points: study.looks.iter().map(|l| l.points).sum(),
        outliers: study.looks.iter().map(|l| l.outliers).sum(),
        model: study.model,
        coefficients: (study.coefficients.iter())
            .map(|c| FittedNumber {
                name: c.name,
                value: c.value,
                deviation: c.deviation,
            })
            .collect(),
        misfit: study.misfit,
        systematic: study.systematic,
        depths: study.depths,
        notices: study.notices.clone(),
    };
    out.write_json("summary.json", &summary)?;
    out.finish()?;
    let mut text = format!(
        "{} looks, {} points, {:.1} % of them outliers; depths from {:.2} to {:.2} m\n",
        summary.looks,
        summary.points,
        100.0 * summary.outliers as f64 / summary.points.max(1) as f64,
        summary.depths[0],
        summary.depths[1],
    );
    for c in &study.coefficients {
        match c.deviation {
            Some(deviation) => writeln!(text, "{:>11} {:.6} +- {deviation:.6}", c.name, c.value)?,
            None => writeln!(text, "{:>11} {:.6} (published)", c.name, c.value)?,
        }
    }
    write!(
        text,
        "the model is right to {:.0} %; systematic error {:.4} m\n{}: noise.toml noise.csv noise.svg systematic.svg",
        100.0 * summary.misfit,
        summary.systematic,
        args.out.display(),
    )?;
    output.result(&summary, &text)
}

fn study_of_data(
    args: &Args,
    truth: &HashMap<String, PlaneTruth>,
    output: &Output,
    runtime: Option<&Path>,
) -> Result<NoiseStudy> {
    let (data, model) = match (&args.data, &args.model) {
        (Some(data), model) => (data.as_str(), model.as_deref()),
        (None, model) => (RENDERED, Some(model.as_deref().unwrap_or("rover"))),
    };
    let source = open_checked(data, &args.unchecked, output)?;
    let mut engine = model
        .map(|model| load_engine(model, runtime, &args.engine))
        .transpose()?;
    let rig = *source.rig();
    let form = match args.form.unwrap_or(Form::Stereo) {
        Form::Stereo => NoiseForm::Stereo {
            focal: rig.fx,
            baseline: rig.baseline,
        },
        Form::StructuredLight => NoiseForm::StructuredLight,
        Form::Laser => NoiseForm::Laser,
    };
    let bar = output.progress("looks", source.len());
    let looks = (0..source.len()).map(|index| {
        bar.inc(1);
        let mut look = look_at(source.as_ref(), index, engine.as_deref_mut())?;
        if let Some(known) = truth.get(&look.name) {
            look.truth = *known;
        }
        Ok::<_, anyhow::Error>(look)
    });
    let study = study_noise(looks, form).with_context(|| data.to_owned())?;
    bar.finish_and_clear();
    Ok(study)
}

/// What an engine makes of a pair, beside the plane that its true disparity shows; without an engine, the disparity
/// that comes with the pair.
fn look_at(
    source: &dyn StereoSource,
    index: usize,
    engine: Option<&mut (dyn DisparityEngine + 'static)>,
) -> Result<PlaneLook> {
    let rig = source.frame_rig(index);
    let frame = source.frame(index)?;
    let stored = source.true_disparity(index)?;
    // Noise itself makes steps, and what it does to them is what is asked for.
    let limits = DepthLimits {
        max_step: f64::INFINITY,
        ..DepthLimits::default()
    };
    let name = frame.name.clone();
    if let Some(engine) = engine {
        let mut map = engine
            .disparity(&frame.left, &frame.right)
            .with_context(|| format!("frame {name}"))?;
        Rejection::default().apply(&frame.left, &frame.right, &mut map);
        let cloud =
            Cloud::from_disparity(rig, &frame.left, &map.disparity, Some(&map.sigma), &limits)?;
        let exact: Vec<Point3<f64>> = stored.map_or_else(Vec::new, |disparity| {
            let pixels = disparity.enumerate_pixels().step_by(7);
            let points = pixels.filter_map(|(u, v, d)| {
                rig.back_project(StereoPoint {
                    u: f64::from(u),
                    v: f64::from(v),
                    d: f64::from(d.0[0]),
                })
            });
            points.collect()
        });
        return Ok(PlaneLook {
            truth: fit_plane(&exact).map_or(PlaneTruth::Unknown, PlaneTruth::Plane),
            name,
            cloud,
        });
    }
    let Some(disparity) = stored else {
        bail!(
            "frame {name}: has no disparity of its own\n  cure: --model makes some, or put what the sensor measured into disparity/"
        );
    };
    // Whether a surface has texture does not matter to a sensor that brings its own.
    let limits = DepthLimits {
        min_contrast: 0.0,
        ..limits
    };
    Ok(PlaneLook {
        cloud: Cloud::from_disparity(rig, &frame.left, &disparity, None, &limits)?,
        truth: PlaneTruth::Unknown,
        name,
    })
}

fn study_of_clouds(args: &Args, truth: &HashMap<String, PlaneTruth>) -> Result<NoiseStudy> {
    let form = match args.form.unwrap_or(Form::StructuredLight) {
        Form::StructuredLight => NoiseForm::StructuredLight,
        Form::Laser => NoiseForm::Laser,
        Form::Stereo => {
            bail!("--form stereo: clouds have no pixels\n  cure: give the pairs as --data")
        }
    };
    let looks = args.clouds.iter().map(|path| {
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        Ok::<_, anyhow::Error>(PlaneLook {
            cloud: Cloud::read(path)?,
            truth: truth.get(name.as_ref()).copied().unwrap_or_default(),
            name: name.into_owned(),
        })
    });
    study_noise(looks, form)
}

/// `name,distance` or `name,distance,nx,ny,nz` a line, after a header.
fn read_planes(file: &Path) -> Result<HashMap<String, PlaneTruth>> {
    let text = std::fs::read_to_string(file).with_context(|| file.display().to_string())?;
    let mut planes = HashMap::new();
    for (number, line) in text.lines().enumerate() {
        if line.trim().is_empty()
            || line.starts_with('#')
            || number == 0 && line.contains("distance")
        {
            continue;
        }
        let mut fields = line.split(',').map(str::trim);
        let name = fields.next().unwrap_or_default();
        let numbers: Result<Vec<f64>, _> = fields.map(str::parse).collect();
        let truth = match numbers.as_deref() {
            Ok(&[distance]) if distance > 0.0 => Some(PlaneTruth::Distance(distance)),
            Ok(&[distance, x, y, z]) => {
                ScenePlane::new(Vector3::new(x, y, z), distance).map(PlaneTruth::Plane)
            }
            _ => None,
        };
        let Some(truth) = truth else {
            bail!(
                "{}, line {}: expected name,distance or name,distance,nx,ny,nz, of a plane ahead",
                file.display(),
                number + 1
            );
        };
        planes.insert(name.to_owned(), truth);
    }
    Ok(planes)
}

/// The model as a file, with what a reader should know of it.
fn file(study: &NoiseStudy) -> Result<String> {
    let mut text = format!(
        "# Noise of a depth sensor, by barchan noise: {} looks, depths from {:.2} to {:.2} m.\n",
        study.looks.len(),
        study.depths[0],
        study.depths[1]
    );
    for c in &study.coefficients {
        match c.deviation {
            Some(deviation) => writeln!(text, "# {} {:.3e} +- {deviation:.1e}", c.name, c.value)?,
            None => writeln!(text, "# {} is published: no look could tell", c.name)?,
        }
    }
    Ok(text + &toml::to_string(&study.model)?)
}

/// A band of depths of one look.
struct Row {
    name: String,
    /// Degrees.
    tilt: f64,
    distance: f64,
    depth: f64,
    points: usize,
    /// All metres along the line of sight.
    error: f64,
    systematic: f64,
    noise: f64,
    model: f64,
}

/// The blocks of each look by depth, a band a quarter of its depth wide.
fn rows(study: &NoiseStudy) -> Vec<Row> {
    let band = |z: f64| (z.ln() / 1.25f64.ln()).floor() as i64;
    let mut blocks: Vec<_> = study.blocks.iter().zip(&study.modelled).collect();
    blocks.sort_by_key(|(b, _)| (b.look, band(b.mean.z)));
    let groups =
        blocks.chunk_by(|(a, _), (b, _)| (a.look, band(a.mean.z)) == (b.look, band(b.mean.z)));
    groups
        .map(|group| {
            let look = &study.looks[group[0].0.look];
            let n = group.len() as f64;
            let mean = |value: &dyn Fn(usize) -> f64| (0..group.len()).map(value).sum::<f64>() / n;
            let scale = |k: usize| group[k].0.depth_per_distance();
            let error = |k: usize| group[k].0.error * scale(k);
            Row {
                name: look.name.clone(),
                tilt: look.tilt.to_degrees(),
                distance: look.distance,
                depth: mean(&|k| group[k].0.mean.z),
                points: group.iter().map(|(b, _)| b.points).sum(),
                error: mean(&error),
                systematic: mean(&|k| error(k).powi(2)).sqrt(),
                noise: mean(&|k| group[k].0.variance * scale(k).powi(2)).sqrt(),
                model: mean(&|k| group[k].1 * scale(k).powi(2)).sqrt(),
            }
        })
        .collect()
}

fn table(rows: &[Row]) -> Result<String> {
    let mut text =
        String::from("name,distance,tilt_deg,depth,points,error,systematic,noise,model\n");
    for r in rows {
        writeln!(
            text,
            "{},{:.4},{:.2},{:.4},{},{:.6},{:.6},{:.6},{:.6}",
            r.name, r.distance, r.tilt, r.depth, r.points, r.error, r.systematic, r.noise, r.model
        )?;
    }
    Ok(text)
}

/// Rows of about one tilt, to the nearest 15 degrees.
fn by_tilt(rows: &[Row]) -> Vec<(i64, Vec<&Row>)> {
    let class = |r: &Row| 15 * (r.tilt / 15.0).round() as i64;
    (0..=6)
        .map(|k| (15 * k, rows.iter().filter(|r| class(r) == 15 * k).collect()))
        .filter(|(_, rows): &(i64, Vec<&Row>)| !rows.is_empty())
        .collect()
}

fn noise_chart(rows: &[Row]) -> Chart {
    let mut series = vec![];
    let classes = by_tilt(rows);
    let last = classes.len().saturating_sub(1);
    for (k, (tilt, rows)) in classes.into_iter().enumerate() {
        // As a share of depth: near looks, which count as much, would else lie on the axis.
        let samples = |value: &dyn Fn(&Row) -> f64| {
            let of = |r: &&Row| (r.depth, 100.0 * value(r) / r.depth);
            let mut samples: Vec<(f64, f64)> = rows.iter().map(of).collect();
            samples.sort_by(|a, b| a.0.total_cmp(&b.0));
            samples
        };
        series.push(Series {
            name: format!("{tilt} degrees"),
            style: Style::Marks,
            samples: samples(&|r| r.noise),
        });
        // Lines of all would hide the marks.
        if k == 0 || k == last {
            series.push(Series {
                name: format!("{tilt} degrees, model"),
                style: Style::Line,
                samples: samples(&|r| r.model),
            });
        }
    }
    Chart {
        title: "Noise along the line of sight".into(),
        horizontal: "depth (m)".into(),
        vertical: "standard deviation (% of depth)".into(),
        plan: false,
        series,
    }
}

fn error_chart(rows: &[Row]) -> Chart {
    let series = by_tilt(rows).into_iter().map(|(tilt, rows)| Series {
        name: format!("{tilt} degrees"),
        style: Style::Marks,
        samples: rows
            .iter()
            .map(|r| (r.depth, 100.0 * r.error / r.depth))
            .collect(),
    });
    Chart {
        title: "Systematic error along the line of sight".into(),
        horizontal: "depth (m)".into(),
        vertical: "mean error (% of depth)".into(),
        plan: false,
        series: series.collect(),
    }
}
