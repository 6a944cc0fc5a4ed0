use nalgebra::Vector2;
use rayon::prelude::*;

use super::noise::floor;

/// Weights of a uniform cubic B-spline at `t` in 0..=1.
pub(super) fn spline(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    [
        s * s * s / 6.0,
        (3.0 * t * t * (t - 2.0) + 4.0) / 6.0,
        (3.0 * s * s * (s - 2.0) + 4.0) / 6.0,
        t * t * t / 6.0,
    ]
}

/// `v` less as many whole `period`s as fit. (`f64::rem_euclid` is a slow division of integers' kind,
/// and this is asked millions of times a frame.)
pub(super) fn wrapped(v: f64, period: f64) -> f32 {
    let turns = v / period;
    let whole = turns as i64;
    let whole = whole - i64::from(whole as f64 > turns);
    ((turns - whole as f64) * period) as f32
}

/// A square image of `C` channels that repeats, with its halvings, for look-ups band-limited to the
/// area a pixel covers: what one camera sees of a point, the other sees too, and neither aliases.
pub(super) struct Texture<const C: usize> {
    /// Level k has side `side >> k`.
    levels: Vec<Vec<[f32; C]>>,
    side: usize,
    /// Whether level 0 is read as a B-spline, for textures of which single texels may be seen.
    smooth: bool,
}

/// The part of a texture's plane that a pixel covers.
#[derive(Clone, Copy)]
pub(super) struct Footprint {
    /// Longer axis.
    pub major: Vector2<f32>,
    /// Length of the shorter.
    pub minor: f32,
}

impl Footprint {
    /// The area between two steps.
    pub fn new(a: Vector2<f32>, b: Vector2<f32>) -> Self {
        let major = if a.norm_squared() > b.norm_squared() {
            a
        } else {
            b
        };
        Self {
            major,
            minor: a.perp(&b).abs() / major.norm().max(1e-9),
        }
    }

    /// The same in other units.
    pub fn scaled(&self, by: f32) -> Self {
        Self {
            major: self.major * by,
            minor: self.minor * by,
        }
    }
}

impl<const C: usize> Texture<C> {
    /// `side` is a power of two and `image` has its square of values.
    pub fn new(side: usize, smooth: bool, image: Vec<[f32; C]>) -> Self {
        let mut levels = vec![image];
        let mut half = side / 2;
        while half >= 1 {
            let fine = &levels[levels.len() - 1];
            let full = half * 2;
            // Half along x, then half along y; a tent of four, which aliases less than a mean of two.
            let tent = [0.125, 0.375, 0.375, 0.125];
            let halved = |at: &dyn Fn(usize) -> [f32; C], x: usize| {
                (0..4).fold([0.0; C], |sum, k| {
                    add(sum, tent[k], at((2 * x + full + k - 1) % full))
                })
            };
            let mut rows = vec![[0.0; C]; full * half];
            rows.par_chunks_mut(half).enumerate().for_each(|(y, row)| {
                let at = |x: usize| fine[y * full + x];
                row.iter_mut()
                    .enumerate()
                    .for_each(|(x, out)| *out = halved(&at, x));
            });
            let mut coarse = vec![[0.0; C]; half * half];
            coarse
                .par_chunks_mut(half)
                .enumerate()
                .for_each(|(y, row)| {
                    let column = |x: usize| halved(&|y: usize| rows[y * half + x], y);
                    row.iter_mut()
                        .enumerate()
                        .for_each(|(x, out)| *out = column(x));
                });
            levels.push(coarse);
            half /= 2;
        }
        Self {
            levels,
            side,
            smooth,
        }
    }

    /// The mean over a footprint around `at`, in texels of level 0: up to eight look-ups along the
    /// major axis at the level of the minor one (as graphics hardware's anisotropic filter).
    pub fn mean(&self, at: Vector2<f32>, over: Footprint) -> [f32; C] {
        const MOST: f32 = 8.0;
        let length = over.major.norm();
        let width = over.minor.max(length / MOST).max(1e-6);
        let taps = (length / width.max(1.0)).ceil().clamp(1.0, MOST);
        let level = width.log2().clamp(0.0, (self.levels.len() - 1) as f32);
        let (low, share) = (level as usize, level.fract());
        let mut sum = [0.0; C];
        for k in 0..taps as usize {
            let at = at + over.major * ((k as f32 + 0.5) / taps - 0.5);
            sum = add(sum, (1.0 - share) / taps, self.at_level(low, at));
            if share > 0.0 {
                sum = add(sum, share / taps, self.at_level(low + 1, at));
            }
        }
        sum
    }

    /// B-spline at level 0 of smooth textures, else bilinear.
    fn at_level(&self, level: usize, at: Vector2<f32>) -> [f32; C] {
        let side = self.side >> level;
        let image = &self.levels[level];
        let scale = 1.0 / (1 << level) as f32;
        // Level k's texel i covers the texels of level 0 around (i + 1/2) 2^k - 1/2.
        let (x, y) = ((at.x + 0.5) * scale - 0.5, (at.y + 0.5) * scale - 0.5);
        let (i, j) = (floor(x), floor(y));
        let (tx, ty) = (x - i as f32, y - j as f32);
        // The side is a power of two, so the mask wraps negative positions too.
        let wrap = |v: i32| v as usize & (side - 1);
        let row = |j: i32| &image[wrap(j) * side..][..side];
        let mut sum = [0.0; C];
        if level == 0 && self.smooth {
            let (wx, wy) = (spline(tx), spline(ty));
            let columns = [wrap(i - 1), wrap(i), wrap(i + 1), wrap(i + 2)];
            for (k, wy) in wy.into_iter().enumerate() {
                let row = row(j + k as i32 - 1);
                for (wx, column) in wx.into_iter().zip(columns) {
                    sum = add(sum, wx * wy, row[column]);
                }
            }
        } else {
            let columns = [wrap(i), wrap(i + 1)];
            for (wy, row) in [(1.0 - ty, row(j)), (ty, row(j + 1))] {
                for (wx, column) in [(1.0 - tx, columns[0]), (tx, columns[1])] {
                    sum = add(sum, wx * wy, row[column]);
                }
            }
        }
        sum
    }
}

/// `sum + weight * term`.
fn add<const C: usize>(mut sum: [f32; C], weight: f32, term: [f32; C]) -> [f32; C] {
    for c in 0..C {
        sum[c] += weight * term[c];
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_keep_the_mean_and_large_footprints_return_it() {
        let image: Vec<[f32; 1]> = (0..64 * 64)
            .map(|i| [((i * 7919) % 101) as f32 / 100.0])
            .collect();
        let mean = image.iter().map(|v| v[0]).sum::<f32>() / image.len() as f32;
        let texture = Texture::new(64, true, image);
        for level in &texture.levels {
            assert!(
                (level.iter().map(|v| v[0]).sum::<f32>() / level.len() as f32 - mean).abs() < 1e-4
            );
        }
        let wide = Footprint {
            major: Vector2::new(64.0, 0.0),
            minor: 64.0,
        };
        assert!((texture.mean(Vector2::new(-5.3, 900.1), wide)[0] - mean).abs() < 1e-4);
    }

    #[test]
    fn a_slow_wave_is_seen_alike_at_every_level_that_can_hold_it() {
        let wave = |x: f32| (x * std::f32::consts::TAU / 128.0).sin();
        let texture = Texture::new(
            128,
            true,
            (0..128 * 128).map(|i| [wave((i % 128) as f32)]).collect(),
        );
        for (x, width) in [(10.3, 0.5), (10.3, 2.0), (77.7, 4.0), (-31.0, 6.0)] {
            let over = Footprint {
                major: Vector2::new(0.0, width),
                minor: width,
            };
            let [seen] = texture.mean(Vector2::new(x, 3.0), over);
            assert!(
                (seen - wave(x)).abs() < 0.03,
                "{x} {width}: {seen} {}",
                wave(x)
            );
        }
    }
}
