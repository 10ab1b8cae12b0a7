//! Complete copies: runs with all their files, and the datasets that they used, in another results folder.

use super::publish::check_target;
use super::{Busy, PublishError};
use crate::dataset::{Dataset, MODEL, inspect};
use crate::{RECORD, Recorded, Registry, RegistryError, Status, UNCOMMITTED};
use harness_shared::files::{FolderLock, write_bytes};
use harness_shared::progress::Progress;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The file that describes a dataset.
const DESCRIPTION: &str = "dataset.json";

/// The result of [`publish_completely`].
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Completed {
    /// Number of runs and datasets that were not there before, or not completely.
    pub copied: usize,
    /// Number of runs and datasets that were there before, with the same content.
    pub same: usize,
    /// Size of the files that were written, bytes.
    pub bytes: u64,
    /// Datasets that the runs used and that are not there to be copied.
    pub lacking: Vec<String>,
}

/// A folder to copy: that of a run or of a dataset.
struct Folder {
    from: PathBuf,
    to: PathBuf,
    /// The names of its files, in the order in which they are copied.
    files: Vec<String>,
}

/// Copies the finished ones of `chosen` runs, with all files and their datasets, to the registry `to`. The files keep
/// their bytes. Files that are there before are kept. The copy of a run has a record once all its other files are
/// there, so the same call continues an interrupted one.
///
/// # Errors
/// When no run is done, one is a published copy, `to` is the same registry, or a file is damaged. When a run or a dataset is there with other
/// content. Nothing is written in these cases. When another process works in a folder, or a file can't be written.
pub fn publish_completely(
    registry: &Registry,
    chosen: &[Recorded],
    to: &Registry,
    progress: &dyn Progress,
) -> Result<Completed, PublishError> {
    check_target(registry, to)?;
    let runs: Vec<&Recorded> = chosen.iter().filter(|(_, record)| record.status == Status::Done).collect();
    if runs.is_empty() {
        return Err(PublishError::Refused(format!(
            "none of these runs is done, so there is nothing to copy; `{}` shows why",
            registry.command("ls")
        )));
    }
    if let Some((_, record)) = runs.iter().find(|(_, record)| record.is_merged()) {
        return Err(PublishError::Refused(format!(
            "{} is a published copy, which has no tables of its own to copy; publish it without --complete",
            record.name()
        )));
    }
    let mut done = Completed::default();
    let mut folders = Vec::new();
    for (name, used) in episodes_of(&runs) {
        match registry.datasets().join(name) {
            from if from.is_dir() => folders.push(dataset(from, to.datasets().join(name), used)?),
            _ => done.lacking.push(name.to_owned()),
        }
    }
    for (from, record) in &runs {
        for name in record.files.keys() {
            record.read_file(from, name)?;
        }
        let others = [UNCOMMITTED, RECORD].into_iter().filter(|name| from.join(name).exists());
        let files = record.files.keys().cloned().chain(others.map(str::to_owned)).collect();
        folders.push(Folder { from: from.clone(), to: to.folder_of(record).path().to_owned(), files });
    }
    for folder in &mut folders {
        folder.keep_what_is_missing()?;
    }
    progress.begin("copying", folders.len() as u64, "folders");
    for folder in folders {
        match folder.files.is_empty() {
            true => done.same += 1,
            false => {
                done.bytes += folder.copy()?;
                done.copied += 1;
            }
        }
        progress.advance(1);
    }
    progress.end();
    Ok(done)
}

/// The number of episodes that these runs used of each dataset; 0 for imported datasets.
fn episodes_of<'a>(runs: &[&'a Recorded]) -> BTreeMap<&'a str, u32> {
    let mut used = BTreeMap::new();
    for (dataset, episodes) in runs.iter().flat_map(|(_, record)| record.datasets()) {
        let most = used.entry(dataset).or_default();
        *most = episodes.max(*most);
    }
    used
}

/// The intact files of a dataset of which runs used the first `used` episodes.
fn dataset(from: PathBuf, to: PathBuf, used: u32) -> Result<Folder, RegistryError> {
    let found = inspect(&from, &|| ());
    let undescribed = found.undescribed.map(|reason| (from.join(DESCRIPTION), reason));
    if let Some((path, reason)) =
        undescribed.into_iter().chain(found.damaged).chain(found.damaged_model).next()
    {
        return Err(RegistryError::File { path, reason });
    }
    if found.outdated {
        let reason = "it is in the format of another version".into();
        return Err(RegistryError::File { path: from.join(DESCRIPTION), reason });
    }
    let episodes = found.promised.max(used);
    let missing = (0..episodes).filter(|index| !found.whole.contains_key(index)).count();
    if missing > 0 {
        return Err(RegistryError::Incomplete { path: from, missing, episodes });
    }
    let name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let episodes = found.whole.range(..episodes).map(|(_, path)| name(path));
    let model = from.join(MODEL).exists().then(|| MODEL.to_owned());
    let files = [DESCRIPTION.to_owned()].into_iter().chain(model).chain(episodes).collect();
    Ok(Folder { from, to, files })
}

fn read(folder: &Path, name: &str) -> Result<Vec<u8>, RegistryError> {
    let path = folder.join(name);
    std::fs::read(&path).map_err(|error| RegistryError::File { path, reason: error.to_string() })
}

impl Folder {
    /// Leaves out the files that are there with the same bytes. Refuses a file with others.
    fn keep_what_is_missing(&mut self) -> Result<(), PublishError> {
        let mut missing = Vec::new();
        for name in std::mem::take(&mut self.files) {
            if !self.to.join(&name).exists() {
                missing.push(name);
                continue;
            }
            // Descriptions of a simulated dataset may differ in the number of episodes.
            let may_differ = name == DESCRIPTION && Dataset::at(&self.to).is_ok();
            if !may_differ && read(&self.to, &name)? != read(&self.from, &name)? {
                return Err(PublishError::Refused(format!(
                    "{} exists already with other content ({name}); nothing was copied. Choose another folder, or \
                     remove what is there",
                    self.to.display()
                )));
            }
        }
        self.files = missing;
        Ok(())
    }

    /// Copies the files, and returns their size in bytes.
    fn copy(&self) -> Result<u64, PublishError> {
        let Some(lock) = FolderLock::attempt(&self.to).map_err(RegistryError::from)? else {
            return Err(Busy::at(&self.to).into());
        };
        let mut size = 0;
        for name in &self.files {
            let bytes = read(&self.from, name)?;
            write_bytes(&self.to.join(name), &bytes).map_err(RegistryError::from)?;
            size += bytes.len() as u64;
        }
        lock.remove(&self.to);
        Ok(size)
    }
}
