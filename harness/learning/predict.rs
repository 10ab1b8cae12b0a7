//! Applies trained networks to the samples of a dataset, with results in physical units.

use super::LearningError;
use super::data::NormalizedData;
use super::marginal::Marginals;
use super::network::{Decoded, Decoder, Draw, Network, Spread, Spreads, State, context};
use super::random::{Random, Stream};
use candle_core::{DType, Result, Tensor};
use harness_judge::{BATCH, JudgeError, Predicted, Predictor, Receive, models};
use harness_metrics::{Ensemble, Members};
use harness_ops::{Values, input};
use harness_samples::{Normalizer, Normalizers, Sample, Samples, after};
use harness_spec::{Modality, Window, WindowStart};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};

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

    /// Returns the number of samples of the longest track.
    fn longest(&self) -> usize {
        self.tracks.iter().map(|track| track.samples).max().unwrap_or_default()
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
fn present(
    network: &dyn Network,
    data: &NormalizedData,
    input: &[Modality],
    window: &Window,
    at: &[Sample],
) -> Result<(State, Option<Tensor>)> {
    Encoded::new(network, data, input, window, at)?.present(&|_| Ok(Draw::Mean))
}

/// The encoded samples of windows, from which the latent states follow.
struct Encoded<'a> {
    network: &'a dyn Network,
    data: &'a NormalizedData,
    tracks: Tracks,
    /// The samples of all tracks, in ascending order, and their encodings, `[samples, width]`.
    samples: Vec<Sample>,
    encoded: Tensor,
}

impl<'a> Encoded<'a> {
    /// Encodes the windows until the present samples `at`, which are in ascending order.
    fn new(
        network: &'a dyn Network,
        data: &'a NormalizedData,
        input: &[Modality],
        window: &Window,
        at: &[Sample],
    ) -> Result<Self> {
        let tracks = Tracks::new(&data.samples, context(network, window), window.start, at);
        let all = (0..tracks.longest()).flat_map(|distance| tracks.at(distance));
        let samples: Vec<Sample> = all.collect::<BTreeSet<Sample>>().into_iter().collect();
        let encoded = samples.chunks(BATCH).map(|at| {
            let observation = data.inputs(at, input)?;
            network.encode(&observation, &mut Draw::Mean)
        });
        let encoded = Tensor::cat(&encoded.collect::<Result<Vec<_>>>()?, 0)?;
        Ok(Self { network, data, tracks, samples, encoded })
    }

    /// Returns what [`present`] does. `draw` says how the latent states of samples are drawn.
    fn present(&self, draw: &dyn Fn(&[Sample]) -> Result<Draw<'static>>) -> Result<(State, Option<Tensor>)> {
        let Self { network, data, tracks, samples: all, encoded } = self;
        let longest = tracks.longest();
        let mut state = network.start(tracks.tracks.len(), &data.device)?;
        let (mut states, mut divergences, mut order) = (Vec::new(), Vec::new(), Vec::new());
        for distance in 0..longest {
            let now = tracks.at(distance);
            let rows: Vec<u32> = now
                .iter()
                .filter_map(|sample| all.binary_search(sample).ok())
                .map(|row| row as u32)
                .collect();
            let encoded = encoded.index_select(&Tensor::new(rows, encoded.device())?, 0)?;
            let seen = network.observe(state.as_ref(), &encoded, &mut draw(&now)?)?;
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
    pub(crate) fn indices(&self, at: &[Sample]) -> Result<Vec<u32>> {
        at.iter()
            .map(|sample| match self.at.binary_search(sample) {
                Ok(row) => Ok(row as u32),
                Err(_) => candle_core::bail!("sample {} has no latent state", sample.index()),
            })
            .collect()
    }

    /// Returns the latent states at these samples, `[at, latent]`.
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
    /// Number of latent states that are drawn for each window. The distribution of the vectors is what the decoder
    /// says for each: a value, or one that is drawn from the distribution that it predicts. 0 for a prediction from the
    /// mean of the latent state alone.
    pub draws: usize,
    /// Seed of these latent states.
    pub seed: u64,
}

impl TrainedNetwork<'_> {
    /// Predicts the vectors from each drawn latent state of windows. Returns the values by modality and horizon,
    /// `[at, width, draws]`. They depend on no other window.
    fn drawn(
        &self,
        encoded: &Encoded,
        at: &[Sample],
        latent: usize,
    ) -> std::result::Result<Drawn, JudgeError> {
        let layout = self.data.samples.layout();
        let vectors: Vec<Modality> =
            self.output.iter().copied().filter(|modality| !layout[*modality].is_image()).collect();
        let mut members = Drawn::new();
        // The stream of each sample, the latest draw, and its noise, which a sample may need several times.
        let streams = RefCell::new(BTreeMap::<Sample, (Random, Option<usize>, Vec<f32>)>::new());
        let of_sample = |sample: &Sample| Random::new(self.seed, Stream::Members(sample.index()));
        let mut generators: Vec<Random> = at.iter().map(of_sample).collect();
        for draw in 0..self.draws {
            let noise = |now: &[Sample]| {
                let mut streams = streams.borrow_mut();
                let of_sample = |sample: &Sample| {
                    let new = || (Random::new(self.seed, Stream::Draws(sample.index())), None, Vec::new());
                    let (random, latest, noise) = streams.entry(*sample).or_insert_with(new);
                    if latest.replace(draw) != Some(draw) {
                        *noise = random.normal(latent);
                    }
                    noise.clone()
                };
                let noise = now.iter().flat_map(of_sample).collect();
                input(Values::F32(noise), (now.len(), latent), &self.data.device).map(Draw::Noise)
            };
            let (state, _) = encoded.present(&noise).map_err(failed)?;
            self.each_horizon(state, at, &mut |horizon, decoded, spreads| {
                let marginals = self.marginals(&decoded, &spreads, at).map_err(failed)?;
                for (modality, mut values) in self.values(&vectors, &decoded, at).map_err(failed)? {
                    if let Some(marginals) = marginals.get(&modality) {
                        values = marginals.draw(&mut generators);
                    }
                    let all = members.entry((modality, horizon));
                    let all = all.or_insert_with(|| vec![0.0; values.len() * self.draws]);
                    let places = all.iter_mut().skip(draw).step_by(self.draws);
                    places.zip(values).for_each(|(place, value)| *place = value);
                }
                Ok(())
            })?;
        }
        Ok(members)
    }

    /// Returns what is predicted of each modality in `output`, in physical units. Changes are added to the values at the
    /// present samples `at`.
    fn values(
        &self,
        output: &[Modality],
        decoded: &Decoded,
        at: &[Sample],
    ) -> Result<Vec<(Modality, Vec<f32>)>> {
        predicted(&self.data.normalizers, output, decoded, |modality| self.data.given_values(modality, at))
    }

    /// Returns the predicted distributions by modality.
    fn marginals(
        &self,
        decoded: &Decoded,
        spreads: &Spreads,
        at: &[Sample],
    ) -> Result<BTreeMap<Modality, Marginals>> {
        let normalizers = &self.data.normalizers;
        let of = |(modality, spread): (&Modality, &Spread)| {
            let means =
                unbounded(normalizers, *modality, decoded, |modality| self.data.given_values(modality, at))?;
            Ok((*modality, Marginals::new(normalizers, *modality, means, spread)?))
        };
        spreads.iter().map(of).collect()
    }

    /// Passes on what the network predicts at each judged horizon from the state at the present samples `at`, or what it
    /// estimates of these samples if the horizon is 0.
    fn each_horizon(
        &self,
        mut state: State,
        at: &[Sample],
        receive: &mut dyn FnMut(usize, Decoded, Spreads) -> std::result::Result<(), JudgeError>,
    ) -> std::result::Result<(), JudgeError> {
        let horizons = self.window.horizons();
        if self.window.horizon == 0 {
            let decoded = self.network.decode(&state).map_err(failed)?;
            return receive(0, decoded, self.network.spreads(&state).map_err(failed)?);
        }
        for horizon in 1..=self.window.horizon {
            let now = after(at, horizon - 1);
            let next = || self.network.act(&state, &self.data.actions(&now)?);
            state = next().map_err(failed)?;
            if horizons.contains(&horizon) {
                let decoded = self.network.decode(&state).map_err(failed)?;
                receive(horizon, decoded, self.network.spreads(&state).map_err(failed)?)?;
            }
        }
        Ok(())
    }

    /// Returns the divergence of each dimension of the latent state from what was expected before the present sample,
    /// averaged over the windows at these present samples, `[latent]`, in nats. It was expected to be standard normal,
    /// or as the prior says if the network has one.
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

    fn given(&self) -> Option<&'static str> {
        self.data.given()
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> std::result::Result<(), JudgeError> {
        let Self { data, network, input, window, .. } = self;
        let encoded = Encoded::new(&**network, data, input, window, at).map_err(failed)?;
        let (state, _) = encoded.present(&|_| Ok(Draw::Mean)).map_err(failed)?;
        let latent = state.latent.dim(1).map_err(failed)?;
        let mut drawn = self.drawn(&encoded, at, latent)?;
        self.each_horizon(state, at, &mut |horizon, decoded, spreads| {
            let marginals = self.marginals(&decoded, &spreads, at).map_err(failed)?;
            for (modality, mut values) in self.values(self.output, &decoded, at).map_err(failed)? {
                let mut ensemble = None;
                if let Some(members) = drawn.remove(&(modality, horizon)) {
                    let drawn = ensemble.insert(Ensemble::new(Members::Draws, self.draws, members)?);
                    values = drawn.means();
                } else if let Some(marginals) = marginals.get(&modality) {
                    let quantiles = ensemble.insert(marginals.ensemble()?);
                    if marginals.moves_means() {
                        values = quantiles.means();
                    }
                }
                receive(&Predicted { modality, horizon, values, ensemble })?;
            }
            Ok(())
        })
    }
}

/// A decoder that reconstructs the present sample from the latent state of a frozen network.
pub struct TrainedDecoder<'a> {
    /// What tables call the model.
    pub name: &'static str,
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
        self.name
    }

    fn given(&self) -> Option<&'static str> {
        self.data.given()
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> std::result::Result<(), JudgeError> {
        let decoded = self.latents.rows(at).and_then(|latent| self.decoder.decode(&latent, None));
        let values = decoded.and_then(|decoded| denormalized(&self.data.normalizers, self.output, &decoded));
        values.map_err(failed)?.into_iter().try_for_each(|(modality, values)| {
            receive(&Predicted { modality, horizon: 0, values, ensemble: None })
        })
    }
}

/// Values that follow from drawn latent states, by modality and horizon, `[windows, width, draws]`.
type Drawn = BTreeMap<(Modality, usize), Vec<f32>>;

/// Returns what a network predicts of each modality in `output` in physical units, `[batch, width]`; images channel by
/// channel. `present` returns the values of a modality at the present samples, to which predicted changes are added.
pub fn predicted(
    normalizers: &Normalizers,
    output: &[Modality],
    decoded: &Decoded,
    present: impl Fn(Modality) -> Vec<f32>,
) -> Result<Vec<(Modality, Vec<f32>)>> {
    let physical = |&modality: &Modality| {
        let mut values = unbounded(normalizers, modality, decoded, &present)?;
        normalizers.modalities[&modality].bound(&mut values);
        Ok((modality, values))
    };
    output.iter().map(physical).collect()
}

/// Returns what a network predicts of a modality as [`predicted`] does, also below its minimum.
fn unbounded(
    normalizers: &Normalizers,
    modality: Modality,
    decoded: &Decoded,
    present: impl Fn(Modality) -> Vec<f32>,
) -> Result<Vec<f32>> {
    let Some(change) = normalizers.changes.get(&modality) else {
        return in_units(decoded, modality, &normalizers.modalities[&modality]);
    };
    let (mut values, changes) = (present(modality), in_units(decoded, modality, change)?);
    values.iter_mut().zip(changes).for_each(|(value, change)| *value += change);
    Ok(values)
}

/// Returns the values of each modality in `output` in physical units, `[batch, width]`; images channel by channel.
pub fn denormalized(
    normalizers: &Normalizers,
    output: &[Modality],
    decoded: &Decoded,
) -> Result<Vec<(Modality, Vec<f32>)>> {
    let physical = |&modality: &Modality| {
        let scale = &normalizers.modalities[&modality];
        let mut values = in_units(decoded, modality, scale)?;
        scale.bound(&mut values);
        Ok((modality, values))
    };
    output.iter().map(physical).collect()
}

/// Returns the decoded values of a modality in the units of a normalizer, also below its minimum.
fn in_units(decoded: &Decoded, modality: Modality, scale: &Normalizer) -> Result<Vec<f32>> {
    let Some(values) = decoded.get(&modality) else {
        candle_core::bail!("the decoder has no output for '{modality}'");
    };
    let mut values = values.flatten_all()?.to_vec1()?;
    scale.denormalize_unbounded(&mut values);
    Ok(values)
}
