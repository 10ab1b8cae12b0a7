//! Trained networks at work on chosen transitions, in physical units.

use super::network::{Decoded, Decoder, Encoder};
use super::objective::{NormalizedData, rows};
use crate::Normalizers;
use candle_core::{Result, Tensor};
use harness_spec::{IMAGE_CHANNELS, Layout, Modality};

/// Transitions decoded at once; bounds the memory that frames take.
const BATCH: usize = 256;

/// The posterior's mean for every transition in `at`, `[at, latent]`.
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

/// One output modality of a batch: `[batch, width]` in physical units, frames channel by channel.
pub struct Predicted<'a> {
    pub modality: Modality,
    /// The transitions that are predicted.
    pub at: &'a [usize],
    pub values: Vec<f32>,
}

/// Decodes the rows of `latent` (one a transition in `at`) and hands each output modality to `each`, batch by
/// batch and in order. The decoder is told the action if `acting`.
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

/// A decoder's output by modality, in physical units: `[batch, width]` each, frames channel by channel.
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

/// `len` columns or channels of a decoder's output, from `start` on.
fn part(output: &Option<Tensor>, start: usize, len: usize) -> Result<Tensor> {
    match output {
        Some(output) => output.narrow(1, start, len)?.contiguous(),
        None => candle_core::bail!("the decoder lacks an output that its experiment names"),
    }
}
