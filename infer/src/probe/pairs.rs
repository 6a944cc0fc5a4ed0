//! Rendered pairs of known disparity, and how far an answer is from it.

use barchan_datasets::{DataError, Rgb, open};

/// A rendered pair and its true disparity.
pub(super) struct KnownPair {
    pub left: Rgb,
    pub right: Rgb,
    /// Pixels, row by row; NaN where it is not judged.
    pub truth: Vec<f32>,
}

/// Disparities up to this share of the width are judged: models search no farther than they were
/// trained for.
const JUDGED: f32 = 0.125;

/// Random scenes of many colours, materials and disparities, of those that semi-global matching masters:
/// what holds for all of them is no luck, and nothing but their images tells their disparity.
///
/// # Errors
/// When the size is out of the renderer's range.
pub(super) fn render([width, height]: [usize; 2]) -> Result<Vec<KnownPair>, DataError> {
    let mut pairs = Vec::new();
    // The first has the most of different disparities: what is tried on it alone must not mistake a
    // constant for an answer.
    for (seed, index) in [(24, 0), (4, 1), (39, 0), (4, 0)] {
        let source = open(&format!(
            "synth:scenes,seed={seed},frames=2,clutter=0,width={width},height={height}"
        ))?;
        let frame = source.frame(index)?;
        let (truth, back) = (
            source.true_disparity(index)?,
            source.true_disparity_right(index)?,
        );
        let (Some(truth), Some(back)) = (truth, back) else {
            continue;
        };
        // Seen by both cameras: the right image's own disparity leads back.
        let judged = truth.enumerate_pixels().map(|(x, y, d)| {
            let d = d.0[0];
            let to = (x as f32 - d).round();
            let seen = to >= 0.0
                && d <= JUDGED * width as f32
                && (back.get_pixel(to as u32, y).0[0] - d).abs() < 1.0;
            if seen { d } else { f32::NAN }
        });
        let truth = judged.collect();
        // Half of them are dark and faint: less contrast than the model should see then shows, and so does a
        // shift of its values.
        let most = if pairs.len() % 2 == 0 { 1.0 } else { 0.3 };
        let [left, right] = stretched([frame.left, frame.right], most);
        pairs.push(KnownPair { left, right, truth });
    }
    Ok(pairs)
}

/// Both images stretched alike until they fill 0 to `most`: values that are scaled wrongly then end where a model
/// knows of none.
fn stretched(mut pair: [Rgb; 2], most: f32) -> [Rgb; 2] {
    let mut values = pair[0].as_raw().clone();
    values.sort_unstable_by(f32::total_cmp);
    let at = |share: usize| values.get(values.len() * share / 100).copied();
    if let (Some(low), Some(high)) = (at(2), at(98))
        && high > low
    {
        for image in &mut pair {
            for v in image.iter_mut() {
                *v = ((*v - low) / (high - low)).clamp(0.0, 1.0) * most;
            }
        }
    }
    pair
}

impl KnownPair {
    /// Width and height.
    pub fn size(&self) -> [usize; 2] {
        [self.left.width() as usize, self.left.height() as usize]
    }

    /// The upper left part.
    pub fn crop(&self, [width, height]: [usize; 2]) -> Self {
        let cut = |image: &Rgb| {
            image::imageops::crop_imm(image, 0, 0, width as u32, height as u32).to_image()
        };
        let rows = self.truth.chunks_exact(self.size()[0]).take(height);
        Self {
            truth: rows.flat_map(|row| &row[..width]).copied().collect(),
            left: cut(&self.left),
            right: cut(&self.right),
        }
    }

    /// With the right image moved to the left by some pixels, so that every disparity grows by them.
    pub fn moved(&self, by: usize) -> Self {
        let (width, height) = self.right.dimensions();
        let right = Rgb::from_fn(width, height, |x, y| {
            *self.right.get_pixel((x + by as u32).min(width - 1), y)
        });
        let column = (0..self.truth.len()).map(|i| i % width as usize);
        let truth = self.truth.iter().zip(column).map(|(d, x)| {
            let moved = d + by as f32;
            if moved <= x as f32 { moved } else { f32::NAN }
        });
        Self {
            truth: truth.collect(),
            left: self.left.clone(),
            right,
        }
    }

    /// Truth and answer where the truth is judged.
    pub fn compare<'a>(&'a self, answer: &'a [f32]) -> impl Iterator<Item = (f32, f32)> + 'a {
        let both = self.truth.iter().copied().zip(answer.iter().copied());
        both.filter(|(truth, _)| truth.is_finite())
    }
}

/// Mean absolute error in pixels, no pixel counting more than a fortieth of the width, so that a few
/// wild ones do not decide; an unknown answer counts that much.
pub(super) fn error(compared: impl Iterator<Item = (f32, f32)>, width: usize) -> f64 {
    let most = width as f64 / 40.0;
    let (mut sum, mut count) = (0.0, 0usize);
    for (truth, answer) in compared {
        let error = f64::from((answer - truth).abs());
        sum += if error.is_nan() {
            most
        } else {
            error.min(most)
        };
        count += 1;
    }
    if count == 0 { most } else { sum / count as f64 }
}

/// The error of the best answer that sees no image: the median truth of each row over all pairs.
pub(super) fn blind_error(pairs: &[KnownPair]) -> f64 {
    let [width, height] = pairs.first().map_or([1, 0], KnownPair::size);
    let mut compared = Vec::new();
    for y in 0..height {
        let mut row: Vec<f32> = (pairs.iter())
            .flat_map(|pair| &pair.truth[y * width..(y + 1) * width])
            .copied()
            .filter(|d| d.is_finite())
            .collect();
        let median = median(&mut row);
        compared.extend(row.into_iter().map(|d| (d, median)));
    }
    error(compared.into_iter(), width)
}

/// The middle value; NaN of none.
pub(super) fn median(values: &mut [f32]) -> f32 {
    values.sort_unstable_by(f32::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f32::NAN)
}

/// The factor from answer to truth: the inverse of the `b` that makes the sum of `|answer - b truth|`
/// least, the median of `answer / truth` weighted by the truth, which wild answers do not bend while they
/// are the minority. Nothing when it is not finite.
pub(super) fn fit(compared: impl Iterator<Item = (f32, f32)>) -> Option<f64> {
    let mut ratios: Vec<(f64, f64)> = compared
        .filter(|(truth, answer)| answer.is_finite() && *truth > 0.0)
        .map(|(truth, answer)| (f64::from(answer) / f64::from(truth), f64::from(truth)))
        .collect();
    ratios.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let half = ratios.iter().map(|(_, weight)| weight).sum::<f64>() / 2.0;
    let mut sum = 0.0;
    let middle = ratios.iter().find(|(_, weight)| {
        sum += weight;
        sum >= half
    });
    let factor = middle.map(|(ratio, _)| 1.0 / ratio);
    factor.filter(|a| a.is_finite() && *a != 0.0)
}

/// Pearson's correlation; 0 when either does not vary.
pub(super) fn correlation(compared: impl Iterator<Item = (f32, f32)>) -> f64 {
    let (mut n, mut s) = (0.0, [0.0f64; 5]);
    for (t, v) in compared.filter(|(_, v)| v.is_finite()) {
        let (t, v) = (f64::from(t), f64::from(v));
        n += 1.0;
        for (sum, term) in s.iter_mut().zip([t, v, t * t, v * v, t * v]) {
            *sum += term;
        }
    }
    let [t, v, tt, vv, tv] = s.map(|sum| sum / n);
    let r = (tv - t * v) / ((tt - t * t) * (vv - v * v)).sqrt();
    if r.is_finite() { r } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fit_withstands_a_third_of_wild_answers() {
        let compared = (0..3000u32).map(|i| {
            let truth = 2.0 + (i % 37) as f32;
            let wild = (i * 7919 % 101) as f32 - 20.0;
            (truth, if i % 3 == 0 { wild } else { -truth / 4.0 })
        });
        let factor = fit(compared.clone()).unwrap();
        assert!((factor + 4.0).abs() < 1e-3, "{factor}");
        assert!(fit((0..9).map(|t| (t as f32, 0.0))).is_none());
    }

    #[test]
    fn known_pairs_are_known() {
        let pairs = render([128, 96]).unwrap();
        assert_eq!(pairs.len(), 4);
        for pair in &pairs {
            let perfect = error(pair.compare(&pair.truth), 128);
            assert_eq!(perfect, 0.0);
            let judged = pair.compare(&pair.truth).count();
            assert!(judged > 128 * 96 / 4, "{judged}");
            assert!((correlation(pair.compare(&pair.truth)) - 1.0).abs() < 1e-6);
            // What the right image shows at x - d is what the left one shows at x, and a little aside is something else.
            let moved = pair.moved(3);
            for pair in [pair, &moved, &pair.crop([100, 50])] {
                let (width, height) = (pair.left.width(), pair.left.height());
                let [left, right] = [&pair.left, &pair.right].map(barchan_datasets::luma);
                let difference = |aside: f32| {
                    let disparity = pair.truth.iter().map(|d| d + aside).collect();
                    let disparity = barchan_datasets::Plane::from_raw(width, height, disparity);
                    let warped = crate::warp_right_to_left(&right, &disparity.unwrap());
                    let mut differences: Vec<f32> = (warped.iter().zip(left.iter()))
                        .map(|(a, b)| (a - b).abs())
                        .filter(|d| d.is_finite())
                        .collect();
                    median(&mut differences)
                };
                let (here, aside) = (difference(0.0), difference(8.0));
                assert!(here < 0.8 * aside, "{here} {aside}");
            }
        }
        let blind = blind_error(&pairs);
        assert!(blind > 0.5, "{blind}");
    }
}
