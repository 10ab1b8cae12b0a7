//! Parquet tables. They are written completely or not at all, with units and provenance in their metadata.

mod lazy;
mod predicted;
pub mod schema;

pub use lazy::{asked_columns, asked_rows, lazily, scan};
pub use predicted::{PREDICTED_COLUMNS, PredictedRow, PredictedRows, read_predicted};

use harness_shared::files::{WriteError, write_bytes};
use harness_shared::seal;
use polars::polars_utils::compression::ZstdLevel;
use polars::prelude::*;
use schema::{Column, Kind};
use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};

/// Key in a file's metadata of the columns' units and meanings, as JSON.
const COLUMNS_KEY: &str = "harness.columns";

/// The level of compression of a packed table, of at most 22.
const PACKED_LEVEL: i32 = 19;
/// The rows of a group and the bytes of a page of a packed table. Long pages are compressed better.
const PACKED: usize = 1 << 24;

/// The provenance of a table by key. It is written to the file's metadata.
pub type Stamp = BTreeMap<String, String>;

/// Why a table could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// The file can't be read, or its content is damaged.
    #[error("{} can't be read ({reason})", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The file can't be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The table can't be made.
    #[error("a table could not be made: {0}")]
    Polars(#[from] PolarsError),
}

/// Returns the Polars type of a kind of column.
pub fn data_type(kind: Kind) -> DataType {
    match kind {
        Kind::Text => DataType::String,
        Kind::Integer => DataType::Int64,
        Kind::Real => DataType::Float64,
        Kind::Flag => DataType::Boolean,
        Kind::Bytes => DataType::Binary,
    }
}

/// Returns a column with the value that `of` takes from each row.
pub fn column_of<'a, R, V, P: ?Sized>(
    rows: &'a [R],
    name: &str,
    of: impl Fn(&'a R) -> V,
) -> polars::prelude::Column
where
    Series: NamedFrom<Vec<V>, P>,
{
    polars::prelude::Column::new(name.into(), rows.iter().map(of).collect::<Vec<_>>())
}

/// Writes a table to a sealed file. The table must have the columns `columns`, in this order.
///
/// # Errors
/// When the table has other columns, or the file can't be written.
pub fn write_table(
    path: &Path,
    table: DataFrame,
    columns: &[Column],
    stamp: &Stamp,
) -> Result<(), TableError> {
    Ok(write_bytes(path, &sealed_table(table, columns, stamp)?)?)
}

/// Returns the bytes of the file that [`write_table`] writes.
///
/// # Errors
/// When the table has other columns.
pub fn sealed_table(table: DataFrame, columns: &[Column], stamp: &Stamp) -> Result<Vec<u8>, TableError> {
    sealed(table, columns, stamp, |writer| writer)
}

/// Returns the bytes of a smaller file than that of [`sealed_table`], which takes longer to write.
///
/// # Errors
/// When the table has other columns.
pub fn packed_table(table: DataFrame, columns: &[Column], stamp: &Stamp) -> Result<Vec<u8>, TableError> {
    let compression = ParquetCompression::Zstd(Some(ZstdLevel::try_new(PACKED_LEVEL)?));
    sealed(table, columns, stamp, |writer| {
        let writer = writer.with_compression(compression).with_statistics(StatisticsOptions::empty());
        writer.with_row_group_size(Some(PACKED)).with_data_page_size(Some(PACKED))
    })
}

fn sealed(
    mut table: DataFrame,
    columns: &[Column],
    stamp: &Stamp,
    with_options: impl FnOnce(ParquetWriter<&mut Vec<u8>>) -> ParquetWriter<&mut Vec<u8>>,
) -> Result<Vec<u8>, TableError> {
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
    let writer = ParquetWriter::new(&mut bytes)
        .with_key_value_metadata(Some(KeyValueMetadata::from_static(metadata)))
        // Several threads write tables at the same time, so more threads for each table would only compete.
        .set_parallel(false);
    with_options(writer).finish(&mut table)?;
    seal::seal(&mut bytes).map_err(|error| PolarsError::ComputeError(error.to_string().into()))?;
    Ok(bytes)
}

/// The metadata of a file, without its rows.
pub struct Footer {
    /// Number of rows.
    pub rows: usize,
    /// Names of the columns.
    pub columns: Vec<String>,
    /// Provenance of the table.
    pub stamp: Stamp,
}

/// The file of a table in memory, whose seal is valid. So Polars decodes exactly the bytes that were written. This
/// matters because its decoder trusts the file's numbers, and some wrong numbers make it abort the process.
pub struct TableFile {
    path: PathBuf,
    bytes: Vec<u8>,
}

impl TableFile {
    /// Reads a file that [`write_table`] has written.
    ///
    /// # Errors
    /// When the file is missing, or its content has changed since it was written.
    pub fn open(path: &Path) -> Result<Self, TableError> {
        Self::new(path, std::fs::read(path).map_err(|error| unreadable(path, error))?)
    }

    /// Checks the seal of `bytes`, which were read from `path`.
    ///
    /// # Errors
    /// When the seal is missing or wrong.
    pub fn new(path: &Path, bytes: Vec<u8>) -> Result<Self, TableError> {
        seal::check(&bytes).map_err(|error| unreadable(path, error))?;
        Ok(Self { path: path.to_owned(), bytes })
    }

    /// Returns the number of rows, the columns and the provenance.
    ///
    /// # Errors
    /// When the metadata can't be decoded.
    pub fn footer(&self) -> Result<Footer, TableError> {
        let mut reader = ParquetReader::new(Cursor::new(&self.bytes));
        let metadata = reader.get_metadata().map_err(|error| unreadable(&self.path, error))?;
        let pairs = metadata.key_value_metadata().clone().unwrap_or_default();
        let stamp = pairs.into_iter().filter_map(|pair| {
            let key = pair.key.strip_prefix("harness.")?.to_owned();
            Some((key, pair.value?))
        });
        let columns = metadata.schema().fields().iter().map(|field| field.name().to_owned());
        Ok(Footer { rows: metadata.num_rows, columns: columns.collect(), stamp: stamp.collect() })
    }

    /// Decodes the given columns, or all columns.
    ///
    /// # Errors
    /// When a column is missing, or the file can't be decoded.
    pub fn table(&self, columns: Option<Vec<String>>) -> Result<DataFrame, TableError> {
        let reader = ParquetReader::new(Cursor::new(&self.bytes)).with_columns(columns);
        reader.finish().map_err(|error| unreadable(&self.path, error))
    }

    /// Decodes the given columns in this order, using only the calling thread.
    ///
    /// # Errors
    /// When a column is missing, or the file can't be decoded.
    pub fn read_serially(&self, columns: &[String]) -> Result<DataFrame, TableError> {
        let reader = ParquetReader::new(Cursor::new(&self.bytes)).with_columns(Some(columns.to_vec()));
        let rows = reader.read_parallel(ParallelStrategy::None).finish();
        rows.and_then(|rows| rows.select(columns)).map_err(|error| unreadable(&self.path, error))
    }
}

/// Concatenates the parts of a table; `None` without parts.
///
/// # Errors
/// When the parts have different columns.
pub fn stacked(parts: Vec<DataFrame>) -> PolarsResult<Option<DataFrame>> {
    let mut parts = parts.into_iter();
    let Some(mut whole) = parts.next() else { return Ok(None) };
    for part in parts {
        whole.vstack_mut_owned(part)?;
    }
    Ok(Some(whole))
}

/// Reads the footer of a file.
///
/// # Errors
/// When the file can't be read or is damaged.
pub fn read_footer(path: &Path) -> Result<Footer, TableError> {
    TableFile::open(path)?.footer()
}

fn unreadable(path: &Path, error: impl std::fmt::Display) -> TableError {
    TableError::Read { path: path.to_owned(), reason: error.to_string() }
}
