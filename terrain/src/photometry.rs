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
    /// Sum of the logarithms of how far away its points were, metres.
    range: f32,
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

    /// Adds what the next key frame saw, in the world, from `eye`.
    pub fn add(&mut self, cloud: &Cloud, eye: &Point3<f64>) {
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
                    range: 0.0,
                });
            }
            if let Some(sighting) = sightings.last_mut() {
                sighting.points += 1;
                // Nothing is seen from nearer than a millimetre.
                sighting.range += (p.position - eye).norm().max(1e-3).ln() as f32;
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
    /// `ln(colour) = ln(gain of the key frame) + ln(colour of the place) + b1 r + b2 r^2` with `r = ln(range)`, least
    /// squares with Tukey's weights: a shadow that moved, a highlight and a wrong point are outliers. The range stands
    /// for lenses that are darker in the corners and for ground that is brighter the flatter one looks at it. On a straight
    /// drive, where each place comes nearer alike, that looks like a gain that grows from key frame to key frame, and
    /// would pile up. A little weight on gains of 1 and on coefficients of 0 keeps it from that; so a steady change of
    /// light along a long way without return is not seen.
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
        let mut looks: Vec<Vec<Logarithm>> = places
            .iter()
            .map(|(_, s)| s.iter().map(|s| s.logarithm(channel)).collect())
            .collect();
        // Ranges about their mean, so that their square says something else than they do.
        let count = looks.iter().flatten().count().max(1) as f64;
        let middle = looks.iter().flatten().map(|l| l.range).sum::<f64>() / count;
        for look in looks.iter_mut().flatten() {
            look.range -= middle;
        }
        let mut unknowns = DVector::zeros(self.keyframes + 2);
        for _ in 0..ROUNDS {
            unknowns = conjugate_gradients(&looks, self.keyframes);
            let mut residuals = vec![];
            for looks in &looks {
                let rest = |l: &Logarithm| l.value - l.modelled(&unknowns);
                let place = weighted_mean(looks, rest);
                residuals.extend(looks.iter().map(|l| rest(l) - place));
            }
            let mut sizes: Vec<f64> = residuals.iter().map(|r: &f64| r.abs()).collect();
            if sizes.is_empty() {
                break;
            }
            let middle = sizes.len() / 2;
            let (_, median, _) = sizes.select_nth_unstable_by(middle, f64::total_cmp);
            // The floor is less than a grey level.
            let deviation = (1.4826 * *median).max(2e-3);
            // Tukey's biweight at 95 % efficiency.
            let reach = 4.685 * deviation;
            for (look, residual) in looks.iter_mut().flatten().zip(residuals) {
                let share = (residual / reach).powi(2).min(1.0);
                // Not quite 0, so that no place loses all of its weight.
                look.weight = (1.0 - share).powi(2).max(1e-6);
            }
        }
        unknowns.rows(0, self.keyframes).into_owned()
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

impl Sighting {
    fn logarithm(&self, channel: usize) -> Logarithm {
        let n = f64::from(self.points);
        Logarithm {
            keyframe: self.keyframe as usize,
            value: (f64::from(self.linear_rgb[channel]) / n).ln(),
            range: f64::from(self.range) / n,
            weight: 1.0,
        }
    }
}

/// A sighting as the least squares see it.
struct Logarithm {
    keyframe: usize,
    /// Of the light.
    value: f64,
    /// Of the range.
    range: f64,
    weight: f64,
}

impl Logarithm {
    /// What gain and range make of it; the gains stand first, then the two coefficients of the range.
    fn modelled(&self, unknowns: &DVector<f64>) -> f64 {
        let k = unknowns.len() - 2;
        unknowns[self.keyframe] + self.range * (unknowns[k] + self.range * unknowns[k + 1])
    }

    /// Adds its derivative, times `by`.
    fn add_derivative(&self, by: f64, sums: &mut DVector<f64>) {
        let k = sums.len() - 2;
        sums[self.keyframe] += by;
        sums[k] += by * self.range;
        sums[k + 1] += by * self.range * self.range;
    }
}

fn weighted_mean(looks: &[Logarithm], value: impl Fn(&Logarithm) -> f64) -> f64 {
    let (mut sum, mut total) = (0.0, 0.0);
    for look in looks {
        sum += look.weight * value(look);
        total += look.weight;
    }
    sum / total
}

/// Gains and coefficients of the range of least squares, the colours of the places eliminated: conjugate gradients,
/// preconditioned by the diagonal.
fn conjugate_gradients(looks: &[Vec<Logarithm>], keyframes: usize) -> DVector<f64> {
    /// A gain of 1 weighs as much as this share of the sightings of a key frame, a coefficient of 0 this one. Sightings are
    /// many and err together, so that no weight in terms of their scatter would do.
    const CALM: [f64; 2] = [0.003, 0.03];
    // What is left of values after each place took its mean, against the derivatives.
    let normal = |value: &dyn Fn(&Logarithm) -> f64| {
        let mut sums = DVector::zeros(keyframes + 2);
        for looks in looks {
            let place = weighted_mean(looks, value);
            for look in looks {
                look.add_derivative(look.weight * (value(look) - place), &mut sums);
            }
        }
        sums
    };
    let mut diagonal = DVector::zeros(keyframes + 2);
    for look in looks.iter().flatten() {
        diagonal[look.keyframe] += look.weight;
        diagonal[keyframes] += look.weight * look.range.powi(2);
        diagonal[keyframes + 1] += look.weight * look.range.powi(4);
    }
    let weight = diagonal.rows(0, keyframes).sum() / keyframes.max(1) as f64;
    let prior = DVector::from_fn(keyframes + 2, |k, _| {
        weight * CALM[usize::from(k >= keyframes)]
    });
    diagonal += &prior;

    let right = normal(&|look| look.value);
    let enough = 1e-20 * right.component_div(&diagonal).dot(&right);
    let mut unknowns = DVector::zeros(keyframes + 2);
    let mut residual = right;
    let mut direction = residual.component_div(&diagonal);
    let mut squared = residual.dot(&direction);
    for _ in 0..10 * keyframes {
        // NaN ends it too.
        if squared.is_nan() || squared <= enough {
            break;
        }
        let mut image = normal(&|look| look.modelled(&direction));
        image += prior.component_mul(&direction);
        let step = squared / direction.dot(&image);
        unknowns += &direction * step;
        residual -= image * step;
        let conditioned = residual.component_div(&diagonal);
        let next = residual.dot(&conditioned);
        direction = conditioned + direction * (next / squared);
        squared = next;
    }
    unknowns
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

    /// Where a key frame stands that sees twelve rows of places from `start` on: before them, or beyond, looking back.
    fn eye(start: i32, back: bool) -> Point3<f64> {
        Point3::new(f64::from(start) + if back { 15.0 } else { -3.0 }, 5.0, 2.0)
    }

    /// What it sees, through gains; a share `astray` of the places is of another colour. What is farther is brighter
    /// by a power of the range.
    fn view(
        start: i32,
        eye: &Point3<f64>,
        gain: [f64; 3],
        astray: f64,
        power: f64,
        rng: &mut ChaCha8Rng,
    ) -> Cloud {
        let places = (start..start + 12).flat_map(|x| (0..10).map(move |y| (x, y)));
        let mut points = vec![];
        for (x, y) in places {
            let mut light = albedo(x, y);
            let range = (Point3::new(f64::from(x), f64::from(y), 0.5) - eye).norm();
            light = light.map(|l| l * (range / 8.0).powf(power));
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
    fn planted_gains_come_back_along_a_way_and_home_though_some_places_changed() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let planted = planted(60);
        let mut gains = ColourGains::new(1.0).unwrap();
        for (k, gain) in planted.iter().enumerate() {
            // From the middle on it looks back.
            let start = 3 * (k.min(59 - k)) as i32;
            let eye = eye(start, k >= 30);
            gains.add(&view(start, &eye, *gain, 0.1, 0.1, &mut rng), &eye);
        }
        let found = gains.solve();
        let off = difference(&found, &planted);
        println!("largest error of a gain {:.2} %", 100.0 * off);
        assert!(off < 0.07, "{off}");
        for c in 0..3 {
            let sum: f64 = found.iter().map(|g| g[c].ln()).sum();
            assert!(sum.abs() < 1e-6, "{sum}");
        }
    }

    #[test]
    fn what_is_brighter_far_away_is_no_gain_that_grows_along_the_way() {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let mut gains = ColourGains::new(1.0).unwrap();
        for k in 0..60 {
            let eye = eye(3 * k, false);
            gains.add(&view(3 * k, &eye, [1.0; 3], 0.05, 0.2, &mut rng), &eye);
        }
        // Taken for gains it would be a factor of 1.03 a key frame, and of 6 over the way.
        let found = gains.solve();
        let off = difference(&found, &[[1.0; 3]; 60]);
        println!("largest gain {:.2} % off", 100.0 * off);
        assert!(off < 0.1, "{off}");
    }

    #[test]
    fn what_is_not_linked_keeps_its_colour() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut gains = ColourGains::new(1.0).unwrap();
        let planted = [[1.4, 1.0, 0.8], [0.7, 1.0, 1.2]];
        let near = eye(0, false);
        gains.add(&view(0, &near, planted[0], 0.0, 0.0, &mut rng), &near);
        gains.add(&view(2, &near, planted[1], 0.0, 0.0, &mut rng), &near);
        gains.add(&view(500, &near, [1.3; 3], 0.0, 0.0, &mut rng), &near);
        gains.add(&Cloud::default(), &near);
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
            let start = 3 * k.min(11 - k) as i32;
            let eye = eye(start, k >= 6);
            gains.add(&view(start, &eye, *gain, 0.0, 0.0, &mut rng), &eye);
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
