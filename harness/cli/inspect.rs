//! `harness query`, `ls`, `show` and `schema`.

use super::layers;
use super::table::{print, shown};
use super::{DONE, submit};
use anyhow::Result;
use clap::Args;
use harness::registry::{self, Registry};
use harness::schema::Table;
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
        print(&registry::query(
            registry,
            &format!(
                "select experiment, run, status, started, {seconds} as seconds, reason from runs where {chosen} \
                 order by {order}experiment, run"
            ),
        )?);
        Ok(ExitCode::from(DONE))
    }
}

#[derive(Args)]
pub struct Show {
    /// The run's id, or the beginning of it
    run: String,
}

impl Show {
    /// Prints everything about the run.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let (folder, record) = registry.find(&self.run)?;
        println!("{}/{}: {}", record.experiment, record.run, record.status.name());
        if let Some(reason) = &record.reason {
            println!("reason  {reason}");
        }
        println!("folder  {}", shown(folder.path()));
        println!("\n{}", record.spec.to_yaml());
        println!("{}\n", layers::table(&record.spec, &record.layout)?);
        // Runs of two experiments have the same id if their specs are equal.
        let own = format!("experiment = '{}' and run = '{}'", record.experiment, record.run);
        let runs = registry::query(registry, &format!("select * from runs where {own}"))?;
        for column in runs.columns().iter().skip_while(|column| column.name() != "status") {
            let value = column.get(0).map_or(String::new(), |value| value.str_value().into_owned());
            println!("{:<24} {value}", column.name());
        }
        let metrics = format!(
            "select task, model, modality, direction, metric, value, unit from metrics where {own} \
             and index is null order by task, modality, direction, metric, model"
        );
        print(&registry::query(registry, &metrics)?);
        Ok(ExitCode::from(DONE))
    }
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
            println!("{}: {}", table.name(), table.meaning());
            for column in table.columns() {
                println!("  {:<24} {:<8} {}", column.name, column.unit, column.meaning);
            }
        }
        Ok(ExitCode::from(DONE))
    }
}
