//! Which experiments the paper's figures show.

use super::source::{Experiments, Source};
use harness_analysis::{Analysis, AnalysisError, Selection, Setting};
use harness_registry::Registry;
use harness_spec::{Experiment, SpecError, load};
use std::path::Path;

/// The experiments that the paper's figures show.
#[derive(Debug, Clone, Default)]
pub struct Shown {
    /// Whether the quick runs are shown.
    pub quick: bool,
    /// The experiment that is shown instead of `single_to_multi`.
    pub single: Option<String>,
    /// The experiment that is shown instead of `multi_to_multi`.
    pub multi: Option<String>,
    /// The reading that is shown instead of both.
    pub reading: Option<OfReading>,
}

/// A reading of an experiment: `paper/recommended`.
#[derive(Debug, Clone)]
pub struct OfReading {
    spec: Experiment,
    reading: String,
}

/// Why a reading can't be shown.
#[derive(Debug, thiserror::Error)]
pub enum ReadingError {
    /// The text does not name an experiment and a reading.
    #[error("'{0}' names no reading; write EXPERIMENT/READING, for example paper/recommended")]
    Form(String),
    /// The experiment's spec can't be read.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The experiment has no readings.
    #[error("{0} has no readings; name an experiment that has, such as paper")]
    NoReadings(String),
    /// The experiment has no such reading.
    #[error("{experiment} has no reading '{wanted}'; its readings are {}", there.join(", "))]
    Unknown {
        /// The experiment's name.
        experiment: String,
        /// The wanted reading.
        wanted: String,
        /// The names of the experiment's readings.
        there: Vec<String>,
    },
}

impl OfReading {
    /// Reads the spec of a reading that `text` names as `EXPERIMENT/READING`. With `quick`, it is about the quick runs.
    ///
    /// # Errors
    /// When `text` has another form, the spec can't be read, or it has no such reading.
    pub fn load(text: &str, quick: bool) -> Result<Self, ReadingError> {
        let named =
            text.rsplit_once('/').filter(|(experiment, wanted)| !experiment.is_empty() && !wanted.is_empty());
        let (experiment, wanted) = named.ok_or_else(|| ReadingError::Form(text.to_owned()))?;
        let spec = load(Path::new(experiment), &[], quick)?;
        if spec.readings.is_empty() {
            return Err(ReadingError::NoReadings(experiment.to_owned()));
        }
        let there: Vec<String> = spec.names_of_readings().into_iter().map(str::to_owned).collect();
        if !there.iter().any(|name| name == wanted) {
            let (experiment, wanted) = (experiment.to_owned(), wanted.to_owned());
            return Err(ReadingError::Unknown { experiment, wanted, there });
        }
        Ok(Self { spec, reading: wanted.to_owned() })
    }
}

impl Shown {
    /// Finds the finished runs that the figures show.
    ///
    /// # Errors
    /// When no run has one of the settings, or its value.
    pub fn analysis(&self, registry: &Registry, settings: &[Setting]) -> Result<Analysis, AnalysisError> {
        let standing = self.reading.iter().flat_map(|of| of.spec.experiments_of_readings());
        let experiments: Vec<String> = self.experiments().all().into_iter().chain(standing).collect();
        let (settings, trained) = (settings.to_vec(), experiments.clone());
        Analysis::new(registry, &Selection { experiments, settings, simulated: true, trained })
    }

    /// The source of the figures, of the runs that [`Self::analysis`] found.
    pub fn source<'a>(&'a self, analysis: &'a Analysis) -> Source<'a> {
        let reading = self.reading.as_ref().map(|of| (&of.spec, of.reading.as_str()));
        Source::new(analysis, self.experiments()).under(reading)
    }

    fn experiments(&self) -> Experiments {
        let paper = Experiments::of_the_paper(self.quick);
        let of_reading = self.reading.as_ref().map(|of| &of.spec.name);
        let instead =
            |own: &Option<String>, usual: String| of_reading.or(own.as_ref()).cloned().unwrap_or(usual);
        Experiments {
            single_to_multi: instead(&self.single, paper.single_to_multi.clone()),
            multi_to_multi: instead(&self.multi, paper.multi_to_multi.clone()),
            ..paper
        }
    }
}
