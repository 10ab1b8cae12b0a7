//! SQL over the tables of a results folder.

use super::compact::RunTable;
use super::folders::Recorded;
use super::record::{RunRecord, runs_table};
use super::rows::conditions;
use super::{Registry, RegistryError, Status, sql};
use harness_dataset::layout_of;
use harness_shared::files::{WriteError, write_whole};
use harness_spec::Layout;
use harness_tables::schema::{Column, Table, sample_columns};
use harness_tables::{TableError, data_type, lazily, scan};
use polars::prelude::*;
use serde::de::DeserializeOwned;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Address space for the stack on which a query is parsed and planned: `1+1+1…` nests as deep as it is long, and
/// the parser and Polars walk what nests by recursion. Only what is used takes memory.
const QUERY_STACK_BYTES: usize = 1 << 30;

/// Why a query gave no answer.
#[derive(Debug, thiserror::Error)]
pub enum QueryError {
    #[error(transparent)]
    Registry(#[from] RegistryError),
    // Polars adds a plan of many lines.
    #[error("the query can't be answered: {}", .0.to_string().lines().next().unwrap_or_default())]
    Sql(#[source] PolarsError),
    #[error("the query can't be answered: {0}")]
    Refused(String),
    #[error("the answer's rows are not what they should be: {0}")]
    Rows(serde_json::Error),
    #[error("can't write to '{}': its name must end in .parquet, .csv or .json", .0.display())]
    Format(PathBuf),
    #[error(transparent)]
    Write(#[from] WriteError),
}

impl From<PolarsError> for QueryError {
    /// What a table that is read lazily could not read comes as an error of Polars.
    fn from(error: PolarsError) -> Self {
        let PolarsError::IO { error, msg } = error else { return Self::Sql(error) };
        match Arc::try_unwrap(error).map(std::io::Error::downcast::<RegistryError>) {
            Ok(Ok(error)) => Self::Registry(error),
            Ok(Err(error)) => Self::Sql(PolarsError::IO { error: Arc::new(error), msg }),
            Err(error) => Self::Sql(PolarsError::IO { error, msg }),
        }
    }
}

/// Answers a question in SQL over the tables of [`Table::ALL`], as the standard says.
///
/// What can't be used as it lies there is left out, see [`Registry::left_out`].
///
/// # Errors
/// When the SQL is not understood, is more than a question, names what isn't there, or when a table's file is
/// damaged.
pub fn query(registry: &Registry, sql: &str) -> Result<DataFrame, QueryError> {
    query_of(registry, |_| true, sql)
}

/// The same over those runs alone that are wanted.
///
/// # Errors
/// As those of [`query`].
pub fn query_of(
    registry: &Registry,
    is_wanted: impl Fn(&RunRecord) -> bool,
    sql: &str,
) -> Result<DataFrame, QueryError> {
    let runs = registry.recorded().into_iter().filter(|(_, record)| is_wanted(record));
    let runs: Vec<Recorded> = runs.collect();
    answer(sql, &|of| table(registry, of, &runs, sql))
}

/// What a table's name stands for in a query.
pub type TableOf<'a> = dyn Fn(Table) -> Result<LazyFrame, QueryError> + Sync + 'a;

/// Answers a query over the tables that `table_of` gives, which is asked for those that the query may be about.
pub fn answer(question: &str, table_of: &TableOf) -> Result<DataFrame, QueryError> {
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().stack_size(QUERY_STACK_BYTES);
        let thread = thread.spawn_scoped(scope, || sql::answer(question, table_of));
        let thread = thread.map_err(|error| QueryError::Refused(error.to_string()))?;
        // Polars may panic at what it does not support.
        thread.join().unwrap_or_else(|panic| {
            let said = panic.downcast_ref::<String>().map(String::as_str);
            let said = said.or(panic.downcast_ref::<&str>().copied()).unwrap_or("it panicked");
            Err(QueryError::Refused(format!("Polars does not support it: {said}")))
        })
    })
}

/// One of the tables, over `runs`, or over all datasets, with the rows that `sql` can see at least.
pub fn table(
    registry: &Registry,
    table: Table,
    runs: &[Recorded],
    sql: &str,
) -> Result<LazyFrame, QueryError> {
    let columns = table.columns();
    let found = match table {
        Table::Runs => {
            if runs.is_empty() {
                None
            } else {
                let records: Vec<RunRecord> = runs.iter().map(|(_, record)| record.clone()).collect();
                Some(runs_table(&records).map_err(TableError::from).map_err(RegistryError::from)?.lazy())
            }
        }
        Table::Episodes => episodes(&registry.episode_files(runs)?, &columns)?,
        Table::Epochs | Table::Metrics | Table::Predictions | Table::Forces | Table::Frames => {
            // A run's tables count once its record says that it is done, and as its record lists them.
            let done = runs.iter().map(|(_, run)| run).filter(|run| run.status == Status::Done);
            run_table(registry, table, &done.collect::<Vec<_>>(), sql)?
        }
    };
    match found {
        Some(found) => Ok(found),
        None => empty(&columns).map_err(QueryError::Sql),
    }
}

/// One of the tables that each run writes; `None` without runs.
fn run_table(
    registry: &Registry,
    table: Table,
    runs: &[&RunRecord],
    sql: &str,
) -> Result<Option<LazyFrame>, QueryError> {
    let mut frames = Vec::new();
    for runs in runs.chunk_by(|a, b| a.experiment == b.experiment) {
        let rows = RunTable::new(registry, table, &runs[0].experiment, runs.iter().copied())?;
        let schema = rows.schema()?;
        frames.push(lazily(rows.only(conditions(sql, table)), schema)?);
    }
    if frames.len() < 2 {
        return Ok(frames.pop());
    }
    Ok(Some(concat(frames, UnionArgs::default())?))
}

/// The episodes' files one after the other, those of a dataset together: first the columns that the table always has, then
/// those that only some datasets have. What a dataset lacks is null.
fn episodes(files: &[PathBuf], always: &[Column]) -> Result<Option<LazyFrame>, QueryError> {
    let mut groups: Vec<(Arc<Layout>, Vec<PathBuf>)> = Vec::new();
    for of_dataset in files.chunk_by(|a, b| a.parent() == b.parent()) {
        let folder = of_dataset[0].parent().unwrap_or(Path::new(""));
        let layout = layout_of(folder).map_err(|error| QueryError::Refused(error.to_string()))?;
        match groups.iter_mut().find(|(other, _)| *other == layout) {
            Some((_, files)) => files.extend_from_slice(of_dataset),
            None => groups.push((layout, of_dataset.to_vec())),
        }
    }
    let held: Vec<Vec<Column>> = groups.iter().map(|(layout, _)| sample_columns(layout)).collect();
    let mut names: Vec<&str> = always.iter().map(|column| column.name.as_str()).collect();
    for column in held.iter().flatten() {
        if !names.contains(&column.name.as_str()) {
            names.push(&column.name);
        }
    }
    let mut frames = Vec::new();
    for ((_, files), held) in groups.iter().zip(&held) {
        let Some(frame) = scan(files, held).map_err(QueryError::Sql)? else { continue };
        let value = |name: &&str| match held.iter().any(|column| column.name == *name) {
            true => col(*name),
            // Only elements of vectors can lack.
            false => lit(NULL).cast(DataType::Float32).alias(*name),
        };
        frames.push(frame.select(names.iter().map(value).collect::<Vec<_>>()));
    }
    match frames.len() {
        0 | 1 => Ok(frames.pop()),
        _ => concat(frames, UnionArgs::default()).map(Some).map_err(QueryError::Sql),
    }
}

/// A table without rows, so that a query of an empty results folder has an empty answer.
fn empty(columns: &[Column]) -> PolarsResult<LazyFrame> {
    let columns = columns.iter().map(|column| {
        polars::prelude::Column::new_empty(column.name.as_str().into(), &data_type(column.kind))
    });
    Ok(DataFrame::new(0, columns.collect())?.lazy())
}

/// An answer's rows as values of `T`, whose fields are its columns.
///
/// # Errors
/// When a column lacks or has another type.
pub fn rows<T: DeserializeOwned>(answer: &mut DataFrame) -> Result<Vec<T>, QueryError> {
    let mut json = Vec::new();
    JsonWriter::new(&mut json).with_json_format(JsonFormat::Json).finish(answer).map_err(QueryError::Sql)?;
    serde_json::from_slice(&json).map_err(QueryError::Rows)
}

/// Writes an answer as Parquet, CSV or JSON, by the ending of the file's name.
pub fn save(answer: &mut DataFrame, path: &Path) -> Result<(), QueryError> {
    let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_lowercase();
    let write: fn(&mut DataFrame, File) -> PolarsResult<()> = match ending.as_str() {
        "parquet" => |answer, file| ParquetWriter::new(file).finish(answer).map(|_| ()),
        "csv" => |answer, file| CsvWriter::new(file).finish(answer),
        "json" => |answer, file| JsonWriter::new(file).with_json_format(JsonFormat::Json).finish(answer),
        _ => return Err(QueryError::Format(path.to_owned())),
    };
    write_whole(path, |file| write(answer, File::create(file)?).map_err(std::io::Error::other))?;
    Ok(())
}
