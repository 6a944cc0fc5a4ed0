//! Which key frames look like the newest one, and keep doing so (Galvez-Lopez and Tardos 2012).

use std::sync::Arc;

use crate::features::Descriptor;
use crate::vocabulary::{BagOfWords, Vocabulary};

/// Key frames before and after the likeliest one of an island that belong to it.
const ISLAND_REACH: usize = 6;
/// How far an island may move between successive key frames and still be the same place.
const ISLAND_DRIFT: usize = 6;
/// Islands that are followed at once.
const ISLANDS: usize = 4;
/// Least score of a key frame with the one before it: less says that it shows nothing to go by.
const LEAST_REFERENCE: f64 = 0.01;

/// Key frames by what they show: an inverted file from words to key frames.
pub(crate) struct Places {
    vocabulary: Arc<Vocabulary>,
    /// For each word, the key frames that show it and its weight there.
    shown_by: Vec<Vec<(usize, f64)>>,
    bags: Vec<BagOfWords>,
    /// Islands of the newest key frame.
    islands: Vec<Island>,
}

/// Neighbouring key frames that all look like the newest one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Island {
    /// The likeliest of them.
    pub keyframe: usize,
    /// Its score over that of the key frame just before the newest one.
    pub score: f64,
    /// How many successive key frames found this place, this one counted.
    pub streak: usize,
}

impl Places {
    pub fn new(vocabulary: Arc<Vocabulary>) -> Self {
        Self {
            shown_by: vec![Vec::new(); vocabulary.len()],
            bags: Vec::new(),
            islands: Vec::new(),
            vocabulary,
        }
    }

    /// Adds the next key frame, and gives the places it looks like, the likeliest first: islands of
    /// key frames whose score reaches `least_score` times that of the key frame just before. Key
    /// frames that `skip` are left out.
    pub fn add(
        &mut self,
        descriptors: &[Descriptor],
        least_score: f64,
        skip: impl Fn(usize) -> bool,
    ) -> Vec<Island> {
        let bag = self.vocabulary.bag(descriptors);
        let reference = self.bags.last().map_or(0.0, |before| bag.score(before));
        let scores = self.scores(&bag);
        let newest = self.bags.len();
        for (word, weight) in &bag.0 {
            self.shown_by[*word].push((newest, *weight));
        }
        self.bags.push(bag);

        let mut islands = Vec::new();
        if reference >= LEAST_REFERENCE {
            let likeness = |k: usize| {
                (scores[k] >= least_score * reference && !skip(k)).then_some(scores[k] / reference)
            };
            let scores: Vec<Option<f64>> = (0..newest).map(likeness).collect();
            islands = islands_of(&scores);
        }
        for island in &mut islands {
            let before = self.islands.iter();
            let same = before.filter(|b| b.keyframe.abs_diff(island.keyframe) <= ISLAND_DRIFT);
            island.streak += same.map(|before| before.streak).max().unwrap_or(0);
        }
        self.islands.clone_from(&islands);
        islands
    }

    /// The key frames that look most like these descriptors, the likeliest first.
    pub fn likeliest(&self, descriptors: &[Descriptor]) -> Vec<usize> {
        let scores = self.scores(&self.vocabulary.bag(descriptors));
        let scores: Vec<_> = scores.iter().map(|s| (*s > 0.0).then_some(*s)).collect();
        islands_of(&scores).iter().map(|i| i.keyframe).collect()
    }

    /// A key frame as a place that the newest one may look like.
    pub fn island(&self, keyframe: usize) -> Island {
        let score = match self.bags.as_slice() {
            [.., before, newest] => {
                let reference = newest.score(before).max(LEAST_REFERENCE);
                newest.score(&self.bags[keyframe]) / reference
            }
            _ => 0.0,
        };
        Island {
            keyframe,
            score,
            streak: 1,
        }
    }

    /// The score of each key frame with a bag: see [`BagOfWords::score`].
    fn scores(&self, bag: &BagOfWords) -> Vec<f64> {
        let mut scores = vec![0.0; self.bags.len()];
        for (word, weight) in &bag.0 {
            for (keyframe, other) in &self.shown_by[*word] {
                scores[*keyframe] += weight.min(*other);
            }
        }
        scores
    }
}

/// The likeliest key frames that have a score and are not near to a likelier one, the first the
/// likeliest.
fn islands_of(scores: &[Option<f64>]) -> Vec<Island> {
    let scored = scores.iter().enumerate();
    let mut found: Vec<(usize, f64)> = scored.filter_map(|(k, s)| Some((k, (*s)?))).collect();
    found.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut islands: Vec<Island> = Vec::new();
    for (keyframe, score) in found {
        let apart = |i: &Island| i.keyframe.abs_diff(keyframe) > ISLAND_REACH;
        if islands.len() < ISLANDS && islands.iter().all(apart) {
            islands.push(Island {
                keyframe,
                score,
                streak: 1,
            });
        }
    }
    islands
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// What is seen at a place: descriptors of its own, some of which the next places show as well.
    fn view(place: usize) -> Vec<Descriptor> {
        let of = |k: usize| {
            let mut rng = ChaCha8Rng::seed_from_u64(k as u64);
            std::array::from_fn(|_| rng.random())
        };
        (place * 20..place * 20 + 60).map(of).collect()
    }

    fn places(count: usize) -> Places {
        let images: Vec<_> = (0..count).map(view).collect();
        let vocabulary = Vocabulary::train(&images, 8, 4, 32, 1);
        Places::new(Arc::new(vocabulary))
    }

    #[test]
    fn the_inverted_file_scores_as_the_bags_do() {
        let mut places = places(12);
        (0..12).for_each(|k| drop(places.add(&view(k), 0.3, |_| false)));
        let bag = places.vocabulary.bag(&view(5));
        let scores = places.scores(&bag);
        for (score, other) in scores.iter().zip(&places.bags) {
            assert!((score - bag.score(other)).abs() < 1e-12);
        }
        assert!((scores[5] - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_place_seen_again_is_found_and_confirmed_by_the_next_ones() {
        let mut places = places(40);
        let recent = |newest: usize| move |k: usize| k + 10 > newest;
        for k in 0..40 {
            let found = places.add(&view(k), 0.3, recent(k));
            assert!(found.is_empty(), "{k}: {found:?}");
        }
        // The one before shows nothing of it: there is no likeness to measure by.
        assert!(places.add(&view(4), 0.3, recent(40)).is_empty());
        for (again, newest) in (5..9).zip(41..) {
            let found = places.add(&view(again), 0.3, recent(newest));
            assert_eq!((found.len(), found[0].keyframe), (1, again));
            assert_eq!(found[0].streak, again - 4);
        }
        // A jump elsewhere begins to count anew.
        assert!(places.add(&view(25), 0.3, recent(45)).is_empty());
        let found = places.add(&view(26), 0.3, recent(46));
        assert_eq!((found[0].keyframe, found[0].streak), (26, 1));
    }

    #[test]
    fn a_frame_that_shows_nothing_is_nowhere() {
        let mut places = places(6);
        (0..6).for_each(|k| drop(places.add(&view(k), 0.3, |_| false)));
        assert!(places.add(&[], 0.3, |_| false).is_empty());
        assert!(places.add(&view(2), 0.3, |_| false).is_empty());
    }
}
