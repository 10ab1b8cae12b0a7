//! The answers of the server, as JSON.

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use harness_analysis::{
    Analysis, AnalysisError, Key, Question, Selection, Setting, all_settings, higher_is_better,
    varied_settings,
};
use harness_catalog::{QueryError, query_all, query_recorded};
use harness_claims::{Claim, ClaimsFile, Judgment, Readings, judge};
use harness_registry::{Recorded, Registry, Status};
use harness_spec::Task;
use harness_tables::schema::{Column, Table};
use polars::prelude::{AnyValue, DataFrame};
use serde_json::{Value, json};
use std::collections::{BTreeSet, HashMap};
use std::error::Error;
use std::time::Instant;

/// Most rows of a query's answer that are sent to the page.
const MOST_ROWS: usize = 1000;

/// An answer to a request.
pub enum Answer {
    /// One of the page's files: its type and contents.
    File(&'static str, &'static str),
    /// A value, as JSON.
    Json(String),
    /// The page has the newest answer already.
    Unchanged,
}

/// Why a request has no answer. It is no [`Error`], so that every error can become one.
#[derive(Debug)]
pub enum Failure {
    /// The request is not from this server's page or from a program of this machine.
    Foreign,
    /// The request would change something.
    Method,
    /// There is nothing of this name.
    Unknown(String),
    /// The request is wrong.
    Bad(String),
}

impl Failure {
    /// The status of the HTTP response.
    pub fn status(&self) -> &'static str {
        match self {
            Self::Foreign => "403 Forbidden",
            Self::Method => "405 Method Not Allowed",
            Self::Unknown(_) => "404 Not Found",
            Self::Bad(_) => "400 Bad Request",
        }
    }

    /// What the body of the response says.
    pub fn message(self) -> String {
        match self {
            Self::Foreign => "only pages of this server may ask it".into(),
            Self::Method => "only GET is allowed".into(),
            Self::Unknown(what) => format!("there is no {what}"),
            Self::Bad(what) => what,
        }
    }
}

impl<E: Error> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Bad(error.to_string())
    }
}

/// Settings, times, metrics, losses and images of a run.
pub fn run(registry: &Registry, recorded: &Recorded) -> Result<Answer, Failure> {
    let (_, record) = recorded;
    let metrics = of_run(
        registry,
        recorded,
        "select task, model, modality, direction, index, metric, value, unit from metrics \
         order by task, modality, metric, direction nulls first, index nulls first, model",
    )?;
    let frames = of_run(
        registry,
        recorded,
        "select task, modality, episode, sample, reference, predicted from frames order by task, modality, episode, \
         sample",
    )?;
    // The losses are there also while the run trains.
    let losses = of_run(
        registry,
        recorded,
        "select task, split, term, epoch, value from epochs order by task, term, split, epoch",
    )?;
    let sizes: serde_json::Map<String, Value> = record
        .layout
        .names()
        .filter_map(|name| Some((name.name().to_owned(), json!(record.layout.get(name)?.size()?))))
        .collect();
    let elements: serde_json::Map<String, Value> = record
        .layout
        .names()
        .filter_map(|name| {
            let elements = record.layout.get(name)?.elements();
            Some((name.name().to_owned(), elements.iter().map(|element| element.name.as_str()).collect()))
        })
        .collect();
    let names = metrics.column("metric")?.str()?;
    let better: serde_json::Map<String, Value> =
        names.iter().flatten().map(|name| (name.to_owned(), json!(higher_is_better(name)))).collect();
    let run = json!({
        "name": record.name(),
        "status": record.status.name(),
        "reason": record.reason,
        "command": record.provenance.command,
        "settings": all_settings(record),
        "metrics": columns(&metrics, metrics.height()),
        "better": better,
        "losses": columns(&losses, losses.height()),
        "horizons": horizons_of(registry, recorded)?,
        "sample_seconds": record.spec.simulation.as_ref().map(|simulation| 1.0 / simulation.sample_rate_hz),
        "frames": columns(&frames, frames.height()),
        "sizes": sizes,
        "elements": elements,
    });
    Ok(Answer::Json(run.to_string()))
}

/// The metrics of a run's predictions at each horizon, and the skill; none before it is done, or if it predicts only one
/// sample.
fn horizons_of(registry: &Registry, recorded: &Recorded) -> Result<Vec<Value>, Failure> {
    if recorded.1.status != Status::Done || recorded.1.spec.window.horizon == 1 {
        return Ok(Vec::new());
    }
    let run = Analysis::of(registry, vec![recorded.clone()], &Selection::default())?;
    let (task, metrics) = (Some(Task::Prediction), run.whole_metrics()?);
    match (Question { task, metrics, by: vec![Key::Horizon], ..Question::default() }).answer(&run) {
        // A run that is not done has none.
        Err(AnalysisError::Nothing(_) | AnalysisError::NoMeans(_)) => Ok(Vec::new()),
        answer => {
            let horizons = answer?.frame()?;
            Ok(columns(&horizons, horizons.height()))
        }
    }
}

/// The answer to a query over the tables of one run.
fn of_run(registry: &Registry, recorded: &Recorded, sql: &str) -> Result<DataFrame, QueryError> {
    query_recorded(registry, std::slice::from_ref(recorded), sql)
}

/// The verdicts on the statements of a file by these runs: by the claims' own experiments and, if the spec of readings
/// that the file names has runs, by its readings.
pub fn claims(registry: &Registry, runs: &[Recorded], file: &ClaimsFile) -> Result<Answer, Failure> {
    let chosen: Vec<&Claim> = file.claims.iter().collect();
    let own = harness_claims::runs_of(registry, runs.to_vec(), &chosen, &[], false)?;
    let answer = |verdicts: DataFrame| {
        Answer::Json(json!({ "columns": columns(&verdicts, verdicts.height()) }).to_string())
    };
    if let Some(spec) = file.spec_of_readings(registry, false)? {
        let readings = Readings::of(registry, runs.to_vec(), &spec, &chosen, &[])?;
        if let Some(matrix) = readings.judge_beside(&chosen, &own, false)? {
            return Ok(answer(matrix.table()?));
        }
    }
    let judgments: Vec<Vec<Judgment>> =
        chosen.iter().map(|claim| judge(&own, claim, false)).collect::<Result<_, _>>()?;
    Ok(answer(harness_claims::table(&judgments.iter().flatten().collect::<Vec<_>>())?))
}

/// The settings in which runs differ. Each has its different values, and for each run the place of its value.
pub fn settings(version: u128, runs: &[Recorded]) -> String {
    let setting = |(name, values): (String, Vec<Option<String>>)| {
        let choices: BTreeSet<&String> = values.iter().flatten().collect();
        let places: HashMap<&String, usize> =
            choices.iter().enumerate().map(|(place, choice)| (*choice, place)).collect();
        let places: Vec<Option<usize>> =
            values.iter().map(|value| value.as_ref().map(|value| places[value])).collect();
        json!({ "name": name, "choices": choices, "places": places })
    };
    let settings: Vec<Value> = varied_settings(runs).into_iter().map(setting).collect();
    let names: Vec<String> = runs.iter().map(|(_, record)| record.name()).collect();
    json!({ "version": version.to_string(), "runs": names, "settings": settings }).to_string()
}

/// The metrics of an experiment's networks beside those of baselines, as `harness compare` shows them.
pub fn compare(registry: &Registry, runs: &[Recorded], experiment: &str) -> Result<Answer, Failure> {
    let selection = Selection { experiments: vec![experiment.to_owned()], ..Selection::default() };
    let registry = registry.anew();
    let mut analysis = Analysis::of(&registry, runs.to_vec(), &selection)?;
    let mut notes: Vec<String> = Vec::new();
    if analysis.runs(experiment).is_empty() {
        let AnalysisError::Outdated { world, version, .. } = analysis.nothing_of(experiment) else {
            return Err(Failure::Unknown(format!("finished run of {experiment}")));
        };
        notes.push(format!("of version {version} of the world {world}, which has changed since"));
        let of_world = Setting { experiment: None, key: "world".to_owned(), value: version };
        let selection = Selection { settings: vec![of_world], ..selection };
        analysis = Analysis::of(&registry.anew(), runs.to_vec(), &selection)?;
    }
    let answer = Question { metrics: analysis.whole_metrics()?, ..Question::default() }.answer(&analysis)?;
    notes.extend(answer.ahead().into_iter().chain(answer.notes.iter().cloned()).chain(registry.left_out()));
    Ok(Answer::Json(json!({ "tables": answer.parts(), "notes": notes }).to_string()))
}

/// All tables with their columns.
pub fn tables() -> Answer {
    let column =
        |column: Column| json!({ "name": column.name, "unit": column.unit, "meaning": column.meaning });
    let table = |table: Table| {
        let columns: Vec<Value> = table.columns().into_iter().map(column).collect();
        json!({ "name": table.name(), "meaning": table.meaning(), "columns": columns })
    };
    Answer::Json(Value::from_iter(Table::ALL.map(table)).to_string())
}

/// The answer to a query over these runs, with at most [`MOST_ROWS`] rows, and what `registry` left out of it.
pub fn sql(registry: &Registry, runs: &[Recorded], sql: &str) -> Result<Answer, Failure> {
    let start = Instant::now();
    let found = query_all(registry, runs, sql)?;
    let shown = found.height().min(MOST_ROWS);
    let answer = json!({
        "count": found.height(),
        "seconds": start.elapsed().as_secs_f64(),
        "left_out": registry.left_out(),
        "columns": columns(&found, shown),
    });
    Ok(Answer::Json(answer.to_string()))
}

/// The first `rows` rows of a table, as a name and values for each column.
pub fn columns(table: &DataFrame, rows: usize) -> Vec<Value> {
    let column = |column: &polars::prelude::Column| {
        let values: Vec<Value> = (0..rows).map(|row| column.get(row).map_or(Value::Null, value)).collect();
        json!({ "name": column.name().as_str(), "values": values })
    };
    table.columns().iter().map(column).collect()
}

/// A cell as JSON. Bytes are encoded in base64.
fn value(cell: AnyValue) -> Value {
    match cell {
        AnyValue::Null => Value::Null,
        AnyValue::Boolean(flag) => flag.into(),
        AnyValue::String(text) => text.into(),
        AnyValue::StringOwned(text) => text.as_str().into(),
        AnyValue::Binary(bytes) => BASE64.encode(bytes).into(),
        AnyValue::BinaryOwned(bytes) => BASE64.encode(bytes).into(),
        AnyValue::Float64(value) => number(value),
        AnyValue::Float32(value) => number(value.into()),
        AnyValue::Int64(value) => value.into(),
        other => other.to_string().into(),
    }
}

/// A number as JSON, which has no infinite numbers: these are texts.
pub fn number(value: f64) -> Value {
    serde_json::Number::from_f64(value).map_or_else(|| value.to_string().into(), Value::Number)
}
