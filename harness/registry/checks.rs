//! Remembers which runs had only intact files, so that a plan of thousands of finished runs need not read all of them.
//!
//! ```text
//! results/compacted/<experiment>/checks.json
//! ```
//!
//! A run's files are read again if its record lists other files, or if the size, the times or the inode of one of them
//! has changed since. Published runs are always read, because their results folder is meant for version control. The
//! file can be deleted at any time.

use super::mark::Mark;
use super::{Registry, RunFolder, RunRecord};
use harness_shared::files::FolderLock;
use harness_shared::seal::{self, hex};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

/// The fewest new checks that are written: fewer are as quickly done again.
const FEWEST: usize = 64;
/// The file of an experiment's checks.
const FILE: &str = "checks.json";

/// What was checked of an experiment's runs.
#[derive(Debug)]
pub(super) struct Checks {
    /// The folders of the experiment's runs and of its checks.
    runs: PathBuf,
    folder: PathBuf,
    before: Remembered,
    now: Mutex<BTreeMap<String, String>>,
}

/// The content of the file.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Remembered {
    /// The fingerprints of runs whose files were intact, by the run's name.
    runs: BTreeMap<String, String>,
}

impl Checks {
    /// Reads the checks of an experiment. There are none if the file is missing or damaged.
    pub fn of(registry: &Registry, experiment: &str) -> Self {
        let (runs, folder) = (registry.runs().join(experiment), registry.compacted(experiment));
        let bytes = seal::read(&folder.join(FILE)).unwrap_or_default();
        Self {
            runs,
            folder,
            before: serde_json::from_slice(&bytes).unwrap_or_default(),
            now: Mutex::default(),
        }
    }

    /// Describes the first file of a run that is damaged, like [`RunRecord::damage`]. The files are not read if they
    /// were intact before and have not changed since.
    pub fn damage(&self, folder: &RunFolder, record: &RunRecord) -> Option<String> {
        if record.published {
            return record.damage(&folder.path);
        }
        let fingerprint = fingerprint(folder, record);
        if fingerprint.is_some() && fingerprint.as_ref() == self.before.runs.get(&record.run) {
            return None;
        }
        let damage = record.damage(&folder.path);
        if let Some(fingerprint) = fingerprint.filter(|_| damage.is_none()) {
            let mut now = self.now.lock().unwrap_or_else(PoisonError::into_inner);
            now.insert(record.run.clone(), fingerprint);
        }
        damage
    }

    /// Writes the checks to their file if there are many new ones. Those of runs that were removed are dropped. Checks
    /// are lost without harm if another process is writing, or the file can't be written.
    pub fn save(self) {
        let new = self.now.into_inner().unwrap_or_else(PoisonError::into_inner);
        if new.len() < FEWEST {
            return;
        }
        let before = self.before.runs.into_iter().filter(|(run, _)| self.runs.join(run).is_dir());
        let runs = before.chain(new).collect();
        if let (Ok(mut json), Ok(Some(_lock))) =
            (serde_json::to_value(Remembered { runs }), FolderLock::attempt(&self.folder))
        {
            json[seal::KEY] = seal::BLANK.into();
            let _ = seal::write(&self.folder.join(FILE), json.to_string().into_bytes());
        }
    }
}

/// A hash of the files that a record lists, and of what the file system says of them. `None` if a file is missing, or
/// was written so recently that another write might not be noticed.
fn fingerprint(folder: &RunFolder, record: &RunRecord) -> Option<String> {
    let mut digest = Sha256::new();
    for (name, listed) in &record.files {
        let mark = Mark::of(&folder.path.join(name)).filter(Mark::is_settled)?;
        digest.update(format!("{name} {} {mark:?} ", listed.sha256));
    }
    Some(hex(&digest.finalize()[..16]))
}
