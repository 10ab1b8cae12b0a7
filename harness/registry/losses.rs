//! The losses that a run's training logged.

use super::{RegistryError, RunFolder, RunRecord};
use harness_metrics::epoch::Losses;
use harness_spec::Task;
use harness_tables::schema::Table;
use polars::prelude::*;

impl RunFolder {
    /// The losses on the validation samples of a finished run, in the order of the epochs.
    pub fn validation_losses(&self, record: &RunRecord, task: Task) -> Result<Vec<Losses>, RegistryError> {
        let columns = ["task", "epoch", "split", "term", "value"].map(str::to_owned);
        let rows = record.columns(&self.path, Table::Epochs, &columns)?;
        let path = || self.path.join(Table::Epochs.file_name());
        losses(&rows, task).map_err(|error| RegistryError::File { path: path(), reason: error.to_string() })
    }
}

fn losses(rows: &DataFrame, task: Task) -> PolarsResult<Vec<Losses>> {
    let [tasks, splits, terms] = ["task", "split", "term"].map(|name| rows.column(name)?.str());
    let (tasks, splits, terms) = (tasks?, splits?, terms?);
    let (epochs, values) = (rows.column("epoch")?.i64()?, rows.column("value")?.f64()?);
    let mut losses: Vec<Losses> = Vec::new();
    for row in 0..rows.height() {
        if tasks.get(row) != Some(task.name()) || splits.get(row) != Some("validation") {
            continue;
        }
        let (Some(epoch), Some(term), Some(value)) = (epochs.get(row), terms.get(row), values.get(row))
        else {
            continue;
        };
        // Every epoch has a row.
        let epoch = usize::try_from(epoch).unwrap_or_default().min(rows.height());
        losses.resize_with(losses.len().max(epoch), Losses::new);
        if let Some(losses) = epoch.checked_sub(1).and_then(|index| losses.get_mut(index)) {
            losses.insert(term.to_owned(), value);
        }
    }
    Ok(losses)
}
