//! Whether errors are as large as the network says.

/// Shares of normally distributed errors within so many standard deviations.
const WITHIN: [(f32, f64); 3] = [(0.6745, 0.5), (1.0, 0.6827), (1.96, 0.95)];

/// Fits `[c, a, b]` so that `c + a v + b v^2`, for each variance `v` that the network states, is the variance of its
/// error: as many errors lie within two thirds of a standard deviation, one and two as of a normal distribution.
///
/// `found` are squared errors with the stated variances, all above zero and in the same unit; `None` where
/// there are too few to tell. The constant is what even the surest answers are off by; the square lets a network be
/// too cautious where it is sure and too bold where it is not, which is how they usually fail.
pub(crate) fn fit(mut found: Vec<(f32, f32)>) -> Option<[f32; 3]> {
    found.retain(|(e, v)| e.is_finite() && v.is_finite() && *v > 0.0);
    if found.len() < 1000 {
        return None;
    }
    // For each shape c / a and b / a the quantiles say how large a must be; where they say the same, the shape is right.
    let powers = |from: i32, to: i32| {
        let tried = (from..=to).map(|k| 10f32.powf(k as f32 / 4.0));
        std::iter::once(0.0).chain(tried)
    };
    let mut scaled = vec![0.0; found.len()];
    let mut best: Option<([f32; 3], f32)> = None;
    for constant in powers(-20, 4) {
        for square in powers(-16, 8) {
            for (scaled, (e, v)) in scaled.iter_mut().zip(&found) {
                *scaled = e / (constant + v + square * v * v);
            }
            let wanted = WITHIN.map(|(deviations, share)| {
                let at = (share * (scaled.len() - 1) as f64) as usize;
                let (_, quantile, _) = scaled.select_nth_unstable_by(at, f32::total_cmp);
                (*quantile / (deviations * deviations)).ln()
            });
            let mean = wanted.iter().sum::<f32>() / wanted.len() as f32;
            let off = wanted.iter().map(|w| (w - mean).powi(2)).sum();
            let size = mean.exp();
            // Not finite: answers without any error have no such shape.
            if size.is_normal() && best.is_none_or(|(_, least)| off < least) {
                best = Some(([size * constant, size, size * square], off));
            }
        }
    }
    best.map(|(fitted, _)| fitted)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn a_fitted_variance_holds_the_errors_of_which_it_is_told() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut normal = || (0..12).map(|_| rng.random_range(-0.5..0.5f32)).sum::<f32>();
        let true_variance = |v: f32| 0.02 + 0.3 * v + 0.08 * v * v;
        let found: Vec<(f32, f32)> = (0..40_000)
            .map(|k| {
                let v = 10f32.powf((k % 200) as f32 / 50.0 - 2.0);
                let error = normal() * true_variance(v).sqrt();
                (error * error, v)
            })
            .collect();
        let [c, a, b] = fit(found.clone()).unwrap();
        for (deviations, share) in WITHIN {
            let within = |(e, v): &&(f32, f32)| *e <= deviations.powi(2) * (c + a * v + b * v * v);
            let held = found.iter().filter(within).count() as f64 / found.len() as f64;
            assert!((held - share).abs() < 0.01, "{deviations}: {held}");
        }
        for (fitted, wanted) in [(c, 0.02), (a, 0.3), (b, 0.08)] {
            assert!((fitted / wanted).ln().abs() < 0.6, "{c} {a} {b}");
        }
    }

    #[test]
    fn too_few_or_perfect_answers_fit_nothing() {
        assert_eq!(fit(vec![(1.0, 1.0); 10]), None);
        assert_eq!(fit(vec![(0.0, 1.0); 5000]), None);
        assert_eq!(fit(vec![(f32::NAN, 1.0); 5000]), None);
    }
}
