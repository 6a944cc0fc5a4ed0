use barchan_datasets::{Plane, Rgb, StereoFrame, planar};
use barchan_geometry::{RectifiedRig, Se3};
use burn::tensor::{Device, Tensor, TensorData};
use rand::{Rng, RngExt};

use crate::Augmentation;
use crate::loss::{Neighbour, projection};

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
    pub truth: Option<[Tensor<4>; 2]>,
    /// Disparity by semi-global matching and 1 where it is known, `[B, 1, H, W]`, when asked for.
    pub proxies: Option<[Tensor<4>; 2]>,
    /// Left images of neighbouring times, when asked for.
    pub neighbours: Vec<Neighbour>,
    /// Names of the frames, for messages.
    pub names: String,
}

/// A frame, and what else training with it wants.
pub(crate) struct Sample {
    pub frame: StereoFrame,
    pub rig: RectifiedRig,
    /// True disparity, where that is wanted.
    pub truth: Option<Plane>,
    /// Disparity by semi-global matching, where that is wanted.
    pub proxy: Option<Plane>,
    /// Left images of neighbouring times, as many of every frame, `None` where there is none.
    pub neighbours: Vec<Option<Moment>>,
}

/// What the left camera saw at another time.
#[allow(non_snake_case)]
pub(crate) struct Moment {
    pub image: Rgb,
    /// Maps points of the left camera at the time of the frame to the left camera at this one.
    pub T_neighbour_frame: Se3,
}

/// Where a crop was taken: its top left corner, its size, and how much further right the right one was.
#[derive(Clone, Copy)]
struct Crop {
    corner: [usize; 2],
    size: [usize; 2],
    further: usize,
}

impl Batch {
    /// The same random crop of both images of every sample, at most `height` x `width`; images
    /// smaller than that shrink the crop for the whole batch. At least one sample.
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
                .map(|s| size(&s.frame.left) as usize)
                .fold(limit, usize::min)
        };
        let (height, width) = (fit(height, Rgb::height), fit(width, Rgb::width));
        let shape = [samples.len(), 3, height, width];
        let mut images: [Vec<f32>; 4] =
            std::array::from_fn(|_| Vec::with_capacity(shape.iter().product()));
        let mut crops = Vec::with_capacity(samples.len());
        for Sample { frame, .. } in samples {
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
            crops.push(Crop {
                corner: [x0, y0],
                size: [width, height],
                further,
            });
        }
        let [left, right, seen_left, seen_right] =
            images.map(|data| Tensor::from_data(TensorData::new(data, shape), device));
        let names: Vec<&str> = samples.iter().map(|s| s.frame.name.as_str()).collect();
        let of = |plane: fn(&Sample) -> Option<&Plane>| {
            let planes: Option<Vec<&Plane>> = samples.iter().map(plane).collect();
            planes.map(|planes| known(&planes, &crops, device))
        };
        Self {
            left,
            right,
            seen_left,
            seen_right,
            truth: of(|s| s.truth.as_ref()),
            proxies: of(|s| s.proxy.as_ref()),
            neighbours: (0..samples[0].neighbours.len())
                .map(|k| neighbour(samples, k, &crops, device))
                .collect(),
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

/// Crops of disparity, with what each crop adds to it, and 1 where it is known.
fn known(planes: &[&Plane], crops: &[Crop], device: &Device) -> [Tensor<4>; 2] {
    let (mut values, mut known) = (vec![], vec![]);
    let [width, height] = crops[0].size;
    for (plane, crop) in planes.iter().zip(crops) {
        let [x0, y0] = crop.corner;
        for y in y0..y0 + height {
            let row = &plane.as_raw()[y * plane.width() as usize..][x0..x0 + width];
            values.extend(row.iter().map(|d| {
                if d.is_finite() {
                    d + crop.further as f32
                } else {
                    0.0
                }
            }));
            known.extend(row.iter().map(|d| f32::from(d.is_finite())));
        }
    }
    let shape = [planes.len(), 1, height, width];
    [values, known].map(|data| Tensor::from_data(TensorData::new(data, shape), device))
}

/// The `k`-th neighbours of all samples.
fn neighbour(samples: &[Sample], k: usize, crops: &[Crop], device: &Device) -> Neighbour {
    let moments = || samples.iter().map(|s| s.neighbours[k].as_ref());
    // At least the four pixels that are sampled around a point.
    let most = |size: fn(&Rgb) -> u32| {
        let sizes = moments().flatten().map(|m| size(&m.image) as usize);
        sizes.fold(2, usize::max)
    };
    let (height, width) = (most(Rgb::height), most(Rgb::width));
    let mut images = vec![0.0; samples.len() * 3 * height * width];
    let (mut projections, mut last) = (vec![], vec![]);
    for (i, moment) in moments().enumerate() {
        let Some(moment) = moment else {
            projections.extend([0.0; 12]);
            last.extend([0.0; 2]);
            continue;
        };
        let (w, h) = (
            moment.image.width() as usize,
            moment.image.height() as usize,
        );
        let planes = planar(&moment.image, [0, 0], [w, h]);
        for (row, values) in planes.chunks_exact(w).enumerate() {
            let (channel, y) = (row / h, row % h);
            images[((3 * i + channel) * height + y) * width..][..w].copy_from_slice(values);
        }
        let pose = &moment.T_neighbour_frame;
        projections.extend(projection(
            &samples[i].rig,
            pose,
            crops[i].corner,
            crops[i].further,
        ));
        last.extend([(w - 1) as f32, (h - 1) as f32]);
    }
    let n = samples.len();
    Neighbour {
        image: Tensor::from_data(TensorData::new(images, [n, 3, height, width]), device),
        projection: Tensor::from_data(TensorData::new(projections, [n, 12]), device),
        last: Tensor::from_data(TensorData::new(last, [n, 2]), device),
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
        let truth = Plane::from_pixel(64, 40, image::Luma([7.0]));
        Sample {
            frame,
            rig: RectifiedRig {
                width: 64,
                height: 40,
                fx: 50.0,
                fy: 50.0,
                cx: 31.5,
                cy: 19.5,
                doffs: 0.0,
                baseline: 0.1,
            },
            proxy: Some(truth.clone()),
            truth: Some(truth),
            neighbours: vec![],
        }
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
            let proxies = batch.proxies.unwrap();
            let [truth, known] = batch.truth.unwrap();
            assert_eq!(proxies[0].to_data(), truth.to_data());
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
    fn neighbours_of_several_sizes_keep_their_own_borders() {
        let image = |w, h| Rgb::from_pixel(w, h, image::Rgb([0.5; 3]));
        let mut samples = [sample(), sample(), sample()];
        for (sample, size) in samples
            .iter_mut()
            .zip([Some((64, 40)), Some((80, 48)), None])
        {
            sample.neighbours = vec![size.map(|(w, h)| Moment {
                image: image(w, h),
                T_neighbour_frame: Se3::identity(),
            })];
        }
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let plain = Augmentation {
            disparity: 10,
            ..Augmentation::default()
        };
        let batch = Batch::crop(&samples, [32, 40], Some(&plain), &mut rng, &Device::flex());
        let [neighbour] = &batch.neighbours[..] else {
            panic!("{} neighbours", batch.neighbours.len())
        };
        assert_eq!(neighbour.image.dims(), [3, 3, 48, 80]);
        // Standing still, a point of any depth is seen where it was; the missing image sees nothing.
        let disparity = Tensor::<4>::full([3, 1, 32, 40], 12.0, &Device::flex());
        let (warped, seen) = neighbour.warp(&disparity);
        let of = |x: &Tensor<4>, i| x.clone().narrow(0, i, 1).mean().into_scalar::<f32>();
        assert_eq!([of(&seen, 0), of(&seen, 1), of(&seen, 2)], [1.0, 1.0, 0.0]);
        assert!((of(&warped, 0) - 0.5).abs() < 1e-6 && (of(&warped, 1) - 0.5).abs() < 1e-6);
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
