//! How the losses fell, epoch by epoch.

use super::short;
use crate::registry::{QueryError, Registry, query, rows};
use crate::spec::Task;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Epochs of each training that the page keeps, evenly chosen, the first and the last among them.
const EPOCHS: usize = 100;

/// The losses of one training.
#[derive(Serialize)]
pub struct Curves {
    #[serde(flatten)]
    of: Of,
    epochs: Vec<usize>,
    /// By term and split, a value an epoch.
    terms: BTreeMap<String, BTreeMap<String, Vec<Option<f64>>>>,
}

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
struct Of {
    experiment: String,
    run: String,
    task: Task,
}

#[derive(Deserialize)]
struct Row {
    #[serde(flatten)]
    of: Of,
    epoch: usize,
    split: String,
    term: String,
    value: Option<f64>,
}

/// The curves of all finished runs, by experiment, run and task.
///
/// # Errors
/// When a table can't be read.
pub fn curves(registry: &Registry) -> Result<Vec<Curves>, QueryError> {
    let mut answer = query(registry, "select experiment, run, task, epoch, split, term, value from epochs")?;
    let mut trainings: BTreeMap<Of, Vec<Row>> = BTreeMap::new();
    for row in rows::<Row>(&mut answer)? {
        trainings.entry(row.of.clone()).or_default().push(row);
    }
    Ok(trainings.into_iter().map(|(of, rows)| Curves::new(of, &rows)).collect())
}

impl Curves {
    fn new(of: Of, rows: &[Row]) -> Self {
        let epochs = thinned(rows.iter().map(|row| row.epoch).collect());
        let places: BTreeMap<usize, usize> =
            epochs.iter().enumerate().map(|(place, epoch)| (*epoch, place)).collect();
        let mut terms: BTreeMap<String, BTreeMap<String, Vec<Option<f64>>>> = BTreeMap::new();
        for row in rows {
            let Some(place) = places.get(&row.epoch) else { continue };
            let splits = terms.entry(row.term.clone()).or_default();
            let values = splits.entry(row.split.clone()).or_insert_with(|| vec![None; epochs.len()]);
            values[*place] = row.value.map(short);
        }
        Self { of, epochs, terms }
    }
}

/// At most [`EPOCHS`] of them, evenly chosen.
fn thinned(epochs: BTreeSet<usize>) -> Vec<usize> {
    let all: Vec<usize> = epochs.into_iter().collect();
    if all.len() <= EPOCHS {
        return all;
    }
    (0..EPOCHS).map(|place| all[place * (all.len() - 1) / (EPOCHS - 1)]).collect()
}
