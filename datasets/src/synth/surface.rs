use nalgebra::{Point3, Vector2, Vector3};
use rayon::prelude::*;

use super::rocks::Rocks;
use super::texture::spline;

/// The ground without what stands on it: the uniform bicubic B-spline over a square grid of
/// control points, smooth and inside their hull, so that their maxima bound it and a ray can skip
/// whatever it flies over.
pub(super) struct Surface {
    /// Control points along a side; a power of two.
    pub side: usize,
    /// Distance between control points, metres.
    pub cell: f64,
    /// The position of control point (0, 0) and the height that heights are counted from.
    pub origin: Point3<f64>,
    /// Cells along x and y after which the surface ends; `None` repeats after `side` cells.
    pub extent: Option<[usize; 2]>,
    /// Heights in metres above the origin, row by row towards y.
    pub control: Vec<f32>,
    /// Level k: the upper bound of the surface over squares of 2^k cells.
    bounds: Vec<Vec<f32>>,
}

/// What a ray meets first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Hit {
    /// The parameter along the ray.
    pub t: f64,
    /// The rock (or other body) and its face, or the ground.
    pub body: Option<(u32, u8)>,
}

impl Surface {
    /// A surface of `side` squared control points; see the fields.
    pub fn new(
        side: usize,
        cell: f64,
        origin: Point3<f64>,
        extent: Option<[usize; 2]>,
        control: Vec<f32>,
    ) -> Self {
        Self {
            bounds: bounds(side, &control),
            side,
            cell,
            origin,
            extent,
            control,
        }
    }

    /// Metres after which the surface repeats.
    pub fn period(&self) -> f64 {
        self.side as f64 * self.cell
    }

    /// A position in cells.
    pub fn cells(&self, x: f64, y: f64) -> (f64, f64) {
        (
            (x - self.origin.x) / self.cell,
            (y - self.origin.y) / self.cell,
        )
    }

    /// Whether a position in cells lies on the surface.
    fn holds(&self, u: f64, v: f64) -> bool {
        self.extent.is_none_or(|[width, height]| {
            (0.0..=width as f64).contains(&u) && (0.0..=height as f64).contains(&v)
        })
    }

    /// Height of the surface, metres; NaN beyond its end.
    pub fn height(&self, x: f64, y: f64) -> f64 {
        let (u, v) = self.cells(x, y);
        if !self.holds(u, v) {
            return f64::NAN;
        }
        self.origin.z + self.patch(u, v).height(u, v)
    }

    /// Unit normal of the surface.
    pub fn normal(&self, x: f64, y: f64) -> Vector3<f64> {
        let (u, v) = self.cells(x, y);
        let slope = self.patch(u, v).slope(u, v) / self.cell;
        Vector3::new(-slope.x, -slope.y, 1.0).normalize()
    }

    /// Index of a control point; the side is a power of two, so the mask wraps negative ones too.
    pub fn node(&self, i: i32, j: i32) -> usize {
        self.wrap(j) * self.side + self.wrap(i)
    }

    fn wrap(&self, index: i32) -> usize {
        index as usize & (self.side - 1)
    }

    /// The surface's heights at the control points' positions.
    pub fn heights_at_nodes(&self) -> Vec<f32> {
        let side = self.side;
        let control = &self.control;
        let third = |a: f32, b: f32, c: f32| (a + 4.0 * b + c) / 6.0;
        let mut heights = vec![0.0; side * side];
        heights
            .par_chunks_mut(side)
            .enumerate()
            .for_each(|(j, row)| {
                let j = j as i32;
                let lines = [-1, 0, 1].map(|k| &control[self.wrap(j + k) * side..][..side]);
                let column = |i: usize| third(lines[0][i], lines[1][i], lines[2][i]);
                for (i, out) in row.iter_mut().enumerate() {
                    let [before, after] = [-1, 1].map(|k| column(self.wrap(i as i32 + k)));
                    *out = third(before, column(i), after);
                }
            });
        heights
    }

    /// The cell around a position, in cells.
    fn patch(&self, u: f64, v: f64) -> Patch {
        let (i, j) = (floor(u), floor(v));
        let columns = [-1, 0, 1, 2].map(|k| self.wrap(i + k));
        let mut control = [[0.0; 4]; 4];
        for (b, out) in control.iter_mut().enumerate() {
            let row = &self.control[self.wrap(j + b as i32 - 1) * self.side..][..self.side];
            *out = columns.map(|column| row[column]);
        }
        Patch {
            cell: (f64::from(i), f64::from(j)),
            control,
        }
    }

    /// The first `t` in `near..far` at which `origin + t direction` meets the surface or a rock.
    ///
    /// Walks the squares of the bounds: a square that the ray flies over is left in one step, and
    /// where that leads into another larger one, it is tried next; one that it may hit is tried in quarters. In squares of the
    /// rocks' level the rocks are asked; within a single cell the surface itself.
    pub fn hit(
        &self,
        rocks: &Rocks,
        origin: &Point3<f64>,
        direction: &Vector3<f64>,
        near: f64,
        far: f64,
    ) -> Option<Hit> {
        // Carries a step across the border that it ends on.
        const ACROSS: f64 = 1e-7;
        let top = self.bounds.len() - 1;
        let highest = f64::from(self.bounds[top][0].max(rocks.highest()));
        let from_origin = origin - self.origin;
        // Positions along the ground in cells, heights in metres.
        let ray = Ray {
            origin: Point3::new(
                from_origin.x / self.cell,
                from_origin.y / self.cell,
                from_origin.z,
            ),
            direction: Vector3::new(
                direction.x / self.cell,
                direction.y / self.cell,
                direction.z,
            ),
        };
        // Where the ray does not move along an axis, that axis never ends a step.
        let slow = |speed: f64| if speed == 0.0 { f64::MAX } else { 1.0 / speed };
        let slowness = (slow(ray.direction.x), slow(ray.direction.y));
        let fall = direction.z.min(0.0);
        let ahead = (i32::from(direction.x > 0.0), i32::from(direction.y > 0.0));
        let mut best = Hit { t: far, body: None };
        let mut asked = None;
        let (mut t, mut level) = (near, 4.min(top));
        while t < best.t {
            let p = ray.at(t);
            if p.z > highest && direction.z >= 0.0 || !self.holds(p.x, p.y) {
                break;
            }
            let (i, j) = (floor(p.x), floor(p.y));
            // A new square of the rocks' level: its rocks have not been asked.
            if level < rocks.level() && asked != Some((i >> rocks.level(), j >> rocks.level())) {
                level = rocks.level();
            }
            let (i, j) = (i >> level, j >> level);
            let exit_x = ((f64::from((i + ahead.0) << level) - p.x) * slowness.0).abs();
            let exit_y = ((f64::from((j + ahead.1) << level) - p.y) * slowness.1).abs();
            // Upright rays leave a square nowhere, but they end.
            let exit = if exit_x < exit_y { exit_x } else { exit_y };
            let left = best.t - t;
            let exit = if exit < left { exit } else { left };
            let side = self.side >> level;
            let square = (j as usize & (side - 1)) * side + (i as usize & (side - 1));
            let mut bound = self.bounds[level][square];
            if level >= rocks.level() {
                bound = bound.max(rocks.bound(level, square));
            }
            if p.z + exit * fall > f64::from(bound) {
                t += exit + ACROSS;
                // Into a square of which the next larger one has not been tried.
                let leaves = if exit_x < exit_y {
                    i & 1 == ahead.0
                } else {
                    j & 1 == ahead.1
                };
                level = (level + usize::from(leaves)).min(top);
                continue;
            }
            if level == rocks.level() && asked != Some((i, j)) {
                asked = Some((i, j));
                let middle = [i, j].map(|k| (f64::from(k) + 0.5) * f64::from(1 << level));
                let middle = Point3::new(middle[0] * self.cell, middle[1] * self.cell, 0.0);
                let local = Point3::from(from_origin - middle.coords);
                rocks.hit(square, &local, direction, near, &mut best);
            }
            if level > 0 {
                level -= 1;
            } else if let Some(at) = self.hit_between(&ray, t, t + exit) {
                if at < best.t {
                    best = Hit { t: at, body: None };
                }
                break;
            } else {
                t += exit + ACROSS;
            }
        }
        (best.t < far).then_some(best)
    }

    /// A parameter in `near..=far` before which no ray between the `corners`' meets anything.
    pub fn clear_until(
        &self,
        rocks: &Rocks,
        origin: &Point3<f64>,
        corners: &[Vector3<f64>; 4],
        near: f64,
        far: f64,
    ) -> f64 {
        let from = origin - self.origin;
        let mut t = near;
        while t < far {
            // The box around this part of the pencil of rays.
            let next = 1.12 * t + 0.02;
            let ends = corners
                .iter()
                .flat_map(|ray| [t, next].map(|t| from + ray * t));
            let (low, high) = ends.fold(
                (Vector3::repeat(f64::MAX), Vector3::repeat(f64::MIN)),
                |(low, high), p| (low.inf(&p), high.sup(&p)),
            );
            let wide = (high - low).xy().max() / self.cell;
            // A level at which few squares cover it.
            let least = rocks.level();
            let top = self.bounds.len() - 1;
            let level = (wide.max(1.0).log2() as usize).clamp(least, top.max(least));
            let [i0, i1, j0, j1] =
                [low.x, high.x, low.y, high.y].map(|c| floor(c / self.cell) >> level);
            let side = self.side >> level;
            let over = |i: i32, j: i32| {
                let square = (j as usize & (side - 1)) * side + (i as usize & (side - 1));
                low.z > f64::from(self.bounds[level][square].max(rocks.bound(level, square)))
            };
            if !(j0..=j1).all(|j| (i0..=i1).all(|i| over(i, j))) {
                return t;
            }
            t = next;
        }
        far
    }

    /// [`Surface::hit`] within one cell: three brackets, then the Illinois form of regula falsi.
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

/// Upper bounds over squares of 1, 2, 4, ... cells.
fn bounds(side: usize, control: &[f32]) -> Vec<Vec<f32>> {
    let wrap = |index: i32| index as usize & (side - 1);
    // A cell's surface lies in the hull of its Bezier points, which is tighter than that of its 4 x 4
    // control points: along each axis they are the ends and two points between the middle two.
    let bezier = |c: [f32; 4]| {
        [
            (c[0] + 4.0 * c[1] + c[2]) / 6.0,
            (2.0 * c[1] + c[2]) / 3.0,
            (c[1] + 2.0 * c[2]) / 3.0,
            (c[1] + 4.0 * c[2] + c[3]) / 6.0,
        ]
    };
    let mut cells = vec![0.0; side * side];
    cells.par_chunks_mut(side).enumerate().for_each(|(j, row)| {
        let lines = [-1, 0, 1, 2].map(|b| &control[wrap(j as i32 + b) * side..][..side]);
        // The Bezier points across the rows for every column of control points.
        let column = |i: i32| bezier(lines.map(|line| line[wrap(i)]));
        let mut window = [column(-1), column(0), column(1), column(2)];
        for (i, out) in row.iter_mut().enumerate() {
            *out = (0..4)
                .flat_map(|k| bezier(window.map(|column| column[k])))
                .fold(f32::MIN, f32::max)
                // Rounding must not put the surface above its bound.
                + 1e-6;
            window = [window[1], window[2], window[3], column(i as i32 + 3)];
        }
    });
    let mut levels = vec![cells];
    let mut half = side / 2;
    while half >= 1 {
        let fine = &levels[levels.len() - 1];
        let of = |i: usize, j: usize| {
            let at = 2 * j * 2 * half + 2 * i;
            fine[at]
                .max(fine[at + 1])
                .max(fine[at + 2 * half])
                .max(fine[at + 2 * half + 1])
        };
        levels.push((0..half * half).map(|k| of(k % half, k / half)).collect());
        half /= 2;
    }
    levels
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synth::relief;

    #[test]
    fn a_hit_lies_on_the_surface_or_a_rock_and_nothing_stands_before_it() {
        let (surface, rocks) = relief::example(5);
        let (mut on_ground, mut on_rock) = (0, 0);
        for k in 0..400 {
            let angle = k as f64 * 0.7;
            let down = -0.02 - 0.9 * (k as f64 / 400.0).powi(2);
            let (x, y) = (3.0 * angle.sin(), -4.0 * angle.cos());
            let origin = Point3::new(
                x,
                y,
                surface.height(x, y).max(rocks.top(&surface, x, y)) + 0.8,
            );
            let direction = Vector3::new(angle.cos(), angle.sin(), down);
            let Some(hit) = surface.hit(&rocks, &origin, &direction, 0.05, 40.0) else {
                continue;
            };
            let above = |t: f64| {
                let p = origin + direction * t;
                p.z - surface.height(p.x, p.y)
            };
            let outside = |t: f64| rocks.distance(&surface, &(origin + direction * t));
            if hit.body.is_some() {
                on_rock += 1;
                assert!(outside(hit.t).abs() < 1e-6, "{}", outside(hit.t));
            } else {
                on_ground += 1;
                assert!(above(hit.t).abs() < 1e-5, "{}", above(hit.t));
            }
            for s in 25..(hit.t / 0.002) as usize {
                let t = s as f64 * 0.002;
                assert!(above(t) > -2e-4, "ray {k} passes through the ground");
                assert!(outside(t) > -2e-4, "ray {k} passes through a rock");
            }
        }
        assert!(on_ground > 200 && on_rock > 20, "{on_ground} {on_rock}");
    }

    #[test]
    fn the_ground_repeats_and_its_normal_is_its_slope() {
        let (surface, _) = relief::example(2);
        let period = surface.period();
        for k in 0..50 {
            let (x, y) = (k as f64 * 0.731 - 20.0, k as f64 * 0.377 - 9.0);
            let there = surface.height(x + period, y - period);
            assert!((surface.height(x, y) - there).abs() < 1e-5);
            let n = surface.normal(x, y);
            let e = 1e-3;
            let slope_x = (surface.height(x + e, y) - surface.height(x - e, y)) / (2.0 * e);
            let slope_y = (surface.height(x, y + e) - surface.height(x, y - e)) / (2.0 * e);
            assert!((n.norm() - 1.0).abs() < 1e-12);
            assert!((-n.x / n.z - slope_x).abs() < 5e-3 && (-n.y / n.z - slope_y).abs() < 5e-3);
        }
    }
}
