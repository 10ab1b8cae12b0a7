//! `harness rm`, `harness gc` and `harness du`.

use super::table::{print_beside, print_texts};
use super::{DONE, FAILED};
use anyhow::Result;
use clap::Args;
use harness::numbers::bytes;
use harness::registry::{Garbage, Registry, Removable};
use std::io::{IsTerminal, Write};
use std::process::ExitCode;

#[derive(Args)]
pub struct Remove {
    /// Runs by id, experiment/id or the beginning of either, or whole experiments
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<String>,
    /// Remove without asking
    #[arg(long, short)]
    yes: bool,
}

impl Remove {
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let mut chosen: Vec<Removable> = Vec::new();
        for wanted in &self.runs {
            for (folder, record) in registry.matching(wanted)? {
                if !chosen.iter().any(|run| run.path == folder) {
                    chosen.push(Removable::new(&folder, record.name()));
                }
            }
        }
        print_beside(chosen.iter().map(|run| (format!("{:>9}", bytes(run.bytes)), run.name.clone())));
        remove(registry, &chosen, self.yes)
    }
}

#[derive(Args)]
pub struct Gc {
    /// Only what is there for this reason; may be given several times [default: all of them]
    #[arg(long = "only", value_name = "REASON", value_parser = Garbage::ALL.map(Garbage::name))]
    only: Vec<String>,
    /// Remove without asking
    #[arg(long, short)]
    yes: bool,
}

impl Gc {
    pub fn execute(self, registry: &Registry) -> Result<ExitCode> {
        let is_wanted =
            |reason: &Garbage| self.only.is_empty() || self.only.iter().any(|only| only == reason.name());
        let wanted: Vec<Garbage> = Garbage::ALL.into_iter().filter(is_wanted).collect();
        let found = registry.garbage(&wanted);
        print_beside(found.iter().map(|(reason, item)| {
            (format!("{:>9}  {:<10}", bytes(item.bytes), reason.name()), item.name.clone())
        }));
        let chosen: Vec<Removable> = found.into_iter().map(|(_, item)| item).collect();
        remove(registry, &chosen, self.yes)
    }
}

/// Asks, and removes.
fn remove(registry: &Registry, chosen: &[Removable], yes: bool) -> Result<ExitCode> {
    if chosen.is_empty() {
        println!("nothing to remove");
        return Ok(ExitCode::from(DONE));
    }
    let total = bytes(chosen.iter().map(|item| item.bytes).sum());
    if !yes {
        if !std::io::stdin().is_terminal() {
            println!("{} folders, {total}; --yes removes them", chosen.len());
            return Ok(ExitCode::from(DONE));
        }
        print!("remove {} folders, {total}? [y/N] ", chosen.len());
        std::io::stdout().flush()?;
        let mut answer = String::new();
        std::io::stdin().read_line(&mut answer)?;
        if !["y", "yes"].contains(&answer.trim().to_lowercase().as_str()) {
            println!("nothing was removed");
            return Ok(ExitCode::from(DONE));
        }
    }
    let mut kept = 0;
    for item in chosen {
        if let Some(holder) = registry.remove(item)? {
            eprintln!("{} is kept: {holder} works on it", item.name);
            kept += 1;
        }
    }
    println!("{} folders removed", chosen.len() - kept);
    Ok(ExitCode::from(if kept == 0 { DONE } else { FAILED }))
}

/// Prints the space that experiments and datasets take.
pub fn usage(registry: &Registry) -> Result<ExitCode> {
    let usage = registry.usage();
    let total: u64 = usage.iter().map(|part| part.bytes).sum();
    let rows = usage.into_iter().map(|part| {
        let count = |count: usize| if count > 0 { count.to_string() } else { String::new() };
        let networks = if part.network_bytes > 0 { bytes(part.network_bytes) } else { String::new() };
        [bytes(part.bytes), networks, count(part.runs), part.kind, part.name]
    });
    print_texts(["size", "networks", "runs", "folder", "name"], rows.collect());
    println!("{} in all", bytes(total));
    Ok(ExitCode::from(DONE))
}
