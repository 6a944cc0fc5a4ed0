//! Small scenes and finite differences, for the tests of the terms.

use burn::tensor::{Device, Tensor};

pub fn device() -> Device {
    Device::flex().autodiff()
}

/// A one-channel map by column and row.
pub fn map(height: usize, width: usize, value: impl Fn(usize, usize) -> f32) -> Tensor<4> {
    let data: Vec<f32> = (0..height * width)
        .map(|i| value(i % width, i / width))
        .collect();
    Tensor::<1>::from_floats(data.as_slice(), &device()).reshape([1, 1, height, width])
}

/// A smooth image of three channels, 12 x 8 pixels.
pub fn waves(phase: f32) -> Tensor<4> {
    let channel = |c: usize| {
        map(8, 12, move |x, y| {
            0.5 + 0.3 * (0.7 * x as f32 + 0.4 * y as f32 + phase + c as f32).sin()
        })
    };
    Tensor::cat(vec![channel(0), channel(1), channel(2)], 1)
}

/// Disparities away from whole pixels, where linear sampling has kinks.
pub fn between_pixels() -> Tensor<4> {
    map(8, 12, |x, y| {
        ((5 * x + 3 * y) % 3) as f32 + 0.2 + 0.1 * ((7 * x + 11 * y) % 7) as f32
    })
}

pub fn pixels(x: &Tensor<4>) -> Vec<f32> {
    x.to_data().iter::<f32>().collect()
}

/// The largest difference between the gradient of a loss in the disparity and finite differences, and
/// the largest gradient.
pub fn gradient_error(disparity: &Tensor<4>, loss: impl Fn(&Tensor<4>) -> Tensor<1>) -> (f32, f32) {
    let d = disparity.clone().require_grad();
    let gradients = loss(&d).backward();
    let gradient: Vec<f32> = d
        .grad(&gradients)
        .unwrap()
        .into_data()
        .iter::<f32>()
        .collect();
    let base = pixels(disparity);
    let step = 0.02;
    let (mut worst, mut largest) = (0.0f32, 0.0f32);
    for i in (0..base.len()).step_by(5) {
        let at = |offset: f32| {
            let mut moved = base.clone();
            moved[i] += offset;
            let moved = Tensor::<1>::from_floats(moved.as_slice(), &device());
            loss(&moved.reshape(disparity.dims())).into_scalar::<f32>()
        };
        let numeric = (at(step) - at(-step)) / (2.0 * step);
        worst = worst.max((numeric - gradient[i]).abs());
        largest = largest.max(gradient[i].abs());
    }
    (worst, largest)
}
