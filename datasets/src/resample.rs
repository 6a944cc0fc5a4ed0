use rayon::prelude::*;

use crate::Rgb;

/// Weights of the four samples around a position `t` in 0..=1 past the second of them: Keys'
/// cubic convolution (1981) with a = -1/2. Interpolates exactly at integers and blurs far less
/// than linear, which matters because only one image of a pair may be resampled.
pub(crate) fn cubic_weights(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    ]
}

/// `image` sampled at `map`, one position a pixel, row by row; black outside.
pub(crate) fn remap(image: &Rgb, map: &[[f32; 2]]) -> Rgb {
    let (width, height) = image.dimensions();
    let (w, h) = (width as usize, height as usize);
    let source = image.as_raw();
    let mut out = vec![0.0; 3 * map.len()];
    out.par_chunks_exact_mut(3)
        .zip(map)
        .for_each(|(pixel, &[x, y])| {
            if !(x >= 0.0 && y >= 0.0 && x <= (w - 1) as f32 && y <= (h - 1) as f32) {
                return;
            }
            let (x0, y0) = (x as usize, y as usize);
            let (wx, wy) = (cubic_weights(x - x0 as f32), cubic_weights(y - y0 as f32));
            let mut sum = [0.0; 3];
            for (j, wy) in wy.iter().enumerate() {
                let yy = (y0 + j).saturating_sub(1).min(h - 1);
                for (i, wx) in wx.iter().enumerate() {
                    let xx = (x0 + i).saturating_sub(1).min(w - 1);
                    let at = 3 * (yy * w + xx);
                    for c in 0..3 {
                        sum[c] += wx * wy * source[at + c];
                    }
                }
            }
            // Cubic weights overshoot at edges.
            for c in 0..3 {
                pixel[c] = sum[c].clamp(0.0, 1.0);
            }
        });
    // Three values a pixel by construction, where the map has the size of the image.
    Rgb::from_raw(width, height, out).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_sum_to_one_and_reproduce_a_parabola() {
        for i in 0..=20 {
            let t = i as f32 / 20.0;
            let w = cubic_weights(t);
            assert!((w.iter().sum::<f32>() - 1.0).abs() < 1e-6);
            let value: f32 = w
                .iter()
                .zip([-1.0f32, 0.0, 1.0, 2.0])
                .map(|(w, x)| w * x * x)
                .sum();
            assert!((value - t * t).abs() < 1e-5, "{t} {value}");
        }
    }

    #[test]
    fn the_identity_map_changes_nothing_and_outside_is_black() {
        let image = Rgb::from_fn(9, 7, |x, y| {
            image::Rgb([x as f32 / 9.0, y as f32 / 7.0, 0.5])
        });
        let identity: Vec<[f32; 2]> = (0..63).map(|i| [(i % 9) as f32, (i / 9) as f32]).collect();
        assert_eq!(remap(&image, &identity), image);
        let outside = vec![[-0.5, 3.0]; 63];
        assert!(remap(&image, &outside).as_raw().iter().all(|v| *v == 0.0));
    }
}
