use nalgebra::{Point3, Vector2, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

use super::noise::add_noise;
use super::texture::{Texture, spline};

/// Nodes along a side of the height grid; a power of two.
pub(super) const SIDE: usize = 2048;
/// Distance between nodes, metres.
pub(super) const CELL: f64 = 0.02;
/// The ground repeats after this many metres along x and y.
pub(super) const PERIOD: f64 = SIDE as f64 * CELL;
/// Radius of the circle that the route follows, metres.
pub(super) const ROUTE_RADIUS: f64 = 9.0;

/// Sand with ripples of every size, craters and rocks, ringed by hills: a height for each (x, y),
/// repeating every [`PERIOD`].
///
/// The surface is the uniform bicubic B-spline whose control points are the grid: smooth, and
/// inside the hull of the control points, so that their maxima bound it and a ray can skip
/// whatever it flies over.
pub(super) struct Ground {
    control: Vec<f32>,
    /// Level k: the upper bound of the surface over squares of 2^k cells.
    bounds: Vec<Vec<f32>>,
    /// For each node the light that falls on it, 0..=1 or a little more (sun with shadows, and
    /// sky); and what it is: 0 for sand, 0.5..=1 for rock, by its brightness.
    pub light_and_rock: Texture<2>,
    /// The direction that light travels along the ground, for shading finer than the grid.
    pub light_along: Vector2<f32>,
}

impl Ground {
    /// Makes the ground of a seed.
    pub fn new(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut control = sand(rng.random());
        dig_craters(&mut control, &mut rng);
        let rock = lay_rocks(&mut control, &mut rng);
        let skew: f32 = rng.random_range(-0.8..0.8);
        let elevation: f32 = rng.random_range(0.5..0.75);
        let light = shine(&control, skew, elevation.tan());
        Self {
            bounds: bounds(&control),
            control,
            light_and_rock: Texture::new(
                SIDE,
                light.into_iter().zip(rock).map(|(l, r)| [l, r]).collect(),
            ),
            light_along: Vector2::new(skew, 1.0).normalize(),
        }
    }

    /// Height of the surface, metres.
    pub fn height(&self, x: f64, y: f64) -> f64 {
        let (u, v) = (x / CELL, y / CELL);
        self.patch(u, v).height(u, v)
    }

    /// Unit normal of the surface.
    pub fn normal(&self, x: f64, y: f64) -> Vector3<f64> {
        let (u, v) = (x / CELL, y / CELL);
        let slope = self.patch(u, v).slope(u, v) / CELL;
        Vector3::new(-slope.x, -slope.y, 1.0).normalize()
    }

    /// The cell around a position, in cells.
    fn patch(&self, u: f64, v: f64) -> Patch {
        let (i, j) = (floor(u), floor(v));
        let columns = [wrap(i - 1), wrap(i), wrap(i + 1), wrap(i + 2)];
        let mut control = [[0.0; 4]; 4];
        for (b, out) in control.iter_mut().enumerate() {
            let row = &self.control[wrap(j + b as i32 - 1) * SIDE..][..SIDE];
            *out = [
                row[columns[0]],
                row[columns[1]],
                row[columns[2]],
                row[columns[3]],
            ];
        }
        Patch {
            cell: (f64::from(i), f64::from(j)),
            control,
        }
    }

    /// The first `t` in `near..far` at which `origin + t direction` meets the surface.
    ///
    /// Walks the squares of [`Ground::bounds`]: a square that the ray flies over is left in one
    /// step and the next one tried is larger; one that it may hit is tried in quarters; within a
    /// single cell the surface itself is asked.
    pub fn hit(
        &self,
        origin: &Point3<f64>,
        direction: &Vector3<f64>,
        near: f64,
        far: f64,
    ) -> Option<f64> {
        // Carries a step across the border that it ends on.
        const ACROSS: f64 = 1e-7;
        let top = self.bounds.len() - 1;
        let highest = f64::from(self.bounds[top][0]);
        // Positions along the ground in cells, heights in metres.
        let ray = Ray {
            origin: Point3::new(origin.x / CELL, origin.y / CELL, origin.z),
            direction: Vector3::new(direction.x / CELL, direction.y / CELL, direction.z),
        };
        // Where the ray does not move along an axis, that axis never ends a step.
        let slow = |speed: f64| if speed == 0.0 { f64::MAX } else { 1.0 / speed };
        let slowness = (slow(ray.direction.x), slow(ray.direction.y));
        let fall = direction.z.min(0.0);
        let ahead = (i32::from(direction.x > 0.0), i32::from(direction.y > 0.0));
        let (mut t, mut level) = (near, 4);
        while t < far {
            let p = ray.at(t);
            if direction.z >= 0.0 && p.z > highest {
                return None;
            }
            let (i, j) = (floor(p.x) >> level, floor(p.y) >> level);
            let exit_x = ((f64::from((i + ahead.0) << level) - p.x) * slowness.0).abs();
            let exit_y = ((f64::from((j + ahead.1) << level) - p.y) * slowness.1).abs();
            let exit = if exit_x < exit_y { exit_x } else { exit_y };
            let side = SIDE >> level;
            let square = (j as usize & (side - 1)) * side + (i as usize & (side - 1));
            if p.z + exit * fall > f64::from(self.bounds[level][square]) {
                t += exit + ACROSS;
                level = (level + 1).min(top);
            } else if level > 0 {
                level -= 1;
            } else if let Some(at) = self.hit_between(&ray, t, t + exit) {
                return Some(at);
            } else {
                t += exit + ACROSS;
            }
        }
        None
    }

    /// [`Ground::hit`] within one cell: three brackets, then the Illinois form of regula falsi.
    fn hit_between(&self, ray: &Ray, from: f64, to: f64) -> Option<f64> {
        const BRACKETS: usize = 3;
        let inside = ray.at((from + to) / 2.0);
        let patch = self.patch(inside.x, inside.y);
        let above = |t: f64| {
            let p = ray.at(t);
            p.z - patch.height(p.x, p.y)
        };
        let (mut a, mut fa) = (from, above(from));
        if fa <= 0.0 {
            return Some(a);
        }
        for k in 1..=BRACKETS {
            let mut b = from + (to - from) * k as f64 / BRACKETS as f64;
            let mut fb = above(b);
            if fb > 0.0 {
                (a, fa) = (b, fb);
                continue;
            }
            for _ in 0..30 {
                let middle = (a * fb - b * fa) / (fb - fa);
                let f = above(middle);
                // Micrometres: the resolution of f32 heights.
                if b - a < 1e-7 || f.abs() < 1e-6 {
                    return Some(middle);
                }
                if f > 0.0 {
                    (a, fa) = (middle, f);
                    fb *= 0.5;
                } else {
                    (b, fb) = (middle, f);
                    fa *= 0.5;
                }
            }
            return Some(b);
        }
        None
    }
}

/// A ray whose x and y are in cells.
struct Ray {
    origin: Point3<f64>,
    direction: Vector3<f64>,
}

impl Ray {
    fn at(&self, t: f64) -> Point3<f64> {
        self.origin + self.direction * t
    }
}

/// The surface over one cell; positions in cells.
struct Patch {
    cell: (f64, f64),
    control: [[f32; 4]; 4],
}

impl Patch {
    fn height(&self, u: f64, v: f64) -> f64 {
        let (tu, tv) = self.within(u, v);
        f64::from(self.weigh(&spline(tu), &spline(tv)))
    }

    /// Metres a cell.
    fn slope(&self, u: f64, v: f64) -> Vector2<f64> {
        let (tu, tv) = self.within(u, v);
        let along = |wx: &[f32; 4], wy: &[f32; 4]| f64::from(self.weigh(wx, wy));
        Vector2::new(
            along(&spline_slope(tu), &spline(tv)),
            along(&spline(tu), &spline_slope(tv)),
        )
    }

    fn within(&self, u: f64, v: f64) -> (f32, f32) {
        ((u - self.cell.0) as f32, (v - self.cell.1) as f32)
    }

    fn weigh(&self, wx: &[f32; 4], wy: &[f32; 4]) -> f32 {
        let row = |c: &[f32; 4]| wx[0] * c[0] + wx[1] * c[1] + wx[2] * c[2] + wx[3] * c[3];
        let [a, b, c, d] = &self.control;
        wy[0] * row(a) + wy[1] * row(b) + wy[2] * row(c) + wy[3] * row(d)
    }
}

/// Derivatives of [`spline`].
fn spline_slope(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    [
        -s * s / 2.0,
        t * (1.5 * t - 2.0),
        s * (2.0 - 1.5 * s),
        t * t / 2.0,
    ]
}

/// Whole part towards minus infinity; see [`super::noise::floor`].
fn floor(v: f64) -> i32 {
    let towards_zero = v as i32;
    towards_zero - i32::from(f64::from(towards_zero) > v)
}

fn wrap(index: i32) -> usize {
    index as usize & (SIDE - 1)
}

/// From the middle of the square that repeats, which is the origin, to a node along one axis.
fn metres(index: usize) -> f32 {
    let half = SIDE as i32 / 2;
    ((index as i32 + half) % SIDE as i32 - half) as f32 * CELL as f32
}

/// Rolling sand of every wavelength, and the hills around.
fn sand(seed: u32) -> Vec<f32> {
    /// Waves a period, and amplitude in metres.
    const WAVES: [(u32, f32); 9] = [
        (2, 0.70),
        (4, 0.40),
        (8, 0.20),
        (17, 0.09),
        (35, 0.045),
        (70, 0.024),
        (140, 0.012),
        (280, 0.007),
        (500, 0.004),
    ];
    let mut control = vec![0.0; SIDE * SIDE];
    control
        .par_chunks_mut(SIDE)
        .enumerate()
        .for_each(|(j, row)| {
            for (k, (waves, amplitude)) in WAVES.into_iter().enumerate() {
                add_noise(row, j, waves, amplitude, seed.wrapping_add(k as u32));
            }
            let mut lumps = vec![1.3; SIDE];
            add_noise(&mut lumps, j, 5, 2.4, seed.wrapping_add(99));
            for (i, h) in row.iter_mut().enumerate() {
                let away = ((metres(i).hypot(metres(j)) - ROUTE_RADIUS as f32 - 3.0) / 8.0)
                    .clamp(0.0, 1.0);
                *h += away * away * (3.0 - 2.0 * away) * lumps[i];
            }
        });
    control
}

/// Calls `shape` with the nodes around a centre: the node's height, and its offset in metres.
fn around(
    control: &mut [f32],
    centre: Vector2<f32>,
    radius: f32,
    mut shape: impl FnMut(usize, &mut f32, Vector2<f32>),
) {
    let reach = (radius / CELL as f32).ceil() as i32;
    let (ci, cj) = (
        (centre.x / CELL as f32).round() as i32,
        (centre.y / CELL as f32).round() as i32,
    );
    for j in cj - reach..=cj + reach {
        for i in ci - reach..=ci + reach {
            let node = wrap(j) * SIDE + wrap(i);
            let offset = Vector2::new(i as f32 * CELL as f32, j as f32 * CELL as f32) - centre;
            shape(node, &mut control[node], offset);
        }
    }
}

fn anywhere(rng: &mut ChaCha8Rng) -> Vector2<f32> {
    let half = PERIOD as f32 / 2.0;
    Vector2::new(rng.random_range(-half..half), rng.random_range(-half..half))
}

/// Bowls with a raised rim.
fn dig_craters(control: &mut [f32], rng: &mut ChaCha8Rng) {
    for _ in 0..40 {
        let centre = anywhere(rng);
        let radius = 0.4 / rng.random_range(0.12f32..1.0);
        let depth = 0.16 * radius;
        around(control, centre, 2.0 * radius, |_, h, offset| {
            let r = offset.norm() / radius;
            let bowl = if r < 1.0 { -depth * (1.0 - r * r) } else { 0.0 };
            let rim = 0.3 * depth * (-((r - 1.0) / 0.25).powi(2)).exp();
            *h += bowl + rim;
        });
    }
}

/// Stones, many small and few large, none in the way of the rover. Returns where rock lies.
fn lay_rocks(control: &mut [f32], rng: &mut ChaCha8Rng) -> Vec<f32> {
    let mut rock = vec![0.0f32; SIDE * SIDE];
    let seed: u32 = rng.random();
    let mut facets = vec![1.0; SIDE * SIDE];
    facets
        .par_chunks_mut(SIDE)
        .enumerate()
        .for_each(|(j, row)| add_noise(row, j, 290, 0.5, seed));
    for _ in 0..2200 {
        let centre = anywhere(rng);
        // P(r > R) ~ R^-1.7, from 6 cm to 60 cm.
        let radius = 0.06 * rng.random_range(0.02f32..1.0).powf(-1.0 / 1.7);
        let (height, bright) = (
            radius * rng.random_range(0.5..0.95f32),
            rng.random_range(0.5..1.0f32),
        );
        let (turn, squeeze) = (
            rng.random_range(0.0..std::f32::consts::TAU),
            rng.random_range(0.7..1.0f32),
        );
        // The wheels are half a metre from the middle of the route, which wanders by 0.8 m.
        if (centre.norm() - ROUTE_RADIUS as f32).abs() < 1.5 + radius && radius > 0.1 {
            continue;
        }
        around(control, centre, 1.3 * radius, |node, h, offset| {
            let (s, c) = turn.sin_cos();
            let (x, y) = (
                c * offset.x + s * offset.y,
                (c * offset.y - s * offset.x) / squeeze,
            );
            let angle = y.atan2(x);
            let outline = 1.0
                + 0.12 * (2.0 * angle + 5.0 * turn).sin()
                + 0.1 * (5.0 * angle + 9.0 * turn).sin();
            let r = x.hypot(y) / (radius * outline);
            if r < 1.0 {
                *h += height * facets[node] * (1.0 - r.powi(3)).powf(0.7);
                rock[node] = bright;
            }
        });
    }
    rock
}

/// Light on each node: the sun stands so that its rays travel along (skew, 1) and fall by
/// `tangent` a metre; one sweep along y carries the height of the shadow from row to row.
fn shine(control: &[f32], skew: f32, tangent: f32) -> Vec<f32> {
    let cell = CELL as f32;
    let drop = cell * skew.hypot(1.0) * tangent;
    let to_sun = Vector3::new(-skew, -1.0, tangent * skew.hypot(1.0)).normalize();
    let mut shadow = control[..SIDE].to_vec();
    let mut light = vec![0.0; SIDE * SIDE];
    // The second round starts with the shadows that the first left at the border.
    for j in (0..SIDE).chain(0..SIDE) {
        let row = &control[j * SIDE..][..SIDE];
        let (before, after) = (wrap(j as i32 - 1) * SIDE, wrap(j as i32 + 1) * SIDE);
        let (whole, share) = (skew.floor(), skew - skew.floor());
        let from = |i: usize| {
            let k = i as i32 - whole as i32;
            shadow[wrap(k)] * (1.0 - share) + shadow[wrap(k - 1)] * share
        };
        let next: Vec<f32> = (0..SIDE).map(|i| row[i].max(from(i) - drop)).collect();
        for i in 0..SIDE {
            let slope_x = (row[wrap(i as i32 + 1)] - row[wrap(i as i32 - 1)]) / (2.0 * cell);
            let slope_y = (control[after + i] - control[before + i]) / (2.0 * cell);
            let normal = Vector3::new(-slope_x, -slope_y, 1.0).normalize();
            let dark = ((next[i] - row[i]) / 0.03).clamp(0.0, 1.0);
            light[j * SIDE + i] =
                0.30 * (0.5 + 0.5 * normal.z) + 0.95 * normal.dot(&to_sun).max(0.0) * (1.0 - dark);
        }
        shadow = next;
    }
    light
}

/// Upper bounds over squares of 1, 2, 4, ... cells.
fn bounds(control: &[f32]) -> Vec<Vec<f32>> {
    // A cell's surface lies in the hull of its 4 x 4 control points.
    let mut cells = vec![0.0; SIDE * SIDE];
    cells.par_chunks_mut(SIDE).enumerate().for_each(|(j, row)| {
        let column: Vec<f32> = (0..SIDE)
            .map(|i| {
                (-1..3)
                    .map(|b| control[wrap(j as i32 + b) * SIDE + i])
                    .fold(f32::MIN, f32::max)
            })
            .collect();
        for (i, out) in row.iter_mut().enumerate() {
            *out = (-1..3)
                .map(|a| column[wrap(i as i32 + a)])
                .fold(f32::MIN, f32::max);
        }
    });
    let mut levels = vec![cells];
    let mut side = SIDE / 2;
    while side >= 1 {
        let fine = &levels[levels.len() - 1];
        let of = |i: usize, j: usize| {
            let at = 2 * j * 2 * side + 2 * i;
            fine[at]
                .max(fine[at + 1])
                .max(fine[at + 2 * side])
                .max(fine[at + 2 * side + 1])
        };
        levels.push((0..side * side).map(|k| of(k % side, k / side)).collect());
        side /= 2;
    }
    levels
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hit_lies_on_the_surface_and_nothing_stands_before_it() {
        let ground = Ground::new(5);
        let mut hits = 0;
        for k in 0..300 {
            let angle = k as f64 * 0.7;
            let down = -0.02 - 0.9 * (k as f64 / 300.0).powi(2);
            let origin = Point3::new(
                3.0 * angle.sin(),
                -4.0 * angle.cos(),
                ground.height(3.0 * angle.sin(), -4.0 * angle.cos()) + 0.8,
            );
            let direction = Vector3::new(angle.cos(), angle.sin(), down);
            let Some(t) = ground.hit(&origin, &direction, 0.05, 40.0) else {
                continue;
            };
            hits += 1;
            let above = |t: f64| {
                let p = origin + direction * t;
                p.z - ground.height(p.x, p.y)
            };
            assert!(above(t).abs() < 1e-5, "{}", above(t));
            let steps = (t / 0.002) as usize;
            for s in 25..steps {
                assert!(
                    above(s as f64 * 0.002) > -2e-4,
                    "ray {k} passes through the ground"
                );
            }
        }
        assert!(hits > 200, "{hits}");
    }

    #[test]
    fn the_ground_repeats_and_its_normal_is_its_slope() {
        let ground = Ground::new(2);
        for k in 0..50 {
            let (x, y) = (k as f64 * 0.731 - 20.0, k as f64 * 0.377 - 9.0);
            assert!((ground.height(x, y) - ground.height(x + PERIOD, y - PERIOD)).abs() < 1e-5);
            let n = ground.normal(x, y);
            let e = 1e-3;
            let slope_x = (ground.height(x + e, y) - ground.height(x - e, y)) / (2.0 * e);
            let slope_y = (ground.height(x, y + e) - ground.height(x, y - e)) / (2.0 * e);
            assert!((n.norm() - 1.0).abs() < 1e-12);
            assert!((-n.x / n.z - slope_x).abs() < 5e-3 && (-n.y / n.z - slope_y).abs() < 5e-3);
        }
    }
}
