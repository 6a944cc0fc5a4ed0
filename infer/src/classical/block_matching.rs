use barchan_datasets::Rgb;
use rayon::prelude::*;

use super::finish::decide;
use super::{CostVolume, match_in_strips};
use crate::engine::check_sizes;
use crate::{DisparityEngine, DisparityMap, InferError};

/// Block matching: the disparity at which the census transforms of a square around a pixel differ
/// least.
#[derive(Debug, Default)]
pub struct BlockMatching {
    range: Option<usize>,
    // Kept from pair to pair.
    volume: CostVolume,
    along: Vec<u16>,
}

/// Half the side of the square, pixels: 11 x 11 times 62 bits fit in 16 bits.
const RADIUS: usize = 5;

impl BlockMatching {
    /// The range as in [`super::SemiGlobal::new`].
    pub fn new(range: Option<usize>) -> Self {
        Self {
            range,
            ..Self::default()
        }
    }
}

impl DisparityEngine for BlockMatching {
    fn name(&self) -> String {
        "block matching".into()
    }

    fn disparity(&mut self, left: &Rgb, right: &Rgb) -> Result<DisparityMap, InferError> {
        check_sizes(left, right)?;
        let (volume, along) = (&mut self.volume, &mut self.along);
        Ok(match_in_strips(
            left,
            right,
            self.range,
            volume,
            |volume, rows, pixels| {
                sum_along_rows(volume, along);
                let row = volume.width * volume.range;
                let area = (2 * RADIUS + 1).pow(2) as f32;
                decide(pixels, (volume.width, volume.range), area, |y, sums| {
                    sums.fill(0);
                    for k in 0..=2 * RADIUS {
                        let y = (rows.start + y + k)
                            .saturating_sub(RADIUS)
                            .min(volume.rows - 1);
                        let along = &along[y * row..][..row];
                        sums.iter_mut().zip(along).for_each(|(s, a)| *s += a);
                    }
                });
            },
        ))
    }
}

/// For each pixel the costs of the pixels of its row up to [`RADIUS`] away; beyond the border its
/// last pixel counts again.
fn sum_along_rows(volume: &CostVolume, along: &mut Vec<u16>) {
    let (width, range) = (volume.width, volume.range);
    along.resize(volume.costs.len(), 0);
    along
        .par_chunks_mut(width * range)
        .zip(volume.costs.par_chunks(width * range))
        .for_each(|(out, costs)| {
            let at = |x: isize| {
                let x = x.clamp(0, width as isize - 1) as usize;
                &costs[x * range..][..range]
            };
            let mut sum = vec![0u16; range];
            let reach = RADIUS as isize;
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
}
