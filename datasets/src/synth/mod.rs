//! A rendered rover traverse with exact truth, for tests, for training and for a first run without
//! any data; and random scenes for pretraining.
//!
//! A mast camera pair drives over sand with ripples, craters, tracks and rocks, ringed by hills,
//! under a low sun; or over the ground of a digital elevation model. Both images look at the same
//! surface, so disparity, occlusion, trajectory, sensors and the ground itself are known exactly. A
//! seed gives the same bytes every time, whatever frames were asked for before.
#![allow(non_snake_case)] // A pose's name tells its frames: T_world_cam.

mod camera;
mod dem;
mod light;
mod noise;
mod options;
mod relief;
mod render;
mod rocks;
mod rover;
mod scenes;
mod sensors;
mod skin;
mod surface;
mod texture;

use std::sync::OnceLock;

use barchan_geometry::{Rectification, RectifiedRig, Rig, Se3, StampedPose, Trajectory};
use nalgebra::{Point3, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

use crate::pairs::no_frame;
use crate::resample::remap;
use crate::{DataError, Plane, Rgb, Sensors, StereoFrame, StereoSource};
use camera::{Sensor, Shot};
use light::Light;
use options::Options;
use render::{Look, Scene, View};
use rocks::Rocks;
use rover::Plan;
use skin::Skin;
use surface::{Hit, Surface};

pub use options::OPTIONS;
pub use rocks::Rock;
pub use scenes::RandomScenes;

/// Seconds between frames.
const INTERVAL: f64 = 0.2;
/// Nearest and farthest depth of anything seen, metres; beyond lies the haze.
const NEAR: f64 = 0.05;
/// Sensor streams of longer sequences would not fit into memory.
const MOST_WITH_SENSORS: usize = 100_000;
/// Renders that share the time of an exposure.
const BLUR_STEPS: usize = 6;

/// Format `synth`: the rendered traverse.
pub struct Synth {
    options: Options,
    rig: RectifiedRig,
    /// The cameras as they are, where images are rectified on reading.
    crooked: Option<(Rig, Rectification)>,
    plan: Plan,
    site: Site,
    sensor: Sensor,
    trajectory: Trajectory,
    /// Made when first asked for.
    sensors: OnceLock<Sensors>,
}

/// The ground, what stands on it and the light: all that can be seen.
struct Site {
    surface: Surface,
    rocks: Rocks,
    light: Light,
    skin: Skin,
}

impl Scene for Site {
    fn hit(&self, origin: &Point3<f64>, ray: &Vector3<f64>, near: f64) -> Option<Hit> {
        self.surface
            .hit(&self.rocks, origin, ray, near, self.light.far())
    }

    fn clear_until(&self, origin: &Point3<f64>, corners: &[Vector3<f64>; 4]) -> f64 {
        let far = self.light.far();
        self.surface
            .clear_until(&self.rocks, origin, corners, NEAR, far)
    }

    fn light(&self, look: &Look, hit: Option<&Hit>) -> Vector3<f32> {
        let Some(hit) = hit else {
            return self.light.beyond(&look.ray);
        };
        let point = look.origin + look.ray * hit.t;
        let light = match hit.body {
            None => self
                .skin
                .ground(&self.surface, &self.light, look, hit.t, &point),
            Some((id, face)) => {
                let centre = self.rocks.centre_near(id, &point);
                let rock = &self.rocks.list[id as usize];
                // A little outside of the face, so that the rock is not met again.
                let outside = point + rock.faces[face as usize].0 * 1e-4;
                let to_sun = &self.light.to_sun;
                let sunlit = (rock.faces[face as usize].0.dot(to_sun) > -0.3
                    && self
                        .surface
                        .hit(&self.rocks, &outside, to_sun, 1e-4, 12.0)
                        .is_none())
                .into();
                let local = point - centre;
                self.skin
                    .rock(rock, face, &local, sunlit, &self.light, look, hit.t)
            }
        };
        self.light.through_haze(light, hit.t)
    }
}

impl Synth {
    /// Reads `seed=1,frames=60,...`, each optional; [`OPTIONS`] lists them.
    ///
    /// # Errors
    /// When an option is unknown or out of range, or a DEM cannot be used; the message names it.
    pub fn parse(spec: &str) -> Result<Self, DataError> {
        Self::new(Options::parse(spec, false)?)
    }

    /// Makes the ground and the route. Frames are rendered when asked for.
    fn new(options: Options) -> Result<Self, DataError> {
        let mut plan = Plan::new(&options);
        let (surface, rocks) = match &options.dem {
            None => relief::build(&options, &plan),
            Some(path) => dem::build(path, &options, &mut plan)?,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(options.seed ^ 0x5017);
        let light = Light::new(&options, &mut rng);
        let skin = Skin::new(&surface, &rocks, &light, &options);

        let straight = straight_rig(&options);
        let crooked = (!options.rectified).then(|| {
            let rig = crooked_rig(&straight, &mut rng);
            let rectification = Rectification::new(&rig);
            (rig, rectification)
        });
        let rig = crooked.as_ref().map_or(straight, |(_, r)| r.rig);
        let pose = |i: usize| {
            let time = i as f64 * INTERVAL;
            StampedPose {
                time,
                T_world_cam: plan.T_world_cam(&surface, time),
            }
        };
        let trajectory = Trajectory {
            poses: (0..options.frames).into_par_iter().map(pose).collect(),
        };
        Ok(Self {
            rig,
            crooked,
            sensor: Sensor::new(options.camera, options.seed, options.width, options.height),
            plan,
            site: Site {
                surface,
                rocks,
                light,
                skin,
            },
            trajectory,
            sensors: OnceLock::new(),
            options,
        })
    }

    /// Height of what is seen from above, metres, world z up: the ground or the rock that stands
    /// there. NaN beyond the end of a DEM.
    pub fn ground_height(&self, x: f64, y: f64) -> f64 {
        self.bare_ground_height(x, y)
            .max(self.site.rocks.top(&self.site.surface, x, y))
    }

    /// Height of the ground without rocks, metres. With a DEM, at its nodes it is the DEM's.
    pub fn bare_ground_height(&self, x: f64, y: f64) -> f64 {
        self.site.surface.height(x, y)
    }

    /// Every rock. Where the ground repeats (every 40.96 m along x and y, without a DEM), so do they.
    pub fn rocks(&self) -> &[Rock] {
        &self.site.rocks.list
    }

    /// The rig that images are taken with before rectification, for `rectified=false`.
    pub fn unrectified_rig(&self) -> Option<&Rig> {
        self.crooked.as_ref().map(|(rig, _)| rig)
    }

    /// The time of a frame, seconds.
    pub(crate) fn time(&self, index: usize) -> f64 {
        index as f64 * INTERVAL
    }

    /// The poses of the left camera that takes the images of [`Synth::photograph`].
    pub(crate) fn trajectory_of_images(&self) -> Trajectory {
        let mut trajectory = self.trajectory.clone();
        if let Some((_, rectification)) = &self.crooked {
            for pose in &mut trajectory.poses {
                pose.T_world_cam *= rectification.R_rect_left;
            }
        }
        trajectory
    }

    /// True depth of the left image of frame `index`, metres along the optical axis; NaN where
    /// nothing is near enough.
    ///
    /// # Errors
    /// When there is no such frame.
    pub fn true_depth(&self, index: usize) -> Result<Plane, DataError> {
        let depth = |hit: Option<&Hit>| hit.map_or(f32::NAN, |hit| hit.t as f32);
        self.truth(index, false, |_, _, hit| depth(hit))
    }

    /// Where the right camera does not see what the left image of frame `index` shows: 1 there, 0
    /// where it does, NaN where nothing is near enough. What lies outside the right image counts as
    /// not seen.
    ///
    /// # Errors
    /// When there is no such frame.
    pub fn true_occlusion(&self, index: usize) -> Result<Plane, DataError> {
        let pose = self.pose(index)?;
        let right = self.view(&pose, true);
        self.truth(index, false, |u, v, hit| {
            let Some(hit) = hit else { return f32::NAN };
            let column = u - self.rig.fx * self.rig.baseline / hit.t;
            let seen = self.site.hit(&right.origin, &right.ray(column, v), NEAR);
            // Depth is the parameter of both rays.
            let hidden = seen.is_some_and(|seen| seen.t < hit.t * (1.0 - 1e-3));
            f32::from(u8::from(hidden || column < -0.5))
        })
    }

    /// A plane of what the rays of one camera meet.
    fn truth(
        &self,
        index: usize,
        right: bool,
        value: impl Fn(f64, f64, Option<&Hit>) -> f32 + Sync,
    ) -> Result<Plane, DataError> {
        let view = self.view(&self.pose(index)?, right);
        let (w, h) = (self.rig.width, self.rig.height);
        let hits = render::hits(&self.site, &view);
        let of =
            |(k, hit): (usize, &Option<Hit>)| value((k % w) as f64, (k / w) as f64, hit.as_ref());
        let values = hits.par_iter().enumerate().map(of).collect();
        // One value a pixel by construction.
        Ok(Plane::from_raw(w as u32, h as u32, values).unwrap_or_default())
    }

    /// What rays of length 1 meet that leave a sensor on the mast of the camera at frame `index`: metres to it, and the
    /// sunlight that comes back from there, the mean of linear red, green and blue.
    ///
    /// # Errors
    /// When there is no such frame.
    pub(crate) fn scan(
        &self,
        index: usize,
        T_cam_sensor: &Se3,
        rays: &[Vector3<f64>],
    ) -> Result<Vec<Option<(f64, f32)>>, DataError> {
        /// Width of a beam, radians.
        const BEAM: f64 = 0.003;
        let T_world_sensor = self.pose(index)? * T_cam_sensor;
        let origin = T_world_sensor * Point3::origin();
        let met = |ray: &Vector3<f64>| {
            let ray = T_world_sensor.rotation * ray;
            let hit = self.site.hit(&origin, &ray, NEAR)?;
            let aside = ray.cross(&Vector3::x()).try_normalize(1e-6);
            let aside = aside.unwrap_or_else(Vector3::y);
            let look = Look {
                origin,
                ray,
                eye: origin,
                steps: [aside * BEAM, ray.cross(&aside) * BEAM],
            };
            Some((hit.t, self.site.light(&look, Some(&hit)).mean()))
        };
        Ok(rays.par_iter().map(met).collect())
    }

    fn pose(&self, index: usize) -> Result<Se3, DataError> {
        let poses = &self.trajectory.poses;
        let pose = poses
            .get(index)
            .ok_or_else(|| no_frame(index, poses.len()))?;
        Ok(pose.T_world_cam)
    }

    fn view(&self, T_world_cam: &Se3, right: bool) -> View<'static> {
        let shift = if right { self.rig.baseline } else { 0.0 };
        View::rectified(&self.rig, T_world_cam, shift)
    }

    /// The left and right images of frame `index` as the cameras take them: of
    /// [`Synth::unrectified_rig`] where there is one, else rectified.
    ///
    /// # Errors
    /// When there is no such frame.
    pub fn photograph(&self, index: usize) -> Result<[Rgb; 2], DataError> {
        self.pose(index)?;
        let [(left, sun_left), (right, sun_right)] = [false, true].map(|r| self.expose(index, r));
        let exposure = self.sensor.meter(&left);
        let developed = |mut image: Vec<f32>, right: bool, sun| {
            let shot = Shot {
                frame: index,
                right,
                exposure,
                sun,
            };
            self.sensor.develop(&mut image, shot);
            // Three values a pixel by construction.
            Rgb::from_raw(self.rig.width as u32, self.rig.height as u32, image).unwrap_or_default()
        };
        Ok([
            developed(left, false, sun_left),
            developed(right, true, sun_right),
        ])
    }

    /// The light on one camera's pixels over the time of the exposure, and where the sun stands.
    fn expose(&self, index: usize, right: bool) -> (Vec<f32>, Option<nalgebra::Vector2<f64>>) {
        let middle = index as f64 * INTERVAL;
        let blur = self.options.camera.blur;
        let steps = if blur > 0.0 { BLUR_STEPS } else { 1 };
        let mut sum = Vec::new();
        for k in 0..steps {
            let time = middle + blur * ((k as f64 + 0.5) / steps as f64 - 0.5);
            let T_world_rect = self.plan.T_world_cam(&self.site.surface, time);
            let light = match &self.crooked {
                None => render::render(&self.site, &self.view(&T_world_rect, right)),
                Some(crooked) => render::render(
                    &self.site,
                    &self.crooked_view(crooked, &T_world_rect, right),
                ),
            };
            if sum.is_empty() {
                sum = light;
            } else {
                sum.iter_mut().zip(light).for_each(|(sum, l)| *sum += l);
            }
        }
        sum.iter_mut().for_each(|l| *l /= steps as f32);
        let T_world_cam = self.trajectory.poses[index].T_world_cam;
        let sun = self
            .view(&T_world_cam, right)
            .pixel(&self.site.light.to_sun);
        (sum, sun)
    }

    fn crooked_view<'a>(
        &self,
        (rig, rectification): &'a (Rig, Rectification),
        T_world_rect: &Se3,
        right: bool,
    ) -> View<'a> {
        let (camera, R_rect_cam, shift) = if right {
            (&rig.right, rectification.R_rect_right, self.rig.baseline)
        } else {
            (&rig.left, rectification.R_rect_left, 0.0)
        };
        View::bent(&self.rig, T_world_rect, shift, camera, &R_rect_cam)
    }
}

/// Opens what follows `synth:`, a traverse, `scenes,...` or `planes,...`.
///
/// # Errors
/// As [`Synth::parse`] and [`RandomScenes::parse`].
pub fn open(spec: &str) -> Result<Box<dyn StereoSource>, DataError> {
    match spec.split_once(',').unwrap_or((spec, "")) {
        ("scenes", rest) => Ok(Box::new(RandomScenes::parse(rest)?)),
        ("planes", rest) => Ok(Box::new(RandomScenes::planes(rest)?)),
        _ => Ok(Box::new(Synth::parse(spec)?)),
    }
}

/// The rig asked for, its optical axes in the middle of the images.
fn straight_rig(options: &Options) -> RectifiedRig {
    let focal = 0.8 * options.width as f64;
    RectifiedRig {
        width: options.width,
        height: options.height,
        fx: focal,
        fy: focal,
        cx: (options.width as f64 - 1.0) / 2.0,
        cy: (options.height as f64 - 1.0) / 2.0,
        doffs: 0.0,
        baseline: options.baseline,
    }
}

impl StereoSource for Synth {
    fn rig(&self) -> &RectifiedRig {
        &self.rig
    }

    fn len(&self) -> usize {
        self.options.frames
    }

    fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
        let [mut left, mut right] = self.photograph(index)?;
        if let Some((_, maps)) = &self.crooked {
            left = remap(&left, &maps.left_map);
            right = remap(&right, &maps.right_map);
        }
        Ok(StereoFrame {
            index,
            name: self.name(index),
            time: self.trajectory.poses[index].time,
            left,
            right,
        })
    }

    fn true_disparity(&self, index: usize) -> Result<Option<Plane>, DataError> {
        let scale = self.rig.fx * self.rig.baseline;
        let disparity = |hit: &Hit| (scale / hit.t) as f32;
        self.truth(index, false, |_, _, hit| hit.map_or(f32::NAN, disparity))
            .map(Some)
    }

    fn true_disparity_right(&self, index: usize) -> Result<Option<Plane>, DataError> {
        let scale = self.rig.fx * self.rig.baseline;
        let disparity = |hit: &Hit| (scale / hit.t) as f32;
        self.truth(index, true, |_, _, hit| hit.map_or(f32::NAN, disparity))
            .map(Some)
    }

    fn true_trajectory(&self) -> Option<&Trajectory> {
        Some(&self.trajectory)
    }

    /// IMU at 100 Hz, wheel odometry at 10 Hz and GNSS at 1 Hz; of sequences up to 100,000 frames.
    fn sensors(&self) -> Option<&Sensors> {
        let frames = self.options.frames;
        let noise_seed = self.options.seed ^ 0x1305;
        (frames <= MOST_WITH_SENSORS).then(|| {
            self.sensors.get_or_init(|| {
                sensors::measure(
                    &self.plan,
                    &self.site.surface,
                    (frames - 1) as f64 * INTERVAL,
                    self.rig.baseline,
                    self.options.sensor_noise.then_some(noise_seed),
                )
            })
        })
    }
}

/// A rig as it leaves a workshop: lenses that bend, unequal focal lengths, cameras turned by up to a
/// degree.
fn crooked_rig(straight: &RectifiedRig, rng: &mut ChaCha8Rng) -> Rig {
    use barchan_geometry::{Camera, Distortion};
    use rand::RngExt;
    let mut camera = || Camera {
        distortion: Distortion::RadTan([
            rng.random_range(-0.22..-0.12),
            rng.random_range(0.02..0.06),
            rng.random_range(-1e-3..1e-3),
            rng.random_range(-1e-3..1e-3),
            0.0,
        ]),
        ..Camera::pinhole(
            straight.fx * rng.random_range(0.99..1.01),
            straight.fy * rng.random_range(0.99..1.01),
            straight.cx + straight.fx * rng.random_range(-0.02..0.02),
            straight.cy + straight.fy * rng.random_range(-0.02..0.02),
        )
    };
    let (left, right) = (camera(), camera());
    let turn = Vector3::from_fn(|_, _| rng.random_range(-0.01..0.01));
    let off_axis = Vector3::new(
        -straight.baseline,
        straight.baseline * rng.random_range(-0.02..0.02),
        straight.baseline * rng.random_range(-0.02..0.02),
    );
    Rig {
        width: straight.width,
        height: straight.height,
        left,
        right,
        T_right_left: Se3::new(off_axis, turn),
        rectified: false,
    }
}

#[cfg(test)]
mod tests;
