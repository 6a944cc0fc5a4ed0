//! Whether errors are as large as the network says.

/// Shares of normally distributed errors within one and within 1.96 standard deviations.
const WITHIN: [(f32, f64); 2] = [(1.0, 0.6827), (1.96, 0.95)];

/// Fits `[a, b]` so that `a v + b v^2`, for each variance `v` that the network states, is the variance of its error: as many
/// errors lie within one and within 1.96 standard deviations as of a normal distribution.
///
/// `found` are squared errors with the stated variances, all above zero and in the same unit; `None` where
/// there are too few to tell. The square lets a network be too cautious where it is sure and too bold where it is not,
/// which is how they usually fail.
pub(crate) fn fit(mut found: Vec<(f32, f32)>) -> Option<[f32; 2]> {
    found.retain(|(e, v)| e.is_finite() && v.is_finite() && *v > 0.0);
    if found.len() < 1000 {
        return None;
    }
    // For each ratio b / a the narrow interval says how large a must be, and the wide one how good that is.
    let tried = (-40..=24).map(|k| 10f32.powf(k as f32 / 8.0));
    let fitted = std::iter::once(0.0).chain(tried).map(|ratio| {
        let mut scaled: Vec<f32> = found.iter().map(|(e, v)| e / (v + ratio * v * v)).collect();
        let [narrow, wide] = WITHIN.map(|(deviations, share)| {
            let at = (share * (scaled.len() - 1) as f64) as usize;
            let (_, quantile, _) = scaled.select_nth_unstable_by(at, f32::total_cmp);
            *quantile / (deviations * deviations)
        });
        ([narrow, narrow * ratio], (wide / narrow).ln().abs())
    });
    let (best, _) = fitted
        .filter(|([a, _], off)| *a > 0.0 && off.is_finite())
        .min_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(best)
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
        let true_variance = |v: f32| 0.3 * v + 0.08 * v * v;
        let found: Vec<(f32, f32)> = (0..40_000)
            .map(|k| {
                let v = 10f32.powf((k % 200) as f32 / 50.0 - 2.0);
                let error = normal() * true_variance(v).sqrt();
                (error * error, v)
            })
            .collect();
        let [a, b] = fit(found.clone()).unwrap();
        for (deviations, share) in WITHIN {
            let within = |(e, v): &&(f32, f32)| *e <= deviations.powi(2) * (a * v + b * v * v);
            let held = found.iter().filter(within).count() as f64 / found.len() as f64;
            assert!((held - share).abs() < 0.01, "{deviations}: {held}");
        }
        assert!(
            (a / 0.3).ln().abs() < 0.3 && (b / 0.08).ln().abs() < 0.3,
            "{a} {b}"
        );
    }

    #[test]
    fn too_few_or_perfect_answers_fit_nothing() {
        assert_eq!(fit(vec![(1.0, 1.0); 10]), None);
        assert_eq!(fit(vec![(0.0, 1.0); 5000]), None);
        assert_eq!(fit(vec![(f32::NAN, 1.0); 5000]), None);
    }
}
