use nalgebra::{Point3, Rotation3, Vector2, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::surface::{Hit, Surface};

/// A rock: a convex body of flat faces, partly buried.
#[derive(Clone, Debug, PartialEq)]
pub struct Rock {
    /// Its middle in the world, metres. Over ground that repeats, so does the rock.
    pub centre: Point3<f64>,
    /// No corner is farther from the middle than this, metres.
    pub radius: f64,
    /// The half-spaces whose intersection it is: outward unit normal `n` and offset `c`, so that
    /// points of the rock obey `n . (p - centre) <= c` for all.
    pub faces: Vec<(Vector3<f64>, f64)>,
    /// Height of its highest corner in the world, metres.
    pub top: f64,
    /// How bright its stone is, around 1.
    pub brightness: f64,
}

impl Rock {
    /// A rock about an upright ellipsoid of half axes `size`, cut by flat faces that touch or cut
    /// it; turned at random.
    pub(super) fn random(centre: Point3<f64>, size: Vector3<f64>, rng: &mut ChaCha8Rng) -> Self {
        let turn = Rotation3::from_scaled_axis(Vector3::new(
            rng.random_range(-0.35..0.35),
            rng.random_range(-0.35..0.35),
            rng.random_range(-3.1..3.1),
        ));
        let count = rng.random_range(11..=16);
        let twist: f64 = rng.random_range(0.0..std::f64::consts::TAU);
        let mut faces = Vec::with_capacity(count);
        for k in 0..count {
            // Points of a golden spiral cover the sphere evenly; jitter makes the faces unequal.
            let z = 1.0 - 2.0 * (k as f64 + 0.5) / count as f64;
            let angle = twist + k as f64 * 2.399_963;
            let side = (1.0 - z * z).sqrt();
            let jitter = Vector3::from_fn(|_, _| rng.random_range(-0.3..0.3));
            let n = (Vector3::new(side * angle.cos(), side * angle.sin(), z) + jitter).normalize();
            // The support function of the ellipsoid: the face would touch it there.
            let touching = size.component_mul(&n).norm();
            faces.push((turn * n, touching * rng.random_range(0.74..1.0)));
        }
        let corners = corners(&faces);
        let radius = corners.iter().map(Vector3::norm).fold(0.0, f64::max);
        let top = corners.iter().map(|c| c.z).fold(f64::MIN, f64::max);
        Self {
            centre,
            radius,
            faces,
            top: centre.z + top,
            brightness: rng.random_range(0.7..1.25),
        }
    }

    /// Where a ray, its origin counted from the rock's middle, enters: parameter and face. `None`
    /// when it misses, or starts inside.
    pub(super) fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> Option<(f64, u8)> {
        let (a, b) = (direction.norm_squared(), origin.dot(direction));
        if b * b < a * (origin.norm_squared() - self.radius * self.radius) {
            return None;
        }
        let (mut enter, mut leave, mut face) = (f64::MIN, f64::MAX, 0);
        for (k, (n, c)) in self.faces.iter().enumerate() {
            let (height, fall) = (n.dot(origin) - c, n.dot(direction));
            if fall < 0.0 {
                let t = -height / fall;
                if t > enter {
                    (enter, face) = (t, k as u8);
                }
            } else if fall > 0.0 {
                leave = leave.min(-height / fall);
            } else if height > 0.0 {
                return None;
            }
        }
        (enter < leave).then_some((enter, face))
    }

    /// The height of its upper side over a position, if it is there.
    pub(super) fn top_at(&self, x: f64, y: f64) -> Option<f64> {
        let above = Vector3::new(x, y, self.top + 1.0) - self.centre.coords;
        let (t, _) = self.hit(&above, &-Vector3::z())?;
        Some(self.top + 1.0 - t)
    }
}

/// The corners of an intersection of half-spaces: where three planes meet inside all others.
fn corners(faces: &[(Vector3<f64>, f64)]) -> Vec<Vector3<f64>> {
    let mut corners = Vec::new();
    for (i, a) in faces.iter().enumerate() {
        for (j, b) in faces.iter().enumerate().skip(i + 1) {
            let ab = a.0.cross(&b.0);
            for c in &faces[j + 1..] {
                let volume = ab.dot(&c.0);
                if volume.abs() < 1e-9 {
                    continue;
                }
                // Cramer's rule in vectors.
                let p = (b.0.cross(&c.0) * a.1 + c.0.cross(&a.0) * b.1 + ab * c.1) / volume;
                if faces.iter().all(|(n, d)| n.dot(&p) <= d + 1e-9) {
                    corners.push(p);
                }
            }
        }
    }
    corners
}

/// All rocks, found by the squares of the ground they stand over.
pub(super) struct Rocks {
    pub list: Vec<Rock>,
    /// Squares have 2^level cells a side.
    level: usize,
    /// The period, metres, where the ground repeats.
    period: Option<f64>,
    /// The rocks of square k: `ids[starts[k]..starts[k + 1]]`.
    starts: Vec<u32>,
    ids: Vec<u32>,
    /// Level `level + k`: the highest top, above the surface's origin, over each square.
    bounds: Vec<Vec<f32>>,
    /// Middles of the rocks counted from the surface's origin, metres.
    centres: Vec<Vector3<f64>>,
    /// Side of a square, metres.
    square: f64,
}

impl Rocks {
    /// Sorts rocks into the squares of a surface.
    pub fn new(surface: &Surface, list: Vec<Rock>) -> Self {
        // Squares of about 30 cm, as large as a common rock's surroundings.
        let most = surface.side.trailing_zeros() as usize;
        let level = ((0.3 / surface.cell).log2().round().max(0.0) as usize).min(most);
        let squares = surface.side >> level;
        let square = surface.cell * f64::from(1u32 << level);
        let mut members = vec![Vec::new(); squares * squares];
        let mut bound = vec![f32::MIN; squares * squares];
        let centres: Vec<_> = list.iter().map(|r| r.centre - surface.origin).collect();
        for (id, (rock, centre)) in list.iter().zip(&centres).enumerate() {
            let range = |middle: f64| {
                let [from, to] = [-rock.radius, rock.radius].map(|r| (middle + r) / square);
                from.floor() as i32..=to.floor() as i32
            };
            for j in range(centre.y) {
                for i in range(centre.x) {
                    let k = (j as usize & (squares - 1)) * squares + (i as usize & (squares - 1));
                    members[k].push(id as u32);
                    bound[k] = bound[k].max((rock.top - surface.origin.z) as f32 + 1e-6);
                }
            }
        }
        let mut starts = vec![0];
        let mut ids = Vec::new();
        for square in members {
            ids.extend(square);
            starts.push(ids.len() as u32);
        }
        let mut bounds = vec![bound];
        let mut half = squares / 2;
        while half >= 1 {
            let fine = &bounds[bounds.len() - 1];
            let of = |k: usize| {
                let at = 4 * half * (k / half) + 2 * (k % half);
                [at, at + 1, at + 2 * half, at + 2 * half + 1]
                    .iter()
                    .fold(f32::MIN, |m, k| m.max(fine[*k]))
            };
            bounds.push((0..half * half).map(of).collect());
            half /= 2;
        }
        Self {
            list,
            level,
            period: surface.extent.is_none().then(|| surface.period()),
            starts,
            ids,
            bounds,
            centres,
            square,
        }
    }

    pub fn level(&self) -> usize {
        self.level
    }

    pub fn highest(&self) -> f32 {
        self.bounds[self.bounds.len() - 1][0]
    }

    /// The highest top over a square of the given level, above the surface's origin.
    pub fn bound(&self, level: usize, square: usize) -> f32 {
        self.bounds[level - self.level][square]
    }

    /// Lowers `best` to the first hit on a rock of a square (of [`Rocks::level`]). The ray's origin
    /// is counted from the middle of the square that it crosses, one of its repetitions.
    pub fn hit(
        &self,
        square: usize,
        from_middle: &Point3<f64>,
        direction: &Vector3<f64>,
        near: f64,
        best: &mut Hit,
    ) {
        let range = self.starts[square] as usize..self.starts[square + 1] as usize;
        if range.is_empty() {
            return;
        }
        let middle = self.middle(square);
        for &id in &self.ids[range] {
            let centre = self.nearest(self.centres[id as usize] - middle);
            let origin = from_middle.coords - centre;
            if let Some((t, face)) = self.list[id as usize].hit(&origin, direction)
                && t >= near
                && t < best.t
            {
                *best = Hit {
                    t,
                    body: Some((id, face)),
                };
            }
        }
    }

    /// The middle of a square, counted from the surface's origin.
    fn middle(&self, square: usize) -> Vector3<f64> {
        let squares = 1usize << (self.bounds.len() - 1);
        let at = |k: usize| (k as f64 + 0.5) * self.square;
        Vector3::new(at(square % squares), at(square / squares), 0.0)
    }

    /// Of an offset between places of a ground that repeats, the shortest.
    fn nearest(&self, mut offset: Vector3<f64>) -> Vector3<f64> {
        if let Some(period) = self.period {
            offset.x -= (offset.x / period).round() * period;
            offset.y -= (offset.y / period).round() * period;
        }
        offset
    }

    /// A rock's middle, of all its repetitions the one nearest to a place.
    pub fn centre_near(&self, id: u32, place: &Point3<f64>) -> Point3<f64> {
        place + self.nearest(self.list[id as usize].centre - place)
    }

    /// The highest top of a rock over a position; minus infinity where none is.
    pub fn top(&self, surface: &Surface, x: f64, y: f64) -> f64 {
        let mut top = f64::NEG_INFINITY;
        for &id in self.over(surface, x, y) {
            let rock = &self.list[id as usize];
            let offset = self.nearest(Vector3::new(x, y, 0.0) - rock.centre.coords);
            if let Some(height) = rock.top_at(rock.centre.x + offset.x, rock.centre.y + offset.y) {
                top = top.max(height);
            }
        }
        top
    }

    /// How far outside of every rock that stands over its square a point is, at least; negative
    /// inside.
    #[cfg(test)]
    pub fn distance(&self, surface: &Surface, at: &Point3<f64>) -> f64 {
        let outside = |rock: &Rock| {
            let offset = self.nearest(at - rock.centre);
            let to_face = |(n, c): &(Vector3<f64>, f64)| n.dot(&offset) - c;
            rock.faces.iter().map(to_face).fold(f64::MIN, f64::max)
        };
        let near = self.over(surface, at.x, at.y);
        near.iter()
            .map(|id| outside(&self.list[*id as usize]))
            .fold(f64::MAX, f64::min)
    }

    /// The rocks that stand over the square of a position.
    fn over(&self, surface: &Surface, x: f64, y: f64) -> &[u32] {
        let (u, v) = surface.cells(x, y);
        let squares = 1usize << (self.bounds.len() - 1);
        let [i, j] = [u, v].map(|c| (c.floor() as i64 >> self.level) as usize & (squares - 1));
        let square = j * squares + i;
        &self.ids[self.starts[square] as usize..self.starts[square + 1] as usize]
    }
}

/// The rocks of a ground of some side, as surveyed on Mars: the share of the ground covered by
/// rocks of diameter D or more is `k exp(-q D)` with `q = 1.79 + 0.152 / k` (Golombek and Rapp
/// 1997). `clear` says how large a rock (its radius) may lie at a place.
pub(super) fn scatter(
    surface: &Surface,
    share: f64,
    rng: &mut ChaCha8Rng,
    clear: impl Fn(Vector2<f64>) -> f64,
) -> Vec<Rock> {
    /// Smallest and largest diameter, metres.
    const DIAMETERS: (f64, f64) = (0.05, 1.6);
    const BINS: usize = 400;
    if share <= 0.0 {
        return Vec::new();
    }
    let size = surface
        .extent
        .unwrap_or([surface.side; 2])
        .map(|n| n as f64 * surface.cell);
    let q = 1.79 + 0.152 / share;
    // Rocks a square metre larger than each of the diameters, from the largest down.
    let ratio = (DIAMETERS.0 / DIAMETERS.1).powf(1.0 / BINS as f64);
    let mut diameter = DIAMETERS.1;
    let mut table = vec![(0.0, diameter)];
    for _ in 0..BINS {
        let next = diameter * ratio;
        let covered = share * ((-q * next).exp() - (-q * diameter).exp());
        let middle = next.midpoint(diameter);
        let rocks = covered / (std::f64::consts::FRAC_PI_4 * middle * middle);
        diameter = next;
        table.push((table[table.len() - 1].0 + rocks, diameter));
    }
    let density = table[table.len() - 1].0;
    let count = (density * size[0] * size[1]).round() as usize;
    let mut list = Vec::with_capacity(count);
    for _ in 0..count {
        let place = surface.origin
            + Vector3::new(
                rng.random_range(0.0..size[0]),
                rng.random_range(0.0..size[1]),
                0.0,
            );
        let drawn = rng.random_range(0.0..density);
        let radius = table[table.partition_point(|(above, _)| *above < drawn).min(BINS)].1 / 2.0;
        // The diameter is that of the disc of equal area, so one axis grows as the other shrinks;
        // faces cut off a seventh.
        let long: f64 = rng.random_range(1.0..1.25);
        let high = rng.random_range(0.45..0.9);
        let size = Vector3::new(long, 1.0 / long, high) * (1.08 * radius);
        let buried = rng.random_range(-0.2..0.55) * size.z;
        if radius > clear(place.xy().coords) {
            continue;
        }
        let ground = surface.height(place.x, place.y);
        if ground.is_finite() {
            let centre = Point3::new(place.x, place.y, ground + size.z * 0.75 - buried);
            list.push(Rock::random(centre, size, rng));
        }
    }
    list
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::rand_core::SeedableRng;

    #[test]
    fn a_rock_is_closed_and_its_corners_are_on_it() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for _ in 0..50 {
            let size = Vector3::new(0.5, 0.4, 0.3);
            let rock = Rock::random(Point3::origin(), size, &mut rng);
            let corners = corners(&rock.faces);
            // Euler: a convex body of F faces has at most 2 F - 4 corners, and at least 4.
            assert!((4..=2 * rock.faces.len() - 4).contains(&corners.len()));
            assert!((0.3..1.2).contains(&rock.radius), "{}", rock.radius);
            for k in 0..100 {
                let angle = k as f64;
                let ahead = Vector3::new(angle.cos(), angle.sin(), (angle * 0.3).sin()).normalize();
                // Towards the middle from outside: entered, and at most its radius away.
                let (t, face) = rock.hit(&(-ahead * 2.0), &ahead).unwrap();
                let at = ahead * (t - 2.0);
                let (n, c) = rock.faces[face as usize];
                assert!((n.dot(&at) - c).abs() < 1e-9 && at.norm() <= rock.radius);
                assert!(n.dot(&ahead) < 0.0);
            }
        }
    }

    #[test]
    fn rocks_cover_the_share_asked_for_and_small_ones_are_many() {
        let surface = Surface::new(512, 0.1, Point3::origin(), None, vec![0.0; 512 * 512]);
        for share in [0.02, 0.1] {
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let list = scatter(&surface, share, &mut rng, |_| f64::MAX);
            // The cut at 5 cm leaves out a few percent of the cover.
            let q = 1.79 + 0.152 / share;
            let expected = share * (-q * 0.05f64).exp();
            let rocks = Rocks::new(&surface, list);
            let mut covered = 0;
            for k in 0..40_000 {
                let (x, y) = (f64::from(k % 200) * 0.256, f64::from(k / 200) * 0.256);
                covered += u32::from(rocks.top(&surface, x, y) > 0.0);
            }
            let found = f64::from(covered) / 40_000.0;
            assert!(
                (0.8..1.15).contains(&(found / expected)),
                "{found} {expected}"
            );
            let large = rocks.list.iter().filter(|r| r.radius > 0.2).count();
            assert!(rocks.list.len() > 20 * large.max(1));
        }
    }
}
