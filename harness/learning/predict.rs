//! Applies trained networks to the samples of a dataset, with results in physical units.

use super::LearningError;
use super::network::{Decoded, Decoder, Encoder};
use super::objective::{NormalizedData, rows};
use candle_core::{Result, Tensor};
use harness_judge::{BATCH, JudgeError, Predicted, Predictor, Receive, models};
use harness_samples::{Normalizers, Sample};
use harness_spec::{IMAGE_CHANNELS, Layout, Modality};

/// Returns the posterior's mean at every sample in `at`, `[at, latent]`.
pub fn encode(
    data: &NormalizedData,
    encoder: &dyn Encoder,
    input: &[Modality],
    at: &[Sample],
) -> Result<Tensor> {
    let encoder = encoder.detached();
    let means = at.chunks(BATCH).map(|at| encoder.encode(&data.observation(at, input)?)?.mean());
    Tensor::cat(&means.collect::<Result<Vec<_>>>()?, 0)?.contiguous()
}

/// The latent states from which a network decodes.
pub enum Latent<'a> {
    /// Those of an encoder with these modalities as input. The decoder gets the action and predicts the next sample.
    Encoded(&'a dyn Encoder, &'a [Modality]),
    /// One for each sample of the dataset, `[samples, latent]`. The decoder reconstructs the present sample.
    Known(&'a Tensor),
}

/// A trained network.
pub struct TrainedNetwork<'a> {
    /// The dataset.
    pub data: &'a NormalizedData,
    /// The latent states.
    pub latent: Latent<'a>,
    /// Maps latent states to samples.
    pub decoder: Box<dyn Decoder>,
    /// The modalities that it decodes.
    pub output: &'a [Modality],
}

/// A modality and its values at some windows.
type ValuesOf = (Modality, Vec<f32>);

impl TrainedNetwork<'_> {
    /// Returns the output at the windows `at`, and its distance from the present.
    fn decoded(&self, at: &[Sample]) -> Result<(usize, Vec<ValuesOf>)> {
        let data = self.data;
        let (horizon, decoded) = match self.latent {
            Latent::Encoded(encoder, input) => {
                let latent = encode(data, encoder, input, at)?;
                (1, self.decoder.decode(&latent, Some(&data.actions(at)?))?)
            }
            Latent::Known(latent) => (0, self.decoder.decode(&rows(latent, at)?, None)?),
        };
        Ok((horizon, denormalized(&data.normalizers, data.samples.layout(), self.output, decoded)?))
    }
}

impl Predictor for TrainedNetwork<'_> {
    fn name(&self) -> &str {
        models::NETWORK
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> std::result::Result<(), JudgeError> {
        let failed = |error| JudgeError::Predictor(Box::new(LearningError::from(error)));
        let (horizon, decoded) = self.decoded(at).map_err(failed)?;
        decoded
            .into_iter()
            .try_for_each(|(modality, values)| receive(Predicted { modality, horizon, values }))
    }
}

/// Converts a decoder's output to physical units. Returns the values of each modality in `output`, `[batch, width]`;
/// frames channel by channel.
pub fn denormalized(
    normalizers: &Normalizers,
    layout: &Layout,
    output: &[Modality],
    Decoded { vector, frames }: Decoded,
) -> Result<Vec<(Modality, Vec<f32>)>> {
    let (mut column, mut channel) = (0, 0);
    let mut denormalized = Vec::with_capacity(output.len());
    for modality in output.iter().copied() {
        let definition = &layout[modality];
        let values = if definition.is_image() {
            channel += IMAGE_CHANNELS;
            part(&frames, channel - IMAGE_CHANNELS, IMAGE_CHANNELS)?
        } else {
            let width = definition.width();
            column += width;
            part(&vector, column - width, width)?
        };
        let mut values = values.flatten_all()?.to_vec1()?;
        normalizers.modalities[&modality].denormalize(&mut values);
        denormalized.push((modality, values));
    }
    Ok(denormalized)
}

/// Returns `len` columns or channels of a decoder's output, starting at `start`.
fn part(output: &Option<Tensor>, start: usize, len: usize) -> Result<Tensor> {
    match output {
        Some(output) => output.narrow(1, start, len)?.contiguous(),
        None => candle_core::bail!("the decoder has no output for a modality of its experiment's output"),
    }
}
