use barchan_datasets::{DataError, Plane, StereoFrame, StereoSource};
use barchan_geometry::RectifiedRig;

use crate::TrainError;

/// Several sources as one, frame after frame.
pub(crate) struct Pool {
    sources: Vec<Box<dyn StereoSource>>,
}

impl Pool {
    pub fn new(sources: Vec<Box<dyn StereoSource>>) -> Result<Self, TrainError> {
        if sources.iter().all(|s| s.is_empty()) {
            return Err(TrainError::Config("there are no frames to train on".into()));
        }
        Ok(Self { sources })
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

impl StereoSource for Pool {
    /// That of the first source; training looks at images only.
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

    fn true_disparity(&self, index: usize) -> Result<Option<Plane>, DataError> {
        let (source, local) = self.find(index)?;
        source.true_disparity(local)
    }
}
