//! The keys by which means are told apart.

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
    /// The task.
    Task,
    /// The predicted modality.
    Modality,
}

impl Key {
    /// All keys, those of runs first.
    pub const ALL: [Key; 7] = {
        use Key::*;
        [Experiment, Scenario, Latent, Variant, Settings, Task, Modality]
    };

    /// The keys of runs: all but those of what a run predicts.
    pub const OF_RUNS: [Key; 5] = *Self::ALL.first_chunk().unwrap();

    /// The key's name on the command line, and in tables.
    pub fn name(self) -> &'static str {
        match self {
            Key::Experiment => "experiment",
            Key::Scenario => "scenario",
            Key::Latent => "latent",
            Key::Variant => "variant",
            Key::Settings => "settings",
            Key::Task => "task",
            Key::Modality => "modality",
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
            Key::Task => "Prediction or reconstruction",
            Key::Modality => "The predicted modality",
        }
    }
}
