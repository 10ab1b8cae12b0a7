//! SQL over the tables of a results folder.

use super::folders::Recorded;
use super::record::{RunRecord, runs_table};
use super::{Registry, RegistryError, Status, sql};
use crate::files::{WriteError, write_whole};
use crate::schema::{Column, Table};
use crate::tables::{TableError, data_type, scan};
use polars::prelude::*;
use rayon::prelude::*;
use serde::de::DeserializeOwned;
use std::fs::File;
use std::path::{Path, PathBuf};

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
    Sql(#[from] PolarsError),
    #[error("the query can't be answered: {0}")]
    Refused(String),
    #[error("the answer's rows are not what they should be: {0}")]
    Rows(serde_json::Error),
    #[error("can't write to '{}': its name must end in .parquet, .csv or .json", .0.display())]
    Format(PathBuf),
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// Answers a question in SQL over the tables of [`Table::ALL`], as the standard says.
///
/// What can't be used as it lies there is left out, see [`Registry::left_out`].
///
/// # Errors
/// When the SQL is not understood, is more than a question, names what isn't there, or when a table's file is
/// damaged.
pub fn query(registry: &Registry, sql: &str) -> Result<DataFrame, QueryError> {
    let runs = registry.recorded();
    answer(sql, &|of| table(registry, of, &runs))
}

/// What a table's name stands for in a query.
pub(crate) type TableOf<'a> = dyn Fn(Table) -> Result<LazyFrame, QueryError> + Sync + 'a;

/// Answers a query over the tables that `table_of` gives, which is asked for those that the query may be about.
pub(crate) fn answer(question: &str, table_of: &TableOf) -> Result<DataFrame, QueryError> {
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

/// One of the tables, over `runs`, or over all datasets.
pub(crate) fn table(registry: &Registry, table: Table, runs: &[Recorded]) -> Result<LazyFrame, QueryError> {
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
        Table::Episodes => scan(&registry.episode_files(runs)?, &columns).map_err(QueryError::Sql)?,
        Table::Epochs | Table::Metrics | Table::Predictions | Table::Forces | Table::Frames => {
            let name = format!("{}.parquet", table.name());
            // A run's tables count once its record says that it is done, and as its record lists them.
            let done: Vec<&Recorded> = runs.iter().filter(|(_, run)| run.status == Status::Done).collect();
            let paths = done.into_par_iter().map(|(folder, record)| record.check_file(folder, &name));
            scan(&paths.collect::<Result<Vec<_>, _>>()?, &columns).map_err(QueryError::Sql)?
        }
    };
    match found {
        Some(found) => Ok(found),
        None => empty(&columns).map_err(QueryError::Sql),
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
