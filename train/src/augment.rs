use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

/// What the network sees instead of the images themselves (Hong 2021, 4.2.1): Gaussian noise,
/// brightness, contrast, and a shift of every channel. The loss compares the untouched images.
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
            disparity: 0,
        }
    }
}

impl Augmentation {
    /// Changes planar images (red, green, blue) of a pair in place. The change is the same for both
    /// but for the noise, as both cameras look at one scene.
    pub fn apply(&self, pair: [&mut [f32]; 2], rng: &mut impl Rng) {
        let mut within = |limit: f32| {
            if limit > 0.0 {
                rng.random_range(-limit..=limit)
            } else {
                0.0
            }
        };
        let contrast = 1.0 + within(self.contrast);
        let brightness = within(self.brightness);
        let shifts = [
            within(self.channel),
            within(self.channel),
            within(self.channel),
        ];
        for image in pair {
            let plane = (image.len() / 3).max(1);
            for (channel, shift) in image.chunks_mut(plane).zip(shifts) {
                for value in channel {
                    // The sum of three uniforms is normal enough for noise.
                    let unit: f32 = (0..3).map(|_| rng.random_range(-1.0f32..=1.0)).sum();
                    *value =
                        (*value - 0.5) * contrast + 0.5 + brightness + shift + self.noise * unit;
                }
            }
        }
    }
}
