//! The tables of many runs: which rows they have, where these are read from, and SQL over them.

mod compact;
mod episodes;
mod error;
mod format;

pub use compact::RunTable;
pub use error::QueryError;
pub use format::{TableFormat, rows, save};

use episodes::episode_files;
use harness_registry::dataset::layout_of;
use harness_registry::{Recorded, Registry, RunRecord, Status, live_table, runs_table};
use harness_shared::files::folders;
use harness_spec::{Layout, Task};
use harness_sql::{Condition, Query, Tables};
use harness_tables::schema::{Column, GIVEN, HORIZON, Kind, Table, sample_columns};
use harness_tables::{data_type, lazily, scan};
use polars::prelude::*;
use std::collections::{BTreeSet, HashSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The SQL condition for the rows of `metrics` that judge a whole modality: those of all its elements, or those of all
/// elements with the same unit if their units differ.
pub const OVERALL: &str = "index is null and (direction is null or direction like 'in %')";

/// Answers one statement of standard SQL over the tables of [`Table::ALL`].
///
/// Runs and datasets that can't be used are left out; see [`Registry::left_out`].
///
/// # Errors
/// When the SQL is invalid or not supported, names a table or column that does not exist, or when a table's file is
/// damaged.
pub fn query(registry: &Registry, sql: &str) -> Result<DataFrame, QueryError> {
    let query = Query::parse(sql)?;
    let answer = answer_for(registry, |_| true, &query)?;
    if !tells_versions_apart(&query) {
        mention_outdated(registry, &registry.recorded(), &query);
    }
    Ok(answer)
}

/// Answers one statement of SQL like [`query`], over runs that were read before.
pub fn query_all(registry: &Registry, runs: &[Recorded], sql: &str) -> Result<DataFrame, QueryError> {
    let query = Query::parse(sql)?;
    let answer = answer_of(registry, runs, &query)?;
    if !tells_versions_apart(&query) {
        mention_outdated(registry, runs, &query);
    }
    Ok(answer)
}

/// Whether a query tells the versions of a world apart.
fn tells_versions_apart(query: &Query) -> bool {
    query.names().contains("world_version")
}

/// Remembers that a query sees runs in several versions of a world.
fn mention_outdated(registry: &Registry, runs: &[Recorded], query: &Query) {
    let seen = runs.iter().map(|(_, record)| record).filter(|record| sees(query, record));
    registry.mention_outdated(&registry.outdated(runs), seen);
}

/// Whether a query may see rows of a run.
fn sees(query: &Query, record: &RunRecord) -> bool {
    let of_runs = Table::ALL.into_iter().filter(|table| *table != Table::Episodes);
    let mut conditions = of_runs.flat_map(|table| conditions(query, table));
    conditions.any(|condition| {
        let allows = |key: &str, own: &String| condition.get(key).is_none_or(|texts| texts.contains(own));
        allows("experiment", &record.experiment) && allows("run", &record.run)
    })
}

/// Answers one statement of SQL over only those runs for which `is_wanted` returns true.
pub fn query_of(
    registry: &Registry,
    is_wanted: impl Fn(&RunRecord) -> bool,
    sql: &str,
) -> Result<DataFrame, QueryError> {
    answer_for(registry, is_wanted, &Query::parse(sql)?)
}

fn answer_for(
    registry: &Registry,
    is_wanted: impl Fn(&RunRecord) -> bool,
    query: &Query,
) -> Result<DataFrame, QueryError> {
    loop {
        let runs = registry.recorded().into_iter().filter(|(_, record)| is_wanted(record));
        match answer_of(registry, &runs.collect::<Vec<_>>(), query) {
            // Another process has removed a run since its record was read.
            Err(error) if error.is_of_removed_run() => {}
            answered => return answered,
        }
    }
}

/// Answers one statement of SQL over only these runs, which were read before.
pub fn query_recorded(registry: &Registry, runs: &[Recorded], sql: &str) -> Result<DataFrame, QueryError> {
    answer_of(registry, runs, &Query::parse(sql)?)
}

fn answer_of(registry: &Registry, runs: &[Recorded], query: &Query) -> Result<DataFrame, QueryError> {
    let rows = |of, query: &Query| table(registry, of, runs, query);
    Ok(query.answer(&Source { rows: &rows, columns: &|of| columns(registry, of, runs) })?)
}

/// A function that returns the rows of a table that a query can see.
pub type TableOf<'a> = dyn Fn(Table, &Query) -> PolarsResult<LazyFrame> + Sync + 'a;

/// Answers a query. `rows` is called for each table that the query reads.
///
/// # Errors
/// When the query is not supported, or when `rows` fails.
pub fn answer(query: &Query, rows: &TableOf) -> Result<DataFrame, QueryError> {
    Ok(query.answer(&Source { rows, columns: &|table| Ok(table.columns()) })?)
}

/// The tables of [`Table::ALL`], with their rows and columns from functions.
struct Source<'a> {
    rows: &'a TableOf<'a>,
    columns: &'a (dyn Fn(Table) -> PolarsResult<Vec<Column>> + Sync),
}

impl Tables for Source<'_> {
    fn list(&self) -> Vec<(&'static str, &'static str)> {
        Table::ALL.map(|table| (table.name(), table.meaning())).to_vec()
    }

    fn columns(&self, table: &str) -> PolarsResult<DataFrame> {
        let columns = (self.columns)(named(table))?;
        let names: Vec<&str> = columns.iter().map(|column| column.name.as_str()).collect();
        let types: Vec<String> =
            columns.iter().map(|column| format!("{:?}", column.kind).to_lowercase()).collect();
        let units: Vec<&str> = columns.iter().map(|column| &*column.unit).collect();
        let meanings: Vec<&str> = columns.iter().map(|column| column.meaning.as_str()).collect();
        df!("column" => names, "type" => types, "unit" => units, "meaning" => meanings)
    }

    fn rows(&self, table: &str, query: &Query) -> PolarsResult<LazyFrame> {
        (self.rows)(named(table), query)
    }
}

/// The table of this name, which is one of the list.
fn named(name: &str) -> Table {
    Table::ALL.into_iter().find(|table| table.name() == name).expect("only tables of the list are asked for")
}

/// The conditions that a query puts on the text columns of a table, and on which of its columns are null. Empty if the
/// query does not read the table.
pub fn conditions(query: &Query, table: Table) -> BTreeSet<Condition> {
    conditions_on(query, table, &table.columns())
}

/// Like [`conditions`], but only on those of the table's columns that are listed.
fn conditions_on(query: &Query, table: Table, columns: &[Column]) -> BTreeSet<Condition> {
    let has = |name: &String, texts: &BTreeSet<String>| {
        columns.iter().any(|own| own.name == *name && (own.kind == Kind::Text || texts.is_empty()))
    };
    let of_table = |condition: &Condition| {
        let mut condition = condition.clone();
        condition.retain(|name, texts| has(name, texts));
        condition
    };
    query.conditions(table.name()).into_iter().flatten().map(of_table).collect()
}

/// A table over `runs` or, for `episodes`, over all datasets. It has at least those rows that the query can see.
pub fn table(registry: &Registry, table: Table, runs: &[Recorded], query: &Query) -> PolarsResult<LazyFrame> {
    // A run's tables count once its record says that it is done, and as its record lists them.
    let done = || -> Vec<&RunRecord> {
        runs.iter().map(|(_, run)| run).filter(|run| run.status == Status::Done).collect()
    };
    let found = match table {
        Table::Runs if runs.is_empty() => None,
        Table::Runs => Some(runs_table(runs.iter().map(|(_, record)| record.clone()).collect())?),
        Table::Episodes => episodes(&episode_files(registry, runs)?)?,
        Table::Epochs | Table::Metrics | Table::Sums | Table::Predictions | Table::Forces | Table::Frames => {
            let rows = run_table(registry, table, table, &done(), query)?;
            if table == Table::Epochs { with_live_epochs(rows, runs)? } else { rows }
        }
        Table::AllMetrics | Table::AllPredictions => {
            let done = done();
            let mut frames = Vec::new();
            for (horizon, usual) in [1, 0].into_iter().flat_map(|horizon| Some((horizon, table.usual()?))) {
                let is_of = |run: &&&RunRecord| run.spec.window.first_horizon() == horizon;
                let runs: Vec<&RunRecord> = done.iter().filter(is_of).copied().collect();
                let rows = run_table(registry, usual, table, &runs, query)?;
                frames.extend(rows.map(|rows| with_distance(rows, table, horizon)));
            }
            frames.extend(run_table(registry, table, table, &done, query)?);
            one_after_the_other(frames)?
        }
    };
    Ok(found.unwrap_or_else(|| empty(&table.columns())))
}

/// The columns of a table. Those of `episodes` depend on the datasets: each column that one of them has. Without
/// datasets, they are those of the built-in finger.
fn columns(registry: &Registry, table: Table, runs: &[Recorded]) -> PolarsResult<Vec<Column>> {
    let groups = match table {
        Table::Episodes => by_layout(&episode_files(registry, runs)?)?,
        _ => Vec::new(),
    };
    let columns = each_once(groups.iter().flat_map(|(layout, _)| sample_columns(layout)));
    Ok(if columns.is_empty() { table.columns() } else { columns })
}

/// The columns of `episodes`: each column that a dataset of this folder describes. Without datasets, they are those of
/// the built-in finger, and the second value is false. No episode is read.
pub fn episode_columns(registry: &Registry) -> (Vec<Column>, bool) {
    let layouts = folders(&registry.datasets()).into_iter().filter_map(|folder| layout_of(&folder).ok());
    let columns = each_once(layouts.flat_map(|layout| sample_columns(&layout)));
    let are_there = !columns.is_empty();
    (if are_there { columns } else { Table::Episodes.columns() }, are_there)
}

/// The columns without those whose name an earlier one has. If they have values of several kinds, these become texts.
fn each_once(columns: impl Iterator<Item = Column>) -> Vec<Column> {
    let mut once: Vec<Column> = Vec::new();
    for column in columns {
        match once.iter_mut().find(|other| other.name == column.name) {
            Some(other) if other.kind != column.kind => other.kind = Kind::Text,
            Some(_) => {}
            None => once.push(column),
        }
    }
    once
}

/// The rows of a usual table in the form of the table `of`, which has all rows: with their horizons. That of
/// predictions is `horizon`.
fn with_distance(rows: LazyFrame, of: Table, horizon: usize) -> LazyFrame {
    let is_reconstruction = col("task").eq(lit(Task::Reconstruction.name()));
    let of_task = when(is_reconstruction).then(lit(0)).otherwise(lit(horizon as i64));
    let horizon = of_task.cast(DataType::Int64).alias(HORIZON);
    let given = lit(NULL).cast(DataType::String).alias(GIVEN);
    let columns = of.columns().into_iter().map(|column| col(column.name)).collect::<Vec<_>>();
    rows.with_columns([horizon, given]).select(columns)
}

/// A table that runs write, as far as a query of the table `asked` can see it; `None` if no run has written it.
fn run_table(
    registry: &Registry,
    table: Table,
    asked: Table,
    runs: &[&RunRecord],
    query: &Query,
) -> PolarsResult<Option<LazyFrame>> {
    let mut frames = Vec::new();
    for runs in runs.chunk_by(|a, b| a.experiment == b.experiment) {
        let rows = RunTable::new(registry, table, &runs[0].experiment, runs.iter().copied())?;
        let schema = rows.schema()?;
        if schema.is_empty() {
            continue;
        }
        frames.push(lazily(rows.only(conditions_on(query, asked, &table.columns())), schema)?);
    }
    one_after_the_other(frames)
}

/// The rows of all frames; `None` without frames.
pub fn one_after_the_other(mut frames: Vec<LazyFrame>) -> PolarsResult<Option<LazyFrame>> {
    match frames.len() {
        0 | 1 => Ok(frames.pop()),
        _ => concat(frames, UnionArgs::default()).map(Some),
    }
}

/// The epochs of finished runs, and then those of running ones.
fn with_live_epochs(done: Option<LazyFrame>, runs: &[Recorded]) -> PolarsResult<Option<LazyFrame>> {
    let mut frames: Vec<LazyFrame> = done.into_iter().collect();
    for (folder, run) in runs.iter().filter(|(_, run)| run.status == Status::Running) {
        let epochs = live_table(folder, run)?;
        if epochs.height() > 0 {
            frames.push(epochs.lazy());
        }
    }
    one_after_the_other(frames)
}

/// The files of datasets with the same layout, for each layout.
type ByLayout = Vec<(Arc<Layout>, Vec<PathBuf>)>;

fn by_layout(files: &[PathBuf]) -> PolarsResult<ByLayout> {
    let mut groups = ByLayout::new();
    for of_dataset in files.chunk_by(|a, b| a.parent() == b.parent()) {
        let folder = of_dataset[0].parent().unwrap_or(Path::new(""));
        let layout =
            layout_of(folder).map_err(|error| PolarsError::ComputeError(error.to_string().into()))?;
        match groups.iter_mut().find(|(other, _)| *other == layout) {
            Some((_, files)) => files.extend_from_slice(of_dataset),
            None => groups.push((layout, of_dataset.to_vec())),
        }
    }
    Ok(groups)
}

/// The episodes' files one after the other, those of a dataset together, with each column that a dataset has. What a
/// dataset lacks is null.
fn episodes(files: &[PathBuf]) -> PolarsResult<Option<LazyFrame>> {
    let groups = by_layout(files)?;
    let held: Vec<Vec<Column>> = groups.iter().map(|(layout, _)| sample_columns(layout)).collect();
    let all = each_once(held.iter().flatten().cloned());
    let labels: HashSet<&str> =
        groups.iter().flat_map(|(layout, _)| &layout.labels).map(|label| label.name.as_str()).collect();
    let mut frames = Vec::new();
    for ((_, files), held) in groups.iter().zip(&held) {
        let Some(frame) = scan(files, held)? else { continue };
        let value = |Column { name, kind, .. }: &Column| {
            let has = held.iter().any(|column| column.name == *name);
            let value = if has { col(name.as_str()) } else { lit(NULL) };
            match labels.contains(name.as_str()) {
                true => value.cast(data_type(*kind)).alias(name.as_str()),
                false if has => value,
                // Only labels and elements of vectors can lack.
                false => value.cast(DataType::Float32).alias(name.as_str()),
            }
        };
        frames.push(frame.select(all.iter().map(value).collect::<Vec<_>>()));
    }
    one_after_the_other(frames)
}

/// A table without rows, so that a query of an empty results folder has an empty answer.
fn empty(columns: &[Column]) -> LazyFrame {
    let field = |column: &Column| Field::new(column.name.as_str().into(), data_type(column.kind));
    DataFrame::empty_with_schema(&columns.iter().map(field).collect()).lazy()
}
