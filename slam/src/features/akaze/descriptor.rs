//! What a feature looks like: its orientation and the modified local difference binary
//! (Alcantarilla 2013, 3.4).

use std::f32::consts::{FRAC_PI_2, PI, SQRT_2, TAU};

use multiversion::multiversion;
use nalgebra::Vector2;

use super::extrema::Peak;
use super::scale_space::Level;
use crate::features::Descriptor;

/// Bits of a descriptor: 3 channels; 6, 36 and 120 pairs of the cells of three grids.
pub(super) const BITS: u32 = 3 * (6 + 36 + 120);
/// How far the samples of a descriptor reach, in spacings of the level: the corner of a square.
pub(super) const REACH: f32 = RADIUS as f32 * SQRT_2;

/// Samples of a descriptor lie on a square lattice that reaches so far from the middle.
const RADIUS: i32 = 10;
const SIDE: usize = 2 * RADIUS as usize + 1;
type Samples = [f32; SIDE * SIDE];

/// The descriptor of a peak: comparisons of the means of brightness and of its two derivatives, over
/// the cells of three grids that turn with the feature.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn describe(level: &Level, peak: &Peak) -> Descriptor {
    let samples = sample(level, peak, orientation(level, peak));
    let mut bits = Bits::default();
    for channel in &samples {
        compare::<4>(&cell_sums(channel, 2, 10), &mut bits);
        compare::<9>(&cell_sums(channel, 3, 7), &mut bits);
        compare::<16>(&cell_sums(channel, 4, 5), &mut bits);
    }
    bits.bytes()
}

/// Cosine and sine of the direction in which most of the brightness around a peak rises: the
/// longest sum of gradients within any sixth of a circle.
#[inline(always)]
fn orientation(level: &Level, peak: &Peak) -> Vector2<f32> {
    /// Samples reach less than so many spacings, and weigh by a bell of this width.
    const REACH: i32 = 6;
    const BELL: f32 = 2.5;
    const SIDE: usize = 2 * REACH as usize - 1;
    /// Slices of the circle, and how many of them are a sixth.
    const SLICES: usize = 42;
    const WINDOW: usize = SLICES / 6;
    let (width, height) = (level.image.width() as i32, level.image.height() as i32);
    let [dx, dy] = level
        .gradient
        .each_ref()
        .map(|plane| plane.as_raw().as_slice());
    let spacing = level.spacing as i32;
    let (cx, cy) = (peak.at.x.round() as i32, peak.at.y.round() as i32);
    let offsets: [i32; SIDE] = std::array::from_fn(|k| k as i32 + 1 - REACH);
    let bell = offsets.map(|i| (-0.5 * (i * i) as f32 / (BELL * BELL)).exp());
    let (mut x, mut y) = ([0.0; SIDE * SIDE], [0.0; SIDE * SIDE]);
    for (k, (j, weight_j)) in offsets.iter().zip(&bell).enumerate() {
        let row = (cy + j * spacing).clamp(0, height - 1) * width;
        for (l, (i, weight_i)) in offsets.iter().zip(&bell).enumerate() {
            if i * i + j * j < REACH * REACH {
                let at = (row + (cx + i * spacing).clamp(0, width - 1)) as usize;
                x[k * SIDE + l] = weight_i * weight_j * dx[at];
                y[k * SIDE + l] = weight_i * weight_j * dy[at];
            }
        }
    }
    let mut turns = [0.0; SIDE * SIDE];
    for k in 0..SIDE * SIDE {
        turns[k] = turn(x[k], y[k]);
    }
    let mut slices = [Vector2::zeros(); SLICES];
    for k in 0..SIDE * SIDE {
        let slice = ((turns[k] * SLICES as f32) as usize).min(SLICES - 1);
        slices[slice] += Vector2::new(x[k], y[k]);
    }
    let mut longest = Vector2::zeros();
    for first in 0..SLICES {
        let sum: Vector2<f32> = (first..first + WINDOW).map(|k| slices[k % SLICES]).sum();
        if sum.norm_squared() > longest.norm_squared() {
            longest = sum;
        }
    }
    longest.try_normalize(0.0).unwrap_or(Vector2::x())
}

/// The angle of a vector as a share of a turn, in 0..=1, to a hundred-thousandth: a polynomial that
/// many lanes can compute at once.
#[inline(always)]
fn turn(x: f32, y: f32) -> f32 {
    let (long, short) = (x.abs().max(y.abs()), x.abs().min(y.abs()));
    let t = short / long.max(f32::MIN_POSITIVE);
    let s = t * t;
    let polynomial = 0.052_653_32 - s * 0.011_721_2;
    let polynomial = -0.116_432_87 + s * polynomial;
    let polynomial = 0.193_543_46 + s * polynomial;
    let polynomial = -0.332_623_47 + s * polynomial;
    let octant = t * (0.999_977_26 + s * polynomial);
    let quadrant = if y.abs() > x.abs() {
        FRAC_PI_2 - octant
    } else {
        octant
    };
    let half = if x < 0.0 { PI - quadrant } else { quadrant };
    (if y < 0.0 { TAU - half } else { half }) / TAU
}

/// Brightness and its derivatives along and across the orientation, on a lattice that turns with it.
#[inline(always)]
fn sample(level: &Level, peak: &Peak, along: Vector2<f32>) -> [Samples; 3] {
    let (right, bottom) = (
        level.image.width() as i32 - 1,
        level.image.height() as i32 - 1,
    );
    let step = level.spacing as f32 * along;
    let mut places = [0i32; SIDE * SIDE];
    for (row, j) in places.chunks_exact_mut(SIDE).zip(-RADIUS..) {
        let (x, y) = (peak.at.x - j as f32 * step.y, peak.at.y + j as f32 * step.x);
        for (k, place) in row.iter_mut().enumerate() {
            let i = (k as i32 - RADIUS) as f32;
            let (x, y) = ((x + i * step.x + 0.5) as i32, (y + i * step.y + 0.5) as i32);
            *place = y.clamp(0, bottom) * (right + 1) + x.clamp(0, right);
        }
    }
    let planes = [&level.image, &level.gradient[0], &level.gradient[1]];
    let mut samples = planes.map(|plane| {
        let pixels = plane.as_raw().as_slice();
        places.map(|place| pixels[place as usize])
    });
    let [_, dx, dy] = &mut samples;
    for (x, y) in dx.iter_mut().zip(dy) {
        (*x, *y) = (along.x * *x + along.y * *y, along.x * *y - along.y * *x);
    }
    samples
}

/// The sum of the samples in each cell of a grid that begins at the lattice's first corner: `cells`
/// along each side, of `side` samples each. Sums compare as means do.
#[inline(always)]
fn cell_sums<const N: usize>(samples: &Samples, cells: usize, side: usize) -> [f32; N] {
    let mut sums = [0.0; N];
    for cy in 0..cells {
        let mut columns = [0.0; SIDE];
        for row in samples.chunks_exact(SIDE).skip(cy * side).take(side) {
            for x in 0..SIDE {
                columns[x] += row[x];
            }
        }
        for cx in 0..cells {
            sums[cy * cells + cx] = columns[cx * side..(cx + 1) * side].iter().sum();
        }
    }
    sums
}

/// A bit for each pair of cells: whether the first has more.
#[inline(always)]
fn compare<const N: usize>(sums: &[f32; N], bits: &mut Bits) {
    for i in 0..N - 1 {
        let mut more = 0;
        for j in 0..N {
            more |= u64::from(sums[i] > sums[j]) << j;
        }
        bits.push(more >> (i + 1), N - 1 - i);
    }
}

/// Bits written one after another, from the lowest of the first word on.
#[derive(Default)]
struct Bits {
    words: [u64; 8],
    count: usize,
}

impl Bits {
    /// Adds the lowest `count` bits of a word whose others are zero.
    #[inline(always)]
    fn push(&mut self, bits: u64, count: usize) {
        let (word, shift) = (self.count / 64, self.count % 64);
        self.words[word] |= bits << shift;
        if shift + count > 64 {
            self.words[word + 1] |= bits >> (64 - shift);
        }
        self.count += count;
    }

    fn bytes(&self) -> Descriptor {
        let mut bytes = [0; 64];
        for (bytes, word) in bytes.chunks_exact_mut(8).zip(self.words) {
            bytes.copy_from_slice(&word.to_le_bytes());
        }
        bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_are_those_of_the_arc_tangent() {
        for k in 0..1000 {
            let angle = (k as f32 + 0.5) / 1000.0 * TAU;
            let (y, x) = angle.sin_cos();
            assert!(
                (turn(3.0 * x, 3.0 * y) * TAU - angle).abs() < 3e-5,
                "{angle}"
            );
        }
        assert_eq!(turn(0.0, 0.0), 0.0);
    }

    #[test]
    fn bits_follow_each_other_over_words() {
        let mut bits = Bits::default();
        let runs = [(0b1u64, 1), (0x7fff, 15), (0, 45), (0b10101, 5), (0b111, 3)];
        for (word, count) in runs {
            bits.push(word, count);
        }
        let bytes = bits.bytes();
        let set: Vec<usize> = (0..512)
            .filter(|i| bytes[i / 8] >> (i % 8) & 1 == 1)
            .collect();
        let expected: Vec<usize> = (0..16).chain([61, 63, 65, 66, 67, 68]).collect();
        assert_eq!(set, expected);
    }
}
