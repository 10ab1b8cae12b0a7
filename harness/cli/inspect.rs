//! `harness query`, `ls`, `show` and `schema`.

use super::format::{Destination, Form, print_page};
use super::layers;
use super::results::{self, LatentUse, Metrics};
use super::sheet::{MISSING, Style};
use super::table::{Grid, print, print_beside, print_command, print_text, shown, width};
use super::{DONE, submit, usage};
use anyhow::Result;
use clap::Args;
use harness::catalog;
use harness::meant;
use harness::numbers::{Natural, duration};
use harness::registry::{Registry, RunFolder, RunRecord, quoted};
use harness::schema::{Column, Table, sample_columns};
use harness::simulation::Scene;
use harness::spec::{Scenario, World, mapping_schema};
use harness::sql::text_in_sql;
use polars::prelude::{AnyValue, DataFrame};
use serde::Deserialize;
use std::collections::BTreeSet;
use std::path::Path;
use std::process::ExitCode;

#[derive(Args)]
pub struct Query {
    /// The query
    sql: String,
    #[command(flatten)]
    to: Destination,
}

impl Query {
    /// Answers the query, and prints or writes the answer.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let form = self.to.form()?;
        // A panic in Polars is reported as an error of the query, so nothing must be printed about it here.
        let hook = std::panic::take_hook();
        std::panic::set_hook(Box::new(|_| {}));
        let answer = catalog::query(registry, &self.sql);
        std::panic::set_hook(hook);
        let mut answer = answer?;
        match form {
            Form::Data(data) => return data.write(&mut answer, "row"),
            Form::Page(Style::Text) => print(&answer),
            Form::Page(style) => print_page(Grid::of_table(&answer, usize::MAX), style),
        }
        Ok(ExitCode::from(DONE))
    }
}

#[derive(Args)]
pub struct List {
    /// List only the runs of these experiments [default: all]
    #[arg(value_name = "EXPERIMENT")]
    experiments: Vec<String>,
    /// List only runs with this status
    #[arg(long, value_name = "STATUS", value_parser = ["done", "failed", "running", "interrupted"])]
    status: Option<String>,
    /// Order by this column; the longest or latest run comes last
    #[arg(long, value_name = "COLUMN", value_parser = ["run", "started", "seconds", "status"], default_value = "run")]
    sort: String,
    /// List the tasks of submitted jobs instead, with their nodes, and the reasons why they wait or failed
    #[arg(long, conflicts_with_all = ["experiments", "status", "sort"])]
    jobs: bool,
    #[command(flatten)]
    to: Destination,
}

impl List {
    /// Whether runs are listed, and not the tasks of jobs.
    pub fn reads_results(&self) -> bool {
        !self.jobs
    }

    /// Prints the runs with how they went, or the tasks of jobs.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let form = self.to.form()?;
        if self.jobs {
            return submit::list(registry, form);
        }
        let mut recorded = registry.recorded();
        check_started(recorded.iter().map(|(_, record)| record), registry, &self.experiments)?;
        let mut conditions = Vec::new();
        if !self.experiments.is_empty() {
            let names: Vec<String> = self.experiments.iter().map(|name| text_in_sql(name)).collect();
            conditions.push(format!("experiment in ({})", names.join(", ")));
        }
        conditions.extend(self.status.iter().map(|status| format!("status = {}", text_in_sql(status))));
        let chosen = if conditions.is_empty() { "true".to_owned() } else { conditions.join(" and ") };
        let order = if self.sort == "run" {
            // The query keeps the order of the runs.
            let name = |text: &String| Natural::new(text.as_str());
            recorded.sort_by_cached_key(|(_, record)| (name(&record.experiment), name(&record.run)));
            String::new()
        } else {
            format!("order by {}, experiment, run", self.sort)
        };
        // A model of another program was not trained here.
        let seconds =
            "coalesce(prediction_seconds, 0) + coalesce(reconstruction_seconds, 0) + evaluation_seconds";
        let sql = format!(
            "select experiment, run, status, started, {seconds} as seconds, reason from runs where {chosen} {order}"
        );
        let mut runs = catalog::query_recorded(registry, &recorded, &sql)?;
        match (form, width()) {
            (Form::Data(data), _) => return data.write(&mut runs, "run"),
            (Form::Page(Style::Text), Some(limit)) => print_listed(runs, limit)?,
            (Form::Page(style), _) => print_page(Grid::of_table(&runs, usize::MAX), style),
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

/// Refuses the name of an experiment of which there is no run.
pub fn check_started<'a>(
    records: impl IntoIterator<Item = &'a RunRecord>,
    registry: &Registry,
    experiments: &[String],
) -> Result<()> {
    let there: BTreeSet<&str> = records.into_iter().map(|record| record.experiment.as_str()).collect();
    if let Some(wanted) = experiments.iter().find(|name| !there.contains(name.as_str())) {
        let meant = meant(wanted, &there.into_iter().collect::<Vec<_>>());
        let list = registry.command("ls");
        return Err(usage(format!("no run of '{wanted}' has started{meant}`{list}` lists the experiments")));
    }
    Ok(())
}

/// Prints a table of runs or, if it is too wide, one for each experiment. Reasons stand below the table.
fn print_listed(mut runs: DataFrame, limit: u16) -> Result<()> {
    let runs: Vec<Listed> = catalog::rows(&mut runs)?;
    let all = listed(&runs, true, true);
    let parts: Vec<(Grid, &[Listed])> = if runs.is_empty() {
        println!("no runs");
        Vec::new()
    } else if all.fits_unbroken(limit) {
        vec![(all, &runs)]
    } else {
        let of_experiment = |runs| {
            let long = listed(runs, false, true);
            (if long.fits_unbroken(limit) { long } else { listed(runs, false, false) }, runs)
        };
        runs.chunk_by(|a, b| a.experiment == b.experiment).map(of_experiment).collect()
    };
    for (place, (table, runs)) in parts.into_iter().enumerate() {
        println!("{}{}", if place > 0 { "\n" } else { "" }, table.text(Some(limit)));
        for run in runs {
            if let Some(reason) = &run.reason {
                print_text(&format!("{}: {reason}", run.run));
            }
        }
    }
    Ok(())
}

/// A table of runs. Without a column of experiments, the header has the name of the first. A short time
/// of the start has no year and no seconds.
fn listed(runs: &[Listed], has_experiments: bool, is_long: bool) -> Grid {
    let row = |run: &Listed| {
        let started = run.started.replace('T', " ");
        let shown = if is_long { 0..19 } else { 5..16 };
        let started = started.get(shown).unwrap_or(&started);
        let time = run.seconds.map_or(String::new(), duration);
        let before = has_experiments.then(|| run.experiment.clone()).into_iter();
        before.chain([run.run.clone(), run.status.clone(), started.to_owned(), time]).collect()
    };
    let first = runs.first().map_or("run", |run| &run.experiment);
    let names = if has_experiments { vec!["experiment", "run"] } else { vec![first] };
    let header: Vec<&str> = names.into_iter().chain(["status", "started (UTC)", "time"]).collect();
    let right = (1..=header.len()).map(|column| column == header.len()).collect();
    let header = header.into_iter().map(str::to_owned).collect();
    Grid { header, rows: runs.iter().map(row).collect(), right, ..Grid::default() }
}

#[derive(Args)]
pub struct Show {
    /// The run's id, EXPERIMENT/ID or folder. A beginning is enough if only one run begins with it
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
const ESSENTIAL: [&str; 12] = [
    "input",
    "output",
    "architecture",
    "latent",
    "variant",
    "seed",
    "dataset",
    "test_dataset",
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
    let is_run = |other: &RunRecord| other.name() == record.name();
    if let Some(used) = LatentUse::of(registry, is_run)? {
        let of_latent = lines.iter_mut().filter(|(name, _)| name == "latent");
        of_latent.for_each(|(_, size)| *size = format!("{size}, {used}"));
    }
    if let Some(submission) = &record.submission {
        lines.push(("task".to_owned(), submission.task.clone()));
        lines.push(("predictions_sha256".to_owned(), submission.predictions_sha256.clone()));
        let notes = submission.notes.iter();
        lines.extend(notes.map(|(name, note)| (format!("note {name}"), note.clone())));
    }
    lines.push(("time".to_owned(), seconds.join(", ")));
    lines.push(("folder".to_owned(), shown(folder_of(folder, record))));
    print_beside(lines);
    let sheet = results::sheet(registry, Metrics::Main, is_run)?;
    if !sheet.rows.is_empty() {
        print!("\n{}", sheet.render(Style::Text, width()));
    }
    Ok(())
}

/// The folder with a run's tables: that of its experiment if the run is published.
fn folder_of<'a>(folder: &'a RunFolder, record: &RunRecord) -> &'a Path {
    let own = folder.path();
    if record.is_merged() { own.parent().unwrap_or(own) } else { own }
}

/// Prints the spec, the layers of the networks, the run's row of the table `runs`, and all metrics.
fn print_everything(registry: &Registry, folder: &RunFolder, record: &RunRecord) -> Result<()> {
    print_beside([("folder".to_owned(), shown(folder_of(folder, record)))]);
    println!("\n{}", record.spec.to_yaml());
    println!("{}\n", layers::table(&record.spec, &record.layout)?);
    let shown =
        |(name, value): (String, String)| (name, if value.is_empty() { MISSING.to_owned() } else { value });
    print_beside(row(registry, record)?.into_iter().skip_while(|(name, _)| name != "status").map(shown));
    let sheet = results::sheet(registry, Metrics::All, |other| other.name() == record.name())?;
    if !sheet.rows.is_empty() {
        print!("\n{}", sheet.render(Style::Text, width()));
    }
    Ok(())
}

/// The columns of `runs` with their values for a run. A missing value is empty.
fn row(registry: &Registry, record: &RunRecord) -> Result<Vec<(String, String)>> {
    let recorded = (registry.folder_of(record).path().to_owned(), record.clone());
    let runs = catalog::query_recorded(registry, &[recorded], "select * from runs")?;
    let value =
        |value: AnyValue| if value.is_null() { String::new() } else { value.str_value().into_owned() };
    let columns = runs.columns().iter();
    Ok(columns
        .map(|column| (column.name().to_string(), column.get(0).map_or(String::new(), value)))
        .collect())
}

#[derive(Args)]
pub struct Schema {
    /// Print the JSON schema of mappings instead, which `harness import` reads
    #[arg(long, conflicts_with_all = ["tables", "world"])]
    mapping: bool,
    /// Print the columns of the tables instead. Those of `episodes` are the columns of the datasets in the results
    /// folder
    #[arg(long)]
    tables: bool,
    /// With --tables: print the columns that `episodes` has in this world, a world file or a built-in world
    #[arg(long, value_name = "WORLD", requires = "tables")]
    world: Option<String>,
}

impl Schema {
    /// Prints the schema.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        if !self.tables {
            let schema = if self.mapping { mapping_schema() } else { harness::spec::schema() };
            print!("{}", harness::spec::schema_text(&schema));
            return Ok(ExitCode::from(DONE));
        }
        let (of_episodes, whose) = self.episodes(registry)?;
        for table in Table::ALL {
            let is_episodes = table == Table::Episodes;
            let follows = if is_episodes { format!(". {whose}") } else { String::new() };
            let columns = if is_episodes { of_episodes.clone() } else { table.columns() };
            print_text(&format!("{}: {}{follows}", table.name(), table.meaning()));
            let line = |column: Column| (format!("  {:<28} {:<6}", column.name, column.unit), column.meaning);
            print_beside(columns.into_iter().map(line));
        }
        Ok(ExitCode::from(DONE))
    }

    /// The columns of `episodes`, and a sentence about whose they are.
    fn episodes(&self, registry: &Registry) -> Result<(Vec<Column>, String)> {
        let (columns, whose) = match &self.world {
            Some(world) => {
                let columns = sample_columns(Scene::new(World::find(world)?)?.layout());
                (columns, format!("these are those of {world}"))
            }
            None => match catalog::episode_columns(registry) {
                (columns, true) => {
                    (columns, format!("these are those of the datasets in {}", shown(registry.root())))
                }
                (_, false) => {
                    let columns = sample_columns(Scene::paper(Scenario::CLUTTERED)?.layout());
                    let command = registry.command("schema --tables --world FILE");
                    (columns, format!("these are those of the built-in worlds; `{command}` prints others"))
                }
            },
        };
        Ok((columns, format!("The columns after time follow the world: {whose}")))
    }
}
