//! Applies trained networks to the samples of a dataset, with results in physical units.

use super::LearningError;
use super::data::NormalizedData;
use super::network::{Decoded, Decoder, Draw, Network, State, context};
use candle_core::{DType, Result, Tensor};
use harness_judge::{BATCH, JudgeError, Predicted, Predictor, Receive, models};
use harness_ops::{Values, input};
use harness_samples::{Normalizer, Normalizers, Sample, Samples, after, physical};
use harness_spec::{Modality, Window, WindowStart};
use std::collections::BTreeSet;

/// Consecutive samples that a network sees one after the other, from a start without knowledge.
struct Track {
    first: Sample,
    samples: usize,
}

/// The tracks that end at present samples, or pass them.
struct Tracks {
    tracks: Vec<Track>,
    /// For each present sample, the track on which it lies, and its distance from the track's first sample.
    places: Vec<(usize, usize)>,
}

impl Tracks {
    /// Returns the tracks for the present samples `at`, which are in ascending order.
    fn new(samples: &Samples, context: usize, start: WindowStart, at: &[Sample]) -> Self {
        let (mut tracks, mut places): (Vec<Track>, _) = (Vec::new(), Vec::with_capacity(at.len()));
        for &present in at {
            let before = samples.place(present).1;
            let distance = match start {
                WindowStart::Rest if context > 1 => before,
                _ => before.min(context - 1),
            };
            let first = present.before(distance);
            // A track from the start of an episode passes the samples after it.
            match tracks.last_mut() {
                Some(last) if last.first == first => last.samples = distance + 1,
                _ => tracks.push(Track { first, samples: distance + 1 }),
            }
            places.push((tracks.len() - 1, distance));
        }
        Self { tracks, places }
    }

    /// Returns the sample of each track at a distance from its first one. A shorter track stays at its last one.
    fn at(&self, distance: usize) -> Vec<Sample> {
        self.tracks.iter().map(|track| track.first.after(distance.min(track.samples - 1))).collect()
    }

    /// Returns for each track the sample whose action leads from this distance to the next. The state of a track that
    /// has ended is not used any more, so it gets the action of one that goes on.
    fn acting(&self, distance: usize) -> Vec<Sample> {
        let goes_on = |track: &&Track| distance + 1 < track.samples;
        let other = self.tracks.iter().find(goes_on).expect("a track goes on");
        let acting = self.tracks.iter().map(|track| if goes_on(&track) { track } else { other });
        acting.map(|track| track.first.after(distance)).collect()
    }

    /// Returns the present samples at this distance, and their tracks.
    fn wanted(&self, distance: usize) -> impl Iterator<Item = (usize, u32)> {
        let places = self.places.iter().enumerate();
        places.filter(move |(_, place)| place.1 == distance).map(|(index, place)| (index, place.0 as u32))
    }
}

/// Returns the state of a network that has seen the windows until the present samples `at`, which are in ascending
/// order, and the divergence of each dimension of their latent states, `[at, latent]`, in nats; `None` for a network
/// that gives none.
///
/// # Errors
/// Those of the network.
fn present(
    network: &dyn Network,
    data: &NormalizedData,
    input: &[Modality],
    window: &Window,
    at: &[Sample],
) -> Result<(State, Option<Tensor>)> {
    let tracks = Tracks::new(&data.samples, context(network, window), window.start, at);
    let longest = tracks.tracks.iter().map(|track| track.samples).max().unwrap_or_default();
    let all: BTreeSet<Sample> = (0..longest).flat_map(|distance| tracks.at(distance)).collect();
    let all: Vec<Sample> = all.into_iter().collect();
    let encoded = all.chunks(BATCH).map(|at| {
        let observation = data.observation(at, input)?;
        network.encode(&observation, &mut Draw::Mean)
    });
    let encoded = Tensor::cat(&encoded.collect::<Result<Vec<_>>>()?, 0)?;
    let mut state = network.start(tracks.tracks.len(), &data.device)?;
    let (mut states, mut divergences, mut order) = (Vec::new(), Vec::new(), Vec::new());
    for distance in 0..longest {
        let now = tracks.at(distance);
        let rows: Vec<u32> =
            now.iter().filter_map(|sample| all.binary_search(sample).ok()).map(|row| row as u32).collect();
        let encoded = encoded.index_select(&Tensor::new(rows, encoded.device())?, 0)?;
        let seen = network.observe(state.as_ref(), &encoded, &mut Draw::Mean)?;
        let (indices, rows): (Vec<usize>, Vec<u32>) = tracks.wanted(distance).unzip();
        if !rows.is_empty() {
            states.push(seen.state.rows(&rows)?);
            if let Some(all) = &seen.divergences {
                divergences.push(all.index_select(&Tensor::new(rows, all.device())?, 0)?);
            }
            order.extend(indices);
        }
        if distance + 1 < longest {
            state = Some(network.act(&seen.state, &data.actions(&tracks.acting(distance))?)?);
        }
    }
    let mut rows = vec![0; order.len()];
    order.into_iter().enumerate().for_each(|(row, index)| rows[index] = row as u32);
    let in_order = |all: Tensor| all.index_select(&Tensor::new(&*rows, all.device())?, 0);
    let divergences = (!divergences.is_empty()).then(|| Tensor::cat(&divergences, 0).and_then(in_order));
    Ok((State::joined(&states)?.rows(&rows)?, divergences.transpose()?))
}

/// The latent states of a network at all samples. At the first ones of an episode, the context is as long as it can be.
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
        window: &Window,
    ) -> Result<Self> {
        let network = network.detached();
        let at = data.samples.windows(&Window { horizon: 0, ..window.of_one_sample() });
        let latents = at.chunks(BATCH).map(|at| Ok(present(&*network, data, input, window, at)?.0.latent));
        let values = Tensor::cat(&latents.collect::<Result<Vec<_>>>()?, 0)?.contiguous()?;
        Ok(Self { at, values })
    }

    /// Returns the rows of these samples' latent states.
    ///
    /// # Errors
    /// When the dataset has no such sample.
    pub(crate) fn indices(&self, at: &[Sample]) -> Result<Vec<u32>> {
        at.iter()
            .map(|sample| match self.at.binary_search(sample) {
                Ok(row) => Ok(row as u32),
                Err(_) => candle_core::bail!("sample {} has no latent state", sample.index()),
            })
            .collect()
    }

    /// Returns the latent states at these samples, `[at, latent]`.
    ///
    /// # Errors
    /// When the dataset has no such sample.
    pub fn rows(&self, at: &[Sample]) -> Result<Tensor> {
        self.values.index_select(&input(Values::U32(self.indices(at)?), at.len(), self.values.device())?, 0)
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
    pub window: &'a Window,
}

impl TrainedNetwork<'_> {
    /// Returns the divergence of each dimension of the latent state from what was expected before the present sample,
    /// averaged over the windows at these present samples, `[latent]`, in nats. It was expected to be standard normal,
    /// or as the prior says if the network has one.
    ///
    /// # Errors
    /// Those of the network.
    pub fn divergences(&self, at: &[Sample]) -> Result<Vec<f64>> {
        let Self { data, network, input, window, .. } = self;
        let mut sums: Vec<f64> = Vec::new();
        for part in at.chunks(BATCH) {
            let (_, Some(divergences)) = present(&**network, data, input, window, part)? else {
                return Ok(Vec::new());
            };
            let of_part = divergences.to_dtype(DType::F64)?.sum(0)?.to_vec1::<f64>()?;
            sums.resize(of_part.len(), 0.0);
            sums.iter_mut().zip(of_part).for_each(|(sum, more)| *sum += more);
        }
        Ok(sums.into_iter().map(|sum| sum / at.len() as f64).collect())
    }
}

impl Predictor for TrainedNetwork<'_> {
    fn name(&self) -> &str {
        models::NETWORK
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> std::result::Result<(), JudgeError> {
        let Self { data, network, input, window, .. } = self;
        let (mut state, _) = present(&**network, data, input, window, at).map_err(failed)?;
        let horizons = window.horizons();
        for horizon in 1..=window.horizon {
            let now = after(at, horizon - 1);
            let next = || network.act(&state, &data.actions(&now)?);
            state = next().map_err(failed)?;
            if !horizons.contains(&horizon) {
                continue;
            }
            let decoded = network.decode(&state).map_err(failed)?;
            let values = predicted(&data.normalizers, self.output, &decoded, |modality| {
                physical(&data.samples, modality, at)
            });
            pass_on(values, horizon, receive)?;
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
        let values = decoded.and_then(|decoded| denormalized(&self.data.normalizers, self.output, &decoded));
        pass_on(values, 0, receive)
    }
}

/// Passes the values of each modality to `receive`.
fn pass_on(
    values: Result<Vec<(Modality, Vec<f32>)>>,
    horizon: usize,
    receive: &mut Receive,
) -> std::result::Result<(), JudgeError> {
    let values = values.map_err(failed)?;
    values.into_iter().try_for_each(|(modality, values)| receive(&Predicted { modality, horizon, values, ensemble: None }))
}

/// Returns what a network predicts of each modality in `output` in physical units, `[batch, width]`; images channel by
/// channel. `present` returns the values of a modality at the present samples, to which predicted changes are added.
///
/// # Errors
/// When the decoder has no such output.
pub fn predicted(
    normalizers: &Normalizers,
    output: &[Modality],
    decoded: &Decoded,
    present: impl Fn(Modality) -> Vec<f32>,
) -> Result<Vec<(Modality, Vec<f32>)>> {
    let physical = |&modality: &Modality| {
        let scale = &normalizers.modalities[&modality];
        let Some(change) = normalizers.changes.get(&modality) else {
            return Ok((modality, in_units(decoded, modality, scale)?));
        };
        let mut values = present(modality);
        values
            .iter_mut()
            .zip(in_units(decoded, modality, change)?)
            .for_each(|(value, change)| *value += change);
        scale.bound(&mut values);
        Ok((modality, values))
    };
    output.iter().map(physical).collect()
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
    let physical = |&modality: &Modality| {
        Ok((modality, in_units(decoded, modality, &normalizers.modalities[&modality])?))
    };
    output.iter().map(physical).collect()
}

/// Returns the decoded values of a modality in the units of a normalizer.
fn in_units(decoded: &Decoded, modality: Modality, scale: &Normalizer) -> Result<Vec<f32>> {
    let Some(values) = decoded.get(&modality) else {
        candle_core::bail!("the decoder has no output for '{modality}'");
    };
    let mut values = values.flatten_all()?.to_vec1()?;
    scale.denormalize(&mut values);
    Ok(values)
}
