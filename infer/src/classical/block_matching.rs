use barchan_datasets::Rgb;
use rayon::prelude::*;

use super::CostVolume;
use super::finish::finish;
use crate::engine::check_sizes;
use crate::{DisparityEngine, DisparityMap, InferError};

/// Block matching: the disparity at which the census transforms of a square around a pixel differ
/// least.
#[derive(Clone, Copy, Debug)]
pub struct BlockMatching {
    /// As in [`super::SemiGlobal`].
    pub range: Option<usize>,
    /// Half the side of the square, pixels; at most 15.
    pub radius: usize,
}

impl Default for BlockMatching {
    fn default() -> Self {
        Self {
            range: None,
            radius: 5,
        }
    }
}

impl DisparityEngine for BlockMatching {
    fn name(&self) -> String {
        "block matching".into()
    }

    fn disparity(&mut self, left: &Rgb, right: &Rgb) -> Result<DisparityMap, InferError> {
        check_sizes(left, right)?;
        let volume = CostVolume::new(left, right, self.range);
        // 31 x 31 pixels of at most 62 bits fit in 16 bits.
        let radius = self.radius.min(15);
        let (width, range) = (volume.width, volume.range);
        let row = width * range;
        // Along x first: each a running sum.
        let mut along = vec![0u16; volume.costs.len()];
        along
            .par_chunks_mut(row)
            .zip(volume.costs.par_chunks(row))
            .for_each(|(out, costs)| {
                let at = |x: isize| {
                    let x = x.clamp(0, width as isize - 1) as usize;
                    &costs[x * range..][..range]
                };
                let mut sum = vec![0u16; range];
                let reach = radius as isize;
                for x in -reach..=reach {
                    sum.iter_mut()
                        .zip(at(x))
                        .for_each(|(s, c)| *s += u16::from(*c));
                }
                for (x, out) in out.chunks_exact_mut(range).enumerate() {
                    out.copy_from_slice(&sum);
                    let (enter, leave) = (at(x as isize + reach + 1), at(x as isize - reach));
                    for ((s, enter), leave) in sum.iter_mut().zip(enter).zip(leave) {
                        *s = *s + u16::from(*enter) - u16::from(*leave);
                    }
                }
            });
        let area = (2 * radius + 1).pow(2) as f32;
        Ok(finish(&volume, area, |y, sums| {
            sums.fill(0);
            for k in 0..=2 * radius {
                let y = (y + k).saturating_sub(radius).min(volume.height - 1);
                let along = &along[y * row..][..row];
                sums.iter_mut().zip(along).for_each(|(s, a)| *s += a);
            }
        }))
    }
}
