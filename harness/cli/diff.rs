//! `harness diff`.

use super::DONE;
use super::sheet::{MISSING, Sheet, Style};
use super::table::{print_text, print_texts, width};
use anyhow::Result;
use clap::Args;
use harness::analysis::differing;
use harness::catalog::{query_of, rows};
use harness::metrics::{best, rounded};
use harness::registry::{Registry, RunRecord};
use serde::Deserialize;
use std::process::ExitCode;

#[derive(Args)]
pub struct Diff {
    /// A run's id, EXPERIMENT/ID or folder. A beginning is enough if only one run begins with it
    a: String,
    /// The other run
    b: String,
}

impl Diff {
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let ((_, a), (_, b)) = (registry.find(&self.a)?, registry.find(&self.b)?);
        println!("a  {}\nb  {}\n", a.name(), b.name());
        let differences = differing(&a, &b);
        if differences.is_empty() {
            println!("no setting, version or machine differs");
        } else {
            let rows = differences.into_iter().map(|(key, a, b)| [key, a, b]);
            print_texts(["differs", "a", "b"], rows.collect());
        }
        let sheet = metrics(registry, &a, &b)?;
        println!();
        match (sheet.rows.is_empty(), sheet.notes.first()) {
            (false, _) => print!("{}", sheet.render(Style::Text, width())),
            (true, Some(same)) => print_text(&format!("no metric differs; {same}")),
            (true, None) => println!("neither of the runs has metrics"),
        }
        Ok(ExitCode::from(DONE))
    }
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
fn metrics(registry: &Registry, a: &RunRecord, b: &RunRecord) -> Result<Sheet> {
    let of = |run: &RunRecord| {
        let own = format!("experiment = '{}' and run = '{}'", run.experiment, run.run);
        format!("max(case when {own} then value end)")
    };
    let names = [a.name(), b.name()];
    let mut answer = query_of(
        registry,
        |record| names.contains(&record.name()),
        &format!(
            "select task, model, modality, direction, metric, unit, {} as a, {} as b from metrics where index is null \
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
    let all: Vec<Row> = rows(&mut answer)?;
    let parts = all.chunk_by(|x, y| (&x.task, &x.model) == (&y.task, &y.model));
    let (same, differing): (Vec<&[Row]>, Vec<&[Row]>) =
        parts.partition(|rows| rows.iter().all(|row| row.a == row.b));
    let same = same.iter().map(|rows| format!("{} of {}", rows[0].task, words(&rows[0].model)));
    let same = same.collect::<Vec<_>>().join(", ");
    let notes = if same.is_empty() { Vec::new() } else { vec![format!("the same in both: {same}")] };
    let header = ["a", "b", "b - a"].map(str::to_owned).to_vec();
    Ok(Sheet {
        titles: 2,
        header,
        rows: differing.into_iter().flatten().map(row).collect(),
        marked: true,
        notes,
        ..Sheet::default()
    })
}

/// A name as words.
fn words(name: &str) -> String {
    name.replace('_', " ")
}
