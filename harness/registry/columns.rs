//! The rows of a run's tables, in the form in which this version writes them.

use super::{RegistryError, RunRecord};
use harness_tables::schema::Table;
use polars::prelude::*;
use std::io::Cursor;
use std::path::Path;

/// Reads columns of a run's table from the bytes of its file, in this order, using only the calling thread.
pub fn read_columns(bytes: &[u8], columns: &[String]) -> PolarsResult<DataFrame> {
    let reader = ParquetReader::new(Cursor::new(bytes)).with_columns(Some(columns.to_vec()));
    // Several tables are read at the same time, so more threads for each would not help.
    reader.read_parallel(ParallelStrategy::None).finish()?.select(columns)
}

impl RunRecord {
    /// Reads a table of the run, and compares its file with the record.
    pub fn table(&self, folder: &Path, table: Table) -> Result<DataFrame, RegistryError> {
        let name = table.file_name();
        let columns: Vec<String> = table.columns().into_iter().map(|column| column.name).collect();
        read_columns(&self.read_file(folder, &name)?, &columns)
            .map_err(|error| RegistryError::File { path: folder.join(&name), reason: error.to_string() })
    }
}
