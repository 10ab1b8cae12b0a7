//! Rows of the tables of metrics.

use harness_spec::{Modality, Task};
use harness_tables::schema::{GIVEN, HORIZON};
use polars::prelude::{DataFrame, PolarsResult, StringChunked};

/// A row of a table of metrics.
#[derive(Clone, Copy)]
pub(super) struct Row<'a> {
    pub experiment: &'a str,
    pub run: &'a str,
    pub task: Task,
    pub model: &'a str,
    pub modality: Modality,
    pub direction: Option<&'a str>,
    pub metric: &'a str,
    /// `None` where the metric is not defined.
    pub value: Option<f64>,
    pub unit: &'a str,
    /// `None` for what judges the latent state, and for a skill horizon.
    pub horizon: Option<usize>,
    /// The modalities that the model got; `None` if it got all of its run's input.
    pub given: Option<&'a str>,
}

impl<'a> Row<'a> {
    /// The rows of a query's answer with these columns. Without the columns `horizon` and
    /// `given`, predictions are of the next sample, by models that got all inputs.
    pub fn all(answer: &'a DataFrame) -> PolarsResult<Vec<Self>> {
        let text = |name: &str| -> PolarsResult<&'a StringChunked> { answer.column(name)?.str() };
        let (experiment, run, model) = (text("experiment")?, text("run")?, text("model")?);
        let (metric, unit, direction) = (text("metric")?, text("unit")?, text("direction")?);
        let (tasks, modalities) = (text("task")?, text("modality")?);
        let value = answer.column("value")?.f64()?;
        let given = answer.column(GIVEN).ok().map(|column| column.str()).transpose()?;
        let horizons = answer.column(HORIZON).ok().map(|column| column.i64()).transpose()?;
        let row = |row: usize| {
            let task = Task::ALL.iter().copied().find(|task| Some(task.name()) == tasks.get(row))?;
            let modality = Modality::new(modalities.get(row)?)?;
            let horizon = match horizons {
                Some(horizons) => horizons.get(row).map(|samples| samples as usize),
                None => Some(usize::from(task == Task::Prediction)),
            };
            Some(Self {
                experiment: experiment.get(row)?,
                run: run.get(row)?,
                task,
                model: model.get(row)?,
                modality,
                direction: direction.get(row),
                metric: metric.get(row)?,
                value: value.get(row),
                unit: unit.get(row)?,
                given: given.and_then(|given| given.get(row)),
                horizon: horizon.filter(|_| modality != Modality::LATENT),
            })
        };
        Ok((0..answer.height()).filter_map(row).collect())
    }
}
