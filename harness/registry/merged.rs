//! Published runs. Those of an experiment share a few files, which are small and fit for version control.
//!
//! ```text
//! results/runs/<experiment>/records.json      the records of the runs, sorted by id, and how many rows each run has
//! results/runs/<experiment>/<table>.parquet   the rows of all these runs, in the same order
//! ```
//!
//! A killed process leaves the old runs or the new ones, both complete: new tables are written beside the old ones,
//! then the list is replaced, and then the new tables are renamed.

use super::record::{Slice, read_sealed};
use super::{FileRecord, RECORD, Registry, RegistryError, RunRecord, SPEC, read_columns, removed};
use harness_shared::files::{FolderLock, WriteError, write_bytes};
use harness_shared::seal;
use harness_spec::Layout;
use harness_tables::schema::Table;
use harness_tables::{Stamp, TableError, packed_table, sealed_table, stacked};
use polars::prelude::{DataFrame, PolarsError};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::iter::repeat_n;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The file with the records of an experiment's published runs.
pub const RECORDS: &str = "records.json";

/// The key of a run's layout in its record.
const LAYOUT: &str = "layout";

/// The ending of a file that replaces the one of the same name.
pub(super) const NEW: &str = ".new";

/// The content of the file.
#[derive(Default, Deserialize)]
#[serde(try_from = "Stored")]
pub(super) struct Merged {
    /// The records list only the files that runs have for themselves: networks.
    records: Vec<RunRecord>,
    /// The tables by the names of their files.
    pub tables: BTreeMap<String, MergedTable>,
}

/// The content of the file as it is stored: most runs of an experiment have the same layout, which is long.
#[derive(Deserialize)]
struct Stored {
    /// The records. `layout` is a place in `layouts`; without this list, it is the layout itself.
    records: Vec<Value>,
    #[serde(default)]
    layouts: Vec<Layout>,
    tables: BTreeMap<String, MergedTable>,
}

impl TryFrom<Stored> for Merged {
    type Error = serde_json::Error;

    fn try_from(Stored { records, layouts, tables }: Stored) -> Result<Self, serde_json::Error> {
        let layouts: Vec<Arc<Layout>> = layouts.into_iter().map(Arc::new).collect();
        let record = |mut record: Value| {
            let place = record.get(LAYOUT).and_then(Value::as_u64);
            let Some(layout) = place.and_then(|place| layouts.get(place as usize)) else {
                return serde_json::from_value(record);
            };
            record.as_object_mut().and_then(|record| record.shift_remove(LAYOUT));
            Ok(RunRecord { layout: layout.clone(), ..serde_json::from_value(record)? })
        };
        Ok(Self { records: records.into_iter().map(record).collect::<Result<_, _>>()?, tables })
    }
}

/// A file with the rows of several runs.
#[derive(Serialize, Deserialize)]
pub(super) struct MergedTable {
    file: FileRecord,
    /// The number of rows of each run.
    rows: Vec<usize>,
}

/// A run to publish.
pub(super) struct Copied {
    /// Its record, which lists its networks.
    pub record: RunRecord,
    /// Its networks, by the names of their files.
    pub networks: Vec<(String, Vec<u8>)>,
    /// Its rows.
    pub tables: BTreeMap<Table, DataFrame>,
}

/// The record of the run in a folder, or that of the published run that belongs there; `None` if there is neither.
pub(super) fn record_in(folder: &Path) -> Result<Option<RunRecord>, RegistryError> {
    if let Some(own) = RunRecord::read(&folder.join(RECORD))? {
        return Ok(Some(own));
    }
    let experiment = folder.parent().unwrap_or(folder);
    let published = Merged::read(experiment)?.runs(experiment)?;
    Ok(published.into_iter().find(|record| folder.ends_with(&record.run)))
}

impl Registry {
    /// Adds published runs to those of an experiment. Those of the same id are replaced, and those for which `is_gone`
    /// returns true are removed. Returns the size of the tables in bytes, or `None` if another process works there.
    ///
    /// # Errors
    /// When a file can't be read or written. Nothing is changed then, unless it can't be removed.
    pub(super) fn merge(
        &self,
        experiment: &str,
        is_gone: impl Fn(&RunRecord) -> bool,
        added: Vec<Copied>,
    ) -> Result<Option<u64>, RegistryError> {
        let folder = self.runs().join(experiment);
        let Some(lock) = FolderLock::attempt(&folder)? else { return Ok(None) };
        let merged = merge_in(&folder, experiment, is_gone, added);
        // The folder is meant for version control.
        lock.remove(&folder);
        Ok(Some(merged?.tables.values().map(|table| table.file.bytes).sum()))
    }
}

/// Like [`Registry::merge`], in the folder of the experiment, which the caller has locked.
fn merge_in(
    folder: &Path,
    experiment: &str,
    is_gone: impl Fn(&RunRecord) -> bool,
    added: Vec<Copied>,
) -> Result<Merged, RegistryError> {
    let before = Merged::read(folder)?;
    before.settle(folder)?;
    let tables_before: Vec<String> = before.tables.keys().cloned().collect();
    let before = before.runs(folder)?;
    let new = added.iter().map(|copied| &copied.record);
    let gone = before.iter().filter(|record| is_gone(record));
    let changed: BTreeSet<String> = new.chain(gone).map(|record| record.run.clone()).collect();
    let kept = before.into_iter().filter(|record| !changed.contains(&record.run));
    let kept = kept.map(|record| Copied { record, networks: Vec::new(), tables: BTreeMap::new() });
    let mut runs: Vec<Copied> = kept.chain(added).collect();
    runs.sort_by(|a, b| a.record.run.cmp(&b.record.run));
    for Copied { record, networks, .. } in &runs {
        for (name, bytes) in networks {
            write_bytes(&folder.join(&record.run).join(name), bytes)?;
        }
    }
    let mut merged = Merged::default();
    let written: Result<Vec<_>, RegistryError> = Table::ALL
        .into_iter()
        .map(|table| Ok((table.file_name(), write_table(folder, experiment, table, &mut runs)?)))
        .collect();
    // After an error, the old tables stay alone.
    let written = written.inspect_err(|_| {
        for table in Table::ALL {
            let _ = std::fs::remove_file(beside(&folder.join(table.file_name())));
        }
    })?;
    merged.tables.extend(written.into_iter().filter_map(|(name, table)| Some((name, table?))));
    merged.records = runs.into_iter().map(|copied| copied.record).collect();
    merged.records.iter_mut().for_each(|record| record.files.retain(|_, file| file.slice.is_none()));
    merged.write(folder)?;
    merged.settle(folder)?;
    for name in tables_before.iter().filter(|name| !merged.tables.contains_key(*name)) {
        let path = folder.join(name);
        removed(&path, std::fs::remove_file(&path))?;
    }
    // What these runs may have left is the networks of earlier copies.
    let has_networks =
        |run: &str| merged.records.iter().any(|record| record.run == run && !record.files.is_empty());
    for path in changed.iter().filter(|run| !has_networks(run)).map(|run| folder.join(run)) {
        if !path.join(RECORD).exists() {
            removed(&path, std::fs::remove_dir_all(&path))?;
        }
    }
    Ok(merged)
}

/// Writes the new file of a table beside the old one, and returns its entry; `None` if no run has rows of it. The rows
/// of runs that were there before are read from the old file.
fn write_table(
    folder: &Path,
    experiment: &str,
    table: Table,
    runs: &mut [Copied],
) -> Result<Option<MergedTable>, RegistryError> {
    let name = table.file_name();
    let path = folder.join(&name);
    let columns: Vec<String> = table.columns().into_iter().map(|column| column.name).collect();
    let mut old: Option<DataFrame> = None;
    let (mut parts, mut rows) = (Vec::new(), Vec::new());
    for Copied { record, tables, .. } in runs {
        let part = match (tables.remove(&table), record.files.get(&name)) {
            (Some(added), _) => Some(added),
            (None, Some(FileRecord { slice: Some(slice), rows: Some(rows), .. })) => {
                let all = match old.take() {
                    Some(all) => all,
                    None => read_columns(&record.read_file(folder, &name)?, &columns, None)
                        .map_err(|error| damaged(&path, error))?,
                };
                Some(old.insert(all).slice(slice.offset as i64, *rows))
            }
            _ => None,
        };
        rows.push(part.as_ref().map_or(0, DataFrame::height));
        parts.extend(part.filter(|part| part.height() > 0));
    }
    let Some(all) = stacked(parts).map_err(TableError::from)? else { return Ok(None) };
    let height = all.height();
    let stamp = Stamp::from([("experiment".to_owned(), experiment.to_owned())]);
    let bytes = packed_table(all, &table.columns(), &stamp)?;
    write_bytes(&beside(&path), &bytes)?;
    Ok(Some(MergedTable { file: FileRecord::of(&bytes, Some(height)), rows }))
}

impl RunRecord {
    /// Writes the files of a published run to a folder, as a run that is not published has them. `own` is where the
    /// run's networks are.
    pub fn extract(&self, own: &Path, to: &Path) -> Result<(), RegistryError> {
        let mut files = BTreeMap::new();
        let mut add = |name: String, bytes: &[u8], rows| {
            write_bytes(&to.join(&name), bytes)?;
            files.insert(name, FileRecord::of(bytes, rows));
            Ok::<_, RegistryError>(())
        };
        for table in self.tables() {
            let rows = self.table(own, table)?;
            let count = rows.height();
            add(table.file_name(), &sealed_table(rows, &table.columns(), &self.stamp())?, Some(count))?;
        }
        for (name, _) in self.files.iter().filter(|(_, file)| file.slice.is_none()) {
            add(name.clone(), &self.read_file(own, name)?, None)?;
        }
        add(SPEC.to_owned(), self.spec_yaml.as_deref().unwrap_or_default().as_bytes(), None)?;
        Self { files, spec_yaml: None, ..self.clone() }.write(&to.join(RECORD))
    }
}

impl Merged {
    /// Reads the list in the folder of an experiment. It is empty if there is none.
    pub fn read(experiment: &Path) -> Result<Self, RegistryError> {
        Ok(read_sealed(&experiment.join(RECORDS))?.unwrap_or_default())
    }

    /// The records of the runs, each with the slices of the tables that are its rows.
    pub fn runs(self, experiment: &Path) -> Result<Vec<RunRecord>, RegistryError> {
        let mut records = self.records;
        for (name, MergedTable { file, rows }) in self.tables {
            let sum = rows.iter().try_fold(0_usize, |sum, rows| sum.checked_add(*rows));
            if sum != file.rows || rows.len() != records.len() {
                let reason = format!("the rows of its runs are not those of {name}");
                return Err(RegistryError::Record { path: experiment.join(RECORDS), reason });
            }
            let path: Arc<Path> = current(experiment, &name, &file).into();
            let mut offset = 0;
            for (record, rows) in records.iter_mut().zip(rows).filter(|(_, rows)| *rows > 0) {
                let slice = Some(Slice { file: path.clone(), offset });
                record.files.insert(name.clone(), FileRecord { rows: Some(rows), slice, ..file.clone() });
                offset += rows;
            }
        }
        Ok(records)
    }

    /// Compares a table's file with the list, and each of its rows with the run that it belongs to.
    pub fn check(&self, experiment: &Path, name: &str) -> Result<(), RegistryError> {
        let MergedTable { file, rows } = &self.tables[name];
        let path = current(experiment, name, file);
        let found = read_columns(&file.read(&path)?, &["run".to_owned()], None);
        let found = found.map_err(|error| damaged(&path, error))?;
        let found = found.column("run").and_then(|runs| runs.str());
        let found = found.map_err(|error| damaged(&path, error))?.iter().map(Option::unwrap_or_default);
        let runs = self.records.iter().zip(rows);
        if found.eq(runs.flat_map(|(record, rows)| repeat_n(record.run.as_str(), *rows))) {
            return Ok(());
        }
        Err(RegistryError::File { path, reason: format!("its rows are not those of the runs in {RECORDS}") })
    }

    /// Whether `path` has the rows of a table under the name that it had before an interruption.
    pub fn is_current(&self, path: &Path) -> bool {
        let folder = path.parent().unwrap_or(path);
        self.tables.iter().any(|(name, table)| current(folder, name, &table.file) == path)
    }

    /// Writes the list, with a seal and a line for each run. An empty list has no file.
    fn write(&self, experiment: &Path) -> Result<(), RegistryError> {
        let path = experiment.join(RECORDS);
        if self.records.is_empty() {
            return Ok(removed(&path, std::fs::remove_file(&path))?);
        }
        let unwritable = |error: serde_json::Error| RegistryError::Record {
            path: path.clone(),
            reason: error.to_string(),
        };
        let mut layouts: Vec<String> = Vec::new();
        let mut line = |record: &RunRecord| {
            let (text, own) = (serde_json::to_string(record)?, serde_json::to_string(&*record.layout)?);
            // A record without a layout has that of the finger.
            let Some((before, after)) = text.split_once(&format!("\"{LAYOUT}\":{own}")) else {
                return Ok(text);
            };
            let place = layouts.iter().position(|layout| *layout == own).unwrap_or_else(|| {
                layouts.push(own);
                layouts.len() - 1
            });
            Ok(format!("{before}\"{LAYOUT}\":{place}{after}"))
        };
        let records: Vec<String> =
            self.records.iter().map(&mut line).collect::<Result<_, _>>().map_err(unwritable)?;
        let (records, layouts) = (records.join(",\n"), layouts.join(",\n"));
        let tables = serde_json::to_string(&self.tables).map_err(unwritable)?;
        let (key, blank) = (seal::KEY, seal::BLANK);
        let text = format!(
            "{{\n\"records\": [\n{records}\n],\n\"layouts\": [\n{layouts}\n],\n\"tables\": {tables},\n\"{key}\": \
             \"{blank}\"\n}}\n"
        );
        Ok(seal::write(&path, text.into_bytes())?)
    }

    /// Gives the tables that belong to the list their names.
    fn settle(&self, experiment: &Path) -> Result<(), WriteError> {
        for (name, MergedTable { file, .. }) in &self.tables {
            let (from, path) = (current(experiment, name, file), experiment.join(name));
            if from != path {
                std::fs::rename(from, &path).map_err(|source| WriteError { path, source })?;
            }
        }
        Ok(())
    }
}

/// Whether an experiment has tables of published runs, but no list of these runs that can be read.
pub(super) fn lacks_list(experiment: &Path) -> bool {
    let has_tables = || Table::ALL.iter().any(|table| experiment.join(table.file_name()).is_file());
    match Merged::read(experiment) {
        Err(_) => true,
        Ok(_) => !experiment.join(RECORDS).is_file() && has_tables(),
    }
}

/// The file of a table. It is still beside the old one if a process was killed after it replaced the list.
fn current(experiment: &Path, name: &str, file: &FileRecord) -> PathBuf {
    let path = experiment.join(name);
    let new = beside(&path);
    if new.exists() && file.read(&new).is_ok() { new } else { path }
}

/// Where the file that replaces another one is written.
fn beside(path: &Path) -> PathBuf {
    let mut new = path.as_os_str().to_owned();
    new.push(NEW);
    new.into()
}

fn damaged(path: &Path, error: PolarsError) -> RegistryError {
    RegistryError::File { path: path.to_owned(), reason: error.to_string() }
}
