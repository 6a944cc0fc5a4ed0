//! Tracks by key points and descriptors: SIFT (Lowe 2004).

use std::collections::{BTreeMap, BTreeSet};

use barchan_datasets::Plane;
use kornia_imgproc::features::{
    DESCR_LEN, FirstOctave, SiftConfig, SiftWorkspace, sift_detect_and_compute,
};
use multiversion::multiversion;
use nalgebra::Vector2;
use rayon::prelude::*;

use super::follow::{Border, Follow, Sighting, TrackId};
use crate::Keypoint;

/// Gradients around a key point in whole numbers, as the detector gives them.
type Look = [u8; DESCR_LEN];

/// A thing that may be seen again.
struct Live {
    track: TrackId,
    look: Look,
    /// Views since it was last seen.
    unseen: usize,
}

/// Matches SIFT key points of an image to those of the newest views.
///
/// de Jong 2020 takes SURF; SIFT, of which SURF is an approximation, stands in for it. The pyramid begins at
/// the size of the image: the doubled image of Lowe 2004 costs four times as much, and lies a quarter of a pixel
/// beside itself in this detector as in OpenCV's.
pub(super) struct SiftTracks {
    /// Most key points of an image.
    pub most: usize,
    /// Least contrast of a key point, of full scale.
    pub contrast: f64,
    /// A match is accepted when its distance is below this share of the second's.
    pub nndr: f64,
    pub border: Border,
    /// Standard deviation of the position of a key point of the finest scale, pixels.
    pub sigma: f64,
    /// Views for which a thing is looked for when it is not seen.
    pub patience: usize,
    live: Vec<Live>,
    next: TrackId,
    workspace: SiftWorkspace,
    /// Key points of the image last followed.
    seen: Vec<(Keypoint, Look)>,
    /// The key point of each sighting that was handed out, and the places that are taken by them.
    of_track: BTreeMap<TrackId, usize>,
    taken: BTreeSet<[u64; 2]>,
}

/// Names a place exactly: one place, one track, however many ways it looks.
fn place(at: &Keypoint) -> [u64; 2] {
    [at.u.to_bits(), at.v.to_bits()]
}

impl SiftTracks {
    pub fn new(most: usize, contrast: f64, nndr: f64, border: Border, sigma: f64) -> Self {
        Self {
            most,
            contrast,
            nndr,
            border,
            sigma,
            patience: 4,
            live: Vec::new(),
            next: 0,
            workspace: SiftWorkspace::new(),
            seen: Vec::new(),
            of_track: BTreeMap::new(),
            taken: BTreeSet::new(),
        }
    }

    /// Key points in the region of interest.
    fn detect(&mut self, grey: &Plane) -> Result<Vec<(Keypoint, Look)>, String> {
        /// Smaller than this the detector looks for nothing.
        const LEAST: u32 = 16;
        let Some((region, [left, top])) = self.border.crop(grey) else {
            return Ok(Vec::new());
        };
        let (width, height) = region.dimensions();
        if width.min(height) < LEAST {
            return Ok(Vec::new());
        }
        let config = SiftConfig {
            n_features: self.most,
            contrast_threshold: self.contrast,
            ..SiftConfig::default()
        };
        let bytes: Vec<f32> = region.iter().map(|v| v.clamp(0.0, 1.0) * 255.0).collect();
        let found = sift_detect_and_compute(
            &mut self.workspace,
            &bytes,
            width as usize,
            height as usize,
            &config,
            FirstOctave::Native,
            usize::MAX,
            false,
        )
        .map_err(|e| e.to_string())?;
        let (looks, _) = found.descriptors.as_chunks::<DESCR_LEN>();
        let seen = found.keypoints.iter().zip(looks).map(|(k, look)| {
            // The size is the diameter, twice the blur, which begins at 1.6 pixels.
            let scale = (f64::from(k.size) / (2.0 * config.sigma)).max(1.0);
            let at = Keypoint {
                u: f64::from(k.x) + left,
                v: f64::from(k.y) + top,
                scale,
                sigma: self.sigma * scale,
            };
            (at, look.map(|value| value as u8))
        });
        Ok(seen.collect())
    }

    /// Live things and key points that are each other's nearest, clearly nearer than the second.
    fn matches(&self) -> Vec<(usize, usize)> {
        let looks: Vec<Look> = self.seen.iter().map(|(_, look)| *look).collect();
        let rows: Vec<Vec<u32>> = (self.live.par_iter())
            .map(|live| distances(&live.look, &looks))
            .collect();
        let nearest_live = |feature: usize| (0..rows.len()).min_by_key(|l| rows[*l][feature]);
        let share = self.nndr * self.nndr;
        rows.iter()
            .enumerate()
            .filter_map(|(l, row)| {
                let feature = (0..row.len()).min_by_key(|f| row[*f])?;
                let at = self.seen[feature].0;
                // A thing that looks two ways has two key points in one place: they are no rivals.
                let elsewhere = |f: &usize| {
                    let k = self.seen[*f].0;
                    (k.u - at.u).abs() > 3.0 || (k.v - at.v).abs() > 3.0
                };
                let rival = (0..row.len()).filter(elsewhere).map(|f| row[f]).min();
                let clear = rival.is_none_or(|r| f64::from(row[feature]) < share * f64::from(r));
                (clear && nearest_live(feature) == Some(l)).then_some((l, feature))
            })
            .collect()
    }
}

/// Squared distances of a descriptor to each of many.
#[multiversion(targets("x86_64+avx512f+avx512bw", "x86_64+avx2", "aarch64+neon"))]
fn distances(look: &Look, all: &[Look]) -> Vec<u32> {
    let squared = |other: &Look| {
        let difference = |(a, b): (&u8, &u8)| i32::from(*a) - i32::from(*b);
        let sum: i32 = (look.iter().zip(other))
            .map(difference)
            .map(|d| d * d)
            .sum();
        sum as u32
    };
    all.iter().map(squared).collect()
}

impl Follow for SiftTracks {
    fn follow(&mut self, grey: &Plane) -> Result<Vec<Sighting>, String> {
        self.seen = self.detect(grey)?;
        self.of_track.clear();
        self.taken.clear();
        let mut sightings = Vec::new();
        for (l, feature) in self.matches() {
            let (track, at) = (self.live[l].track, self.seen[feature].0);
            if self.taken.insert(place(&at)) {
                self.of_track.insert(track, feature);
                sightings.push(Sighting { track, at });
            }
        }
        Ok(sightings)
    }

    fn find(&mut self, expected: &[(TrackId, Vector2<f64>)], radius: f64) -> Vec<Sighting> {
        /// Largest distance of descriptors, of 512 at most, and share of the second's: few are so near.
        const ALIKE: u32 = 300 * 300;
        const NEAR_SHARE: f64 = 0.9;
        let looks: BTreeMap<TrackId, &Look> = (self.live.iter())
            .map(|live| (live.track, &live.look))
            .collect();
        let mut found = Vec::new();
        for (track, around) in expected {
            let Some(look) = looks
                .get(track)
                .filter(|_| !self.of_track.contains_key(track))
            else {
                continue;
            };
            let near = |k: &Keypoint| (k.u - around.x).hypot(k.v - around.y) <= radius;
            let mut candidates: Vec<(u32, usize)> = (self.seen.iter().enumerate())
                .filter(|(_, (at, _))| near(at) && !self.taken.contains(&place(at)))
                .map(|(feature, (_, other))| (distances(look, &[*other])[0], feature))
                .collect();
            candidates.sort_unstable();
            let Some((distance, feature)) = candidates.first().copied() else {
                continue;
            };
            let at = self.seen[feature].0;
            let rival = candidates
                .iter()
                .find(|(_, f)| place(&self.seen[*f].0) != place(&at));
            let share = NEAR_SHARE * NEAR_SHARE;
            let clear = rival.is_none_or(|(r, _)| f64::from(distance) < share * f64::from(*r));
            if distance <= ALIKE && clear {
                self.taken.insert(place(&at));
                self.of_track.insert(*track, feature);
                found.push(Sighting { track: *track, at });
            }
        }
        found
    }

    /// Key points are matched to those of the newest views: an image between them changes nothing.
    fn accept(&mut self, _kept: &[Sighting]) {}

    fn begin(&mut self, kept: &[Sighting]) -> Result<Vec<Sighting>, String> {
        let mut track_of: BTreeMap<usize, TrackId> = BTreeMap::new();
        for sighting in kept {
            if let Some(feature) = self.of_track.get(&sighting.track) {
                track_of.insert(*feature, sighting.track);
            }
        }
        if kept.is_empty() {
            self.live.clear();
        }
        let seen_again: BTreeSet<TrackId> = track_of.values().copied().collect();
        self.live.retain_mut(|live| {
            live.unseen += 1;
            live.unseen <= self.patience && !seen_again.contains(&live.track)
        });
        let kept_places: BTreeSet<[u64; 2]> = kept.iter().map(|s| place(&s.at)).collect();
        let mut sightings = Vec::with_capacity(self.seen.len());
        for (feature, (at, look)) in self.seen.iter().enumerate() {
            if kept_places.contains(&place(at)) && !track_of.contains_key(&feature) {
                continue;
            }
            let track = *track_of.entry(feature).or_insert_with(|| {
                self.next += 1;
                self.next - 1
            });
            sightings.push(Sighting { track, at: *at });
            self.live.push(Live {
                track,
                look: *look,
                unseen: 0,
            });
        }
        Ok(sightings)
    }
}
