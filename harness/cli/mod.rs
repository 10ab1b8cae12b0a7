//! The command line of the harness: arguments, terminal output, signals and exit codes.

// This module must come first, because its macros are only visible in the modules after it.
#[macro_use]
mod output;

mod claims;
mod compare;
mod diff;
mod doctor;
mod experiments;
mod export;
mod figures;
mod inspect;
mod interrupt;
mod layers;
mod pack;
mod plot;
pub mod progress;
mod publish;
mod removal;
mod render;
mod report;
mod results;
mod run;
mod search;
mod serve;
mod sheet;
mod slurm;
mod submit;
mod table;
mod verify;
mod watch;
mod world;

use anyhow::bail;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use clap_complete::Shell;
use harness::analysis::AnalysisError;
use harness::claims::ClaimsError;
use harness::collection::CollectionError;
use harness::dataset::DatasetError;
use harness::experiment::{ExperimentError, ModelError, describe};
use harness::learning::LearningError;
use harness::registry::{QueryError, Registry, RegistryError, quoted};
use harness::report::ReportError;
use harness::simulation::SimulationError;
use harness::spec::SpecError;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::OnceLock;

/// A research harness for multi-modal perception of a soft robot.
///
/// An experiment is a YAML file. Its results are Parquet tables that are queried with SQL.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:
  harness run multi_to_multi --quick
  harness query \"select run, status, prediction_seconds from runs\"
  harness render cluttered --output scene.png"
)]
struct Arguments {
    /// Folder of datasets and runs
    // Parsed as text, because Polars only supports paths in UTF-8.
    #[arg(long, global = true, value_name = "DIR", default_value = "results", value_parser = text_path, display_order = 100)]
    results: PathBuf,
    /// Threads for simulation and training [default: all processors]
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024), display_order = 100)]
    threads: Option<u16>,
    #[command(subcommand)]
    command: Command,
}

fn text_path(path: &str) -> Result<PathBuf, std::convert::Infallible> {
    Ok(path.into())
}

#[derive(Subcommand)]
enum Command {
    /// Do all runs of an experiment that are not done yet
    #[command(after_help = "Examples:
  harness run multi_to_multi
  harness run multi_to_multi --quick --dry-run
  harness run my_spec.yaml training.batch_size=512 latent=[8,16]")]
    Run(run::Run),
    /// Simulate the missing episodes of an experiment's datasets, without training
    #[command(after_help = "Example:\n  harness collect multi_to_multi scenarios=[cluttered]")]
    Collect(run::Collect),
    /// Submit an experiment to a Slurm cluster: datasets first, then the runs, divided among tasks
    #[command(after_help = SUBMIT_HELP)]
    Submit(submit::Submit),
    /// Cancel a submitted job; what its tasks have done is kept
    #[command(after_help = "Examples:
  harness cancel multi_to_multi                     every job of an experiment
  harness cancel multi_to_multi-20261122T093000Z    one job, as `harness ls --jobs` lists it")]
    Cancel(submit::Cancel),
    /// Check a spec and list its runs
    #[command(after_help = "Example:\n  harness validate smoke training.epochs=3")]
    Validate(run::Validate),
    /// List the built-in experiments, or print the spec of one
    #[command(after_help = "Examples:
  harness experiments
  harness experiments multi_to_multi > my_spec.yaml")]
    Experiments(experiments::Experiments),
    /// Answer a SQL query over the tables runs, epochs, metrics, predictions, forces, frames and episodes
    #[command(after_help = "Examples:
  harness query \"select run, status, prediction_seconds from runs\"
  harness query \"select run, modality, value from metrics where metric = 'r2'\"
  harness query \"select * from epochs where term = 'total'\" --output curves.csv

`harness schema --tables` lists the columns.")]
    Query(inspect::Query),
    /// Test which of the paper's statements hold
    #[command(after_help = "Examples:
  harness claims
  harness claims vision_improves_force            its query, and the value of every seed
  harness claims --quick                          by the results of `harness run … --quick`
  harness claims --plan                           how many more seeds or datasets would decide, and the commands
  harness claims --readings                       all claims under each reading of the paper, and what changes
  harness claims --output verdicts.csv

A claim holds if the whole 95 % interval satisfies its condition, and does not hold if the whole interval violates \
it. Otherwise, or with a single seed, it is undecided. A claim is not testable if its requirement does not hold, for \
example that the compared networks learned something. Intervals are over datasets or, with one dataset, over its \
seeds.")]
    Claims(claims::Claims),
    /// Compare runs in a table: mean and interval over seeds, with the best value of each row marked
    #[command(after_help = "Examples:
  harness compare single_to_multi
  harness compare --by experiment,latent --task prediction --models network
  harness compare --by scenario --metrics r2,rmse
  harness compare multi_to_multi --format latex > table.tex

Metrics are over all joints, links or pixels, on the test episodes; `harness query` has those of each joint or link. \
The number after ± is half of the 95 % interval of the mean over seeds (Student's t). LaTeX needs \
\\usepackage{booktabs}.")]
    Compare(compare::Compare),
    /// List all runs
    Ls(inspect::List),
    /// Show what runs now: losses, rates, remaining time and processes, refreshed each second
    #[command(after_help = "Examples:
  harness watch                    until nothing runs any more, or Ctrl-C
  harness watch multi_to_multi
  harness watch --once             for scripts")]
    Watch(watch::Watch),
    /// Show one run: settings, times and metrics, or everything with --all
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

superseded: a later run has the same settings, but another dataset or another revision of the method. failed: the run \
failed. quick: the run was made with --quick. unused: no remaining run uses the simulated dataset. Imported datasets are \
never removed.")]
    Gc(removal::Gc),
    /// Show the space that each experiment and each dataset takes
    Du,
    /// Print the JSON schema of experiment specs, for editors, or the columns of the tables
    Schema(inspect::Schema),
    /// List the worlds, check a world file, or write one for an MJCF model
    #[command(after_help = "Examples:
  harness world list
  harness world new robots/gripper.xml
  harness world check robots/gripper.yaml

A spec names a world file in its `scenarios`, as a path relative to the spec's folder.")]
    World(world::Command),
    /// Render a scene, or an image or clip of an episode, in high quality
    #[command(after_help = "Examples:
  harness render cluttered --output scene.png
  harness render cluttered --episode 3 --sample 250 --width 1600 --height 1000 --output push.png
  harness render empty --episode 0 --output clip.gif
  harness render robots/gripper.yaml --output gripper.png")]
    Render(render::Render),
    /// Draw the paper's figures from the tables, as SVG and PNG, each with its numbers as CSV
    #[command(after_help = FIGURES_HELP)]
    Figures(figures::Figures),
    /// Plot a metric over a setting, with the intervals of `compare`, as SVG, PNG or CSV
    #[command(after_help = "Examples:
  harness plot smoke --x latent --y r2 --by modality --facet scenario
  harness plot --x latent --y r2 --modality contact_force --by experiment,scenario --output forces.png

A point is the mean of a network's metric over all joints, links or pixels, over datasets and seeds.")]
    Plot(plot::Plot),
    /// Write an HTML report: scenes, claims, interactive results, figures, training curves, runs
    #[command(after_help = REPORT_HELP)]
    Report(report::Report),
    /// Serve a local page that follows running trainings, with tables, curves, claims and SQL
    #[command(after_help = "Examples:
  harness serve
  harness serve --port 9000 --results results/reference
  ssh -L 8787:127.0.0.1:8787 machine              see the page of another machine at http://127.0.0.1:8787

The page needs no network and no account. Only this machine can reach it, and it can't change any result.")]
    Serve(serve::Serve),
    /// Copy the tables of finished runs to a folder that is small enough for version control
    #[command(after_help = "Examples:
  harness publish single_to_multi multi_to_multi
  harness figures --results results/reference
  harness publish my_experiment --to paper/results

Records, specs, epochs and metrics are copied. Tables about single samples are copied only
where figures show them: predictions of the last two joints and links, and images, of each
cell's lowest seed, but not of sweeps. Networks are not copied.")]
    Publish(publish::Publish),
    /// Write a trained network as an ONNX model, for other programs
    #[command(after_help = "Examples:
  harness export --format onnx multi_to_multi_best/cluttered network.onnx
  harness export --format onnx smoke/empty reconstruction.onnx --task reconstruction

The model takes and returns SI units, and images as bytes. docs/networks.md describes it.")]
    Export(export::Export),
    /// Write runs with their networks to one file, from which another machine predicts the same
    #[command(after_help = PACK_HELP)]
    Pack(pack::Pack),
    /// Add the runs of a pack to the results folder
    #[command(after_help = UNPACK_HELP)]
    Unpack(pack::Unpack),
    /// Check that all files of the results folder are as they were written
    #[command(after_help = "Examples:
  harness verify
  harness --results /data/results verify

Names each file that is damaged or missing, and the command that repairs it. The exit code is 0 if all files
are intact, and 1 otherwise.")]
    Verify,
    /// Check this machine: rendering, MuJoCo, threads, memory, disk
    Doctor,
    /// Print a script with which a shell completes the harness's commands and options
    #[command(after_help = "Examples:
  harness completions bash > ~/.local/share/bash-completion/completions/harness
  harness completions zsh > ~/.zfunc/_harness          with fpath+=~/.zfunc before compinit in ~/.zshrc
  harness completions fish > ~/.config/fish/completions/harness.fish")]
    Completions {
        /// The shell
        #[arg(value_name = "SHELL", value_parser = PossibleValuesParser::new(["bash", "zsh", "fish"]).try_map(|name| name.parse::<Shell>()))]
        shell: Shell,
    },
}

const FIGURES_HELP: &str = "Examples:
  harness figures
  harness figures prediction_results regression --out paper/figures
  harness figures --quick
  harness figures propriovision_to_vision --multi multi_to_multi_best
  harness figures readings                        what vision adds under each reading of the paper
  harness figures --results results/reference

Figures are 8.5 cm wide, a journal's column. Letters are outlines, so no font is needed to show them.
They show the runs of single_to_multi and multi_to_multi. Missing runs are listed.
Runs of one experiment that differ in settings can't be drawn together: select some of them with --where.";

const SUBMIT_HELP: &str = "Examples:
  harness submit multi_to_multi --tasks 16 --cpus 4 --memory 8G --time 04:00:00
  harness submit multi_to_multi --partition cpu --throttle 8 --sbatch=--account=lab
  harness submit multi_to_multi --config cluster.yaml --dry-run
  harness ls --jobs
  harness cancel multi_to_multi

The command submits up to three jobs with sbatch: an array that simulates the missing episodes, an array that divides \
the runs, and one task that does the remaining runs if a task was lost. A task that reaches its time limit or is \
preempted saves its state, is queued again, and resumes. All nodes must share the file system of the results folder, and \
its locks must work across nodes.";

const PACK_HELP: &str = "Examples:
  harness pack multi_to_multi --output multi_to_multi.harness
  harness pack smoke/empty-z4 smoke/cluttered-z4 --output two.harness --datasets
  tar tvf two.harness                               a pack is a plain tar archive

A pack contains all files of the finished runs: records, specs, tables and networks. Its manifest.json lists the \
versions of the harness and MuJoCo, and the size and SHA-256 of each file. The datasets of built-in worlds can be \
collected again where the pack is unpacked, so they are packed only with --datasets.";

const UNPACK_HELP: &str = "Examples:
  harness unpack multi_to_multi.harness
  harness unpack multi_to_multi.harness --results /data/results

Every file is checked before the first run appears. Runs that are there already with the same content are skipped. If \
a run is there with other content, nothing is unpacked.";

const REPORT_HELP: &str = "Examples:
  harness report
  harness report --quick --out quick.html
  harness report --results results/reference

The report is one HTML file that works offline: open it in a browser, or send it. It shows the runs of `harness \
figures` and `harness claims`, and lists missing runs. Images of the simulated world are rendered once, and cached in \
$XDG_CACHE_HOME/harness (~/.cache/harness) until the program changes.";

/// Exit code: everything was done, now or before.
const DONE: u8 = 0;
/// Exit code: a run failed, or a file could not be read or written.
const FAILED: u8 = 1;
/// Exit code: the spec or the arguments are wrong, and nothing was done.
const USAGE: u8 = 2;

/// Prepares the process for [`main`]. The allocator will return no memory to the system. Closed standard streams are
/// opened as `/dev/null`, because the next file to be opened would otherwise receive what is printed.
pub fn prepare_process() {
    /// `mi_option_purge_delay` of mimalloc.h (versions 2 and 3), which has no name in the bindings.
    const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;
    const NEVER: std::ffi::c_long = -1;
    // SAFETY: the option is a number that may be set at any time.
    unsafe { libmimalloc_sys::mi_option_set(PURGE_DELAY, NEVER) };
    for stream in 0..=2 {
        // SAFETY: `fcntl` only asks whether the descriptor is open. `open` returns the lowest closed descriptor, which
        // is this one.
        unsafe {
            if libc::fcntl(stream, libc::F_GETFD) == -1 {
                libc::open(c"/dev/null".as_ptr(), libc::O_RDWR);
            }
        }
    }
}

/// The words that this process was started with. In the Python package, those of the process are the interpreter's.
static WORDS: OnceLock<Vec<OsString>> = OnceLock::new();

/// Runs the command in `arguments`, whose first item is the program's name, prints its error if there is one, and
/// returns the exit code. `program` is the command that starts this program from any folder.
pub fn main(arguments: Vec<OsString>, program: Vec<String>) -> ExitCode {
    let arguments = match parsed(WORDS.get_or_init(|| arguments)) {
        Ok(arguments) => arguments,
        Err(told) => {
            // Help and version are errors of clap as well. If printing fails, nothing can be reported.
            let _ = told.print();
            return ExitCode::from(if told.use_stderr() { USAGE } else { DONE });
        }
    };
    let threads = arguments.threads.map_or_else(all_threads, usize::from);
    // This fails only if the global pool exists already, and this is its first use.
    let _ = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
    let registry = Registry::new(&arguments.results);
    let outcome = execute(arguments.command, &registry, threads, &program);
    for left_out in registry.left_out() {
        eprintln!("warning: {left_out}");
    }
    let outcome = outcome.and_then(|code| output::lost().map_or(Ok(code), |lost| bail!(lost)));
    outcome.unwrap_or_else(|error| {
        if let Some((signal, code)) = interrupt::received().filter(|_| is_cancelled(&error)) {
            let words: Vec<String> = words().collect();
            let command = quoted(words.iter().map(String::as_str));
            eprintln!("stopped by {signal}; continue with the same command: {command}");
            return ExitCode::from(code);
        }
        eprintln!("error: {}", describe(error.as_ref()));
        ExitCode::from(if is_usage(&error) { USAGE } else { FAILED })
    })
}

/// Parses the arguments. The examples in a command's help fit the terminal.
fn parsed(arguments: &[OsString]) -> Result<Arguments, clap::Error> {
    let mut command = Arguments::command();
    if let Some(limit) = table::width() {
        command = with_fitting_examples(command, limit);
    }
    let matches = command.try_get_matches_from_mut(arguments)?;
    Arguments::from_arg_matches(&matches).map_err(|error| error.format(&mut command))
}

/// Makes the examples of a command and of its subcommands fit the terminal. An example is a line that begins with
/// `  harness`; three spaces separate what it does.
fn with_fitting_examples(command: clap::Command, limit: u16) -> clap::Command {
    let fitting = |line: &str| {
        if !line.starts_with("  harness ") || line.chars().count() <= usize::from(limit) {
            return line.to_owned();
        }
        match line.split_once("   ") {
            Some((example, meaning)) => {
                let example = table::command_lines("  ", example.trim(), Some(limit));
                format!("{example}\n{}", table::fitted(&format!("      {}", meaning.trim()), Some(limit)))
            }
            None => table::command_lines("  ", line.trim(), Some(limit)),
        }
    };
    let help = command.get_after_help().map(ToString::to_string);
    let help = help.map(|help| help.lines().map(fitting).collect::<Vec<_>>().join("\n"));
    let command = if let Some(help) = help { command.after_help(help) } else { command };
    command.mut_subcommands(|subcommand| with_fitting_examples(subcommand, limit))
}

fn execute(
    command: Command,
    registry: &Registry,
    threads: usize,
    program: &[String],
) -> anyhow::Result<ExitCode> {
    if command.reads_results() {
        registry.check_there()?;
    }
    match command {
        Command::Run(run) => run.execute(registry, threads),
        Command::Collect(collect) => collect.execute(registry, threads),
        Command::Validate(validate) => validate.execute(),
        Command::Experiments(experiments) => experiments.execute(),
        Command::Query(query) => query.execute(registry),
        Command::Claims(claims) => claims.execute(registry),
        Command::Compare(compare) => compare.execute(registry),
        Command::Submit(submit) => submit.execute(registry, threads, program),
        Command::Cancel(cancel) => cancel.execute(registry),
        Command::Ls(list) => list.execute(registry),
        Command::Watch(watch) => watch.execute(registry),
        Command::Show(show) => show.execute(registry),
        Command::Diff(diff) => diff.execute(registry),
        Command::Rm(remove) => remove.execute(registry),
        Command::Gc(gc) => gc.execute(registry),
        Command::Du => removal::usage(registry),
        Command::Schema(schema) => schema.execute(),
        Command::Render(render) => render.execute(),
        Command::Figures(figures) => figures.execute(registry),
        Command::Plot(plot) => plot.execute(registry),
        Command::Report(report) => report.execute(registry),
        Command::Serve(serve) => serve.execute(registry),
        Command::Publish(publish) => publish.execute(registry),
        Command::Export(export) => export.execute(registry),
        Command::Pack(pack) => pack.execute(registry),
        Command::Unpack(unpack) => unpack.execute(registry),
        Command::Verify => verify::execute(registry),
        Command::World(world) => world.execute(),
        Command::Doctor => doctor::execute(registry, threads),
        Command::Completions { shell } => Ok(print_completions(shell)),
    }
}

impl Command {
    /// Whether the command only reads results, so that the results folder must exist.
    fn reads_results(&self) -> bool {
        match self {
            Self::Query(_) | Self::Claims(_) | Self::Compare(_) | Self::Show(_) => true,
            Self::Ls(list) => list.reads_results(),
            Self::Figures(_)
            | Self::Plot(_)
            | Self::Report(_)
            | Self::Serve(_)
            | Self::Publish(_)
            | Self::Export(_) => true,
            Self::Verify | Self::Diff(_) | Self::Watch(_) => true,
            Self::Rm(_) | Self::Gc(_) | Self::Du | Self::Pack(_) => true,
            Self::Unpack(_) | Self::Completions { .. } => false,
            Self::Run(_) | Self::Collect(_) | Self::Validate(_) | Self::Submit(_) | Self::Cancel(_) => false,
            Self::Experiments(_) | Self::Schema(_) | Self::World(_) | Self::Render(_) | Self::Doctor => false,
        }
    }
}

fn print_completions(shell: Shell) -> ExitCode {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut Arguments::command(), "harness", &mut script);
    print!("{}", String::from_utf8_lossy(&script));
    ExitCode::from(DONE)
}

/// The words of this process's command line. Invalid Unicode is replaced.
fn words() -> impl Iterator<Item = String> {
    WORDS.get().into_iter().flatten().map(|word| word.to_string_lossy().into_owned())
}

/// The command line of this process, quoted for a shell. The program is named without its folder, so that records do
/// not depend on where it is installed.
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

/// Whether the error is that a signal cancelled the work.
fn is_cancelled(error: &anyhow::Error) -> bool {
    error.downcast_ref().is_some_and(ExperimentError::is_cancelled)
        || error.downcast_ref().is_some_and(CollectionError::is_cancelled)
        || pack::is_cancelled(error)
}

/// Whether the error is in the arguments, the spec or the query, so that the exit code is [`USAGE`].
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
        || pack::is_usage(error)
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
        || matches!(error.downcast_ref(), Some(ModelError::NoReconstruction { .. }))
        || matches!(error.downcast_ref(), Some(ModelError::Registry(error)) if is_wrong_name(error))
        || error.downcast_ref().is_some_and(is_wrong_name)
}

/// Whether the arguments name a run or a results folder that does not exist, or several runs.
fn is_wrong_name(error: &RegistryError) -> bool {
    matches!(
        error,
        RegistryError::Unknown { .. } | RegistryError::Ambiguous { .. } | RegistryError::NoResults { .. }
    )
}
