//! How far off what was chosen may be.

use std::f32::consts::{LN_2, LOG2_E, SQRT_2};

use multiversion::multiversion;
use rayon::prelude::*;

use super::judge::Likeness;

/// Half the side of the window over which likeness is averaged, pixels.
const RADIUS: usize = 4;
/// Standard deviation of a pixel that tells nothing against itself, but for sigma; the power of what multiplies it,
/// the exponents of what is unlike and of what is hidden. All four are fitted to the errors of rendered pairs, the
/// first so that intervals hold what they should, the others by the likelihood of a Laplace distribution.
const SCALE: f32 = 0.64;
const POWER: f32 = 0.29;
const UNLIKE: f32 = 3.56;
const HIDDEN: f32 = 0.36;
/// What is added to a movement and to a spread before they multiply, pixels.
const MOVED: f32 = 0.3;
const SPREAD: f32 = 0.2;
/// Likeness of what is hidden, in bits of a census; and the mark of it.
const HIDDEN_BITS: u16 = 19;
pub(super) const MARK: u8 = u8::MAX;

/// What is known of the pixels of an image before and after outlines were moved.
pub(super) struct Doubt<'a> {
    /// Before.
    pub disparity_before: &'a [f32],
    pub sigma_before: &'a [f32],
    /// After; unknown ones have no new sigma.
    pub disparity: &'a [f32],
    /// Standard deviation of the disparity among what a pixel might have chosen.
    pub spread: &'a [f32],
}

impl Doubt<'_> {
    /// Makes sigma, that of the surface that was taken, the larger the farther off the disparity may be: where the
    /// pixel was surer of something else, where the choice was close, and where the images are unlike or the right
    /// camera does not see what is there. Confidence is the share of a Laplace distribution within a pixel.
    pub fn set(
        &self,
        likeness: &Likeness,
        width: usize,
        sigma: &mut [f32],
        confidence: &mut [f32],
    ) {
        let mut differing = vec![0; self.disparity.len()];
        (differing
            .par_chunks_mut(width)
            .zip(self.disparity.par_chunks(width)))
        .enumerate()
        .for_each(|(y, (out, row))| likeness.differing(y, row, out));
        let height = self.disparity.len() / width;
        let rows = (sigma.par_chunks_mut(width)).zip(confidence.par_chunks_mut(width));
        rows.enumerate().for_each(|(y, (sigma, confidence))| {
            // Beyond the border its last pixels repeat.
            let lines: [&[u8]; 2 * RADIUS + 1] = std::array::from_fn(|k| {
                let y = (y + k).saturating_sub(RADIUS).min(height - 1);
                &differing[y * width..][..width]
            });
            let mut sums = vec![0; width];
            around(lines, &mut sums);
            let row = y * width..(y + 1) * width;
            let known = Doubt {
                disparity_before: &self.disparity_before[row.clone()],
                sigma_before: &self.sigma_before[row.clone()],
                disparity: &self.disparity[row.clone()],
                spread: &self.spread[row],
            };
            known.row(&sums, lines[RADIUS], sigma, confidence);
        });
    }

    fn row(&self, sums: &[u16], differing: &[u8], sigma: &mut [f32], confidence: &mut [f32]) {
        row(self, sums, differing, sigma, confidence);
    }
}

/// Sums of differing bits over the window of each pixel of a row.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn around(lines: [&[u8]; 2 * RADIUS + 1], sums: &mut [u16]) {
    let width = sums.len();
    let mut columns = vec![0u16; width + 2 * RADIUS];
    for line in lines {
        for (sum, bits) in columns[RADIUS..].iter_mut().zip(line) {
            *sum += if *bits == MARK {
                HIDDEN_BITS
            } else {
                u16::from(*bits)
            };
        }
    }
    let (first, last) = (columns[RADIUS], columns[RADIUS + width - 1]);
    columns[..RADIUS].fill(first);
    columns[RADIUS + width..].fill(last);
    for k in 0..=2 * RADIUS {
        for (sum, column) in sums.iter_mut().zip(&columns[k..]) {
            *sum += column;
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn row(doubt: &Doubt, sums: &[u16], differing: &[u8], sigma: &mut [f32], confidence: &mut [f32]) {
    const SIDE: f32 = (2 * RADIUS + 1) as f32;
    const PER_BIT: f32 = UNLIKE / (SIDE * SIDE * 62.0);
    let width = sigma.len();
    let confidence = &mut confidence[..width];
    let (sums, differing) = (&sums[..width], &differing[..width]);
    let (own, before) = (
        &doubt.sigma_before[..width],
        &doubt.disparity_before[..width],
    );
    let (after, spread) = (&doubt.disparity[..width], &doubt.spread[..width]);
    for x in 0..width {
        let moved = (after[x] - before[x]).abs() + MOVED;
        let product = sigma[x] * own[x] * moved * (spread[x] + SPREAD);
        let hidden = if differing[x] == MARK { HIDDEN } else { 0.0 };
        let told = PER_BIT * f32::from(sums[x]) + hidden;
        let larger = SCALE * exp2(LOG2_E * (POWER * ln(product) + told));
        // A disparity or sigma that is no number has none.
        if product < f32::INFINITY {
            sigma[x] = larger;
            // Of standard deviation sqrt(2) times the distance that the density falls over.
            confidence[x] = 1.0 - exp2(-LOG2_E * SQRT_2 / larger);
        }
    }
}

/// Within 1e-4, of a positive number; less than 1e-30 is taken for that. That of the library would take as long as
/// all else.
#[inline(always)]
fn ln(v: f32) -> f32 {
    let bits = (if v > 1e-30 { v } else { 1e-30 }).to_bits();
    let m = f32::from_bits(bits & 0x007f_ffff | 0x3f80_0000);
    let series = 2.821_202_6 + m * (-1.469_956_8 + m * (0.447_179_55 - 0.056_570_85 * m));
    ((bits >> 23) as i32 as f32 - 127.0) * LN_2 - 1.741_793_9 + m * series
}

/// Within 1e-4 of it, between -100 and 100; beyond as there.
#[inline(always)]
fn exp2(v: f32) -> f32 {
    let v = if v > -100.0 { v } else { -100.0 };
    let v = if v < 100.0 { v } else { 100.0 };
    // Truncated, and so rounded down.
    let whole = (v + 128.0) as i32;
    let f = v + 128.0 - whole as f32;
    let series = 0.695_976_1 + f * (0.224_940_4 + f * 0.079_020_8);
    f32::from_bits(((whole - 1) << 23) as u32) * (1.0 + f * series)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn powers_and_logarithms_are_near_the_library_s() {
        for k in -400..=400 {
            let v = k as f32 * 0.05;
            let off = exp2(v) / v.exp2() - 1.0;
            assert!(off.abs() < 2e-4, "2^{v} is off by {off}");
            let back = ln(v.exp()) - v;
            assert!(back.abs() < 2e-4, "ln e^{v} is off by {back}");
        }
        let ends = [f32::NEG_INFINITY, -1e9, 1e9, f32::INFINITY, f32::NAN].map(exp2);
        assert!(ends.iter().all(|v| v.is_finite() && *v > 0.0), "{ends:?}");
        assert!([0.0, -1.0, f32::NAN].iter().all(|v| ln(*v).is_finite()));
    }

    #[test]
    fn windows_are_summed_and_what_is_hidden_counts() {
        let lines: Vec<Vec<u8>> = (0..9)
            .map(|j| {
                let bits = |x: usize| {
                    if (x + j).is_multiple_of(7) {
                        MARK
                    } else {
                        (x * j % 60) as u8
                    }
                };
                (0..30).map(bits).collect()
            })
            .collect();
        let rows: [&[u8]; 2 * RADIUS + 1] = std::array::from_fn(|j| &lines[j][..]);
        let mut sums = vec![0; 30];
        around(rows, &mut sums);
        for (x, sum) in sums.iter().enumerate() {
            let columns = (0..=2 * RADIUS).map(|i| (x + i).saturating_sub(RADIUS).min(29));
            let bits = |v: u8| if v == MARK { HIDDEN_BITS } else { u16::from(v) };
            let wanted: u16 = columns
                .map(|x| rows.iter().map(|row| bits(row[x])).sum::<u16>())
                .sum();
            assert_eq!(*sum, wanted, "at {x}");
        }
    }
}
