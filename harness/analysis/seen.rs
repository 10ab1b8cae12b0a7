//! What the queries that are expected see of a table.

use super::{Expected, tables_of, words};
use harness_registry::{RunTable, asked_columns};
use harness_tables::schema::Table;
use polars::prelude::*;
use std::any::Any;
use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};

/// A table of an experiment's runs, with the rows that expected queries see. It is read once, when the first of them asks.
#[derive(Clone)]
pub(super) struct Seen {
    rows: Arc<RunTable>,
    pub schema: SchemaRef,
    /// The columns that are read besides those that a query asks for: others will.
    columns: Arc<Vec<String>>,
    read: Arc<Mutex<DataFrame>>,
}

impl Seen {
    /// The table, whose rows are `rows`.
    pub fn new(table: Table, rows: RunTable, schema: SchemaRef, expected: &Expected) -> Self {
        let queries = expected.queries.iter().filter(|sql| tables_of(sql).any(|of| of == table));
        let words: BTreeSet<&str> = queries.flat_map(|sql| words(sql)).collect();
        let named = schema.iter_names().map(PlSmallStr::to_string).filter(|name| words.contains(&**name));
        let columns = Arc::new(named.collect());
        Self { rows: Arc::new(rows), schema, columns, read: Arc::default() }
    }
}

impl AnonymousScan for Seen {
    fn as_any(&self) -> &dyn Any {
        self
    }

    fn scan(&self, asked: AnonymousScanArgs) -> PolarsResult<DataFrame> {
        let mut read = self.read.lock().unwrap_or_else(PoisonError::into_inner);
        let columns = asked_columns(&asked);
        if columns.iter().any(|column| read.column(column).is_err()) {
            let before = read.get_column_names_owned().into_iter().map(|name| name.to_string());
            let all: BTreeSet<String> =
                before.chain(self.columns.iter().cloned()).chain(columns.iter().cloned()).collect();
            *read = self.rows.read(&all.into_iter().collect::<Vec<_>>(), None)?;
            read.rechunk_mut_par();
        }
        let rows = read.select(columns)?;
        Ok(asked.n_rows.map_or(rows.clone(), |count| rows.head(Some(count))))
    }

    fn allows_projection_pushdown(&self) -> bool {
        true
    }
}
