use barchan_geometry::{Camera, RectifiedRig, Se3};
use nalgebra::{Matrix3, Point3, UnitQuaternion, Vector2, Vector3};
use rayon::prelude::*;

use super::surface::Hit;

/// What can be looked at.
pub(super) trait Scene: Sync {
    /// The first thing that a ray meets after parameter `near`.
    fn hit(&self, origin: &Point3<f64>, ray: &Vector3<f64>, near: f64) -> Option<Hit>;

    /// A parameter before which no ray between four meets anything: where to begin to look.
    fn clear_until(&self, origin: &Point3<f64>, corners: &[Vector3<f64>; 4]) -> f64;

    /// The light (linear red, green, blue) that comes back along a ray from what it met, averaged
    /// over the pixel.
    fn light(&self, look: &Look, hit: Option<&Hit>) -> Vector3<f32>;
}

/// A ray and its pixel.
pub(super) struct Look {
    pub origin: Point3<f64>,
    pub ray: Vector3<f64>,
    /// From where surfaces are judged that look different from different sides: the middle between
    /// the cameras, so that both see them alike and the truth of the pair is exact.
    pub eye: Point3<f64>,
    /// How the ray changes across the pixel along columns and rows (Igehy 1999).
    pub steps: [Vector3<f64>; 2],
}

/// A camera at a place.
#[allow(non_snake_case)]
pub(super) struct View<'a> {
    pub width: usize,
    pub height: usize,
    pub origin: Point3<f64>,
    /// See [`Look::eye`].
    eye: Point3<f64>,
    /// Turns directions of the camera that `lens` belongs to into the world.
    R_world_cam: Matrix3<f64>,
    focal: [f64; 2],
    lens: Lens<'a>,
}

enum Lens<'a> {
    Pinhole { cx: f64, cy: f64 },
    Bent(&'a Camera),
}

impl<'a> View<'a> {
    /// A camera of a rectified rig, `shift` metres to the right of the left one. Its rays have z = 1
    /// in the camera, so that the parameter along them is the depth.
    #[allow(non_snake_case)]
    pub fn rectified(rig: &RectifiedRig, T_world_left: &Se3, shift: f64) -> View<'static> {
        View {
            width: rig.width,
            height: rig.height,
            origin: T_world_left * Point3::new(shift, 0.0, 0.0),
            eye: middle(rig, T_world_left),
            R_world_cam: T_world_left.rotation.to_rotation_matrix().into_inner(),
            focal: [rig.fx, rig.fy],
            lens: Lens::Pinhole {
                cx: rig.cx,
                cy: rig.cy,
            },
        }
    }

    /// One camera of an unrectified rig: `straight` is the rig after rectification, and
    /// `R_rect_cam` turns points of the camera into its rectified frame.
    #[allow(non_snake_case)]
    pub fn bent(
        straight: &RectifiedRig,
        T_world_left: &Se3,
        shift: f64,
        camera: &'a Camera,
        R_rect_cam: &UnitQuaternion<f64>,
    ) -> Self {
        Self {
            width: straight.width,
            height: straight.height,
            origin: T_world_left * Point3::new(shift, 0.0, 0.0),
            eye: middle(straight, T_world_left),
            R_world_cam: (T_world_left.rotation * R_rect_cam)
                .to_rotation_matrix()
                .into_inner(),
            focal: [camera.fx, camera.fy],
            lens: Lens::Bent(camera),
        }
    }

    /// The ray through a pixel, in the world.
    pub fn ray(&self, u: f64, v: f64) -> Vector3<f64> {
        let [fx, fy] = self.focal;
        self.R_world_cam
            * match self.lens {
                Lens::Pinhole { cx, cy } => Vector3::new((u - cx) / fx, (v - cy) / fy, 1.0),
                Lens::Bent(camera) => camera.ray(Vector2::new(u, v)).push(1.0),
            }
    }

    /// Where a direction of the world appears; `None` behind the camera.
    pub fn pixel(&self, direction: &Vector3<f64>) -> Option<Vector2<f64>> {
        let d = self.R_world_cam.tr_mul(direction);
        match self.lens {
            Lens::Pinhole { cx, cy } => (d.z > 0.0).then(|| {
                Vector2::new(
                    self.focal[0] * d.x / d.z + cx,
                    self.focal[1] * d.y / d.z + cy,
                )
            }),
            Lens::Bent(camera) => camera.project(&Point3::from(d)),
        }
    }

    fn look(&self, u: f64, v: f64, pixels: f64) -> Look {
        let step = |axis: usize| self.R_world_cam.column(axis) * (pixels / self.focal[axis]);
        Look {
            origin: self.origin,
            ray: self.ray(u, v),
            eye: self.eye,
            steps: [step(0), step(1)],
        }
    }
}

/// The middle between the cameras of a rig.
#[allow(non_snake_case)]
fn middle(rig: &RectifiedRig, T_world_left: &Se3) -> Point3<f64> {
    T_world_left * Point3::new(rig.baseline / 2.0, 0.0, 0.0)
}

/// For square tiles of the image, where to begin to look: pixels next to each other fly over the
/// same ground, and share that part of the way.
struct Clear {
    across: usize,
    until: Vec<f64>,
}

impl Clear {
    const TILE: usize = 16;

    fn new(scene: &impl Scene, view: &View) -> Self {
        let across = view.width.div_ceil(Self::TILE);
        let tiles = across * view.height.div_ceil(Self::TILE);
        let until = |k: usize| {
            // A pixel more on each side, for rays beside the middle of a pixel and for bent lenses.
            let [u, v] = [k % across, k / across].map(|n| (n * Self::TILE) as f64);
            let (from, to) = (-1.5, Self::TILE as f64 + 0.5);
            let corners = [(from, from), (to, from), (from, to), (to, to)];
            scene.clear_until(&view.origin, &corners.map(|(a, b)| view.ray(u + a, v + b)))
        };
        Self {
            across,
            until: (0..tiles).into_par_iter().map(until).collect(),
        }
    }

    fn at(&self, u: usize, v: usize) -> f64 {
        self.until[v / Self::TILE * self.across + u / Self::TILE]
    }
}

/// What each pixel's middle meets, row by row.
pub(super) fn hits(scene: &impl Scene, view: &View) -> Vec<Option<Hit>> {
    hits_after(scene, view, &Clear::new(scene, view))
}

fn hits_after(scene: &impl Scene, view: &View, clear: &Clear) -> Vec<Option<Hit>> {
    let mut hits = vec![None; view.width * view.height];
    hits.par_chunks_exact_mut(view.width)
        .enumerate()
        .for_each(|(v, row)| {
            for (u, hit) in row.iter_mut().enumerate() {
                let ray = view.ray(u as f64, v as f64);
                *hit = scene.hit(&view.origin, &ray, clear.at(u, v));
            }
        });
    hits
}

/// The light that falls on each pixel: linear red, green and blue, row by row.
///
/// Surfaces average their own light over a pixel; where a pixel lies on the outline of something,
/// four rays share it.
pub(super) fn render(scene: &impl Scene, view: &View) -> Vec<f32> {
    const SHARED: [(f64, f64); 4] = [
        (-0.125, -0.375),
        (0.375, -0.125),
        (0.125, 0.375),
        (-0.375, 0.125),
    ];
    /// Pixels that a pixel's light comes from, across: lenses are a little less sharp than sensors.
    const SPREAD: f64 = 1.25;
    let (w, h) = (view.width, view.height);
    let clear = Clear::new(scene, view);
    let hits = hits_after(scene, view, &clear);
    let mut image = vec![0.0f32; 3 * w * h];
    image
        .par_chunks_exact_mut(3 * w)
        .enumerate()
        .for_each(|(v, row)| {
            for (u, pixel) in row.chunks_exact_mut(3).enumerate() {
                let hit = &hits[v * w + u];
                let neighbours = [
                    (u > 0).then(|| &hits[v * w + u - 1]),
                    (u + 1 < w).then(|| &hits[v * w + u + 1]),
                    (v > 0).then(|| &hits[(v - 1) * w + u]),
                    (v + 1 < h).then(|| &hits[(v + 1) * w + u]),
                ];
                let on_outline = neighbours.iter().flatten().any(|n| apart(hit, n));
                let at = (u as f64, v as f64);
                let light = if on_outline {
                    let shared = |(du, dv): &(f64, f64)| {
                        let look = view.look(at.0 + du, at.1 + dv, 0.5 * SPREAD);
                        let hit = scene.hit(&look.origin, &look.ray, clear.at(u, v));
                        scene.light(&look, hit.as_ref())
                    };
                    SHARED.iter().map(shared).sum::<Vector3<f32>>() / 4.0
                } else {
                    scene.light(&view.look(at.0, at.1, SPREAD), hit.as_ref())
                };
                pixel.copy_from_slice(light.as_slice());
            }
        });
    image
}

/// Whether an outline lies between two neighbouring pixels.
fn apart(a: &Option<Hit>, b: &Option<Hit>) -> bool {
    match (a, b) {
        (None, None) => false,
        (Some(a), Some(b)) => {
            let (near, far) = if a.t < b.t { (a.t, b.t) } else { (b.t, a.t) };
            a.body.map(|body| body.0) != b.body.map(|body| body.0)
                || far > 1.15 * near && near < 15.0
        }
        _ => true,
    }
}
