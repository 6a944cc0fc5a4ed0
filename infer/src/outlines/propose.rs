//! What a pixel may be: the surfaces around it, and what a second opinion takes it for.

use multiversion::multiversion;
use rayon::prelude::*;

/// Distances along an axis at which surfaces are proposed, pixels.
const REACH: [isize; 5] = [-10, -5, 0, 5, 10];
/// Proposals closer than this to one there is are the same, pixels.
const SAME: f32 = 1.0;
/// A surface that moved by less has not moved, pixels.
const FAR: f32 = 2.0;
/// Most surfaces that a pixel chooses from: a register of AVX2.
pub(super) const MOST: usize = 8;
/// Steeper disparity is an outline and no slope.
const STEEPEST: f32 = 0.5;
/// How far to each side a slope is looked at, pixels: next to each other, noise looks like slopes.
const BESIDE: usize = 2;
/// Columns that are worked on at once.
const LANES: usize = 64;
/// Unknown surface around the image, so that all of it is inside.
const PAD: usize = 16;

/// Disparity and its slopes along x and y, with a frame of unknown surface around.
pub(super) struct Surfaces {
    stride: usize,
    planes: [Vec<f32>; 3],
}

/// Where surfaces moved, in tiles of a row. What is farther than a proposal reaches from all of that would
/// choose as before.
pub(super) struct Moved {
    /// Tiles of a row.
    tiles: usize,
    flags: Vec<bool>,
}

/// Columns of a tile.
const TILE: usize = 16;

impl Moved {
    /// As if all surfaces had moved.
    pub fn everywhere(width: usize, height: usize) -> Self {
        let tiles = width.div_ceil(TILE);
        Self {
            tiles,
            flags: vec![true; tiles * height],
        }
    }

    /// Compares two disparities of the same pixels.
    pub fn set(&mut self, before: &[f32], after: &[f32], width: usize) {
        let rows = before.par_chunks(width).zip(after.par_chunks(width));
        self.flags
            .par_chunks_mut(self.tiles)
            .zip(rows)
            .for_each(|(flags, (before, after))| {
                let tiles = before.chunks(TILE).zip(after.chunks(TILE));
                for (flag, (before, after)) in flags.iter_mut().zip(tiles) {
                    *flag = before.iter().zip(after).any(|(a, b)| (a - b).abs() > FAR);
                }
            });
    }

    /// Whether anything that [`LANES`] pixels might take over has moved, or they themselves.
    fn near(&self, x: usize, y: usize) -> bool {
        let reach = REACH[REACH.len() - 1] as usize;
        let rows = self.flags.chunks_exact(self.tiles);
        let first = y.saturating_sub(reach);
        let tiles =
            x.saturating_sub(reach) / TILE..self.tiles.min((x + LANES + reach).div_ceil(TILE));
        rows.skip(first)
            .take(y + reach + 1 - first)
            .any(|row| row[tiles.clone()].contains(&true))
    }
}

/// What the pixels of a row choose from, where they have a choice. What it is already comes first.
#[derive(Clone, Default)]
pub(super) struct Choices {
    /// Where the pixels with a choice lie.
    pub columns: Vec<u32>,
    /// Of each column, which of `columns` it is; [`NONE`] where there is no choice.
    pub slot: Vec<u32>,
    /// How many surfaces there are.
    pub count: Vec<u8>,
    pub disparity: Vec<[f32; MOST]>,
    /// Where a surface comes from: 0 for what it is already, [`OPINION`], or which of [`offsets`], counted from [`AROUND`].
    pub source: Vec<[u8; MOST]>,
    /// How unlike the images are; [`NEVER`] beyond `count`.
    pub cost: Vec<[f32; MOST]>,
}

/// Source of a surface that the second opinion proposes, and of the first that a pixel around does.
pub(super) const OPINION: usize = 1;
pub(super) const AROUND: usize = 2;
/// No choice.
pub(super) const NONE: u32 = u32::MAX;
/// The cost of what is no choice; finite, so that differences are numbers.
pub(super) const NEVER: f32 = 1e9;

/// Where surfaces are taken from, `[x, y]`, the nearest first.
pub(super) fn offsets() -> Vec<[isize; 2]> {
    let mut around: Vec<[isize; 2]> = (REACH.iter())
        .flat_map(|&dy| REACH.map(|dx| [dx, dy]))
        .filter(|offset| *offset != [0, 0])
        .collect();
    around.sort_by_key(|[dx, dy]| dx * dx + dy * dy);
    around
}

impl Surfaces {
    /// Nothing known of an image of this size.
    pub fn unknown(width: usize, height: usize) -> Self {
        let stride = width.next_multiple_of(LANES) + 2 * PAD;
        let plane = vec![f32::NAN; stride * (height + 2 * PAD)];
        Self {
            stride,
            planes: [plane.clone(), plane.clone(), plane],
        }
    }

    /// Slope of the disparity along x and y at every pixel: the flatter of the two sides; 0 where they
    /// disagree, an outline is near, or a side is unknown. At the border there is one side.
    pub fn set(&mut self, d: &[f32], width: usize) {
        let (stride, inside) = (self.stride, PAD..PAD + width);
        let [plane, along_x, along_y] = &mut self.planes;
        let rows = (plane.par_chunks_mut(stride).skip(PAD))
            .zip(along_x.par_chunks_mut(stride).skip(PAD))
            .zip(along_y.par_chunks_mut(stride).skip(PAD))
            .zip(d.par_chunks(width))
            .enumerate();
        rows.for_each(|(y, (((plane, along_x), along_y), row))| {
            plane[inside.clone()].copy_from_slice(row);
            let line = |y: usize| d.get(y * width..(y + 1) * width);
            let beside = [y.checked_sub(BESIDE).and_then(line), line(y + BESIDE)];
            let (along_x, along_y) = (&mut along_x[inside.clone()], &mut along_y[inside.clone()]);
            slopes(row, beside, along_x, along_y);
        });
    }

    /// [`LANES`] pixels of a plane from a pixel of the image on, which may be up to [`PAD`] outside.
    #[inline(always)]
    fn lanes(&self, plane: usize, x: isize, y: isize) -> &[f32; LANES] {
        let at = (y + PAD as isize) as usize * self.stride + (x + PAD as isize) as usize;
        match self.planes[plane][at..].first_chunk() {
            Some(lanes) => lanes,
            None => &[f32::NAN; LANES],
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn slopes(row: &[f32], beside: [Option<&[f32]>; 2], along_x: &mut [f32], along_y: &mut [f32]) {
    let width = row.len();
    for x in (0..width.min(BESIDE)).chain(width.saturating_sub(BESIDE)..width) {
        // At the border what is beyond goes on as it comes.
        let sides = (
            x.checked_sub(BESIDE),
            (x + BESIDE < width).then_some(x + BESIDE),
        );
        along_x[x] = match sides {
            (Some(before), Some(after)) => slope(row[before], row[x], row[after]),
            (Some(before), None) => slope(row[before], row[x], 2.0 * row[x] - row[before]),
            (None, Some(after)) => slope(2.0 * row[x] - row[after], row[x], row[after]),
            (None, None) => 0.0,
        };
    }
    if let Some(inner) = along_x.get_mut(BESIDE..width.saturating_sub(BESIDE)) {
        for (x, out) in inner.iter_mut().enumerate() {
            *out = slope(row[x], row[x + BESIDE], row[x + 2 * BESIDE]);
        }
    }
    match beside {
        [Some(above), Some(below)] => {
            for (((out, a), here), b) in along_y.iter_mut().zip(above).zip(row).zip(below) {
                *out = slope(*a, *here, *b);
            }
        }
        [Some(one), None] | [None, Some(one)] => {
            let sign = if beside[0].is_some() { 1.0 } else { -1.0 };
            for ((out, one), here) in along_y.iter_mut().zip(one).zip(row) {
                *out = sign * slope(*one, *here, 2.0 * here - one);
            }
        }
        [None, None] => along_y.fill(0.0),
    }
}

#[inline(always)]
fn slope(before: f32, here: f32, after: f32) -> f32 {
    let (a, b) = (here - before, after - here);
    let flatter = if a.abs() < b.abs() { a } else { b } / BESIDE as f32;
    if (a * b > 0.0) & (flatter.abs() <= STEEPEST) {
        flatter
    } else {
        0.0
    }
}

/// What the pixels of a row may be: what they are, what the second opinion takes them for, then the surfaces
/// around, the nearest first.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn propose(
    surfaces: &Surfaces,
    offsets: &[[isize; 2]],
    opinion: Option<&[f32]>,
    moved: &Moved,
    [width, y]: [usize; 2],
    choices: &mut Choices,
) {
    choices.clear(width);
    let mut proposals = [[0.0f32; LANES]; REACH.len() * REACH.len()];
    for x in (0..width).step_by(LANES) {
        if !moved.near(x, y) {
            continue;
        }
        let here = surfaces.lanes(0, x as isize, y as isize);
        let mut farthest = [0.0f32; LANES];
        let [other, around @ ..] = &mut proposals;
        *other = [f32::NAN; LANES];
        for (i, d) in opinion
            .into_iter()
            .flat_map(|row| row[x..].iter().take(LANES).enumerate())
        {
            other[i] = *d;
            let far = (d - here[i]).abs();
            farthest[i] = if far > farthest[i] { far } else { farthest[i] };
        }
        for ([dx, dy], proposed) in offsets.iter().zip(around) {
            let (qx, qy) = (x as isize + dx, y as isize + dy);
            let d = surfaces.lanes(0, qx, qy);
            let (along_x, along_y) = (surfaces.lanes(1, qx, qy), surfaces.lanes(2, qx, qy));
            let (right, down) = (*dx as f32, *dy as f32);
            for i in 0..LANES {
                proposed[i] = d[i] - along_x[i] * right - along_y[i] * down;
                let far = (proposed[i] - here[i]).abs();
                // Not `max`, which asks for NaN twice.
                farthest[i] = if far > farthest[i] { far } else { farthest[i] };
            }
        }
        let mut most = 0.0;
        for far in farthest {
            most = if far > most { far } else { most };
        }
        if most > SAME {
            choices.take_different(here, &proposals, x, width);
        }
    }
}

impl Choices {
    fn clear(&mut self, width: usize) {
        self.slot.clear();
        self.slot.resize(width, NONE);
        self.columns.clear();
        self.count.clear();
        self.disparity.clear();
        self.source.clear();
    }

    /// Of the proposals for some columns those that are no less than 0 and differ from all before.
    #[inline(always)]
    fn take_different(
        &mut self,
        here: &[f32; LANES],
        proposals: &[[f32; LANES]],
        x: usize,
        width: usize,
    ) {
        // Far from everything, but from the unknown: what is unknown stays so.
        let mut disparity = [[f32::INFINITY; LANES]; MOST];
        let mut source = [[0u8; LANES]; MOST];
        let mut count = [1u32; LANES];
        let mut most = 1;
        disparity[0] = *here;
        for (n, proposed) in proposals.iter().enumerate() {
            let mut new = [0u32; LANES];
            for i in 0..LANES {
                new[i] = u32::from(proposed[i] >= 0.0);
            }
            for there in &disparity[..most] {
                for i in 0..LANES {
                    new[i] &= u32::from((there[i] - proposed[i]).abs() > SAME);
                }
            }
            let mut any = 0;
            for new in new {
                any |= new;
            }
            if any == 0 {
                continue;
            }
            for k in 1..MOST.min(most + 1) {
                for i in 0..LANES {
                    let take = (new[i] != 0) & (count[i] == k as u32);
                    disparity[k][i] = if take { proposed[i] } else { disparity[k][i] };
                    source[k][i] = if take { n as u8 + 1 } else { source[k][i] };
                }
            }
            for i in 0..LANES {
                count[i] = (count[i] + new[i]).min(MOST as u32);
            }
            let mut largest = 0;
            for count in count {
                largest = largest.max(count);
            }
            most = largest as usize;
        }
        for i in 0..LANES.min(width - x) {
            if count[i] > 1 {
                self.slot[x + i] = self.columns.len() as u32;
                self.columns.push((x + i) as u32);
                self.count.push(count[i] as u8);
                let (mut own, mut from) = ([0.0; MOST], [0; MOST]);
                for k in 0..MOST {
                    own[k] = disparity[k][i];
                    from[k] = source[k][i];
                }
                self.disparity.push(own);
                self.source.push(from);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn proposals_are_surfaces_around_that_differ_and_the_first_is_what_is_there() {
        let (width, height) = (90, 40);
        // Terraces on a slope, and a hole.
        let mut d: Vec<f32> = (0..width * height)
            .map(|i| 4.0 * ((i % width) / 13 % 3) as f32 + 0.1 * (i / width) as f32)
            .collect();
        d[20 * width + 30] = f32::NAN;
        let mut surfaces = Surfaces::unknown(width, height);
        surfaces.set(&d, width);
        let (offsets, all) = (offsets(), Moved::everywhere(width, height));
        let mut choices = Choices::default();
        let mut found = 0;
        for y in 0..height {
            propose(&surfaces, &offsets, None, &all, [width, y], &mut choices);
            for (k, &x) in choices.columns.iter().enumerate() {
                let (x, own) = (x as usize, &choices.disparity[k]);
                let own = &own[..usize::from(choices.count[k])];
                assert_eq!(own[0], d[y * width + x]);
                assert_eq!(choices.slot[x], k as u32);
                assert!(own.len() >= 2);
                for (i, a) in own.iter().enumerate() {
                    assert!(*a >= 0.0 && own[..i].iter().all(|b| (a - b).abs() > SAME));
                    let Some(n) = usize::from(choices.source[k][i]).checked_sub(AROUND) else {
                        continue;
                    };
                    // Terraces rise by 0.1 a row and not along it, outside their edges.
                    let [dx, dy] = offsets[n];
                    let source = y.saturating_add_signed(dy) * width + x.saturating_add_signed(dx);
                    assert!(
                        (a - (d[source] - 0.1 * dy as f32)).abs() < 1.1,
                        "{a} at {x} {y}"
                    );
                }
                found += 1;
            }
        }
        assert!(found > 1000, "{found}");
        assert_eq!(choices.slot.len(), width);
    }

    #[test]
    fn only_what_is_near_a_movement_chooses_again() {
        let (width, height) = (400, 60);
        let before = vec![5.0; width * height];
        let mut after = before.clone();
        after[30 * width + 200] = 9.0;
        let mut moved = Moved::everywhere(width, height);
        assert!(moved.near(0, 0));
        moved.set(&before, &after, width);
        assert!(moved.near(192, 30) && moved.near(192, 20) && moved.near(192, 40));
        assert!(!moved.near(192, 19) && !moved.near(192, 41) && !moved.near(0, 30));
        assert!(!moved.near(320, 30));
    }
}
