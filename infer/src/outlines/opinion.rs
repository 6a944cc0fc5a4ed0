//! What a matcher without learning takes each pixel for.

use barchan_datasets::{Plane, Rgb};

use crate::classical::SemiGlobal;
use crate::engine::{DisparityEngine, DisparityMap, InferError};

/// How far beyond the network's largest disparity is searched, pixels.
const BEYOND: f32 = 8.0;

/// Who else is asked which surfaces there are, for [`super::Outlines`] to choose among.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SecondOpinion {
    /// Nobody.
    None,
    /// Semi-global matching of images of half the size: an eighth of the work.
    Half,
    /// Semi-global matching.
    #[default]
    Full,
}

/// [`SecondOpinion`] at work.
pub(super) struct Opinion {
    kind: SecondOpinion,
    matcher: SemiGlobal,
}

impl Opinion {
    pub fn new(kind: SecondOpinion) -> Self {
        Self {
            kind,
            matcher: SemiGlobal::default(),
        }
    }

    /// Of a pair for which the network has an answer, whose largest disparity says how far to search.
    pub fn of(
        &mut self,
        left: &Rgb,
        right: &Rgb,
        map: &DisparityMap,
    ) -> Result<Option<DisparityMap>, InferError> {
        let known = map.disparity.as_raw().iter().filter(|d| d.is_finite());
        let reach = known.fold(0.0f32, |most, d| most.max(*d)) + BEYOND;
        let (width, height) = left.dimensions();
        match self.kind {
            SecondOpinion::Full => {
                self.matcher.search(reach as usize);
                self.matcher.disparity(left, right).map(Some)
            }
            SecondOpinion::Half if width > 1 && height > 1 => {
                self.matcher.search((0.5 * reach) as usize);
                let half = self.matcher.disparity(&halved(left), &halved(right))?;
                Ok(Some(DisparityMap {
                    disparity: doubled(&half.disparity, 2.0, (width, height)),
                    sigma: doubled(&half.sigma, 2.0, (width, height)),
                    confidence: doubled(&half.confidence, 1.0, (width, height)),
                }))
            }
            SecondOpinion::Half | SecondOpinion::None => Ok(None),
        }
    }
}

/// Four pixels are one.
fn halved(image: &Rgb) -> Rgb {
    Rgb::from_fn(image.width() / 2, image.height() / 2, |x, y| {
        let four = [(0, 0), (1, 0), (0, 1), (1, 1)];
        let four = four.map(|(dx, dy)| image.get_pixel(2 * x + dx, 2 * y + dy).0);
        image::Rgb([0, 1, 2].map(|c| 0.25 * (four[0][c] + four[1][c] + four[2][c] + four[3][c])))
    })
}

/// One pixel is four, its value times a factor; beyond the last one it repeats.
fn doubled(plane: &Plane, factor: f32, (width, height): (u32, u32)) -> Plane {
    let last = (plane.width() - 1, plane.height() - 1);
    Plane::from_fn(width, height, |x, y| {
        let value = plane.get_pixel((x / 2).min(last.0), (y / 2).min(last.1))[0];
        image::Luma([factor * value])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn disparities_of_half_the_size_are_doubled_and_lie_where_they_were() {
        let grey = |x: i64, y: i64| {
            let h = ((x * 7919) ^ (y * 104_729)).wrapping_mul(2_654_435_761) >> 7;
            image::Rgb([(h & 0xff) as f32 / 255.0; 3])
        };
        // Blocks of two pixels, so that half the size shows all there is.
        let shifted = |d: i64| {
            Rgb::from_fn(151, 93, move |x, y| {
                grey((i64::from(x) + d) / 2, i64::from(y) / 2)
            })
        };
        let map = DisparityMap {
            disparity: Plane::from_pixel(151, 93, image::Luma([20.0])),
            sigma: Plane::default(),
            confidence: Plane::default(),
        };
        for kind in [SecondOpinion::Half, SecondOpinion::Full] {
            let found = Opinion::new(kind)
                .of(&shifted(0), &shifted(12), &map)
                .unwrap()
                .unwrap();
            assert_eq!(found.disparity.dimensions(), (151, 93));
            let right = found
                .disparity
                .enumerate_pixels()
                .filter(|(x, _, d)| *x > 30 && (d[0] - 12.0).abs() < 1.0);
            assert!(right.count() > 100 * 93, "{kind:?}");
        }
        let flat = Rgb::from_pixel(1, 1, image::Rgb([0.5; 3]));
        assert!(
            Opinion::new(SecondOpinion::Half)
                .of(&flat, &flat, &map)
                .unwrap()
                .is_none()
        );
        assert!(
            Opinion::new(SecondOpinion::None)
                .of(&flat, &flat, &map)
                .unwrap()
                .is_none()
        );
    }
}
