//! A baseline that always predicts zero.

use harness_judge::{JudgeError, Predicted, Predictor, Receive};
use harness_samples::Sample;
use harness_spec::Modality;

/// Predicts zero for one modality of this width, at several horizons.
pub struct Zero(pub Modality, pub usize, pub Vec<usize>);

impl Predictor for Zero {
    fn name(&self) -> &str {
        "zero"
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> Result<(), JudgeError> {
        let Self(modality, width, horizons) = self;
        let predicted = |horizon: &usize| Predicted {
            modality: *modality,
            horizon: *horizon,
            values: vec![0.0; at.len() * width],
            ensemble: None,
        };
        horizons.iter().try_for_each(|horizon| receive(&predicted(horizon)))
    }
}
