//! Some of the runs, as if there were no others.

use super::seen::Seen;
use super::{Analysis, Run};
use harness_registry::{QueryError, answer, asked_columns, lazily, table};
use harness_tables::schema::Table;
use polars::prelude::*;
use std::any::Any;

/// The column of the name that runs are known by.
const EXPERIMENT: &str = "experiment";

/// Runs of an analysis, by the names of the experiments that queries ask for.
pub struct View<'a> {
    analysis: &'a Analysis,
    runs: Vec<(String, Vec<&'a Run>)>,
}

impl Analysis {
    /// These runs, which queries find under the name beside them, whatever their own experiment is. Queries must be
    /// expected ([`Analysis::expect`]).
    pub fn view<'a>(&'a self, runs: Vec<(String, Vec<&'a Run>)>) -> View<'a> {
        View { analysis: self, runs }
    }
}

impl View<'_> {
    /// Answers a query over these runs.
    ///
    /// # Errors
    /// As those of [`query`](harness_registry::query).
    pub fn query(&self, sql: &str) -> Result<DataFrame, QueryError> {
        if self.is_whole() {
            let names: Vec<&str> = self.runs.iter().map(|(name, _)| name.as_str()).collect();
            return self.analysis.query(&names, sql);
        }
        answer(sql, &|of| match of {
            Table::Epochs | Table::Metrics | Table::Predictions | Table::Forces | Table::Frames => {
                let mut parts = self.parts(of)?;
                match parts.len() {
                    0 => table(&self.analysis.registry, of, &[], sql),
                    1 => Ok(parts.remove(0)),
                    _ => Ok(concat(parts, UnionArgs::default())?),
                }
            }
            Table::Runs | Table::Episodes => {
                let named = |name: &str, run: &Run| {
                    let mut record = run.record.clone();
                    record.experiment = name.to_owned();
                    (run.folder.clone(), record)
                };
                let of_name = |(name, runs): &(String, Vec<&Run>)| {
                    runs.iter().map(|run| named(name, run)).collect::<Vec<_>>()
                };
                let recorded: Vec<_> = self.runs.iter().flat_map(of_name).collect();
                table(&self.analysis.registry, of, &recorded, sql)
            }
        })
    }

    /// Whether these are all runs of their experiments, under their own names.
    fn is_whole(&self) -> bool {
        self.runs.iter().all(|(name, runs)| {
            runs.len() == self.analysis.runs(name).len()
                && runs.iter().all(|run| run.record.experiment == *name)
        })
    }

    /// The runs' rows of a table, by experiment and name.
    fn parts(&self, of: Table) -> Result<Vec<LazyFrame>, QueryError> {
        let mut parts = Vec::new();
        for (name, runs) in &self.runs {
            for runs in runs.chunk_by(|a, b| a.record.experiment == b.record.experiment) {
                let seen = self.analysis.seen(of, &runs[0].record.experiment)?;
                let schema = seen.schema.clone();
                let runs = runs.iter().map(|run| run.record.run.clone()).collect();
                parts.push(lazily(Part { seen, runs, name: name.clone() }, schema)?);
            }
        }
        Ok(parts)
    }
}

/// The rows of some runs of an experiment, which is called by another name.
struct Part {
    seen: Seen,
    runs: Vec<String>,
    name: String,
}

impl AnonymousScan for Part {
    fn as_any(&self) -> &dyn Any {
        self
    }

    fn scan(&self, asked: AnonymousScanArgs) -> PolarsResult<DataFrame> {
        let mut rows = self.seen.rows_of(&self.runs, &asked_columns(&asked))?;
        if rows.column(EXPERIMENT).is_ok() {
            let name = Scalar::new(DataType::String, AnyValue::StringOwned(self.name.as_str().into()));
            rows.with_column(Column::new_scalar(EXPERIMENT.into(), name, rows.height()))?;
        }
        Ok(asked.n_rows.map_or(rows.clone(), |count| rows.head(Some(count))))
    }

    fn allows_projection_pushdown(&self) -> bool {
        true
    }
}
