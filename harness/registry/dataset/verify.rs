//! Checks the files of a dataset's folder.

use super::DatasetError;
use super::description::{Description, MODEL};
use super::episode_file::{episode_file, open_episode};
use harness_shared::files::{UNFINISHED, sorted};
use harness_spec::Simulation;
use harness_tables::{TableError, TableFile};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// The contents of a dataset's folder, and what is wrong with it.
#[derive(Debug, Default)]
pub struct Inspection {
    /// Whether the dataset was imported. If so, missing and damaged files can't be collected here.
    pub imported: bool,
    /// Whether the dataset has another format. If so, its files are not checked, and no run uses them.
    pub outdated: bool,
    /// Why the description can't be used: it is missing, damaged, or describes another dataset. In that case, episodes
    /// are compared only with their seals.
    pub undescribed: Option<String>,
    /// Undamaged episodes, by index.
    pub whole: BTreeMap<u32, PathBuf>,
    /// Number of episodes in the description.
    pub promised: u32,
    /// Indices of the episodes that are missing.
    pub missing: Vec<u32>,
    /// Damaged episodes, each with the problem.
    pub damaged: Vec<(PathBuf, String)>,
    /// The file of the model with the problem, if it is damaged or missing. No run reads it.
    pub damaged_model: Option<(PathBuf, String)>,
    /// Files that don't belong in the folder.
    pub unknown: Vec<PathBuf>,
}

/// The number of samples in a dataset's episodes.
enum Lengths {
    Simulated(Simulation),
    Imported(Vec<usize>),
}

impl Lengths {
    /// Returns the lengths in a description; `None` if it describes another dataset than `name`.
    fn of(description: &Description, name: &str) -> Option<Self> {
        let imported =
            || description.imported(name).map(|content| Self::Imported(content.samples().collect()));
        description.simulated(name).map(|(_, simulation)| Self::Simulated(simulation)).or_else(imported)
    }

    fn episodes(&self) -> u32 {
        match self {
            Self::Simulated(simulation) => simulation.episodes,
            Self::Imported(samples) => samples.len() as u32,
        }
    }

    /// Returns the number of samples in an episode; `None` if there can be no such episode.
    fn samples(&self, index: u32) -> Option<usize> {
        match self {
            // The index is not limited, because a longer dataset may have been collected before a shorter one.
            Self::Simulated(simulation) => Some(simulation.samples_per_episode()),
            Self::Imported(samples) => samples.get(index as usize).copied(),
        }
    }
}

/// Compares every file in a dataset's folder with its seal and with the dataset's description. Calls `advance` for each
/// file.
pub fn inspect(folder: &Path, advance: &(dyn Fn() + Sync)) -> Inspection {
    let mut found = Inspection::default();
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    let description = Description::read(folder);
    let lengths = match &description {
        Ok(description) if !description.is_current() => {
            found.outdated = true;
            return found;
        }
        Ok(description) => {
            Lengths::of(description, &name).ok_or("it does not describe this dataset".to_owned())
        }
        Err(reason) => Err(reason.clone()),
    };
    found.undescribed = lengths.as_ref().err().cloned();
    let lengths = lengths.ok();
    found.imported = matches!(lengths, Some(Lengths::Imported(_)));
    let checked = sorted(folder).into_par_iter().map(|path| {
        advance();
        let checked = check(&path, &name, lengths.as_ref());
        (path, checked)
    });
    let mut present = BTreeSet::new();
    for (path, checked) in checked.collect::<Vec<_>>() {
        match checked {
            Checked::Whole(index) => drop((present.insert(index), found.whole.insert(index, path))),
            Checked::Damaged(index, problem) => {
                present.insert(index);
                found.damaged.push((path, problem));
            }
            Checked::Known => {}
            Checked::Unknown => found.unknown.push(path),
        }
    }
    let fault_of_model = description.ok().and_then(|description| description.fault_of_model(folder));
    found.damaged_model = fault_of_model.map(|problem| (folder.join(MODEL), problem));
    found.promised = lengths.map_or(0, |lengths| lengths.episodes());
    found.missing = (0..found.promised).filter(|index| !present.contains(index)).collect();
    found
}

/// The kind of a file in a dataset's folder.
enum Checked {
    /// The undamaged episode with this index.
    Whole(u32),
    /// A damaged episode, with its index and the problem.
    Damaged(u32, String),
    /// The description, the model, or a lock.
    Known,
    /// Any other file.
    Unknown,
}

fn check(path: &Path, dataset: &str, lengths: Option<&Lengths>) -> Checked {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let Some(index) = episode_index(&name) else {
        let is_known = [Description::FILE, MODEL].contains(&&*name) || is_lock(&name);
        return if is_known { Checked::Known } else { Checked::Unknown };
    };
    let opened = match lengths.map(|lengths| lengths.samples(index)) {
        Some(Some(samples)) => open_episode(path, dataset, index, samples).map(drop),
        Some(None) => return Checked::Unknown,
        None => TableFile::open(path).map(drop).map_err(DatasetError::from),
    };
    match opened {
        Ok(()) => Checked::Whole(index),
        Err(
            DatasetError::Damaged { problem, .. }
            | DatasetError::Table(TableError::Read { reason: problem, .. }),
        ) => Checked::Damaged(index, problem),
        Err(error) => Checked::Damaged(index, error.to_string()),
    }
}

/// Returns the index in an episode's file name, `episode_00012.parquet`.
fn episode_index(name: &str) -> Option<u32> {
    let index = name.strip_prefix("episode_")?.strip_suffix(".parquet")?.parse().ok()?;
    (name == episode_file(index)).then_some(index)
}

/// Whether a file is an empty file that processes lock, so that only one of them writes to a folder.
pub fn is_lock(name: &str) -> bool {
    name.starts_with(UNFINISHED) && name.ends_with("lock")
}
