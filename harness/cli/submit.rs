//! `harness submit` and `harness ls --jobs`: experiments as jobs of a Slurm cluster.
//!
//! ```text
//! results/jobs/<experiment>-<time>/   job.json, collect.sh, train.sh, finish.sh, and a log of each task
//! ```

use super::format::{Form, print_page};
use super::run::Spec;
use super::sheet::Style;
use super::slurm::{self, Job, Resources, Step, Task};
use super::table::{Grid, print_command, print_text, print_texts, shown};
use super::{DONE, interrupt, usage};
use anyhow::Result;
use clap::Args;
use harness::experiment::{Runner, provenance};
use harness::files::{write_bytes, write_whole};
use harness::numbers::counted;
use harness::progress::Silent;
use harness::registry::Registry;
use polars::prelude::{Column, DataFrame};
use serde::{Deserialize, Serialize};
use serde_yaml::{MessageFormatter, UserMessageFormatter};
use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// The folder of all jobs, in the results folder.
const FOLDER: &str = "jobs";
/// A job's description in its folder.
const DESCRIPTION: &str = "job.json";

#[derive(Args)]
pub struct Submit {
    #[command(flatten)]
    spec: Spec,
    #[command(flatten)]
    resources: Resources,
    /// YAML file with the settings tasks, throttle, cpus, memory, time, partition, options (for sbatch) and setup
    /// (commands before the harness). Options on the command line replace them; those for sbatch are added
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print the scripts, but do not submit them
    #[arg(long)]
    dry_run: bool,
}

impl Submit {
    pub fn execute(self, registry: &Registry, threads: usize, program: &[String]) -> Result<ExitCode> {
        let experiment = self.spec.load()?;
        let provenance = provenance(threads, super::command_line());
        let plan = Runner::new(registry, threads, &provenance, &Silent).plan(&experiment)?;
        let to_do = plan.iter().filter(|planned| !planned.is_settled()).count();
        if to_do == 0 {
            return Err(usage(format!("nothing to submit: every run of {} is done", experiment.name)));
        }
        let resources = self.resources()?;
        let episodes: usize = experiment.simulated().iter().map(|(_, of)| of.episodes as usize).sum();
        // An array index beyond the work would be a task that does nothing.
        let tasks = |items: usize| resources.tasks().min(u32::try_from(items).unwrap_or(u32::MAX)).max(1);
        let time = jiff::Timestamp::now().strftime("%Y%m%dT%H%M%SZ");
        let name = format!("{}-{time}", experiment.name);
        let folder = std::path::absolute(registry.root().join(FOLDER).join(&name))?;
        let job = Job {
            experiment: &experiment.name,
            folder: &folder,
            workdir: &std::env::current_dir()?,
            program,
            results: &std::path::absolute(registry.root())?,
            words: &self.spec.words(),
            waits: experiment.search.as_ref().is_some_and(|search| search.halving.is_some()),
            resources: &resources,
        };
        let steps = Step::ALL.into_iter().filter(|step| *step != Step::Collect || episodes > 0);
        let scripts: Vec<(Step, String)> = steps
            .map(|step| match step {
                Step::Collect => (step, job.script(step, tasks(episodes))),
                Step::Train => (step, job.script(step, tasks(plan.len()))),
                Step::Finish => (step, job.script(step, 1)),
            })
            .collect();
        if self.dry_run {
            for (step, script) in &scripts {
                println!("==> {} <==\n{script}", folder.join(format!("{}.sh", step.name())).display());
            }
            return Ok(ExitCode::from(DONE));
        }
        registry.check_writable()?;
        interrupt::install()?;
        let mut record = Record { experiment: experiment.name.clone(), steps: Vec::new() };
        if let Err(error) = record.submit(&folder, &scripts) {
            // An experiment is submitted as a whole or not at all.
            let numbers: Vec<u64> = record.steps.iter().map(|(_, number)| *number).collect();
            if !numbers.is_empty() {
                let _ = slurm::cancel(&numbers);
            }
            let _ = std::fs::remove_dir_all(&folder);
            return Err(error);
        }
        let jobs = record.steps.iter().map(|(step, number)| format!("{} {number}", step.name()));
        let jobs = jobs.collect::<Vec<_>>().join(", ");
        print_text(&format!("{} of {} submitted: {jobs}", counted(to_do, "run"), experiment.name));
        println!("scripts and logs  {}", shown(&folder));
        print_command("progress          ", &registry.command("ls --jobs"));
        let numbers = record.steps.iter().map(|(_, number)| number.to_string()).collect::<Vec<_>>();
        print_command("cancel            ", &format!("scancel {}", numbers.join(" ")));
        Ok(ExitCode::from(DONE))
    }

    /// The settings of the configuration file with the flags in their place.
    fn resources(&self) -> Result<Resources> {
        let (mut resources, mut place) = (self.resources.clone(), String::new());
        if let Some(path) = &self.config {
            resources = resources.or(read_config(path)?);
            place = format!("{}: ", path.display());
        }
        resources.check().map_err(|reason| usage(format!("{place}{reason}")))?;
        Ok(resources)
    }
}

fn read_config(path: &Path) -> Result<Resources> {
    let text = harness::spec::read_text(path)?;
    serde_yaml::from_str(&text).map_err(|error| {
        let at = error.location().map(|at| format!(":{}:{}", at.line(), at.column()));
        let place = format!("{}{}", path.display(), at.unwrap_or_default());
        let reason = UserMessageFormatter.format_message(error.without_snippet()).into_owned();
        usage(format!("{place}: {reason}"))
    })
}

/// The description of a job in its folder, `job.json`.
#[derive(Debug, Serialize, Deserialize)]
struct Record {
    experiment: String,
    /// Slurm's number of each step.
    steps: Vec<(Step, u64)>,
}

impl Record {
    /// Writes all scripts to a folder, and then submits one after the other.
    fn submit(&mut self, folder: &Path, scripts: &[(Step, String)]) -> Result<()> {
        let path = |step: Step| folder.join(format!("{}.sh", step.name()));
        for (step, script) in scripts {
            write_whole(&path(*step), |file| {
                std::fs::write(file, script)?;
                std::fs::set_permissions(file, std::fs::Permissions::from_mode(0o755))
            })?;
        }
        for (step, _) in scripts {
            let after = self.steps.last().map(|(_, number)| *number);
            self.steps.push((*step, slurm::submit(&path(*step), after)?));
            write_bytes(&folder.join(DESCRIPTION), serde_json::to_string_pretty(self)?.as_bytes())?;
        }
        Ok(())
    }
}

/// All jobs that were submitted from this results folder, by the names of their folders.
fn records(registry: &Registry) -> BTreeMap<String, (PathBuf, Record)> {
    let folders = std::fs::read_dir(registry.root().join(FOLDER)).into_iter().flatten().flatten();
    let read = |entry: std::fs::DirEntry| {
        let folder = entry.path();
        let record = std::fs::read(folder.join(DESCRIPTION)).ok()?;
        let name = entry.file_name().to_string_lossy().into_owned();
        Some((name, (folder, serde_json::from_slice(&record).ok()?)))
    };
    folders.filter_map(read).collect()
}

/// The columns of the tasks of all jobs.
const HEADER: [&str; 6] = ["job", "step", "state", "host", "time", "last log line, or why it waits"];

/// Prints or writes the tasks of all jobs.
pub fn list(registry: &Registry, form: Form) -> Result<ExitCode> {
    let rows = tasks(registry)?;
    match form {
        Form::Data(data) => {
            let names = ["job", "step", "state", "host", "time", "message"];
            let column = |(place, name): (usize, &str)| {
                Column::new(name.into(), rows.iter().map(|row| row[place].as_str()).collect::<Vec<_>>())
            };
            let columns = names.into_iter().enumerate().map(column).collect();
            return data.write(&mut DataFrame::new(rows.len(), columns)?, "task");
        }
        Form::Page(Style::Text) if rows.is_empty() => println!("no jobs; `harness submit SPEC` makes some"),
        Form::Page(Style::Text) => print_texts(HEADER, rows),
        Form::Page(style) => print_page(Grid::of_texts(HEADER, rows), style),
    }
    Ok(ExitCode::from(DONE))
}

/// The tasks of all jobs: where they are, what they do, and why they wait or failed. Empty if no job was submitted from
/// this results folder.
///
/// # Errors
/// When Slurm can't be asked.
pub fn tasks(registry: &Registry) -> Result<Vec<[String; 6]>> {
    let all = records(registry);
    if all.is_empty() {
        return Ok(Vec::new());
    }
    let known = slurm::tasks()?;
    let mut rows = Vec::new();
    for (name, (folder, record)) in &all {
        for (step, number) in &record.steps {
            let mut logs = logs(folder, *step);
            for task in known.iter().filter(|task| task.job == *number) {
                let said = logs.remove(&task.index).unwrap_or_default();
                rows.push(row(name, *step, task, &said));
            }
            for (index, said) in logs {
                let ended = Task {
                    job: *number,
                    index,
                    state: "ended".into(),
                    host: String::new(),
                    elapsed: String::new(),
                    reason: String::new(),
                };
                rows.push(row(name, *step, &ended, &said));
            }
        }
    }
    Ok(rows)
}

fn row(name: &str, step: Step, task: &Task, said: &str) -> [String; 6] {
    let index = task.index.map(|index| format!(" {index}")).unwrap_or_default();
    let why = if task.reason.is_empty() || task.state == "RUNNING" { said } else { &task.reason };
    [
        name.to_owned(),
        format!("{}{index}", step.name()),
        task.state.to_lowercase(),
        task.host.clone(),
        task.elapsed.clone(),
        why.to_owned(),
    ]
}

/// The last line of the log of each task of a step, by the task's index.
fn logs(folder: &Path, step: Step) -> BTreeMap<Option<u32>, String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let read = |entry: std::fs::DirEntry| {
        let name = entry.file_name().to_string_lossy().into_owned();
        let rest = name.strip_prefix(step.name())?.strip_suffix(".log")?;
        let index = match rest.strip_prefix('-') {
            Some(index) => Some(index.parse().ok()?),
            None => None,
        };
        let text = std::fs::read(entry.path()).ok()?;
        let text = String::from_utf8_lossy(&text);
        let last = text.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or_default();
        Some((index, last.to_owned()))
    };
    entries.filter_map(read).collect()
}
