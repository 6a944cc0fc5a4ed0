use nalgebra::{Point3, Vector2};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

use super::noise::add_noise;
use super::options::{Look, Options, RouteKind};
use super::rocks::{Rocks, scatter};
use super::rover::Plan;
use super::surface::Surface;

/// Nodes along a side of the ground that repeats, and the metres between them.
const SIDE: usize = 2048;
const CELL: f64 = 0.02;
/// Metres from the rover's middle in which no rock larger than [`PEBBLE`] may lie, and that radius.
const CLEARANCE: f64 = 1.2;
const PEBBLE: f64 = 0.04;
/// At most so many metres of route have tracks and are cleared of rocks.
const LONGEST: f64 = 500.0;

/// The invented ground: rolling sand, craters, wind ripples and an earlier drive's tracks, with
/// rocks upon it. The origin is in the middle of the square that repeats.
pub(super) fn build(options: &Options, plan: &Plan) -> (Surface, Rocks) {
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let length = (options.frames as f64 * 0.2 * options.speed + 8.0).min(LONGEST);
    let mut control = sand(rng.random(), options.route != RouteKind::Straight);
    dig_craters(&mut control, options.craters, &mut rng);
    // The sandpit of the arena: more ripples, fewer stones.
    let (windy, stony) = match options.look {
        Look::Arena => (2.0, 0.015),
        _ => (1.0, 0.05),
    };
    blow_ripples(&mut control, windy * options.ripples as f32, &mut rng);
    if options.tracks {
        press_tracks(&mut control, plan, length, &mut rng);
    }
    let surface = Surface::new(SIDE, CELL, Point3::origin(), None, control);
    let clear = Clear::new(plan, length, surface.period());
    let list = scatter(
        &surface,
        options.rocks.unwrap_or(stony),
        &mut rng,
        |place| {
            if clear.at(place) { PEBBLE } else { f64::MAX }
        },
    );
    let rocks = Rocks::new(&surface, list);
    (surface, rocks)
}

/// The places along a route where no large rock may lie, over a ground that may repeat.
pub(super) struct Clear {
    period: f64,
    marked: Vec<bool>,
}

impl Clear {
    const SQUARES: usize = 256;

    /// `period` must exceed what is asked about, where the ground does not repeat.
    pub fn new(plan: &Plan, length: f64, period: f64) -> Self {
        let mut clear = Self {
            period,
            marked: vec![false; Self::SQUARES * Self::SQUARES],
        };
        let square = period / Self::SQUARES as f64;
        let reach = (CLEARANCE / square).ceil() as i32;
        for k in 0..(length / 0.1) as usize {
            let place = plan.place(k as f64 * 0.1 - 1.0);
            for j in -reach..=reach {
                for i in -reach..=reach {
                    let at = place + Vector2::new(f64::from(i), f64::from(j)) * square;
                    let index = clear.index(at);
                    clear.marked[index] = true;
                }
            }
        }
        clear
    }

    fn index(&self, place: Vector2<f64>) -> usize {
        let along = |v: f64| {
            let share = (v / self.period).rem_euclid(1.0);
            ((share * Self::SQUARES as f64) as usize).min(Self::SQUARES - 1)
        };
        along(place.y) * Self::SQUARES + along(place.x)
    }

    pub fn at(&self, place: Vector2<f64>) -> bool {
        self.marked[self.index(place)]
    }
}

fn wrap(index: i32) -> usize {
    index as usize & (SIDE - 1)
}

/// From the middle of the square that repeats, which is the origin, to a node along one axis.
fn metres(index: usize) -> f32 {
    let half = SIDE as i32 / 2;
    ((index as i32 + half) % SIDE as i32 - half) as f32 * CELL as f32
}

/// Rolling sand of every wavelength, and the hills around the site.
fn sand(seed: u32, hills: bool) -> Vec<f32> {
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
            if !hills {
                return;
            }
            let mut lumps = vec![1.3; SIDE];
            add_noise(&mut lumps, j, 5, 2.4, seed.wrapping_add(99));
            for (i, h) in row.iter_mut().enumerate() {
                let away = ((metres(i).hypot(metres(j)) - Plan::RADIUS as f32 - 3.0) / 8.0)
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
    mut shape: impl FnMut(&mut f32, Vector2<f32>),
) {
    let reach = (radius / CELL as f32).ceil() as i32;
    let [ci, cj] = [centre.x, centre.y].map(|c| (c / CELL as f32).round() as i32);
    for j in cj - reach..=cj + reach {
        for i in ci - reach..=ci + reach {
            let offset = Vector2::new(i as f32 * CELL as f32, j as f32 * CELL as f32) - centre;
            shape(&mut control[wrap(j) * SIDE + wrap(i)], offset);
        }
    }
}

/// Bowls with a raised rim. Their number above a radius falls as its -2nd power, as on surfaces
/// where small craters wear away as fast as they form (Trask 1966); the shape, a depth of a
/// sixth of the radius when fresh, less when old, with a rim of a quarter of that.
fn dig_craters(control: &mut [f32], amount: f64, rng: &mut ChaCha8Rng) {
    let half = (SIDE as f64 * CELL / 2.0) as f32;
    for _ in 0..(90.0 * amount) as usize {
        let centre = Vector2::new(rng.random_range(-half..half), rng.random_range(-half..half));
        let radius = 0.25 * rng.random_range(0.004f32..1.0).powf(-0.5);
        let depth = 0.18 * radius * rng.random_range(0.4..1.0f32);
        around(control, centre, 2.0 * radius, |h, offset| {
            let r = offset.norm() / radius;
            let bowl = if r < 1.0 { -depth * (1.0 - r * r) } else { 0.0 };
            let rim = 0.3 * depth * (-((r - 1.0) / 0.25).powi(2)).exp();
            *h += bowl + rim;
        });
    }
}

/// Ripples of 14 cm across the wind, in patches: a long rise on the windward side and a short fall
/// in the lee; crests wander and fork where noise bends their phase.
fn blow_ripples(control: &mut [f32], amount: f32, rng: &mut ChaCha8Rng) {
    const HEIGHT: f32 = 0.012;
    if amount == 0.0 {
        return;
    }
    let seed: u32 = rng.random();
    // Whole waves a period along both axes, so that ripples go on where the ground repeats.
    let angle = rng.random_range(0.0..std::f32::consts::TAU);
    let waves = (SIDE as f32 * CELL as f32 / 0.14, angle);
    let [kx, ky] = [waves.0 * waves.1.cos(), waves.0 * waves.1.sin()].map(f32::round);
    control
        .par_chunks_mut(SIDE)
        .enumerate()
        .for_each(|(j, row)| {
            let (mut bend, mut patch) = (vec![0.0; SIDE], vec![0.1; SIDE]);
            for (waves, amplitude) in [(9, 1.6), (31, 1.1), (83, 0.6)] {
                add_noise(&mut bend, j, waves, amplitude, seed.wrapping_add(waves));
            }
            add_noise(&mut patch, j, 6, 1.8, seed.wrapping_add(1));
            for (i, h) in row.iter_mut().enumerate() {
                let turns = (kx * i as f32 + ky * j as f32) / SIDE as f32 + bend[i];
                let phase = turns - turns.floor();
                // Seven tenths of the wave rise, the rest falls.
                let rise = if phase < 0.7 {
                    phase / 0.7
                } else {
                    (1.0 - phase) / 0.3
                };
                let smooth = rise * rise * (3.0 - 2.0 * rise);
                *h += HEIGHT * amount * patch[i].clamp(0.0, 1.0) * (smooth - 0.5);
            }
        });
}

/// The tracks of an earlier drive beside the route and across it: two ruts with pressed cleats and
/// raised edges.
fn press_tracks(control: &mut [f32], plan: &Plan, length: f64, rng: &mut ChaCha8Rng) {
    const STEP: f64 = 0.01;
    /// From the middle of the rover to the middle of a wheel, and half a wheel's width, metres.
    const WHEEL: (f64, f64) = (0.35, 0.075);
    const CLEAT: f64 = 0.065;
    let (phase, depth) = (
        rng.random_range(0.0..std::f64::consts::TAU),
        rng.random_range(0.008..0.02f32),
    );
    // A node belongs to the nearest sample of a rut and is pressed once.
    let mut pressed: Vec<(u32, f32, f32)> = Vec::new();
    for k in 0..(length / STEP) as usize {
        let s = k as f64 * STEP;
        let ahead = (plan.place(s + 1e-3) - plan.place(s - 1e-3)).normalize();
        let left = Vector2::new(-ahead.y, ahead.x);
        let beside = 0.9 * (s / 3.7 + phase).sin() + 0.35 * (s / 1.3).sin();
        for side in [-WHEEL.0, WHEEL.0] {
            let middle = (plan.place(s) + left * (beside + side)).cast::<f32>();
            let cleat = (s / CLEAT).fract() < 0.3;
            let reach = ((WHEEL.1 + 0.06) / CELL).ceil() as i32;
            let [ci, cj] = [middle.x, middle.y].map(|c| (c / CELL as f32).round() as i32);
            for j in cj - reach..=cj + reach {
                for i in ci - reach..=ci + reach {
                    let node = Vector2::new(i as f32, j as f32) * CELL as f32;
                    let offset = node - middle;
                    let along = offset.dot(&ahead.cast());
                    if along.abs() > STEP as f32 {
                        continue;
                    }
                    let across = offset.dot(&left.cast()).abs() / WHEEL.1 as f32;
                    let rut = if across < 1.0 {
                        -depth * (if cleat { 1.35 } else { 0.8 })
                    } else {
                        0.5 * depth * (-((across - 1.25) / 0.25).powi(2)).exp()
                    };
                    pressed.push(((wrap(j) * SIDE + wrap(i)) as u32, along.abs(), rut));
                }
            }
        }
    }
    pressed.sort_by(|a, b| (a.0, a.1).partial_cmp(&(b.0, b.1)).unwrap_or(a.0.cmp(&b.0)));
    pressed.dedup_by_key(|(node, ..)| *node);
    for (node, _, rut) in pressed {
        control[node as usize] += rut;
    }
}

/// The ground of a seed, for tests.
#[cfg(test)]
pub(super) fn example(seed: u64) -> (Surface, Rocks) {
    let options = Options {
        seed,
        ..Options::default()
    };
    build(&options, &Plan::new(&options))
}
