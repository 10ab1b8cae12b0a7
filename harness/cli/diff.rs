//! `harness diff`.

use super::DONE;
use super::results::{ahead, common_horizon, rows_at};
use super::sheet::{MISSING, Sheet, Style};
use super::table::{print_text, print_texts, width};
use anyhow::Result;
use clap::Args;
use harness::analysis::differing;
use harness::catalog::{OVERALL, query_of, rows};
use harness::dataset::{is_of_model, world_parts};
use harness::judge::models::{UNTRAINED, baselines_in_sql};
use harness::metrics::{Metric, best, rounded};
use harness::numbers::counted;
use harness::registry::{Registry, RunRecord};
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;

#[derive(Args)]
pub struct Diff {
    /// A run's id, EXPERIMENT/ID or folder. A beginning is enough if only one run begins with it
    a: String,
    /// The other run
    b: String,
    /// Also print the versions of the program and the machine, every difference of the worlds, and every metric, those
    /// of baselines too
    #[arg(long)]
    all: bool,
}

impl Diff {
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let ((_, a), (_, b)) = (registry.find(&self.a)?, registry.find(&self.b)?);
        println!("a  {}\nb  {}\n", a.name(), b.name());
        self.print_settings(&a, &b);
        self.print_worlds(registry, &a, &b);
        let sheet = metrics(registry, &a, &b, self.all)?;
        println!();
        match (sheet.rows.is_empty(), sheet.notes.first()) {
            (false, _) => {
                print!("{}", sheet.render(Style::Text, width()));
                if !self.all {
                    print_text("--all prints everything that differs");
                }
            }
            (true, Some(same)) => print_text(&format!("no metric differs; {same}")),
            (true, None) => println!("neither of the runs has metrics"),
        }
        Ok(ExitCode::from(DONE))
    }

    fn print_settings(&self, a: &RunRecord, b: &RunRecord) {
        let differences = differing(a, b);
        let is_shown = |key: &str| self.all || !is_of_program(key);
        let all = differences.len();
        let rows = differences.into_iter().filter(|(key, ..)| is_shown(key)).map(|(key, a, b)| [key, a, b]);
        let rows: Vec<[String; 3]> = rows.collect();
        match (rows.is_empty(), all) {
            (false, _) => print_texts(["differs", "a", "b"], rows),
            (true, 0) => println!("no setting, version or machine differs"),
            (true, _) => println!("no setting differs"),
        }
    }

    /// Prints what differs between the worlds of the two runs, if their versions differ.
    fn print_worlds(&self, registry: &Registry, a: &RunRecord, b: &RunRecord) {
        let is_simulated = |run: &RunRecord| run.spec.simulation.is_some();
        if !is_simulated(a) || !is_simulated(b) || a.provenance.world == b.provenance.world {
            return;
        }
        let mut parts = [a, b].map(|run| world_parts(&registry.datasets().join(&run.dataset)));
        let without_model = parts.each_ref().map(|of| !of.keys().any(|part| is_of_model(part)));
        let lacking = ["a", "b"].into_iter().zip(without_model).find(|(_, without)| *without);
        if lacking.is_some() {
            parts.iter_mut().for_each(|of| of.retain(|part, _| !is_of_model(part)));
        }
        let [of_a, of_b] = parts;
        println!();
        let keys: BTreeSet<&String> = of_a.keys().chain(of_b.keys()).collect();
        let value = |of: &BTreeMap<String, String>, key: &String| {
            of.get(key).cloned().unwrap_or_else(|| MISSING.into())
        };
        let rows = keys.into_iter().map(|key| (key, value(&of_a, key), value(&of_b, key)));
        let rows = rows.filter(|(_, a, b)| a != b).map(|(key, a, b)| {
            let [a, b] = differing_words(&a, &b);
            [key.clone(), a, b]
        });
        let mut rows: Vec<[String; 3]> = rows.collect();
        let more = if self.all { 0 } else { rows.len().saturating_sub(MOST_PARTS) };
        rows.truncate(rows.len() - more);
        if let Some((run, _)) = lacking {
            print_text(&format!(
                "the worlds differ; the dataset of {run} is gone or lacks its model, so models are not compared"
            ));
        } else if rows.is_empty() {
            print_text(
                "the worlds differ in what their datasets do not have: in a comment of the model, or in digits that \
                 MJCF rounds",
            );
        }
        if rows.is_empty() {
            return;
        }
        print_texts(["in the world", "a", "b"], rows);
        if more > 0 {
            print_text(&format!("{} more differ in the world; --all prints them", counted(more, "part")));
        }
    }
}

/// The number of differences of worlds that are printed without `--all`.
const MOST_PARTS: usize = 12;
/// The number of words that a list must have so that only those that differ are printed.
const LONG: usize = 5;

/// Whether a key is one of the program, its versions or the machine, or a hash of a part of the world.
fn is_of_program(key: &str) -> bool {
    const OF_PROGRAM: [&str; 8] = [
        "candle_version",
        "git_commit",
        "git_dirty",
        "harness_version",
        "host",
        "mujoco_version",
        "processor",
        "threads",
    ];
    OF_PROGRAM.contains(&key) || key.starts_with("world.")
}

/// Two texts or, if they are long lists of words, the words that differ with their places, counted from 1.
fn differing_words(a: &str, b: &str) -> [String; 2] {
    let (of_a, of_b): (Vec<&str>, Vec<&str>) =
        (a.split_whitespace().collect(), b.split_whitespace().collect());
    if of_a.len() < LONG || of_a.len() != of_b.len() {
        return [a.to_owned(), b.to_owned()];
    }
    let differing: Vec<usize> = (0..of_a.len()).filter(|place| of_a[*place] != of_b[*place]).collect();
    let words = |of: &[&str]| {
        let words = differing.iter().map(|place| format!("{} (number {})", of[*place], place + 1));
        words.collect::<Vec<_>>().join(", ")
    };
    [words(&of_a), words(&of_b)]
}

/// A metric of both runs.
#[derive(Deserialize)]
struct Row {
    task: String,
    model: String,
    modality: String,
    direction: Option<String>,
    metric: String,
    unit: String,
    a: Option<f64>,
    b: Option<f64>,
}

/// The metrics of two runs side by side.
///
/// Without `all`, they are the usual metrics of the networks or models of other programs.
fn metrics(registry: &Registry, a: &RunRecord, b: &RunRecord, all: bool) -> Result<Sheet> {
    let others = format!("{}, '{UNTRAINED}'", baselines_in_sql());
    let chosen = match all {
        true => "index is null".to_owned(),
        false => format!(
            "{OVERALL} and model not in ({others}) and metric in ('smape', 'wmape', 'r2', 'relative_error', 'accuracy', \
             'balanced_accuracy', 'log_loss', 'angle')"
        ),
    };
    let of = |run: &RunRecord| {
        let own = format!("experiment = '{}' and run = '{}'", run.experiment, run.run);
        format!("max(case when {own} then value end)")
    };
    let names = [a.name(), b.name()];
    let horizon = common_horizon([a, b].into_iter());
    let (table, at_horizon) = rows_at(horizon);
    // What predicts is compared also if the runs call it differently.
    let own = if a.predictor() == b.predictor() { a.predictor() } else { "network or model" };
    let model = format!("case when model in ({others}) then model else '{own}' end as model");
    let mut answer = query_of(
        registry,
        |record| names.contains(&record.name()),
        &format!(
            "select task, model, modality, direction, metric, unit, {} as a, {} as b from \
             (select experiment, run, task, {model}, modality, direction, metric, unit, value from {table} \
             where {chosen} {at_horizon}) as rows \
             group by task, model, modality, direction, metric, unit \
             order by task, model, modality, direction, metric",
            of(a),
            of(b)
        ),
    )?;
    let row = |Row { task, model, modality, direction, metric, unit, a, b }: &Row| {
        let number = |value: Option<f64>, is_best| match value {
            Some(value) => Style::Text.number(&rounded(value, unit), None, is_best),
            None => MISSING.into(),
        };
        let (best, difference) = (best(metric, unit, &[*a, *b]), a.zip(*b).map(|(a, b)| b - a));
        let numbers = vec![number(*a, best[0]), number(*b, best[1]), number(difference, false)];
        let direction = direction.as_deref().unwrap_or_default();
        let metric = Style::Text.metric(metric, unit);
        (vec![words(task), words(model), words(modality), words(direction), metric], numbers)
    };
    let mut all: Vec<Row> = rows(&mut answer)?;
    let of = |row: &Row| (row.task.clone(), row.model.clone(), row.modality.clone(), row.direction.clone());
    all.chunk_by_mut(|x, y| of(x) == of(y))
        .for_each(|rows| rows.sort_by_key(|row| Metric::place(&row.metric)));
    let parts = all.chunk_by(|x, y| (&x.task, &x.model) == (&y.task, &y.model));
    let (same, differing): (Vec<&[Row]>, Vec<&[Row]>) =
        parts.partition(|rows| rows.iter().all(|row| row.a == row.b));
    let same = same.iter().map(|rows| format!("{} of {}", rows[0].task, words(&rows[0].model)));
    let same = same.collect::<Vec<_>>().join(", ");
    let same = (!same.is_empty()).then(|| format!("the same in both: {same}"));
    let notes = same.into_iter().chain((!all.is_empty()).then(|| ahead(horizon))).collect();
    let header = ["a", "b", "b - a"].map(str::to_owned).to_vec();
    Ok(Sheet {
        titles: 2,
        header,
        rows: differing.into_iter().flatten().map(row).collect(),
        notes,
        ..Sheet::default()
    })
}

/// A name as words.
fn words(name: &str) -> String {
    name.replace('_', " ")
}
