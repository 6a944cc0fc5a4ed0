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
}

impl Schedule {
    /// From nothing: 10 epochs at 1e-3, the last three at 1e-4 (Hong 2021, 4.2.1).
    pub const PRETRAIN: Self = Self {
        epochs: 10,
        lr: 1e-3,
        drop_epoch: 7,
        steps: None,
    };
    /// From weights: one epoch at 1e-4 (Hong 2021, 4.2.1).
    pub const FINETUNE: Self = Self {
        epochs: 1,
        lr: 1e-4,
        drop_epoch: usize::MAX >> 1,
        steps: None,
    };

    /// The learning rate of an epoch, counted from 0.
    pub fn lr(&self, epoch: usize) -> f64 {
        if epoch < self.drop_epoch {
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
        let rates: Vec<f64> = (0..10).map(|e| Schedule::PRETRAIN.lr(e)).collect();
        assert_eq!(rates[..7], [1e-3; 7]);
        assert_eq!(rates[7..], [1e-4; 3]);
        assert_eq!(Schedule::FINETUNE.lr(0), 1e-4);
        assert_eq!(Schedule::FINETUNE.total(309), 309);
    }
}
