//! A small disparity engine for tests: sums of absolute differences over windows, nothing more.

use barchan_datasets::{Plane, Rgb, luma};
use barchan_infer::{DisparityEngine, DisparityMap, InferError};

/// Whole-pixel disparities below `range`.
pub struct BlockMatcher {
    pub range: usize,
}

/// Half the side of a window.
const RADIUS: usize = 4;

impl DisparityEngine for BlockMatcher {
    fn name(&self) -> String {
        "block matcher".into()
    }

    fn disparity(&mut self, left: &Rgb, right: &Rgb) -> Result<DisparityMap, InferError> {
        let (left, right) = (luma(left), luma(right));
        let (width, height) = left.dimensions();
        let (w, h) = (width as usize, height as usize);
        let mut least = vec![f32::INFINITY; w * h];
        let mut disparity = vec![f32::NAN; w * h];
        for d in 0..self.range.min(w) {
            // Summed-area table of the differences at this disparity.
            let mut table = vec![0.0f64; (w + 1) * (h + 1)];
            for y in 0..h {
                let mut row = 0.0;
                for x in 0..w {
                    let other = right.as_raw()[y * w + x.saturating_sub(d)];
                    row += f64::from((left.as_raw()[y * w + x] - other).abs());
                    table[(y + 1) * (w + 1) + x + 1] = table[y * (w + 1) + x + 1] + row;
                }
            }
            for y in RADIUS..h.saturating_sub(RADIUS) {
                for x in RADIUS + d..w.saturating_sub(RADIUS) {
                    let at =
                        |dx: usize, dy: usize| table[(y + dy - RADIUS) * (w + 1) + x + dx - RADIUS];
                    let side = 2 * RADIUS + 1;
                    let sum = (at(side, side) + at(0, 0) - at(side, 0) - at(0, side)) as f32;
                    if sum < least[y * w + x] {
                        (least[y * w + x], disparity[y * w + x]) = (sum, d as f32);
                    }
                }
            }
        }
        let flat = |value: f32| Plane::from_pixel(width, height, image::Luma([value]));
        Ok(DisparityMap {
            // One value a pixel by construction.
            disparity: Plane::from_raw(width, height, disparity).unwrap(),
            // Whole pixels are off by 0.29 in the mean square, where they are right.
            sigma: flat(0.5),
            confidence: flat(1.0),
        })
    }
}
