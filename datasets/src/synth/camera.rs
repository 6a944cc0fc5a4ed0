use nalgebra::Vector2;
use rand::{Rng, RngExt};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

use super::options::CameraOptions;

/// Two cameras that turn light into grey levels.
pub(super) struct Sensor {
    options: CameraOptions,
    seed: u64,
    width: usize,
    height: usize,
    /// For each camera, dust on its lens: what passes, a pixel; empty where there is none.
    dust: [Vec<f32>; 2],
    /// Grey level by linear signal.
    response: Vec<f32>,
}

/// One exposure.
#[derive(Clone, Copy)]
pub(super) struct Shot {
    pub frame: usize,
    pub right: bool,
    /// Signal for light.
    pub exposure: f32,
    /// Where the sun stands in the image plane, if before the camera.
    pub sun: Option<Vector2<f64>>,
}

/// Steps of the response curve's table.
const STEPS: usize = 4096;

impl Sensor {
    pub fn new(options: CameraOptions, seed: u64, width: usize, height: usize) -> Self {
        let dust = [0, 1].map(|side| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xd057);
            rng.set_stream(side);
            specks(options.dust, width, height, &mut rng)
        });
        // The curve of sRGB (IEC 61966-2-1).
        let curve = |k: usize| {
            let s = k as f32 / STEPS as f32;
            if s <= 0.003_130_8 {
                12.92 * s
            } else {
                1.055 * s.powf(1.0 / 2.4) - 0.055
            }
        };
        Self {
            options,
            seed,
            width,
            height,
            dust,
            response: (0..=STEPS).map(curve).collect(),
        }
    }

    /// The automatic exposure: what brings the mean of an image's light, highlights and black sky
    /// aside, to a fifth of full scale.
    pub fn meter(&self, light: &[f32]) -> f32 {
        let lum = |p: &[f32]| 0.2126 * p[0] + 0.7152 * p[1] + 0.0722 * p[2];
        let (mut sum, mut n) = (0.0f64, 0.0f64);
        for pixel in light.chunks_exact(3) {
            let root = lum(pixel).max(0.0).sqrt();
            if root > 0.01 {
                sum += f64::from(root);
                n += 1.0;
            }
        }
        let mean = if n > 0.0 { (sum / n).powi(2) } else { 1.0 };
        (0.2 / mean * self.options.exposure) as f32
    }

    /// From the light on each pixel to the stored image, 0 to 1, in place: veil, lens, exposure,
    /// sensor and response curve, in the order that light and signal take.
    pub fn develop(&self, image: &mut [f32], shot: Shot) {
        let options = &self.options;
        let (w, h) = (self.width, self.height);
        let veil = (options.bloom > 0.0).then(|| self.veil(image, shot));
        let gain = shot.exposure
            * if shot.right {
                1.0 + options.gain as f32
            } else {
                1.0
            };
        let dust = &self.dust[usize::from(shot.right)];
        let corner = (w as f32).hypot(h as f32) / 2.0;

        // Variance of the noise: proportional to the signal (photons), and a hundredth of it at
        // mid grey always there (reading). Its deviation there, 0.5 in grey levels of the image, is
        // a signal of 0.214, where the response has slope 1.08.
        let sigma = (options.noise / 255.0 / 1.08) as f32;
        let (shot_noise, read_noise) = (0.99 * sigma * sigma / 0.214, 0.01 * sigma * sigma);
        let mut base = ChaCha8Rng::seed_from_u64(self.seed);
        base.set_stream(2 * shot.frame as u64 + u64::from(shot.right) + 1);
        let mut pattern = ChaCha8Rng::seed_from_u64(self.seed ^ 0xf1a7);
        pattern.set_stream(u64::from(shot.right));

        image
            .par_chunks_exact_mut(3 * w)
            .enumerate()
            .for_each(|(y, row)| {
                let at = (3 * w * y) as u128;
                let (mut noise, mut pattern) = (base.clone(), pattern.clone());
                noise.set_word_pos(at);
                pattern.set_word_pos(at);
                for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
                    let from_middle =
                        (x as f32 - w as f32 / 2.0).hypot(y as f32 - h as f32 / 2.0) / corner;
                    // The cosine to the fourth of an ordinary lens, as strong as asked for.
                    let lens = (1.0 - options.vignetting as f32 * from_middle.powi(2))
                        * dust.get(y * w + x).unwrap_or(&1.0);
                    for (c, value) in pixel.iter_mut().enumerate() {
                        let veiled = *value + veil.as_ref().map_or(0.0, |v| v[3 * (y * w + x) + c]);
                        let mut signal = veiled * lens * gain;
                        if options.pattern > 0.0 {
                            signal *= 1.0 + options.pattern as f32 * bell(&mut pattern);
                        }
                        if options.noise > 0.0 {
                            let deviation = (shot_noise * signal.max(0.0) + read_noise).sqrt();
                            signal += deviation * bell(&mut noise);
                        }
                        *value = self.respond(signal);
                    }
                }
            });
    }

    fn respond(&self, signal: f32) -> f32 {
        let at = signal.clamp(0.0, 1.0) * STEPS as f32;
        let k = (at as usize).min(STEPS - 1);
        let share = at - k as f32;
        self.response[k] * (1.0 - share) + self.response[k + 1] * share
    }

    /// Light scattered in the lens: a glow around the sun, inside the image or beyond its edge, and
    /// around what overexposes.
    fn veil(&self, image: &[f32], shot: Shot) -> Vec<f32> {
        let (w, h) = (self.width, self.height);
        let amount = self.options.bloom as f32;
        let too_bright = |v: &f32| (v - 1.0 / shot.exposure).max(0.0);
        let mut glow: Vec<f32> = image.iter().map(too_bright).collect();
        // Three running means along rows and columns are nearly a bell of this reach.
        let reach = (w / 60).max(1);
        for _ in 0..3 {
            glow = blurred_rows(&glow, w, reach);
            glow = transposed(&glow, w, h);
            glow = blurred_rows(&glow, h, reach);
            glow = transposed(&glow, h, w);
        }
        let scale = w as f32 / 6.0;
        for (k, pixel) in glow.chunks_exact_mut(3).enumerate() {
            let around_sun = shot.sun.map_or(0.0, |sun| {
                let (dx, dy) = ((k % w) as f32 - sun.x as f32, (k / w) as f32 - sun.y as f32);
                0.6 / shot.exposure / (1.0 + (dx.hypot(dy) / scale).powi(2))
            });
            for value in pixel {
                *value = amount * (0.5 * *value + around_sun);
            }
        }
        glow
    }
}

/// Near enough to normal, and the same on every machine: the sum of four uniform bytes, of mean
/// 510 and variance 4 (256^2 - 1) / 12.
fn bell(rng: &mut ChaCha8Rng) -> f32 {
    let bytes = rng.next_u32().to_le_bytes();
    let sum: u32 = bytes.into_iter().map(u32::from).sum();
    (sum as f32 - 510.0) / 147.8
}

/// Blurred dark discs, as specks out of focus on the front of a lens are.
fn specks(count: usize, width: usize, height: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    if count == 0 {
        return Vec::new();
    }
    let mut passes = vec![1.0f32; width * height];
    for _ in 0..count {
        let x = rng.random_range(0.0..width as f32);
        let y = rng.random_range(0.0..height as f32);
        let radius = width as f32 * rng.random_range(0.008..0.03);
        let dark = rng.random_range(0.05..0.35f32);
        for j in (y - radius).max(0.0) as usize..((y + radius) as usize + 1).min(height) {
            for i in (x - radius).max(0.0) as usize..((x + radius) as usize + 1).min(width) {
                let r = (i as f32 - x).hypot(j as f32 - y) / radius;
                let inside = ((1.0 - r) * 3.0).clamp(0.0, 1.0);
                passes[j * width + i] *= 1.0 - dark * inside * inside * (3.0 - 2.0 * inside);
            }
        }
    }
    passes
}

/// The running mean over `2 reach + 1` pixels of each row of colours.
fn blurred_rows(image: &[f32], width: usize, reach: usize) -> Vec<f32> {
    let mut out = vec![0.0; image.len()];
    let rows = out.par_chunks_exact_mut(3 * width);
    rows.zip(image.par_chunks_exact(3 * width))
        .for_each(|(out, row)| {
            for c in 0..3 {
                let at = |x: isize| row[3 * x.clamp(0, width as isize - 1) as usize + c];
                let reach = reach as isize;
                let mut sum: f32 = (-reach..=reach).map(at).sum();
                for x in 0..width as isize {
                    out[3 * x as usize + c] = sum / (2 * reach + 1) as f32;
                    sum += at(x + reach + 1) - at(x - reach);
                }
            }
        });
    out
}

/// The image with rows for columns.
fn transposed(image: &[f32], width: usize, height: usize) -> Vec<f32> {
    let mut out = vec![0.0; image.len()];
    for (k, pixel) in image.chunks_exact(3).enumerate() {
        let at = 3 * (k % width * height + k / width);
        out[at..at + 3].copy_from_slice(pixel);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synth::options::Options;

    fn sensor(change: impl Fn(&mut CameraOptions)) -> Sensor {
        let mut options = Options::default().camera;
        options.noise = 0.0;
        change(&mut options);
        Sensor::new(options, 7, 96, 64)
    }

    fn shot(sensor: &Sensor, light: f32, right: bool, frame: usize) -> Vec<f32> {
        let mut image = vec![light; 3 * 96 * 64];
        let shot = Shot {
            frame,
            right,
            exposure: 1.0,
            sun: Some(Vector2::new(90.0, -10.0)),
        };
        sensor.develop(&mut image, shot);
        image
    }

    #[test]
    fn the_response_is_srgb_and_full_scale_is_white() {
        let plain = sensor(|_| ());
        for (light, grey) in [
            (0.0, 0.0),
            (0.214, 0.5),
            (0.5, 0.7354),
            (1.0, 1.0),
            (3.0, 1.0),
        ] {
            assert!(
                (shot(&plain, light, false, 0)[99] - grey).abs() < 2e-3,
                "{light}"
            );
        }
    }

    #[test]
    fn each_fault_does_what_it_is_called() {
        let mean = |image: &[f32], from: usize, to: usize| {
            image[from..to].iter().sum::<f32>() / (to - from) as f32
        };
        let dark = shot(&sensor(|o| o.vignetting = 0.4), 0.2, false, 0);
        assert!(dark[0] < 0.85 * dark[3 * (32 * 96 + 48)]);
        let bloom = shot(&sensor(|o| o.bloom = 0.5), 0.2, false, 0);
        assert!(bloom[3 * 90] > 1.1 * bloom[3 * (60 * 96 + 5)]);
        let gain = sensor(|o| o.gain = 0.2);
        assert!(shot(&gain, 0.2, true, 0)[5] > shot(&gain, 0.2, false, 0)[5]);
        let dust = sensor(|o| o.dust = 9);
        let (left, right) = (shot(&dust, 0.2, false, 0), shot(&dust, 0.2, true, 0));
        assert!(mean(&left, 0, left.len()) < mean(&shot(&sensor(|_| ()), 0.2, false, 0), 0, 9));
        assert_ne!(left, right);
        // The fixed pattern stays from frame to frame, noise does not.
        let pattern = sensor(|o| o.pattern = 0.05);
        assert_eq!(shot(&pattern, 0.2, false, 0), shot(&pattern, 0.2, false, 3));
        let noise = sensor(|o| o.noise = 3.0);
        assert_ne!(shot(&noise, 0.2, false, 0), shot(&noise, 0.2, false, 3));
    }

    #[test]
    fn noise_has_the_deviation_asked_for_and_the_cameras_their_own() {
        let sensor = sensor(|o| o.noise = 2.0);
        let deviations = |right: bool, light: f32| -> Vec<f32> {
            let image = shot(&sensor, light, right, 1);
            let mean = image.iter().sum::<f32>() / image.len() as f32;
            image.iter().map(|v| (v - mean) * 255.0).collect()
        };
        let power = |d: &[f32]| (d.iter().map(|v| v * v).sum::<f32>() / d.len() as f32).sqrt();
        let (left, right) = (deviations(false, 0.214), deviations(true, 0.214));
        assert!((power(&left) - 2.0).abs() < 0.05 && (power(&right) - 2.0).abs() < 0.05);
        // Photon noise grows as the root of the light, and the curve's slope falls nearly as fast.
        assert!((1.5..2.6).contains(&power(&deviations(false, 0.7))));
        assert!((1.5..2.8).contains(&power(&deviations(false, 0.03))));
        let product: f32 = left.iter().zip(&right).map(|(a, b)| a * b).sum();
        assert!((product / left.len() as f32).abs() < 0.1);
    }
}
