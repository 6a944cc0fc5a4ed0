//! How far a depth sensor is off, learnt from looks at flat surfaces (the sensor study of Bai 2019, section 3).
//!
//! Each look is one cloud, in the sensor frame, of one plane that fills most of what is seen. The cloud is held
//! against the true plane where that is known, else against the plane that fits it best. What is left over is
//! taken apart by blocks of the image: what varies within a block is noise, and more looks average it away; what
//! a block has in common (lenses, matching that favours some fractions of a pixel) is systematic.
//!
//! The spread in the blocks, over depths and tilts, gives the coefficients of a noise model by least squares of
//! logarithms: each block counts by ratio, so that the small noise of near looks counts as much as that of far ones.

mod fit;
mod model;
mod plane;
#[cfg(test)]
mod tests;

use nalgebra::{Point3, Vector3};

pub use fit::Coefficient;
pub use model::{NoiseForm, NoiseModel};
pub use plane::{ScenePlane, fit_plane};

use crate::{Cloud, TerrainError};

/// What is known of the plane that was looked at.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum PlaneTruth {
    /// Nothing: the plane that fits the cloud stands for it, and errors that tilt or shift all of it are not seen.
    #[default]
    Unknown,
    /// Where the optical axis meets it, metres.
    Distance(f64),
    /// All of it.
    Plane(ScenePlane),
}

/// One look at a flat surface.
#[derive(Clone, Debug)]
pub struct PlaneLook {
    /// What messages and tables call it.
    pub name: String,
    /// What was measured, in the sensor frame (z is depth).
    pub cloud: Cloud,
    /// What there was.
    pub truth: PlaneTruth,
}

/// A part of a look: the points of one block of the image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NoiseBlock {
    /// Which look.
    pub look: usize,
    /// Mean of the points, metres.
    pub mean: Point3<f64>,
    /// The plane that errors are held against.
    pub plane: ScenePlane,
    /// Points without outliers.
    pub points: usize,
    /// Mean distance of the points from the plane, away from the sensor positive, metres.
    pub error: f64,
    /// Their variance about that mean, square metres.
    pub variance: f64,
}

impl NoiseBlock {
    /// Square of [`NoiseBlock::error`] without what noise adds to it, which may leave less than nothing.
    fn systematic(&self) -> f64 {
        self.error * self.error - self.variance / self.points as f64
    }

    /// Metres of depth, along the line of sight, that a metre across the plane is.
    pub fn depth_per_distance(&self) -> f64 {
        self.mean.z / self.plane.distance
    }
}

/// A look, as far as it was used.
#[derive(Clone, Debug, PartialEq)]
pub struct LookSummary {
    /// Its name.
    pub name: String,
    /// Where the optical axis meets the plane, metres.
    pub distance: f64,
    /// Angle between the plane's normal and the optical axis, radians.
    pub tilt: f64,
    /// Points of the cloud.
    pub points: usize,
    /// Points that are none of the plane, or lie farther from their block than noise explains.
    pub outliers: usize,
}

/// What looks at planes tell of a sensor.
#[derive(Clone, Debug)]
pub struct NoiseStudy {
    /// The looks.
    pub looks: Vec<LookSummary>,
    /// Their blocks.
    pub blocks: Vec<NoiseBlock>,
    /// Variances, square metres, that the model without its systematic part states for the blocks' distances from
    /// their planes: what [`NoiseBlock::variance`] would be if it were right.
    pub modelled: Vec<f64>,
    /// The model that fits them.
    pub model: NoiseModel,
    /// Its coefficients with their standard deviations.
    pub coefficients: Vec<Coefficient>,
    /// Root mean square of the logarithm of noise over model: 0.1 is a model that is right to 10 %.
    pub misfit: f64,
    /// Root mean square of the systematic part, metres along the line of sight; of what looks without truth show.
    pub systematic: f64,
    /// Least and greatest depth that was seen, metres: the model says nothing beyond.
    pub depths: [f64; 2],
    /// What the user should know.
    pub notices: Vec<String>,
}

/// Blocks along either side of what a look sees.
const BLOCKS: usize = 12;
/// Fewest points of a block that tells a variance.
const FEWEST: usize = 50;
/// Points of a block farther from its median than so many deviations are none of the sensor's usual noise.
const OUTLIER: f64 = 4.5;
/// A normal distribution's standard deviation over its median absolute one.
const SIGMA_PER_MAD: f64 = 1.4826;
/// Below this tilt noise across the line of sight leaves no trace, radians.
const TELLING_TILT: f64 = 0.35;

/// Studies the noise of a sensor: looks -> planes -> blocks -> the coefficients of `form`.
///
/// # Errors
/// The first error of `looks`; when no look shows a plane, or there are too few blocks for the coefficients.
pub fn study_noise<E: From<TerrainError>>(
    looks: impl IntoIterator<Item = Result<PlaneLook, E>>,
    form: NoiseForm,
) -> Result<NoiseStudy, E> {
    let (mut summaries, mut blocks, mut notices) = (vec![], vec![], vec![]);
    let mut all_true = true;
    for look in looks {
        let look = look?;
        let positions: Vec<Point3<f64>> = look.cloud.points.iter().map(|p| p.position).collect();
        let Some(fitted) = fit_plane(&positions) else {
            notices.push(format!("{}: shows no plane and is left out", look.name));
            continue;
        };
        all_true &= !matches!(look.truth, PlaneTruth::Unknown);
        let plane = match look.truth {
            PlaneTruth::Plane(plane) => plane,
            PlaneTruth::Distance(axis) => ScenePlane {
                distance: axis * fitted.normal.z,
                ..fitted
            },
            PlaneTruth::Unknown => fitted,
        };
        let found = blocks_of(&positions, &fitted, &plane, summaries.len());
        let used: usize = found.iter().map(|b| b.points).sum();
        summaries.push(LookSummary {
            name: look.name,
            distance: plane.axis_distance(),
            tilt: plane.tilt(),
            points: positions.len(),
            outliers: positions.len() - used,
        });
        blocks.extend(found);
    }
    if !all_true {
        notices.push(
            "the true planes are not known for all looks: an error that shifts, scales or tilts all of a look is not seen".into(),
        );
    }
    let steepest = summaries.iter().map(|l| l.tilt).fold(0.0, f64::max);
    let tilted = steepest >= TELLING_TILT;
    if !tilted {
        notices.push(format!(
            "no look is tilted by {:.0} degrees or more: noise across the line of sight is not seen, and a published value stands for it",
            TELLING_TILT.to_degrees()
        ));
    }
    let depths = blocks.iter().fold([f64::INFINITY, 0.0], |[near, far], b| {
        [f64::min(near, b.mean.z), f64::max(far, b.mean.z)]
    });
    let fitted = fit::fit(&form, &blocks, tilted)?;
    let in_depth = |b: &NoiseBlock| b.systematic() * b.depth_per_distance().powi(2);
    let systematic = mean(blocks.iter().map(in_depth)).max(0.0).sqrt();
    Ok(NoiseStudy {
        model: form.with_systematic(fitted.model, &blocks),
        coefficients: fitted.coefficients,
        modelled: blocks
            .iter()
            .map(|b| form.variance(&fitted.model, b))
            .collect(),
        misfit: fitted.misfit,
        systematic,
        depths,
        looks: summaries,
        blocks,
        notices,
    })
}

/// The blocks of a look: squares of its field of view, each freed of outliers. Points far from the `fitted` plane
/// belong to something else; errors are counted from `plane`.
fn blocks_of(
    points: &[Point3<f64>],
    fitted: &ScenePlane,
    plane: &ScenePlane,
    look: usize,
) -> Vec<NoiseBlock> {
    let reach = 3.0 * OUTLIER * fitted.spread(points);
    let own: Vec<&Point3<f64>> = (points.iter())
        .filter(|p| fitted.inverse_depth_error(p).abs() <= reach)
        .collect();
    let bearing = |p: &Point3<f64>| [p.x / p.z, p.y / p.z];
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for b in own.iter().map(|p| bearing(p)) {
        for k in 0..2 {
            low[k] = low[k].min(b[k]);
            high[k] = high[k].max(b[k]);
        }
    }
    let mut members: Vec<Vec<&Point3<f64>>> = vec![vec![]; BLOCKS * BLOCKS];
    for p in own {
        let b = bearing(p);
        let [column, row] = [0, 1].map(|k| {
            let share = (b[k] - low[k]) / (high[k] - low[k]).max(1e-12);
            ((share * BLOCKS as f64) as usize).min(BLOCKS - 1)
        });
        members[row * BLOCKS + column].push(p);
    }
    let blocks = members.into_iter().filter_map(|members| {
        let errors: Vec<f64> = members.iter().map(|p| plane.error(p)).collect();
        let middle = median(errors.clone())?;
        let deviation =
            SIGMA_PER_MAD * median(errors.iter().map(|e| (e - middle).abs()).collect())?;
        // Half of the points on one value: no deviation to judge by.
        let kept: Vec<usize> = (0..errors.len())
            .filter(|&i| deviation == 0.0 || (errors[i] - middle).abs() <= OUTLIER * deviation)
            .collect();
        if kept.len() < FEWEST {
            return None;
        }
        let error = mean(kept.iter().map(|&i| errors[i]));
        let n = kept.len() as f64;
        let variance = mean(kept.iter().map(|&i| (errors[i] - error).powi(2))) * n / (n - 1.0);
        let sum: Vector3<f64> = kept.iter().map(|&i| members[i].coords).sum();
        Some(NoiseBlock {
            look,
            mean: Point3::from(sum / n),
            plane: *plane,
            points: kept.len(),
            error,
            variance,
        })
    });
    blocks.collect()
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0usize), |(sum, n), v| (sum + v, n + 1));
    sum / n as f64
}

/// Of no values none.
fn median(mut values: Vec<f64>) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}
