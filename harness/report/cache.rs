//! Pictures that take seconds to render and depend on the program alone, kept from one report to the next in the user's
//! folder for caches: `$XDG_CACHE_HOME/harness`, or `~/.cache/harness`.

use harness_shared::seal;
use std::path::{Path, PathBuf};

/// What the program was made of: files of another program are not taken.
const SOURCES: &str = env!("HARNESS_SOURCES");

/// What the file of this name holds, or what `make` gives, which the file then holds. Where it can't be read or written,
/// or is damaged, it is made anew each time.
pub fn cached<E>(name: &str, make: impl FnOnce() -> Result<Vec<u8>, E>) -> Result<Vec<u8>, E> {
    let Some(folder) = folder() else { return make() };
    let path = folder.join(format!("{name}-{SOURCES}"));
    if let Ok(mut bytes) = seal::read(&path) {
        bytes.truncate(bytes.len() - seal::BLANK.len());
        return Ok(bytes);
    }
    let made = make()?;
    if seal::write(&path, [&made, seal::BLANK.as_bytes()].concat()).is_ok() {
        remove_others(&folder, name, &path);
    }
    Ok(made)
}

fn folder() -> Option<PathBuf> {
    let absolute = |path: PathBuf| path.is_absolute().then_some(path);
    let given = std::env::var_os("XDG_CACHE_HOME").map(PathBuf::from).and_then(absolute);
    let caches = given.or_else(|| Some(std::env::home_dir().and_then(absolute)?.join(".cache")))?;
    Some(caches.join("harness"))
}

/// Removes what other programs kept under the name, so that the folder doesn't grow.
fn remove_others(folder: &Path, name: &str, kept: &Path) {
    let prefix = format!("{name}-");
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let found = entry.file_name().to_string_lossy().into_owned();
        if found.starts_with(&prefix) && entry.path() != kept {
            // What stays takes room and does no other harm.
            let _ = std::fs::remove_file(entry.path());
        }
    }
}
