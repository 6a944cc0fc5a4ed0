use std::path::Path;

use barchan_model::NetConfig;
use serde::{Deserialize, Serialize};
use toml::de::{DeTable, DeValue};

use crate::{Augmentation, DeviceName, Loss, Schedule, TrainError};

/// Everything that decides a run; written to `config.toml`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// The data, as given.
    pub data: Vec<String>,
    /// The weights started from; none is a random network.
    pub init: Option<String>,
    /// Where training runs.
    pub device: DeviceName,
    /// Seeds the network, the order of frames, crops and augmentation.
    pub seed: u64,
    /// Trains against true disparity (eq. 8) instead of the images alone.
    pub supervised: bool,
    /// Pairs a step.
    pub batch: usize,
    /// Height and width of the crops, pixels.
    pub crop: [usize; 2],
    /// Longest gradient, Euclidean norm over all weights; 0 does not clip.
    pub clip: f32,
    /// Decay of the moving average of the weights, 0..1; 0 keeps the weights themselves. The average
    /// is what is validated, saved and exported.
    pub average: f64,
    /// Steps between checkpoints.
    pub checkpoint_every: usize,
    /// Steps between validations; 0 validates after every epoch. Before the first step and after the
    /// last it is done anyway.
    pub validate_every: usize,
    /// The network.
    pub net: NetConfig,
    /// How long and how fast.
    pub schedule: Schedule,
    /// Weights of eq. 1, and its options.
    pub loss: Loss,
    /// What is done to the images that the network sees.
    pub augmentation: Augmentation,
}

impl TrainConfig {
    /// Crops from nothing: 256 rows and 512 columns (Hong 2021, 4.2.1, "512x256").
    pub const PRETRAIN_CROP: [usize; 2] = [256, 512];
    /// Crops of the fine-tuning: 320 rows and 384 columns (Hong 2021, 4.2.1, "320x384"; its images
    /// have 366 rows, so the rows come first there).
    pub const FINETUNE_CROP: [usize; 2] = [320, 384];

    /// The paper's training from nothing of a network, on the images alone.
    pub fn new(net: NetConfig) -> Self {
        Self {
            data: vec![],
            init: None,
            device: DeviceName::Flex,
            seed: 1,
            supervised: false,
            batch: 1,
            crop: Self::PRETRAIN_CROP,
            clip: 1.0,
            average: 0.0,
            checkpoint_every: 100,
            validate_every: 0,
            net,
            schedule: Schedule::PRETRAIN,
            loss: Loss::default(),
            augmentation: Augmentation::default(),
        }
    }

    /// This configuration with what `text` (TOML, any part of a `config.toml`) says instead. `path`
    /// stands for it in messages.
    ///
    /// # Errors
    /// When `text` is no TOML, or a key is unknown or of another type: file, line and what is known.
    pub fn overlay(&self, text: &str, path: &Path) -> Result<Self, TrainError> {
        let wrong = |message: String| TrainError::Run {
            path: path.to_owned(),
            message,
        };
        let base = toml::Table::try_from(self).map_err(|e| wrong(e.to_string()))?;
        let said: toml::Table = text
            .parse()
            .map_err(|e: toml::de::Error| wrong(e.to_string().trim_end().to_owned()))?;
        let with = |part: toml::Table| {
            let mut whole = base.clone();
            merge(&mut whole, part);
            whole.try_into::<Self>()
        };
        let error = match with(said.clone()) {
            Ok(config) => return Ok(config),
            Err(error) => error,
        };
        // Which key is to blame: the first that is refused by itself.
        let spans = DeTable::parse(text).map_err(|e| wrong(e.to_string()))?;
        for (keys, start) in leaves(spans.get_ref(), &[]) {
            if let Err(error) = with(only(&said, &keys)) {
                let line = 1 + text[..start].matches('\n').count();
                let (key, message) = (keys.join("."), error.message());
                return Err(wrong(format!("line {line}: {key}: {message}")));
            }
        }
        Err(wrong(error.message().to_owned()))
    }

    /// Refuses what cannot be trained.
    ///
    /// # Errors
    /// Says which field and what it should be.
    pub fn check(&self) -> Result<(), TrainError> {
        let refuse = |message: &str| Err(TrainError::Config(message.into()));
        self.net.check()?;
        if self.batch == 0 || self.checkpoint_every == 0 || self.schedule.epochs == 0 {
            return refuse("batch, checkpoint_every and epochs must be at least 1");
        }
        if self.crop.iter().any(|n| *n < 32) {
            return refuse("a crop must be at least 32 x 32 pixels");
        }
        if !(self.schedule.lr.is_finite() && self.schedule.lr > 0.0) {
            return refuse("the learning rate must be above zero");
        }
        if !(self.clip.is_finite() && self.clip >= 0.0) {
            return refuse("clip must be a length of the gradient, or 0 for none");
        }
        if !(0.0..1.0).contains(&self.average) {
            return refuse("average must be at least 0 and below 1");
        }
        self.loss.check(self.supervised)?;
        let turned = self.augmentation.flip_vertical + self.augmentation.flip_swap > 0.0;
        if turned && self.loss.neighbours > 0 {
            return refuse("flips turn a pair away from its neighbours: leave one of the two away");
        }
        self.augmentation.check()
    }
}

/// What `from` says goes into `into`; tables are merged key by key.
fn merge(into: &mut toml::Table, from: toml::Table) {
    for (key, value) in from {
        match (into.get_mut(&key), value) {
            (Some(toml::Value::Table(into)), toml::Value::Table(from)) => merge(into, from),
            (_, value) => {
                into.insert(key, value);
            }
        }
    }
}

/// The path of every value that is no table, and where in the text its key begins; in the order of
/// the text.
fn leaves(table: &DeTable<'_>, above: &[String]) -> Vec<(Vec<String>, usize)> {
    let mut found = vec![];
    for (key, value) in table {
        let keys = [above, &[key.get_ref().to_string()]].concat();
        match value.get_ref() {
            DeValue::Table(inner) => found.extend(leaves(inner, &keys)),
            _ => found.push((keys, key.span().start)),
        }
    }
    found.sort_by_key(|(_, start)| *start);
    found
}

/// The one value of `table` under the path `keys`, at the same place.
fn only(table: &toml::Table, keys: &[String]) -> toml::Table {
    let Some((key, below)) = keys.split_first() else {
        return toml::Table::new();
    };
    let value = match table.get(key) {
        Some(toml::Value::Table(inner)) if !below.is_empty() => {
            toml::Value::Table(only(inner, below))
        }
        Some(value) => value.clone(),
        None => return toml::Table::new(),
    };
    toml::Table::from_iter([(key.clone(), value)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use barchan_model::Preset;

    fn base() -> TrainConfig {
        TrainConfig::new(Preset::Tiny.config())
    }

    fn over(text: &str) -> Result<TrainConfig, String> {
        base()
            .overlay(text, Path::new("my.toml"))
            .map_err(|e| e.to_string())
    }

    #[test]
    fn a_whole_config_comes_back_and_a_part_changes_that_part() {
        let mut config = base();
        config.init = Some("tiny".into());
        config.schedule.steps = Some(7);
        config.augmentation.erase = 0.25;
        let text = toml::to_string(&config).unwrap();
        let again = over(&text).unwrap();
        assert_eq!(toml::to_string(&again).unwrap(), text);

        let part = over("crop = [64, 96]\n[schedule]\nlr = 0.5\nsteps = 3\n").unwrap();
        assert_eq!(part.crop, [64, 96]);
        assert_eq!((part.schedule.lr, part.schedule.steps), (0.5, Some(3)));
        assert_eq!(part.schedule.epochs, base().schedule.epochs);
        assert_eq!(part.net, base().net);
        assert_eq!(
            toml::to_string(&over("").unwrap()).unwrap(),
            toml::to_string(&base()).unwrap()
        );
    }

    #[test]
    fn what_is_wrong_is_named_with_file_and_line() {
        let cases = [
            ("batch = 2\nbatsch = 3\n", "line 2", "batsch"),
            ("batch = 2\n\n[schedule]\nrate = 1\n", "line 4", "rate"),
            ("[lose]\nssim = 1.0\n", "line 2", "lose"),
            ("batch = \"two\"\n", "line 1", "batch"),
            ("crop = [64]\n", "line 1", "crop"),
            ("device = \"abacus\"\n", "line 1", "flex"),
            ("seed = 1\nbatch = = 2\n", "line 2", "TOML"),
            ("schedule = 3\n", "line 1", "schedule"),
            ("seed = -1\n", "line 1", "seed"),
        ];
        for (text, line, word) in cases {
            let message = over(text).unwrap_err();
            for wanted in ["my.toml", line, word] {
                assert!(message.contains(wanted), "{text}: {message}");
            }
        }
    }

    #[test]
    fn what_cannot_be_trained_is_refused() {
        let broken: [fn(&mut TrainConfig); 8] = [
            |c| c.batch = 0,
            |c| c.crop = [16, 400],
            |c| c.schedule.lr = f64::NAN,
            |c| c.clip = -1.0,
            |c| c.average = 1.0,
            |c| c.augmentation.erase = 1.5,
            |c| c.augmentation.noise = f32::INFINITY,
            |c| c.net.max_disparity = 17,
        ];
        base().check().unwrap();
        for change in broken {
            let mut config = base();
            change(&mut config);
            assert!(config.check().is_err());
        }
    }
}
