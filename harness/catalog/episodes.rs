//! The files of the `episodes` table.

use harness_registry::dataset::inspect;
use harness_registry::{Recorded, Registry, RegistryError, episodes_used};
use harness_shared::files::{FolderLock, folders};
use std::path::{Path, PathBuf};

/// The file of every episode of every dataset. A dataset is left out if it is not the one that its folder's name
/// says (such as a copy), or if it is in the format of another version.
///
/// # Errors
/// When an episode is damaged. When an episode is missing that one of `runs` used or that was imported, unless the
/// dataset is being collected.
pub fn episode_files(registry: &Registry, runs: &[Recorded]) -> Result<Vec<PathBuf>, RegistryError> {
    let mut used = episodes_used(runs.iter().map(|(_, record)| record));
    let mut files = Vec::new();
    for folder in folders(&registry.datasets()) {
        let name = folder.file_name().unwrap_or_default().to_string_lossy();
        files.extend(episodes_in(registry, &folder, used.remove(&*name).unwrap_or_default())?);
    }
    for name in used.keys() {
        let folder = registry.datasets().join(name);
        registry.leave_out(&folder, format!("a dataset that finished runs used is missing: {name}"));
    }
    Ok(files)
}

/// The files of a dataset's episodes. Finished runs used the first `used` of them.
fn episodes_in(registry: &Registry, folder: &Path, used: u32) -> Result<Vec<PathBuf>, RegistryError> {
    let found = inspect(folder, &|| ());
    if found.outdated {
        let problem = "it is in the format of another version, which this version can't read";
        registry.leave_out(folder, format!("{} is left out: {problem}", folder.display()));
        return Ok(Vec::new());
    }
    if let Some(problem) = found.undescribed {
        // A folder with nothing but a lock belongs to a collection that has not started.
        if !found.whole.is_empty() || !found.damaged.is_empty() {
            registry.leave_out(folder, format!("{} is left out: dataset.json: {problem}", folder.display()));
        }
        return Ok(Vec::new());
    }
    if let Some((path, reason)) = found.damaged.into_iter().next() {
        return Err(RegistryError::File { path, reason });
    }
    let episodes = found.promised.max(used);
    let is_missing = |index: &u32| !found.whole.contains_key(index);
    let missing = (0..episodes).filter(is_missing).count();
    if missing == 0 {
        return Ok(found.whole.into_values().collect());
    }
    let needed = if found.imported { episodes } else { used };
    let reason = match FolderLock::in_use(folder) {
        Some(holder) => format!("{holder} is collecting them"),
        None if (0..needed).any(|index| is_missing(&index)) => {
            return Err(RegistryError::Incomplete { path: folder.to_owned(), missing, episodes });
        }
        None => "their collection was interrupted".to_owned(),
    };
    let folder_name = folder.display();
    registry.leave_out(
        folder,
        format!("{missing} of the {episodes} episodes of {folder_name} are missing; {reason}"),
    );
    Ok(found.whole.into_values().collect())
}
