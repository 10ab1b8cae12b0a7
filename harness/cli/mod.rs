//! The command line of the harness: arguments, terminal and exit codes; nothing scientific.

// First, since its macros are known from here on.
#[macro_use]
mod output;

mod claims;
mod compare;
mod diff;
mod doctor;
mod figures;
mod inspect;
mod interrupt;
mod layers;
pub mod progress;
mod publish;
mod removal;
mod render;
mod report;
mod run;
mod sheet;
mod slurm;
mod submit;
mod table;
mod verify;
mod world;

use anyhow::bail;
use clap::{Parser, Subcommand};
use harness::analysis::AnalysisError;
use harness::claims::ClaimsError;
use harness::collection::CollectionError;
use harness::dataset::DatasetError;
use harness::experiment::{ExperimentError, describe};
use harness::learning::LearningError;
use harness::registry::{QueryError, Registry, RegistryError, quoted};
use harness::report::ReportError;
use harness::simulation::SimulationError;
use harness::spec::SpecError;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// A research harness for multi-modal perception of a soft robot.
///
/// An experiment is a YAML file; its results are Parquet tables, queried with SQL.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:
  harness run experiments/multi_to_multi.yaml --quick
  harness query \"select scenario, latent, value from metrics where model = 'network' and metric = 'wmape' and index is null\"
  harness render cluttered --output scene.png"
)]
struct Arguments {
    /// Folder of datasets and runs
    // Read as text, since Polars takes no other paths.
    #[arg(long, global = true, value_name = "DIR", default_value = "results", value_parser = text_path)]
    results: PathBuf,
    /// Threads for simulation and training [default: all processors]
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    #[command(subcommand)]
    command: Command,
}

fn text_path(path: &str) -> Result<PathBuf, std::convert::Infallible> {
    Ok(path.into())
}

#[derive(Subcommand)]
enum Command {
    /// Do every run of an experiment that isn't done yet
    #[command(after_help = "Examples:
  harness run experiments/multi_to_multi.yaml
  harness run experiments/multi_to_multi.yaml --quick --dry-run
  harness run experiments/single_to_multi.yaml training.batch_size=512 latent=[8,16]")]
    Run(run::Run),
    /// Simulate what is missing of an experiment's datasets, without training
    #[command(
        after_help = "Example:\n  harness collect experiments/multi_to_multi.yaml scenarios=[cluttered]"
    )]
    Collect(run::Collect),
    /// Hand an experiment to a Slurm cluster: datasets first, then the runs, divided among tasks
    #[command(after_help = SUBMIT_HELP)]
    Submit(submit::Submit),
    /// Cancel a job that was submitted; what its tasks have done is kept
    #[command(after_help = "Examples:
  harness cancel multi_to_multi                     every job of an experiment
  harness cancel multi_to_multi-20261122T093000Z    one job, as `harness ls --jobs` lists it")]
    Cancel(submit::Cancel),
    /// Check a spec and list the runs it stands for
    #[command(after_help = "Example:\n  harness validate experiments/smoke.yaml training.epochs=3")]
    Validate(run::Validate),
    /// Answer a question in SQL over the tables runs, epochs, metrics, predictions, forces, frames and episodes
    #[command(after_help = "Examples:
  harness query \"select run, status, prediction_seconds from runs\"
  harness query \"select scenario, latent, value from metrics where model = 'network' and metric = 'wmape' and index is null\"
  harness query \"select * from epochs where term = 'total'\" --output curves.csv

`harness schema --tables` lists the columns.")]
    Query(inspect::Query),
    /// Judge the paper's statements by the tables
    #[command(after_help = "Examples:
  harness claims
  harness claims vision_improves_force            its query, and the value of every seed
  harness claims --quick                          by the results of `harness run … --quick`
  harness claims --plan                           how many more seeds or datasets would decide, and the commands
  harness claims --readings                       claims by readings of the paper, and the choices that decide
  harness claims --output verdicts.csv

A claim holds where the whole 95 % interval satisfies its condition, does not hold where the whole \
interval violates it, and is undecided otherwise, or with a single seed. It is not testable where what it requires \
does not hold, as that the networks which it compares learned something. Intervals are over datasets or, where there \
is one dataset, over its seeds.")]
    Claims(claims::Claims),
    /// Print runs side by side: mean and interval over seeds, the best of a row marked
    #[command(after_help = "Examples:
  harness compare single_to_multi
  harness compare --by experiment,latent --task prediction --models network
  harness compare --by scenario --metrics r2,rmse
  harness compare multi_to_multi --format latex > table.tex

Metrics are over all joints, links or pixels, on the test episodes; `harness query` has those of each. After ± \
stands half of the 95 % interval of the mean over seeds (Student's t). LaTeX needs \\usepackage{booktabs}.")]
    Compare(compare::Compare),
    /// List all runs
    Ls(inspect::List),
    /// Show one run: its spec, its networks' layers, provenance, times and metrics
    #[command(after_help = "Example:\n  harness show cluttered-z64-seed0")]
    Show(inspect::Show),
    /// Show in what two runs differ: settings, code, versions, machine, and metrics side by side
    #[command(after_help = "Example:\n  harness diff smoke/cluttered-z4-seed0 smoke/cluttered-z8-seed0")]
    Diff(diff::Diff),
    /// Remove runs, after asking
    #[command(after_help = "Examples:
  harness rm smoke                                  every run of an experiment
  harness rm smoke/cluttered-z4-seed0-1a2b3c4d      one run
  harness rm smoke/cluttered --yes                  all whose name begins so, without asking")]
    Rm(removal::Remove),
    /// Find what is no longer needed, and remove it after asking
    #[command(after_help = "Examples:
  harness gc                                        list all of it with sizes, and ask
  harness gc --only quick --only failed --yes

superseded: runs of which there is a later one with the same settings, on another dataset or by another revision of \
the method. failed: runs that failed. quick: runs of `harness run --quick`. unused: simulated datasets that no remaining \
run uses. Imported datasets always stay.")]
    Gc(removal::Collect),
    /// Show the space that each experiment and each dataset takes
    Du,
    /// Print the JSON schema of experiment specs, for editors, or the columns of the tables
    Schema(inspect::Schema),
    /// List the worlds, check a world file, or write a first one for an MJCF model
    #[command(after_help = "Examples:
  harness world list
  harness world new robots/gripper.xml
  harness world check robots/gripper.yaml

A spec names a world file in its `scenarios`, by the path from its own folder.")]
    World(world::Command),
    /// Draw a scene, or an instant or a clip of an episode, in good quality
    #[command(after_help = "Examples:
  harness render cluttered --output scene.png
  harness render cluttered --episode 3 --sample 250 --width 1600 --height 1000 --output push.png
  harness render empty --episode 0 --output clip.gif
  harness render robots/gripper.yaml --output gripper.png")]
    Render(render::Render),
    /// Draw the paper's figures from the tables, as SVG and PNG, each with its numbers as CSV
    #[command(after_help = FIGURES_HELP)]
    Figures(figures::Figures),
    /// Write a page to read: scenes, claims, results to look closer at, figures, training curves, runs
    #[command(after_help = REPORT_HELP)]
    Report(report::Report),
    /// Copy finished runs' tables to a folder that is small enough for version control
    #[command(after_help = "Examples:
  harness publish single_to_multi multi_to_multi
  harness figures --results results/reference
  harness publish my_experiment --to paper/results

Kept are records, specs, all epochs and metrics. Of single samples, what the figures show is
kept: the last two joints and links, and the pictures, of each cell's lowest seed; of sweeps,
none. Networks stay behind.")]
    Publish(publish::Publish),
    /// Check that everything in the results folder is as it was written
    #[command(after_help = "Examples:
  harness verify
  harness --results /data/results verify

Names each file that is broken or missing, and the command that repairs it. Exit code 0: everything is whole;
1: something is broken.")]
    Verify,
    /// Check what this machine offers: rendering, MuJoCo, threads, memory, disk
    Doctor,
}

const FIGURES_HELP: &str = "Examples:
  harness figures
  harness figures prediction_results regression --out paper/figures
  harness figures --quick
  harness figures propriovision_to_vision --multi multi_to_multi_best
  harness figures readings                        what vision adds under each reading of the paper
  harness figures --results results/reference

Width: 8.5 cm, a journal's column. Letters are outlines, so no font is needed to show them.
Runs: those of experiments/single_to_multi.yaml and multi_to_multi.yaml; what is missing is named.
Runs of one experiment that differ in settings are not put together: --where chooses among them.";

const SUBMIT_HELP: &str = "Examples:
  harness submit experiments/multi_to_multi.yaml --tasks 16 --cpus 4 --memory 8G --time 04:00:00
  harness submit experiments/multi_to_multi.yaml --partition cpu --throttle 8 --sbatch=--account=lab
  harness submit experiments/multi_to_multi.yaml --config cluster.yaml --dry-run
  harness ls --jobs
  harness cancel multi_to_multi

Hands in up to three jobs with sbatch: an array that simulates the missing episodes, an array that divides the runs, and \
one task that does what is left, should a task be lost. A task that reaches its time limit or is preempted saves its \
state, is queued again and resumes. The results folder must be on a file system that all nodes share, with working locks.";

const REPORT_HELP: &str = "Examples:
  harness report
  harness report --quick --out quick.html
  harness report --results results/reference

One HTML file that needs no network: open it in a browser, or send it. Runs are those of `harness figures` and \
`harness claims`; what there are none for is named in the page. What shows the simulated world alone is rendered once, \
and kept in $XDG_CACHE_HOME/harness (~/.cache/harness) until the program changes.";

/// Everything went well, or was done before.
const DONE: u8 = 0;
/// Some run failed, or something could not be read or written.
const FAILED: u8 = 1;
/// The spec or the arguments are wrong; nothing was done.
const USAGE: u8 = 2;

/// Makes a process the program's own: its allocator gives nothing back, and a standard stream that was closed leads
/// nowhere, since the next file to be opened would take its place and receive what is printed.
pub fn prepare_process() {
    /// `mi_option_purge_delay` of mimalloc.h (versions 2 and 3), to which the bindings give no name.
    const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;
    const NEVER: std::ffi::c_long = -1;
    // SAFETY: the option is a number that may be set at any time.
    unsafe { libmimalloc_sys::mi_option_set(PURGE_DELAY, NEVER) };
    for stream in 0..=2 {
        // SAFETY: asks whether the descriptor is open; the lowest that is not is what `open` returns.
        unsafe {
            if libc::fcntl(stream, libc::F_GETFD) == -1 {
                libc::open(c"/dev/null".as_ptr(), libc::O_RDWR);
            }
        }
    }
}

/// Runs the command that `arguments` give, the first of which is the program's name, and reports its error, once.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let arguments = match Arguments::try_parse_from(arguments) {
        Ok(arguments) => arguments,
        Err(told) => {
            // Help and version come this way as well. Where they can't be printed, there is no one to tell.
            let _ = told.print();
            return ExitCode::from(if told.use_stderr() { USAGE } else { DONE });
        }
    };
    let threads = arguments.threads.map_or_else(all_threads, usize::from);
    // Fails only if a pool exists already, and this is the first use.
    let _ = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
    let registry = Registry::new(&arguments.results);
    let outcome = execute(arguments.command, &registry, threads);
    for left_out in registry.left_out() {
        eprintln!("warning: {left_out}");
    }
    let outcome = outcome.and_then(|code| output::lost().map_or(Ok(code), |lost| bail!(lost)));
    outcome.unwrap_or_else(|error| {
        if let Some((signal, code)) = interrupt::received().filter(|_| is_cancelled(&error)) {
            let words: Vec<String> = words().collect();
            let command = quoted(words.iter().map(String::as_str));
            eprintln!("stopped by {signal}; the same command goes on from here: {command}");
            return ExitCode::from(code);
        }
        eprintln!("error: {}", describe(error.as_ref()));
        ExitCode::from(if is_usage(&error) { USAGE } else { FAILED })
    })
}

fn execute(command: Command, registry: &Registry, threads: usize) -> anyhow::Result<ExitCode> {
    if command.reads_results() {
        registry.check_there()?;
    }
    match command {
        Command::Run(run) => run.execute(registry, threads),
        Command::Collect(collect) => collect.execute(registry, threads),
        Command::Validate(validate) => validate.execute(),
        Command::Query(query) => query.execute(registry),
        Command::Claims(claims) => claims.execute(registry),
        Command::Compare(compare) => compare.execute(registry),
        Command::Submit(submit) => submit.execute(registry, threads),
        Command::Cancel(cancel) => cancel.execute(registry),
        Command::Ls(list) => list.execute(registry),
        Command::Show(show) => show.execute(registry),
        Command::Diff(diff) => diff.execute(registry),
        Command::Rm(remove) => remove.execute(registry),
        Command::Gc(collect) => collect.execute(registry),
        Command::Du => removal::usage(registry),
        Command::Schema(schema) => schema.execute(),
        Command::Render(render) => render.execute(),
        Command::Figures(figures) => figures.execute(registry),
        Command::Report(report) => report.execute(registry),
        Command::Publish(publish) => publish.execute(registry),
        Command::Verify => verify::execute(registry),
        Command::World(world) => world.execute(),
        Command::Doctor => doctor::execute(registry, threads),
    }
}

impl Command {
    /// Whether the command answers from results, which must be there.
    fn reads_results(&self) -> bool {
        match self {
            Self::Query(_) | Self::Claims(_) | Self::Compare(_) | Self::Ls(_) | Self::Show(_) => true,
            Self::Figures(_) | Self::Report(_) | Self::Publish(_) | Self::Verify | Self::Diff(_) => true,
            Self::Rm(_) | Self::Gc(_) | Self::Du => true,
            Self::Run(_) | Self::Collect(_) | Self::Validate(_) | Self::Submit(_) | Self::Cancel(_) => false,
            Self::Schema(_) | Self::World(_) | Self::Render(_) | Self::Doctor => false,
        }
    }
}

/// This process's command in words; what is not Unicode in them is replaced.
fn words() -> impl Iterator<Item = String> {
    std::env::args_os().map(|word| word.to_string_lossy().into_owned())
}

/// This process's command as it was typed, with its program by name: where that lies is no part of what was done.
pub fn command_line() -> String {
    let mut words = words();
    let program = words.next().unwrap_or_default();
    let name = Path::new(&program).file_name().map(|name| name.to_string_lossy().into_owned());
    let words: Vec<String> = name.into_iter().chain(words).collect();
    quoted(words.iter().map(String::as_str))
}

fn all_threads() -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}

/// Whether the work stopped because it was asked to.
fn is_cancelled(error: &anyhow::Error) -> bool {
    error.downcast_ref().is_some_and(ExperimentError::is_cancelled)
        || error.downcast_ref().is_some_and(CollectionError::is_cancelled)
}

/// Whether the user asked for something that can't be; then the exit code is 2, as for unknown arguments.
fn is_usage(error: &anyhow::Error) -> bool {
    error.is::<SpecError>()
        || error.is::<ClaimsError>()
        || error.is::<AnalysisError>()
        || matches!(error.downcast_ref(), Some(ReportError::Claims(_) | ReportError::Analysis(_)))
        || error.is::<compare::CompareError>()
        || error.is::<render::RenderError>()
        || matches!(
            error.downcast_ref(),
            Some(QueryError::Sql(_) | QueryError::Refused(_) | QueryError::Format(_))
        )
        || submit::is_usage(error)
        || error.is::<world::WorldError>()
        || matches!(
            error.downcast_ref(),
            Some(
                SimulationError::PictureSize { .. }
                    | SimulationError::World(_)
                    | SimulationError::Spec { .. }
                    | SimulationError::Compile { .. }
                    | SimulationError::Unsuitable { .. }
            )
        )
        || matches!(
            error.downcast_ref(),
            Some(ExperimentError::Simulation(
                SimulationError::World(_) | SimulationError::Spec { .. } | SimulationError::Compile { .. }
            ))
        )
        || matches!(error.downcast_ref(), Some(ExperimentError::Unsuitable { .. }))
        || matches!(
            error.downcast_ref(),
            Some(ExperimentError::Dataset(DatasetError::NotImported { .. } | DatasetError::Lacks { .. }))
        )
        || matches!(error.downcast_ref(), Some(ExperimentError::Learning(LearningError::Device { .. })))
        || matches!(
            error.downcast_ref(),
            Some(
                RegistryError::Unknown { .. }
                    | RegistryError::Ambiguous { .. }
                    | RegistryError::NoResults { .. }
            )
        )
}
