//! Whether the rows of a pair correspond. A stereo network trained on pairs whose rows do not
//! learns nothing, and says nothing about it: measure first.

use rayon::prelude::*;

use crate::resample::cubic_weights;
use crate::{DataError, Plane, Rgb, StereoFrame, StereoSource, luma};
use barchan_geometry::{RectifiedRig, Trajectory};

/// By how much the rows of the right images are off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RowOffset {
    /// Median over the matches, pixels; positive: the right image's content lies lower. NaN when
    /// nothing matched.
    pub offset: f64,
    /// Robust standard deviation of the matches (1.4826 times the median absolute deviation),
    /// pixels. NaN when nothing matched.
    pub spread: f64,
    /// How many patches were found in both images.
    pub matches: usize,
}

/// Largest row offset looked for, pixels.
const REACH: i32 = 8;
/// Half the side of a patch, pixels.
const RADIUS: i32 = 7;
/// Patches tried over all frames.
const PATCHES: usize = 720;

/// Measures the row offset over up to 12 frames spread over the sequence.
///
/// Textured patches of the left image are searched in the right one over disparities of up to a
/// quarter of the width and row offsets of up to 8 px, by zero-mean normalised correlation; a
/// match must be good and clearly better than the second best.
///
/// # Errors
/// When a frame cannot be read.
pub fn measure_row_offset(source: &dyn StereoSource) -> Result<RowOffset, DataError> {
    let count = source.len().min(12);
    let mut offsets = Vec::new();
    for k in 0..count {
        let frame = source.frame(k * source.len() / count)?;
        let (left, right) = (luma(&frame.left), luma(&frame.right));
        let patches = textured_patches(&left, PATCHES / count);
        offsets.par_extend(
            patches
                .par_iter()
                .filter_map(|at| row_offset_of(&left, &right, *at)),
        );
    }
    let offset = median(&mut offsets);
    let mut deviations: Vec<f64> = offsets.iter().map(|v| (v - offset).abs()).collect();
    Ok(RowOffset {
        offset,
        spread: 1.4826 * median(&mut deviations),
        matches: offsets.len(),
    })
}

/// Whether the rows are off by more than half a pixel, and the matches agree well enough to be sure.
pub fn needs_correction(rows: &RowOffset) -> bool {
    rows.offset.abs() > 0.5 && rows.matches >= 30 && rows.spread < 1.5
}

/// The middle of the values; NaN of none.
fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    match values.len() {
        0 => f64::NAN,
        n => (values[(n - 1) / 2] + values[n / 2]) / 2.0,
    }
}

/// The best patch of each field of a grid of about `count`: where the smaller eigenvalue of the
/// structure tensor is largest (Shi and Tomasi 1994), so that neither direction is flat.
fn textured_patches(image: &Plane, count: usize) -> Vec<(i32, i32)> {
    /// Least accepted gradient along the flatter direction, root mean square a pixel.
    const LEAST: f32 = 1.5 / 255.0;
    let (w, h) = (image.width() as i32, image.height() as i32);
    let margin = RADIUS + REACH + 1;
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
        smaller / ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as f32
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

/// Row offset of the patch at `(x, y)` of the left image, to a fraction of a pixel; `None` when it
/// is not found for sure.
fn row_offset_of(left: &Plane, right: &Plane, (x, y): (i32, i32)) -> Option<f64> {
    /// Least correlation of a match, and by how much a second one must fall short of it.
    const GOOD: f32 = 0.85;
    const LEAD: f32 = 0.04;
    let w = left.width() as i32;
    let row = |x: i32, y: i32| {
        let start = (y * w + x - RADIUS) as usize;
        start..start + (2 * RADIUS + 1) as usize
    };
    let n = ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as f32;
    let mut patch: Vec<f32> = (-RADIUS..=RADIUS)
        .flat_map(|k| left.as_raw()[row(x, y + k)].iter().copied())
        .collect();
    let mean = patch.iter().sum::<f32>() / n;
    patch.iter_mut().for_each(|v| *v -= mean);
    let norm = patch.iter().map(|v| v * v).sum::<f32>().sqrt();

    // Correlation for each disparity (columns) and row offset (rows); both inside the image.
    let most = (w / 4).min(512).min(x - RADIUS);
    let height = 2 * REACH + 1;
    let correlation = |d: i32, dy: i32| {
        let (mut sum, mut squares, mut product) = (0.0f32, 0.0f32, 0.0f32);
        for (k, own) in (-RADIUS..=RADIUS).zip(patch.chunks_exact((2 * RADIUS + 1) as usize)) {
            for (a, b) in own.iter().zip(&right.as_raw()[row(x - d, y + dy + k)]) {
                sum += b;
                squares += b * b;
                product += a * b;
            }
        }
        product / (norm * (squares - sum * sum / n).max(1e-9).sqrt())
    };
    let scores: Vec<f32> = (0..=most)
        .flat_map(|d| (-REACH..=REACH).map(move |dy| (d, dy)))
        .map(|(d, dy)| correlation(d, dy))
        .collect();
    let score = |d: i32, dy: i32| scores[(d * height + dy + REACH) as usize];
    let best = (0..scores.len()).max_by(|a, b| scores[*a].total_cmp(&scores[*b]))? as i32;
    let (d, dy) = (best / height, best % height - REACH);
    // At the rim of the window the true peak may lie outside.
    if dy.abs() == REACH || d == 0 || d == most || score(d, dy) < GOOD {
        return None;
    }
    let elsewhere = |k: &usize| {
        let (other_d, other_dy) = (*k as i32 / height, *k as i32 % height - REACH);
        (other_d - d).abs() > 3 || (other_dy - dy).abs() > 3
    };
    let second = (0..scores.len())
        .filter(elsewhere)
        .map(|k| scores[k])
        .fold(-1.0, f32::max);
    if second > score(d, dy) - LEAD {
        return None;
    }
    // The top of the paraboloid through the peak and its neighbours; both directions together,
    // because slanted texture couples them.
    let s = |i: i32, j: i32| f64::from(score(d + i, dy + j));
    let (gx, gy) = ((s(1, 0) - s(-1, 0)) / 2.0, (s(0, 1) - s(0, -1)) / 2.0);
    let (xx, yy) = (
        s(1, 0) + s(-1, 0) - 2.0 * s(0, 0),
        s(0, 1) + s(0, -1) - 2.0 * s(0, 0),
    );
    let xy = (s(1, 1) + s(-1, -1) - s(1, -1) - s(-1, 1)) / 4.0;
    let determinant = xx * yy - xy * xy;
    let step = (xy * gx - xx * gy) / determinant;
    (determinant > 0.0 && step.abs() <= 1.0).then_some(f64::from(dy) + step)
}

/// A source whose right images are moved up by a row offset, so that rows correspond.
pub struct RowCorrected {
    source: Box<dyn StereoSource>,
    offset: f64,
}

impl RowCorrected {
    /// `offset` as [`measure_row_offset`] gives it. Rows that the right image does not have repeat
    /// its last one.
    pub fn new(source: Box<dyn StereoSource>, offset: f64) -> Self {
        Self { source, offset }
    }

    /// By how much the right images are moved up, pixels.
    pub fn offset(&self) -> f64 {
        self.offset
    }
}

impl StereoSource for RowCorrected {
    fn rig(&self) -> &RectifiedRig {
        self.source.rig()
    }

    fn len(&self) -> usize {
        self.source.len()
    }

    fn name(&self, index: usize) -> String {
        self.source.name(index)
    }

    fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
        let frame = self.source.frame(index)?;
        Ok(StereoFrame {
            right: move_up(&frame.right, self.offset),
            ..frame
        })
    }

    fn true_disparity(&self, index: usize) -> Result<Option<Plane>, DataError> {
        self.source.true_disparity(index)
    }

    fn true_trajectory(&self) -> Option<&Trajectory> {
        self.source.true_trajectory()
    }
}

/// The image with row `y` taken from `y + offset`, by cubic interpolation.
fn move_up(image: &Rgb, offset: f64) -> Rgb {
    let (width, height) = image.dimensions();
    let (stride, last) = (3 * width as usize, f64::from(height) - 1.0);
    let source = image.as_raw();
    let mut out = vec![0.0; source.len()];
    out.par_chunks_exact_mut(stride.max(1))
        .enumerate()
        .for_each(|(y, row)| {
            let at = (y as f64 + offset).clamp(0.0, last);
            let weights = cubic_weights(at.fract() as f32);
            let rows: [&[f32]; 4] = std::array::from_fn(|k| {
                let y = (at as usize + k).saturating_sub(1).min(last as usize);
                &source[y * stride..][..stride]
            });
            for (i, out) in row.iter_mut().enumerate() {
                // Cubic weights overshoot at edges.
                *out = (0..4)
                    .map(|k| weights[k] * rows[k][i])
                    .sum::<f32>()
                    .clamp(0.0, 1.0);
            }
        });
    // The same size as before.
    Rgb::from_raw(width, height, out).unwrap_or_default()
}
