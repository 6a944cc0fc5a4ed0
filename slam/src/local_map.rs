//! The part of the map that a frame is placed in.

use std::collections::BTreeMap;

use barchan_geometry::Se3;

use crate::map::{Map, MapPoint, PointId};

/// Points around a key frame, as they were when it settled. A copy: the map may change meanwhile.
#[derive(Clone, Debug)]
#[allow(non_snake_case)]
pub(crate) struct LocalMap {
    /// The key frame.
    pub keyframe: usize,
    /// The part of the map that it belongs to.
    pub submap: usize,
    /// Its pose.
    pub T_keyframe_world: Se3,
    /// What it and those around it see.
    pub points: BTreeMap<PointId, MapPoint>,
    /// What it and the nearest see.
    pub nearest: Vec<PointId>,
}

impl LocalMap {
    /// The points of the `window` key frames around one, see [`Map::around`].
    pub fn around(map: &Map, keyframe: usize, window: usize) -> Self {
        const NEAREST: usize = 3;
        let around = map.around(keyframe, window);
        let point = |id: PointId| Some((id, map.points.get(&id)?.clone()));
        let ids = map.points_of(&around).into_iter();
        let newest = &map.keyframes[keyframe];
        Self {
            keyframe,
            submap: newest.submap,
            T_keyframe_world: newest.T_cam_world,
            points: ids.filter_map(point).collect(),
            nearest: map.points_of(&around[..around.len().min(NEAREST)]),
        }
    }
}
