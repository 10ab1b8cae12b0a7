//! How the losses fell, epoch by epoch.

use super::short;
use crate::registry::{QueryError, Registry, RunRecord, Status};
use crate::schema::Table;
use polars::prelude::PolarsResult;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Epochs of each training that the page keeps, evenly chosen, the first and the last among them.
const EPOCHS: usize = 100;
/// The same of all trainings together, of which none keeps fewer than [`FEWEST_EPOCHS`].
const ALL_EPOCHS: usize = 60_000;
const FEWEST_EPOCHS: usize = 10;

/// The losses of one training.
#[derive(Serialize)]
pub struct Curves {
    experiment: String,
    run: String,
    task: String,
    epochs: Vec<i64>,
    /// By term and split, a value an epoch.
    terms: BTreeMap<String, BTreeMap<String, Vec<Option<f64>>>>,
}

/// The curves of all finished runs, by experiment, run and task.
///
/// # Errors
/// When a table can't be read.
pub fn curves(registry: &Registry) -> Result<Vec<Curves>, QueryError> {
    let runs: Vec<_> =
        registry.recorded().into_iter().filter(|(_, run)| run.status == Status::Done).collect();
    let trainings: usize = runs.iter().map(|(_, run)| run.spec.tasks.len()).sum();
    let kept = (ALL_EPOCHS / trainings.max(1)).clamp(FEWEST_EPOCHS, EPOCHS);
    let of_runs = runs.par_iter().map(|(folder, run)| of_run(folder, run, kept));
    Ok(of_runs.collect::<Result<Vec<_>, _>>()?.into_iter().flatten().collect())
}

/// The curves of a run, by task.
fn of_run(folder: &Path, run: &RunRecord, kept: usize) -> Result<Vec<Curves>, QueryError> {
    let columns = ["task", "epoch", "split", "term", "value"].map(str::to_owned).to_vec();
    let table = run.read_table(folder, Table::Epochs, columns)?;
    let rows = || -> PolarsResult<Vec<Row>> {
        let text = |name: &str| table.column(name)?.str();
        let (tasks, splits, terms) = (text("task")?, text("split")?, text("term")?);
        let (epochs, values) = (table.column("epoch")?.i64()?, table.column("value")?.f64()?);
        let row = |row| {
            let (task, split) = (tasks.get(row)?, splits.get(row)?);
            Some(Row { task, epoch: epochs.get(row)?, split, term: terms.get(row)?, value: values.get(row) })
        };
        Ok((0..table.height()).filter_map(row).collect())
    };
    let mut by_task: BTreeMap<&str, Vec<Row>> = BTreeMap::new();
    for row in rows().map_err(QueryError::Sql)? {
        by_task.entry(row.task).or_default().push(row);
    }
    Ok(by_task.into_iter().map(|(task, rows)| Curves::new(run, task, &rows, kept)).collect())
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
    fn new(run: &RunRecord, task: &str, rows: &[Row], kept: usize) -> Self {
        let epochs = thinned(rows.iter().map(|row| row.epoch).collect(), kept);
        let mut terms: BTreeMap<String, BTreeMap<String, Vec<Option<f64>>>> = BTreeMap::new();
        for row in rows {
            let Ok(place) = epochs.binary_search(&row.epoch) else { continue };
            let splits = terms.entry(row.term.to_owned()).or_default();
            let values = splits.entry(row.split.to_owned()).or_insert_with(|| vec![None; epochs.len()]);
            values[place] = row.value.map(short);
        }
        Self {
            experiment: run.experiment.clone(),
            run: run.run.clone(),
            task: task.to_owned(),
            epochs,
            terms,
        }
    }
}

/// At most `kept` of them, evenly chosen.
fn thinned(epochs: BTreeSet<i64>, kept: usize) -> Vec<i64> {
    let all: Vec<i64> = epochs.into_iter().collect();
    if all.len() <= kept {
        return all;
    }
    (0..kept).map(|place| all[place * (all.len() - 1) / (kept - 1)]).collect()
}
