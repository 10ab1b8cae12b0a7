//! Finds the commands that make a run or dataset again.

use super::command_line::{command_in, command_of};
use super::folders::Recorded;
use super::record::{RunRecord, SimulatedFor};
use super::{Registry, SPEC};
use harness_shared::files::folders;
use harness_shared::{path_word, quoted};
use harness_spec::{self as spec, RunSpec};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::rc::Rc;

/// Finds the commands that make runs and datasets again. Each command is checked before it is suggested: its spec is
/// read, relative to the current folder, and must expand to the run in question.
pub(super) struct Commands<'a> {
    registry: &'a Registry,
    recorded: &'a [Recorded],
    /// The runs that each command makes, for the commands checked so far.
    made: RefCell<BTreeMap<String, Rc<Made>>>,
    /// Why each dataset can't be collected again; `None` if nothing is known against it.
    lost: RefCell<BTreeMap<String, Option<String>>>,
}

/// How a run or dataset can be made again.
pub(super) enum Again {
    /// This command makes it.
    Command(String),
    /// A recorded command may make it, but its spec can't be used here. The field says why, and what to do.
    Elsewhere(String),
    /// The recorded command makes other runs now. The field says why, and what to do.
    Changed(String),
    /// No command is known.
    Unknown,
}

impl Again {
    /// The command that makes it.
    pub fn command(&self) -> Option<String> {
        match self {
            Self::Command(command) => Some(command.clone()),
            _ => None,
        }
    }

    /// A problem, followed by why the recorded command can't repair it.
    pub fn explain(&self, problem: String) -> String {
        match self {
            Self::Elsewhere(reason) | Self::Changed(reason) => format!("{problem}; {reason}"),
            Self::Command(_) | Self::Unknown => problem,
        }
    }
}

/// The runs that a command makes: their experiment, and the hashes of their specs with the paths of their world files.
/// An error if its spec can't be used.
type Made = Result<(String, BTreeSet<(String, Option<PathBuf>)>), String>;

impl<'a> Commands<'a> {
    /// Searches the commands of all recorded runs.
    pub fn new(registry: &'a Registry, recorded: &'a [Recorded]) -> Self {
        Self { registry, recorded, made: RefCell::default(), lost: RefCell::default() }
    }

    /// How the run of a folder can be made again. Without a record, the command is found by the spec in the folder and
    /// the commands of other runs of the experiment.
    pub fn run(&self, folder: &Path, record: Option<&RunRecord>) -> Again {
        let experiment = folder.parent().and_then(Path::file_name).and_then(OsStr::to_str);
        let spec = record.map(|record| record.spec.clone()).or_else(|| read_spec(folder));
        let (Some(experiment), Some(spec)) = (experiment, spec) else { return Again::Unknown };
        // The predictions of an external model come from another program.
        if spec.trained().is_none() {
            return Again::Unknown;
        }
        let datasets = self.datasets();
        let tests: Vec<Option<&str>> = match spec.other_world() {
            Some(_) => datasets.iter().map(|test| Some(test.as_str())).collect(),
            None => vec![None],
        };
        let is_of = |dataset: &str, test: Option<&str>| {
            self.registry.run_with_test(experiment, &spec, dataset, test).path() == folder
        };
        let is_own = |dataset: &&String| tests.iter().any(|test| is_of(dataset, *test));
        let Some(dataset) = datasets.iter().find(is_own) else { return Again::Unknown };
        // Without a record, the world is that of another run on the dataset.
        let same = || self.recorded.iter().map(|(_, other)| other).find(|other| other.dataset == *dataset);
        let like = record.or_else(same);
        let world = like.and_then(|record| record.provenance.world_file.as_deref());
        let is_other = |other: &&RunRecord| other.experiment == experiment && other.spec.trained().is_some();
        let others = self.recorded.iter().map(|(_, other)| other).filter(is_other);
        let own = record.map(|record| command_of(&record.provenance.command, &spec));
        let others: BTreeSet<String> =
            others.map(|other| command_of(&other.provenance.command, &spec)).collect();
        let mut best = Again::Unknown;
        for command in own.iter().chain(&others) {
            let found = self.again("run", command, experiment, &spec, world);
            match found {
                Again::Command(_) => return self.on_dataset(found, like),
                // The commands of other runs may never have made this one.
                Again::Changed(_) if own.as_ref() != Some(command) => {}
                _ if matches!(best, Again::Unknown) => best = found,
                _ => {}
            }
        }
        best
    }

    /// How a run's dataset can be collected again.
    pub fn collect(&self, record: &RunRecord) -> Again {
        if record.spec.trained().is_none() {
            return Again::Unknown;
        }
        let by = &record.provenance;
        let world = by.world_file.as_deref();
        let again = self.again("collect", &by.command, &record.experiment, &record.spec, world);
        self.on_dataset(again, Some(record))
    }

    /// `again`, unless the dataset of a run can't be had any more.
    fn on_dataset(&self, again: Again, record: Option<&RunRecord>) -> Again {
        let Some(record) = record else { return again };
        let lost = self.lost.borrow().get(&record.dataset).cloned();
        let lost = lost.unwrap_or_else(|| {
            let lost = self.loss(record);
            self.lost.borrow_mut().insert(record.dataset.clone(), lost.clone());
            lost
        });
        lost.map_or(again, Again::Changed)
    }

    /// Why the dataset of a run can't be had any more, and what to do. `None` if nothing is known against it.
    fn loss(&self, record: &RunRecord) -> Option<String> {
        if record.spec.simulation.is_none() {
            let mut datasets = record.datasets();
            let is_gone = datasets.any(|(name, _)| !self.registry.datasets().join(name).exists());
            let reason = "the dataset was imported, and is not there; import it again with the same mapping";
            return is_gone.then(|| reason.to_owned());
        }
        let has_changed = |of: &SimulatedFor| {
            let now = self.registry.datasets_now?(&of.world, &[&of.simulation])?;
            Some(!now.iter().any(|now| now == of.dataset))
        };
        record.simulated().find(|of| has_changed(of) == Some(true)).map(|SimulatedFor { scenario, dataset, .. }| {
            format!(
                "the world {scenario} or MuJoCo has changed since, so it can't be made again; undo the change and \
                 verify again, or remove the runs on the dataset {dataset}"
            )
        })
    }

    /// The names of all datasets that exist or that a run used.
    fn datasets(&self) -> BTreeSet<String> {
        let used = self.recorded.iter().flat_map(|(_, record)| record.datasets());
        let used = used.map(|(name, _)| name.to_owned());
        let there = folders(&self.registry.datasets());
        let there = there.iter().filter_map(|folder| Some(folder.file_name()?.to_str()?.to_owned()));
        used.chain(there).collect()
    }

    /// `command` with the subcommand `verb` (`run` or `collect`), if it makes the run of `spec`, in the world of the
    /// file `world` if the file is known.
    fn again(
        &self,
        verb: &str,
        command: &str,
        experiment: &str,
        spec: &RunSpec,
        world: Option<&Path>,
    ) -> Again {
        let Some(asked) = Asked::of(command) else { return Again::Unknown };
        let made = self.made.borrow().get(command).cloned();
        let made = made.unwrap_or_else(|| {
            let made = Rc::new(asked.made());
            self.made.borrow_mut().insert(command.to_owned(), made.clone());
            made
        });
        let words = format!("{verb} {}", asked.words());
        let hash = spec.hash();
        let is_it = |(own, of): &(String, Option<PathBuf>)| {
            *own == hash && (world.is_none() || of.as_deref() == world)
        };
        match &*made {
            Ok((name, runs)) if name == experiment && runs.iter().any(is_it) => {
                Again::Command(self.registry.command(&words))
            }
            Ok(_) => Again::Changed(format!(
                "`{}` made it, but {} or the harness has changed since, so it makes other runs now; undo the change \
                 and verify again, or remove the folder",
                self.registry.command(&words),
                asked.spec.display()
            )),
            Err(error) => {
                // The command is for another folder than the current one.
                let root = std::path::absolute(self.registry.root());
                let root = root.unwrap_or_else(|_| self.registry.root().to_owned());
                Again::Elsewhere(format!(
                    "to repair it, run `{}` where it was run before; it fails here: {error}",
                    command_in(&root, &words)
                ))
            }
        }
    }
}

/// The resolved spec in a run's folder, or `None` if it can't be read.
fn read_spec(folder: &Path) -> Option<RunSpec> {
    serde_yaml::from_str(&spec::read_text(&folder.join(SPEC)).ok()?).ok()
}

/// The words of a command that determine which runs it makes.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Asked {
    /// The spec, by its path or its name.
    pub spec: PathBuf,
    /// Settings that differ from the spec's, as `KEY=VALUE`.
    pub overrides: Vec<String>,
    /// Whether it makes quick runs.
    pub quick: bool,
}

impl Asked {
    /// Parses a command of the harness. Returns `None` if it names no spec.
    pub fn of(command: &str) -> Option<Self> {
        let mut asked = Self::default();
        let mut words = shlex::split(command)?.into_iter().skip(1);
        while let Some(word) = words.next() {
            match word.as_str() {
                "run" | "collect" => {}
                "--quick" => asked.quick = true,
                "--results" | "--threads" | "--jobs" | "--where" => drop(words.next()),
                option if option.starts_with('-') => {}
                path if asked.spec.as_os_str().is_empty() => asked.spec = path.into(),
                _ => asked.overrides.push(word),
            }
        }
        (!asked.spec.as_os_str().is_empty()).then_some(asked)
    }

    /// The words for a shell.
    pub fn words(&self) -> String {
        let quick = self.quick.then_some("--quick");
        let others = quoted(self.overrides.iter().map(String::as_str).chain(quick));
        format!("{} {others}", path_word(&self.spec)).trim_end().to_owned()
    }

    fn made(&self) -> Made {
        let load = spec::load(&self.spec, &self.overrides, self.quick);
        let experiment = load.map_err(|error| error.to_string())?;
        let runs = experiment.runs();
        let of = |run: RunSpec| (run.hash(), experiment.world(&run.scenario).and_then(|world| world.path()));
        let made = runs.iter().flat_map(|run| experiment.rungs(run)).map(of).collect();
        Ok((experiment.name, made))
    }
}
