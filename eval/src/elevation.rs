//! Elevations against true ones, cell by cell (Hong 2021, 4.3, figure 10), and whether stated bounds
//! hold.

use serde::Serialize;

use crate::EvalError;

/// A cell whose true height is known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ComparedCell {
    /// The estimate, metres; NaN where there is none.
    pub estimate: f64,
    /// The truth, metres.
    pub truth: f64,
    /// The bounds that the estimate states for itself, metres.
    pub bounds: Option<[f64; 2]>,
}

/// How far elevations are off, metres. All figures but `known` are over the cells that have an estimate.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ElevationScore {
    /// Cells compared.
    pub cells: usize,
    /// Share of the cells of known truth within the extent of the estimate that have an estimate.
    pub known: f64,
    /// Mean of estimate less truth: the signed vertical difference.
    pub mean: f64,
    /// Root of the mean square.
    pub rmse: f64,
    /// Half of the differences are smaller.
    pub p50: f64,
    /// 68 % are smaller.
    pub p68: f64,
    /// 95 % are smaller.
    pub p95: f64,
    /// The largest.
    pub max: f64,
    /// Share below 0.5 m, the figure of Hong 2021.
    pub within_half_metre: f64,
    /// Share of the differences in steps of 2 cm, the last open.
    pub histogram: Vec<f64>,
    /// Where the estimate has bounds.
    pub bounds: Option<BoundsScore>,
}

/// Whether bounds hold.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BoundsScore {
    /// Share of the true heights between their bounds; 0.9973 of three deviations of normal errors.
    pub coverage: f64,
    /// Mean distance from the lower to the upper bound, metres.
    pub width: f64,
    /// Half of the bounds are narrower, metres.
    pub width_p50: f64,
}

/// Bins of [`ElevationScore::histogram`]: 0 to 1 m.
const BINS: usize = 50;

/// Scores the cells of an estimate.
///
/// # Errors
/// When no cell has both an estimate and a truth.
pub fn score(cells: impl IntoIterator<Item = ComparedCell>) -> Result<ElevationScore, EvalError> {
    let with_truth: Vec<ComparedCell> = cells.into_iter().filter(|c| c.truth.is_finite()).collect();
    let compared: Vec<&ComparedCell> = with_truth
        .iter()
        .filter(|c| c.estimate.is_finite())
        .collect();
    if compared.is_empty() {
        return Err(EvalError::NoOverlap {
            truth: with_truth.len(),
        });
    }
    let n = compared.len() as f64;
    let signed = || compared.iter().map(|c| c.estimate - c.truth);
    let mut sizes: Vec<f64> = signed().map(f64::abs).collect();
    sizes.sort_unstable_by(f64::total_cmp);
    let mut histogram = vec![0.0; BINS + 1];
    for size in &sizes {
        histogram[((size / 0.02) as usize).min(BINS)] += 1.0 / n;
    }
    Ok(ElevationScore {
        cells: compared.len(),
        known: n / with_truth.len() as f64,
        mean: signed().sum::<f64>() / n,
        rmse: (signed().map(|d| d * d).sum::<f64>() / n).sqrt(),
        p50: quantile(&sizes, 0.5),
        p68: quantile(&sizes, 0.68),
        p95: quantile(&sizes, 0.95),
        max: quantile(&sizes, 1.0),
        within_half_metre: sizes.partition_point(|s| *s < 0.5) as f64 / n,
        histogram,
        bounds: bounds(&compared),
    })
}

fn bounds(cells: &[&ComparedCell]) -> Option<BoundsScore> {
    let bounded: Vec<(f64, [f64; 2])> = cells
        .iter()
        .filter_map(|c| Some((c.truth, c.bounds?)))
        .filter(|(_, [low, high])| low.is_finite() && high.is_finite())
        .collect();
    if bounded.is_empty() {
        return None;
    }
    let n = bounded.len() as f64;
    let held = bounded
        .iter()
        .filter(|(truth, [low, high])| (low..=high).contains(&truth));
    let mut widths: Vec<f64> = bounded.iter().map(|(_, [low, high])| high - low).collect();
    widths.sort_unstable_by(f64::total_cmp);
    Some(BoundsScore {
        coverage: held.count() as f64 / n,
        width: widths.iter().sum::<f64>() / n,
        width_p50: quantile(&widths, 0.5),
    })
}

/// Of values in ascending order, at least one.
pub(crate) fn quantile(sorted: &[f64], share: f64) -> f64 {
    sorted[((sorted.len() - 1) as f64 * share).round() as usize]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(estimate: f64, truth: f64) -> ComparedCell {
        ComparedCell {
            estimate,
            truth,
            bounds: Some([estimate - 0.1, estimate + 0.1]),
        }
    }

    #[test]
    fn figures_worked_by_hand() {
        let cells = [
            cell(1.03, 1.0),
            cell(2.0, 2.05),
            cell(0.0, 0.6),
            cell(f64::NAN, 3.0),
            cell(1.0, f64::NAN),
        ];
        let s = score(cells).unwrap();
        assert_eq!((s.cells, s.known), (3, 0.75));
        assert!((s.mean - (0.03 - 0.05 - 0.6) / 3.0).abs() < 1e-12);
        let rmse = ((0.0009 + 0.0025 + 0.36) / 3.0f64).sqrt();
        assert!((s.rmse - rmse).abs() < 1e-12);
        assert!((s.p50 - 0.05).abs() < 1e-12 && (s.max - 0.6).abs() < 1e-12);
        assert!((s.within_half_metre - 2.0 / 3.0).abs() < 1e-12);
        assert!((s.histogram[1] - 1.0 / 3.0).abs() < 1e-12 && s.histogram.len() == 51);
        assert!((s.histogram.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        let bounds = s.bounds.unwrap();
        assert!((bounds.coverage - 2.0 / 3.0).abs() < 1e-12 && (bounds.width - 0.2).abs() < 1e-12);
    }

    #[test]
    fn nothing_to_compare_is_said() {
        let error = score([cell(f64::NAN, 1.0), cell(1.0, f64::NAN)]).unwrap_err();
        assert_eq!(error, EvalError::NoOverlap { truth: 1 });
        let unbounded = ComparedCell {
            bounds: None,
            ..cell(1.0, 1.0)
        };
        assert_eq!(score([unbounded]).unwrap().bounds, None);
    }
}
