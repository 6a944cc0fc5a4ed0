//! Patches of one image found in another, to a fraction of a pixel.

use std::ops::RangeInclusive;

use nalgebra::{Matrix2, Vector2};
use rayon::prelude::*;

use crate::resample::cubic_weights;
use crate::{Plane, Rgb, luma};

/// A place of one image found in another.
#[derive(Clone, Copy, Debug)]
pub(super) struct Match {
    /// Column and row in the first image, pixels.
    pub from: Vector2<f64>,
    /// Column and row in the second.
    pub to: Vector2<f64>,
    /// Brightness of the second image's patch over that of the first.
    pub gain: f64,
}

/// Where a patch is looked for: columns and rows of the second image less those of the first.
pub(super) struct Window {
    pub columns: RangeInclusive<f64>,
    pub rows: RangeInclusive<f64>,
}

/// A grey image ready for matching: whole, and shrunk until searching it is cheap.
pub(super) struct View {
    full: Plane,
    coarse: Plane,
    /// Sums of `coarse` and of its squares over all pixels above and to the left of a pixel, with a
    /// row and a column of zeros before the first.
    sums: Vec<[f64; 2]>,
    factor: u32,
}

/// Images wider than this are searched in a smaller copy, pixels.
const SEARCHED: u32 = 640;
/// Half the side of a patch, pixels.
const RADIUS: i32 = 7;
const SIDE: i32 = 2 * RADIUS + 1;
/// Pixels of a patch.
const AREA: f32 = (SIDE * SIDE) as f32;

impl View {
    pub fn new(image: &Rgb) -> Self {
        let full = luma(image);
        let factor = full.width().div_ceil(SEARCHED).max(1);
        let coarse = shrink(&full, factor);
        Self {
            sums: sums(&coarse),
            coarse,
            full,
            factor,
        }
    }

    /// Sum and sum of squares of the coarse image over the patch around a pixel.
    fn moments(&self, x: i32, y: i32) -> [f64; 2] {
        let stride = self.coarse.width() as i32 + 1;
        let at = |i: i32, j: i32| self.sums[((y + j) * stride + x + i) as usize];
        let (low, high) = (-RADIUS, RADIUS + 1);
        std::array::from_fn(|k| {
            at(high, high)[k] - at(high, low)[k] - at(low, high)[k] + at(low, low)[k]
        })
    }
}

fn sums(image: &Plane) -> Vec<[f64; 2]> {
    let (w, h) = (image.width() as usize, image.height() as usize);
    let mut sums = vec![[0.0; 2]; (w + 1) * (h + 1)];
    for y in 0..h {
        let mut row = [0.0; 2];
        for x in 0..w {
            let value = f64::from(image.as_raw()[y * w + x]);
            row = [row[0] + value, row[1] + value * value];
            let above = sums[y * (w + 1) + x + 1];
            sums[(y + 1) * (w + 1) + x + 1] = [above[0] + row[0], above[1] + row[1]];
        }
    }
    sums
}

/// Means over squares of `factor` pixels; what does not fill a square at the far borders is left out.
fn shrink(image: &Plane, factor: u32) -> Plane {
    if factor == 1 {
        return image.clone();
    }
    let side = 0..factor;
    Plane::from_fn(image.width() / factor, image.height() / factor, |x, y| {
        let pixels = side
            .clone()
            .flat_map(|j| side.clone().map(move |i| (i, j)))
            .map(|(i, j)| image.get_pixel(factor * x + i, factor * y + j).0[0]);
        image::Luma([pixels.sum::<f32>() / (factor * factor) as f32])
    })
}

/// Finds up to about `count` textured patches of `first` in `second`.
///
/// A match must correlate well, clearly better than any other place of its window, and not lie on
/// the window's rim, where the true place may be outside. `window` is asked with the place in the
/// first image, and answers in pixels of the whole images; `None` passes the place over.
pub(super) fn find_matches(
    first: &View,
    second: &View,
    count: usize,
    window: impl Fn(Vector2<f64>) -> Option<Window> + Sync,
) -> Vec<Match> {
    let factor = f64::from(first.factor);
    // The middle of a square of pixels of the whole image is the centre of a coarse one.
    let to_full = |at: Vector2<f64>| (at * factor).add_scalar((factor - 1.0) / 2.0);
    textured_patches(&first.coarse, count)
        .into_par_iter()
        .filter_map(|(x, y)| {
            let at = Vector2::new(f64::from(x), f64::from(y));
            let window = window(to_full(at))?;
            let coarse = |range: &RangeInclusive<f64>| {
                (range.start() / factor).floor() as i32..=(range.end() / factor).ceil() as i32
            };
            let patch = Patch::new(&first.coarse, (x, y))?;
            let (dx, dy) = patch.search(second, coarse(&window.columns), coarse(&window.rows))?;
            let start = at + Vector2::new(f64::from(dx), f64::from(dy));
            let (mut to, mut gain) = patch.refine(&second.coarse, start)?;
            let mut from = at;
            if first.factor > 1 {
                // The same place once more, at the full resolution.
                from = to_full(at).map(f64::round);
                let start = to_full(to) + (from - to_full(at));
                let fine = Patch::new(&first.full, (from.x as i32, from.y as i32))?;
                (to, gain) = fine.refine(&second.full, start)?;
            }
            Some(Match { from, to, gain })
        })
        .collect()
}

/// The best patch of each field of a grid of about `count`: where the smaller eigenvalue of the
/// structure tensor is largest (Shi and Tomasi 1994), so that neither direction is flat.
fn textured_patches(image: &Plane, count: usize) -> Vec<(i32, i32)> {
    /// Least accepted gradient along the flatter direction, root mean square a pixel.
    const LEAST: f32 = 1.5 / 255.0;
    let (w, h) = (image.width() as i32, image.height() as i32);
    let margin = RADIUS + 2;
    if w <= 2 * margin || h <= 2 * margin {
        return Vec::new();
    }
    let at = |x: i32, y: i32| image.as_raw()[(y * w + x) as usize];
    let texture = |cx: i32, cy: i32| {
        let (mut xx, mut yy, mut xy) = (0.0f32, 0.0f32, 0.0f32);
        for y in cy - RADIUS..=cy + RADIUS {
            for x in cx - RADIUS..=cx + RADIUS {
                let (gx, gy) = (
                    (at(x + 1, y) - at(x - 1, y)) / 2.0,
                    (at(x, y + 1) - at(x, y - 1)) / 2.0,
                );
                xx += gx * gx;
                yy += gy * gy;
                xy += gx * gy;
            }
        }
        let smaller = (xx + yy) / 2.0 - ((xx - yy).powi(2) / 4.0 + xy * xy).sqrt();
        smaller / AREA
    };
    let field = ((w * h) as f32 / count.max(1) as f32).sqrt().max(4.0) as usize;
    let corners: Vec<(i32, i32)> = (margin..h - margin)
        .step_by(field)
        .flat_map(|y| (margin..w - margin).step_by(field).map(move |x| (x, y)))
        .collect();
    let best = |&(x0, y0): &(i32, i32)| {
        let ys = (y0..(y0 + field as i32).min(h - margin)).step_by(3);
        let tried = ys.flat_map(|y| {
            (x0..(x0 + field as i32).min(w - margin))
                .step_by(3)
                .map(move |x| (x, y))
        });
        let (score, place) = tried
            .map(|(x, y)| (texture(x, y), (x, y)))
            .max_by(|a, b| a.0.total_cmp(&b.0))?;
        (score > LEAST * LEAST).then_some(place)
    };
    corners.par_iter().filter_map(best).collect()
}

/// The surroundings of a pixel, free of their mean.
struct Patch {
    /// Values less their mean, row by row.
    values: Vec<f32>,
    /// Derivatives along x and y in the same order, over `norm`.
    gradients: Vec<Vector2<f32>>,
    mean: f32,
    /// Root of the sum of squares of `values`.
    norm: f32,
    at: (i32, i32),
}

impl Patch {
    /// `None` too near the border, or where the image is flat.
    fn new(image: &Plane, at: (i32, i32)) -> Option<Self> {
        let (w, h) = (image.width() as i32, image.height() as i32);
        let (x, y) = at;
        let margin = RADIUS + 1;
        if x < margin || y < margin || x >= w - margin || y >= h - margin {
            return None;
        }
        let pixel = |i: i32, j: i32| image.as_raw()[((y + j) * w + x + i) as usize];
        let mut values: Vec<f32> = places().map(|(i, j)| pixel(i, j)).collect();
        let mean = values.iter().sum::<f32>() / AREA;
        values.iter_mut().for_each(|v| *v -= mean);
        let norm = values.iter().map(|v| v * v).sum::<f32>().sqrt();
        let gradients = places()
            .map(|(i, j)| {
                let along_x = pixel(i + 1, j) - pixel(i - 1, j);
                let along_y = pixel(i, j + 1) - pixel(i, j - 1);
                Vector2::new(along_x, along_y) / (2.0 * norm)
            })
            .collect();
        (norm > 1e-6).then_some(Self {
            values,
            gradients,
            mean,
            norm,
            at,
        })
    }

    /// The whole-pixel shift at which the patch correlates best with the coarse image (zero-mean
    /// normalised); `None` when it is not found for sure.
    fn search(
        &self,
        view: &View,
        columns: RangeInclusive<i32>,
        rows: RangeInclusive<i32>,
    ) -> Option<(i32, i32)> {
        /// Least correlation of a match, and by how much a second one must fall short of it.
        const GOOD: f32 = 0.85;
        const LEAD: f32 = 0.04;
        let image = view.coarse.as_raw();
        let (w, h) = (view.coarse.width() as i32, view.coarse.height() as i32);
        let (x, y) = self.at;
        // Inside the image.
        let (x0, x1) = (
            (*columns.start()).max(RADIUS - x),
            (*columns.end()).min(w - 1 - RADIUS - x),
        );
        let (y0, y1) = (
            (*rows.start()).max(RADIUS - y),
            (*rows.end()).min(h - 1 - RADIUS - y),
        );
        if x0 >= x1 || y0 >= y1 {
            return None;
        }
        // The patch has mean zero, so the other's mean drops out of the product.
        let correlation = |dx: i32, dy: i32| {
            let start = ((y + dy - RADIUS) * w + x + dx - RADIUS) as usize;
            let product: f32 = self
                .values
                .chunks_exact(SIDE as usize)
                .zip(image[start..].chunks(w as usize))
                .map(|(own, row)| own.iter().zip(row).map(|(a, b)| a * b).sum::<f32>())
                .sum();
            let [sum, squares] = view.moments(x + dx, y + dy);
            let variance = squares - sum * sum / f64::from(AREA);
            product / (self.norm * (variance.max(1e-9) as f32).sqrt())
        };
        let shifts: Vec<(i32, i32)> = (y0..=y1)
            .flat_map(|dy| (x0..=x1).map(move |dx| (dx, dy)))
            .collect();
        let scores: Vec<f32> = shifts.iter().map(|&(dx, dy)| correlation(dx, dy)).collect();
        let best = (0..scores.len()).max_by(|a, b| scores[*a].total_cmp(&scores[*b]))?;
        let (dx, dy) = shifts[best];
        // At the rim of the window the true peak may lie outside.
        let inside = dx > x0 && dx < x1 && dy > y0 && dy < y1;
        let second = shifts
            .iter()
            .zip(&scores)
            .filter(|((i, j), _)| (i - dx).abs() > 3 || (j - dy).abs() > 3)
            .map(|(_, score)| *score)
            .fold(-1.0, f32::max);
        (inside && scores[best] >= GOOD && second <= scores[best] - LEAD).then_some((dx, dy))
    }

    /// The place of the patch in `image` near `start`, to a fraction of a pixel, and the gain: least
    /// squares over its shift (Lucas and Kanade 1981, with the patch's own gradients), brightness
    /// and contrast free. A parabola through correlations is drawn towards whole pixels by up to 0.1.
    fn refine(&self, image: &Plane, start: Vector2<f64>) -> Option<(Vector2<f64>, f64)> {
        let normal: Matrix2<f32> = self.gradients.iter().map(|g| g * g.transpose()).sum();
        let inverse = normal.try_inverse()?;
        let mut shift = Vector2::<f32>::zeros();
        let mut brightness = self.mean;
        for _ in 0..8 {
            let at = start + shift.cast::<f64>();
            let mut seen: Vec<f32> = places()
                .map(|(i, j)| sample(image, at.x + f64::from(i), at.y + f64::from(j)))
                .collect();
            brightness = seen.iter().sum::<f32>() / AREA;
            seen.iter_mut().for_each(|v| *v -= brightness);
            let norm = seen.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-9);
            let terms = self.gradients.iter().zip(seen.iter().zip(&self.values));
            let step = inverse
                * terms
                    .map(|(g, (b, a))| g * (b / norm - a / self.norm))
                    .sum::<Vector2<f32>>();
            shift -= step;
            // More than the next pixel: not the peak that was found.
            if shift.amax() > 1.5 || shift.x.is_nan() {
                return None;
            }
            if step.amax() < 1e-3 {
                break;
            }
        }
        let gain = f64::from(brightness) / f64::from(self.mean.max(1e-3));
        Some((start + shift.cast::<f64>(), gain))
    }
}

/// Offsets of a patch's pixels, row by row.
fn places() -> impl Iterator<Item = (i32, i32)> {
    (-RADIUS..=RADIUS).flat_map(|j| (-RADIUS..=RADIUS).map(move |i| (i, j)))
}

/// The image between pixels, by cubic interpolation; beyond the border its last pixels.
fn sample(image: &Plane, x: f64, y: f64) -> f32 {
    let (w, h) = (image.width() as i32, image.height() as i32);
    let (x0, y0) = (x.floor(), y.floor());
    let (wx, wy) = (
        cubic_weights((x - x0) as f32),
        cubic_weights((y - y0) as f32),
    );
    let mut sum = 0.0;
    for (j, wy) in (-1..3).zip(wy) {
        let row = (y0 as i32 + j).clamp(0, h - 1) * w;
        for (i, wx) in (-1..3).zip(wx) {
            sum += wx * wy * image.as_raw()[(row + (x0 as i32 + i).clamp(0, w - 1)) as usize];
        }
    }
    sum
}
