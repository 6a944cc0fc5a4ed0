//! What turns the rows of the right image into those of the left.

use barchan_geometry::RectifiedRig;
use nalgebra::{Matrix3, Rotation3, SMatrix, SVector, Vector2, Vector3};
use serde::Serialize;

use super::median;

/// How the right camera differs from a rectified one, as far as the rows of matches tell: each
/// pixel of a rectified right image lies in the given image at `K (1 + scale) R K^-1 p + (0, offset)`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct RowModel {
    /// Principal point too low, pixels; positive: the right image's content lies lower.
    pub offset: f64,
    /// Rotation about the camera's x axis, radians. It shifts rows too, but more towards the top and
    /// the bottom: `offset` and `pitch` are told apart by that, and one of them is zero.
    pub pitch: f64,
    /// Rotation about the y axis, radians, as far as rows tell: a keystone, which some lens
    /// distortion makes too.
    pub yaw: f64,
    /// Rotation about the optical axis, radians; positive: the right side of the image lies lower.
    pub roll: f64,
    /// Larger (positive) or smaller than the left image, as a share.
    pub scale: f64,
    /// Robust standard deviation of the rows of matches about the model, pixels.
    pub spread: f64,
    /// How many matches there were, and how many the model explains.
    pub matches: usize,
    /// See `matches`.
    pub explained: usize,
    /// How far out the matches lie, so that nine in ten lie nearer: the product of column and row,
    /// column, and row, from the principal point in units of the focal length.
    #[serde(skip)]
    pub(super) reach: [f64; 3],
}

/// A match of the left and the right image, and the rig it was seen with.
#[derive(Clone, Copy, Debug)]
pub(super) struct RowMatch {
    pub rig: RectifiedRig,
    pub left: Vector2<f64>,
    pub right: Vector2<f64>,
}

impl RowMatch {
    /// The place in the right image, from the principal point in units of the focal length.
    fn ray(&self) -> Vector2<f64> {
        let rig = &self.rig;
        Vector2::new(
            (self.right.x - rig.cx - rig.doffs) / rig.fx,
            (self.right.y - rig.cy) / rig.fy,
        )
    }
}

/// Fewer matches say nothing.
pub(super) const ENOUGH: usize = 30;

type Parameters = SVector<f64, 5>;

impl RowModel {
    /// Fits the model that explains the rows with the fewest causes: offset, roll and scale; pitch
    /// in place of the offset, and yaw, only where the matches demand it. `None` of too few matches.
    pub(super) fn fit(matches: &[RowMatch]) -> Option<Self> {
        if matches.len() < ENOUGH {
            return None;
        }
        /// By how much the robust cost, in variances, must fall before a less common cause is
        /// believed. (Nine would be three sigma for independent matches; neighbours are not.)
        const DEMAND: f64 = 60.0;
        const OFFSET: [bool; 5] = [true, false, false, true, true];
        const PITCH: [bool; 5] = [false, true, false, true, true];
        let (plain, plain_cost, sigma) = fit_causes(matches, OFFSET, None);
        let (pitched, pitched_cost, _) = fit_causes(matches, PITCH, Some(sigma));
        let (mut best, mut cost, mut causes) = (plain, plain_cost, OFFSET);
        if pitched_cost < plain_cost - DEMAND {
            (best, cost, causes) = (pitched, pitched_cost, PITCH);
        }
        causes[2] = true;
        let (keystone, keystone_cost, _) = fit_causes(matches, causes, Some(sigma));
        if keystone_cost < cost - DEMAND {
            best = keystone;
        }
        let mut model = Self {
            offset: best[0],
            pitch: best[1],
            yaw: best[2],
            roll: best[3],
            scale: best[4],
            matches: matches.len(),
            ..Self::default()
        };
        let reach = |of: &dyn Fn(Vector2<f64>) -> f64| {
            let mut sizes: Vec<f64> = matches.iter().map(|m| of(m.ray()).abs()).collect();
            sizes.sort_by(f64::total_cmp);
            sizes[(sizes.len() - 1) * 9 / 10]
        };
        model.reach = [reach(&|r| r.x * r.y), reach(&|r| r.x), reach(&|r| r.y)];
        let residuals = residuals(matches, &best);
        let tolerance = |m: &RowMatch| 0.75 * (m.rig.width as f64 / 640.0).max(1.0);
        model.spread = deviation(&residuals);
        model.explained = matches
            .iter()
            .zip(&residuals)
            .filter(|(m, r)| r.abs() < tolerance(m))
            .count();
        Some(model)
    }

    /// Where each pixel of the rectified right image lies in the given one, but for the keystone: were
    /// it distortion and not yaw, taking it for yaw would falsify every disparity.
    pub fn homography(&self, rig: &RectifiedRig) -> Matrix3<f64> {
        homography(
            rig,
            &Parameters::from([self.offset, self.pitch, 0.0, self.roll, self.scale]),
        )
    }

    /// The share of the matches that the model explains.
    pub fn consistency(&self) -> f64 {
        self.explained as f64 / self.matches.max(1) as f64
    }
}

fn homography(rig: &RectifiedRig, p: &Parameters) -> Matrix3<f64> {
    let k = Matrix3::new(
        rig.fx,
        0.0,
        rig.cx + rig.doffs,
        0.0,
        rig.fy,
        rig.cy,
        0.0,
        0.0,
        1.0,
    );
    // A camera matrix with focal lengths above zero has an inverse.
    let inverse = k.try_inverse().unwrap_or(Matrix3::identity());
    let turn = Rotation3::new(Vector3::new(p[1], p[2], p[3]));
    let zoom = Matrix3::from_diagonal(&Vector3::new(1.0 + p[4], 1.0 + p[4], 1.0));
    let shift = Matrix3::new_translation(&Vector2::new(0.0, p[0]));
    shift * k * zoom * turn.matrix() * inverse
}

/// Row of each match in the corrected right image, less that in the left.
fn residuals(matches: &[RowMatch], p: &Parameters) -> Vec<f64> {
    let mut last: Option<(RectifiedRig, Matrix3<f64>)> = None;
    let mut to_corrected = |rig: &RectifiedRig| match &last {
        Some((known, matrix)) if known == rig => *matrix,
        _ => {
            // Near the identity, so invertible.
            let matrix = homography(rig, p)
                .try_inverse()
                .unwrap_or(Matrix3::identity());
            last = Some((*rig, matrix));
            matrix
        }
    };
    matches
        .iter()
        .map(|m| {
            let corrected = to_corrected(&m.rig) * m.right.push(1.0);
            corrected.y / corrected.z - m.left.y
        })
        .collect()
}

fn deviation(residuals: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = residuals.iter().map(|r| r.abs()).collect();
    1.4826 * median(&mut sizes)
}

/// Iteratively reweighted least squares with Tukey's biweight over the causes that are free.
/// Returns the parameters, the cost in variances, and the standard deviation that it was measured
/// with: `sigma`, or that of these residuals.
fn fit_causes(matches: &[RowMatch], free: [bool; 5], sigma: Option<f64>) -> (Parameters, f64, f64) {
    let mut offsets: Vec<f64> = matches.iter().map(|m| m.right.y - m.left.y).collect();
    let mut p = Parameters::zeros();
    if free[0] {
        p[0] = median(&mut offsets);
    } else {
        let f = matches[0].rig.fy;
        p[1] = -median(&mut offsets) / f;
    }
    let mut scale = f64::INFINITY;
    for _ in 0..20 {
        let residuals = residuals(matches, &p);
        // Never narrower than what sub-pixel matching resolves, and narrowing only.
        scale = deviation(&residuals).max(0.05).min(scale);
        let mut normal = SMatrix::<f64, 5, 5>::zeros();
        let mut right_side = Parameters::zeros();
        for (m, r) in matches.iter().zip(&residuals) {
            let weight = biweight(r / scale).0;
            let ray = m.ray();
            let (x, y) = (ray.x, ray.y);
            // To first order of small angles; the loop makes up for the rest.
            let f = m.rig.fy;
            let row = Parameters::from([-1.0, f * (1.0 + y * y), -f * x * y, -f * x, -f * y]);
            normal += weight * row * row.transpose();
            right_side -= weight * r * row;
        }
        for k in 0..5 {
            if free[k] {
                continue;
            }
            normal.row_mut(k).fill(0.0);
            normal.column_mut(k).fill(0.0);
            normal[(k, k)] = 1.0;
            right_side[k] = 0.0;
        }
        let Some(step) = normal.cholesky().map(|c| c.solve(&right_side)) else {
            break;
        };
        p += step;
        // Beyond this no two cameras of one rig stand, and the model is not meant.
        p = p.zip_map(
            &Parameters::from([1e3, 0.3, 0.3, 0.3, 0.3]),
            |v, most: f64| v.clamp(-most, most),
        );
        if step.amax() < 1e-9 {
            break;
        }
    }
    let residuals = residuals(matches, &p);
    let sigma = sigma.unwrap_or_else(|| deviation(&residuals).max(0.05));
    let cost = residuals.iter().map(|r| biweight(r / sigma).1).sum();
    (p, cost, sigma)
}

/// Tukey's biweight of a residual in standard deviations: its weight, and its cost (twice the
/// integral, so that small residuals cost their square).
fn biweight(r: f64) -> (f64, f64) {
    const C: f64 = 4.685;
    let inside = (1.0 - (r / C).powi(2)).max(0.0);
    (inside * inside, C * C / 3.0 * (1.0 - inside.powi(3)))
}
