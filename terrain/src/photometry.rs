//! What exposure and white balance did to each key frame, learnt from places that several saw.

use nalgebra::{DVector, Point3};
use rustc_hash::{FxBuildHasher, FxHashMap};
use std::hash::BuildHasher;

use crate::voxel::{linear_to_srgb, srgb_to_linear};
use crate::{Cloud, TerrainError};

/// Gains of key frames, learnt from clouds that are added one by one and forgotten.
///
/// What is kept is the mean colour that each key frame gave to a place, for a choice of places that thins out as
/// it fills up, so that memory does not grow with the way. The choice is by the place alone: whoever sees one
/// again is compared there.
#[derive(Clone, Debug)]
pub struct ColourGains {
    /// Edge of a place, metres.
    size: f64,
    keyframes: usize,
    places: FxHashMap<[i32; 3], Vec<Sighting>>,
    sightings: usize,
    /// Only places whose hash ends in so many zeros are kept.
    thinned: u32,
}

/// What one key frame saw of one place.
#[derive(Clone, Copy, Debug)]
struct Sighting {
    keyframe: u32,
    points: u32,
    /// Sum of linear light.
    linear_rgb: [f32; 3],
}

/// Most sightings that are kept: 50 MB.
const MOST: usize = 2_000_000;
/// Levels, of 255, below and above which a camera's answer says little of the light.
const LEVELS: std::ops::RangeInclusive<u8> = 8..=247;

impl ColourGains {
    /// Nothing seen yet; places are cubes of `size` metres.
    ///
    /// # Errors
    /// When `size` is not a positive number.
    pub fn new(size: f64) -> Result<Self, TerrainError> {
        crate::error::positive("size of a place", size)?;
        Ok(Self {
            size,
            keyframes: 0,
            places: FxHashMap::default(),
            sightings: 0,
            thinned: 0,
        })
    }

    /// Adds what the next key frame saw, in the world.
    pub fn add(&mut self, cloud: &Cloud) {
        let keyframe = self.keyframes as u32;
        self.keyframes += 1;
        for p in &cloud.points {
            let Some(place) = self.place(&p.position).filter(|p| self.is_kept(p)) else {
                continue;
            };
            if !p.colour.iter().all(|c| LEVELS.contains(c)) {
                continue;
            }
            let sightings = self.places.entry(place).or_default();
            if sightings.last().is_none_or(|s| s.keyframe != keyframe) {
                self.sightings += 1;
                sightings.push(Sighting {
                    keyframe,
                    points: 0,
                    linear_rgb: [0.0; 3],
                });
            }
            if let Some(sighting) = sightings.last_mut() {
                sighting.points += 1;
                for (sum, c) in sighting.linear_rgb.iter_mut().zip(p.colour) {
                    *sum += srgb_to_linear(c) as f32;
                }
            }
            if self.sightings > MOST {
                self.thin();
            }
        }
    }

    /// Red, green and blue by which the light of each key frame was multiplied, in the order in which they were
    /// added. Their geometric mean over key frames that are linked by common places is 1: what all have in common
    /// is nobody's gain. A key frame that shares no place with another has gains of 1.
    ///
    /// `ln(colour) = ln(gain of the key frame) + ln(colour of the place)`, least squares with Tukey's weights: a
    /// shadow that moved, a highlight and a wrong point are outliers.
    pub fn solve(&self) -> Vec<[f64; 3]> {
        let mut gains = vec![[1.0; 3]; self.keyframes];
        for channel in 0..3 {
            for (gain, logarithm) in gains.iter_mut().zip(self.solve_channel(channel).iter()) {
                gain[channel] = logarithm.exp();
            }
        }
        gains
    }

    fn solve_channel(&self, channel: usize) -> DVector<f64> {
        const ROUNDS: usize = 6;
        // In a fixed order, so that the same clouds give the same bits.
        let mut places: Vec<_> = self.places.iter().filter(|(_, s)| s.len() > 1).collect();
        places.sort_unstable_by_key(|(key, _)| **key);
        let seen: Vec<Vec<(usize, f64)>> = places
            .iter()
            .map(|(_, sightings)| {
                let logarithm = |s: &Sighting| {
                    let mean = f64::from(s.linear_rgb[channel]) / f64::from(s.points);
                    (s.keyframe as usize, mean.ln())
                };
                sightings.iter().map(logarithm).collect()
            })
            .collect();
        let mut weights: Vec<Vec<f64>> = seen.iter().map(|s| vec![1.0; s.len()]).collect();
        let mut gains = DVector::zeros(self.keyframes);
        for _ in 0..ROUNDS {
            gains = conjugate_gradients(&seen, &weights, self.keyframes);
            let residuals: Vec<Vec<f64>> = (seen.iter().zip(&weights))
                .map(|(seen, weights)| {
                    let place = weighted_mean(seen, weights, |k, y| y - gains[k]);
                    seen.iter().map(|&(k, y)| y - gains[k] - place).collect()
                })
                .collect();
            let mut sizes: Vec<f64> = residuals.iter().flatten().map(|r| r.abs()).collect();
            if sizes.is_empty() {
                break;
            }
            let middle = sizes.len() / 2;
            let deviation = 1.4826 * *sizes.select_nth_unstable_by(middle, f64::total_cmp).1;
            // 4.685 deviations: Tukey's biweight at 95 % efficiency. The floor is a grey level's step.
            let reach = 4.685 * deviation.max(2e-3);
            for (weights, residuals) in weights.iter_mut().zip(&residuals) {
                for (weight, residual) in weights.iter_mut().zip(residuals) {
                    let share = (residual / reach).powi(2);
                    // Not quite 0, so that no place loses all of its weight.
                    *weight = (1.0 - share.min(1.0)).powi(2).max(1e-6);
                }
            }
        }
        gains
    }

    fn place(&self, p: &Point3<f64>) -> Option<[i32; 3]> {
        let cell = p.coords.map(|x| (x / self.size).floor());
        // NaN is refused too.
        cell.iter()
            .all(|c| c.abs() < f64::from(i32::MAX))
            .then(|| [cell.x as i32, cell.y as i32, cell.z as i32])
    }

    fn is_kept(&self, place: &[i32; 3]) -> bool {
        FxBuildHasher.hash_one(place).leading_zeros() >= self.thinned
    }

    /// Forgets about half of the places.
    fn thin(&mut self) {
        self.thinned += 1;
        let mut places = std::mem::take(&mut self.places);
        places.retain(|place, _| self.is_kept(place));
        self.sightings = places.values().map(Vec::len).sum();
        self.places = places;
    }
}

fn weighted_mean(seen: &[(usize, f64)], weights: &[f64], value: impl Fn(usize, f64) -> f64) -> f64 {
    let (mut sum, mut total) = (0.0, 0.0);
    for (&(k, y), w) in seen.iter().zip(weights) {
        sum += w * value(k, y);
        total += w;
    }
    sum / total
}

/// The gains of least squares, the colours of the places eliminated. The matrix is a graph's Laplacian, whose null space
/// is a common gain of what is linked: begun at zero, conjugate gradients never enter it, which fixes the gauge.
fn conjugate_gradients(
    seen: &[Vec<(usize, f64)>],
    weights: &[Vec<f64>],
    keyframes: usize,
) -> DVector<f64> {
    // What is left of values after each place took its mean, summed by key frame.
    let reduced = |value: &dyn Fn(usize, f64) -> f64| {
        let mut sums = DVector::zeros(keyframes);
        for (seen, weights) in seen.iter().zip(weights) {
            let place = weighted_mean(seen, weights, value);
            for (&(k, y), w) in seen.iter().zip(weights) {
                sums[k] += w * (value(k, y) - place);
            }
        }
        sums
    };
    let right = reduced(&|_, y| y);
    let enough = 1e-16 * right.norm_squared();
    let mut gains = DVector::zeros(keyframes);
    let mut residual = right;
    let mut direction = residual.clone();
    let mut squared = residual.norm_squared();
    for _ in 0..10 * keyframes {
        if squared <= enough {
            break;
        }
        let image = reduced(&|k, _| direction[k]);
        let step = squared / direction.dot(&image);
        gains += &direction * step;
        residual -= image * step;
        let next = residual.norm_squared();
        direction = &residual + &direction * (next / squared);
        squared = next;
    }
    gains
}

/// An image, sRGB in 0..=1, as it would be had its light not been multiplied by `gain`.
pub(crate) fn without_gain(
    image: &barchan_datasets::Rgb,
    gain: &[f64; 3],
) -> barchan_datasets::Rgb {
    // A level of the image is one of 255: a table has all.
    let tables = gain.map(|g| -> Vec<f32> {
        (0..=255)
            .map(|level| {
                let linear = (srgb_to_linear(level) / g).clamp(0.0, 1.0);
                f32::from(linear_to_srgb(linear)) / 255.0
            })
            .collect()
    });
    let mut image = image.clone();
    for pixel in image.pixels_mut() {
        for (value, table) in pixel.0.iter_mut().zip(&tables) {
            *value = table[(value.clamp(0.0, 1.0) * 255.0).round() as usize];
        }
    }
    image
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::CloudPoint;

    /// Light of a place that repeats nowhere near.
    fn albedo(x: i32, y: i32) -> [f64; 3] {
        let wave =
            |a: f64| 0.15 + 0.1 * (a * f64::from(x)).sin() * (0.7 * a * f64::from(y) + a).cos();
        [wave(0.9), wave(1.7), wave(2.3)]
    }

    /// What a key frame sees of places from `start` on, through gains; one place in `astray` is of another colour.
    fn view(start: i32, gain: [f64; 3], astray: f64, rng: &mut ChaCha8Rng) -> Cloud {
        let places = (start..start + 12).flat_map(|x| (0..10).map(move |y| (x, y)));
        let mut points = vec![];
        for (x, y) in places {
            let mut light = albedo(x, y);
            if rng.random_bool(astray) {
                light = light.map(|l| 0.3 * l);
            }
            for k in 0..3 {
                let level = |c: usize| {
                    let noise = 1.0 + 0.06 * (rng.random::<f64>() - 0.5);
                    linear_to_srgb((light[c] * gain[c] * noise).clamp(0.0, 1.0))
                };
                let colour = [0, 1, 2].map(level);
                points.push(CloudPoint {
                    position: Point3::new(
                        f64::from(x) + 0.2 * f64::from(k),
                        f64::from(y) + 0.5,
                        0.5,
                    ),
                    colour,
                    sigma: f32::NAN,
                });
            }
        }
        Cloud { points }
    }

    fn planted(count: usize) -> Vec<[f64; 3]> {
        let gain = |k: usize, a: f64| (0.35 * (a * k as f64 + a).sin()).exp();
        (0..count)
            .map(|k| [gain(k, 0.31), gain(k, 0.17), gain(k, 0.53)])
            .collect()
    }

    /// Largest difference of logarithms, each set freed of its common gain.
    fn difference(found: &[[f64; 3]], planted: &[[f64; 3]]) -> f64 {
        let mut largest: f64 = 0.0;
        for c in 0..3 {
            let off: Vec<f64> = (found.iter().zip(planted))
                .map(|(f, p)| (f[c] / p[c]).ln())
                .collect();
            let mean = off.iter().sum::<f64>() / off.len() as f64;
            largest = off.iter().fold(largest, |l, o| l.max((o - mean).abs()));
        }
        largest
    }

    #[test]
    fn planted_gains_come_back_along_a_way_though_some_places_changed() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let planted = planted(60);
        let mut gains = ColourGains::new(1.0).unwrap();
        for (k, gain) in planted.iter().enumerate() {
            gains.add(&view(3 * k as i32, *gain, 0.1, &mut rng));
        }
        let found = gains.solve();
        let off = difference(&found, &planted);
        println!("largest error of a gain {:.2} %", 100.0 * off);
        assert!(off < 0.05, "{off}");
        for c in 0..3 {
            let sum: f64 = found.iter().map(|g| g[c].ln()).sum();
            assert!(sum.abs() < 1e-6, "{sum}");
        }
    }

    #[test]
    fn what_is_not_linked_keeps_its_colour() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut gains = ColourGains::new(1.0).unwrap();
        let planted = [[1.4, 1.0, 0.8], [0.7, 1.0, 1.2]];
        gains.add(&view(0, planted[0], 0.0, &mut rng));
        gains.add(&view(2, planted[1], 0.0, &mut rng));
        gains.add(&view(500, [1.3; 3], 0.0, &mut rng));
        gains.add(&Cloud::default());
        let found = gains.solve();
        assert_eq!(&found[2..], [[1.0; 3]; 2]);
        assert!(difference(&found[..2], &planted) < 0.01);
    }

    #[test]
    fn memory_is_bounded_and_thinning_keeps_what_compares() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let planted = planted(12);
        let mut gains = ColourGains::new(1.0).unwrap();
        for (k, gain) in planted.iter().enumerate() {
            gains.add(&view(3 * k as i32, *gain, 0.0, &mut rng));
            if k % 5 == 4 {
                gains.thin();
            }
        }
        let kept: usize = gains.places.values().map(Vec::len).sum();
        assert_eq!(kept, gains.sightings);
        assert!(kept < 12 * 120 / 2, "{kept}");
        assert!(difference(&gains.solve(), &planted) < 0.05);
    }

    #[test]
    fn an_image_is_freed_of_its_gain() {
        let image = barchan_datasets::Rgb::from_pixel(4, 3, image::Rgb([0.5, 0.5, 0.5]));
        let freed = without_gain(&image, &[2.0, 1.0, 0.5]);
        let linear = |v: f32| srgb_to_linear((v * 255.0).round() as u8);
        let [r, g, b] = freed.get_pixel(0, 0).0.map(linear);
        assert!((g / r - 2.0).abs() < 0.03 && (b / g - 2.0).abs() < 0.03);
    }
}
