//! Disparity scores over the frames of a sequence, pixel by pixel.

use barchan_datasets::Plane;
use serde::Serialize;

use crate::EvalError;

/// What `barchan eval disparity` says: over all pixels of known truth, and, under `estimated`, over
/// those of them that have an estimate (`None`, JSON `null`, when no pixel has).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DisparityScore {
    /// Over all pixels of known truth. A missing estimate is bad under every threshold, and counts
    /// in `epe` with the error of answering 0, which is the true disparity: an engine cannot
    /// improve these figures by answering only where it is easy.
    #[serde(flatten)]
    pub all: DisparityFigures,
    /// Over the pixels that have both truth and an estimate.
    pub estimated: Option<DisparityFigures>,
}

/// Errors over one set of pixels, all frames together.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DisparityFigures {
    /// Mean absolute error, pixels.
    pub epe: f64,
    /// Percent of the pixels off by more than 1 px.
    pub bad1: f64,
    /// Percent off by more than 2 px.
    pub bad2: f64,
    /// Percent off by more than 3 px.
    pub bad3: f64,
    /// Percent off by more than 3 px and by more than 5 % of the truth (KITTI 2015 D1).
    pub d1: f64,
    /// Percent of the pixels that have an estimate.
    pub density: f64,
    /// Frames compared.
    pub frames: usize,
}

/// Adds up errors frame by frame; constant memory.
#[derive(Clone, Debug, Default)]
pub struct DisparityTally {
    estimated: Sums,
    missing: Sums,
    frames: usize,
}

#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    pixels: u64,
    error: f64,
    bad: [u64; 3],
    d1: u64,
}

impl DisparityTally {
    /// Nothing compared yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Compares one frame. Both images in pixels of disparity; a value that is not finite is unknown.
    ///
    /// # Errors
    /// When the sizes differ; the tally is then unchanged.
    pub fn add(&mut self, prediction: &Plane, truth: &Plane) -> Result<(), EvalError> {
        if prediction.dimensions() != truth.dimensions() {
            return Err(EvalError::Sizes {
                prediction: prediction.dimensions(),
                truth: truth.dimensions(),
            });
        }
        for (&p, &t) in prediction.as_raw().iter().zip(truth.as_raw()) {
            if !t.is_finite() {
                continue;
            }
            let t = f64::from(t);
            if p.is_finite() {
                let error = (f64::from(p) - t).abs();
                let over = |limit: f64| u64::from(error > limit);
                let sums = &mut self.estimated;
                sums.pixels += 1;
                sums.error += error;
                for (bad, limit) in sums.bad.iter_mut().zip([1.0, 2.0, 3.0]) {
                    *bad += over(limit);
                }
                sums.d1 += over((0.05 * t.abs()).max(3.0));
            } else {
                let sums = &mut self.missing;
                sums.pixels += 1;
                sums.error += t.abs();
                sums.bad.iter_mut().for_each(|bad| *bad += 1);
                sums.d1 += 1;
            }
        }
        self.frames += 1;
        Ok(())
    }

    /// The figures over all frames added.
    ///
    /// # Errors
    /// When no pixel had a known truth.
    pub fn score(&self) -> Result<DisparityScore, EvalError> {
        let (e, m) = (&self.estimated, &self.missing);
        let all = Sums {
            pixels: e.pixels + m.pixels,
            error: e.error + m.error,
            bad: std::array::from_fn(|i| e.bad[i] + m.bad[i]),
            d1: e.d1 + m.d1,
        };
        Ok(DisparityScore {
            all: self.figures(&all).ok_or(EvalError::NoTruth {
                frames: self.frames,
            })?,
            estimated: self.figures(e),
        })
    }

    /// `None` over no pixels.
    fn figures(&self, sums: &Sums) -> Option<DisparityFigures> {
        let percent = |count: u64| 100.0 * count as f64 / sums.pixels as f64;
        (sums.pixels > 0).then(|| DisparityFigures {
            epe: sums.error / sums.pixels as f64,
            bad1: percent(sums.bad[0]),
            bad2: percent(sums.bad[1]),
            bad3: percent(sums.bad[2]),
            d1: percent(sums.d1),
            density: percent(self.estimated.pixels),
            frames: self.frames,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plane(values: &[f32]) -> Plane {
        Plane::from_raw(values.len() as u32, 1, values.to_vec()).unwrap()
    }

    #[test]
    fn figures_worked_by_hand() {
        const NO: f32 = f32::NAN;
        let mut tally = DisparityTally::new();
        // errors: 0, 1.5, 2.5, 4 (of 100: within 5 %), 4 (of 10), missing 20; one pixel has no truth
        tally
            .add(
                &plane(&[10.0, 11.5, 7.5, 104.0, 14.0, NO, 5.0]),
                &plane(&[10.0, 10.0, 10.0, 100.0, 10.0, 20.0, NO]),
            )
            .unwrap();
        // errors: exactly 1 and exactly 3, which are not more than 1 and 3
        tally
            .add(&plane(&[11.0, 7.0]), &plane(&[10.0, 10.0]))
            .unwrap();
        let s = tally.score().unwrap();
        let percent = |count: f64, of: f64| 100.0 * count / of;
        let all = DisparityFigures {
            epe: (0.0 + 1.5 + 2.5 + 4.0 + 4.0 + 20.0 + 1.0 + 3.0) / 8.0,
            bad1: percent(6.0, 8.0),
            bad2: percent(5.0, 8.0),
            bad3: percent(3.0, 8.0),
            d1: percent(2.0, 8.0),
            density: percent(7.0, 8.0),
            frames: 2,
        };
        assert_eq!(s.all, all);
        let estimated = DisparityFigures {
            epe: 16.0 / 7.0,
            bad1: percent(5.0, 7.0),
            bad2: percent(4.0, 7.0),
            bad3: percent(2.0, 7.0),
            d1: percent(1.0, 7.0),
            density: 100.0,
            frames: 2,
        };
        assert_eq!(s.estimated, Some(estimated));
    }

    #[test]
    fn leaving_out_the_bad_pixels_does_not_help() {
        let truth: Vec<f32> = (0..500).map(|i| 1.0 + (i % 70) as f32).collect();
        let full: Vec<f32> = truth
            .iter()
            .enumerate()
            .map(|(i, t)| t + (i % 7) as f32 - 3.0)
            .collect();
        // Pixels are left out that were off by more than 2 px, but by less than the answer 0 is.
        let holes: Vec<f32> = full
            .iter()
            .zip(&truth)
            .map(|(p, t)| {
                if (p - t).abs() >= 2.0 && *t > 3.0 {
                    f32::NAN
                } else {
                    *p
                }
            })
            .collect();
        let score = |p: &[f32]| {
            let mut tally = DisparityTally::new();
            tally.add(&plane(p), &plane(&truth)).unwrap();
            tally.score().unwrap()
        };
        let (dense, sparse) = (score(&full), score(&holes));
        assert!(sparse.all.epe >= dense.all.epe && sparse.all.bad1 >= dense.all.bad1);
        assert!(sparse.all.bad3 >= dense.all.bad3 && sparse.all.d1 >= dense.all.d1);
        assert!(sparse.all.density < dense.all.density);
        assert!(sparse.estimated.unwrap().epe < dense.estimated.unwrap().epe);
    }

    #[test]
    fn nothing_to_compare_is_said() {
        let mut tally = DisparityTally::new();
        assert_eq!(tally.score(), Err(EvalError::NoTruth { frames: 0 }));
        tally.add(&plane(&[1.0]), &plane(&[f32::INFINITY])).unwrap();
        assert_eq!(tally.score(), Err(EvalError::NoTruth { frames: 1 }));
        let error = tally.add(&plane(&[1.0]), &plane(&[1.0, 2.0])).unwrap_err();
        assert!(error.to_string().contains("(1, 1)"), "{error}");
        tally.add(&plane(&[f32::NAN]), &plane(&[2.0])).unwrap();
        let s = tally.score().unwrap();
        assert_eq!(
            (s.estimated, s.all.bad3, s.all.epe, s.all.density),
            (None, 100.0, 2.0, 0.0)
        );
    }

    #[test]
    fn the_json_has_the_keys_of_the_contract() {
        let mut tally = DisparityTally::new();
        tally.add(&plane(&[1.0]), &plane(&[2.0])).unwrap();
        let json = serde_json::to_value(tally.score().unwrap()).unwrap();
        for key in ["epe", "bad1", "bad2", "bad3", "d1", "density", "frames"] {
            assert!(
                json[key].is_number() && json["estimated"][key].is_number(),
                "{key}: {json}"
            );
        }
    }
}
