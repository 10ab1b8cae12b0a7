//! Small copies of finished runs: what figures, claims and comparisons need, fit for version control.

use super::record::{RunRecord, TABLES};
use super::{RECORD, Registry, RegistryError, RunFolder, SPEC};
use harness_shared::files::write_bytes;
use harness_shared::progress::Progress;
use harness_tables::schema::Table;
use harness_tables::{TableError, TableFile, write_table};
use polars::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The result of [`Registry::publish`].
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Published {
    /// Number of published runs.
    pub runs: usize,
    /// Size of their files in bytes, without the records.
    pub bytes: u64,
}

impl Registry {
    /// Copies `chosen` runs of this registry to the registry `to`: records, specs and tables, but no networks. Tables
    /// about single samples are copied without most of their rows.
    ///
    /// All epochs and metrics are copied. Of each cell's lowest seed, the predictions of the last two joints and links
    /// and all images are copied. The forces are copied of one run for each dataset. Of runs with a `variant`, only
    /// epochs and metrics are copied; of runs under a reading, also the forces of one run for each dataset, reading and
    /// role. A run of the same cell and seed that was published before is replaced.
    ///
    /// # Errors
    /// When `to` is this registry, or a file can't be read or written. Files that exist already are not damaged.
    pub fn publish<'a>(
        &self,
        chosen: impl IntoIterator<Item = (&'a Path, &'a RunRecord)>,
        to: &Registry,
        progress: &dyn Progress,
    ) -> Result<Published, RegistryError> {
        if std::fs::canonicalize(&self.root)
            .is_ok_and(|root| std::fs::canonicalize(&to.root).ok() == Some(root))
        {
            return Err(RegistryError::IntoItself(self.root.clone()));
        }
        let chosen: Vec<_> = chosen.into_iter().collect();
        let shown = Shown::of(chosen.iter().map(|(_, record)| *record));
        let published_before = to.recorded();
        let mut published = Published::default();
        progress.begin("publishing", chosen.len() as u64, "runs");
        for (folder, record) in chosen {
            let copy = RunFolder {
                path: to.runs().join(&record.experiment).join(&record.run),
                experiment: record.experiment.clone(),
                id: record.run.clone(),
                dataset: record.dataset.clone(),
            };
            remove_same(&published_before, record)?;
            let spec = record.check_file(folder, SPEC)?;
            let spec = std::fs::read(&spec)
                .map_err(|error| RegistryError::File { path: spec.clone(), reason: error.to_string() })?;
            write_bytes(&copy.path.join(SPEC), &spec)?;
            let mut names = vec![SPEC.to_owned()];
            for table in TABLES {
                let name = table.file_name();
                let rows = TableFile::open(&record.check_file(folder, &name)?)?.table(None)?;
                let kept = shown.keep(table, record, rows).map_err(TableError::from)?;
                if kept.height() == 0 {
                    continue;
                }
                write_table(&copy.path.join(&name), kept, &table.columns(), &record.stamp())?;
                names.push(name);
            }
            let record = record.clone().with_files(&copy, names)?;
            published.bytes += record.files.values().map(|file| file.bytes).sum::<u64>();
            published.runs += 1;
            record.write(&copy.path.join(RECORD))?;
            progress.advance(1);
        }
        progress.end();
        Ok(published)
    }
}

/// Removes those of `published` that are of the same cell and seed.
fn remove_same(published: &[(PathBuf, RunRecord)], record: &RunRecord) -> Result<(), RegistryError> {
    for (folder, other) in published {
        if (&other.experiment, other.label()) == (&record.experiment, record.label()) {
            std::fs::remove_dir_all(folder)
                .map_err(|error| RegistryError::File { path: folder.clone(), reason: error.to_string() })?;
        }
    }
    Ok(())
}

/// Of which runs single samples are kept.
struct Shown {
    /// The lowest seed of each cell of an experiment.
    seeds: BTreeMap<(String, String), u64>,
    /// The run that the forces of a dataset are kept of.
    forces: BTreeMap<ForcesOf, String>,
}

impl Shown {
    fn of<'a>(records: impl Iterator<Item = &'a RunRecord>) -> Self {
        let mut shown = Self { seeds: BTreeMap::new(), forces: BTreeMap::new() };
        for record in records {
            let is_plain = record.spec.variant.is_empty();
            if is_plain {
                let lowest = shown.seeds.entry(cell(record)).or_insert(record.spec.seed);
                *lowest = record.spec.seed.min(*lowest);
            }
            if is_plain || record.spec.reading().is_some() {
                shown.forces.entry(forces_of(record)).or_insert_with(|| record.run.clone());
            }
        }
        shown
    }

    /// The rows of a run's table that are kept.
    fn keep(&self, table: Table, record: &RunRecord, rows: DataFrame) -> PolarsResult<DataFrame> {
        let is_lowest_seed = self.seeds.get(&cell(record)) == Some(&record.spec.seed);
        match table {
            Table::Predictions if is_lowest_seed => {
                let is_last = record.layout.modalities.iter().map(|definition| {
                    let last = definition.last_elements().into_iter().map(|index| index as i64);
                    let index = last.map(|index| col("index").eq(lit(index))).reduce(Expr::or);
                    col("modality").eq(lit(definition.name.name())).and(index.unwrap_or(lit(false)))
                });
                rows.lazy().filter(is_last.reduce(Expr::or).unwrap_or(lit(false))).collect()
            }
            Table::Frames if is_lowest_seed => Ok(rows),
            Table::Forces if self.forces.get(&forces_of(record)) == Some(&record.run) => Ok(rows),
            Table::Predictions | Table::Frames | Table::Forces => Ok(rows.clear()),
            _ => Ok(rows),
        }
    }
}

fn cell(record: &RunRecord) -> (String, String) {
    (record.experiment.clone(), record.spec.cell())
}

/// An experiment, a dataset, and the reading and the role of the runs on it.
type ForcesOf = (String, String, Option<String>, Option<String>);

fn forces_of(record: &RunRecord) -> ForcesOf {
    let [reading, role] = [record.spec.reading(), record.spec.role()].map(|name| name.map(str::to_owned));
    (record.experiment.clone(), record.dataset.clone(), reading, role)
}
