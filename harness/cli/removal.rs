//! `harness rm` and `harness gc`.

use super::table::print_beside;
use super::{DONE, FAILED};
use anyhow::Result;
use clap::Args;
use harness::experiment::describe;
use harness::numbers::{bytes, counted};
use harness::registry::Registry;
use harness::transfer::{self, Garbage, Removable};
use std::collections::BTreeSet;
use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Args)]
pub struct Remove {
    /// Experiments, ids, EXPERIMENT/ID or folders. A beginning of an id stands for every run that begins with it
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
                    chosen.push(Removable::run(&folder, &record));
                }
            }
        }
        print_beside(chosen.iter().map(|run| (format!("{:>9}", bytes(run.bytes)), run.name.clone())));
        match refusal(&chosen, self.yes)? {
            Some(code) => Ok(code),
            None => Ok(remove(registry, &chosen).code()),
        }
    }
}

#[derive(Args)]
pub struct Gc {
    /// Remove only what has this reason; may be given several times [default: all reasons]
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
        let found = transfer::garbage(registry, &wanted);
        print_beside(found.iter().map(|(reason, item)| {
            (format!("{:>9}  {:<10}", bytes(item.bytes), reason.name()), item.name.clone())
        }));
        let chosen: Vec<Removable> = found.iter().map(|(_, item)| item.clone()).collect();
        if let Some(code) = refusal(&chosen, self.yes)? {
            return Ok(code);
        }
        // Runs may have ended and others begun since the list was made. A dataset is unused only after the removal of
        // the runs that use it.
        let (datasets, runs): (Vec<_>, Vec<_>) =
            found.into_iter().partition(|(reason, _)| *reason == Garbage::Unused);
        let runs = remove(registry, &still(registry, runs));
        let datasets = remove(registry, &still(registry, datasets));
        Ok(Removed { removed: runs.removed + datasets.removed, kept: runs.kept + datasets.kept }.code())
    }
}

/// Those of the folders that can still be removed for their reason. Prints the others.
fn still(registry: &Registry, listed: Vec<(Garbage, Removable)>) -> Vec<Removable> {
    let reasons: Vec<Garbage> = listed.iter().map(|(reason, _)| *reason).collect();
    let now: BTreeSet<PathBuf> =
        transfer::garbage(registry, &reasons).into_iter().map(|(_, item)| item.path).collect();
    let (free, used): (Vec<_>, Vec<_>) =
        listed.into_iter().map(|(_, item)| item).partition(|item| now.contains(&item.path));
    for item in used {
        eprintln!("{} is kept: it has been used or changed since it was listed", item.name);
    }
    free
}

/// Asks whether to remove these folders. Returns the exit code if not.
fn refusal(chosen: &[Removable], yes: bool) -> Result<Option<ExitCode>> {
    if chosen.is_empty() {
        println!("nothing to remove");
        return Ok(Some(ExitCode::from(DONE)));
    }
    let total = bytes(chosen.iter().map(|item| item.bytes).sum());
    let folders = counted(chosen.len(), "folder");
    if !yes {
        if !std::io::stdin().is_terminal() {
            println!("{folders}, {total}; --yes removes them");
            return Ok(Some(ExitCode::from(DONE)));
        }
        print!("remove {folders}, {total}? [y/N] ");
        std::io::stdout().flush()?;
        let mut answer = String::new();
        std::io::stdin().read_line(&mut answer)?;
        if !["y", "yes"].contains(&answer.trim().to_lowercase().as_str()) {
            println!("nothing was removed");
            return Ok(Some(ExitCode::from(DONE)));
        }
    }
    Ok(None)
}

/// The number of folders that were removed, and of those that were not.
struct Removed {
    removed: usize,
    kept: usize,
}

impl Removed {
    /// Prints the number of removed folders, and returns the exit code.
    fn code(&self) -> ExitCode {
        println!("{} removed", counted(self.removed, "folder"));
        ExitCode::from(if self.kept == 0 { DONE } else { FAILED })
    }
}

/// Removes folders, and prints why others are kept.
fn remove(registry: &Registry, chosen: &[Removable]) -> Removed {
    let mut end = Removed { removed: 0, kept: 0 };
    for items in chosen.chunk_by(Removable::together) {
        match transfer::remove(registry, items) {
            Ok(None) => end.removed += items.len(),
            Ok(Some(holder)) => {
                for item in items {
                    eprintln!("{} is kept: {holder} works on it", item.name);
                }
                end.kept += items.len();
            }
            Err(error) => {
                eprintln!("error: {}", describe(&error));
                end.kept += items.len();
            }
        }
    }
    end
}
