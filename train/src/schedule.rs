use serde::{Deserialize, Serialize};

/// How long and how fast.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Schedule {
    /// Passes over the data.
    pub epochs: usize,
    /// Learning rate.
    pub lr: f64,
    /// The learning rate is divided by ten from this epoch on.
    pub drop_epoch: usize,
    /// Stops after this many steps, where that is sooner.
    pub steps: Option<usize>,
    /// The learning rate falls along half a cosine to a hundredth at the last step, instead of dropping once
    /// (Loshchilov 2017).
    #[serde(default)]
    pub cosine: bool,
}

impl Schedule {
    /// From nothing: 10 epochs at 1e-3, the last three at 1e-4 (Hong 2021, 4.2.1).
    pub const PRETRAIN: Self = Self {
        epochs: 10,
        lr: 1e-3,
        drop_epoch: 7,
        steps: None,
        cosine: false,
    };
    /// From weights: one epoch at 1e-4 (Hong 2021, 4.2.1).
    pub const FINETUNE: Self = Self {
        epochs: 1,
        lr: 1e-4,
        drop_epoch: usize::MAX >> 1,
        steps: None,
        cosine: false,
    };

    /// The learning rate of a step, counted from 0, when an epoch has `per_epoch`.
    pub fn lr(&self, step: usize, per_epoch: usize) -> f64 {
        if self.cosine {
            let done = step as f64 / self.total(per_epoch).max(1) as f64;
            let share = 0.5 + 0.5 * (done * std::f64::consts::PI).cos();
            return self.lr * (0.01 + 0.99 * share);
        }
        if step / per_epoch < self.drop_epoch {
            self.lr
        } else {
            self.lr / 10.0
        }
    }

    /// How many steps there are when an epoch has `per_epoch`.
    pub fn total(&self, per_epoch: usize) -> usize {
        let all = per_epoch.saturating_mul(self.epochs);
        self.steps.map_or(all, |steps| steps.min(all))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_rates() {
        let rates: Vec<f64> = (0..10).map(|e| Schedule::PRETRAIN.lr(5 * e, 5)).collect();
        assert_eq!(rates[..7], [1e-3; 7]);
        assert_eq!(rates[7..], [1e-4; 3]);
        assert_eq!(Schedule::FINETUNE.lr(0, 309), 1e-4);
        assert_eq!(Schedule::FINETUNE.total(309), 309);
    }

    #[test]
    fn a_cosine_falls_from_the_rate_to_a_hundredth_of_it() {
        let cosine = Schedule {
            cosine: true,
            ..Schedule::PRETRAIN
        };
        let rates: Vec<f64> = (0..=100).map(|step| cosine.lr(step, 10)).collect();
        assert!(rates.windows(2).all(|pair| pair[1] < pair[0]));
        let near = |a: f64, b: f64| (a - b).abs() < 1e-9;
        assert!(near(rates[0], 1e-3) && near(rates[50], 0.505e-3) && near(rates[100], 1e-5));
    }
}
