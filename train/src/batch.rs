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
            let x0 = rng.random_range(0..=w as usize - width);
            let y0 = rng.random_range(0..=h as usize - height);
            let mut left = planar(&frame.left, [x0, y0], [width, height]);
            let mut right = planar(&frame.right, [x0, y0], [width, height]);
            images[0].extend(&left);
            images[1].extend(&right);
            if let Some(augmentation) = augmentation {
                augmentation.apply([&mut left, &mut right], rng);
            }
            images[2].append(&mut left);
            images[3].append(&mut right);
            if let Some(disparity) = disparity {
                for y in y0..y0 + height {
                    let row = &disparity.as_raw()[y * w as usize..][x0..x0 + width];
                    truth.extend(row.iter().map(|d| if d.is_finite() { *d } else { 0.0 }));
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
