//! The baseline that predicts the mean of the training samples.

use super::{BATCH, JudgeError, Predicted, Predictor, Receive, models};
use harness_metrics::baselines;
use harness_samples::{Sample, Samples, after, physical};
use harness_spec::Modality;

/// Predicts the mean of the samples that training windows predict.
pub struct TrainingMean {
    modality: Modality,
    horizon: usize,
    mean: baselines::TrainingMean,
}

impl TrainingMean {
    /// Computes the mean of a modality, `horizon` samples after the present samples in `training`.
    ///
    /// # Errors
    /// When a value is not finite.
    pub fn fit(
        samples: &Samples,
        training: &[Sample],
        modality: Modality,
        horizon: usize,
    ) -> Result<Self, JudgeError> {
        let mut mean = baselines::TrainingMean::new(samples.layout()[modality].width());
        for at in training.chunks(BATCH) {
            mean.add(&physical(samples, modality, &after(at, horizon)))?;
        }
        Ok(Self { modality, horizon, mean })
    }
}

impl Predictor for TrainingMean {
    fn name(&self) -> &str {
        models::TRAINING_MEAN
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> Result<(), JudgeError> {
        let values = self.mean.predict(at.len())?;
        receive(&Predicted { modality: self.modality, horizon: self.horizon, values, ensemble: None })
    }
}
