//! What is known of an activation, and the 8 bits that follow from it.

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

    /// 256 levels over the values between this percentile from either end; 100 clips none.
    pub fn affine(&self, percentile: f64) -> Affine {
        let total: u64 = self.counts.iter().sum();
        let share = 1.0 - percentile.clamp(50.0, 100.0) / 100.0;
        let clipped = (total as f64 * share) as u64;
        let edge = |bin: &dyn Fn(usize) -> usize| {
            let mut seen = 0;
            (0..2 * HALF).map(bin).find(|bin| {
                seen += self.counts[*bin];
                seen > clipped
            })
        };
        let (low, high) = (f64::from(self.low), f64::from(self.high));
        let bottom = edge(&|i| i).map_or(low, |bin| self.bound(bin));
        let top = edge(&|i| 2 * HALF - 1 - i).map_or(high, |bin| self.bound(bin + 1));
        Affine::covering(bottom.max(low), top.min(high))
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
    fn a_percentile_clips_what_it_promises() {
        let mut histogram = Histogram::default();
        let values: Vec<f32> = (0..100_000).map(|i| i as f32 / 100_000.0).collect();
        assert!(histogram.add(&values));
        assert!(histogram.add(&[100.0; 5]));
        let top = |percentile| 255.0 * histogram.affine(percentile).scale;
        assert!((top(100.0) - 100.0).abs() < 1e-3);
        assert!((top(99.9) - 1.0).abs() < 0.05);
        assert_eq!(histogram.affine(99.9).zero, 0);
        assert_eq!(histogram.counts.iter().sum::<u64>(), 99_999 + 5);
        assert!(!histogram.add(&[1.0, f32::NAN]) && !histogram.add(&[f32::INFINITY]));
        assert_eq!(
            Histogram::default().affine(99.9),
            Affine::covering(0.0, 0.0)
        );
    }

    #[test]
    fn both_signs_and_growing_values_keep_their_places() {
        let mut histogram = Histogram::default();
        for power in -30..10 {
            assert!(histogram.add(&[-(2f32.powi(power)), 3.0 * 2f32.powi(power)]));
        }
        let Affine { scale, zero } = histogram.affine(100.0);
        assert!((255.0 * scale - 2048.0).abs() < 0.1, "{scale}");
        assert_eq!(zero, 64);
        let negative: u64 = histogram.counts[..HALF].iter().sum();
        assert_eq!(negative, 40);
    }
}
