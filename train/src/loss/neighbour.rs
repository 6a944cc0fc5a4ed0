//! Images of other times, seen from the left camera of this one.

use barchan_geometry::nalgebra::{Matrix3, Vector3};
use barchan_geometry::{RectifiedRig, Se3};
use burn::tensor::{Int, Tensor};

/// The left images of a neighbouring time, one for each pair of a batch, and where they stood. An
/// image that is missing (before the first frame, after the last) has a projection of zeros: it sees
/// nothing.
#[derive(Clone, Debug)]
pub struct Neighbour {
    /// Whole images `[B, 3, H, W]` in 0..=1, smaller ones padded below and to the right.
    pub image: Tensor<4>,
    /// `[B, 12]`: the rows of the matrix [`projection`] makes.
    pub projection: Tensor<2>,
    /// `[B, 2]`: last column and last row of each image.
    pub last: Tensor<2>,
}

/// Nearest depth in the neighbouring camera, as a share of that in this one.
const NEAREST: f32 = 1e-3;

impl Neighbour {
    /// The neighbouring image seen from the left camera through the disparity `[B, 1, h, w]` of a crop:
    /// bilinear sampling, differentiable in the disparity; and 1 where the point lies before the
    /// neighbouring camera and inside its image, else 0, `[B, 1, h, w]`.
    pub fn warp(&self, disparity: &Tensor<4>) -> (Tensor<4>, Tensor<4>) {
        let [batch, _, height, width] = disparity.dims();
        let [_, channels, image_height, image_width] = self.image.dims();
        let device = disparity.device();
        let count = |n: usize| Tensor::<1, Int>::arange(0..n as i64, &device).float();
        let x = count(width).reshape([1, 1, 1, width]);
        let y = count(height).reshape([1, 1, height, 1]);
        let of =
            |values: &Tensor<2>, k: usize| values.clone().narrow(1, k, 1).reshape([batch, 1, 1, 1]);
        let row = |r: usize| {
            let m = |k: usize| of(&self.projection, 4 * r + k);
            x.clone() * m(0) + (y.clone() * m(1) + m(2)) + disparity.clone() * m(3)
        };
        let depth = row(2);
        let ahead = depth.clone().detach().greater_scalar(NEAREST).float();
        let depth = depth.clamp_min(NEAREST);
        let (u, v) = (row(0) / depth.clone(), row(1) / depth);
        let within = |at: &Tensor<4>, k: usize| {
            let at = at.clone().detach();
            at.clone().greater_equal_scalar(0.0).float()
                * at.lower_equal(of(&self.last, k).expand([batch, 1, height, width]))
                    .float()
        };
        let seen = ahead * within(&u, 0) * within(&v, 1);

        // The four pixels around, by their place in the flattened image.
        let split = |at: Tensor<4>, n: usize| {
            let at = at.clamp(0.0, (n - 1) as f32);
            let before = at.clone().detach().floor().clamp_max((n - 2) as f32);
            (before.clone().int(), at - before)
        };
        let (column, a) = split(u, image_width);
        let (line, b) = split(v, image_height);
        let first = line * image_width as i64 + column;
        let flat = self
            .image
            .clone()
            .reshape([batch, channels, image_height * image_width]);
        let sample = |offset: usize| {
            let at = (first.clone() + offset as i64)
                .reshape([batch, 1, height * width])
                .repeat_dim(1, channels);
            flat.clone()
                .gather(2, at)
                .reshape([batch, channels, height, width])
        };
        let between = |from: Tensor<4>, to: Tensor<4>, share: &Tensor<4>| {
            from.clone() + (to - from) * share.clone()
        };
        let above = between(sample(0), sample(1), &a);
        let below = between(sample(image_width), sample(image_width + 1), &a);
        (between(above, below, &b), seen)
    }
}

/// The 3x4 matrix, row by row, that takes `(x, y, 1, d)`, a pixel of a left image's crop at `[x0, y0]`
/// and its disparity with `added` pixels too many, to homogeneous coordinates in the left image of
/// another time: `K (R K^-1 (x + x0, y + y0, 1) + t / Z)` with `1 / Z = (d - added + doffs) / (fx b)`
/// (Godard 2019, eq. 2, over the depth so that points at infinity are no exception).
#[allow(non_snake_case)]
pub fn projection(
    rig: &RectifiedRig,
    T_neighbour_frame: &Se3,
    [x0, y0]: [usize; 2],
    added: usize,
) -> [f32; 12] {
    let K = Matrix3::new(rig.fx, 0.0, rig.cx, 0.0, rig.fy, rig.cy, 0.0, 0.0, 1.0);
    // The inverse, with the shift of the crop.
    let rays = Matrix3::new(
        1.0 / rig.fx,
        0.0,
        (x0 as f64 - rig.cx) / rig.fx,
        0.0,
        1.0 / rig.fy,
        (y0 as f64 - rig.cy) / rig.fy,
        0.0,
        0.0,
        1.0,
    );
    let along = K * T_neighbour_frame.rotation.to_rotation_matrix() * rays;
    let per_disparity: Vector3<f64> =
        K * T_neighbour_frame.translation.vector / (rig.fx * rig.baseline);
    let constant = along.column(2) + per_disparity * (rig.doffs - added as f64);
    std::array::from_fn(|k| {
        let row = k / 4;
        let value = match k % 4 {
            2 => constant[row],
            3 => per_disparity[row],
            column => along[(row, column)],
        };
        value as f32
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::checks::{gradient_error, map, pixels};
    use crate::loss::masked_mean;
    use barchan_datasets::{StereoSource, Synth, planar};
    use burn::tensor::{Device, TensorData};

    fn neighbour(image: Tensor<4>, projection: [f32; 12]) -> Neighbour {
        let [_, _, h, w] = image.dims();
        let device = image.device();
        let tensor = |v: &[f32]| Tensor::<1>::from_floats(v, &device).reshape([1, v.len()]);
        Neighbour {
            projection: tensor(&projection),
            last: tensor(&[w as f32 - 1.0, h as f32 - 1.0]),
            image,
        }
    }

    #[test]
    #[allow(non_snake_case)]
    fn true_disparity_and_poses_bring_the_next_image_onto_this_one() {
        let synth = Synth::parse("seed=3,frames=2,width=128,height=96,noise=0").unwrap();
        let (now, next) = (synth.frame(0).unwrap(), synth.frame(1).unwrap());
        let poses = &synth.true_trajectory().unwrap().poses;
        let T_next_now = poses[1].T_world_cam.inverse() * poses[0].T_world_cam;
        let device = Device::flex();
        let image = |i| {
            Tensor::<4>::from_data(
                TensorData::new(planar(i, [0, 0], [128, 96]), [1, 3, 96, 128]),
                &device,
            )
        };
        let truth = synth.true_disparity(0).unwrap().unwrap();
        // A crop away from the corner, whose right image was taken four pixels further right.
        let ([x0, y0], [w, h], added) = ([16, 8], [96, 80], 4);
        let crop = truth.rows().skip(y0).take(h).flat_map(|row| {
            row.skip(x0)
                .take(w)
                .map(|d| d[0] + added as f32)
                .collect::<Vec<_>>()
        });
        let disparity = Tensor::<4>::from_data(
            TensorData::new(crop.collect::<Vec<f32>>(), [1, 1, h, w]),
            &device,
        );
        let known = disparity.clone().is_nan().bool_not().float();
        let disparity = disparity.clone().mask_fill(disparity.is_nan(), 1.0);
        let left = image(&now.left).narrow(2, y0, h).narrow(3, x0, w);
        let error = |pose: &Se3| {
            let next = image(&next.left);
            let n = neighbour(next, projection(synth.rig(), pose, [x0, y0], added));
            let (warped, seen) = n.warp(&disparity);
            let difference =
                masked_mean((warped - left.clone()).abs(), seen.clone() * known.clone());
            let share = seen.mean().into_scalar::<f32>();
            assert!(share > 0.7, "{share}");
            difference.into_scalar::<f32>()
        };
        let (with, without) = (error(&T_next_now), error(&Se3::identity()));
        assert!(
            with < 0.4 * without,
            "{with} with the pose, {without} without"
        );
    }

    #[test]
    fn gradient_through_a_perspective_warp_matches_finite_differences() {
        // Linear in x and y, so that bilinear sampling has no kinks.
        let ramp = map(10, 16, |x, y| 0.02 * x as f32 + 0.03 * y as f32).repeat_dim(1, 3);
        let projection = [
            1.0, 0.02, 1.3, -0.6, -0.01, 0.95, 0.4, 0.3, 0.001, 0.002, 1.0, 0.04,
        ];
        let n = neighbour(ramp, projection);
        let disparity = map(8, 12, |x, y| 1.0 + 0.3 * ((x * 7 + y * 3) % 5) as f32);
        let (worst, largest) = gradient_error(&disparity, |d| {
            let (warped, seen) = n.warp(d);
            (warped * seen).square().sum()
        });
        assert!(
            largest > 1e-3 && worst < 0.02 * largest,
            "{worst} of {largest}"
        );
    }

    #[test]
    fn a_missing_image_sees_nothing_and_what_lies_behind_is_not_seen() {
        let image = map(8, 12, |_, _| 0.5).repeat_dim(1, 3);
        let disparity = map(8, 12, |_, _| 2.0);
        let seen = |p: [f32; 12]| pixels(&neighbour(image.clone(), p).warp(&disparity).1);
        assert!(seen([0.0; 12]).iter().all(|s| *s == 0.0));
        let same = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        assert!(seen(same).iter().all(|s| *s == 1.0));
        assert!(seen(same.map(|m| -m)).iter().all(|s| *s == 0.0));
    }
}
