//! The baseline that averages the training samples whose input is nearest, for estimates of the present sample.

use super::ridge::{row_of, side_by_side, vectors_in};
use super::{BATCH, Given, JudgeError, Predicted, Predictor, Receive, models};
use harness_samples::{Sample, Samples};
use harness_spec::Modality;
use rayon::prelude::*;

/// Number of neighbors that are averaged, as in scikit-learn's `KNeighborsRegressor`.
const NEIGHBORS: usize = 5;

/// Largest number of training samples that are searched. Of more, as many are taken at equal distances.
const MOST: usize = 10_000;

/// The mean of the outputs at the training samples whose normalized input is nearest, by the Euclidean distance.
pub struct NearestNeighbors<'a> {
    given: Given<'a>,
    output: Vec<Modality>,
    /// The searched samples.
    known: Vec<Sample>,
    /// Their normalized inputs, `[known, inputs]`.
    inputs: Vec<f32>,
}

impl<'a> NearestNeighbors<'a> {
    /// Takes the samples `training`. Estimates the vectors in `output`; `None` if all of them are images.
    ///
    /// # Errors
    /// When a value is not finite.
    pub fn fit(
        given: Given<'a>,
        training: &[Sample],
        output: &[Modality],
    ) -> Result<Option<Self>, JudgeError> {
        let output = vectors_in(given.samples, output);
        if output.is_empty() {
            return Ok(None);
        }
        let known: Vec<Sample> =
            training.iter().copied().step_by(training.len().div_ceil(MOST).max(1)).collect();
        let parts = known.chunks(BATCH).map(|at| given.values(at, 0)).collect::<Result<Vec<_>, _>>()?;
        Ok(Some(Self { given, output, known, inputs: parts.concat() }))
    }

    /// Returns the samples whose inputs are nearest to `input`, the nearest first. Of two that are equally near, the
    /// earlier one comes first.
    fn nearest(&self, input: &[f32]) -> Vec<Sample> {
        let distance = |known: &[f32]| known.iter().zip(input).map(|(a, b)| (a - b) * (a - b)).sum::<f32>();
        let distances = self.inputs.chunks_exact(input.len()).map(distance);
        let mut all: Vec<(f32, Sample)> = distances.zip(self.known.iter().copied()).collect();
        let order =
            |one: &(f32, Sample), other: &(f32, Sample)| one.0.total_cmp(&other.0).then(one.1.cmp(&other.1));
        if all.len() > NEIGHBORS {
            all.select_nth_unstable_by(NEIGHBORS, order);
            all.truncate(NEIGHBORS);
        }
        all.sort_unstable_by(order);
        all.into_iter().map(|(_, sample)| sample).collect()
    }
}

impl Predictor for NearestNeighbors<'_> {
    fn name(&self) -> &str {
        models::NEAREST_NEIGHBORS
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> Result<(), JudgeError> {
        let samples: &Samples = self.given.samples;
        let inputs = self.given.values(at, 0)?;
        let rows = (0..at.len()).into_par_iter().map(|row| self.nearest(row_of(&inputs, row, at.len())));
        let neighbors: Vec<Vec<Sample>> = rows.collect();
        for &modality in &self.output {
            let width = samples.layout()[modality].width();
            let mean = |neighbors: &Vec<Sample>| {
                let values = side_by_side(samples, &[modality], neighbors, 0);
                let count = neighbors.len() as f32;
                (0..width)
                    .map(|element| values.iter().skip(element).step_by(width).sum::<f32>() / count)
                    .collect::<Vec<f32>>()
            };
            let values = neighbors.iter().flat_map(mean).collect();
            receive(&Predicted { modality, horizon: 0, values, ensemble: None })?;
        }
        Ok(())
    }
}
