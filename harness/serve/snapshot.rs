//! The runs as they were read last, and the answer of `/api/runs`.

use super::answers::{Answer, Failure, columns, number};
use harness_analysis::higher_is_better;
use harness_analysis::models::baselines_in_sql;
use harness_catalog::query_recorded;
use harness_registry::{Recorded, Registry, Remembered, RunRecord};
use harness_spec::Modality;
use polars::prelude::{DataFrame, PolarsResult};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// How long the runs are not looked at again after they were.
const FRESH: Duration = Duration::from_secs(1);

/// The columns of a run in the page's table.
const RUNS: &str = "select experiment, run, status, scenario, input, output, architecture, latent, variant, seed, \
     started, prediction_seconds + coalesce(reconstruction_seconds, 0) + evaluation_seconds as seconds, \
     parameters, reading, reason, host, dataset, group_hash from runs order by experiment, run";
/// The overall metrics of predictions, by all models but baselines.
const METRICS: &str =
    "where task = 'prediction' and model not in ({baselines}) and index is null and direction is null";

/// The runs of a results folder, which are read again when they change.
pub struct Snapshot {
    registry: Registry,
    memory: Remembered,
    /// The runs that the last look left out, with the reasons.
    left_out: Vec<String>,
    looked: Option<Instant>,
    /// Raised with every change. Begins with the time, in microseconds since 1970, so that a page that stays open does
    /// not take the answers of the next server for its own.
    version: u128,
    /// The answer for this version, once it was asked for and had all metrics.
    answer: Option<String>,
    /// The settings in which the runs of this version differ, once they were asked for.
    settings: Option<String>,
}

impl Snapshot {
    pub fn new(registry: Registry) -> Self {
        let version = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |time| time.as_micros());
        let (memory, left_out) = (Remembered::default(), Vec::new());
        Self { registry, memory, left_out, looked: None, version, answer: None, settings: None }
    }

    /// Reads the runs that have changed, if the last look was some time ago.
    pub fn refresh(&mut self) {
        if self.looked.is_some_and(|looked| looked.elapsed() < FRESH) {
            return;
        }
        // A registry never forgets what it has left out, so each look has its own.
        let registry = self.registry.anew();
        let changed = registry.refresh(&mut self.memory);
        let before = std::mem::replace(&mut self.left_out, registry.left_out());
        let is_same = before == self.left_out;
        if changed || !is_same || self.looked.is_none() {
            self.version += 1;
            self.answer = None;
            self.settings = None;
        }
        self.looked = Some(Instant::now());
    }

    /// The folders and records of all runs.
    pub fn recorded(&mut self) -> Arc<Vec<Recorded>> {
        self.refresh();
        self.memory.recorded().clone()
    }

    /// The number of this version of the runs.
    pub fn version(&self) -> u128 {
        self.version
    }

    /// The settings in which the runs differ, as JSON, if they were asked for before.
    pub fn settings(&self) -> Option<&str> {
        self.settings.as_deref()
    }

    /// Remembers the settings in which the runs of a version differ, unless the runs have changed meanwhile.
    pub fn remember_settings(&mut self, version: u128, settings: String) {
        if version == self.version {
            self.settings = Some(settings);
        }
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

    /// All runs with their overall metrics, unless they are those of `version`, which the page has already. If the
    /// metrics can't be read, all runs without them, and the reason.
    ///
    /// # Errors
    /// When the query of the runs fails.
    pub fn runs(&mut self, version: Option<&str>) -> Result<Answer, Failure> {
        self.refresh();
        if self.answer.is_some() && version.is_some_and(|version| version == self.version.to_string()) {
            return Ok(Answer::Unchanged);
        }
        if let Some(answer) = &self.answer {
            return Ok(Answer::Json(answer.clone()));
        }
        let (answer, is_whole) = self.answer()?;
        self.answer = is_whole.then(|| answer.clone());
        Ok(Answer::Json(answer))
    }

    /// The answer for this version, and whether it has the metrics.
    fn answer(&self) -> Result<(String, bool), Failure> {
        let all = self.memory.recorded();
        let ask = |sql: &str| query_recorded(&self.registry, all, sql);
        let runs = ask(RUNS)?;
        let mut left_out = self.left_out.clone();
        let own: HashMap<(&str, &str), i64> = all.iter().map(|(_, record)| own_horizon(record)).collect();
        let horizons: BTreeSet<i64> = own.values().copied().collect();
        let further = horizons.iter().any(|horizon| *horizon > 1);
        let listed: Vec<String> = horizons.iter().map(i64::to_string).collect();
        let (horizon, table) = if further { ("horizon", "all_metrics") } else { ("1 as horizon", "metrics") };
        let mut sql =
            format!("select experiment, run, modality, metric, {horizon}, value from {table} {METRICS}");
        if further {
            sql += &format!(
                " and given is null and (horizon in ({}) or modality = 'latent')",
                listed.join(", ")
            );
        }
        let mut metrics = Metrics::new();
        match ask(&sql.replace("{baselines}", &baselines_in_sql())) {
            Ok(rows) => add_metrics(&mut metrics, &runs, &rows, &own)?,
            Err(error) => left_out.push(format!("the metrics of all runs are left out: {error}")),
        }
        let is_whole = left_out.len() == self.left_out.len();
        let mut found = columns(&runs, runs.height());
        for ((modality, metric, horizon), values) in metrics {
            let values: Vec<Value> =
                values.into_iter().map(|value| value.map_or(Value::Null, number)).collect();
            found.push(json!({
                "name": match horizon {
                    _ if !further || modality == Modality::LATENT.name() => format!("{modality} {metric}"),
                    1 => format!("{modality} {metric}, next sample"),
                    _ => format!("{modality} {metric}, {horizon} samples ahead"),
                },
                "metric": metric,
                "better": higher_is_better(&metric),
                "values": values,
            }));
        }
        let root =
            std::path::absolute(self.registry.root()).unwrap_or_else(|_| self.registry.root().to_owned());
        let answer = json!({
            "version": self.version.to_string(),
            "results": root.display().to_string(),
            "left_out": left_out,
            "count": runs.height(),
            "columns": found,
        });
        Ok((answer.to_string(), is_whole))
    }
}

/// The values of metrics, by modality, metric and horizon in samples: one for each run.
type Metrics = BTreeMap<(String, String, i64), Vec<Option<f64>>>;

/// The experiment and the name of a run, and the horizon that its spec asks for, in samples.
fn own_horizon(record: &RunRecord) -> ((&str, &str), i64) {
    ((&record.experiment, &record.run), record.spec.window.horizon as i64)
}

/// Adds the overall metrics of each row of `runs`: those of the run's own horizon, and of the latent state.
fn add_metrics(
    found: &mut Metrics,
    runs: &DataFrame,
    metrics: &DataFrame,
    own: &HashMap<(&str, &str), i64>,
) -> PolarsResult<()> {
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
    let (horizons, values) = (metrics.column("horizon")?.i64()?, metrics.column("value")?.f64()?);
    for row in 0..metrics.height() {
        let Some(place) = rows.get(&(experiment.get(row), run.get(row))) else { continue };
        let (Some(modality), Some(metric)) = (modality.get(row), metric.get(row)) else { continue };
        let name = experiment.get(row).zip(run.get(row));
        let is_of_latent = modality == Modality::LATENT.name();
        let is_own = |horizon: &i64| is_of_latent || name.and_then(|name| own.get(&name)) == Some(horizon);
        let Some(horizon) = horizons.get(row).filter(is_own) else { continue };
        let column = found.entry((modality.to_owned(), metric.to_owned(), horizon));
        column.or_insert_with(|| vec![None; runs.height()])[*place] = values.get(row);
    }
    Ok(())
}
