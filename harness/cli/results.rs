//! The results of some runs, for `harness run` and `harness show`: the metrics of the networks beside those of the
//! baselines, and the best of some runs.

use super::sheet::{MISSING, Sheet, Style};
use anyhow::Result;
use harness::analysis::{BY_UNIT, Undefined};
use harness::catalog::{OVERALL, query_of, rows};
use harness::judge::models;
use harness::learning::objective::KL;
use harness::learning::training::TOTAL;
use harness::metrics::{Metric, best, label, rounded};
use harness::numbers::Natural;
use harness::registry::{Registry, RunRecord};
use harness::spec::{Task, model_parts};
use serde::Deserialize;
use std::cmp::Reverse;
use std::collections::BTreeSet;

/// A row of the table, with the means over runs that differ in their seeds.
#[derive(Deserialize)]
struct Row {
    task: String,
    scenario: String,
    variant: String,
    /// `None` for an external model.
    latent: Option<u32>,
    modality: String,
    direction: Option<String>,
    metric: String,
    unit: String,
    /// The value of the network or the model of another program.
    own: Option<f64>,
    persistence: Option<f64>,
    ridge: Option<f64>,
    training_mean: Option<f64>,
    nearest_neighbors: Option<f64>,
    /// The number of runs that the means are over.
    runs: usize,
}

impl Row {
    /// The value of the network or the other model, and those of [`models::BASELINES`].
    fn values(&self) -> [Option<f64>; 5] {
        [self.own, self.persistence, self.ridge, self.training_mean, self.nearest_neighbors]
    }
}

/// The metric that only predicted distributions of forces have.
const COVERAGE: &str = "coverage_90_contact";

/// Which metrics a table has.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Metrics {
    /// Those by which networks are compared.
    Main,
    /// All of them, also for each direction.
    All,
}

/// Metrics of the runs in question and of the baselines, averaged over seeds.
pub fn sheet(registry: &Registry, metrics: Metrics, is_wanted: impl Fn(&RunRecord) -> bool) -> Result<Sheet> {
    let of_baseline = |model: &str| format!("avg(case when model = '{model}' then value end) as {model}");
    let others = format!("{}, '{}'", models::baselines_in_sql(), models::UNTRAINED);
    let own = format!("avg(case when model not in ({others}) then value end) as own");
    let means: Vec<String> = std::iter::once(own).chain(models::BASELINES.map(of_baseline)).collect();
    let chosen = match metrics {
        Metrics::Main => format!(
            "{OVERALL} and metric in ('smape', 'wmape', 'r2', 'relative_error', 'accuracy', 'balanced_accuracy', \
             'log_loss', 'angle', 'f1', 'crps', '{COVERAGE}')"
        ),
        Metrics::All => "index is null".to_owned(),
    };
    let records = registry.records();
    let horizon = common_horizon(records.iter().filter(|record| is_wanted(record)));
    let (table, own) = rows_at(horizon);
    let cell = "task, scenario, variant, latent, modality, direction, metric, unit";
    let sql = format!(
        "select {cell}, count(distinct run) as runs, {} from {table} where {chosen} {own} group by {cell} \
         order by task, scenario desc, variant, latent, modality, direction, metric",
        means.join(", ")
    );
    let mut rows: Vec<Row> = rows(&mut query_of(registry, &is_wanted, &sql)?)?;
    if metrics == Metrics::Main {
        // A network that predicts distributions is also judged by them.
        let judged: BTreeSet<String> =
            rows.iter().filter(|row| row.metric == COVERAGE).map(|row| row.modality.clone()).collect();
        let is_main =
            |row: &Row| !["f1", "crps"].contains(&row.metric.as_str()) || judged.contains(&row.modality);
        rows.retain(is_main);
    }
    let place =
        |row: &Row| (row.task.clone(), Reverse(row.scenario.clone()), Natural::new(row.variant.as_str()));
    rows.sort_by_cached_key(place);
    let of = |row: &Row| (place(row), row.latent, row.modality.clone(), row.direction.clone());
    rows.chunk_by_mut(|a, b| of(a) == of(b))
        .for_each(|rows| rows.sort_by_key(|row| Metric::place(&row.metric)));
    // A baseline without any value has no column.
    let has_values: Vec<bool> = (0..=models::BASELINES.len())
        .map(|model| model == 0 || rows.iter().any(|row| row.values()[model].is_some()))
        .collect();
    let row = |row: Row| {
        let values = row.values();
        let number = |(value, is_best): (&Option<f64>, bool)| match value {
            Some(value) => Style::Text.number(&rounded(*value, &row.unit), None, is_best),
            None => MISSING.into(),
        };
        let numbers = values.iter().zip(best(&row.metric, &row.unit, &values)).map(number);
        let numbers = numbers.zip(&has_values).filter(|(_, has)| **has).map(|(number, _)| number).collect();
        let words = vec![
            row.task,
            row.scenario,
            row.variant.replace(',', ", "),
            row.latent.map(|latent| format!("latent {latent}")).unwrap_or_default(),
            row.modality.replace('_', " "),
            row.direction.unwrap_or_default(),
            Style::Text.metric(&row.metric, &row.unit),
        ];
        (words, numbers)
    };
    let header =
        std::iter::once(predictors(&rows)).chain(models::BASELINES.map(|model| model.replace('_', " ")));
    let header = header.zip(&has_values).filter(|(_, has)| **has).map(|(name, _)| name).collect();
    let is_part = |row: &Row| row.direction.as_ref().is_some_and(|name| name.starts_with("in "));
    let by_unit = rows.iter().any(is_part).then(|| BY_UNIT.to_owned());
    let most = rows.iter().map(|row| row.runs).max().filter(|runs| *runs > 1);
    let means =
        most.map(|runs| format!("means over up to {runs} runs, which differ in their seeds or folds"));
    let notes = means.into_iter().chain(by_unit).chain([ahead(horizon)]).chain(undefined(&rows)).collect();
    Ok(Sheet { titles: 4, header, rows: rows.into_iter().map(row).collect(), notes, ..Sheet::default() })
}

/// The horizon that runs predict at. Runs with several horizons have the next sample in common.
pub fn common_horizon<'a>(runs: impl Iterator<Item = &'a RunRecord>) -> usize {
    let horizons: BTreeSet<usize> = runs.map(|run| run.spec.window.horizon).collect();
    horizons.first().copied().filter(|_| horizons.len() == 1).unwrap_or(1)
}

/// The table with the metrics of predictions at a horizon from all inputs, and a condition, if it has others too.
pub fn rows_at(horizon: usize) -> (&'static str, String) {
    match horizon {
        1 => ("metrics", String::new()),
        _ => (
            "all_metrics",
            format!("and given is null and (horizon in (0, {horizon}) or modality = 'latent')"),
        ),
    }
}

/// Says how far ahead predictions are.
pub fn ahead(horizon: usize) -> String {
    match horizon {
        0 => "estimates of the present sample".to_owned(),
        1 => "predictions of the next sample".to_owned(),
        _ => format!("predictions {horizon} samples ahead"),
    }
}

/// Sentences about the modalities that lack metrics, because they do not change in the test samples.
fn undefined(rows: &[Row]) -> Vec<String> {
    let scenarios: BTreeSet<&str> = rows.iter().map(|row| row.scenario.as_str()).collect();
    let mut undefined = Undefined::default();
    let lacks = |row: &&Row| {
        let is_whole = row.direction.as_ref().is_none_or(|part| part.starts_with("in "));
        let is_prediction = row.task == Task::Prediction.name();
        is_prediction && is_whole && Undefined::may_lack(&row.metric) && row.values() == [None; 5]
    };
    for row in rows.iter().filter(lacks) {
        let part = row.direction.iter().map(|part| format!(" {part}")).collect::<String>();
        let place = if scenarios.len() > 1 { format!("{}: ", row.scenario) } else { String::new() };
        undefined.add(&format!("{place}{}{part}", row.modality), None, &row.metric);
    }
    undefined.sentences(|_| true)
}

/// What the models that are not baselines are called: `network`, the name of an external model, or both words.
fn predictors(rows: &[Row]) -> String {
    let names: BTreeSet<Option<&str>> = rows.iter().map(|row| model_parts(&row.variant).1).collect();
    match names.iter().copied().collect::<Vec<_>>()[..] {
        [] | [None] => models::NETWORK.to_owned(),
        [Some(name)] => name.to_owned(),
        [None, ..] => "network or model".to_owned(),
        _ => "model".to_owned(),
    }
}

/// The run with the lowest validation error of some runs that were validated alike.
#[derive(Deserialize)]
pub struct Best {
    /// The run's id.
    pub run: String,
    /// The mean of its outputs' errors on the validation samples, in the epoch whose parameters were kept.
    pub error: f64,
}

impl Best {
    /// The best of the runs in question, or `None` if no run is done or there are no validation samples.
    pub fn of(registry: &Registry, is_wanted: impl Fn(&RunRecord) -> bool) -> Result<Option<Self>> {
        let losses = "from epochs where task = 'prediction' and split = 'validation'";
        // The weighted sum of the terms is not used, because runs may differ in the weights.
        let sql = format!(
            "with kept as (select run, epoch, row_number() over (partition by run order by value, epoch) as place \
             {losses} and term = '{TOTAL}') \
             select run, avg(value) as error from (select run, epoch, value {losses} and term not in ('{TOTAL}', \
             '{KL}')) join kept using (run, epoch) where place = 1 group by run order by error, run limit 1"
        );
        Ok(rows(&mut query_of(registry, is_wanted, &sql)?)?.into_iter().next())
    }
}

/// How much of its latent state a network uses, as the table of metrics says.
#[derive(Deserialize)]
pub struct LatentUse {
    kl: f64,
    active: f64,
}

impl LatentUse {
    /// Of the run in question; `None` if its table lacks it.
    pub fn of(registry: &Registry, is_run: impl Fn(&RunRecord) -> bool) -> Result<Option<Self>> {
        let [kl, active] = Metric::LATENT.map(Metric::name);
        let sql = format!(
            "select k.value as kl, a.value as active from metrics as k join metrics as a using (experiment, run, \
             modality) where k.metric = '{kl}' and k.index is null and a.metric = '{active}'"
        );
        Ok(rows(&mut query_of(registry, is_run, &sql)?)?.into_iter().next())
    }
}

impl std::fmt::Display for LatentUse {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let Self { kl, active } = self;
        write!(f, "{active} active (KL {} nats)", rounded(*kl, "nats"))
    }
}

/// How many outputs a run predicts better than a baseline does, on the test samples.
#[derive(Deserialize)]
pub struct Comparison {
    baseline: String,
    better: u32,
    outputs: u32,
    /// The metrics that the outputs are compared by, in alphabetical order.
    first_metric: String,
    last_metric: String,
}

impl Comparison {
    /// Compares a run with each baseline on the test samples: by R2, for images by the relative error, and for
    /// categories by the accuracy.
    pub fn all(registry: &Registry, is_run: impl Fn(&RunRecord) -> bool) -> Result<Vec<Self>> {
        let errors = format!(
            "select model, modality, coalesce(direction, '') as part, metric, \
             case when metric = 'relative_error' then value else 1 - value end as error from metrics \
             where task = 'prediction' and {OVERALL} and metric in ('r2', 'relative_error', 'accuracy') \
             and value is not null"
        );
        let sql = format!(
            "with errors as ({errors}) select b.model as baseline, \
             sum(case when n.error < b.error then 1 else 0 end) as better, count(*) as outputs, \
             min(n.metric) as first_metric, max(n.metric) as last_metric \
             from errors as n join errors as b on n.modality = b.modality and n.part = b.part \
             where n.model not in ({baselines}) and b.model in ({baselines}) group by b.model order by baseline",
            baselines = models::baselines_in_sql()
        );
        Ok(rows(&mut query_of(registry, is_run, &sql)?)?)
    }

    /// The metrics that outputs are compared by, in words.
    pub fn metrics(all: &[Self]) -> String {
        let names = all.iter().flat_map(|one| [&one.first_metric, &one.last_metric]);
        let names: BTreeSet<String> = names.map(|name| label(name, "1")).collect();
        names.into_iter().collect::<Vec<_>>().join(" or ")
    }
}

impl std::fmt::Display for Comparison {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let Self { baseline, better, outputs, .. } = self;
        let article = if baseline == models::TRAINING_MEAN { "the " } else { "" };
        write!(f, "{article}{} in {better} of {outputs}", baseline.replace('_', " "))
    }
}
