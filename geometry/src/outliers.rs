use nalgebra::Point3;
use rayon::prelude::*;

use crate::KdTree;

/// Which points lie alone (Rusu 2008): their mean distance to the nearest `neighbours` others exceeds the mean
/// of all such distances by more than `deviations` standard deviations. Points that are not finite do, and all
/// of a cloud too small to have neighbours do not.
///
/// `pcdenoise` of Matlab, which de Jong 2020 uses, takes 4 neighbours and 1 deviation.
pub fn outliers(points: &[Point3<f64>], neighbours: usize, deviations: f64) -> Vec<bool> {
    let tree = KdTree::new(points);
    let distance = |p: &Point3<f64>| {
        // The nearest is the point itself.
        let near = tree.nearest(p, neighbours + 1);
        let others = near.len().saturating_sub(1).max(1) as f64;
        let sum: f64 = near.iter().map(|(square, _)| square.sqrt()).sum();
        match near.is_empty() {
            true => f64::NAN,
            false => sum / others,
        }
    };
    let distances: Vec<f64> = points.par_iter().map(distance).collect();
    let known = || distances.iter().filter(|d| d.is_finite());
    let n = known().count().max(1) as f64;
    let mean = known().sum::<f64>() / n;
    let variance = known().map(|d| (d - mean).powi(2)).sum::<f64>() / n;
    let most = mean + deviations * variance.sqrt();
    distances.iter().map(|d| d.is_nan() || *d > most).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_floats_above_the_ground_goes_and_the_ground_stays() {
        // A sheet of points 2 cm apart, and a few that float over it.
        let sheet =
            (0..2500).map(|i| Point3::new(f64::from(i % 50), f64::from(i / 50), 0.0) * 0.02);
        let floating = (0..10).map(|i| Point3::new(f64::from(i) * 0.1, 0.5, 0.3));
        let mut points: Vec<_> = sheet.chain(floating).collect();
        points.push(Point3::new(f64::NAN, 0.0, 0.0));
        let found = outliers(&points, 4, 1.0);
        assert!(found[2500..].iter().all(|o| *o));
        // Of the sheet all but perhaps the corners, whose neighbours are farther away.
        assert!(found[..2500].iter().filter(|o| **o).count() <= 4);
    }

    #[test]
    fn nothing_is_alone_among_few_or_equals() {
        assert!(outliers(&[], 4, 1.0).is_empty());
        assert_eq!(outliers(&[Point3::origin()], 4, 1.0), [false]);
        assert_eq!(outliers(&[Point3::origin(); 9], 4, 1.0), [false; 9]);
    }
}
