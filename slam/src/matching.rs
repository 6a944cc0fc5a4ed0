//! Which features are of one thing: left to right along rows, and map to image.

use barchan_datasets::Plane;
use barchan_geometry::{RectifiedRig, Se3};
use multiversion::multiversion;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::features::{Descriptor, Features};
use crate::lanes::{dot, sum};
use crate::map::{MapPoint, PointId};
use crate::{Keypoint, SlamConfig};

/// Differing bits of two descriptors.
#[inline(always)]
pub fn hamming(a: &Descriptor, b: &Descriptor) -> u32 {
    let (a, b) = (a.as_chunks::<8>().0, b.as_chunks::<8>().0);
    a.iter()
        .zip(b)
        .map(|(x, y)| (u64::from_ne_bytes(*x) ^ u64::from_ne_bytes(*y)).count_ones())
        .sum()
}

/// Differing bits of a descriptor and each of many.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512vpopcntdq+popcnt",
    "x86_64+avx2+popcnt",
    "aarch64+neon"
))]
fn distances(descriptor: &Descriptor, all: &[Descriptor], into: &mut Vec<u32>) {
    into.clear();
    into.extend(all.iter().map(|other| hamming(descriptor, other)));
}

/// How many stereo matches each rule decided (Hong 2021, table 1).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MatchCounts {
    /// Accepted by the distance ratio; the dense map agrees or is silent.
    pub ratio: usize,
    /// Too ambiguous for the ratio, accepted because the dense map agrees.
    pub gate: usize,
    /// Accepted by the ratio, refused because the dense map contradicts.
    pub refused: usize,
}

/// Dense disparity as a witness for feature matches (Hong 2021, 3.2.3).
#[derive(Clone, Copy, Debug)]
pub struct DisparityGate<'a> {
    /// Dense disparity of the left image, NaN unknown.
    pub disparity: &'a Plane,
    /// Its standard deviation, where it has one, pixels.
    pub sigma: Option<&'a Plane>,
    /// Largest difference that still agrees, pixels.
    pub threshold: f64,
}

impl DisparityGate<'_> {
    /// Largest difference of refined disparity and the dense map, pixels: three standard deviations of the network's
    /// on ground.
    const REFINED: f64 = 1.0;

    /// Whether the map agrees with a feature's disparity; `None` where it does not know, or where two of its standard
    /// deviations are more than the threshold.
    pub fn agrees(&self, keypoint: &Keypoint, disparity: f64) -> Option<bool> {
        let (u, v) = (keypoint.u.round() as u32, keypoint.v.round() as u32);
        let at = |plane: &Plane| Some(f64::from(plane.get_pixel_checked(u, v)?.0[0]));
        let dense = at(self.disparity)?;
        let unsure = self
            .sigma
            .and_then(at)
            .is_some_and(|s| 2.0 * s > self.threshold);
        (dense.is_finite() && !unsure).then(|| (dense - disparity).abs() < self.threshold)
    }

    /// Whether a disparity refined by correlation is what the map says, too, and is sure of to the same measure: nothing is
    /// left then of the distance of two key points that lay apart, and a look-alike beside the true place is told from
    /// it.
    fn confirms(&self, keypoint: &Keypoint, refined: f64) -> bool {
        let narrow = Self {
            threshold: self.threshold.min(Self::REFINED),
            ..*self
        };
        narrow.agrees(keypoint, refined) == Some(true)
    }
}

/// Disparity of each left feature, where it has a match in the right image.
///
/// A candidate lies in the same rows, at most a level of scale away, before the cameras and no nearer than
/// a disparity of a quarter of the width: no rig of use is focused there. The
/// nearest neighbour by descriptor is accepted when it is clearly nearer than the second **or** the
/// gate agrees with it. Its position is then refined by correlation to a fraction of a pixel, and the match is refused
/// where the gate contradicts that.
pub(crate) fn stereo_matches(
    left: &Features,
    right: &Features,
    images: [&Plane; 2],
    rig: &RectifiedRig,
    gate: Option<&DisparityGate>,
    config: &SlamConfig,
) -> (Vec<Option<f64>>, MatchCounts) {
    let mut counts = MatchCounts::default();
    let range = -1.0 - rig.doffs..rig.width as f64 / 4.0;
    let max_hamming = config.max_hamming(right.bits);
    let rows = by_row(&right.keypoints, images[1].height() as usize);
    let disparities = left
        .keypoints
        .iter()
        .zip(&left.descriptors)
        .map(|(keypoint, descriptor)| {
            let reach = config.row_tolerance * keypoint.scale;
            let in_reach = |r: &Keypoint| {
                (r.v - keypoint.v).abs() <= reach
                    && levels_apart(r, keypoint) <= 1.0
                    && range.contains(&(keypoint.u - r.u))
            };
            let from = (keypoint.v - reach).max(0.0) as usize;
            let to = ((keypoint.v + reach) as usize + 1).min(rows.len());
            let candidates = rows
                .get(from..to)?
                .iter()
                .flatten()
                .copied()
                .filter(|r| in_reach(&right.keypoints[*r]));
            let (best, distance, second) = two_nearest(descriptor, candidates, right)?;
            if distance > max_hamming {
                return None;
            }
            let coarse = keypoint.u - right.keypoints[best].u;
            let by_ratio = f64::from(distance) < config.nndr * f64::from(second);
            let near = || gate.is_some_and(|g| g.agrees(keypoint, coarse) == Some(true));
            if !(by_ratio || near()) {
                return None;
            }
            // Two key points of one corner lie up to some pixels apart: what is judged is where the images are alike.
            let refined = refine_disparity(images, keypoint, coarse)?;
            let rule = if by_ratio {
                if gate.and_then(|g| g.agrees(keypoint, refined)) == Some(false) {
                    counts.refused += 1;
                    return None;
                }
                &mut counts.ratio
            } else if gate.is_some_and(|g| g.confirms(keypoint, refined)) {
                &mut counts.gate
            } else {
                return None;
            };
            *rule += 1;
            Some(refined)
        })
        .collect();
    (disparities, counts)
}

/// How many levels of scale lie between two features. Detectors step by a fifth, or nearly so: a
/// level here is a little more, so that neighbours of either kind are one apart.
fn levels_apart(a: &Keypoint, b: &Keypoint) -> f64 {
    const LEVEL: f64 = 1.22;
    (a.scale / b.scale).ln().abs() / LEVEL.ln()
}

/// Indices of key points by their row.
fn by_row(keypoints: &[Keypoint], height: usize) -> Vec<Vec<usize>> {
    let mut rows = vec![Vec::new(); height];
    for (i, keypoint) in keypoints.iter().enumerate() {
        if let Some(row) = rows.get_mut(keypoint.v.max(0.0) as usize) {
            row.push(i);
        }
    }
    rows
}

/// The nearest feature, its distance, and that of the nearest one elsewhere: the same corner at a
/// neighbouring scale, within 3 pixels, is no rival.
pub(crate) fn two_nearest(
    descriptor: &Descriptor,
    candidates: impl Iterator<Item = usize>,
    features: &Features,
) -> Option<(usize, u32, u32)> {
    let all: Vec<(u32, usize)> = candidates
        .map(|i| (hamming(descriptor, &features.descriptors[i]), i))
        .collect();
    nearest_and_rival(all.iter().copied(), features)
}

/// Of distances and features, what [`two_nearest`] gives.
fn nearest_and_rival(
    all: impl Iterator<Item = (u32, usize)> + Clone,
    features: &Features,
) -> Option<(usize, u32, u32)> {
    let (distance, best) = all.clone().min()?;
    let at = features.keypoints[best];
    let elsewhere = |i: usize| {
        let k = features.keypoints[i];
        (k.u - at.u).abs() > 3.0 || (k.v - at.v).abs() > 3.0
    };
    let rival = all.fold(features.bits, |least, (d, i)| {
        // Most are farther than the rival so far, and need no look at where they are.
        if d < least && elsewhere(i) { d } else { least }
    });
    Some((best, distance, rival))
}

/// An 11x11 window of an image, its mean taken out.
pub(crate) struct Window {
    values: [f32; Self::SIDE * Self::SIDE],
    energy: f32,
}

impl Window {
    const RADIUS: i64 = 5;
    const SIDE: usize = 2 * Self::RADIUS as usize + 1;

    /// The window around a pixel; `None` where it would leave the image.
    pub fn cut(image: &Plane, u: i64, v: i64) -> Option<Self> {
        let (width, height) = (i64::from(image.width()), i64::from(image.height()));
        let inside = |x: i64, size: i64| x >= Self::RADIUS && x + Self::RADIUS < size;
        if !(inside(u, width) && inside(v, height)) {
            return None;
        }
        let mut values = [0.0f32; Self::SIDE * Self::SIDE];
        for (row, dy) in values.chunks_exact_mut(Self::SIDE).zip(-Self::RADIUS..) {
            let start = ((v + dy) * width + u - Self::RADIUS) as usize;
            row.copy_from_slice(&image.as_raw()[start..start + Self::SIDE]);
        }
        let mean = sum(&values) / values.len() as f32;
        values.iter_mut().for_each(|value| *value -= mean);
        let energy = dot(&values, &values);
        Some(Self { values, energy })
    }

    /// How alike two windows are, whatever their brightness and contrast: 1 for the same.
    pub fn correlation(&self, other: &Self) -> f32 {
        let norm = (self.energy * other.energy).sqrt().max(1e-9);
        dot(&self.values, &other.values) / norm
    }
}

/// Zero-mean correlation of a window along the row around the coarse match, and a parabola through its
/// peak. `None` when the peak is not inside the search.
pub(crate) fn refine_disparity(
    [left, right]: [&Plane; 2],
    keypoint: &Keypoint,
    coarse: f64,
) -> Option<f64> {
    const REACH: i64 = 4;
    let (u, v) = (keypoint.u.round() as i64, keypoint.v.round() as i64);
    let u_right = (keypoint.u - coarse).round() as i64;
    let reference = Window::cut(left, u, v)?;
    let mut scores = [0.0f64; 2 * REACH as usize + 1];
    for (score, shift) in scores.iter_mut().zip(-REACH..) {
        let other = Window::cut(right, u_right + shift, v)?;
        *score = f64::from(reference.correlation(&other));
    }
    let best = (0..scores.len()).max_by(|a, b| scores[*a].total_cmp(&scores[*b]))?;
    if best == 0 || best + 1 == scores.len() || scores[best] < 0.6 {
        return None;
    }
    let (before, peak, after) = (scores[best - 1], scores[best], scores[best + 1]);
    let offset = 0.5 * (before - after) / (before - 2.0 * peak + after);
    let at_right = u_right as f64 + best as f64 - REACH as f64 + offset.clamp(-0.5, 0.5);
    // The window sat on whole pixels; the feature's own fraction moves with it.
    Some(u as f64 - at_right)
}

/// Map points and the features that may be them.
pub(crate) struct ProjectedMatches {
    pub pairs: Vec<(PointId, usize)>,
    /// How many of the points should be in the image.
    pub in_view: usize,
}

/// Features of an image, `radius` around where a pose puts map points, that look like them.
#[allow(non_snake_case)]
pub(crate) fn find_points<'a>(
    points: impl Iterator<Item = (&'a PointId, &'a MapPoint)>,
    T_cam_world: &Se3,
    (features, grid): (&Features, &Grid),
    radius: f64,
    rig: &RectifiedRig,
    config: &SlamConfig,
) -> ProjectedMatches {
    let (width, height) = (rig.width as f64, rig.height as f64);
    let (mut ids, mut expected) = (Vec::new(), Vec::new());
    for (id, point) in points {
        let Some(at) = rig.project(&(T_cam_world * point.position)) else {
            continue;
        };
        if (0.0..width).contains(&at.u) && (0.0..height).contains(&at.v) {
            let at = Keypoint {
                u: at.u,
                v: at.v,
                scale: point.scale,
                sigma: point.scale,
            };
            ids.push(*id);
            expected.push((point.descriptor, at));
        }
    }
    let pairs = match_projections(&expected, features, grid, radius, config);
    ProjectedMatches {
        pairs: pairs.into_iter().map(|(i, f)| (ids[i], f)).collect(),
        in_view: ids.len(),
    }
}

/// A feature of the image for each map point that is expected in it: `expected` gives descriptor,
/// position and scale of point `i`. A feature takes the point that looks most like it.
fn match_projections(
    expected: &[(Descriptor, Keypoint)],
    features: &Features,
    grid: &Grid,
    radius: f64,
    config: &SlamConfig,
) -> Vec<(usize, usize)> {
    let max_hamming = config.max_hamming(features.bits);
    // For each feature, the best point so far.
    let mut taken: Vec<Option<(u32, usize)>> = vec![None; features.keypoints.len()];
    for (point, (descriptor, at)) in expected.iter().enumerate() {
        let reach = radius * at.scale.sqrt();
        let near = |i: &usize| {
            let k = features.keypoints[*i];
            (k.u - at.u).abs() <= reach
                && (k.v - at.v).abs() <= reach
                && levels_apart(&k, at) <= 2.0
        };
        let candidates = grid.around(at.u, at.v, reach).filter(near);
        let Some((best, distance, second)) = two_nearest(descriptor, candidates, features) else {
            continue;
        };
        if distance > max_hamming || f64::from(distance) > 0.9 * f64::from(second) {
            continue;
        }
        if taken[best].is_none_or(|(d, _)| distance < d) {
            taken[best] = Some((distance, point));
        }
    }
    taken
        .iter()
        .enumerate()
        .filter_map(|(feature, t)| t.map(|(_, point)| (point, feature)))
        .collect()
}

/// Pairs of two descriptor sets that are nearest to each other and pass the ratio.
pub(crate) fn match_all(
    a: &[Descriptor],
    b: &Features,
    config: &SlamConfig,
) -> Vec<(usize, usize)> {
    let max_hamming = config.max_hamming(b.bits);
    let forward: Vec<Option<(usize, u32)>> = a
        .par_iter()
        .with_min_len(64)
        .map_init(Vec::new, |all, descriptor| {
            distances(descriptor, &b.descriptors, all);
            let numbered = all.iter().copied().zip(0..);
            let (best, distance, second) = nearest_and_rival(numbered, b)?;
            (distance <= max_hamming && f64::from(distance) < config.nndr * f64::from(second))
                .then_some((best, distance))
        })
        .collect();
    let mut taken: Vec<Option<(u32, usize)>> = vec![None; b.descriptors.len()];
    for (i, found) in forward.iter().enumerate() {
        if let Some((best, distance)) = found
            && taken[*best].is_none_or(|(d, _)| *distance < d)
        {
            taken[*best] = Some((*distance, i));
        }
    }
    taken
        .iter()
        .enumerate()
        .filter_map(|(j, t)| t.map(|(_, i)| (i, j)))
        .collect()
}

/// Key points by cells of the image, for looking around a place.
pub(crate) struct Grid {
    columns: usize,
    rows: usize,
    cells: Vec<Vec<usize>>,
}

impl Grid {
    const CELL: f64 = 24.0;

    pub fn new(keypoints: &[Keypoint], width: usize, height: usize) -> Self {
        let columns = (width as f64 / Self::CELL) as usize + 1;
        let rows = (height as f64 / Self::CELL) as usize + 1;
        let mut cells = vec![Vec::new(); columns * rows];
        for (i, k) in keypoints.iter().enumerate() {
            let (x, y) = ((k.u / Self::CELL) as usize, (k.v / Self::CELL) as usize);
            cells[y.min(rows - 1) * columns + x.min(columns - 1)].push(i);
        }
        Self {
            columns,
            rows,
            cells,
        }
    }

    fn around(&self, u: f64, v: f64, reach: f64) -> impl Iterator<Item = usize> + '_ {
        let range = |at: f64, count: usize| {
            let from = ((at - reach) / Self::CELL).max(0.0) as usize;
            let to = ((at + reach) / Self::CELL).max(-1.0) + 1.0;
            from..(to as usize).min(count)
        };
        let columns = range(u, self.columns);
        range(v, self.rows).flat_map(move |y| {
            columns
                .clone()
                .flat_map(move |x| self.cells[y * self.columns + x].iter().copied())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hamming_counts_differing_bits() {
        let mut other = [0u8; 64];
        assert_eq!(hamming(&[0; 64], &other), 0);
        other[3] = 0b101;
        other[63] = 0x80;
        assert_eq!(hamming(&[0; 64], &other), 3);
        assert_eq!(hamming(&[0; 64], &[0xff; 64]), 512);
    }

    /// A texture and itself moved by a fraction of a pixel.
    fn shifted(by: f64) -> [Plane; 2] {
        let texture = |x: f64, y: f64| {
            let waves = (0.9 * x + 0.3 * y).sin()
                + (0.35 * x - 0.8 * y).sin()
                + (0.21 * x + 0.13 * y).cos();
            (0.5 + 0.15 * waves) as f32
        };
        [0.0, by].map(|d| {
            Plane::from_fn(80, 40, |x, y| {
                image::Luma([texture(f64::from(x) + d, f64::from(y))])
            })
        })
    }

    #[test]
    fn refinement_finds_fractions_of_a_pixel() {
        for true_disparity in [4.0, 5.3, 6.75] {
            let [left, right] = shifted(true_disparity);
            let at = Keypoint {
                u: 40.0,
                v: 20.0,
                scale: 1.0,
                sigma: 1.0,
            };
            let found = refine_disparity([&left, &right], &at, 5.0).unwrap();
            assert!(
                (found - true_disparity).abs() < 0.1,
                "{true_disparity}: {found}"
            );
        }
    }

    #[test]
    fn the_gate_admits_the_ambiguous_and_refuses_the_contradicted() {
        let [left, right] = shifted(6.0);
        let keypoint = |u: f64| Keypoint {
            u,
            v: 20.0,
            scale: 1.0,
            sigma: 1.0,
        };
        let features = |us: &[f64]| Features {
            keypoints: us.iter().map(|u| keypoint(*u)).collect(),
            descriptors: vec![[7; 64]; us.len()],
            bits: 256,
        };
        let config = SlamConfig::default();
        let rig = RectifiedRig {
            width: 320,
            height: 40,
            fx: 100.0,
            fy: 100.0,
            cx: 40.0,
            cy: 20.0,
            doffs: 0.0,
            baseline: 0.1,
        };
        let dense = |d: f32| Plane::from_pixel(80, 40, image::Luma([d]));
        let judged = |right_us: &[f64], gate: Option<f32>, sigma: f32| {
            let map = gate.map(dense);
            let sigma = dense(sigma);
            let gate = map.as_ref().map(|disparity| DisparityGate {
                disparity,
                sigma: Some(&sigma),
                threshold: 3.0,
            });
            stereo_matches(
                &features(&[40.0]),
                &features(right_us),
                [&left, &right],
                &rig,
                gate.as_ref(),
                &config,
            )
        };
        let run = |right_us: &[f64], gate: Option<f32>| judged(right_us, gate, 0.3);
        // Two equal candidates: the ratio cannot choose, the gate can.
        let (none, _) = run(&[34.0, 20.0], None);
        assert_eq!(none, [None]);
        let (found, counts) = run(&[34.0, 20.0], Some(6.0));
        assert!((found[0].unwrap() - 6.0).abs() < 0.1);
        assert_eq!(counts.gate, 1);
        // One candidate: the ratio accepts it, a contradicting map refuses it.
        let (found, counts) = run(&[34.0], None);
        assert!(found[0].is_some() && counts.ratio == 1);
        let (found, counts) = run(&[34.0], Some(30.0));
        assert_eq!((found[0], counts.refused), (None, 1));
        // Key points 3.5 pixels apart beside disparity, of images that are alike where the map says.
        let (found, counts) = run(&[30.5], Some(6.0));
        assert!((found[0].unwrap() - 6.0).abs() < 0.1 && counts.ratio == 1);
        // A map that is not sure of itself neither refuses nor admits.
        let (found, counts) = judged(&[34.0], Some(30.0), 1.6);
        assert!(found[0].is_some() && counts.ratio == 1);
        assert_eq!(judged(&[34.0, 20.0], Some(6.0), 1.6).0, [None]);
    }
}
