//! What a key frame adds to the map, and how the map then settles (Pire 2017, mapping thread).

use barchan_datasets::{Rgb, StereoFrame};
use barchan_geometry::{RectifiedRig, StereoPoint};
use nalgebra::{Point3, Vector2};

use crate::SlamConfig;
use crate::bundle_adjustment::BundleAdjustment;
use crate::frame::Seen;
use crate::map::{Keyframe, Map, PointId};
use crate::patch::Patch;
use crate::pose::Observation;
use crate::tracker::Placement;

/// Adds a key frame to a part of the map: sightings of known points, new points from the other stereo
/// features, local bundle adjustment over the key frames around it, culling.
pub(crate) fn insert_keyframe(
    map: &mut Map,
    frame: &StereoFrame,
    seen: Seen,
    placement: &Placement,
    submap: usize,
    rig: &RectifiedRig,
    config: &SlamConfig,
) {
    let keyframe = add_keyframe(map, frame, &seen, placement, submap);
    add_new_points(map, keyframe, &frame.left, &seen, rig, config);
    let local = map.around(keyframe, config.window);
    adjust_locally(map, &local, rig, config);
    cull(map, keyframe);
}

fn add_keyframe(
    map: &mut Map,
    frame: &StereoFrame,
    seen: &Seen,
    placement: &Placement,
    submap: usize,
) -> usize {
    let mut features = seen.features[0].clone();
    for sighting in &placement.sightings {
        features.keypoints[sighting.feature] = sighting.at;
    }
    let keyframe = map.keyframes.len();
    map.keyframes.push(Keyframe {
        frame: frame.index,
        name: frame.name.clone(),
        time: frame.time,
        submap,
        T_cam_world: placement.T_cam_world,
        carried: placement.carried,
        points: vec![None; features.keypoints.len()],
        features,
        disparities: seen.disparities.clone(),
        proof_disparities: seen.disparities.clone(),
    });
    for sighting in &placement.sightings {
        map.observe(keyframe, sighting.feature, sighting.point);
    }
    keyframe
}

/// Features with a disparity that see no known point make new ones.
fn add_new_points(
    map: &mut Map,
    keyframe: usize,
    left: &Rgb,
    seen: &Seen,
    rig: &RectifiedRig,
    config: &SlamConfig,
) {
    let frame = &map.keyframes[keyframe];
    let pose = frame.T_cam_world;
    for feature in 0..seen.disparities.len() {
        let frame = &map.keyframes[keyframe];
        let at = frame.features.keypoints[feature];
        let Some(d) = seen.disparities[feature].filter(|d| d + rig.doffs >= config.min_disparity)
        else {
            continue;
        };
        let known = frame.points[feature].is_some();
        let place = StereoPoint {
            u: at.u,
            v: at.v,
            d,
        };
        let colour = left.get_pixel_checked(at.u.round() as u32, at.v.round() as u32);
        if let (false, Some(p_cam), Some(colour)) = (known, rig.back_project(place), colour) {
            let colour = colour.0.map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8);
            let (centre, spacing) = (Vector2::new(at.u, at.v), at.scale);
            let patch = Patch::cut(&seen.grey[0], centre, spacing, p_cam.z);
            map.add_point(keyframe, feature, pose.inverse() * p_cam, colour, patch);
        }
    }
}

/// Bundle adjustment over key frames and what they see. Others that see the same points hold them in
/// place; where there are none, the oldest does.
fn adjust_locally(map: &mut Map, local: &[usize], rig: &RectifiedRig, config: &SlamConfig) {
    let ids: Vec<PointId> = map
        .points_of(local)
        .into_iter()
        .filter(|id| map.points[id].observations.len() > 1)
        .collect();
    let mut keyframes: Vec<usize> = ids
        .iter()
        .flat_map(|id| map.points[id].observations.iter().map(|(k, _)| *k))
        .collect();
    keyframes.sort_unstable();
    keyframes.dedup();
    let Some(oldest) = keyframes.first().copied() else {
        return;
    };
    let border = keyframes.iter().any(|k| !local.contains(k));
    let positions: Vec<Point3<f64>> = ids.iter().map(|id| map.points[id].position).collect();
    let mut problem = BundleAdjustment {
        T_cam_world: keyframes
            .iter()
            .map(|k| map.keyframes[*k].T_cam_world)
            .collect(),
        fixed: keyframes
            .iter()
            .map(|k| match border {
                true => !local.contains(k),
                false => *k == oldest,
            })
            .collect(),
        points: positions,
        observations: Vec::new(),
    };
    for (point, id) in ids.iter().enumerate() {
        for (k, feature) in &map.points[id].observations {
            // Every key frame of an observation is in the list it was collected from.
            let Ok(pose) = keyframes.binary_search(k) else {
                continue;
            };
            let frame = &map.keyframes[*k];
            let sighting = Observation::new(
                problem.points[point],
                &frame.features.keypoints[*feature],
                frame.disparities[*feature],
                config.disparity_sigma,
            );
            problem.observations.push((pose, point, sighting));
        }
    }
    problem.solve(rig, config.ba_iterations);

    for (k, pose) in keyframes.iter().zip(&problem.T_cam_world) {
        map.keyframes[*k].T_cam_world = *pose;
    }
    for (id, position) in ids.iter().zip(&problem.points) {
        if let Some(point) = map.points.get_mut(id) {
            point.position = *position;
        }
    }
    let residuals = problem.squared_residuals(rig);
    for ((pose, point, sighting), squared) in problem.observations.iter().zip(residuals) {
        if !sighting.accepts(squared) {
            map.forget(ids[*point], keyframes[*pose]);
        }
    }
}

/// Points that no second key frame has seen within three were noise.
fn cull(map: &mut Map, newest: usize) {
    let Some(due) = newest.checked_sub(3) else {
        return;
    };
    let seen_once = |id: &PointId| map.points.get(id).is_some_and(|p| p.observations.len() < 2);
    let noise: Vec<PointId> = map.keyframes[due]
        .points
        .iter()
        .flatten()
        .copied()
        .filter(seen_once)
        .collect();
    for id in noise {
        map.remove(id);
    }
}
