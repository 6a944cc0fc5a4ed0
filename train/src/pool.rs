use std::iter::repeat_with;
use std::sync::Arc;

use barchan_datasets::{DataError, Prefetch, StereoFrame, StereoSource, prefetch_with};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::batch::Sample;
use crate::{Augmentation, TrainError};

/// Several sources as one, frame after frame.
pub(crate) struct Pool {
    /// Each with what it was opened by.
    sources: Vec<(String, Box<dyn StereoSource>)>,
}

/// Keeps the draws of flips apart from those of crops, which use the same seed.
const FLIPS: u64 = 0x666c_6970;

impl Pool {
    /// `specs` are what the sources were opened by, for messages.
    pub fn new(specs: &[String], sources: Vec<Box<dyn StereoSource>>) -> Result<Self, TrainError> {
        if sources.iter().all(|s| s.is_empty()) {
            return Err(TrainError::Config("there are no frames to train on".into()));
        }
        let specs = specs.iter().cloned().chain(repeat_with(String::new));
        Ok(Self {
            sources: specs.zip(sources).collect(),
        })
    }

    /// How many frames there are.
    pub fn len(&self) -> usize {
        self.sources.iter().map(|(_, s)| s.len()).sum()
    }

    /// Reads (or renders) pairs on threads ahead of their use, in the order asked for: as they are,
    /// with truth where there is any.
    pub fn whole(self: &Arc<Self>, order: Vec<usize>) -> Prefetch<Sample> {
        let pool = Arc::clone(self);
        prefetch_with(order, 2, move |index| {
            let (_, source, local) = pool.find(index)?;
            Ok((pool.frame(index)?, source.true_disparity(local)?))
        })
    }

    /// The same for training: pairs turned by the flips of `augmentation`, with truth if `supervised`.
    /// `order` holds the number of the draw and the frame: what a draw gives depends on its number and
    /// the seed only, so that a resumed run sees what an uninterrupted one would.
    pub fn training(
        self: &Arc<Self>,
        order: Vec<(u64, usize)>,
        ahead: usize,
        supervised: bool,
        augmentation: Augmentation,
        seed: u64,
    ) -> Prefetch<Sample> {
        let pool = Arc::clone(self);
        let places = (0..order.len()).collect();
        prefetch_with(places, ahead, move |place| {
            let (draw, index) = order[place];
            let (_, source, local) = pool.find(index)?;
            let mut rng = ChaCha8Rng::seed_from_u64(seed ^ FLIPS);
            rng.set_stream(draw);
            let mut flips = augmentation.draw_flips(&mut rng);
            let mut truth = None;
            if supervised && flips.swap {
                truth = source.true_disparity_right(local)?;
                flips.swap = truth.is_some();
            }
            if supervised && !flips.swap {
                truth = source.true_disparity(local)?;
            }
            Ok(flips.apply(pool.frame(index)?, truth))
        })
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
