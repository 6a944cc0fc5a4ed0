//! What each rule says of a match, so that rules can be compared (Hong 2021, table 1).

use barchan_datasets::Plane;
use rayon::prelude::*;

use crate::features::Features;
use crate::matching::{DisparityGate, two_nearest};

/// The rules that accept a left feature's nearest neighbour by descriptor.
#[derive(Clone, Copy, Debug)]
pub struct MatchRules {
    /// The nearest neighbour is accepted when its distance is below this share of the second's.
    pub nndr: f64,
    /// It is accepted when its disparity is so near to the dense one, pixels.
    pub gate_px: f64,
    /// Neighbours are looked for in rows at most so far away, pixels; `None` takes the whole image, as
    /// the paper's experiment does.
    pub rows: Option<f64>,
}

/// A left feature's nearest neighbour, accepted by one rule at least.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RuledMatch {
    /// Index of the left feature.
    pub left: usize,
    /// Index of the right feature.
    pub right: usize,
    /// Whether the distance ratio accepts it.
    pub by_ratio: bool,
    /// Whether dense disparity agrees; `None` where it is not known.
    pub by_disparity: Option<bool>,
}

impl MatchRules {
    /// Nearest neighbours that one rule accepts at least, in the order of the left features. `dense`
    /// is the disparity of the left image, NaN unknown.
    pub fn judge(&self, left: &Features, right: &Features, dense: &Plane) -> Vec<RuledMatch> {
        let gate = DisparityGate {
            disparity: dense,
            sigma: None,
            threshold: self.gate_px,
        };
        let judge = |i: usize| {
            let at = &left.keypoints[i];
            let near = |j: &usize| {
                let row = right.keypoints[*j].v;
                self.rows.is_none_or(|rows| (row - at.v).abs() <= rows)
            };
            let candidates = (0..right.keypoints.len()).filter(near);
            let (best, distance, second) = two_nearest(&left.descriptors[i], candidates, right)?;
            let by_ratio = f64::from(distance) < self.nndr * f64::from(second);
            let by_disparity = gate.agrees(at, at.u - right.keypoints[best].u);
            (by_ratio || by_disparity == Some(true)).then_some(RuledMatch {
                left: i,
                right: best,
                by_ratio,
                by_disparity,
            })
        };
        (0..left.keypoints.len())
            .into_par_iter()
            .filter_map(judge)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Keypoint;

    /// One left feature at column 40 and right ones of given columns, rows and looks.
    fn judged(rights: &[(f64, f64, u8)], dense: f32, rows: Option<f64>) -> Vec<RuledMatch> {
        let features = |places: &[(f64, f64, u8)]| Features {
            keypoints: places
                .iter()
                .map(|(u, v, _)| Keypoint {
                    u: *u,
                    v: *v,
                    scale: 1.0,
                    sigma: 1.0,
                })
                .collect(),
            descriptors: places.iter().map(|(_, _, look)| [*look; 64]).collect(),
            bits: 512,
        };
        let rules = MatchRules {
            nndr: 0.6,
            gate_px: 3.0,
            rows,
        };
        let dense = Plane::from_pixel(80, 40, image::Luma([dense]));
        rules.judge(&features(&[(40.0, 20.0, 0)]), &features(rights), &dense)
    }

    #[test]
    fn each_rule_speaks_for_itself() {
        let verdict = |rights: &[(f64, f64, u8)], dense: f32, rows: Option<f64>| {
            let found = judged(rights, dense, rows);
            found.first().map(|m| (m.right, m.by_ratio, m.by_disparity))
        };
        // The first differs by one bit a byte, the second by eight: the ratio chooses.
        let clear = [(34.0, 20.0, 1), (20.0, 20.0, 0xff)];
        assert_eq!(verdict(&clear, 6.0, None), Some((0, true, Some(true))));
        assert_eq!(verdict(&clear, 30.0, None), Some((0, true, Some(false))));
        assert_eq!(verdict(&clear, f32::NAN, None), Some((0, true, None)));
        // One bit and another bit: only disparity can accept the nearest.
        let ambiguous = [(34.0, 20.0, 1), (20.0, 20.0, 2)];
        assert_eq!(verdict(&ambiguous, 8.9, None), Some((0, false, Some(true))));
        assert_eq!(verdict(&ambiguous, 9.1, None), None);
        assert_eq!(verdict(&ambiguous, f32::NAN, None), None);
        // Along rows the nearest is another one.
        let elsewhere = [(34.0, 30.0, 1), (20.0, 21.0, 0x0f)];
        assert_eq!(
            verdict(&elsewhere, 20.0, Some(2.0)),
            Some((1, true, Some(true)))
        );
    }
}
