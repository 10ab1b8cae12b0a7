//! `harness tag`.

use super::DONE;
use anyhow::Result;
use clap::Args;
use harness::numbers::counted;
use harness::registry::{Registry, check_tag};
use std::collections::BTreeSet;
use std::process::ExitCode;

#[derive(Args)]
pub struct Tag {
    /// Experiments, ids, EXPERIMENT/ID or folders. A beginning of an id stands for every run that begins with it
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<String>,
    /// The tag: letters, digits, '-', '_' and '.'
    #[arg(value_name = "NAME")]
    name: String,
    /// Take the tag away from the runs
    #[arg(long)]
    remove: bool,
}

impl Tag {
    /// Gives the tag to the runs, or takes it away.
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        check_tag(&self.name)?;
        let mut runs: BTreeSet<String> = BTreeSet::new();
        for wanted in &self.runs {
            runs.extend(registry.matching(wanted)?.into_iter().map(|(_, record)| record.name()));
        }
        let runs: Vec<String> = runs.into_iter().collect();
        let changed = registry.tag(&runs, &self.name, self.remove)?;
        let done = if self.remove { "without" } else { "with" };
        let before = runs.len() - changed;
        let note = if before > 0 { format!(", {before} before") } else { String::new() };
        println!("{} {done} the tag {}{note}", counted(runs.len(), "run"), self.name);
        Ok(ExitCode::from(DONE))
    }
}
