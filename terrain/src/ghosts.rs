//! Voxels of what was there for a while only, and of points that hang in the air: later key frames look through them.

use barchan_geometry::{RectifiedRig, Se3};
use nalgebra::Point3;

use crate::Cloud;

/// Whether key frames confirm voxels or look through them. Two numbers a voxel: memory does not grow with the number
/// of key frames.
#[derive(Clone, Debug)]
pub(crate) struct Sightlines {
    /// Middles of the voxels, those of a block side by side.
    middles: Vec<Point3<f64>>,
    /// Of each of the middles, where the caller has it.
    order: Vec<usize>,
    blocks: Vec<Block>,
    /// Key frames that saw something at the voxel, and that saw something behind it.
    seen: Vec<[u16; 2]>,
    /// Edge of a voxel, metres.
    size: f64,
}

/// Voxels that are near to each other.
#[derive(Clone, Debug)]
struct Block {
    first: usize,
    end: usize,
    centre: Point3<f64>,
    radius: f64,
}

/// Voxels along the edge of a block.
const BLOCK: f64 = 32.0;
/// So many deviations of depth behind a voxel is behind it.
const BEHIND: f64 = 3.0;
/// Fewest key frames that must look through a voxel.
const FEWEST: u16 = 2;

impl Sightlines {
    /// For voxels at these places, of edges of `size` metres.
    pub(crate) fn new(voxels: &[Point3<f64>], size: f64) -> Self {
        let block_of = |p: &Point3<f64>| -> [i64; 3] {
            p.coords.map(|x| (x / (BLOCK * size)).floor() as i64).into()
        };
        let mut order: Vec<usize> = (0..voxels.len()).collect();
        order.sort_by_cached_key(|&i| block_of(&voxels[i]));
        let middles: Vec<Point3<f64>> = order.iter().map(|&i| voxels[i]).collect();
        let mut blocks = vec![];
        for members in middles.chunk_by(|a, b| block_of(a) == block_of(b)) {
            let first = blocks.last().map_or(0, |b: &Block| b.end);
            let sum: nalgebra::Vector3<f64> = members.iter().map(|p| p.coords).sum();
            let centre = Point3::from(sum / members.len() as f64);
            let far = members.iter().map(|p| (p - centre).norm());
            blocks.push(Block {
                first,
                end: first + members.len(),
                centre,
                radius: far.fold(0.0, f64::max),
            });
        }
        Self {
            seen: vec![[0; 2]; middles.len()],
            middles,
            order,
            blocks,
            size,
        }
    }

    /// Casts the line of sight of each voxel that a key frame has in its image. `cloud` is what it measured, in the camera
    /// frame: only pixels that are believed to be something say that what is before them is nothing.
    #[allow(non_snake_case)]
    pub(crate) fn look(&mut self, cloud: &Cloud, T_world_cam: &Se3, rig: &RectifiedRig) {
        let image = DepthImage::new(cloud, rig);
        let T_cam_world = T_world_cam.inverse();
        let to_camera = T_cam_world.to_matrix();
        for block in &self.blocks {
            let centre = T_cam_world * block.centre;
            if centre.z + block.radius <= 0.0
                || centre.z - block.radius > image.farthest
                || is_beside(rig, &centre, block.radius)
            {
                continue;
            }
            for k in block.first..block.end {
                let p = to_camera.transform_point(&self.middles[k]);
                match image.compare(&p, rig, self.size) {
                    Sight::Confirmed => self.seen[k][0] = self.seen[k][0].saturating_add(1),
                    Sight::Through => self.seen[k][1] = self.seen[k][1].saturating_add(1),
                    Sight::Nothing => {}
                }
            }
        }
    }

    /// Of each voxel, in the caller's order: whether more key frames look through it than see it, and at least two.
    pub(crate) fn ghosts(&self) -> Vec<bool> {
        let mut ghosts = vec![false; self.seen.len()];
        for (&index, [confirmed, through]) in self.order.iter().zip(&self.seen) {
            ghosts[index] = through > confirmed && *through >= FEWEST;
        }
        ghosts
    }
}

/// Whether a ball lies outside the pyramid of what the camera sees.
fn is_beside(rig: &RectifiedRig, centre: &Point3<f64>, radius: f64) -> bool {
    // Distances from the four sides of the pyramid, outwards positive.
    let side = |f: f64, edge: f64, x: f64| (f * x - edge * centre.z) / f.hypot(edge);
    let [left, right] = [-rig.cx - 0.5, rig.width as f64 - rig.cx - 0.5];
    let [top, bottom] = [-rig.cy - 0.5, rig.height as f64 - rig.cy - 0.5];
    side(rig.fx, right, centre.x) > radius
        || -side(rig.fx, left, centre.x) > radius
        || side(rig.fy, bottom, centre.y) > radius
        || -side(rig.fy, top, centre.y) > radius
}

/// What a key frame says of a voxel.
enum Sight {
    /// Something is there.
    Confirmed,
    /// Something was seen behind it, and nothing around that line of sight that could be it.
    Through,
    /// It is hidden, or not in the image.
    Nothing,
}

/// Depths of a key frame and their deviations, NaN where nothing was measured.
struct DepthImage {
    width: i64,
    height: i64,
    depths: Vec<[f32; 2]>,
    farthest: f64,
}

impl DepthImage {
    fn new(cloud: &Cloud, rig: &RectifiedRig) -> Self {
        let (width, height) = (rig.width as i64, rig.height as i64);
        let mut depths = vec![[f32::NAN; 2]; rig.width * rig.height];
        let mut farthest: f64 = 0.0;
        for p in &cloud.points {
            let at = rig.project(&p.position);
            let index = at.and_then(|at| pixel(at.u, at.v, width, height));
            if let Some(index) = index {
                depths[index] = [p.position.z as f32, p.sigma];
                farthest = farthest.max(p.position.z);
            }
        }
        Self {
            width,
            height,
            depths,
            farthest,
        }
    }

    /// A voxel, in the camera frame, against the nine pixels around its line of sight.
    fn compare(&self, p: &Point3<f64>, rig: &RectifiedRig, size: f64) -> Sight {
        // Farther than anything measured, or behind the camera.
        if p.z <= 0.0 || p.z > self.farthest {
            return Sight::Nothing;
        }
        let (u, v) = (rig.fx * p.x / p.z + rig.cx, rig.fy * p.y / p.z + rig.cy);
        let Some(middle) = pixel(u, v, self.width, self.height) else {
            return Sight::Nothing;
        };
        if self.depths[middle][0].is_nan() {
            return Sight::Nothing;
        }
        let (column, row) = (middle as i64 % self.width, middle as i64 / self.width);
        let mut through = true;
        for r in (row - 1).max(0)..(row + 2).min(self.height) {
            for c in (column - 1).max(0)..(column + 2).min(self.width) {
                let [depth, sigma] = self.depths[(r * self.width + c) as usize].map(f64::from);
                if depth.is_nan() {
                    continue;
                }
                // A voxel reaches so far, and the point in it was no better known than this one.
                let margin = size + BEHIND * std::f64::consts::SQRT_2 * sigma;
                if (depth - p.z).abs() <= margin {
                    return Sight::Confirmed;
                }
                through &= depth > p.z;
            }
        }
        if through {
            Sight::Through
        } else {
            Sight::Nothing
        }
    }
}

fn pixel(u: f64, v: f64, width: i64, height: i64) -> Option<usize> {
    // Casts take NaN to 0, so that is seen first.
    let (column, row) = (u.round(), v.round());
    let inside = column >= 0.0 && row >= 0.0 && column < width as f64 && row < height as f64;
    inside.then(|| (row as i64 * width + column as i64) as usize)
}
