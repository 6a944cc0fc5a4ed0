use std::f64::consts::FRAC_PI_2;

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
/// flat, round, angular, thin, with holes and in rows and twigs, before slanted walls over a slanted
/// floor. Every frame is another scene; cameras and truth are those of a rectified rig.
pub struct RandomScenes {
    options: Options,
    rig: RectifiedRig,
    materials: Vec<Texture<3>>,
    /// One wall without end a frame, and nothing else: see [`RandomScenes::planes`].
    only_walls: bool,
}

/// Side of the materials' textures.
const TEXELS: usize = 256;
const MATERIALS: usize = 48;
/// One material in so many is leaves upon leaves.
const LEAVES: usize = 3;

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
        let seeds: Vec<u32> = (0..MATERIALS).map(|_| rng.random()).collect();
        Ok(Self {
            materials: (seeds.into_par_iter().enumerate())
                .map(|(k, seed)| material(k, seed))
                .collect(),
            rig,
            options,
            only_walls: false,
        })
    }

    /// Flat walls for the study of a sensor's noise, one a frame: tilts of 0, 15, 30, 45 and 60 degrees at each of
    /// the distances, which go from a disparity of 20 % of the width to one of 2 %. The options are those of
    /// [`RandomScenes::parse`].
    ///
    /// # Errors
    /// When an option is unknown or out of range; the message names it.
    pub fn planes(spec: &str) -> Result<Self, DataError> {
        Ok(Self {
            only_walls: true,
            ..Self::parse(spec)?
        })
    }

    /// Scene `index`: from a stream of its own, so that none depends on another.
    fn shapes(&self, index: usize) -> Result<(Shapes<'_>, ChaCha8Rng), DataError> {
        if index >= self.len() {
            return Err(no_frame(index, self.len()));
        }
        let mut rng = ChaCha8Rng::seed_from_u64(self.options.seed);
        rng.set_stream(index as u64);
        let shapes = match self.only_walls {
            true => Shapes::wall(&self.rig, &self.materials, index, self.len(), &mut rng),
            false => Shapes::random(&self.rig, &self.materials, &self.options, &mut rng),
        };
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
    /// How much of the material's contrast is left; what goes is replaced by grey.
    contrast: f32,
    tint: Vector3<f32>,
}

enum Body {
    /// The plane across the third axis, cut to a rectangle or an ellipse of half sizes; without end.
    Rectangle(f64, f64),
    Ellipse(f64, f64),
    /// A rectangle with a window of this share of its sizes.
    Frame(f64, f64, f64),
    /// A leaf: radius, lobes, depth of the lobes as a share.
    Leaf(f64, f64, f64),
    Plane,
    /// Half axes.
    Ellipsoid(Vector3<f64>),
    /// About the third axis: radius and half length, without caps.
    Pipe(f64, f64),
    /// About the third axis, its tip in the centre: radius at the base and height, without a base.
    Cone(f64, f64),
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
            Body::Frame(w, h, window) => flat(&|x, y| {
                let (x, y) = (x.abs() / w, y.abs() / h);
                x < 1.0 && y < 1.0 && (x > *window || y > *window)
            })?,
            Body::Leaf(radius, lobes, depth) => flat(&|x, y| {
                let rim = radius * (1.0 - depth * (0.5 + 0.5 * (lobes * y.atan2(x)).cos()));
                x * x + y * y < rim * rim
            })?,
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
            Body::Cone(radius, height) => {
                let slope = (radius / height).powi(2);
                let squared =
                    |a: &Vector3<f64>, b: &Vector3<f64>| a.xy().dot(&b.xy()) - slope * a.z * b.z;
                let within = |t: f64| (0.0..*height).contains(&(o.z + d.z * t));
                first_root(squared(&d, &d), squared(&o, &d), squared(&o, &o), within)?
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
            Body::Plane
            | Body::Rectangle(..)
            | Body::Ellipse(..)
            | Body::Frame(..)
            | Body::Leaf(..) => (z, p.xy(), [x, y]),
            Body::Ellipsoid(size) => {
                let n = p.component_div(size).component_div(size).normalize();
                projected(self.axes * n)
            }
            Body::Pipe(radius, _) => {
                let out = (x * p.x + y * p.y) / *radius;
                let around = z.cross(&out);
                (out, Vector2::new(p.y.atan2(p.x) * radius, p.z), [around, z])
            }
            Body::Cone(radius, height) => {
                let out = Vector3::new(p.x, p.y, -p.z * (radius / height).powi(2)).normalize();
                projected(self.axes * out)
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

/// Where and how shapes are put.
struct Stage<'a> {
    rig: &'a RectifiedRig,
    /// Depths of the middle of the wall and of the nearest shape, metres.
    wall: f64,
    nearest: f64,
    /// How far below the cameras the floor is, where there is one.
    floor: Option<f64>,
    /// As [`Options::clutter`].
    clutter: f64,
    rng: &'a mut ChaCha8Rng,
}

impl Stage<'_> {
    /// Metres that so many pixels cover at a depth.
    fn pixels(&self, z: f64, pixels: f64) -> f64 {
        z / self.rig.fx * pixels
    }

    /// A place in the picture, a little beyond its borders; as many at each disparity.
    fn place(&mut self) -> Vector3<f64> {
        let share: f64 = self.rng.random_range(0.0..1.0);
        let z = 1.0 / ((1.0 - share) / self.wall + share / self.nearest);
        let [x, y] = [self.rig.width, self.rig.height]
            .map(|n| n as f64 * self.rng.random_range(-0.55..0.55));
        Vector3::new(self.pixels(z, x), self.pixels(z, y), z)
    }

    /// A turn about any axis, by up to `most` radians.
    fn turn(&mut self, most: f64) -> UnitQuaternion<f64> {
        let axis = Vector3::from_fn(|_, _| self.rng.random_range(-1.0..1.0));
        let angle = self.rng.random_range(0.0..most);
        UnitQuaternion::from_scaled_axis(axis.normalize() * angle)
    }

    /// A body in a material of its own.
    fn paint(&mut self, body: Body, centre: Vector3<f64>, axes: UnitQuaternion<f64>) -> Shape {
        let radius = match &body {
            Body::Plane => f64::INFINITY,
            Body::Rectangle(w, h) | Body::Frame(w, h, _) => w.hypot(*h),
            Body::Ellipse(w, h) => w.max(*h),
            Body::Leaf(radius, ..) => *radius,
            Body::Ellipsoid(size) => size.max(),
            Body::Pipe(r, half) => r.hypot(*half),
            Body::Cone(r, height) => r.hypot(*height),
            Body::Faces(rock) => rock.radius,
        };
        let rng = &mut *self.rng;
        let bright = rng.random_range(0.15..1.2f32);
        // Half of the shapes are all but grey.
        let colourful = if rng.random_bool(0.5 * self.clutter) {
            0.06
        } else {
            0.4
        };
        Shape {
            body,
            centre,
            radius,
            axes: axes.to_rotation_matrix().into_inner(),
            material: match rng.random_range(0..MATERIALS) {
                // Leaves, which have texture everywhere.
                any if self.clutter == 0.0 => any - any % LEAVES,
                any => any,
            },
            // A texel is a quarter of a pixel up to four, seen at the shape's depth.
            texel: centre.z.max(0.5) / self.rig.fx * 4f64.powf(rng.random_range(-1.0..1.0)),
            // Every sixth is nearly uniform.
            contrast: match rng.random_bool(0.17 * self.clutter) {
                true => rng.random_range(0.02..0.2),
                false => rng.random_range(1.0 - 0.65 * self.clutter as f32..1.01),
            },
            tint: Vector3::from_fn(|_, _| bright * rng.random_range(1.0 - colourful..1.0)),
        }
    }

    /// A body by itself.
    fn single(&mut self) -> Shape {
        let mut centre = self.place();
        let z = centre.z;
        // Small ones are as many as large ones at each doubling.
        let pixels = self.rig.width as f64
            * 0.24
            * (4.0 + 8.0 * self.clutter).powf(self.rng.random_range(-1.0..0.0));
        let size = self.pixels(z, pixels);
        let [a, b, c] = std::array::from_fn(|_| size * self.rng.random_range(0.4..1.0));
        if let Some(floor) = self.floor
            && self.rng.random_bool(0.5)
        {
            centre.y = floor - c;
        }
        let rng = &mut *self.rng;
        let body = match rng.random_range(0..10) {
            0 | 1 => Body::Rectangle(a, b),
            2 => Body::Ellipse(a, b),
            3 => Body::Frame(a, b, rng.random_range(0.5..0.95)),
            4 => Body::Leaf(a, rng.random_range(2..8).into(), rng.random_range(0.2..0.9)),
            5 => Body::Ellipsoid(Vector3::new(a, b, c)),
            // Thin: one to eight pixels.
            6 => Body::Pipe(
                z / self.rig.fx * 8f64.powf(rng.random_range(-0.33..0.67)),
                3.0 * size,
            ),
            7 => Body::Pipe(0.4 * a, 1.5 * b),
            8 => Body::Cone(0.5 * a, 2.0 * b),
            _ => Body::Faces(Rock::random(Point3::origin(), Vector3::new(a, b, c), rng)),
        };
        let axes = match &body {
            // Rather facing the cameras than edge on.
            Body::Rectangle(..) | Body::Ellipse(..) | Body::Frame(..) | Body::Leaf(..) => {
                self.turn(1.1)
            }
            // Standing, rather.
            Body::Cone(..) if self.rng.random_bool(0.7) => {
                let upright = Rotation3::from_axis_angle(&Vector3::x_axis(), -FRAC_PI_2);
                self.turn(0.3) * UnitQuaternion::from_rotation_matrix(&upright)
            }
            _ => self.turn(3.1),
        };
        self.paint(body, centre, axes)
    }

    /// A large body with next to no texture: only its outline and its shading tell where it is.
    fn bare(&mut self) -> Shape {
        let centre = self.place();
        let size = self.pixels(centre.z, self.rig.width as f64);
        let [a, b] =
            std::array::from_fn(|_| 0.12 * size * 3.75f64.powf(self.rng.random_range(0.0..1.0)));
        let c = a.min(b) * self.rng.random_range(0.3..0.8);
        let body = match self.rng.random_range(0..4) {
            0 => Body::Rectangle(a, b),
            1 => Body::Ellipsoid(Vector3::new(a, b, c)),
            _ => Body::Faces(Rock::random(
                Point3::origin(),
                Vector3::new(a, b, c),
                self.rng,
            )),
        };
        let axes = self.turn(0.9);
        Shape {
            contrast: self.rng.random_range(0.0..0.08),
            ..self.paint(body, centre, axes)
        }
    }

    /// Many alike, in a row as bars of a fence: the background is seen between them.
    fn fence(&mut self) -> Vec<Shape> {
        let centre = self.place();
        let unit = self.pixels(centre.z, 1.0);
        let (thick, length) = (
            unit * self.rng.random_range(1.0..6.0),
            unit * self.rng.random_range(20.0..90.0),
        );
        let step = thick * self.rng.random_range(2.5..6.0);
        let axes = self.turn(1.0);
        let across = axes * Vector3::x() * step;
        let count = self.rng.random_range(3..12);
        let first = self.paint(Body::Plane, centre, axes);
        let bar = |k: i32| {
            let centre = centre + across * f64::from(k - count / 2);
            Shape {
                body: Body::Rectangle(thick / 2.0, length),
                centre,
                radius: length.hypot(thick),
                ..first
            }
        };
        (0..count).map(bar).collect()
    }

    /// A twig that turns and forks as it grows.
    fn twig(&mut self) -> Vec<Shape> {
        let root = self.place();
        let unit = self.pixels(root.z, 1.0);
        let bark = self.paint(Body::Plane, root, UnitQuaternion::identity());
        let mut tips = vec![(root, self.turn(3.1), unit * self.rng.random_range(1.0..4.0))];
        let mut shapes = Vec::new();
        while let Some((from, axes, thick)) = tips.pop() {
            let half = unit * self.rng.random_range(5.0..16.0);
            let along = axes * Vector3::z() * half;
            shapes.push(Shape {
                body: Body::Pipe(thick, half),
                centre: from + along,
                radius: half.hypot(thick),
                axes: axes.to_rotation_matrix().into_inner(),
                ..bark
            });
            if shapes.len() + tips.len() >= 12 {
                continue;
            }
            for _ in 0..self.rng.random_range(1..=2) {
                let turn = self.turn(0.9);
                tips.push((from + along * 2.0, turn * axes, thick * 0.8));
            }
        }
        shapes
    }
}

impl<'a> Shapes<'a> {
    /// Wall `index` of `count`; see [`RandomScenes::planes`].
    fn wall(
        rig: &RectifiedRig,
        materials: &'a [Texture<3>],
        index: usize,
        count: usize,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        const TILTS: usize = 5;
        let rows = count.div_ceil(TILTS);
        let farther = (index / TILTS) as f64 / rows.saturating_sub(1).max(1) as f64;
        let distance = rig.fx * rig.baseline / (0.2 * 0.1f64.powf(farther) * rig.width as f64);
        let tilt = (15.0 * (index % TILTS) as f64).to_radians();
        // About the image's horizontal axis, in which it sees less: 60 degrees do not reach the horizon.
        let up = if rng.random_bool(0.5) { tilt } else { -tilt };
        Self {
            shapes: vec![Shape {
                body: Body::Plane,
                centre: Vector3::new(0.0, 0.0, distance),
                radius: f64::INFINITY,
                axes: *Rotation3::from_axis_angle(&Vector3::x_axis(), up).matrix(),
                material: LEAVES * rng.random_range(0..MATERIALS / LEAVES),
                texel: distance / rig.fx * rng.random_range(0.7..1.5),
                contrast: 1.0,
                tint: Vector3::repeat(1.0),
            }],
            materials,
            to_lamp: -Vector3::z(),
            ambient: 0.5,
        }
    }

    fn random(
        rig: &RectifiedRig,
        materials: &'a [Texture<3>],
        options: &Options,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let clutter = options.clutter;
        let most = |least: u32, all: u32| least + (f64::from(all - least) * clutter).round() as u32;
        // Depths by disparity: the wall at 0.5 to 6 % of the width, shapes up to 28 %.
        let depth = |share: f64| rig.fx * rig.baseline / (share * rig.width as f64);
        let wall = depth(0.005 * 12f64.powf(rng.random_range(0.0..1.0)));
        let floor = rng.random_bool(0.7);
        let floor = floor.then(|| rng.random_range(0.15..0.5) * wall);
        let mut stage = Stage {
            rig,
            wall,
            nearest: depth(0.28),
            floor,
            clutter,
            rng,
        };

        let mut shapes = Vec::new();
        // Walls without end meet in corners.
        for k in 0..stage.rng.random_range(1..most(2, 4)) {
            let away = if k == 0 {
                1.0
            } else {
                stage.rng.random_range(0.7..1.4)
            };
            let turn = stage.turn(0.8);
            shapes.push(stage.paint(Body::Plane, Vector3::new(0.0, 0.0, wall * away), turn));
        }
        if let Some(floor) = floor {
            let level = Rotation3::from_axis_angle(&Vector3::x_axis(), FRAC_PI_2);
            let axes = stage.turn(0.15) * UnitQuaternion::from_rotation_matrix(&level);
            shapes.push(stage.paint(Body::Plane, Vector3::new(0.0, floor, wall / 2.0), axes));
        }
        for _ in 0..stage.rng.random_range(5..most(9, 40)) {
            shapes.push(stage.single());
        }
        for _ in 0..stage.rng.random_range(0..most(1, 3)) {
            shapes.extend(stage.fence());
        }
        for _ in 0..stage.rng.random_range(0..most(1, 4)) {
            shapes.extend(stage.twig());
        }
        if options.bare > 0 {
            for _ in 0..stage.rng.random_range(1..=options.bare) {
                shapes.push(stage.bare());
            }
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
        let paint = paint.map(|v| 0.4 + (v - 0.4) * shape.contrast);
        let lit = normal.cast::<f32>().dot(&self.to_lamp).max(0.0) * (1.0 - self.ambient);
        Vector3::from(paint).component_mul(&shape.tint) * (self.ambient + lit)
    }
}

/// One of the kinds of material: noise of every size, fine noise, stripes, tiles, spots, or nearly
/// nothing, in two colours; and every third time leaves upon leaves.
fn material(kind: usize, seed: u32) -> Texture<3> {
    let mut rng = ChaCha8Rng::seed_from_u64(u64::from(seed));
    if kind.is_multiple_of(LEAVES) {
        return Texture::new(TEXELS, true, fallen_leaves(&mut rng));
    }
    let kind = kind - kind / LEAVES - 1;
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

/// Discs and bars of every size and colour, one upon the other: as many edges of every length as
/// photographs have (Lee 2001, "Occlusion models for natural images"), and none of them an edge of depth.
fn fallen_leaves(rng: &mut ChaCha8Rng) -> Vec<[f32; 3]> {
    let side = TEXELS as i32;
    let grey = rng.random_range(0.0..1.0f32);
    let spread = rng.random_range(0.3..1.0f32);
    let mut image = vec![[0.4; 3]; TEXELS * TEXELS];
    for _ in 0..1500 {
        // Sizes by the inverse cube, which looks alike at every distance.
        let share: f32 = rng.random_range(0.0..1.0);
        let (least, most) = (1.5f32, 60.0f32);
        let radius = 1.0 / (share / least.powi(2) + (1.0 - share) / most.powi(2)).sqrt();
        let [cx, cy] = std::array::from_fn(|_| rng.random_range(0.0..side as f32));
        let flat = rng.random_range(0.15..1.0f32);
        let (sin, cos) = rng.random_range(0.0..std::f32::consts::PI).sin_cos();
        let square = rng.random_bool(0.5);
        let bright: f32 = 0.45 + spread * rng.random_range(-0.45..0.45f32);
        let colour: [f32; 3] = std::array::from_fn(|_| {
            let own = rng.random_range(0.0..0.9f32);
            bright * grey + own * (1.0 - grey)
        });
        let grain = rng.random_range(0.0..0.12f32);
        let reach = (radius * 1.5).ceil() as i32;
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let (fx, fy) = (dx as f32, dy as f32);
                let (x, y) = (
                    (fx * cos + fy * sin) / radius,
                    (fy * cos - fx * sin) / (radius * flat),
                );
                let inside = if square {
                    x.abs().max(y.abs()) < 1.0
                } else {
                    x * x + y * y < 1.0
                };
                if inside {
                    let wrap = |c: f32, d: i32| (c as i32 + d).rem_euclid(side) as usize;
                    let noise = grain * rng.random_range(-1.0..1.0f32);
                    image[wrap(cy, dy) * TEXELS + wrap(cx, dx)] =
                        colour.map(|c| (c + noise).clamp(0.0, 1.0));
                }
            }
        }
    }
    image
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
