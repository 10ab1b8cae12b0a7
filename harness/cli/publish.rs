//! `harness publish`.

use super::DONE;
use super::progress::Bars;
use anyhow::Result;
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use harness::analysis::{Analysis, AnalysisError, Selection, Setting};
use harness::numbers::{self, counted};
use harness::registry::{Recorded, Registry, RunRecord, Status};
use harness::tables::schema::Table;
use harness::transfer::{self, Content, Published};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct Publish {
    /// Experiments to publish, as `harness ls` names them; with --complete also runs
    #[arg(value_name = "EXPERIMENT", required = true)]
    experiments: Vec<String>,
    /// The folder to copy to. Other commands read it with --results
    #[arg(long, short, value_name = "DIR", default_value = "results/reference")]
    output: PathBuf,
    /// Copy the trained networks, too, so that `load_model` and `export` work with the copies
    #[arg(long)]
    networks: bool,
    /// Copy every file of the finished runs and their datasets, to move them to another machine or results folder
    #[arg(long, requires = "output", conflicts_with_all = ["networks", "without", "settings"])]
    complete: bool,
    /// Leave out a table; may be given several times
    #[arg(long, value_name = "TABLE", value_parser = optional())]
    without: Vec<Table>,
    /// Use only runs with this setting, for example training.epochs=200; may be given several times. Several values of
    /// one setting are alternatives
    #[arg(long = "where", value_name = "KEY=VALUE")]
    settings: Vec<Setting>,
}

/// Parses the name of a table that can be left out.
fn optional() -> impl TypedValueParser<Value = Table> {
    let named = |name: String| Content::OPTIONAL.into_iter().find(|table| table.name() == name);
    PossibleValuesParser::new(Content::OPTIONAL.map(Table::name))
        .map(move |name| named(name).expect("only names of these tables are parsed"))
}

impl Publish {
    /// Publishes the runs of the experiments that count, or all of them completely.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let to = Registry::new(&self.output);
        if self.output.is_file() {
            to.check_writable()?;
        }
        if self.complete {
            return self.copy(registry);
        }
        let (experiments, settings) = (self.experiments.clone(), self.settings);
        let selection = Selection { experiments, settings, ..Selection::default() };
        let analysis = Analysis::new(registry, &selection)?;
        analysis.check_finished(&self.experiments)?;
        let mut chosen = Vec::new();
        for experiment in analysis.experiments() {
            analysis.check_uniform(experiment, true).map_err(AnalysisError::from)?;
            chosen.extend(analysis.runs(experiment).iter().map(|run| (run.folder(), &run.record)));
        }
        let content = Content { networks: self.networks, without: &self.without };
        let Published { runs, bytes } = transfer::publish(registry, chosen, &to, content, &Bars::default())?;
        for left_out in to.left_out() {
            eprintln!("warning: {left_out}");
        }
        println!("{}, {} in {}", counted(runs, "run"), numbers::bytes(bytes), self.output.display());
        Ok(ExitCode::from(DONE))
    }

    /// Copies runs and their datasets completely.
    fn copy(self, registry: &Registry) -> Result<ExitCode> {
        let mut chosen: BTreeMap<PathBuf, RunRecord> = BTreeMap::new();
        for wanted in &self.experiments {
            chosen.extend(registry.matching(wanted)?);
        }
        let chosen: Vec<Recorded> = chosen.into_iter().collect();
        let to = Registry::new(&self.output);
        let copied = transfer::publish_completely(registry, &chosen, &to, &Bars::default())?;
        for (_, record) in chosen.iter().filter(|(_, record)| record.status != Status::Done) {
            eprintln!("{} is left out: it is {}", record.name(), record.status.name());
        }
        for name in &copied.lacking {
            eprintln!("dataset {name} is left out: it is not in {}", registry.root().display());
        }
        let (folders, size) = (counted(copied.copied, "folder"), numbers::bytes(copied.bytes));
        println!("{folders}, {size} copied to {}, {} there before", self.output.display(), copied.same);
        Ok(ExitCode::from(DONE))
    }
}
