//! Tables that are read when a query is answered. Only the columns that the query needs are read.

use super::schema::Column;
use super::stacked;
use polars::prelude::*;
use rayon::prelude::*;
use std::any::Any;
use std::fs::File;
use std::path::{Path, PathBuf};

/// The names of the columns that a scan must return.
pub fn asked_columns(asked: &AnonymousScanArgs) -> Vec<String> {
    match &asked.with_columns {
        Some(names) => names.iter().map(PlSmallStr::to_string).collect(),
        None => asked.schema.iter_names().map(PlSmallStr::to_string).collect(),
    }
}

/// The first rows, as many as a scan must return.
pub fn asked_rows(rows: DataFrame, asked: &AnonymousScanArgs) -> DataFrame {
    match asked.n_rows {
        Some(count) => rows.head(Some(count)),
        None => rows,
    }
}

/// A lazy frame that scans `table`, whose columns are those of `schema`, when it is collected.
///
/// # Errors
/// When Polars refuses the scan.
pub fn lazily(table: impl AnonymousScan + 'static, schema: SchemaRef) -> PolarsResult<LazyFrame> {
    LazyFrame::anonymous_scan(
        Arc::new(table),
        ScanArgsAnonymous { schema: Some(schema), name: "TABLE", ..ScanArgsAnonymous::default() },
    )
}

/// The tables at `paths` one after the other, lazily and cut down to `columns`; `None` if there are none.
///
/// Polars reads the files later and does not check seals, so the caller must have checked them.
///
/// # Errors
/// When the first file can't be read or lacks a column.
pub fn scan(paths: &[PathBuf], columns: &[Column]) -> PolarsResult<Option<LazyFrame>> {
    let Some(first) = paths.first() else { return Ok(None) };
    let names: Vec<String> = columns.iter().map(|column| column.name.clone()).collect();
    let schema = read(first, &names, Some(0))?.schema().clone();
    lazily(Files(paths.to_vec()), schema).map(Some)
}

/// Parquet files that have the same columns.
struct Files(Vec<PathBuf>);

impl AnonymousScan for Files {
    fn as_any(&self) -> &dyn Any {
        self
    }

    fn scan(&self, asked: AnonymousScanArgs) -> PolarsResult<DataFrame> {
        let columns = asked_columns(&asked);
        let parts = match asked.n_rows {
            // Only as many files as the rows take.
            Some(mut left) => {
                let mut parts = Vec::new();
                for path in &self.0 {
                    let part = read(path, &columns, Some(left))?;
                    left -= part.height();
                    parts.push(part);
                    if left == 0 {
                        break;
                    }
                }
                parts
            }
            None => self.0.par_iter().map(|path| read(path, &columns, None)).collect::<PolarsResult<_>>()?,
        };
        Ok(stacked(parts)?.unwrap_or_default())
    }

    // Polars filters what it gets. To scans of this kind it would hand its filter in a form that not every filter has.
    fn allows_predicate_pushdown(&self) -> bool {
        false
    }

    fn allows_projection_pushdown(&self) -> bool {
        true
    }
}

/// These columns of a file, in this order: all rows, or the first ones.
fn read(path: &Path, columns: &[String], limit: Option<usize>) -> PolarsResult<DataFrame> {
    let reader = ParquetReader::new(File::open(path)?).with_columns(Some(columns.to_vec()));
    // Files are read side by side; more threads for each would only compete.
    let reader = reader.read_parallel(ParallelStrategy::None);
    reader.with_slice(limit.map(|rows| (0, rows))).finish()?.select(columns)
}
