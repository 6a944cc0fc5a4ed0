//! What a feature looks like: its orientation and the modified local difference binary
//! (Alcantarilla 2013, 3.4).

use std::array::from_fn;
use std::f32::consts::TAU;

use nalgebra::Vector2;

use super::extrema::Peak;
use super::filters::row;
use super::scale_space::Level;
use crate::features::Descriptor;

/// Bits of a descriptor: 3 channels; 6, 36 and 120 pairs of the cells of three grids.
pub(super) const BITS: u32 = 3 * (6 + 36 + 120);
/// How far the samples of a descriptor reach, in spacings of the level: the corner of a square.
pub(super) const REACH: f32 = RADIUS as f32 * std::f32::consts::SQRT_2;

const RADIUS: i32 = 10;
const SIDE: usize = 2 * RADIUS as usize + 1;
/// Cells along a side of each grid, and samples along a side of a cell.
const GRIDS: [(usize, usize); 3] = [(2, 10), (3, 7), (4, 5)];

/// The descriptor of a peak: comparisons of the means of brightness and of its two derivatives, over
/// the cells of three grids that turn with the feature.
pub(super) fn describe(level: &Level, peak: &Peak) -> Descriptor {
    let samples = sample(level, peak, orientation(level, peak));
    let mut descriptor = [0; 64];
    let mut bit = 0;
    for (cells, side) in GRIDS {
        for channel in &samples {
            let sums = cell_sums(channel, cells, side);
            for (i, a) in sums[..cells * cells].iter().enumerate() {
                for b in &sums[i + 1..cells * cells] {
                    descriptor[bit / 8] |= u8::from(a > b) << (bit % 8);
                    bit += 1;
                }
            }
        }
    }
    descriptor
}

/// Cosine and sine of the direction in which most of the brightness around a peak rises: the
/// longest sum of gradients within any sixth of a circle.
fn orientation(level: &Level, peak: &Peak) -> Vector2<f32> {
    /// Samples reach so many spacings, and weigh by a bell of this width.
    const REACH: i32 = 6;
    const BELL: f32 = 2.5;
    /// Slices of the circle, and how many of them are a sixth.
    const SLICES: usize = 42;
    const WINDOW: usize = SLICES / 6;
    let spacing = level.spacing as i32;
    let (cx, cy) = (peak.at.x.round() as i32, peak.at.y.round() as i32);
    let mut slices = [Vector2::zeros(); SLICES];
    for j in -REACH..=REACH {
        let y = (cy + j * spacing).clamp(0, level.image.height() as i32 - 1);
        let [dx, dy] = level
            .gradient
            .each_ref()
            .map(|plane| row(plane, y as usize));
        for i in -REACH..=REACH {
            let squared = i * i + j * j;
            if squared >= REACH * REACH {
                continue;
            }
            let x = (cx + i * spacing).clamp(0, dx.len() as i32 - 1) as usize;
            let gradient = Vector2::new(dx[x], dy[x]);
            let turn = gradient.y.atan2(gradient.x) / TAU;
            let slice = ((turn + 0.5) * SLICES as f32) as usize % SLICES;
            slices[slice] += (-0.5 * squared as f32 / (BELL * BELL)).exp() * gradient;
        }
    }
    let window = |first: usize| -> Vector2<f32> {
        (first..first + WINDOW).map(|k| slices[k % SLICES]).sum()
    };
    (0..SLICES)
        .map(window)
        .max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))
        .and_then(|sum| sum.try_normalize(0.0))
        .unwrap_or(Vector2::x())
}

/// Brightness and its derivatives along and across the orientation, on a lattice that turns with it.
fn sample(level: &Level, peak: &Peak, along: Vector2<f32>) -> [[f32; SIDE * SIDE]; 3] {
    let (width, height) = (level.image.width() as i32, level.image.height() as i32);
    let [image, dx, dy] =
        [&level.image, &level.gradient[0], &level.gradient[1]].map(|p| p.as_raw());
    let step = level.spacing as f32 * along;
    let mut samples = [[0.0; SIDE * SIDE]; 3];
    for k in 0..SIDE * SIDE {
        let i = ((k % SIDE) as i32 - RADIUS) as f32;
        let j = ((k / SIDE) as i32 - RADIUS) as f32;
        let x = (peak.at.x + i * step.x - j * step.y + 0.5) as i32;
        let y = (peak.at.y + i * step.y + j * step.x + 0.5) as i32;
        let at = (y.clamp(0, height - 1) * width + x.clamp(0, width - 1)) as usize;
        samples[0][k] = image[at];
        samples[1][k] = along.x * dx[at] + along.y * dy[at];
        samples[2][k] = along.x * dy[at] - along.y * dx[at];
    }
    samples
}

/// The sum of the samples in each cell of a grid that begins at the lattice's first corner; means
/// compare as sums do.
fn cell_sums(samples: &[f32; SIDE * SIDE], cells: usize, side: usize) -> [f32; 16] {
    let mut sums = [0.0; 16];
    for cy in 0..cells {
        let columns: [f32; SIDE] = from_fn(|x| {
            let rows = cy * side..(cy + 1) * side;
            rows.map(|y| samples[y * SIDE + x]).sum()
        });
        for cx in 0..cells {
            sums[cy * cells + cx] = columns[cx * side..(cx + 1) * side].iter().sum();
        }
    }
    sums
}
