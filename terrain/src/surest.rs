//! Voxels of points that a surer look at the same place explains.

use crate::Voxel;

/// So many times surer is surer.
const SURER: f64 = 2.0;
/// So many deviations are what a point may be off.
const OFF: f64 = 3.0;

/// Of voxels in a frame whose z is up, which are superseded: a voxel in the same upright cell, of edges of `cell` metres,
/// is twice as sure and no farther away than three deviations of what it supersedes.
///
/// The far is seen at small angles and with errors that grow as the square of its distance: clouds of it hang before and
/// behind the ground, in voxels of their own that no mean draws in. Where a nearer look knows the ground they say nothing.
/// What only the far looks saw stays, and so do cells: one of a cell's surest voxels always stays.
pub(crate) fn superseded(voxels: &[Voxel], cell: f64) -> Vec<bool> {
    let place = |v: &Voxel| [v.mean.x, v.mean.y].map(|x| (x / cell).floor() as i64);
    let mut order: Vec<usize> = (0..voxels.len()).collect();
    order.sort_by_cached_key(|&i| place(&voxels[i]));
    let mut gone = vec![false; voxels.len()];
    for column in order.chunk_by(|&a, &b| place(&voxels[a]) == place(&voxels[b])) {
        for &i in column {
            let (z, sigma) = (voxels[i].mean.z, voxels[i].sigma());
            gone[i] = column.iter().any(|&j| {
                SURER * voxels[j].sigma() <= sigma && (voxels[j].mean.z - z).abs() <= OFF * sigma
            });
        }
    }
    gone
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Vector3};

    use super::*;

    fn voxel(x: f64, z: f64, sigma: f64) -> Voxel {
        Voxel {
            count: 4,
            weight: 4.0 / (sigma * sigma),
            mean: Point3::new(x, 0.1, z),
            linear_rgb: Vector3::zeros(),
        }
    }

    #[test]
    fn the_surer_supersedes_what_may_be_the_same_and_nothing_else() {
        let voxels = [
            voxel(0.1, 0.0, 0.02),
            // May be the ground, is as sure as the ground, cannot be the ground, lies elsewhere.
            voxel(0.15, 0.25, 0.1),
            voxel(0.15, 0.05, 0.03),
            voxel(0.15, 0.45, 0.1),
            voxel(0.25, 0.05, 0.1),
        ];
        assert!((voxels[1].sigma() - 0.1).abs() < 1e-12);
        assert_eq!(superseded(&voxels, 0.2), [false, true, false, false, false]);
        // A chain: what is superseded itself supersedes still, and the surest stays.
        let chain = [
            voxel(0.1, 0.0, 0.01),
            voxel(0.1, 0.02, 0.02),
            voxel(0.1, 0.05, 0.04),
        ];
        assert_eq!(superseded(&chain, 0.2), [false, true, true]);
        assert!(superseded(&[], 0.2).is_empty());
    }
}
