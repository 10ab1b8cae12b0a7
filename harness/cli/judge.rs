//! `harness judge` and `harness task`: models of other programs.

use super::progress::Bars;
use super::results::{self, Metrics};
use super::run::Spec;
use super::sheet::Style;
use super::table::{print_beside, print_command, print_text, width};
use super::{DONE, interrupt, usage};
use anyhow::{Result, bail};
use clap::Args;
use harness::experiment::{
    ExperimentError, External, JudgedRun, OpenTask, PredictionTask, Predictions, Replay, Runner, describe,
    provenance,
};
use harness::numbers::counted;
use harness::registry::{Registry, RunRecord, quoted};
use harness::simulation::{Knowledge, PositionError, Scene};
use harness::spec::{Definition, Experiment, IMAGE_CHANNELS, Modality, World};
use harness::tables::{PREDICTED_COLUMNS, read_predicted};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

/// What stands for the predictions of the simulator itself, and the usual name of that model.
const SIMULATOR: &str = "simulator";

/// The task to judge, of those of an experiment.
#[derive(Args)]
pub struct Choice {
    /// The task, if the experiment has several: a scenario, or a name that `harness task` lists
    #[arg(long, value_name = "NAME")]
    cell: Option<String>,
}

impl Choice {
    /// The chosen task of an experiment.
    fn of(&self, experiment: &Experiment, tasks: Vec<PredictionTask>) -> Result<PredictionTask> {
        PredictionTask::choose(tasks, self.cell.as_deref()).map_err(|names| {
            let (experiment, listed) = (&experiment.name, names.join(", "));
            usage(match &self.cell {
                Some(wanted) if !names.iter().any(|name| name.starts_with(&format!("{wanted}-"))) => {
                    format!("{experiment} has no task '{wanted}'; it has {listed}")
                }
                _ => format!("{experiment} has several tasks; choose one with --cell: {listed}"),
            })
        })
    }
}

#[derive(Args)]
pub struct Judge {
    /// The experiment that asks for the predictions: a YAML file, or a name, as for `harness run`
    #[arg(value_name = "SPEC")]
    path: PathBuf,
    /// The file of predictions: Parquet, or CSV if its name ends in .csv. `harness task` lists its columns. The word
    /// `simulator` stands for what the simulator itself predicts from the state at each sample, rounded to f32, or as
    /// far as --error, --without and --at-rest say that it is known; or with --world, from the setpoints alone
    #[arg(value_name = "PREDICTIONS")]
    predictions: PathBuf,
    /// Settings to change, as for `harness run`
    #[arg(value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Use the spec's `quick` settings, as for `harness run`
    #[arg(long)]
    quick: bool,
    /// Name of the model in tables: letters, digits, '_', '-' and '.' [default for the simulator: simulator, and what
    /// it does not know]
    #[arg(long, value_name = "NAME")]
    model: Option<String>,
    #[command(flatten)]
    known: Known,
    /// Seed of the model's training
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    #[command(flatten)]
    choice: Choice,
    /// The hash of the task that the predictions are for. They are refused if the task has another
    #[arg(long, value_name = "HASH")]
    task: Option<String>,
    /// What to record about the model, for example commit=ab12cd3; may be given several times
    #[arg(long = "note", value_name = "NAME=TEXT", value_parser = note)]
    notes: Vec<(String, String)>,
    /// The file of the model, which is copied to the run: .onnx, .pt (TorchScript) or .pt2 (torch.export)
    #[arg(long, value_name = "FILE")]
    network: Option<PathBuf>,
}

/// How well the simulator knows the state at each sample.
#[derive(Args)]
struct Known {
    /// For `simulator`: an error of the positions of a modality, joints or bodies, with its standard deviation in deg,
    /// rad, mm, cm or m; may be given several times
    #[arg(long = "error", value_name = "NAME=SIZE", value_parser = str::parse::<PositionError>)]
    errors: Vec<PositionError>,
    /// For `simulator`: freely moving bodies that it knows nothing of, by name or pattern; may be given several times
    #[arg(long, value_name = "BODY")]
    without: Vec<String>,
    /// For `simulator`: it starts with all velocities at 0
    #[arg(long)]
    at_rest: bool,
    /// For `simulator`: the world, by name or file, whose actuators repeat the setpoints of each episode from its start.
    /// Nothing else of the dataset is used. It says how well a world matches the robot that was recorded
    #[arg(long, value_name = "WORLD", conflicts_with_all = ["errors", "without", "at_rest", "restarts"])]
    world: Option<String>,
    /// For --world: the value of a factor of variation of the world file; may be given several times
    #[arg(long = "factor", value_name = "NAME=VALUE", value_parser = factor, requires = "world")]
    factors: Vec<(String, f64)>,
    /// For `simulator`: number of simulations from each sample, each with other errors. The prediction is their mean
    /// [default: 16 with --error, else 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1000))]
    restarts: Option<u16>,
}

impl Known {
    /// The first of the options that was given.
    fn given(&self) -> Option<&'static str> {
        let given = [
            ("--error", !self.errors.is_empty()),
            ("--without", !self.without.is_empty()),
            ("--at-rest", self.at_rest),
            ("--restarts", self.restarts.is_some()),
            ("--world", self.world.is_some()),
        ];
        given.into_iter().find(|(_, is_given)| *is_given).map(|(name, _)| name)
    }

    /// The usual name of the simulator that knows this: `simulator-arm-0.5deg`.
    fn name(&self) -> String {
        let errors = self.errors.iter().map(|error| error.text.clone());
        let without = self.without.iter().map(|body| format!("without-{body}"));
        let world = self
            .world
            .iter()
            .map(|world| Path::new(world).file_stem().unwrap_or_default().to_string_lossy().into_owned());
        let factors = self.factors.iter().map(|(name, value)| format!("{name}-{value}"));
        let parts = errors
            .chain(without)
            .chain(self.at_rest.then(|| "at-rest".to_owned()))
            .chain(world)
            .chain(factors);
        let allowed = |c: char| if c == '=' { '-' } else { c };
        let parts = parts.map(|part| {
            part.chars().map(allowed).filter(|c| c.is_ascii_alphanumeric() || "_-.".contains(*c)).collect()
        });
        [SIMULATOR.to_owned()].into_iter().chain(parts).collect::<Vec<String>>().join("-")
    }

    fn predictions(self) -> Result<Predictions> {
        if let Some(world) = &self.world {
            let factors: BTreeMap<String, f64> = self.factors.iter().cloned().collect();
            if factors.len() < self.factors.len() {
                bail!("a factor has one value; name each once with --factor");
            }
            let scene = Scene::new(World::find(world)?).map_err(ExperimentError::from)?;
            return Ok(Predictions::Replayed(Replay { scene: Arc::new(scene), factors }));
        }
        let restarts = self.restarts.map_or(if self.errors.is_empty() { 1 } else { 16 }, usize::from);
        let Self { errors, without, at_rest, .. } = self;
        Ok(Predictions::Simulated(Knowledge { errors, at_rest, without, restarts }))
    }
}

fn factor(text: &str) -> Result<(String, f64), String> {
    let (name, value) = text.split_once('=').ok_or("write NAME=VALUE, such as stiffness=1.5")?;
    let value = value.trim().parse().map_err(|_| format!("'{value}' is no number"))?;
    Ok((name.trim().to_owned(), value))
}

fn note(text: &str) -> Result<(String, String), String> {
    let (name, note) = text.split_once('=').ok_or("write NAME=TEXT, such as commit=ab12cd3")?;
    Ok((name.trim().to_owned(), note.to_owned()))
}

impl Judge {
    /// Judges the predictions, writes the run, and prints its metrics.
    pub fn execute(self, registry: &Registry, threads: usize) -> Result<ExitCode> {
        let spec = Spec { path: self.path, overrides: self.overrides, quick: self.quick };
        let is_simulator = self.predictions.to_str() == Some(SIMULATOR);
        if let Some(option) = self.known.given().filter(|_| !is_simulator) {
            return Err(usage(format!(
                "{option} is for the word `simulator` instead of a file of predictions"
            )));
        }
        let model = self.model.or_else(|| is_simulator.then(|| self.known.name()));
        let model =
            model.ok_or_else(|| usage("the model has no name; give it one, for example --model my_gru"))?;
        let experiment = spec.load_task()?;
        let (provenance, bars) = (provenance(threads, super::command_line()), Bars::default());
        let runner = Runner::new(registry, threads, &provenance, &bars);
        let task = self.choice.of(&experiment, runner.tasks(&experiment)?)?;
        if let Some((dataset, missing)) = task.uncollected().next() {
            let command = collect(registry, &spec);
            return Err(usage(format!(
                "the dataset {dataset} lacks {missing} of its episodes, so nothing can be judged yet; `{command}` \
                 simulates them"
            )));
        }
        let predictions = match is_simulator {
            true => self.known.predictions()?,
            false => {
                let nearest = task.spec().window.horizon.min(1);
                Predictions::Rows(
                    read_predicted(&self.predictions, nearest).map_err(|error| usage(describe(&error)))?,
                )
            }
        };
        registry.check_writable()?;
        interrupt::install()?;
        let task = runner.open_task(task)?;
        let (seed, notes) = (self.seed, BTreeMap::from_iter(self.notes));
        let (task_hash, network) = (self.task, self.network);
        let external = External { model, seed, notes, task: task_hash, network, predictions };
        let JudgedRun { record, was_done } = runner.judge(&task, external)?;
        let is_run = |other: &RunRecord| other.name() == record.name();
        println!("{}", results::sheet(registry, Metrics::Main, is_run)?.render(Style::Text, width()));
        let before = if was_done { "; the same predictions were judged before" } else { "" };
        print_text(&format!("{}: done{before}", record.name()));
        print_command("next ", &registry.command(&format!("compare {}", quoted([&*record.experiment]))));
        Ok(ExitCode::from(DONE))
    }
}

/// The command that collects the datasets of a spec.
fn collect(registry: &Registry, spec: &Spec) -> String {
    registry.command(&format!("collect {}", quoted(spec.words().iter().map(String::as_str))))
}

#[derive(Args)]
pub struct Task {
    #[command(flatten)]
    spec: Spec,
    #[command(flatten)]
    choice: Choice,
}

impl Task {
    /// Describes the tasks of the experiment, and prints the results so far.
    pub fn execute(self, registry: &Registry, threads: usize) -> Result<ExitCode> {
        let experiment = self.spec.load_task()?;
        let (provenance, bars) = (provenance(threads, super::command_line()), Bars::default());
        let runner = Runner::new(registry, threads, &provenance, &bars);
        let tasks = runner.tasks(&experiment)?;
        let tasks = match &self.choice.cell {
            Some(_) => vec![self.choice.of(&experiment, tasks)?],
            None => tasks,
        };
        let hashes: Vec<String> = tasks.iter().map(PredictionTask::hash).collect();
        let is_several = self.choice.cell.is_some() || tasks.len() > 1;
        let first = tasks.first().map(PredictionTask::name);
        for (place, task) in tasks.into_iter().enumerate() {
            if place > 0 {
                println!();
            }
            self.describe(registry, &runner, task)?;
        }
        print_text("\nColumns of a file of predictions, one row for each value:");
        print_beside(PREDICTED_COLUMNS.map(|(name, meaning)| (format!("  {name:<9}"), meaning.to_owned())));
        let spec = quoted(self.spec.words().iter().map(String::as_str));
        let cell = first
            .filter(|_| is_several)
            .map(|name| format!(" --cell {}", quoted([&*name])))
            .unwrap_or_default();
        println!();
        print_command(
            "judge with: ",
            &registry.command(&format!("judge {spec} predictions.parquet{cell} --model NAME")),
        );
        print_results(registry, &experiment.name, &hashes)?;
        Ok(ExitCode::from(DONE))
    }

    fn describe(&self, registry: &Registry, runner: &Runner, task: PredictionTask) -> Result<()> {
        let (spec, missing) = (task.spec().clone(), task.missing());
        println!("{}/{}", task.experiment(), task.name());
        let mut lines =
            vec![("task".to_owned(), task.hash()), ("dataset".to_owned(), task.dataset().name().to_owned())];
        if spec.test.is_some() {
            lines.push(("test".to_owned(), task.tested().name().to_owned()));
        }
        let of = |modality: &Modality| task.dataset().layout().get(*modality).map(described);
        let inputs = spec.input.iter().filter_map(of).collect::<Vec<_>>();
        let outputs = spec.output.iter().filter_map(of).collect::<Vec<_>>();
        let horizons = spec.window.horizons();
        let unit = if horizons[..] == [1] { "sample" } else { "samples" };
        let horizons: Vec<String> = horizons.iter().map(usize::to_string).collect();
        lines.push(("inputs".to_owned(), inputs.join(", ")));
        lines.push(("outputs".to_owned(), outputs.join(", ")));
        lines.push(("context".to_owned(), counted(spec.window.context, "sample")));
        lines.push(("horizons".to_owned(), format!("{} {unit} ahead", horizons.join(", "))));
        let split = match &spec.test {
            Some(_) => format!("by {}, {} for validation", spec.split.by, spec.split.validation),
            None => format!(
                "by {}, {} for validation, {} for the test",
                spec.split.by, spec.split.validation, spec.split.test
            ),
        };
        lines.push(("split".to_owned(), split));
        match missing {
            0 => lines.push(("windows".to_owned(), windows(&runner.open_task(task)?))),
            missing => {
                let collect = collect(registry, &self.spec);
                lines.push((
                    "missing".to_owned(),
                    format!("{}; `{collect}` simulates them", counted(missing, "episode")),
                ));
            }
        }
        print_beside(lines.into_iter().map(|(name, text)| (format!("  {name:<9}"), text)));
        Ok(())
    }
}

/// A modality with its shape and unit: `contact_force [20] N`.
fn described(definition: &Definition) -> String {
    let shape = match definition.size() {
        Some([rows, columns]) => format!("[{rows}, {columns}, {IMAGE_CHANNELS}]"),
        None => format!("[{}]", definition.width()),
    };
    let unit = definition.unit().unwrap_or(if definition.is_image() { "1" } else { "several units" });
    format!("{} {shape} {unit}", definition.name)
}

/// The number of windows in each part.
fn windows(task: &OpenTask) -> String {
    let partition = task.windows();
    let parts =
        [("training", &partition.training), ("validation", &partition.validation), ("test", &partition.test)];
    parts.map(|(name, windows)| format!("{} for {name}", windows.len())).join(", ")
}

/// Prints the metrics of the experiment's runs with these tasks, and their baselines.
fn print_results(registry: &Registry, experiment: &str, tasks: &[String]) -> Result<()> {
    let is_own = |record: &RunRecord| record.experiment == experiment && tasks.contains(&record.task_hash());
    let sheet = results::sheet(registry, Metrics::Main, is_own)?;
    if sheet.rows.is_empty() {
        return Ok(());
    }
    print_text("\nResults so far:");
    print!("{}", sheet.render(Style::Text, width()));
    Ok(())
}
