//! What is wrong with a dataset's folder.

use super::DatasetError;
use super::store::{Description, open_episode};
use crate::files::UNFINISHED;
use crate::seal;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// What a dataset's folder holds, and what is wrong with it.
#[derive(Debug, Default)]
pub struct Inspection {
    /// Written in another format; nothing is known about its files, and no run uses them.
    pub outdated: bool,
    /// Episodes that its description speaks of, and that are not there.
    pub missing: Vec<u32>,
    /// Files that are not as they were written, and what is wrong with each.
    pub damaged: Vec<(PathBuf, String)>,
    /// Files that don't belong there.
    pub unknown: Vec<PathBuf>,
}

/// Compares every file in a dataset's folder with its seal, and all of them with the dataset's description;
/// calls `advance` at each.
pub fn inspect(folder: &Path, advance: &dyn Fn()) -> Inspection {
    let mut found = Inspection::default();
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    let described = folder.join(Description::FILE);
    let simulation = match Description::read(folder) {
        Ok(description) if !description.is_current() => {
            found.outdated = true;
            return found;
        }
        Ok(description) => description.content(&name).ok_or("it does not describe this dataset".to_owned()),
        Err(reason) => Err(reason),
    };
    let simulation = match simulation {
        Ok((_, simulation)) => Some(simulation),
        Err(reason) => {
            found.damaged.push((described.clone(), reason));
            None
        }
    };
    let mut present = BTreeSet::new();
    for path in sorted(folder) {
        advance();
        let name_of = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let index = name_of.strip_prefix("episode_").and_then(|rest| rest.strip_suffix(".parquet"));
        match (index.and_then(|digits| digits.parse().ok()), &simulation) {
            (Some(index), Some(simulation)) => {
                present.insert(index);
                match open_episode(&path, &name, index, simulation.samples_per_episode()) {
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
            (None, _) if path == described || is_lock(&name_of) => {}
            (None, _) => found.unknown.push(path),
        }
    }
    let promised = simulation.map_or(0, |simulation| simulation.episodes);
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
