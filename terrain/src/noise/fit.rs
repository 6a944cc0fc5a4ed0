//! Coefficients of a noise model by least squares of logarithms.

use nalgebra::{DMatrix, DVector};

use super::{NoiseBlock, NoiseForm, NoiseModel};
use crate::TerrainError;

/// A fitted coefficient.
#[derive(Clone, Debug, PartialEq)]
pub struct Coefficient {
    /// As in [`NoiseModel`].
    pub name: &'static str,
    /// Its value, in the model's unit.
    pub value: f64,
    /// Its standard deviation, from how well the model fits; `None` of a value that no look could tell, which
    /// is a published one.
    pub deviation: Option<f64>,
}

/// What [`fit`] finds.
pub(super) struct Fitted {
    /// Without a systematic part.
    pub model: NoiseModel,
    pub coefficients: Vec<Coefficient>,
    /// Root mean square of the logarithm of standard deviation over model.
    pub misfit: f64,
}

/// The coefficients for which `ln(variance of a block) - ln(variance of the model)` is least in squares (Levenberg and
/// Marquardt), begun at published values; those that only tilted looks show stay there unless there are some.
pub(super) fn fit(
    form: &NoiseForm,
    blocks: &[NoiseBlock],
    tilted: bool,
) -> Result<Fitted, TerrainError> {
    let published = form.coefficients();
    let free: Vec<usize> = (0..published.len())
        .filter(|&k| tilted || !published[k].2)
        .collect();
    let used: Vec<&NoiseBlock> = blocks.iter().filter(|b| b.variance > 0.0).collect();
    if used.len() < 4 * free.len() {
        return Err(TerrainError::Empty(format!(
            "{} parts of looks at planes are too few for {} coefficients\n  cure: more looks, at planes that fill the image",
            used.len(),
            free.len()
        )));
    }
    let start: Vec<f64> = published.iter().map(|c| c.1).collect();
    // Coefficients by their logarithms, so that none becomes negative.
    let values = |x: &DVector<f64>| {
        let mut values = start.clone();
        for (k, x) in free.iter().zip(x.iter()) {
            values[*k] = x.exp();
        }
        values
    };
    let residuals = |x: &DVector<f64>| {
        let model = form.model(&values(x));
        let residuals = used.iter().map(|b| {
            // The logarithm of a variance of n numbers is too small by 1 / (n - 1) in the mean.
            let seen = b.variance.ln() + 1.0 / (b.points as f64 - 1.0);
            seen - form.variance(&model, b).ln()
        });
        DVector::from_vec(residuals.collect())
    };
    let jacobian = |x: &DVector<f64>| {
        const STEP: f64 = 1e-3;
        let columns: Vec<DVector<f64>> = (0..x.len())
            .map(|k| {
                let moved = |by: f64| {
                    let mut x = x.clone();
                    x[k] += by;
                    residuals(&x)
                };
                (moved(STEP) - moved(-STEP)) / (2.0 * STEP)
            })
            .collect();
        DMatrix::from_columns(&columns)
    };

    let mut x = DVector::from_iterator(free.len(), free.iter().map(|&k| start[k].ln()));
    let mut r = residuals(&x);
    let mut damping = 1e-2;
    for _ in 0..200 {
        let j = jacobian(&x);
        let mut normal = j.tr_mul(&j);
        for k in 0..x.len() {
            normal[(k, k)] += damping * (1e-6 + normal[(k, k)]);
        }
        let Some(factor) = normal.cholesky() else {
            break;
        };
        // No further than to the e-fold, and no smaller than what no look could tell from zero.
        let step = factor.solve(&j.tr_mul(&r)).map(|s| s.clamp(-1.0, 1.0));
        let candidate = (&x - &step).map(|v| v.max(-16.0));
        let moved = residuals(&candidate);
        if moved.norm_squared() < r.norm_squared() {
            let small = r.norm_squared() - moved.norm_squared() < 1e-10 * r.norm_squared();
            (x, r, damping) = (candidate, moved, (damping * 0.3).max(1e-9));
            if small {
                break;
            }
        } else {
            damping *= 5.0;
            if damping > 1e9 {
                break;
            }
        }
    }

    let j = jacobian(&x);
    let scatter = r.norm_squared() / (used.len() - free.len()) as f64;
    let covariance = j.tr_mul(&j).pseudo_inverse(1e-12).ok();
    let values = values(&x);
    let coefficients = published.iter().enumerate().map(|(k, (name, ..))| {
        let place = free.iter().position(|f| *f == k);
        let of_logarithm = place
            .zip(covariance.as_ref())
            .map(|(p, c)| (scatter * c[(p, p)]).sqrt());
        Coefficient {
            name,
            value: values[k],
            deviation: of_logarithm.map(|d| d * values[k]),
        }
    });
    Ok(Fitted {
        coefficients: coefficients.collect(),
        model: form.model(&values),
        // A logarithm of variance is two of standard deviation.
        misfit: 0.5 * (r.norm_squared() / r.len() as f64).sqrt(),
    })
}
