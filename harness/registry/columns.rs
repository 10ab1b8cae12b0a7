//! The rows of a run's tables, in the form in which this version writes them.

use super::{RegistryError, RunRecord};
use harness_judge::models::NETWORK;
use harness_tables::schema::{TRAINED_HERE, Table};
use polars::prelude::*;
use std::io::Cursor;
use std::path::Path;

/// The column with the name of the model, in tables of metrics.
const MODEL: &str = "model";
/// The columns that tell in tables of earlier versions of which model a row is.
const OF_RUN: [&str; 2] = ["architecture", "latent"];

/// Reads columns of a run's table from the bytes of its file, in this order, using only the calling thread.
///
/// In tables of metrics of earlier versions, the model of another program was called `network`, like the networks that
/// were trained here. They are read as if this version had written them.
pub fn read_columns(bytes: &[u8], columns: &[String]) -> PolarsResult<DataFrame> {
    let needs = |name: &str| columns.iter().any(|column| column == name);
    if !needs(MODEL) && !needs(TRAINED_HERE) || names(bytes)?.iter().any(|name| name == TRAINED_HERE) {
        return decoded(bytes, columns);
    }
    let mut stored: Vec<String> = columns.iter().filter(|name| *name != TRAINED_HERE).cloned().collect();
    for name in [&[MODEL], &OF_RUN[..]].concat() {
        if !needs(name) {
            stored.push(name.to_owned());
        }
    }
    let mut rows = decoded(bytes, &stored)?;
    let [architecture, latent] = OF_RUN.map(|name| rows.column(name));
    let model = rows.column(MODEL)?.str()?;
    // A model of another program has no latent state, and its name is in the column of the architecture.
    let (is_network, is_other) = (model.equal(NETWORK), latent?.is_null());
    let named = architecture?.str()?.zip_with(&(&is_network & &is_other), model)?;
    let trained_here = &is_network & &!is_other;
    rows.with_column(named.with_name(MODEL.into()).into_column())?;
    rows.with_column(trained_here.with_name(TRAINED_HERE.into()).into_column())?;
    rows.select(columns)
}

fn decoded(bytes: &[u8], columns: &[String]) -> PolarsResult<DataFrame> {
    let reader = ParquetReader::new(Cursor::new(bytes)).with_columns(Some(columns.to_vec()));
    // Several tables are read at the same time, so more threads for each would not help.
    reader.read_parallel(ParallelStrategy::None).finish()?.select(columns)
}

/// The names of a file's columns.
fn names(bytes: &[u8]) -> PolarsResult<Vec<String>> {
    let mut reader = ParquetReader::new(Cursor::new(bytes));
    let fields = reader.get_metadata()?.schema().fields();
    Ok(fields.iter().map(|field| field.name().to_owned()).collect())
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
