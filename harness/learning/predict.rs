//! Applies trained networks to chosen transitions, with results in physical units.

use super::network::{Decoded, Decoder, Encoder};
use super::objective::{NormalizedData, rows};
use crate::Normalizers;
use candle_core::{Result, Tensor};
use harness_spec::{IMAGE_CHANNELS, Layout, Modality};

/// Number of transitions that are decoded at once. It limits the memory for frames.
const BATCH: usize = 256;

/// Returns the posterior's mean of every transition in `at`, `[transitions, latent]`.
pub fn encode(
    data: &NormalizedData,
    encoder: &dyn Encoder,
    input: &[Modality],
    at: &[usize],
) -> Result<Tensor> {
    let encoder = encoder.detached();
    let means = at.chunks(BATCH).map(|at| encoder.encode(&data.observation(at, input)?)?.mean());
    Tensor::cat(&means.collect::<Result<Vec<_>>>()?, 0)?.contiguous()
}

/// The predictions of one output modality for a batch.
pub struct Predicted<'a> {
    /// The output modality.
    pub modality: Modality,
    /// The predicted transitions, given by their first samples.
    pub at: &'a [usize],
    /// Predicted values in physical units, `[batch, width]`; frames channel by channel.
    pub values: Vec<f32>,
}

/// Decodes the rows of `latent`, one for each transition in `at`. Calls `each` with every output modality of every
/// batch, in order. The decoder gets the action if `acting`.
pub fn decode(
    data: &NormalizedData,
    decoder: &dyn Decoder,
    output: &[Modality],
    acting: bool,
    latent: &Tensor,
    at: &[usize],
    mut each: impl FnMut(Predicted),
) -> Result<()> {
    let decoder = decoder.detached();
    for (index, at) in at.chunks(BATCH).enumerate() {
        let places: Vec<usize> = (index * BATCH..index * BATCH + at.len()).collect();
        let action = acting.then(|| data.actions(at)).transpose()?;
        let decoded = decoder.decode(&rows(latent, &places)?, action.as_ref())?;
        for (modality, values) in denormalized(&data.normalizers, data.samples.layout(), output, decoded)? {
            each(Predicted { modality, at, values });
        }
    }
    Ok(())
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
