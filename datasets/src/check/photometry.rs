//! Light and sharpness of images.

use super::{Fault, Finding, median};
use crate::{Plane, Rgb, luma};

/// What the images of a pair say without being matched.
pub(super) struct Photometry {
    /// Share of over-exposed pixels in the lower halves of both images: a white sky costs nothing.
    saturated: f64,
    sharpness: [f64; 2],
}

impl Photometry {
    pub fn new(left: &Rgb, right: &Rgb) -> Self {
        let saturated = |image: &Rgb| {
            let values = image.as_raw();
            let lower = &values[values.len() / 6 * 3..];
            let white = lower
                .chunks_exact(3)
                .filter(|p| p.iter().all(|v| *v >= 254.0 / 255.0))
                .count();
            white as f64 / (lower.len() / 3).max(1) as f64
        };
        Self {
            saturated: (saturated(left) + saturated(right)) / 2.0,
            sharpness: [left, right].map(|image| sharpness(&luma(image))),
        }
    }
}

/// Root mean square step between neighbours over that between pixels four apart, along rows and
/// columns, whichever is less: 1 for noise, a quarter where the image is smooth over four pixels.
/// NaN of an image too small or flat.
fn sharpness(image: &Plane) -> f64 {
    let (w, h) = (image.width() as usize, image.height() as usize);
    if w < 16 || h < 16 {
        return f64::NAN;
    }
    let values = image.as_raw();
    let energy = |step: usize, stride: usize| {
        let mut sum = 0.0f64;
        for y in 0..h - 4 {
            for x in 0..w - 4 {
                let at = y * w + x;
                sum += f64::from(values[at + step * stride] - values[at]).powi(2);
            }
        }
        sum
    };
    let along = |stride: usize| (energy(1, stride) / energy(4, stride)).sqrt();
    along(1).min(along(w))
}

/// Says what is wrong with the light and the sharpness of the pairs that were looked at.
pub(super) fn judge(pairs: &[&Photometry], findings: &mut Vec<Finding>) {
    /// Share of white pixels that costs depth.
    const WHITE: f64 = 0.05;
    /// Sharpness below which nothing of a pixel's size is left to match.
    const BLURRED: f64 = 0.29;
    /// Sharpness of one side over that of the other.
    const UNEVEN: f64 = 0.65;
    let middle = |value: &dyn Fn(&Photometry) -> f64| {
        let values = pairs.iter().map(|p| value(p)).filter(|v| v.is_finite());
        median(&mut values.collect::<Vec<f64>>())
    };
    let white = middle(&|p| p.saturated);
    if white > WHITE {
        findings.push(Finding {
            fault: Fault::Saturation,
            value: white,
            text: format!(
                "{:.0} % of the lower half of the images is white: nothing can be matched there; expose less",
                100.0 * white
            ),
        });
    }
    let [left, right] = [0, 1].map(|side| middle(&|p| p.sharpness[side]));
    let mut blurred = |value: f64, text: String| {
        findings.push(Finding {
            fault: Fault::Blur,
            value,
            text,
        });
    };
    if left.max(right) < BLURRED {
        blurred(
            left.max(right),
            format!(
                "the images are blurred (sharpness {left:.2} left, {right:.2} right; {BLURRED} is the least): focus, expose for a shorter time, or use smaller images"
            ),
        );
    } else if left.min(right) < UNEVEN * left.max(right) {
        let side = if left < right { "left" } else { "right" };
        blurred(
            left.min(right),
            format!(
                "the {side} images are much less sharp (sharpness {left:.2} left, {right:.2} right): focus that camera, or clean it"
            ),
        );
    } else {
        let soft = pairs
            .iter()
            .filter(|p| p.sharpness[0] < UNEVEN * left)
            .count();
        if soft > 0 {
            blurred(
                soft as f64 / pairs.len() as f64,
                format!(
                    "{soft} of {} pairs that were looked at are blurred against the others: the rover moved or shook; expose for a shorter time",
                    pairs.len()
                ),
            );
        }
    }
}
