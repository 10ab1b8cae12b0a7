//! The baseline that predicts vectors by a linear regression of a model's input and the actions.

use super::{BATCH, JudgeError, Predicted, Predictor, Receive, models};
use harness_metrics::MetricsError;
use harness_metrics::baselines::{self, RidgeSums, downsample_frame};
use harness_samples::{Normalizers, Sample, Samples, physical};
use harness_spec::{Action, Modality};
use rayon::prelude::*;

/// Factor of the ridge regression's penalty, for normalized inputs and thousands of samples.
const ALPHA: f64 = 1.0;

/// What the regression gets: the actions until the predicted sample, and the input's vectors and images at the present
/// one, normalized. Images are reduced to small gray ones.
#[derive(Clone, Copy)]
pub struct Given<'a> {
    /// The dataset.
    pub samples: &'a Samples,
    /// The samples as the model's sensors give them.
    pub sensed: &'a Samples,
    /// The normalizers of the input and the action.
    pub normalizers: &'a Normalizers,
    /// Which quantity is used as the action.
    pub action: Action,
    /// Modalities of the input.
    pub input: &'a [Modality],
}

/// A ridge regression of a later sample's vectors.
pub struct Ridge<'a> {
    given: Given<'a>,
    horizon: usize,
    output: Vec<Modality>,
    regression: baselines::Ridge,
}

impl<'a> Ridge<'a> {
    /// Fits a regression to the windows with the present samples `training`. It predicts the vectors in `output`,
    /// `horizon` samples after the present one. Returns `None` if all of them are images.
    ///
    /// # Errors
    /// When a value is not finite.
    pub fn fit(
        given: Given<'a>,
        training: &[Sample],
        output: &[Modality],
        horizon: usize,
    ) -> Result<Option<Self>, JudgeError> {
        let layout = given.samples.layout();
        let output = vectors_in(given.samples, output);
        if output.is_empty() {
            return Ok(None);
        }
        let widths = output.iter().map(|modality| layout[*modality].width()).sum();
        let inputs = given.values(&training[..1], horizon)?.len();
        let mut sums = RidgeSums::new(inputs, widths);
        for at in training.chunks(BATCH) {
            sums.add(&given.values(at, horizon)?, &side_by_side(given.samples, &output, at, horizon))?;
        }
        Ok(Some(Self { given, horizon, output, regression: sums.solve(ALPHA)? }))
    }
}

impl Predictor for Ridge<'_> {
    fn name(&self) -> &str {
        models::RIDGE
    }

    fn predict(&self, at: &[Sample], receive: &mut Receive) -> Result<(), JudgeError> {
        let predicted = self.regression.predict(&self.given.values(at, self.horizon)?)?;
        let layout = self.given.samples.layout();
        let mut first = 0;
        for &modality in &self.output {
            let width = layout[modality].width();
            let rows = predicted.chunks_exact(predicted.len() / at.len());
            let values = rows.flat_map(|row| &row[first..first + width]).copied().collect();
            receive(&Predicted { modality, horizon: self.horizon, values, ensemble: None })?;
            first += width;
        }
        Ok(())
    }
}

impl Given<'_> {
    /// Returns the normalized inputs at the samples `at`, `[at, inputs]`: the next `horizon` actions, the vectors, and
    /// the images reduced to small gray ones.
    pub(super) fn values(&self, at: &[Sample], horizon: usize) -> Result<Vec<f32>, MetricsError> {
        let Given { samples, sensed, normalizers, action, input } = *self;
        let vectors = normalizers.vectors(sensed, at, input);
        let steps = |sample: &Sample| (0..horizon).map(|step| sample.after(step)).collect::<Vec<_>>();
        let steps: Vec<Sample> = at.iter().flat_map(steps).collect();
        let actions = normalizers.actions(samples, &steps, action);
        let layout = samples.layout();
        let images: Vec<(Modality, [usize; 2])> =
            input.iter().filter_map(|modality| Some((*modality, layout[*modality].size()?))).collect();
        let rows = at.par_iter().enumerate().map(|(row, &sample)| {
            let mut values = row_of(&actions, row, at.len()).to_vec();
            values.extend_from_slice(row_of(&vectors, row, at.len()));
            for (modality, size) in &images {
                let mut frame = physical(sensed, *modality, &[sample]);
                normalizers.modalities[modality].normalize(&mut frame);
                values.extend(downsample_frame(&frame, *size)?);
            }
            Ok(values)
        });
        let rows: Vec<Vec<f32>> = rows.collect::<Result<_, MetricsError>>()?;
        Ok(rows.concat())
    }
}

/// Returns the vectors among modalities.
pub(super) fn vectors_in(samples: &Samples, modalities: &[Modality]) -> Vec<Modality> {
    let layout = samples.layout();
    modalities.iter().copied().filter(|modality| !layout[*modality].is_image()).collect()
}

/// Returns one of the rows of a matrix.
pub(super) fn row_of(values: &[f32], row: usize, rows: usize) -> &[f32] {
    let width = values.len() / rows;
    &values[row * width..][..width]
}

/// Returns the vectors `horizon` samples after those in `at`, side by side.
pub(super) fn side_by_side(
    samples: &Samples,
    vectors: &[Modality],
    at: &[Sample],
    horizon: usize,
) -> Vec<f32> {
    let later = |sample: &Sample| {
        let later = sample.after(horizon);
        vectors.iter().flat_map(move |modality| samples.vector(*modality, later).iter().copied())
    };
    at.iter().flat_map(later).collect()
}
