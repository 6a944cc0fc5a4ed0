//! How well the poses of key frames are known.

use std::collections::BTreeSet;

use barchan_geometry::{RectifiedRig, StereoPoint};
use nalgebra::{Matrix3, Matrix6};

use crate::SlamConfig;
use crate::loops::GUESS_SIGMA;
use crate::map::Map;
use crate::pose::reprojection_jacobian;
use crate::pose_graph::{PoseEdge, PoseGraph};

/// Covariance of the pose of each key frame against the first of its part of the map: position and
/// rotation vector, both along the axes of the world. Each key frame hangs on the one before it that
/// shares most points, as well as these points can tell (or other sensors, over a gap), and on what loops measured; a motion is
/// counted once, for sightings of one point err alike. `None` when the graph does not hold together.
pub(crate) fn pose_covariances(
    map: &Map,
    loops: &[PoseEdge],
    rig: &RectifiedRig,
    config: &SlamConfig,
) -> Option<Vec<Matrix6<f64>>> {
    let mut parts = BTreeSet::new();
    let mut edges = loops.to_vec();
    let mut fixed = Vec::new();
    for (k, keyframe) in map.keyframes.iter().enumerate() {
        let first = parts.insert(keyframe.submap);
        fixed.push(first);
        if first {
            continue;
        }
        let nearest = map.shared_with(k).into_iter().find(|(other, _)| *other < k);
        let a = nearest.map_or(k - 1, |(other, _)| other);
        let (sigma_translation, sigma_rotation) = motion_sigma(map, a, k, rig, config)
            .or(keyframe.carried)
            .unwrap_or(GUESS_SIGMA);
        edges.push(PoseEdge {
            a,
            b: k,
            T_a_b: map.keyframes[a].T_cam_world * keyframe.T_cam_world.inverse(),
            sigma_translation,
            sigma_rotation,
            robust: false,
        });
    }
    let graph = PoseGraph {
        T_world_cam: (map.keyframes.iter())
            .map(|k| k.T_cam_world.inverse())
            .collect(),
        fixed,
        edges,
    };
    graph.covariances()
}

/// Deviations, in metres and radians, of the motion between two key frames that the points both see
/// tell: each point is where the first sees it, to what its sighting and disparity are good for, and
/// so is its image in the second. `None` when the points do not fix the motion.
fn motion_sigma(
    map: &Map,
    a: usize,
    b: usize,
    rig: &RectifiedRig,
    config: &SlamConfig,
) -> Option<(f64, f64)> {
    let (first, second) = (&map.keyframes[a], &map.keyframes[b]);
    let motion = second.T_cam_world * first.T_cam_world.inverse();
    let turn = motion.rotation.to_rotation_matrix();
    let sigma_d = config.match_sigma;
    let mut information = Matrix6::zeros();
    for (feature, id) in first.points.iter().enumerate() {
        let sightings = id.map(|id| &map.points[&id].observations);
        let there = sightings.and_then(|s| s.iter().find(|(k, _)| *k == b));
        let (Some((_, there)), Some(d)) = (there, first.disparities[feature]) else {
            continue;
        };
        let [here, there] = [
            &first.features.keypoints[feature],
            &second.features.keypoints[*there],
        ];
        let (u, v) = (here.u, here.v);
        let Some(point) = rig.back_project(StereoPoint { u, v, d }) else {
            continue;
        };
        let seen = motion * point;
        if rig.project(&seen).is_none() {
            continue;
        }
        let spread = rig.point_covariance(&point, here.sigma, sigma_d);
        let project = rig.projection_jacobian(&seen) * turn.matrix();
        let own = [there.sigma, there.sigma, sigma_d].map(|s| s * s);
        let covariance =
            Matrix3::from_diagonal(&own.into()) + project * spread * project.transpose();
        let jacobian = reprojection_jacobian(rig, &seen);
        information += jacobian.transpose() * covariance.try_inverse()? * jacobian;
    }
    let covariance = information.cholesky()?.inverse();
    let sigma = |k: usize| (covariance.fixed_view::<3, 3>(k, k).trace() / 3.0).sqrt();
    Some((sigma(0), sigma(3)))
}
