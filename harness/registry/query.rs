//! SQL over the tables of a results folder.

use super::record::{RunRecord, runs_table};
use super::{RECORD, Registry, RegistryError};
use crate::dataset::episode_scan;
use crate::files::{WriteError, write_whole};
use crate::schema::{Column, Table};
use crate::tables::{TableError, data_type, scan};
use polars::prelude::*;
use polars::sql::SQLContext;
use serde::de::DeserializeOwned;
use std::fs::File;
use std::path::{Path, PathBuf};

/// Why a query gave no answer.
#[derive(Debug, thiserror::Error)]
pub enum QueryError {
    #[error(transparent)]
    Registry(#[from] RegistryError),
    #[error("the query can't be answered: {0}")]
    Sql(PolarsError),
    #[error("the answer's rows are not what they should be: {0}")]
    Rows(serde_json::Error),
    #[error("can't write to '{}': its name must end in .parquet, .csv or .json", .0.display())]
    Format(PathBuf),
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// Answers a query in Polars' SQL over the tables of [`Table::ALL`].
///
/// # Errors
/// When the SQL is not understood, names what isn't there, or a table can't be read.
pub fn query(registry: &Registry, sql: &str) -> Result<DataFrame, QueryError> {
    answer(registry, sql, &registry.run_folders())
}

/// As [`query`], but of the runs only those that count: done, and of several of the same cell and seed in an
/// experiment (after a setting or the method changed) the latest.
pub fn query_latest(registry: &Registry, sql: &str) -> Result<DataFrame, QueryError> {
    answer(registry, sql, &registry.latest_folders())
}

fn answer(registry: &Registry, sql: &str, runs: &[PathBuf]) -> Result<DataFrame, QueryError> {
    let mut context = SQLContext::new();
    for table in Table::ALL {
        // Only what the query may be about is looked up: the folders of thousands of runs take a while.
        if sql.to_lowercase().contains(table.name()) {
            context.register(table.name(), table_of(registry, table, runs)?);
        }
    }
    context.execute(sql).and_then(LazyFrame::collect).map_err(QueryError::Sql)
}

/// One of the tables, over everything in the results folder.
pub fn table(registry: &Registry, table: Table) -> Result<LazyFrame, QueryError> {
    table_of(registry, table, &registry.run_folders())
}

/// One of the tables, over the runs in the folders `runs`, or over all datasets.
fn table_of(registry: &Registry, table: Table, runs: &[PathBuf]) -> Result<LazyFrame, QueryError> {
    let columns = table.columns();
    let found = match table {
        Table::Runs => {
            let records: Vec<RunRecord> =
                runs.iter().filter_map(|folder| RunRecord::read(&folder.join(RECORD)).ok()?).collect();
            if records.is_empty() {
                None
            } else {
                Some(runs_table(&records).map_err(TableError::from).map_err(RegistryError::from)?.lazy())
            }
        }
        Table::Episodes => episode_scan(&registry.datasets()).map_err(QueryError::Sql)?,
        Table::Epochs | Table::Metrics | Table::Predictions | Table::Forces | Table::Frames => {
            let name = format!("{}.parquet", table.name());
            let paths: Vec<PathBuf> =
                runs.iter().map(|folder| folder.join(&name)).filter(|path| path.exists()).collect();
            scan(&paths, &columns).map_err(QueryError::Sql)?
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
