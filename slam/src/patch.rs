//! Small pictures of map points, for sightings to a fraction of a pixel.

use barchan_datasets::Plane;
use nalgebra::{Matrix2, Vector2};

use crate::lanes::{dot, sum};

/// Half the side of a patch, samples; its outermost ring only serves the gradient.
const RADIUS: i32 = 5;
const SIDE: usize = 2 * RADIUS as usize + 1;
const INNER: usize = SIDE - 2;

/// What a map point looked like: samples around it, some pixels apart.
#[derive(Clone, Debug)]
pub struct Patch {
    samples: [f32; SIDE * SIDE],
    /// Pixels between samples: the scale of the feature.
    spacing: f32,
    /// Depth of the point when the patch was cut, metres.
    depth: f32,
}

impl Patch {
    /// How many numbers a patch is made of.
    pub(crate) const NUMBERS: usize = SIDE * SIDE + 2;

    /// Samples, spacing and depth.
    pub(crate) fn to_numbers(&self) -> [f32; Self::NUMBERS] {
        std::array::from_fn(|k| match k.checked_sub(SIDE * SIDE) {
            None => self.samples[k],
            Some(0) => self.spacing,
            Some(_) => self.depth,
        })
    }

    /// The patch that these numbers are of; `None` when one of them is none.
    pub(crate) fn from_numbers(numbers: &[f32]) -> Option<Self> {
        let whole = numbers.len() == Self::NUMBERS && numbers.iter().all(|n| n.is_finite());
        whole.then(|| Self {
            samples: std::array::from_fn(|k| numbers[k]),
            spacing: numbers[SIDE * SIDE],
            depth: numbers[SIDE * SIDE + 1],
        })
    }

    /// Cuts a patch around a place of an image; `None` where it would leave the image.
    pub fn cut(image: &Plane, at: Vector2<f64>, spacing: f64, depth: f64) -> Option<Self> {
        let samples = sample::<{ SIDE * SIDE }, SIDE>(image, at, spacing)?;
        Some(Self {
            samples,
            spacing: spacing as f32,
            depth: depth as f32,
        })
    }

    /// Where the patch is in another image, which sees the point at `depth` and roughly at `guess`:
    /// translation by inverse compositional Gauss-Newton (Baker and Matthews 2004) on samples of
    /// equal mean and contrast, the patch scaled by the ratio of depths. `None` where it does not
    /// settle near the guess or does not look alike.
    pub fn find(&self, image: &Plane, guess: Vector2<f64>, depth: f64) -> Option<Vector2<f64>> {
        const LIKENESS: f32 = 0.85;
        let spacing = f64::from(self.spacing) * f64::from(self.depth) / depth;
        let mut reference = [0.0f32; INNER * INNER];
        let [mut along, mut down] = [[0.0f32; INNER * INNER]; 2];
        for y in 0..INNER {
            for x in 0..INNER {
                let (at, inner) = ((y + 1) * SIDE + x + 1, y * INNER + x);
                reference[inner] = self.samples[at];
                along[inner] = 0.5 * (self.samples[at + 1] - self.samples[at - 1]);
                down[inner] = 0.5 * (self.samples[at + SIDE] - self.samples[at - SIDE]);
            }
        }
        let contrast = normalise(&mut reference)?;
        for gradient in [&mut along, &mut down] {
            gradient.iter_mut().for_each(|g| *g /= contrast);
        }
        let mixed = dot(&along, &down);
        let hessian = Matrix2::new(dot(&along, &along), mixed, mixed, dot(&down, &down));
        let inverse = hessian.try_inverse()?;

        let mut at = guess;
        for _ in 0..10 {
            let mut seen = sample::<{ INNER * INNER }, INNER>(image, at, spacing)?;
            normalise(&mut seen)?;
            let error: [f32; INNER * INNER] = std::array::from_fn(|k| reference[k] - seen[k]);
            let pull = Vector2::new(dot(&along, &error), dot(&down, &error));
            let step = (inverse * pull).cast::<f64>() * spacing;
            at += step;
            if (at - guess).norm() > 2.5 * spacing.max(1.0) {
                return None;
            }
            if step.norm() < 0.01 * spacing {
                return (dot(&reference, &seen) > LIKENESS).then_some(at);
            }
        }
        None
    }
}

/// Takes the mean out and divides by the norm, which is returned; `None` for a blank.
fn normalise(samples: &mut [f32]) -> Option<f32> {
    let mean = sum(samples) / samples.len() as f32;
    samples.iter_mut().for_each(|s| *s -= mean);
    let norm = dot(samples, samples).sqrt();
    if norm < 1e-3 {
        return None;
    }
    samples.iter_mut().for_each(|s| *s /= norm);
    Some(norm)
}

/// A square of `SIDE` x `SIDE` samples around a place, linearly between pixels; `None` where it leaves the image.
fn sample<const N: usize, const SIDE: usize>(
    image: &Plane,
    at: Vector2<f64>,
    spacing: f64,
) -> Option<[f32; N]> {
    let radius = (SIDE / 2) as f64;
    let reach = spacing * radius;
    let (width, height) = (image.width() as usize, image.height() as usize);
    let inside = |x: f64, size: usize| x - reach >= 0.0 && x + reach + 1.0 < size as f64;
    if !(inside(at.x, width) && inside(at.y, height)) {
        return None;
    }
    // Whole pixel and fraction of each column, and of each row.
    let split = |centre: f64| -> [(usize, f32); SIDE] {
        std::array::from_fn(|k| {
            let x = centre + spacing * (k as f64 - radius);
            (x as usize, x.fract() as f32)
        })
    };
    let (columns, pixels) = (split(at.x), image.as_raw());
    let mut samples = [0.0; N];
    for (samples, (y, b)) in samples.chunks_exact_mut(SIDE).zip(split(at.y)) {
        let (upper, lower) = (&pixels[y * width..][..width], &pixels[(y + 1) * width..]);
        for (sample, (x, a)) in samples.iter_mut().zip(columns) {
            let top = upper[x] + a * (upper[x + 1] - upper[x]);
            let bottom = lower[x] + a * (lower[x + 1] - lower[x]);
            *sample = top + b * (bottom - top);
        }
    }
    Some(samples)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Waves, seen from nearer by `zoom` and moved.
    fn picture(zoom: f64, moved: Vector2<f64>) -> Plane {
        Plane::from_fn(90, 70, |u, v| {
            let x = 40.0 + (f64::from(u) - 40.0 - moved.x) / zoom;
            let y = 30.0 + (f64::from(v) - 30.0 - moved.y) / zoom;
            let waves =
                (0.5 * x + 0.2 * y).sin() + (0.3 * x - 0.45 * y).sin() + (0.1 * x * y / 30.0).cos();
            image::Luma([(0.4 + 0.1 * waves) as f32])
        })
    }

    #[test]
    fn a_patch_is_found_to_a_hundredth_of_a_pixel() {
        let at = Vector2::new(40.0, 30.0);
        let patch = Patch::cut(&picture(1.0, Vector2::zeros()), at, 1.2, 2.0).unwrap();
        for (zoom, moved) in [
            (1.0, Vector2::new(0.0, 0.0)),
            (1.0, Vector2::new(0.4, -0.7)),
            (1.25, Vector2::new(-0.6, 0.3)),
        ] {
            // Half the contrast and another level: exposure says nothing.
            let mut seen = picture(zoom, moved);
            seen.iter_mut().for_each(|v| *v = 0.5 * *v + 0.1);
            let found = patch.find(&seen, at, 2.0 / zoom).unwrap();
            assert!(
                (found - at - moved).norm() < 0.03,
                "{zoom} {moved}: {found}"
            );
        }
    }

    #[test]
    fn what_is_not_there_is_not_found() {
        let at = Vector2::new(40.0, 30.0);
        let patch = Patch::cut(&picture(1.0, Vector2::zeros()), at, 1.0, 2.0).unwrap();
        let blank = Plane::from_pixel(90, 70, image::Luma([0.5]));
        assert!(patch.find(&blank, at, 2.0).is_none());
        let mut negative = picture(1.0, Vector2::zeros());
        negative.iter_mut().for_each(|v| *v = 1.0 - *v);
        assert!(patch.find(&negative, at, 2.0).is_none());
        for (depth, guess) in [
            (2.0, Vector2::new(1.0, 1.0)),
            (0.0, at),
            (f64::NAN, at),
            (2.0, Vector2::new(-5.0, f64::NAN)),
        ] {
            assert!(
                patch
                    .find(&picture(1.0, Vector2::zeros()), guess, depth)
                    .is_none()
            );
        }
        assert!(Patch::cut(&blank, Vector2::new(2.0, 30.0), 1.0, 2.0).is_none());
    }
}
