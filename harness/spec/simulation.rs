//! The settings of a simulation.

use super::stored::stored;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value as Json, json};
use smart_default::SmartDefault;
use std::collections::BTreeMap;

/// The largest seed, 2^53 - 1. Every reader of JSON and Parquet represents integers up to this one exactly.
pub const MAX_SEED: u64 = (1 << 53) - 1;

/// Regular expression of a policy's name and version.
const POLICY: &str = "^[A-Za-z_][A-Za-z0-9_]{0,63}@[A-Za-z0-9_.+-]{1,64}$";

/// How episodes are simulated. A dataset's hash covers all of these settings except the number of episodes.
#[derive(Debug, Clone, PartialEq, SmartDefault, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Simulation {
    /// Seed of the dataset. An episode's random stream is derived from it, the scenario and the episode's index.
    #[schemars(range(min = 0, max = MAX_SEED))]
    pub seed: u64,
    /// Number of independent episodes, each of which starts at rest. A split by episode needs at least 3. One long
    /// episode corresponds to the paper's continuous run.
    #[schemars(range(min = 1, max = 1_000_000))]
    #[default(200)]
    pub episodes: u32,
    /// Number of commanded moves in an episode.
    #[schemars(range(min = 1, max = 100_000))]
    #[default(20)]
    pub actuations_per_episode: u32,
    /// Duration of a move, s. It must be a whole number of samples.
    #[schemars(range(max = 60.0), extend("exclusiveMinimum" = 0.0))]
    #[default(1.0)]
    pub actuation_seconds: f64,
    /// Samples recorded per second, Hz. There must be a whole number of simulation steps between two samples.
    #[schemars(range(max = 100_000.0), extend("exclusiveMinimum" = 0.0))]
    #[default(10.0)]
    pub sample_rate_hz: f64,
    /// Factors of variation of the world that each episode draws anew, by name.
    #[schemars(extend("uniqueItems" = true))]
    pub factors: Vec<String>,
    /// The policy that gives the setpoints instead of the world's motion, `NAME@VERSION`. Its episodes are collected
    /// with `harness.collect(SPEC, policy=...)` in Python.
    #[schemars(regex(pattern = POLICY))]
    pub policy: Option<String>,
    /// Whether these are the episodes of a [`TestDataset`](super::TestDataset). A spec can't set it.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    #[schemars(skip)]
    pub test: bool,
    /// Values of the settings that the world defines, by name: the range of each actuator's setpoints, and the
    /// clearance of placed bodies. The default is the world's value.
    #[serde(flatten)]
    #[schemars(skip)]
    pub world: BTreeMap<String, Setting>,
}

/// The value of a world's setting.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Setting {
    /// The lowest and the highest value of a range.
    Range([f64; 2]),
    /// A single number.
    Number(f64),
}

impl Simulation {
    /// The settings that every world has.
    pub(super) const KEYS: [&str; 7] = [
        "seed",
        "episodes",
        "actuations_per_episode",
        "actuation_seconds",
        "sample_rate_hz",
        "factors",
        "policy",
    ];

    /// Returns the settings as a dataset's description and its hash have them.
    pub fn stored(&self) -> Json {
        stored("simulation", json!(self), &json!(Self::default()))
    }

    /// Returns the seed of all random streams of the episodes. Those of test episodes are above [`MAX_SEED`], so they
    /// are never the same as those of a dataset with any seed.
    pub fn stream(&self) -> u64 {
        if self.test { self.seed + MAX_SEED + 1 } else { self.seed }
    }

    /// Returns the range of a world's setting; `None` if there is no such setting, or if it is a number.
    pub fn range(&self, setting: &str) -> Option<[f64; 2]> {
        match self.world.get(setting)? {
            Setting::Range(range) => Some(*range),
            Setting::Number(_) => None,
        }
    }

    /// Returns the number of a world's setting; `None` if there is no such setting, or if it is a range.
    pub fn number(&self, setting: &str) -> Option<f64> {
        match self.world.get(setting)? {
            Setting::Number(number) => Some(*number),
            Setting::Range(_) => None,
        }
    }

    /// Returns the simulation with another value of a world's setting.
    pub fn with(mut self, setting: &str, value: Setting) -> Self {
        self.world.insert(setting.to_owned(), value);
        self
    }

    /// Returns the number of samples recorded during one actuation.
    pub fn samples_per_actuation(&self) -> usize {
        (self.actuation_seconds * self.sample_rate_hz).round() as usize
    }

    /// Returns the number of samples recorded in one episode.
    pub fn samples_per_episode(&self) -> usize {
        self.actuations_per_episode as usize * self.samples_per_actuation()
    }
}

/// Refuses a sample rate with no whole number of simulation steps between two samples. The error is the message.
pub(super) fn sample_rate(rate: f64, steps: f64) -> Result<(), String> {
    if is_positive_whole(steps / rate) {
        return Ok(());
    }
    let usual = [10.0, 20.0, 50.0, 100.0].into_iter().filter(|usual| is_positive_whole(steps / usual));
    let mut usual: Vec<String> = usual.map(|rate: f64| rate.to_string()).collect();
    if usual.is_empty() {
        usual.push((steps / (steps / rate).round().max(1.0)).to_string());
    }
    let usual = usual.join(", ");
    Err(format!("{rate} Hz does not divide the simulation's {steps} Hz; use one that does, such as {usual}"))
}

/// Refuses a duration of a move that is no whole number of samples. The error is the message.
pub(super) fn actuation(seconds: f64, rate: f64) -> Result<(), String> {
    if is_positive_whole(seconds * rate) {
        return Ok(());
    }
    let interval = 1.0 / rate;
    Err(format!("{seconds} s is not a whole number of samples at {rate} Hz; use a multiple of {interval} s"))
}

fn is_positive_whole(value: f64) -> bool {
    value.round() >= 1.0 && (value - value.round()).abs() < 1e-9 * value
}
