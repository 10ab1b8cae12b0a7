//! A fusion of two encoders: the product of their distributions.

use candle_core::Result;
use harness_learning::network::description::Layer;
use harness_learning::network::{Encoder, Observation, Posterior};
use harness_ops::Dropout;

/// Multiplies the Gaussian distributions of two encoders: their precisions are added.
pub struct Product(pub Box<dyn Encoder>, pub Box<dyn Encoder>);

impl Encoder for Product {
    fn encode_with_dropout(&self, observation: &Observation, dropout: Option<Dropout>) -> Result<Posterior> {
        let [one, other] =
            [&self.0, &self.1].map(|encoder| encoder.encode_with_dropout(observation, dropout));
        let (one, other) = (one?, other?);
        let precision = |posterior: &Posterior| posterior.log_variance()?.neg()?.exp();
        let (of_one, of_other) = (precision(&one)?, precision(&other)?);
        let precision = (&of_one + &of_other)?;
        let mean = (((one.mean()? * of_one)? + (other.mean()? * of_other)?)? / &precision)?;
        Posterior::new(&mean, &precision.log()?.neg()?)
    }

    fn detached(&self) -> Box<dyn Encoder> {
        Box::new(Self(self.0.detached(), self.1.detached()))
    }

    fn layers(&self) -> Result<Vec<Layer>> {
        Ok([self.0.layers()?, self.1.layers()?].concat())
    }
}
