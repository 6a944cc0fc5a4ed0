//! Distances of clouds to true ones (Hong 2021, 4.3). How they are brought together before:
//! `barchan_geometry::registration`.

use barchan_geometry::nalgebra::Point3;
use barchan_geometry::registration::Reference;
use rayon::prelude::*;
use serde::Serialize;

use crate::EvalError;
use crate::elevation::quantile;

/// Distances of the points of a cloud to the nearest points of another, metres.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CloudScore {
    /// Points of the estimate.
    pub points: usize,
    /// Share of them that lies within the largest distance of the reference: the rest is left out.
    pub overlap: f64,
    /// Root of the mean square.
    pub rmse: f64,
    /// Mean.
    pub mean: f64,
    /// Half are nearer.
    pub p50: f64,
    /// 68 % are nearer.
    pub p68: f64,
    /// 95 % are nearer.
    pub p95: f64,
    /// Share within 0.5 m, the figure of Hong 2021.
    pub within_half_metre: f64,
    /// Shares in steps of 2 cm, the last open (Hong 2021, figure 10).
    pub histogram: Vec<f64>,
}

/// Distances of `estimate` to `reference`, of those points that lie within `max_distance` of it.
///
/// # Errors
/// When none does.
pub fn score(
    estimate: &[Point3<f64>],
    reference: &Reference,
    max_distance: f64,
) -> Result<CloudScore, EvalError> {
    let mut distances: Vec<f64> = estimate
        .par_iter()
        .map(|p| reference.distance(p))
        .filter(|d| *d <= max_distance)
        .collect();
    if distances.is_empty() {
        return Err(EvalError::NoOverlap {
            truth: reference.len(),
        });
    }
    distances.sort_unstable_by(f64::total_cmp);
    let n = distances.len() as f64;
    let mut histogram = vec![0.0; 51];
    for d in &distances {
        histogram[((d / 0.02) as usize).min(50)] += 1.0 / n;
    }
    Ok(CloudScore {
        points: estimate.len(),
        overlap: n / estimate.len() as f64,
        rmse: (distances.iter().map(|d| d * d).sum::<f64>() / n).sqrt(),
        mean: distances.iter().sum::<f64>() / n,
        p50: quantile(&distances, 0.5),
        p68: quantile(&distances, 0.68),
        p95: quantile(&distances, 0.95),
        within_half_metre: distances.partition_point(|d| *d < 0.5) as f64 / n,
        histogram,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_those_to_the_nearest_points() {
        let grid: Vec<_> = (0..100)
            .map(|i| Point3::new(f64::from(i % 10), f64::from(i / 10), 0.0))
            .collect();
        let reference = Reference::new(&grid).unwrap();
        let above = |h: f64| Point3::new(3.0, 4.0, h);
        let estimate = [above(0.03), above(-0.05), above(0.6), above(50.0)];
        let s = score(&estimate, &reference, 1.0).unwrap();
        assert_eq!((s.points, s.overlap), (4, 0.75));
        assert!((s.mean - 0.68 / 3.0).abs() < 1e-12 && (s.p50 - 0.05).abs() < 1e-12);
        assert!((s.within_half_metre - 2.0 / 3.0).abs() < 1e-12);
        assert!((s.histogram[1] - 1.0 / 3.0).abs() < 1e-12);
        assert!(score(&[above(9.0)], &reference, 1.0).is_err());
    }
}
