//! By how much the clocks of an estimate and of its truth differ: de Jong 2020, section 9.1, found the images of
//! the Katwijk archive ahead of its fixes.

use barchan_geometry::Trajectory;
use barchan_geometry::nalgebra::Vector3;
use serde::Serialize;

use crate::EvalError;
use crate::trajectory::{in_order_of_time, umeyama};

/// What [`time_shift`] found.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TimeShift {
    /// Seconds by which the estimate is ahead: at time `t` it is where the truth is at `t + ahead`.
    pub ahead: f64,
    /// Seconds by which `ahead` may be wrong: beyond, the error is more than √2 times the least. Large on a straight
    /// drive at one speed, which looks the same at any time.
    pub give_or_take: f64,
    /// Root mean square error of positions after alignment with scale, as the times are, metres.
    pub error_before: f64,
    /// The same with the shift, metres.
    pub error_after: f64,
    /// Poses compared, the same for every shift.
    pub frames: usize,
}

/// The shift of time, at most `most` seconds (100 at most) to either side, that brings an estimate nearest to the truth, which is
/// interpolated: every tenth of a second is tried, and a parabola through the squared errors around the best tells
/// the rest. Alignment is with scale, lest a wrong one pass for a shift.
///
/// # Errors
/// When fewer than ten poses stay within the truth at every shift, one side does not move, or a pose is not finite.
pub fn time_shift(
    estimate: &Trajectory,
    truth: &Trajectory,
    most: f64,
) -> Result<TimeShift, EvalError> {
    const STEP: f64 = 0.1;
    const FEWEST: usize = 10;
    /// What rounding makes of an error of zero, square metres.
    const NOTHING: f64 = 1e-12;
    let steps = (most / STEP).ceil().clamp(1.0, 1000.0) as i64;
    let estimate = in_order_of_time(estimate, "estimate")?;
    let truth = Trajectory {
        poses: in_order_of_time(truth, "truth")?,
    };
    let span = truth.poses.first().zip(truth.poses.last());
    let margin = steps as f64 * STEP;
    let compared: Vec<(f64, Vector3<f64>)> = (estimate.iter())
        .filter(|p| {
            span.is_some_and(|(a, b)| p.time - margin >= a.time && p.time + margin <= b.time)
        })
        .map(|p| (p.time, p.T_world_cam.translation.vector))
        .collect();
    if compared.len() < FEWEST {
        return Err(EvalError::TooShortToShift {
            poses: compared.len(),
            fewest: FEWEST,
            most: margin,
        });
    }
    let est: Vec<Vector3<f64>> = compared.iter().map(|(_, p)| *p).collect();
    let squared_error = |shift: f64| -> Result<f64, EvalError> {
        let at = |(time, p): &(f64, Vector3<f64>)| {
            let pose = truth.at(time + shift);
            pose.map_or(*p, |pose| pose.translation.vector)
        };
        let gt: Vec<Vector3<f64>> = compared.iter().map(at).collect();
        let onto = umeyama(&est, &gt, true)?;
        let squared = est
            .iter()
            .zip(&gt)
            .map(|(e, g)| (onto.apply(e) - g).norm_squared());
        Ok(squared.sum::<f64>() / est.len() as f64)
    };
    let errors = (-steps..=steps)
        .map(|k| squared_error(k as f64 * STEP))
        .collect::<Result<Vec<f64>, _>>()?;
    let best = (0..errors.len())
        .min_by(|a, b| errors[*a].total_cmp(&errors[*b]))
        .unwrap_or(0);
    let around = best.checked_sub(1).and_then(|k| errors.get(k..k + 3));
    let within = around.map_or(0.0, |e| {
        let bend = e[0] - 2.0 * e[1] + e[2];
        if bend > 0.0 {
            0.5 * (e[0] - e[2]) / bend
        } else {
            0.0
        }
    });
    let ahead = ((best as i64 - steps) as f64 + within) * STEP;
    let least = squared_error(ahead)?.min(errors[best]);
    let as_good = errors
        .iter()
        .filter(|e| **e <= 2.0 * least + NOTHING)
        .count();
    Ok(TimeShift {
        ahead,
        give_or_take: 0.5 * STEP * as_good.max(1) as f64,
        error_before: errors[steps as usize].sqrt(),
        error_after: least.sqrt(),
        frames: est.len(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use barchan_geometry::{Se3, StampedPose};

    /// A drive with bends, a pose every `step` seconds, as a clock that is `ahead` shows it.
    fn drive(step: f64, ahead: f64, place: impl Fn(f64) -> Vector3<f64>) -> Trajectory {
        let pose = |k: usize| {
            let time = k as f64 * step;
            let p = place(time + ahead);
            StampedPose {
                time,
                T_world_cam: Se3::translation(p.x, p.y, p.z),
            }
        };
        Trajectory {
            poses: (0..(60.0 / step) as usize).map(pose).collect(),
        }
    }

    fn bends(t: f64) -> Vector3<f64> {
        Vector3::new(5.0 * (0.3 * t).sin(), 0.4 * t + (0.5 * t).cos(), 0.0)
    }

    #[test]
    fn a_clock_that_is_ahead_is_found_out_whatever_the_scale() {
        let truth = drive(1.0, 0.0, bends);
        for planted in [-2.3, 0.0, 0.37, 1.5] {
            let estimate = drive(0.2, planted, |t| 0.7 * bends(t));
            let found = time_shift(&estimate, &truth, 5.0).unwrap();
            // The truth is a chord between its poses a second apart.
            assert!((found.ahead - planted).abs() < 0.02, "{planted}: {found:?}");
            assert!(found.give_or_take < 0.3, "{found:?}");
            assert!(found.error_after < 0.1 && found.error_after <= found.error_before);
        }
    }

    #[test]
    fn a_straight_drive_tells_nothing_and_says_so() {
        let straight = |t: f64| Vector3::new(0.4 * t, 0.0, 0.0);
        let truth = drive(1.0, 0.0, straight);
        let found = time_shift(&drive(0.2, 1.0, straight), &truth, 3.0).unwrap();
        assert!(found.give_or_take >= 3.0, "{found:?}");
    }

    #[test]
    fn too_short_a_drive_is_an_error() {
        let short = Trajectory {
            poses: drive(0.2, 0.0, bends).poses[..20].to_vec(),
        };
        assert!(time_shift(&short, &short, 5.0).is_err());
        assert!(time_shift(&Trajectory::default(), &short, 5.0).is_err());
    }
}
