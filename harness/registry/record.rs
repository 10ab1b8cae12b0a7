//! The record of a run (`run.json`), and the tables that a run writes.

use super::command_line::command_of;
use super::{Provenance, REVISION, RegistryError, RunFolder, SPEC, identity, peak_memory_bytes};
use harness_judge::{FrameRow, MetricRow, PredictionRow};
use harness_metrics::contact::{Contact, QUANTILES};
use harness_metrics::epoch::Epoch;
use harness_shared::seal::{self, SealError, hex};
use harness_spec::{Layout, Modality, RunSpec, Task, World};
use harness_tables::schema::Table;
use harness_tables::{Stamp, TableError, data_type, read_footer, write_table};
use jiff::Timestamp;
use polars::prelude::*;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The tables that each run writes.
pub(super) const TABLES: [Table; 5] =
    [Table::Epochs, Table::Metrics, Table::Predictions, Table::Forces, Table::Frames];

/// What is wrong with a file that is a folder.
pub(super) const IN_ITS_PLACE: &str = "a folder is in its place";

/// The status of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// A process works on the run.
    Running,
    /// The run was started, and no process works on it. It is not written: a record that says `running` is read as
    /// interrupted if no process holds the lock of its folder.
    Interrupted,
    /// The run has ended, and its record lists all of its files.
    Done,
    /// The run ended with an error, which is the record's reason.
    Failed,
}

impl Status {
    /// The status as tables and the command line write it.
    pub fn name(self) -> &'static str {
        match self {
            Status::Running => "running",
            Status::Interrupted => "interrupted",
            Status::Done => "done",
            Status::Failed => "failed",
        }
    }
}

/// Wall times of a run's stages, in seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Timings {
    /// Collecting and loading the dataset, and evaluating the baselines. Runs that share this work have the same time.
    pub collect: f64,
    /// Training of the prediction.
    pub prediction: f64,
    /// Training of the reconstruction, or `None` without that task.
    pub reconstruction: Option<f64>,
    /// Evaluation on the test samples.
    pub evaluation: f64,
}

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

/// The size and checksum of a file of a finished run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileRecord {
    /// Size of the file in bytes.
    pub bytes: u64,
    /// Number of rows of a table; `None` for other files.
    pub rows: Option<usize>,
    /// SHA-256 of the whole file, in hexadecimal.
    pub sha256: String,
}

impl FileRecord {
    /// The entry of a file with these bytes, of which a table has `rows`.
    pub(super) fn of(bytes: &[u8], rows: Option<usize>) -> Self {
        Self { bytes: bytes.len() as u64, rows, sha256: hex(&Sha256::digest(bytes)) }
    }

    /// Reads the file at `path`.
    ///
    /// # Errors
    /// When the file can't be read, or its size or checksum is not this one.
    pub(super) fn read(&self, path: &Path) -> Result<Vec<u8>, RegistryError> {
        let damaged = |reason: String| Err(RegistryError::File { path: path.to_owned(), reason });
        let bytes = match std::fs::read(path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == ErrorKind::IsADirectory => return damaged(IN_ITS_PLACE.into()),
            Err(error) => return damaged(error.to_string()),
        };
        match self.check(&bytes) {
            Ok(()) => Ok(bytes),
            Err(reason) => damaged(reason),
        }
    }

    /// Compares the bytes of the file with this entry.
    ///
    /// # Errors
    /// When their number or their checksum is not this one. Returns the reason.
    pub(super) fn check(&self, bytes: &[u8]) -> Result<(), String> {
        if bytes.len() as u64 != self.bytes {
            return Err(format!("it has {} bytes instead of {}", bytes.len(), self.bytes));
        }
        if hex(&Sha256::digest(bytes)) != self.sha256 {
            return Err("it has changed since it was written: its SHA-256 differs".into());
        }
        Ok(())
    }
}

/// The record of a run: its spec, status, provenance and files. A row of the `runs` table is made from it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Name of the experiment.
    pub experiment: String,
    /// Id of the run, such as `empty-z4-seed0-5c94f6a8`.
    pub run: String,
    /// Status of the run.
    pub status: Status,
    /// Why the run failed; `None` if it did not.
    pub reason: Option<String>,
    /// Whether a trial of a search failed because its loss was no longer finite.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub diverged: bool,
    /// Hash of the spec.
    pub spec_hash: String,
    /// Name of the dataset's folder.
    pub dataset: String,
    /// When the run was started, in UTC, such as `2026-01-31T12:00:00Z`.
    pub started: String,
    /// Wall times of a finished run; `None` before.
    pub timings: Option<Timings>,
    /// Peak memory of the process at the end of the run, in bytes; `None` before, or where it is unknown.
    pub peak_memory_bytes: Option<u64>,
    /// Number of trained parameters of the prediction network; `None` before the run is done.
    pub parameters: Option<usize>,
    /// Source tree, versions, machine and command.
    pub provenance: Provenance,
    /// The run's resolved spec.
    pub spec: RunSpec,
    /// The modalities of the dataset's samples. A record without a layout has that of the finger.
    #[serde(default = "Layout::finger", skip_serializing_if = "is_finger", with = "shared")]
    pub layout: Arc<Layout>,
    /// The files of a finished run, by name; empty before.
    #[serde(default)]
    pub files: BTreeMap<String, FileRecord>,
}

fn is_finger(layout: &Arc<Layout>) -> bool {
    **layout == *Layout::finger()
}

/// Serializes a layout behind an `Arc` like the layout itself.
mod shared {
    use harness_spec::Layout;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};
    use std::sync::Arc;

    pub fn serialize<S: Serializer>(layout: &Arc<Layout>, serializer: S) -> Result<S::Ok, S::Error> {
        layout.as_ref().serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Arc<Layout>, D::Error> {
        Layout::deserialize(deserializer).map(Arc::new)
    }
}

/// The world of a run. Two runs with equal specs may have different worlds, because a spec has only the world's name.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum WorldOf {
    /// A built-in world.
    BuiltIn(String),
    /// The world file with this path, whatever it contains.
    File(PathBuf),
    /// The world of this dataset: an imported dataset, or a world file whose path is not known.
    Dataset(String),
}

impl RunRecord {
    /// The run's world.
    pub(super) fn world(&self) -> WorldOf {
        let name = self.spec.scenario.name();
        match &self.provenance.world_file {
            Some(path) => WorldOf::File(path.clone()),
            None if World::named(name).is_some() => WorldOf::BuiltIn(name.to_owned()),
            None => WorldOf::Dataset(self.dataset.clone()),
        }
    }

    /// The record of a run that starts now.
    pub(super) fn new(folder: &RunFolder, spec: &RunSpec, layout: &Arc<Layout>, by: &Provenance) -> Self {
        Self {
            experiment: folder.experiment.clone(),
            run: folder.id.clone(),
            status: Status::Running,
            reason: None,
            diverged: false,
            spec_hash: spec.hash(),
            dataset: folder.dataset.clone(),
            started: Timestamp::now().strftime("%Y-%m-%dT%H:%M:%SZ").to_string(),
            timings: None,
            peak_memory_bytes: None,
            parameters: None,
            provenance: Provenance { command: command_of(&by.command, spec), ..by.clone() },
            spec: spec.clone(),
            layout: layout.clone(),
            files: BTreeMap::new(),
        }
    }

    pub(super) fn failed(self, reason: &str) -> Self {
        let peak_memory_bytes = peak_memory_bytes();
        Self { status: Status::Failed, reason: Some(reason.to_owned()), peak_memory_bytes, ..self }
    }

    pub(super) fn done(self, outcome: &Outcome) -> Self {
        Self {
            status: Status::Done,
            timings: Some(outcome.timings),
            parameters: Some(outcome.parameters),
            peak_memory_bytes: peak_memory_bytes(),
            ..self
        }
    }

    /// The run's id without its hash, such as `cluttered-z64-seed0`.
    pub fn label(&self) -> String {
        self.spec.label()
    }

    /// The run's full name, `experiment/run`.
    pub fn name(&self) -> String {
        format!("{}/{}", self.experiment, self.run)
    }

    /// Number of episodes of a simulated dataset that the run used; 0 for an imported dataset.
    pub(super) fn episodes(&self) -> u32 {
        self.spec.simulation.as_ref().map_or(0, |simulation| simulation.episodes)
    }

    /// Whether this is the record of a published run, which is published without its networks and dataset.
    pub(super) fn is_published(&self) -> bool {
        self.status == Status::Done && self.expected_files().iter().any(|name| !self.files.contains_key(name))
    }

    /// The record with a list of these files of the run, as they are now.
    ///
    /// # Errors
    /// When a file can't be read.
    pub(super) fn with_files(self, folder: &RunFolder, names: Vec<String>) -> Result<Self, RegistryError> {
        let mut files = BTreeMap::new();
        for name in names {
            let path = folder.path.join(&name);
            let damaged = |reason: String| RegistryError::File { path: path.clone(), reason };
            let bytes = std::fs::read(&path).map_err(|error| damaged(error.to_string()))?;
            let rows = if name.ends_with(".parquet") { Some(read_footer(&path)?.rows) } else { None };
            files.insert(name, FileRecord::of(&bytes, rows));
        }
        Ok(Self { files, ..self })
    }

    /// The names of the files that a finished run of this spec has, besides its record.
    pub(super) fn expected_files(&self) -> Vec<String> {
        let tables = TABLES.iter().map(|table| table.file_name());
        let checkpoints = self.spec.tasks.iter().map(|task| format!("{}.safetensors", task.name()));
        std::iter::once(SPEC.to_owned()).chain(tables).chain(checkpoints).collect()
    }

    /// Whether an unfinished run may have a file of this name: a result, or the saved state of its training.
    pub(super) fn expects(&self, name: &str) -> bool {
        let is_state = name.contains(".state.") && name.contains(".safetensors");
        is_state || self.expected_files().iter().any(|expected| expected == name)
    }

    /// Compares a whole file with its entry in the record, and returns its path.
    ///
    /// Every reader of a run's table must do this first. Hashing 3 MB takes a few milliseconds. Polars detects few
    /// kinds of damage, and would return wrong numbers for the others.
    ///
    /// # Errors
    /// When the record does not list the file, the file can't be read, or its size or checksum differs.
    pub(super) fn check_file(&self, folder: &Path, name: &str) -> Result<PathBuf, RegistryError> {
        self.read_file(folder, name).map(|_| folder.join(name))
    }

    /// Reads a file and compares it with its entry in the record.
    pub(super) fn read_file(&self, folder: &Path, name: &str) -> Result<Vec<u8>, RegistryError> {
        self.listed(folder, name)?.read(&folder.join(name))
    }

    /// Whether the finished run has a file of this table. Published runs have none of tables without rows.
    pub fn has(&self, table: Table) -> bool {
        self.files.contains_key(&table.file_name()) || !self.is_published()
    }

    /// The record's entry for a file.
    ///
    /// # Errors
    /// When the record does not list the file.
    pub(super) fn listed(&self, folder: &Path, name: &str) -> Result<&FileRecord, RegistryError> {
        self.files.get(name).ok_or_else(|| RegistryError::File {
            path: folder.join(name),
            reason: "the run's record does not list it".into(),
        })
    }

    /// The revision of the method that made the run, or `None` if the run's id matches no revision up to this one.
    pub fn revision(&self) -> Option<u32> {
        let is_of = |revision: &u32| self.run.ends_with(&identity(&self.spec_hash, &self.dataset, *revision));
        (0..=REVISION).rev().find(is_of)
    }

    /// A hash that is the same for all runs that differ only in their seed.
    fn group_hash(&self) -> String {
        let spec = RunSpec { seed: 0, ..self.spec.clone() };
        let revision = self.revision().map_or("unknown".to_owned(), |revision| revision.to_string());
        let digest = Sha256::digest(format!("{} {} {revision}", spec.hash(), self.dataset));
        hex(&digest[..8])
    }

    /// Describes the first listed file that is damaged or missing, or returns `None` if all files are intact.
    pub(super) fn damage(&self, folder: &Path) -> Option<String> {
        self.files.par_iter().find_map_first(|(name, _)| {
            let RegistryError::File { reason, .. } = self.check_file(folder, name).err()? else {
                return None;
            };
            Some(format!("{name} is damaged: {reason}"))
        })
    }

    /// Reads a record, or returns `None` if the file does not exist.
    ///
    /// # Errors
    /// When the file can't be read, its seal does not match, or it is no record.
    pub(super) fn read(path: &Path) -> Result<Option<Self>, RegistryError> {
        let damaged = |reason: String| RegistryError::Record { path: path.to_owned(), reason };
        match seal::read(path) {
            Err(SealError::Read(error))
                if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) =>
            {
                Ok(None)
            }
            Err(error) => Err(damaged(error.to_string())),
            Ok(bytes) => serde_json::from_slice(&bytes).map(Some).map_err(|error| damaged(error.to_string())),
        }
    }

    /// Writes the record, with a seal.
    pub(super) fn write(&self, path: &Path) -> Result<(), RegistryError> {
        let damaged = |error: serde_json::Error| RegistryError::Record {
            path: path.to_owned(),
            reason: error.to_string(),
        };
        let mut json = serde_json::to_value(self).map_err(damaged)?;
        json[seal::KEY] = seal::BLANK.into();
        Ok(seal::write(path, format!("{json:#}\n").into_bytes())?)
    }

    /// The metadata that the run's table files carry about the run.
    pub(super) fn stamp(&self) -> Stamp {
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

    /// The values of the columns that identify the run. They are the first columns of every table of runs.
    fn key(&self) -> Vec<AnyValue<'static>> {
        let spec = &self.spec;
        vec![
            text(&self.experiment),
            text(&self.run),
            text(spec.scenario.name()),
            text(joined(&spec.input)),
            text(joined(&spec.output)),
            text(spec.network.preset.name()),
            count(spec.latent as u64),
            text(&spec.variant),
            count(spec.seed),
        ]
    }

    /// A table of the run: the columns that identify it, and then `columns`. `all` describes both.
    pub(super) fn with_key(
        &self,
        columns: Vec<Column>,
        all: &[harness_tables::schema::Column],
    ) -> PolarsResult<DataFrame> {
        let rows = columns.first().map_or(0, Column::len);
        let key = all.iter().zip(self.key()).map(|(column, value)| {
            Column::new_scalar(column.name.as_str().into(), Scalar::new(data_type(column.kind), value), rows)
        });
        DataFrame::new(rows, key.chain(columns).collect())
    }

    /// The run's row in the `runs` table, in the order of its columns.
    fn row(&self) -> Vec<AnyValue<'static>> {
        let by = &self.provenance;
        let seconds = |of: fn(&Timings) -> Option<f64>| {
            self.timings.as_ref().and_then(of).map_or(AnyValue::Null, AnyValue::Float64)
        };
        let mut row = self.key();
        row.extend([
            text(self.status.name()),
            optional(self.reason.as_deref()),
            text(&self.spec_hash),
            text(self.group_hash()),
            text(&self.dataset),
            self.spec.simulation.as_ref().map_or(AnyValue::Null, |simulation| count(simulation.seed)),
            optional(self.spec.reading()),
            optional(self.spec.role()),
            text(self.spec.split.by.name()),
            text(&self.started),
            seconds(|timings| Some(timings.collect)),
            seconds(|timings| Some(timings.prediction)),
            seconds(|timings| timings.reconstruction),
            seconds(|timings| Some(timings.evaluation)),
            self.peak_memory_bytes.map_or(AnyValue::Null, count),
            self.parameters.map_or(AnyValue::Null, |parameters| count(parameters as u64)),
            optional(by.git_commit.as_deref()),
            by.git_dirty.map_or(AnyValue::Null, AnyValue::Boolean),
            text(&by.harness_version),
            text(&by.mujoco_version),
            text(&by.candle_version),
            text(&by.host),
            text(&by.processor),
            count(by.threads as u64),
            text(&by.command),
        ]);
        row
    }
}

fn text(value: impl AsRef<str>) -> AnyValue<'static> {
    AnyValue::StringOwned(value.as_ref().into())
}

fn optional(value: Option<&str>) -> AnyValue<'static> {
    value.map_or(AnyValue::Null, text)
}

fn count(value: u64) -> AnyValue<'static> {
    AnyValue::Int64(value as i64)
}

fn joined(modalities: &[Modality]) -> String {
    modalities.iter().map(|modality| modality.name()).collect::<Vec<_>>().join("+")
}

/// The `runs` table, with a row for each record.
pub(super) fn runs_table(records: &[RunRecord]) -> PolarsResult<DataFrame> {
    let rows: Vec<Vec<AnyValue>> = records.par_iter().map(RunRecord::row).collect();
    let columns = Table::Runs.columns().into_iter().enumerate().map(|(index, column)| {
        let values: Vec<AnyValue> = rows.iter().map(|row| row[index].clone()).collect();
        let series =
            Series::from_any_values_and_dtype(column.name.into(), &values, &data_type(column.kind), true)?;
        Ok(series.into())
    });
    DataFrame::new(rows.len(), columns.collect::<PolarsResult<Vec<Column>>>()?)
}

/// The columns of the table `epochs` without those of the run.
pub(super) fn epochs_columns(epochs: &[(Task, Epoch)]) -> Vec<Column> {
    let rows: Vec<(Task, usize, &str, &str, f64, f64)> = epochs
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

impl Outcome {
    /// Writes all tables of the run to its folder.
    pub(super) fn write_tables(&self, folder: &RunFolder, record: &RunRecord) -> Result<(), RegistryError> {
        let columns = [
            epochs_columns(&self.epochs),
            self.metrics_columns(),
            self.predictions_columns(),
            self.forces_columns(),
            self.frames_columns(),
        ];
        for (table, columns) in TABLES.into_iter().zip(columns) {
            let frame = record.with_key(columns, &table.columns()).map_err(TableError::from)?;
            let path = folder.path.join(table.file_name());
            write_table(&path, frame, &table.columns(), &record.stamp())?;
        }
        Ok(())
    }

    fn metrics_columns(&self) -> Vec<Column> {
        let rows = &self.metrics;
        vec![
            Column::new("task".into(), rows.iter().map(|row| row.task.name()).collect::<Vec<_>>()),
            Column::new("model".into(), rows.iter().map(|row| row.model.as_str()).collect::<Vec<_>>()),
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
            Column::new("unit".into(), rows.iter().map(|row| row.row.unit.as_str()).collect::<Vec<_>>()),
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

    fn forces_columns(&self) -> Vec<Column> {
        let rows: Vec<(&ForceRows, usize, &Contact)> = self
            .forces
            .iter()
            .flat_map(|rows| rows.links.iter().enumerate().map(move |(link, contact)| (rows, link, contact)))
            .collect();
        let mut columns = vec![
            Column::new("modality".into(), rows.iter().map(|row| row.0.modality.name()).collect::<Vec<_>>()),
            Column::new(
                "episode".into(),
                rows.iter().map(|row| row.0.episode.map(i64::from)).collect::<Vec<_>>(),
            ),
            Column::new("index".into(), rows.iter().map(|row| row.1 as i64).collect::<Vec<_>>()),
            Column::new("samples".into(), rows.iter().map(|row| row.2.samples as i64).collect::<Vec<_>>()),
            Column::new("contacts".into(), rows.iter().map(|row| row.2.contacts as i64).collect::<Vec<_>>()),
            Column::new("mean".into(), rows.iter().map(|row| row.2.mean).collect::<Vec<_>>()),
        ];
        columns.extend(QUANTILES.iter().enumerate().map(|(place, (name, _))| {
            let values = rows.iter().map(|row| row.2.quantiles.map(|quantiles| quantiles[place]));
            Column::new((*name).into(), values.collect::<Vec<_>>())
        }));
        columns.push(Column::new("max".into(), rows.iter().map(|row| row.2.max).collect::<Vec<_>>()));
        columns
    }

    fn frames_columns(&self) -> Vec<Column> {
        let rows = &self.frames;
        let pictures = |name: &str, of: fn(&FrameRow) -> &[u8]| {
            let column: BinaryChunked = rows.iter().map(|row| Some(of(row))).collect();
            column.with_name(name.into()).into_series().into()
        };
        vec![
            Column::new("task".into(), rows.iter().map(|row| row.task.name()).collect::<Vec<_>>()),
            Column::new("modality".into(), rows.iter().map(|row| row.modality.name()).collect::<Vec<_>>()),
            Column::new("episode".into(), rows.iter().map(|row| i64::from(row.episode)).collect::<Vec<_>>()),
            Column::new("sample".into(), rows.iter().map(|row| i64::from(row.sample)).collect::<Vec<_>>()),
            Column::new("motion".into(), rows.iter().map(|row| row.motion).collect::<Vec<_>>()),
            pictures("reference", |row| &row.reference),
            pictures("predicted", |row| &row.predicted),
        ]
    }
}
