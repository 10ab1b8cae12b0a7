//! Some of the runs, as if there were no others.

use super::seen::Seen;
use super::{Analysis, Run};
use harness_registry::{QueryError, RunRecord};
use harness_tables::schema::Table;
use harness_tables::{asked_columns, asked_rows, lazily};
use polars::prelude::*;
use std::any::Any;

/// The column of the name that runs are known by.
const EXPERIMENT: &str = "experiment";

/// Runs of an analysis, by the names of the experiments that queries ask for.
pub struct Subset<'a> {
    analysis: &'a Analysis,
    runs: Vec<(String, Vec<&'a Run>)>,
}

impl Analysis {
    /// These runs, which queries find under the name beside them, whatever their own experiment is. Queries must be
    /// expected ([`Analysis::expect`]).
    pub fn subset<'a>(&'a self, runs: Vec<(String, Vec<&'a Run>)>) -> Subset<'a> {
        Subset { analysis: self, runs }
    }
}

impl Subset<'_> {
    /// Answers a query over these runs.
    ///
    /// # Errors
    /// As those of [`query`](harness_registry::query).
    pub fn query(&self, sql: &str) -> Result<DataFrame, QueryError> {
        if self.is_whole() {
            let names: Vec<&str> = self.runs.iter().map(|(name, _)| name.as_str()).collect();
            return self.analysis.query(&names, sql);
        }
        let recorded = || {
            let named = |(name, runs): &(String, Vec<&Run>)| {
                let recorded = runs.iter().map(|run| run.recorded());
                let renamed = recorded
                    .map(|(folder, record)| (folder, RunRecord { experiment: name.clone(), ..record }));
                renamed.collect::<Vec<_>>()
            };
            self.runs.iter().flat_map(named).collect()
        };
        self.analysis.answer(sql, |of| self.rows(of, sql), recorded)
    }

    /// Whether these are all runs of their experiments, under their own names.
    fn is_whole(&self) -> bool {
        self.runs.iter().all(|(name, runs)| {
            runs.len() == self.analysis.runs(name).len()
                && runs.iter().all(|run| run.record.experiment == *name)
        })
    }

    /// The runs' rows of a table, by experiment and name.
    fn rows(&self, of: Table, sql: &str) -> Result<Vec<LazyFrame>, QueryError> {
        let mut parts = Vec::new();
        for (name, runs) in &self.runs {
            for runs in runs.chunk_by(|a, b| a.record.experiment == b.record.experiment) {
                let seen = self.analysis.seen(of, &runs[0].record.experiment)?;
                seen.read(sql, &["run"])?;
                let schema = seen.schema.clone();
                let runs = runs.iter().map(|run| run.record.run.clone()).collect();
                parts.push(lazily(RunRows { seen, runs, name: name.clone() }, schema)?);
            }
        }
        Ok(parts)
    }
}

/// The rows of some runs of an experiment, which is called by another name.
struct RunRows {
    seen: Seen,
    runs: Vec<String>,
    name: String,
}

impl AnonymousScan for RunRows {
    fn as_any(&self) -> &dyn Any {
        self
    }

    fn scan(&self, asked: AnonymousScanArgs) -> PolarsResult<DataFrame> {
        let mut rows = self.seen.rows_of(&self.runs, &asked_columns(&asked))?;
        if rows.column(EXPERIMENT).is_ok() {
            let name = Scalar::new(DataType::String, AnyValue::StringOwned(self.name.as_str().into()));
            rows.with_column(Column::new_scalar(EXPERIMENT.into(), name, rows.height()))?;
        }
        Ok(asked_rows(rows, &asked))
    }

    fn allows_projection_pushdown(&self) -> bool {
        true
    }
}
