//! Small copies of finished runs: what figures, claims and comparisons need, fit for version control.

use super::Busy;
use crate::command_line::without_results;
use crate::merged::Copied;
use crate::record::Worlds;
use crate::{
    FileRecord, ForcesOf, Provenance, Registry, RegistryError, RunRecord, SPEC, forces_of, is_network,
};
use harness_shared::progress::Progress;
use harness_tables::TableError;
use harness_tables::schema::Table;
use polars::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;

/// Why runs can't be published.
#[derive(Debug, thiserror::Error)]
pub enum PublishError {
    /// A file can't be read or written.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// The runs can't be copied, or not to this place. The text is the message.
    #[error("{0}")]
    Refused(String),
    /// Another process works in the folder of a copy.
    #[error(transparent)]
    Busy(#[from] Busy),
}

/// The most test episodes whose predictions are copied.
pub const EPISODES: usize = 20;

/// The result of [`publish`].
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Published {
    /// Number of published runs.
    pub runs: usize,
    /// Size of the tables of their experiments in bytes.
    pub bytes: u64,
}

/// What of each run is copied, besides its record, spec, epochs and metrics.
#[derive(Debug, Clone, Copy, Default)]
pub struct Content<'a> {
    /// Whether networks are copied.
    pub networks: bool,
    /// Which tables of [`Content::OPTIONAL`] are not copied.
    pub without: &'a [Table],
}

impl Content<'_> {
    /// The tables that can be left out.
    pub const OPTIONAL: [Table; 4] = [Table::Predictions, Table::Frames, Table::Forces, Table::Sums];

    fn has(&self, table: Table) -> bool {
        !self.without.contains(&table.usual().unwrap_or(table))
    }
}

/// Copies `chosen` runs of a registry to the registry `to`, where the runs of an experiment share files: records, specs,
/// tables and what `content` adds or leaves out. Tables about single samples are copied without most of their rows.
///
/// All epochs and metrics are copied. Of each cell's lowest seed on its first dataset, the predictions of the last two
/// joints and links in the first [`EPISODES`] test episodes and all images are copied. Of runs with a `variant` that is not a reading's, no predictions and
/// images are copied. The forces are copied of one run for each dataset, reading and role. Of a published copy, all
/// rows are copied. A run of the same cell and seed that was published before is replaced, unless it is one of `chosen`
/// too.
///
/// # Errors
/// When `to` is the same registry or has such a run that is not a published copy, a process works on a copy, or a file
/// can't be read or written. Nothing that was published before is changed for a run with a damaged file.
pub fn publish<'a>(
    registry: &Registry,
    chosen: impl IntoIterator<Item = (&'a Path, &'a RunRecord)>,
    to: &Registry,
    content: Content,
    progress: &dyn Progress,
) -> Result<Published, PublishError> {
    check_target(registry, to)?;
    let chosen: Vec<_> = chosen.into_iter().collect();
    let shown = Shown::of(chosen.iter().map(|(_, record)| *record));
    let is_replaced = |other: &RunRecord| chosen.iter().any(|(_, record)| is_same(other, record));
    // Other runs have networks and rows that a copy would remove, or a process works on them.
    if let Some((folder, _)) =
        to.recorded().into_iter().find(|(_, other)| !other.is_merged() && is_replaced(other))
    {
        return Err(PublishError::Refused(format!(
            "publishing would replace {}, which is not a published copy; choose another folder",
            folder.display()
        )));
    }
    let mut experiments: BTreeMap<&str, Vec<(&Path, &RunRecord)>> = BTreeMap::new();
    for (folder, record) in &chosen {
        experiments.entry(&record.experiment).or_default().push((folder, record));
    }
    let mut published = Published::default();
    progress.begin("publishing", chosen.len() as u64, "runs");
    for (experiment, runs) in experiments {
        // All files are read before the first one is written, because one of them may be damaged.
        let mut copies = Vec::new();
        for (folder, record) in runs {
            copies.push(shown.copy(folder, record, content)?);
            progress.advance(1);
        }
        published.runs += copies.len();
        let bytes = to.merge(experiment, is_replaced, copies)?;
        published.bytes += bytes.ok_or_else(|| Busy::at(&to.runs().join(experiment)))?;
    }
    progress.end();
    Ok(published)
}

/// Refuses to publish a results folder into itself.
pub(super) fn check_target(registry: &Registry, to: &Registry) -> Result<(), PublishError> {
    match registry.contains(to.root()) {
        false => Ok(()),
        true => Err(PublishError::Refused(format!(
            "{} can't be published into itself; choose another folder",
            registry.root().display()
        ))),
    }
}

/// Whether two runs are of the same cell and seed.
fn is_same(a: &RunRecord, b: &RunRecord) -> bool {
    (&a.experiment, a.spec.label(), a.worlds()) == (&b.experiment, b.spec.label(), b.worlds())
}

/// Of which runs single samples are kept.
struct Shown {
    /// The lowest seeds of the dataset and the run of each cell of an experiment.
    seeds: BTreeMap<Cell, (u64, u64)>,
    /// The run that the forces of a dataset are kept of.
    forces: BTreeMap<ForcesOf, String>,
}

impl Shown {
    fn of<'a>(records: impl Iterator<Item = &'a RunRecord>) -> Self {
        let mut shown = Self { seeds: BTreeMap::new(), forces: BTreeMap::new() };
        for record in records {
            if record.spec.variant.is_empty() || record.spec.reading().is_some() {
                let lowest = shown.seeds.entry(cell(record)).or_insert(seeds(record));
                *lowest = seeds(record).min(*lowest);
            }
            shown.forces.entry(forces_of(record)).or_insert_with(|| record.run.clone());
        }
        shown
    }

    /// What is published of a run. Compares each file with the record. The recorded command is copied without
    /// `--results`.
    fn copy(&self, folder: &Path, record: &RunRecord, content: Content) -> Result<Copied, RegistryError> {
        let kept = record.tables().map(|table| {
            let rows = record.table(folder, table)?;
            let kept = match content.has(table) {
                true => self.keep(table, record, rows).map_err(TableError::from)?,
                false => rows.clear(),
            };
            Ok((table, kept))
        });
        let tables = kept.collect::<Result<_, RegistryError>>()?;
        let networks = record.files.keys().filter(|name| content.networks && is_network(name));
        let networks: Vec<_> = networks
            .map(|name| Ok((name.clone(), record.read_file(folder, name)?)))
            .collect::<Result<_, RegistryError>>()?;
        let spec = || record.read_file(folder, SPEC).map(|text| String::from_utf8_lossy(&text).into_owned());
        let command = without_results(&record.provenance.command);
        let record = RunRecord {
            published: true,
            provenance: Provenance { command, ..record.provenance.clone() },
            files: networks.iter().map(|(name, bytes)| (name.clone(), FileRecord::of(bytes, None))).collect(),
            spec_yaml: Some(record.spec_yaml.clone().map_or_else(spec, Ok)?),
            ..record.clone()
        };
        Ok(Copied { record, networks, tables })
    }

    /// The rows of a run's table that are kept.
    fn keep(&self, table: Table, record: &RunRecord, rows: DataFrame) -> PolarsResult<DataFrame> {
        let is_lowest_seed = self.seeds.get(&cell(record)) == Some(&seeds(record));
        match table {
            // A published copy has only what was kept before.
            _ if record.published => Ok(rows),
            Table::Predictions | Table::AllPredictions if is_lowest_seed => {
                let is_last = record.layout.modalities.iter().map(|definition| {
                    let last = definition.last_elements().into_iter().map(|index| index as i64);
                    let index = last.map(|index| col("index").eq(lit(index))).reduce(Expr::or);
                    col("modality").eq(lit(definition.name.name())).and(index.unwrap_or(lit(false)))
                });
                let episodes = rows.column("episode")?.unique()?.sort(SortOptions::default())?;
                let last = episodes.i64()?.get(EPISODES.min(episodes.len()).saturating_sub(1));
                let is_early = last.map_or(lit(true), |last| col("episode").lt_eq(lit(last)));
                let is_kept = is_last.reduce(Expr::or).unwrap_or(lit(false)).and(is_early);
                rows.lazy().filter(is_kept).collect()
            }
            Table::Frames if is_lowest_seed => Ok(rows),
            Table::Forces if self.forces.get(&forces_of(record)) == Some(&record.run) => Ok(rows),
            Table::Predictions | Table::AllPredictions | Table::Frames | Table::Forces => Ok(rows.clear()),
            _ => Ok(rows),
        }
    }
}

/// The seeds of a run's dataset and of the run.
fn seeds(record: &RunRecord) -> (u64, u64) {
    (record.spec.dataset_seed(), record.spec.seed)
}

/// An experiment, the name of one of its cells, and the worlds of the cell's runs.
type Cell = (String, String, Worlds);

fn cell(record: &RunRecord) -> Cell {
    (record.experiment.clone(), record.spec.cell(), record.worlds())
}
