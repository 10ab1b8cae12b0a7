//! The baseline that predicts the present sample.

use super::{JudgeError, Predicted, Predictor, Receive, models};
use harness_metrics::baselines::persistence;
use harness_samples::{Sample, Samples, physical};
use harness_spec::Modality;

/// Predicts that later samples equal the present one, and that no image changes.
pub struct Persistence<'a> {
    /// The dataset.
    pub samples: &'a Samples,
    /// The predicted modality.
    pub modality: Modality,
    /// Numbers of samples after the present one that are predicted.
    pub horizons: &'a [usize],
}

impl Predictor for Persistence<'_> {
    fn name(&self) -> &str {
        models::PERSISTENCE
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> Result<(), JudgeError> {
        let now = physical(self.samples, self.modality, at);
        let values = persistence(&self.samples.layout()[self.modality], &now).into_owned();
        let mut predicted = Predicted { modality: self.modality, horizon: 0, values, ensemble: None };
        self.horizons.iter().try_for_each(|&horizon| {
            predicted.horizon = horizon;
            receive(&predicted)
        })
    }
}
