//! Tables in memory, with the rows and columns that expected queries see.

use super::Expected;
use harness_catalog::RunTable;
use harness_sql::{Condition, Query, Terms};
use harness_tables::schema::Table;
use harness_tables::{asked_columns, asked_rows, stacked};
use polars::prelude::*;
use std::any::Any;
use std::collections::{BTreeSet, HashMap};
use std::sync::{Mutex, OnceLock, PoisonError};

/// A table of an experiment's runs, with the rows that expected queries see. It is read once, for the first query.
/// Clones share what was read.
#[derive(Clone)]
pub(super) struct Seen {
    rows: Arc<RunTable>,
    /// The names and types of all columns of the table.
    pub schema: SchemaRef,
    /// The columns that expected queries need. They are read together with those of the first query.
    columns: Arc<Vec<String>>,
    /// The columns that were read so far.
    read: Arc<Mutex<DataFrame>>,
    /// The rows in which the terms of the queries' conditions hold.
    terms: Arc<Mutex<Terms>>,
    /// The conditions of the query that scans this clone.
    conditions: Arc<BTreeSet<Condition>>,
    /// The position of each run's first row, and the number of its rows.
    places: Arc<OnceLock<HashMap<String, (usize, usize)>>>,
}

impl Seen {
    /// A table with the rows of `rows`. Its columns are those that `expected` queries name.
    pub fn new(table: Table, rows: RunTable, schema: SchemaRef, expected: &Expected) -> Self {
        let readers = || expected.queries.iter().filter(|query| query.conditions(table.name()).is_some());
        let is_named = |name: &String| readers().any(|query| query.names().contains(name));
        let columns = Arc::new(schema.iter_names().map(PlSmallStr::to_string).filter(is_named).collect());
        Self {
            rows: Arc::new(rows),
            schema,
            columns,
            read: Arc::default(),
            terms: Arc::default(),
            conditions: Arc::default(),
            places: Arc::default(),
        }
    }

    /// Reads the columns that `query` and the expected queries name, and `columns`, unless they were read before.
    ///
    /// This must be called before a scan. [`Seen::scan`] would read the columns in one of Polars' threads. While such a
    /// thread waits for files, it may start another scan of the same table, which would then wait for the first one
    /// forever.
    ///
    /// # Errors
    /// When a file can't be read.
    pub fn read(&self, query: &Query, columns: &[&str]) -> PolarsResult<()> {
        let asked = query.names().iter().map(String::as_str).chain(columns.iter().copied());
        let asked = asked.filter(|name| self.schema.contains(name)).map(str::to_owned);
        let asked: Vec<String> = asked.chain(self.columns.iter().cloned()).collect();
        self.with(&asked).map(drop)
    }

    /// The table with only those rows that satisfy at least one of the conditions.
    pub fn only(self, conditions: BTreeSet<Condition>) -> Self {
        Self { conditions: Arc::new(conditions), ..self }
    }

    /// All rows, with at least these columns.
    fn with(&self, columns: &[String]) -> PolarsResult<DataFrame> {
        let mut read = self.read.lock().unwrap_or_else(PoisonError::into_inner);
        if columns.iter().any(|column| read.column(column).is_err()) {
            let before = read.get_column_names_owned().into_iter().map(|name| name.to_string());
            let all: BTreeSet<String> =
                before.chain(self.columns.iter().cloned()).chain(columns.iter().cloned()).collect();
            *read = self.rows.read(&all.into_iter().collect::<Vec<_>>(), None)?;
            // One column after the other, so that only one of them is in memory twice.
            read.rechunk_mut();
        }
        Ok(read.clone())
    }

    /// These columns of the rows of some runs, in the order of `runs`.
    pub fn rows_of(&self, runs: &[String], columns: &[String]) -> PolarsResult<DataFrame> {
        let needed: Vec<String> = columns.iter().cloned().chain(["run".to_owned()]).collect();
        let all = self.with(&needed)?;
        let names = all.column("run")?.str()?;
        let places = self.places.get_or_init(|| places_of(names.iter().flatten()));
        let all = all.select(columns)?;
        let of_run = |run: &String| places.get(run).map(|&(first, rows)| all.slice(first as i64, rows));
        Ok(stacked(runs.iter().filter_map(of_run).collect())?.unwrap_or_else(|| all.clear()))
    }
}

/// The position of each run's first row, and the number of its rows. The rows of a run are adjacent.
fn places_of<'a>(names: impl Iterator<Item = &'a str>) -> HashMap<String, (usize, usize)> {
    let mut places: HashMap<String, (usize, usize)> = HashMap::new();
    for (row, name) in names.enumerate() {
        match places.get_mut(name) {
            Some((_, rows)) => *rows += 1,
            None => drop(places.insert(name.to_owned(), (row, 1))),
        }
    }
    places
}

impl AnonymousScan for Seen {
    fn as_any(&self) -> &dyn Any {
        self
    }

    fn scan(&self, asked: AnonymousScanArgs) -> PolarsResult<DataFrame> {
        let columns = asked_columns(&asked);
        let conditions = self.conditions.iter().flat_map(|condition| condition.keys().cloned());
        let needed: Vec<String> = columns.iter().cloned().chain(conditions).collect();
        let all = self.with(&needed)?;
        let mut terms = self.terms.lock().unwrap_or_else(PoisonError::into_inner);
        let wanted = terms.wanted(&all, &self.conditions)?;
        drop(terms);
        let rows = all.select(columns)?;
        let rows = match wanted.filter(|wanted| !wanted.all()) {
            Some(wanted) => rows.filter(&wanted)?,
            None => rows,
        };
        Ok(asked_rows(rows, &asked))
    }

    fn allows_projection_pushdown(&self) -> bool {
        true
    }
}
