//! The length of a gradient, clipping it, and whether weights are numbers.

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::Tensor;

/// Shortens the gradient of all parameters together to the Euclidean norm `limit` where it is
/// longer (0 leaves it as it is), and returns the norm it had: no finite number as soon as one
/// component is none.
pub(crate) fn clip<M: Module>(gradients: &mut GradientsParams, module: &M, limit: f32) -> f32 {
    let mut squares = Squares {
        gradients: Some(gradients),
        sums: vec![],
    };
    module.visit(&mut squares);
    let norm = root(squares.sums);
    if limit > 0.0 && norm > limit && norm.is_finite() {
        module.visit(&mut Scale {
            gradients,
            by: limit / norm,
        });
    }
    norm
}

/// The Euclidean norm of all weights together.
pub(crate) fn norm<M: Module>(module: &M) -> f32 {
    let mut squares = Squares {
        gradients: None,
        sums: vec![],
    };
    module.visit(&mut squares);
    root(squares.sums)
}

fn root(sums: Vec<Tensor<1>>) -> f32 {
    if sums.is_empty() {
        return 0.0;
    }
    // One reading off the device for all layers.
    Tensor::cat(sums, 0).sum().sqrt().into_scalar::<f32>()
}

/// Sums of squares, one a layer: of the gradients, or without any of the weights.
struct Squares<'a> {
    gradients: Option<&'a GradientsParams>,
    sums: Vec<Tensor<1>>,
}

impl ModuleVisitor for Squares<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let values = match self.gradients {
            Some(gradients) => gradients.get::<D>(param.id),
            None => Some(param.val()),
        };
        if let Some(values) = values {
            self.sums.push(values.square().sum());
        }
    }
}

struct Scale<'a> {
    gradients: &'a mut GradientsParams,
    by: f32,
}

impl ModuleVisitor for Scale<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if let Some(gradient) = self.gradients.remove::<D>(param.id) {
            self.gradients.register(param.id, gradient * self.by);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[derive(Module, Debug)]
    struct Two {
        a: Param<Tensor<1>>,
        b: Param<Tensor<2>>,
    }

    /// The gradient of `2 a.a / 2 + b.b / 2` at a = [3, 0], b = [[4], [0]]: [6, 0] and [[4], [0]].
    fn gradient() -> (Two, GradientsParams) {
        let device = Device::flex().autodiff();
        let two = Two {
            a: Param::from_tensor(Tensor::from_floats([3.0, 0.0], &device)),
            b: Param::from_tensor(Tensor::from_floats([[4.0], [0.0]], &device)),
        };
        let loss = two.a.val().square().sum() + two.b.val().square().sum() * 0.5;
        let gradients = GradientsParams::from_grads(loss.backward(), &two);
        (two, gradients)
    }

    #[test]
    fn the_whole_gradient_keeps_its_direction_and_gets_the_length() {
        let (two, mut gradients) = gradient();
        let length = 52.0f32.sqrt();
        assert!((clip(&mut gradients, &two, 0.0) - length).abs() < 1e-5);
        assert!((clip(&mut gradients, &two, 100.0) - length).abs() < 1e-5);
        assert!((clip(&mut gradients, &two, 0.5) - length).abs() < 1e-5);
        assert!((clip(&mut gradients, &two, 0.0) - 0.5).abs() < 1e-6);
        let [a, b] = [
            gradients.get::<1>(two.a.id).unwrap().to_data(),
            gradients.get::<2>(two.b.id).unwrap().to_data(),
        ]
        .map(|d| d.iter::<f32>().next().unwrap());
        assert!((a / b - 1.5).abs() < 1e-5 && a > 0.0);
    }

    #[test]
    fn one_component_that_is_no_number_shows_in_the_norm() {
        let (two, mut gradients) = gradient();
        let device = Device::flex();
        gradients.remove::<1>(two.a.id);
        gradients.register(two.a.id, Tensor::<1>::from_floats([f32::NAN, 0.0], &device));
        assert!(!clip(&mut gradients, &two, 1.0).is_finite());
        assert!((norm(&two) - 5.0).abs() < 1e-6);
    }
}
