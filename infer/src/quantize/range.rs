//! What is known of an activation, and the 8 bits that follow from it.

/// How the range that 256 levels cover follows from what calibration saw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RangeRule {
    /// From the smallest to the largest value: nothing is clipped.
    MinMax,
    /// The values between this percentile from either end; 99.99 clips one value in ten thousand
    /// above and below.
    Percentile(f64),
    /// The range of least squared error: what clipping loses against what finer steps win.
    LeastSquares,
}

/// `real = scale * (level - zero)`, level in 0..=255; zero itself is exact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Affine {
    pub scale: f32,
    pub zero: u8,
}

impl Affine {
    /// Covers `low..=high` and zero. A range of nothing but zero has steps of one.
    pub fn covering(low: f64, high: f64) -> Self {
        let (low, high) = (low.min(0.0), high.max(0.0));
        if high - low <= 0.0 {
            return Self {
                scale: 1.0,
                zero: 0,
            };
        }
        let scale = ((high - low) / 255.0).clamp(f32::MIN_POSITIVE.into(), f32::MAX.into());
        Self {
            scale: scale as f32,
            zero: (-low / scale).round().clamp(0.0, 255.0) as u8,
        }
    }
}

/// Bins on either side of zero.
const HALF: usize = 4096;

/// Counts of values in equal bins over `-reach..reach`. A value beyond doubles the reach and merges
/// the bins two by two, so that one pass over the data suffices and memory stays as it is.
pub(super) struct Histogram {
    reach: f64,
    counts: Vec<u64>,
    low: f32,
    high: f32,
}

impl Default for Histogram {
    fn default() -> Self {
        Self {
            reach: 2.0_f64.powi(-20),
            counts: vec![0; 2 * HALF],
            low: 0.0,
            high: 0.0,
        }
    }
}

impl Histogram {
    /// Counts `values`; false when one of them is not finite. Zeros are exact whatever the range
    /// and are not counted.
    pub fn add(&mut self, values: &[f32]) -> bool {
        let (low, high, finite) = values.iter().fold((0.0f32, 0.0f32, true), |(l, h, f), v| {
            (l.min(*v), h.max(*v), f && v.is_finite())
        });
        if !finite {
            return false;
        }
        (self.low, self.high) = (self.low.min(low), self.high.max(high));
        while self.reach <= f64::from(high.max(-low)) {
            self.reach *= 2.0;
            let mut merged = vec![0; 2 * HALF];
            for (i, count) in self.counts.iter().enumerate() {
                merged[HALF / 2 + i / 2] += count;
            }
            self.counts = merged;
        }
        let bins = HALF as f64 / self.reach;
        for v in values.iter().filter(|v| **v != 0.0) {
            let bin = (f64::from(*v) * bins).floor() as isize + HALF as isize;
            self.counts[bin.clamp(0, 2 * HALF as isize - 1) as usize] += 1;
        }
        true
    }

    /// The 256 levels by `rule`.
    pub fn affine(&self, rule: RangeRule) -> Affine {
        let (low, high) = (f64::from(self.low), f64::from(self.high));
        match rule {
            RangeRule::MinMax => Affine::covering(low, high),
            RangeRule::Percentile(percent) => {
                let total: u64 = self.counts.iter().sum();
                let clipped = (total as f64 * (1.0 - percent.clamp(50.0, 100.0) / 100.0)) as u64;
                let edge = |bin: &dyn Fn(usize) -> usize| {
                    let mut seen = 0;
                    (0..2 * HALF).map(bin).find(|bin| {
                        seen += self.counts[*bin];
                        seen > clipped
                    })
                };
                let bottom = edge(&|i| i).map_or(low, |bin| self.bound(bin));
                let top = edge(&|i| 2 * HALF - 1 - i).map_or(high, |bin| self.bound(bin + 1));
                Affine::covering(bottom.max(low), top.min(high))
            }
            RangeRule::LeastSquares => (0..=140)
                .map(|step| 1.0 - f64::from(step) * 0.005)
                .map(|share| (self.squared_error(share * low, share * high), share))
                .min_by(|a, b| a.0.total_cmp(&b.0))
                .map_or(Affine::covering(low, high), |(_, share)| {
                    Affine::covering(share * low, share * high)
                }),
        }
    }

    /// Sum of squared errors of levels over `low..=high`: a twelfth of the squared step inside,
    /// the squared distance to the range outside.
    fn squared_error(&self, low: f64, high: f64) -> f64 {
        let inside = ((high - low) / 255.0).powi(2) / 12.0;
        let error = |(bin, count): (usize, &u64)| {
            let middle = 0.5 * (self.bound(bin) + self.bound(bin + 1));
            let beyond = (low - middle).max(middle - high).max(0.0);
            *count as f64 * (inside + beyond * beyond)
        };
        self.counts
            .iter()
            .enumerate()
            .filter(|(_, count)| **count > 0)
            .map(error)
            .sum()
    }

    /// Lower bound of a bin.
    fn bound(&self, bin: usize) -> f64 {
        (bin as f64 - HALF as f64) / HALF as f64 * self.reach
    }
}

/// Weights as int8, symmetric about zero, with one scale per output channel: `weights` has
/// `scales.len()` channels one after another. The bias is added in steps of `scale * input_scale`
/// and has to fit an int32, which bounds the scale of nearly empty channels from below.
pub(super) fn weights_to_int8(
    weights: &[f32],
    channels: usize,
    bias: Option<&[f32]>,
    input_scale: f32,
) -> (Vec<i8>, Vec<f32>) {
    let size = (weights.len() / channels.max(1)).max(1);
    let scales: Vec<f32> = (weights.chunks(size).enumerate())
        .map(|(channel, weights)| {
            let largest = weights.iter().fold(0.0f32, |m, w| m.max(w.abs()));
            let bias = bias.map_or(0.0, |bias| bias[channel].abs());
            let scale = (largest / 127.0).max(bias / input_scale / 2.0f32.powi(30));
            if scale.is_normal() { scale } else { 1.0 }
        })
        .collect();
    let levels = (weights.chunks(size).zip(&scales))
        .flat_map(|(weights, scale)| {
            (weights.iter()).map(move |w| (w / scale).round().clamp(-127.0, 127.0) as i8)
        })
        .collect();
    (levels, scales)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_come_back_within_half_a_step_of_their_channel() {
        let weights: Vec<f32> = (0..60)
            .map(|i| (i as f32 * 1.7).sin() * 10f32.powi(i / 20 - 2))
            .collect();
        let (levels, scales) = weights_to_int8(&weights, 3, Some(&[1.0, -2.0, 0.0]), 0.1);
        for (channel, scale) in scales.iter().enumerate() {
            let range = 20 * channel..20 * (channel + 1);
            let largest = weights[range.clone()]
                .iter()
                .fold(0.0f32, |m, w| m.max(w.abs()));
            assert!((scale * 127.0 - largest).abs() <= 1e-6 * largest);
            for (w, q) in weights[range.clone()].iter().zip(&levels[range]) {
                assert!((w - scale * f32::from(*q)).abs() <= 0.5001 * scale);
            }
        }
    }

    #[test]
    fn an_empty_channel_and_a_large_bias_have_a_scale() {
        let (levels, scales) =
            weights_to_int8(&[0.0, 0.0, 1e-30, 1e-30], 2, Some(&[0.0, 1e3]), 1e-6);
        assert_eq!(levels, [0; 4]);
        assert!(scales.iter().all(|s| s.is_normal()));
        assert!(f64::from(1e3f32) / f64::from(scales[1]) / 1e-6 < f64::from(i32::MAX));
    }

    #[test]
    fn a_range_holds_zero_exactly_and_its_ends_within_a_step() {
        for (low, high) in [
            (0.0, 6.0),
            (-3.0, 1.0),
            (0.5, 2.0),
            (-2.0, -1.0),
            (-1e-30, 1e30),
        ] {
            let a = Affine::covering(low, high);
            for end in [low.min(0.0), high.max(0.0)] {
                let level = (end / f64::from(a.scale) + f64::from(a.zero))
                    .round()
                    .clamp(0.0, 255.0);
                let back = f64::from(a.scale) * (level - f64::from(a.zero));
                assert!(
                    (back - end).abs() <= 0.51 * f64::from(a.scale),
                    "{low} {high} {end} {back}"
                );
            }
        }
        assert_eq!(
            Affine::covering(0.0, 0.0),
            Affine {
                scale: 1.0,
                zero: 0
            }
        );
    }

    #[test]
    fn rules_clip_what_they_promise() {
        let mut histogram = Histogram::default();
        let mut values: Vec<f32> = (0..100_000).map(|i| i as f32 / 100_000.0).collect();
        assert!(histogram.add(&values));
        values.clear();
        values.resize(5, 100.0);
        assert!(histogram.add(&values));
        let top = |rule| 255.0 * histogram.affine(rule).scale;
        assert!((top(RangeRule::MinMax) - 100.0).abs() < 1e-3);
        assert!((top(RangeRule::Percentile(99.9)) - 1.0).abs() < 0.05);
        // Five values of 100 outweigh the finer steps of the rest.
        assert!(top(RangeRule::LeastSquares) > 50.0);
        assert_eq!(histogram.affine(RangeRule::MinMax).zero, 0);
        assert!(!histogram.add(&[1.0, f32::NAN]) && !histogram.add(&[f32::INFINITY]));
    }
}
