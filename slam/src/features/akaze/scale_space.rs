//! The non-linear scale space (Alcantarilla 2013, 3.1 and 3.2): the image at rising scales, each
//! diffused from the one before, little across edges.

use barchan_datasets::Plane;

use super::filters::{blur, conductivity, diffuse, gradient, halve, hessian_determinant};

/// Octaves, and levels in each.
const OCTAVES: u32 = 4;
const SUBLEVELS: u32 = 4;
/// Scale of the first level, pixels.
pub(super) const FIRST_SIGMA: f32 = 1.6;
/// Derivatives are taken at so many times the scale of a level.
const DERIVATIVE_FACTOR: f32 = 1.5;
/// The smallest level that is worth an octave, pixels.
const SMALLEST: [u32; 2] = [80, 40];

/// The image at one scale.
pub(super) struct Level {
    /// Scale, pixels of the image.
    pub sigma: f32,
    /// Size of a pixel of this level in pixels of the image: 1, 2, 4 or 8.
    pub ratio: f32,
    /// Distance of the samples of derivatives, pixels of this level.
    pub spacing: usize,
    /// The diffused image.
    pub image: Plane,
    /// Its derivatives along rows and columns, normalised for scale.
    pub gradient: [Plane; 2],
    /// Determinant of its Hessian, normalised for scale.
    pub response: Plane,
}

/// All levels of an image, from fine to coarse.
///
/// Two peculiarities of the authors' program are kept, because thresholds mean what they mean with
/// them: derivatives are of the image before the diffusion of their level, blurred by one pixel; and
/// the time of diffusion counts pixels of the image, also where it is spent on a smaller one.
pub(super) fn scale_space(grey: &Plane) -> Vec<Level> {
    let [width, height] = [grey.width(), grey.height()];
    let mut contrast = contrast_factor(&blur::<5>(grey, 1.0));
    let mut image = blur::<9>(grey, FIRST_SIGMA);
    let mut smooth = image.clone();
    let mut time = 0.5 * FIRST_SIGMA.powi(2);
    let mut levels = Vec::new();
    for octave in 0..OCTAVES {
        if octave > 0 && (width >> octave < SMALLEST[0] || height >> octave < SMALLEST[1]) {
            break;
        }
        let ratio = (1 << octave) as f32;
        for sublevel in 0..SUBLEVELS {
            let sigma = FIRST_SIGMA * ratio * (sublevel as f32 / SUBLEVELS as f32).exp2();
            let until = 0.5 * sigma.powi(2);
            if octave > 0 && sublevel == 0 {
                image = halve(&image);
                contrast *= 0.75;
            }
            if until > time {
                smooth = blur::<5>(&image, 1.0);
                image = evolve(image, &conductivity(&smooth, contrast), until - time);
            }
            time = until;
            let spacing = (sigma * DERIVATIVE_FACTOR / ratio).round() as usize;
            let gradient = gradient(&smooth, spacing);
            levels.push(Level {
                sigma,
                ratio,
                spacing,
                image: image.clone(),
                response: hessian_determinant(&gradient, spacing),
                gradient,
            });
        }
    }
    levels
}

/// Diffusion for `time` by a cycle of fast explicit steps (Grewenig 2010).
fn evolve(mut image: Plane, conductivity: &Plane, time: f32) -> Plane {
    let mut diffused = Plane::new(image.width(), image.height());
    for tau in fast_explicit_steps(time) {
        diffuse(&image, conductivity, tau, &mut diffused);
        std::mem::swap(&mut image, &mut diffused);
    }
    image
}

/// The steps of a cycle that lasts `time`: most of them longer than a stable step of explicit
/// diffusion, stable together. The order keeps the errors of rounding small.
fn fast_explicit_steps(time: f32) -> Vec<f32> {
    /// The longest stable step in two dimensions.
    const STABLE: f32 = 0.25;
    let n = ((3.0 * time / STABLE + 0.25).sqrt() - 0.5).ceil().max(1.0) as usize;
    let scale = 1.5 * time / (n * (n + 1)) as f32;
    let step = |k: usize| {
        let angle = std::f32::consts::PI * (2 * k + 1) as f32 / (4 * n + 2) as f32;
        scale / angle.cos().powi(2)
    };
    // Multiples of about half of n, modulo a prime over n, visit every step once.
    let is_prime = |p: &usize| {
        (2..*p)
            .take_while(|d| d * d <= *p)
            .all(|d| !p.is_multiple_of(d))
    };
    let prime = (n + 1..).find(is_prime).unwrap_or(n + 1);
    let stride = (n / 2).max(1);
    (1..prime)
        .map(|k| k * stride % prime - 1)
        .filter(|index| *index < n)
        .map(step)
        .collect()
}

/// The gradient that counts as an edge: the 70th percentile of those that are not blank, from a
/// histogram.
fn contrast_factor(smooth: &Plane) -> f32 {
    const BINS: usize = 300;
    const PERCENTILE: f32 = 0.7;
    /// Of a blank image.
    const NONE: f32 = 0.03;
    let [dx, dy] = gradient(smooth, 1);
    let lengths: Vec<f32> = dx
        .iter()
        .zip(dy.iter())
        .map(|(x, y)| (x * x + y * y).sqrt())
        .collect();
    let largest = lengths.iter().copied().fold(0.0, f32::max);
    if largest <= 0.0 {
        return NONE;
    }
    let mut histogram = [0usize; BINS];
    for length in &lengths {
        histogram[((length / largest * BINS as f32) as usize).min(BINS - 1)] += 1;
    }
    let wanted = (PERCENTILE * (lengths.len() - histogram[0]) as f32) as usize;
    let mut below = 0;
    for (bin, count) in histogram.iter().enumerate().skip(1) {
        if below >= wanted {
            return largest * bin as f32 / BINS as f32;
        }
        below += count;
    }
    largest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fast_explicit_steps_last_as_long_as_they_should() {
        for time in [0.1, 0.53, 1.0, 7.3, 58.0] {
            let steps = fast_explicit_steps(time);
            let sum: f32 = steps.iter().sum();
            assert!((sum - time).abs() < 1e-3 * time, "{time}: {sum}");
            // Fewer than stable explicit steps would be.
            assert!(steps.len() as f32 <= (time / 0.25).ceil().max(1.0));
            assert!(steps.iter().all(|s| *s > 0.0));
        }
    }

    #[test]
    fn diffusion_stops_at_edges_and_goes_on_between_them() {
        // A step edge, and ripples too weak to be edges.
        let image = Plane::from_fn(120, 90, |x, y| {
            let step = if x < 60 { 0.2 } else { 0.8 };
            image::Luma([step + 0.01 * ((x + y) as f32).sin()])
        });
        let levels = scale_space(&image);
        let at = |level: &Level, x| level.image.get_pixel(x, 45).0[0];
        let (first, last) = (&levels[0], &levels[3]);
        let across = |level| at(level, 63) - at(level, 56);
        assert!(across(last) > 0.97 * across(first), "{}", across(last));
        let ripple = |level| {
            let values: Vec<f32> = (20..40).map(|x| at(level, x)).collect();
            let largest = values.iter().copied().fold(f32::MIN, f32::max);
            largest - values.iter().copied().fold(f32::MAX, f32::min)
        };
        assert!(ripple(last) < 0.6 * ripple(first), "{}", ripple(last));
    }
}
