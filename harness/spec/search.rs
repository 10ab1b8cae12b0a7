//! Searches: settings that are drawn from distributions, one combination for each trial.

use super::simulation::MAX_SEED;
use super::sobol::sobol;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use smart_default::SmartDefault;
use std::collections::BTreeMap;

/// Draws settings, one combination for each trial.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Search {
    /// How the settings are drawn.
    pub method: Method,
    /// Number of trials. A search with more trials begins with the same ones.
    #[schemars(range(min = 1, max = 10_000))]
    pub trials: usize,
    /// Seed of the drawn settings.
    #[serde(default)]
    #[schemars(range(min = 0, max = MAX_SEED))]
    pub seed: u64,
    /// The distribution of each setting, by dotted key: `training.learning_rate: {log_uniform: [0.0001, 0.01]}`.
    // The schema of the keys is added in `schema`.
    #[schemars(with = "BTreeMap<String, Value>")]
    pub space: BTreeMap<String, Candidates>,
    /// The loss by which trials are compared.
    #[serde(default)]
    pub objective: Objective,
    /// Successive halving, which stops bad trials early.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "halving")]
    pub halving: Option<Halving>,
}

/// How a search draws settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Independently of each other.
    Random,
    /// By a Sobol sequence, which covers the space more evenly (Joe & Kuo, 2008). The seed shifts the sequence (random
    /// digital shift). The number of trials should be a power of 2.
    Sobol,
}

/// The values that a setting can have in a search, and their distribution.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Candidates {
    /// Uniformly between the lowest and the highest value.
    Uniform([f64; 2]),
    /// Uniformly in the logarithm, between the lowest and the highest value.
    LogUniform([f64; 2]),
    /// An integer from the lowest to the highest value, each with the same probability.
    Integer([i64; 2]),
    /// One of several values, each with the same probability.
    Choice(Vec<Value>),
}

/// The value by which trials are compared: a term of the loss on the validation samples. The best trial has the lowest.
#[derive(Debug, Clone, PartialEq, Eq, SmartDefault, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Objective {
    /// `total`, or an output modality, as in the column `term` of the table `epochs`.
    #[default(Self::TOTAL.into())]
    pub term: String,
    /// The samples on which the loss is evaluated. Choosing by the test samples would make their errors too small.
    pub split: Evaluated,
}

/// The samples on which an objective is evaluated.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
#[schemars(rename = "Samples")]
pub enum Evaluated {
    /// The validation samples.
    #[default]
    Validation,
}

impl Objective {
    /// The weighted sum of all terms.
    pub const TOTAL: &str = "total";
}

/// Successive halving (Jamieson & Talwalkar, 2016): all trials are trained for a few epochs, and the best of them are
/// trained further.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Halving {
    /// The best 1/`eta` of the trials continue until they have been trained for `eta` times as many epochs.
    #[serde(default = "default_eta")]
    #[schemars(range(min = 2, max = 100))]
    pub eta: usize,
    /// Number of epochs for which every trial is trained.
    #[schemars(range(min = 1, max = 100_000))]
    pub min_epochs: usize,
}

fn default_eta() -> usize {
    4
}

fn halving(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
    generator.subschema_for::<Halving>()
}

/// The settings of one trial, by dotted key.
pub type Trial = BTreeMap<String, Value>;

impl Search {
    /// Returns the settings of each trial. They follow from `method`, `seed` and `space` alone.
    pub fn draw(&self) -> Vec<Trial> {
        let mut trials = vec![Trial::new(); self.trials];
        for (dimension, (key, candidates)) in self.space.iter().enumerate() {
            let mut random = ChaCha8Rng::seed_from_u64(self.seed);
            random.set_stream(dimension as u64);
            let shift = random.next_u32();
            for (number, trial) in trials.iter_mut().enumerate() {
                let share = match self.method {
                    Method::Random => random.random(),
                    // The middle of the interval that 32 bits leave.
                    Method::Sobol => {
                        (f64::from(sobol(number as u32, dimension) ^ shift) + 0.5) / 2_f64.powi(32)
                    }
                };
                trial.insert(key.clone(), candidates.quantile(share));
            }
        }
        trials
    }

    /// Checks the rules that the schema can't express, without looking at the other settings. An error has the dotted
    /// path in `search` of the value at fault, and the message.
    pub(super) fn check(&self) -> Result<(), (String, String)> {
        if self.space.is_empty() {
            return Err((
                "space".into(),
                "'search.space' is empty; give a setting and its distribution".into(),
            ));
        }
        for (key, candidates) in &self.space {
            let at = |message| (format!("space.{key}.{}", candidates.name()), message);
            candidates.check().map_err(at)?;
        }
        Ok(())
    }
}

impl Candidates {
    fn name(&self) -> &'static str {
        match self {
            Self::Uniform(_) => "uniform",
            Self::LogUniform(_) => "log_uniform",
            Self::Integer(_) => "integer",
            Self::Choice(_) => "choice",
        }
    }

    fn check(&self) -> Result<(), String> {
        let name = self.name();
        let empty = |low: String, high: String| {
            Err(format!("'{name}' needs a lowest value below the highest; found {low} and {high}"))
        };
        match self {
            Self::Uniform([low, high]) | Self::LogUniform([low, high]) if low >= high => {
                empty(low.to_string(), high.to_string())
            }
            Self::Integer([low, high]) if low >= high => empty(low.to_string(), high.to_string()),
            Self::LogUniform([low, _]) if *low <= 0.0 => {
                Err(format!("'log_uniform' draws values above 0; the lowest is {low}"))
            }
            _ => Ok(()),
        }
    }

    /// Returns the quantile of a share in [0, 1).
    fn quantile(&self, share: f64) -> Value {
        match self {
            Self::Uniform([low, high]) => rounded(low + share * (high - low)).clamp(*low, *high).into(),
            Self::LogUniform([low, high]) => {
                rounded((low.ln() + share * (high.ln() - low.ln())).exp()).clamp(*low, *high).into()
            }
            Self::Integer([low, high]) => {
                let values = (high - low + 1) as f64;
                (low + ((share * values) as i64).min(high - low)).into()
            }
            Self::Choice(values) => {
                let index = (share * values.len() as f64) as usize;
                values[index.min(values.len() - 1)].clone()
            }
        }
    }
}

/// Rounds to 6 significant digits. Trials are then the same on machines whose logarithms differ in the last bit, and
/// can be typed.
fn rounded(value: f64) -> f64 {
    format!("{value:.5e}").parse().unwrap_or(value)
}

impl Halving {
    /// Returns the epochs after which trials are compared, and last `epochs`, the epochs of a whole training.
    pub fn rungs(&self, epochs: usize) -> Vec<usize> {
        let longer = |rung: &usize| rung.checked_mul(self.eta);
        let mut rungs: Vec<usize> =
            std::iter::successors(Some(self.min_epochs), longer).take_while(|rung| *rung < epochs).collect();
        rungs.push(epochs);
        rungs
    }

    /// Returns how many of so many trials train on.
    pub fn kept(&self, trials: usize) -> usize {
        (trials / self.eta).max(1)
    }
}
