use nalgebra::{Vector2, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::options::{Look, Options, Sky};
use super::rocks::Rocks;
use super::surface::Surface;

/// Everything about colours and light at a site.
#[derive(Clone, Debug)]
pub(super) struct Light {
    /// Unit vector to the sun.
    pub to_sun: Vector3<f64>,
    pub sun: Vector3<f32>,
    /// From the whole sky, onto level ground.
    pub ambient: Vector3<f32>,
    /// Albedos.
    pub sand: Vector3<f32>,
    pub stone: Vector3<f32>,
    /// How much of the ground is gravel, 0 to 1.
    pub gravel: f32,
    /// Contrast of the grain between the gravel, times the usual.
    pub grain: f32,
    sky_low: Vector3<f32>,
    sky_high: Vector3<f32>,
    /// Distance at which haze has taken 1 - 1/e of the light, metres.
    haze: f64,
    /// Phases of the hills on the horizon.
    hills: [f64; 5],
}

impl Light {
    /// The light of a place; the seed varies it a little.
    pub fn new(options: &Options, rng: &mut ChaCha8Rng) -> Self {
        let v = |r: f32, g: f32, b: f32| Vector3::new(r, g, b);
        let (sand, stone, gravel, sun, ambient, default_sky) = match options.look {
            Look::Mars => (
                v(0.58, 0.29, 0.13),
                v(0.30, 0.19, 0.13),
                0.25,
                v(1.0, 0.96, 0.88),
                v(0.11, 0.095, 0.075),
                Sky::Hazy,
            ),
            Look::Moon => (
                v(0.20, 0.195, 0.185),
                v(0.26, 0.255, 0.25),
                0.15,
                v(1.3, 1.3, 1.28),
                v(0.012, 0.012, 0.012),
                Sky::Black,
            ),
            // A hall: lamps from above and much light from the walls.
            Look::Arena => (
                v(0.62, 0.24, 0.19),
                v(0.28, 0.12, 0.10),
                0.0,
                v(0.95, 0.92, 0.86),
                v(0.24, 0.23, 0.21),
                Sky::Black,
            ),
            Look::Devon => (
                v(0.20, 0.125, 0.105),
                v(0.42, 0.34, 0.32),
                0.9,
                v(1.25, 1.2, 1.12),
                v(0.10, 0.12, 0.15),
                Sky::Clear,
            ),
        };
        let (sky_low, sky_high, haze) = match options.sky.unwrap_or(default_sky) {
            Sky::Hazy => (v(0.52, 0.35, 0.21), v(0.17, 0.11, 0.08), 24.0),
            Sky::Clear => (v(0.75, 0.80, 0.85), v(0.20, 0.42, 0.62), 400.0),
            Sky::Black => (v(0.0, 0.0, 0.0), v(0.0, 0.0, 0.0), f64::INFINITY),
        };
        let skew: f64 = rng.random_range(-0.8..0.8);
        let drawn: f64 = rng.random_range(0.5..0.75);
        let lamps = if options.look == Look::Arena {
            0.4
        } else {
            0.0
        };
        let [azimuth, elevation] = options
            .sun
            .unwrap_or([f64::atan2(-1.0, -skew), drawn + lamps]);
        let tint = Vector3::from_fn(|_, _| rng.random_range(0.94..1.06f32));
        Self {
            to_sun: Vector3::new(
                azimuth.cos() * elevation.cos(),
                azimuth.sin() * elevation.cos(),
                elevation.sin(),
            ),
            sun,
            ambient,
            sand: sand.component_mul(&tint),
            stone: stone.component_mul(&tint),
            gravel,
            sky_low,
            sky_high,
            haze,
            grain: match options.look {
                Look::Mars => 1.0,
                Look::Moon => 0.8,
                Look::Arena => 0.35,
                Look::Devon => 0.45,
            },
            hills: std::array::from_fn(|_| rng.random_range(0.0..std::f64::consts::TAU)),
        }
    }

    /// The direction that light travels along the ground.
    pub fn along(&self) -> Vector2<f32> {
        -self.to_sun.xy().normalize().cast::<f32>()
    }

    /// How far one sees, metres.
    pub fn far(&self) -> f64 {
        if self.haze < 100.0 { 40.0 } else { 100.0 }
    }

    /// The light that a surface sends back: albedo, unit normal, the share of the sun that reaches
    /// it, and the unit vector to the eye.
    pub fn reflected(
        &self,
        albedo: &Vector3<f32>,
        normal: &Vector3<f32>,
        sunlit: f32,
        to_eye: &Vector3<f32>,
    ) -> Vector3<f32> {
        let to_sun = self.to_sun.cast::<f32>();
        let direct = if sunlit > 0.0 {
            sunlit * reflectance(normal.dot(&to_sun), normal.dot(to_eye), to_sun.dot(to_eye))
        } else {
            0.0
        };
        let light = self.sun * direct + self.ambient * (0.5 + 0.5 * normal.z);
        albedo.component_mul(&light)
    }

    /// Light through `depth` metres of haze.
    pub fn through_haze(&self, light: Vector3<f32>, depth: f64) -> Vector3<f32> {
        if self.haze.is_infinite() {
            return light;
        }
        let clear = (-(depth / self.haze).powi(2)).exp() as f32;
        light * clear + self.sky_low * (1.0 - clear)
    }

    /// What stands where nothing does: distant hills and the sky.
    pub fn beyond(&self, ray: &Vector3<f64>) -> Vector3<f32> {
        let elevation = (ray.z / ray.norm()).asin();
        let azimuth = ray.y.atan2(ray.x);
        let waves = [
            (3.0, 0.022),
            (5.0, 0.014),
            (11.0, 0.008),
            (23.0, 0.004),
            (47.0, 0.002),
        ];
        let ridge: f64 = 0.045
            + waves
                .iter()
                .zip(self.hills)
                .map(|((n, a), phase)| a * (n * azimuth + phase).sin())
                .sum::<f64>();
        // A soft edge, so that it looks the same to both cameras.
        let hill = ((ridge - elevation) / 0.003 + 0.5).clamp(0.0, 1.0) as f32;
        let high = (elevation as f32 * 3.0).clamp(0.0, 1.0);
        let sky = self.sky_low * (1.0 - high) + self.sky_high * high;
        let face = self.sand.component_mul(&self.sun) * 0.35;
        let far_hill = if self.haze.is_infinite() {
            face
        } else {
            face * 0.3 + self.sky_low * 0.7
        };
        sky * (1.0 - hill) + far_hill * hill
    }
}

/// Reflectance of regolith in units in which a white matt surface gives the cosine of incidence
/// when the phase angle is 70 degrees: Hapke's (1981, equation 16; 1986 for the surge) bidirectional
/// reflectance with a backscattering lobe. Unlike a matt surface it brightens towards the sun's
/// opposite point and does not darken towards the limb.
fn reflectance(cos_incidence: f32, cos_emission: f32, cos_phase: f32) -> f32 {
    /// Single-scattering albedo, lobe, and amplitude and width of the opposition surge.
    const W: f32 = 0.6;
    const LOBE: f32 = 0.22;
    const SURGE: f32 = 0.8;
    const WIDTH: f32 = 0.06;
    /// Makes the unit, see above (incidence and emission at 50 degrees).
    const UNIT: f32 = 1.205;
    if cos_incidence <= 0.0 {
        return 0.0;
    }
    let emission = cos_emission.max(0.02);
    let cos_phase = cos_phase.clamp(-1.0, 1.0);
    let half_tangent = ((1.0 - cos_phase) / (1.0 + cos_phase).max(1e-6)).sqrt();
    let surge = SURGE / (1.0 + half_tangent / WIDTH);
    let bent = 1.0 - 2.0 * LOBE * cos_phase + LOBE * LOBE;
    let lobe = (1.0 - LOBE * LOBE) / (bent * bent.sqrt());
    let gamma = (1.0 - W).sqrt();
    let h = |x: f32| (1.0 + 2.0 * x) / (1.0 + 2.0 * gamma * x);
    let scattered = (1.0 + surge) * lobe + h(cos_incidence) * h(emission) - 1.0;
    UNIT * W * cos_incidence / (cos_incidence + emission) * scattered
}

/// For each node of the surface, how it lies to the cast shadows: -1 in the sun, 1 in shadow,
/// between on their edge. One sweep along the main axis of the light carries the height of the
/// shadow of ground and rocks from line to line.
pub(super) fn shadows(surface: &Surface, rocks: &Rocks, to_sun: &Vector3<f64>) -> Vec<f32> {
    let side = surface.side;
    let heights = surface.heights_at_nodes();
    let mut tops = heights.clone();
    for rock in &rocks.list {
        let (u, v) = surface.cells(rock.centre.x, rock.centre.y);
        let reach = rock.radius / surface.cell;
        for j in (v - reach).ceil() as i32..=(v + reach) as i32 {
            for i in (u - reach).ceil() as i32..=(u + reach) as i32 {
                let x = surface.origin.x + f64::from(i) * surface.cell;
                let y = surface.origin.y + f64::from(j) * surface.cell;
                if let Some(top) = rock.top_at(x, y) {
                    let node = surface.node(i, j);
                    tops[node] = tops[node].max((top - surface.origin.z) as f32);
                }
            }
        }
    }

    // Lines lie across the main axis of the light; from line to line its rays move `skew` nodes
    // along them and fall by `drop`.
    let along_y = to_sun.y.abs() >= to_sun.x.abs();
    let (main, across) = if along_y {
        (to_sun.y, to_sun.x)
    } else {
        (to_sun.x, to_sun.y)
    };
    let skew = (across / -main.abs()) as f32;
    let drop = (surface.cell * to_sun.z / main.abs()) as f32;
    let index = |line: usize, k: usize| {
        // Light travels away from the sun.
        let line = if main < 0.0 { line } else { side - 1 - line };
        if along_y {
            line * side + k
        } else {
            k * side + line
        }
    };
    let (whole, share) = (skew.floor(), skew - skew.floor());
    let repeats = surface.extent.is_none();
    let before = |k: usize, by: i32| {
        let from = k as i32 - by;
        let wrapped = from as usize & (side - 1);
        (repeats || from >= 0 && (from as usize) < side).then_some(wrapped)
    };
    let mut shadow = vec![f32::MIN / 2.0; side];
    let mut edges = vec![-1.0; side * side];
    // The second round starts with the shadows that the first left at the border.
    let rounds = if repeats { 2 } else { 1 };
    for line in (0..rounds).flat_map(|_| 0..side) {
        let at =
            |shadow: &[f32], by: i32, k: usize| before(k, by).map_or(f32::MIN / 2.0, |k| shadow[k]);
        let next: Vec<f32> = (0..side)
            .map(|k| {
                let carried = at(&shadow, whole as i32, k) * (1.0 - share)
                    + at(&shadow, whole as i32 + 1, k) * share
                    - drop;
                let node = index(line, k);
                edges[node] = ((carried - heights[node]) / drop).clamp(-1.0, 1.0);
                tops[node].max(carried)
            })
            .collect();
        shadow = next;
    }
    edges
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synth::relief;

    #[test]
    fn reflectance_surges_at_opposition_and_does_not_darken_towards_the_limb() {
        let at = |incidence: f32, emission: f32, phase: f32| {
            let cos = |degrees: f32| degrees.to_radians().cos();
            reflectance(cos(incidence), cos(emission), cos(phase))
        };
        let unit = at(50.0, 50.0, 70.0) / 50f32.to_radians().cos();
        assert!((unit - 1.0).abs() < 0.03, "{unit}");
        // A surge of a fifth over the last ten degrees.
        assert!(at(50.0, 50.0, 0.0) > 1.2 * at(50.0, 50.0, 10.0));
        assert!(at(0.0, 0.0, 0.0) < 1.6 * at(60.0, 60.0, 0.0));
        // Reciprocity: light goes both ways, the cosine of incidence aside.
        let there = at(20.0, 65.0, 60.0) / 20f32.to_radians().cos();
        let back = at(65.0, 20.0, 60.0) / 65f32.to_radians().cos();
        assert!((there - back).abs() < 1e-5);
        assert_eq!(at(95.0, 30.0, 70.0), 0.0);
    }

    #[test]
    fn shadows_are_where_a_ray_to_the_sun_meets_something() {
        let (surface, rocks) = relief::example(3);
        for azimuth in [0.3f64, 2.2, 3.6, 5.0] {
            let to_sun = Vector3::new(azimuth.cos(), azimuth.sin(), 0.5).normalize();
            let edges = shadows(&surface, &rocks, &to_sun);
            let (mut agree, mut asked) = (0, 0);
            for k in 0..4000 {
                let (i, j) = (k * 37 % 2048, k * 91 % 2048);
                let edge = edges[surface.node(i, j)];
                let (x, y) = (f64::from(i) * surface.cell, f64::from(j) * surface.cell);
                if edge.abs() < 1.0 || rocks.top(&surface, x, y) > surface.height(x, y) {
                    continue;
                }
                let from = nalgebra::Point3::new(x, y, surface.height(x, y) + 0.01);
                let dark = surface.hit(&rocks, &from, &to_sun, 0.0, 60.0).is_some();
                asked += 1;
                agree += u32::from(dark == (edge > 0.0));
            }
            let share = f64::from(agree) / f64::from(asked);
            assert!(
                asked > 1500 && share > 0.96,
                "{azimuth}: {agree} of {asked}"
            );
        }
    }
}
