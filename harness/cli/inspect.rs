//! `harness query`, `ls`, `show` and `schema`.

use super::DONE;
use super::layers;
use super::table::{print, shown};
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
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        // What Polars panics at is an error of the query's, and reported as one.
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

/// Prints every run with how it went.
pub fn list(registry: &Registry) -> Result<ExitCode> {
    let sql = "select experiment, run, status, started, \
               collect_seconds + prediction_seconds + coalesce(reconstruction_seconds, 0) + evaluation_seconds \
               as seconds, reason from runs order by experiment, run";
    print(&registry::query(registry, sql)?);
    Ok(ExitCode::from(DONE))
}

#[derive(Args)]
pub struct Show {
    /// The run's id, or enough of its beginning
    run: String,
}

impl Show {
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let (folder, record) = registry.find(&self.run)?;
        println!("{}/{}: {}", record.experiment, record.run, record.status.name());
        if let Some(reason) = &record.reason {
            println!("reason  {reason}");
        }
        println!("folder  {}", shown(folder.path()));
        println!("\n{}", record.spec.to_yaml());
        println!("{}\n", layers::table(&record.spec, &record.layout)?);
        // Runs of two experiments that ask for the same have the same id.
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
    /// The columns of the result tables instead
    #[arg(long)]
    tables: bool,
}

impl Schema {
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
