//! The record of a run (`run.json`), and the table of all runs.

use super::command_line::command_of;
use super::{Provenance, REVISION, RegistryError, RunFolder, SPEC, identity};
use crate::dataset::WorldVersion;
use harness_judge::models;
use harness_shared::seal::{self, SealError, hex};
use harness_spec::{Layout, Modality, Origin, RunSpec, Simulation, World};
use harness_tables::schema::Table;
use harness_tables::{Stamp, column_of, read_footer};
use jiff::Timestamp;
use polars::prelude::*;
use rayon::prelude::*;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The tables that each run writes.
const TABLES: [Table; 5] = [Table::Epochs, Table::Metrics, Table::Predictions, Table::Forces, Table::Frames];
/// The tables that a run writes if it has rows of them.
const FURTHER_TABLES: [Table; 3] = [Table::AllMetrics, Table::AllPredictions, Table::Sums];

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

/// The size and checksum of a file of a finished run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileRecord {
    /// Size of the file in bytes.
    pub bytes: u64,
    /// Number of rows of a table; `None` for other files.
    pub rows: Option<usize>,
    /// SHA-256 of the whole file, in hexadecimal.
    pub sha256: String,
    /// What the file is replaced with while a user's metric is added to the run. As long as it is listed, the file may
    /// be the one or the other, so that the run is intact whenever the process is killed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<Box<FileRecord>>,
    /// The rows of a published run in the file of its experiment; `None` if the file is the run's own.
    #[serde(skip)]
    pub slice: Option<Slice>,
}

/// Consecutive rows of a file that has the rows of several runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Slice {
    /// The file.
    pub file: Arc<Path>,
    /// The number of rows before those of the run.
    pub offset: usize,
}

impl FileRecord {
    /// The entry of a file with these bytes, of which a table has `rows`.
    pub fn of(bytes: &[u8], rows: Option<usize>) -> Self {
        Self { bytes: bytes.len() as u64, rows, sha256: hex(&Sha256::digest(bytes)), next: None, slice: None }
    }

    /// Reads the file, which is at `path` if it is the run's own.
    pub fn read(&self, path: &Path) -> Result<Vec<u8>, RegistryError> {
        let path = self.slice.as_ref().map_or(path, |slice| &slice.file);
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

    /// The entry of the file at `path` as it is now: this one, or the next one.
    pub fn settled(&self, path: &Path) -> Self {
        let next = self.next.as_deref().filter(|next| next.read(path).is_ok());
        Self { next: None, ..next.unwrap_or(self).clone() }
    }

    /// Compares the bytes of the file with this entry.
    ///
    /// # Errors
    /// When their number or their checksum is not this one. Returns the reason.
    pub fn check(&self, bytes: &[u8]) -> Result<(), String> {
        if self.next.as_ref().is_some_and(|next| next.check(bytes).is_ok()) {
            return Ok(());
        }
        if bytes.len() as u64 != self.bytes {
            return Err(format!("it has {} bytes instead of {}", bytes.len(), self.bytes));
        }
        if hex(&Sha256::digest(bytes)) != self.sha256 {
            return Err("it has changed since it was written: its SHA-256 differs".into());
        }
        Ok(())
    }
}

/// The predictions of an external model that were judged.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Submission {
    /// Hash of the task: the dataset, the split, the inputs, the outputs and the window.
    pub task: String,
    /// SHA-256 of the predicted values in hexadecimal. It does not depend on the order of the rows.
    pub predictions_sha256: String,
    /// What the user says about the model, such as its commit, the versions of packages, or seconds of training.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub notes: BTreeMap<String, String>,
    /// Name of the file in the run's folder that holds the model itself; `None` if the user attached none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub network: Option<String>,
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
    /// Whether this is the record of a published copy, which has neither networks nor a dataset.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub published: bool,
    /// Hash of the spec.
    pub spec_hash: String,
    /// Name of the dataset's folder.
    pub dataset: String,
    /// Name of the folder of the dataset that only the test uses; `None` if the run has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub test_dataset: Option<String>,
    /// When the run was started, in UTC, such as `2026-01-31T12:00:00.123456Z`.
    pub started: String,
    /// Wall times of a finished run; `None` before.
    pub timings: Option<Timings>,
    /// Peak memory of the process at the end of the run, in bytes; `None` before, or where it is unknown.
    pub peak_memory_bytes: Option<u64>,
    /// Number of trained parameters of the prediction network; `None` before the run is done.
    pub parameters: Option<usize>,
    /// Source tree, versions, machine and command.
    pub provenance: Provenance,
    /// The predictions of an external model, and what its user says about it; `None` for a network.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub submission: Option<Submission>,
    /// Position of the run's variant among those of the experiment that it was made for. It is 0 in records of earlier
    /// versions.
    #[serde(default, skip_serializing_if = "is_first")]
    pub place: usize,
    /// The run's resolved spec.
    pub spec: RunSpec,
    /// The modalities of the dataset's samples. A record without a layout has that of the finger.
    #[serde(default = "Layout::finger", skip_serializing_if = "is_finger", with = "shared")]
    pub layout: Arc<Layout>,
    /// The files of a finished run, by name; empty before.
    #[serde(default)]
    pub files: BTreeMap<String, FileRecord>,
    /// The resolved spec in YAML, with every default, of a published run that is merged with others; see `merged`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub spec_yaml: Option<String>,
}

fn is_first(place: &usize) -> bool {
    *place == 0
}

fn is_finger(layout: &Arc<Layout>) -> bool {
    **layout == *Layout::finger()
}

/// Serializes a layout behind an `Arc` like the layout itself, and reads equal ones once. A layout is three quarters of a
/// record, and that of most runs in a folder is the same.
mod shared {
    use harness_spec::Layout;
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};
    use serde_json::value::RawValue;
    use std::collections::HashMap;
    use std::sync::{Arc, LazyLock, PoisonError, RwLock};

    /// The layouts that were read, by their JSON.
    static READ: LazyLock<RwLock<HashMap<Box<str>, Arc<Layout>>>> = LazyLock::new(RwLock::default);

    pub fn serialize<S: Serializer>(layout: &Arc<Layout>, serializer: S) -> Result<S::Ok, S::Error> {
        layout.as_ref().serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Arc<Layout>, D::Error> {
        let json = Box::<RawValue>::deserialize(deserializer)?;
        if let Some(layout) = READ.read().unwrap_or_else(PoisonError::into_inner).get(json.get()) {
            return Ok(layout.clone());
        }
        let layout: Arc<Layout> = Arc::new(serde_json::from_str(json.get()).map_err(D::Error::custom)?);
        READ.write().unwrap_or_else(PoisonError::into_inner).insert(json.get().into(), layout.clone());
        Ok(layout)
    }
}

/// The world of a run. Two runs with equal specs may have different worlds, because a spec has only the world's name.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum WorldOf {
    /// A built-in world.
    BuiltIn(String),
    /// The world file with this path, whatever it contains.
    File(PathBuf),
    /// The world of this dataset: an imported dataset, or a world file whose path is not known.
    Dataset(String),
}

/// The world of a run, and that of its test if this is another one.
pub(super) type Worlds = (WorldOf, Option<WorldOf>);

impl WorldOf {
    /// The world with this name, of the file `file` if it is not built in, in which a dataset was simulated.
    fn new(scenario: &Origin, file: &Option<PathBuf>, dataset: &str) -> Self {
        match file {
            Some(path) => Self::File(path.clone()),
            None if World::named(scenario.name()).is_some() => Self::BuiltIn(scenario.name().to_owned()),
            None => Self::Dataset(dataset.to_owned()),
        }
    }
}

/// A dataset that was simulated for a run.
#[derive(Debug, Clone)]
pub(super) struct SimulatedFor<'a> {
    /// Name of the dataset.
    pub dataset: &'a str,
    /// Name of its world.
    pub scenario: &'a Origin,
    /// Its world.
    pub world: WorldOf,
    /// The version of the world; `None` if it is not known.
    pub version: Option<&'a WorldVersion>,
    /// The settings of the simulation.
    pub simulation: Simulation,
}

/// Reads a sealed record or list of records, or returns `None` if the file does not exist.
pub(super) fn read_sealed<T: DeserializeOwned>(path: &Path) -> Result<Option<T>, RegistryError> {
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

/// Whether a file of a finished run with this name belongs to a network, or is an attached model.
pub fn is_network(name: &str) -> bool {
    name != SPEC && !name.ends_with(".parquet")
}

impl RunRecord {
    /// Whether the files of a finished run contain those of its networks, or of an attached model.
    pub fn has_network(&self) -> bool {
        self.files.keys().any(|name| is_network(name))
    }

    /// The run's world, and that of its test if this is another one.
    pub(super) fn worlds(&self) -> Worlds {
        let Provenance { world_file, test_world_file, .. } = &self.provenance;
        let own = WorldOf::new(&self.spec.scenario, world_file, &self.dataset);
        let test = self.spec.other_world().zip(self.test_dataset.as_deref());
        (own, test.map(|(scenario, dataset)| WorldOf::new(scenario, test_world_file, dataset)))
    }

    /// The record of a run that starts now.
    pub(super) fn new(folder: &RunFolder, spec: &RunSpec, layout: &Arc<Layout>, by: &Provenance) -> Self {
        Self {
            experiment: folder.experiment.clone(),
            run: folder.id.clone(),
            status: Status::Running,
            reason: None,
            diverged: false,
            published: false,
            spec_hash: spec.hash(),
            dataset: folder.dataset.clone(),
            test_dataset: folder.test_dataset.clone(),
            started: Timestamp::now().strftime("%Y-%m-%dT%H:%M:%S%.6fZ").to_string(),
            timings: None,
            peak_memory_bytes: None,
            parameters: None,
            provenance: Provenance { command: command_of(&by.command, spec), ..by.clone() },
            submission: None,
            place: 0,
            spec: spec.clone(),
            layout: layout.clone(),
            files: BTreeMap::new(),
            spec_yaml: None,
        }
    }

    /// Whether the run is published in the files of its experiment, and has a folder at most for its networks.
    pub fn is_merged(&self) -> bool {
        self.spec_yaml.is_some()
    }

    /// The run's full name, `experiment/run`.
    pub fn name(&self) -> String {
        format!("{}/{}", self.experiment, self.run)
    }

    /// The name of what predicts, in the column `model`: that of a network, or of a model of another program.
    pub fn predictor(&self) -> &str {
        self.spec.trained().map_or(self.spec.model.name(), |_| models::NETWORK)
    }

    /// The hash of what the run asks of a model; see [`RunSpec::task_hash`].
    pub fn task_hash(&self) -> String {
        self.spec.task_hash(&self.data())
    }

    /// What names the run's data in hashes.
    fn data(&self) -> String {
        self.spec.data(&self.dataset, self.test_dataset.as_deref())
    }

    /// The datasets that were simulated for the run, each in a world of its own: that for training and, if the test is
    /// in another world, that for the test.
    pub(super) fn simulated(&self) -> impl Iterator<Item = SimulatedFor<'_>> {
        let Self { dataset, spec, provenance, .. } = self;
        let (world, other) = self.worlds();
        let own = spec.simulation.clone().map(|simulation| SimulatedFor {
            dataset,
            scenario: &spec.scenario,
            world,
            version: provenance.world.as_ref(),
            simulation,
        });
        let test = other.zip(spec.test_simulation()).map(|(world, simulation)| SimulatedFor {
            dataset: self.tested(),
            scenario: spec.tested_in(),
            world,
            version: provenance.test_world.as_ref(),
            simulation,
        });
        own.into_iter().chain(test)
    }

    /// The name of the dataset that has the test episodes.
    pub fn tested(&self) -> &str {
        self.test_dataset.as_deref().unwrap_or(&self.dataset)
    }

    /// The datasets that the run used, each with the number of its episodes; 0 for an imported one.
    pub fn datasets(&self) -> impl Iterator<Item = (&str, u32)> {
        let tested = self.spec.test_simulation().map_or(0, |simulation| simulation.episodes);
        let test = self.test_dataset.as_deref().map(|name| (name, tested));
        std::iter::once((&*self.dataset, self.episodes())).chain(test)
    }

    /// The number of episodes of this dataset that the run used; `None` if it did not use the dataset.
    pub fn episodes_of(&self, dataset: &str) -> Option<u32> {
        self.datasets().find(|(name, _)| *name == dataset).map(|(_, episodes)| episodes)
    }

    /// Number of episodes of a simulated dataset that the run used; 0 for an imported dataset.
    pub fn episodes(&self) -> u32 {
        self.spec.simulation.as_ref().map_or(0, |simulation| simulation.episodes)
    }

    /// The record with a list of these files of the run, as they are now.
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
        let trained = self.spec.tasks.iter().filter(|_| self.spec.trained().is_some());
        let checkpoints = trained.map(|task| format!("{}.safetensors", task.name()));
        let attached = self.submission.iter().filter_map(|submission| submission.network.clone());
        std::iter::once(SPEC.to_owned()).chain(tables).chain(checkpoints).chain(attached).collect()
    }

    /// Whether an unfinished run may have a file of this name: a result, or the saved state of its training.
    pub(super) fn expects(&self, name: &str) -> bool {
        let is_state = name.contains(".state.") && name.contains(".safetensors");
        let mut expected = self.expected_files().into_iter().chain(FURTHER_TABLES.map(Table::file_name));
        is_state || expected.any(|expected| expected == name)
    }

    /// Compares a whole file with its entry in the record, and returns its path.
    ///
    /// Every reader of a run's table must do this first. Hashing 3 MB takes a few milliseconds. Polars detects few
    /// kinds of damage, and would return wrong numbers for the others.
    ///
    /// # Errors
    /// When the record does not list the file, the file can't be read, or its size or checksum differs.
    pub fn check_file(&self, folder: &Path, name: &str) -> Result<PathBuf, RegistryError> {
        self.read_file(folder, name).map(|_| folder.join(name))
    }

    /// Reads a file and compares it with its entry in the record.
    pub fn read_file(&self, folder: &Path, name: &str) -> Result<Vec<u8>, RegistryError> {
        self.listed(folder, name)?.read(&folder.join(name))
    }

    /// Compares the file of the model of another program with its entry in the record, and returns its path; `None` if
    /// none was attached.
    ///
    /// # Errors
    /// When the file is damaged or missing. Published copies lack it.
    pub fn attached(&self, folder: &Path) -> Result<Option<PathBuf>, RegistryError> {
        let name = self.submission.as_ref().and_then(|submission| submission.network.as_ref());
        name.map(|name| self.check_file(folder, name)).transpose()
    }

    /// Whether the finished run has a file of this table. Published runs have none of tables without rows.
    pub fn has(&self, table: Table) -> bool {
        self.files.contains_key(&table.file_name()) || TABLES.contains(&table) && !self.published
    }

    /// The tables of which the finished run has a file.
    pub fn tables(&self) -> impl Iterator<Item = Table> {
        TABLES.into_iter().chain(FURTHER_TABLES).filter(|table| self.has(*table))
    }

    /// The record's entry for a file.
    ///
    /// # Errors
    /// When the record does not list the file.
    pub fn listed(&self, folder: &Path, name: &str) -> Result<&FileRecord, RegistryError> {
        self.files.get(name).ok_or_else(|| RegistryError::File {
            path: folder.join(name),
            reason: "the run's record does not list it".into(),
        })
    }

    /// The revision of the method that made the run, or `None` if the run's id matches no revision up to this one.
    pub fn revision(&self) -> Option<u32> {
        let data = self.data();
        let is_of = |revision: &u32| self.run.ends_with(&identity(&self.spec_hash, &data, *revision));
        (0..=REVISION).rev().find(is_of)
    }

    /// What the user of an external model says about it, as JSON; `None` for a network.
    fn notes(&self) -> Option<String> {
        let submission = self.submission.as_ref()?;
        serde_json::to_string(&submission.notes).ok()
    }

    /// A hash that is the same for all runs that differ only in their seed.
    fn group_hash(&self) -> String {
        let spec = RunSpec { seed: 0, ..self.spec.clone() };
        let revision = self.revision().map_or("unknown".to_owned(), |revision| revision.to_string());
        let digest = Sha256::digest(format!("{} {} {revision}", spec.hash(), self.data()));
        hex(&digest[..8])
    }

    /// Describes the first listed file that is damaged or missing, or returns `None` if all files are intact.
    pub fn damage(&self, folder: &Path) -> Option<String> {
        self.files.par_iter().find_map_first(|(name, _)| {
            let RegistryError::File { reason, .. } = self.check_file(folder, name).err()? else {
                return None;
            };
            Some(format!("{name} is damaged: {reason}"))
        })
    }

    /// Reads a record, or returns `None` if the file does not exist.
    pub fn read(path: &Path) -> Result<Option<Self>, RegistryError> {
        read_sealed(path)
    }

    /// Writes the record, with a seal.
    pub(super) fn write(&self, path: &Path) -> Result<(), RegistryError> {
        let mut json = serde_json::to_value(self)
            .map_err(|error| RegistryError::Record { path: path.to_owned(), reason: error.to_string() })?;
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

    /// A table of the run: the columns that identify it, and then `columns`.
    pub(super) fn with_key(&self, columns: Vec<Column>) -> PolarsResult<DataFrame> {
        let rows = columns.first().map_or(0, Column::len);
        let key = key_columns(std::slice::from_ref(self)).into_iter();
        DataFrame::new(rows, key.map(|column| column.new_from_index(0, rows)).chain(columns).collect())
    }
}

/// An experiment, a dataset, and the reading and the role of the runs on it.
pub type ForcesOf = (String, String, Option<String>, Option<String>);

/// What the rows of a run's table `forces` are about. They describe the dataset, so runs with the same value have the
/// same rows, and those of one run are enough.
pub fn forces_of(record: &RunRecord) -> ForcesOf {
    let [reading, role] = [record.spec.reading(), record.spec.role()].map(|name| name.map(str::to_owned));
    (record.experiment.clone(), record.dataset.clone(), reading, role)
}

fn joined(modalities: &[Modality]) -> String {
    modalities.iter().map(|modality| modality.name()).collect::<Vec<_>>().join("+")
}

/// The columns that identify each run. They are the first columns of every table of runs.
fn key_columns(records: &[RunRecord]) -> Vec<Column> {
    vec![
        column_of(records, "experiment", |run| run.experiment.as_str()),
        column_of(records, "run", |run| run.run.as_str()),
        column_of(records, "scenario", |run| run.spec.scenario.name()),
        column_of(records, "input", |run| joined(&run.spec.input)),
        column_of(records, "output", |run| joined(&run.spec.output)),
        column_of(records, "architecture", |run| run.spec.model.name()),
        column_of(records, "latent", |run| run.spec.latent().map(|latent| latent as i64)),
        column_of(records, "variant", |run| run.spec.variant.as_str()),
        column_of(records, "seed", |run| run.spec.seed as i64),
    ]
}

/// The `runs` table, with a row for each record. A query that does not read the hashes does not compute them.
pub fn runs_table(records: Vec<RunRecord>) -> PolarsResult<LazyFrame> {
    /// The position of a row's record.
    const RECORD: &str = "record";
    let shared = Arc::new(records);
    let hash = |name: &str, of: fn(&RunRecord) -> String| {
        let records = shared.clone();
        let hashes = move |rows: Column| {
            let rows: Vec<Option<u32>> = rows.u32()?.iter().collect();
            let of_row = |row: Option<u32>| records.get(row? as usize).map(of);
            let hashes: Vec<Option<String>> = rows.into_par_iter().map(of_row).collect();
            Ok(Column::new(RECORD.into(), hashes))
        };
        let text = |_: &Schema, field: &Field| Ok(Field::new(field.name().clone(), DataType::String));
        col(RECORD).map(hashes, text).alias(name)
    };
    let hashes = [hash("group_hash", RunRecord::group_hash), hash("task_hash", RunRecord::task_hash)];
    let records = shared.as_slice();
    let seconds = |name: &str, of: fn(&Timings) -> Option<f64>| {
        column_of(records, name, |run| run.timings.as_ref().and_then(of))
    };
    let prediction_seconds = |run: &RunRecord| {
        let timings = run.timings.as_ref().filter(|_| run.spec.trained().is_some())?;
        Some(timings.prediction)
    };
    let mut columns = key_columns(records);
    columns.extend([
        column_of(records, "status", |run| run.status.name()),
        column_of(records, "reason", |run| run.reason.as_deref()),
        column_of(records, "spec_hash", |run| run.spec_hash.as_str()),
        column_of(records, "dataset", |run| run.dataset.as_str()),
        column_of(records, "test_dataset", |run| run.test_dataset.as_deref()),
        column_of(records, "dataset_seed", |run| {
            let seed = run.spec.simulation.as_ref().map(|of| of.seed as i64);
            seed.or(run.spec.split.fold.map(|fold| fold as i64))
        }),
        column_of(records, "world_version", |run| run.provenance.world.as_ref().map(WorldVersion::id)),
        column_of(records, "reading", |run| run.spec.reading()),
        column_of(records, "role", |run| run.spec.role()),
        column_of(records, "split", |run| run.spec.split.by.name()),
        column_of(records, "started", |run| run.started.as_str()),
        seconds("collect_seconds", |timings| Some(timings.collect)),
        column_of(records, "prediction_seconds", prediction_seconds),
        seconds("reconstruction_seconds", |timings| timings.reconstruction),
        seconds("evaluation_seconds", |timings| Some(timings.evaluation)),
        column_of(records, "peak_memory_bytes", |run| run.peak_memory_bytes.map(|bytes| bytes as i64)),
        column_of(records, "parameters", |run| run.parameters.map(|parameters| parameters as i64)),
        column_of(records, "git_commit", |run| run.provenance.git_commit.as_deref()),
        column_of(records, "git_dirty", |run| run.provenance.git_dirty),
        column_of(records, "harness_version", |run| run.provenance.harness_version.as_str()),
        column_of(records, "mujoco_version", |run| run.provenance.mujoco_version.as_str()),
        column_of(records, "candle_version", |run| run.provenance.candle_version.as_str()),
        column_of(records, "host", |run| run.provenance.host.as_str()),
        column_of(records, "processor", |run| run.provenance.processor.as_str()),
        column_of(records, "threads", |run| run.provenance.threads as i64),
        column_of(records, "command", |run| run.provenance.command.as_str()),
        column_of(records, "notes", RunRecord::notes),
        Column::new(RECORD.into(), (0..records.len() as u32).collect::<Vec<_>>()),
    ]);
    let columns_of_table =
        Table::Runs.columns().into_iter().map(|column| col(column.name)).collect::<Vec<_>>();
    Ok(DataFrame::new(records.len(), columns)?.lazy().with_columns(hashes).select(columns_of_table))
}

/// The number of episodes of each simulated dataset that finished runs used. Published runs are not counted, because
/// they are published without their datasets.
pub fn episodes_used<'a>(records: impl Iterator<Item = &'a RunRecord>) -> BTreeMap<&'a str, u32> {
    let mut used = BTreeMap::new();
    for record in records.filter(|record| record.status == Status::Done && !record.published) {
        for (dataset, episodes) in record.datasets() {
            let most = used.entry(dataset).or_default();
            *most = episodes.max(*most);
        }
    }
    used
}
