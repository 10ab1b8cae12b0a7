//! A fusion of two encoders: the mean of their parameters.

use candle_core::Result;
use harness_learning::network::description::Layer;
use harness_learning::network::{Encoder, Observation, Posterior};
use harness_ops::Dropout;

/// Averages the means and the log-variances of two encoders.
pub struct MeanOfBoth(pub Box<dyn Encoder>, pub Box<dyn Encoder>);

impl Encoder for MeanOfBoth {
    fn encode_with_dropout(&self, observation: &Observation, dropout: Option<Dropout>) -> Result<Posterior> {
        let [one, other] =
            [&self.0, &self.1].map(|encoder| encoder.encode_with_dropout(observation, dropout));
        let (one, other) = (one?, other?);
        let mean = ((one.mean()? + other.mean()?)? / 2.0)?;
        Posterior::new(&mean, &((one.log_variance()? + other.log_variance()?)? / 2.0)?)
    }

    fn detached(&self) -> Box<dyn Encoder> {
        Box::new(Self(self.0.detached(), self.1.detached()))
    }

    fn layers(&self) -> Result<Vec<Layer>> {
        Ok([self.0.layers()?, self.1.layers()?].concat())
    }
}
