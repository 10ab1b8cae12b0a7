//! Samples as disturbed sensors would give them to a network. Targets are not disturbed: they come from the samples
//! themselves.

use super::frames::FrameStore;
use super::{FramesError, Normalizer, Normalizers, Samples};
use harness_spec::{Disturbance, IMAGE_CHANNELS, Modality};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

/// The gray of an occluded part of an image.
const GRAY: u8 = 128;
/// A blur reaches so many standard deviations far.
const REACH: f64 = 3.0;

impl Samples {
    /// Returns the samples with these disturbances. `purpose` names the random streams: those of a training and of a
    /// test differ. The streams also depend on the seed of the dataset, the modality, the episode and the kind of
    /// disturbance, and on nothing else.
    ///
    /// # Errors
    /// When frames can't be written to disk.
    pub fn disturbed(
        &self,
        disturbances: &BTreeMap<Modality, Disturbance>,
        normalizers: &Normalizers,
        purpose: &str,
    ) -> Result<Self, FramesError> {
        let mut samples = self.clone();
        for (&modality, disturbance) in disturbances {
            let scale = &normalizers.modalities[&modality];
            let disturbed = Disturbed { samples: self, modality, scale, of: disturbance, purpose };
            let position = self.position(modality);
            if self.layout[modality].is_image() {
                let frames = disturbed.frames();
                let frames = frames.map_err(|source| FramesError { folder: self.folder.clone(), source })?;
                samples.images[position] = Some(Arc::new(frames));
            } else {
                samples.vectors[position] = Arc::new(disturbed.vectors());
            }
        }
        Ok(samples)
    }
}

/// A modality that is disturbed.
struct Disturbed<'a> {
    samples: &'a Samples,
    modality: Modality,
    /// What the strengths of noise, bias and drift are relative to.
    scale: &'a Normalizer,
    of: &'a Disturbance,
    purpose: &'a str,
}

impl Disturbed<'_> {
    /// The random stream of a kind of disturbance in an episode.
    fn stream(&self, kind: &str, episode: usize) -> ChaCha8Rng {
        let own = self.samples.own_episodes().len();
        let episode = match episode.checked_sub(own) {
            Some(of_test) => format!("test episode {of_test}"),
            None => format!("episode {episode}"),
        };
        let (seed, modality, purpose) = (self.samples.recording.seed, self.modality, self.purpose);
        let identity = format!("harness disturbance: seed {seed}, {purpose}, {modality}, {episode}, {kind}");
        ChaCha8Rng::from_seed(Sha256::digest(identity).into())
    }

    /// The sample of the episode that has arrived at each of its samples, counted from 0: the last one that was not
    /// dropped, `delay` samples late. The first one always arrives.
    fn arrived(&self, episode: usize, samples: usize) -> Vec<usize> {
        let mut dropped = self.stream("dropped", episode);
        let mut latest = 0;
        let held = (0..samples).map(|sample| {
            if !dropped.random_bool(self.of.dropped) {
                latest = sample;
            }
            latest
        });
        let held: Vec<usize> = held.collect();
        (0..samples).map(|sample| held[sample.saturating_sub(self.of.delay)]).collect()
    }

    /// The values of a vector, `[samples, width]`.
    fn vectors(&self) -> Vec<f32> {
        let width = self.samples.layout[self.modality].width();
        let values = self.samples.vectors(self.modality);
        let episodes = self.samples.episodes.iter().enumerate();
        let of_episode = |(episode, range): (usize, &Range<usize>)| {
            let sensed = self.sensed(episode, &values[range.start * width..range.end * width], width);
            let arrived = self.arrived(episode, range.len());
            arrived.into_iter().flat_map(|sample| sensed[sample * width..][..width].to_vec()).collect()
        };
        episodes.flat_map::<Vec<f32>, _>(of_episode).collect()
    }

    /// What the elements of a vector measure in an episode, `[samples, width]`.
    fn sensed(&self, episode: usize, values: &[f32], width: usize) -> Vec<f32> {
        let normal = |kind: &str, strength: f64| -> Vec<f32> {
            let drawn = StandardNormal.sample_iter(self.stream(kind, episode)).take(width);
            drawn
                .enumerate()
                .map(|(element, drawn): (usize, f32)| drawn * self.unit(element, strength))
                .collect()
        };
        let (bias, drift) = (normal("bias", self.of.bias), normal("drift", self.of.drift));
        let mut dead = self.stream("dead", episode);
        let only = &self.of.only;
        let lacks = |element| !only.is_empty() && !only.contains(&element);
        let dead: Vec<bool> =
            (0..width).map(|element| dead.random_bool(self.of.dead) || lacks(element)).collect();
        let mut noise = self.stream("noise", episode);
        let rate = self.samples.recording.sample_rate_hz;
        let sensed = values.iter().enumerate().map(|(place, value)| {
            let (element, seconds) = (place % width, ((place / width) as f64 / rate) as f32);
            let drawn: f32 = StandardNormal.sample(&mut noise);
            let error = bias[element] + drift[element] * seconds + drawn * self.unit(element, self.of.noise);
            if dead[element] { 0.0 } else { value + error }
        });
        sensed.collect()
    }

    /// A number of standard deviations of an element in its unit.
    fn unit(&self, element: usize, deviations: f64) -> f32 {
        deviations as f32 * self.scale.std(element)
    }

    /// The frames of an image.
    fn frames(&self) -> std::io::Result<FrameStore> {
        let samples = self.samples;
        let own = samples.frames(self.modality);
        let mut store = own.empty(samples.len(), &samples.folder)?;
        for (episode, range) in samples.episodes.iter().enumerate() {
            let view = View::of(self, episode);
            let arrived = self.arrived(episode, range.len());
            // A part of an episode at once, because an episode may be long.
            for arrived in arrived.chunks(super::frames::FRAMES_AT_ONCE) {
                let frames =
                    arrived.par_iter().map(|sample| view.of_frame(own.frame(range.start + sample), *sample));
                store.append(&frames.collect::<Vec<_>>().concat())?;
            }
        }
        store.finish()?;
        Ok(store)
    }
}

/// What disturbs the frames of an episode.
struct View {
    size: [usize; 2],
    /// The rows and columns that are occluded.
    hidden: [Range<usize>; 2],
    /// The weights of a blur over pixels beside one another; a single one without blur.
    weights: Vec<f32>,
    /// The standard deviation of the noise, in steps of a byte.
    noise: f32,
    stream: ChaCha8Rng,
}

impl View {
    fn of(disturbed: &Disturbed, episode: usize) -> Self {
        let Disturbed { samples, modality, of, .. } = disturbed;
        let size = samples.layout[*modality].size().unwrap_or_default();
        let mut place = disturbed.stream("occlusion", episode);
        let hidden = size.map(|side| {
            let hidden = (side as f64 * of.occlusion.sqrt()).round() as usize;
            let first = place.random_range(0..=side - hidden);
            first..first + hidden
        });
        let reach = (REACH * of.blur).ceil() as i32;
        let weight = |distance: i32| (-0.5 * (f64::from(distance) / of.blur).powi(2)).exp();
        let weights: Vec<f64> = if reach == 0 { vec![1.0] } else { (-reach..=reach).map(weight).collect() };
        let sum: f64 = weights.iter().sum();
        Self {
            size,
            hidden,
            weights: weights.into_iter().map(|weight| (weight / sum) as f32).collect(),
            noise: disturbed.unit(0, of.noise) * 255.0,
            stream: disturbed.stream("noise", episode),
        }
    }

    /// A frame as the camera gives it, `[channel, row, column]`.
    fn of_frame(&self, frame: &[u8], sample: usize) -> Vec<u8> {
        let [rows, columns] = self.size;
        let mut values: Vec<f32> = frame.iter().map(|byte| f32::from(*byte)).collect();
        if self.weights.len() > 1 {
            values = blurred(&values, &self.weights, columns, 1);
            values = blurred(&values, &self.weights, rows, columns);
        }
        for channel in 0..IMAGE_CHANNELS {
            for row in self.hidden[0].clone() {
                let first = (channel * rows + row) * columns;
                values[first + self.hidden[1].start..first + self.hidden[1].end].fill(f32::from(GRAY));
            }
        }
        if self.noise > 0.0 {
            let mut stream = self.stream.clone();
            stream.set_stream(sample as u64);
            let drawn = StandardNormal.sample_iter(&mut stream);
            values.iter_mut().zip(drawn).for_each(|(value, drawn): (_, f32)| *value += self.noise * drawn);
        }
        values.into_iter().map(|value| value.round().clamp(0.0, 255.0) as u8).collect()
    }
}

/// Returns lines of `length` values, `step` apart, blurred by weights. Beyond its ends, a line has the value there.
fn blurred(values: &[f32], weights: &[f32], length: usize, step: usize) -> Vec<f32> {
    let reach = weights.len() / 2;
    let blurred = values.iter().enumerate().map(|(place, _)| {
        let own = place / step % length;
        let weighted = weights.iter().enumerate().map(|(index, weight)| {
            let other = (own + index).saturating_sub(reach).min(length - 1);
            weight * values[place - own * step + other * step]
        });
        weighted.sum::<f32>()
    });
    blurred.collect()
}
