use std::collections::hash_map::Entry;
use std::sync::LazyLock;

use nalgebra::{Point3, Vector3};
use rustc_hash::FxHashMap;

use crate::error::positive;
use crate::{Cloud, CloudPoint, TerrainError};

/// What a cube of space holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Voxel {
    /// Points that fell into it.
    pub count: u32,
    /// Sum of what they weigh, the inverses of their variances, over square metres.
    pub weight: f64,
    /// Their mean by weight, metres.
    pub mean: Point3<f64>,
    /// Their mean colour by weight, linear light, 0..=1.
    pub linear_rgb: Vector3<f64>,
}

/// Points of all key frames, gathered in cubes of one size (Hong 2021, 3.2.2: "the voxel is used to
/// register and handle 3D points in an identical space at the predefined resolution").
///
/// A cube keeps the running mean of position and of colour. A point weighs the inverse of its variance: one that was
/// seen from four metres a sixteenth of one that was seen from two. An unknown deviation counts as a metre. Colour is averaged in linear light,
/// because the mean of two sRGB values is darker than the mean of what was seen.
#[derive(Clone, Debug)]
pub struct VoxelMap {
    size: f64,
    voxels: FxHashMap<[i32; 3], Voxel>,
}

impl VoxelMap {
    /// An empty map of cubes whose edges are `size` metres long.
    ///
    /// # Errors
    /// When `size` is not a positive number.
    pub fn new(size: f64) -> Result<Self, TerrainError> {
        positive("voxel", size)?;
        Ok(Self {
            size,
            voxels: FxHashMap::default(),
        })
    }

    /// Adds the points of a cloud, whose frame is the map's.
    ///
    /// Points that are not finite, or more than two thousand million cubes away from the origin, are
    /// passed over.
    pub fn insert(&mut self, cloud: &Cloud) {
        let levels = &*SRGB_TO_LINEAR;
        let mut points = cloud.points.iter().peekable();
        while let Some(first) = points.next() {
            let Some(key) = self.key(&first.position) else {
                continue;
            };
            // Neighbours in an image are neighbours in space: those of one cube are summed before it is looked up.
            let colour = |p: &CloudPoint| Vector3::from(p.colour.map(|c| levels[usize::from(c)]));
            let weight = weight(first);
            let mut run = Voxel {
                count: 1,
                weight,
                mean: first.position * weight,
                linear_rgb: colour(first) * weight,
            };
            while let Some(p) = points.next_if(|p| self.key(&p.position) == Some(key)) {
                let weight = self::weight(p);
                run.count += 1;
                run.weight += weight;
                run.mean += p.position.coords * weight;
                run.linear_rgb += colour(p) * weight;
            }
            run.mean /= run.weight;
            run.linear_rgb /= run.weight;
            match self.voxels.entry(key) {
                Entry::Vacant(vacant) => {
                    vacant.insert(run);
                }
                Entry::Occupied(mut known) => known.get_mut().merge(&run),
            }
        }
    }

    /// Length of a cube's edge, metres.
    pub fn size(&self) -> f64 {
        self.size
    }

    /// Number of cubes that hold a point.
    pub fn len(&self) -> usize {
        self.voxels.len()
    }

    /// Whether no point was added.
    pub fn is_empty(&self) -> bool {
        self.voxels.is_empty()
    }

    /// The cubes that hold at least `min_points` points, in the order of their place in the grid: x,
    /// then y, then z. A cube with fewer is taken for noise (Hong 2021, 3.2.2).
    pub fn voxels(&self, min_points: u32) -> Vec<Voxel> {
        let mut kept: Vec<_> = self
            .voxels
            .iter()
            .filter(|(_, v)| v.count >= min_points)
            .collect();
        kept.sort_unstable_by_key(|(key, _)| **key);
        kept.into_iter().map(|(_, v)| *v).collect()
    }

    fn key(&self, p: &Point3<f64>) -> Option<[i32; 3]> {
        let mut key = [0; 3];
        for (k, x) in key.iter_mut().zip(p.iter()) {
            let cell = (x / self.size).floor();
            if cell.is_nan() || cell.abs() >= f64::from(i32::MAX) {
                return None;
            }
            *k = cell as i32;
        }
        Some(key)
    }
}

impl Voxel {
    /// Takes the points of another in.
    fn merge(&mut self, other: &Self) {
        self.count = self.count.saturating_add(other.count);
        self.weight += other.weight;
        let share = other.weight / self.weight;
        self.mean += (other.mean - self.mean) * share;
        self.linear_rgb += (other.linear_rgb - self.linear_rgb) * share;
    }

    /// The deviation of one of its points along the line of sight, metres: the harmonic mean of their variances has it.
    pub fn sigma(&self) -> f64 {
        (f64::from(self.count) / self.weight).sqrt()
    }

    /// The voxel as a point of a cloud. No deviation is known: that of the mean of correlated
    /// estimates is not their number's.
    pub fn to_point(&self) -> CloudPoint {
        let colour = [self.linear_rgb.x, self.linear_rgb.y, self.linear_rgb.z].map(linear_to_srgb);
        CloudPoint {
            position: self.mean,
            colour,
            sigma: f32::NAN,
        }
    }
}

/// What a point weighs: see [`VoxelMap`]. Nothing is known better than to a tenth of a millimetre.
fn weight(p: &CloudPoint) -> f64 {
    let sigma = f64::from(p.sigma);
    match sigma.is_finite() {
        true => sigma.max(1e-4).powi(-2),
        false => 1.0,
    }
}

/// IEC 61966-2-1.
static SRGB_TO_LINEAR: LazyLock<[f64; 256]> = LazyLock::new(|| {
    std::array::from_fn(|i| {
        let s = i as f64 / 255.0;
        if s <= 0.04045 {
            s / 12.92
        } else {
            ((s + 0.055) / 1.055).powf(2.4)
        }
    })
});

/// IEC 61966-2-1.
pub(crate) fn srgb_to_linear(level: u8) -> f64 {
    SRGB_TO_LINEAR[usize::from(level)]
}

/// IEC 61966-2-1, to the nearest of 256 levels.
pub(crate) fn linear_to_srgb(linear: f64) -> u8 {
    let s = if linear <= 0.0031308 {
        12.92 * linear
    } else {
        1.055 * linear.powf(1.0 / 2.4) - 0.055
    };
    (s * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of a bumpy sheet, with colours, in a fixed order.
    fn sheet(n: usize) -> Cloud {
        let point = |i: usize| {
            let (a, b) = (
                (i % 97) as f64 * 0.0173 - 0.8,
                (i / 97) as f64 * 0.0131 - 0.7,
            );
            CloudPoint {
                position: Point3::new(a, b, 0.05 * (9.0 * a).sin()),
                colour: [(i % 251) as u8, (i % 17) as u8, 200],
                sigma: f32::NAN,
            }
        };
        Cloud {
            points: (0..n).map(point).collect(),
        }
    }

    fn map_of(cloud: &Cloud, size: f64) -> VoxelMap {
        let mut map = VoxelMap::new(size).unwrap();
        map.insert(cloud);
        map
    }

    #[test]
    fn the_order_of_insertion_does_not_matter() {
        let cloud = sheet(9000);
        let forward = map_of(&cloud, 0.05).voxels(1);
        let mut reversed = cloud.clone();
        reversed.points.reverse();
        // Streamed in pieces as well.
        let mut backward = VoxelMap::new(0.05).unwrap();
        for piece in reversed.points.chunks(777) {
            backward.insert(&Cloud {
                points: piece.to_vec(),
            });
        }
        let backward = backward.voxels(1);
        assert_eq!(forward.len(), backward.len());
        for (a, b) in forward.iter().zip(&backward) {
            assert_eq!(a.count, b.count);
            assert!((a.mean - b.mean).norm() < 1e-9 && (a.linear_rgb - b.linear_rgb).norm() < 1e-9);
        }
    }

    #[test]
    fn every_point_is_counted_once_and_its_mean_stays_in_its_cube() {
        let cloud = sheet(9000);
        let map = map_of(&cloud, 0.05);
        let voxels = map.voxels(1);
        assert_eq!(voxels.len(), map.len());
        assert_eq!(voxels.iter().map(|v| v.count as usize).sum::<usize>(), 9000);
        let mean = voxels
            .iter()
            .map(|v| v.mean.coords * f64::from(v.count))
            .sum::<Vector3<f64>>()
            / 9000.0;
        let expected = cloud
            .points
            .iter()
            .map(|p| p.position.coords)
            .sum::<Vector3<f64>>()
            / 9000.0;
        assert!((mean - expected).norm() < 1e-12);
        let keys: Vec<_> = voxels.iter().map(|v| map.key(&v.mean).unwrap()).collect();
        assert!(
            keys.windows(2).all(|k| k[0] < k[1]),
            "sorted, and one voxel a cube"
        );
    }

    #[test]
    fn few_points_are_noise() {
        let mut cloud = sheet(4000);
        let lone = CloudPoint {
            position: Point3::new(50.0, 50.0, 50.0),
            colour: [0; 3],
            sigma: f32::NAN,
        };
        cloud.points.push(lone);
        let map = map_of(&cloud, 0.05);
        assert_eq!(map.voxels(1).last().map(|v| v.mean), Some(lone.position));
        assert!(
            map.voxels(2)
                .iter()
                .all(|v| v.count >= 2 && v.mean.x < 10.0)
        );
    }

    #[test]
    fn colour_is_averaged_in_linear_light_and_survives_alone() {
        let at = |colour| CloudPoint {
            position: Point3::origin(),
            colour,
            sigma: f32::NAN,
        };
        let both = map_of(
            &Cloud {
                points: vec![at([0, 0, 0]), at([255, 255, 255])],
            },
            1.0,
        );
        // Half the light of white is sRGB 188, not 128.
        assert_eq!(both.voxels(1)[0].to_point().colour, [188; 3]);
        for c in 0..=255 {
            let one = map_of(
                &Cloud {
                    points: vec![at([c; 3])],
                },
                1.0,
            );
            assert_eq!(one.voxels(1)[0].to_point().colour, [c; 3]);
        }
    }

    #[test]
    fn the_sure_count_for_more() {
        let at = |x: f64, sigma: f32| CloudPoint {
            position: Point3::new(x, 0.5, 0.5),
            colour: [0; 3],
            sigma,
        };
        // In one run, and one after the other.
        for points in [
            vec![at(0.0, 0.1), at(1.0, 0.2)],
            vec![at(1.0, 0.2), at(7.0, 0.1), at(0.0, 0.1)],
        ] {
            let voxel = map_of(&Cloud { points }, 2.0).voxels(1)[0];
            assert!((voxel.mean.x - 0.2).abs() < 1e-6, "{voxel:?}");
            let harmonic = (2.0f64 / (100.0 + 25.0)).sqrt();
            assert!((voxel.sigma() - harmonic).abs() < 1e-6);
        }
        // No point is surer than anything can be, or less sure than unknown.
        let odd = [at(0.0, 0.0), at(1.0, f32::NAN)];
        let voxel = map_of(
            &Cloud {
                points: odd.to_vec(),
            },
            2.0,
        )
        .voxels(1)[0];
        assert!(voxel.mean.x.is_finite() && voxel.mean.x < 1e-6);
    }

    #[test]
    fn absurd_points_and_sizes_do_no_harm() {
        let at = |x| CloudPoint {
            position: Point3::new(x, 0.0, 0.0),
            colour: [0; 3],
            sigma: f32::NAN,
        };
        let cloud = Cloud {
            points: vec![
                at(f64::NAN),
                at(f64::INFINITY),
                at(1e30),
                at(-1e30),
                at(-0.5),
            ],
        };
        let map = map_of(&cloud, 0.01);
        assert_eq!(map.len(), 1);
        assert!(!map.is_empty());
        for size in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(VoxelMap::new(size).is_err(), "{size}");
        }
    }
}
