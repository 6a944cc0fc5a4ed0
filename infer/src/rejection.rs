use barchan_datasets::{Plane, Rgb, luma};
use rayon::prelude::*;

use crate::DisparityMap;

/// Marks as unknown the pixels that the pair itself contradicts (Hong 2021, 4.2.1): the right
/// image, warped by the disparity, must look like the left.
///
/// The paper prints "L_SSIM values less than 0.4 are rejected" with L_SSIM = (1 - SSIM) / 2, which
/// read literally keeps the worst pixels. What is meant, and done here, is the reverse: a pixel
/// whose *dis*similarity exceeds the threshold is rejected. Pixels that fall outside the right
/// image cannot be checked and are rejected too.
#[derive(Clone, Copy, Debug)]
pub struct Rejection {
    /// Largest accepted (1 - SSIM) / 2.
    pub max_dissimilarity: f32,
}

impl Default for Rejection {
    fn default() -> Self {
        Self {
            max_dissimilarity: 0.4,
        }
    }
}

impl Rejection {
    /// Sets rejected pixels of `map` to NaN and returns the share that is left.
    pub fn apply(&self, left: &Rgb, right: &Rgb, map: &mut DisparityMap) -> f64 {
        let warped = warp_right_to_left(&luma(right), &map.disparity);
        let dissimilarity = structural_dissimilarity(&luma(left), &warped);
        for (d, s) in map.disparity.iter_mut().zip(dissimilarity.iter()) {
            // NaN is where the warp fell outside.
            if s.is_nan() || *s > self.max_dissimilarity {
                *d = f32::NAN;
            }
        }
        map.density()
    }
}

/// The right image as the left camera would see it: sampled at `x - d`, linearly. NaN where the
/// disparity is unknown or points outside the right image.
pub fn warp_right_to_left(right: &Plane, disparity: &Plane) -> Plane {
    let (width, height) = disparity.dimensions();
    let (w, source) = (width as usize, right.as_raw());
    let mut warped = vec![f32::NAN; w * height as usize];
    warped
        .par_chunks_mut(w.max(1))
        .enumerate()
        .for_each(|(y, row)| {
            for (x, out) in row.iter_mut().enumerate() {
                let at = x as f32 - disparity.as_raw()[y * w + x];
                if !(at >= 0.0 && at <= (w - 1) as f32) {
                    continue;
                }
                let x0 = at as usize;
                let a = at - x0 as f32;
                let next = source[y * w + (x0 + 1).min(w - 1)];
                *out = (1.0 - a) * source[y * w + x0] + a * next;
            }
        });
    // One value a pixel by construction.
    Plane::from_raw(width, height, warped).unwrap_or_default()
}

/// (1 - SSIM) / 2 per pixel over 7x7 windows (Hong 2021, eq. 2; Wang 2004 for SSIM), 0 for equal
/// and 1 for opposite structure. A window takes the pixels known in both images; where its centre
/// is unknown the result is NaN.
pub fn structural_dissimilarity(a: &Plane, b: &Plane) -> Plane {
    const RADIUS: usize = 3;
    const C1: f32 = 0.01 * 0.01;
    const C2: f32 = 0.03 * 0.03;
    let (width, height) = a.dimensions();
    let (w, h) = (width as usize, height as usize);
    let (pa, pb) = (a.as_raw(), b.as_raw());
    let mut out = vec![f32::NAN; w * h];
    out.par_chunks_mut(w.max(1))
        .enumerate()
        .for_each(|(y, row)| {
            // Sums over the window's rows, one list for each of count, means and products; with room for a window
            // around the first and the last column. What is unknown counts as nothing.
            let mut columns: [Vec<f32>; 6] = std::array::from_fn(|_| vec![0.0; w + 2 * RADIUS]);
            for yy in y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(h) {
                let [n, a, b, aa, bb, ab] = &mut columns;
                for x in 0..w {
                    let (va, vb) = (pa[yy * w + x], pb[yy * w + x]);
                    let known = va.is_finite() && vb.is_finite();
                    let (va, vb) = if known { (va, vb) } else { (0.0, 0.0) };
                    let at = x + RADIUS;
                    n[at] += f32::from(u8::from(known));
                    a[at] += va;
                    b[at] += vb;
                    aa[at] += va * va;
                    bb[at] += vb * vb;
                    ab[at] += va * vb;
                }
            }
            let sums = columns.map(|column| {
                let mut sums = column[..w].to_vec();
                for k in 1..=2 * RADIUS {
                    for (sum, value) in sums.iter_mut().zip(&column[k..]) {
                        *sum += value;
                    }
                }
                sums
            });
            let [n, a, b, aa, bb, ab] = sums.each_ref().map(|sums| &sums[..w]);
            for (x, out) in row.iter_mut().enumerate() {
                let (ma, mb) = (a[x] / n[x], b[x] / n[x]);
                let va = (aa[x] / n[x] - ma * ma).max(0.0);
                let vb = (bb[x] / n[x] - mb * mb).max(0.0);
                let cov = ab[x] / n[x] - ma * mb;
                let ssim = ((2.0 * ma * mb + C1) * (2.0 * cov + C2))
                    / ((ma * ma + mb * mb + C1) * (va + vb + C2));
                *out = ((1.0 - ssim) / 2.0).clamp(0.0, 1.0);
            }
            let centres = pa[y * w..].iter().zip(&pb[y * w..]);
            for (out, (a, b)) in row.iter_mut().zip(centres) {
                if !(a.is_finite() && b.is_finite()) {
                    *out = f32::NAN;
                }
            }
        });
    Plane::from_raw(width, height, out).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (u32, u32) = (48, 24);

    fn texture(x: f32, y: f32) -> f32 {
        0.5 + 0.2 * (0.9 * x + 0.2 * y).sin() + 0.2 * (0.31 * x - 1.1 * y).sin()
    }

    fn image(shift: f32) -> Rgb {
        Rgb::from_fn(SIZE.0, SIZE.1, |x, y| {
            image::Rgb([texture(x as f32 + shift, y as f32); 3])
        })
    }

    fn map(disparity: impl Fn(u32, u32) -> f32) -> DisparityMap {
        let known = Plane::from_pixel(SIZE.0, SIZE.1, image::Luma([1.0]));
        let disparity = Plane::from_fn(SIZE.0, SIZE.1, |x, y| image::Luma([disparity(x, y)]));
        DisparityMap {
            disparity,
            sigma: known.clone(),
            confidence: known,
        }
    }

    #[test]
    fn warping_by_the_true_disparity_restores_the_left_image() {
        let warped = warp_right_to_left(&luma(&image(5.0)), &map(|_, _| 5.0).disparity);
        for (x, y, value) in warped.enumerate_pixels() {
            if x < 5 {
                assert!(value.0[0].is_nan());
            } else {
                assert!((value.0[0] - texture(x as f32, y as f32)).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn true_pixels_stay_false_ones_and_the_unseen_go() {
        // The lower half claims a disparity that the texture contradicts.
        let mut map = map(|_, y| if y < 12 { 5.0 } else { 8.5 });
        let share = Rejection::default().apply(&image(0.0), &image(5.0), &mut map);
        let at = |x, y| map.disparity.get_pixel(x, y).0[0];
        assert!(
            (5..48).all(|x| (0..9).all(|y| at(x, y) == 5.0)),
            "a true pixel was rejected"
        );
        assert!(
            (0..5).all(|x| (0..12).all(|y| at(x, y).is_nan())),
            "an unseen pixel was kept"
        );
        let kept = (9..48)
            .flat_map(|x| (16..24).map(move |y| (x, y)))
            .filter(|(x, y)| at(*x, *y).is_finite())
            .count();
        assert!(
            kept < 39 * 8 / 4,
            "{kept} of {} false pixels were kept",
            39 * 8
        );
        assert!((share - map.density()).abs() < 1e-12);
    }

    #[test]
    fn dissimilarity_is_symmetric_zero_for_equals_and_within_bounds() {
        let (a, b) = (luma(&image(0.0)), luma(&image(2.3)));
        let (ab, ba) = (
            structural_dissimilarity(&a, &b),
            structural_dissimilarity(&b, &a),
        );
        assert!(ab.iter().zip(ba.iter()).all(|(x, y)| (x - y).abs() < 1e-5));
        assert!(ab.iter().all(|v| (0.0..=1.0).contains(v)));
        assert!(structural_dissimilarity(&a, &a).iter().all(|v| *v < 1e-4));
    }
}
