use std::fmt::{Display, Formatter};
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use barchan_geometry::nalgebra::{UnitQuaternion, Vector3};
use barchan_geometry::{Se3, StampedPose, Trajectory};
#[cfg(feature = "rerun")]
use barchan_report::RerunRecording;
use barchan_report::{FoxgloveRecording, Recording};
use barchan_terrain::{Cloud, DenseKeyframe, DepthLimits};
use clap::Parser;
use serde::Serialize;

use crate::commands::report::{parts, relief};
use crate::output::{Output, StagedFile};
use crate::preview::{bytes, disparity_picture, disparity_range};
use crate::slam_run::{RunKeyframe, SlamRun};

/// A run to be played in a viewer: route, images, disparity, points, relief over time
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan view demo --mcap demo.mcap     for Foxglove: open it there, and look at frame \"map\"\n  \
    barchan view runs/s --map map/ --mcap day1.mcap --points 50000\n  \
    barchan view runs/s --map map/     in Rerun, where this program is built with it\n\n\
    Frames: \"map\" (z up) holds \"world\" (that of the run), which holds \"camera\" (x right, y down, z forward).\n\
    Topics: /tf, /route, /keyframes, /camera/left, /camera/disparity, /camera/calibration, /camera/points, \
    and of the map /map/cloud and /map/relief.")]
pub struct Args {
    /// A run of `barchan slam`, or the folder of a demo with `slam` and `map` in it
    run: PathBuf,
    /// What `barchan map` made of it
    #[arg(long, value_name = "DIR")]
    map: Option<PathBuf>,
    /// Writes an MCAP file, which Foxglove plays
    #[arg(long, value_name = "FILE")]
    mcap: Option<PathBuf>,
    /// Writes a file for Rerun, in builds with `--features rerun`; without --mcap and --save its viewer is opened
    #[arg(long, value_name = "FILE.rrd")]
    save: Option<PathBuf>,
    /// Most points of a key frame
    #[arg(long, value_name = "COUNT", default_value_t = 10_000)]
    points: usize,
    /// Most points of the map's cloud
    #[arg(long, value_name = "COUNT", default_value_t = 1_000_000)]
    map_points: usize,
}

#[derive(Serialize)]
struct Summary {
    out: PathBuf,
    bytes: u64,
    frames: usize,
    keyframes: usize,
}

pub fn run(args: Args, output: &Output) -> Result<()> {
    let scene = Scene::open(&args)?;
    let mut written = vec![];
    if let Some(out) = &args.mcap {
        let begin = |path: &Path| -> Result<Box<dyn Recording>> {
            let file = File::create(path).with_context(|| out.display().to_string())?;
            Ok(Box::new(FoxgloveRecording::new(BufWriter::new(file))?))
        };
        written.push(scene.write(out, begin, output)?);
    }
    if let Some(out) = &args.save {
        written.push(scene.write(out, rerun_file, output)?);
    }
    if written.is_empty() {
        scene.tell(rerun_viewer()?, output)?;
        output.notice("the run is in the viewer");
    }
    let text: Vec<String> = written.iter().map(Summary::to_string).collect();
    output.result(&written, &text.join("\n"))
}

#[cfg(feature = "rerun")]
fn rerun_file(path: &Path) -> Result<Box<dyn Recording>> {
    Ok(Box::new(RerunRecording::save(path)?))
}

#[cfg(feature = "rerun")]
fn rerun_viewer() -> Result<Box<dyn Recording>> {
    let viewer = RerunRecording::spawn().context(
        "the viewer does not start\n  cure: `pip install rerun-sdk==0.36.*` installs it",
    )?;
    Ok(Box::new(viewer))
}

#[cfg(not(feature = "rerun"))]
fn rerun_file(_: &Path) -> Result<Box<dyn Recording>> {
    bail!(
        "this program is built without Rerun\n  cure: `cargo install --path . --features rerun` builds it with; or --mcap FILE writes what Foxglove plays"
    )
}

#[cfg(not(feature = "rerun"))]
fn rerun_viewer() -> Result<Box<dyn Recording>> {
    rerun_file(Path::new(""))
}

impl Display for Summary {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{}: {} frames, {} key frames, {:.1} MB",
            self.out.display(),
            self.frames,
            self.keyframes,
            self.bytes as f64 / 1e6
        )
    }
}

/// What there is of a run to be seen.
#[allow(non_snake_case)]
struct Scene {
    trajectory: Trajectory,
    /// Key frames with disparity; the methods that look for none leave none.
    dense: Option<SlamRun>,
    map: Option<PathBuf>,
    /// Maps the run's world to one whose z is up.
    T_map_world: Se3,
    points: usize,
    map_points: usize,
}

/// A frame, and its images where it is a key frame.
struct Moment<'a> {
    pose: StampedPose,
    keyframe: Option<&'a RunKeyframe>,
}

impl Scene {
    fn open(args: &Args) -> Result<Self> {
        let (run, map) = parts(&args.run, args.map.clone())?;
        let trajectory = Trajectory::read_tum(&run.join("trajectory.tum"))?;
        let dense = (run.join("keyframes/disparity").is_dir())
            .then(|| SlamRun::open(&run))
            .transpose()?;
        #[allow(non_snake_case)]
        let T_map_world = match &map {
            Some(map) => levelled(&trajectory, &map.join("keyframes.tum"))?,
            // Only the run can say what is up: its first camera is taken for level.
            None => Se3::from_parts(
                Vector3::zeros().into(),
                UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -std::f64::consts::FRAC_PI_2),
            ),
        };
        Ok(Self {
            trajectory,
            dense,
            map,
            T_map_world,
            points: args.points,
            map_points: args.map_points,
        })
    }

    /// Tells all of it into a file, which appears whole or not at all.
    fn write(
        &self,
        out: &Path,
        begin: impl FnOnce(&Path) -> Result<Box<dyn Recording>>,
        output: &Output,
    ) -> Result<Summary> {
        let staged = StagedFile::new(out);
        let counts = self.tell(begin(staged.path())?, output);
        let [frames, keyframes] = counts.with_context(|| out.display().to_string())?;
        Ok(Summary {
            bytes: staged.finish()?,
            out: out.to_owned(),
            frames,
            keyframes,
        })
    }

    /// Frames and key frames in the order of time, each moment once.
    fn moments(&self) -> Vec<Moment<'_>> {
        let frames = self.trajectory.poses.iter().map(|pose| Moment {
            pose: *pose,
            keyframe: None,
        });
        let keyframes = self.dense.iter().flat_map(|run| &run.keyframes);
        let keyframes = keyframes.map(|k| Moment {
            pose: k.pose,
            keyframe: Some(k),
        });
        let mut moments: Vec<Moment> = frames.chain(keyframes).collect();
        moments.sort_by(|a, b| a.pose.time.total_cmp(&b.pose.time));
        moments.dedup_by(|later, kept| {
            let same = later.pose.time == kept.pose.time;
            if same {
                kept.keyframe = kept.keyframe.or(later.keyframe);
            }
            same
        });
        moments
    }

    /// Tells all of it; the number of frames and of key frames.
    fn tell(&self, mut to: Box<dyn Recording>, output: &Output) -> Result<[usize; 2]> {
        let moments = self.moments();
        // Recordings have no time before 1970: sequences may, whose clock starts with them.
        let first = moments.first().map_or(0.0, |m| m.pose.time);
        let time = |pose: &StampedPose| pose.time - first.min(0.0);
        let start = first.max(0.0);

        to.transform(start, "map", "world", &self.T_map_world)?;
        let poses = |poses: &mut dyn Iterator<Item = &StampedPose>| -> Vec<Se3> {
            poses.map(|p| p.T_world_cam).collect()
        };
        let way = poses(&mut self.trajectory.poses.iter());
        to.route(start, "/route", "world", &way)?;
        if let Some(run) = &self.dense {
            let places = poses(&mut run.keyframes.iter().map(|k| &k.pose));
            to.route(start, "/keyframes", "world", &places)?;
        }
        if let Some(map) = &self.map {
            let cloud = Cloud::read_ply(&map.join("cloud.ply"))?.points;
            let every = cloud.len().div_ceil(self.map_points.max(1)).max(1);
            let some: Vec<_> = cloud.into_iter().step_by(every).collect();
            to.cloud(start, "/map/cloud", "map", &some)?;
            to.relief(start, "/map/relief", "map", &relief(map)?)?;
        }

        let bar = output.progress("view", moments.len());
        let mut keyframes = 0;
        for moment in &moments {
            let time = time(&moment.pose);
            to.transform(time, "world", "camera", &moment.pose.T_world_cam)?;
            if let (Some(run), Some(keyframe)) = (&self.dense, moment.keyframe) {
                self.tell_keyframe(&mut *to, time, run, &run.read(keyframe)?)?;
                keyframes += 1;
            }
            bar.inc(1);
        }
        bar.finish_and_clear();
        to.finish()?;
        Ok([moments.len(), keyframes])
    }

    fn tell_keyframe(
        &self,
        to: &mut dyn Recording,
        time: f64,
        run: &SlamRun,
        keyframe: &DenseKeyframe,
    ) -> Result<()> {
        let (left, disparity) = (&keyframe.left, &keyframe.disparity);
        let picture = disparity_picture(disparity, disparity_range(disparity));
        to.camera(time, "/camera/calibration", "camera", &run.rig)?;
        to.image(time, "/camera/left", "camera", &bytes(left))?;
        to.image(time, "/camera/disparity", "camera", &picture)?;
        let pixels = (run.rig.width * run.rig.height) as f64;
        let limits = DepthLimits {
            stride: (pixels / self.points.max(1) as f64).sqrt().ceil().max(1.0) as usize,
            ..DepthLimits::default()
        };
        let sigma = keyframe.sigma.as_ref();
        let cloud = Cloud::from_disparity(&run.rig, left, disparity, sigma, &limits)?;
        Ok(to.cloud(time, "/camera/points", "camera", &cloud.points)?)
    }
}

/// Maps the world of a run to that of its map, whose key frames are the run's.
fn levelled(run: &Trajectory, map: &Path) -> Result<Se3> {
    let places = Trajectory::read_tum(map)?;
    let both = places.poses.iter().find_map(|p| {
        let same = |q: &&StampedPose| (q.time - p.time).abs() < 1e-6;
        Some((p, run.poses.iter().find(same)?))
    });
    let Some((place, pose)) = both else {
        bail!(
            "{}: none of its times is that of a frame of the run\n  cure: give the map that `barchan map` made of this run",
            map.display()
        );
    };
    Ok(place.T_world_cam * pose.T_world_cam.inverse())
}
