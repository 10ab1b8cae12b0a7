//! The options that ask a question of results. Commands about results share them.

use super::{DIVIDED, item};
use clap::builder::{PossibleValue, PossibleValuesParser, StyledStr, TypedValueParser};
use clap::error::{ContextKind, ContextValue};
use clap::{Arg, Args, Command};
use harness::analysis::{Horizon, Key, Over, Question, Setting, name_of_given};
use harness::spec::Task;
use std::ffi::OsStr;

/// The option that chooses runs.
#[derive(Args)]
pub struct Where {
    /// Use only runs with this setting, for example training.epochs=200; may be given several times. Several values of
    /// one setting are alternatives
    #[arg(long = "where", value_name = "KEY=VALUE")]
    pub settings: Vec<Setting>,
}

/// A question on the command line.
#[derive(Args)]
pub struct Asked {
    /// Experiments, as `harness ls` names them [default: all]
    #[arg(value_name = "EXPERIMENT")]
    experiments: Vec<String>,
    /// Only the predictions of these modalities, separated by commas, or of the part of one with one unit, for example
    /// "arm in rad" [default: all]
    #[arg(long, value_name = "NAME", value_delimiter = ',', value_parser = item)]
    of: Vec<String>,
    /// The metrics, separated by commas [default: smape,wmape,r2,relative_error]:
    /// - r2, rmse, mae, smape, wmape, relative_error
    /// - relative_error_REGION: only for the pixels of a region, such as finger
    /// - r2_KIND: only for a kind of contact, such as ground
    /// - log_r2, trimmed_r2, f1, auc: of forces, without much weight on the strongest contacts
    /// - crps, coverage_50, coverage_90, width_50, width_90: of the predictive distribution of forces
    /// - crps_PHASE: only for contact, onset, sustained, release or free
    /// - r2_from_Ns: only for the samples after N s
    /// - skill: that over persistence
    /// - skill_horizon: the horizon up to which the skill is positive
    /// - kl: that of the latent state
    /// - active: the number of dimensions of the latent state that are used
    /// - the metrics that you have added to runs, by their names
    #[arg(verbatim_doc_comment, long, value_name = "METRIC", value_delimiter = ',', value_parser = item)]
    metrics: Vec<String>,
    /// The models, separated by commas: network, which stands for all networks and models of other programs, the
    /// baselines persistence, ridge, training_mean and nearest_neighbors, or the name of a model of another program
    /// [default: all in a table, network in a plot]
    #[arg(long, value_name = "MODEL", value_delimiter = ',', value_parser = item)]
    models: Vec<String>,
    /// Only this task [default: both in a table, prediction in a plot]
    #[arg(long, value_parser = named(Task::ALL, Task::name))]
    task: Option<Task>,
    /// How far ahead the predictions are: numbers of samples, as 5, or times, as 0.5s, separated by commas [default:
    /// `window.horizon` of each run's spec, or all horizons if they are a key of the answer]
    #[arg(long, value_name = "N", value_delimiter = ',', value_parser = |text: &str| item(text)?.parse::<Horizon>())]
    horizon: Vec<Horizon>,
    /// The modalities that the models got, joined by +, of models that got only some of their run's inputs
    #[arg(long, value_name = "NAME")]
    given: Option<String>,
    /// The keys that distinguish the columns of a table or the series of a plot, separated by commas: those below,
    /// settings, such as input or network.hidden, or axes, such as senses. All other keys distinguish rows or tables
    /// [default of a table: latent, or variant if the runs of one experiment have several variants and one latent size]
    #[arg(long, value_name = "KEY", value_delimiter = ',', value_parser = key())]
    by: Vec<Key>,
    /// Show how much the other columns differ from the column with this heading. Differences are paired: they are those
    /// of runs with the same dataset and seed, or with the same dataset if the column is a baseline. Those with p < 0.05
    /// are marked, where p is corrected for the number of differences by Holm's method
    #[arg(long, value_name = "COLUMN")]
    against: Option<String>,
    /// What the intervals are to contain: the mean over all datasets and seeds, or the value on one more dataset
    #[arg(
        long,
        value_name = "OVER",
        value_parser = named(Over::ALL, Over::name),
        default_value = Over::Mean.name()
    )]
    interval: Over,
    #[command(flatten)]
    runs: Where,
}

impl Asked {
    /// The question.
    pub fn question(self) -> Question {
        Question {
            experiments: self.experiments,
            settings: self.runs.settings,
            task: self.task,
            of: self.of,
            metrics: self.metrics,
            models: self.models,
            horizons: self.horizon,
            given: self.given.as_deref().map(name_of_given),
            by: self.by,
            against: self.against,
            over: self.interval,
        }
    }
}

/// A parser for the names of some values, whose error lists all names.
fn named<T: Copy + Send + Sync + 'static>(
    all: impl AsRef<[T]>,
    name: fn(T) -> &'static str,
) -> impl TypedValueParser<Value = T> {
    let all = all.as_ref().to_vec();
    PossibleValuesParser::new(all.iter().map(|one| name(*one)).collect::<Vec<_>>())
        .try_map(move |text| all.iter().copied().find(|one| name(*one) == text).ok_or("no such name"))
}

/// A parser for names of keys, whose error lists them, and for the keys of settings.
pub fn key() -> impl TypedValueParser<Value = Key> {
    KeyParser
}

#[derive(Clone)]
struct KeyParser;

fn keys() -> impl Iterator<Item = PossibleValue> {
    Key::ALL.iter().map(|key| PossibleValue::new(key.name()).help(key.meaning()))
}

impl TypedValueParser for KeyParser {
    type Value = Key;

    fn parse_ref(&self, command: &Command, arg: Option<&Arg>, value: &OsStr) -> Result<Key, clap::Error> {
        let key = value.to_str().and_then(|text| text.parse::<Key>().ok());
        let named = PossibleValuesParser::new(keys()).try_map(|name| name.parse());
        if let Some(key) = key.filter(|key| key.setting().is_some()) {
            return Ok(key);
        }
        named.parse_ref(command, arg, value).map_err(|mut error| {
            let of_settings =
                "settings and axes of a spec are possible too, such as input, network.hidden or senses";
            let hint = StyledStr::from(if value.is_empty() { DIVIDED } else { of_settings });
            error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![hint]));
            error
        })
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new(keys()))
    }
}
