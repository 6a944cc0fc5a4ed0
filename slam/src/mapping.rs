//! What a key frame adds to the map, and how the map then settles (Pire 2017, mapping thread).

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Instant;

use barchan_datasets::{Rgb, StereoFrame};
use barchan_geometry::{RectifiedRig, Se3, StereoPoint};
use barchan_infer::{DisparityEngine, DisparityMap, Rejection};
use nalgebra::{Point3, Vector2};
use serde::Serialize;

use crate::bundle_adjustment::BundleAdjustment;
use crate::frame::Seen;
use crate::loops::{LoopCloser, LoopEvent, Way};
use crate::map::{Keyframe, Map, PointId};
use crate::matching::{DisparityGate, MatchCounts};
use crate::patch::Patch;
use crate::pose::Observation;
use crate::tracker::Placement;
use crate::{SlamConfig, SlamError};

/// What a key frame came to, once it is in the map with all that its dense disparity says.
#[derive(Clone, Debug, Serialize)]
pub struct Mapped {
    /// Index of the frame in the sequence.
    pub frame: usize,
    /// Name of the frame.
    pub name: String,
    /// How its stereo matches were decided.
    pub matches: MatchCounts,
    /// Places that it looked like; a closed loop moved the map.
    pub loops: Vec<LoopEvent>,
    /// Milliseconds of dense disparity; 0 without an engine.
    pub ms_disparity: f64,
    /// Milliseconds of all that came after disparity.
    pub ms_map: f64,
    /// Its left image. Not serialised.
    #[serde(skip)]
    pub left: Rgb,
    /// Dense disparity after rejection, when there is an engine. Not serialised.
    #[serde(skip)]
    pub dense: Option<DisparityMap>,
}

/// A frame that is to become a key frame.
pub(crate) struct Candidate {
    pub frame: StereoFrame,
    pub seen: Seen,
    pub placement: Placement,
    /// The part of the map that it belongs to.
    pub submap: usize,
    /// How it came to a place that it was found at, after the camera was lost.
    pub way: Option<Way>,
}

/// What adding a key frame, or the disparity of one, came to.
#[allow(non_snake_case)]
pub(crate) struct Settled {
    /// The key frame that is through, if one is.
    pub mapped: Option<Mapped>,
    /// Where the world went under the newest key frame: see `Tracker::map_moved`.
    pub T_old_new: Se3,
}

/// A key frame that is in the map by its sparse matches, while its dense disparity is computed.
struct Pending {
    frame: StereoFrame,
    seen: Seen,
    way: Option<Way>,
    dense: JoinHandle<Disparity>,
    ms_map: f64,
}

/// Dense disparity less what the pair itself contradicts, and the milliseconds it took; nothing without an engine,
/// which comes along.
struct Disparity {
    engine: Option<Box<dyn DisparityEngine>>,
    dense: Result<Option<DisparityMap>, SlamError>,
    ms: f64,
}

/// Makes the map: key frames in, one by one.
///
/// A key frame comes in by its sparse matches at once, so that what follows is tracked against it. Its dense disparity
/// takes longer: what it says of these matches is heard before the next key frame comes in, and then loops are looked
/// for.
pub(crate) struct Mapper {
    rig: RectifiedRig,
    config: SlamConfig,
    /// `None` while it works, and when there is none.
    engine: Option<Box<dyn DisparityEngine>>,
    pending: Option<Pending>,
    pub map: Map,
    pub loops: Option<LoopCloser>,
}

impl Mapper {
    pub fn new(
        rig: RectifiedRig,
        config: SlamConfig,
        engine: Option<Box<dyn DisparityEngine>>,
        loops: Option<LoopCloser>,
    ) -> Self {
        Self {
            rig,
            config,
            engine,
            pending: None,
            map: Map::default(),
            loops,
        }
    }

    /// Adds a key frame to the map: sightings of known points, new points from the other stereo features, local
    /// bundle adjustment over the key frames around it, culling. Before that, what is left of the one before:
    /// [`Mapper::complete`].
    #[allow(non_snake_case)]
    fn add(&mut self, candidate: Candidate) -> Result<Settled, SlamError> {
        let Candidate {
            frame,
            seen,
            mut placement,
            submap,
            way,
        } = candidate;
        let T_cam_world = placement.T_cam_world;
        let Settled { mapped, T_old_new } = self.complete()?;
        placement.T_cam_world *= T_old_new;
        let dense = self.begin_disparity(&frame);

        let started = Instant::now();
        let (map, rig, config) = (&mut self.map, &self.rig, &self.config);
        let keyframe = add_keyframe(map, &frame, &seen, &placement, submap);
        add_new_points(map, keyframe, &frame.left, &seen, rig, config);
        let local = map.around(keyframe, config.window);
        adjust(map, &local, rig, config);
        cull(map, keyframe);
        let mut T_old_new = T_cam_world.inv_mul(&map.keyframes[keyframe].T_cam_world);
        T_old_new.rotation.renormalize();
        self.pending = Some(Pending {
            frame,
            seen,
            way,
            dense,
            ms_map: ms_since(started),
        });
        Ok(Settled { mapped, T_old_new })
    }

    /// Waits for the dense disparity of the newest key frame: stereo matches gated by it (Hong 2021, 3.2.3), loops
    /// proved by it.
    #[allow(non_snake_case)]
    fn complete(&mut self) -> Result<Settled, SlamError> {
        let Some(pending) = self.pending.take() else {
            return Ok(Settled {
                mapped: None,
                T_old_new: Se3::identity(),
            });
        };
        let Pending {
            frame,
            mut seen,
            way,
            dense,
            ms_map,
        } = pending;
        let Disparity { engine, dense, ms } = joined(dense);
        self.engine = engine;
        let dense = dense?;

        let started = Instant::now();
        let (map, rig, config) = (&mut self.map, &self.rig, &self.config);
        let keyframe = map.keyframes.len() - 1;
        if let Some(dense) = dense.as_ref().filter(|_| config.gate) {
            let gate = DisparityGate {
                disparity: &dense.disparity,
                sigma: Some(&dense.sigma),
                threshold: config.gate_px,
            };
            seen.match_stereo(rig, Some(&gate), config);
            forget_changed_matches(map, keyframe, &seen);
            add_new_points(map, keyframe, &frame.left, &seen, rig, config);
        }
        let before = map.keyframes[keyframe].T_cam_world;
        let dense_disparity = dense.as_ref().map(|d| &d.disparity);
        let loops = (self.loops.as_mut()).map(|closer| closer.close(map, dense_disparity, way));
        let mut T_old_new = before.inv_mul(&map.keyframes[keyframe].T_cam_world);
        T_old_new.rotation.renormalize();
        let mapped = Mapped {
            frame: frame.index,
            name: frame.name,
            matches: seen.matches,
            loops: loops.unwrap_or_default(),
            ms_disparity: ms,
            ms_map: ms_map + ms_since(started),
            left: frame.left,
            dense,
        };
        Ok(Settled {
            mapped: Some(mapped),
            T_old_new,
        })
    }

    /// Dense disparity in a thread of its own, where there is an engine.
    fn begin_disparity(&mut self, frame: &StereoFrame) -> JoinHandle<Disparity> {
        let mut engine = self.engine.take();
        let rejection = Rejection {
            max_dissimilarity: self.config.max_dissimilarity,
        };
        let frame = engine.as_ref().map(|_| frame.clone());
        std::thread::spawn(move || {
            let started = Instant::now();
            let dense = engine.as_mut().zip(frame).map(|(engine, frame)| {
                let dense = engine.disparity(&frame.left, &frame.right);
                let mut dense = dense.map_err(|source| SlamError::Disparity {
                    frame: frame.name.clone(),
                    source,
                })?;
                rejection.apply(&frame.left, &frame.right, &mut dense);
                Ok(dense)
            });
            let ms = dense.as_ref().map_or(0.0, |_| ms_since(started));
            let dense = dense.transpose();
            Disparity { engine, dense, ms }
        })
    }
}

fn ms_since(started: Instant) -> f64 {
    started.elapsed().as_secs_f64() * 1e3
}

/// What a thread ends with. What panics there has to be heard of here.
fn joined<T>(thread: JoinHandle<T>) -> T {
    (thread.join()).unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

/// The map, and the thread that at times works on it while frames are tracked (Pire 2017).
pub(crate) struct Mapping {
    mapper: Arc<Mutex<Mapper>>,
    work: Option<JoinHandle<Result<Settled, SlamError>>>,
}

impl Mapping {
    pub fn new(mapper: Mapper) -> Self {
        Self {
            mapper: Arc::new(Mutex::new(mapper)),
            work: None,
        }
    }

    /// Whether a key frame is being added.
    pub fn is_busy(&self) -> bool {
        self.work.is_some()
    }

    /// The map, when the key frame in hand is in it.
    pub fn mapper(&self) -> MutexGuard<'_, Mapper> {
        self.mapper.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Begins to add a key frame. [`Mapping::settle`] gives what became of it, and is to be called before
    /// the next.
    pub fn begin(&mut self, candidate: Candidate) {
        let mapper = Arc::clone(&self.mapper);
        self.work = Some(std::thread::spawn(move || {
            let mut mapper = mapper.lock().unwrap_or_else(PoisonError::into_inner);
            mapper.add(candidate)
        }));
    }

    /// Waits until the key frame in hand, if there is one, is in the map. The one before it then is through.
    pub fn settle(&mut self) -> Result<Option<Settled>, SlamError> {
        self.work.take().map(joined).transpose()
    }

    /// Waits for the dense disparity of the newest key frame, if one is awaited. Nothing may be in hand.
    pub fn complete(&mut self) -> Result<Settled, SlamError> {
        self.mapper().complete()
    }
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
    // Points that dense disparity refused meanwhile, or that a loop made one with others, are not observed.
    for sighting in &placement.sightings {
        map.observe(keyframe, sighting.feature, sighting.point);
    }
    keyframe
}

/// The newest key frame takes over stereo matches that were decided anew. Points that it made of others are no more;
/// of points that were known before, it keeps what the left image sees.
fn forget_changed_matches(map: &mut Map, keyframe: usize, seen: &Seen) {
    for (feature, disparity) in seen.disparities.iter().enumerate() {
        let frame = &mut map.keyframes[keyframe];
        if frame.disparities[feature] == *disparity {
            continue;
        }
        frame.disparities[feature] = *disparity;
        let point = frame.points[feature];
        if let Some(id) = point.filter(|id| map.points[id].observations.len() == 1) {
            map.remove(id);
        }
    }
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
        let Some(d) = seen.disparities[feature].filter(|d| config.is_mapped(rig, *d)) else {
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

/// Bundle adjustment over the whole map; the first key frame of each part stays.
pub(crate) fn adjust_all(map: &mut Map, rig: &RectifiedRig, config: &SlamConfig) {
    let first = |(k, keyframe): (usize, &Keyframe)| {
        let before = &map.keyframes[..k];
        before.iter().all(|other| other.submap != keyframe.submap)
    };
    let keyframes = map.keyframes.iter().enumerate();
    let free = keyframes
        .filter(|k| !first(*k))
        .map(|(k, _)| k)
        .collect::<Vec<_>>();
    adjust(map, &free, rig, config);
}

/// Bundle adjustment over key frames and what they see. Others that see the same points hold them in
/// place; where there are none, the oldest does.
fn adjust(map: &mut Map, free: &[usize], rig: &RectifiedRig, config: &SlamConfig) {
    let ids: Vec<PointId> = map
        .points_of(free)
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
    let free: BTreeSet<usize> = free.iter().copied().collect();
    let border = keyframes.iter().any(|k| !free.contains(k));
    let positions: Vec<Point3<f64>> = ids.iter().map(|id| map.points[id].position).collect();
    let mut problem = BundleAdjustment {
        T_cam_world: keyframes
            .iter()
            .map(|k| map.keyframes[*k].T_cam_world)
            .collect(),
        fixed: keyframes
            .iter()
            .map(|k| match border {
                true => !free.contains(k),
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
