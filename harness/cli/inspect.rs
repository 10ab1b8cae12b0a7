//! `harness query`, `ls`, `show` and `schema`.

use super::layers;
use super::results;
use super::sheet::Style;
use super::table::{Grid, print, print_beside, print_command, print_text, shown, width};
use super::{DONE, submit};
use anyhow::Result;
use clap::Args;
use harness::numbers::duration;
use harness::registry::{self, Registry, RunFolder, RunRecord, quoted};
use harness::schema::Table;
use polars::prelude::{AnyValue, DataFrame};
use serde::Deserialize;
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct Query {
    /// The query, in SQL
    sql: String,
    /// Write the answer to a file instead: .parquet, .csv or .json
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
}

impl Query {
    /// Answers the query, and prints or writes the answer.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        // A panic in Polars is reported as an error of the query, so nothing must be printed about it here.
        let hook = std::panic::take_hook();
        std::panic::set_hook(Box::new(|_| {}));
        let answer = registry::query(registry, &self.sql);
        std::panic::set_hook(hook);
        let mut answer = answer?;
        match self.output {
            Some(path) => {
                registry::save(&mut answer, &path)?;
                println!("{} rows in {}", answer.height(), shown(&path));
            }
            None => print(&answer),
        }
        Ok(ExitCode::from(DONE))
    }
}

#[derive(Args)]
pub struct List {
    /// Only the runs of these experiments
    #[arg(value_name = "EXPERIMENT")]
    experiments: Vec<String>,
    /// Only runs with this status
    #[arg(long, value_name = "STATUS", value_parser = ["done", "failed", "running", "interrupted"])]
    status: Option<String>,
    /// Order by a column; the longest or latest come last
    #[arg(long, value_name = "COLUMN", value_parser = ["run", "started", "seconds", "status"], default_value = "run")]
    sort: String,
    /// List the tasks of submitted jobs instead: where they are, and why they wait or failed
    #[arg(long, conflicts_with_all = ["experiments", "status", "sort"])]
    jobs: bool,
}

impl List {
    /// Whether runs are listed, and not the tasks of jobs.
    pub fn reads_results(&self) -> bool {
        !self.jobs
    }

    /// Prints the runs with how they went, or the tasks of jobs.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        if self.jobs {
            return submit::list(registry);
        }
        let text = |text: &String| format!("'{}'", text.replace('\'', "''"));
        let mut conditions = Vec::new();
        if !self.experiments.is_empty() {
            let names: Vec<String> = self.experiments.iter().map(text).collect();
            conditions.push(format!("experiment in ({})", names.join(", ")));
        }
        conditions.extend(self.status.iter().map(|status| format!("status = {}", text(status))));
        let chosen = if conditions.is_empty() { "true".to_owned() } else { conditions.join(" and ") };
        let order = if self.sort == "run" { String::new() } else { format!("{}, ", self.sort) };
        let seconds =
            "collect_seconds + prediction_seconds + coalesce(reconstruction_seconds, 0) + evaluation_seconds";
        let runs = registry::query(
            registry,
            &format!(
                "select experiment, run, status, started, {seconds} as seconds, reason from runs where {chosen} \
                 order by {order}experiment, run"
            ),
        )?;
        match width() {
            Some(limit) if !Grid::of_table(&runs).fits(limit) => print_by_experiment(runs, limit)?,
            _ => print(&runs),
        }
        Ok(ExitCode::from(DONE))
    }
}

/// A row of `harness ls`.
#[derive(Deserialize)]
struct Listed {
    experiment: String,
    run: String,
    status: String,
    started: String,
    seconds: Option<f64>,
    reason: Option<String>,
}

/// Prints a narrow table for each experiment. Reasons stand below it.
fn print_by_experiment(mut runs: DataFrame, limit: u16) -> Result<()> {
    let runs: Vec<Listed> = registry::rows(&mut runs)?;
    for (place, runs) in runs.chunk_by(|a, b| a.experiment == b.experiment).enumerate() {
        let row = |run: &Listed| {
            let started = run.started.replace('T', " ").replace('Z', "");
            [run.run.clone(), run.status.clone(), started, run.seconds.map_or(String::new(), duration)]
        };
        let header = [&*runs[0].experiment, "status", "started (UTC)", "time"];
        let table = Grid::of_texts(header, runs.iter().map(row).collect());
        println!("{}{}", if place > 0 { "\n" } else { "" }, table.text(Some(limit)));
        for run in runs {
            if let Some(reason) = &run.reason {
                print_text(&format!("{}: {reason}", run.run));
            }
        }
    }
    Ok(())
}

#[derive(Args)]
pub struct Show {
    /// The run's id, or the beginning of it
    run: String,
    /// Also print every setting, layer, version and metric
    #[arg(long)]
    all: bool,
}

impl Show {
    /// Prints what is most important about the run, or everything.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let (folder, record) = registry.find(&self.run)?;
        println!("{}: {}", record.name(), record.status.name());
        if let Some(reason) = &record.reason {
            print_beside([("reason".to_owned(), reason.clone())]);
        }
        if self.all {
            print_everything(registry, &folder, &record)?;
        } else {
            print_essentials(registry, &folder, &record)?;
            let run = quoted([&*self.run]);
            println!();
            print_command("everything       ", &registry.command(&format!("show {run} --all")));
        }
        Ok(ExitCode::from(DONE))
    }
}

/// The columns of `runs` that are shown of every run.
const ESSENTIAL: [&str; 11] = [
    "input",
    "output",
    "architecture",
    "latent",
    "variant",
    "seed",
    "dataset",
    "started",
    "parameters",
    "harness_version",
    "command",
];

/// Prints the main settings, the times, the training's end and the main metrics.
fn print_essentials(registry: &Registry, folder: &RunFolder, record: &RunRecord) -> Result<()> {
    let mut lines = row(registry, record)?;
    let seconds: Vec<String> = lines
        .iter()
        .filter_map(|(name, value)| Some((name.strip_suffix("_seconds")?, value.parse::<f64>().ok()?)))
        .map(|(stage, seconds)| format!("{stage} {}", duration(seconds)))
        .collect();
    lines.retain(|(name, value)| ESSENTIAL.contains(&name.as_str()) && !value.is_empty());
    lines.push(("time".to_owned(), seconds.join(", ")));
    lines.push(("folder".to_owned(), shown(folder.path())));
    print_beside(lines);
    let is_run = |other: &RunRecord| other.name() == record.name();
    let sheet = results::sheet(registry, is_run)?;
    if !sheet.rows.is_empty() {
        print!("\n{}", sheet.render(Style::Text, width()));
    }
    Ok(())
}

/// Prints the spec, the layers of the networks, the run's row of the table `runs`, and all metrics.
fn print_everything(registry: &Registry, folder: &RunFolder, record: &RunRecord) -> Result<()> {
    println!("folder  {}", shown(folder.path()));
    println!("\n{}", record.spec.to_yaml());
    println!("{}\n", layers::table(&record.spec, &record.layout)?);
    print_beside(row(registry, record)?.into_iter().skip_while(|(name, _)| name != "status"));
    println!();
    let sql = format!(
        "select task, model, modality, direction, metric, value, unit from metrics where {} \
         and index is null order by task, modality, direction, metric, model",
        is_run(record)
    );
    print(&registry::query(registry, &sql)?);
    Ok(())
}

/// The SQL condition for rows of a run. Runs of two experiments have the same id if their specs are equal.
fn is_run(record: &RunRecord) -> String {
    format!("experiment = '{}' and run = '{}'", record.experiment, record.run)
}

/// The columns of `runs` with their values for a run. A missing value is empty.
fn row(registry: &Registry, record: &RunRecord) -> Result<Vec<(String, String)>> {
    let runs = registry::query(registry, &format!("select * from runs where {}", is_run(record)))?;
    let value =
        |value: AnyValue| if value.is_null() { String::new() } else { value.str_value().into_owned() };
    let columns = runs.columns().iter();
    Ok(columns
        .map(|column| (column.name().to_string(), column.get(0).map_or(String::new(), value)))
        .collect())
}

#[derive(Args)]
pub struct Schema {
    /// Print the columns of the tables instead
    #[arg(long)]
    tables: bool,
}

impl Schema {
    /// Prints the schema.
    pub fn execute(self) -> Result<ExitCode> {
        if !self.tables {
            println!("{}", serde_json::to_string_pretty(&harness::spec::schema())?);
            return Ok(ExitCode::from(DONE));
        }
        for table in Table::ALL {
            print_text(&format!("{}: {}", table.name(), table.meaning()));
            print_beside(
                table
                    .columns()
                    .into_iter()
                    .map(|column| (format!("  {:<24} {:<6}", column.name, column.unit), column.meaning)),
            );
        }
        Ok(ExitCode::from(DONE))
    }
}
