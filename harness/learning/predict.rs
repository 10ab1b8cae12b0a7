//! Applies trained networks to the samples of a dataset, with results in physical units.

use super::LearningError;
use super::data::NormalizedData;
use super::network::{Decoded, Decoder, Draw, Network, State, context};
use candle_core::{Result, Tensor};
use harness_judge::{BATCH, JudgeError, Predicted, Predictor, Receive, models};
use harness_samples::{Normalizers, Sample, after, before};
use harness_spec::{Modality, Window};

/// Returns the state of a network that has seen the windows until the present samples `at`.
///
/// # Errors
/// Those of the network.
fn present(
    network: &dyn Network,
    data: &NormalizedData,
    input: &[Modality],
    window: Window,
    at: &[Sample],
) -> Result<State> {
    let mut state = network.start(at.len(), &data.device)?;
    let mut distance = context(state.as_ref(), window) - 1;
    loop {
        let now = before(at, distance);
        let observation = data.observation(&now, input)?;
        let seen = network.observe(state.as_ref(), &observation, &mut Draw::Mean)?.state;
        if distance == 0 {
            return Ok(seen);
        }
        state = Some(network.act(&seen, &data.actions(&now)?)?);
        distance -= 1;
    }
}

/// The latent states of a network at all samples that have a whole context before them.
pub struct Latents {
    /// The samples, in their order.
    at: Vec<Sample>,
    /// The latent state of each, `[samples, latent]`.
    values: Tensor,
}

impl Latents {
    /// Computes the latent states, which are means of posteriors.
    ///
    /// # Errors
    /// Those of the network.
    pub fn of(
        network: &dyn Network,
        data: &NormalizedData,
        input: &[Modality],
        window: Window,
    ) -> Result<Self> {
        let network = network.detached();
        let at = data.samples.windows(Window { horizon: 0, ..window });
        let latents = at.chunks(BATCH).map(|at| Ok(present(&*network, data, input, window, at)?.latent));
        let values = Tensor::cat(&latents.collect::<Result<Vec<_>>>()?, 0)?.contiguous()?;
        Ok(Self { at, values })
    }

    /// Returns the latent states at these samples, `[at, latent]`.
    ///
    /// # Errors
    /// When a sample has no whole context before it.
    pub fn rows(&self, at: &[Sample]) -> Result<Tensor> {
        let row = |sample: &Sample| match self.at.binary_search(sample) {
            Ok(row) => Ok(row as u32),
            Err(_) => candle_core::bail!("sample {} has no latent state", sample.index()),
        };
        let rows = at.iter().map(row).collect::<Result<Vec<_>>>()?;
        self.values.index_select(&Tensor::new(rows, self.values.device())?, 0)
    }
}

/// Turns an error of a network into one of a predictor.
fn failed(error: candle_core::Error) -> JudgeError {
    JudgeError::Predictor(Box::new(LearningError::from(error)))
}

/// A trained network, which predicts the window's samples after the present one.
pub struct TrainedNetwork<'a> {
    /// The dataset.
    pub data: &'a NormalizedData,
    /// The network, without gradients.
    pub network: Box<dyn Network>,
    /// The modalities that it sees.
    pub input: &'a [Modality],
    /// The modalities that it predicts.
    pub output: &'a [Modality],
    /// How many samples it sees and predicts.
    pub window: Window,
}

impl Predictor for TrainedNetwork<'_> {
    fn name(&self) -> &str {
        models::NETWORK
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> std::result::Result<(), JudgeError> {
        let Self { data, network, input, window, .. } = self;
        let mut state = present(&**network, data, input, *window, at).map_err(failed)?;
        let horizons = window.horizons();
        for horizon in 1..=window.horizon {
            let now = after(at, horizon - 1);
            let next = || network.act(&state, &data.actions(&now)?);
            state = next().map_err(failed)?;
            if !horizons.contains(&horizon) {
                continue;
            }
            let decoded = network.decode(&state).map_err(failed)?;
            pass_on(&data.normalizers, self.output, decoded, horizon, receive)?;
        }
        Ok(())
    }
}

/// A decoder that reconstructs the present sample from the latent state of a frozen network.
pub struct TrainedDecoder<'a> {
    /// The dataset.
    pub data: &'a NormalizedData,
    /// The latent states.
    pub latents: &'a Latents,
    /// The decoder, without gradients.
    pub decoder: Box<dyn Decoder>,
    /// The modalities that it reconstructs.
    pub output: &'a [Modality],
}

impl Predictor for TrainedDecoder<'_> {
    fn name(&self) -> &str {
        models::NETWORK
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> std::result::Result<(), JudgeError> {
        let decoded = self.latents.rows(at).and_then(|latent| self.decoder.decode(&latent, None));
        pass_on(&self.data.normalizers, self.output, decoded.map_err(failed)?, 0, receive)
    }
}

/// Passes each decoded modality to `receive`, in physical units.
fn pass_on(
    normalizers: &Normalizers,
    output: &[Modality],
    decoded: Decoded,
    horizon: usize,
    receive: &mut Receive,
) -> std::result::Result<(), JudgeError> {
    let decoded = denormalized(normalizers, output, &decoded).map_err(failed)?;
    decoded.into_iter().try_for_each(|(modality, values)| receive(&Predicted { modality, horizon, values }))
}

/// Returns the values of each modality in `output` in physical units, `[batch, width]`; images channel by channel.
///
/// # Errors
/// When the decoder has no such output.
pub fn denormalized(
    normalizers: &Normalizers,
    output: &[Modality],
    decoded: &Decoded,
) -> Result<Vec<(Modality, Vec<f32>)>> {
    let physical = |modality: &Modality| {
        let Some(values) = decoded.get(modality) else {
            candle_core::bail!("the decoder has no output for '{modality}'");
        };
        let mut values = values.flatten_all()?.to_vec1()?;
        normalizers.modalities[modality].denormalize(&mut values);
        Ok((*modality, values))
    };
    output.iter().map(physical).collect()
}
