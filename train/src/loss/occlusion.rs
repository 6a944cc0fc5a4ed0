//! What one camera sees and the other does not.

use burn::tensor::Tensor;

use super::warp_right_to_left;

/// 1 where the right image's disparity at the match of a left pixel says the same within `limit`
/// pixels, `|d_l(x) - d_r(x - d_l(x))| <= limit`, else 0: what only the left camera sees has no match,
/// and the comparison there would teach nonsense. No gradient; all `[B, 1, H, W]`.
pub fn visible(disparity: &Tensor<4>, right_disparity: &Tensor<4>, limit: f32) -> Tensor<4> {
    let disparity = disparity.clone().detach();
    let (seen, _) = warp_right_to_left(&right_disparity.clone().detach(), &disparity);
    (disparity - seen).abs().lower_equal_scalar(limit).float()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::checks::{map, pixels};

    #[test]
    fn of_two_planes_exactly_the_band_behind_the_nearer_is_masked() {
        // A near plane of disparity 6 in columns 10..16 of the left image, 4..10 of the right one,
        // before a far plane of disparity 2.
        let plane = |from: usize| {
            move |x: usize, _: usize| {
                if (from..from + 6).contains(&x) {
                    6.0
                } else {
                    2.0
                }
            }
        };
        let (left, right) = (map(4, 24, plane(10)), map(4, 24, plane(4)));
        // Far points of columns 6..10 have their match where the near plane stands in the right image.
        for (at, seen) in pixels(&visible(&left, &right, 1.0)).iter().enumerate() {
            let x = at % 24;
            assert_eq!(*seen, f32::from(!(6..10).contains(&x)), "column {x}");
        }
    }
}
