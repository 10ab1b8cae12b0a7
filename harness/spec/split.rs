//! How a dataset is divided into training, validation and test set.

use crate::layout::{intern, is_name};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use sha2::{Digest, Sha256};
use smart_default::SmartDefault;
use std::fmt;
use std::ops::Range;

/// The unit that a split divides.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum Division {
    /// Whole episodes. The episodes of the test set are not used in training.
    #[default]
    Episode,
    /// The time of each episode. Its first part is for training, followed by a gap, validation, a gap and the test.
    Time,
    /// Transitions drawn at random, the same for all seeds. This split leaks: most test samples have a neighbor in
    /// training that is one sampling interval away, so errors are smaller than on new data.
    Sample,
    /// The episodes with one value of this label of an imported dataset.
    Label(&'static str),
}

impl Division {
    /// Every value but the labels, in the order of declaration.
    pub const ALL: &'static [Self] = &[Self::Episode, Self::Time, Self::Sample];

    /// Returns the name in specs, tables and file names.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Episode => "episode",
            Self::Time => "time",
            Self::Sample => "sample",
            Self::Label(name) => name,
        }
    }

    /// Returns the division of this name; `None` if it can't be that of a label either.
    pub fn new(name: &str) -> Option<Self> {
        let known = Self::ALL.iter().copied().find(|division| division.name() == name);
        known.or_else(|| is_name(name).then(|| Self::Label(intern(name))))
    }

    /// Whether each episode is in one part.
    pub fn keeps_episodes(self) -> bool {
        matches!(self, Self::Episode | Self::Label(_))
    }
}

impl fmt::Display for Division {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.pad(self.name())
    }
}

impl Serialize for Division {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for Division {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = String::deserialize(deserializer)?;
        Self::new(&name).ok_or_else(|| D::Error::custom(format!("'{name}' names no label")))
    }
}

impl JsonSchema for Division {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Division".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let choice = |(name, meaning): (Self, &str)| json_schema!({ "description": meaning, "type": "string", "const": name.name() });
        let choices = [
            (Self::Episode, "Whole episodes. The episodes of the test set are not used in training."),
            (
                Self::Time,
                "The time of each episode. Its first part is for training, followed by a gap, validation, a gap and \
                 the test.",
            ),
            (
                Self::Sample,
                "Transitions drawn at random, the same for all seeds. This split leaks: most test samples have a \
                 neighbor in\ntraining that is one sampling interval away, so errors are smaller than on new data.",
            ),
        ];
        let names: Vec<&str> = Self::ALL.iter().map(|division| division.name()).collect();
        // None of the names, so that each fits one choice only.
        let pattern = format!("^(?!({})$)[a-z][a-z0-9_]{{0,63}}$", names.join("|"));
        let label = json_schema!({
            "description": "The episodes with one value of this label of an imported dataset.",
            "type": "string", "pattern": pattern,
        });
        let choices: Vec<Schema> = choices.map(choice).into_iter().chain([label]).collect();
        json_schema!({ "description": "The unit that a split divides.", "oneOf": choices })
    }
}

/// What is for the test.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Tested {
    /// A share of what is divided, in (0, 1).
    Share(f64),
    /// The episodes with these values of a label.
    Groups(Vec<Group>),
}

impl Tested {
    /// Returns the share; `None` if groups are named.
    pub fn share(&self) -> Option<f64> {
        match self {
            Self::Share(share) => Some(*share),
            Self::Groups(_) => None,
        }
    }
}

impl From<f64> for Tested {
    fn from(share: f64) -> Self {
        Self::Share(share)
    }
}

impl fmt::Display for Tested {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Share(share) => write!(f, "{share}"),
            Self::Groups(groups) => {
                f.write_str(&groups.iter().map(|group| group.0.as_str()).collect::<Vec<_>>().join(", "))
            }
        }
    }
}

/// A value of a label, as text.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "TextOrNumber")]
pub struct Group(pub String);

#[derive(Deserialize)]
#[serde(untagged)]
enum TextOrNumber {
    Text(String),
    Number(serde_json::Number),
}

impl From<TextOrNumber> for Group {
    fn from(value: TextOrNumber) -> Self {
        match value {
            TextOrNumber::Text(text) => Self(text),
            TextOrNumber::Number(number) => Self(number.to_string()),
        }
    }
}

/// How a dataset is divided into training, validation and test set.
#[derive(Debug, Clone, PartialEq, SmartDefault, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Split {
    /// The unit that is divided.
    pub by: Division,
    /// Share for validation, in (0, 1). It is rounded to whole episodes, groups or samples, and to at least one.
    #[schemars(extend("exclusiveMinimum" = 0.0, "exclusiveMaximum" = 1.0))]
    #[default(0.1)]
    pub validation: f64,
    /// Share for the test, in (0, 1), rounded in the same way, or the values of a label whose episodes are for the test.
    #[schemars(schema_with = "tested_schema")]
    #[default(Tested::Share(0.1))]
    pub test: Tested,
    /// Time that a split by time leaves out between training and validation, and between validation and test, s. The
    /// default is 5. It is taken from the training set.
    #[schemars(range(min = 0.0, max = 3600.0))]
    pub gap_seconds: Option<f64>,
    /// Number of folds of an imported dataset. Each group, or each episode, is for the test in one of them. The folds
    /// are those of scikit-learn's `GroupKFold`. Each has runs of its own, as a dataset of its own has.
    #[schemars(range(min = 2, max = 1000))]
    pub folds: Option<usize>,
    /// The fold that a run tests, counted from 0. The default is a run for each.
    #[schemars(range(max = 999))]
    pub fold: Option<usize>,
    /// Seed of the shuffle in which groups become parts. Episodes that are not shuffled keep their order, the last ones
    /// being for the test.
    #[schemars(range(max = super::simulation::MAX_SEED))]
    pub seed: Option<u64>,
}

/// Numbers of episodes, samples or transitions in each part of a split.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SplitCounts {
    /// Number in the training set.
    pub training: usize,
    /// Number in the validation set.
    pub validation: usize,
    /// Number in the test set.
    pub test: usize,
}

/// A part of a split.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// For training.
    Training,
    /// For validation.
    Validation,
    /// For the test.
    Test,
}

impl Split {
    /// The default gap of a split by time, s: five actuations of the default duration. The autocorrelation of the
    /// finger's angles is 0.19 after 1 s, 0.04 after 2 s and 0.00 after 5 s (cluttered scenario). Samples before and
    /// after the gap therefore have only the positions of the pushed boxes in common.
    pub(crate) const GAP_SECONDS: f64 = 5.0;

    /// Divides `all` episodes or transitions; `None` if none would be left for training. None are for the test if it
    /// has a dataset of its own.
    pub fn counts(&self, all: usize, has_own_test: bool) -> Option<SplitCounts> {
        if !has_own_test {
            return self.divide(all, 0, 1);
        }
        let validation = self.for_validation(all, 1);
        let training = all.checked_sub(validation).filter(|left| *left > 0)?;
        Some(SplitCounts { training, validation, test: 0 })
    }

    /// Splits an episode of `samples` samples by time into the ranges for training, validation and test. Each has at
    /// least `least` samples, the length of a window; `None` if fewer would be left for training.
    pub fn times(&self, samples: usize, least: usize, sample_rate_hz: f64) -> Option<[Range<usize>; 3]> {
        let seconds = self.gap_seconds.unwrap_or(Self::GAP_SECONDS);
        let gap = (seconds * sample_rate_hz - 1e-9).ceil().max(0.0) as usize;
        let SplitCounts { training, validation, test } = self.divide(samples, gap, least)?;
        let (second, third) = (training + gap, samples - test);
        Some([0..training, second..second + validation, third..samples])
    }

    /// Divides `all` items with two gaps of `gap` items between the parts. Each part has at least `least` items.
    fn divide(&self, all: usize, gap: usize, least: usize) -> Option<SplitCounts> {
        let test = ((all as f64 * self.test.share().unwrap_or_default()).round() as usize).max(least);
        let validation = self.for_validation(all, least);
        let training = all.checked_sub(validation + test + 2 * gap).filter(|&n| n >= least)?;
        Some(SplitCounts { training, validation, test })
    }

    fn for_validation(&self, all: usize, least: usize) -> usize {
        ((all as f64 * self.validation).round() as usize).max(least)
    }

    /// Returns this split of a dataset whose own split is `own`: what has its default is that of the dataset.
    pub fn with_defaults_of(&self, own: &Self) -> Self {
        let default = Self::default();
        if self.by != default.by || self.folds.is_some() {
            let seed = self.seed.or(self.by.keeps_episodes().then_some(own.seed).flatten());
            let by = if self.by == default.by && own.by.keeps_episodes() { own.by } else { self.by };
            return Self { by, seed, ..self.clone() };
        }
        Self {
            by: own.by,
            validation: if self.validation == default.validation { own.validation } else { self.validation },
            test: if self.test == default.test { own.test.clone() } else { self.test.clone() },
            gap_seconds: self.gap_seconds.or(own.gap_seconds),
            seed: self.seed.or(own.seed),
            ..self.clone()
        }
    }

    /// Returns how many samples a fold has for the test for each one for training, but for the rounding to whole groups.
    /// `None` without folds.
    pub fn test_to_training(&self) -> Option<f64> {
        let test = 1.0 / self.folds? as f64;
        let training = 1.0 - test - self.validation;
        (training > 0.0).then(|| test / training)
    }

    /// Whether groups are drawn or named, instead of the last episodes being for the test.
    pub fn has_groups(&self) -> bool {
        self.seed.is_some() || self.folds.is_some() || matches!(self.test, Tested::Groups(_))
    }

    /// Divides groups, each with a number of samples. Returns the part of each.
    ///
    /// In folds, the groups of a fold are for the test: the largest group comes into the smallest fold, and so on, as in
    /// scikit-learn's `GroupKFold`. Otherwise, the named groups are, or a share of them in a random order. The rest are
    /// divided between validation and training in a random order.
    ///
    /// # Errors
    /// When a part would have no group, or a named group is not there. Returns the message.
    pub fn parts(&self, groups: &[(&str, usize)]) -> Result<Vec<Part>, String> {
        let names: Vec<&str> = groups.iter().map(|(name, _)| *name).collect();
        let mut order: Vec<usize> = (0..groups.len()).collect();
        let identity = format!("harness split by group: seed {}", self.seed.unwrap_or_default());
        order.shuffle(&mut ChaCha8Rng::from_seed(Sha256::digest(identity).into()));
        let mut parts = vec![Part::Training; groups.len()];
        match (self.folds, &self.test) {
            (Some(folds), _) => {
                if folds > groups.len() {
                    return Err(format!("{folds} folds need as many groups, and there are {}", groups.len()));
                }
                let fold = self.fold.unwrap_or_default();
                let of_groups = folds_of(groups, folds);
                parts
                    .iter_mut()
                    .zip(of_groups)
                    .filter(|(_, own)| *own == fold)
                    .for_each(|(part, _)| *part = Part::Test);
            }
            (None, Tested::Groups(tested)) => {
                for Group(name) in tested {
                    let place = names.iter().position(|own| own == name).ok_or_else(|| {
                        format!(
                            "test: no episode has the {} '{name}'; there are {}",
                            self.by,
                            names.join(", ")
                        )
                    })?;
                    parts[place] = Part::Test;
                }
            }
            (None, Tested::Share(share)) => {
                let count = ((groups.len() as f64 * share).round() as usize).max(1);
                order.iter().rev().take(count).for_each(|place| parts[*place] = Part::Test);
            }
        }
        let left: Vec<usize> = order.into_iter().filter(|place| parts[*place] == Part::Training).collect();
        let count = self.for_validation(groups.len(), 1);
        left.iter().rev().take(count).for_each(|place| parts[*place] = Part::Validation);
        if left.len() <= count {
            return Err(format!(
                "{} groups can't be divided into training, validation and test: {}",
                groups.len(),
                names.join(", ")
            ));
        }
        Ok(parts)
    }
}

/// Returns the fold of each group, as scikit-learn's `GroupKFold` assigns them. Groups of the same size are taken from
/// the last to the first.
fn folds_of(groups: &[(&str, usize)], folds: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..groups.len()).collect();
    order.sort_by_key(|group| groups[*group].1);
    let (mut sizes, mut fold_of) = (vec![0; folds], vec![0; groups.len()]);
    for group in order.into_iter().rev() {
        let smallest = (0..folds).min_by_key(|fold| sizes[*fold]).unwrap_or_default();
        sizes[smallest] += groups[group].1;
        fold_of[group] = smallest;
    }
    fold_of
}

fn tested_schema(_: &mut SchemaGenerator) -> Schema {
    json_schema!({
        "anyOf": [
            { "type": "number", "exclusiveMinimum": 0.0, "exclusiveMaximum": 1.0 },
            {
                "type": "array", "minItems": 1, "uniqueItems": true,
                "items": { "anyOf": [{ "type": "string" }, { "type": "number" }] },
            },
        ],
    })
}
