//! Slurm: batch scripts that a person can read and edit, and the commands that submit, list and cancel jobs.

use super::usage;
use anyhow::{Result, anyhow, bail};
use clap::Args;
use harness::registry::{path_word, quoted};
use serde::{Deserialize, Serialize};
use std::fmt::Write;
use std::path::Path;
use std::process::Command;

/// What to do where a program of Slurm is missing.
fn instead(program: &str) -> &'static str {
    match program {
        "sbatch" => "; without Slurm, start the shares yourself: `harness run SPEC --shard I/N --no-wait`",
        _ => "; without Slurm, `harness watch` shows the running trainings",
    }
}

/// What an array of tasks requests from the cluster: the options of `harness submit`, or its configuration file.
#[derive(Debug, Clone, Default, Args, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Resources {
    /// Number of tasks that divide the runs [default: 8, or the number of runs if it is smaller]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=MOST_TASKS))]
    tasks: Option<u32>,
    /// Largest number of tasks that run at the same time [default: no limit]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=MOST_TASKS))]
    throttle: Option<u32>,
    /// Processors for each task [default: 4]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=MOST_CPUS))]
    cpus: Option<u32>,
    /// Memory for each task, for example 8G [default: the cluster's]
    #[arg(long, value_name = "SIZE")]
    memory: Option<String>,
    /// Time limit of each task, for example 04:00:00. A task that reaches it saves its state and is queued again
    /// [default: the cluster's]
    #[arg(long, value_name = "TIME")]
    time: Option<String>,
    /// Partition of the cluster [default: the cluster's]
    #[arg(long, value_name = "NAME")]
    partition: Option<String>,
    /// Another option of sbatch, for example --sbatch=--account=lab; may be given several times
    #[arg(long = "sbatch", value_name = "OPTION")]
    options: Vec<String>,
    /// Shell commands before the harness starts, for example `module load mesa`, which only the file can have.
    #[arg(skip)]
    setup: Vec<String>,
}

/// Largest number of tasks.
const MOST_TASKS: i64 = 1000;
/// Largest number of processors of a task.
const MOST_CPUS: i64 = 1024;
/// The options of sbatch that a script has for itself.
const OWN: [&str; 11] = [
    "--array",
    "-a",
    "--cpus-per-task",
    "-c",
    "--job-name",
    "-J",
    "--open-mode",
    "--output",
    "-o",
    "--requeue",
    "--signal",
];

impl Resources {
    /// Number of tasks of the array that divides the work.
    pub fn tasks(&self) -> u32 {
        self.tasks.unwrap_or(8)
    }

    /// These resources, or those of `file` where there are none. The options of both are taken.
    pub fn or(self, file: Self) -> Self {
        Self {
            tasks: self.tasks.or(file.tasks),
            throttle: self.throttle.or(file.throttle),
            cpus: self.cpus.or(file.cpus),
            memory: self.memory.or(file.memory),
            time: self.time.or(file.time),
            partition: self.partition.or(file.partition),
            options: [file.options, self.options].concat(),
            setup: file.setup,
        }
    }

    /// Refuses what does not make a script that divides the work.
    ///
    /// # Errors
    /// When a number is out of its range, a text is not a part of one line, or an option is not one of sbatch, or is one
    /// that the script has for itself. The error is the message.
    pub fn check(&self) -> Result<(), String> {
        let numbers = [
            ("tasks", self.tasks, MOST_TASKS),
            ("throttle", self.throttle, MOST_TASKS),
            ("cpus", self.cpus, MOST_CPUS),
        ];
        for (key, number, most) in numbers {
            if let Some(number) = number.filter(|number| !(1..=most).contains(&i64::from(*number))) {
                return Err(format!("'{key}' is {number}, and must be from 1 to {most}"));
            }
        }
        let texts = [("memory", &self.memory), ("time", &self.time), ("partition", &self.partition)];
        let texts = texts.into_iter().filter_map(|(key, text)| Some((key, text.as_ref()?)));
        for (key, text) in texts.chain(self.options.iter().map(|option| ("options", option))) {
            if text.is_empty() || text.chars().any(char::is_control) {
                return Err(format!(
                    "a value of '{key}' is empty or has a line break; it is a part of one line"
                ));
            }
        }
        for option in &self.options {
            let name = option.split(['=', ' ']).next().unwrap_or_default();
            if !name.starts_with('-') {
                return Err(format!("'{option}' is no option of sbatch; one is --account=lab"));
            }
            if OWN.contains(&name) {
                return Err(format!(
                    "{name} is set by the harness; tasks, throttle, cpus, memory, time and partition can be set"
                ));
            }
        }
        Ok(())
    }
}

/// One of the jobs that an experiment is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Step {
    /// The datasets' missing episodes, by an array.
    Collect,
    /// The runs, by an array.
    Train,
    /// The remaining runs if a task was lost, by one task.
    Finish,
}

impl Step {
    /// All steps, in their order.
    pub const ALL: [Self; 3] = [Self::Collect, Self::Train, Self::Finish];

    /// Returns the name in names of jobs and files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Collect => "collect",
            Self::Train => "train",
            Self::Finish => "finish",
        }
    }

    fn purpose(self) -> &'static str {
        match self {
            Self::Collect => "simulates the episodes that the datasets lack, divided among the tasks",
            Self::Train => "trains the runs that are not done yet, divided among the tasks",
            Self::Finish => "does the remaining runs if a task was lost",
        }
    }
}

/// The common part of an experiment's scripts.
pub struct Job<'a> {
    /// The experiment's name.
    pub experiment: &'a str,
    /// The folder of the scripts and logs, absolute.
    pub folder: &'a Path,
    /// Where the command was typed: paths in it are relative to this folder.
    pub workdir: &'a Path,
    /// The command that starts the harness from any folder.
    pub program: &'a [String],
    /// The results folder.
    pub results: &'a Path,
    /// Spec, changed settings and `--quick`, as they were typed.
    pub words: &'a [String],
    /// Whether a task waits for the runs of others, to compare them with its own (successive halving).
    pub waits: bool,
    /// What each task requests.
    pub resources: &'a Resources,
}

impl Job<'_> {
    /// The batch script of a step, whose array has so many tasks.
    pub fn script(&self, step: Step, tasks: u32) -> String {
        let Resources { throttle, cpus, memory, time, partition, options, setup, .. } = self.resources;
        let cpus = cpus.unwrap_or(4);
        let mut head = vec![format!("--job-name=harness-{}-{}", self.experiment, step.name())];
        let mut log = step.name().to_owned();
        if step != Step::Finish {
            let throttle = throttle.map(|most| format!("%{most}")).unwrap_or_default();
            head.push(format!("--array=1-{tasks}{throttle}"));
            log += "-%a";
        }
        head.push(format!("--cpus-per-task={cpus}"));
        head.extend(memory.iter().map(|memory| format!("--mem={memory}")));
        head.extend(time.iter().map(|time| format!("--time={time}")));
        head.extend(partition.iter().map(|partition| format!("--partition={partition}")));
        // Slurm replaces patterns such as %a in the path, and splits the line at spaces unless they are quoted.
        let folder = self.folder.to_string_lossy().replace('%', "%%");
        head.push(format!("--output={}/{log}.log", quoted([&*folder])));
        head.extend(["--open-mode=append", "--requeue", "--signal=B:TERM@120"].map(str::to_owned));
        head.extend(options.iter().cloned());

        let mut script = format!("#!/bin/bash\n# {}: {}.\n", self.experiment, step.purpose());
        script += "# `harness submit` wrote this script. You can edit it and submit it with `sbatch`.\n";
        for option in head {
            let _ = writeln!(script, "#SBATCH {option}");
        }
        let _ = writeln!(script, "\ncd {} || exit", path_word(self.workdir));
        for line in setup {
            let _ = writeln!(script, "{line}");
        }
        let (command, options) = match step {
            Step::Collect => ("collect", " --shard \"$SLURM_ARRAY_TASK_ID/$tasks\""),
            Step::Train if self.waits => ("run", " --shard \"$SLURM_ARRAY_TASK_ID/$tasks\""),
            Step::Train => ("run", " --shard \"$SLURM_ARRAY_TASK_ID/$tasks\" --no-wait"),
            Step::Finish => ("run", ""),
        };
        if step != Step::Finish {
            let _ = writeln!(script, "tasks={tasks}");
        }
        let words = quoted(self.words.iter().map(String::as_str));
        let _ = write!(
            script,
            r#"
echo "task ${{SLURM_ARRAY_TASK_ID:-1}} begins on $(hostname), start $((${{SLURM_RESTART_COUNT:-0}} + 1))"
{program} --results {results} --threads {cpus} \
    {command} {words}{options} &
harness=$!

# Slurm sends SIGTERM two minutes before the time limit. The harness then saves the training's state and ends with code
# 143.
trap 'kill -TERM "$harness" 2>/dev/null' TERM
wait "$harness"; code=$?
while kill -0 "$harness" 2>/dev/null; do wait "$harness"; code=$?; done
echo "task ${{SLURM_ARRAY_TASK_ID:-1}} ends with code $code"

# A task that a signal ended goes back into the queue and resumes: always after SIGTERM, up to three times after another
# signal. A task that was cancelled is no longer running, and stays cancelled.
state=$(scontrol show job "$SLURM_JOB_ID" --oneliner | grep -o 'JobState=[A-Z_]*')
if [ "$state" = JobState=RUNNING ] && [ "$code" -gt 128 ] &&
    {{ [ "$code" -eq 143 ] || [ "${{SLURM_RESTART_COUNT:-0}}" -lt 3 ]; }}; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
"#,
            program = quoted(self.program.iter().map(String::as_str)),
            results = path_word(self.results),
        );
        script
    }
}

/// Submits a script. Its job begins when the job `after` has ended, whether that succeeded or not. Returns the job's
/// number.
///
/// # Errors
/// When sbatch is not installed or refuses the script.
pub fn submit(script: &Path, after: Option<u64>) -> Result<u64> {
    let mut arguments = vec!["--parsable".to_owned()];
    arguments.extend(after.map(|job| format!("--dependency=afterany:{job}")));
    let mut command = Command::new("sbatch");
    let said = answer(command.args(arguments).arg(script))?;
    // `--parsable` prints `number` or `number;cluster`.
    let number = said.trim().split(';').next().and_then(|number| number.parse().ok());
    number.ok_or_else(|| anyhow!("sbatch failed: {}", said.trim()))
}

/// Cancels jobs.
///
/// # Errors
/// When scancel is not installed or fails.
pub fn cancel(jobs: &[u64]) -> Result<()> {
    answer(Command::new("scancel").args(jobs.iter().map(u64::to_string))).map(drop)
}

/// A task that Slurm knows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Task {
    /// Number of its job.
    pub job: u64,
    /// The task's index in its array; `None` for a job without one.
    pub index: Option<u32>,
    /// For example RUNNING or PENDING.
    pub state: String,
    /// The machine that it runs on; empty if it waits.
    pub host: String,
    /// Time since it began, as Slurm prints it.
    pub elapsed: String,
    /// Why it waits.
    pub reason: String,
}

/// This user's tasks that wait or run.
///
/// # Errors
/// When squeue is not installed or fails.
pub fn tasks() -> Result<Vec<Task>> {
    let format = "%F|%K|%T|%N|%M|%r";
    let said = answer(Command::new("squeue").args(["--me", "--noheader", "--array", "--format", format]))?;
    Ok(said.lines().filter_map(task).collect())
}

fn task(line: &str) -> Option<Task> {
    let parts: Vec<&str> = line.split('|').map(str::trim).collect();
    let [job, index, state, host, elapsed, reason] = parts[..] else { return None };
    let reason = if reason == "None" { "" } else { reason };
    Some(Task {
        job: job.parse().ok()?,
        index: index.parse().ok(),
        state: state.to_owned(),
        host: host.to_owned(),
        elapsed: elapsed.to_owned(),
        reason: reason.to_owned(),
    })
}

/// Runs a command of Slurm, and returns its output.
fn answer(command: &mut Command) -> Result<String> {
    let program = command.get_program().to_string_lossy().into_owned();
    let output = command.output().map_err(|source| match source.kind() {
        std::io::ErrorKind::NotFound => {
            let instead = instead(&program);
            usage(format!(
                "{program} is not installed, so this machine is not part of a Slurm cluster{instead}"
            ))
        }
        _ => anyhow!("{program} can't be started: {source}"),
    })?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr).trim().replace('\n', "; ");
        bail!("{program} failed: {said}");
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}
