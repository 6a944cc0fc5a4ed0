use std::path::Path;

use barchan_datasets::{Plane, Rgb, luma};
use barchan_geometry::{RectifiedRig, Se3, StereoPoint};
use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use crate::TerrainError;

/// A coloured point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CloudPoint {
    /// Where, metres.
    pub position: Point3<f64>,
    /// Red, green, blue, sRGB.
    pub colour: [u8; 3],
    /// Standard deviation along the line of sight, metres; NaN where not known.
    pub sigma: f32,
}

/// Points in one frame, which its owner names.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cloud {
    /// The points.
    pub points: Vec<CloudPoint>,
}

/// Which pixels of a disparity image become points.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DepthLimits {
    /// Nearest accepted depth, metres. Default 0.1: nearer than that is the rover itself.
    pub min_depth: f64,
    /// Farthest accepted depth, metres. Default none: `max_relative_sigma` cuts where this rig's
    /// depth stops being worth having, which suits a rover of 0.1 m baseline and a car alike.
    pub max_depth: Option<f64>,
    /// Largest accepted standard deviation of depth over depth, `z sigma_d / (f b)`. Default 0.1.
    pub max_relative_sigma: f64,
    /// Standard deviation of disparity where an engine gives none, pixels. Default 0.5.
    pub default_sigma: f64,
    /// Smallest standard deviation of disparity believed, pixels. Default 0.25: no calibration is
    /// good enough for less, whatever a network says of itself.
    pub min_sigma: f64,
    /// Largest accepted difference of disparity between neighbouring pixels, pixels. Default 1.
    /// Where it is exceeded, the surface is seen at a grazing angle or, more often, it is no surface
    /// but an estimate smeared over an occluding edge ("flying pixels"). Flat ground seen from a
    /// height `h` stays at `baseline / h` or below.
    pub max_step: f64,
    /// Smallest accepted standard deviation of brightness in the 9 x 9 pixels around, grey levels of
    /// 255. Default 2, twice a camera's noise: in the sky and in burnt-out places any disparity
    /// matches, and networks state one with confidence.
    pub min_contrast: f64,
    /// Takes every n-th pixel of every n-th row. Default 1.
    pub stride: usize,
}

impl Default for DepthLimits {
    fn default() -> Self {
        Self {
            min_depth: 0.1,
            max_depth: None,
            max_relative_sigma: 0.1,
            default_sigma: 0.5,
            min_sigma: 0.25,
            max_step: 1.0,
            min_contrast: 2.0,
            stride: 1,
        }
    }
}

impl Cloud {
    /// The points seen by the left camera, in its frame (Hong 2021, eq. 6), coloured by `left`.
    ///
    /// `disparity` and `sigma` in pixels; NaN is unknown. `limits` says which pixels are left out.
    ///
    /// # Errors
    /// When an image has not the size of the rig, or `limits.stride` is 0.
    pub fn from_disparity(
        rig: &RectifiedRig,
        left: &Rgb,
        disparity: &Plane,
        sigma: Option<&Plane>,
        limits: &DepthLimits,
    ) -> Result<Self, TerrainError> {
        let mut sizes = vec![
            ("left image", left.dimensions()),
            ("disparity", disparity.dimensions()),
        ];
        sizes.extend(sigma.map(|s| ("standard deviation of disparity", s.dimensions())));
        for (what, found) in sizes {
            if (found.0 as usize, found.1 as usize) != (rig.width, rig.height) {
                return Err(TerrainError::Sizes {
                    what,
                    found,
                    rig: (rig.width, rig.height),
                });
            }
        }
        if limits.stride == 0 {
            return Err(TerrainError::Setting {
                field: "stride",
                value: "0".into(),
                expected: "1 or more",
            });
        }

        let contrast = Contrast::new(left);
        let max_depth = limits.max_depth.unwrap_or(f64::INFINITY);
        let (w, d) = (rig.width, disparity.as_raw());
        let mut points = Vec::new();
        for v in (0..rig.height).step_by(limits.stride) {
            for u in (0..w).step_by(limits.stride) {
                let i = v * w + u;
                if !d[i].is_finite()
                    || steepest_step(d, w, rig.height, u, v) > limits.max_step as f32
                    || contrast.at(u, v) < limits.min_contrast
                {
                    continue;
                }
                let at = StereoPoint {
                    u: u as f64,
                    v: v as f64,
                    d: f64::from(d[i]),
                };
                let Some(position) = rig.back_project(at) else {
                    continue;
                };
                let z = position.z;
                let sigma_d = sigma
                    .map(|s| f64::from(s.as_raw()[i]))
                    .filter(|s| s.is_finite())
                    .unwrap_or(limits.default_sigma)
                    .max(limits.min_sigma);
                // dz/dd of eq. 6.
                let sigma_z = z * z / (rig.fx * rig.baseline) * sigma_d;
                if z < limits.min_depth || z > max_depth || sigma_z > limits.max_relative_sigma * z
                {
                    continue;
                }
                let colour = left
                    .get_pixel(u as u32, v as u32)
                    .0
                    .map(|c| (c * 255.0).round() as u8);
                points.push(CloudPoint {
                    position,
                    colour,
                    sigma: sigma_z as f32,
                });
            }
        }
        Ok(Self { points })
    }

    /// Reads a PLY, LAS or LAZ file, as its name ends.
    ///
    /// # Errors
    /// When the file cannot be read, is damaged, or is of another format.
    pub fn read(path: &Path) -> Result<Self, TerrainError> {
        let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
        match extension.to_str() {
            Some("ply") => Self::read_ply(path),
            Some("las" | "laz") => Self::read_las(path),
            _ => Err(TerrainError::Cloud {
                path: path.to_owned(),
                message: "its name ends in none of .ply, .las, .laz".into(),
            }),
        }
    }

    /// The cloud in another frame: every position is mapped by `T_b_a`.
    #[allow(non_snake_case)]
    pub fn transform(mut self, T_b_a: &Se3) -> Self {
        for p in &mut self.points {
            p.position = T_b_a * p.position;
        }
        self
    }
}

/// How much the brightness of an image varies around each pixel.
struct Contrast {
    width: usize,
    height: usize,
    /// Sums of brightness and of its square, grey levels, over all pixels above and left of a corner.
    sums: Vec<[f64; 2]>,
}

impl Contrast {
    /// Pixels to each side.
    const HALF: usize = 4;

    fn new(image: &Rgb) -> Self {
        let brightness = luma(image);
        let (width, height) = (image.width() as usize, image.height() as usize);
        let mut sums = vec![[0.0; 2]; (width + 1) * (height + 1)];
        for (y, row) in brightness.as_raw().chunks_exact(width.max(1)).enumerate() {
            let mut along = [0.0; 2];
            for (x, value) in row.iter().enumerate() {
                let grey = f64::from(*value) * 255.0;
                along = [along[0] + grey, along[1] + grey * grey];
                let above = sums[y * (width + 1) + x + 1];
                sums[(y + 1) * (width + 1) + x + 1] = [above[0] + along[0], above[1] + along[1]];
            }
        }
        Self {
            width,
            height,
            sums,
        }
    }

    /// Standard deviation around a pixel, grey levels.
    fn at(&self, x: usize, y: usize) -> f64 {
        let (left, right) = (
            x.saturating_sub(Self::HALF),
            (x + Self::HALF + 1).min(self.width),
        );
        let (top, bottom) = (
            y.saturating_sub(Self::HALF),
            (y + Self::HALF + 1).min(self.height),
        );
        let corner = |x: usize, y: usize| self.sums[y * (self.width + 1) + x];
        let n = ((right - left) * (bottom - top)) as f64;
        let [mean, square] = [0, 1].map(|k| {
            (corner(right, bottom)[k] - corner(left, bottom)[k] - corner(right, top)[k]
                + corner(left, top)[k])
                / n
        });
        (square - mean * mean).max(0.0).sqrt()
    }
}

/// Largest difference between a disparity and its four neighbours, as far as these are known.
fn steepest_step(d: &[f32], w: usize, h: usize, u: usize, v: usize) -> f32 {
    let i = v * w + u;
    let neighbours = [
        (u > 0).then(|| i - 1),
        (u + 1 < w).then(|| i + 1),
        (v > 0).then(|| i - w),
        (v + 1 < h).then(|| i + w),
    ];
    // f32::max passes over NaN, the step to an unknown neighbour.
    neighbours
        .into_iter()
        .flatten()
        .map(|n| (d[n] - d[i]).abs())
        .fold(0.0, f32::max)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn rig() -> RectifiedRig {
        RectifiedRig {
            width: 160,
            height: 120,
            fx: 100.0,
            fy: 100.0,
            cx: 80.0,
            cy: 60.0,
            doffs: 0.0,
            baseline: 0.1,
        }
    }

    /// Of two colours, pixel by pixel.
    pub(crate) fn chequered(rig: &RectifiedRig) -> Rgb {
        Rgb::from_fn(rig.width as u32, rig.height as u32, |x, y| {
            match (x + y) % 2 {
                0 => image::Rgb([0.2, 0.4, 1.0]),
                _ => image::Rgb([0.4, 0.6, 1.0]),
            }
        })
    }

    fn constant(rig: &RectifiedRig, value: f32) -> Plane {
        Plane::from_pixel(rig.width as u32, rig.height as u32, image::Luma([value]))
    }

    #[test]
    fn points_project_back_to_their_pixels() {
        let rig = RectifiedRig {
            doffs: 1.5,
            ..rig()
        };
        let disparity = Plane::from_fn(160, 120, |x, y| {
            image::Luma([10.0 + 0.02 * x as f32 + 0.1 * y as f32])
        });
        let cloud = Cloud::from_disparity(
            &rig,
            &chequered(&rig),
            &disparity,
            None,
            &DepthLimits::default(),
        )
        .unwrap();
        assert_eq!(cloud.points.len(), 160 * 120);
        for (i, p) in cloud.points.iter().enumerate() {
            let at = rig.project(&p.position).unwrap();
            assert!(
                (at.u - (i % 160) as f64).abs() < 1e-9 && (at.v - (i / 160) as f64).abs() < 1e-9
            );
            assert!((at.d - f64::from(disparity.as_raw()[i])).abs() < 1e-9);
            let even = (i % 160 + i / 160) % 2 == 0;
            assert_eq!(
                p.colour,
                if even {
                    [51, 102, 255]
                } else {
                    [102, 153, 255]
                }
            );
            // The same first order as the full covariance of the geometry crate.
            let full = rig.point_covariance(&p.position, 0.0, 0.5)[(2, 2)].sqrt();
            assert!((f64::from(p.sigma) - full).abs() < 1e-6 * full);
        }
    }

    #[test]
    fn depth_is_cut_where_its_deviation_exceeds_its_share() {
        let rig = rig();
        let limits = DepthLimits::default();
        let count = |d: f32, sigma: Option<f32>, limits: &DepthLimits| {
            let sigma = sigma.map(|s| constant(&rig, s));
            Cloud::from_disparity(
                &rig,
                &chequered(&rig),
                &constant(&rig, d),
                sigma.as_ref(),
                limits,
            )
            .unwrap()
            .points
            .len()
        };
        // sigma_z / z = sigma_d / d: at most 0.1 means d of at least 5 for 0.5 px.
        assert_eq!(count(5.01, None, &limits), 160 * 120);
        assert_eq!(count(4.99, None, &limits), 0);
        assert_eq!(count(4.99, Some(0.3), &limits), 160 * 120);
        // A network may not claim less than the floor of 0.25 px.
        assert_eq!(count(2.49, Some(0.001), &limits), 0);
        assert_eq!(count(5.01, Some(f32::NAN), &limits), 160 * 120);
        // Depth 2 m by disparity 5.
        assert_eq!(
            count(
                5.01,
                None,
                &DepthLimits {
                    max_depth: Some(1.9),
                    ..limits
                }
            ),
            0
        );
        assert_eq!(
            count(
                5.01,
                None,
                &DepthLimits {
                    min_depth: 2.1,
                    ..limits
                }
            ),
            0
        );
        assert_eq!(count(f32::NAN, None, &limits), 0);
        assert_eq!(count(-3.0, None, &limits), 0);
        assert_eq!(
            count(
                5.01,
                None,
                &DepthLimits {
                    stride: 4,
                    ..limits
                }
            ),
            40 * 30
        );
    }

    #[test]
    fn what_has_no_texture_makes_no_points() {
        let rig = rig();
        // Ground below, and a sky above in which only noise of a grey level differs.
        let mut image = chequered(&rig);
        for (x, y, pixel) in image.enumerate_pixels_mut().filter(|p| p.1 < 40) {
            let noise = ((x * 7 + y * 13) % 5) as f32 - 2.0;
            pixel.0 = [0.7 + 0.7 * noise / 255.0; 3];
        }
        let limits = DepthLimits::default();
        let rows = |limits| {
            let cloud =
                Cloud::from_disparity(&rig, &image, &constant(&rig, 20.0), None, limits).unwrap();
            assert_eq!(cloud.points.len() % 160, 0);
            cloud.points.len() / 160
        };
        // The window reaches four pixels into the sky.
        assert_eq!(rows(&limits), 84);
        assert_eq!(
            rows(&DepthLimits {
                min_contrast: 0.0,
                ..limits
            }),
            120
        );
    }

    #[test]
    fn smeared_edges_are_dropped_and_clean_surfaces_kept() {
        let rig = rig();
        // Near box, far wall, and between them an estimate smeared over 6 pixels.
        let smeared = |x: u32| (30.0 - (f64::from(x) - 57.0).clamp(0.0, 6.0) / 6.0 * 20.0) as f32;
        let disparity = Plane::from_fn(160, 120, |x, _| image::Luma([smeared(x)]));
        let cloud = Cloud::from_disparity(
            &rig,
            &chequered(&rig),
            &disparity,
            None,
            &DepthLimits::default(),
        )
        .unwrap();
        // Both surfaces lie at 1/3 m and at 1 m; anything between is a flying pixel.
        assert!(
            cloud
                .points
                .iter()
                .all(|p| p.position.z < 0.334 || p.position.z > 0.999)
        );
        assert_eq!(cloud.points.len(), 120 * (160 - 7));
    }

    #[test]
    fn transform_maps_points_and_keeps_the_rest() {
        let point = CloudPoint {
            position: Point3::new(1.0, 2.0, 3.0),
            colour: [1, 2, 3],
            sigma: 0.5,
        };
        let turned = Cloud {
            points: vec![point],
        }
        .transform(&Se3::translation(1.0, -2.0, 0.5));
        assert_eq!(
            turned.points,
            vec![CloudPoint {
                position: Point3::new(2.0, 0.0, 3.5),
                ..point
            }]
        );
    }

    #[test]
    fn another_size_or_a_stride_of_zero_is_refused() {
        let rig = rig();
        let small = Plane::new(10, 10);
        let error = Cloud::from_disparity(
            &rig,
            &chequered(&rig),
            &small,
            None,
            &DepthLimits::default(),
        )
        .unwrap_err();
        assert!(
            error.to_string().contains("disparity is (10, 10)"),
            "{error}"
        );
        let zero = DepthLimits {
            stride: 0,
            ..DepthLimits::default()
        };
        assert!(
            Cloud::from_disparity(&rig, &chequered(&rig), &constant(&rig, 9.0), None, &zero)
                .is_err()
        );
    }
}
