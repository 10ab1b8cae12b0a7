//! Files that are either whole or not there.

use std::fs::Permissions;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

/// How the name of a file begins that is not whole yet.
pub const UNFINISHED: &str = ".unfinished-";

/// A file that could not be written.
#[derive(Debug, thiserror::Error)]
#[error("can't write {}: {source}", path.display())]
pub struct WriteError {
    pub path: PathBuf,
    #[source]
    pub source: io::Error,
}

/// Lets `write` fill a file of a temporary name beside `path`, flushes it to disk and gives it its name.
///
/// Whoever looks at `path` sees the old file, the new file or none, never a part of one.
pub fn write_whole(path: &Path, write: impl FnOnce(&Path) -> io::Result<()>) -> Result<(), WriteError> {
    let attempt = || {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        std::fs::create_dir_all(folder)?;
        let temporary = tempfile::Builder::new()
            .prefix(UNFINISHED)
            .permissions(Permissions::from_mode(0o666))
            .tempfile_in(folder)?
            .into_temp_path();
        write(&temporary)?;
        std::fs::File::open(&temporary)?.sync_all()?;
        temporary.persist(path).map_err(|error| error.error)
    };
    attempt().map_err(|source| WriteError { path: path.to_owned(), source })
}

/// Writes `bytes` as a whole file.
pub fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    write_whole(path, |file| std::fs::write(file, bytes))
}
