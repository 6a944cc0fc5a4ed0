//! Outlines of a dense disparity put where the images have them.

use std::ops::Range;

use barchan_datasets::{Rgb, luma};
use multiversion::multiversion;
use rayon::prelude::*;

use crate::classical::{Census, MOST_DIFFERENT, census};
use crate::engine::{DisparityEngine, DisparityMap, InferError};

/// Puts outlines where the images have them: a matching window that reaches over an outline fattens the
/// nearer surface, and what works at a quarter of the resolution draws outlines as coarsely.
///
/// Every pixel may take over the surface of a pixel up to ten away, disparity and slope, if full-resolution
/// likeness (census, weighed by colour around the pixel) and the neighbours' choices, along four
/// paths, agree: semi-global matching (Hirschmüller 2008) among few planes, proposed as in PatchMatch stereo
/// (Bleyer 2011). What nearer surfaces hide from the right camera is no match at all, and costs as much
/// whatever it is taken for.
#[derive(Clone, Copy, Debug)]
pub struct Outlines {
    /// How often: each pass moves outlines by up to ten pixels.
    pub passes: usize,
}

impl Default for Outlines {
    fn default() -> Self {
        Self { passes: 2 }
    }
}

/// Distances along an axis at which surfaces are proposed, pixels.
const REACH: [isize; 5] = [-10, -5, 0, 5, 10];
/// Proposals closer than this to one there is are the same, pixels.
const SAME: f32 = 1.0;
/// Most surfaces that a pixel chooses from.
const MOST: usize = 8;
/// Steeper disparity is an outline and no slope.
const STEEPEST: f32 = 0.5;
/// Where likeness is looked at around a pixel, along an axis.
const WINDOW: [isize; 3] = [-4, 0, 4];
/// Cost of what has no match in the right image, in shares of the bits of a census.
const UNSEEN: f32 = 0.3;
/// What a proposal must be better by than what is there.
const MARGIN: f32 = 0.03;
/// Cost of a pixel of disparity between neighbours, and the most, where nothing is seen between them.
const BEND: f32 = 0.1;
const BREAK: f32 = 0.5;
/// The difference of colour by which the most falls to 1/e, and the least share that is left of it.
const CONTRAST: f32 = 0.05;
const LEAST_BREAK: f32 = 0.1;
/// The difference of colour by which a pixel of the window counts less by e, and the distance.
const LIKE: f32 = 0.06;
const NEAR: f32 = 5.0;

/// What the pixels of a row choose from, where they have a choice. The `k`th such pixel lies at column
/// `columns[k]`, and `first[k]..first[k + 1]` are its surfaces; what it is already comes first.
#[derive(Default)]
struct Choices {
    columns: Vec<u32>,
    first: Vec<u32>,
    disparity: Vec<f32>,
    /// The pixel of the image that a surface is taken from.
    source: Vec<u32>,
    cost: Vec<f32>,
    /// Of each column, which of `columns` it is; [`NONE`] where there is no choice.
    slot: Vec<u32>,
}

/// No choice.
const NONE: u32 = u32::MAX;

impl Choices {
    fn of(&self, k: usize) -> Range<usize> {
        self.first[k] as usize..self.first[k + 1] as usize
    }
}

/// An image whose differences of colour are whole numbers, so that weights by them are looked up.
struct Colours {
    width: usize,
    height: usize,
    pixels: Vec<[u8; 3]>,
}

/// Most that two colours differ, over three channels.
const MOST_CONTRAST: usize = 3 * 255;

impl Colours {
    fn of(image: &Rgb) -> Self {
        let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
        let pixels = image.as_raw().chunks_exact(3);
        Self {
            width: image.width() as usize,
            height: image.height() as usize,
            pixels: pixels
                .map(|p| [byte(p[0]), byte(p[1]), byte(p[2])])
                .collect(),
        }
    }

    /// How much two pixels differ, summed over the channels.
    #[inline(always)]
    fn contrast(&self, a: usize, b: usize) -> usize {
        let [a, b] = [self.pixels[a], self.pixels[b]];
        (0..3).map(|c| usize::from(a[c].abs_diff(b[c]))).sum()
    }
}

/// `exp(-contrast / scale)` for every contrast, of colours in `0..=1`.
fn falling(scale: f32) -> Vec<f32> {
    let share = |sum: usize| sum as f32 / MOST_CONTRAST as f32;
    (0..=MOST_CONTRAST)
        .map(|sum| (-share(sum) / scale).exp())
        .collect()
}

impl Outlines {
    /// Moves the outlines of `map` to those of the images. Sigma and confidence come along from where a
    /// disparity is taken. Unknown disparity stays unknown.
    pub fn sharpen(&self, left: &Rgb, right: &Rgb, map: &mut DisparityMap) {
        let (width, height) = (left.width() as usize, left.height() as usize);
        let fits = map.disparity.dimensions() == left.dimensions();
        if width < 2 || height < 2 || right.dimensions() != left.dimensions() || !fits {
            return;
        }
        let colours = Colours::of(left);
        let seen = [census(&luma(left)), census(&luma(right))];
        let breaks: Vec<f32> = (falling(CONTRAST).iter())
            .map(|share| BREAK * share.max(LEAST_BREAK))
            .collect();
        let likeness = falling(LIKE);
        for _ in 0..self.passes {
            let d = map.disparity.as_raw();
            let nearest = nearest_in_right(d, width);
            let slopes = slopes(d, width);
            let rows: Vec<Choices> = (0..height)
                .into_par_iter()
                .map(|y| {
                    let mut row = propose(d, &slopes, [width, height], y);
                    judge(&mut row, &colours, &likeness, &seen, &nearest, y);
                    row
                })
                .collect();
            let totals = follow_paths(&rows, d, &colours, &breaks);
            let mut moved = map.clone();
            for (y, (row, totals)) in rows.iter().zip(&totals).enumerate() {
                for (k, &x) in row.columns.iter().enumerate() {
                    let best = cheapest(&totals[row.of(k)]) + row.of(k).start;
                    let (here, source) = (y * width + x as usize, row.source[best] as usize);
                    moved.disparity.as_flat_samples_mut().samples[here] = row.disparity[best];
                    moved.sigma.as_flat_samples_mut().samples[here] = map.sigma.as_raw()[source];
                    moved.confidence.as_flat_samples_mut().samples[here] =
                        map.confidence.as_raw()[source];
                }
            }
            *map = moved;
        }
    }
}

/// The first of the least.
fn cheapest(totals: &[f32]) -> usize {
    (1..totals.len()).fold(0, |best, i| if totals[i] < totals[best] { i } else { best })
}

/// The largest disparity that lands on each pixel of the right image; 0 where none does.
fn nearest_in_right(disparity: &[f32], width: usize) -> Vec<f32> {
    let mut nearest = vec![0.0f32; disparity.len()];
    let rows = nearest
        .par_chunks_mut(width)
        .zip(disparity.par_chunks(width));
    rows.for_each(|(nearest, row)| {
        for (x, d) in row.iter().enumerate() {
            let at = x as isize - (d + 0.5) as isize;
            if let Some(there) = usize::try_from(at).ok().and_then(|at| nearest.get_mut(at)) {
                // An unknown disparity is never the larger.
                *there = there.max(*d);
            }
        }
    });
    nearest
}

/// Slope of the disparity along x and y at every pixel: the flatter of the two sides; 0 where they
/// disagree, an outline is near, or a side is unknown. At the border there is one side.
fn slopes(d: &[f32], width: usize) -> [Vec<f32>; 2] {
    let slope = |before: f32, here: f32, after: f32| {
        let (a, b) = (here - before, after - here);
        let flatter = if a.abs() < b.abs() { a } else { b };
        if a * b > 0.0 && flatter.abs() <= STEEPEST {
            flatter
        } else {
            0.0
        }
    };
    let mut all = [vec![0.0; d.len()], vec![0.0; d.len()]];
    let [along_x, along_y] = &mut all;
    let rows = along_x
        .par_chunks_mut(width)
        .zip(along_y.par_chunks_mut(width));
    rows.enumerate().for_each(|(y, (along_x, along_y))| {
        let row = &d[y * width..][..width];
        for (x, w) in row.windows(3).enumerate() {
            along_x[x + 1] = slope(w[0], w[1], w[2]);
        }
        along_x[0] = slope(2.0 * row[0] - row[1], row[0], row[1]);
        let [inner, last] = [row[width - 2], row[width - 1]];
        along_x[width - 1] = slope(inner, last, 2.0 * last - inner);
        let above = y.checked_sub(1).map(|y| &d[y * width..][..width]);
        let below = (y + 2 <= d.len() / width).then(|| &d[(y + 1) * width..][..width]);
        for (x, out) in along_y.iter_mut().enumerate() {
            *out = match (above, below) {
                (Some(above), Some(below)) => slope(above[x], row[x], below[x]),
                (None, Some(below)) => slope(2.0 * row[x] - below[x], row[x], below[x]),
                (Some(above), None) => slope(above[x], row[x], 2.0 * row[x] - above[x]),
                (None, None) => 0.0,
            };
        }
    });
    all
}

/// What the pixels of a row may be: what they are, then the surfaces around, the nearest first.
#[multiversion(targets("x86_64+avx2+popcnt", "aarch64+neon"))]
fn propose(d: &[f32], slopes: &[Vec<f32>; 2], [width, height]: [usize; 2], y: usize) -> Choices {
    let mut around: Vec<[isize; 2]> = REACH
        .iter()
        .flat_map(|&dy| REACH.map(|dx| [dx, dy]))
        .filter(|&[dx, dy]| {
            let inside = dx.unsigned_abs() < width;
            let line = y.checked_add_signed(dy).filter(|&y| y < height);
            [dx, dy] != [0, 0] && inside && line.is_some()
        })
        .collect();
    around.sort_by_key(|[dx, dy]| dx * dx + dy * dy);
    // What each offset proposes, and how far it is from what is there, for the whole row at once; NaN outside.
    let row = &d[y * width..][..width];
    let mut proposals = vec![f32::NAN; around.len() * width];
    let mut farthest = vec![0.0f32; width];
    for ([dx, dy], proposals) in around.iter().zip(proposals.chunks_exact_mut(width)) {
        let line = y.saturating_add_signed(*dy) * width;
        let (from, to) = columns(width, *dx);
        let shifted = line + from.saturating_add_signed(*dx)..line + to.saturating_add_signed(*dx);
        let there = d[shifted.clone()].iter();
        let slopes = slopes[0][shifted.clone()].iter().zip(&slopes[1][shifted]);
        let here = row[from..to].iter().zip(&mut farthest[from..to]);
        let (right, down) = (*dx as f32, *dy as f32);
        for (((there, (gx, gy)), (here, farthest)), proposed) in
            there.zip(slopes).zip(here).zip(&mut proposals[from..to])
        {
            *proposed = there - gx * right - gy * down;
            let far = (*proposed - here).abs();
            // Not `max`, which asks for NaN twice.
            *farthest = if far > *farthest { far } else { *farthest };
        }
    }
    let mut choices = Choices {
        first: vec![0],
        slot: vec![NONE; width],
        ..Choices::default()
    };
    for x in (0..width).filter(|&x| farthest[x] > SAME) {
        let start = choices.disparity.len();
        choices.disparity.push(row[x]);
        choices.source.push((y * width + x) as u32);
        for (n, [dx, dy]) in around.iter().enumerate() {
            let proposed = proposals[n * width + x];
            let new = |there: &f32| (there - proposed).abs() > SAME;
            if proposed >= 0.0 && choices.disparity[start..].iter().all(new) {
                choices.disparity.push(proposed);
                let line = y.saturating_add_signed(*dy) * width;
                choices
                    .source
                    .push((line + x.saturating_add_signed(*dx)) as u32);
                if choices.disparity.len() - start == MOST {
                    break;
                }
            }
        }
        if choices.disparity.len() - start == 1 {
            choices.disparity.pop();
            choices.source.pop();
            continue;
        }
        choices.slot[x] = choices.columns.len() as u32;
        choices.columns.push(x as u32);
        choices.first.push(choices.disparity.len() as u32);
    }
    choices
}

/// The columns from which `dx` further is still inside; `dx` is less than the width.
fn columns(width: usize, dx: isize) -> (usize, usize) {
    let reach = dx.unsigned_abs();
    if dx < 0 {
        (reach, width)
    } else {
        (0, width - reach)
    }
}

/// How unlike the two images are under each proposal: differing census bits around the pixel, weighed by
/// how much the colour there is its own.
#[multiversion(targets("x86_64+avx2+popcnt", "aarch64+neon"))]
fn judge(
    row: &mut Choices,
    colours: &Colours,
    likeness: &[f32],
    seen: &[Census; 2],
    nearest: &[f32],
    y: usize,
) {
    let (width, height) = (colours.width, colours.height);
    let near = WINDOW.map(|d| (-(d.abs() as f32) / NEAR).exp());
    row.cost = vec![0.0; row.disparity.len()];
    let mut window: Vec<(usize, usize, f32)> = Vec::with_capacity(WINDOW.len() * WINDOW.len());
    for (k, &x) in row.columns.iter().enumerate() {
        let x = x as usize;
        window.clear();
        for (dy, near_y) in WINDOW.into_iter().zip(near) {
            let Some(qy) = y.checked_add_signed(dy).filter(|&qy| qy < height) else {
                continue;
            };
            for (dx, near_x) in WINDOW.into_iter().zip(near) {
                let Some(qx) = x.checked_add_signed(dx).filter(|&qx| qx < width) else {
                    continue;
                };
                let contrast = colours.contrast(y * width + x, qy * width + qx);
                window.push((qx, qy * width, near_x * near_y * likeness[contrast]));
            }
        }
        let weights: f32 = window.iter().map(|w| w.2).sum();
        let proposals = row.first[k] as usize..row.first[k + 1] as usize;
        for i in proposals.clone() {
            let d = row.disparity[i];
            let whole = (d + 0.5) as usize;
            let mut sum = 0.0;
            for &(qx, line, weight) in &window {
                // Outside the right image, or behind a nearer surface.
                let hidden = qx < whole || nearest[line + qx - whole] > d + 1.5;
                let unlike = if hidden {
                    UNSEEN
                } else {
                    let differ = seen[0].bits[line + qx] ^ seen[1].bits[line + qx - whole];
                    differ.count_ones() as f32 / f32::from(MOST_DIFFERENT)
                };
                sum += weight * unlike;
            }
            let moved = if i > proposals.start { MARGIN } else { 0.0 };
            row.cost[i] = sum / weights + moved;
        }
    }
}

/// For each row the sums of the costs along the four paths through each pixel with a choice. A pixel without
/// a choice costs nothing, whoever comes before it: paths begin anew there.
fn follow_paths(rows: &[Choices], d: &[f32], colours: &Colours, breaks: &[f32]) -> Vec<Vec<f32>> {
    let width = colours.width;
    let along_rows = |(y, row): (usize, &Choices)| {
        let mut total = row.cost.clone();
        for forward in [true, false] {
            let mut sums = vec![0.0; row.cost.len()];
            for n in 0..row.columns.len() {
                let k = if forward {
                    n
                } else {
                    row.columns.len() - 1 - n
                };
                let (here, x) = (row.of(k), row.columns[k] as usize);
                let own = (&row.disparity[here.clone()], &row.cost[here.clone()]);
                let before = if forward {
                    x.checked_sub(1)
                } else {
                    Some(x + 1)
                };
                let Some(before) = before.filter(|&x| x < width) else {
                    step((&[], &[]), own, 0.0, &mut sums[here]);
                    continue;
                };
                let limit = breaks[colours.contrast(y * width + x, y * width + before)];
                if row.slot[before] == NONE {
                    let from = (&d[y * width + before..][..1], &[0.0][..]);
                    step(from, own, limit, &mut sums[here.clone()]);
                } else {
                    let there = row.of(row.slot[before] as usize);
                    let (from, to) = two(&mut sums, there.clone(), here.clone());
                    step((&row.disparity[there], from), own, limit, to);
                }
                add_path(&mut total[here.clone()], &sums[here.clone()], own.1);
            }
        }
        total
    };
    let along_columns = |down: bool| {
        let mut all: Vec<Vec<f32>> = vec![];
        for n in 0..rows.len() {
            let y = if down { n } else { rows.len() - 1 - n };
            let row = &rows[y];
            let mut sums = vec![0.0; row.cost.len()];
            for (k, &x) in row.columns.iter().enumerate() {
                let (here, x) = (row.of(k), x as usize);
                let own = (&row.disparity[here.clone()], &row.cost[here.clone()]);
                let Some(sums_before) = all.last() else {
                    step((&[], &[]), own, 0.0, &mut sums[here]);
                    continue;
                };
                let before = if down { y - 1 } else { y + 1 };
                let limit = breaks[colours.contrast(y * width + x, before * width + x)];
                let slot = rows[before].slot[x];
                let from = if slot == NONE {
                    (&d[before * width + x..][..1], &[0.0][..])
                } else {
                    let there = rows[before].of(slot as usize);
                    (&rows[before].disparity[there.clone()], &sums_before[there])
                };
                step(from, own, limit, &mut sums[here]);
            }
            all.push(sums);
        }
        all
    };
    let mut totals: Vec<Vec<f32>> = rows.par_iter().enumerate().map(along_rows).collect();
    let (down, up) = rayon::join(|| along_columns(true), || along_columns(false));
    let columns = down.into_par_iter().zip(up.into_par_iter().rev());
    let all = totals.par_iter_mut().zip(rows).zip(columns);
    all.for_each(|((total, row), (down, up))| {
        add_path(total, &down, &row.cost);
        add_path(total, &up, &row.cost);
    });
    totals
}

/// Adds what a path says, less the pixel's own cost, which counts once.
fn add_path(total: &mut [f32], sums: &[f32], cost: &[f32]) {
    for ((total, sum), cost) in total.iter_mut().zip(sums).zip(cost) {
        *total += sum - cost;
    }
}

/// A pixel on a path: its own cost, and the least over what the pixel before may be.
fn step(
    (disparities_before, sums_before): (&[f32], &[f32]),
    (disparities, costs): (&[f32], &[f32]),
    limit: f32,
    sums: &mut [f32],
) {
    let least = sums_before.iter().copied().fold(f32::INFINITY, f32::min);
    for ((sum, d), cost) in sums.iter_mut().zip(disparities).zip(costs) {
        let mut way = limit;
        for (before, sum) in disparities_before.iter().zip(sums_before) {
            way = way.min(sum - least + BEND * ((before - d).abs() - 0.5).max(0.0));
        }
        *sum = cost + way;
    }
}

/// Two ranges of one slice that do not overlap: the first to read, the second to write.
fn two(all: &mut [f32], read: Range<usize>, write: Range<usize>) -> (&[f32], &mut [f32]) {
    if read.end <= write.start {
        let (low, high) = all.split_at_mut(write.start);
        (&low[read], &mut high[..write.len()])
    } else {
        let (low, high) = all.split_at_mut(read.start);
        (&high[..read.len()], &mut low[write])
    }
}

/// An engine whose outlines are put where the images have them.
pub struct Outlined {
    engine: Box<dyn DisparityEngine>,
    outlines: Outlines,
}

impl Outlined {
    /// `engine`, and then [`Outlines::sharpen`].
    pub fn new(engine: Box<dyn DisparityEngine>, outlines: Outlines) -> Self {
        Self { engine, outlines }
    }
}

impl DisparityEngine for Outlined {
    fn name(&self) -> String {
        self.engine.name()
    }

    fn disparity(&mut self, left: &Rgb, right: &Rgb) -> Result<DisparityMap, InferError> {
        let mut map = self.engine.disparity(left, right)?;
        self.outlines.sharpen(left, right, &mut map);
        Ok(map)
    }

    fn disparity_batch(&mut self, pairs: &[(&Rgb, &Rgb)]) -> Result<Vec<DisparityMap>, InferError> {
        let mut maps = self.engine.disparity_batch(pairs)?;
        for ((left, right), map) in pairs.iter().zip(&mut maps) {
            self.outlines.sharpen(left, right, map);
        }
        Ok(maps)
    }
}

#[cfg(test)]
mod tests {
    use barchan_datasets::Plane;

    use super::*;

    const WIDTH: u32 = 160;
    const HEIGHT: u32 = 96;

    /// Greys that no two places share.
    fn texture(x: i64, y: i64) -> f32 {
        let mut h = (x.wrapping_mul(0x9e37_79b9) ^ y.wrapping_mul(0x85eb_ca6b)) as u64;
        h ^= h >> 13;
        h = h.wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        ((h >> 40) & 0xff) as f32 / 255.0
    }

    /// A square of `near` before a wall of `far`, and the true disparity of the left image.
    fn square_before_wall(near: i64, far: i64) -> (Rgb, Rgb, Plane) {
        let inside = |x: i64, y: i64| (60..110).contains(&x) && (25..70).contains(&y);
        let grey = |v: f32| image::Rgb([v; 3]);
        let wall = |x: i64, y: i64| 0.6 + 0.4 * texture(x, y);
        let front = |x: i64, y: i64| 0.4 * texture(x + 5000, y);
        let left = Rgb::from_fn(WIDTH, HEIGHT, |x, y| {
            let (x, y) = (i64::from(x), i64::from(y));
            grey(if inside(x, y) {
                front(x, y)
            } else {
                wall(x, y)
            })
        });
        let right = Rgb::from_fn(WIDTH, HEIGHT, |x, y| {
            let (x, y) = (i64::from(x), i64::from(y));
            grey(if inside(x + near, y) {
                front(x + near, y)
            } else {
                wall(x + far, y)
            })
        });
        let truth = Plane::from_fn(WIDTH, HEIGHT, |x, y| {
            let near_here = inside(i64::from(x), i64::from(y));
            image::Luma([if near_here { near } else { far } as f32])
        });
        (left, right, truth)
    }

    fn map_of(disparity: Plane) -> DisparityMap {
        let sigma = Plane::from_pixel(WIDTH, HEIGHT, image::Luma([0.3]));
        DisparityMap {
            confidence: sigma.clone(),
            sigma,
            disparity,
        }
    }

    fn wrong(map: &DisparityMap, truth: &Plane) -> usize {
        let pairs = map.disparity.as_raw().iter().zip(truth.as_raw());
        pairs.filter(|(d, t)| (*d - *t).abs() > 1.0).count()
    }

    #[test]
    fn a_fattened_square_gets_its_outline_back() {
        let (left, right, truth) = square_before_wall(20, 6);
        // Seven pixels too large on every side, as a window of fifteen makes it.
        let fat = Plane::from_fn(WIDTH, HEIGHT, |x, y| {
            let near = (53..117).contains(&x) && (18..77).contains(&y);
            image::Luma([if near { 20.0 } else { 6.0 }])
        });
        let mut map = map_of(fat);
        let before = wrong(&map, &truth);
        Outlines::default().sharpen(&left, &right, &mut map);
        let after = wrong(&map, &truth);
        assert!(
            before > 1400 && after < before / 20,
            "{before} wrong, then {after}"
        );
    }

    #[test]
    fn truth_and_slopes_stay_and_what_is_unknown_stays_unknown() {
        let (left, right, truth) = square_before_wall(20, 6);
        let mut map = map_of(truth.clone());
        map.disparity.put_pixel(10, 10, image::Luma([f32::NAN]));
        Outlines::default().sharpen(&left, &right, &mut map);
        assert!(map.disparity.get_pixel(10, 10)[0].is_nan());
        map.disparity.put_pixel(10, 10, *truth.get_pixel(10, 10));
        assert!(wrong(&map, &truth) < 20, "{} moved", wrong(&map, &truth));

        let slope = Plane::from_fn(WIDTH, HEIGHT, |x, y| {
            image::Luma([5.0 + 0.1 * x as f32 + 0.2 * y as f32])
        });
        let mut map = map_of(slope.clone());
        Outlines::default().sharpen(&left, &right, &mut map);
        assert!(map.disparity == slope, "a slope moved");
    }

    #[test]
    fn small_and_unknown_maps_do_no_harm() {
        let sizes = [(1, 1), (2, 2), (1, 9), (3, 40)];
        for (width, height) in sizes {
            let image = Rgb::from_pixel(width, height, image::Rgb([0.5; 3]));
            for value in [f32::NAN, f32::INFINITY, -3.0, 0.0, 1e30] {
                let plane = Plane::from_fn(width, height, |x, _| {
                    image::Luma([if x % 2 == 0 { value } else { 4.0 }])
                });
                let mut map = DisparityMap {
                    disparity: plane.clone(),
                    sigma: plane.clone(),
                    confidence: plane,
                };
                Outlines::default().sharpen(&image, &image, &mut map);
            }
        }
    }
}
