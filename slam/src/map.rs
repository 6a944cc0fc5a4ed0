//! Key frames, the points they see, and who sees what.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use barchan_geometry::Se3;
use nalgebra::Point3;

use crate::features::{Descriptor, Features};
use crate::patch::Patch;

/// Names a point of the map for good.
pub type PointId = usize;

/// A frame that the map keeps.
#[derive(Clone, Debug)]
#[allow(non_snake_case)]
pub struct Keyframe {
    /// Index of the frame in its sequence.
    pub frame: usize,
    /// Name of the frame.
    pub name: String,
    /// Seconds.
    pub time: f64,
    /// The part of the map it belongs to: how parts lie to each other is a guess, until a loop joins
    /// them.
    pub submap: usize,
    /// Maps world points to the left camera.
    pub T_cam_world: Se3,
    /// Deviations (metres, radians) of the way from the key frame before, where images did not show it
    /// and other sensors did.
    pub carried: Option<(f64, f64)>,
    /// Features of the left image.
    pub features: Features,
    /// Disparity of each feature, where it was matched in the right image, pixels.
    pub disparities: Vec<Option<f64>>,
    /// Disparity of each feature that loops are proved with: dense where that is wanted and known, else
    /// that of its match, pixels.
    pub proof_disparities: Vec<Option<f64>>,
    /// The map point that each feature sees.
    pub points: Vec<Option<PointId>>,
}

/// A point of the world that key frames see.
#[derive(Clone, Debug)]
pub struct MapPoint {
    /// Where, world frame, metres.
    pub position: Point3<f64>,
    /// What it looked like when last seen by a key frame.
    pub descriptor: Descriptor,
    /// Scale at which it was last seen, see [`Keypoint::scale`](crate::Keypoint::scale).
    pub scale: f64,
    /// Its picture when it was first seen, where it is far enough from the border.
    pub patch: Option<Patch>,
    /// Its colour, sRGB.
    pub colour: [u8; 3],
    /// Key frame and feature of each sighting.
    pub observations: Vec<(usize, usize)>,
}

/// Everything known so far.
#[derive(Clone, Debug, Default)]
pub struct Map {
    /// Key frames in the order of time.
    pub keyframes: Vec<Keyframe>,
    /// Points by name; ordered, so that every walk over them is the same.
    pub points: BTreeMap<PointId, MapPoint>,
    pub(crate) next: PointId,
}

impl Map {
    /// Adds a point seen by feature `feature` of key frame `keyframe`.
    pub fn add_point(
        &mut self,
        keyframe: usize,
        feature: usize,
        position: Point3<f64>,
        colour: [u8; 3],
        patch: Option<Patch>,
    ) -> PointId {
        let id = self.next;
        self.next += 1;
        let frame = &mut self.keyframes[keyframe];
        frame.points[feature] = Some(id);
        let point = MapPoint {
            position,
            descriptor: frame.features.descriptors[feature],
            scale: frame.features.keypoints[feature].scale,
            colour,
            patch,
            observations: vec![(keyframe, feature)],
        };
        self.points.insert(id, point);
        id
    }

    /// Notes that a feature of a key frame sees a point; the point takes the newer look.
    pub fn observe(&mut self, keyframe: usize, feature: usize, id: PointId) {
        let frame = &mut self.keyframes[keyframe];
        if let Some(point) = self.points.get_mut(&id) {
            frame.points[feature] = Some(id);
            point.observations.push((keyframe, feature));
            point.descriptor = frame.features.descriptors[feature];
            point.scale = frame.features.keypoints[feature].scale;
        }
    }

    /// Forgets one sighting, and the point with its last one.
    pub fn forget(&mut self, id: PointId, keyframe: usize) {
        let Some(point) = self.points.get_mut(&id) else {
            return;
        };
        point.observations.retain(|(k, feature)| {
            if *k == keyframe {
                self.keyframes[*k].points[*feature] = None;
            }
            *k != keyframe
        });
        if point.observations.is_empty() {
            self.points.remove(&id);
        }
    }

    /// Forgets a point.
    pub fn remove(&mut self, id: PointId) {
        if let Some(point) = self.points.remove(&id) {
            for (keyframe, feature) in point.observations {
                self.keyframes[keyframe].points[feature] = None;
            }
        }
    }

    /// Points seen by any of these key frames, in order.
    pub fn points_of(&self, keyframes: &[usize]) -> Vec<PointId> {
        let mut ids: Vec<PointId> = keyframes
            .iter()
            .flat_map(|k| self.keyframes[*k].points.iter().flatten().copied())
            .collect();
        ids.sort_unstable();
        ids.dedup();
        ids
    }

    /// The map around a key frame (Pire 2017): itself, then those that see most of its points, then
    /// those that see most points of these; at most `most` in all. Time plays no part, so that a
    /// place seen again is the same place.
    pub fn around(&self, keyframe: usize, most: usize) -> Vec<usize> {
        let mut local = vec![keyframe];
        let mut next = 0;
        while next < local.len() && local.len() < most {
            let mut shared = self.shared_with(local[next]);
            shared.retain(|(k, _)| !local.contains(k));
            let room = most - local.len();
            local.extend(shared.iter().take(room).map(|(k, _)| *k));
            next += 1;
        }
        local
    }

    /// Key frames that see points of another, and how many: those that share most first, and of
    /// equals the latest.
    pub fn shared_with(&self, keyframe: usize) -> Vec<(usize, usize)> {
        let mut shared = BTreeMap::<usize, usize>::new();
        let points = self.keyframes[keyframe].points.iter().flatten();
        for point in points.filter_map(|id| self.points.get(id)) {
            for (k, _) in point.observations.iter().filter(|(k, _)| *k != keyframe) {
                *shared.entry(*k).or_default() += 1;
            }
        }
        let mut shared: Vec<(usize, usize)> = shared.into_iter().collect();
        shared.sort_by_key(|(k, count)| Reverse((*count, *k)));
        shared
    }
}
