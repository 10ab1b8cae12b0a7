//! Tags: names that users give to runs. They are in one file beside the runs, and no part of a record or a hash.

use super::{Registry, RegistryError};
use harness_shared::files::FolderLock;
use harness_shared::seal;
use polars::prelude::{DataFrame, PolarsResult};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// The file of the tags in a results folder.
const FILE: &str = "tags.json";
/// The key of the tags in the file.
const TAGS: &str = "tags";
/// How long another process that changes the tags is waited for.
const PATIENCE: Duration = Duration::from_secs(10);

/// The tags of each run, by its name `experiment/run`.
pub type Tags = BTreeMap<String, BTreeSet<String>>;

/// Checks the name of a tag.
///
/// # Errors
/// When it has other characters than letters, digits, `-`, `_` and `.`, or none.
pub fn check_tag(name: &str) -> Result<(), RegistryError> {
    let is_allowed = |character: char| character.is_ascii_alphanumeric() || "-_.".contains(character);
    match !name.is_empty() && name.chars().all(is_allowed) {
        true => Ok(()),
        false => Err(RegistryError::TagName(name.to_owned())),
    }
}

/// The tags of each row of a table of runs, with spaces between them; `None` for a run without a tag.
pub fn tags_of(runs: &DataFrame, tags: &Tags) -> PolarsResult<Vec<Option<String>>> {
    let names = runs.column("experiment")?.str()?.iter().zip(runs.column("run")?.str()?.iter());
    let of_run = |(experiment, run): (Option<&str>, Option<&str>)| {
        let own = tags.get(&format!("{}/{}", experiment?, run?))?;
        Some(own.iter().map(String::as_str).collect::<Vec<_>>().join(" "))
    };
    Ok(names.map(of_run).collect())
}

impl Registry {
    /// The tags of all runs, also of runs that were removed.
    pub fn tags(&self) -> Result<Tags, RegistryError> {
        let path = self.tags_file();
        let damaged = |reason: String| RegistryError::Tags { path: path.clone(), reason };
        if !path.exists() {
            return Ok(Tags::new());
        }
        let bytes = seal::read(&path).map_err(|error| damaged(error.to_string()))?;
        let mut file: Value = serde_json::from_slice(&bytes).map_err(|error| damaged(error.to_string()))?;
        let tags = file.get_mut(TAGS).map(Value::take).unwrap_or_default();
        serde_json::from_value(tags).map_err(|error| damaged(error.to_string()))
    }

    /// Gives a tag to runs, or takes it away if `remove`. Returns the number of runs that have changed.
    ///
    /// # Errors
    /// When the name of the tag is not allowed, the file of the tags is damaged or can't be written, or another process
    /// does not stop to change it.
    pub fn tag(&self, runs: &[String], tag: &str, remove: bool) -> Result<usize, RegistryError> {
        check_tag(tag)?;
        let _lock = self.lock_tags()?;
        let mut tags = self.tags()?;
        let mut changed = 0;
        for run in runs {
            let own = tags.entry(run.clone()).or_default();
            changed += usize::from(if remove { own.remove(tag) } else { own.insert(tag.to_owned()) });
        }
        tags.retain(|_, own| !own.is_empty());
        if changed > 0 {
            let file = json!({ (seal::KEY): seal::BLANK, (TAGS): tags });
            seal::write(&self.tags_file(), format!("{file:#}\n").into_bytes())?;
        }
        Ok(changed)
    }

    fn tags_file(&self) -> PathBuf {
        self.root.join(FILE)
    }

    /// Waits for the right to change the tags.
    fn lock_tags(&self) -> Result<FolderLock, RegistryError> {
        let start = Instant::now();
        loop {
            if let Some(lock) = FolderLock::attempt(&self.runs())? {
                return Ok(lock);
            }
            if start.elapsed() > PATIENCE {
                let holder = FolderLock::other(&self.runs());
                return Err(RegistryError::TagsInUse { path: self.tags_file(), holder });
            }
        }
    }
}
