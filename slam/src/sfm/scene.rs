//! Views, tracks and the points that they see: triangulation and bundle adjustment.
#![allow(non_snake_case)] // A pose's name tells its frames: T_cam_world.

use std::collections::BTreeMap;
use std::ops::Range;

use barchan_geometry::{RectifiedRig, Se3};
use nalgebra::{Matrix3, Point3, Vector2, Vector3};

use super::follow::{Sighting, TrackId};
use crate::{BundleAdjustment, Keypoint, Observation};

/// An image that the scene keeps.
pub(super) struct View {
    /// Index of its frame.
    pub frame: usize,
    pub name: String,
    pub time: f64,
    /// Which beginning it belongs to: the worlds of two are not the same.
    pub piece: usize,
    pub T_cam_world: Se3,
    /// Stereo disparity of some of its sightings, pixels.
    pub disparities: Vec<(TrackId, f64)>,
}

/// One thing, seen by some views.
pub(super) struct Track {
    /// sRGB.
    pub colour: [u8; 3],
    /// View, and where it sees the thing.
    pub sightings: Vec<(usize, Keypoint)>,
    /// Where the thing is, in the world of its piece, once that is known.
    pub point: Option<Point3<f64>>,
}

/// All that is known.
pub(super) struct Scene {
    pub rig: RectifiedRig,
    pub views: Vec<View>,
    /// Ordered, so that every walk over them is the same.
    pub tracks: BTreeMap<TrackId, Track>,
}

impl Scene {
    /// The point of a track.
    pub fn point(&self, track: TrackId) -> Option<Point3<f64>> {
        self.tracks.get(&track)?.point
    }

    /// The ray `(x/z, y/z)` of a pixel.
    pub fn ray(&self, at: &Keypoint) -> Vector2<f64> {
        let rig = &self.rig;
        Vector2::new((at.u - rig.cx) / rig.fx, (at.v - rig.cy) / rig.fy)
    }

    /// What an image sees of the points that are known, and of which track each is.
    pub fn observations(&self, seen: &[Sighting]) -> (Vec<TrackId>, Vec<Observation>) {
        let known = seen.iter().filter_map(|s| {
            let point = self.point(s.track)?;
            Some((s.track, Observation::new(point, &s.at, None, 1.0)))
        });
        known.unzip()
    }

    /// The newest view's sightings of a track, and of no view before `since`.
    pub fn sighting(&self, track: TrackId, view: usize) -> Option<&Keypoint> {
        let sightings = &self.tracks.get(&track)?.sightings;
        let found = sightings.iter().rev().find(|(v, _)| *v == view);
        found.map(|(_, at)| at)
    }

    /// Adds a view. `colour` tells the colour of a thing seen for the first time. Tracks that no view of late
    /// saw, and of which nothing is known, are forgotten.
    pub fn add(&mut self, view: View, seen: &[Sighting], colour: impl Fn(&Keypoint) -> [u8; 3]) {
        const LATE: usize = 10;
        let index = self.views.len();
        self.views.push(view);
        for sighting in seen {
            let track = self.tracks.entry(sighting.track).or_insert_with(|| Track {
                colour: colour(&sighting.at),
                sightings: Vec::new(),
                point: None,
            });
            track.sightings.push((index, sighting.at));
        }
        self.tracks.retain(|_, track| {
            let last = track.sightings.last();
            track.point.is_some() || last.is_some_and(|(v, _)| v + LATE > index)
        });
    }

    /// Places the things that the newest view sees and whose place is not known: where two views see one
    /// under an angle of at least `min_angle` (radians), and it projects to where each view saw it. How many
    /// were placed.
    pub fn triangulate(&mut self, min_angle: f64) -> usize {
        let newest = self.views.len().wrapping_sub(1);
        let poses: Vec<Se3> = self.views.iter().map(|v| v.T_cam_world).collect();
        let rig = self.rig;
        let mut placed = 0;
        for track in self.tracks.values_mut() {
            let seen_now = track.sightings.last().is_some_and(|(v, _)| *v == newest);
            if seen_now && track.point.is_none() && track.sightings.len() > 1 {
                let sightings: Vec<(Se3, Keypoint)> = (track.sightings.iter())
                    .map(|(view, at)| (poses[*view], *at))
                    .collect();
                track.point = triangulate(&rig, &sightings, min_angle);
                placed += usize::from(track.point.is_some());
            }
        }
        placed
    }

    /// Bundle adjustment of some views and all points that they see (de Jong 2020, section 6.3). Other views
    /// that see these points stay, and so does the first of all that are concerned when no other does. Then
    /// sightings that contradict their points are forgotten.
    pub fn adjust(&mut self, free: Range<usize>, first_of_piece: usize, iterations: usize) {
        let is_free = |v: usize| free.contains(&v) && v != first_of_piece;
        let mut slots = BTreeMap::<usize, usize>::new();
        let mut problem = BundleAdjustment::default();
        let mut of_point = Vec::new();
        for (id, track) in &self.tracks {
            let Some(point) = track.point else { continue };
            if !track.sightings.iter().any(|(v, _)| free.contains(v)) {
                continue;
            }
            for (view, at) in &track.sightings {
                let slot = *slots.entry(*view).or_insert_with(|| {
                    problem.T_cam_world.push(self.views[*view].T_cam_world);
                    problem.fixed.push(!is_free(*view));
                    problem.fixed.len() - 1
                });
                let observation = Observation::new(point, at, None, 1.0);
                problem
                    .observations
                    .push((slot, problem.points.len(), observation));
            }
            problem.points.push(point);
            of_point.push(*id);
        }
        if problem.fixed.iter().all(|fixed| !fixed)
            && let Some((_, slot)) = slots.first_key_value()
        {
            problem.fixed[*slot] = true;
        }
        problem.solve(&self.rig, iterations);

        for (view, slot) in &slots {
            self.views[*view].T_cam_world = problem.T_cam_world[*slot];
        }
        for (id, position) in of_point.iter().zip(&problem.points) {
            if let Some(track) = self.tracks.get_mut(id) {
                track.point = Some(*position);
                let views = &self.views;
                let agrees = |(view, at): &(usize, Keypoint)| {
                    agrees(&self.rig, &views[*view].T_cam_world, at, position)
                };
                track.sightings.retain(agrees);
                if track.sightings.len() < 2 {
                    track.point = None;
                }
            }
        }
    }
}

/// Whether a point projects to where a view sees it.
fn agrees(rig: &RectifiedRig, T_cam_world: &Se3, at: &Keypoint, point: &Point3<f64>) -> bool {
    let observation = Observation::new(*point, at, None, 1.0);
    let residual = observation.residual(rig, &(T_cam_world * point));
    residual.is_some_and(|r| observation.accepts(r.norm_squared()))
}

/// Where rays of several views meet: the point nearest to all rays, then Gauss-Newton on the reprojection
/// errors. `None` where the last ray makes no angle of at least `min_angle` with another, and where the point
/// does not project to each sighting.
fn triangulate(
    rig: &RectifiedRig,
    sightings: &[(Se3, Keypoint)],
    min_angle: f64,
) -> Option<Point3<f64>> {
    let rays: Vec<(Vector3<f64>, Vector3<f64>)> = (sightings.iter())
        .map(|(T_cam_world, at)| {
            let T_world_cam = T_cam_world.inverse();
            let ray = Vector3::new((at.u - rig.cx) / rig.fx, (at.v - rig.cy) / rig.fy, 1.0);
            let direction = T_world_cam.rotation * ray.normalize();
            (T_world_cam.translation.vector, direction)
        })
        .collect();
    let (_, last) = rays.last()?;
    let widest = rays
        .iter()
        .map(|(_, ray)| ray.dot(last))
        .fold(1.0, f64::min);
    if widest > min_angle.cos() {
        return None;
    }
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for (centre, ray) in &rays {
        let across = Matrix3::identity() - ray * ray.transpose();
        normal += across;
        right += across * centre;
    }
    let mut point = Point3::from(normal.cholesky()?.solve(&right));
    for _ in 0..5 {
        let (mut hessian, mut gradient) = (Matrix3::zeros(), Vector3::zeros());
        for (T_cam_world, at) in sightings {
            let p_cam = T_cam_world * point;
            let observation = Observation::new(point, at, None, 1.0);
            let residual = observation.residual(rig, &p_cam)?;
            let rotation = T_cam_world.rotation.to_rotation_matrix().into_inner();
            let jacobian = observation.whiten(rig.projection_jacobian(&p_cam)) * rotation;
            hessian += jacobian.tr_mul(&jacobian);
            gradient += jacobian.tr_mul(&residual);
        }
        point += hessian.cholesky()?.solve(&gradient);
    }
    let holds = |(T_cam_world, at): &(Se3, Keypoint)| agrees(rig, T_cam_world, at, &point);
    sightings.iter().all(holds).then_some(point)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::tests::rig;

    fn sighting(T_cam_world: Se3, point: Point3<f64>, shift: f64) -> (Se3, Keypoint) {
        let seen = rig().project(&(T_cam_world * point)).unwrap();
        let at = Keypoint {
            u: seen.u + shift,
            v: seen.v,
            scale: 1.0,
            sigma: 1.0,
        };
        (T_cam_world, at)
    }

    #[test]
    fn rays_meet_in_the_point_and_narrow_or_false_ones_in_none() {
        let point = Point3::new(0.3, -0.2, 4.0);
        let moved = |x: f64| Se3::translation(-x, 0.01, 0.02);
        let views = [0.0, 0.2, 0.4].map(|x| sighting(moved(x), point, 0.0));
        let found = triangulate(&rig(), &views, 0.02).unwrap();
        assert!((found - point).norm() < 1e-9, "{found}");
        // 0.4 m aside at a depth of 4 m are a tenth.
        assert!(triangulate(&rig(), &views, 0.12).is_none());
        // Along the rows any shift is another depth; a third view contradicts it.
        let mut lying = views;
        lying[1] = sighting(moved(0.2), point, 9.0);
        assert!(triangulate(&rig(), &lying, 0.02).is_none());
        // Rays that meet behind the cameras.
        let behind = [
            sighting(moved(0.0), point, 0.0),
            sighting(moved(0.4), point, 60.0),
        ];
        assert!(triangulate(&rig(), &behind, 0.02).is_none());
    }
}
