//! Standard deviation and confidence for a model that gives neither: from the pair itself.

use barchan_datasets::{Plane, Rgb, luma};
use rayon::prelude::*;

use crate::{DisparityMap, structural_dissimilarity, warp_right_to_left};

/// Half the side of the windows, as in [`structural_dissimilarity`].
const RADIUS: usize = 3;
/// What remains on perfect texture, pixels: models err where images are perfect.
const LEAST_SIGMA: f32 = 0.25;
/// Beyond this nothing is known; as semi-global matching has it.
const MOST_SIGMA: f32 = 8.0;

/// Judges a disparity map by its pair.
///
/// Sigma is that of least-squares matching (Gruen 1985): over a window around the pixel the right image,
/// warped by the disparity, differs from the left by residuals `r` about their mean, and a disparity moves
/// it by the gradient `g` along the row, so that `sigma^2 = mean(r^2) / sum(g^2)`; flat and wrongly matched
/// places have a large one, 8 pixels at most. Confidence is the probability that a normal error of that
/// sigma stays within a pixel, times the structural similarity of the two windows. Where the disparity
/// is unknown or points outside the right image, sigma is 8 and confidence 0.
pub(crate) fn judge(left: &Rgb, right: &Rgb, disparity: Plane) -> DisparityMap {
    let left = luma(left);
    let warped = warp_right_to_left(&luma(right), &disparity);
    let dissimilarity = structural_dissimilarity(&left, &warped);
    let sigma = least_squares_sigma(&left, &warped);
    let confidence = (sigma.iter().zip(dissimilarity.iter()))
        .map(|(sigma, dissimilarity)| {
            // (1 - SSIM) / 2 is NaN where there is nothing to compare.
            let similar = (1.0 - 2.0 * dissimilarity).max(0.0);
            if similar.is_nan() {
                0.0
            } else {
                similar * within(1.0 / sigma)
            }
        })
        .collect();
    // One value a pixel by construction.
    let confidence = Plane::from_raw(left.width(), left.height(), confidence).unwrap_or_default();
    DisparityMap {
        disparity,
        sigma,
        confidence,
    }
}

/// Probability that a standard normal variable stays within `z` of 0, to 5e-4 (Abramowitz and Stegun,
/// 7.1.27, of the error function).
fn within(z: f32) -> f32 {
    let x = z / std::f32::consts::SQRT_2;
    let p = 1.0 + x * (0.278393 + x * (0.230389 + x * (0.000972 + x * 0.078108)));
    1.0 - 1.0 / (p * p * p * p)
}

fn least_squares_sigma(left: &Plane, warped: &Plane) -> Plane {
    let (width, height) = left.dimensions();
    let (w, h) = (width as usize, height as usize);
    let (left, warped) = (left.as_raw(), warped.as_raw());
    let mut sigma = vec![MOST_SIGMA; w * h];
    sigma
        .par_chunks_mut(w.max(1))
        .enumerate()
        .for_each(|(y, row)| {
            // Count and sums of r, r^2 and g^2 over the window's rows, column by column.
            let columns: Vec<[f32; 4]> = (0..w)
                .map(|x| {
                    let (before, after) = (x.saturating_sub(1), (x + 1).min(w - 1));
                    let mut sums = [0.0; 4];
                    for yy in y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(h) {
                        let r = left[yy * w + x] - warped[yy * w + x];
                        if r.is_finite() {
                            let span = (after - before).max(1) as f32;
                            let g = (left[yy * w + after] - left[yy * w + before]) / span;
                            for (sum, term) in sums.iter_mut().zip([1.0, r, r * r, g * g]) {
                                *sum += term;
                            }
                        }
                    }
                    sums
                })
                .collect();
            for (x, sigma) in row.iter_mut().enumerate() {
                if !warped[y * w + x].is_finite() {
                    continue;
                }
                let mut sums = [0.0; 4];
                for column in &columns[x.saturating_sub(RADIUS)..(x + RADIUS + 1).min(w)] {
                    for (sum, term) in sums.iter_mut().zip(column) {
                        *sum += term;
                    }
                }
                let [n, r, rr, gg] = sums;
                // Eight bits of grey leave a residual of their own.
                let variance = (rr / n - (r / n) * (r / n)).max(0.0) + (0.3f32 / 255.0).powi(2);
                *sigma = (variance / gg).sqrt().hypot(LEAST_SIGMA).min(MOST_SIGMA);
            }
        });
    // One value a pixel by construction.
    Plane::from_raw(width, height, sigma).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_normal_distribution_is_met() {
        for (z, p) in [
            (0.0, 0.0),
            (0.5, 0.38292),
            (1.0, 0.68269),
            (2.0, 0.9545),
            (4.0, 0.99994),
        ] {
            assert!((within(z) - p).abs() < 6e-4, "{z}: {}", within(z));
        }
    }

    #[test]
    fn flat_wrong_and_unseen_places_are_told_from_good_ones() {
        // Textured above, flat below; the right image shows the same, 4 pixels further left.
        let image = |shift: u32| {
            Rgb::from_fn(96, 64, |x, y| {
                let at = (x + shift) as f32;
                let texture = 0.2 * (0.9 * at + 0.4 * y as f32).sin() + 0.1 * (2.1 * at).sin();
                image::Rgb([if y < 32 { 0.5 + texture } else { 0.5 }; 3])
            })
        };
        let disparity = Plane::from_fn(96, 64, |x, _| {
            image::Luma([if x < 50 {
                4.0
            } else if x < 90 {
                5.5
            } else {
                f32::NAN
            }])
        });
        let map = judge(&image(0), &image(4), disparity);
        let mean = |plane: &Plane, xs: std::ops::Range<u32>, ys: std::ops::Range<u32>| {
            let values: Vec<f32> = (ys.flat_map(|y| xs.clone().map(move |x| (x, y))))
                .map(|(x, y)| plane.get_pixel(x, y).0[0])
                .collect();
            values.iter().sum::<f32>() / values.len() as f32
        };
        let (good, wrong, flat, unknown) = (
            (8..44, 4..28),
            (54..86, 4..28),
            (8..44, 40..60),
            (91..96, 4..60),
        );
        let of = |plane: &Plane, at: &(std::ops::Range<u32>, std::ops::Range<u32>)| {
            mean(plane, at.0.clone(), at.1.clone())
        };
        assert!(of(&map.sigma, &good) < 0.3, "{}", of(&map.sigma, &good));
        assert!(of(&map.confidence, &good) > 0.95);
        assert!(of(&map.confidence, &wrong) < 0.3 * of(&map.confidence, &good));
        assert_eq!(of(&map.sigma, &flat), MOST_SIGMA);
        assert!(of(&map.confidence, &flat) < 0.2);
        assert_eq!(
            (of(&map.sigma, &unknown), of(&map.confidence, &unknown)),
            (8.0, 0.0)
        );
    }
}
