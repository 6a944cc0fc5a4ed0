use barchan_geometry::{RectifiedRig, Se3};
use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector2, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

use super::NEAR;
use super::camera::{Sensor, Shot};
use super::noise::add_noise;
use super::options::Options;
use super::render::{self, Look, Scene, View};
use super::rocks::Rock;
use super::straight_rig;
use super::surface::Hit;
use super::texture::{Footprint, Texture, wrapped};
use crate::pairs::no_frame;
use crate::{DataError, Plane, Rgb, StereoFrame, StereoSource};

/// Random scenes with exact disparity of both views, for pretraining: floating and standing shapes,
/// flat, round, angular and thin, before a slanted wall over a slanted floor. Every frame is another
/// scene; cameras and truth are those of a rectified rig.
pub struct RandomScenes {
    options: Options,
    rig: RectifiedRig,
    materials: Vec<Texture<3>>,
}

/// Side of the materials' textures.
const TEXELS: usize = 256;

impl RandomScenes {
    /// Reads `seed=1,frames=60,width=384,height=288,baseline=0.12,noise=1`, each optional.
    ///
    /// # Errors
    /// When an option is unknown or out of range; the message names it.
    pub fn parse(spec: &str) -> Result<Self, DataError> {
        let options = Options::parse(spec, true)?;
        let rig = straight_rig(&options);
        let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
        rng.set_stream(u64::MAX);
        let seeds: Vec<u32> = (0..16).map(|_| rng.random()).collect();
        Ok(Self {
            materials: (seeds.into_par_iter().enumerate())
                .map(|(k, seed)| material(k, seed))
                .collect(),
            rig,
            options,
        })
    }

    /// Scene `index`: from a stream of its own, so that none depends on another.
    fn shapes(&self, index: usize) -> Result<(Shapes<'_>, ChaCha8Rng), DataError> {
        if index >= self.len() {
            return Err(no_frame(index, self.len()));
        }
        let mut rng = ChaCha8Rng::seed_from_u64(self.options.seed);
        rng.set_stream(index as u64);
        let shapes = Shapes::random(&self.rig, &self.materials, &mut rng);
        Ok((shapes, rng))
    }

    fn truth(&self, index: usize, shift: f64) -> Result<Option<Plane>, DataError> {
        let (shapes, _) = self.shapes(index)?;
        let view = View::rectified(&self.rig, &Se3::identity(), shift);
        let scale = self.rig.fx * self.rig.baseline;
        let hits = render::hits(&shapes, &view);
        let disparities = hits
            .iter()
            .map(|hit| hit.map_or(f32::NAN, |h| (scale / h.t) as f32));
        Ok(Plane::from_raw(
            self.rig.width as u32,
            self.rig.height as u32,
            disparities.collect(),
        ))
    }
}

impl StereoSource for RandomScenes {
    fn rig(&self) -> &RectifiedRig {
        &self.rig
    }

    fn len(&self) -> usize {
        self.options.frames
    }

    fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
        let (shapes, mut rng) = self.shapes(index)?;
        // Every scene has cameras of its own; the noise asked for is the most.
        let mut camera = self.options.camera;
        camera.noise *= rng.random_range(0.0..1.0);
        camera.exposure = rng.random_range(0.5..1.6);
        camera.gain = rng.random_range(-0.05..0.05);
        camera.vignetting = rng.random_range(0.0..0.15);
        let (width, height) = (self.rig.width, self.rig.height);
        let sensor = Sensor::new(camera, self.options.seed, width, height);
        let light = |shift: f64| {
            let view = View::rectified(&self.rig, &Se3::identity(), shift);
            render::render(&shapes, &view)
        };
        let (left, right) = (light(0.0), light(self.rig.baseline));
        let exposure = sensor.meter(&left);
        let developed = |mut image: Vec<f32>, right: bool| {
            let shot = Shot {
                frame: index,
                right,
                exposure,
                sun: None,
            };
            sensor.develop(&mut image, shot);
            // Three values a pixel by construction.
            Rgb::from_raw(width as u32, height as u32, image).unwrap_or_default()
        };
        Ok(StereoFrame {
            index,
            name: self.name(index),
            time: index as f64,
            left: developed(left, false),
            right: developed(right, true),
        })
    }

    fn true_disparity(&self, index: usize) -> Result<Option<Plane>, DataError> {
        self.truth(index, 0.0)
    }

    fn true_disparity_right(&self, index: usize) -> Result<Option<Plane>, DataError> {
        self.truth(index, self.rig.baseline)
    }
}

/// A scene: shapes and a lamp.
struct Shapes<'a> {
    shapes: Vec<Shape>,
    materials: &'a [Texture<3>],
    to_lamp: Vector3<f32>,
    ambient: f32,
}

/// A body and its paint. Coordinates are those of the left camera.
struct Shape {
    body: Body,
    centre: Vector3<f64>,
    /// Nothing of the body is farther from the centre.
    radius: f64,
    /// The body's own axes in columns.
    axes: Matrix3<f64>,
    material: usize,
    /// Metres a texel.
    texel: f64,
    tint: Vector3<f32>,
}

enum Body {
    /// The plane across the third axis, cut to a rectangle or an ellipse of half sizes; without end.
    Rectangle(f64, f64),
    Ellipse(f64, f64),
    Plane,
    /// Half axes.
    Ellipsoid(Vector3<f64>),
    /// About the third axis: radius and half length, without caps.
    Pipe(f64, f64),
    Faces(Rock),
}

impl Shape {
    /// Where a ray meets the shape first: parameter and face.
    fn hit(&self, origin: &Vector3<f64>, ray: &Vector3<f64>) -> Option<(f64, u8)> {
        let from = origin - self.centre;
        if self.radius.is_finite() {
            let (a, b) = (ray.norm_squared(), from.dot(ray));
            if b * b < a * (from.norm_squared() - self.radius * self.radius) {
                return None;
            }
        }
        if let Body::Faces(rock) = &self.body {
            return rock.hit(&from, ray);
        }
        let (o, d) = (self.axes.tr_mul(&from), self.axes.tr_mul(ray));
        let flat = |inside: &dyn Fn(f64, f64) -> bool| {
            let t = -o.z / d.z;
            let p = o + d * t;
            (t.is_finite() && inside(p.x, p.y)).then_some(t)
        };
        let t = match &self.body {
            Body::Plane => flat(&|_, _| true)?,
            Body::Rectangle(w, h) => flat(&|x, y| x.abs() < *w && y.abs() < *h)?,
            Body::Ellipse(w, h) => flat(&|x, y| (x / w).powi(2) + (y / h).powi(2) < 1.0)?,
            Body::Ellipsoid(size) => {
                let (o, d) = (o.component_div(size), d.component_div(size));
                first_root(d.norm_squared(), o.dot(&d), o.norm_squared() - 1.0, |_| {
                    true
                })?
            }
            Body::Pipe(radius, half) => {
                let (o2, d2) = (o.xy(), d.xy());
                let c = o2.norm_squared() - radius * radius;
                let within = |t: f64| (o.z + d.z * t).abs() < *half;
                first_root(d2.norm_squared(), o2.dot(&d2), c, within)?
            }
            Body::Faces(_) => return None,
        };
        (t > NEAR).then_some((t, 0))
    }

    /// At a point of the shape (counted from its centre): the outward normal, and the position and
    /// axes of its paint.
    fn paint(
        &self,
        local: &Vector3<f64>,
        face: u8,
    ) -> (Vector3<f64>, Vector2<f64>, [Vector3<f64>; 2]) {
        let [x, y, z] = [0, 1, 2].map(|k| self.axes.column(k).into_owned());
        let p = self.axes.tr_mul(local);
        // On a bent or angular body the paint is projected along the axis that the normal is nearest to.
        let projected = |normal: Vector3<f64>| {
            let lean = self.axes.tr_mul(&normal).map(f64::abs).imax();
            let (a, b) = ((lean + 1) % 3, (lean + 2) % 3);
            let axes = [[x, y, z][a], [x, y, z][b]];
            (normal, Vector2::new(p[a], p[b]), axes)
        };
        match &self.body {
            Body::Plane | Body::Rectangle(..) | Body::Ellipse(..) => (z, p.xy(), [x, y]),
            Body::Ellipsoid(size) => {
                let n = p.component_div(size).component_div(size).normalize();
                projected(self.axes * n)
            }
            Body::Pipe(radius, _) => {
                let out = (x * p.x + y * p.y) / *radius;
                let around = z.cross(&out);
                (out, Vector2::new(p.y.atan2(p.x) * radius, p.z), [around, z])
            }
            Body::Faces(rock) => projected(rock.faces[face as usize].0),
        }
    }
}

/// The smaller positive root of `a t^2 + 2 b t + c` that is accepted.
fn first_root(a: f64, b: f64, c: f64, accept: impl Fn(f64) -> bool) -> Option<f64> {
    let root = (b * b - a * c).sqrt();
    // NaN compares false: no root, none found.
    [(-b - root) / a, (-b + root) / a]
        .into_iter()
        .find(|t| *t > NEAR && accept(*t))
}

impl<'a> Shapes<'a> {
    fn random(rig: &RectifiedRig, materials: &'a [Texture<3>], rng: &mut ChaCha8Rng) -> Self {
        // Depths by disparity: the wall at 1 to 4 % of the width, shapes up to a quarter of it.
        let depth = |share: f64| rig.fx * rig.baseline / (share * rig.width as f64);
        let wall = depth(rng.random_range(0.01..0.04));
        let nearest = depth(0.25);
        let turn = |rng: &mut ChaCha8Rng, most: f64| {
            let axis = Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0));
            let angle = rng.random_range(0.0..most);
            UnitQuaternion::from_scaled_axis(axis.normalize() * angle)
        };
        let paint =
            |body: Body, centre: Vector3<f64>, axes: UnitQuaternion<f64>, rng: &mut ChaCha8Rng| {
                let radius = match &body {
                    Body::Plane => f64::INFINITY,
                    Body::Rectangle(w, h) => w.hypot(*h),
                    Body::Ellipse(w, h) => w.max(*h),
                    Body::Ellipsoid(size) => size.max(),
                    Body::Pipe(r, half) => r.hypot(*half),
                    Body::Faces(rock) => rock.radius,
                };
                let bright = rng.random_range(0.25..1.0f32);
                Shape {
                    body,
                    centre,
                    radius,
                    axes: axes.to_rotation_matrix().into_inner(),
                    material: rng.random_range(0..materials.len()),
                    // A texel is a third of a pixel up to three, seen at the shape's depth.
                    texel: centre.z.max(0.5) / rig.fx * 3f64.powf(rng.random_range(-1.0..1.0)),
                    tint: Vector3::from_fn(|_, _| bright * rng.random_range(0.6..1.0f32)),
                }
            };

        let mut shapes = Vec::new();
        let wall_turn = turn(rng, 0.7);
        shapes.push(paint(
            Body::Plane,
            Vector3::new(0.0, 0.0, wall),
            wall_turn,
            rng,
        ));
        let floor = rng.random_range(0.15..0.5) * wall;
        let has_floor = rng.random_bool(0.7);
        if has_floor {
            let level = Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
            let axes = turn(rng, 0.15) * UnitQuaternion::from_rotation_matrix(&level);
            shapes.push(paint(
                Body::Plane,
                Vector3::new(0.0, floor, wall / 2.0),
                axes,
                rng,
            ));
        }
        for _ in 0..rng.random_range(6..22) {
            // As many shapes at each disparity.
            let share: f64 = rng.random_range(0.0..1.0);
            let z = 1.0 / ((1.0 - share) / wall + share / nearest);
            let across = |pixels: usize, f: f64, at: f64| z * pixels as f64 / f * at;
            let mut centre = Vector3::new(
                across(rig.width, rig.fx, rng.random_range(-0.55..0.55)),
                across(rig.height, rig.fy, rng.random_range(-0.55..0.55)),
                z,
            );
            let size = across(rig.width, rig.fx, rng.random_range(0.03..0.22));
            let mut axis = || size * rng.random_range(0.4..1.0);
            let (a, b, c) = (axis(), axis(), axis());
            if has_floor && rng.random_bool(0.5) {
                centre.y = floor - c;
            }
            let body = match rng.random_range(0..6) {
                0 => Body::Rectangle(a, b),
                1 => Body::Ellipse(a, b),
                2 => Body::Ellipsoid(Vector3::new(a, b, c)),
                // Thin: one to four pixels.
                3 => Body::Pipe(z / rig.fx * rng.random_range(0.5..2.0), 3.0 * size),
                4 => Body::Pipe(0.4 * a, 1.5 * b),
                _ => Body::Faces(Rock::random(Point3::origin(), Vector3::new(a, b, c), rng)),
            };
            let axes = match &body {
                // Rather facing the cameras than edge on.
                Body::Rectangle(..) | Body::Ellipse(..) => turn(rng, 1.1),
                _ => turn(rng, 3.1),
            };
            shapes.push(paint(body, centre, axes, rng));
        }
        let to_lamp = Vector3::new(
            rng.random_range(-1.0..1.0),
            rng.random_range(-1.0..0.3),
            rng.random_range(-1.0..-0.2f32),
        );
        Self {
            shapes,
            materials,
            to_lamp: to_lamp.normalize(),
            ambient: rng.random_range(0.15..0.6),
        }
    }
}

impl Scene for Shapes<'_> {
    fn clear_until(&self, _: &Point3<f64>, _: &[Vector3<f64>; 4]) -> f64 {
        NEAR
    }

    fn hit(&self, origin: &Point3<f64>, ray: &Vector3<f64>, near: f64) -> Option<Hit> {
        let mut best: Option<Hit> = None;
        for (id, shape) in self.shapes.iter().enumerate() {
            if let Some((t, face)) = shape.hit(&origin.coords, ray)
                && t > near
                && best.is_none_or(|best| t < best.t)
            {
                best = Some(Hit {
                    t,
                    body: Some((id as u32, face)),
                });
            }
        }
        best
    }

    fn light(&self, look: &Look, hit: Option<&Hit>) -> Vector3<f32> {
        let Some((t, (id, face))) = hit.and_then(|hit| Some((hit.t, hit.body?))) else {
            return Vector3::repeat(0.1);
        };
        let shape = &self.shapes[id as usize];
        let local = look.origin.coords + look.ray * t - shape.centre;
        let (outward, place, axes) = shape.paint(&local, face);
        let normal = if outward.dot(&look.ray) > 0.0 {
            -outward
        } else {
            outward
        };
        let towards = normal.dot(&look.ray).min(-0.02 * look.ray.norm());
        let [a, b] = look.steps.map(|step| {
            let along = (step - look.ray * (normal.dot(&step) / towards)) * (t / shape.texel);
            Vector2::new(along.dot(&axes[0]) as f32, along.dot(&axes[1]) as f32)
        });
        let at = (place / shape.texel).map(|v| wrapped(v, TEXELS as f64));
        let paint = self.materials[shape.material].mean(at, Footprint::new(a, b));
        let lit = normal.cast::<f32>().dot(&self.to_lamp).max(0.0) * (1.0 - self.ambient);
        Vector3::from(paint).component_mul(&shape.tint) * (self.ambient + lit)
    }
}

/// One of the kinds of material: noise of every size, fine noise, stripes, tiles, spots, or nearly
/// nothing; in two colours.
fn material(kind: usize, seed: u32) -> Texture<3> {
    let mut rng = ChaCha8Rng::seed_from_u64(u64::from(seed));
    let waves: &[(u32, f32)] = match kind % 4 {
        0 => &[(4, 1.2), (9, 1.2), (19, 1.2), (41, 1.2), (85, 1.2)],
        1 => &[(60, 2.0), (100, 2.0)],
        2 => &[(3, 2.0), (7, 1.0), (50, 0.5)],
        _ => &[(5, 0.3), (70, 0.35)],
    };
    let pattern = kind / 4 % 4;
    let (stripes, tilt) = (rng.random_range(4..24), rng.random_range(0..3));
    let mut image = vec![0.0f32; TEXELS * TEXELS];
    for (j, row) in image.chunks_exact_mut(TEXELS).enumerate() {
        for (k, (waves, amplitude)) in waves.iter().enumerate() {
            add_noise(row, j, *waves, *amplitude, seed.wrapping_add(k as u32));
        }
        for (i, v) in row.iter_mut().enumerate() {
            let (x, y) = (i as f32 / TEXELS as f32, j as f32 / TEXELS as f32);
            // Whole waves a side, so that it repeats; slopes of a few texels, so that it is smooth.
            let wave = |phase: f32| (4.0 * (phase * std::f32::consts::TAU).sin()).clamp(-1.0, 1.0);
            let across = stripes as f32 * x + (tilt * stripes / 2) as f32 * y + 0.3 * *v;
            *v += match pattern {
                1 => 0.6 * wave(across),
                2 => 0.6 * wave(stripes as f32 * x) * wave(stripes as f32 * y),
                3 => f32::from(u8::from(*v > 0.45)),
                _ => 0.0,
            };
        }
    }
    let mut colour = || Vector3::from_fn(|_, _| rng.random_range(0.02..0.9f32));
    let (dark, bright) = (colour() * 0.4, colour());
    let painted = |v: f32| {
        let share = (0.5 + 0.4 * v).clamp(0.0, 1.0);
        (dark * (1.0 - share) + bright * share).into()
    };
    Texture::new(TEXELS, true, image.into_iter().map(painted).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warping_by_either_truth_gives_the_other_image() {
        let scenes = RandomScenes::parse("seed=2,frames=12,width=256,height=192,noise=0").unwrap();
        let (mut error, mut seen) = (0.0, 0.0);
        for index in 0..12 {
            let frame = scenes.frame(index).unwrap();
            let left = scenes.true_disparity(index).unwrap().unwrap();
            let right = scenes.true_disparity_right(index).unwrap().unwrap();
            let mut spread = Vec::new();
            for (u, v, d) in left.enumerate_pixels() {
                let at = u as f32 - d.0[0];
                if at.is_nan() || at < 0.0 || at + 1.0 >= 255.0 {
                    continue;
                }
                let (x, share) = (at as u32, at.fract());
                let [a, b] = [0, 1].map(|k| right[(x + k, v)].0[0]);
                // Seen by both, away from outlines: the right image's truth leads back.
                if (a - b).abs() > 0.5 || (a * (1.0 - share) + b * share - d.0[0]).abs() > 0.1 {
                    continue;
                }
                let green = |x: u32| frame.right[(x, v)].0[1];
                let warped = green(x) * (1.0 - share) + green(x + 1) * share;
                error += (warped - frame.left[(u, v)].0[1]).abs() * 255.0;
                seen += 1.0;
                spread.push(d.0[0]);
            }
            spread.sort_by(f32::total_cmp);
            assert!(spread.len() > 256 * 192 / 3, "{index}: {}", spread.len());
        }
        println!("{} grey levels", error / seen);
        // The cameras differ by up to 5 % in gain.
        assert!(error / seen < 6.0, "{}", error / seen);
    }

    #[test]
    fn scenes_differ_and_come_again_with_their_seed() {
        let open = |spec: &str| RandomScenes::parse(spec).unwrap();
        let (a, b) = (
            open("seed=3,width=64,height=48"),
            open("seed=3,width=64,height=48"),
        );
        let first = a.frame(5).unwrap();
        b.frame(1).unwrap();
        let again = b.frame(5).unwrap();
        assert_eq!((&first.left, &first.right), (&again.left, &again.right));
        assert_ne!(first.left, a.frame(6).unwrap().left);
        assert_ne!(
            first.left,
            open("seed=4,width=64,height=48").frame(5).unwrap().left
        );
        assert!(a.frame(60).is_err() && a.true_disparity(60).is_err());
        assert!(RandomScenes::parse("mast=2").is_err());
    }
}
