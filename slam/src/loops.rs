//! A place seen before: find it, prove it by geometry, and take the drift out of the map (Galvez-Lopez
//! and Tardos 2012 for finding; Hong 2021, 3.2.3 for proving with dense disparity).

use std::collections::BTreeSet;
use std::sync::Arc;

use barchan_datasets::Plane;
use barchan_geometry::{RectifiedRig, Se3, StereoPoint};
use nalgebra::Point3;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::features::Descriptor;
use crate::map::{Keyframe, Map, PointId};
use crate::matching::{Grid, find_points, match_all};
use crate::places::{Island, Places};
use crate::pose::{Observation, optimise_pose, sample_pose};
use crate::pose_graph::{PoseEdge, PoseGraph};
use crate::vocabulary::Vocabulary;
use crate::{Keypoint, SlamConfig};

/// Deviation of the motion between two key frames that see the same points: metres at [`DEPTH`],
/// radians.
const NEIGHBOUR_SIGMA: (f64, f64) = (0.005, 0.0005);
/// Deviation of the motion that a loop measures, likewise.
const LOOP_SIGMA: (f64, f64) = (0.01, 0.002);
/// Metres. What is twice as far tells half as well where the camera is: among houses these deviations
/// are many times those of a rover that looks at the ground before it.
const DEPTH: f64 = 3.0;
/// Deviation of the guess that leads over a gap in tracking.
pub(crate) const GUESS_SIGMA: (f64, f64) = (10.0, 1.0);
/// Key frames that share so many points are tied in the pose graph.
const COVISIBLE: usize = 40;
/// Key frames before and after a found one, whose points are looked for too.
const NEIGHBOURS: usize = 3;

/// How loops are looked for and judged.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LoopConfig {
    /// Whether loops are looked for at all.
    pub enabled: bool,
    /// Whether a loop corrects the map; else it is reported only.
    pub correct: bool,
    /// Where the points come from that prove a loop.
    pub points: LoopPoints,
    /// Least likeness of a place, as a share of the likeness of two successive key frames.
    pub min_score: f64,
    /// Successive key frames that must find the same place.
    pub min_streak: usize,
    /// Newest key frames that are no place seen *before*.
    pub min_gap: usize,
    /// Fewest points that must agree with the motion between both views.
    pub min_inliers: usize,
    /// Least share of the matches around that motion that must agree with it.
    pub min_match_share: f64,
}

impl Default for LoopConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            correct: true,
            points: LoopPoints::Dense,
            min_score: 0.3,
            min_streak: 3,
            min_gap: 20,
            min_inliers: 20,
            min_match_share: 0.6,
        }
    }
}

/// Where the points come from that prove a loop (Hong 2021, 3.2.3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LoopPoints {
    /// Dense disparity at the features; stereo matches where it is silent or there is no engine.
    Dense,
    /// Features with a stereo match only.
    Sparse,
}

/// A place that was recognised, and what geometry said to it.
#[derive(Clone, Debug, Serialize)]
pub struct LoopEvent {
    /// Index of the frame that recognised the place.
    pub frame: usize,
    /// Index of the earlier frame of that place.
    pub earlier_frame: usize,
    /// Likeness as a share of the likeness of two successive key frames.
    pub score: f64,
    /// Matches by looks alone, and how many of them agree with one motion.
    pub matches: [usize; 2],
    /// Map points of the earlier place found in the frame, and how many agree with the motion.
    pub map_points: [usize; 2],
    /// Whether that is proof.
    pub proved: bool,
    /// How far closing the loop moved the frame, metres.
    pub moved: f64,
}

/// How a camera that was lost came to the place that it was found at.
#[derive(Clone, Copy, Debug)]
#[allow(non_snake_case)]
pub(crate) struct Way {
    /// The key frame of the place.
    pub place: usize,
    /// The motion from the newest key frame, as the camera moved before it was lost or other sensors say.
    pub T_keyframe_cam: Se3,
    /// Its deviations, metres and radians.
    pub sigma: (f64, f64),
}

/// Finds loops among the key frames of a map and closes them.
pub(crate) struct LoopCloser {
    rig: RectifiedRig,
    config: SlamConfig,
    places: Places,
    /// Motions that closed loops measured.
    edges: Vec<PoseEdge>,
}

/// Where the newest key frame is in the earlier part of the map.
#[allow(non_snake_case)]
struct Found {
    T_cam_world: Se3,
    /// Earlier map points and the features that see them.
    pairs: Vec<(PointId, usize)>,
}

impl LoopCloser {
    pub fn new(rig: RectifiedRig, config: SlamConfig, vocabulary: Arc<Vocabulary>) -> Self {
        Self {
            rig,
            config,
            places: Places::new(vocabulary),
            edges: Vec::new(),
        }
    }

    /// Takes note of all key frames of a map that was made before.
    pub fn learn(&mut self, map: &Map) {
        for keyframe in &map.keyframes {
            let least = self.config.loops.min_score;
            self.places
                .add(&keyframe.features.descriptors, least, |_| true);
        }
    }

    /// Takes note of the newest key frame of the map, of which `dense` is the disparity. Looks for
    /// places that look like it, that its predecessors found too, and that it does not see the same
    /// points as anyway; first of all the place where a lost camera was found, if it came some `way`. The
    /// first that geometry confirms is a loop: the pose graph is solved, key frames and points move, and
    /// points that were mapped twice become one.
    ///
    /// Gives each place that was tried.
    #[allow(non_snake_case)]
    pub fn close(
        &mut self,
        map: &mut Map,
        dense: Option<&Plane>,
        way: Option<Way>,
    ) -> Vec<LoopEvent> {
        let Some(newest) = map.keyframes.len().checked_sub(1) else {
            return Vec::new();
        };
        map.keyframes[newest].proof_disparities = self.known_disparities(map, dense);
        let connected = connected(map, newest);
        let loops = &self.config.loops;
        let skip = |k: usize| k + loops.min_gap > newest || connected.contains(&k);
        let descriptors = &map.keyframes[newest].features.descriptors;
        let mut islands = self.places.add(descriptors, loops.min_score, skip);
        islands.retain(|island| island.streak >= loops.min_streak);
        if let Some(way) = way {
            // Where nothing links both, the graph could not share out what lies between them.
            self.edges.push(PoseEdge {
                a: newest - 1,
                b: newest,
                T_a_b: way.T_keyframe_cam,
                sigma_translation: way.sigma.0,
                sigma_rotation: way.sigma.1,
                robust: true,
            });
            islands.insert(0, self.places.island(way.place));
        }

        let loops = &self.config.loops;
        let mut events = Vec::new();
        for island in &islands {
            let (mut event, found) = self.verify(map, newest, island);
            event.proved = found.is_some();
            if let Some(found) = found.filter(|_| loops.correct) {
                let before = map.keyframes[newest].T_cam_world.inverse();
                self.correct(map, newest, island.keyframe, &found);
                join(map, newest, island.keyframe);
                self.fuse(map, newest, island.keyframe, &found);
                let after = map.keyframes[newest].T_cam_world.inverse();
                event.moved = (after.translation.vector - before.translation.vector).norm();
                events.push(event);
                break;
            }
            events.push(event);
        }
        events
    }

    /// Motions that closed loops measured.
    pub fn edges(&self) -> &[PoseEdge] {
        &self.edges
    }

    /// Key frames that look most like these descriptors, the likeliest first: where a camera that is
    /// lost may be.
    pub fn likeliest(&self, descriptors: &[Descriptor]) -> Vec<usize> {
        self.places.likeliest(descriptors)
    }

    /// Disparity of each feature of the newest key frame: dense where that is wanted and known,
    /// else of its stereo match.
    fn known_disparities(&self, map: &Map, dense: Option<&Plane>) -> Vec<Option<f64>> {
        let Some(frame) = map.keyframes.last() else {
            return Vec::new();
        };
        let dense = dense.filter(|_| self.config.loops.points == LoopPoints::Dense);
        let at = |k: &Keypoint| {
            let (u, v) = (k.u.round() as u32, k.v.round() as u32);
            let d = f64::from(dense?.get_pixel_checked(u, v)?.0[0]);
            self.config.is_mapped(&self.rig, d).then_some(d)
        };
        let features = frame.features.keypoints.iter().zip(&frame.disparities);
        features.map(|(k, sparse)| at(k).or(*sparse)).collect()
    }

    /// Whether the newest key frame is at a place seen before. Its features are matched to those of
    /// the earlier key frame by looks; the earlier ones have a depth, and so give the motion by
    /// sampling and robust optimisation. Around that motion, the earlier part of the map is matched
    /// again: a true motion explains most of what is then found, as in tracking.
    #[allow(non_snake_case)]
    fn verify(&self, map: &Map, newest: usize, island: &Island) -> (LoopEvent, Option<Found>) {
        let (new, old) = (&map.keyframes[newest], &map.keyframes[island.keyframe]);
        let mut event = LoopEvent {
            frame: new.frame,
            earlier_frame: old.frame,
            score: island.score,
            matches: [0; 2],
            map_points: [0; 2],
            proved: false,
            moved: 0.0,
        };
        let least = self.config.loops.min_inliers;

        let (mut looks, mut places) = (Vec::<Descriptor>::new(), Vec::<Point3<f64>>::new());
        let features = old.features.keypoints.iter().zip(&old.features.descriptors);
        for ((k, look), d) in features.zip(&old.proof_disparities) {
            let at = d.map(|d| StereoPoint { u: k.u, v: k.v, d });
            if let Some(place) = at.and_then(|at| self.rig.back_project(at)) {
                looks.push(*look);
                places.push(place);
            }
        }
        let pairs = match_all(&looks, &new.features, &self.config);
        let observations: Vec<Observation> = pairs
            .iter()
            .map(|(i, feature)| self.observation(places[*i], map, newest, *feature))
            .collect();
        event.matches[0] = observations.len();
        let mut rng = ChaCha8Rng::seed_from_u64(self.config.seed);
        let Some(T_sampled) = sample_pose(&self.rig, &observations, least, &mut rng) else {
            return (event, None);
        };
        let rough = optimise_pose(&self.rig, &observations, &T_sampled);
        event.matches[1] = rough.count();
        if rough.count() < least {
            return (event, None);
        }

        let T_rough = rough.T_cam_world * old.T_cam_world;
        let earlier = points_around(map, island.keyframe);
        let pairs = self.look_for(map, &earlier, newest, &T_rough);
        let observations: Vec<Observation> = pairs
            .iter()
            .map(|(id, f)| self.observation(map.points[id].position, map, newest, *f))
            .collect();
        let pose = optimise_pose(&self.rig, &observations, &T_rough);
        event.map_points = [pairs.len(), pose.count()];
        let share = pose.count() as f64 / pairs.len().max(1) as f64;
        if pose.count() < least || share < self.config.loops.min_match_share {
            return (event, None);
        }
        let agreeing = pairs.into_iter().zip(&pose.inliers).filter(|(_, i)| **i);
        let found = Found {
            T_cam_world: pose.T_cam_world,
            pairs: agreeing.map(|(pair, _)| pair).collect(),
        };
        (event, Some(found))
    }

    /// A point seen by a feature of a key frame: to a pixel of the feature's scale, whatever its
    /// alignment, for the point is not better known than that from where it is looked at now.
    fn observation(
        &self,
        place: Point3<f64>,
        map: &Map,
        keyframe: usize,
        feature: usize,
    ) -> Observation {
        let k = map.keyframes[keyframe].features.keypoints[feature];
        let at = Keypoint {
            sigma: k.scale,
            ..k
        };
        let d = map.keyframes[keyframe].proof_disparities[feature];
        Observation::new(place, &at, d, self.config.disparity_sigma)
    }

    /// Features of a key frame that look like points and lie where a pose puts these.
    #[allow(non_snake_case)]
    fn look_for(
        &self,
        map: &Map,
        points: &[PointId],
        keyframe: usize,
        T_cam_world: &Se3,
    ) -> Vec<(PointId, usize)> {
        const RADIUS: f64 = 8.0;
        let features = &map.keyframes[keyframe].features;
        let grid = Grid::new(&features.keypoints, self.rig.width, self.rig.height);
        let features = (features, &grid);
        let known = points.iter().filter_map(|id| map.points.get_key_value(id));
        find_points(
            known,
            T_cam_world,
            features,
            RADIUS,
            &self.rig,
            &self.config,
        )
        .pairs
    }

    /// Solves the pose graph with the new loop in it, and moves key frames and points.
    #[allow(non_snake_case)]
    fn correct(&mut self, map: &mut Map, newest: usize, earlier: usize, found: &Found) {
        let scale = (self.median_depth(&map.keyframes[newest]) / DEPTH).max(1.0);
        self.edges.push(PoseEdge {
            a: earlier,
            b: newest,
            T_a_b: map.keyframes[earlier].T_cam_world * found.T_cam_world.inverse(),
            sigma_translation: scale * LOOP_SIGMA.0,
            sigma_rotation: LOOP_SIGMA.1,
            robust: true,
        });
        let old: Vec<Se3> = map.keyframes.iter().map(|k| k.T_cam_world).collect();
        let tie = |a: usize, b: usize, (translation, rotation): (f64, f64)| PoseEdge {
            a,
            b,
            T_a_b: old[a] * old[b].inverse(),
            sigma_translation: translation,
            sigma_rotation: rotation,
            robust: false,
        };
        let mut edges = Vec::new();
        for k in 1..=newest {
            let shared = map.shared_with(k).into_iter();
            let earlier = shared.filter(|(other, _)| *other < k).enumerate();
            // The first shares most.
            let ties: Vec<usize> = earlier
                .filter(|(place, (other, count))| {
                    *place == 0 || other + 1 == k || *count >= COVISIBLE
                })
                .map(|(_, (other, _))| other)
                .collect();
            let counted = (ties.len() as f64).sqrt();
            for other in ties {
                // Ties of one key frame tell of the same steps: together they count as one tie to the one before.
                let steps = match k - other {
                    steps if steps < self.config.loops.min_gap => steps as f64,
                    _ => 1.0,
                };
                let (translation, rotation) = NEIGHBOUR_SIGMA;
                let shares = steps * counted;
                edges.push(tie(
                    other,
                    k,
                    (shares * scale * translation, shares * rotation),
                ));
            }
            if edges.last().is_none_or(|e| e.b != k) {
                let sigma = map.keyframes[k].carried.unwrap_or(GUESS_SIGMA);
                edges.push(tie(k - 1, k, sigma));
            }
        }
        edges.extend(&self.edges);
        let mut graph = PoseGraph {
            T_world_cam: old.iter().map(Se3::inverse).collect(),
            fixed: (0..=newest).map(|k| k == 0).collect(),
            edges,
        };
        graph.solve(30);

        for point in map.points.values_mut() {
            if let Some((k, _)) = point.observations.first() {
                point.position = graph.T_world_cam[*k] * (old[*k] * point.position);
            }
        }
        for (keyframe, T_world_cam) in map.keyframes.iter_mut().zip(&graph.T_world_cam) {
            keyframe.T_cam_world = T_world_cam.inverse();
        }
    }

    /// How far what a key frame sees is in the median, metres; zero when nothing of it has a depth.
    fn median_depth(&self, keyframe: &Keyframe) -> f64 {
        let known = keyframe.proof_disparities.iter().flatten();
        let mut disparities: Vec<f64> = known.map(|d| d + self.rig.doffs).collect();
        disparities.sort_by(f64::total_cmp);
        let median = disparities.get(disparities.len() / 2).copied();
        let depth = |d: f64| self.rig.fx * self.rig.baseline / d.max(self.config.min_disparity);
        median.map_or(0.0, depth)
    }

    /// Makes points one that were mapped once at each visit: those that proved the loop, then what
    /// the key frames before the newest see of the earlier place.
    fn fuse(&self, map: &mut Map, newest: usize, earlier: usize, found: &Found) {
        for (point, feature) in &found.pairs {
            merge(map, *point, newest, *feature);
        }
        for keyframe in newest.saturating_sub(NEIGHBOURS)..newest {
            let points = points_around(map, earlier);
            let pose = map.keyframes[keyframe].T_cam_world;
            for (id, feature) in self.look_for(map, &points, keyframe, &pose) {
                // Merging may have taken it.
                let Some(place) = map.points.get(&id).map(|p| p.position) else {
                    continue;
                };
                let sighting = self.observation(place, map, keyframe, feature);
                let residual = sighting.residual(&self.rig, &(pose * place));
                if residual.is_some_and(|r| sighting.accepts(r.norm_squared())) {
                    merge(map, id, keyframe, feature);
                }
            }
        }
    }
}

/// Lets a feature see an earlier point; a point that it saw before becomes the earlier one.
fn merge(map: &mut Map, earlier: PointId, keyframe: usize, feature: usize) {
    let double = map.keyframes[keyframe].points[feature];
    if double == Some(earlier) {
        return;
    }
    let mut sightings = vec![(keyframe, feature)];
    if let Some(double) = double.and_then(|id| map.points.remove(&id)) {
        sightings = double.observations;
    }
    let Some(point) = map.points.get_mut(&earlier) else {
        return;
    };
    for (keyframe, feature) in sightings {
        let known = point.observations.iter().any(|(k, _)| *k == keyframe);
        map.keyframes[keyframe].points[feature] = (!known).then_some(earlier);
        if !known {
            point.observations.push((keyframe, feature));
        }
    }
}

/// Points seen by a key frame or its neighbours in time.
fn points_around(map: &Map, keyframe: usize) -> Vec<PointId> {
    let last = (keyframe + NEIGHBOURS).min(map.keyframes.len() - 1);
    let around = &map.keyframes[keyframe.saturating_sub(NEIGHBOURS)..=last];
    let ids: BTreeSet<PointId> = around
        .iter()
        .flat_map(|k| k.points.iter().flatten().copied())
        .collect();
    ids.into_iter().collect()
}

/// Makes the parts of the map that two key frames belong to one.
fn join(map: &mut Map, a: usize, b: usize) {
    let (a, b) = (map.keyframes[a].submap, map.keyframes[b].submap);
    for keyframe in &mut map.keyframes {
        if keyframe.submap == a.max(b) {
            keyframe.submap = a.min(b);
        }
    }
}

/// Key frames that see a point of a key frame, and those that see a point of these.
fn connected(map: &Map, keyframe: usize) -> BTreeSet<usize> {
    let mut reached = BTreeSet::from([keyframe]);
    for _ in 0..2 {
        let ids = reached.iter().flat_map(|k| &map.keyframes[*k].points);
        let ids: BTreeSet<PointId> = ids.flatten().copied().collect();
        let sightings = ids.iter().filter_map(|id| map.points.get(id));
        reached.extend(sightings.flat_map(|p| p.observations.iter().map(|(k, _)| *k)));
    }
    reached
}

#[cfg(test)]
mod tests {
    use barchan_geometry::se3;
    use nalgebra::Vector6;

    use super::*;
    use crate::features::Features;

    /// Key frames of three features each, none of which sees a point.
    fn map(keyframes: usize) -> Map {
        let at = Keypoint {
            u: 0.0,
            v: 0.0,
            scale: 1.0,
            sigma: 1.0,
        };
        let keyframe = |frame: usize| Keyframe {
            frame,
            name: String::new(),
            time: frame as f64,
            submap: 0,
            T_cam_world: Se3::identity(),
            carried: None,
            features: Features {
                keypoints: vec![at; 3],
                descriptors: vec![[0; _]; 3],
                bits: 256,
            },
            disparities: vec![None; 3],
            proof_disparities: vec![None; 3],
            points: vec![None; 3],
        };
        let mut map = Map::default();
        map.keyframes.extend((0..keyframes).map(keyframe));
        map
    }

    /// Key frames and points agree on who sees what.
    fn assert_consistent(map: &Map) {
        let mut sightings = 0;
        for (k, frame) in map.keyframes.iter().enumerate() {
            for (f, id) in frame.points.iter().enumerate() {
                if let Some(id) = id {
                    assert!(map.points[id].observations.contains(&(k, f)), "{k} {f}");
                    sightings += 1;
                }
            }
        }
        let noted: usize = map.points.values().map(|p| p.observations.len()).sum();
        assert_eq!(noted, sightings);
    }

    #[test]
    fn points_mapped_twice_become_one() {
        let mut map = map(4);
        let add = |map: &mut Map, k, f| map.add_point(k, f, Point3::origin(), [0; 3], None);
        let earlier = add(&mut map, 0, 0);
        map.observe(1, 0, earlier);
        let double = add(&mut map, 2, 0);
        map.observe(3, 2, double);
        // Key frame 1 sees the earlier one already: it cannot see it twice.
        map.observe(1, 1, double);

        merge(&mut map, earlier, 3, 2);
        assert_consistent(&map);
        assert!(!map.points.contains_key(&double));
        let seen_by: Vec<usize> = map.points[&earlier]
            .observations
            .iter()
            .map(|o| o.0)
            .collect();
        assert_eq!(seen_by, [0, 1, 2, 3]);
        // Again changes nothing; a feature that saw nothing sees it now.
        merge(&mut map, earlier, 3, 2);
        assert_eq!(map.points[&earlier].observations.len(), 4);
        let other = add(&mut map, 0, 1);
        merge(&mut map, other, 2, 1);
        assert_consistent(&map);
        assert_eq!(map.points[&other].observations, [(0, 1), (2, 1)]);
    }

    /// Key frames of a drive, each of which sees the same points as the five before it.
    fn drive(poses: &[Se3]) -> Map {
        const NEW: usize = 50;
        const SEEN: usize = 6;
        let mut map = map(poses.len());
        for (keyframe, pose) in map.keyframes.iter_mut().zip(poses) {
            keyframe.T_cam_world = *pose;
            keyframe.features.keypoints = vec![keyframe.features.keypoints[0]; NEW * SEEN];
            keyframe.features.descriptors = vec![keyframe.features.descriptors[0]; NEW * SEEN];
            keyframe.points = vec![None; NEW * SEEN];
        }
        for k in 0..poses.len() {
            for n in 0..NEW {
                let slot = |k: usize| k % SEEN * NEW + n;
                let id = map.add_point(k, slot(k), Point3::origin(), [0; 3], None);
                for later in k + 1..(k + SEEN).min(poses.len()) {
                    map.observe(later, slot(k), id);
                }
            }
        }
        map
    }

    #[test]
    fn a_loop_takes_out_a_drift_that_many_ties_agree_on() {
        const KEYFRAMES: usize = 300;
        let poses = |yaw: f64| -> Vec<Se3> {
            let step = se3::exp(&Vector6::new(0.0, 0.0, -0.2, 0.0, yaw, 0.0));
            std::iter::successors(Some(Se3::identity()), |pose| Some(step * pose))
                .take(KEYFRAMES)
                .collect()
        };
        // The heading drifts by 0.2 mrad a step, well within what a step may be off.
        let (truth, estimate) = (poses(0.0), poses(2e-4));
        let mut map = drive(&estimate);
        let rig = RectifiedRig {
            fx: 300.0,
            fy: 300.0,
            cx: 192.0,
            cy: 144.0,
            baseline: 0.12,
            doffs: 0.0,
            width: 384,
            height: 288,
        };
        let config = SlamConfig::default();
        let words = Vocabulary::shipped(config.detector);
        let mut closer = LoopCloser::new(rig, config, words);
        let newest = KEYFRAMES - 1;
        let found = Found {
            T_cam_world: truth[newest],
            pairs: Vec::new(),
        };
        let off = |map: &Map, k: usize| {
            (map.keyframes[k].T_cam_world * truth[k].inverse())
                .translation
                .vector
                .norm()
        };
        let before = off(&map, newest);
        closer.correct(&mut map, newest, 0, &found);
        let after = off(&map, newest);
        assert!(
            before > 1.5 && after < 0.05 * before,
            "{before} m, then {after} m"
        );
        let half = off(&map, newest / 2);
        assert!(half < 0.5 * before, "half of the way is {half} m off");
    }

    #[test]
    fn key_frames_are_connected_over_one_between() {
        let mut map = map(5);
        for k in 0..3 {
            let id = map.add_point(k, 0, Point3::origin(), [0; 3], None);
            map.observe(k + 1, 1, id);
        }
        assert_eq!(connected(&map, 0), BTreeSet::from([0, 1, 2]));
        assert_eq!(connected(&map, 4), BTreeSet::from([4]));
        assert_eq!(map.shared_with(1), [(2, 1), (0, 1)]);
        assert_eq!(map.around(0, 3), [0, 1, 2]);
        assert_eq!(map.around(4, 3), [4]);
    }
}
