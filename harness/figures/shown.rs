//! Which experiments the paper's figures show.

use super::reading::OfReading;
use super::source::{Experiments, Source};
use harness_analysis::{Analysis, AnalysisError, Selection, Setting};
use harness_registry::Registry;
use harness_spec::SpecError;

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

impl Shown {
    /// The same, with the reading that [`OfReading::instead_of`] names if no experiment is asked for.
    ///
    /// # Errors
    /// When the spec of the reading can't be read.
    pub fn or_reproduction(self, registry: &Registry) -> Result<Self, SpecError> {
        match (&self.single, &self.multi, &self.reading) {
            (None, None, None) => {
                let paper = Experiments::of_the_paper(self.quick).names();
                let reading = OfReading::instead_of(&paper, registry, self.quick)?;
                Ok(Self { reading, ..self })
            }
            _ => Ok(self),
        }
    }

    /// Finds the finished runs that the figures show.
    ///
    /// # Errors
    /// When no run has one of the settings, or its value.
    pub fn analysis(&self, registry: &Registry, settings: &[Setting]) -> Result<Analysis, AnalysisError> {
        let experiments = self.experiments().all();
        let (settings, trained) = (settings.to_vec(), experiments.clone());
        Analysis::new(registry, &Selection { experiments, settings, simulated: true, trained })
    }

    /// The source of the figures, of the runs that [`Self::analysis`] found.
    pub fn source<'a>(&'a self, analysis: &'a Analysis) -> Source<'a> {
        Source::new(analysis, self.experiments()).under(self.reading.as_ref())
    }

    fn experiments(&self) -> Experiments {
        let paper = Experiments::of_the_paper(self.quick);
        let of_reading = self.reading.as_ref().map(OfReading::experiment);
        let instead =
            |own: &Option<String>, usual: String| of_reading.or(own.as_deref()).map_or(usual, str::to_owned);
        Experiments {
            single_to_multi: instead(&self.single, paper.single_to_multi.clone()),
            multi_to_multi: instead(&self.multi, paper.multi_to_multi.clone()),
            ..paper
        }
    }
}
