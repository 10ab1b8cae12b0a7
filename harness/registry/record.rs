//! The record of a run, and its tables.

use super::{Provenance, RegistryError, RunFolder, peak_memory_bytes};
use crate::experiment::{MetricRow, PredictionRow};
use crate::files::write_bytes;
use crate::learning::training::Epoch;
use crate::schema::Table;
use crate::spec::{Modality, RunSpec, Task};
use crate::tables::{Stamp, TableError, write_table};
use jiff::Timestamp;
use polars::prelude::*;
use serde::{Deserialize, Serialize};
use std::io::ErrorKind;
use std::path::Path;

/// How far a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    Running,
    Done,
    Failed,
}

impl Status {
    pub fn name(self) -> &'static str {
        match self {
            Status::Running => "running",
            Status::Done => "done",
            Status::Failed => "failed",
        }
    }
}

/// Wall times of a run's stages, s.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Timings {
    /// Collecting, loading and judging the dataset, once for all runs of a scenario.
    pub collect: f64,
    pub prediction: f64,
    pub reconstruction: Option<f64>,
    pub evaluation: f64,
}

/// What a run that came to its end has to show.
#[derive(Default)]
pub struct Outcome {
    pub epochs: Vec<(Task, Epoch)>,
    pub metrics: Vec<MetricRow>,
    pub predictions: Vec<PredictionRow>,
    pub timings: Timings,
    /// Trained parameters of the prediction.
    pub parameters: usize,
}

/// A row of the `runs` table, with the run's whole spec.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    pub experiment: String,
    pub run: String,
    pub status: Status,
    pub reason: Option<String>,
    pub spec_hash: String,
    pub dataset: String,
    /// UTC.
    pub started: String,
    pub timings: Option<Timings>,
    pub peak_memory_bytes: Option<u64>,
    pub parameters: Option<usize>,
    pub provenance: Provenance,
    pub spec: RunSpec,
}

impl RunRecord {
    pub(super) fn new(folder: &RunFolder, spec: &RunSpec, by: &Provenance, status: Status) -> Self {
        Self {
            experiment: folder.experiment.clone(),
            run: folder.id.clone(),
            status,
            reason: None,
            spec_hash: spec.hash(),
            dataset: folder.dataset.clone(),
            started: Timestamp::now().strftime("%Y-%m-%dT%H:%M:%SZ").to_string(),
            timings: None,
            peak_memory_bytes: peak_memory_bytes(),
            parameters: None,
            provenance: by.clone(),
            spec: spec.clone(),
        }
    }

    pub(super) fn with(self, outcome: &Outcome) -> Self {
        Self { timings: Some(outcome.timings), parameters: Some(outcome.parameters), ..self }
    }

    /// The run in short, without its hash.
    pub fn label(&self) -> String {
        self.spec.label()
    }

    /// Reads a record; `None` if there is none.
    pub(super) fn read(path: &Path) -> Result<Option<Self>, RegistryError> {
        let damaged = |reason: String| RegistryError::Record { path: path.to_owned(), reason };
        match std::fs::read(path) {
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(error) => Err(damaged(error.to_string())),
            Ok(bytes) => serde_json::from_slice(&bytes).map(Some).map_err(|error| damaged(error.to_string())),
        }
    }

    pub(super) fn write(&self, path: &Path) -> Result<(), RegistryError> {
        let damaged = |error: serde_json::Error| RegistryError::Record {
            path: path.to_owned(),
            reason: error.to_string(),
        };
        let text = serde_json::to_string_pretty(self).map_err(damaged)?;
        Ok(write_bytes(path, format!("{text}\n").as_bytes())?)
    }

    /// What a table's file says about the run that made it.
    fn stamp(&self) -> Stamp {
        let by = &self.provenance;
        let text = |value: &Option<String>| value.clone().unwrap_or_else(|| "none".into());
        Stamp::from([
            ("run".into(), self.run.clone()),
            ("spec_hash".into(), self.spec_hash.clone()),
            ("dataset".into(), self.dataset.clone()),
            ("seed".into(), self.spec.seed.to_string()),
            ("git_commit".into(), text(&by.git_commit)),
            ("git_dirty".into(), by.git_dirty.map_or("none".into(), |dirty| dirty.to_string())),
            ("harness_version".into(), by.harness_version.clone()),
            ("mujoco_version".into(), by.mujoco_version.clone()),
            ("candle_version".into(), by.candle_version.clone()),
            ("host".into(), by.host.clone()),
        ])
    }

    /// The columns that tell the run from others, `rows` high.
    fn key_columns(&self, rows: usize) -> Vec<Column> {
        let spec = &self.spec;
        let text = |name: &str, value: &str| {
            Column::new_scalar(name.into(), Scalar::from(PlSmallStr::from_str(value)), rows)
        };
        vec![
            text("experiment", &self.experiment),
            text("run", &self.run),
            text("scenario", spec.scenario.name()),
            text("input", &joined(&spec.input)),
            text("output", &joined(&spec.output)),
            text("architecture", spec.network.architecture.name()),
            Column::new_scalar("latent".into(), Scalar::from(spec.latent as i64), rows),
            Column::new_scalar("seed".into(), Scalar::from(spec.seed as i64), rows),
        ]
    }
}

fn joined(modalities: &[Modality]) -> String {
    modalities.iter().map(|modality| modality.name()).collect::<Vec<_>>().join("+")
}

/// The `runs` table.
pub(super) fn runs_table(records: &[RunRecord]) -> PolarsResult<DataFrame> {
    let keys = records.iter().map(|record| DataFrame::new(1, record.key_columns(1))?.lazy().collect());
    let keys = keys.collect::<PolarsResult<Vec<_>>>()?;
    let rows = records.len();
    let mut columns: Vec<Column> =
        match concat(keys.into_iter().map(IntoLazy::lazy).collect::<Vec<_>>(), UnionArgs::default()) {
            Ok(keys) => keys.collect()?.columns().to_vec(),
            Err(_) => Vec::new(),
        };
    let by = |record: &RunRecord| record.provenance.clone();
    macro_rules! add {
        ($($name:literal => $value:expr),+ $(,)?) => {
            $(columns.push(Column::new($name.into(), records.iter().map($value).collect::<Vec<_>>()));)+
        };
    }
    add! {
        "status" => |record: &RunRecord| record.status.name(),
        "reason" => |record: &RunRecord| record.reason.clone(),
        "spec_hash" => |record: &RunRecord| record.spec_hash.clone(),
        "dataset" => |record: &RunRecord| record.dataset.clone(),
        "started" => |record: &RunRecord| record.started.clone(),
        "collect_seconds" => |record: &RunRecord| record.timings.map(|t| t.collect),
        "prediction_seconds" => |record: &RunRecord| record.timings.map(|t| t.prediction),
        "reconstruction_seconds" => |record: &RunRecord| record.timings.and_then(|t| t.reconstruction),
        "evaluation_seconds" => |record: &RunRecord| record.timings.map(|t| t.evaluation),
        "peak_memory_bytes" => |record: &RunRecord| record.peak_memory_bytes.map(|bytes| bytes as i64),
        "parameters" => |record: &RunRecord| record.parameters.map(|count| count as i64),
        "git_commit" => |record: &RunRecord| by(record).git_commit,
        "git_dirty" => |record: &RunRecord| by(record).git_dirty,
        "harness_version" => |record: &RunRecord| by(record).harness_version,
        "mujoco_version" => |record: &RunRecord| by(record).mujoco_version,
        "candle_version" => |record: &RunRecord| by(record).candle_version,
        "host" => |record: &RunRecord| by(record).host,
        "processor" => |record: &RunRecord| by(record).processor,
        "threads" => |record: &RunRecord| by(record).threads as i64,
        "command" => |record: &RunRecord| by(record).command,
    }
    DataFrame::new(rows, columns)
}

impl Outcome {
    pub(super) fn write_tables(&self, folder: &RunFolder, record: &RunRecord) -> Result<(), RegistryError> {
        let tables = [
            (Table::Epochs, self.epochs_columns()),
            (Table::Metrics, self.metrics_columns()),
            (Table::Predictions, self.predictions_columns()),
        ];
        for (table, columns) in tables {
            let rows = columns.first().map_or(0, Column::len);
            let columns = [record.key_columns(rows), columns].concat();
            let frame = DataFrame::new(rows, columns).map_err(TableError::from)?;
            let path = folder.path.join(format!("{}.parquet", table.name()));
            write_table(&path, frame, &table.columns(), &record.stamp())?;
        }
        Ok(())
    }

    fn epochs_columns(&self) -> Vec<Column> {
        let rows: Vec<(Task, usize, &str, &str, f64, f64)> = self
            .epochs
            .iter()
            .flat_map(|(task, epoch)| {
                [("train", &epoch.train), ("validation", &epoch.validation)].into_iter().flat_map(
                    move |(split, losses)| {
                        losses.iter().map(move |(term, value)| {
                            (*task, epoch.epoch, split, term.as_str(), *value, epoch.seconds)
                        })
                    },
                )
            })
            .collect();
        vec![
            Column::new("task".into(), rows.iter().map(|row| row.0.name()).collect::<Vec<_>>()),
            Column::new("epoch".into(), rows.iter().map(|row| row.1 as i64).collect::<Vec<_>>()),
            Column::new("split".into(), rows.iter().map(|row| row.2).collect::<Vec<_>>()),
            Column::new("term".into(), rows.iter().map(|row| row.3).collect::<Vec<_>>()),
            Column::new("value".into(), rows.iter().map(|row| row.4).collect::<Vec<_>>()),
            Column::new("seconds".into(), rows.iter().map(|row| row.5).collect::<Vec<_>>()),
        ]
    }

    fn metrics_columns(&self) -> Vec<Column> {
        let rows = &self.metrics;
        vec![
            Column::new("task".into(), rows.iter().map(|row| row.task.name()).collect::<Vec<_>>()),
            Column::new("model".into(), rows.iter().map(|row| row.model).collect::<Vec<_>>()),
            Column::new(
                "modality".into(),
                rows.iter().map(|row| row.row.modality.name()).collect::<Vec<_>>(),
            ),
            Column::new(
                "direction".into(),
                rows.iter()
                    .map(|row| row.row.direction.map(|direction| direction.name()))
                    .collect::<Vec<_>>(),
            ),
            Column::new(
                "index".into(),
                rows.iter().map(|row| row.row.index.map(i64::from)).collect::<Vec<_>>(),
            ),
            Column::new("metric".into(), rows.iter().map(|row| row.row.metric.name()).collect::<Vec<_>>()),
            Column::new("value".into(), rows.iter().map(|row| row.row.value).collect::<Vec<_>>()),
            Column::new("unit".into(), rows.iter().map(|row| row.row.unit()).collect::<Vec<_>>()),
        ]
    }

    fn predictions_columns(&self) -> Vec<Column> {
        let rows = &self.predictions;
        vec![
            Column::new("task".into(), rows.iter().map(|row| row.task.name()).collect::<Vec<_>>()),
            Column::new("modality".into(), rows.iter().map(|row| row.modality.name()).collect::<Vec<_>>()),
            Column::new("episode".into(), rows.iter().map(|row| i64::from(row.episode)).collect::<Vec<_>>()),
            Column::new("sample".into(), rows.iter().map(|row| i64::from(row.sample)).collect::<Vec<_>>()),
            Column::new("index".into(), rows.iter().map(|row| i64::from(row.index)).collect::<Vec<_>>()),
            Column::new("reference".into(), rows.iter().map(|row| row.reference).collect::<Vec<_>>()),
            Column::new("predicted".into(), rows.iter().map(|row| row.predicted).collect::<Vec<_>>()),
        ]
    }
}
