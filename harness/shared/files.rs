//! Files that are either whole or not there, and folders that one process at a time works in.

use std::fs::{File, OpenOptions, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use sysinfo::Disks;

/// How the name of a file begins that is not whole yet.
pub const UNFINISHED: &str = ".unfinished-";
/// The file of a folder that whoever works there locks. It stays when the work is over, and says who was last.
pub const LOCK: &str = ".unfinished-lock";

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
        let permissions = std::fs::metadata(&temporary)?.permissions();
        write(&temporary)?;
        // A writer that makes the file anew may make it readable to this user alone.
        std::fs::set_permissions(&temporary, permissions)?;
        std::fs::File::open(&temporary)?.sync_all()?;
        temporary.persist(path).map_err(|error| error.error)
    };
    attempt().map_err(|source| WriteError { path: path.to_owned(), source })
}

/// Writes `bytes` as a whole file.
pub fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    write_whole(path, |file| std::fs::write(file, bytes))
}

/// A folder that can't be locked.
#[derive(Debug, thiserror::Error)]
#[error("can't lock {}: {source}", path.display())]
pub struct LockError {
    pub path: PathBuf,
    #[source]
    pub source: io::Error,
}

/// A folder in which only its holder writes, until this is dropped.
///
/// It is an advisory lock (flock), which the system lets go of when its holder dies, however it dies. Between machines
/// it holds on NFS 4, where the server frees a dead client's locks after its lease (about 90 s), and on file systems
/// that support flock across nodes; Lustre must be mounted with `flock`, not `localflock`.
#[derive(Debug)]
pub struct FolderLock {
    _file: File,
}

impl FolderLock {
    /// Locks a folder, which is made if need be, and removes what killed processes left unfinished in it; `None` if
    /// it is locked already, by this process or another.
    pub fn attempt(folder: &Path) -> Result<Option<Self>, LockError> {
        let path = folder.join(LOCK);
        let attempt = || {
            std::fs::create_dir_all(folder)?;
            let mut file = OpenOptions::new().create(true).write(true).truncate(false).open(&path)?;
            match file.try_lock() {
                Ok(()) => {}
                Err(std::fs::TryLockError::WouldBlock) => return Ok(None),
                Err(std::fs::TryLockError::Error(error)) => return Err(error),
            }
            // On a full disk the name is missing, and the lock holds all the same.
            let _ = file.set_len(0).and_then(|()| file.write_all(this_process().as_bytes()));
            Ok(Some(Self { _file: file }))
        };
        let lock = attempt().map_err(|source| LockError { path: path.clone(), source })?;
        if lock.is_some() {
            remove_unfinished(folder);
        }
        Ok(lock)
    }

    /// Locks a folder together with others that ask for a share of it; `None` if one process has it alone. Files that others
    /// have not finished stay.
    ///
    /// # Errors
    /// When the folder can't be made or its lock can't be opened.
    pub fn attempt_shared(folder: &Path) -> Result<Option<Self>, LockError> {
        let path = folder.join(LOCK);
        let attempt = || {
            std::fs::create_dir_all(folder)?;
            let file = OpenOptions::new().create(true).write(true).truncate(false).open(&path)?;
            match file.try_lock_shared() {
                Ok(()) => Ok(Some(Self { _file: file })),
                Err(std::fs::TryLockError::WouldBlock) => Ok(None),
                Err(std::fs::TryLockError::Error(error)) => Err(error),
            }
        };
        attempt().map_err(|source| LockError { path: path.clone(), source })
    }

    /// Who holds a folder's lock alone, for example `process 4711 on host`; `None` if nobody does. Writes nothing.
    pub fn holder(folder: &Path) -> Option<String> {
        let path = folder.join(LOCK);
        match File::open(&path).ok()?.try_lock_shared() {
            Err(std::fs::TryLockError::WouldBlock) => {
                let name = std::fs::read_to_string(&path).ok().filter(|name| !name.is_empty());
                Some(name.unwrap_or_else(|| "another process".into()))
            }
            _ => None,
        }
    }
}

fn this_process() -> String {
    let host = sysinfo::System::host_name().unwrap_or_else(|| "an unnamed host".into());
    format!("process {} on {host}", std::process::id())
}

/// Removes the unfinished files of a folder, whose lock the caller holds.
fn remove_unfinished(folder: &Path) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name();
        if name != LOCK && name.to_string_lossy().starts_with(UNFINISHED) {
            // One that stays takes room and does no other harm.
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// Room on the disk that holds `path`: the one whose mount point is the longest part of it.
pub fn free_bytes(path: &Path) -> Option<u64> {
    let path = std::path::absolute(path).ok()?;
    let disks = Disks::new_with_refreshed_list();
    let holders = disks.iter().filter(|disk| path.starts_with(disk.mount_point()));
    holders.max_by_key(|disk| disk.mount_point().as_os_str().len()).map(|disk| disk.available_space())
}
