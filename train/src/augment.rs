use barchan_datasets::{Plane, Rgb, StereoFrame};
use image::imageops::{flip_horizontal, flip_vertical};
use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

use crate::TrainError;

/// What the network sees instead of the images themselves (Hong 2021, 4.2.1): Gaussian noise,
/// brightness, contrast, and a shift of every channel. The loss compares the untouched images, but
/// for the flips, which make another pair of both.
///
/// The paper has the first four; all else is off by default.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Augmentation {
    /// Standard deviation of the noise.
    pub noise: f32,
    /// Brightness is shifted by up to this.
    pub brightness: f32,
    /// Contrast is scaled by 1 plus or minus up to this.
    pub contrast: f32,
    /// Each channel is shifted by up to this.
    pub channel: f32,
    /// Both images are blurred by a Gaussian of up to this standard deviation, pixels.
    pub blur: f32,
    /// Share of the pairs whose two images are changed each in its own way, as two cameras with
    /// exposure, gain and focus of their own would (RAFT-Stereo, HITNet); else both are changed alike
    /// but for the noise.
    pub asymmetric: f32,
    /// Share of the pairs that lose one or two patches of the right image, painted over with its mean
    /// colour: the network learns to fill what only one camera sees (RAFT-Stereo, HITNet). For
    /// supervised training, which knows what is there.
    pub erase: f32,
    /// Share of the pairs that are turned upside down.
    pub flip_vertical: f32,
    /// Share of the pairs that are mirrored and swapped: the mirrored right image becomes the left
    /// one, and every disparity keeps its size and sign. Supervised, only pairs whose disparity of the
    /// right image is known.
    pub flip_swap: f32,
    /// The right crop is taken up to this many pixels further right, which adds as much to every
    /// disparity: a network that saw only far ground learns near ground too. For supervised training,
    /// which knows what then leaves the search range; without truth such pixels would teach nonsense.
    pub disparity: usize,
}

impl Default for Augmentation {
    fn default() -> Self {
        Self {
            noise: 0.01,
            brightness: 0.1,
            contrast: 0.2,
            channel: 0.05,
            blur: 0.0,
            asymmetric: 0.0,
            erase: 0.0,
            flip_vertical: 0.0,
            flip_swap: 0.0,
            disparity: 0,
        }
    }
}

/// Sides of erased patches, pixels (RAFT-Stereo); never more than half the crop.
const PATCH: [usize; 2] = [50, 100];

impl Augmentation {
    /// Refuses amounts that are none.
    ///
    /// # Errors
    /// Says which and what it should be.
    pub fn check(&self) -> Result<(), TrainError> {
        let amounts = [
            ("noise", self.noise, 10.0),
            ("brightness", self.brightness, 10.0),
            ("contrast", self.contrast, 10.0),
            ("channel", self.channel, 10.0),
            ("blur", self.blur, 20.0),
            ("asymmetric", self.asymmetric, 1.0),
            ("erase", self.erase, 1.0),
            ("flip_vertical", self.flip_vertical, 1.0),
            ("flip_swap", self.flip_swap, 1.0),
        ];
        match amounts
            .iter()
            .find(|(_, v, most)| !(0.0..=*most).contains(v))
        {
            Some((name, value, most)) => Err(TrainError::Config(format!(
                "augmentation: {name} is {value}, and must be 0 to {most}"
            ))),
            None => Ok(()),
        }
    }

    /// Which flips a pair gets.
    pub(crate) fn draw_flips(&self, rng: &mut impl Rng) -> Flips {
        Flips {
            vertical: chance(self.flip_vertical, rng),
            swap: chance(self.flip_swap, rng),
        }
    }

    /// Changes planar images (red, green, blue) of a pair, each of `size` (width, height), in place.
    pub fn apply(&self, pair: [&mut [f32]; 2], size: [usize; 2], rng: &mut impl Rng) {
        let separately = chance(self.asymmetric, rng);
        let mut change = Change::draw(self, rng);
        let [left, right] = pair;
        change.apply(left, size, rng);
        if separately {
            change = Change::draw(self, rng);
        }
        change.apply(right, size, rng);
        if chance(self.erase, rng) {
            erase(right, size, rng);
        }
    }
}

/// How a pair is turned before it is cropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Flips {
    pub vertical: bool,
    pub swap: bool,
}

impl Flips {
    /// The turned pair. With `swap`, `truth` is the disparity of the right image.
    pub fn apply(self, frame: StereoFrame, truth: Option<Plane>) -> (StereoFrame, Option<Plane>) {
        let (mut frame, mut truth) = (frame, truth);
        if self.swap {
            // A point at column x_r = x_l - d of the right image comes to W - 1 - x_r of the new left
            // one, and from x_l to W - 1 - x_l of the new right one: the difference is d again.
            let left: Rgb = flip_horizontal(&frame.right);
            frame.right = flip_horizontal(&frame.left);
            frame.left = left;
            truth = truth.map(|t| flip_horizontal(&t));
        }
        if self.vertical {
            frame.left = flip_vertical(&frame.left);
            frame.right = flip_vertical(&frame.right);
            truth = truth.map(|t| flip_vertical(&t));
        }
        (frame, truth)
    }
}

/// What one camera does to the colours.
struct Change {
    contrast: f32,
    brightness: f32,
    shifts: [f32; 3],
    noise: f32,
    blur: f32,
}

impl Change {
    fn draw(limits: &Augmentation, rng: &mut impl Rng) -> Self {
        let mut within = |limit: f32| {
            if limit > 0.0 {
                rng.random_range(-limit..=limit)
            } else {
                0.0
            }
        };
        Self {
            contrast: 1.0 + within(limits.contrast),
            brightness: within(limits.brightness),
            shifts: std::array::from_fn(|_| within(limits.channel)),
            noise: limits.noise,
            blur: within(limits.blur).abs(),
        }
    }

    fn apply(&self, image: &mut [f32], [width, height]: [usize; 2], rng: &mut impl Rng) {
        let plane = (width * height).max(1);
        for (channel, shift) in image.chunks_mut(plane).zip(self.shifts) {
            if self.blur > 0.0 {
                blur(channel, width, self.blur);
            }
            for value in channel {
                // The sum of three uniforms is normal enough for noise.
                let unit: f32 = (0..3).map(|_| rng.random_range(-1.0f32..=1.0)).sum();
                *value = (*value - 0.5) * self.contrast
                    + 0.5
                    + self.brightness
                    + shift
                    + self.noise * unit;
            }
        }
    }
}

fn chance(share: f32, rng: &mut impl Rng) -> bool {
    share > 0.0 && rng.random_range(0.0..1.0) < share
}

/// A Gaussian of standard deviation `sigma` pixels over rows, then columns; the border is repeated.
fn blur(plane: &mut [f32], width: usize, sigma: f32) {
    let reach = (3.0 * sigma).ceil() as usize;
    let kernel: Vec<f32> = (0..=2 * reach)
        .map(|k| (-0.5 * ((k as f32 - reach as f32) / sigma).powi(2)).exp())
        .collect();
    let sum: f32 = kernel.iter().sum();
    let height = plane.len() / width.max(1);
    for (count, length, next, step) in [(height, width, width, 1), (width, height, 1, width)] {
        for line in 0..count {
            let row: Vec<f32> = (0..length).map(|i| plane[line * next + i * step]).collect();
            for i in 0..length {
                let weighted = kernel.iter().enumerate().map(|(k, weight)| {
                    let at = (i + k).saturating_sub(reach).min(length - 1);
                    weight * row[at]
                });
                plane[line * next + i * step] = weighted.sum::<f32>() / sum;
            }
        }
    }
}

/// One or two patches of a planar image take its mean colour.
fn erase(image: &mut [f32], [width, height]: [usize; 2], rng: &mut impl Rng) {
    for _ in 0..rng.random_range(1..=2) {
        let [w, h] = [width, height].map(|side| {
            let most = PATCH[1].min(side / 2);
            rng.random_range(PATCH[0].min(most)..=most)
        });
        let (x0, y0) = (
            rng.random_range(0..=width - w),
            rng.random_range(0..=height - h),
        );
        for channel in image.chunks_mut((width * height).max(1)) {
            let mean = channel.iter().sum::<f32>() / channel.len() as f32;
            for row in channel.chunks_mut(width).skip(y0).take(h) {
                row[x0..x0 + w].fill(mean);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    const SIZE: [usize; 2] = [120, 80];

    fn nothing() -> Augmentation {
        Augmentation {
            noise: 0.0,
            brightness: 0.0,
            contrast: 0.0,
            channel: 0.0,
            ..Default::default()
        }
    }

    /// A pair of the same pattern in both images.
    fn pair() -> [Vec<f32>; 2] {
        let mut rng = ChaCha8Rng::seed_from_u64(99);
        let image: Vec<f32> = (0..3 * SIZE[0] * SIZE[1])
            .map(|_| rng.random_range(0.0..1.0))
            .collect();
        [image.clone(), image]
    }

    /// Of how many values two images differ by more than rounding.
    fn different(a: &[f32], b: &[f32]) -> usize {
        a.iter()
            .zip(b)
            .filter(|(a, b)| (*a - *b).abs() > 1e-6)
            .count()
    }

    fn changed(augmentation: Augmentation, seed: u64) -> [Vec<f32>; 2] {
        let [mut left, mut right] = pair();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        augmentation.apply([&mut left, &mut right], SIZE, &mut rng);
        [left, right]
    }

    #[test]
    fn nothing_changes_nothing() {
        let (after, before) = (changed(nothing(), 1), pair());
        assert_eq!(different(&after[0], &before[0]), 0);
        assert_eq!(different(&after[1], &before[1]), 0);
    }

    #[test]
    fn both_cameras_change_alike_unless_asked() {
        let colours = Augmentation {
            brightness: 0.2,
            contrast: 0.3,
            channel: 0.1,
            blur: 1.0,
            ..nothing()
        };
        let apart = |augmentation: Augmentation| {
            (0..200)
                .filter(|seed| {
                    let [left, right] = changed(augmentation, *seed);
                    left != right
                })
                .count()
        };
        assert_eq!(apart(colours), 0);
        let asymmetric = |share| Augmentation {
            asymmetric: share,
            ..colours
        };
        assert_eq!(apart(asymmetric(1.0)), 200);
        // 200 draws of 0.2: 40, standard deviation 6.
        assert!((20..60).contains(&apart(asymmetric(0.2))));
    }

    #[test]
    fn a_blur_keeps_the_mean_and_flattens() {
        let [mut image, _] = pair();
        let plane = &mut image[..SIZE[0] * SIZE[1]];
        let spread = |p: &[f32]| {
            let mean = p.iter().sum::<f32>() / p.len() as f32;
            let square = p.iter().map(|v| (v - mean).powi(2)).sum::<f32>();
            (mean, square / p.len() as f32)
        };
        let (mean, variance) = spread(plane);
        blur(plane, SIZE[0], 1.5);
        let (after, less) = spread(plane);
        assert!((after - mean).abs() < 0.01 && less < 0.3 * variance);
        let mut flat = vec![0.25; 50];
        blur(&mut flat, 10, 0.8);
        assert!(flat.iter().all(|v| (v - 0.25).abs() < 1e-6));
    }

    #[test]
    fn only_patches_of_the_right_image_are_erased() {
        let always = Augmentation {
            erase: 1.0,
            ..nothing()
        };
        for seed in 0..50 {
            let [left, right] = changed(always, seed);
            let [before, _] = pair();
            assert_eq!(different(&left, &before), 0);
            let plane = SIZE[0] * SIZE[1];
            let gone = different(&right[..plane], &before[..plane]);
            // One or two patches of 50 to 60 by 40 pixels.
            assert!((1990..=4800).contains(&gone), "seed {seed}: {gone}");
        }
    }

    #[test]
    fn erasing_fits_the_smallest_crop() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for _ in 0..100 {
            erase(&mut [0.5; 3 * 9], [3, 3], &mut rng);
            erase(&mut [0.5; 3], [1, 1], &mut rng);
        }
    }

    /// Red at `x - d` of the right image is red at `x` of the left one, with `d` growing downwards.
    fn frame() -> (StereoFrame, [Plane; 2]) {
        let red = |at: f32, y: u32| image::Rgb([at / 100.0, y as f32 / 100.0, 0.0]);
        let frame = StereoFrame {
            index: 0,
            name: "a".into(),
            time: 0.0,
            left: Rgb::from_fn(40, 10, |x, y| red(x as f32, y)),
            right: Rgb::from_fn(40, 10, |x, y| red((x + y) as f32, y)),
        };
        let truth = Plane::from_fn(40, 10, |_, y| image::Luma([y as f32]));
        (frame, [truth.clone(), truth])
    }

    #[test]
    fn a_flipped_pair_has_the_same_disparities() {
        for (vertical, swap) in [(true, false), (false, true), (true, true)] {
            let (frame, [left, right]) = frame();
            let truth = if swap { right } else { left };
            let (frame, truth) = Flips { vertical, swap }.apply(frame, Some(truth));
            let truth = truth.unwrap();
            let mut seen = 0;
            for (x, y, d) in truth.enumerate_pixels() {
                let d = d.0[0] as u32;
                let rows = if vertical { 9 - y } else { y };
                assert_eq!(d, rows);
                if d <= x {
                    let (a, b) = (frame.left.get_pixel(x, y), frame.right.get_pixel(x - d, y));
                    assert_eq!(a, b, "{vertical} {swap} at {x} {y}");
                    seen += 1;
                }
            }
            assert!(seen > 300);
        }
    }
}
