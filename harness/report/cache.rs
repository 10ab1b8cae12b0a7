//! Caches pictures that take seconds to render and depend only on the program. The cache is the folder
//! `$XDG_CACHE_HOME/harness`, or `~/.cache/harness` if that variable isn't set.

use harness_shared::seal;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::{Path, PathBuf};

/// The hash of the program's sources. It is part of a file's name, so that another build never uses the file.
const SOURCES: &str = env!("HARNESS_SOURCES");

/// Returns the value in the cached file of this name. If there is no such file, or it can't be read, the function calls
/// `make`, tries to write the result to the file, and returns it. A cache that can't be written is no error.
///
/// # Errors
/// When `make` fails.
pub fn cached<T, E>(name: &str, make: impl FnOnce() -> Result<T, E>) -> Result<T, E>
where
    T: Serialize + DeserializeOwned,
{
    let Some(folder) = folder() else { return make() };
    let path = folder.join(format!("{name}-{SOURCES}"));
    if let Some(value) = read(&path) {
        return Ok(value);
    }
    let made = make()?;
    let written = serde_json::to_vec(&made).is_ok_and(|mut bytes| {
        bytes.extend_from_slice(seal::BLANK.as_bytes());
        seal::write(&path, bytes).is_ok()
    });
    if written {
        remove_others(&folder, name, &path);
    }
    Ok(made)
}

/// Reads a cached file. `None` if there is none, its seal does not match, or it has another format.
fn read<T: DeserializeOwned>(path: &Path) -> Option<T> {
    let bytes = seal::read(path).ok()?;
    serde_json::from_slice(&bytes[..bytes.len().checked_sub(seal::BLANK.len())?]).ok()
}

/// The cache's folder. `None` if it has no absolute path.
fn folder() -> Option<PathBuf> {
    let absolute = |path: PathBuf| path.is_absolute().then_some(path);
    let given = std::env::var_os("XDG_CACHE_HOME").map(PathBuf::from).and_then(absolute);
    let caches = given.or_else(|| Some(std::env::home_dir().and_then(absolute)?.join(".cache")))?;
    Some(caches.join("harness"))
}

/// Removes the files of this name that other builds have written, so that the folder doesn't grow.
fn remove_others(folder: &Path, name: &str, kept: &Path) {
    let prefix = format!("{name}-");
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let found = entry.file_name().to_string_lossy().into_owned();
        if found.starts_with(&prefix) && entry.path() != kept {
            // A file that can't be removed only costs space.
            let _ = std::fs::remove_file(entry.path());
        }
    }
}
