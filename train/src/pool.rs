use std::sync::{Arc, Mutex, PoisonError};

use barchan_datasets::{DataError, Plane, Prefetch, StereoFrame, StereoSource, prefetch_with};
use barchan_geometry::{RectifiedRig, Se3, Trajectory};
use barchan_infer::{DisparityEngine, SemiGlobal};

use crate::batch::{Moment, Sample};
use crate::{TrainConfig, TrainError};

/// Smallest side of an image that can be trained on: the windows of the terms need some.
const SMALLEST: u32 = 16;

/// Several sources as one, frame after frame, with what else a configuration wants of each.
pub(crate) struct Pool {
    sources: Vec<Box<dyn StereoSource>>,
    /// Whether true disparity is wanted.
    truth: bool,
    /// How many frames away neighbours are; 0 is none.
    neighbours: usize,
    /// Disparities that are searched for proxies, if those are wanted.
    proxies: Option<usize>,
    /// Matchers not in use: their memory is kept.
    matchers: Mutex<Vec<SemiGlobal>>,
}

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
        let loss = &config.loss;
        if loss.neighbours > 0 {
            for (k, source) in sources.iter().enumerate() {
                check_poses(source.true_trajectory()).map_err(|found| {
                    let data = config.data.get(k).map_or("the data", String::as_str);
                    TrainError::Config(format!(
                        "loss: neighbours need the pose of every frame, and {data} has {found}\n  cure: `barchan slam --data {data} --out RUN` makes some: put its trajectory.tum beside the images as groundtruth.tum; or leave neighbours away"
                    ))
                })?;
            }
        }
        Ok(Self {
            sources,
            truth: config.supervised,
            neighbours: loss.neighbours,
            proxies: (loss.proxies > 0.0).then_some(config.net.max_disparity),
            matchers: Mutex::default(),
        })
    }

    /// Reads samples ahead on threads, in the order asked for: reading, rendering and matching overlap
    /// with training.
    pub fn prefetch(
        self: &Arc<Self>,
        order: Vec<usize>,
        ahead: usize,
    ) -> Prefetch<Sample, TrainError> {
        let pool = Arc::clone(self);
        prefetch_with(move |index| pool.sample(index), order, ahead)
    }

    /// A frame with all that is wanted of it.
    pub fn sample(&self, index: usize) -> Result<Sample, TrainError> {
        let (source, local) = self.find(index)?;
        let frame = self.frame(index)?;
        if frame.left.width().min(frame.left.height()) < SMALLEST {
            return Err(TrainError::Config(format!(
                "{}: {} x {} pixels are too few to train on, {SMALLEST} x {SMALLEST} are needed",
                frame.name,
                frame.left.width(),
                frame.left.height()
            )));
        }
        Ok(Sample {
            rig: *source.frame_rig(local),
            truth: match self.truth {
                true => source.true_disparity(local)?,
                false => None,
            },
            proxy: match self.proxies {
                Some(range) => Some(self.proxy(&frame, range)?),
                None => None,
            },
            neighbours: match self.neighbours {
                0 => vec![],
                n => vec![
                    neighbour(source, &frame, local, local.checked_sub(n))?,
                    neighbour(source, &frame, local, local.checked_add(n))?,
                ],
            },
            frame,
        })
    }

    /// Disparity of whole images by semi-global matching, NaN where left and right disagree.
    fn proxy(&self, frame: &StereoFrame, range: usize) -> Result<Plane, TrainError> {
        let matchers = || self.matchers.lock().unwrap_or_else(PoisonError::into_inner);
        let idle = matchers().pop();
        let mut matcher = idle.unwrap_or_else(|| SemiGlobal::new(Some(range)));
        let map = matcher.disparity(&frame.left, &frame.right)?;
        matchers().push(matcher);
        Ok(map.disparity)
    }

    fn find(&self, mut index: usize) -> Result<(&dyn StereoSource, usize), DataError> {
        for source in &self.sources {
            if index < source.len() {
                return Ok((source.as_ref(), index));
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

impl StereoSource for Pool {
    /// That of the first source.
    fn rig(&self) -> &RectifiedRig {
        self.sources[0].rig()
    }

    fn len(&self) -> usize {
        self.sources.iter().map(|s| s.len()).sum()
    }

    fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
        let (source, local) = self.find(index)?;
        // The caller asks by the pool's index and finds the frame again by it.
        Ok(StereoFrame {
            index,
            ..source.frame(local)?
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Augmentation, DeviceName, Loss, Schedule};
    use barchan_datasets::Synth;
    use barchan_geometry::StampedPose;
    use barchan_model::Preset;

    fn pool(
        source: impl StereoSource + 'static,
        change: fn(&mut TrainConfig),
    ) -> Result<Arc<Pool>, TrainError> {
        let mut config = TrainConfig {
            data: vec!["some/images".into()],
            init: None,
            device: DeviceName::Flex,
            seed: 1,
            supervised: false,
            batch: 1,
            crop: [64, 96],
            checkpoint_every: 1,
            net: Preset::Tiny.config(),
            schedule: Schedule::FINETUNE,
            loss: Loss::default(),
            augmentation: Augmentation::default(),
        };
        change(&mut config);
        Ok(Arc::new(Pool::new(vec![Box::new(source)], &config)?))
    }

    fn synth(spec: &str) -> Synth {
        Synth::parse(spec).unwrap()
    }

    #[test]
    fn only_what_is_wanted_is_made() {
        let plain = pool(synth("frames=1,width=96,height=64"), |_| ()).unwrap();
        let sample = plain.sample(0).unwrap();
        assert!(sample.truth.is_none() && sample.proxy.is_none() && sample.neighbours.is_empty());
    }

    #[test]
    fn proxies_of_a_rendered_pair_are_within_a_pixel_of_the_truth_for_most() {
        let pool = pool(synth("seed=4,frames=1,width=256,height=192"), |c| {
            (c.supervised, c.loss.proxies) = (true, 0.1);
        })
        .unwrap();
        let sample = pool.prefetch(vec![0], 1).next().unwrap().unwrap();
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
            let sample = pool.sample(index).unwrap();
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
        let refused = pool.sample(0).err().unwrap().to_string();
        assert!(
            refused.contains("strip") && refused.contains("3 x 40"),
            "{refused}"
        );
    }
}
