//! An engine on threads of its own.

use barchan_datasets::Rgb;
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::engine::{DisparityEngine, DisparityMap, InferError};

/// An engine that keeps to some threads, so that other work beside it need not wait for it.
pub struct Threaded {
    engine: Box<dyn DisparityEngine>,
    pool: ThreadPool,
}

impl Threaded {
    /// `engine` on `threads` threads; 0 takes one a core.
    ///
    /// # Errors
    /// When there are no such threads to be had.
    pub fn new(engine: Box<dyn DisparityEngine>, threads: usize) -> Result<Self, InferError> {
        let pool = ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = pool.map_err(|source| InferError::Failed {
            engine: engine.name(),
            message: format!("{threads} threads: {source}"),
        })?;
        Ok(Self { engine, pool })
    }
}

impl DisparityEngine for Threaded {
    fn name(&self) -> String {
        self.engine.name()
    }

    fn disparity(&mut self, left: &Rgb, right: &Rgb) -> Result<DisparityMap, InferError> {
        self.pool.install(|| self.engine.disparity(left, right))
    }

    fn disparity_batch(&mut self, pairs: &[(&Rgb, &Rgb)]) -> Result<Vec<DisparityMap>, InferError> {
        self.pool.install(|| self.engine.disparity_batch(pairs))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Answers with the number of its threads.
    struct Counts;

    impl DisparityEngine for Counts {
        fn name(&self) -> String {
            "counts".into()
        }
        fn disparity(&mut self, left: &Rgb, _: &Rgb) -> Result<DisparityMap, InferError> {
            let threads = rayon::current_num_threads() as f32;
            let (width, height) = left.dimensions();
            let plane = barchan_datasets::Plane::from_pixel(width, height, image::Luma([threads]));
            Ok(DisparityMap {
                disparity: plane.clone(),
                sigma: plane.clone(),
                confidence: plane,
            })
        }
    }

    #[test]
    fn an_engine_keeps_to_its_threads() {
        let image = Rgb::new(2, 2);
        for threads in [1, 3] {
            let mut engine = Threaded::new(Box::new(Counts), threads).unwrap();
            let one = engine.disparity(&image, &image).unwrap();
            let batch = engine.disparity_batch(&[(&image, &image); 2]).unwrap();
            for map in batch.iter().chain([&one]) {
                assert!(map.disparity.pixels().all(|p| p.0[0] == threads as f32));
            }
        }
    }
}
