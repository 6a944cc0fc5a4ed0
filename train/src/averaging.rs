//! The exponential moving average of a network's weights.

use barchan_model::StereoNet;
use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::Tensor;

/// `average` drawn towards `net` after `step` steps: `a <- k a + (1 - k) w`, where `k` climbs as
/// `(1 + step) / (10 + step)` to `decay`, so that early averages forget the weights training began
/// with. `average` is without gradients and on the device of `net`.
pub(crate) fn follow(average: StereoNet, net: &StereoNet, decay: f64, step: usize) -> StereoNet {
    let step = step as f64;
    let keep = decay.min((1.0 + step) / (10.0 + step)) as f32;
    let mut flat = Flat(vec![]);
    net.valid().visit(&mut flat);
    flat.0.reverse();
    average.map(&mut Towards { flat: flat.0, keep })
}

/// Every parameter as one row, in the order of the layers.
struct Flat(Vec<Tensor<1>>);

impl ModuleVisitor for Flat {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.0.push(param.val().flatten(0, D - 1));
    }
}

struct Towards {
    /// The parameters, the first layer's last.
    flat: Vec<Tensor<1>>,
    keep: f32,
}

impl ModuleMapper for Towards {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let Some(weights) = self.flat.pop() else {
            return param;
        };
        param.map(|average| {
            let weights = weights.reshape(average.dims());
            average * self.keep + weights * (1.0 - self.keep)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use barchan_model::{Device, Preset};

    fn values(net: &StereoNet) -> Vec<f32> {
        let mut flat = Flat(vec![]);
        net.visit(&mut flat);
        flat.0
            .iter()
            .flat_map(|t| t.to_data().iter::<f32>().collect::<Vec<_>>())
            .collect()
    }

    #[test]
    fn the_average_lies_between_and_comes_to_the_weights() {
        let device = Device::flex();
        let net = |seed| StereoNet::init(&Preset::Tiny.config(), seed, &device).unwrap();
        let (start, end) = (net(1), net(2));
        // Half-way at the eighth step of the warm-up: (1 + 8) / (10 + 8).
        let half = values(&follow(start.clone(), &end, 0.99, 8));
        for ((a, b), m) in values(&start).iter().zip(values(&end)).zip(half) {
            assert!((m - 0.5 * (a + b)).abs() < 1e-6);
        }
        let mut average = start;
        for step in 1..200 {
            average = follow(average, &end, 0.9, step);
        }
        for (a, w) in values(&average).iter().zip(values(&end)) {
            assert!((a - w).abs() < 1e-4);
        }
    }
}
