//! Where was the camera when this frame was taken? (Pire 2017, tracking thread.)

use barchan_geometry::{RectifiedRig, Se3, se3};
use nalgebra::{Matrix6, Vector2, Vector6};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::features::Descriptor;
use crate::frame::Seen;
use crate::local_map::LocalMap;
use crate::map::PointId;
use crate::matching::{ProjectedMatches, find_points, match_all};
use crate::pose::{Observation, optimise_pose, reprojection_jacobian, sample_pose};
use crate::{Keypoint, SlamConfig};

/// Where a frame is, and what tells so.
#[derive(Clone, Debug)]
#[allow(non_snake_case)]
pub(crate) struct Placement {
    /// Maps world points to the left camera.
    pub T_cam_world: Se3,
    /// Map points that agree with the pose.
    pub sightings: Vec<Sighting>,
    /// Deviations of the way to it, where no map point tells but other sensors do; see
    /// [`Keyframe::carried`](crate::Keyframe::carried).
    pub carried: Option<(f64, f64)>,
}

/// A map point seen by a feature of a frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sighting {
    pub point: PointId,
    pub feature: usize,
    /// Where: the feature's place, aligned to a fraction of a pixel when that was possible.
    pub at: Keypoint,
}

/// By how many deviations few matches must agree better than by chance: near the predicted pose, which
/// is a witness too, and elsewhere.
const NEAR: f64 = 3.5;
/// See [`NEAR`].
const FAR: f64 = 5.0;

/// Follows the camera through a map that others build.
pub(crate) struct Tracker {
    rig: RectifiedRig,
    config: SlamConfig,
    /// Pose (`T_cam_world`) and time of the last frame.
    last: Option<(Se3, f64)>,
    /// The twist that led to the last pose, and how long it took.
    velocity: Option<(Vector6<f64>, f64)>,
}

impl Tracker {
    pub fn new(rig: RectifiedRig, config: SlamConfig) -> Self {
        Self {
            rig,
            config,
            last: None,
            velocity: None,
        }
    }

    /// Places a frame: match the local map where the predicted pose puts it, optimise the pose; where that fails, match the newest key frames by looks alone, sample
    /// a pose and optimise that. `None` when neither finds a pose that enough points agree with.
    #[allow(non_snake_case)]
    pub fn track(&self, seen: &Seen, T_predicted: &Se3, local: &LocalMap) -> Option<Placement> {
        self.track_by_projection(seen, local, T_predicted)
            .or_else(|| self.track_by_looks(seen, local))
    }

    /// The last pose moved on by the last velocity, scaled to the time that passed.
    pub fn predict(&self, time: f64) -> Se3 {
        let Some((last, last_time)) = self.last else {
            return Se3::identity();
        };
        match self.velocity {
            Some((twist, took)) if took > 0.0 => {
                // Times of field data jump; a rover does not.
                let share = ((time - last_time) / took).clamp(0.0, 2.0);
                se3::exp(&(twist * share)) * last
            }
            _ => last,
        }
    }

    /// Takes note of the pose of a frame that came on from the last one.
    #[allow(non_snake_case)]
    pub fn moved_to(&mut self, T_cam_world: Se3, time: f64) {
        self.velocity = self
            .last
            .map(|(last, last_time)| (se3::log(&(T_cam_world * last.inverse())), time - last_time));
        self.last = Some((T_cam_world, time));
    }

    /// Takes note of the pose of a frame that did not: the next one is looked for around it.
    #[allow(non_snake_case)]
    pub fn set_down_at(&mut self, T_cam_world: Se3, time: f64) {
        self.velocity = None;
        self.last = Some((T_cam_world, time));
    }

    /// The map moved under the last frame: what was at a place of the new world was at
    /// `T_old_new` times it.
    #[allow(non_snake_case)]
    pub fn map_moved(&mut self, T_old_new: &Se3) {
        if let Some((last, _)) = &mut self.last {
            *last *= T_old_new;
        }
    }

    /// Matches local points where the predicted pose puts them, in windows that widen until a pose
    /// holds.
    #[allow(non_snake_case)]
    fn track_by_projection(
        &self,
        seen: &Seen,
        local: &LocalMap,
        T_predicted: &Se3,
    ) -> Option<Placement> {
        [(12.0, NEAR), (24.0, NEAR), (48.0, FAR)]
            .into_iter()
            .find_map(|(radius, beyond)| {
                let matches = self.project_and_match(seen, local, T_predicted, radius);
                let observations = self.observations(seen, local, &matches.pairs);
                let rough = optimise_pose(&self.rig, &observations, T_predicted);
                (rough.count() >= self.config.min_inliers)
                    .then(|| self.settle(seen, local, &rough.T_cam_world, beyond))?
            })
    }

    /// Matches the nearest points by descriptor alone, samples a pose and settles it in the whole
    /// local map: for jumps that no prediction covers, and for places known from long ago.
    #[allow(non_snake_case)]
    pub fn track_by_looks(&self, seen: &Seen, local: &LocalMap) -> Option<Placement> {
        let nearest = &local.nearest;
        let look = |id: &PointId| local.points[id].descriptor;
        let looks: Vec<Descriptor> = nearest.iter().map(look).collect();
        let pairs: Vec<(PointId, usize)> = match_all(&looks, &seen.features[0], &self.config)
            .into_iter()
            .map(|(i, feature)| (nearest[i], feature))
            .collect();
        let observations = self.observations(seen, local, &pairs);
        let mut rng = ChaCha8Rng::seed_from_u64(self.config.seed);
        let T_sampled = sample_pose(&self.rig, &observations, self.config.min_inliers, &mut rng)?;
        let rough = optimise_pose(&self.rig, &observations, &T_sampled);
        self.settle(seen, local, &rough.T_cam_world, FAR)
    }

    /// The last, narrow match around a pose that is nearly right, with sightings aligned to a
    /// fraction of a pixel; `None` unless the pose explains what is seen.
    ///
    /// Sand looks like sand: near a false pose a third of the points still find a corner that could
    /// be theirs. So a count proves nothing; a true pose explains most matches (four in five, where
    /// false ones were seen to explain half), and more than a few of the points in view. When a fast
    /// motion or a crest, behind which most points in view are hidden, leaves few matches, these must
    /// agree better than half of them could by chance: by so many deviations of a binomial distribution.
    #[allow(non_snake_case)]
    fn settle(
        &self,
        seen: &Seen,
        local: &LocalMap,
        T_rough: &Se3,
        deviations: f64,
    ) -> Option<Placement> {
        const RADIUS: f64 = 6.0;
        let matches = self.project_and_match(seen, local, T_rough, RADIUS);
        let sightings: Vec<Sighting> = matches
            .pairs
            .iter()
            .map(|(point, feature)| Sighting {
                point: *point,
                feature: *feature,
                at: self.align(seen, local, *point, *feature, T_rough),
            })
            .collect();
        let observations: Vec<Observation> = sightings
            .iter()
            .map(|s| self.observation(seen, local, s.point, s.feature, &s.at))
            .collect();
        let pose = optimise_pose(&self.rig, &observations, T_rough);
        let count = pose.count();
        let explains = |share: f64, of: usize| count as f64 >= share * of as f64;
        let n = matches.pairs.len() as f64;
        let beyond_chance = count as f64 - 0.5 * n > deviations * (0.25 * n).sqrt();
        let holds = count >= self.config.min_inliers
            && explains(self.config.min_match_share, matches.pairs.len())
            && (explains(self.config.min_view_share, matches.in_view) || beyond_chance);
        let inliers = sightings.into_iter().zip(&pose.inliers);
        holds.then(|| Placement {
            T_cam_world: pose.T_cam_world,
            sightings: inliers.filter(|(_, i)| **i).map(|(s, _)| s).collect(),
            carried: None,
        })
    }

    /// Covariance of the twist `xi` (translation first) of which `exp(xi) T_cam_world` is the true
    /// pose of a placement, as its sightings tell. A pose without any is where it is by definition; one
    /// that they do not fix is known to a metre and a radian.
    pub fn covariance(&self, seen: &Seen, local: &LocalMap, placement: &Placement) -> Matrix6<f64> {
        if placement.sightings.is_empty() {
            return Matrix6::zeros();
        }
        let mut information = Matrix6::zeros();
        for s in &placement.sightings {
            let o = self.observation(seen, local, s.point, s.feature, &s.at);
            let p_cam = placement.T_cam_world * o.point;
            let jacobian = o.whiten(reprojection_jacobian(&self.rig, &p_cam));
            information += jacobian.transpose() * jacobian;
        }
        let known = information.cholesky().map(|c| c.inverse());
        known.unwrap_or_else(Matrix6::identity)
    }

    /// Where the picture of a point fits best around a matched feature. A corner detector puts a
    /// corner on whole pixels, now here, now there; the picture does not.
    #[allow(non_snake_case)]
    fn align(
        &self,
        seen: &Seen,
        local: &LocalMap,
        point: PointId,
        feature: usize,
        T_cam_world: &Se3,
    ) -> Keypoint {
        let corner = seen.features[0].keypoints[feature];
        let point = &local.points[&point];
        let depth = (T_cam_world * point.position).z;
        let guess = Vector2::new(corner.u, corner.v);
        let found = point
            .patch
            .as_ref()
            .and_then(|p| p.find(&seen.grey[0], guess, depth));
        found.map_or(corner, |at| Keypoint {
            u: at.x,
            v: at.y,
            sigma: self.config.alignment_sigma * corner.scale,
            ..corner
        })
    }

    #[allow(non_snake_case)]
    fn project_and_match(
        &self,
        seen: &Seen,
        local: &LocalMap,
        T_cam_world: &Se3,
        radius: f64,
    ) -> ProjectedMatches {
        let features = (&seen.features[0], &seen.grid);
        find_points(
            local.points.iter(),
            T_cam_world,
            features,
            radius,
            &self.rig,
            &self.config,
        )
    }

    fn observations(
        &self,
        seen: &Seen,
        local: &LocalMap,
        pairs: &[(PointId, usize)],
    ) -> Vec<Observation> {
        pairs
            .iter()
            .map(|(point, feature)| {
                let at = &seen.features[0].keypoints[*feature];
                self.observation(seen, local, *point, *feature, at)
            })
            .collect()
    }

    fn observation(
        &self,
        seen: &Seen,
        local: &LocalMap,
        point: PointId,
        feature: usize,
        at: &Keypoint,
    ) -> Observation {
        Observation::new(
            local.points[&point].position,
            at,
            seen.disparities[feature],
            self.config.disparity_sigma,
        )
    }
}
