//! What is wrong with a dataset's folder.

use super::DatasetError;
use super::store::{Description, open_episode};
use crate::files::UNFINISHED;
use crate::seal;
use crate::spec::Simulation;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// What a dataset's folder holds, and what is wrong with it.
#[derive(Debug, Default)]
pub struct Inspection {
    /// Recorded elsewhere: what is missing or damaged can't be made again here.
    pub imported: bool,
    /// Written in another format; nothing is known about its files, and no run uses them.
    pub outdated: bool,
    /// Episodes that its description speaks of, and that are not there.
    pub missing: Vec<u32>,
    /// Files that are not as they were written, and what is wrong with each.
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
pub fn inspect(folder: &Path, advance: &dyn Fn()) -> Inspection {
    let mut found = Inspection::default();
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    let described = folder.join(Description::FILE);
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
    let lengths = match lengths {
        Ok(lengths) => Some(lengths),
        Err(reason) => {
            found.damaged.push((described.clone(), reason));
            None
        }
    };
    found.imported = matches!(lengths, Some(Lengths::Imported(_)));
    let mut present = BTreeSet::new();
    for path in sorted(folder) {
        advance();
        let name_of = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let index = name_of.strip_prefix("episode_").and_then(|rest| rest.strip_suffix(".parquet"));
        let index: Option<u32> = index.and_then(|digits| digits.parse().ok());
        let samples = index.zip(lengths.as_ref()).map(|(index, lengths)| lengths.samples(index));
        match (index, samples) {
            (Some(index), Some(Some(samples))) => {
                present.insert(index);
                match open_episode(&path, &name, index, samples) {
                    Err(DatasetError::Damaged { path, problem }) => found.damaged.push((path, problem)),
                    Err(error) => found.damaged.push((path, error.to_string())),
                    Ok(_) => {}
                }
            }
            (Some(_), None) => {
                if let Err(error) = seal::read(&path) {
                    found.damaged.push((path, error.to_string()));
                }
            }
            (Some(_), Some(None)) => found.unknown.push(path),
            (None, _) if path == described || is_lock(&name_of) => {}
            (None, _) => found.unknown.push(path),
        }
    }
    let promised = lengths.map_or(0, |lengths| lengths.episodes());
    found.missing = (0..promised).filter(|index| !present.contains(index)).collect();
    found
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
