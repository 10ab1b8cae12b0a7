//! Metrics of a user's own, computed from the stored predictions of finished runs.

use super::{Registry, RegistryError, RunFolder, RunRecord, Status};
use harness_judge::{is_usual, models};
use harness_spec::{Modality, Task};
use harness_tables::schema::{GIVEN, HORIZON, TRAINED_HERE, Table};
use harness_tables::{TableError, column_of};
use polars::prelude::*;

/// Values of a user's metric for a run, over all elements of a modality.
#[derive(Debug, Clone)]
pub struct OwnMetric {
    /// Its name in tables.
    pub name: String,
    /// Unit of the values; "1" for none.
    pub unit: String,
    /// Its values. Each belongs to other predictions.
    pub values: Vec<OwnValue>,
}

/// The value of a user's metric for some predictions.
#[derive(Debug, Clone)]
pub struct OwnValue {
    /// The predicted modality.
    pub modality: Modality,
    /// Number of samples from the present to the predicted one; 0 for the present one.
    pub horizon: usize,
    /// The modalities that the predictor got, as `arm,proprioception`; `None` if it got all of its run's input.
    pub given: Option<String>,
    /// The value; `None` if it isn't defined.
    pub value: Option<f64>,
}

impl Registry {
    /// Adds the rows of a user's metric to the tables of a finished run. They replace the rows that an earlier call
    /// added for a metric of this name. A run whose process is killed meanwhile is intact.
    ///
    /// # Errors
    /// When the run is not finished, another process works on it, or its tables are damaged or can't be written.
    pub fn add_metric(&self, folder: &RunFolder, metric: &OwnMetric) -> Result<(), RegistryError> {
        let refused = |problem| RegistryError::NoMetric { path: folder.path.clone(), problem };
        let finished = || {
            let record = folder.record()?.filter(|record| record.status == Status::Done && !record.published);
            record.ok_or_else(|| refused("it is not a finished run, or it is a published copy"))
        };
        finished()?;
        let claimed = self.claim(folder)?.ok_or_else(|| refused("another process works on it"))?;
        let record = finished()?;
        // An earlier call may have been killed.
        let settled =
            record.files.iter().map(|(name, file)| (name.clone(), file.settled(&folder.path.join(name))));
        let record = RunRecord { files: settled.collect(), ..record.clone() };
        let (usual, further) =
            metric.values.iter().partition(|value| is_usual(value.horizon, value.given.as_deref()));
        let tables = [(Table::Metrics, usual), (Table::AllMetrics, further)];
        let tables =
            tables.map(|(table, values)| Ok((table, with_values(&record, folder, table, metric, values)?)));
        let tables = tables.into_iter().collect::<Result<Vec<_>, RegistryError>>()?;
        let tables = tables.into_iter().filter_map(|(table, rows)| Some((table, rows?))).collect();
        claimed.replace_tables(record, tables)
    }
}

/// The rows of a table of metrics, with these values of a user's metric instead of earlier ones. `None` if the run has
/// no such table, and needs none.
fn with_values(
    record: &RunRecord,
    folder: &RunFolder,
    table: Table,
    metric: &OwnMetric,
    values: Vec<&OwnValue>,
) -> Result<Option<DataFrame>, RegistryError> {
    let own = record.with_key(own_columns(table, metric, &values, record)).map_err(TableError::from)?;
    if !record.has(table) {
        return Ok((own.height() > 0).then_some(own));
    }
    let rows = record.table(&folder.path, table)?;
    let joined = || -> PolarsResult<DataFrame> {
        let others = rows.column("metric")?.str()?.not_equal(metric.name.as_str());
        rows.filter(&others)?.vstack(&own)
    };
    Ok(Some(joined().map_err(TableError::from)?))
}

/// The columns of the table `metrics` or `all_metrics`, without those of the run, for a user's metric.
/// `record` is that of the run.
fn own_columns(table: Table, metric: &OwnMetric, values: &[&OwnValue], record: &RunRecord) -> Vec<Column> {
    let none = |_: &&OwnValue| None::<&str>;
    let (model, spec) = (record.predictor(), &record.spec);
    // No output is an input where the present sample is estimated.
    let is_predicted = |value: &&OwnValue| {
        value.horizon > 0 || spec.window.horizon == 0 && spec.output.contains(&value.modality)
    };
    let task = |value: &&OwnValue| if is_predicted(value) { Task::Prediction } else { Task::Reconstruction };
    let mut columns = vec![
        column_of(values, "task", |value| task(value).name()),
        column_of(values, "model", |_| model),
        column_of(values, TRAINED_HERE, |_| model == models::NETWORK),
        column_of(values, "modality", |value| value.modality.name()),
        column_of(values, "direction", none),
        column_of(values, "index", |_| None::<i64>),
        column_of(values, "metric", |_| metric.name.as_str()),
        column_of(values, "value", |value| value.value),
        column_of(values, "unit", |_| metric.unit.as_str()),
    ];
    if table == Table::AllMetrics {
        columns.push(column_of(values, HORIZON, |value| value.horizon as i64));
        columns.push(column_of(values, GIVEN, |value| value.given.as_deref()));
    }
    columns
}
