//! Trained networks at work on chosen transitions, in physical units.

use super::network::{Decoder, Encoder};
use super::objective::{View, rows};
use crate::spec::Modality;
use candle_core::{Result, Tensor};

/// Transitions decoded at once; bounds the memory that frames take.
const BATCH: usize = 256;

/// The posterior's mean for every transition in `at`, `[at, latent]`.
pub fn encode(view: &View, encoder: &Encoder, input: &[Modality], at: &[usize]) -> Result<Tensor> {
    let encoder = encoder.detached();
    let means = at.chunks(BATCH).map(|at| encoder.encode(&view.observation(at, input)?)?.mean());
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
    view: &View,
    decoder: &Decoder,
    output: &[Modality],
    acting: bool,
    latent: &Tensor,
    at: &[usize],
    mut each: impl FnMut(Predicted),
) -> Result<()> {
    let decoder = decoder.detached();
    for (index, at) in at.chunks(BATCH).enumerate() {
        let places: Vec<usize> = (index * BATCH..index * BATCH + at.len()).collect();
        let action = acting.then(|| view.actions(at)).transpose()?;
        let (vector, frames) = decoder.decode(&rows(latent, &places)?, action.as_ref())?;
        let (mut column, mut channel) = (0, 0);
        for modality in output.iter().copied() {
            let values = if modality.is_frame() {
                let frames = part(&frames, channel, crate::spec::FRAME_CHANNELS)?;
                channel += crate::spec::FRAME_CHANNELS;
                frames
            } else {
                let vector = part(&vector, column, modality.width())?;
                column += modality.width();
                vector
            };
            let mut values = values.flatten_all()?.to_vec1()?;
            view.standard.scales[&modality].restore(&mut values);
            each(Predicted { modality, at, values });
        }
    }
    Ok(())
}

/// `len` columns or channels of a decoder's output, from `start` on.
fn part(output: &Option<Tensor>, start: usize, len: usize) -> Result<Tensor> {
    match output {
        Some(output) => output.narrow(1, start, len)?.contiguous(),
        None => candle_core::bail!("the decoder lacks an output that its experiment names"),
    }
}
