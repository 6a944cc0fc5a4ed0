//! Visual words: a tree over binary descriptors that says what an image shows in a few hundred
//! numbers (Galvez-Lopez and Tardos 2012).

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::str::{FromStr, SplitAsciiWhitespace};
use std::sync::{Arc, OnceLock};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::config::Detector;
use crate::features::Descriptor;
use crate::hamming;

/// The shipped vocabularies: features of rendered traverses, made by `make vocabularies`.
const SHIPPED_ORB: &str = include_str!("vocabulary-orb.txt");
const SHIPPED_AKAZE: &str = include_str!("vocabulary-akaze.txt");

/// A tree of descriptors whose leaves are words.
#[derive(Clone, Debug, PartialEq)]
pub struct Vocabulary {
    /// Most children of a node.
    branching: usize,
    /// Most steps from the root to a word.
    depth: usize,
    /// Bytes of a descriptor that the words tell apart; the others are zero.
    bytes: usize,
    /// The root first; parents before their children.
    nodes: Vec<Node>,
    words: usize,
}

#[derive(Clone, Debug, PartialEq)]
struct Node {
    parent: usize,
    descriptor: Descriptor,
    children: Vec<usize>,
    /// Number of the word, and its weight: the logarithm of how rare it is.
    word: Option<(usize, f64)>,
}

/// What an image shows: words, ascending, with weights that sum to one.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BagOfWords(pub Vec<(usize, f64)>);

impl BagOfWords {
    /// Likeness of two images, 0 to 1: one less half the L1 distance of their bags.
    pub fn score(&self, other: &Self) -> f64 {
        let (mut i, mut j, mut shared) = (0, 0, 0.0);
        while let (Some((a, weight_a)), Some((b, weight_b))) = (self.0.get(i), other.0.get(j)) {
            if a == b {
                shared += weight_a.min(*weight_b);
            }
            i += usize::from(a <= b);
            j += usize::from(b <= a);
        }
        shared
    }
}

impl Vocabulary {
    /// The vocabulary for the features of a detector that is shipped.
    pub fn shipped(detector: Detector) -> Arc<Self> {
        static ORB: OnceLock<Arc<Vocabulary>> = OnceLock::new();
        static AKAZE: OnceLock<Arc<Vocabulary>> = OnceLock::new();
        let (parsed, text) = match detector {
            Detector::Orb => (&ORB, SHIPPED_ORB),
            Detector::Akaze => (&AKAZE, SHIPPED_AKAZE),
        };
        let parse = || Arc::new(text.parse().unwrap_or_else(|_| Self::of_nothing()));
        parsed.get_or_init(parse).clone()
    }

    /// A root without words: every image is an empty bag, like no other.
    fn of_nothing() -> Self {
        Self {
            branching: 2,
            depth: 1,
            bytes: size_of::<Descriptor>(),
            nodes: vec![Node {
                parent: 0,
                descriptor: [0; _],
                children: Vec::new(),
                word: None,
            }],
            words: 0,
        }
    }

    /// How many words it knows.
    pub fn len(&self) -> usize {
        self.words
    }

    /// Whether it knows no word.
    pub fn is_empty(&self) -> bool {
        self.words == 0
    }

    /// Bytes of a descriptor that its words tell apart.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Learns words from the descriptors of many images, of which the first `bytes` bytes count.
    /// Each node's descriptors are split into at most `branching` groups around their majorities
    /// (k-means with the Hamming distance, seeded as k-means++: Arthur 2007), `depth` times. A word
    /// weighs the logarithm of the share of images that show it, so that what all show weighs
    /// nothing.
    pub fn train(
        images: &[Vec<Descriptor>],
        branching: usize,
        depth: usize,
        bytes: usize,
        seed: u64,
    ) -> Self {
        let mut vocabulary = Self {
            branching,
            depth,
            bytes: bytes.min(size_of::<Descriptor>()),
            ..Self::of_nothing()
        };
        // Nodes of one level, each with the descriptors that fall to it.
        let mut level = vec![(0, images.iter().flatten().copied().collect::<Vec<_>>())];
        for _ in 0..depth {
            let split = |(node, members): &(usize, Vec<Descriptor>)| {
                let mut rng = ChaCha8Rng::seed_from_u64(seed ^ *node as u64);
                (*node, majorities(members, branching, &mut rng))
            };
            let groups: Vec<_> = level.par_iter().map(split).collect();
            level.clear();
            for (parent, groups) in groups {
                // What cannot be split is a word.
                for (descriptor, members) in groups.into_iter().filter(|g| !g.1.is_empty()) {
                    level.push((vocabulary.add(parent, descriptor), members));
                }
            }
        }
        vocabulary.number_words();

        let mut shown_by = vec![0usize; vocabulary.words];
        for image in images {
            let mut words: Vec<usize> = image.iter().filter_map(|d| vocabulary.leaf(d)).collect();
            words.sort_unstable();
            words.dedup();
            words.iter().for_each(|node| {
                if let Some((word, _)) = vocabulary.nodes[*node].word {
                    shown_by[word] += 1;
                }
            });
        }
        for (word, weight) in vocabulary.nodes.iter_mut().flat_map(|n| &mut n.word) {
            let rarity = (images.len() as f64 / shown_by[*word].max(1) as f64).ln();
            // Four decimals are enough, and short to write.
            *weight = (rarity * 1e4).round() / 1e4;
        }
        vocabulary
    }

    /// The words of an image: how often each is seen, times its weight, as shares.
    pub fn bag(&self, descriptors: &[Descriptor]) -> BagOfWords {
        let mut counts = BTreeMap::<usize, f64>::new();
        for descriptor in descriptors {
            let word = self.leaf(descriptor).and_then(|node| self.nodes[node].word);
            if let Some((word, weight)) = word.filter(|(_, weight)| *weight > 0.0) {
                *counts.entry(word).or_default() += weight;
            }
        }
        let sum: f64 = counts.values().sum();
        BagOfWords(counts.into_iter().map(|(w, c)| (w, c / sum)).collect())
    }

    /// The leaf that a descriptor falls to; `None` in a tree of nothing but its root.
    fn leaf(&self, descriptor: &Descriptor) -> Option<usize> {
        let mut at = 0;
        while !self.nodes[at].children.is_empty() {
            let nearest = self.nodes[at]
                .children
                .iter()
                .min_by_key(|c| hamming(descriptor, &self.nodes[**c].descriptor));
            at = *nearest?;
        }
        (at > 0).then_some(at)
    }

    fn add(&mut self, parent: usize, descriptor: Descriptor) -> usize {
        let node = self.nodes.len();
        self.nodes[parent].children.push(node);
        self.nodes.push(Node {
            parent,
            descriptor,
            children: Vec::new(),
            word: None,
        });
        node
    }

    /// Words are the leaves in the order of nodes.
    fn number_words(&mut self) {
        let leaves = self.nodes.iter_mut().skip(1);
        for (word, leaf) in leaves.filter(|n| n.children.is_empty()).enumerate() {
            let weight = leaf.word.map_or(0.0, |(_, weight)| weight);
            leaf.word = Some((word, weight));
            self.words = word + 1;
        }
    }

    /// The text that [`Vocabulary::from_str`] and DBoW2 read.
    pub fn to_text(&self) -> String {
        // L1 scores of term frequencies weighted by inverse document frequencies.
        let mut text = format!("{} {} 0 0\n", self.branching, self.depth);
        for node in self.nodes.iter().skip(1) {
            let _ = write!(text, "{} {} ", node.parent, u8::from(node.word.is_some()));
            for byte in &node.descriptor[..self.bytes] {
                let _ = write!(text, "{byte} ");
            }
            let _ = writeln!(text, "{}", node.word.map_or(0.0, |(_, weight)| weight));
        }
        text
    }
}

/// Splits descriptors into groups around at most `count` majorities; empty when there is nothing to
/// split.
fn majorities(
    members: &[Descriptor],
    count: usize,
    rng: &mut ChaCha8Rng,
) -> Vec<(Descriptor, Vec<Descriptor>)> {
    const ROUNDS: usize = 12;
    let mut distinct = members.to_vec();
    distinct.sort_unstable();
    distinct.dedup();
    if distinct.len() < 2 {
        return Vec::new();
    }
    if distinct.len() <= count {
        let group = |d: Descriptor| (d, members.iter().filter(|m| **m == d).copied().collect());
        return distinct.into_iter().map(group).collect();
    }
    let mut centres = first_centres(members, count, rng);
    let mut nearest = vec![0; members.len()];
    for _ in 0..ROUNDS {
        let before = nearest.clone();
        for (group, member) in nearest.iter_mut().zip(members) {
            let by_distance = |c: &usize| hamming(member, &centres[*c]);
            *group = (0..centres.len()).min_by_key(by_distance).unwrap_or(0);
        }
        if before == nearest {
            break;
        }
        for (group, centre) in centres.iter_mut().enumerate() {
            let of_group = members.iter().zip(&nearest).filter(|(_, g)| **g == group);
            *centre = majority(of_group.map(|(m, _)| m)).unwrap_or(*centre);
        }
    }
    let mut groups: Vec<_> = centres.into_iter().map(|c| (c, Vec::new())).collect();
    for (group, member) in nearest.into_iter().zip(members) {
        groups[group].1.push(*member);
    }
    groups
}

/// Centres far from each other: each is drawn with a probability that grows with the squared
/// distance to the nearest one before.
fn first_centres(members: &[Descriptor], count: usize, rng: &mut ChaCha8Rng) -> Vec<Descriptor> {
    let mut centres = vec![members[rng.random_range(0..members.len())]];
    let mut squared = vec![u64::MAX; members.len()];
    while centres.len() < count {
        let newest = centres[centres.len() - 1];
        for (least, member) in squared.iter_mut().zip(members) {
            *least = (*least).min(u64::from(hamming(member, &newest)).pow(2));
        }
        let mut left = rng.random_range(0..squared.iter().sum::<u64>().max(1));
        let drawn = squared.iter().position(|s| {
            let here = left < *s;
            left = left.saturating_sub(*s);
            here
        });
        let Some(drawn) = drawn else { break };
        centres.push(members[drawn]);
    }
    centres
}

/// Each bit as most have it; `None` of nothing.
fn majority<'a>(members: impl Iterator<Item = &'a Descriptor>) -> Option<Descriptor> {
    let mut ones = [[0u32; 8]; size_of::<Descriptor>()];
    let mut count = 0;
    for member in members {
        count += 1;
        for (ones, byte) in ones.iter_mut().zip(member) {
            for (bit, ones) in ones.iter_mut().enumerate() {
                *ones += u32::from(byte >> bit & 1);
            }
        }
    }
    let byte = |ones: &[u32; 8]| {
        let bits = ones.iter().enumerate();
        bits.fold(0u8, |byte, (bit, n)| byte | u8::from(2 * n > count) << bit)
    };
    (count > 0).then(|| std::array::from_fn(|k| byte(&ones[k])))
}

/// Why a vocabulary cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line} of the vocabulary: {message}")]
pub struct VocabularyError {
    /// Counted from 1.
    pub line: usize,
    /// What is wrong.
    pub message: String,
}

impl FromStr for Vocabulary {
    type Err = VocabularyError;

    /// Reads DBoW2's text: `branching depth scoring weighting`, then a line for each node but the
    /// root, parents first: `parent leaf byte... weight`. Memory grows with the text, whatever it
    /// claims.
    fn from_str(text: &str) -> Result<Self, VocabularyError> {
        let lines = text.lines().enumerate().map(|(k, line)| (k + 1, line));
        let mut lines = lines.filter(|(_, line)| !line.trim().is_empty());
        let (line, header) = lines.next().unwrap_or((1, ""));
        let fail = |line: usize, message: String| VocabularyError { line, message };
        let header: Vec<usize> = header
            .split_ascii_whitespace()
            .map_while(|w| w.parse().ok())
            .collect();
        let &[branching, depth, scoring, weighting] = header.as_slice() else {
            let message = "expected four whole numbers: branching, depth, scoring, weighting";
            return Err(fail(line, message.into()));
        };
        if !(2..=20).contains(&branching) || !(1..=10).contains(&depth) {
            let message =
                format!("branching {branching} and depth {depth}: expected 2 to 20, 1 to 10");
            return Err(fail(line, message));
        }
        if (scoring, weighting) != (0, 0) {
            let message = format!(
                "scoring {scoring} and weighting {weighting}: only 0 0, L1 and tf-idf, is known"
            );
            return Err(fail(line, message));
        }
        let mut vocabulary = Self {
            branching,
            depth,
            bytes: 0,
            ..Self::of_nothing()
        };
        let mut depths = vec![0];
        for (line, text) in lines {
            let (parent, leaf, descriptor, weight) = vocabulary
                .read_node(text)
                .map_err(|message| fail(line, message))?;
            let node = vocabulary.add(parent, descriptor);
            depths.push(depths[parent] + 1);
            let problem = if depths[node] > depth {
                Some(format!("the node is deeper than {depth}"))
            } else if vocabulary.nodes[parent].children.len() > branching {
                Some(format!("node {parent} has more than {branching} children"))
            } else if vocabulary.nodes[parent].word.is_some() {
                Some(format!("node {parent} is a leaf and has a child"))
            } else {
                None
            };
            if let Some(message) = problem {
                return Err(fail(line, message));
            }
            vocabulary.nodes[node].word = leaf.then_some((0, weight));
        }
        let barren = |n: &Node| n.children.is_empty() && n.word.is_none();
        if let Some(node) = vocabulary.nodes.iter().position(barren) {
            let message = format!("node {node} is no leaf and has no child: is the file cut off?");
            return Err(fail(text.lines().count(), message));
        }
        vocabulary.number_words();
        Ok(vocabulary)
    }
}

impl Vocabulary {
    /// Parent, whether it is a leaf, descriptor and weight of a line. The first line read says how
    /// many bytes a descriptor has.
    fn read_node(&mut self, text: &str) -> Result<(usize, bool, Descriptor, f64), String> {
        fn next<T: FromStr>(words: &mut SplitAsciiWhitespace, what: &str) -> Result<T, String> {
            let word = words.next().ok_or(format!("{what} is missing"))?;
            let wrong = |_| {
                let start: String = word.chars().take(20).collect();
                format!("{what} is \"{start}\"")
            };
            word.parse().map_err(wrong)
        }
        let most = size_of::<Descriptor>();
        let mut words = text.split_ascii_whitespace();
        let count = words.clone().take(most + 4).count();
        if self.bytes == 0 {
            self.bytes = count.saturating_sub(3);
        }
        if count != self.bytes + 3 || !(8..=most).contains(&self.bytes) {
            return Err(format!(
                "{} bytes a descriptor, expected 8 to {most}, as many in each line",
                count.saturating_sub(3)
            ));
        }
        let parent: usize = next(&mut words, "the parent")?;
        if parent >= self.nodes.len() {
            return Err(format!("the parent, {parent}, is none of the nodes before"));
        }
        let leaf: u8 = next(&mut words, "the leaf mark")?;
        let mut descriptor: Descriptor = [0; _];
        for byte in &mut descriptor[..self.bytes] {
            *byte = next(&mut words, "a byte of the descriptor")?;
        }
        let weight: f64 = next(&mut words, "the weight")?;
        if !(0.0..1e6).contains(&weight) {
            return Err(format!("the weight is {weight}"));
        }
        Ok((parent, leaf != 0, descriptor, weight))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Images of descriptors that scatter around a few shapes; `kinds` are the shapes each shows.
    fn images(kinds: &[&[usize]], seed: u64) -> Vec<Vec<Descriptor>> {
        let shape = |kind: usize| {
            let mut rng = ChaCha8Rng::seed_from_u64(900 + kind as u64);
            std::array::from_fn::<u8, 32, _>(|_| rng.random())
        };
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let image = |kinds: &&[usize]| {
            let seen = (0..60).map(|k| {
                let mut descriptor: Descriptor = [0; _];
                descriptor[..32].copy_from_slice(&shape(kinds[k % kinds.len()]));
                for _ in 0..12 {
                    let bit = rng.random_range(0..256);
                    descriptor[bit / 8] ^= 1 << (bit % 8);
                }
                descriptor
            });
            seen.collect()
        };
        kinds.iter().map(image).collect()
    }

    const KINDS: [&[usize]; 4] = [&[0, 1, 2, 9], &[3, 4, 9], &[5, 6, 7, 9], &[8, 2, 4, 9]];

    fn trained() -> Vocabulary {
        Vocabulary::train(&images(&KINDS, 1), 4, 3, 32, 7)
    }

    #[test]
    fn images_of_the_same_things_are_alike_and_others_are_not() {
        let vocabulary = trained();
        let bags = |seed| -> Vec<BagOfWords> {
            let images = images(&KINDS, seed);
            images.iter().map(|i| vocabulary.bag(i)).collect()
        };
        let (first, again) = (bags(2), bags(3));
        for (i, bag) in first.iter().enumerate() {
            let sum: f64 = bag.0.iter().map(|(_, weight)| weight).sum();
            assert!((sum - 1.0).abs() < 1e-12 && (bag.score(bag) - 1.0).abs() < 1e-12);
            let best = (0..4).max_by(|a, b| {
                let [a, b] = [a, b].map(|j| bag.score(&again[*j]));
                a.total_cmp(&b)
            });
            assert_eq!(best, Some(i));
            for other in &again {
                assert_eq!(bag.score(other), other.score(bag));
            }
        }
    }

    #[test]
    fn the_score_is_the_l1_distance() {
        let a = BagOfWords(vec![(1, 0.2), (4, 0.5), (9, 0.3)]);
        let b = BagOfWords(vec![(2, 0.1), (4, 0.4), (9, 0.5)]);
        let distance = 0.2 + 0.1 + 0.1 + 0.2;
        assert!((a.score(&b) - (1.0 - 0.5 * distance)).abs() < 1e-12);
        assert_eq!(a.score(&BagOfWords::default()), 0.0);
    }

    #[test]
    fn a_word_that_every_image_shows_weighs_less_than_a_rare_one() {
        let vocabulary = Vocabulary::train(&images(&KINDS, 1), 10, 1, 32, 7);
        let weight = |kind: usize| {
            let image = &images(&[&[kind]], 5)[0];
            let leaf = vocabulary.leaf(&image[0]).unwrap();
            vocabulary.nodes[leaf].word.unwrap().1
        };
        assert!(weight(9) < weight(0), "{} {}", weight(9), weight(0));
    }

    #[test]
    fn text_is_read_back_exactly() {
        let vocabulary = trained();
        let text = vocabulary.to_text();
        assert_eq!(text.parse(), Ok(vocabulary));
        assert_eq!(text.parse::<Vocabulary>().unwrap().to_text(), text);
    }

    #[test]
    fn the_shipped_ones_are_whole() {
        for (detector, text, words) in [
            (Detector::Orb, SHIPPED_ORB, 5000),
            (Detector::Akaze, SHIPPED_AKAZE, 500),
        ] {
            let shipped: Vocabulary = text.parse().unwrap();
            assert!(shipped.len() > words, "{}", shipped.len());
            assert!(text.len() <= 1_500_000);
            assert_eq!(shipped.bytes(), detector.descriptor_bytes());
            let mut nodes = shipped.nodes.iter();
            assert!(nodes.all(|n| n.children.len() <= shipped.branching));
        }
    }

    #[test]
    fn hostile_text_is_refused_with_the_line() {
        let node = |parent: usize, leaf: u8, weight: &str| {
            format!("{parent} {leaf} {}{weight}", "7 ".repeat(32))
        };
        let ok = format!("2 2 0 0\n{}\n{}\n", node(0, 1, "0.5"), node(0, 1, "0.25"));
        assert_eq!(ok.parse::<Vocabulary>().unwrap().len(), 2);
        let cases = [
            (String::new(), "four whole numbers"),
            ("10 4 0".into(), "four whole numbers"),
            ("4000000000 4 0 0".into(), "branching 4000000000"),
            ("10 99999999999 0 0".into(), "depth"),
            ("99999999999999999999999 4 0 0".into(), "four whole numbers"),
            ("10 4 2 0".into(), "scoring 2"),
            ("10 4 0 0".into(), "no child"),
            (ok.clone() + &node(0, 1, "1"), "more than 2 children"),
            (ok.clone() + &node(1, 1, "1"), "is a leaf"),
            (ok.clone() + &node(99, 1, "1"), "none of the nodes"),
            (ok.clone() + &node(3, 1, "1"), "none of the nodes"),
            (ok.clone() + "-1 1 7", "bytes a descriptor"),
            (ok.replace("0.5", "nan"), "weight"),
            (ok.replace("0.5", "-1"), "weight"),
            (ok.replace("0.5", "half"), "weight is \"half\""),
            (ok.replacen(" 7", " 256", 1), "byte"),
            (
                format!("2 1 0 0\n{}\n{}", node(0, 0, "0"), node(1, 1, "1")),
                "deeper",
            ),
            (format!("2 2 0 0\n{}", node(0, 0, "0")), "cut off"),
            (
                format!("2 2 0 0\n0 1 {}1", "7 ".repeat(5000)),
                "bytes a descriptor",
            ),
        ];
        for (text, expected) in cases {
            let message = text.parse::<Vocabulary>().unwrap_err().to_string();
            assert!(message.contains(expected), "{expected}: {message}");
        }
    }
}
