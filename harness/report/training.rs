//! Collects the losses of trainings by epoch.

use super::{Asked, rounded, short};
use harness_catalog::{QueryError, RunTable};
use harness_registry::{Registry, RunRecord, Status};
use harness_spec::RunSpec;
use harness_tables::schema::Table;
use polars::prelude::{DataFrame, PolarsResult};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// Largest number of epochs per training in the page. They are evenly chosen and include the first and the last.
const EPOCHS: usize = 100;
/// Target for the number of epochs of all trainings together. If there are many trainings, the long ones have fewer
/// epochs, but at least [`FEWEST_EPOCHS`].
const ALL_EPOCHS: usize = 24_200;
/// Significant digits of the losses of a training with more epochs than the page has. They are most of the page's data.
const DIGITS: usize = 4;
/// Least number of epochs per training in the page, if the training has as many.
const FEWEST_EPOCHS: usize = 10;

/// The losses of one training.
#[derive(Serialize)]
pub struct Curves {
    experiment: String,
    run: String,
    task: String,
    epochs: Vec<i64>,
    /// The loss at each of the epochs, by term and split.
    terms: BTreeMap<String, BTreeMap<String, Vec<Option<f64>>>>,
}

/// Returns the curves of the finished runs that are asked for, sorted by experiment, run and task.
///
/// Runs under a reading are left out, unless their experiment is asked for. They are many, and the page shows their
/// verdicts.
///
/// # Errors
/// When a table can't be read.
pub fn curves(registry: &Registry, asked: &Asked) -> Result<Vec<Curves>, QueryError> {
    let recorded = registry.recorded();
    let outdated = registry.outdated(&recorded);
    let is_shown = |run: &RunRecord| {
        run.status == Status::Done
            && !outdated.has(run)
            && asked.has_run(run)
            && (run.spec.reading().is_none() || !asked.experiments.is_empty())
    };
    let runs = recorded.into_iter().map(|(_, run)| run).filter(is_shown).collect::<Vec<_>>();
    let kept = epochs_kept(&runs);
    let mut curves = Vec::new();
    for runs in runs.chunk_by(|a, b| a.experiment == b.experiment) {
        let experiment = &runs[0].experiment;
        let rows = RunTable::new(registry, Table::Epochs, experiment, runs.iter())?;
        let columns = ["run", "task", "epoch", "split", "term", "value"].map(str::to_owned);
        let of_runs = rows.map(&columns, None, |rows| of_rows(experiment, &rows, kept))?;
        curves.extend(of_runs.into_iter().flatten());
    }
    Ok(curves)
}

/// Returns the largest number of epochs per training with which all trainings together stay within the target.
fn epochs_kept(runs: &[RunRecord]) -> usize {
    let all = |kept: usize| -> usize {
        let of_run = |spec: &RunSpec| {
            spec.trained().map_or(0, |trained| spec.tasks.len() * trained.training.epochs.min(kept))
        };
        runs.iter().map(|run| of_run(&run.spec)).sum()
    };
    (FEWEST_EPOCHS..=EPOCHS).rev().find(|kept| all(*kept) <= ALL_EPOCHS).unwrap_or(FEWEST_EPOCHS)
}

/// Returns the curves of a table's runs by run and task. The rows of each run must follow each other.
fn of_rows(experiment: &str, table: &DataFrame, kept: usize) -> PolarsResult<Vec<Curves>> {
    let text = |name: &str| table.column(name)?.str();
    let (runs, tasks, splits, terms) = (text("run")?, text("task")?, text("split")?, text("term")?);
    let (epochs, values) = (table.column("epoch")?.i64()?, table.column("value")?.f64()?);
    let row = |row| {
        let (task, split) = (tasks.get(row)?, splits.get(row)?);
        Some(Row { task, epoch: epochs.get(row)?, split, term: terms.get(row)?, value: values.get(row) })
    };
    let (mut curves, mut start) = (Vec::new(), 0);
    while start < table.height() {
        let run = runs.get(start);
        let end = (start..table.height()).find(|row| runs.get(*row) != run).unwrap_or(table.height());
        let mut by_task: BTreeMap<&str, Vec<Row>> = BTreeMap::new();
        for row in (start..end).filter_map(row) {
            by_task.entry(row.task).or_default().push(row);
        }
        let of_task = |(task, rows): (&str, Vec<Row>)| {
            Curves::new(experiment, run.unwrap_or_default(), task, &rows, kept)
        };
        curves.extend(by_task.into_iter().map(of_task));
        start = end;
    }
    Ok(curves)
}

/// A row of the epochs table.
struct Row<'a> {
    task: &'a str,
    epoch: i64,
    split: &'a str,
    term: &'a str,
    value: Option<f64>,
}

impl Curves {
    fn new(experiment: &str, run: &str, task: &str, rows: &[Row], kept: usize) -> Self {
        let all: BTreeSet<i64> = rows.iter().map(|row| row.epoch).collect();
        let is_long = all.len() > kept;
        let epochs = thinned(all.into_iter().collect(), kept);
        let mut terms: BTreeMap<String, BTreeMap<String, Vec<Option<f64>>>> = BTreeMap::new();
        for row in rows {
            let Ok(place) = epochs.binary_search(&row.epoch) else { continue };
            let splits = terms.entry(row.term.to_owned()).or_default();
            let values = splits.entry(row.split.to_owned()).or_insert_with(|| vec![None; epochs.len()]);
            values[place] =
                row.value.map(|value| if is_long { rounded(value, DIGITS) } else { short(value) });
        }
        Self { experiment: experiment.to_owned(), run: run.to_owned(), task: task.to_owned(), epochs, terms }
    }
}

/// Chooses at most `kept` epochs evenly.
fn thinned(all: Vec<i64>, kept: usize) -> Vec<i64> {
    if all.len() <= kept {
        return all;
    }
    (0..kept).map(|place| all[place * (all.len() - 1) / (kept - 1)]).collect()
}
