//! The runs as they were read last, and the answer of `/api/runs`.

use super::answers::{Answer, Failure, columns, number};
use harness_registry::{Recorded, Registry, Remembered, answer, table};
use polars::prelude::{DataFrame, PolarsResult};
use serde_json::{Value, json};
use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant};

/// How long the runs are not looked at again after they were.
const FRESH: Duration = Duration::from_secs(1);

/// The columns of a run in the page's table.
const RUNS: &str = "select experiment, run, status, scenario, input, output, architecture, latent, variant, seed, started, \
     collect_seconds + prediction_seconds + coalesce(reconstruction_seconds, 0) + evaluation_seconds as seconds, \
     parameters, reading, reason, host, dataset, group_hash from runs order by experiment, run";
/// The overall metrics of the networks that predict.
const METRICS: &str = "select experiment, run, modality, metric, value from metrics where task = 'prediction' and \
     model = 'network' and index is null and direction is null";

/// The runs of a results folder, which are read again when they change.
pub struct Snapshot {
    registry: Registry,
    memory: Remembered,
    looked: Option<Instant>,
    /// Raised with every change.
    version: u64,
    /// The answer for this version, once it was asked for.
    answer: Option<String>,
}

impl Snapshot {
    pub fn new(registry: Registry) -> Self {
        Self { registry, memory: Remembered::default(), looked: None, version: 0, answer: None }
    }

    /// Reads the runs that have changed, if the last look was some time ago.
    pub fn refresh(&mut self) {
        if self.looked.is_some_and(|looked| looked.elapsed() < FRESH) {
            return;
        }
        if self.registry.refresh(&mut self.memory) || self.looked.is_none() {
            self.version += 1;
            self.answer = None;
        }
        self.looked = Some(Instant::now());
    }

    /// The folder and record of a run.
    ///
    /// # Errors
    /// When there is no run with this name, `experiment/run`.
    pub fn find(&mut self, name: &str) -> Result<Recorded, Failure> {
        self.refresh();
        let found = self.memory.recorded().iter().find(|(_, record)| record.name() == name);
        found.cloned().ok_or_else(|| Failure::Unknown(format!("run {name}")))
    }

    /// All runs with their overall metrics, unless they are those of `version`, which the page has already.
    ///
    /// # Errors
    /// When a table is damaged.
    pub fn runs(&mut self, version: Option<&str>) -> Result<Answer, Failure> {
        self.refresh();
        if version.is_some_and(|version| version == self.version.to_string()) {
            return Ok(Answer::Unchanged);
        }
        if self.answer.is_none() {
            self.answer = Some(self.answer()?);
        }
        Ok(Answer::Json(self.answer.clone().unwrap_or_default()))
    }

    fn answer(&self) -> Result<String, Failure> {
        let all = self.memory.recorded();
        let ask = |sql: &str| answer(sql, &|of| table(&self.registry, of, all, sql));
        let runs = ask(RUNS)?;
        let mut found = columns(&runs, runs.height());
        for ((modality, metric), values) in metrics(&runs, &ask(METRICS)?).map_err(Failure::from)? {
            let values: Vec<Value> =
                values.into_iter().map(|value| value.map_or(Value::Null, number)).collect();
            found.push(json!({ "name": format!("{modality} {metric}"), "metric": metric, "values": values }));
        }
        let root =
            std::path::absolute(self.registry.root()).unwrap_or_else(|_| self.registry.root().to_owned());
        let answer = json!({
            "version": self.version.to_string(),
            "results": root.display().to_string(),
            "left_out": self.registry.left_out(),
            "count": runs.height(),
            "columns": found,
        });
        Ok(answer.to_string())
    }
}

/// The values of metrics, by modality and metric: one for each run.
type Metrics = BTreeMap<(String, String), Vec<Option<f64>>>;

/// The overall metrics of each row of `runs`.
fn metrics(runs: &DataFrame, metrics: &DataFrame) -> PolarsResult<Metrics> {
    let text = |table: &DataFrame, name: &str| {
        Ok::<_, polars::prelude::PolarsError>(table.column(name)?.str()?.clone())
    };
    let (experiments, ids) = (text(runs, "experiment")?, text(runs, "run")?);
    let names = experiments.iter().zip(ids.iter()).enumerate();
    let rows: HashMap<(Option<&str>, Option<&str>), usize> = names.map(|(row, name)| (name, row)).collect();
    let [experiment, run, modality, metric] = [
        text(metrics, "experiment")?,
        text(metrics, "run")?,
        text(metrics, "modality")?,
        text(metrics, "metric")?,
    ];
    let values = metrics.column("value")?.f64()?;
    let mut found = Metrics::new();
    for row in 0..metrics.height() {
        let Some(place) = rows.get(&(experiment.get(row), run.get(row))) else { continue };
        let (Some(modality), Some(metric)) = (modality.get(row), metric.get(row)) else { continue };
        let column = found.entry((modality.to_owned(), metric.to_owned()));
        column.or_insert_with(|| vec![None; runs.height()])[*place] = values.get(row);
    }
    Ok(found)
}
