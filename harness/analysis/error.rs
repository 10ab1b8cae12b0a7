//! Why results can't be computed from runs.

use super::settings::{Difference, Setting};
use harness_catalog::QueryError;
use harness_shared::nearest;

/// An error in selecting runs, or in computing results from them.
#[derive(Debug, thiserror::Error)]
pub enum AnalysisError {
    /// An experiment has no finished runs.
    #[error("'{wanted}' has no finished runs; {}", finished(wanted, there))]
    NothingFinished {
        /// The name of the experiment.
        wanted: String,
        /// The names of the experiments that have finished runs.
        there: Vec<String>,
    },
    /// All finished runs of an experiment are in a version of their world that does not count.
    #[error(
        "the finished runs of '{experiment}' that were chosen are in another version of the world {world} than the \
         one that counts; run the experiment again, or select the version with --where {experiment}:world={version}"
    )]
    Outdated {
        /// The name of the experiment.
        experiment: String,
        /// The name of the world.
        world: String,
        /// The version of one of the runs.
        version: String,
    },
    /// No finished run of an experiment has the requested settings.
    #[error(
        "no finished run of '{experiment}' has {}; its finished runs have {}",
        wanted.iter().map(Setting::to_string).collect::<Vec<_>>().join(" and "), listed(there)
    )]
    NothingChosen {
        /// The name of the experiment.
        experiment: String,
        /// The requested settings.
        wanted: Vec<Setting>,
        /// The values that its finished runs have for these settings.
        there: Vec<Difference>,
    },
    /// The runs have no answer to the question. The text is the message.
    #[error("{0}")]
    Unanswerable(String),
    /// No run predicts a modality. The text is the message.
    #[error("{0}")]
    UnknownModality(String),
    /// There are no finished runs. The field is a command that makes some.
    #[error("there are no finished runs to compare; `{0}` makes some")]
    Nothing(String),
    /// No run has the requested metrics. The text is the message.
    #[error("{0}")]
    NoMeans(String),
    /// The runs of an experiment differ in settings that must be equal.
    #[error(transparent)]
    Mixed(#[from] Mixed),
    /// A query failed, or a table is damaged.
    #[error(transparent)]
    Query(#[from] QueryError),
}

/// Says which experiments have finished runs, and which of them was probably meant. If `wanted` is the path of a spec,
/// its experiment may be one of them.
pub fn finished(wanted: &str, there: &[String]) -> String {
    if there.is_empty() {
        return "no experiment in this folder has any; `harness ls` says which runs failed or are running"
            .to_owned();
    }
    let names = there.join(", ");
    let name = wanted.strip_suffix(".yaml").and_then(|path| path.rsplit('/').next());
    let there: Vec<&str> = there.iter().map(String::as_str).collect();
    match nearest(name.unwrap_or(wanted), &there) {
        Some(name) => format!("did you mean '{name}'? Those that have: {names}"),
        None => format!("those that have: {names}"),
    }
}

/// The runs of an experiment differ in settings that must be equal for a common result.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "the runs of {experiment} differ in {}; select some, for example with {}",
    listed(differences),
    options(choice)
)]
pub struct Mixed {
    /// The name of the experiment.
    pub experiment: String,
    /// The settings in which the runs differ.
    pub differences: Vec<Difference>,
    /// Settings that select runs which do not differ. They are the values that most runs have.
    pub choice: Vec<Setting>,
}

fn listed(differences: &[Difference]) -> String {
    differences.iter().map(Difference::to_string).collect::<Vec<_>>().join(" and ")
}

fn options(choice: &[Setting]) -> String {
    format!("`{}`", choice.iter().map(Setting::option).collect::<Vec<_>>().join(" "))
}
