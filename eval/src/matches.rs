//! How many feature matches each rule accepts, and how many of them are true (Hong 2021, table 1).

use barchan_datasets::Plane;
use serde::Serialize;

/// Matches of a kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct MatchFigures {
    /// How many in an image, on average.
    pub matches: f64,
    /// How many of those with a known truth are true, percent; `None` where none is known.
    pub precision: Option<f64>,
}

/// Matches by which rules accept them, then by ways to combine the rules.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MatchScore {
    /// Images judged.
    pub images: usize,
    /// Features of a left image, on average.
    pub features: f64,
    /// Accepted by the distance ratio, contradicted by dense disparity.
    pub nndr_contradicted: MatchFigures,
    /// Accepted by the distance ratio where dense disparity is not known. With those before: the
    /// paper's NNDR and not disparity.
    pub nndr_alone: MatchFigures,
    /// Accepted by both.
    pub both: MatchFigures,
    /// Accepted by dense disparity only.
    pub disparity_alone: MatchFigures,
    /// All that the distance ratio accepts.
    pub nndr: MatchFigures,
    /// All that dense disparity accepts.
    pub disparity: MatchFigures,
    /// All that either accepts: the paper's rule for tracking.
    pub either: MatchFigures,
    /// All that either accepts, less what dense disparity contradicts: the rule of `barchan slam`.
    pub not_contradicted: MatchFigures,
}

/// Counts matches of any number of images.
#[derive(Clone, Copy, Debug, Default)]
pub struct MatchTally {
    images: usize,
    features: usize,
    kinds: [Count; 4],
}

#[derive(Clone, Copy, Debug, Default)]
struct Count {
    matches: usize,
    known: usize,
    correct: usize,
}

const CONTRADICTED: usize = 0;
const SILENT: usize = 1;
const BOTH: usize = 2;
const DISPARITY: usize = 3;

impl MatchTally {
    /// Notes an image with so many features in its left half.
    pub fn add_image(&mut self, features: usize) {
        self.images += 1;
        self.features += features;
    }

    /// Notes a match: whether the distance ratio accepts it, whether dense disparity does (`None`
    /// where it is not known), and whether it is true, where that is known.
    pub fn add(&mut self, by_ratio: bool, by_disparity: Option<bool>, correct: Option<bool>) {
        let kind = match (by_ratio, by_disparity) {
            (true, Some(true)) => BOTH,
            (true, Some(false)) => CONTRADICTED,
            (true, None) => SILENT,
            (false, Some(true)) => DISPARITY,
            (false, _) => return,
        };
        let count = &mut self.kinds[kind];
        count.matches += 1;
        count.known += usize::from(correct.is_some());
        count.correct += usize::from(correct == Some(true));
    }

    /// Averages over the images; `None` without any.
    pub fn score(&self) -> Option<MatchScore> {
        let images = (self.images > 0).then_some(self.images as f64)?;
        let figures = |kinds: &[usize]| {
            let sum =
                |of: fn(&Count) -> usize| kinds.iter().map(|k| of(&self.kinds[*k])).sum::<usize>();
            let (known, correct) = (sum(|c| c.known), sum(|c| c.correct));
            MatchFigures {
                matches: sum(|c| c.matches) as f64 / images,
                precision: (known > 0).then(|| 100.0 * correct as f64 / known as f64),
            }
        };
        Some(MatchScore {
            images: self.images,
            features: self.features as f64 / images,
            nndr_contradicted: figures(&[CONTRADICTED]),
            nndr_alone: figures(&[SILENT]),
            both: figures(&[BOTH]),
            disparity_alone: figures(&[DISPARITY]),
            nndr: figures(&[CONTRADICTED, SILENT, BOTH]),
            disparity: figures(&[BOTH, DISPARITY]),
            either: figures(&[CONTRADICTED, SILENT, BOTH, DISPARITY]),
            not_contradicted: figures(&[SILENT, BOTH, DISPARITY]),
        })
    }
}

/// Whether a match lies within `tolerance` pixels of where true disparity puts it; `None` where that
/// is not known. Places are column and row.
pub fn is_correct(truth: &Plane, left: [f64; 2], right: [f64; 2], tolerance: f64) -> Option<bool> {
    let [u, v] = left.map(|c| c.round().max(0.0) as u32);
    let disparity = f64::from(truth.get_pixel_checked(u, v)?.0[0]);
    let error = (left[0] - disparity - right[0]).hypot(left[1] - right[1]);
    disparity.is_finite().then_some(error <= tolerance)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn combined_rules_are_sums_of_their_parts() {
        let mut tally = MatchTally::default();
        assert_eq!(tally.score(), None);
        tally.add_image(10);
        tally.add_image(20);
        tally.add(true, Some(true), Some(true));
        tally.add(true, Some(true), Some(true));
        tally.add(true, Some(false), Some(false));
        tally.add(true, None, None);
        tally.add(false, Some(true), Some(true));
        // No rule accepts these: they count nowhere.
        tally.add(false, Some(false), Some(false));
        tally.add(false, None, Some(true));
        let s = tally.score().unwrap();
        assert_eq!((s.images, s.features), (2, 15.0));
        assert_eq!((s.both.matches, s.both.precision), (1.0, Some(100.0)));
        assert_eq!(s.nndr_alone.precision, None);
        assert_eq!((s.nndr.matches, s.disparity.matches), (2.0, 1.5));
        assert_eq!((s.either.matches, s.either.precision), (2.5, Some(75.0)));
        assert_eq!(s.not_contradicted.precision, Some(100.0));
        assert_eq!(
            s.not_contradicted.matches + s.nndr_contradicted.matches,
            2.5
        );
    }

    #[test]
    fn a_match_is_true_near_to_where_disparity_puts_it() {
        let row: Vec<f32> = (0..20)
            .map(|x| if x < 10 { f32::NAN } else { 4.0 })
            .collect();
        let truth = Plane::from_raw(20, 10, row.repeat(10)).unwrap();
        let verdict = |left, right| is_correct(&truth, left, right, 3.0);
        assert_eq!(verdict([15.0, 5.0], [11.0, 5.0]), Some(true));
        assert_eq!(verdict([15.0, 5.0], [8.5, 5.0]), Some(true));
        assert_eq!(verdict([15.0, 5.0], [7.5, 5.0]), Some(false));
        assert_eq!(verdict([15.0, 5.0], [11.0, 8.5]), Some(false));
        assert_eq!(verdict([5.0, 5.0], [1.0, 5.0]), None);
        assert_eq!(verdict([25.0, 5.0], [1.0, 5.0]), None);
    }
}
