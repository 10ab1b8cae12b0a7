//! `harness run`, `harness collect` and `harness validate`.

use super::progress::Bars;
use super::results::{self, Best, Comparison, Metrics};
use super::sheet::Style;
use super::table::{print_beside, print_command, print_text, shown, width};
use super::{DONE, FAILED, interrupt, layers, output, search};
use anyhow::{Result, bail};
use clap::Args;
use harness::analysis::{self, Setting};
use harness::collection::{check_missing, collect, collect_share, dataset_of};
use harness::dataset::{AnyDataset, Dataset};
use harness::experiment::{Planned, Runner, Summary, best, check_in_worlds, describe, provenance};
use harness::numbers::{counted, rounded};
use harness::progress::Silent;
use harness::registry::{Decision, Registry, RunRecord, Status, quoted};
use harness::samples::FramePlace;
use harness::shard::Shard;
use harness::simulation::Scene;
use harness::spec::{self, Experiment, Explained, Sourced, Trained};
use std::collections::{BTreeSet, HashMap};
use std::path::PathBuf;
use std::process::ExitCode;

/// A spec and the settings to change in it.
#[derive(Args)]
pub struct Spec {
    /// The experiment: a YAML file, or a name. A name stands for NAME.yaml, experiments/NAME.yaml or a built-in
    /// experiment, whichever exists first. `harness experiments` lists the built-in ones
    #[arg(value_name = "SPEC")]
    pub(super) path: PathBuf,
    /// Settings to change, for example training.epochs=5 'latent=[8,16]' seeds=7. A list with one value can be written
    /// as the value. If the spec varies the setting, only the values given here are used
    #[arg(value_name = "KEY=VALUE")]
    pub(super) overrides: Vec<String>,
    /// Use the spec's `quick` settings, for minutes instead of hours. KEY=VALUE can change them again. The experiment's
    /// name then ends in -quick. A spec without these settings is refused
    #[arg(long)]
    pub(super) quick: bool,
}

impl Spec {
    pub fn load(&self) -> Result<Experiment> {
        Ok(spec::load(&self.path, &self.overrides, self.quick)?)
    }

    /// Loads the spec to collect its data or to judge other models, so it need not have a network.
    pub fn load_task(&self) -> Result<Experiment> {
        Ok(spec::load_task(&self.path, &self.overrides, self.quick)?)
    }

    /// The arguments that say the same again.
    pub fn words(&self) -> Vec<String> {
        let path = self.path.to_string_lossy().into_owned();
        let quick = self.quick.then(|| "--quick".to_owned());
        std::iter::once(path).chain(self.overrides.iter().cloned()).chain(quick).collect()
    }
}

#[derive(Args)]
pub struct Run {
    #[command(flatten)]
    spec: Spec,
    /// Do nothing, but print whether each run would be done, why, where its settings come from, and the layers of the
    /// networks. --dry-run=all also prints the settings that have their default
    #[arg(long, value_name = "WHAT", num_args = 0..=1, require_equals = true, default_missing_value = "short")]
    dry_run: Option<Detail>,
    /// Number of runs of a dataset to train at the same time, each with its share of the threads. This is faster for
    /// small networks, and gives the same results
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: u16,
    /// Keep a dataset's images in memory if they take at most GB gigabytes, and otherwise in a temporary file next to
    /// the dataset, which is hardly slower. The images of 40,000 samples take 0.5 GB [default: an eighth of the free
    /// memory]
    #[arg(long, value_name = "GB", value_parser = gigabytes)]
    memory: Option<u64>,
    /// Do only the runs with this setting, for example variant=role=oracle; may be given several times. Several values
    /// of one setting are alternatives
    #[arg(long = "where", value_name = "KEY=VALUE")]
    settings: Vec<Setting>,
    #[command(flatten)]
    share: Share,
    /// Skip runs that other processes work on, instead of waiting for them
    #[arg(long)]
    no_wait: bool,
    /// Stop after the first run that fails
    #[arg(long)]
    fail_fast: bool,
}

/// Which settings a dry run prints.
#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Detail {
    /// Those without their default
    Short,
    /// All of them
    All,
}

/// What this process does of the work.
#[derive(Args)]
pub struct Share {
    /// Do only the I-th of N shares of the work, for example 1/4. N processes with different I do all of it, also on
    /// several machines that share the results folder
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
}

/// Parses a number of gigabytes, and returns bytes.
fn gigabytes(text: &str) -> Result<u64, String> {
    let number: Option<f64> = text.parse().ok().filter(|number| (0.0..=1e9).contains(number));
    number
        .map(|number| (number * 1e9) as u64)
        .ok_or("it must be a number of gigabytes, such as 8 or 0.5".into())
}

impl Run {
    /// Does the runs of the experiment, or prints the plan.
    pub fn execute(self, registry: &Registry, threads: usize) -> Result<ExitCode> {
        let experiment = self.spec.load()?;
        let provenance = provenance(threads, super::command_line());
        let bars = Bars::default();
        let runner = Runner {
            jobs: self.jobs.into(),
            shard: self.share.shard,
            waits: !self.no_wait,
            fails_fast: self.fail_fast,
            memory: self.memory,
            ..Runner::new(registry, threads, &provenance, &bars)
        };
        let plan = self.chosen(&experiment, runner.plan(&experiment)?)?;
        let is_own = |index: usize| self.share.shard.is_none_or(|shard| shard.contains(index));
        let own =
            |plan: &[Planned]| -> Vec<usize> { (0..plan.len()).filter(|index| is_own(*index)).collect() };
        if let Some(detail) = self.dry_run {
            let plan: Vec<&Planned> = own(&plan).into_iter().map(|index| &plan[index]).collect();
            print_plan(&plan);
            print_datasets(&plan);
            search::print_rungs(&experiment);
            self.print_settings(&experiment, &plan, detail)?;
            print_networks(&plan)?;
            return Ok(ExitCode::from(DONE));
        }
        registry.check_writable()?;
        interrupt::install()?;
        let (summary, plan) = runner.run(&experiment, plan)?;
        let trials = best(&experiment, &plan);
        let is_shown = |planned: &&Planned| match experiment.search {
            Some(_) => trials.iter().any(|best| best.is_of(&planned.spec)),
            None => true,
        };
        let shown: Vec<&Planned> =
            own(&plan).into_iter().map(|index| &plan[index]).filter(is_shown).collect();
        let mut best = search::best_trials(&experiment, &trials);
        match print_results(registry, &experiment, &shown) {
            Ok(lines) => best.extend(lines),
            Err(error) => eprintln!("warning: the results can't be shown: {error}"),
        }
        print_summary(registry, &experiment, &summary, best);
        search::print_commands(registry, &experiment, &trials, &self.spec.words());
        warn_of_loss();
        Ok(ExitCode::from(if summary.failed.is_empty() { DONE } else { FAILED }))
    }

    /// Prints the settings that all runs of a plan share, and then those in which its variants differ, each with its
    /// origin. The plan itself lists the settings of trials.
    fn print_settings(&self, experiment: &Experiment, plan: &[&Planned], detail: Detail) -> Result<()> {
        let variants: BTreeSet<&str> = plan.iter().map(|planned| planned.spec.variant.as_str()).collect();
        let Spec { path, overrides, quick } = &self.spec;
        let mut explained = spec::explain(path, overrides, *quick)?;
        explained.retain(|one| variants.contains(one.variant.as_str()));
        let Some(first) = explained.first() else { return Ok(()) };
        let is_shown = |one: &Sourced| detail == Detail::All || one.source.is_some();
        let mut counts: HashMap<&Sourced, usize> = HashMap::new();
        explained.iter().flat_map(|one| &one.settings).for_each(|one| *counts.entry(one).or_default() += 1);
        let is_shared = |one: &Sourced| counts[one] == explained.len();
        let print = |title: &str, settings: Vec<&Sourced>| {
            println!("\n{title}:");
            print_beside(settings.into_iter().map(|one| {
                let source = one.source.as_deref().unwrap_or("default");
                (format!("  {} = {}", one.key, one.value), source.to_owned())
            }));
        };
        let shared = first.settings.iter().filter(|one| is_shown(one) && is_shared(one));
        print("the settings of all runs", shared.collect());
        for Explained { variant, settings } in explained.iter().filter(|_| experiment.search.is_none()) {
            let own: Vec<&Sourced> = settings.iter().filter(|one| is_shown(one) && !is_shared(one)).collect();
            if !own.is_empty() {
                print(&format!("the settings of {variant}"), own);
            }
        }
        Ok(())
    }

    /// Leaves out of a plan the runs that do not have the settings of `--where`.
    fn chosen(&self, experiment: &Experiment, plan: Vec<Planned>) -> Result<Vec<Planned>> {
        if self.settings.is_empty() {
            return Ok(plan);
        }
        if experiment.search.is_some() {
            bail!("--where can't choose trials of a search, which are compared with each other; use --shard");
        }
        let runs: Vec<_> = plan.iter().map(|planned| (&planned.spec, &**planned.layout())).collect();
        let chosen = analysis::planned(&experiment.name, &runs, &self.settings)?;
        let plan: Vec<Planned> = plan
            .into_iter()
            .zip(chosen)
            .filter_map(|(planned, is_chosen)| is_chosen.then_some(planned))
            .collect();
        if plan.is_empty() {
            bail!("no run has all of these settings; --dry-run without --where lists the runs");
        }
        Ok(plan)
    }
}

/// The number of samples of a dataset, of which other shares may not have collected all.
fn there(dataset: &Dataset) -> String {
    let there = dataset.files() * dataset.spec().samples_per_episode();
    match dataset.samples() {
        all if there < all => format!("{there} of {} so far", counted(all, "sample")),
        all => format!("{} in all", counted(all, "sample")),
    }
}

#[derive(Args)]
pub struct Collect {
    #[command(flatten)]
    spec: Spec,
    #[command(flatten)]
    share: Share,
}

impl Collect {
    /// Collects the missing episodes of all scenarios.
    pub fn execute(self, registry: &Registry, threads: usize) -> Result<ExitCode> {
        let experiment = self.spec.load_task()?;
        registry.check_writable()?;
        interrupt::install()?;
        let (mut failed, bars) = (false, Bars::default());
        for origin in experiment.scenarios.iter().filter(|origin| experiment.world(origin).is_none()) {
            println!("{origin}: imported, so nothing is collected");
        }
        // The episodes of all datasets are divided, one dataset after the other.
        let mut first = 0;
        for (world, simulation) in experiment.simulated() {
            let scene = Scene::new(world)?;
            scene.check(&simulation)?;
            let dataset = dataset_of(&registry.datasets(), &scene, &simulation);
            check_missing([&dataset])?;
            let own = first..first + simulation.episodes as usize;
            first = own.end;
            let made = match self.share.shard {
                Some(shard) => collect_share(&dataset, &scene, shard, own.start, threads, &bars),
                None => collect(&dataset, &scene, threads, &bars),
            };
            match made {
                Ok(episodes) => {
                    print_text(&format!(
                        "{}: {} made, {}",
                        shown(dataset.folder()),
                        counted(episodes, "episode"),
                        there(&dataset),
                    ));
                    if episodes > 0 && !simulation.test && dataset.missing().is_empty() {
                        constant_outputs(&experiment, &dataset)?.iter().for_each(|note| eprintln!("{note}"));
                    }
                }
                Err(error) if error.is_cancelled() => return Err(error.into()),
                Err(error) => {
                    eprintln!("{} failed: {}", dataset.name(), describe(&error));
                    failed = true;
                }
            }
        }
        warn_of_loss();
        Ok(ExitCode::from(if failed { FAILED } else { DONE }))
    }
}

/// Sentences about the outputs of an experiment that are the same in all samples of a part of its dataset.
fn constant_outputs(experiment: &Experiment, dataset: &Dataset) -> Result<Vec<String>> {
    let samples = AnyDataset::from(dataset.clone()).load(FramePlace::Nowhere, &Silent)?;
    let partition = samples.partition(&experiment.split, &experiment.window);
    let of_partition =
        |partition| samples.constant_outputs(&experiment.output, &partition, &experiment.window);
    Ok(partition.map(of_partition).unwrap_or_default())
}

/// Warns if the output could not be printed. The exit code does not change, because the work was done.
fn warn_of_loss() {
    if let Some(lost) = output::lost() {
        eprintln!("warning: {lost}");
    }
}

fn print_plan(plan: &[&Planned]) {
    print_beside(plan.iter().map(|planned| {
        let (verb, reason) = match &planned.decision {
            Decision::Run { reason } => ("run", reason.as_str()),
            Decision::Resume { reason } => ("resume", reason.as_str()),
            Decision::Running { holder } => ("running", holder.as_str()),
            Decision::Skip => ("skip", "it is done"),
            Decision::Diverged { reason } => ("failed", reason.as_str()),
        };
        let trial = search::described(&planned.spec);
        (format!("{verb:<7} {:<36}", planned.folder.id()).trim_end().to_owned(), format!("{trial}{reason}"))
    }));
}

/// Prints the datasets of a plan whose tests have datasets of their own.
fn print_datasets(plan: &[&Planned]) {
    let mut lines = BTreeSet::new();
    for planned in plan {
        let Some((dataset, test)) = planned.datasets_with_test() else { continue };
        lines.extend([("training and validation", dataset), ("test", test)].map(|(what, dataset)| {
            let made =
                format!("{} of {}", dataset.files(), counted(dataset.spec().episodes as usize, "episode"));
            (dataset.name().to_owned(), format!("for {what}, {made} made"))
        }));
    }
    if !lines.is_empty() {
        print_text("\nthe datasets:");
        print_beside(lines.into_iter().map(|(name, what)| (format!("  {name}"), what)));
    }
}

/// Prints the layers of each network that the plan's runs train. Equal networks are printed once.
fn print_networks(plan: &[&Planned]) -> Result<()> {
    let mut networks: Vec<(String, Vec<&str>)> = Vec::new();
    for planned in plan {
        let (layers, run) = (layers::table(&planned.spec, planned.layout())?, planned.folder.id());
        match networks.iter_mut().find(|(others, _)| *others == layers) {
            Some((_, runs)) => runs.push(run),
            None => networks.push((layers, vec![run])),
        }
    }
    for (layers, runs) in networks {
        let others = if runs.len() > 1 { format!(" and {} more", runs.len() - 1) } else { String::new() };
        print_text(&format!("\nthe network of {}{others}:", runs[0]));
        println!("{layers}");
    }
    Ok(())
}

/// Prints the metrics of these runs. Returns lines about the best of them. A search names its best trials itself.
fn print_results(
    registry: &Registry,
    experiment: &Experiment,
    plan: &[&Planned],
) -> Result<Vec<(String, String)>> {
    let ids = |runs: &[&Planned]| -> BTreeSet<String> {
        runs.iter().map(|planned| planned.folder.id().to_owned()).collect()
    };
    let is_done = |record: &RunRecord, ids: &BTreeSet<String>| {
        record.experiment == experiment.name && record.status == Status::Done && ids.contains(&record.run)
    };
    let all = ids(plan);
    let sheet = results::sheet(registry, Metrics::Main, |record| is_done(record, &all))?;
    if !sheet.rows.is_empty() {
        println!("{}", sheet.render(Style::Text, width()));
    }
    let mut lines = Vec::new();
    if experiment.search.is_some() {
        // With several seeds, several runs are the best trial.
        if let [run] = plan {
            lines.extend(baselines(registry, experiment, run.folder.id())?);
        }
        return Ok(lines);
    }
    for runs in comparable(plan) {
        let own = ids(runs);
        let Some(best) = Best::of(registry, |record| is_done(record, &own))? else { continue };
        let scenario = match experiment.scenarios.len() {
            1 => String::new(),
            _ => format!("in {}: ", runs[0].spec.scenario.name()),
        };
        lines.push(("best run".into(), format!("{scenario}{} ({})", best.run, error_words(best.error))));
        lines.extend(baselines(registry, experiment, &best.run)?);
    }
    Ok(lines)
}

/// The error of a run on the validation samples, in words. It is in units of the outputs' variance in training.
fn error_words(error: f64) -> String {
    /// From this error on, its digits say nothing.
    const HUGE: f64 = 1000.0;
    if error < HUGE {
        return format!("validation error {}", rounded(error));
    }
    "an output varies far more in the validation samples than in the training samples".to_owned()
}

/// The runs of each scenario. A scenario is left out if its runs were validated on different samples, outputs or
/// losses, because their validation errors can't be compared.
fn comparable<'p, 'a>(plan: &'p [&'a Planned]) -> impl Iterator<Item = &'p [&'a Planned]> {
    let measured = |planned: &'a Planned| {
        let spec = &planned.spec;
        let losses = spec
            .trained()
            .map(|Trained { training, .. }| (&training.losses, &training.distributions, &training.predict));
        (&spec.simulation, &spec.split, &spec.output, &spec.scaling, losses)
    };
    let scenarios = plan.chunk_by(|a, b| a.spec.scenario == b.spec.scenario);
    scenarios.filter(move |runs| runs.iter().all(|run| measured(run) == measured(runs[0])))
}

/// A line about the baselines that a run beats, if it is compared with any.
fn baselines(registry: &Registry, experiment: &Experiment, run: &str) -> Result<Option<(String, String)>> {
    let is_run = |record: &RunRecord| record.experiment == experiment.name && record.run == run;
    let all = Comparison::all(registry, is_run)?;
    let beaten: Vec<String> = all.iter().map(Comparison::to_string).collect();
    let line = || {
        let by = Comparison::metrics(&all);
        ("baselines".into(), format!("beats {} outputs by {by}", beaten.join(", ")))
    };
    Ok((!beaten.is_empty()).then(line))
}

/// Prints what was done, the best runs, where the results are, and what to do next.
fn print_summary(
    registry: &Registry,
    experiment: &Experiment,
    summary: &Summary,
    best: Vec<(String, String)>,
) {
    let Summary { done, continued, diverged, skipped, failed, held, left, awaited } = summary;
    let failed = failed.len();
    print_text(&format!("{done} done, {skipped} done before, {failed} failed"));
    if *continued > 0 {
        print_text(&format!("{continued} continued after a comparison of trials"));
    }
    if *diverged > 0 {
        print_text(&format!(
            "{diverged} diverged: their loss was no longer finite, so they are the worst trials"
        ));
    }
    if *awaited > 0 {
        print_text(&format!(
            "{awaited} are left to other shares; when they are done, the same command continues the best trials"
        ));
    }
    if *held > 0 {
        print_text(&format!("{held} left to the processes that work on them"));
    }
    if *left > 0 {
        print_text(&format!("{left} not tried, because of --fail-fast; the same command continues"));
    }
    let name = quoted([&*experiment.name]);
    let next = match (failed, done + skipped) {
        (0, 1..) if experiment.search.is_some() => format!("compare {name} --by variant"),
        (0, 1..) => format!("compare {name}"),
        _ => format!("ls {name}"),
    };
    print_beside(best.into_iter().map(|(heading, text)| (format!("{heading:<9}"), text)));
    println!("results    {}", shown(&registry.root().join("runs").join(&experiment.name)));
    print_command("next       ", &registry.command(&next));
}

#[derive(Args)]
pub struct Validate {
    #[command(flatten)]
    spec: Spec,
}

impl Validate {
    /// Checks the spec, and prints its runs.
    pub fn execute(self) -> Result<ExitCode> {
        let experiment = self.spec.load()?;
        check_in_worlds(&experiment)?;
        let runs = experiment.runs();
        println!("{} is valid: {}", self.spec.path.display(), counted(runs.len(), "run"));
        for run in runs {
            println!("  {}", run.label());
        }
        if let Some(repetitions) = experiment.repetitions() {
            print_text(&repetitions);
        }
        Ok(ExitCode::from(DONE))
    }
}
