use barchan_datasets::{Plane, Rgb, StereoFrame, planar};
use burn::tensor::{Device, Tensor, TensorData};
use rand::{Rng, RngExt};

use crate::Augmentation;

/// Pairs as tensors `[B, 3, H, W]`, RGB in 0..=1.
pub struct Batch {
    /// The left images as they are: what the loss compares.
    pub left: Tensor<4>,
    /// The right images as they are.
    pub right: Tensor<4>,
    /// The left images as the network sees them.
    pub seen_left: Tensor<4>,
    /// The right images as the network sees them.
    pub seen_right: Tensor<4>,
    /// True disparity and 1 where it is known, `[B, 1, H, W]`, when asked for.
    pub truth: Option<(Tensor<4>, Tensor<4>)>,
    /// Names of the frames, for messages.
    pub names: String,
}

/// A frame, and its truth where that is wanted.
pub(crate) type Sample = (StereoFrame, Option<Plane>);

impl Batch {
    /// The same random crop of both images of every sample, at most `height` x `width`; images
    /// smaller than that shrink the crop for the whole batch.
    pub(crate) fn crop(
        samples: &[Sample],
        [height, width]: [usize; 2],
        augmentation: Option<&Augmentation>,
        rng: &mut impl Rng,
        device: &Device,
    ) -> Self {
        let fit = |limit: usize, size: fn(&Rgb) -> u32| {
            samples
                .iter()
                .map(|(f, _)| size(&f.left) as usize)
                .fold(limit, usize::min)
        };
        let (height, width) = (fit(height, Rgb::height), fit(width, Rgb::width));
        let shape = [samples.len(), 3, height, width];
        let mut images: [Vec<f32>; 4] =
            std::array::from_fn(|_| Vec::with_capacity(shape.iter().product()));
        let (mut truth, mut known) = (vec![], vec![]);
        for (frame, disparity) in samples {
            let (w, h) = frame.left.dimensions();
            let room = w as usize - width;
            let further = rng.random_range(0..=augmentation.map_or(0, |a| a.disparity).min(room));
            let x0 = rng.random_range(0..=room - further);
            let y0 = rng.random_range(0..=h as usize - height);
            let mut left = planar(&frame.left, [x0, y0], [width, height]);
            let mut right = planar(&frame.right, [x0 + further, y0], [width, height]);
            images[0].extend(&left);
            images[1].extend(&right);
            if let Some(augmentation) = augmentation {
                augmentation.apply([&mut left, &mut right], [width, height], rng);
            }
            images[2].append(&mut left);
            images[3].append(&mut right);
            if let Some(disparity) = disparity {
                for y in y0..y0 + height {
                    let row = &disparity.as_raw()[y * w as usize..][x0..x0 + width];
                    truth.extend(row.iter().map(|d| {
                        if d.is_finite() {
                            d + further as f32
                        } else {
                            0.0
                        }
                    }));
                    known.extend(row.iter().map(|d| f32::from(d.is_finite())));
                }
            }
        }
        let [left, right, seen_left, seen_right] =
            images.map(|data| Tensor::from_data(TensorData::new(data, shape), device));
        let one = [samples.len(), 1, height, width];
        let truth = (truth.len() == one.iter().product::<usize>()).then(|| {
            [truth, known]
                .map(|data| Tensor::from_data(TensorData::new(data, one), device))
                .into()
        });
        let names: Vec<&str> = samples.iter().map(|(f, _)| f.name.as_str()).collect();
        Self {
            left,
            right,
            seen_left,
            seen_right,
            truth,
            names: names.join(", "),
        }
    }

    /// A whole frame, untouched.
    pub(crate) fn whole(frame: &StereoFrame, device: &Device) -> [Tensor<4>; 2] {
        [&frame.left, &frame.right].map(|image| {
            let (w, h) = (image.width() as usize, image.height() as usize);
            Tensor::from_data(
                TensorData::new(planar(image, [0, 0], [w, h]), [1, 3, h, w]),
                device,
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// Every pixel's red is its column over 100, so a crop tells where it was taken.
    fn sample() -> Sample {
        let image = |shift: f32| {
            Rgb::from_fn(64, 40, |x, _| {
                image::Rgb([(x as f32 + shift) / 100.0, 0.0, 0.0])
            })
        };
        let frame = StereoFrame {
            index: 0,
            name: "a".into(),
            time: 0.0,
            left: image(0.0),
            right: image(7.0),
        };
        (frame, Some(Plane::from_pixel(64, 40, image::Luma([7.0]))))
    }

    #[test]
    fn truth_follows_the_disparity_that_augmentation_adds() {
        let device = Device::flex();
        let plain = Augmentation {
            noise: 0.0,
            brightness: 0.0,
            contrast: 0.0,
            channel: 0.0,
            disparity: 20,
            ..Augmentation::default()
        };
        let mut added = Vec::new();
        for seed in 0..20 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let batch = Batch::crop(&[sample()], [32, 32], Some(&plain), &mut rng, &device);
            let red = |t: &Tensor<4>| t.to_data().iter::<f32>().next().unwrap() * 100.0;
            let (truth, known) = batch.truth.unwrap();
            let truth = truth.to_data().iter::<f32>().next().unwrap();
            // At the same place of both crops the right one shows what lies `truth` columns further.
            assert!((red(&batch.right) - red(&batch.left) - truth).abs() < 1e-3);
            assert_eq!(known.mean().into_scalar::<f32>(), 1.0);
            added.push(truth - 7.0);
        }
        assert!(
            added.iter().any(|a| *a > 5.0) && added.iter().all(|a| (0.0..=20.0).contains(a)),
            "{added:?}"
        );
    }

    #[test]
    fn a_crop_shrinks_to_a_small_image() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let batch = Batch::crop(
            &[sample()],
            [192, 320],
            Some(&Augmentation::default()),
            &mut rng,
            &Device::flex(),
        );
        assert_eq!(batch.left.dims(), [1, 3, 40, 64]);
    }
}
