//! Which experiments the paper's figures show.

use super::reading::OfReading;
use super::source::{Experiments, Source};
use harness_analysis::{Analysis, AnalysisError, Selection, Setting};
use harness_registry::Registry;
use harness_spec::{SpecError, load};
use std::path::Path;

/// The spec whose last reading is shown if there are no runs of the paper's experiments.
const REPRODUCTION: &str = "reproduction";

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
    /// The same or, if nothing is asked for, with the last reading of the spec `reproduction`. The results folder must have
    /// runs of that spec, and none of the paper's experiments.
    ///
    /// # Errors
    /// When the spec `reproduction` can't be read.
    pub fn or_reproduction(self, registry: &Registry) -> Result<Self, SpecError> {
        let is_asked = self.single.is_some() || self.multi.is_some() || self.reading.is_some();
        if is_asked || self.experiments().names().iter().any(|name| registry.has_runs(name)) {
            return Ok(self);
        }
        let spec = load(Path::new(REPRODUCTION), &[], self.quick)?;
        let has_runs = registry.has_runs(&spec.name);
        Ok(Self { reading: OfReading::last_of(spec).filter(|_| has_runs), ..self })
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
        match &self.reading {
            Some(reading) => paper.replaced_by(reading.experiment()),
            None => Experiments {
                single_to_multi: self.single.clone().unwrap_or(paper.single_to_multi),
                multi_to_multi: self.multi.clone().unwrap_or(paper.multi_to_multi),
                ..paper
            },
        }
    }
}
