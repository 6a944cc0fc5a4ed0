//! Structure from motion by one camera (de Jong 2020, chapter 6).
//!
//! [`StructureFromMotion::track`] takes pairs one by one and reads as the chapter: key points, their matches
//! with the newest view, the essential matrix, the pose, new points, bundle adjustment. Right images serve for
//! one thing only, the length of a metre.
//!
//! Where the chapter is silent: a view after the second is placed by the points that it shares with earlier
//! ones, so that one scale goes through the whole; an image that shows too little motion is placed by them too,
//! but is no view, for its baseline would be all noise; and an image that is discarded lies on the way between
//! its neighbours.
#![allow(non_snake_case)] // A pose's name tells its frames: T_cam_world.

mod config;
mod essential;
mod five_point;
mod follow;
mod klt;
mod scale;
mod scene;
mod sift;

use std::collections::BTreeSet;
use std::ops::Range;
use std::time::Instant;

use barchan_datasets::{Plane, Rgb, StereoFrame, luma};
use barchan_geometry::{RectifiedRig, Se3, StampedPose, Trajectory};
use nalgebra::{Point3, Vector2};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

pub use config::{SfmConfig, TrackKind};
pub use essential::{RayPair, RelativePose, relative_pose};
pub use five_point::five_point;
pub use follow::Border;
use follow::{Follow, Sighting, TrackId};
pub use scale::MetricScale;
use scale::{median, metric_scale, stereo_disparities};
use scene::{Scene, Track, View};

use crate::frame::check_size;
use crate::{Keypoint, PoseEstimate, SlamError, optimise_pose};

/// Fewest points that tell the length of the way of a pair.
const FEWEST_LENGTHS: usize = 5;
/// How near to where a pose puts a point the point is looked for, pixels.
const SEARCH_RADIUS: f64 = 6.0;

/// What became of one frame.
#[derive(Clone, Debug, Serialize)]
pub struct SfmReport {
    /// Index in the sequence.
    pub frame: usize,
    /// Name of the frame.
    pub name: String,
    /// Whether it agrees with the views so far: its pose is known, at the latest when there is a second view.
    /// Else it is discarded, and put between its neighbours.
    pub tracked: bool,
    /// Whether it became a view.
    pub view: bool,
    /// Which beginning it belongs to.
    pub piece: usize,
    /// Matches with the newest view.
    pub matches: usize,
    /// The share of them that agrees with one motion.
    pub inlier_share: f64,
    /// How far things moved since the newest view, rotation aside: the median, pixels.
    pub shift: f64,
    /// Points known before that agree with the pose.
    pub points: usize,
    /// Why it was discarded, is no view yet, or is placed by its pair alone; empty otherwise.
    pub reason: String,
    /// Milliseconds.
    pub ms: f64,
}

/// An image of the reconstruction.
#[derive(Clone, Debug)]
pub struct SfmView {
    /// Index of its frame in the sequence.
    pub frame: usize,
    /// Name of its frame.
    pub name: String,
    /// In metres, where they are known.
    pub pose: StampedPose,
    /// Which beginning it belongs to: how two lie to each other is a guess.
    pub piece: usize,
}

/// A point of the reconstruction.
#[derive(Clone, Debug)]
pub struct SfmPoint {
    /// In metres, where they are known; world frame.
    pub position: Point3<f64>,
    /// sRGB, as the first view saw it.
    pub colour: [u8; 3],
    /// How many views see it.
    pub views: usize,
}

/// What is left when all frames are through. The world is the first view's camera (x right, y down, z forward).
#[derive(Clone, Debug)]
pub struct SfmResult {
    /// Every frame in order, in metres; in units where no scale is known. A discarded frame is on the straight
    /// way between its neighbours.
    pub trajectory: Trajectory,
    /// The same in units of its own; the first two views were begun one apart.
    pub trajectory_up_to_scale: Trajectory,
    /// Which frames were placed by what they see.
    pub tracked: Vec<bool>,
    /// Metres in a unit; `None` when stereo tells of no view.
    pub scale: Option<MetricScale>,
    /// The views.
    pub views: Vec<SfmView>,
    /// The sparse cloud.
    pub points: Vec<SfmPoint>,
}

/// Where a frame is, relative to a view, so that it follows when that one is corrected.
struct Placed {
    time: f64,
    /// The view, and the pose; `None` of a frame that was discarded.
    place: Option<(usize, Se3)>,
}

/// What an image turns out to be.
enum Outcome {
    /// Too little is known of it.
    Discarded(String),
    /// It agrees with the first view, from which too little moved as yet.
    Waiting(Vec<Sighting>, String),
    /// Its pose is known.
    Placed(Se3, Vec<Sighting>),
    /// Its pose is known, and it adds to the scene.
    View(Se3, Vec<Sighting>),
}

/// Reconstructs the way of the left camera, and sparse points.
pub struct StructureFromMotion {
    config: SfmConfig,
    follow: Box<dyn Follow>,
    scene: Scene,
    frames: Vec<Placed>,
    /// Frames since the first view of this piece, while it has no second: what they see of it.
    waiting: Vec<(usize, Vec<Sighting>)>,
    piece: usize,
    /// The first view of this piece. Its camera is the world of the piece.
    first: usize,
    /// Known points that the newest view sees.
    newest_points: usize,
    /// Frames discarded in a row.
    discarded: usize,
    rng: ChaCha8Rng,
}

impl StructureFromMotion {
    /// Structure from motion for the left camera of a rig.
    pub fn new(rig: RectifiedRig, config: SfmConfig) -> Self {
        Self {
            follow: config.follower(),
            scene: Scene {
                rig,
                views: Vec::new(),
                tracks: Default::default(),
            },
            frames: Vec::new(),
            waiting: Vec::new(),
            piece: 0,
            first: 0,
            newest_points: 0,
            discarded: 0,
            rng: ChaCha8Rng::seed_from_u64(config.seed),
            config,
        }
    }

    /// Places one frame against the newest view and the points known so far. One that moved far enough becomes
    /// a view: new points, windowed bundle adjustment. After many that could not be placed all begins anew.
    ///
    /// # Errors
    /// When the frame has not the size of the rig, or the detector fails. A frame that cannot be placed is no
    /// error but a report with a reason.
    pub fn track(&mut self, frame: &StereoFrame) -> Result<SfmReport, SlamError> {
        let started = Instant::now();
        check_size(frame, &self.scene.rig)?;
        let failed = |message| SlamError::Features {
            frame: frame.name.clone(),
            message,
        };
        let grey = luma(&frame.left);
        let seen = self.follow.follow(&grey).map_err(failed)?;
        let mut report = SfmReport {
            frame: frame.index,
            name: frame.name.clone(),
            tracked: true,
            view: false,
            piece: self.piece,
            matches: seen.len(),
            inlier_share: 0.0,
            shift: 0.0,
            points: 0,
            reason: String::new(),
            ms: 0.0,
        };
        self.frames.push(Placed {
            time: frame.time,
            place: None,
        });
        let outcome = match self.scene.views.len() > self.first {
            true => self.look(&seen, &mut report),
            false => Outcome::View(Se3::identity(), Vec::new()),
        };
        match outcome {
            Outcome::View(T_cam_world, kept) => {
                let all = self.follow.begin(&kept).map_err(failed)?;
                if kept.is_empty() && all.len() < self.config.min_matches {
                    self.discard(&mut report, self.too_few(all.len(), "things to follow"));
                } else {
                    self.add_view(frame, &grey, T_cam_world, &kept, &all);
                    (report.view, self.discarded) = (true, 0);
                }
            }
            Outcome::Placed(T_cam_world, kept) => {
                self.follow.accept(&kept);
                self.discarded = 0;
                let newest = self.scene.views.len() - 1;
                self.place(self.frames.len() - 1, newest, T_cam_world);
            }
            Outcome::Waiting(kept, reason) => {
                self.follow.accept(&kept);
                (self.discarded, report.reason) = (0, reason);
                self.waiting.push((self.frames.len() - 1, kept));
            }
            Outcome::Discarded(reason) => {
                self.discard(&mut report, reason);
                if self.discarded > self.config.restart_after {
                    let all = self.follow.begin(&[]).map_err(failed)?;
                    if all.len() >= self.config.min_matches {
                        self.restart();
                        self.add_view(frame, &grey, Se3::identity(), &[], &all);
                        (report.view, report.piece) = (true, self.piece);
                        report.reason +=
                            "; all begins anew here, and how it lies to what was before is a guess";
                    }
                }
            }
        }
        report.ms = started.elapsed().as_secs_f64() * 1e3;
        Ok(report)
    }

    /// What an image is worth, from its matches (de Jong 2020, section 6.2): does one motion since the newest
    /// view explain enough of them; by how much did things move; which pose do points known before agree with?
    fn look(&mut self, seen: &[Sighting], report: &mut SfmReport) -> Outcome {
        let config = &self.config;
        let newest = self.scene.views.len() - 1;
        let since = format!("since frame {}", self.scene.views[newest].name);

        // Matches with the newest view. A thing that it did not see, but one before, is judged by its point.
        let (mut pairs, mut of_pair) = (Vec::<RayPair>::new(), Vec::new());
        let mut kept = Vec::new();
        for sighting in seen {
            if let Some(before) = self.scene.sighting(sighting.track, newest) {
                pairs.push([self.scene.ray(before), self.scene.ray(&sighting.at)]);
                of_pair.push(*sighting);
            } else if self.scene.point(sighting.track).is_some() {
                kept.push(*sighting);
            }
        }
        report.matches = pairs.len();
        if pairs.len() < config.min_matches {
            return Outcome::Discarded(self.too_few(pairs.len(), &format!("matches {since}")));
        }

        // The motion that most agree with; looked for twice, for chance may have played (section 6.2).
        let threshold = config.epipolar_px / self.scene.rig.fx;
        let tries = (0..2).filter_map(|_| relative_pose(&pairs, threshold, &mut self.rng));
        let enough = |pair: &RelativePose| pair.inlier_share() >= config.min_inlier_share;
        let mut best: Option<RelativePose> = None;
        for found in tries {
            let better = |b: &RelativePose| found.inlier_share() > b.inlier_share();
            if best.as_ref().is_none_or(better) {
                best = Some(found);
            }
            if best.as_ref().is_some_and(enough) {
                break;
            }
        }
        let share = best.as_ref().map_or(0.0, RelativePose::inlier_share);
        report.inlier_share = share;
        let Some(pair) = best.filter(enough) else {
            return Outcome::Discarded(format!(
                "{:.0} % of {} matches {since} agree with one motion, {:.0} % are wanted",
                100.0 * share,
                pairs.len(),
                100.0 * config.min_inlier_share
            ));
        };
        let agreeing = || (0..pairs.len()).filter(|k| pair.inliers[*k]);
        kept.extend(agreeing().map(|k| of_pair[k]));

        // By which angle the directions of things changed, the turn of the camera aside.
        let turn = pair.T_second_first.rotation;
        let angles: Vec<f64> = agreeing()
            .map(|k| (turn * pairs[k][0].push(1.0)).angle(&pairs[k][1].push(1.0)))
            .collect();
        let wide = angles
            .iter()
            .filter(|a| **a >= config.min_angle.to_radians());
        let wide = wide.count();
        report.shift = median(angles).unwrap_or(0.0) * self.scene.rig.fx;
        let wanted_shift = config.view_shift * self.scene.rig.width as f64;
        let far_enough = report.shift >= wanted_shift;

        if newest == self.first {
            return if far_enough && wide >= config.min_points {
                Outcome::View(pair.T_second_first, kept)
            } else {
                let reason = format!(
                    "things moved by {:.1} px {since}, {wanted_shift:.1} px are wanted for a second view",
                    report.shift
                );
                Outcome::Waiting(kept, reason)
            };
        }

        // The pose: that of the pair, its length by the points that both see; or as before, when it stands.
        let T_newest_world = self.scene.views[newest].T_cam_world;
        let lengths = agreeing().filter_map(|k| {
            let p_newest = T_newest_world * self.scene.point(of_pair[k].track)?;
            length_of_way(&pair.T_second_first, &p_newest, &pairs[k])
        });
        let lengths: Vec<f64> = lengths.filter(|length| *length > 0.0).collect();
        let by_points = lengths.len();
        let length = median(lengths).filter(|_| by_points >= FEWEST_LENGTHS);
        let length_or_speed = length.unwrap_or_else(|| self.way_since_newest());
        let mut T_by_pair = pair.T_second_first;
        T_by_pair.translation.vector *= length_or_speed;
        let T_by_pair = T_by_pair * T_newest_world;
        let rough = self.best_pose(&kept, &[T_by_pair, self.last_pose()]);
        let holds = |found: &PoseEstimate| {
            found.count() >= config.min_points && 2 * found.count() >= found.inliers.len()
        };
        let holds_rough = holds(&rough);
        let T_rough = if holds_rough {
            rough.T_cam_world
        } else {
            T_by_pair
        };

        // Points that were not found by their looks alone are looked for where the pose puts them.
        let expected = self.expected(&T_rough, &kept);
        kept.extend(self.follow.find(&expected, SEARCH_RADIUS));
        let found = self.best_pose(&kept, &[T_rough]);
        let (tracks, observations) = self.scene.observations(&kept);
        report.points = found.count();
        let T_cam_world = if holds(&found) {
            found.T_cam_world
        } else if far_enough {
            // Too few points go on from here. The pair alone tells all but the length of the way.
            report.reason = format!(
                "only {} of {} points known before agree with one pose: it is that of the pair, the length of the way {}",
                found.count(),
                observations.len(),
                match length {
                    Some(_) => format!("by {by_points} points"),
                    None => "a guess, by the speed before".into(),
                }
            );
            T_by_pair
        } else {
            return Outcome::Discarded(format!(
                "{} of {} points known before agree with one pose, {} are wanted and half of all",
                found.count(),
                observations.len(),
                config.min_points
            ));
        };
        let refused: BTreeSet<TrackId> = (tracks.iter().zip(&observations))
            .filter(|(_, o)| {
                let residual = o.residual(&self.scene.rig, &(T_cam_world * o.point));
                !residual.is_some_and(|r| o.accepts(r.norm_squared()))
            })
            .map(|(track, _)| *track)
            .collect();
        kept.retain(|s| !refused.contains(&s.track));

        let few = (report.points as f64) < config.view_share * self.newest_points as f64;
        match far_enough || few {
            true => Outcome::View(T_cam_world, kept),
            false => Outcome::Placed(T_cam_world, kept),
        }
    }

    /// Every frame through: bundle adjustment of each piece as a whole, metres, and all poses.
    pub fn finish(mut self) -> SfmResult {
        let pieces: Vec<Range<usize>> = (0..=self.piece)
            .map(|piece| {
                let first = self.scene.views.partition_point(|v| v.piece < piece);
                first..self.scene.views.partition_point(|v| v.piece <= piece)
            })
            .filter(|views| !views.is_empty())
            .collect();
        for views in pieces.iter().filter(|_| self.config.global_iterations > 0) {
            self.scene
                .adjust(views.clone(), views.start, self.config.global_iterations);
        }

        // Pieces one after another: each as long as stereo says it is against the first, and begun where the
        // one before ended.
        let scales: Vec<Option<MetricScale>> = (pieces.iter())
            .map(|views| metric_scale(&self.scene, self.scene.views[views.start].piece))
            .collect();
        let factor = |k: usize| scales[k].as_ref().map(|s| s.factor);
        let mut onto_first = vec![(Se3::identity(), 1.0)];
        let mut end = Se3::identity();
        for (k, views) in pieces.iter().enumerate() {
            if k > 0 {
                let longer = factor(k)
                    .zip(factor(0))
                    .map_or(1.0, |(own, first)| own / first);
                onto_first.push((end, longer));
            }
            let last = (self.frames.iter().rev())
                .filter_map(|f| f.place)
                .find(|(view, _)| views.contains(view));
            if let Some(place) = last {
                end = moved(&onto_first[k], &self.T_world_cam(&place));
            }
        }
        let piece_of = |view: usize| pieces.iter().position(|p| p.contains(&view)).unwrap_or(0);
        let T_world_cam =
            |place: &(usize, Se3)| moved(&onto_first[piece_of(place.0)], &self.T_world_cam(place));

        let known = Trajectory {
            poses: (self.frames.iter())
                .filter_map(|f| {
                    Some(StampedPose {
                        time: f.time,
                        T_world_cam: T_world_cam(f.place.as_ref()?),
                    })
                })
                .collect(),
        };
        let nearest_end = |time: f64| {
            let ends = [known.poses.first(), known.poses.last()];
            let distance = |p: &&StampedPose| (p.time - time).abs();
            let nearest = ends
                .into_iter()
                .flatten()
                .min_by(|a, b| distance(a).total_cmp(&distance(b)));
            nearest.map_or_else(Se3::identity, |p| p.T_world_cam)
        };
        let pose = |f: &Placed| StampedPose {
            time: f.time,
            T_world_cam: match &f.place {
                Some(place) => T_world_cam(place),
                None => known.at(f.time).unwrap_or_else(|| nearest_end(f.time)),
            },
        };
        let trajectory_up_to_scale = Trajectory {
            poses: self.frames.iter().map(pose).collect(),
        };

        let scale = scales.first().cloned().flatten();
        let metres = (Se3::identity(), scale.as_ref().map_or(1.0, |s| s.factor));
        let in_metres = |p: &StampedPose| StampedPose {
            time: p.time,
            T_world_cam: moved(&metres, &p.T_world_cam),
        };
        let views = self.scene.views.iter().enumerate();
        let points = self.scene.tracks.values().filter_map(|track| {
            let piece = piece_of(track.sightings.first()?.0);
            let (onto, longer) = &onto_first[piece];
            Some(SfmPoint {
                position: (onto * (track.point? * *longer)) * metres.1,
                colour: track.colour,
                views: track.sightings.len(),
            })
        });
        SfmResult {
            trajectory: Trajectory {
                poses: trajectory_up_to_scale.poses.iter().map(in_metres).collect(),
            },
            tracked: self.frames.iter().map(|f| f.place.is_some()).collect(),
            views: views
                .map(|(index, view)| SfmView {
                    frame: view.frame,
                    name: view.name.clone(),
                    pose: in_metres(&StampedPose {
                        time: view.time,
                        T_world_cam: T_world_cam(&(index, Se3::identity())),
                    }),
                    piece: view.piece,
                })
                .collect(),
            points: points.collect(),
            trajectory_up_to_scale,
            scale,
        }
    }

    /// The frame into the scene: new tracks, new points, windowed bundle adjustment.
    fn add_view(
        &mut self,
        frame: &StereoFrame,
        grey: &Plane,
        T_cam_world: Se3,
        kept: &[Sighting],
        all: &[Sighting],
    ) {
        let images = [grey, &luma(&frame.right)];
        let rig = self.scene.rig;
        let view = View {
            frame: frame.index,
            name: frame.name.clone(),
            time: frame.time,
            piece: self.piece,
            T_cam_world,
            disparities: stereo_disparities(images, kept, &rig, self.config.min_disparity),
        };
        let index = self.scene.views.len();
        self.scene.add(view, all, |at| colour(&frame.left, at));
        self.place(self.frames.len() - 1, index, T_cam_world);
        self.scene.triangulate(self.config.min_angle.to_radians());
        let window = (index + 1)
            .saturating_sub(self.config.window)
            .max(self.first);
        self.scene
            .adjust(window..index + 1, self.first, self.config.window_iterations);
        self.newest_points = self.scene.observations(all).0.len();

        // The first frames are placed by the points that there are now.
        for (waited, seen) in std::mem::take(&mut self.waiting) {
            let views = [self.first, index].map(|v| self.scene.views[v].T_cam_world);
            let found = self.best_pose(&seen, &views);
            if found.count() >= self.config.min_points {
                self.place(waited, self.first, found.T_cam_world);
            }
        }
    }

    /// Notes where a frame is.
    fn place(&mut self, frame: usize, view: usize, T_cam_world: Se3) {
        let T_view_world = self.scene.views[view].T_cam_world;
        self.frames[frame].place = Some((view, T_cam_world * T_view_world.inverse()));
    }

    /// The pose of a frame in the world of its piece.
    fn T_world_cam(&self, (view, T_cam_view): &(usize, Se3)) -> Se3 {
        (T_cam_view * self.scene.views[*view].T_cam_world).inverse()
    }

    /// The pose that most points agree with, from some guesses of it.
    fn best_pose(&self, seen: &[Sighting], guesses: &[Se3]) -> PoseEstimate {
        let (_, observations) = self.scene.observations(seen);
        let found = (guesses.iter())
            .map(|T_guess| optimise_pose(&self.scene.rig, &observations, T_guess))
            .max_by_key(|found| found.count());
        found.unwrap_or(PoseEstimate {
            T_cam_world: Se3::identity(),
            inliers: Vec::new(),
        })
    }

    /// Where a pose puts points that the window's views see and that are not among the sightings.
    fn expected(&self, T_cam_world: &Se3, seen: &[Sighting]) -> Vec<(TrackId, Vector2<f64>)> {
        let seen: BTreeSet<TrackId> = seen.iter().map(|s| s.track).collect();
        let oldest = (self.scene.views.len().saturating_sub(self.config.window)).max(self.first);
        let tracks = self.scene.tracks.iter().filter(|(id, track)| {
            !seen.contains(id) && track.sightings.last().is_some_and(|(v, _)| *v >= oldest)
        });
        let project = |(id, track): (&TrackId, &Track)| {
            let at = self.scene.rig.project(&(T_cam_world * track.point?))?;
            Some((*id, Vector2::new(at.u, at.v)))
        };
        tracks.filter_map(project).collect()
    }

    /// How far the camera went since the newest view, at its speed between the last two views.
    fn way_since_newest(&self) -> f64 {
        let [.., before, newest] = self.scene.views.as_slice() else {
            return 0.0;
        };
        let way = newest.T_cam_world * before.T_cam_world.inverse();
        let now = self.frames.last().map_or(newest.time, |f| f.time);
        let share = (now - newest.time) / (newest.time - before.time);
        // Times of field data jump; a rover does not.
        let share = if share.is_finite() {
            share.clamp(0.0, 5.0)
        } else {
            1.0
        };
        way.translation.vector.norm() * share
    }

    /// Where the camera was last.
    fn last_pose(&self) -> Se3 {
        let last = self.frames.iter().rev().find_map(|f| f.place.as_ref());
        last.map_or_else(Se3::identity, |place| self.T_world_cam(place).inverse())
    }

    fn too_few(&self, count: usize, what: &str) -> String {
        format!("{count} {what}, {} are wanted", self.config.min_matches)
    }

    fn discard(&mut self, report: &mut SfmReport, reason: String) {
        self.discarded += 1;
        (report.tracked, report.reason) = (false, reason);
    }

    /// The next view is the first of a new piece. A lone view, from which nothing could be reconstructed, is
    /// forgotten.
    fn restart(&mut self) {
        self.waiting.clear();
        self.discarded = 0;
        if self.scene.views.len() == self.first + 1 {
            let lone = self.first;
            self.scene.views.pop();
            self.scene
                .tracks
                .retain(|_, t| t.sightings.iter().all(|(v, _)| *v != lone));
            for frame in &mut self.frames {
                frame.place = frame.place.filter(|(view, _)| *view != lone);
            }
        } else {
            self.piece += 1;
            self.first = self.scene.views.len();
        }
    }
}

/// How long the way between two cameras is, from a point whose place in the first is known: least squares of
/// `x_second x (R p_first + s t) = 0`. `None` where the point lies in the direction of the way.
fn length_of_way(T_second_first: &Se3, p_first: &Point3<f64>, pair: &RayPair) -> Option<f64> {
    let ray = pair[1].push(1.0);
    let turned = ray.cross(&(T_second_first.rotation * p_first.coords));
    let along = ray.cross(&T_second_first.translation.vector);
    let length = -turned.dot(&along) / along.norm_squared();
    length.is_finite().then_some(length)
}

/// A pose in a world that is longer by a factor and lies elsewhere.
fn moved((onto, longer): &(Se3, f64), T_world_cam: &Se3) -> Se3 {
    let mut pose = *T_world_cam;
    pose.translation.vector *= *longer;
    onto * pose
}

/// The colour of an image at a key point.
fn colour(image: &Rgb, at: &Keypoint) -> [u8; 3] {
    let pixel = image.get_pixel_checked(at.u.round() as u32, at.v.round() as u32);
    pixel.map_or([0; 3], |p| p.0.map(|value| (value * 255.0).round() as u8))
}
