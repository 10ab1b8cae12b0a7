//! What is wrong with a dataset's folder.

use super::DatasetError;
use super::store::{Description, episode_file, open_episode};
use harness_shared::files::UNFINISHED;
use harness_spec::Simulation;
use harness_tables::{TableError, TableFile};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// What a dataset's folder holds, and what is wrong with it.
#[derive(Debug, Default)]
pub struct Inspection {
    /// Recorded elsewhere: what is missing or damaged can't be made again here.
    pub imported: bool,
    /// Written in another format; nothing is known about its files, and no run uses them.
    pub outdated: bool,
    /// Why its description can't be used: it is damaged, missing, or that of a dataset of another name. Episodes are
    /// compared with their seals alone then.
    pub undescribed: Option<String>,
    /// Episodes that are what they should be, by index.
    pub whole: BTreeMap<u32, PathBuf>,
    /// Episodes that its description speaks of.
    pub promised: u32,
    /// Those of them that are not there.
    pub missing: Vec<u32>,
    /// Episodes that are not as they were written, and what is wrong with each.
    pub damaged: Vec<(PathBuf, String)>,
    /// Files that don't belong there.
    pub unknown: Vec<PathBuf>,
}

/// How many samples a dataset's episodes have.
enum Lengths {
    Simulated(Simulation),
    Imported(Vec<usize>),
}

impl Lengths {
    /// What the description of the dataset of that name promises; `None` if it is another's.
    fn of(description: &Description, name: &str) -> Option<Self> {
        let imported = || description.imported(name).map(|content| Self::Imported(content.samples()));
        description.simulated(name).map(|(_, simulation)| Self::Simulated(simulation)).or_else(imported)
    }

    fn episodes(&self) -> u32 {
        match self {
            Self::Simulated(simulation) => simulation.episodes,
            Self::Imported(samples) => samples.len() as u32,
        }
    }

    /// Samples of an episode; `None` where there can be no such episode.
    fn samples(&self, index: u32) -> Option<usize> {
        match self {
            // A longer dataset was collected before a shorter one was asked for.
            Self::Simulated(simulation) => Some(simulation.samples_per_episode()),
            Self::Imported(samples) => samples.get(index as usize).copied(),
        }
    }
}

/// Compares every file in a dataset's folder with its seal, and all of them with the dataset's description;
/// calls `advance` at each.
pub fn inspect(folder: &Path, advance: &(dyn Fn() + Sync)) -> Inspection {
    let mut found = Inspection::default();
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    let lengths = match Description::read(folder) {
        Ok(description) if !description.is_current() => {
            found.outdated = true;
            return found;
        }
        Ok(description) => {
            Lengths::of(&description, &name).ok_or("it does not describe this dataset".to_owned())
        }
        Err(reason) => Err(reason),
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
    found.promised = lengths.map_or(0, |lengths| lengths.episodes());
    found.missing = (0..found.promised).filter(|index| !present.contains(index)).collect();
    found
}

/// What a file in a dataset's folder is.
enum Checked {
    /// The episode of that index.
    Whole(u32),
    /// The same, and what is wrong with it.
    Damaged(u32, String),
    /// The description, or a lock.
    Known,
    Unknown,
}

fn check(path: &Path, dataset: &str, lengths: Option<&Lengths>) -> Checked {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let Some(index) = episode_index(&name) else {
        return if name == Description::FILE || is_lock(&name) { Checked::Known } else { Checked::Unknown };
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

/// The index in an episode's file name, `episode_00012.parquet`.
fn episode_index(name: &str) -> Option<u32> {
    let index = name.strip_prefix("episode_")?.strip_suffix(".parquet")?.parse().ok()?;
    (name == episode_file(index)).then_some(index)
}

/// Whether a file is what processes lock to keep out of each other's way; it holds nothing.
pub fn is_lock(name: &str) -> bool {
    name.starts_with(UNFINISHED) && name.ends_with("lock")
}

fn sorted(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
    paths.sort();
    paths
}
