//! Parquet tables: written whole, stamped with what made them, with units in their metadata.

use crate::files::{WriteError, write_bytes};
use crate::schema::{Column, Kind};
use polars::prelude::*;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};

/// Key of the columns' units and meanings in a file's metadata, as JSON.
pub const COLUMNS_KEY: &str = "harness.columns";

/// What made a table, by key; written into the file's metadata.
pub type Stamp = BTreeMap<String, String>;

/// Why a table could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    #[error("{} can't be read ({reason})", path.display())]
    Read { path: PathBuf, reason: String },
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error("a table could not be made: {0}")]
    Polars(#[from] PolarsError),
}

/// How Polars holds what a column is.
pub fn data_type(kind: Kind) -> DataType {
    match kind {
        Kind::Text => DataType::String,
        Kind::Integer => DataType::Int64,
        Kind::Real => DataType::Float64,
        Kind::Flag => DataType::Boolean,
        Kind::Bytes => DataType::Binary,
    }
}

/// Writes a table whose columns are those of `columns`, in their order.
pub fn write_table(
    path: &Path,
    mut table: DataFrame,
    columns: &[Column],
    stamp: &Stamp,
) -> Result<(), TableError> {
    let expected: Vec<&str> = columns.iter().map(|column| column.name.as_str()).collect();
    let found: Vec<&str> = table.get_column_names().into_iter().map(|name| name.as_str()).collect();
    if found != expected {
        let message = format!("the table has the columns {found:?}, its schema {expected:?}");
        return Err(PolarsError::SchemaMismatch(message.into()).into());
    }
    let described = serde_json::to_string(columns)
        .map_err(|error| PolarsError::ComputeError(error.to_string().into()))?;
    let mut metadata = vec![(COLUMNS_KEY.to_owned(), described)];
    metadata.extend(stamp.iter().map(|(key, value)| (format!("harness.{key}"), value.clone())));
    // In memory first: Polars does not pass on why a file could not be written.
    let mut bytes = Vec::new();
    ParquetWriter::new(&mut bytes)
        .with_key_value_metadata(Some(KeyValueMetadata::from_static(metadata)))
        // Tables are written from threads of their own; more threads for each would only compete.
        .set_parallel(false)
        .finish(&mut table)?;
    Ok(write_bytes(path, &bytes)?)
}

/// What a file's metadata say, without the table itself.
pub struct Footer {
    pub rows: usize,
    pub stamp: Stamp,
}

/// Reads a file's footer.
pub fn read_footer(path: &Path) -> Result<Footer, TableError> {
    let file = File::open(path).map_err(|error| unreadable(path, error))?;
    let mut reader = ParquetReader::new(file);
    let metadata = reader.get_metadata().map_err(|error| unreadable(path, error))?;
    let pairs = metadata.key_value_metadata().clone().unwrap_or_default();
    let stamp = pairs.into_iter().filter_map(|pair| {
        let key = pair.key.strip_prefix("harness.")?.to_owned();
        Some((key, pair.value?))
    });
    Ok(Footer { rows: metadata.num_rows, stamp: stamp.collect() })
}

/// Reads a table, all of its columns or those named.
pub fn read_table(path: &Path, columns: Option<Vec<String>>) -> Result<DataFrame, TableError> {
    let file = File::open(path).map_err(|error| unreadable(path, error))?;
    ParquetReader::new(file).with_columns(columns).finish().map_err(|error| unreadable(path, error))
}

fn unreadable(path: &Path, error: impl std::fmt::Display) -> TableError {
    TableError::Read { path: path.to_owned(), reason: error.to_string() }
}

/// The tables at `paths` one after the other, lazily and cut down to `columns`; `None` if there are none.
pub fn scan(paths: &[PathBuf], columns: &[Column]) -> PolarsResult<Option<LazyFrame>> {
    if paths.is_empty() {
        return Ok(None);
    }
    let wanted: Vec<Expr> = columns.iter().map(|column| col(column.name.as_str())).collect();
    let paths = paths.iter().map(|path| PlRefPath::try_from_path(path)).collect::<PolarsResult<_>>()?;
    // The paths are names of files, whatever characters are in them, and no patterns.
    let options = ScanArgsParquet { glob: false, ..ScanArgsParquet::default() };
    Ok(Some(LazyFrame::scan_parquet_files(paths, options)?.select(wanted)))
}
