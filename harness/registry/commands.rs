//! Finds the commands that make a run or dataset again.

use super::command_line::{command_of, quoted};
use super::folders::{Recorded, folders};
use super::record::RunRecord;
use super::{Registry, SPEC};
use harness_spec::{self as spec, RunSpec};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::rc::Rc;

/// Finds the commands that make runs and datasets again. Each command is checked before it is suggested: its spec is
/// read, relative to the current folder, and must expand to the run in question.
pub(super) struct Commands<'a> {
    registry: &'a Registry,
    recorded: &'a [Recorded],
    /// The runs that each command makes, for the commands checked so far.
    made: RefCell<BTreeMap<String, Rc<Made>>>,
}

/// The runs that a command makes: their experiment, and the hashes of their specs. Empty if its spec can't be read.
#[derive(Default)]
struct Made {
    experiment: String,
    specs: BTreeSet<String>,
}

impl<'a> Commands<'a> {
    /// Searches the commands of all recorded runs.
    pub fn new(registry: &'a Registry, recorded: &'a [Recorded]) -> Self {
        Self { registry, recorded, made: RefCell::default() }
    }

    /// The command that makes the run of a folder again. Without a record, it is found by the spec in the folder and
    /// the commands of other runs of the experiment.
    pub fn run(&self, folder: &Path, record: Option<&RunRecord>) -> Option<String> {
        let experiment = folder.parent()?.file_name()?.to_str()?;
        let spec = match record {
            Some(record) => record.spec.clone(),
            None => read_spec(folder)?,
        };
        let is_own = |dataset: &str| self.registry.run(experiment, &spec, dataset).path() == folder;
        if !self.datasets().iter().any(|dataset| is_own(dataset)) {
            return None;
        }
        let others =
            self.recorded.iter().map(|(_, other)| other).filter(|other| other.experiment == experiment);
        let commands: BTreeSet<String> = record
            .into_iter()
            .chain(others)
            .map(|record| command_of(&record.provenance.command, &spec))
            .collect();
        commands.iter().find_map(|command| self.again("run", command, experiment, &spec))
    }

    /// The command that collects a run's dataset again.
    pub fn collect(&self, record: &RunRecord) -> Option<String> {
        self.again("collect", &record.provenance.command, &record.experiment, &record.spec)
    }

    /// The names of all datasets that exist or that a run used.
    fn datasets(&self) -> BTreeSet<String> {
        let used = self.recorded.iter().map(|(_, record)| record.dataset.clone());
        let there = folders(&self.registry.datasets());
        let there = there.iter().filter_map(|folder| Some(folder.file_name()?.to_str()?.to_owned()));
        used.chain(there).collect()
    }

    /// `command` with the subcommand `verb` (`run` or `collect`), or `None` if it does not make the run of `spec`.
    fn again(&self, verb: &str, command: &str, experiment: &str, spec: &RunSpec) -> Option<String> {
        let asked = Asked::of(command)?;
        let made = self.made.borrow().get(command).cloned();
        let made = made.unwrap_or_else(|| {
            let made = Rc::new(asked.made());
            self.made.borrow_mut().insert(command.to_owned(), made.clone());
            made
        });
        let makes_it = made.experiment == experiment && made.specs.contains(&spec.hash());
        makes_it.then(|| self.registry.command(&format!("{verb} {}", asked.words())))
    }
}

/// The resolved spec in a run's folder, or `None` if it can't be read.
fn read_spec(folder: &Path) -> Option<RunSpec> {
    serde_yaml::from_str(&spec::read_text(&folder.join(SPEC)).ok()?).ok()
}

/// The words of a command that determine which runs it makes.
#[derive(Default)]
struct Asked {
    spec: PathBuf,
    overrides: Vec<String>,
    quick: bool,
}

impl Asked {
    /// Parses a command of the harness. Returns `None` if it names no spec, or uses `--models`.
    fn of(command: &str) -> Option<Self> {
        let mut asked = Self::default();
        let mut words = shlex::split(command)?.into_iter().skip(1);
        while let Some(word) = words.next() {
            match word.as_str() {
                "run" | "collect" => {}
                "--quick" => asked.quick = true,
                // Earlier versions read other models from a folder; runs with them can't be made again.
                option if option.starts_with("--models") => return None,
                "--results" | "--threads" | "--jobs" => drop(words.next()),
                option if option.starts_with('-') => {}
                setting if setting.contains('=') => asked.overrides.push(word),
                path => asked.spec = path.into(),
            }
        }
        (!asked.spec.as_os_str().is_empty()).then_some(asked)
    }

    fn words(&self) -> String {
        let spec = self.spec.to_string_lossy();
        let quick = self.quick.then_some("--quick");
        quoted([&*spec].into_iter().chain(self.overrides.iter().map(String::as_str)).chain(quick))
    }

    fn made(&self) -> Made {
        match spec::load(&self.spec, &self.overrides, self.quick) {
            Ok(experiment) => {
                let runs = experiment.runs();
                let rungs = runs.iter().flat_map(|run| experiment.rungs(run));
                let specs = rungs.map(|run| run.hash()).collect();
                Made { experiment: experiment.name, specs }
            }
            _ => Made::default(),
        }
    }
}
