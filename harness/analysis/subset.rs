//! Queries over some of the runs of an analysis.

use super::seen::Seen;
use super::{Analysis, Run};
use harness_catalog::QueryError;
use harness_registry::{RunRecord, forces_of};
use harness_sql::Query;
use harness_tables::schema::Table;
use harness_tables::{asked_columns, asked_rows, lazily};
use polars::prelude::*;
use std::any::Any;
use std::collections::BTreeSet;

/// The column with the name of a run's experiment.
const EXPERIMENT: &str = "experiment";

/// Some runs of an analysis, under experiment names that may differ from their own.
pub struct Subset<'a> {
    analysis: &'a Analysis,
    /// An experiment's name in queries, and its runs.
    runs: Vec<(String, Vec<&'a Run>)>,
}

impl Analysis {
    /// A subset of runs. Each item is an experiment name and runs that have this name in queries, whatever their own
    /// experiment is. The queries must be announced before, with [`Analysis::expect`].
    pub fn subset<'a>(&'a self, runs: Vec<(String, Vec<&'a Run>)>) -> Subset<'a> {
        Subset { analysis: self, runs }
    }
}

impl Subset<'_> {
    /// Answers a query over these runs.
    ///
    /// # Errors
    /// Like [`query`](harness_catalog::query).
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
        self.analysis.answer(sql, |of, query| self.rows(of, query), recorded)
    }

    /// Whether the subset has all runs of its experiments, under their own names.
    fn is_whole(&self) -> bool {
        self.runs.iter().all(|(name, runs)| {
            runs.len() == self.analysis.runs(name).len()
                && runs.iter().all(|run| run.record.experiment == *name)
        })
    }

    /// The runs' rows of a table, a frame for each name and experiment.
    fn rows(&self, of: Table, query: &Query) -> PolarsResult<Vec<LazyFrame>> {
        let mut parts = Vec::new();
        for (name, runs) in &self.runs {
            for runs in runs.chunk_by(|a, b| a.record.experiment == b.record.experiment) {
                let experiment = &runs[0].record.experiment;
                let seen = self.analysis.seen(of, experiment, name)?;
                if seen.schema.is_empty() {
                    continue;
                }
                seen.read(query, &["run"])?;
                let schema = seen.schema.clone();
                let runs = match of {
                    Table::Forces => self.runs_with_forces(experiment, runs),
                    _ => runs.iter().map(|run| run.record.run.clone()).collect(),
                };
                parts.push(lazily(RunRows { seen, runs, name: name.clone() }, schema)?);
            }
        }
        Ok(parts)
    }

    /// The runs that have the same forces as one of `runs`. The forces of a dataset are kept of one of its runs.
    fn runs_with_forces(&self, experiment: &str, runs: &[&Run]) -> Vec<String> {
        let wanted: BTreeSet<_> = runs.iter().map(|run| forces_of(&run.record)).collect();
        let all = self.analysis.runs(experiment).iter().map(|run| &run.record);
        all.filter(|run| wanted.contains(&forces_of(run))).map(|run| run.run.clone()).collect()
    }
}

/// The rows of some runs of an experiment, with another name in the column `experiment`.
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
