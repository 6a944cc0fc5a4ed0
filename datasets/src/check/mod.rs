//! Whether pairs are what stereo needs. A rig that is off is the first thing to fail for users of any
//! stereo tool, and networks and matchers say nothing about it: measure first.
//!
//! [`check`] matches patches from left to right, and along the sequence where there are true poses, and
//! returns a [`Report`]: what is wrong, in words, and the [`crate::Correction`] that would mend it.

mod matching;
mod photometry;
mod poses;
mod rows;

use std::fmt;

use barchan_geometry::RectifiedRig;
use nalgebra::{Matrix3, Vector2};
use rayon::prelude::*;
use serde::Serialize;

use crate::{Correction, DataError, StereoSource};
use matching::{Match, View, Window, find_matches};
use photometry::Photometry;
pub use poses::PoseScale;
use rows::RowMatch;
pub use rows::RowModel;

/// What can be wrong with the pairs of a rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fault {
    /// Left and right images have changed places.
    Swapped,
    /// The right images are those of some frames earlier or later.
    Slipped,
    /// Rows of the right image lie lower or higher.
    RowOffset,
    /// The right camera looks up or down against the left one.
    Pitch,
    /// The right camera is turned inwards or outwards, or a lens is not undistorted.
    Yaw,
    /// The right camera is turned about its optical axis.
    Roll,
    /// The right image is larger or smaller.
    Scale,
    /// The right image is brighter or darker.
    Exposure,
    /// The baseline contradicts the true poses.
    Baseline,
    /// The focal length contradicts the true poses.
    FocalLength,
    /// The true poses fit the images with no baseline.
    Poses,
    /// Images are blurred.
    Blur,
    /// Images are over-exposed.
    Saturation,
    /// Hardly anything of the left images is found in the right ones.
    NoMatches,
}

/// One thing that is wrong.
#[derive(Clone, Debug, Serialize)]
pub struct Finding {
    /// What.
    pub fault: Fault,
    /// How much of it, in the unit that `text` names.
    pub value: f64,
    /// A sentence for people: what was measured, and what to do.
    pub text: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

/// What [`check`] found.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// How many frames were looked at.
    pub frames: usize,
    /// Fit of the rows; none of too few matches.
    pub rows: Option<RowModel>,
    /// Median over the matches of the right image's brightness over the left's.
    pub gain: f64,
    /// Disparity of the 2nd, 50th and 98th percentile of the matches, pixels.
    pub disparity: Option<[f64; 3]>,
    /// What the true poses say of the rig, where there are poses that can tell.
    pub poses: Option<PoseScale>,
    /// What is wrong; empty when nothing is.
    pub findings: Vec<Finding>,
    /// What mends the findings that can be mended; `None` when nothing needs to be.
    pub correction: Option<Correction>,
    /// For the picture: the matches of the first frame that was looked at.
    #[serde(skip)]
    pub sample: Sample,
}

/// The matches of one frame.
#[derive(Clone, Debug, Default)]
pub struct Sample {
    /// Which frame.
    pub frame: usize,
    /// Column and row in the left image, and in the right one, pixels.
    pub matches: Vec<[[f64; 2]; 2]>,
}

impl Report {
    /// Whether a fault was found.
    pub fn has(&self, fault: Fault) -> bool {
        self.findings.iter().any(|f| f.fault == fault)
    }
}

/// Frames looked at.
const FRAMES: usize = 12;
/// Patches tried over all frames.
const PATCHES: usize = 720;
/// Slips looked for, frames either way.
const LAGS: isize = 6;
/// Rows that are off by less than this harm nothing, pixels; taken where one match in ten is worse, so
/// that corners where nothing was found do not count.
const HARMLESS: f64 = 0.5;

/// Looks at up to 12 frames spread over the sequence, and at 3 stretches of 13 when the rows do not
/// agree.
///
/// # Errors
/// When a frame cannot be read.
pub fn check(source: &dyn StereoSource) -> Result<Report, DataError> {
    let frames = spread(source.len(), FRAMES);
    // The left image of frame i belongs to the right image of frame i + lag.
    let mut lag = 0;
    let mut looks = look(source, &frames, lag)?;
    let mut rows = RowModel::fit(&row_matches(&looks));

    // Rows that no rig explains: perhaps the images are not of one moment.
    let consistency = |rows: &Option<RowModel>| rows.as_ref().map_or(0.0, RowModel::consistency);
    if consistency(&rows) < 0.9 && source.len() > 1 {
        lag = find_slip(source)?;
        if lag != 0 {
            looks = look(source, &frames, lag)?;
            rows = RowModel::fit(&row_matches(&looks));
        }
    }
    let swapped = is_swapped(&looks);
    // Pairs that do not fit together, and a keystone, which may be a yaw that shifts every disparity,
    // leave nothing to compare poses with.
    let keystone = rows.is_some_and(|rows| rows.yaw != 0.0);
    let poses = if swapped || lag != 0 || keystone {
        None
    } else {
        poses::pose_scale(source, &looks, rows.as_ref())?
    };

    let mut findings = Vec::new();
    judge_matches(&looks, rows.as_ref(), &mut findings);
    judge_pairing(lag, swapped, &mut findings);
    let rows_need_correction = judge_rows(source.rig(), rows.as_ref(), &mut findings);
    let gain = judge_exposure(&looks, &mut findings);
    let photometry: Vec<&Photometry> = looks.iter().map(|look| &look.photometry).collect();
    photometry::judge(&photometry, &mut findings);
    if let Some(poses) = &poses {
        poses.judge(source.rig(), &mut findings);
    }

    // One homography mends one rig.
    let one_rig = looks.iter().all(|look| look.rig == *source.rig());
    let rows_need_correction = rows_need_correction && one_rig;
    let correction = (rows_need_correction || swapped || lag != 0).then(|| Correction {
        swapped,
        right_frame_shift: lag as i64,
        right_homography: match &rows {
            Some(rows) if rows_need_correction => rows.homography(source.rig()),
            _ => Matrix3::identity(),
        },
    });
    Ok(Report {
        frames: looks.len(),
        gain,
        disparity: disparity_range(&looks, swapped),
        poses,
        findings,
        correction,
        sample: sample(&looks),
        rows,
    })
}

/// A frame, and what of its left image was found in its right one.
struct Look {
    frame: usize,
    rig: RectifiedRig,
    /// How many patches were looked for.
    patches: usize,
    matches: Vec<Match>,
    photometry: Photometry,
}

/// Up to `count` indices spread evenly over `0..len`.
fn spread(len: usize, count: usize) -> Vec<usize> {
    let count = count.min(len);
    (0..count).map(|k| k * len / count).collect()
}

/// Matches the given frames, those whose partner exists.
fn look(source: &dyn StereoSource, frames: &[usize], lag: isize) -> Result<Vec<Look>, DataError> {
    let patches = PATCHES / frames.len().max(1);
    frames
        .par_iter()
        .filter_map(|&i| {
            let partner = i.checked_add_signed(lag)?;
            (partner < source.len()).then_some((i, partner))
        })
        .map(|(i, partner)| {
            let frame = source.frame(i)?;
            let right = if partner == i {
                frame.right
            } else {
                source.frame(partner)?.right
            };
            let rig = *source.frame_rig(i);
            let (left_view, right_view) = (View::new(&frame.left), View::new(&right));
            Ok(Look {
                frame: i,
                rig,
                patches,
                matches: match_pair(&left_view, &right_view, &rig, patches),
                photometry: Photometry::new(&frame.left, &right),
            })
        })
        .collect()
}

/// Patches of the left image in the right one: disparities of either sign up to a quarter of the
/// width, rows up to a fortieth of it off.
fn match_pair(left: &View, right: &View, rig: &RectifiedRig, count: usize) -> Vec<Match> {
    let reach = (rig.width as f64 / 4.0).min(512.0);
    let rows = (rig.width as f64 / 40.0).max(8.0);
    find_matches(left, right, count, |_| {
        Some(Window {
            columns: rig.doffs - reach..=rig.doffs + reach,
            rows: -rows..=rows,
        })
    })
}

fn row_matches(looks: &[Look]) -> Vec<RowMatch> {
    looks
        .iter()
        .flat_map(|look| {
            look.matches.iter().map(|m| RowMatch {
                rig: look.rig,
                left: m.from,
                right: m.to,
            })
        })
        .collect()
}

/// The shift between left and right images at which most matches agree on one rig, looked for in
/// three stretches of the sequence.
fn find_slip(source: &dyn StereoSource) -> Result<isize, DataError> {
    let len = source.len() as isize;
    let middles = spread(source.len(), 4).into_iter().skip(1);
    let mut by_lag: Vec<Vec<RowMatch>> = vec![Vec::new(); 2 * LAGS as usize + 1];
    let mut stretches = vec![0usize; by_lag.len()];
    for middle in middles {
        let middle = middle as isize;
        let around: Vec<isize> = (-LAGS..=LAGS)
            .filter(|lag| (0..len).contains(&(middle + lag)))
            .collect();
        let rig = *source.frame_rig(middle as usize);
        let left = View::new(&source.frame(middle as usize)?.left);
        let found: Vec<(isize, Vec<RowMatch>)> = around
            .into_par_iter()
            .map(|lag| {
                let right = View::new(&source.frame((middle + lag) as usize)?.right);
                let matches = match_pair(&left, &right, &rig, PATCHES / 10);
                let matches = matches.into_iter().map(|m| RowMatch {
                    rig,
                    left: m.from,
                    right: m.to,
                });
                Ok((lag, matches.collect()))
            })
            .collect::<Result<_, DataError>>()?;
        for (lag, matches) in found {
            by_lag[(lag + LAGS) as usize].extend(matches);
            stretches[(lag + LAGS) as usize] += 1;
        }
    }
    // A stretch near an end of the sequence does not reach every lag.
    let explained: Vec<f64> = by_lag
        .iter()
        .zip(&stretches)
        .map(|(matches, stretches)| {
            let explained = RowModel::fit(matches).map_or(0, |rows| rows.explained);
            explained as f64 / (*stretches).max(1) as f64
        })
        .collect();
    let now = explained[LAGS as usize];
    let best = (0..explained.len())
        .max_by(|a, b| explained[*a].total_cmp(&explained[*b]))
        .unwrap_or(LAGS as usize);
    // A rover that hardly moves agrees at every lag: then the images as they are come first.
    let better = explained[best] > 1.25 * now + 5.0;
    Ok(if better { best as isize - LAGS } else { 0 })
}

/// Whether what is seen lies behind the cameras: most disparities negative.
fn is_swapped(looks: &[Look]) -> bool {
    let clear: Vec<f64> = looks
        .iter()
        .flat_map(disparities)
        .filter(|d| d.abs() > 1.0)
        .collect();
    let negative = clear.iter().filter(|d| **d < 0.0).count();
    clear.len() >= rows::ENOUGH && negative as f64 > 0.7 * clear.len() as f64
}

/// Disparities of a look as far as depth goes: zero at infinity.
fn disparities(look: &Look) -> impl Iterator<Item = f64> {
    look.matches
        .iter()
        .map(|m| m.from.x - m.to.x + look.rig.doffs)
}

fn disparity_range(looks: &[Look], swapped: bool) -> Option<[f64; 3]> {
    let mut all: Vec<f64> = looks
        .iter()
        .flat_map(|look| {
            let doffs = look.rig.doffs;
            disparities(look).map(move |d| if swapped { -d } else { d - doffs })
        })
        .collect();
    all.sort_by(f64::total_cmp);
    let at = |share: f64| all[((all.len() - 1) as f64 * share).round() as usize];
    (!all.is_empty()).then(|| [at(0.02), at(0.5), at(0.98)])
}

fn sample(looks: &[Look]) -> Sample {
    looks
        .iter()
        .max_by_key(|look| look.matches.len())
        .map(|look| Sample {
            frame: look.frame,
            matches: look
                .matches
                .iter()
                .map(|m| [m.from.into(), m.to.into()])
                .collect(),
        })
        .unwrap_or_default()
}

fn judge_matches(looks: &[Look], rows: Option<&RowModel>, findings: &mut Vec<Finding>) {
    let matches: usize = looks.iter().map(|look| look.matches.len()).sum();
    if matches < rows::ENOUGH {
        findings.push(Finding {
            fault: Fault::NoMatches,
            value: matches as f64,
            text: format!(
                "only {matches} patches of {} left images are found in the right ones: are they of one moment and of one scene, in focus and lit?",
                looks.len()
            ),
        });
    } else if let Some(rows) = rows
        && rows.consistency() < 0.6
    {
        findings.push(Finding {
            fault: Fault::NoMatches,
            value: rows.consistency(),
            text: format!(
                "only {:.0} % of {matches} matches agree on how the rows correspond: the cameras are not triggered together, move against each other, or are not calibrated",
                100.0 * rows.consistency()
            ),
        });
    }
}

fn judge_pairing(lag: isize, swapped: bool, findings: &mut Vec<Finding>) {
    if swapped {
        findings.push(Finding {
            fault: Fault::Swapped,
            value: 1.0,
            text: "left and right are swapped: what is nearer lies further to the right in the right images".into(),
        });
    }
    if lag != 0 {
        let (frames, when) = (lag.unsigned_abs(), if lag > 0 { "late" } else { "early" });
        findings.push(Finding {
            fault: Fault::Slipped,
            value: lag as f64,
            text: format!(
                "the right images come {frames} frame{} too {when}: left image i belongs to right image i{:+}",
                if frames == 1 { "" } else { "s" },
                lag
            ),
        });
    }
}

/// Says what is wrong with the rows; whether a homography would mend any of it.
fn judge_rows(rig: &RectifiedRig, rows: Option<&RowModel>, findings: &mut Vec<Finding>) -> bool {
    let Some(rows) = rows.filter(|rows| rows.consistency() >= 0.6) else {
        return false;
    };
    let mut need_correction = false;
    let mut say = |fault, value: f64, pixels: f64, text: String| {
        if pixels.abs() > HARMLESS {
            need_correction |= fault != Fault::Yaw;
            findings.push(Finding { fault, value, text });
        }
    };
    let half = Vector2::new(rig.width as f64, rig.height as f64) / 2.0;
    let [keystone, tilt, growth] = rows.reach;
    let of = format!(
        "over {} matches, spread {:.2} px",
        rows.matches, rows.spread
    );
    let lower = |v: f64| if v > 0.0 { "lower" } else { "higher" };
    say(
        Fault::RowOffset,
        rows.offset,
        rows.offset,
        format!(
            "the right images lie {:.2} px {} than the left ({of})",
            rows.offset.abs(),
            lower(rows.offset)
        ),
    );
    let pitch_rows = -rows.pitch * rig.fy;
    say(
        Fault::Pitch,
        rows.pitch.to_degrees(),
        pitch_rows,
        format!(
            "the right camera is pitched by {:.2} degrees: its images lie {:.2} px {} in the middle and more at top and bottom ({of})",
            rows.pitch.to_degrees().abs(),
            pitch_rows.abs(),
            lower(pitch_rows)
        ),
    );
    let corner = rows.yaw * half.x * half.y / rig.fy;
    say(
        Fault::Yaw,
        rows.yaw.to_degrees(),
        rows.yaw * rig.fy * keystone,
        format!(
            "rows are {1:.2} px off in the corners, as if the right camera were yawed by {0:.2} degrees ({of}); a lens that is not quite undistorted looks the same, and rows cannot tell which: calibrate again",
            rows.yaw.to_degrees().abs(),
            corner.abs()
        ),
    );
    let side = rows.roll * half.x;
    say(
        Fault::Roll,
        rows.roll.to_degrees(),
        rows.roll * rig.fy * tilt,
        format!(
            "the right camera is rolled by {:.2} degrees: the right side of its images lies {:.2} px {}, the left side as much the other way ({of})",
            rows.roll.to_degrees().abs(),
            side.abs(),
            lower(side)
        ),
    );
    let edge = rows.scale * half.y;
    say(
        Fault::Scale,
        100.0 * rows.scale,
        rows.scale * rig.fy * growth,
        format!(
            "the right images are {:.2} % {}: rows are {:.2} px off at top and bottom ({of})",
            100.0 * rows.scale.abs(),
            if rows.scale > 0.0 {
                "larger"
            } else {
                "smaller"
            },
            edge.abs()
        ),
    );
    need_correction
}

/// The gain of the right images over the left.
fn judge_exposure(looks: &[Look], findings: &mut Vec<Finding>) -> f64 {
    /// Gains beyond this trouble a photometric loss, which compares grey levels.
    const MOST: f64 = 1.12;
    let mut gains: Vec<f64> = looks
        .iter()
        .flat_map(|look| look.matches.iter().map(|m| m.gain))
        .collect();
    let gain = median(&mut gains);
    if gains.len() >= rows::ENOUGH && !(1.0 / MOST..=MOST).contains(&gain) {
        findings.push(Finding {
            fault: Fault::Exposure,
            value: gain,
            text: format!(
                "the right images are {:.0} % {} than the left: give both cameras the same exposure and gain",
                100.0 * (gain - 1.0).abs(),
                if gain > 1.0 { "brighter" } else { "darker" }
            ),
        });
    }
    gain
}

/// The middle of the values; NaN of none.
fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    match values.len() {
        0 => f64::NAN,
        n => (values[(n - 1) / 2] + values[n / 2]) / 2.0,
    }
}
