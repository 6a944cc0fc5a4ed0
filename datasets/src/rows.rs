//! Whether the rows of a pair correspond. A stereo network trained on pairs whose rows do not
//! learns nothing, and says nothing about it: measure first.

use nalgebra::{Matrix2, Vector2};
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
    refine(left, right, (x, y), &patch, norm, (d, dy))
}

/// The row offset of a match to a fraction of a pixel: least squares over the shift of the patch
/// (Lucas and Kanade 1981, with the gradients of the left image), brightness and contrast free.
/// A parabola through the correlations is drawn towards whole pixels by up to 0.1 px.
fn refine(
    left: &Plane,
    right: &Plane,
    (x, y): (i32, i32),
    patch: &[f32],
    norm: f32,
    (d, dy): (i32, i32),
) -> Option<f64> {
    let at = |x: i32, y: i32| left[(x as u32, y as u32)].0[0];
    let places: Vec<(i32, i32)> = (-RADIUS..=RADIUS)
        .flat_map(|j| (-RADIUS..=RADIUS).map(move |i| (i, j)))
        .collect();
    let gradients: Vec<Vector2<f32>> = places
        .iter()
        .map(|(i, j)| {
            let (x, y) = (x + i, y + j);
            Vector2::new(at(x + 1, y) - at(x - 1, y), at(x, y + 1) - at(x, y - 1)) / (2.0 * norm)
        })
        .collect();
    let normal: Matrix2<f32> = gradients.iter().map(|g| g * g.transpose()).sum();
    let inverse = normal.try_inverse()?;
    let mut shift = Vector2::zeros();
    for _ in 0..8 {
        let corner = Vector2::new((x - d) as f32, (y + dy) as f32) + shift;
        let mut seen: Vec<f32> = places
            .iter()
            .map(|(i, j)| sample(right, corner.x + *i as f32, corner.y + *j as f32))
            .collect();
        let mean = seen.iter().sum::<f32>() / seen.len() as f32;
        seen.iter_mut().for_each(|v| *v -= mean);
        let seen_norm = seen.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-9);
        let terms = gradients.iter().zip(seen.iter().zip(patch));
        let step = inverse
            * terms
                .map(|(g, (r, l))| g * (r / seen_norm - l / norm))
                .sum::<Vector2<f32>>();
        shift -= step;
        // More than the next pixel: not the peak that was found.
        if shift.amax() > 1.0 || shift.x.is_nan() {
            return None;
        }
        if step.amax() < 1e-3 {
            break;
        }
    }
    Some(f64::from(dy) + f64::from(shift.y))
}

/// The image between pixels, by cubic interpolation; beyond the border its last pixels.
fn sample(image: &Plane, x: f32, y: f32) -> f32 {
    let (w, h) = (image.width() as i32, image.height() as i32);
    let (x0, y0) = (x.floor(), y.floor());
    let (wx, wy) = (cubic_weights(x - x0), cubic_weights(y - y0));
    let mut sum = 0.0;
    for (j, wy) in (-1..3).zip(wy) {
        let row = (y0 as i32 + j).clamp(0, h - 1) * w;
        for (i, wx) in (-1..3).zip(wx) {
            sum += wx * wy * image.as_raw()[(row + (x0 as i32 + i).clamp(0, w - 1)) as usize];
        }
    }
    sum
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Synth, open};
    use std::path::{Path, PathBuf};

    fn traverse() -> Box<dyn StereoSource> {
        Box::new(Synth::parse("seed=3,frames=2,width=256,height=192").unwrap())
    }

    #[test]
    fn a_known_offset_is_measured_and_its_correction_leaves_none() {
        let none = measure_row_offset(&*traverse()).unwrap();
        assert!(
            none.offset.abs() < 0.03 && none.spread < 0.2 && none.matches > 100,
            "{none:?}"
        );
        assert!(!needs_correction(&none));
        for offset in [2.3, -4.6, 0.75] {
            let off = RowCorrected::new(traverse(), -offset);
            let measured = measure_row_offset(&off).unwrap();
            assert!(
                (measured.offset - offset).abs() < 0.06,
                "{offset}: {measured:?}"
            );
            assert!(needs_correction(&measured));
            let corrected = RowCorrected::new(Box::new(off), measured.offset);
            let left_over = measure_row_offset(&corrected).unwrap();
            assert!(
                left_over.offset.abs() < 0.06 && !needs_correction(&left_over),
                "{left_over:?}"
            );
        }
    }

    #[test]
    fn correction_forwards_everything_else() {
        let corrected = RowCorrected::new(traverse(), 1.5);
        let source = traverse();
        assert_eq!(
            (corrected.len(), corrected.rig()),
            (source.len(), source.rig())
        );
        assert_eq!(corrected.true_trajectory(), source.true_trajectory());
        let (a, b) = (corrected.frame(1).unwrap(), source.frame(1).unwrap());
        assert_eq!(
            (a.index, a.name, a.time, a.left),
            (b.index, b.name, b.time, b.left)
        );
        assert_ne!(a.right, b.right);
    }

    /// One grey pair.
    struct Blank(RectifiedRig);

    impl StereoSource for Blank {
        fn rig(&self) -> &RectifiedRig {
            &self.0
        }
        fn len(&self) -> usize {
            1
        }
        fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
            let image = Rgb::from_pixel(
                self.0.width as u32,
                self.0.height as u32,
                image::Rgb([0.5; 3]),
            );
            Ok(StereoFrame {
                index,
                name: String::new(),
                time: 0.0,
                left: image.clone(),
                right: image,
            })
        }
    }

    #[test]
    fn nothing_is_claimed_of_pairs_without_texture_or_too_small() {
        for (width, height) in [(200, 150), (20, 20), (1, 1)] {
            let rig = RectifiedRig {
                width,
                height,
                ..*traverse().rig()
            };
            let rows = measure_row_offset(&Blank(rig)).unwrap();
            assert!(rows.matches == 0 && rows.offset.is_nan() && !needs_correction(&rows));
        }
    }

    fn shared(folder: &str) -> Option<PathBuf> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../shared/data")
            .join(folder);
        if !path.exists() {
            println!("skipped: {} is absent", path.display());
        }
        path.exists().then_some(path)
    }

    #[test]
    fn real_pairs_have_the_offsets_that_are_known_of_them() {
        // devon1 was rectified by its publisher to half a pixel: correlation along rows peaks
        // where its right image is moved down by 0.5 px.
        for (folder, expected) in [
            ("arena-unlabelled", 3.1),
            ("arena-run1", 0.0),
            ("devon1", -0.5),
        ] {
            let Some(path) = shared(folder) else { continue };
            let source = open(path.to_str().unwrap()).unwrap();
            let rows = measure_row_offset(&*source).unwrap();
            assert!(
                (rows.offset - expected).abs() < 0.2 && rows.matches > 200,
                "{folder}: {rows:?}"
            );
        }
    }

    #[test]
    fn middlebury_rows_correspond() {
        let Some(cones) = shared("middlebury2003/cones") else {
            return;
        };
        let dir = tempfile::tempdir().unwrap();
        for (side, image) in [("left", "im2.png"), ("right", "im6.png")] {
            std::fs::create_dir(dir.path().join(side)).unwrap();
            std::fs::copy(cones.join(image), dir.path().join(side).join("cones.png")).unwrap();
        }
        let rig = RectifiedRig {
            width: 450,
            height: 375,
            ..*traverse().rig()
        };
        std::fs::write(
            dir.path().join("rig.toml"),
            barchan_geometry::Rig::from(rig).to_toml(),
        )
        .unwrap();
        let rows = measure_row_offset(&*open(dir.path().to_str().unwrap()).unwrap()).unwrap();
        assert!(rows.offset.abs() < 0.15 && rows.matches > 200, "{rows:?}");
    }
}
