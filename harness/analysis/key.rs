//! The keys by which means are told apart.

use super::settings::OF_RUNS;
use harness_spec::{intern, is_axis, varied_setting};
use std::str::FromStr;

/// A key by which means are told apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Key {
    /// The experiment.
    Experiment,
    /// The scenario or imported dataset.
    Scenario,
    /// The size of the latent state.
    Latent,
    /// The settings that an experiment varies.
    Variant,
    /// The other settings in which the runs of an experiment differ.
    Settings,
    /// The number of samples from the present to the predicted one.
    Horizon,
    /// The inputs that the model got.
    Given,
    /// The task.
    Task,
    /// The predicted modality.
    Modality,
    /// The metric.
    Metric,
    /// One setting of a spec, such as `input`, by its dotted key, or an axis of a spec with labels, by its name.
    Setting(&'static str),
}

impl FromStr for Key {
    type Err = String;

    /// Reads the name of a key, the key of a setting, or what may be the name of an axis. A setting can be given without
    /// its section, as in the column `variant`, if no other setting has the same name.
    fn from_str(text: &str) -> Result<Self, String> {
        if text == "seed" {
            return Err(
                "means are over the seeds of the training; simulation.seed tells datasets apart".into()
            );
        }
        let named = Self::ALL.into_iter().find(|key| key.name() == text);
        let of_runs = || OF_RUNS.into_iter().find(|key| *key == text).map(Self::Setting);
        let setting = || Some(Self::Setting(intern(&varied_setting(text)?)));
        let axis = || is_axis(text).then(|| Self::Setting(intern(text)));
        named.or_else(of_runs).or_else(setting).or_else(axis).ok_or_else(|| {
            let allowed = Self::ALL.map(Self::name).join(", ");
            format!(
                "there is no key '{text}'; allowed: {allowed}, or a setting, such as input or network.hidden"
            )
        })
    }
}

impl Key {
    /// All keys except settings.
    pub const ALL: [Key; 10] = {
        use Key::*;
        [Experiment, Scenario, Latent, Variant, Settings, Horizon, Given, Task, Modality, Metric]
    };

    /// The key's name on the command line, and in tables.
    pub fn name(self) -> &'static str {
        match self {
            Key::Experiment => "experiment",
            Key::Scenario => "scenario",
            Key::Latent => "latent",
            Key::Variant => "variant",
            Key::Settings => "settings",
            Key::Horizon => "horizon",
            Key::Given => "given",
            Key::Task => "task",
            Key::Modality => "modality",
            Key::Metric => "metric",
            Key::Setting(key) => key,
        }
    }

    /// The dotted key of the setting, if the key is one.
    pub fn setting(self) -> Option<&'static str> {
        match self {
            Key::Setting(key) => Some(key),
            _ => None,
        }
    }

    /// What the key is, in a few words for people.
    pub fn meaning(self) -> &'static str {
        match self {
            Key::Experiment => "The experiment",
            Key::Scenario => "The scenario or imported dataset",
            Key::Latent => "The size of the latent state",
            Key::Variant => "The settings that an experiment varies",
            Key::Settings => "The other settings in which the runs of an experiment differ",
            Key::Horizon => "The number of samples from the present to the predicted one",
            Key::Given => "The inputs that the model got, if it was also tested with some of them",
            Key::Task => "Prediction or reconstruction",
            Key::Modality => "The predicted modality",
            Key::Metric => "The metric",
            Key::Setting(_) => "A setting or an axis of a spec",
        }
    }
}
