use nalgebra::{Point3, UnitQuaternion, Vector2, Vector3};

use crate::{Camera, RectifiedRig, Rig};

/// The maps that turn the images of an unrectified [`Rig`] into a rectified pair.
#[derive(Clone, Debug)]
#[allow(non_snake_case)]
pub struct Rectification {
    /// The rig that the rectified images obey: of the same size, square pixels, `doffs` zero.
    pub rig: RectifiedRig,
    /// Turns points of the original left camera frame into the rectified left camera frame.
    pub R_rect_left: UnitQuaternion<f64>,
    /// The same for the right camera.
    pub R_rect_right: UnitQuaternion<f64>,
    /// For each pixel of the rectified left image, row by row, where it lies in the original:
    /// column and row in pixels, NaN where no ray of the original camera goes.
    pub left_map: Vec<[f32; 2]>,
    /// The same for the right image.
    pub right_map: Vec<[f32; 2]>,
}

impl Rectification {
    /// Rectifies a rig (Fusiello, Trucco and Verri 2000; the split of the rotation as in OpenCV).
    ///
    /// The right camera must stand to the right of the left one, as [`Rig::load`] demands.
    #[allow(non_snake_case)]
    pub fn new(rig: &Rig) -> Self {
        // Each camera turns by half the rotation between them, so that neither image is bent more
        // than it must: with R = r r, points obey p_right' = p_left' + r^-1 t.
        let R_right_left = rig.T_right_left.rotation;
        let half = UnitQuaternion::from_scaled_axis(R_right_left.scaled_axis() * 0.5);
        let to_right_camera = -(half.inverse() * rig.T_right_left.translation.vector);
        // Both then turn together until the baseline is the x axis. (There is no shortest turn only
        // when the cameras have changed sides.)
        let align = UnitQuaternion::rotation_between(&to_right_camera, &Vector3::x())
            .unwrap_or_else(|| {
                UnitQuaternion::from_axis_angle(&Vector3::y_axis(), std::f64::consts::PI)
            });
        let R_rect_left = align * half;
        let R_rect_right = align * half.inverse();

        // One focal length for all; the principal point puts what the middles of the two original
        // images see, on average, into the middle of the rectified ones.
        let f = (rig.left.fx + rig.left.fy + rig.right.fx + rig.right.fy) / 4.0;
        let middle = Vector2::new(
            (rig.width as f64 - 1.0) / 2.0,
            (rig.height as f64 - 1.0) / 2.0,
        );
        let seen = |camera: &Camera, R: &UnitQuaternion<f64>| {
            let ray = R * camera.ray(middle).push(1.0);
            ray.xy() / ray.z
        };
        let mean = (seen(&rig.left, &R_rect_left) + seen(&rig.right, &R_rect_right)) / 2.0;
        let rectified = RectifiedRig {
            width: rig.width,
            height: rig.height,
            fx: f,
            fy: f,
            cx: middle.x - f * mean.x,
            cy: middle.y - f * mean.y,
            doffs: 0.0,
            baseline: rig.baseline(),
        };
        Self {
            rig: rectified,
            R_rect_left,
            R_rect_right,
            left_map: map(&rectified, &rig.left, &R_rect_left.inverse()),
            right_map: map(&rectified, &rig.right, &R_rect_right.inverse()),
        }
    }
}

/// Where each pixel of a rectified image lies in the original image of `camera`.
#[allow(non_snake_case)]
fn map(
    rectified: &RectifiedRig,
    camera: &Camera,
    R_cam_rect: &UnitQuaternion<f64>,
) -> Vec<[f32; 2]> {
    let folds_at = camera.folds_at();
    let original = |u: usize, v: usize| {
        let ray = Vector3::new(
            (u as f64 - rectified.cx) / rectified.fx,
            (v as f64 - rectified.cy) / rectified.fy,
            1.0,
        );
        let p_cam = Point3::from(R_cam_rect * ray);
        let pixel = camera.project(&p_cam)?;
        ((p_cam.x / p_cam.z).hypot(p_cam.y / p_cam.z) < folds_at)
            .then_some([pixel.x as f32, pixel.y as f32])
    };
    let pixels = (0..rectified.height).flat_map(|v| (0..rectified.width).map(move |u| (u, v)));
    pixels
        .map(|(u, v)| original(u, v).unwrap_or([f32::NAN; 2]))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Distortion, Se3, StereoPoint};

    /// Radial and tangential distortion, unequal cameras, three degrees between them, and a
    /// baseline that is not quite along x.
    fn crooked() -> Rig {
        let camera = |f, k1| Camera {
            distortion: Distortion::RadTan([k1, 0.08, 0.001, -0.0007, 0.0]),
            ..Camera::pinhole(f, f * 1.01, 310.0, 247.0)
        };
        let turn = Vector3::new(0.6, -0.7, 0.4).normalize() * 3f64.to_radians();
        Rig {
            width: 640,
            height: 480,
            left: camera(520.0, -0.25),
            right: camera(505.0, -0.22),
            T_right_left: Se3::new(Vector3::new(-0.12, 0.004, -0.006), turn),
            rectified: false,
        }
    }

    fn points() -> impl Iterator<Item = Point3<f64>> {
        (0..200).map(|i| {
            let (a, b, c) = (
                i as f64 * 0.618 % 1.0,
                i as f64 * 0.414 % 1.0,
                i as f64 * 0.732 % 1.0,
            );
            let z = 0.5 + 20.0 * c;
            Point3::new((a - 0.5) * 0.8 * z, (b - 0.5) * 0.6 * z, z)
        })
    }

    #[test]
    fn points_lie_on_the_same_row_and_their_disparity_gives_the_depth() {
        let rig = crooked();
        let r = Rectification::new(&rig);
        // From an original pixel to the rectified image.
        let to_rectified = |camera: &Camera, turn: &UnitQuaternion<f64>, pixel| {
            let ray = turn * camera.ray(pixel).push(1.0);
            Vector2::new(
                r.rig.fx * ray.x / ray.z + r.rig.cx,
                r.rig.fy * ray.y / ray.z + r.rig.cy,
            )
        };
        for p_left in points() {
            let seen_left = rig.left.project(&p_left).unwrap();
            let seen_right = rig.right.project(&(rig.T_right_left * p_left)).unwrap();
            let left = to_rectified(&rig.left, &r.R_rect_left, seen_left);
            let right = to_rectified(&rig.right, &r.R_rect_right, seen_right);
            assert!(
                (left.y - right.y).abs() < 1e-6,
                "rows {} {}",
                left.y,
                right.y
            );
            let at = StereoPoint {
                u: left.x,
                v: left.y,
                d: left.x - right.x,
            };
            let back = r.rig.back_project(at).unwrap();
            let expected = r.R_rect_left * p_left;
            assert!(
                (back - expected).norm() < 1e-6 * expected.z,
                "{back} {expected}"
            );
        }
    }

    #[test]
    fn the_maps_lead_to_where_the_original_cameras_see_the_point() {
        let rig = crooked();
        let r = Rectification::new(&rig);
        let w = rig.width;
        for (u, v, d) in [(320, 240, 20), (100, 60, 5), (600, 450, 60), (63, 400, 62)] {
            let p_rect = r
                .rig
                .back_project(StereoPoint {
                    u: u as f64,
                    v: v as f64,
                    d: d as f64,
                })
                .unwrap();
            let p_left = r.R_rect_left.inverse() * p_rect;
            let left = rig.left.project(&p_left).unwrap();
            let right = rig.right.project(&(rig.T_right_left * p_left)).unwrap();
            for (pixel, map) in [
                (left, r.left_map[v * w + u]),
                (right, r.right_map[v * w + u - d]),
            ] {
                let error = (pixel - Vector2::new(map[0] as f64, map[1] as f64)).norm();
                assert!(error < 1e-3, "{pixel} {map:?}");
            }
        }
    }

    #[test]
    fn both_images_keep_most_of_what_they_saw() {
        let rig = crooked();
        let r = Rectification::new(&rig);
        for map in [&r.left_map, &r.right_map] {
            let inside =
                |p: &&[f32; 2]| (0.0..=639.0).contains(&p[0]) && (0.0..=479.0).contains(&p[1]);
            let share = map.iter().filter(inside).count() as f64 / map.len() as f64;
            assert!(share > 0.9, "{share}");
        }
    }

    #[test]
    fn a_rectified_rig_is_left_as_it_is() {
        let before = RectifiedRig {
            width: 64,
            height: 48,
            fx: 50.0,
            fy: 50.0,
            cx: 31.0,
            cy: 24.5,
            doffs: 0.0,
            baseline: 0.1,
        };
        let r = Rectification::new(&Rig::from(before));
        assert!(
            (r.rig.cx - before.cx).abs() < 1e-9
                && (r.rig.cy - before.cy).abs() < 1e-9
                && r.rig.fx == before.fx
        );
        for (i, map) in r.left_map.iter().chain(&r.right_map).enumerate() {
            let (u, v) = ((i % 64) as f32, (i / 64 % 48) as f32);
            assert!((map[0] - u).abs() < 1e-4 && (map[1] - v).abs() < 1e-4);
        }
    }
}
