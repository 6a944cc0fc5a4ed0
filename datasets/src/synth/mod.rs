//! A rendered rover traverse with exact truth, for tests and for a first run without any data.
//!
//! A mast camera pair drives a wide circle over sand with ripples, craters and rocks, ringed by
//! hills, under a low sun. Both images look at the same surface, so disparity, trajectory and the
//! ground itself are known exactly. A seed gives the same bytes every time, whatever frames were
//! asked for before.
#![allow(non_snake_case)] // A pose's name tells its frames: T_world_cam.

mod ground;
mod noise;
mod texture;

use barchan_geometry::nalgebra::{Matrix3, Rotation3, Translation3};
use barchan_geometry::{RectifiedRig, Se3, StampedPose, Trajectory};
use nalgebra::{Matrix2, Point3, UnitQuaternion, Vector2, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

use crate::pairs::no_frame;
use crate::{DataError, Plane, Rgb, StereoFrame, StereoSource};
use ground::{CELL, Ground, ROUTE_RADIUS};
use noise::add_noise;
use texture::{Footprint, Texture};

/// The options of a synthetic traverse.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Options {
    /// Chooses the ground, the route and the noise.
    seed: u64,
    /// How many frames. About 700 drive the circle once.
    frames: usize,
    /// Image width, pixels.
    width: usize,
    /// Image height, pixels.
    height: usize,
    /// Standard deviation of the sensor noise, grey levels of 255.
    noise: f64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            seed: 1,
            frames: 60,
            width: 384,
            height: 288,
            noise: 1.0,
        }
    }
}

/// Format `synth`: the rendered traverse.
pub struct Synth {
    options: Options,
    rig: RectifiedRig,
    ground: Ground,
    grain: Texture<1>,
    trajectory: Trajectory,
}

/// Metres driven between frames.
const STEP: f64 = 0.08;
/// Seconds between frames.
const INTERVAL: f64 = 0.2;
/// Height of the camera above the ground, metres.
const MAST: f64 = 0.8;
/// How far the camera looks down, radians.
const PITCH: f64 = 0.36;
/// Farther than this, metres, the haze has swallowed everything.
const FAR: f64 = 40.0;
/// Side of the grain texture, and the metres of its texel in its fine and its coarse use.
const GRAIN: usize = 1024;
const FINE: f32 = 0.0023;
const COARSE: f32 = 0.0171;

impl Synth {
    /// Reads `seed=1,frames=60,width=384,height=288,noise=1`, each optional.
    ///
    /// # Errors
    /// When an option is unknown or out of range; the message names it.
    pub fn parse(spec: &str) -> Result<Self, DataError> {
        let mut options = Options::default();
        let bad = |message: String| DataError::Layout {
            spec: format!("synth:{spec}"),
            message,
        };
        for item in spec
            .split(',')
            .map(str::trim)
            .filter(|item| !item.is_empty())
        {
            let (key, value) = item.split_once('=').unwrap_or((item, ""));
            let whole = |least: usize, most: usize| {
                value
                    .parse()
                    .ok()
                    .filter(|v| (least..=most).contains(v))
                    .ok_or_else(|| {
                        bad(format!(
                            "{key} is \"{value}\", expected a whole number from {least} to {most}"
                        ))
                    })
            };
            match key {
                "seed" => {
                    options.seed = value.parse().map_err(|_| {
                        bad(format!("seed is \"{value}\", expected a whole number"))
                    })?;
                }
                "frames" => options.frames = whole(1, 1_000_000)?,
                "width" => options.width = whole(32, 4096)?,
                "height" => options.height = whole(32, 4096)?,
                "noise" => {
                    options.noise = value
                        .parse()
                        .ok()
                        .filter(|v| (0.0..=50.0).contains(v))
                        .ok_or_else(|| {
                            bad(format!(
                                "noise is \"{value}\", expected grey levels from 0 to 50"
                            ))
                        })?;
                }
                _ => {
                    return Err(bad(format!(
                        "unknown option \"{key}\"; known: seed, frames, width, height, noise"
                    )));
                }
            }
        }
        Ok(Self::new(options))
    }

    /// Makes the ground and the route. Frames are rendered when asked for.
    fn new(options: Options) -> Self {
        let focal = 0.8 * options.width as f64;
        let rig = RectifiedRig {
            width: options.width,
            height: options.height,
            fx: focal,
            fy: focal,
            cx: (options.width as f64 - 1.0) / 2.0,
            cy: (options.height as f64 - 1.0) / 2.0,
            doffs: 0.0,
            baseline: 0.12,
        };
        let ground = Ground::new(options.seed);
        let grain = grain(options.seed as u32, ground.light_along);
        let pose = |i: usize| StampedPose {
            time: i as f64 * INTERVAL,
            T_world_cam: pose(&ground, options.seed, i),
        };
        let trajectory = Trajectory {
            poses: (0..options.frames).into_par_iter().map(pose).collect(),
        };
        Self {
            options,
            rig,
            ground,
            grain,
            trajectory,
        }
    }

    /// Height of the true ground, metres, world z up. What it is evaluated on by the renderer,
    /// so a map may be compared with it point by point.
    pub fn ground_height(&self, x: f64, y: f64) -> f64 {
        self.ground.height(x, y)
    }

    /// The ray through a pixel, in the world. It has z = 1 in the camera, so that the parameter
    /// along it is the depth.
    fn ray(&self, T_world_cam: &Se3, u: f64, v: f64) -> Vector3<f64> {
        let rig = &self.rig;
        T_world_cam.rotation * Vector3::new((u - rig.cx) / rig.fx, (v - rig.cy) / rig.fy, 1.0)
    }

    /// What a camera `shift` metres to the right of the left one sees at a pixel.
    fn look(&self, T_world_cam: &Se3, shift: f64, u: f64, v: f64) -> Option<Hit> {
        let origin = T_world_cam * Point3::new(shift, 0.0, 0.0);
        let ray = self.ray(T_world_cam, u, v);
        let depth = self.ground.hit(&origin, &ray, 0.05, FAR)?;
        Some(Hit {
            depth,
            point: origin + ray * depth,
            ray,
        })
    }

    fn render(&self, index: usize, right: bool) -> Rgb {
        let T_world_cam = self.trajectory.poses[index].T_world_cam;
        let shift = if right { self.rig.baseline } else { 0.0 };
        let (w, h) = (self.rig.width, self.rig.height);
        let mut image = vec![0.0f32; 3 * w * h];
        image
            .par_chunks_exact_mut(3 * w)
            .enumerate()
            .for_each(|(v, row)| {
                for (u, pixel) in row.chunks_exact_mut(3).enumerate() {
                    let (u, v) = (u as f64, v as f64);
                    let colour = match self.look(&T_world_cam, shift, u, v) {
                        Some(hit) => self.surface(&T_world_cam, &hit),
                        None => sky(&self.ray(&T_world_cam, u, v)),
                    };
                    pixel.copy_from_slice(colour.as_slice());
                }
            });
        self.add_noise(&mut image, 2 * index as u64 + u64::from(right));
        // Three values a pixel by construction.
        Rgb::from_raw(w as u32, h as u32, image).unwrap_or_default()
    }

    /// Colour of the ground at a hit, averaged over the pixel.
    fn surface(&self, T_world_cam: &Se3, hit: &Hit) -> Vector3<f32> {
        let (x, y) = (hit.point.x, hit.point.y);
        let over = self.footprint(T_world_cam, hit);
        let scaled = |metres: f32| Footprint {
            major: over.major / metres,
            minor: over.minor / metres,
        };
        // Positions in the grain wrap: reduce them in f64 first, or far from the origin they blur.
        let texel = |x: f64, y: f64, metres: f32| {
            let wrapped = |v: f64| (v / f64::from(metres)).rem_euclid(GRAIN as f64) as f32;
            Vector2::new(wrapped(x), wrapped(y))
        };
        let node = Vector2::new((x / CELL) as f32, (y / CELL) as f32);
        let [light, rock] = self.ground.light_and_rock.mean(node, scaled(CELL as f32));
        // The same grain twice, turned and at incommensurate scales: together it does not repeat.
        let [fine] = self.grain.mean(texel(x, y, FINE), scaled(FINE));
        let (s, c) = 0.65f32.sin_cos();
        let turn = Matrix2::new(c, s, -s, c);
        let turned = turn.cast::<f64>() * Vector2::new(x, y);
        let coarse_over = Footprint {
            major: turn * over.major / COARSE,
            minor: over.minor / COARSE,
        };
        let [coarse] = self
            .grain
            .mean(texel(turned.x, turned.y, COARSE), coarse_over);

        let sand = Vector3::new(0.78, 0.56, 0.38);
        let stone = Vector3::new(0.56, 0.46, 0.39) * (0.4 + rock);
        let is_rock = (2.0 * rock).min(1.0);
        let albedo =
            (sand * (1.0 - is_rock) + stone * is_rock) * (1.0 + 0.22 * fine + 0.16 * coarse);
        let clear = (-(hit.depth / 24.0).powi(2)).exp() as f32;
        (albedo * light * clear + haze(0.0) * (1.0 - clear)).map(|v| v.clamp(0.0, 1.0))
    }

    /// What a pixel covers of the ground plan (ray differentials, Igehy 1999).
    fn footprint(&self, T_world_cam: &Se3, hit: &Hit) -> Footprint {
        let normal = self.ground.normal(hit.point.x, hit.point.y);
        let towards = normal.dot(&hit.ray).min(-1e-3);
        let across = |step: Vector3<f64>| {
            let step = T_world_cam.rotation * step;
            ((step - hit.ray * (normal.dot(&step) / towards)) * hit.depth)
                .xy()
                .cast::<f32>()
        };
        let a = across(Vector3::new(1.0 / self.rig.fx, 0.0, 0.0));
        let b = across(Vector3::new(0.0, 1.0 / self.rig.fy, 0.0));
        let major = if a.norm_squared() > b.norm_squared() {
            a
        } else {
            b
        };
        Footprint {
            major,
            minor: a.perp(&b).abs() / major.norm().max(1e-9),
        }
    }

    /// Sensor noise, from a stream of its own for each image.
    fn add_noise(&self, image: &mut [f32], stream: u64) {
        if self.options.noise == 0.0 {
            return;
        }
        let mut rng = ChaCha8Rng::seed_from_u64(self.options.seed);
        rng.set_stream(stream + 1);
        // The sum of four uniform bytes is near enough to normal, and the same on every machine:
        // mean 510, variance 4 (256^2 - 1) / 12.
        let scale = self.options.noise as f32 / 255.0 / 147.8;
        for value in image {
            let sum: u32 = rng
                .next_u32()
                .to_le_bytes()
                .into_iter()
                .map(u32::from)
                .sum();
            *value = (*value + (sum as f32 - 510.0) * scale).clamp(0.0, 1.0);
        }
    }
}

struct Hit {
    depth: f64,
    point: Point3<f64>,
    ray: Vector3<f64>,
}

impl StereoSource for Synth {
    fn rig(&self) -> &RectifiedRig {
        &self.rig
    }

    fn len(&self) -> usize {
        self.options.frames
    }

    fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
        let pose = self
            .trajectory
            .poses
            .get(index)
            .ok_or_else(|| no_frame(index, self.len()))?;
        let (left, right) = (self.render(index, false), self.render(index, true));
        Ok(StereoFrame {
            index,
            name: format!("{index:06}"),
            time: pose.time,
            left,
            right,
        })
    }

    fn true_disparity(&self, index: usize) -> Result<Option<Plane>, DataError> {
        let pose = self
            .trajectory
            .poses
            .get(index)
            .ok_or_else(|| no_frame(index, self.len()))?;
        let (w, h) = (self.rig.width, self.rig.height);
        let mut disparity = vec![f32::NAN; w * h];
        disparity
            .par_chunks_exact_mut(w)
            .enumerate()
            .for_each(|(v, row)| {
                for (u, d) in row.iter_mut().enumerate() {
                    if let Some(hit) = self.look(&pose.T_world_cam, 0.0, u as f64, v as f64) {
                        *d = (self.rig.fx * self.rig.baseline / hit.depth) as f32;
                    }
                }
            });
        Ok(Plane::from_raw(w as u32, h as u32, disparity))
    }

    fn true_trajectory(&self) -> Option<&Trajectory> {
        Some(&self.trajectory)
    }
}

/// The pose of frame `i`: on the route, tilted as the ground under the wheels.
fn pose(ground: &Ground, seed: u64, i: usize) -> Se3 {
    let start = (seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 11) as f64 / (1u64 << 53) as f64
        * std::f64::consts::TAU;
    let angle = start + i as f64 * STEP / ROUTE_RADIUS;
    let at = |angle: f64| {
        let radius = ROUTE_RADIUS + 0.8 * (3.0 * angle + start).sin();
        Vector2::new(angle.cos(), angle.sin()) * radius
    };
    let here = at(angle);
    let heading = (at(angle + 1e-4) - at(angle - 1e-4)).normalize();

    // The plane that fits the ground best over the 1.4 m around: the wheels smooth what they roll over.
    let (mut mean, mut slope) = (0.0, Vector2::zeros());
    let reach = -7..=7;
    let offsets = reach.clone().flat_map(|a| {
        reach
            .clone()
            .map(move |b| Vector2::new(f64::from(a), f64::from(b)) * 0.1)
    });
    let mut spread = 0.0;
    for offset in offsets.clone() {
        let height = ground.height(here.x + offset.x, here.y + offset.y);
        mean += height;
        slope += offset * height;
        spread += offset.x * offset.x;
    }
    mean /= offsets.count() as f64;
    slope /= spread;

    let up = Vector3::new(-slope.x, -slope.y, 1.0).normalize();
    let ahead = Vector3::new(heading.x, heading.y, heading.dot(&slope)).normalize();
    let z = ahead * PITCH.cos() - up * PITCH.sin();
    let x = ahead.cross(&up);
    let axes = Matrix3::from_columns(&[x, z.cross(&x), z]);
    let position = Vector3::new(here.x, here.y, mean) + up * MAST;
    Se3::from_parts(
        Translation3::from(position),
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes)),
    )
}

/// Dust in the air, by the sine of the elevation.
fn haze(elevation: f32) -> Vector3<f32> {
    let high = (elevation * 3.0).clamp(0.0, 1.0);
    Vector3::new(0.74, 0.62, 0.49) * (1.0 - high) + Vector3::new(0.45, 0.37, 0.32) * high
}

fn sky(ray: &Vector3<f64>) -> Vector3<f32> {
    haze((ray.z / ray.norm()) as f32)
}

/// Grains, pebbles and patches with as much contrast at every size, of mean about 0 and standard
/// deviation about 1; the finest lit from the side as relief.
fn grain(seed: u32, light_along: Vector2<f32>) -> Texture<1> {
    let noise = |octaves: &[(u32, f32)], seed: u32| {
        let mut image = vec![0.0f32; GRAIN * GRAIN];
        image
            .par_chunks_mut(GRAIN)
            .enumerate()
            .for_each(|(j, row)| {
                for (k, (waves, amplitude)) in octaves.iter().enumerate() {
                    add_noise(row, j, *waves, *amplitude, seed.wrapping_add(k as u32));
                }
            });
        image
    };
    let relief = noise(
        &[(256, 4.0), (128, 8.0), (64, 16.0)],
        seed.wrapping_add(200),
    );
    let patches = noise(
        &[(200, 1.7), (96, 1.7), (47, 1.7), (23, 1.7), (11, 1.7)],
        seed.wrapping_add(300),
    );
    let height = |i: usize, j: usize| relief[(j % GRAIN) * GRAIN + i % GRAIN];
    let lit = |k: usize| {
        let (i, j) = (k % GRAIN + GRAIN, k / GRAIN + GRAIN);
        // A slope that rises along the light faces the sun.
        let slope_x = height(i + 1, j) - height(i - 1, j);
        let slope_y = height(i, j + 1) - height(i, j - 1);
        [patches[k] + 0.45 * (light_along.x * slope_x + light_along.y * slope_y)]
    };
    Texture::new(GRAIN, (0..GRAIN * GRAIN).into_par_iter().map(lit).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::resample::cubic_weights;
    use barchan_geometry::StereoPoint;

    fn synth(spec: &str) -> Synth {
        Synth::parse(spec).unwrap()
    }

    #[test]
    fn the_right_image_warped_by_the_true_disparity_is_the_left_image() {
        for seed in [1, 4] {
            let synth = synth(&format!("seed={seed},frames=30,noise=0"));
            let index = 17;
            let T_world_cam = synth.trajectory.poses[index].T_world_cam;
            let frame = synth.frame(index).unwrap();
            let disparity = synth.true_disparity(index).unwrap().unwrap();
            let (w, h) = disparity.dimensions();
            let (mut error, mut seen, mut known, mut missed) = (0.0, 0, 0, 0);
            for (u, v) in (0..h).flat_map(|v| (0..w).map(move |u| (u, v))) {
                let d = f64::from(disparity[(u, v)].0[0]);
                let at = f64::from(u) - d;
                if d.is_nan() || at < 1.0 {
                    continue;
                }
                known += 1;
                // The right camera sees the same point there, or something before it; or, at an
                // edge that both rays graze, just misses it.
                let depth = synth.rig.depth(d);
                let hit = synth.look(&T_world_cam, synth.rig.baseline, at, f64::from(v));
                let there = hit.map_or(f64::INFINITY, |hit| hit.depth / depth);
                missed += u32::from(there > 1.0 + 1e-3);
                if (there - 1.0).abs() > 1e-3 {
                    continue;
                }
                seen += 1;
                let weights = cubic_weights(at.fract() as f32);
                for c in 0..3 {
                    let right: f32 = (0..4u32)
                        .map(|k| {
                            weights[k as usize]
                                * frame.right[((at as u32 + k - 1).min(w - 1), v)].0[c]
                        })
                        .sum();
                    error += f64::from((right - frame.left[(u, v)].0[c]).abs()) / 3.0;
                }
            }
            let error = error / f64::from(seen) * 255.0;
            assert!(missed < known / 1000, "{missed} of {known}");
            assert!(error < 1.0, "mean error {error} grey levels");
            assert!(
                f64::from(seen) > 0.95 * f64::from(known),
                "{seen} of {known}"
            );
            assert!(f64::from(known) > 0.75 * f64::from(w * h), "{known}");
        }
    }

    #[test]
    fn disparity_back_projects_onto_the_ground_along_the_trajectory() {
        let synth = synth("seed=9,frames=300,width=128,height=96");
        for index in [0, 150, 299] {
            let T_world_cam = synth.true_trajectory().unwrap().poses[index].T_world_cam;
            let disparity = synth.true_disparity(index).unwrap().unwrap();
            let mut near = 0;
            for (u, v, d) in disparity
                .enumerate_pixels()
                .filter(|p| p.2.0[0].is_finite())
            {
                let at = StereoPoint {
                    u: f64::from(u),
                    v: f64::from(v),
                    d: f64::from(d.0[0]),
                };
                let p_cam = synth.rig.back_project(at).unwrap();
                let p_world = T_world_cam * p_cam;
                let above = p_world.z - synth.ground_height(p_world.x, p_world.y);
                assert!(
                    above.abs() < 2e-5 * p_cam.z.max(1.0),
                    "{above} at {} m",
                    p_cam.z
                );
                near += usize::from(d.0[0] > 1.0);
            }
            // At a third of the default width, a third of the default disparity.
            assert!(near > 128 * 96 * 7 / 10, "{near}");
        }
    }

    #[test]
    fn the_rover_drives_on_and_looks_down_at_the_ground() {
        let synth = synth("seed=2,frames=700,width=32,height=32");
        let poses = &synth.true_trajectory().unwrap().poses;
        for (a, b) in poses.iter().zip(&poses[1..]) {
            let T_a_b = a.T_world_cam.inverse() * b.T_world_cam;
            assert!(
                (0.04..0.13).contains(&T_a_b.translation.vector.norm()),
                "{T_a_b}"
            );
            assert!(T_a_b.rotation.angle() < 0.06, "{}", T_a_b.rotation.angle());
            assert!((b.time - a.time - INTERVAL).abs() < 1e-9);
            let at = a.T_world_cam.translation.vector;
            let above = at.z - synth.ground_height(at.x, at.y);
            assert!((0.5..1.1).contains(&above), "{above}");
            let down = -(a.T_world_cam.rotation * Vector3::z()).z.asin();
            assert!((0.05..0.7).contains(&down), "{down}");
        }
    }

    #[test]
    fn a_seed_fixes_every_byte_and_another_changes_them() {
        let spec = "seed=5,frames=9,width=64,height=48";
        let (a, b, other) = (
            synth(spec),
            synth(spec),
            synth("seed=6,frames=9,width=64,height=48"),
        );
        // In another order, after other frames.
        let first = a.frame(7).unwrap();
        b.frame(8).unwrap();
        b.frame(0).unwrap();
        let again = b.frame(7).unwrap();
        assert_eq!((&first.left, &first.right), (&again.left, &again.right));
        assert_ne!(first.left, other.frame(7).unwrap().left);
        assert_ne!(first.left, a.frame(6).unwrap().left);
        assert_eq!(a.true_trajectory(), b.true_trajectory());
        assert!(a.frame(9).is_err() && a.true_disparity(9).is_err());
    }

    #[test]
    fn noise_has_the_deviation_asked_for() {
        let (clean, noisy) = (synth("noise=0,frames=1"), synth("noise=2,frames=1"));
        let (clean, noisy) = (clean.frame(0).unwrap(), noisy.frame(0).unwrap());
        let power = |a: &Rgb, b: &Rgb| {
            let middle = a
                .iter()
                .zip(b.iter())
                .filter(|(a, _)| (0.1..0.9).contains(*a));
            let (n, sum) = middle.fold((0.0, 0.0), |(n, s), (a, b)| {
                (n + 1.0, s + f64::from(a - b).powi(2))
            });
            (sum / n).sqrt() * 255.0
        };
        assert!((power(&clean.left, &noisy.left) - 2.0).abs() < 0.03);
        assert!((power(&clean.right, &noisy.right) - 2.0).abs() < 0.03);
        // Independent in the two images: the difference has twice the variance.
        let left = clean.left.iter().zip(noisy.left.iter()).map(|(a, b)| b - a);
        let right = clean
            .right
            .iter()
            .zip(noisy.right.iter())
            .map(|(a, b)| b - a);
        let (product, n) = left
            .zip(right)
            .fold((0.0, 0.0), |(p, n), (a, b)| (p + f64::from(a * b), n + 1.0));
        assert!((product / n).abs() * 255.0 * 255.0 < 0.05);
    }

    #[test]
    fn options_are_checked_by_name() {
        let defaults = synth("");
        assert_eq!(
            (defaults.len(), defaults.rig().width, defaults.rig().height),
            (60, 384, 288)
        );
        for (spec, named) in [
            ("sead=1", "sead"),
            ("frames=0", "frames"),
            ("frames", "frames"),
            ("width=7", "width"),
            ("height=99999", "height"),
            ("seed=-1", "seed"),
            ("noise=nan", "noise"),
        ] {
            let message = Synth::parse(spec)
                .err()
                .map(|e| e.to_string())
                .unwrap_or_default();
            assert!(
                message.contains(&format!("synth:{spec}: ")) && message.contains(named),
                "{message}"
            );
        }
    }
}
