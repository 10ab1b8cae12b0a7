//! `harness diff`.

use super::DONE;
use super::sheet::{Sheet, Style, best, rounded};
use super::table::{print_texts, width};
use anyhow::Result;
use clap::Args;
use harness::analysis::differing;
use harness::registry::{Registry, RunRecord, query_of, rows};
use serde::Deserialize;
use std::process::ExitCode;

#[derive(Args)]
pub struct Diff {
    /// A run's id, or enough of its beginning
    a: String,
    /// The other run's
    b: String,
}

impl Diff {
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let (a, b) = (registry.find(&self.a)?.1, registry.find(&self.b)?.1);
        println!("a  {}\nb  {}", a.name(), b.name());
        let differences = differing(&a, &b);
        if differences.is_empty() {
            println!("no setting, version or machine differs");
        } else {
            let rows = differences.into_iter().map(|(key, a, b)| [key, a, b]);
            print_texts(["differs", "a", "b"], rows.collect());
            println!();
        }
        println!("{}", metrics(registry, &a, &b)?.render(Style::Text, width()));
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
    let row = |Row { task, model, modality, direction, metric, unit, a, b }: Row| {
        let best = best(&metric, &[a, b]).filter(|_| a != b);
        let number = |value: Option<f64>, is_best| match value {
            Some(value) => Style::Text.number(&rounded(value, &unit), None, is_best),
            None => "-".into(),
        };
        let difference = a.zip(b).map(|(a, b)| b - a);
        let numbers = vec![
            number(a, best.is_some() && best == a),
            number(b, best.is_some() && best == b),
            number(difference, false),
        ];
        let metric = Style::Text.metric(&metric, &unit);
        let words = [task, model, modality, direction.unwrap_or_default(), metric];
        (words.map(|word| word.replace('_', " ")).to_vec(), numbers)
    };
    let rows = rows::<Row>(&mut answer)?.into_iter().map(row).collect();
    Ok(Sheet { titles: 2, header: ["a", "b", "b - a"].map(str::to_owned).to_vec(), rows, notes: Vec::new() })
}
