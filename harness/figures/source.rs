//! What figures are drawn from: the finished runs of the paper's two experiments, and their tables.

use super::FigureError;
use crate::metrics::interval::{Interval, LEVEL, mean_interval};
use crate::registry::{Registry, RunRecord, Status, query};
use crate::spec::{Origin, RunSpec, Scenario};
use polars::prelude::*;
use std::collections::BTreeMap;

/// The paper's experiments; each has a spec of its name in `experiments/`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Study {
    /// Proprioception alone is given.
    SingleToMulti,
    /// Proprioception and vision are given.
    MultiToMulti,
}

impl Study {
    pub const BOTH: [Study; 2] = [Study::SingleToMulti, Study::MultiToMulti];

    pub fn name(self) -> &'static str {
        match self {
            Study::SingleToMulti => "single_to_multi",
            Study::MultiToMulti => "multi_to_multi",
        }
    }

    /// What its networks are given, for people.
    pub fn input(self) -> &'static str {
        match self {
            Study::SingleToMulti => "from proprioception",
            Study::MultiToMulti => "from proprioception + vision",
        }
    }
}

/// A results folder, seen as the place of the two studies.
pub struct Source<'a> {
    registry: &'a Registry,
    quick: bool,
}

/// The finished runs of a study: they differ in scenario, latent size and seed alone.
pub struct Runs<'a> {
    registry: &'a Registry,
    pub experiment: String,
    /// By scenario, latent size and seed.
    pub records: Vec<RunRecord>,
    command: String,
}

impl<'a> Source<'a> {
    /// With `quick`, the runs that `harness run … --quick` makes.
    pub fn new(registry: &'a Registry, quick: bool) -> Self {
        Self { registry, quick }
    }

    /// The finished runs of a study.
    ///
    /// An experiment's folder may hold runs of different settings, after overrides or a changed spec. They can't
    /// be averaged; the settings with the most runs are taken, and among equals the ones that were run last.
    ///
    /// # Errors
    /// When there are none; the message says what to run.
    pub fn runs(&self, study: Study) -> Result<Runs<'a>, FigureError> {
        let (ending, option) = if self.quick { ("-quick", " --quick") } else { ("", "") };
        let experiment = format!("{}{ending}", study.name());
        let command = format!("harness run experiments/{}.yaml{option}", study.name());
        let mut by_settings: BTreeMap<String, Vec<RunRecord>> = BTreeMap::new();
        for record in self.registry.records() {
            // The figures are about the simulated scenarios.
            let is_simulated = matches!(record.spec.scenario, Origin::Simulated(_));
            if is_simulated && record.experiment == experiment && record.status == Status::Done {
                by_settings.entry(settings(&record.spec)).or_default().push(record);
            }
        }
        let last = |records: &[RunRecord]| records.iter().map(|record| record.started.clone()).max();
        let most = by_settings.into_values().max_by_key(|records| (records.len(), last(records)));
        let Some(mut records) = most else {
            let root = self.registry.root().to_owned();
            return Err(FigureError::NoRuns { experiment, root, command });
        };
        records.sort_by_key(|record| (record.spec.scenario.clone(), record.spec.latent, record.spec.seed));
        Ok(Runs { registry: self.registry, experiment, records, command })
    }
}

/// What runs must share so that they can stand in one figure: all settings but scenario, latent size and seed.
fn settings(spec: &RunSpec) -> String {
    let mut spec = spec.clone();
    spec.seed = 0;
    spec.latent = 0;
    spec.scenario = Scenario::ALL[0].into();
    spec.hash()
}

impl Runs<'_> {
    /// The rows of a query over these runs. In `sql`, `{runs}` stands for the condition that picks them.
    ///
    /// # Errors
    /// When the query can't be answered, or has no rows.
    pub fn query(&self, sql: &str) -> Result<DataFrame, FigureError> {
        let ids: Vec<String> = self.records.iter().map(|record| format!("'{}'", record.run)).collect();
        let condition = format!("experiment = '{}' and run in ({})", self.experiment, ids.join(", "));
        let answer = query(self.registry, &sql.replace("{runs}", &condition))?;
        if answer.height() == 0 {
            let (experiment, command) = (self.experiment.clone(), self.command.clone());
            return Err(FigureError::NoRows { experiment, root: self.registry.root().to_owned(), command });
        }
        Ok(answer)
    }

    /// The latent sizes there are, ascending.
    pub fn latents(&self) -> Vec<usize> {
        let mut latents: Vec<usize> = self.records.iter().map(|record| record.spec.latent).collect();
        latents.sort_unstable();
        latents.dedup();
        latents
    }

    /// The most seeds that any cell has.
    pub fn seeds(&self) -> usize {
        let mut cells: BTreeMap<String, usize> = BTreeMap::new();
        for record in &self.records {
            *cells.entry(record.spec.cell()).or_default() += 1;
        }
        cells.into_values().max().unwrap_or_default()
    }

    /// The runs with the lowest seed of each cell, as a condition in SQL: one network a cell, to show single samples.
    pub fn first_seeds(&self) -> String {
        let mut first = self.records.iter().collect::<Vec<_>>();
        first.dedup_by_key(|record| record.spec.cell());
        let ids: Vec<String> = first.iter().map(|record| format!("'{}'", record.run)).collect();
        format!("run in ({})", ids.join(", "))
    }
}

/// A column of text, without nulls.
pub fn texts(table: &DataFrame, column: &str) -> Result<Vec<String>, FigureError> {
    let values = table.column(column)?.str()?;
    Ok(values.iter().map(|value| value.unwrap_or_default().to_owned()).collect())
}

/// A column of integers, without nulls.
pub fn integers(table: &DataFrame, column: &str) -> Result<Vec<i64>, FigureError> {
    let values = table.column(column)?.cast(&DataType::Int64)?;
    Ok(values.i64()?.iter().map(Option::unwrap_or_default).collect())
}

/// A column of numbers; null stays `None`.
pub fn reals(table: &DataFrame, column: &str) -> Result<Vec<Option<f64>>, FigureError> {
    let values = table.column(column)?.cast(&DataType::Float64)?;
    Ok(values.f64()?.iter().collect())
}

/// Means over seeds: rows with the same key become one interval, in the order of the keys. Null values are left out.
pub fn intervals<K: Ord>(rows: impl IntoIterator<Item = (K, Option<f64>)>) -> BTreeMap<K, Interval> {
    let mut values: BTreeMap<K, Vec<f64>> = BTreeMap::new();
    for (key, value) in rows {
        values.entry(key).or_default().extend(value);
    }
    values.into_iter().filter_map(|(key, values)| Some((key, mean_interval(&values, LEVEL)?))).collect()
}
