use nalgebra::{Matrix2, Point3, Vector2, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

use super::light::{Light, shadows};
use super::noise::add_noise;
use super::options::Options;
use super::render::Look;
use super::rocks::{Rock, Rocks};
use super::surface::Surface;
use super::texture::{Footprint, Texture, wrapped};

/// What the ground and the rocks look like: grain, gravel, patches, shadows.
pub(super) struct Skin {
    /// For each node of the surface: its slopes along x and y, how it lies to the shadows, and how
    /// much gravel there is.
    lie: Texture<4>,
    grain: Texture<1>,
    gravel: Texture<1>,
    /// Contrast of the grain.
    contrast: f32,
}

/// Side of the grain textures, and the metres of a texel in each use of them.
const GRAIN: usize = 1024;
const FINE: f32 = 0.0023;
const COARSE: f32 = 0.0171;
const GRAVEL: f32 = 0.0029;

impl Skin {
    pub fn new(surface: &Surface, rocks: &Rocks, light: &Light, options: &Options) -> Self {
        let seed = options.seed as u32;
        Self {
            lie: lie(surface, rocks, light, seed),
            grain: grain(seed, light.along()),
            gravel: gravel(seed, light.along()),
            contrast: options.texture,
        }
    }

    /// Light from the ground at a point `depth` along a look, averaged over the pixel.
    pub fn ground(
        &self,
        surface: &Surface,
        light: &Light,
        look: &Look,
        depth: f64,
        point: &Point3<f64>,
    ) -> Vector3<f32> {
        let exact = surface.normal(point.x, point.y);
        let over = footprint(look, depth, &exact).map(|step| step.xy().cast::<f32>());
        let over = Footprint::new(over[0], over[1]);
        let cell = surface.cell as f32;
        let (u, v) = surface.cells(point.x, point.y);
        let node = Vector2::new(u, v).map(|c| wrapped(c, surface.side as f64));
        let [slope_x, slope_y, shadow, gravel] = self.lie.mean(node, over.scaled(1.0 / cell));

        // Seen closely the surface's own normal, from afar the mean of the slopes in the pixel.
        let afar = ((over.major.norm() / cell - 0.5) / 0.5).clamp(0.0, 1.0);
        let mean = Vector3::new(-slope_x, -slope_y, 1.0).normalize();
        let normal = (exact.cast::<f32>() * (1.0 - afar) + mean * afar).normalize();
        // The shadow's edge is sharp within a cell when seen closely; from afar its share counts.
        let width = 0.35 + 0.65 * afar;
        let sunlit = (0.5 - 0.5 * shadow / width).clamp(0.0, 1.0);

        // The same grain twice, turned and at incommensurate scales: together it does not repeat.
        let place = Vector2::new(point.x, point.y);
        let [fine] = self.grain.mean(texel(place, FINE), over.scaled(1.0 / FINE));
        let (s, c) = 0.65f32.sin_cos();
        let turn = Matrix2::new(c, s, -s, c);
        let turned = Footprint {
            major: turn * over.major,
            minor: over.minor,
        };
        let at = texel(turn.cast::<f64>() * place, COARSE);
        let [coarse] = self.grain.mean(at, turned.scaled(1.0 / COARSE));
        let mut tone = 1.0 + self.contrast * light.grain * (0.22 * fine + 0.16 * coarse);
        let share = light.gravel * gravel;
        if share > 0.02 {
            let [stones] = self
                .gravel
                .mean(texel(place, GRAVEL), over.scaled(1.0 / GRAVEL));
            tone += 1.5 * share * stones;
        }
        // Contrast as the eye has it: the square undoes most of the camera's response curve.
        let albedo = light.sand * tone.max(0.1).powi(2);
        light.reflected(&albedo, &normal, sunlit, &to_eye(look, point))
    }

    /// Light from a rock: `local` is counted from its middle.
    pub fn rock(
        &self,
        rock: &Rock,
        face: u8,
        local: &Vector3<f64>,
        sunlit: f32,
        light: &Light,
        look: &Look,
        depth: f64,
    ) -> Vector3<f32> {
        let flat = rock.faces[face as usize].0;
        // The grain is laid on the face along the two axes that it leans to least; every rock cuts
        // out its own piece.
        let lean = flat.map(f64::abs).imax();
        let (a, b) = ((lean + 1) % 3, (lean + 2) % 3);
        let flatten = |p: &Vector3<f64>| Vector2::new(p[a], p[b]);
        let over = footprint(look, depth, &flat).map(|step| flatten(&step).cast::<f32>());
        let over = Footprint::new(over[0], over[1]);
        let own = Vector2::new(rock.radius * 977.0, rock.brightness * 31.0);
        let place = flatten(local) + own;
        let [fine] = self.grain.mean(texel(place, FINE), over.scaled(1.0 / FINE));
        let metres = 3.1 * FINE;
        let [coarse] = self
            .grain
            .mean(texel(place, metres), over.scaled(1.0 / metres));

        // Edges are worn: towards a neighbouring face the normal turns to it.
        let worn = (0.07 * rock.radius) as f32;
        let mut normal = Vector3::zeros();
        for (n, c) in &rock.faces {
            let away = (c - n.dot(local)) as f32 / worn;
            normal += n.cast::<f32>() / (1.0 + away * away * away * away);
        }
        // Roughness tilts it as well.
        let tilt = Vector3::new(fine, coarse, fine - coarse) * 0.06;
        let normal = (normal.normalize() + tilt).normalize();
        let tone = rock.brightness as f32 * (1.0 + 0.16 * fine + 0.22 * coarse).max(0.1);
        let to_eye = to_eye(look, &(look.origin + look.ray * depth));
        light.reflected(&(light.stone * tone * tone), &normal, sunlit, &to_eye)
    }
}

/// Positions in a grain texture wrap: they are reduced in f64 first, or far from the origin they blur.
fn texel(place: Vector2<f64>, metres: f32) -> Vector2<f32> {
    let side = GRAIN as f64;
    place.map(|v| wrapped(v / f64::from(metres), side))
}

fn to_eye(look: &Look, point: &Point3<f64>) -> Vector3<f32> {
    (look.eye - point).normalize().cast::<f32>()
}

/// What a pixel covers of a face with a normal: the steps along it to the pixel's ends (ray
/// differentials, Igehy 1999).
fn footprint(look: &Look, depth: f64, normal: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let towards = normal.dot(&look.ray).min(-1e-3);
    look.steps
        .map(|step| (step - look.ray * (normal.dot(&step) / towards)) * depth)
}

/// See [`Skin::lie`].
fn lie(surface: &Surface, rocks: &Rocks, light: &Light, seed: u32) -> Texture<4> {
    let side = surface.side;
    let shadow = shadows(surface, rocks, &light.to_sun);
    let mut cover = vec![0.5; side * side];
    cover.par_chunks_mut(side).enumerate().for_each(|(j, row)| {
        for (waves, amplitude) in [(7, 2.0), (23, 1.5), (61, 1.0)] {
            let waves = waves.min(side as u32 / 4).max(1);
            add_noise(row, j, waves, amplitude, seed.wrapping_add(400 + waves));
        }
    });
    let control = &surface.control;
    let at = |k: usize| {
        let (i, j) = ((k % side) as i32, (k / side) as i32);
        let half = 0.5 / surface.cell as f32;
        let slope = |a: (i32, i32), b: (i32, i32)| {
            (control[surface.node(i + b.0, j + b.1)] - control[surface.node(i + a.0, j + a.1)])
                * half
        };
        [
            slope((-1, 0), (1, 0)),
            slope((0, -1), (0, 1)),
            shadow[k],
            cover[k].clamp(0.0, 1.0),
        ]
    };
    Texture::new(
        side,
        false,
        (0..side * side).into_par_iter().map(at).collect(),
    )
}

/// A square of noise of the grain's side: octaves of waves and amplitude.
fn octaves(octaves: &[(u32, f32)], seed: u32) -> Vec<f32> {
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
}

/// The relief lit from the side: a slope that rises along the light faces the sun.
fn lit(relief: &[f32], k: usize, along: Vector2<f32>) -> f32 {
    let (i, j) = (k % GRAIN + GRAIN, k / GRAIN + GRAIN);
    let height = |i: usize, j: usize| relief[(j % GRAIN) * GRAIN + i % GRAIN];
    let slope_x = height(i + 1, j) - height(i - 1, j);
    let slope_y = height(i, j + 1) - height(i, j - 1);
    along.x * slope_x + along.y * slope_y
}

/// Grains and patches with as much contrast at every size, of mean about 0 and standard deviation
/// about 1; the finest lit from the side as relief.
fn grain(seed: u32, along: Vector2<f32>) -> Texture<1> {
    let relief = octaves(
        &[(256, 4.0), (128, 8.0), (64, 16.0)],
        seed.wrapping_add(200),
    );
    let patches = octaves(
        &[(200, 1.7), (96, 1.7), (47, 1.7), (23, 1.7), (11, 1.7)],
        seed.wrapping_add(300),
    );
    let value = |k: usize| [patches[k] + 0.45 * lit(&relief, k, along)];
    Texture::new(
        GRAIN,
        true,
        (0..GRAIN * GRAIN).into_par_iter().map(value).collect(),
    )
}

/// Pebbles of 1 to 5 cm, each with its own brightness and a lit and a dark side, and their small
/// shadows; mean about 0.
fn gravel(seed: u32, along: Vector2<f32>) -> Texture<1> {
    let mut rng = ChaCha8Rng::seed_from_u64(u64::from(seed) ^ 0x6e4e1);
    let mut tone = vec![0.0f32; GRAIN * GRAIN];
    for _ in 0..9000 {
        let centre = Vector2::from_fn(|_, _| rng.random_range(0.0..GRAIN as f32));
        let radius = 1.7 * rng.random_range(0.03f32..1.0).powf(-0.5);
        let bright = rng.random_range(-0.35..0.75f32).powi(3) * 1.6;
        let squeeze = rng.random_range(0.6..1.0f32);
        let turn = rng.random_range(0.0..3.2f32);
        let (s, c) = turn.sin_cos();
        let reach = (radius * 2.2) as i32 + 1;
        for j in -reach..=reach {
            for i in -reach..=reach {
                let [x, y] = [centre.x.floor() + i as f32, centre.y.floor() + j as f32];
                let offset = Vector2::new(x, y) - centre;
                let disc = |o: Vector2<f32>| {
                    (c * o.x + s * o.y).hypot((c * o.y - s * o.x) / squeeze) / radius
                };
                let wrap = |v: f32| v as i32 as usize & (GRAIN - 1);
                let pixel = &mut tone[wrap(y) * GRAIN + wrap(x)];
                let r = disc(offset);
                let cover = ((1.0 - r) * radius + 0.5).clamp(0.0, 1.0);
                // The face towards the light is bright, the other dark.
                let shade = -0.5 * offset.dot(&along) / radius;
                *pixel = *pixel * (1.0 - cover) + cover * (bright + shade);
                if cover == 0.0 && disc(offset - along * (0.9 * radius)) < 1.0 {
                    *pixel -= 0.3;
                }
            }
        }
    }
    let mean = tone.iter().sum::<f32>() / tone.len() as f32;
    Texture::new(
        GRAIN,
        true,
        tone.into_iter()
            .map(|t| [(t - mean).clamp(-0.6, 1.0)])
            .collect(),
    )
}
