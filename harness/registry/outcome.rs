//! The results of a finished run, as the tables that it writes.

use super::RegistryError;
use super::record::{RunRecord, Timings};
use harness_judge::{FrameRow, Judged, MetricRow, PredictionRow, SumRow, is_usual, models};
use harness_metrics::contact::{Contact, QUANTILES};
use harness_metrics::epoch::Epoch;
use harness_spec::{Modality, Task};
use harness_tables::schema::{GIVEN, HORIZON, TRAINED_HERE, Table};
use harness_tables::{TableError, column_of};
use polars::prelude::*;

/// Rows of the forces table, one for each link, without the columns that identify the run.
#[derive(Debug, Clone)]
pub struct ForceRows {
    /// The vector of forces.
    pub modality: Modality,
    /// The episode that the rows summarize, or `None` for the whole dataset.
    pub episode: Option<u32>,
    /// The distribution of each link's force, from the base on.
    pub links: Vec<Contact>,
}

/// The results of a finished run.
#[derive(Default)]
pub struct Outcome {
    /// The losses of each epoch.
    pub epochs: Vec<(Task, Epoch)>,
    /// The rows of the metrics table.
    pub metrics: Vec<MetricRow>,
    /// The rows of the table of sums.
    pub sums: Vec<SumRow>,
    /// The rows of the predictions table.
    pub predictions: Vec<PredictionRow>,
    /// The rows of the forces table.
    pub forces: Vec<ForceRows>,
    /// The rows of the frames table.
    pub frames: Vec<FrameRow>,
    /// The wall times of the run's stages.
    pub timings: Timings,
    /// Number of trained parameters of the prediction network.
    pub parameters: usize,
}

/// The columns of the table `epochs` without those of the run.
pub(super) fn epochs_columns(epochs: &[(Task, Epoch)]) -> Vec<Column> {
    let mut rows = Vec::new();
    for (task, epoch) in epochs {
        for (split, losses) in [("train", &epoch.train), ("validation", &epoch.validation)] {
            rows.extend(losses.iter().map(|loss| (*task, epoch, split, loss)));
        }
    }
    vec![
        column_of(&rows, "task", |(task, ..)| task.name()),
        column_of(&rows, "epoch", |(_, epoch, ..)| epoch.epoch as i64),
        column_of(&rows, "split", |(_, _, split, _)| *split),
        column_of(&rows, "term", |(.., (term, _))| term.as_str()),
        column_of(&rows, "value", |(.., (_, value))| **value),
        column_of(&rows, "seconds", |(_, epoch, ..)| epoch.seconds),
    ]
}

impl Outcome {
    /// Adds the rows of a predictor.
    pub fn extend(&mut self, judged: Judged) {
        let Judged { metrics, sums, predictions, frames } = judged;
        self.metrics.extend(metrics);
        self.sums.extend(sums);
        self.predictions.extend(predictions);
        self.frames.extend(frames);
    }

    /// Returns all tables of the run.
    pub(super) fn tables(&self, record: &RunRecord) -> Result<Vec<(Table, DataFrame)>, RegistryError> {
        let (metrics, further_metrics): (Vec<&MetricRow>, _) =
            self.metrics.iter().partition(|row| is_usual(row.horizon, row.given));
        let (predictions, further_predictions): (Vec<&PredictionRow>, _) =
            self.predictions.iter().partition(|row| is_usual(row.horizon as usize, row.given));
        let mut tables = vec![
            (Table::Epochs, epochs_columns(&self.epochs)),
            (Table::Metrics, metrics_columns(&metrics)),
            (Table::Predictions, predictions_columns(&predictions)),
            (Table::Forces, self.forces_columns()),
            (Table::Frames, self.frames_columns()),
        ];
        if !further_metrics.is_empty() {
            let further = further_columns(&further_metrics, |row| row.horizon as i64, |row| row.given);
            tables.push((Table::AllMetrics, [metrics_columns(&further_metrics), further].concat()));
        }
        if !further_predictions.is_empty() {
            let further = further_columns(&further_predictions, |row| row.horizon.into(), |row| row.given);
            tables
                .push((Table::AllPredictions, [predictions_columns(&further_predictions), further].concat()));
        }
        if !self.sums.is_empty() {
            tables.push((Table::Sums, sums_columns(&self.sums)));
        }
        let tables = tables
            .into_iter()
            .map(|(table, columns)| Ok((table, record.with_key(columns).map_err(TableError::from)?)));
        tables.collect()
    }

    fn forces_columns(&self) -> Vec<Column> {
        let mut rows = Vec::new();
        for of_vector in &self.forces {
            let links = of_vector.links.iter().enumerate();
            rows.extend(links.map(|(link, contact)| (of_vector, link as i64, contact)));
        }
        let mut columns = vec![
            column_of(&rows, "modality", |(vector, ..)| vector.modality.name()),
            column_of(&rows, "episode", |(vector, ..)| vector.episode.map(i64::from)),
            column_of(&rows, "index", |(_, link, _)| *link),
            column_of(&rows, "samples", |(.., contact)| contact.samples as i64),
            column_of(&rows, "contacts", |(.., contact)| contact.contacts as i64),
            column_of(&rows, "mean", |(.., contact)| contact.mean),
        ];
        columns.extend(QUANTILES.iter().enumerate().map(|(place, (name, _))| {
            column_of(&rows, name, |(.., contact)| contact.quantiles.map(|quantiles| quantiles[place]))
        }));
        columns.push(column_of(&rows, "max", |(.., contact)| contact.max));
        columns
    }

    fn frames_columns(&self) -> Vec<Column> {
        let rows = &self.frames;
        vec![
            column_of(rows, "task", |row| row.task.name()),
            column_of(rows, "modality", |row| row.modality.name()),
            column_of(rows, "episode", |row| i64::from(row.episode)),
            column_of(rows, "sample", |row| i64::from(row.sample)),
            column_of(rows, "motion", |row| row.motion),
            column_of(rows, "reference", |row| row.reference.as_slice()),
            column_of(rows, "predicted", |row| row.predicted.as_slice()),
        ]
    }
}

/// The columns of the table `metrics` without those of the run.
fn metrics_columns(rows: &[&MetricRow]) -> Vec<Column> {
    vec![
        column_of(rows, "task", |row| row.task.name()),
        column_of(rows, "model", |row| row.model.as_str()),
        column_of(rows, TRAINED_HERE, |row| row.model == models::NETWORK),
        column_of(rows, "modality", |row| row.row.modality.name()),
        column_of(rows, "direction", |row| row.row.direction.map(|direction| direction.name())),
        column_of(rows, "index", |row| row.row.index.map(i64::from)),
        column_of(rows, "metric", |row| row.row.metric.name()),
        column_of(rows, "value", |row| row.row.value),
        column_of(rows, "unit", |row| row.row.unit.as_str()),
    ]
}

/// The columns of the table `sums` without those of the run.
fn sums_columns(rows: &[SumRow]) -> Vec<Column> {
    vec![
        column_of(rows, "task", |of| of.task.name()),
        column_of(rows, "model", |of| of.model.as_str()),
        column_of(rows, "modality", |of| of.row.modality.name()),
        column_of(rows, "direction", |of| of.row.direction.map(|direction| direction.name())),
        column_of(rows, "metric", |of| of.row.metric.name()),
        column_of(rows, HORIZON, |of| of.horizon as i64),
        column_of(rows, GIVEN, |of| of.given),
        column_of(rows, "episode", |of| i64::from(of.row.episode)),
        column_of(rows, "numerator", |of| rounded(of.row.numerator)),
        column_of(rows, "denominator", |of| rounded(of.row.denominator)),
    ]
}

/// A number rounded to 10 binary digits, which makes the file of many such numbers smaller by a third.
fn rounded(value: f64) -> f32 {
    const DROPPED: u32 = f32::MANTISSA_DIGITS - 10;
    let bits = (value as f32).to_bits() + (1 << (DROPPED - 1));
    f32::from_bits(bits >> DROPPED << DROPPED)
}

/// The columns that rows of further samples and of models that got only some inputs have in addition.
fn further_columns<R>(
    rows: &[R],
    horizon: impl Fn(&R) -> i64,
    given: impl Fn(&R) -> Option<&'static str>,
) -> Vec<Column> {
    vec![column_of(rows, HORIZON, horizon), column_of(rows, GIVEN, given)]
}

/// The columns of the table `predictions` without those of the run.
fn predictions_columns(rows: &[&PredictionRow]) -> Vec<Column> {
    vec![
        column_of(rows, "task", |row| row.task.name()),
        column_of(rows, "modality", |row| row.modality.name()),
        column_of(rows, "episode", |row| i64::from(row.episode)),
        column_of(rows, "sample", |row| i64::from(row.sample)),
        column_of(rows, "index", |row| i64::from(row.index)),
        column_of(rows, "reference", |row| row.reference),
        column_of(rows, "predicted", |row| row.predicted),
    ]
}
