//! The removal of runs and datasets.

use crate::dataset::Dataset;
use crate::record::Worlds;
use crate::{Outdated, Registry, RegistryError, RunRecord, Status};
use harness_shared::files::{ANOTHER, FolderLock, UNFINISHED, abandoned, folders, remove_abandoned};
use harness_spec::QUICK;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Why a run or a dataset can be removed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Garbage {
    /// A later run of the same experiment has the same settings and the same world, but another dataset or revision of
    /// the method.
    Superseded,
    /// The run was made in another version of its world than the one that counts.
    World,
    /// The run failed.
    Failed,
    /// A run of `harness run --quick`.
    Quick,
    /// A simulated dataset that no run uses.
    Unused,
    /// What a killed process left in the results folder: a part of an import or of a removed folder.
    Unfinished,
}

impl Garbage {
    /// Every reason.
    pub const ALL: [Self; 6] =
        [Self::Superseded, Self::World, Self::Failed, Self::Quick, Self::Unused, Self::Unfinished];

    /// The reason in one word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Superseded => "superseded",
            Self::World => "world",
            Self::Failed => "failed",
            Self::Quick => "quick",
            Self::Unused => "unused",
            Self::Unfinished => "unfinished",
        }
    }
}

/// A folder, or an unfinished file, that can be removed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Removable {
    /// The folder or file.
    pub path: PathBuf,
    /// `experiment/run`, a dataset's name, or the name of what is unfinished.
    pub name: String,
    /// Size of all its files, bytes.
    pub bytes: u64,
    /// Whether it is a published run that shares files with others.
    pub is_merged: bool,
}

/// Whether a run was made with `--quick`. The name alone does not tell, because a spec may have such a name, too.
fn is_quick(record: &RunRecord) -> bool {
    let words = shlex::split(&record.provenance.command).unwrap_or_default();
    record.experiment.ends_with(QUICK) && words.iter().any(|word| word == "--quick")
}

/// Returns the runs that have one of these reasons and, if asked for, the datasets that no other run uses, and what
/// killed processes left. Each is returned once.
///
/// No dataset counts as unused while runs are left out, because they may use it; see [`Registry::left_out`].
pub fn garbage(registry: &Registry, wanted: &[Garbage]) -> Vec<(Garbage, Removable)> {
    let recorded = registry.recorded();
    let outdated = registry.outdated(&recorded);
    let superseded = superseded(recorded.iter().map(|(_, record)| record), &outdated);
    let mut found = Vec::new();
    let mut used = BTreeSet::new();
    for (folder, record) in &recorded {
        // A run that a process works on can't be removed, and needs its dataset.
        let is_free = |_: &(Garbage, bool)| FolderLock::holder(folder).is_none();
        let reasons = [
            (Garbage::Superseded, superseded.contains(&record.name())),
            (Garbage::World, outdated.has(record)),
            (Garbage::Failed, record.status == Status::Failed),
            (Garbage::Quick, is_quick(record)),
        ];
        let applies = |(reason, applies): &(Garbage, bool)| *applies && wanted.contains(reason);
        match reasons.into_iter().find(applies).filter(is_free) {
            Some((reason, _)) => found.push((reason, Removable::run(folder, record))),
            None => used.extend(record.datasets().map(|(name, _)| name.to_owned())),
        }
    }
    if wanted.contains(&Garbage::Unused) {
        let is_unused = |folder: &PathBuf| Dataset::at(folder).is_ok() && !used.contains(&name(folder));
        for folder in folders(&registry.datasets()).into_iter().filter(is_unused) {
            let name = name(&folder);
            if registry.leaves_out_runs() {
                let why = "a run that is left out may use it, and no other run does";
                registry.leave_out(&folder, format!("the dataset {name} is kept: {why}"));
            } else {
                found.push((Garbage::Unused, Removable::new(&folder, name)));
            }
        }
    }
    if wanted.contains(&Garbage::Unfinished) {
        let left = unfinished(registry).into_iter();
        found.extend(left.map(|path| (Garbage::Unfinished, Removable::new(&path, name(&path)))));
    }
    found
}

/// The unfinished files and folders in the results folder that no process works on. Those in the folders of runs
/// and datasets are removed by the next process that works there.
fn unfinished(registry: &Registry) -> Vec<PathBuf> {
    let is_left =
        |folder: &PathBuf| name(folder).starts_with(UNFINISHED) && FolderLock::in_use(folder).is_none();
    let folders = folders(registry.root()).into_iter().filter(is_left);
    folders.chain(abandoned(registry.root())).collect()
}

/// Removes published runs of one experiment.
fn remove_merged(
    registry: &Registry,
    experiment: &Path,
    runs: &[Removable],
) -> Result<Option<String>, RegistryError> {
    let is_gone = |record: &RunRecord| runs.iter().any(|run| run.path == registry.folder_of(record).path());
    if registry.merge(&name(experiment), is_gone, Vec::new())?.is_none() {
        return Ok(Some(FolderLock::other(experiment)));
    }
    remove_empty(registry, experiment);
    Ok(None)
}

/// Removes the folder of a run or a dataset, or what is unfinished, or several published runs of an experiment, which
/// is faster than one by one; see [`Removable::together`]. If a process works there, nothing changes, and the process is
/// returned.
///
/// A folder is renamed first, so that an interruption leaves no part of it under its name. The next call removes what an
/// interruption left.
pub fn remove(registry: &Registry, items: &[Removable]) -> Result<Option<String>, RegistryError> {
    let Some(item) = items.first() else { return Ok(None) };
    if let Some(experiment) = item.path.parent().filter(|_| item.is_merged) {
        return remove_merged(registry, experiment, items);
    }
    if !item.path.exists() {
        return Ok(None);
    }
    if item.path.is_file() {
        return Ok((!remove_abandoned(&item.path)?).then(|| ANOTHER.into()));
    }
    let Some(lock) = FolderLock::attempt(&item.path)? else {
        return Ok(Some(FolderLock::other(&item.path)));
    };
    registry.discard(&item.path, lock)?;
    if let Some(experiment) = item.path.parent().filter(|folder| *folder != registry.root()) {
        remove_empty(registry, experiment);
    }
    registry.remove_set_aside();
    Ok(None)
}

/// Removes the folder of an experiment without runs, with the copies of its tables, or the folder of all datasets
/// if there is none. Errors are ignored, because an empty folder and the copies only take space.
fn remove_empty(registry: &Registry, folder: &Path) {
    let is_removed = std::fs::remove_dir(folder).is_ok();
    let copies = registry.compacted(&name(folder));
    if is_removed
        && folder.parent() == Some(&registry.runs())
        && copies.exists()
        && let Ok(Some(lock)) = FolderLock::attempt(&copies)
    {
        let _ = registry.discard(&copies, lock);
    }
}

/// The names of finished runs that have a later run with the same settings in the same world. A run whose world has
/// changed since supersedes none that counts.
fn superseded<'a>(records: impl Iterator<Item = &'a RunRecord>, outdated: &Outdated) -> BTreeSet<String> {
    let place = |record: &'a RunRecord| (!outdated.has(record), record.started.as_str());
    let mut kept: BTreeMap<(&str, &str, Worlds), &RunRecord> = BTreeMap::new();
    let mut superseded = BTreeSet::new();
    for record in records.filter(|record| record.status == Status::Done) {
        let key = (record.experiment.as_str(), record.spec_hash.as_str(), record.worlds());
        let other = match kept.get(&key) {
            Some(other) if place(other) > place(record) => Some(record),
            _ => kept.insert(key, record),
        };
        superseded.extend(other.map(RunRecord::name));
    }
    superseded
}

impl Removable {
    /// A folder or file with its size.
    pub fn new(path: &Path, name: String) -> Self {
        let bytes = match std::fs::symlink_metadata(path) {
            Ok(about) if about.is_file() => about.len(),
            _ => files(path).into_iter().map(|(_, bytes)| bytes).sum(),
        };
        Self { path: path.to_owned(), name, bytes, is_merged: false }
    }

    /// The folder of a run. The size of one that shares files with others is that of the files of its own.
    pub fn run(folder: &Path, record: &RunRecord) -> Self {
        Self { is_merged: record.is_merged(), ..Self::new(folder, record.name()) }
    }

    /// Whether two runs can be removed by one call.
    pub fn together(&self, other: &Self) -> bool {
        self.is_merged && other.is_merged && self.path.parent() == other.path.parent()
    }
}

fn name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// All files below a folder with their sizes, bytes. Links are not followed.
fn files(folder: &Path) -> Vec<(PathBuf, u64)> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let Ok(about) = entry.metadata() else { continue };
        if about.is_dir() {
            found.extend(files(&entry.path()));
        } else {
            found.push((entry.path(), about.len()));
        }
    }
    found
}
