//! Normalization with the training set's statistics.

use super::{Sample, Samples};
use harness_spec::{AXES, Action, Modality, Scale, Scalings};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// A column is constant if its largest and smallest value differ by less than this part of the largest magnitude, which
/// is 8 times the precision of an f32. The difference of two sums could not tell: its rounding error grows with the
/// number of samples.
const CONSTANT: f64 = 1e-6;

/// Number of frames that are summed in 32 bits. The sum of this many squared differences of bytes fits in an `i32`.
const FRAMES_AT_ONCE: usize = 4096;

/// Mean and standard deviation of one modality, and the minimum of its predictions.
#[derive(Debug, Clone, PartialEq)]
pub struct Normalizer {
    /// One mean for each value, in physical units; `[channel, row, column]` for frames.
    pub mean: Vec<f32>,
    /// One standard deviation for each value, or a single one for all values. Frames have a single one.
    pub std: Vec<f32>,
    /// Predictions below this value are set to it, in physical units.
    pub minimum: Option<f32>,
}

impl Normalizer {
    /// Returns the normalizer that changes no value. Categories have it, so that their inputs are 0 and 1.
    fn none(width: usize) -> Self {
        Self { mean: vec![0.0; width], std: vec![1.0], minimum: None }
    }

    pub(super) fn std(&self, index: usize) -> f32 {
        self.std[if self.std.len() == 1 { 0 } else { index }]
    }

    /// Returns the normalizer of several objects, each of which has this one.
    fn for_objects(self, objects: usize) -> Self {
        let std = if self.std.len() == 1 { self.std } else { self.std.repeat(objects) };
        Self { mean: self.mean.repeat(objects), std, ..self }
    }

    /// Normalizes `values` `[n, width]`, which are in physical units, in place.
    pub fn normalize(&self, values: &mut [f32]) {
        for row in values.chunks_exact_mut(self.mean.len().max(1)) {
            for (index, (value, mean)) in row.iter_mut().zip(&self.mean).enumerate() {
                *value = (*value - mean) / self.std(index);
            }
        }
    }

    /// Returns a function that normalizes a value of an image. It takes the value in steps of 1/255, as bytes have
    /// them, and the mean.
    pub fn of_steps(&self) -> impl Fn(f32, f32) -> f32 + use<> {
        let factor = 1.0 / self.std[0];
        move |steps, mean| (steps * (1.0 / 255.0) - mean) * factor
    }

    /// Normalizes images `[n, channel, row, column]` in place. They are intensities in [0, 1], or changes of these.
    ///
    /// A byte divided by 255 gets the same number, to the last digit, as [`Normalizer::of_steps`] returns for the byte.
    pub fn normalize_images(&self, values: &mut [f32]) {
        let normalized = self.of_steps();
        for image in values.chunks_exact_mut(self.mean.len()) {
            image
                .iter_mut()
                .zip(&self.mean)
                .for_each(|(value, mean)| *value = normalized(*value * 255.0, *mean));
        }
    }

    /// Converts normalized `values` `[n, width]` to physical units in place. Values below the minimum are set to the
    /// minimum.
    pub fn denormalize(&self, values: &mut [f32]) {
        self.denormalize_unbounded(values);
        self.bound(values);
    }

    /// Converts normalized `values` `[n, width]` to physical units in place, also those below the minimum.
    pub fn denormalize_unbounded(&self, values: &mut [f32]) {
        for row in values.chunks_exact_mut(self.mean.len()) {
            for (index, (value, mean)) in row.iter_mut().zip(&self.mean).enumerate() {
                *value = *value * self.std(index) + mean;
            }
        }
    }

    /// Converts normalized deviations `[n, width]` from a value to physical units in place.
    pub fn denormalize_deviations(&self, deviations: &mut [f32]) {
        for row in deviations.chunks_exact_mut(self.mean.len()) {
            row.iter_mut().enumerate().for_each(|(index, deviation)| *deviation *= self.std(index));
        }
    }

    /// Sets `values` in physical units that are below the minimum to the minimum.
    pub fn bound(&self, values: &mut [f32]) {
        // `f32::max` would replace NaN with the minimum.
        if let Some(minimum) = self.minimum {
            values.iter_mut().filter(|value| **value < minimum).for_each(|value| *value = minimum);
        }
    }
}

/// The normalizers of every modality that an experiment uses, and of the action.
#[derive(Debug, Clone, PartialEq)]
pub struct Normalizers {
    /// Normalizer of each modality.
    pub modalities: BTreeMap<Modality, Normalizer>,
    /// Normalizer of the action, with one value for each element.
    pub action: Normalizer,
    /// Normalizers of the changes since the present sample, of the modalities that a network predicts as such. Their
    /// means are 0, so that no change is 0.
    pub changes: BTreeMap<Modality, Normalizer>,
    /// For each output whose predicted quantiles are recalibrated, the probabilities of values below those that the
    /// network predicts at 0, 1/n, 2/n, up to 1, given a contact for a hurdle.
    pub levels: BTreeMap<Modality, Vec<f32>>,
}

/// Running sums for means and standard deviations, one for each value.
struct Moments {
    count: f64,
    sum: Vec<f64>,
    square: Vec<f64>,
    /// Whether a value is the same in all samples.
    constant: Vec<bool>,
}

impl Moments {
    /// Sums rows of `width` values over the given `samples`. A sample has one row, or one for each object of a set.
    fn of<V: AsRef<[f32]>>(width: usize, samples: &[Sample], values: impl Fn(Sample) -> V) -> Self {
        let (mut sum, mut square) = (vec![0.0; width], vec![0.0; width]);
        let mut range = vec![(f64::INFINITY, f64::NEG_INFINITY); width];
        let mut count = 0_usize;
        for sample in samples {
            for row in values(*sample).as_ref().chunks_exact(width.max(1)) {
                count += 1;
                let sums = sum.iter_mut().zip(&mut square).zip(&mut range);
                for (value, ((sum, square), (least, greatest))) in row.iter().zip(sums) {
                    let value = f64::from(*value);
                    *sum += value;
                    *square += value * value;
                    *least = least.min(value);
                    *greatest = greatest.max(value);
                }
            }
        }
        let is_constant =
            |(least, greatest): (f64, f64)| greatest - least <= CONSTANT * least.abs().max(greatest.abs());
        let constant = range.into_iter().map(is_constant).collect();
        Self { count: count as f64, sum, square, constant }
    }

    fn means(&self) -> Vec<f32> {
        self.sum.iter().map(|sum| (sum / self.count) as f32).collect()
    }

    fn variances(&self) -> impl ExactSizeIterator<Item = f64> {
        self.sum.iter().zip(&self.square).zip(&self.constant).map(|((sum, square), constant)| {
            let mean = sum / self.count;
            if *constant { 0.0 } else { (square / self.count - mean * mean).max(0.0) }
        })
    }

    fn scale(&self, std: Scale) -> Normalizer {
        Normalizer { mean: self.means(), std: roots(self.variances(), std), minimum: None }
    }

    /// Returns the normalizer of `width` elements of unit vectors: their root mean square length becomes 1, and what has
    /// no direction stays 0.
    fn scale_of_lengths(&self, width: usize) -> Normalizer {
        let square = self.square.iter().sum::<f64>() / self.count;
        Normalizer { mean: vec![0.0; width], std: vec![root(square)], minimum: None }
    }

    /// Returns the normalizer with a mean of 0.
    fn scale_around_zero(&self, std: Scale) -> Normalizer {
        let squares = self.square.iter().map(|square| square / self.count);
        Normalizer { mean: vec![0.0; self.sum.len()], std: roots(squares, std), minimum: None }
    }
}

/// Returns the square roots of variances, or that of their mean.
fn roots(variances: impl ExactSizeIterator<Item = f64>, std: Scale) -> Vec<f32> {
    let count = variances.len() as f64;
    match std {
        Scale::PerElement => variances.map(root).collect(),
        Scale::Shared => vec![root(variances.sum::<f64>() / count)],
    }
}

/// Returns the square root of a variance. Returns 1 for a value that never changes, which is then normalized to zero.
fn root(variance: f64) -> f32 {
    let std = variance.sqrt() as f32;
    if std > 1e-8 { std } else { 1.0 }
}

impl Normalizers {
    /// Computes the statistics of the modalities in `scalings`, and of the action, over `transitions`.
    pub fn fit(samples: &Samples, transitions: &[Sample], scalings: &Scalings, action: Action) -> Self {
        let fitted = scalings.iter().map(|(&modality, scaling)| {
            let definition = &samples.layout()[modality];
            if definition.category {
                return (modality, Normalizer::none(definition.width()));
            }
            if definition.unit_vectors {
                let moments = Moments::of(AXES, transitions, |sample| samples.vector(modality, sample));
                return (modality, moments.scale_of_lengths(definition.width()));
            }
            let moments = if definition.is_image() {
                frame_moments(samples, transitions, modality)
            } else {
                let width = definition.width() / definition.objects.unwrap_or(1);
                Moments::of(width, transitions, |sample| samples.vector(modality, sample))
            };
            let minimum = scaling.minimum.map(|minimum| minimum as f32);
            let each = moments.scale(scaling.scale);
            (modality, Normalizer { minimum, ..each.for_objects(definition.objects.unwrap_or(1)) })
        });
        let width = samples.layout().action().len();
        let actions =
            Moments::of(width, transitions, |sample| samples.action(action, sample).collect::<Vec<_>>());
        let action = actions.scale(Scale::PerElement);
        Self { modalities: fitted.collect(), action, changes: BTreeMap::new(), levels: BTreeMap::new() }
    }

    /// Returns these normalizers with those of the changes of `modalities`, which are vectors. They are computed over
    /// the changes from each sample in `present` to the `horizon` samples after it.
    pub fn with_changes(
        &self,
        samples: &Samples,
        present: &[Sample],
        modalities: impl Iterator<Item = Modality>,
        horizon: usize,
    ) -> Self {
        let changes = modalities.map(|modality| {
            let objects = samples.layout()[modality].objects.unwrap_or(1);
            let change = |sample: Sample| -> Vec<f32> {
                let now = samples.vector(modality, sample);
                let after = |distance| samples.vector(modality, sample.after(distance)).iter();
                (1..=horizon)
                    .flat_map(|distance| after(distance).zip(now).map(|(then, now)| then - now))
                    .collect()
            };
            let moments = Moments::of(samples.layout()[modality].width() / objects, present, change);
            let value = &self.modalities[&modality];
            let std = if value.std.len() == 1 { Scale::Shared } else { Scale::PerElement };
            (modality, moments.scale_around_zero(std).for_objects(objects))
        });
        Self { changes: changes.collect(), ..self.clone() }
    }

    /// Returns for each modality that is predicted as a change the factor by which its change in units of its own
    /// deviation is divided, one for each element.
    pub fn change_ratios(&self) -> BTreeMap<Modality, Vec<f32>> {
        let ratios = self.changes.iter().map(|(modality, change)| {
            let value = &self.modalities[modality];
            (*modality, (0..change.mean.len()).map(|index| change.std(index) / value.std(index)).collect())
        });
        ratios.collect()
    }

    /// Returns the normalized vectors of several modalities side by side, `[batch, width]`. They are empty if all
    /// modalities are images.
    pub fn vectors(&self, samples: &Samples, at: &[Sample], modalities: &[Modality]) -> Vec<f32> {
        let layout = samples.layout();
        let vectors = modalities.iter().filter(|modality| !layout[**modality].is_image());
        let part = |modality: &Modality| {
            (layout[*modality].width(), samples.vectors(*modality), &self.modalities[modality])
        };
        let parts: Vec<(usize, &[f32], &Normalizer)> = vectors.map(part).collect();
        let width: usize = parts.iter().map(|(width, ..)| width).sum();
        let mut values = Vec::with_capacity(at.len() * width);
        for sample in at {
            for (width, vectors, scale) in &parts {
                let first = values.len();
                values.extend_from_slice(&vectors[sample.index() * width..][..*width]);
                scale.normalize(&mut values[first..]);
            }
        }
        values
    }

    /// Returns the normalized actions, `[batch, elements]`, of the steps from the samples `at` to the next ones.
    pub fn actions(&self, samples: &Samples, at: &[Sample], action: Action) -> Vec<f32> {
        let scale = &self.action;
        let values = at.iter().flat_map(|sample| {
            let scales = scale.mean.iter().zip(&scale.std);
            samples.action(action, *sample).zip(scales).map(|(value, (mean, std))| (value - mean) / std)
        });
        values.collect()
    }
}

/// Returns the sums of a frame modality. Bytes are summed as integers, so the result does not depend on threads or
/// order.
fn frame_moments(samples: &Samples, at: &[Sample], modality: Modality) -> Moments {
    let definition = &samples.layout()[modality];
    let (width, is_difference) = (definition.width(), definition.difference_of.is_some());
    let black = vec![0; width];
    let sums_of = |at: &[Sample]| {
        samples.prefetch(modality, at);
        let mut sums = vec![[0i32; 2]; width];
        for sample in at.iter().copied() {
            let before =
                if is_difference { samples.previous_frame_bytes(modality, sample) } else { black.as_slice() };
            let frames = samples.frame_bytes(modality, sample).iter().zip(before);
            for ([sum, square], (now, before)) in sums.iter_mut().zip(frames) {
                let value = i32::from(*now) - i32::from(*before);
                *sum += value;
                *square += value * value;
            }
        }
        sums.into_iter().map(|sums| sums.map(i64::from)).collect::<Vec<_>>()
    };
    let none = || vec![[0i64; 2]; width];
    let sums = at.par_chunks(FRAMES_AT_ONCE).map(sums_of).reduce(none, |mut sums, others| {
        let each = sums.iter_mut().flatten().zip(others.iter().flatten());
        each.for_each(|(sum, other)| *sum += other);
        sums
    });
    let count = at.len() as i128;
    let constant =
        sums.iter().map(|[sum, square]| count * i128::from(*square) == i128::from(*sum).pow(2)).collect();
    let [sum, square] = [(0, 255.0), (1, 255.0 * 255.0)]
        .map(|(which, unit)| sums.iter().map(|sums| sums[which] as f64 / unit).collect());
    Moments { count: at.len() as f64, sum, square, constant }
}
