//! What can only be found out by serving: sizes, units, batches, and whether both images are looked at.

use super::pairs::{KnownPair, error, median};
use crate::onnxruntime::{OnnxEngine, Unit};
use crate::{DisparityEngine, InferError};

/// By how much the answer moves for each pixel that the right image is moved.
pub(super) fn response(engine: &mut OnnxEngine, pairs: &[KnownPair]) -> Result<f64, InferError> {
    let mut moves = Vec::new();
    for pair in pairs {
        let by = (pair.size()[0] / 40).max(2);
        let moved = pair.moved(by);
        let before = engine.disparity(&pair.left, &pair.right)?.disparity;
        let after = engine.disparity(&moved.left, &moved.right)?.disparity;
        moves.extend(
            (before.iter().zip(after.iter()).zip(&moved.truth))
                .filter(|(_, truth)| truth.is_finite())
                .map(|((before, after), _)| (after - before) / by as f32),
        );
    }
    Ok(f64::from(median(&mut moves)))
}

/// The error through the engine as a user runs it; infinite where it fails.
fn served_error(engine: &mut OnnxEngine, pair: &KnownPair) -> f64 {
    match engine.disparity(&pair.left, &pair.right) {
        Ok(map) => error(pair.compare(map.disparity.as_raw()), pair.size()[0]),
        Err(_) => f64::INFINITY,
    }
}

/// Finds the multiples to which free sides must be padded, and the smallest size; a model that is free
/// by declaration only is fixed to the size with which it ran.
pub(super) fn settle_size(
    engine: &mut OnnxEngine,
    pairs: &[KnownPair],
    given: [usize; 2],
    known: f64,
) {
    let declared = engine.contract.size.clone();
    let Some(pair) = pairs.first() else { return };
    if declared.width.is_some() && declared.height.is_some() {
        return;
    }
    let shrink = engine
        .contract
        .input
        .iter()
        .map(|i| i.shrink)
        .max()
        .unwrap_or(1);
    let size = pair.size();
    let good = |error: f64| error <= 1.5 * known + size[0] as f64 / 800.0;
    for multiple in (0..8)
        .map(|k| 1usize << k)
        .filter(|m| m.is_multiple_of(shrink))
    {
        // Odd multiples, so that no larger power of two divides them.
        let odd = size.map(|side| {
            let times = (side * 15 / 16) / multiple;
            multiple * (times - usize::from(times.is_multiple_of(2) && times > 0))
        });
        if odd.contains(&0) {
            break;
        }
        engine.contract.size.multiple = multiple;
        engine.contract.size.at_least = multiple;
        if !good(served_error(engine, &pair.crop(odd))) {
            continue;
        }
        let smallest = std::iter::successors(Some(multiple), |side| Some(2 * side))
            .take_while(|side| *side <= size[0].min(size[1]))
            .find(|side| served_error(engine, &pair.crop([*side; 2])).is_finite());
        engine.contract.size.at_least = smallest.unwrap_or(size[0].min(size[1]));
        return;
    }
    engine.contract.size.multiple = 1;
    engine.contract.size.at_least = 1;
    engine.contract.size.width = Some(given[0]);
    engine.contract.size.height = Some(given[1]);
}

/// With a free width, tells widths from pixels by another width.
pub(super) fn settle_unit(engine: &mut OnnxEngine, pairs: &[KnownPair], given: [usize; 2]) {
    let output = engine.contract.output.clone();
    if output.unit == Unit::Pixels || engine.contract.size.width.is_some() {
        return;
    }
    let narrow: Vec<KnownPair> = (pairs.iter())
        .map(|pair| pair.crop([pair.size()[0] * 3 / 5, pair.size()[1]]))
        .collect();
    let as_width: f64 = narrow.iter().map(|p| served_error(engine, p)).sum();
    engine.contract.output.unit = Unit::Pixels;
    engine.contract.output.factor = output.factor * given[0] as f64;
    let as_pixels: f64 = narrow.iter().map(|p| served_error(engine, p)).sum();
    if as_width <= as_pixels {
        engine.contract.output = output;
    }
}

/// Whether two pairs at once give what they give one by one.
pub(super) fn runs_in_batches(engine: &mut OnnxEngine, pairs: &[KnownPair]) -> bool {
    let pairs: Vec<_> = pairs.iter().take(2).map(|p| (&p.left, &p.right)).collect();
    let alone = engine.disparity_batch(&pairs);
    engine.contract.size.batch = true;
    let together = engine.disparity_batch(&pairs);
    engine.contract.size.batch = false;
    let (Ok(alone), Ok(together)) = (alone, together) else {
        return false;
    };
    alone.iter().zip(&together).all(|(a, b)| {
        let mut apart: Vec<f32> = (a.disparity.iter().zip(b.disparity.iter()))
            .map(|(a, b)| (a - b).abs())
            .filter(|d| d.is_finite())
            .collect();
        median(&mut apart) < 1e-2
    })
}
