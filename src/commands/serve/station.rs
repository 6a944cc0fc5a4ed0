//! What becomes of a pair: disparity, then the camera's pose and the map, in the order of arrival.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Instant;

use anyhow::{Context, Result};
use barchan_datasets::{Rgb, StereoFrame, parse_rgb, parse_size};
use barchan_geometry::{RectifiedRig, Se3};
use barchan_infer::{DisparityEngine, DisparityMap, InferError, Rejection};
use barchan_slam::{Slam, SlamConfig};
use barchan_terrain::{Cloud, DepthLimits, VoxelMap};
use serde_json::{Value, json};

use super::http::Response;
use super::metrics::Metrics;
use super::ring::{Ring, Run};
use super::settings::Settings;
use super::tiles::Terrain;

/// Everything that the connections share.
pub struct Station {
    rig: RectifiedRig,
    settings: Settings,
    matcher: Mutex<Matcher>,
    tracking: Option<Mutex<Tracking>>,
    terrain: Mutex<Option<Arc<Terrain>>>,
    answers: Mutex<VecDeque<Arc<Answer>>>,
    rate: Mutex<Rate>,
    pub metrics: Arc<Metrics>,
}

/// A pair as it came.
pub struct Pair {
    pub name: Option<String>,
    /// Seconds; without it pairs count as one second apart.
    pub time: Option<f64>,
    pub left: Rgb,
    pub right: Rgb,
}

/// What is answered of a pair.
pub struct Answer {
    pub number: usize,
    pub told: Value,
    /// Disparity without what the pair contradicts, as `barchan infer` writes it.
    pub map: DisparityMap,
}

struct Matcher {
    engine: Box<dyn DisparityEngine>,
    pairs: usize,
    /// Time of the newest pair.
    time: Option<f64>,
}

impl Station {
    /// # Errors
    /// When the folder of runs cannot be used, or a setting makes no sense.
    pub fn new(
        settings: Settings,
        rig: RectifiedRig,
        mut engine: Box<dyn DisparityEngine>,
    ) -> Result<Self> {
        // The first pair should not wait for what is done once.
        engine.warm_up(rig.width as u32, rig.height as u32)?;
        let tracking = (settings.track)
            .then(|| Tracking::new(&settings, rig))
            .transpose()?;
        Ok(Self {
            rig,
            rate: Mutex::new(Rate::new(settings.max_rate)),
            settings,
            matcher: Mutex::new(Matcher {
                engine,
                pairs: 0,
                time: None,
            }),
            tracking: tracking.map(Mutex::new),
            terrain: Mutex::default(),
            answers: Mutex::default(),
            metrics: Arc::default(),
        })
    }

    /// Refuses a pair more than the rate allows.
    ///
    /// # Errors
    /// The refusal.
    pub fn admit(&self) -> Result<(), Response> {
        if locked(&self.rate).take(Instant::now()) {
            return Ok(());
        }
        let message = format!(
            "more than {} pairs a second\n  cure: send fewer, or start the service with a larger --max-rate",
            self.settings.max_rate
        );
        Err(Response::refusal(429, message).retry_after(1))
    }

    /// An image of the rig's size out of a file's bytes; the size is looked at before anything is unpacked.
    ///
    /// # Errors
    /// The refusal.
    pub fn image(&self, name: &str, bytes: &[u8]) -> Result<Rgb, Response> {
        let refuse = |e: &dyn std::fmt::Display| Response::refusal(422, e);
        let size = parse_size(bytes, Path::new(name)).map_err(|e| refuse(&e))?;
        let (width, height) = (self.rig.width as u32, self.rig.height as u32);
        if size != (width, height) {
            return Err(refuse(&format!(
                "{name}: {} x {} pixels, but the rig says {width} x {height}",
                size.0, size.1
            )));
        }
        parse_rgb(bytes, Path::new(name)).map_err(|e| refuse(&e))
    }

    /// Disparity, pose and map of a pair.
    ///
    /// # Errors
    /// The refusal.
    pub fn process(&self, pair: Pair) -> Result<Arc<Answer>, Response> {
        let failed = |e: &dyn std::fmt::Display| Response::refusal(500, e);
        let mut matcher = locked(&self.matcher);
        let time = match (pair.time, matcher.time) {
            (Some(time), Some(last)) if time <= last => {
                let message =
                    format!("time: is {time} s, but the pair before was taken at {last} s");
                return Err(Response::refusal(422, message));
            }
            (Some(time), _) => time,
            (None, last) => last.map_or(0.0, |t| t + 1.0),
        };
        matcher.time = Some(time);
        let number = matcher.pairs;
        matcher.pairs += 1;
        let frame = StereoFrame {
            index: number,
            name: pair.name.unwrap_or_else(|| format!("{number:06}")),
            time,
            left: pair.left,
            right: pair.right,
        };
        let started = Instant::now();
        let dense = matcher.engine.disparity(&frame.left, &frame.right);
        let dense = dense.map_err(|e| failed(&e))?;
        let mut told = json!({ "pair": number, "name": frame.name, "time": time });
        let disparity_time = started.elapsed();

        if let Some(tracking) = &self.tracking {
            // Taken before the matcher is given back: pairs are tracked in their order, one while the
            // disparity of the next is made.
            let mut tracking = locked(tracking);
            drop(matcher);
            let tracked = tracking.track(frame.clone(), dense.clone(), &self.metrics);
            told["track"] = tracked.map_err(|e| failed(&format!("{e:#}")))?;
        } else {
            drop(matcher);
        }
        let mut map = dense;
        told["density"] = Rejection::default()
            .apply(&frame.left, &frame.right, &mut map)
            .into();
        told["ms_disparity"] = (disparity_time.as_secs_f64() * 1e3).into();
        for product in [
            "disparity.png",
            "disparity.pfm",
            "sigma.pfm",
            "confidence.png",
        ] {
            told["products"][product] = format!("/pairs/{number}/{product}").into();
        }
        self.metrics.answered(disparity_time);
        let answer = Arc::new(Answer { number, told, map });
        let mut answers = locked(&self.answers);
        answers.push_back(Arc::clone(&answer));
        if answers.len() > self.settings.keep_answers {
            answers.pop_front();
        }
        Ok(answer)
    }

    /// An answer given before, by its number; the newest without.
    pub fn answer(&self, number: Option<usize>) -> Option<Arc<Answer>> {
        let answers = locked(&self.answers);
        let mut found = answers.iter().rev();
        let wanted = |a: &&Arc<Answer>| number.is_none_or(|n| n == a.number);
        found.find(wanted).cloned()
    }

    /// The map of the run so far.
    ///
    /// # Errors
    /// When there is none yet.
    pub fn terrain(&self) -> Result<Arc<Terrain>> {
        let tracking = self
            .tracking
            .as_ref()
            .context("the camera is not tracked")?;
        // Held while a map is made, so that it is made once.
        let mut terrain = locked(&self.terrain);
        let (voxels, first_pose, keyframes) = {
            let tracking = locked(tracking);
            let known = terrain.as_ref().map(|t| t.keyframes);
            if let (Some(terrain), true) = (&*terrain, known == Some(tracking.keyframes)) {
                return Ok(Arc::clone(terrain));
            }
            let first_pose = tracking.first_pose.context("no key frame yet")?;
            (tracking.voxels.voxels(2), first_pose, tracking.keyframes)
        };
        let made = Terrain::new(voxels, &first_pose, self.settings.cell, keyframes)?;
        Ok(Arc::clone(terrain.insert(Arc::new(made))))
    }

    /// Ends the run in hand and waits until every run is on disk.
    pub fn finish(&self) {
        if let Some(tracking) = &self.tracking {
            let mut tracking = locked(tracking);
            tracking.end_run(&self.metrics);
            for writer in std::mem::take(&mut tracking.writers) {
                // One that panicked has said so.
                let _ = writer.join();
            }
        }
    }
}

/// A panic in one request, which should not be, is not the end of all others.
pub fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The engine of the service's SLAM: hands on the disparity that was made of the same pair already.
struct Handed(Arc<Mutex<Option<DisparityMap>>>);

impl DisparityEngine for Handed {
    fn name(&self) -> String {
        "handed".into()
    }

    fn disparity(&mut self, _: &Rgb, _: &Rgb) -> Result<DisparityMap, InferError> {
        locked(&self.0).take().ok_or_else(|| InferError::Failed {
            engine: self.name(),
            message: "asked twice for the disparity of one pair".into(),
        })
    }
}

/// The camera's way and what it saw, run after run.
struct Tracking {
    rig: RectifiedRig,
    settings: Settings,
    slam: Slam,
    handed: Arc<Mutex<Option<DisparityMap>>>,
    /// Pairs of this run.
    frames: usize,
    /// Key frames of all runs: what is new since a map was made.
    keyframes: usize,
    first_pose: Option<Se3>,
    voxels: VoxelMap,
    ring: Option<Ring>,
    /// The run in hand; `None` where nothing is written, or it could not be.
    run: Option<Run>,
    /// How often a run was begun.
    number: usize,
    /// Key frames of this run.
    run_keyframes: usize,
    /// Finish the runs before.
    writers: Vec<JoinHandle<()>>,
}

/// A run of more key frames is recorded without the adjustment of its whole map: where all of them see the same, as
/// when a rover works in one place, its time grows with the cube of their number and takes minutes from here on.
const MOST_ADJUSTED: usize = 600;

impl Tracking {
    fn new(settings: &Settings, rig: RectifiedRig) -> Result<Self> {
        let ring = (settings.runs.as_ref())
            .map(|folder| Ring::open(folder, settings.keep_runs))
            .transpose()?;
        let handed = Arc::default();
        Ok(Self {
            rig,
            slam: begin(settings, rig, &handed),
            handed,
            frames: 0,
            keyframes: 0,
            first_pose: None,
            voxels: VoxelMap::new(settings.voxel)?,
            ring,
            run: None,
            number: 0,
            run_keyframes: 0,
            writers: vec![],
            settings: settings.clone(),
        })
    }

    /// Places a pair, adds it to map and run, and says what became of it.
    fn track(
        &mut self,
        mut frame: StereoFrame,
        dense: DisparityMap,
        metrics: &Arc<Metrics>,
    ) -> Result<Value> {
        if self.frames == 0 {
            self.begin_run(metrics);
        }
        // Frames of a run count from 0, as those of a sequence.
        frame.index = self.frames;
        self.frames += 1;
        *locked(&self.handed) = Some(dense);
        let report = self.slam.track(frame)?;
        let pose = self.slam.pose().map(|p| p.T_world_cam);
        let mapped = report.mapped.last();
        let dense = mapped.and_then(|m| Some((&m.left, m.dense.as_ref()?)));
        if let (Some((left, dense)), Some(pose)) = (dense, pose) {
            let limits = DepthLimits::default();
            let sigma = Some(&dense.sigma);
            let cloud = Cloud::from_disparity(&self.rig, left, &dense.disparity, sigma, &limits)?;
            self.voxels.insert(&cloud.transform(&pose));
            self.first_pose.get_or_insert(pose);
            self.keyframes += 1;
            self.run_keyframes += 1;
        }
        if let Some(run) = &mut self.run
            && let Err(e) = run.add(&report)
        {
            self.run = None;
            metrics.run_failed(&e);
        }
        metrics.tracked(&report);
        let matrix = pose.map(|p| p.to_homogeneous());
        let rows = matrix.map(|m| [0, 1, 2].map(|r| [0, 1, 2, 3].map(|c| m[(r, c)])));
        let told = json!({
            "run": self.number,
            "frame": report.frame,
            "tracked": report.tracked,
            "reason": report.reason,
            "keyframe": report.keyframe,
            "inliers": report.inliers,
            "loops": mapped.map_or(0, |m| m.loops.iter().filter(|l| l.proved).count()),
            "T_world_cam": rows,
            "ms": report.ms_track,
        });
        // A map that begins anew after the camera was lost is another run: nobody knows how they lie.
        let anew = !report.tracked && report.keyframe;
        if anew || self.frames >= self.settings.frames_per_run {
            self.end_run(metrics);
        }
        Ok(told)
    }

    fn begin_run(&mut self, metrics: &Arc<Metrics>) {
        self.number += 1;
        // Till now the map of the run before could be asked for.
        self.first_pose = None;
        if let Ok(empty) = VoxelMap::new(self.settings.voxel) {
            self.voxels = empty;
        }
        let begun = (self.ring.as_mut()).map(|ring| ring.begin(&self.rig, &self.settings.slam));
        match begun.transpose() {
            Ok(run) => self.run = run,
            // A full disk ends the record, not the service.
            Err(e) => metrics.run_failed(&e),
        }
    }

    /// Hands the run to a thread that finishes it, and makes everything ready for the next. Nobody waits for it.
    fn end_run(&mut self, metrics: &Arc<Metrics>) {
        let slam = begin(&self.settings, self.rig, &self.handed);
        let mut slam = std::mem::replace(&mut self.slam, slam);
        self.frames = 0;
        let keyframes = std::mem::take(&mut self.run_keyframes);
        let (Some(run), Some(folder)) = (self.run.take(), self.settings.runs.clone()) else {
            return;
        };
        self.writers.retain(|writer| !writer.is_finished());
        // One at a time is adjusted: runs that come faster than that are written as they were answered.
        if keyframes > MOST_ADJUSTED || !self.writers.is_empty() {
            slam = slam.without_last_adjustment();
        }
        let (keep, metrics) = (self.settings.keep_runs, Arc::clone(metrics));
        self.writers.push(std::thread::spawn(move || {
            let written = run.finish(&slam.finish());
            match written.and_then(|some| Ring::prune(&folder, keep).map(|()| some)) {
                Ok(some) => metrics.run_written(some),
                Err(e) => metrics.run_failed(&e),
            }
        }));
    }
}

fn begin(
    settings: &Settings,
    rig: RectifiedRig,
    handed: &Arc<Mutex<Option<DisparityMap>>>,
) -> Slam {
    let engine = Box::new(Handed(Arc::clone(handed)));
    let config = SlamConfig {
        // The disparity is there already, and an answer tells the pose with the map's last word.
        map_lag: 0,
        ..settings.slam.clone()
    };
    Slam::new(rig, config, Some(engine))
}

/// A bucket that fills at a rate and holds the pairs of one second.
struct Rate {
    rate: f64,
    left: f64,
    filled: Instant,
}

impl Rate {
    fn new(rate: f64) -> Self {
        Self {
            rate,
            left: rate.max(1.0),
            filled: Instant::now(),
        }
    }

    fn take(&mut self, now: Instant) -> bool {
        let since = now.saturating_duration_since(self.filled).as_secs_f64();
        self.left = (self.left + since * self.rate).min(self.rate.max(1.0));
        self.filled = now;
        let some = self.left >= 1.0;
        self.left -= f64::from(u8::from(some));
        some
    }
}
