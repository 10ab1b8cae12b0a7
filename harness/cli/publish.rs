//! `harness publish`.

use super::DONE;
use super::progress::Bars;
use anyhow::Result;
use clap::Args;
use harness::analysis::{Analysis, AnalysisError, Selection, Setting};
use harness::registry::{Published, Registry};
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct Publish {
    /// Experiments to publish, as `harness ls` names them
    #[arg(value_name = "EXPERIMENT", required = true)]
    experiments: Vec<String>,
    /// Folder to copy to; other commands read it with --results
    #[arg(long, value_name = "DIR", default_value = "results/reference")]
    to: PathBuf,
    /// Only runs with this setting, such as training.epochs=200
    #[arg(long = "where", value_name = "KEY=VALUE")]
    settings: Vec<Setting>,
}

impl Publish {
    /// Publishes the runs of the experiments that count.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let selection =
            Selection { experiments: self.experiments.clone(), settings: self.settings, simulated: false };
        let analysis = Analysis::new(registry, &selection)?;
        analysis.check_finished(&self.experiments)?;
        let mut chosen = Vec::new();
        for experiment in analysis.experiments() {
            analysis.check_uniform(experiment, true).map_err(AnalysisError::from)?;
            chosen.extend(analysis.runs(experiment).iter().map(|run| (run.folder(), &run.record)));
        }
        let to = Registry::new(&self.to);
        let Published { runs, bytes } = registry.publish(chosen, &to, &Bars::default())?;
        for left_out in to.left_out() {
            eprintln!("warning: {left_out}");
        }
        println!("{runs} runs, {} in {}", harness::numbers::bytes(bytes), self.to.display());
        Ok(ExitCode::from(DONE))
    }
}
