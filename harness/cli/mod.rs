//! The command line of the harness: arguments, terminal output, signals and exit codes.

mod asked;
mod claims;
mod compare;
mod diff;
mod doctor;
mod experiments;
mod export;
mod figures;
mod fitness;
mod format;
mod import;
mod inspect;
mod interrupt;
mod judge;
mod layers;
mod plot;
pub mod progress;
mod publish;
mod removal;
mod render;
mod report;
mod results;
mod rollout;
mod run;
mod search;
mod serve;
mod sheet;
mod slurm;
mod submit;
mod verify;
mod watch;
mod world;

use crate::terminal::{encoding, latex, output, table};
use anyhow::bail;
use clap::builder::{PossibleValuesParser, StyledStr, TypedValueParser};
use clap::error::{ContextKind, ContextValue};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use clap_complete::Shell;
use harness::analysis::AnalysisError;
use harness::catalog::QueryError;
use harness::claims::ClaimsError;
use harness::dataset::DatasetError;
use harness::experiment::{
    ExperimentError, ModelError, RolloutError, SubmissionError, describe, results as results_folder,
};
use harness::figures::FigureError;
use harness::learning::LearningError;
use harness::nearest;
use harness::registry::{Registry, RegistryError, quoted};
use harness::report::ReportError;
use harness::simulation::SimulationError;
use harness::spec::{SpecError, setting_names};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::OnceLock;

/// A research harness for soft-robot perception
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:
  harness run first                               a first result, in seconds
  harness run multi_to_multi --quick              the paper's networks, in minutes
  harness compare first
  harness query \"select run, status, prediction_seconds from runs\"
  harness render cluttered --output scene.png

An experiment is a YAML file, called a spec. Its results are Parquet tables, which you query with SQL. \
`harness COMMAND --help` explains a command."
)]
struct Arguments {
    /// Folder of datasets and runs
    // Parsed as text, because Polars only supports paths in UTF-8.
    #[arg(long, global = true, value_name = "DIR", default_value = "results", value_parser = text_path)]
    #[arg(display_order = 100)]
    results: PathBuf,
    /// Threads for simulation and training [default: all processors]
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    #[arg(display_order = 100)]
    threads: Option<u16>,
    #[command(subcommand)]
    command: Command,
}

fn text_path(path: &str) -> Result<PathBuf, std::convert::Infallible> {
    Ok(path.into())
}

/// Parses a number of samples. A time is refused with a word about the difference.
fn samples(text: &str) -> Result<u32, String> {
    item(text)?;
    if text.strip_suffix('s').is_some_and(|seconds| seconds.parse::<f64>().is_ok()) {
        return Err(
            "it is a number of samples, not a time; at the 10 samples per second of the built-in worlds, \
                    0.5 s are 5 samples"
                .into(),
        );
    }
    text.parse()
        .ok()
        .filter(|samples| *samples > 0)
        .ok_or("it must be a whole number of samples, at least 1".into())
}

/// Parses an item of a list that is separated by commas. An empty one is left where a shell divided the list.
fn item(text: &str) -> Result<String, String> {
    if text.is_empty() { Err(DIVIDED.into()) } else { Ok(text.to_owned()) }
}

/// Why an item of a list is empty.
const DIVIDED: &str = "a list has no spaces and no comma at its end, as in A,B";

/// A parser for names of shells, whose error lists all names.
fn shell() -> impl TypedValueParser<Value = Shell> {
    PossibleValuesParser::new(["bash", "zsh", "fish"]).try_map(|name| name.parse::<Shell>())
}

#[derive(Subcommand)]
enum Command {
    /// Run an experiment, skipping the runs that are done
    #[command(after_help = "Examples:
  harness run smoke
  harness run smoke training.epochs=3 'latent=[8,16]'
  harness run multi_to_multi --quick --dry-run    only print what would be done
  harness run which_sense --where senses=touch    only the runs with this label

An experiment has a run for each scenario, latent size and seed. A run trains a network on simulated episodes, \
compares its predictions on test episodes with those of baselines, and writes tables to the results folder. The \
command ends with the best run of each scenario, which has the lowest mean error of its outputs on the validation \
samples. You can interrupt the command at any time: the same command continues.")]
    Run(run::Run),
    /// Simulate the missing episodes of an experiment's datasets
    #[command(after_help = "Example:\n  harness collect smoke 'scenarios=[cluttered]'")]
    Collect(run::Collect),
    /// Submit an experiment to a Slurm cluster
    #[command(after_help = SUBMIT_HELP)]
    Submit(submit::Submit),
    /// Judge the predictions of a model of another program
    #[command(after_help = JUDGE_HELP)]
    Judge(judge::Judge),
    /// Describe what an experiment asks of a model, and list the results so far
    #[command(after_help = "Examples:
  harness task smoke
  harness task smoke --cell empty
  harness task smoke window.context=5

A spec says which data a model gets and what it predicts, so every spec is a task for models of other programs. The \
command prints the dataset, the shapes and units of inputs and outputs, the number of windows, and the columns that a \
file of predictions must have. The spec of a task need not have a network.")]
    Task(judge::Task),
    /// Check a spec and list its runs
    #[command(after_help = "Example:\n  harness validate smoke training.epochs=3")]
    Validate(run::Validate),
    /// List the built-in experiments, or print the spec of one
    #[command(after_help = "Examples:
  harness experiments
  harness experiments multi_to_multi > my_spec.yaml")]
    Experiments(experiments::Experiments),
    /// Query the results with SQL
    #[command(after_help = "Examples:
  harness query \"select run, status, prediction_seconds from runs\"
  harness query \"select run, modality, value from metrics where metric = 'r2'\"
  harness query \"select * from epochs where term = 'total'\" --output curves.csv
  harness query \"select run, started from runs\" --format csv
  harness query \"show tables\"
  harness query \"describe metrics\"

The tables are runs, epochs, metrics, predictions, forces, frames and episodes. `harness schema --tables` lists their \
columns. Scripts read csv and json, which have all rows and all digits.")]
    Query(inspect::Query),
    /// Test which of the paper's statements hold
    #[command(after_help = "Examples:
  harness claims
  harness claims vision_improves_force    its query, and the value of every seed
  harness claims --quick                  judge by quick runs
  harness claims --plan                   what would decide the undecided claims
  harness claims --output verdicts.csv
  harness claims --format json

Most claims need the runs of single_to_multi and multi_to_multi. A claim holds if the whole 95 % interval satisfies \
its condition, and does not hold if the whole interval violates it. Otherwise, or with a single seed or dataset, it is \
undecided. A claim is not testable if its requirement, for example that the compared networks learned something, does \
not hold or is undecided. Intervals are over datasets or, with one dataset, over its seeds or episodes.")]
    Claims(claims::Claims),
    /// Compare networks and baselines in a table
    #[command(after_help = "Examples:
  harness compare smoke
  harness compare --by experiment,latent --task prediction --models network
  harness compare --by scenario --metrics r2,rmse
  harness compare history --horizon 1,10 --of contact_force --metrics r2
  harness compare smoke --format latex > table.tex
  harness compare smoke --format csv              the means, one in each row

Each number is a mean over datasets and seeds. The number after ± is half of its 95 % interval (Student's t). The best \
value of each row is marked. Metrics are computed over all joints, links or pixels of the test episodes. The table \
metrics, which `harness query` reads, has them for each joint and link. The LaTeX table needs \\usepackage{booktabs}.")]
    Compare(compare::Compare),
    /// List the runs
    #[command(after_help = "Examples:
  harness ls
  harness ls smoke --status failed
  harness ls --sort seconds
  harness ls --status failed --format json
  harness ls --jobs")]
    Ls(inspect::List),
    /// Follow the running trainings: losses, speed, remaining time
    #[command(after_help = "Examples:
  harness watch
  harness watch smoke
  harness watch --once             print once, for scripts

The list is refreshed each second, until nothing is running or you press Ctrl-C. It also shows which process trains \
each network, and which datasets are being collected.")]
    Watch(watch::Watch),
    /// Show one run: settings, times and metrics
    #[command(after_help = "Examples:
  harness show smoke/cluttered
  harness show smoke/cluttered --all")]
    Show(inspect::Show),
    /// Show the differences between two runs, and their metrics
    #[command(after_help = "Example:
  harness diff smoke/empty smoke/cluttered

The differences are in settings, worlds and metrics and, with --all, also in the versions and the machine.")]
    Diff(diff::Diff),
    /// Remove runs, after asking
    #[command(after_help = "Examples:
  harness rm smoke                    every run of the experiment
  harness rm smoke/cluttered          the runs whose id begins with cluttered
  harness rm smoke/cluttered --yes    the same, without asking

Datasets are not removed. `harness gc` removes those that no run uses.")]
    Rm(removal::Remove),
    /// Remove runs and datasets that are no longer needed, after asking
    #[command(after_help = "Examples:
  harness gc
  harness gc --only quick --only failed --yes

The command first lists what it would remove, with the size and one of these reasons. superseded: a later run has the \
same settings and the same world, but another dataset or another revision of the method. world: the world has changed \
since, so that the run does not count. failed: the run failed. \
quick: the run was made with --quick. unused: no remaining run uses the simulated dataset. unfinished: a killed \
process left it. Imported datasets are never removed.")]
    Gc(removal::Gc),
    /// Print the JSON schema of specs or mappings, or the columns of the tables
    #[command(after_help = "Examples:
  harness schema > schema.json
  harness schema --mapping > mapping.schema.json
  harness schema --tables
  harness schema --tables --world robots/gripper.yaml

Editors complete and check a spec that begins with this line:
  # yaml-language-server: $schema=schema.json")]
    Schema(inspect::Schema),
    /// List the worlds, check a world file, or write one for a model
    #[command(after_help = "Examples:
  harness world list
  harness world check cluttered
  harness world new robots/gripper.xml    write robots/gripper.yaml
  harness world check robots/gripper.yaml
  harness world check robots/gripper.yaml --render pictures

A world is a YAML file next to an MJCF model. It defines what is sensed, what moves, and what is random. A spec names \
it in `scenarios`, by its path relative to the spec's folder.")]
    World(world::Command),
    /// Render a scene, an image or clip of an episode, or what a network predicts along it
    #[command(after_help = "Examples:
  harness render cluttered --output scene.png
  harness render cluttered --episode 3 --sample 150 --width 1600 --height 1000 --output push.png
  harness render empty --episode 0 --output clip.gif
  harness render robots/gripper.yaml --camera wrist --output gripper.png
  harness render cluttered --as-seen --episode 3 --sample 150 --output seen.png
  harness render smoke/empty --horizon 1 --output predicted.gif")]
    Render(render::Render),
    /// Draw the paper's figures, or those of any robot, as SVG, PNG and CSV
    #[command(after_help = FIGURES_HELP)]
    Figures(figures::Figures),
    /// Plot a metric over a setting, as SVG, PNG or CSV
    #[command(after_help = "Examples:
  harness plot smoke --x latent --metrics r2 --by modality --facet scenario
  harness plot --x latent --metrics r2 --of contact_force --by experiment,scenario --output forces.png

A point is the mean of a network's metric over all joints, links or pixels, over datasets and seeds.")]
    Plot(plot::Plot),
    /// Write all results to one HTML file
    #[command(after_help = REPORT_HELP)]
    Report(report::Report),
    /// Show the results in a browser, also of running trainings
    #[command(after_help = "Examples:
  harness serve
  harness serve --port 9000

Open the printed address in a browser. The page shows runs, curves, metrics, claims and answers to SQL queries. The \
curves grow during training. The page needs no network and no account, and it can't change any result. Other machines \
can't reach it, but every user of this machine can read the results through its port. To see the page of another \
machine, forward its port with `ssh -L 8787:127.0.0.1:8787 MACHINE`, and open http://127.0.0.1:8787.")]
    Serve(serve::Serve),
    /// Copy results to a folder, small enough for version control or complete
    #[command(after_help = "Examples:
  harness publish smoke --output published
  harness compare smoke --results published
  harness publish smoke --complete --output moved
  harness publish smoke --complete --output results --results moved

The command copies records, specs, and the tables epochs, metrics and forces. It copies only those predictions and \
images that figures show, and networks only with --networks. With --complete, it \
copies every file of the runs and their datasets, byte for byte. The last example adds such a copy to another results \
folder. What is there with the same content is skipped, and nothing with other content is replaced.")]
    Publish(publish::Publish),
    /// Write a trained network as an ONNX model
    #[command(after_help = "Examples:
  harness export --format onnx smoke/empty network.onnx
  harness export --format onnx smoke/empty reconstruction.onnx --task reconstruction

The model takes and returns SI units, and images as bytes. docs/networks.md describes it.")]
    Export(export::Export),
    /// Make a dataset from a recording, with the Python package
    #[command(after_help = IMPORT_HELP)]
    Import(import::Import),
    /// Check that no file of the results has changed or is missing
    #[command(after_help = "Examples:
  harness verify
  harness verify --results /data/results

The command lists each file that is damaged or missing, with the command that repairs it. The exit code is 0 if all \
files are intact, and 1 otherwise.")]
    Verify,
    /// Check this machine: rendering, MuJoCo, threads, memory, disk
    #[command(
        after_help = "A line that begins with FAIL says what is missing and what to do. The exit code is then 1."
    )]
    Doctor,
    /// Print a completion script for bash, zsh or fish
    #[command(after_help = "Examples:
  harness completions bash > ~/.local/share/bash-completion/completions/harness
  harness completions zsh > ~/.zfunc/_harness          with fpath+=~/.zfunc before compinit in ~/.zshrc
  harness completions fish > ~/.config/fish/completions/harness.fish")]
    Completions {
        /// The shell that reads the script
        #[arg(value_name = "SHELL", value_parser = shell())]
        shell: Shell,
    },
}

const FIGURES_HELP: &str = "Examples:
  harness figures
  harness figures prediction_results regression --output paper/figures
  harness figures --quick
  harness figures propriovision_to_vision --reading reproduction/base
  harness figures --experiment my_robot
  harness figures horizon --experiment history --of contact_force

The figures show the runs of single_to_multi and multi_to_multi. If runs are missing, a message names the command that \
creates them. The figure horizon shows the runs of hidden_stiffness. Runs of one experiment that differ in settings can't be \
drawn together: select some of them with --where. With --experiment, the figures show one experiment in any world, and \
a message says why the others do not apply. Figures are 8.5 cm wide, a journal's column. Letters are outlines, so no \
font is needed to show them.";

const SUBMIT_HELP: &str = "Examples:
  harness submit multi_to_multi --tasks 16 --cpus 4 --memory 8G --time 04:00:00
  harness submit multi_to_multi --partition cpu --throttle 8 --sbatch=--account=lab
  harness submit multi_to_multi --config cluster.yaml
  harness submit multi_to_multi --dry-run         print the scripts
  harness ls --jobs                               where the tasks are

The command submits up to three jobs with sbatch: an array that simulates the missing episodes, an array that divides \
the runs, and one task that does the remaining runs if a task was lost. A task that reaches its time limit or is \
preempted saves its state, is queued again, and resumes. The command prints `scancel` with the jobs' \
numbers, which cancels them. Finished runs and saved states are kept. All nodes must share the file system of the results folder, \
and its locks must work across nodes.";

const JUDGE_HELP: &str = "Examples:
  harness judge smoke predictions.parquet --cell empty --model my_gru --seed 0
  harness judge smoke predictions.csv --cell empty --model my_gru --seed 1 --note commit=ab12cd3
  harness judge history simulator --cell cluttered-senses=touch

The predictions become a run of the experiment, beside the networks that `harness run` trains: `harness compare`, \
`query`, `plot` and `report` show it. Its metrics are computed by the program, on the same test windows and with the \
same baselines. Nothing is written unless every prediction is there and finite. Judging the same predictions again \
changes nothing. docs/your-own-model.md explains every step, also from Python.";

const IMPORT_HELP: &str = "Example, in a clone of the repository:
  .venv/bin/pip install '.[import]'        install the Python package, once
  .venv/bin/harness import --inspect recordings/trial_1.h5
  .venv/bin/harness import mapping.yaml

Only the Python package imports recordings: LeRobot datasets, Parquet, CSV, HDF5, zarr and MATLAB files, videos and \
ROS 2 bags. The mapping says what makes up each modality. --inspect lists what is in a recording, and writes a first \
mapping. \
docs/exchange.md has an example.";

const REPORT_HELP: &str = "Examples:
  harness report
  harness report smoke --output smoke.html
  harness report --quick --output quick.html
  harness report --results results/reference

The report is one HTML file that works offline: open it in a browser, or send it. It shows the runs of `harness \
figures` and `harness claims`, and lists missing runs. With names of experiments, it shows their worlds, metrics, \
predictions and images, for any robot. Images of the simulated world are rendered once, and cached in \
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
            if told.use_stderr() {
                eprintln!("{}", told.render().to_string().trim_end());
                return ExitCode::from(USAGE);
            }
            // Help and version are errors of clap as well. If printing fails, nothing can be reported.
            let _ = told.print();
            return ExitCode::from(DONE);
        }
    };
    let threads = arguments.threads.map_or_else(all_threads, usize::from);
    // This fails only if the global pool exists already, and this is its first use.
    let _ = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
    let registry = results_folder(&arguments.results);
    let outcome = execute(arguments.command, &registry, threads, &program);
    for left_out in registry.left_out() {
        eprintln!("warning: {left_out}");
    }
    let outcome = outcome.and_then(|code| output::lost().map_or(Ok(code), |lost| bail!(lost)));
    outcome.unwrap_or_else(|error| {
        if let Some((signal, code)) = interrupt::received().filter(|_| is_cancelled(&error)) {
            let words: Vec<String> = words().collect();
            let command = quoted(words.iter().map(String::as_str));
            eprintln!("stopped by {signal}; continue with the same command: {}", table::unbroken(&command));
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
    let matches = command.try_get_matches_from_mut(arguments);
    let matches = matches.map_err(|error| {
        with_setting(with_nearest_command(error, &command, arguments), &command, arguments)
    })?;
    Arguments::from_arg_matches(&matches).map_err(|error| error.format(&mut command))
}

/// Adds the command that was probably meant to the error about a command that there is not.
fn with_nearest_command(
    mut error: clap::Error,
    command: &clap::Command,
    arguments: &[OsString],
) -> clap::Error {
    let Some(ContextValue::String(wanted)) = error.get(ContextKind::InvalidSubcommand) else { return error };
    // The last command before the wrong one is the one whose subcommands were meant.
    let of = command_before(wanted, command, arguments);
    let names: Vec<&str> = of.get_subcommands().map(clap::Command::get_name).collect();
    if let Some(name) = nearest(wanted, &names).map(str::to_owned) {
        error.insert(ContextKind::SuggestedSubcommand, ContextValue::Strings(vec![name]));
    }
    error
}

/// Says how a setting is written to the error about an option of its name, instead of how to pass the option as a value.
fn with_setting(mut error: clap::Error, command: &clap::Command, arguments: &[OsString]) -> clap::Error {
    let Some(ContextValue::String(option)) = error.get(ContextKind::InvalidArg) else { return error };
    let takes_settings = |argument: &clap::Arg| {
        argument.get_value_names().is_some_and(|names| names.iter().any(|name| name == "KEY=VALUE"))
    };
    let names = setting_names();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let meant = nearest(&option.trim_start_matches('-').replace('-', "_"), &names);
    let of = command_before(option, command, arguments);
    let meant = meant.filter(|_| of.get_positionals().any(takes_settings));
    let tip = meant.map(|name| StyledStr::from(format!("a setting is written without dashes: {name}=VALUE")));
    let mut tips: Vec<StyledStr> = match error.remove(ContextKind::Suggested) {
        Some(ContextValue::StyledStrs(tips)) => tips,
        _ => Vec::new(),
    };
    tips.retain(|tip| !tip.to_string().contains("as a value"));
    tips.extend(tip);
    if !tips.is_empty() {
        error.insert(ContextKind::Suggested, ContextValue::StyledStrs(tips));
    }
    error
}

/// Returns the last command that is named before `word`, which may have a value after `=`.
fn command_before<'a>(word: &str, command: &'a clap::Command, arguments: &[OsString]) -> &'a clap::Command {
    let words = arguments.iter().filter_map(|one| one.to_str());
    let before = words.take_while(|one| one.split('=').next() != Some(word));
    before.fold(command, |command, word| command.find_subcommand(word).unwrap_or(command))
}

/// Makes the examples of a command and of its subcommands fit the terminal. An example is a line that begins with two
/// spaces; three spaces separate what it does. If an example is too wide, what it does is below it, also in the others.
fn with_fitting_examples(command: clap::Command, limit: u16) -> clap::Command {
    let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
    let is_example = |line: &str| line.starts_with("  ");
    let fits = |line: &str| line.chars().count() <= usize::from(limit);
    let is_narrow = help.lines().any(|line| is_example(line) && !fits(line));
    let fitting = |line: &str| {
        if !is_example(line) || !is_narrow {
            return line.to_owned();
        }
        match line.trim().split_once("   ") {
            Some((example, meaning)) => {
                let example = table::command_lines("  ", example.trim(), Some(limit));
                format!("{example}\n{}", table::fitted(&format!("      {}", meaning.trim()), Some(limit)))
            }
            None => table::command_lines("  ", line.trim(), Some(limit)),
        }
    };
    let help = help.lines().map(fitting).collect::<Vec<_>>().join("\n");
    let command = if help.is_empty() { command } else { command.after_help(help) };
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
        Command::Judge(judge) => judge.execute(registry, threads),
        Command::Task(task) => task.execute(registry, threads),
        Command::Validate(validate) => validate.execute(),
        Command::Experiments(experiments) => experiments.execute(),
        Command::Query(query) => query.execute(registry),
        Command::Claims(claims) => claims.execute(registry),
        Command::Compare(compare) => compare.execute(registry),
        Command::Submit(submit) => submit.execute(registry, threads, program),
        Command::Ls(list) => list.execute(registry),
        Command::Watch(watch) => watch.execute(registry),
        Command::Show(show) => show.execute(registry),
        Command::Diff(diff) => diff.execute(registry),
        Command::Rm(remove) => remove.execute(registry),
        Command::Gc(gc) => gc.execute(registry),
        Command::Schema(schema) => schema.execute(registry),
        Command::Render(render) => render.execute(registry),
        Command::Figures(figures) => figures.execute(registry),
        Command::Plot(plot) => plot.execute(registry),
        Command::Report(report) => report.execute(registry),
        Command::Serve(serve) => serve.execute(registry),
        Command::Publish(publish) => publish.execute(registry),
        Command::Export(export) => export.execute(registry),
        Command::Import(import) => import.execute(registry),
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
            Self::Query(_) | Self::Compare(_) | Self::Show(_) => true,
            Self::Ls(list) => list.reads_results(),
            Self::Figures(_) | Self::Plot(_) | Self::Publish(_) | Self::Export(_) => true,
            Self::Verify | Self::Diff(_) | Self::Watch(_) => true,
            Self::Rm(_) | Self::Gc(_) => true,
            // They read the user's files first, and check the folder themselves.
            Self::Claims(_) | Self::Report(_) | Self::Serve(_) => false,
            Self::Completions { .. } => false,
            Self::Run(_) | Self::Collect(_) | Self::Validate(_) | Self::Submit(_) => false,
            Self::Import(_) | Self::Judge(_) | Self::Task(_) => false,
            Self::Render(render) => render.reads_results(),
            Self::Experiments(_) | Self::Schema(_) | Self::World(_) | Self::Doctor => false,
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

/// The reason why a command does not do what its arguments ask for. The exit code is [`USAGE`].
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct UsageError(String);

/// The error with this message.
fn usage(message: impl Into<String>) -> anyhow::Error {
    UsageError(message.into()).into()
}

/// Whether the error is that a signal cancelled the work.
fn is_cancelled(error: &anyhow::Error) -> bool {
    error.downcast_ref().is_some_and(ExperimentError::is_cancelled)
}

/// Whether the error is in the arguments, the spec or the query, so that the exit code is [`USAGE`].
fn is_usage(error: &anyhow::Error) -> bool {
    error.is::<UsageError>()
        || error.is::<SpecError>()
        || error.is::<ClaimsError>()
        || error.is::<AnalysisError>()
        || matches!(error.downcast_ref(), Some(ReportError::Claims(_) | ReportError::Analysis(_)))
        || matches!(
            error.downcast_ref(),
            Some(
                FigureError::Analysis(_)
                    | FigureError::Ambiguous { .. }
                    | FigureError::TooMany { .. }
                    | FigureError::SeveralMetrics(_)
                    | FigureError::NoDifferences(_)
            )
        )
        || matches!(error.downcast_ref(), Some(RolloutError::Asked(_)))
        || matches!(
            error.downcast_ref(),
            Some(
                QueryError::Sql(_)
                    | QueryError::Refused(_)
                    | QueryError::Format(_)
                    | QueryError::Bytes { .. }
            )
        )
        || matches!(
            error.downcast_ref().or(match error.downcast_ref() {
                Some(ExperimentError::Simulation(error)) => Some(error),
                _ => None,
            }),
            Some(
                SimulationError::Argument(_)
                    | SimulationError::World(_)
                    | SimulationError::Spec { .. }
                    | SimulationError::Compile { .. }
                    | SimulationError::Unsuitable { .. }
            )
        )
        || matches!(
            error.downcast_ref(),
            Some(
                ExperimentError::Simulator(_)
                    | ExperimentError::Unsuitable { .. }
                    | ExperimentError::Dataset(DatasetError::Unsuitable(_))
                    | ExperimentError::Learning(LearningError::Device { .. })
                    | ExperimentError::Submission(SubmissionError::Refused(_))
            )
        )
        || matches!(error.downcast_ref(), Some(ModelError::NoReconstruction { .. }))
        || matches!(error.downcast_ref(), Some(ModelError::Registry(error)) if is_wrong_name(error))
        || error.downcast_ref().is_some_and(is_wrong_name)
}

/// Whether the arguments name a run or a results folder that does not exist, or several runs.
fn is_wrong_name(error: &RegistryError) -> bool {
    matches!(error, RegistryError::Unknown(_) | RegistryError::NoResults { .. })
}
