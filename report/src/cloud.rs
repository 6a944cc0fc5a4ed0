use barchan_terrain::CloudPoint;
use serde::Serialize;

use crate::base64;

/// Most points that a page holds: 8 bytes each.
pub const MAX_POINTS: usize = 1_000_000;

/// Points to be turned and looked at; z is up.
#[derive(Clone, Debug, Default)]
pub struct Cloud3d {
    /// The ground.
    pub points: Vec<CloudPoint>,
    /// The way of the camera, metres.
    pub route: Vec<[f64; 3]>,
}

/// As the page's script reads it.
#[derive(Serialize)]
pub(crate) struct Packed {
    pub shown: usize,
    pub of: usize,
    /// Where the whole numbers begin, metres.
    pub origin: [f64; 3],
    /// Metres of a whole number.
    pub step: f64,
    /// Three little-endian `u16` a point.
    pub positions: String,
    /// Three bytes a point.
    pub colours: String,
    pub route: String,
}

impl Cloud3d {
    /// `None` without points.
    pub(crate) fn pack(&self) -> Option<Packed> {
        let finite = |p: &&CloudPoint| p.position.iter().all(|v| v.is_finite());
        let found: Vec<&CloudPoint> = self.points.iter().filter(finite).collect();
        let extent = |axis: usize| {
            let of_ground = found.iter().map(|p| p.position[axis]);
            let all = of_ground.chain(self.route.iter().map(|p| p[axis]));
            all.filter(|v| v.is_finite())
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
                    (low.min(v), high.max(v))
                })
        };
        let extents = [extent(0), extent(1), extent(2)];
        if found.is_empty() {
            return None;
        }
        let origin = extents.map(|(low, _)| low);
        let largest = extents
            .iter()
            .fold(0.0f64, |m, (low, high)| m.max(high - low));
        let step = (largest / f64::from(u16::MAX)).max(1e-9);
        let whole = |p: [f64; 3]| -> [u8; 6] {
            let mut bytes = [0; 6];
            for (axis, value) in p.into_iter().enumerate() {
                let value = ((value - origin[axis]) / step).round() as u16;
                bytes[2 * axis..2 * axis + 2].copy_from_slice(&value.to_le_bytes());
            }
            bytes
        };
        // Any beginning of the list shows the whole, only thinner: the script draws a part while the view turns. A step
        // that shares no factor with the count visits every point once.
        let count = found.len();
        let stride = coprime_near((count as f64 * 0.618_034) as usize, count);
        let shown = count.min(MAX_POINTS);
        let chosen = || (0..shown).map(|k| found[(k * stride) % count]);
        let positions: Vec<u8> = chosen()
            .flat_map(|p| whole([p.position.x, p.position.y, p.position.z]))
            .collect();
        let colours: Vec<u8> = chosen().flat_map(|p| p.colour).collect();
        let route: Vec<u8> = self.route.iter().flat_map(|p| whole(*p)).collect();
        Some(Packed {
            shown,
            of: count,
            origin,
            step,
            positions: base64(&positions),
            colours: base64(&colours),
            route: base64(&route),
        })
    }
}

fn coprime_near(start: usize, count: usize) -> usize {
    let gcd = |mut a: usize, mut b: usize| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    (start.max(1)..).find(|k| gcd(*k, count) == 1).unwrap_or(1)
}
