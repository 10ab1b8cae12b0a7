//! Parquet tables: written whole, stamped with what made them, with units in their metadata.

mod lazy;
pub mod schema;

pub use lazy::{asked_columns, asked_rows, lazily, scan};

use harness_shared::files::WriteError;
use harness_shared::seal;
use polars::prelude::*;
use schema::{Column, Kind};
use std::collections::BTreeMap;
use std::io::Cursor;
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

/// Writes a table whose columns are those of `columns`, in their order, and seals its file.
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
    metadata.push((format!("harness.{}", seal::KEY), seal::BLANK.to_owned()));
    let mut bytes = Vec::new();
    ParquetWriter::new(&mut bytes)
        .with_key_value_metadata(Some(KeyValueMetadata::from_static(metadata)))
        // Tables are written from threads of their own; more threads for each would only compete.
        .set_parallel(false)
        .finish(&mut table)?;
    Ok(seal::write(path, bytes)?)
}

/// What a file's metadata say, without the table itself.
pub struct Footer {
    pub rows: usize,
    pub stamp: Stamp,
}

/// A table's file in memory, whose seal holds: what Polars decodes is what was written, bit by bit. Its decoder
/// trusts the file's numbers and ends the process at some that were changed.
pub struct TableFile {
    path: PathBuf,
    bytes: Vec<u8>,
}

impl TableFile {
    /// Reads a file that [`write_table`] wrote.
    ///
    /// # Errors
    /// When it is not there, or not as it was written.
    pub fn open(path: &Path) -> Result<Self, TableError> {
        Self::new(path, std::fs::read(path).map_err(|error| unreadable(path, error))?)
    }

    /// The same for bytes that are said to be those of `path`.
    pub fn new(path: &Path, bytes: Vec<u8>) -> Result<Self, TableError> {
        seal::check(&bytes).map_err(|error| unreadable(path, error))?;
        Ok(Self { path: path.to_owned(), bytes })
    }

    pub fn footer(&self) -> Result<Footer, TableError> {
        let mut reader = ParquetReader::new(Cursor::new(&self.bytes));
        let metadata = reader.get_metadata().map_err(|error| unreadable(&self.path, error))?;
        let pairs = metadata.key_value_metadata().clone().unwrap_or_default();
        let stamp = pairs.into_iter().filter_map(|pair| {
            let key = pair.key.strip_prefix("harness.")?.to_owned();
            Some((key, pair.value?))
        });
        Ok(Footer { rows: metadata.num_rows, stamp: stamp.collect() })
    }

    /// The table, all of its columns or those named.
    pub fn table(&self, columns: Option<Vec<String>>) -> Result<DataFrame, TableError> {
        let reader = ParquetReader::new(Cursor::new(&self.bytes)).with_columns(columns);
        reader.finish().map_err(|error| unreadable(&self.path, error))
    }

    /// These columns of the table, in this order, by the calling thread alone.
    pub fn read_serially(&self, columns: &[String]) -> Result<DataFrame, TableError> {
        let reader = ParquetReader::new(Cursor::new(&self.bytes)).with_columns(Some(columns.to_vec()));
        let rows = reader.read_parallel(ParallelStrategy::None).finish();
        rows.and_then(|rows| rows.select(columns)).map_err(|error| unreadable(&self.path, error))
    }
}

/// Parts of a table as one; `None` if there are none.
pub fn stacked(parts: Vec<DataFrame>) -> PolarsResult<Option<DataFrame>> {
    let mut parts = parts.into_iter();
    let Some(mut whole) = parts.next() else { return Ok(None) };
    for part in parts {
        whole.vstack_mut_owned(part)?;
    }
    Ok(Some(whole))
}

/// Reads a file's footer.
pub fn read_footer(path: &Path) -> Result<Footer, TableError> {
    TableFile::open(path)?.footer()
}

/// Reads a table, all of its columns or those named.
pub fn read_table(path: &Path, columns: Option<Vec<String>>) -> Result<DataFrame, TableError> {
    TableFile::open(path)?.table(columns)
}

fn unreadable(path: &Path, error: impl std::fmt::Display) -> TableError {
    TableError::Read { path: path.to_owned(), reason: error.to_string() }
}
