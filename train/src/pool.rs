use std::iter::repeat_with;
use std::sync::{Arc, Mutex, PoisonError};

use barchan_datasets::{DataError, Plane, Prefetch, StereoFrame, StereoSource, prefetch_with};
use barchan_geometry::{Se3, Trajectory};
use barchan_infer::{DisparityEngine, SemiGlobal};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::augment::Flips;
use crate::batch::{Moment, Sample};
use crate::{TrainConfig, TrainError};

/// Smallest side of an image that can be trained on: the windows of the terms need some.
const SMALLEST: u32 = 16;

/// Keeps the draws of flips apart from those of crops, which use the same seed.
const FLIPS: u64 = 0x666c_6970;

/// Several sources as one, frame after frame, with what else a configuration wants of each.
pub(crate) struct Pool {
    /// Each with what it was opened by.
    sources: Vec<(String, Box<dyn StereoSource>)>,
    config: TrainConfig,
    /// Matchers not in use: their memory is kept.
    matchers: Mutex<Vec<SemiGlobal>>,
}

/// A whole pair, and its true disparity where that is known.
pub(crate) type Whole = (StereoFrame, Option<Plane>);

impl Pool {
    /// # Errors
    /// When there are no frames, or neighbours are wanted of a source without poses.
    pub fn new(
        sources: Vec<Box<dyn StereoSource>>,
        config: &TrainConfig,
    ) -> Result<Self, TrainError> {
        if sources.iter().all(|s| s.is_empty()) {
            return Err(TrainError::Config("there are no frames to train on".into()));
        }
        let specs = config.data.iter().cloned().chain(repeat_with(String::new));
        let sources: Vec<_> = specs.zip(sources).collect();
        if config.loss.neighbours > 0 {
            for (data, source) in &sources {
                check_poses(source.true_trajectory()).map_err(|found| {
                    TrainError::Config(format!(
                        "loss: neighbours need the pose of every frame, and {data} has {found}\n  cure: `barchan slam --data {data} --out RUN` makes some: put its trajectory.tum beside the images as groundtruth.tum; or leave neighbours away"
                    ))
                })?;
            }
        }
        Ok(Self {
            sources,
            config: config.clone(),
            matchers: Mutex::default(),
        })
    }

    /// How many frames there are.
    pub fn len(&self) -> usize {
        self.sources.iter().map(|(_, s)| s.len()).sum()
    }

    /// Reads (or renders) pairs on threads ahead of their use, in the order asked for: as they are,
    /// with truth where there is any.
    pub fn whole(self: &Arc<Self>, order: Vec<usize>) -> Prefetch<Whole, TrainError> {
        let pool = Arc::clone(self);
        let read = move |index| {
            let (_, source, local) = pool.find(index)?;
            Ok((pool.frame(index)?, source.true_disparity(local)?))
        };
        prefetch_with(read, order, 2)
    }

    /// The same for training: pairs with all that is wanted of them, so that reading, rendering and
    /// matching overlap with it. `order` holds the number of the draw and the frame: what a draw gives
    /// depends on its number and the seed only, so that a resumed run sees what an uninterrupted one would.
    pub fn training(
        self: &Arc<Self>,
        order: Vec<(u64, usize)>,
        ahead: usize,
    ) -> Prefetch<Sample, TrainError> {
        let pool = Arc::clone(self);
        let places = (0..order.len()).collect();
        let read = move |place: usize| {
            let (draw, index) = order[place];
            let mut rng = ChaCha8Rng::seed_from_u64(pool.config.seed ^ FLIPS);
            rng.set_stream(draw);
            pool.sample(index, pool.config.augmentation.draw_flips(&mut rng))
        };
        prefetch_with(read, places, ahead)
    }

    /// A frame turned by `flips`, with all that is wanted of it.
    fn sample(&self, index: usize, mut flips: Flips) -> Result<Sample, TrainError> {
        let (_, source, local) = self.find(index)?;
        let frame = self.frame(index)?;
        if frame.left.width().min(frame.left.height()) < SMALLEST {
            return Err(TrainError::Config(format!(
                "{}: {} x {} pixels are too few to train on, {SMALLEST} x {SMALLEST} are needed",
                frame.name,
                frame.left.width(),
                frame.left.height()
            )));
        }
        let mut truth = None;
        if self.config.supervised && flips.swap {
            truth = source.true_disparity_right(local)?;
            flips.swap = truth.is_some();
        }
        if self.config.supervised && !flips.swap {
            truth = source.true_disparity(local)?;
        }
        let neighbours = match self.config.loss.neighbours {
            0 => vec![],
            n => vec![
                neighbour(source, &frame, local, local.checked_sub(n))?,
                neighbour(source, &frame, local, local.checked_add(n))?,
            ],
        };
        let (frame, truth) = flips.apply(frame, truth);
        let proxy = match self.config.loss.proxies > 0.0 {
            true => Some(self.proxy(&frame)?),
            false => None,
        };
        Ok(Sample {
            rig: *source.frame_rig(local),
            truth,
            proxy,
            neighbours,
            frame,
        })
    }

    /// Disparity of whole images by semi-global matching, NaN where left and right disagree.
    fn proxy(&self, frame: &StereoFrame) -> Result<Plane, TrainError> {
        let matchers = || self.matchers.lock().unwrap_or_else(PoisonError::into_inner);
        let idle = matchers().pop();
        let range = self.config.net.max_disparity;
        let mut matcher = idle.unwrap_or_else(|| SemiGlobal::new(Some(range)));
        let map = matcher.disparity(&frame.left, &frame.right)?;
        matchers().push(matcher);
        Ok(map.disparity)
    }

    /// Frame `index` of all, its name completed by the data it is of.
    fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
        let (spec, source, local) = self.find(index)?;
        let frame = source.frame(local)?;
        Ok(StereoFrame {
            index,
            name: match spec {
                "" => frame.name,
                spec => format!("{} of {spec}", frame.name),
            },
            ..frame
        })
    }

    /// What frame `index` of all is of, and its number there.
    fn find(&self, mut index: usize) -> Result<(&str, &dyn StereoSource, usize), DataError> {
        for (spec, source) in &self.sources {
            if index < source.len() {
                return Ok((spec, source.as_ref(), index));
            }
            index -= source.len();
        }
        Err(DataError::Layout {
            spec: "training data".into(),
            message: "no frame of that number".into(),
        })
    }
}

/// What the left camera saw at frame `other`, if there is such a frame and both poses are known.
#[allow(non_snake_case)]
fn neighbour(
    source: &dyn StereoSource,
    frame: &StereoFrame,
    local: usize,
    other: Option<usize>,
) -> Result<Option<Moment>, DataError> {
    let Some(other) = other.filter(|other| *other < source.len()) else {
        return Ok(None);
    };
    // Of mixed calibrations the projection would have to know both.
    if source.frame_rig(other) != source.frame_rig(local) {
        return Ok(None);
    }
    let Some(trajectory) = source.true_trajectory() else {
        return Ok(None);
    };
    let next = source.frame(other)?;
    let pose = |index: usize, time: f64| -> Option<Se3> {
        if trajectory.poses.len() == source.len() {
            return Some(trajectory.poses[index].T_world_cam);
        }
        trajectory.at(time)
    };
    let poses = pose(local, frame.time).zip(pose(other, next.time));
    Ok(poses.map(|(T_world_frame, T_world_neighbour)| Moment {
        image: next.left,
        T_neighbour_frame: T_world_neighbour.inverse() * T_world_frame,
    }))
}

/// Refuses a trajectory that knows no orientation; says what was found.
fn check_poses(trajectory: Option<&Trajectory>) -> Result<(), &'static str> {
    match trajectory {
        None => Err("no poses"),
        Some(t) if t.poses.len() < 2 => Err("fewer than two poses"),
        // A camera on a rover is never oriented as the world is, whose z is up.
        Some(t)
            if t.poses
                .iter()
                .all(|p| p.T_world_cam.rotation.angle() < 1e-9) =>
        {
            Err("positions without orientations")
        }
        Some(_) => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use barchan_datasets::Synth;
    use barchan_geometry::{RectifiedRig, StampedPose};
    use barchan_model::Preset;

    fn pool(
        source: impl StereoSource + 'static,
        change: fn(&mut TrainConfig),
    ) -> Result<Arc<Pool>, TrainError> {
        let mut config = TrainConfig::new(Preset::Tiny.config());
        config.data = vec!["some/images".into()];
        change(&mut config);
        Ok(Arc::new(Pool::new(vec![Box::new(source)], &config)?))
    }

    const UNTURNED: Flips = Flips {
        vertical: false,
        swap: false,
    };

    fn synth(spec: &str) -> Synth {
        Synth::parse(spec).unwrap()
    }

    #[test]
    fn only_what_is_wanted_is_made() {
        let plain = pool(synth("frames=1,width=96,height=64"), |_| ()).unwrap();
        let sample = plain.sample(0, UNTURNED).unwrap();
        assert!(sample.truth.is_none() && sample.proxy.is_none() && sample.neighbours.is_empty());
    }

    #[test]
    fn proxies_of_a_rendered_pair_are_within_a_pixel_of_the_truth_for_most() {
        let pool = pool(synth("seed=4,frames=1,width=256,height=192"), |c| {
            (c.supervised, c.loss.proxies) = (true, 0.1);
        })
        .unwrap();
        let sample = pool.training(vec![(0, 0)], 1).next().unwrap().unwrap();
        let (truth, proxy) = (sample.truth.unwrap(), sample.proxy.unwrap());
        let (mut known, mut both, mut near) = (0, 0, 0);
        for (t, p) in truth.as_raw().iter().zip(proxy.as_raw()) {
            known += usize::from(t.is_finite());
            both += usize::from((t - p).is_finite());
            near += usize::from((t - p).abs() <= 1.0);
        }
        assert!(both > known / 2, "{both} of {known}");
        assert!(near as f64 > 0.95 * both as f64, "{near} of {both}");
    }

    #[test]
    fn neighbours_are_those_of_the_sequence_and_missing_at_its_ends() {
        let pool = pool(synth("seed=4,frames=4,width=96,height=64"), |c| {
            c.loss.neighbours = 2;
        })
        .unwrap();
        for index in 0..4 {
            let sample = pool.sample(index, UNTURNED).unwrap();
            let there: Vec<bool> = sample.neighbours.iter().map(Option::is_some).collect();
            assert_eq!(there, [index >= 2, index + 2 < 4], "{index}");
            let moment = sample.neighbours.iter().flatten().next().unwrap();
            let other = if index < 2 { index + 2 } else { index - 2 };
            assert_eq!(moment.image, pool.frame(other).unwrap().left);
        }
    }

    /// A source whose trajectory is another.
    struct Posed(Synth, Option<Trajectory>);

    impl StereoSource for Posed {
        fn rig(&self) -> &RectifiedRig {
            self.0.rig()
        }
        fn len(&self) -> usize {
            self.0.len()
        }
        fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
            self.0.frame(index)
        }
        fn true_trajectory(&self) -> Option<&Trajectory> {
            self.1.as_ref()
        }
    }

    #[test]
    fn neighbours_without_poses_are_refused_in_plain_words() {
        let at = |x: f64| StampedPose {
            time: x,
            T_world_cam: Se3::translation(x, 0.0, 0.0),
        };
        let planar = Trajectory {
            poses: vec![at(0.0), at(1.0)],
        };
        for (trajectory, found) in [(None, "no poses"), (Some(planar), "without orientations")] {
            let source = Posed(synth("frames=2,width=96,height=64"), trajectory);
            let refused = pool(source, |c| c.loss.neighbours = 1)
                .err()
                .unwrap()
                .to_string();
            assert!(
                refused.contains("some/images") && refused.contains(found),
                "{refused}"
            );
        }
    }

    #[test]
    fn an_image_too_small_for_the_windows_is_refused_by_name() {
        struct Tiny(Synth);
        impl StereoSource for Tiny {
            fn rig(&self) -> &RectifiedRig {
                self.0.rig()
            }
            fn len(&self) -> usize {
                1
            }
            fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
                let image = barchan_datasets::Rgb::new(3, 40);
                Ok(StereoFrame {
                    index,
                    name: "strip".into(),
                    time: 0.0,
                    left: image.clone(),
                    right: image,
                })
            }
        }
        let pool = pool(Tiny(synth("frames=1,width=96,height=64")), |_| ()).unwrap();
        let refused = pool.sample(0, UNTURNED).err().unwrap().to_string();
        assert!(
            refused.contains("strip") && refused.contains("3 x 40"),
            "{refused}"
        );
    }
}
