//! The rows of a run's tables, in the form in which this version writes them.

use super::{RegistryError, RunRecord};
use harness_tables::schema::Table;
use polars::prelude::*;
use std::io::Cursor;
use std::path::Path;

/// Reads columns of a table from the bytes of its file, in this order, using only the calling thread: all rows, or those
/// of an offset and a number.
pub fn read_columns(
    bytes: &[u8],
    columns: &[String],
    rows: Option<(usize, usize)>,
) -> PolarsResult<DataFrame> {
    let reader = ParquetReader::new(Cursor::new(bytes)).with_columns(Some(columns.to_vec())).with_slice(rows);
    // Several tables are read at the same time, so more threads for each would not help.
    reader.read_parallel(ParallelStrategy::None).finish()?.select(columns)
}

impl RunRecord {
    /// Reads a table of the run, and compares its file with the record.
    pub fn table(&self, folder: &Path, table: Table) -> Result<DataFrame, RegistryError> {
        let columns: Vec<String> = table.columns().into_iter().map(|column| column.name).collect();
        self.columns(folder, table, &columns)
    }

    /// Reads these columns of a table of the run, and compares its file with the record.
    pub(super) fn columns(
        &self,
        folder: &Path,
        table: Table,
        columns: &[String],
    ) -> Result<DataFrame, RegistryError> {
        let name = table.file_name();
        let bytes = self.read_file(folder, &name)?;
        let listed = self.listed(folder, &name)?;
        let rows = listed.slice.as_ref().zip(listed.rows).map(|(slice, rows)| (slice.offset, rows));
        read_columns(&bytes, columns, rows)
            .map_err(|error| RegistryError::File { path: folder.join(&name), reason: error.to_string() })
    }
}
