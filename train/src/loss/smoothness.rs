//! Disparity should be smooth where the image is: eq. 4, and its second-order form.

use burn::tensor::Tensor;

/// How fast an edge of the image forgives an edge of the disparity: a step of 0.1 in brightness
/// divides the smoothness weight by e.
const EDGE: f32 = 10.0;

/// `|dx d| exp(-10 |dx I|) + |dy d| exp(-10 |dy I|)`, the mean over pixels (Godard 2017).
pub fn edge_aware_smoothness(image: &Tensor<4>, disparity: &Tensor<4>) -> Tensor<1> {
    let along = |dim: usize| {
        let edge = difference(image, dim).abs().mean_dim(1);
        (difference(disparity, dim).abs() * (edge * -EDGE).exp()).mean()
    };
    along(3) + along(2)
}

/// The same of second differences `d(x-1) - 2 d(x) + d(x+1)`, each forgiven by the image's edges to
/// both sides: ground that slants away costs nothing, where first differences pull it upright
/// (Woodford 2009 for stereo; edge-aware as Jonschkowski 2020).
pub fn second_order_smoothness(image: &Tensor<4>, disparity: &Tensor<4>) -> Tensor<1> {
    let along = |dim: usize| {
        let edge = difference(image, dim).abs().mean_dim(1);
        let n = edge.dims()[dim];
        let edges = edge.clone().narrow(dim, 0, n - 1) + edge.narrow(dim, 1, n - 1);
        let bend = difference(&difference(disparity, dim), dim);
        (bend.abs() * (edges * -EDGE).exp()).mean()
    };
    along(3) + along(2)
}

/// Each value less the one before it.
fn difference(x: &Tensor<4>, dim: usize) -> Tensor<4> {
    let n = x.dims()[dim];
    x.clone().narrow(dim, 1, n - 1) - x.clone().narrow(dim, 0, n - 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::checks::{device, map};

    #[test]
    fn smoothness_counts_disparity_edges_less_on_image_edges() {
        let step = |height: f32| map(8, 12, |x, _| if x < 6 { 0.0 } else { height });
        let disparity = step(0.5);
        let flat =
            edge_aware_smoothness(&step(0.0).repeat_dim(1, 3), &disparity).into_scalar::<f32>();
        let edge =
            edge_aware_smoothness(&step(0.3).repeat_dim(1, 3), &disparity).into_scalar::<f32>();
        // One of eleven differences is 0.5; the image step of 0.3 forgives it by exp(-3).
        assert!((flat - 0.5 / 11.0).abs() < 1e-6, "{flat}");
        assert!(
            (edge / flat - (-3.0f32).exp()).abs() < 1e-4,
            "{edge} {flat}"
        );
    }

    #[test]
    fn second_order_is_blind_to_a_slanted_plane_and_sees_a_fold() {
        let image = Tensor::<4>::full([1, 3, 8, 12], 0.5, &device());
        let plane = map(8, 12, |x, y| 3.0 + 0.25 * x as f32 + 0.5 * y as f32);
        let roof = map(8, 12, |x, _| 0.25 * (x as f32 - 6.0).abs());
        let cost = |d: &Tensor<4>| second_order_smoothness(&image, d).into_scalar::<f32>();
        assert!(cost(&plane) < 1e-6, "{}", cost(&plane));
        // One of ten second differences along x is 2 * 0.25.
        assert!((cost(&roof) - 0.05).abs() < 1e-6, "{}", cost(&roof));
        let first = edge_aware_smoothness(&image, &plane).into_scalar::<f32>();
        assert!((first - 0.75).abs() < 1e-5, "{first}");
    }
}
