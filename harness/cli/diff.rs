//! `harness diff`.

use super::DONE;
use super::table::{print, wrapped};
use anyhow::Result;
use clap::Args;
use harness::analysis::differing;
use harness::registry::{Registry, query_of};
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
            println!("{}", wrapped(["differs", "a", "b"], rows.collect()));
        }
        let of = |run: &harness::registry::RunRecord| {
            let own = format!("experiment = '{}' and run = '{}'", run.experiment, run.run);
            format!("max(case when {own} then value end)")
        };
        let (of_a, of_b) = (of(&a), of(&b));
        let names = [a.name(), b.name()];
        print(&query_of(
            registry,
            |record| names.contains(&record.name()),
            &format!(
                "select task, model, modality, direction, metric, unit, {of_a} as a, {of_b} as b, {of_b} - {of_a} as \
                 \"b - a\" from metrics where index is null group by task, model, modality, direction, metric, unit \
                 order by task, model, modality, direction, metric"
            ),
        )?);
        Ok(ExitCode::from(DONE))
    }
}
