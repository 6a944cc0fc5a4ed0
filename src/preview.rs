//! Pictures of disparity for people.

use barchan_datasets::{Plane, Rgb};
use image::RgbImage;

/// The left image beside its disparity in colour: far is blue, near is red, unknown is black.
/// `range` fixes the colours, so that the frames of a sequence compare.
pub fn disparity_beside_image(left: &Rgb, disparity: &Plane, range: (f32, f32)) -> RgbImage {
    let (width, height) = left.dimensions();
    let (low, high) = range;
    RgbImage::from_fn(2 * width, height, |x, y| {
        if x < width {
            return image::Rgb(
                left.get_pixel(x, y)
                    .0
                    .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8),
            );
        }
        let d = disparity.get_pixel(x - width, y).0[0];
        if !d.is_finite() {
            return image::Rgb([0; 3]);
        }
        let share = ((d - low) / (high - low).max(1e-6)).clamp(0.0, 1.0);
        let colour = colorous::TURBO.eval_continuous(f64::from(share));
        image::Rgb([colour.r, colour.g, colour.b])
    })
}

/// The 2nd and 98th percentile of the known disparities; 0 to 1 where none is known.
pub fn disparity_range(disparity: &Plane) -> (f32, f32) {
    let mut known: Vec<f32> = disparity
        .iter()
        .copied()
        .filter(|d| d.is_finite())
        .collect();
    known.sort_by(f32::total_cmp);
    match known.len() {
        0 => (0.0, 1.0),
        n => (known[n / 50], known[n - 1 - n / 50]),
    }
}
